"""Loop closures of a tree: the constraint rows, the projection onto them, and motion through singular postures.

As a mechanism passes through a singular posture, its accelerations and the projection onto
its constraints are smooth along the motion, but their equations lose rank: round-off is divided
by a singular value that goes through zero. Near such a posture they are interpolated,

    f(0) = sum_j w_j f(s_j) + O(s^10),    s_j = +-s, +-2 s, ..., +-5 s,

from values f(s_j) at postures on the constraints a little before and after along the
velocities, where the equations have full rank.
"""

from collections.abc import Callable
from math import factorial
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...math.derivative import held_constant
from ...math.linalg import (
    count_products,
    factor_cholesky,
    factor_saddle,
    independent_rows,
    solve_lower,
)
from ...math.native.program import native
from ...math.rotation import cross, rotation_matrix
from ...math.stacked import apply_matrix, apply_transposed, multiply_matrices
from ...mechanics.body import GROUND
from ...mechanics.constraint import ROWS, BodyKinematics
from ...mechanics.state import Kinematics
from ...mechanics.system import System
from ..formulations.base import AbstractModel, Residuals, residuals_of
from ..formulations.constraints import Constraints
from ..formulations.independence import WEAK, longest_arm, row_scales, turn_rows
from .coordinates import TreeCoordinates, retract_coordinates, unit_vectors
from .motion import (
    TreeMotion,
    composite_inertia,
    compute_motion,
    mass_matrix,
)
from .parameters import TreeParameters
from .topology import SpanningTree, align_axes, find_supported, motion_columns, pick_entries


class Placed(NamedTuple):
    """Kinematics of bodies and ground in the world, components first; see `Kinematics`."""

    r: Float[Array, "3 N *s"]
    v: Float[Array, "3 N *s"]
    omega: Float[Array, "3 N *s"]
    R_wb: Float[Array, "3 3 N *s"]
    omega_w: Float[Array, "3 N *s"]


def in_world(parameters: TreeParameters, at: TreeCoordinates, moving: TreeMotion) -> Placed:
    """Positions and velocities of all bodies and of ground in the world."""
    tree = parameters.tree
    R, r, v, w = moving.R, moving.c, moving.v, moving.w
    omega = apply_transposed(R, w)
    if not tree.floating:
        return Placed(r - r[:, -1:], v, omega, R, w)
    # Only here the attitude and place of a floating base enter: everything before it is relative to the
    # base, so that its round-off does not grow with the distance from the origin.
    R_w0 = rotation_matrix(at.p)
    # The last body is the ground, which has to stay at rest exactly, without round-off of the base's
    # motion.
    moves = align_axes(np.arange(r.shape[1]) < r.shape[1] - 1, r.ndim - 1)
    R = jnp.where(moves[None, None], multiply_matrices(R_w0, R), align_axes(np.eye(3), R.ndim))
    moves = moves[None]
    r = jnp.where(moves, at.r + apply_matrix(R_w0, r), 0.0)
    v = jnp.where(moves, at.v + apply_matrix(R_w0, v), 0.0)
    omega = jnp.where(moves, omega, 0.0)
    return Placed(r, v, omega, R, apply_matrix(R, omega))


def make_kinematics(system: System, placement: Placed) -> Kinematics:
    """Kinematics of one state in the form that force elements take."""
    # XLA makes no kernels of these transposes: docs/theory.md, "Array layout"
    R = jnp.moveaxis(placement.R_wb, -1, 0)
    return Kinematics(
        r=placement.r.T,
        v=placement.v.T,
        omega=placement.omega.T,
        R_wb=R,
        omega_w=placement.omega_w.T,
        mass=jnp.concatenate([system.bodies.mass, jnp.zeros(1)]),
        com=jnp.concatenate([system.bodies.com, jnp.zeros((1, 3))]),
        names=(*system.names, GROUND),
        joints=system.joints,
    )


