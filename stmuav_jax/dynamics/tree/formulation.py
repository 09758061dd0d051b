"""Formulation in the relative coordinates of a spanning tree, with loop-closure constraints.

With the tree's velocities u, spatial axes S_k and frames' velocities V = sum S_k u_k,

    [ M   -J^T ] [ du/dt  ]   [ -h    ]
    [ J    0   ] [ lambda ] = [ gamma ],

M follows from composite inertias, h from the velocity-product accelerations (exact, in closed
form) and the loads, J from the loop-closing joints' primitives and the axes S_k. If the system
floats, all are written in the base's axes and do not depend on the position of the base.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6 (composite inertias)
and ch. 8 (closed loops). Derivation: docs/dynamics.md.
"""

import dataclasses
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra import lapack
from ...algebra.compiler import kept_jit
from ...algebra.linalg import solve_saddle
from ...algebra.rotation import conjugate, cross, product, rotation_matrix
from ...algebra.stacked import apply, apply_transposed
from ...mechanics.constraint import ROWS
from ...mechanics.load import total_load
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.base import AbstractFormulation, Accelerations, Flows, Residuals
from ..formulations.constraints import constraints
from ..formulations.reactions import Reactions, joint_reactions
from ..formulations.stabilisation import AbstractStabilisation
from .closures import Placed, Rows, closure_rows, in_world, kinematics
from .coordinates import (
    TreeCoordinates,
    filled,
    join,
    moved,
    normalised,
    rates,
    read,
    split,
    with_unit_vectors,
)
from .derivatives import forward_dynamics
from .elimination import has_small_blocks
from .motion import (
    TreeMotion,
    bias,
    bias_of_base,
    body_accelerations,
    inertia,
    mass_matrix,
    motion,
    wrenches_by_frame,
)
from .parameters import TreeParameters, euler_parameters, tree_parameters
from .projection import TreeModel, all_columns, closed, left
from .reactions import tree_reactions
from .singular import interpolated, kept_rows, nearness
from .topology import spanning_tree


class Loads(NamedTuple):
    """Sum of all loads, components first: world force [N], moment in body axes [N m], power [W].

    The power is that of the loads without potential energy.
    """

    force: Float[Array, "3 n"]
    moment: Float[Array, "3 n"]
    power: Float[Array, "*s"]


class Solved(NamedTuple):
    """Solution of the equations of motion: accelerations `rate` and multipliers of the `rows`.

    `moving` and `placed` are the motion in frame 0 and that of the bodies in the world.
    """

    moving: TreeMotion
    placed: Placed
    rows: Rows | None
    loads: Loads
    rate: Float[Array, "k"]
    multipliers: Float[Array, "m"]


