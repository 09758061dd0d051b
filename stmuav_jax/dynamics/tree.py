"""Relative coordinates of a spanning tree, with the cut joints' rows as constraints.

With the tree's velocities u, spatial axes S_k and frames' velocities V = sum S_k u_k,

    [ M   -J^T ] [ du/dt  ]   [ -h    ]
    [ J    0   ] [ lambda ] = [ gamma ],

M from composite inertias, h from the velocity-product accelerations (exact, in closed form)
and the loads, J from the cut joints' primitives and the axes S_k. All of it is written in
the base's axes where the system floats, so that it does not depend on where the base is.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6 (composite inertias)
and ch. 8 (closed loops). Derivation: docs/dynamics.md.
"""

from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..algebra.linalg import solve_saddle
from ..algebra.rotation import (
    conjugate,
    cross,
    euler_parameter_rate,
    normalise,
    product,
    rotation_matrix,
)
from ..algebra.stacked import apply, apply_transposed
from ..mechanics.constraint import ROWS
from ..mechanics.load import total_load
from ..mechanics.state import State
from ..mechanics.system import System
from .balance import balanced
from .branches import serves
from .chain import Chain, chain, parameters
from .closing import TreeModel, all_columns, closed, left, moved
from .coordinates import Coordinates, join, read, shapes, split
from .cut import Placed, Rows, cut_rows, in_world, kinematics
from .differential import constraints
from .formulation import AbstractFormulation, Accelerations, Flows, Residuals
from .motion import (
    Motion,
    bias,
    bias_of_base,
    body_accelerations,
    inertia,
    mass_matrix,
    motion,
    wrenches_by_frame,
)
from .pose import kinds
from .reactions import Reactions, joint_reactions, tree_reactions
from .singular import interpolated, kept_rows, nearness
from .stabilisation import AbstractStabilisation, Baumgarte
from .topology import SpanningTree, spanning_tree


class Loads(NamedTuple):
    """The sum of all loads, components first: force in the world, moment in body axes."""

    force: Float[Array, "3 n"]
    moment: Float[Array, "3 n"]
    power: Float[Array, "*s"]


class Solved(NamedTuple):
    """Accelerations at one set of coordinates, with what they were made from."""

    moving: Motion
    placed: Placed
    rows: Rows | None
    loads: Loads
    rate: Float[Array, "k"]
    multipliers: Float[Array, "m"]