class Rows(NamedTuple):
    """Constraint rows of the loop closures, m of them.

    Attributes:
        value: constraint values Phi (m, *s).
        target: right-hand side of the velocity constraints J u = target (m, *s).
        gamma: right-hand side of the acceleration constraints J du/dt = gamma (m, *s).
        J: constraint Jacobian in the velocities of the tree's steps (m, k, *s); its columns for
            a floating base would be zero.
        wrenches: wrenches on bodies i and on bodies j per unit multiplier, moment about the
            origin of frame 0 and force, two of (6, m, *s); two more on those of mates where joints are coupled.
        row_mask: mask of the rows that the equations hold (m,), the others being zero; None if all are.
    """

    value: Float[Array, "m *s"]
    target: Float[Array, "m *s"]
    gamma: Float[Array, "m *s"]
    J: Float[Array, "m k *s"]
    wrenches: tuple[Float[Array, "6 m *s"], ...]
    row_mask: Bool[Array, " m"] | None = None

    def in_body_axes(self, constraints: Constraints, R: Float[Array, "3 3 N *s"]) -> "Rows":
        """Rows with those of coincident points in the axes of body i; R has the bodies' axes."""
        rotate_rows = lambda x: turn_rows(constraints, R, x)
        columns_of = lambda W: jnp.swapaxes(rotate_rows(jnp.swapaxes(W, 0, 1)), 0, 1)
        return Rows(
            rotate_rows(self.value),
            self.target,
            rotate_rows(self.gamma),
            rotate_rows(self.J),
            tuple(map(columns_of, self.wrenches)),
            self.row_mask,
        )

    def with_mask(self, row_mask: Bool[Array, " m"]) -> "Rows":
        """Rows with zeros in the place of those that are left out."""
        mask_rows = lambda x: jnp.where(row_mask.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0)
        wide = lambda W: jnp.where(row_mask.reshape(1, -1, *(1,) * (W.ndim - 2)), W, 0.0)
        value, target, gamma, J = map(mask_rows, (self.value, self.target, self.gamma, self.J))
        return Rows(value, target, gamma, J, tuple(map(wide, self.wrenches)), row_mask)


def row_bodies(constraints: Constraints) -> tuple[np.ndarray, ...]:
    """Bodies i, bodies j, and those of mates of all rows, (m,) each; ground where a row has no mate."""
    count, ground = max(len(group.ends) for group in constraints.groups), constraints.n_bodies
    padded_ends = lambda group: [
        *group.ends,
        *[(ground,) * len(group.i)] * (count - len(group.ends)),
    ]
    parts = [
        [np.repeat(end, ROWS[group.kind]) for end in padded_ends(group)]
        for group in constraints.groups
    ]
    return tuple(np.concatenate(part) for part in zip(*parts, strict=True))


def row_frames(tree: SpanningTree, constraints: Constraints) -> tuple[np.ndarray, ...]:
    """Frames of `row_bodies`, (m,) each."""
    return tuple(np.array(tree.frame)[bodies] for bodies in row_bodies(constraints))


def closure_rows(
    parameters: TreeParameters, constraints: Constraints, t: Float[Array, "*s"], moving: TreeMotion
) -> Rows:
    """Constraint rows of the loop-closing joints, from their primitives and the spatial axes."""
    tree = parameters.tree
    twists = jnp.concatenate([moving.v, moving.w])
    sides = BodyKinematics(moving.c, moving.v, moving.R, moving.w, twists)
    group_rows = [group.rows(sides, t, "world") for group in constraints.groups]
    batch = moving.c.shape[2:]

    # Primitives of one kind are evaluated as one array over all joints: a kernel for each kind instead of
    # one for each joint.
    def flatten_rows(name: str) -> Array:
        """Rows in the groups' order, those of one primitive together."""
        parts = [jnp.swapaxes(getattr(rows, name), 0, 1) for rows in group_rows]
        return jnp.concatenate([part.reshape(-1, *batch) for part in parts])

    gamma = flatten_rows("gamma")
    J = jnp.zeros(())
    wrenches = []
    for end, body in enumerate(row_bodies(constraints)):
        # the rows of joints have two blocks, and none of a mate
        blocks = (
            rows.blocks[end] if end < len(rows.blocks) else jnp.zeros_like(rows.J_i)
            for rows in group_rows
        )
        J_body = jnp.concatenate(
            [jnp.moveaxis(J, 0, 2).reshape(6, -1, *batch) for J in blocks], axis=1
        )
        c, w, v = (pick_entries(x, body, 1) for x in (moving.c, moving.w, moving.v))
        force = J_body[:3]
        # A row per unit multiplier is a force at the centre of mass and a moment: moved to the origin of
        # frame 0 it is one wrench, whose product with every spatial axis is a column of J.
        W = jnp.concatenate([J_body[3:] + cross(c, force), force])
        frame = np.array(tree.frame)[body]
        A = pick_entries(moving.A, frame, 1)
        # The acceleration of the centre of mass is that of the frame's material point plus omega x v, which
        # the spatial acceleration does not contain.
        twist = cross(w, v)
        gamma = gamma - jnp.sum(W * A, axis=0) - jnp.sum(force * twist, axis=0)
        # An axis moves a body only if it lies between the body and the root; all other entries of J are zero
        # in every posture.
        support_mask = find_supported(tree)[np.ix_(motion_columns(tree).frame, frame)].T.astype(
            float
        )
        product = jnp.sum(W[:, :, None] * moving.S[:, None], axis=0)
        J = J + align_axes(support_mask, 2 + len(batch)) * product
        wrenches.append(W)
    return Rows(flatten_rows("value"), flatten_rows("target"), gamma, J, tuple(wrenches))