class Tree(AbstractFormulation):
    """Formulation in relative coordinates of a spanning tree; only loop closures have multipliers.

    The multipliers belong to the loop closures' rows in the axes of frame 0; the reactions at
    all joints follow from them and from the bodies' accelerations.

    Args:
        cut: names of joints that close loops; by default those with the fewest rows. See
            `spanning_tree` for the tree that results.
        redundant: allow dependent rows; multipliers are then those of minimum norm.
    """

    cut: tuple[str, ...] = eqx.field(static=True, default=())
    redundant: bool = eqx.field(static=True, default=False)

    def __str__(self) -> str:
        return f"Tree(cut={', '.join(self.cut) or 'chosen'}, redundant={self.redundant})"

    def allowing_dependent_rows(self) -> "Tree":
        return self if self.redundant else dataclasses.replace(self, redundant=True)

    def prepare(self, system: System) -> TreeModel:
        tree = spanning_tree(system, self.cut)
        parameters = tree_parameters(system, tree)
        alone = tree.floating and not tree.steps
        inverse = _inverse_of_base(parameters) if alone else None
        return TreeModel(system, parameters, constraints(system, joints=tree.cut), inverse)

    def to_vector(self, model: TreeModel, state: State) -> Float[Array, " k"]:
        return join(read(model.parameters, state))

    def to_state(self, model: TreeModel, x: Float[Array, " k"]) -> State:
        at = split(model.parameters.tree, x)
        placed = in_world(model.parameters, at, motion(model.parameters, at))
        p = euler_parameters(model.parameters, at.q, at.u)[:, :-1]
        p = product(at.p, p) if model.parameters.tree.floating else p
        bodies = lambda x: x[:, :-1].T
        return State(bodies(placed.r), p.T, bodies(placed.v), bodies(placed.omega))

    def accelerations(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        state: State,
        stabilisation: AbstractStabilisation,
    ) -> Accelerations:
        at = read(model.parameters, state)
        solved = self._solve(model, t, at, stabilisation, dependent="minimum norm")
        v_rate, omega_rate = body_accelerations(model.parameters, at, solved.moving, solved.rate)
        return Accelerations(v_rate.T, omega_rate.T, solved.multipliers)

    def derivative(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        tree, how = model.parameters.tree, stabilisation
        at = split(tree, x)
        solved = self._solve(model, t, at, how)
        u_rate, driven = solved.rate, _driven(solved)
        if self._passes(model):
            u_rate, driven = self._through(model, t, x, how)
        rate = with_unit_vectors(tree, rates(tree, at, u_rate), how.held_norms, at)
        load, placed = solved.loads, solved.placed
        moment = cross(placed.r, load.force) + apply(placed.R_wb, load.moment)
        power = load.power if solved.rows is None else load.power + driven
        flows = Flows(power, jnp.sum(load.force[:, :-1], 1), jnp.sum(moment[:, :-1], 1))
        return join(rate), flows

    def reactions(
        self, model: TreeModel, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        system, tree = model.system, model.parameters.tree
        kin = system.kinematics(state)
        cut = _closure_reactions(model, t, state, result.multipliers)
        load = total_load(system.forces, t, kin)
        return tree_reactions(system, tree, kin, load, result, cut)

    def _solve(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        at: TreeCoordinates,
        how: AbstractStabilisation,
        *,
        dependent: Literal["fast", "minimum norm"] = "fast",
    ) -> Solved:
        tree = model.parameters.tree
        moving = motion(model.parameters, at)
        placed = in_world(model.parameters, at, moving)
        load = _loads(model.system, t, placed)
        force, moment = load.force[:, :-1], apply(moving.R[:, :, :-1], load.moment[:, :-1])
        if tree.floating:
            force = apply_transposed(rotation_matrix(at.p), force)
        wrench = wrenches_by_frame(tree, moving, force, moment)
        if model.inverse is not None:
            rate = -apply(model.inverse, bias_of_base(model.parameters, moving, wrench))
            return Solved(moving, placed, None, load, rate, rate[:0])
        rows = None
        if model.constraints.groups:
            rows = closure_rows(model.parameters, model.constraints, t, moving)
            off = jnp.sum(rows.J * at.u, axis=1) - rows.target
            rows = rows._replace(gamma=how.held_rows(rows.gamma, rows.value, off))
        if self._small(model):
            rate, multipliers = forward_dynamics(
                model.parameters, model.constraints, moving, wrench, rows
            )
            return Solved(moving, placed, rows, load, rate, multipliers)
        total = inertia(model.parameters, moving, wrench)
        h = bias(tree, moving.S, total)
        J, gamma = (jnp.zeros((0, len(at.u))), h[:0]) if rows is None else (rows.J, rows.gamma)
        rate, multipliers = solve_saddle(
            mass_matrix(tree, moving.S, total),
            all_columns(tree, J),
            -h,
            gamma,
            redundant=dependent if self.redundant else False,
            kept=model.kept,
        )
        return Solved(moving, placed, rows, load, rate, multipliers)

    def _small(self, model: TreeModel) -> bool:
        """True if the equations are solved branch by branch."""
        rows = sum(ROWS[group.kind] * len(group.i) for group in model.constraints.groups)
        return not self.redundant and has_small_blocks(model.parameters.tree, rows)

    def at_step(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> TreeModel:
        """Model with the independent rows that are kept until the integrator's step ends.

        A row that depends on others where the constraints hold need not do so at the stages of
        a step, where they are slightly violated; kept, it would get an arbitrary multiplier.
        """
        if not self._passes(model):
            return model
        kept = kept_rows(model, t, jax.lax.stop_gradient(split(model.parameters.tree, x)))
        return eqx.tree_at(lambda m: m.kept, model, kept, is_leaf=lambda x: x is None)

    def _through(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        how: AbstractStabilisation,
    ) -> tuple[Float[Array, " u"], Float[Array, ""]]:
        """Accelerations and the power of drivers, also near and in singular postures."""
        model = self.at_step(model, t, x) if model.kept is None else model
        at = split(model.parameters.tree, x)
        singular = nearness(model, t, at)

        def one(by: Float[Array, " u"]) -> tuple[Float[Array, " u"], Float[Array, ""]]:
            closed_there = lambda: closed(
                model, t, moved(model.parameters.tree, at, by), 3, self._small
            )[0]
            found = self._solve(
                model, t, jax.lax.cond(singular.near, closed_there, lambda: at), how
            )
            return found.rate, _driven(found)

        return interpolated(singular, at.u, one, power=3)

    def _passes(self, model: TreeModel) -> bool:
        """True if there are loop closures and their rows may depend on each other."""
        return self.redundant and bool(model.constraints.groups)

    def project(
        self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        tree = model.parameters.tree
        at = normalised(tree, split(tree, x))
        if not model.constraints.groups:
            return join(at), left(model, at, None)
        if not self._passes(model):
            at, rows = closed(model, t, at, iterations, self._small)
            return join(at), left(model, at, rows)
        model = self.at_step(model, t, x) if model.kept is None else model

        def one(by: Float[Array, " u"]) -> TreeCoordinates:
            start = moved(tree, at, by)
            end, _ = closed(model, t, start, iterations, self._small)
            return jax.tree.map(jnp.subtract, end, start)

        moves = interpolated(nearness(model, t, at), at.u, one, power=2)
        end = jax.tree.map(jnp.add, at, moves)
        end = normalised(tree, end)
        return join(end), self.residuals(model, t, join(end))

    def residuals(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> Residuals:
        at = split(model.parameters.tree, x)
        if not model.constraints.groups:
            return left(model, at, None)
        rows = closure_rows(model.parameters, model.constraints, t, motion(model.parameters, at))
        return left(model, at, rows)


def _driven(found: Solved) -> Float[Array, "*s"]:
    """Power of the drivers among the loop closures [W]."""
    rows = found.rows
    return jnp.zeros(()) if rows is None else jnp.sum(found.multipliers * rows.target, axis=0)


@kept_jit
def _inverse_of_base(parameters: TreeParameters) -> Float[Array, "6 6"]:
    """Inverse mass matrix of a floating base whose only joints are welds."""
    tree = parameters.tree
    at = filled(tree, jnp.zeros)
    moving = motion(parameters, at._replace(p=at.p.at[0].set(1.0)))
    total = inertia(parameters, moving, jnp.zeros_like(moving.V))
    return lapack.inverse(mass_matrix(tree, moving.S, total))


def _closure_reactions(
    model: TreeModel, t: Float[Array, ""], state: State, multipliers: Float[Array, " m"]
) -> Reactions:
    """Reactions at the loop-closing joints in world axes, from multipliers in frame 0's axes."""
    system, tree = model.system, model.parameters.tree
    if not tree.floating:
        return joint_reactions(system, model.constraints, t, state, multipliers)
    r, p = state.r[tree.root], state.p[tree.root]
    R_w0 = rotation_matrix(p)
    own = jax.vmap(product, in_axes=(None, 0))(conjugate(p), state.p)
    seen = State((state.r - r) @ R_w0, own, state.v @ R_w0, state.omega)
    found = joint_reactions(system, model.constraints, t, seen, multipliers)
    return Reactions(found.force @ R_w0.T, found.moment @ R_w0.T)


def _loads(system: System, t: Float[Array, ""], placed: Placed) -> Loads:
    """Sum of the loads of all force elements."""
    kin = kinematics(system, placed)
    load = total_load(system.forces, t, kin)
    return Loads(load.force.T, load.moment.T, load.power)