class Tree(AbstractFormulation):
    """Relative coordinates of a spanning tree; multipliers for the cut joints only.

    Args:
        cut: names of joints to cut; by default those with the fewest rows. See
            `spanning_tree` for the tree that results.
        redundant: allow dependent rows; multipliers are then those of minimum norm.

    Its multipliers belong to the cut joints' rows in the axes of frame 0; the reactions at
    all joints follow from them and from the bodies' accelerations.
    """

    cut: tuple[str, ...] = eqx.field(static=True, default=())
    redundant: bool = eqx.field(static=True, default=False)

    def prepare(self, system: System) -> TreeModel:
        tree = spanning_tree(system, self.cut)
        numbers = chain(system, tree)
        alone = tree.floating and not tree.steps
        inverse = _inverse_of_base(numbers) if alone else None
        return TreeModel(system, numbers, constraints(system, joints=tree.cut), inverse)

    def to_vector(self, model: TreeModel, state: State) -> Float[Array, " k"]:
        return join(read(model.chain, state))

    def to_state(self, model: TreeModel, x: Float[Array, " k"]) -> State:
        at = split(model.chain.tree, x)
        placed = in_world(model.chain, at, motion(model.chain, at))
        p = parameters(model.chain, at.q1, at.balls)[:, :-1]
        p = product(at.p, p) if model.chain.tree.floating else p
        bodies = lambda x: x[:, :-1].T
        return State(bodies(placed.r), p.T, bodies(placed.v), bodies(placed.omega))

    def accelerations(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        state: State,
        stabilisation: AbstractStabilisation,
    ) -> Accelerations:
        at = read(model.chain, state)
        solved = self._solve(model, t, at, stabilisation, dependent="minimum norm")
        v_rate, omega_rate = body_accelerations(model.chain, at, solved.moving, solved.rate)
        return Accelerations(v_rate.T, omega_rate.T, solved.multipliers)

    def derivative(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        stabilisation: AbstractStabilisation,
    ) -> tuple[Float[Array, " k"], Flows]:
        tree, how = model.chain.tree, stabilisation
        at = split(tree, x)
        solved = self._solve(model, t, at, how)
        u_rate, driven = solved.rate, _driven(solved)
        if self._passes(model):
            u_rate, driven = self._through(model, t, x, how)
        rate = _rates(tree, at, u_rate)
        if isinstance(how, Baumgarte):
            pull = lambda p: how.norm * (1 - jnp.sum(p**2, axis=0)) * p
            rate = rate._replace(p=rate.p + pull(at.p), balls=rate.balls + pull(at.balls))
        load, placed = solved.loads, solved.placed
        moment = cross(placed.r, load.force) + apply(placed.R_wb, load.moment)
        power = load.power if solved.rows is None else load.power + driven
        flows = Flows(power, jnp.sum(load.force[:, :-1], 1), jnp.sum(moment[:, :-1], 1))
        return join(rate), flows

    def reactions(
        self, model: TreeModel, t: Float[Array, ""], state: State, result: Accelerations
    ) -> Reactions:
        system, tree = model.system, model.chain.tree
        kin = system.kinematics(state)
        cut = _cut_reactions(model, t, state, result.multipliers)
        load = total_load(system.forces, t, kin)
        return tree_reactions(system, tree, kin, load, result, cut)

    def _solve(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        at: Coordinates,
        how: AbstractStabilisation,
        *,
        dependent: Literal["fast", "minimum norm"] = "fast",
    ) -> Solved:
        tree = model.chain.tree
        moving = motion(model.chain, at)
        placed = in_world(model.chain, at, moving)
        load = _loads(model.system, t, placed)
        force, moment = load.force[:, :-1], apply(moving.R[:, :, :-1], load.moment[:, :-1])
        if tree.floating:
            force = apply_transposed(rotation_matrix(at.p), force)
        wrench = wrenches_by_frame(tree, moving, force, moment)
        if model.inverse is not None:
            rate = -apply(model.inverse, bias_of_base(model.chain, moving, wrench))
            return Solved(moving, placed, None, load, rate, rate[:0])
        rows = None
        if model.constraints.groups:
            rows = cut_rows(model.chain, model.constraints, t, moving)
            if isinstance(how, Baumgarte):
                off = jnp.sum(rows.J * at.u, axis=1) - rows.target
                pull = 2 * how.alpha * off + how.beta**2 * rows.value
                rows = rows._replace(gamma=rows.gamma - pull)
        if self._small(model):
            rate, multipliers = balanced(model.chain, model.constraints, moving, wrench, rows)
            return Solved(moving, placed, rows, load, rate, multipliers)
        total = inertia(model.chain, moving, wrench)
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
        """Whether the equations are solved branch by branch."""
        rows = sum(ROWS[group.kind] * len(group.i) for group in model.constraints.groups)
        return not self.redundant and serves(model.chain.tree, rows)

    def at_step(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> TreeModel:
        """The model with the rows that count until the step is done.

        A row that depends on others where the constraints hold need not do so at the stages of
        a step, which are a little off; solved with all others it would act at any strength.
        """
        if not self._passes(model):
            return model
        kept = kept_rows(model, t, jax.lax.stop_gradient(split(model.chain.tree, x)))
        return eqx.tree_at(lambda m: m.kept, model, kept, is_leaf=lambda x: x is None)

    def _through(
        self,
        model: TreeModel,
        t: Float[Array, ""],
        x: Float[Array, " k"],
        how: AbstractStabilisation,
    ) -> tuple[Float[Array, " u"], Float[Array, ""]]:
        """Accelerations and the power of drivers, through singular postures too."""
        model = self.at_step(model, t, x) if model.kept is None else model
        at = split(model.chain.tree, x)
        singular = nearness(model, t, at)

        def one(by: Float[Array, " u"]) -> tuple[Float[Array, " u"], Float[Array, ""]]:
            closed_there = lambda: closed(
                model, t, moved(model.chain.tree, at, by), 3, self._small
            )[0]
            found = self._solve(
                model, t, jax.lax.cond(singular.near, closed_there, lambda: at), how
            )
            return found.rate, _driven(found)

        return interpolated(singular, at.u, one, power=3)

    def _passes(self, model: TreeModel) -> bool:
        """Whether rows may depend on each other."""
        return self.redundant and bool(model.constraints.groups)

    def project(
        self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"], iterations: int
    ) -> tuple[Float[Array, " k"], Residuals]:
        tree = model.chain.tree
        at = split(tree, x)
        at = at._replace(p=normalise(at.p), balls=normalise(at.balls))
        if not model.constraints.groups:
            return join(at), left(model, at, None)
        if not self._passes(model):
            at, rows = closed(model, t, at, iterations, self._small)
            return join(at), left(model, at, rows)
        model = self.at_step(model, t, x) if model.kept is None else model

        def one(by: Float[Array, " u"]) -> Coordinates:
            start = moved(tree, at, by)
            end, _ = closed(model, t, start, iterations, self._small)
            return jax.tree.map(jnp.subtract, end, start)

        moves = interpolated(nearness(model, t, at), at.u, one, power=2)
        end = jax.tree.map(jnp.add, at, moves)
        end = end._replace(balls=normalise(end.balls))
        return join(end), self.residuals(model, t, join(end))

    def residuals(self, model: TreeModel, t: Float[Array, ""], x: Float[Array, " k"]) -> Residuals:
        at = split(model.chain.tree, x)
        if not model.constraints.groups:
            return left(model, at, None)
        rows = cut_rows(model.chain, model.constraints, t, motion(model.chain, at))
        return left(model, at, rows)


def _driven(found: Solved) -> Float[Array, "*s"]:
    """The power of drivers in cut joints."""
    rows = found.rows
    return jnp.zeros(()) if rows is None else jnp.sum(found.multipliers * rows.target, axis=0)


@kept_jit
def _inverse_of_base(numbers: Chain) -> Float[Array, "6 6"]:
    """The inverse mass matrix of a base without joints but welds."""
    tree = numbers.tree
    at = Coordinates(*(jnp.zeros(shape) for shape in shapes(tree)))
    moving = motion(numbers, at._replace(p=at.p.at[0].set(1.0)))
    total = inertia(numbers, moving, jnp.zeros_like(moving.V))
    return jnp.linalg.inv(mass_matrix(tree, moving.S, total))


def _cut_reactions(
    model: TreeModel, t: Float[Array, ""], state: State, multipliers: Float[Array, " m"]
) -> Reactions:
    """Of the cut joints, world axes; the multipliers are those of rows in frame 0's axes."""
    system, tree = model.system, model.chain.tree
    if not tree.floating:
        return joint_reactions(system, model.constraints, t, state, multipliers)
    r, p = state.r[tree.root], state.p[tree.root]
    R_w0 = rotation_matrix(p)
    own = jax.vmap(product, in_axes=(None, 0))(conjugate(p), state.p)
    seen = State((state.r - r) @ R_w0, own, state.v @ R_w0, state.omega)
    found = joint_reactions(system, model.constraints, t, seen, multipliers)
    return Reactions(found.force @ R_w0.T, found.moment @ R_w0.T)


def _loads(system: System, t: Float[Array, ""], placed: Placed) -> Loads:
    """The sum of all force elements."""
    kin = kinematics(system, placed)
    load = total_load(system.forces, t, kin)
    return Loads(load.force.T, load.moment.T, load.power)


def _rates(tree: SpanningTree, at: Coordinates, u_rate: Float[Array, "k"]) -> Coordinates:
    """The rates of all coordinates at the given accelerations."""
    q1, shift, balls = kinds(tree, at.u)
    turning = euler_parameter_rate(at.balls, balls) if balls.shape[1] else at.balls
    if not tree.floating:
        return Coordinates(at.r, at.p, q1, shift, turning, at.v, at.omega, u_rate)
    return Coordinates(
        r=at.v,
        p=euler_parameter_rate(at.p, at.omega),
        q1=q1,
        shift=shift,
        balls=turning,
        v=apply(rotation_matrix(at.p), u_rate[3:6, None]),
        omega=u_rate[:3, None],
        u=u_rate[6:],
    )