class TreeModel(AbstractModel):
    """System prepared for the formulation in relative coordinates.

    Attributes:
        constraints: constraints of the loop closures.
        row_mask: mask of the rows that the equations hold, if others depend on them in every posture, with
            those of points in the axes of body i; else None. See `formulations.independence`.
        step_rows: mask of the rows that are held through one step, see `at_step`.
    """

    system: System
    parameters: TreeParameters
    constraints: Constraints
    row_mask: Bool[Array, " m"] | None = None
    step_rows: Bool[Array, " m"] | None = None

    @property
    def active_rows(self) -> Bool[Array, " m"] | None:
        """Mask of the rows that the equations hold; None if they hold all."""
        return self.row_mask if self.step_rows is None else self.step_rows


def rotate_rows(model: TreeModel, moving: TreeMotion, rows: Rows) -> Rows:
    """Rows with those of points in the axes of body i, where some rows are left out for good."""
    return rows if model.row_mask is None else rows.in_body_axes(model.constraints, moving.R)


def mask_rows(model: TreeModel, moving: TreeMotion, rows: Rows) -> Rows:
    """`rotate_rows` with zeros in the place of rows that are left out."""
    rows = rotate_rows(model, moving, rows)
    return rows if model.active_rows is None else rows.with_mask(model.active_rows)


def close_loops(
    model: TreeModel,
    t: Float[Array, ""],
    at: TreeCoordinates,
    iterations: int,
) -> tuple[TreeCoordinates, Rows]:
    """Nearest coordinates that satisfy the loop closures, and the rows at their positions."""
    tree = model.parameters.tree

    def rows_of(moving: TreeMotion) -> Rows:
        return closure_rows(model.parameters, model.constraints, t, moving)

    def evaluate_rows(moving: TreeMotion) -> Rows:
        return mask_rows(model, moving, rows_of(moving))

    # The derivative of a converged iteration is that of its last step at constant G: the
    # neglected terms are of the size of the residual before that step.
    iterate = jax.lax.stop_gradient(at)
    moving = compute_motion(model.parameters, iterate)
    rows = jax.lax.stop_gradient(evaluate_rows(moving))
    # One factorisation at the first iterate serves all iterations (simplified Newton): a step of the
    # integrator leaves so small a violation that the Jacobian hardly changes.
    G = jax.lax.stop_gradient(_closing_inverse(model, moving, rows.J))
    by_rows = lambda b: jnp.sum(G * b[None], axis=1)

    def newton_step(_: Any, now: TreeCoordinates) -> TreeCoordinates:
        rows = jax.lax.stop_gradient(evaluate_rows(compute_motion(model.parameters, now)))
        return retract_coordinates(tree, now, -by_rows(rows.value))

    # The first iteration is outside of the loop, since its rows have been evaluated for G already.
    iterate = retract_coordinates(tree, iterate, -by_rows(rows.value))
    iterate = jax.lax.fori_loop(1, iterations, newton_step, iterate)
    at = _carry_derivatives(at, iterate)
    moving = compute_motion(model.parameters, at)
    every = rows_of(moving)
    rows = mask_rows(model, moving, every)
    at = _carry_derivatives(retract_coordinates(tree, at, -by_rows(rows.value)), iterate)
    # Velocities satisfy linear equations, but G belongs to the first iterate: a second pass removes the
    # error of its factor.
    for _ in range(max(iterations, 2)):
        rate_residuals = jnp.sum(rows.J * at.u[None], axis=1) - rows.target
        at = at._replace(u=at.u - by_rows(rate_residuals))
    return at, every


