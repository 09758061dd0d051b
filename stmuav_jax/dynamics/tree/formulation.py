"""Formulation in the relative coordinates of a spanning tree, with loop-closure constraints.

With the tree's velocities u, spatial axes S_k and frames' velocities V = sum S_k u_k,

    [ M   -J^T ] [ du/dt  ]   [ -h    ]
    [ J    0   ] [ lambda ] = [ gamma ],

M follows from composite inertias, h from the velocity-product accelerations (exact, in closed
form) and the loads, J from the loop-closing joints' primitives and the axes S_k. If the system
floats, all are written in the base's axes and do not depend on the position of the base.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6 (composite inertias)
and ch. 8 (closed loops). Derivation: docs/theory.md.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.numbers import as_jax
from ...math.compiler import kept_jit, remember_results
from ...math.derivative import directional_derivative
from ...math.linalg import Redundant, Saddle, factor_saddle
from ...math.native.program import native
from ...math.rotation import conjugate, cross, product, rotation_matrix
from ...math.stacked import apply_matrix, apply_transposed, sum_columns
from ...mechanics.load import Load, total_load
from ...mechanics.state import Kinematics, State
from ...mechanics.system import System
from ..formulations.base import (
    AbstractFormulation,
    Accelerations,
    Flows,
    Reactions,
    Residuals,
    joint_points,
    joint_reactions,
)
from ..formulations.constraints import Constraints, group_constraints
from ..formulations.independence import find_independent_rows, turn_rows
from ..formulations.stabilisation import AbstractStabilisation
from .closures import (
    Placed,
    Rows,
    TreeModel,
    all_columns,
    choose_order,
    close_loops,
    closure_rows,
    compute_residuals,
    in_world,
    interpolate_posture,
    make_kinematics,
    measure_nearness,
    rotate_rows,
    row_frames,
    step_rows,
    way_along,
)
from .coordinates import (
    TreeCoordinates,
    coordinate_rates,
    join_coordinates,
    normalise_vectors,
    read_coordinates,
    retract_coordinates,
    split_vector,
    with_unit_vectors,
)
from .motion import (
    TreeMotion,
    bias_force,
    body_accelerations,
    composite_inertia,
    compute_motion,
    mass_matrix,
    needed_wrenches,
    wrenches_by_frame,
)
from .parameters import TreeParameters, by_frame, euler_parameters, tree_parameters
from .topology import (
    SpanningTree,
    backward_pass,
    forward_pass,
    motion_columns,
    pick_entries,
    spanning_tree,
)


def tree_reactions(
    system: System,
    tree: SpanningTree,
    kin: Kinematics,
    load: Load,
    rates: Accelerations,
    cut: Reactions,
) -> Reactions:
    """Reactions at all joints, from those of the loop-closing joints.

    A joint of the tree transmits the wrench that the bodies behind it need for their
    accelerations beyond the loads and the reactions of loop-closing joints.

    Args:
        load: sum of the loads of all force elements.
        cut: reactions at the loop-closing joints, with zeros for the joints of the tree.
    """
    n = system.n_bodies
    bodies = system.bodies
    origin = kin.r[:1]
    R, omega = kin.R_wb[:-1], kin.omega[:-1]
    spin = jnp.einsum("nab,nb->na", bodies.inertia, omega)
    turning = jnp.einsum("nab,nb->na", bodies.inertia, rates.omega_rate) + jnp.cross(omega, spin)
    # Newton and Euler for each body give the wrench that its joints have to transmit in sum; in a tree
    # the sums over the bodies behind a joint determine each joint by itself.
    force = bodies.mass[:, None] * rates.v_rate - load.force[:-1]
    moment = jnp.einsum("nab,nb->na", R, turning - load.moment[:-1])
    # Moments are taken about the first body rather than about the world's origin: far from the origin
    # they would be differences of large numbers.
    moment = moment + jnp.cross(kin.r[:-1] - origin, force)
    points = joint_points(system, kin)[0] if system.joints else jnp.zeros((0, 3))
    about = cut.moment + jnp.cross(points - origin, cut.force)
    # Loop-closing joints act on their two bodies with opposite signs; their multipliers are known, and
    # their wrenches count as loads on the tree.
    ends = np.zeros((n + 1, len(system.joints)))
    names = list(kin.names)
    for k, joint in enumerate(system.joints):
        ends[names.index(joint.body_j), k] += 1.0
        ends[names.index(joint.body_i), k] -= 1.0
    force, moment = force - ends[:n] @ cut.force, moment - ends[:n] @ about
    behind = np.zeros((len(system.joints), n))
    for joint, sign, below in tree.behind():
        behind[joint, list(below)] = sign
    force, moment = behind @ force, behind @ moment
    moment = moment - jnp.cross(points - origin, force)
    return Reactions(cut.force + force, cut.moment + moment)


Solution = tuple[Float[Array, "l *s"], Float[Array, "m *s"]]


@eqx.filter_custom_jvp
def forward_dynamics(
    parameters: TreeParameters,
    constraints: Constraints,
    moving: TreeMotion,
    load: Float[Array, "6 F"],
    rows: Rows | None,
) -> Solution:
    """Accelerations (l,), in the order of `mass_matrix`, and multipliers (m,).

    Args:
        load: wrenches on the frames, see `wrenches_by_frame`.
        rows: constraint rows of the loop closures; None without any.
    """
    saddle, h, gamma = _factor_equations(parameters, constraints, moving, load, rows)
    return saddle.solve(-h, gamma)


@forward_dynamics.def_jvp
def _forward_dynamics_jvp(primals: Any, tangents: Any) -> tuple[Solution, Solution]:
    parameters, constraints, moving, load, rows = primals
    # The derivative is not taken through the factorisation: the tangents of the residuals M x + h - J^T y
    # and gamma - J x cost one pass over the tree, and the factors that solve for them exist already.
    saddle, h, gamma = _factor_equations(parameters, constraints, moving, load, rows)
    x, y = saddle.solve(-h, gamma)
    residual = lambda *setting: inverse_dynamics_residual(*setting, x, y)  # pyright: ignore[reportCallIssue]
    _, (h_dot, gamma_dot) = directional_derivative(residual, primals, tangents)
    return (x, y), saddle.solve(-h_dot, gamma_dot)


def _factor_equations(
    parameters: TreeParameters,
    constraints: Constraints,
    moving: TreeMotion,
    load: Float[Array, "6 F"],
    rows: Rows | None,
    redundant: Redundant = False,
) -> tuple[Saddle, Float[Array, " l"], Float[Array, " m"]]:
    """Equations of motion M x - J^T y = -h, J x = gamma in factors, with h and gamma."""
    tree = parameters.tree
    total = composite_inertia(parameters, moving, load)
    h = bias_force(tree, moving.S, total)
    J, gamma, row_mask = (
        (moving.S[:0], h[:0], None) if rows is None else (rows.J, rows.gamma, rows.row_mask)
    )
    M, J = mass_matrix(tree, moving.S, total), all_columns(tree, J)
    order = choose_order(tree, constraints)
    return factor_saddle(M, J, redundant=redundant, row_mask=row_mask, order=order), h, gamma


def inverse_dynamics_residual(
    parameters: TreeParameters,
    constraints: Constraints,
    moving: TreeMotion,
    load: Float[Array, "6 F *s"],
    rows: Rows | None,
    x: Float[Array, "l *s"],
    y: Float[Array, "m *s"],
) -> Solution:
    """Residuals M x + h - J^T y (l,) and gamma - J x (m,), from the frames' accelerations."""
    tree = parameters.tree
    base = 6 * tree.floating
    root = jnp.zeros((6, 1, *x.shape[1:]), x.dtype)
    joint_part = forward_pass(tree, root, by_frame(tree, moving.S * x[None, base:]))
    A = moving.A + joint_part
    if base:
        A = A + x[:6, None]
    wrench = needed_wrenches(parameters, moving, A) - load
    # on the base the wrenches of a joint on its two bodies cancel, whether it is closed or not
    on_base = jnp.sum(wrench, axis=1)
    row_residual = y
    if rows is not None:
        row_residual = rows.gamma
        for frame, W in zip(row_frames(tree, constraints), rows.wrenches, strict=True):
            holds = np.eye(wrench.shape[1])[frame]
            wrench = wrench - sum_columns(W * y[None], holds)
            row_residual = row_residual - jnp.sum(W * pick_entries(joint_part, frame, 1), axis=0)
    joint_part = jnp.sum(
        moving.S * pick_entries(backward_pass(tree, wrench), motion_columns(tree).frame, 1), axis=0
    )
    return (jnp.concatenate([on_base, joint_part]) if base else joint_part), row_residual