def _closing_inverse(
    model: TreeModel, moving: TreeMotion, J: Float[Array, "m k"]
) -> Float[Array, "k m"]:
    """Right inverse G of J: u = G b solves J u = b with minimum norm in the mass metric."""
    tree = model.parameters.tree
    total = composite_inertia(model.parameters, moving, jnp.zeros_like(moving.V))
    saddle = factor_saddle(
        mass_matrix(tree, moving.S, total),
        all_columns(tree, J),
        redundant="fast" if model.step_rows is not None else False,
        row_mask=model.active_rows,
        order=choose_order(tree, model.constraints),
    )
    return saddle.right_inverse()[6 * tree.floating :]


def rows_after(
    model: TreeModel, t: Float[Array, ""], at: TreeCoordinates, by: Float[Array, "k"]
) -> Float[Array, "m k"]:
    """Rows J of the loop closures after a displacement `by` along the velocities."""
    moving = compute_motion(model.parameters, retract_coordinates(model.parameters.tree, at, by))
    rows = closure_rows(model.parameters, model.constraints, t, moving)
    return rotate_rows(model, moving, rows).J


def all_columns(tree: SpanningTree, J: Float[Array, "m k"]) -> Float[Array, "m l"]:
    """Rows in all velocities, with zeros for the base, whose motion violates no loop closure."""
    if not tree.floating:
        return J
    return jnp.concatenate([jnp.zeros((J.shape[0], 6, *J.shape[2:]), J.dtype), J], axis=1)


def choose_order(tree: SpanningTree, constraints: Constraints) -> tuple[int, ...]:
    """Order in which the unknowns of `mass_matrix` are eliminated: of two the one with fewer products.

    From the last to the first, no zero between two branches fills in. A floating base that is eliminated first
    fills in all of them; in exchange its rows of zeros in J^T have no part in anything that follows.

    Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6.5, for the first.
    """
    n = tree.n_velocities
    outermost = tuple(range(n))[::-1]
    if not tree.floating or not constraints.groups:
        return outermost
    frame, supported = motion_columns(tree).frame, find_supported(tree)
    above = supported[np.ix_(frame, frame)]
    couples = np.ones((n, n), bool)
    couples[6:, 6:] = above | above.T
    # the mass of the whole machine, the same in all directions
    couples[3:6, 3:6] = np.eye(3, dtype=bool)
    touches = np.zeros((n, len(row_bodies(constraints)[0])), bool)
    for frames in row_frames(tree, constraints):
        touches[6:] |= supported[np.ix_(frame, frames)]
    base_first = (*range(6)[::-1], *range(6, n))
    return min((outermost, base_first), key=lambda order: count_products(couples, touches, order))


def _carry_derivatives(at: TreeCoordinates, to: TreeCoordinates) -> TreeCoordinates:
    """Coordinates with the values of `to` and the derivatives of `at`."""
    stop = jax.lax.stop_gradient
    return jax.tree.map(lambda x, y: stop(y) + (x - stop(x)), at, to)


def compute_residuals(model: TreeModel, at: TreeCoordinates, rows: Rows | None) -> Residuals:
    """Residuals of the loop closures, of their rates, and of the norms of unit vectors."""
    # Norms are measured as squares, whose derivative is finite also where an estimate of a state has a
    # zero vector.
    squares = [jnp.sum(p**2, axis=0) for p in unit_vectors(model.parameters.tree, at)]
    norm = jnp.max(jnp.abs(jnp.concatenate(squares) - 1), axis=0, initial=0.0)
    if rows is None:
        return residuals_of(model.constraints, norm[None], norm[None], norm)
    rate_residuals = jnp.sum(rows.J * at.u[None], axis=1) - rows.target
    return residuals_of(model.constraints, rows.value, rate_residuals, norm)


# A row is dependent for a step if the square of its distance from the span of the others is below the
# square of `WEAK`. The distance is measured here and `AHEAD` [rad], or that part of the longest arm,
# further along the velocities unless these are below `_SLOW` [1/s], hence round-off. Further along,
# its square is about AHEAD^2 if the posture is singular for a moment only, and AHEAD^4 for permanently
# dependent rows, because the constraints hold up to AHEAD^2 there.
AHEAD = 1e-4
_SLOW = 1e-6

# A posture is near a singular one if its smallest singular value is less than the share `NEARER`
# of those at the postures around it, `_APART` [rad], [m] apart: the value goes through zero
# linearly, however large the mechanism and however small the value itself. The postures around
# are not evaluated if the value exceeds `_CLEAR`, nor used if their own values are below `_LOST`.
NEARER = 0.5
_CLEAR = 0.03
_LOST = 1e-6
_APART = 0.06
_HALF = 5


def _interpolation_weights(half: int) -> np.ndarray:
    """Weights that interpolate a polynomial at 0 from its values at +-1, ..., +-half."""
    one_side = [
        (-1.0) ** (j + 1) * factorial(half) ** 2 / (factorial(half - j) * factorial(half + j))
        for j in range(1, half + 1)
    ]
    return np.array(one_side[::-1] + one_side)


_PLACES = np.array([*range(-_HALF, 0), *range(1, _HALF + 1)])
_WEIGHTS = _interpolation_weights(_HALF)
# weights of the polynomial through all places but the outermost, which estimate the error
_FEWER = np.array([0.0, *_interpolation_weights(_HALF - 1), 0.0])
# Error of the equations themselves by round-off, times a power of the smallest singular value:
# the second power for velocities projected onto the constraints, the third for accelerations.
_ROUND_OFF = 1e-15
_UNCERTAIN = 1e-6

T = TypeVar("T")


def _scale_velocities(model: TreeModel, u: Float[Array, "k"]) -> Float[Array, "k"]:
    """Velocities scaled to a maximum of one [rad] or the longest arm; much less if they are round-off."""
    units = _velocity_units(model)
    # At rest the velocities are round-off and point nowhere: the displacement then shrinks with them
    # instead of following a random direction.
    speed = jnp.max(jnp.abs(u / units), initial=0.0)
    return jax.lax.stop_gradient(jnp.asarray(u / (_SLOW + speed)))


def _velocity_units(model: TreeModel) -> Float[Array | np.ndarray, "k"]:
    """Units of the tree's velocities: one for rates of turning, the longest arm for others."""
    arm = longest_arm(model.system, model.constraints)
    return jnp.where(motion_columns(model.parameters.tree).angular > 0, 1.0, arm)


class Nearness(NamedTuple):
    """Nearness of a posture to a singular one, and its smallest singular value."""

    is_near: Bool[Array, ""]
    smallest: Float[Array, ""]


def interpolate_posture(
    at: Nearness, way: Float[Array, "k"], function: Callable[[Float[Array, "k"]], T], *, power: int
) -> T:
    """Value one(0), interpolated near a singular posture from displacements before and after.

    The value is one(0) itself wherever interpolation of lower order differs from it by more
    than the effect of round-off on one(0), or by more than 1e-6: such a motion is not smooth,
    for example that of a linkage which narrowly misses the singular posture.

    Args:
        way: displacement to the next of the postures, see `way_along`.
        function: function of a displacement (k,) that returns arrays.
        power: power of the smallest singular value by which round-off is divided.
    """
    shape = jax.eval_shape(function, way)
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    # Interpolation replaces the equations only where it is better than they are: their own error by
    # round-off grows with this power of the smallest singular value.
    limit = jnp.minimum(_ROUND_OFF / at.smallest**power, _UNCERTAIN)

    def largest_number(tree: T) -> Float[Array, ""]:
        parts = [jnp.max(jnp.abs(x), initial=0.0) for x in jax.tree.leaves(tree)]
        return jnp.max(jnp.stack(parts))

    def add_sample(sums: tuple[T, T], place_of: tuple[Any, ...]) -> tuple[tuple[T, T], None]:
        place, weight, fewer = place_of
        total, less = sums
        deviation = largest_number(jax.tree.map(jnp.subtract, total, less))
        itself = (place == 0) & ~(at.is_near & (deviation <= limit * (1 + largest_number(total))))
        needed = jnp.where(place == 0, itself, at.is_near)
        value = jax.lax.cond(needed, lambda: function(place * way), lambda: none)
        total = jax.tree.map(lambda x, y: jnp.where(itself, y, x + weight * y), total, value)
        return (total, jax.tree.map(lambda x, y: x + fewer * y, less, value)), None

    # the posture itself is evaluated last and only if needed: near a singular posture its
    # derivatives may be NaN
    end = lambda x: jnp.asarray([*x, 0.0], way.dtype)
    (total, _), _ = jax.lax.scan(
        add_sample, (none, none), (end(_PLACES), end(_WEIGHTS), end(_FEWER))
    )
    return total