class Loads(NamedTuple):
    """Sum of all loads, components first: world force [N], moment in body axes [N m], power [W].

    The power is that of the loads without potential energy.
    """

    force: Float[Array, "3 n"]
    moment: Float[Array, "3 n"]
    power: Float[Array, "*s"]


class Solved(NamedTuple):
    """Solution of the equations of motion: accelerations `rate` and multipliers of the `rows`.

    `moving` and `placement` are the motion in frame 0 and that of the bodies in the world.
    """

    moving: TreeMotion
    placement: Placed
    rows: Rows | None
    loads: Loads
    rate: Float[Array, "k"]
    multipliers: Float[Array, "m"]


class Tree(AbstractFormulation):
    """Formulation in relative coordinates of a spanning tree; only loop closures have multipliers.

    The multipliers belong to the loop closures' rows in the axes of frame 0; the reactions at
    all joints follow from them and from the bodies' accelerations. Rows that depend on others in every
    posture, as in planar loops, are left out by `prepare`; the multipliers of `accelerations` are
    those of minimum norm in all rows.

    Args:
        cut: names of joints that close loops; by default those with the fewest rows. See
            `spanning_tree` for the tree that results.
        redundant: allow rows to become dependent in some postures, and select the rows again in every step.
    """

    cut: tuple[str, ...] = eqx.field(static=True, default=())
    redundant: bool = eqx.field(static=True, default=False)

    def __str__(self) -> str:
        return f"Tree(cut={', '.join(self.cut) or 'chosen'}, redundant={self.redundant})"

    def allowing_dependent_rows(self) -> "Tree":
        return self if self.redundant else dataclasses.replace(self, redundant=True)

    # The search for dependent rows takes longer than a short run.
    @remember_results
    def prepare(self, system: System) -> TreeModel:
        tree = spanning_tree(system, self.cut)
        parameters = tree_parameters(system, tree)
        # Rows that repeat others in every posture are found from the joints' geometry before any number is
        # traced: a mask keeps the shapes.
        row_mask = find_independent_rows(system, tree.cut).rows
        row_mask = None if row_mask is None else as_jax(row_mask)
        return TreeModel(system, parameters, group_constraints(system, joints=tree.cut), row_mask)

    def vector_size(self, model: TreeModel) -> int:
        tree = model.parameters.tree
        return tree.n_positions + tree.n_velocities

    def to_vector(self, model: TreeModel, state: State) -> Float[Array, " k"]:
        return join_coordinates(read_coordinates(model.parameters, state))

    def to_state(self, model: TreeModel, x: Float[Array, " k"]) -> State:
        return _vector_to_state(model.parameters, x)

    def accelerations(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        state: State,
        stabilisation: AbstractStabilisation,
    ) -> Accelerations:
        at = read_coordinates(model.parameters, state)
        solved = self._solve_coordinates(model, t, at, stabilisation, shared=True)
        v_rate, omega_rate = body_accelerations(model.parameters, at, solved.moving, solved.rate)
        multipliers = solved.multipliers
        if model.row_mask is not None:
            multipliers = turn_rows(model.constraints, solved.moving.R, multipliers, back=True)
        return Accelerations(v_rate.T, omega_rate.T, multipliers)

    def derivative(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        # Only a formulation that allows dependent rows pays for postures beside the present one.
        if self._may_interpolate(model):
            u_rate, driven = self._solve_interpolated(model, t, x, stabilisation)
            return _find_derivative(model, t, x, u_rate, driven, stabilisation)
        at = split_vector(model.parameters.tree, x)
        solved = self._solve_coordinates(model, t, at, stabilisation)
        motion = (solved.placement, solved.loads, solved.rate, _driver_power(solved))
        return _join_derivative(model.parameters, at, *motion, stabilisation)

    def reactions(
        self, model: TreeModel, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        system, tree = model.system, model.parameters.tree
        kin = system.kinematics(state)
        cut = _closure_reactions(model, t, state, result.multipliers)
        load = total_load(system.forces, t, kin)
        return tree_reactions(system, tree, kin, load, result, cut)

    def _solve_coordinates(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        at: TreeCoordinates,
        stabilisation: AbstractStabilisation,
        *,
        shared: bool = False,
    ) -> Solved:
        """Solution at given coordinates; the multipliers are those of all rows if they are `shared`."""
        tree = model.parameters.tree
        moving = compute_motion(model.parameters, at)
        placement = in_world(model.parameters, at, moving)
        load = _sum_loads(model.system, t, placement)
        force, moment = load.force[:, :-1], apply_matrix(moving.R[:, :, :-1], load.moment[:, :-1])
        if tree.floating:
            force = apply_transposed(rotation_matrix(at.p), force)
        wrench = wrenches_by_frame(tree, moving, force, moment)
        rows = None
        if model.constraints.groups:
            rows = closure_rows(model.parameters, model.constraints, t, moving)
            rate_residuals = jnp.sum(rows.J * at.u[None], axis=1) - rows.target
            rows = rows._replace(
                gamma=stabilisation.add_row_feedback(rows.gamma, rows.value, rate_residuals)
            )
        shared = shared and rows is not None and (self.redundant or model.row_mask is not None)
        every = rows if rows is None else rotate_rows(model, moving, rows)
        rows = (
            every
            if every is None or model.active_rows is None
            else every.with_mask(model.active_rows)
        )
        if not self.redundant and not shared:
            rate, multipliers = forward_dynamics(
                model.parameters, model.constraints, moving, wrench, rows
            )
            return Solved(moving, placement, rows, load, rate, multipliers)
        choice = self.redundant and ("minimum norm" if shared else "fast")
        saddle, h, gamma = _factor_equations(
            model.parameters, model.constraints, moving, wrench, rows, choice
        )
        rate, multipliers = saddle.solve(-h, gamma)
        if shared and every is not None:
            multipliers = saddle.share_multipliers(all_columns(tree, every.J), multipliers)
        return Solved(moving, placement, rows, load, rate, multipliers)

    def at_step(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> TreeModel:
        """Model with the independent rows that are kept until the integrator's step ends.

        A row that depends on others where the constraints hold need not do so at the stages of
        a step, where they are slightly violated; kept, it would get an arbitrary multiplier.
        """
        if not self._may_interpolate(model):
            return model
        rows = step_rows(model, t, jax.lax.stop_gradient(split_vector(model.parameters.tree, x)))
        return eqx.tree_at(lambda m: m.step_rows, model, rows, is_leaf=lambda x: x is None)

    def _solve_interpolated(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " u"], Float[Array, ""]]:
        """Accelerations and the power of drivers, also near and in singular postures."""
        model = self.at_step(model, t, x) if model.step_rows is None else model
        at = split_vector(model.parameters.tree, x)
        singular = measure_nearness(model, t, at)

        def solve_displaced(by: Float[Array, " u"]) -> tuple[Float[Array, " u"], Float[Array, ""]]:
            closed_there = lambda: _close_displaced(model, t, at, by, 3)[1]
            posture = jax.lax.cond(singular.is_near, closed_there, lambda: at)
            return _solve_posture(self, model, t, posture, stabilisation)

        return interpolate_posture(singular, way_along(model, at.u), solve_displaced, power=3)

    def _may_interpolate(self, model: TreeModel) -> bool:
        """True if there are loop closures and their rows may depend on each other."""
        return self.redundant and bool(model.constraints.groups)

    def project(
        self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        tree = model.parameters.tree
        at = normalise_vectors(tree, split_vector(tree, x))
        if not model.constraints.groups:
            return join_coordinates(at), compute_residuals(model, at, None)
        if not self._may_interpolate(model):
            at, rows = close_loops(model, t, at, iterations)
            return join_coordinates(at), compute_residuals(model, at, rows)
        model = self.at_step(model, t, x) if model.step_rows is None else model

        # The interpolated quantity is the displacement to the constraints, which stays small and smooth
        # through a singular posture, unlike the coordinates themselves.
        def closure_change(by: Float[Array, " u"]) -> TreeCoordinates:
            start, end = _close_displaced(model, t, at, by, iterations)
            return jax.tree.map(jnp.subtract, end, start)

        moves = interpolate_posture(
            measure_nearness(model, t, at), way_along(model, at.u), closure_change, power=2
        )
        end = jax.tree.map(jnp.add, at, moves)
        end = normalise_vectors(tree, end)
        return join_coordinates(end), self.residuals(model, t, join_coordinates(end))

    def residuals(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> Residuals:
        at = split_vector(model.parameters.tree, x)
        if not model.constraints.groups:
            return compute_residuals(model, at, None)
        rows = closure_rows(
            model.parameters, model.constraints, t, compute_motion(model.parameters, at)
        )
        return compute_residuals(model, at, rows)


def _driver_power(solution: Solved) -> Float[Array, "*s"]:
    """Power of the drivers among the loop closures [W]."""
    rows = solution.rows
    return jnp.zeros(()) if rows is None else jnp.sum(solution.multipliers * rows.target, axis=0)


def _join_derivative(
    parameters: TreeParameters,
    at: TreeCoordinates,
    placement: Placed,
    load: Loads,
    u_rate: Float[Array, " u"],
    driven: Float[Array, ""],
    stabilisation: AbstractStabilisation,
) -> tuple[Float[Array, " k"], Flows]:
    """Derivative of the vector and flows, from accelerations and the power of drivers."""
    rates = coordinate_rates(parameters.tree, at, u_rate)
    rates = with_unit_vectors(parameters.tree, rates, stabilisation.add_norm_feedback, at)
    # Flows of energy and momentum are integrated beside the state, so that the balances of a run's
    # accuracy report have the error of the integrator and not that of a quadrature afterwards.
    moment = cross(placement.r, load.force) + apply_matrix(placement.R_wb, load.moment)
    sums = (jnp.sum(x[:, :-1], axis=1) for x in (load.force, moment))
    return join_coordinates(rates), Flows(load.power + driven, *sums)


# The choice of rows and of postures is XLA's; the equations between them are machine code.
@native
def _find_derivative(
    model: TreeModel,
    t: Float[Array, ""],
    x: Float[Array, " k"],
    u_rate: Float[Array, " u"],
    driven: Float[Array, ""],
    stabilisation: AbstractStabilisation,
) -> tuple[Float[Array, " k"], Flows]:
    """`_join_derivative` of a vector, with its loads."""
    at = split_vector(model.parameters.tree, x)
    placement = in_world(model.parameters, at, compute_motion(model.parameters, at))
    load = _sum_loads(model.system, t, placement)
    return _join_derivative(model.parameters, at, placement, load, u_rate, driven, stabilisation)


@native
def _solve_posture(
    formulation: Tree,
    model: TreeModel,
    t: Float[Array, ""],
    at: TreeCoordinates,
    stabilisation: AbstractStabilisation,
) -> tuple[Float[Array, " u"], Float[Array, ""]]:
    """Accelerations and the power of drivers by the rows of a step."""
    solved = formulation._solve_coordinates(model, t, at, stabilisation)
    return solved.rate, _driver_power(solved)


@native
def _close_displaced(
    model: TreeModel,
    t: Float[Array, ""],
    at: TreeCoordinates,
    by: Float[Array, " u"],
    iterations: int,
) -> tuple[TreeCoordinates, TreeCoordinates]:
    """Coordinates after a displacement, before and after the loops are closed."""
    start = retract_coordinates(model.parameters.tree, at, by)
    return start, close_loops(model, t, start, iterations)[0]


@kept_jit
@native
def _vector_to_state(parameters: TreeParameters, x: Float[Array, " k"]) -> State:
    at = split_vector(parameters.tree, x)
    placement = in_world(parameters, at, compute_motion(parameters, at))
    p = euler_parameters(parameters, at.q, at.u)[:, :-1]
    p = product(at.p, p) if parameters.tree.floating else p
    bodies = lambda x: x[:, :-1].T
    return State(bodies(placement.r), p.T, bodies(placement.v), bodies(placement.omega))


def _closure_reactions(
    model: TreeModel, t: Float[Array, ""], state: State, multipliers: Float[Array, " m"]
) -> Reactions:
    """Reactions at the loop-closing joints in world axes, from multipliers in frame 0's axes."""
    system, tree = model.system, model.parameters.tree
    if not tree.floating:
        return joint_reactions(system, model.constraints, t, state, multipliers)
    r, p = state.r[tree.root], state.p[tree.root]
    R_w0 = rotation_matrix(p)
    # Multipliers of a floating machine belong to rows in the base's axes: the bodies are placed relative
    # to it, and the wrenches are turned back.
    relative_parameters = jax.vmap(product, in_axes=(None, 0))(conjugate(p), state.p)
    relative_state = State((state.r - r) @ R_w0, relative_parameters, state.v @ R_w0, state.omega)
    reactions = joint_reactions(system, model.constraints, t, relative_state, multipliers)
    return Reactions(reactions.force @ R_w0.T, reactions.moment @ R_w0.T)


def _sum_loads(system: System, t: Float[Array, ""], placement: Placed) -> Loads:
    """Sum of the loads of all force elements."""
    kin = make_kinematics(system, placement)
    load = total_load(system.forces, t, kin)
    return Loads(load.force.T, load.moment.T, load.power)