def way_along(model: TreeModel, u: Float[Array, "k"]) -> Float[Array, "k"]:
    """Displacement along velocities between the postures from which values are interpolated."""
    return _APART * _scale_velocities(model, u)


def _scale_jacobian(model: TreeModel, J: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """Rows and columns without units, as constants for differentiation."""
    arm = longest_arm(model.system, model.constraints)
    scale = row_scales(model.constraints, arm)
    return jax.lax.stop_gradient(jnp.asarray(scale)[:, None] * J * _velocity_units(model))


def bound_singular(J: Float[Array, "m k"], row_mask: Bool[Array, " m"]) -> Float[Array, ""]:
    """Lower bound, within a factor sqrt(m), of the smallest singular value of the kept rows without units.

    The bound is 1 / |L^-1| in the Frobenius norm, with J J^T = L L^T; zero where the Cholesky
    factor does not exist.
    """
    J = jnp.where(row_mask[:, None], J, 0.0)
    # A bound by the triangular factor costs one substitution; a singular value decomposition at every
    # right-hand side would cost more than the equations of motion.
    identity = jnp.eye(len(J), dtype=J.dtype)
    # rows that are left out get ones on the diagonal and do not enter the norm
    inverse = solve_lower(
        factor_cholesky(J @ J.T + jnp.where(row_mask, 0.0, 1.0) * identity), identity
    )
    square = jnp.sum(jnp.where(row_mask[:, None], inverse, 0.0) ** 2)
    return jnp.where(jnp.isfinite(square), 1 / jnp.sqrt(square), 0.0)


# Products and factors of the rows are left to LAPACK: as machine code they would take longer to compile than
# most runs last.
@native
def _scaled_rows_after(
    model: TreeModel, t: Float[Array, ""], at: TreeCoordinates, by: Float[Array, "k"]
) -> Float[Array, "m k"]:
    """Rows without units after a displacement along the velocities."""
    return _scale_jacobian(model, rows_after(model, t, at, by))


def step_rows(model: TreeModel, t: Float[Array, ""], at: TreeCoordinates) -> Bool[Array, " m"]:
    """Mask of the independent rows (m,) for a step that starts here.

    Rows are tested here and a little further along the motion, and the larger set is taken: in
    a singular posture rows may be dependent that are independent before and after it.
    """
    displacement = AHEAD * _scale_velocities(model, at.u)

    def independent_at(share: Float[Array, ""]) -> Bool[Array, " m"]:
        J = _scaled_rows_after(model, t, at, share * displacement)
        return independent_rows(J @ J.T, WEAK**2)

    start_mask, ahead_mask = jax.vmap(independent_at)(jnp.array([0.0, 1.0], at.u.dtype))
    return jnp.where(jnp.sum(start_mask) >= jnp.sum(ahead_mask), start_mask, ahead_mask)


def measure_nearness(model: TreeModel, t: Float[Array, ""], at: TreeCoordinates) -> Nearness:
    """Nearness of this posture to a singular one, in comparison with those before and after."""
    row_mask = model.step_rows
    assert row_mask is not None
    model, at = held_constant((model, at))
    step = way_along(model, at.u)

    def singular_value_at(place: Float[Array, ""]) -> Float[Array, ""]:
        return bound_singular(_scaled_rows_after(model, t, at, place * step), row_mask)

    present_clearance = singular_value_at(jnp.zeros((), at.u.dtype))

    def less_near(places: np.ndarray) -> Bool[Array, ""]:
        neighbour_clearances = jax.lax.map(singular_value_at, jnp.asarray(places, at.u.dtype))
        return jnp.all(
            (neighbour_clearances > present_clearance / NEARER) & (neighbour_clearances > _LOST)
        )

    # for most postures the two next to them decide
    no = lambda: jnp.asarray(False)
    others = lambda: less_near(_PLACES[np.abs(_PLACES) > 1])
    around = lambda: jax.lax.cond(less_near(_PLACES[np.abs(_PLACES) == 1]), others, no)
    return Nearness(jax.lax.cond(present_clearance < _CLEAR, around, no), present_clearance)
