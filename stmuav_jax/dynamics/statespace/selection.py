"""Partitioning of a spanning tree's velocities into independent and dependent ones by pivoting.

The rows J u = target of the loop-closing joints leave n - rank J of the tree's n velocities free.
A QR factorisation with column pivoting selects as dependent the velocities that the rows determine
best; the others are independent.

Source: R. A. Wehage, E. J. Haug, Generalized coordinate partitioning for dimension reduction in
analysis of constrained dynamic systems, J. Mechanical Design 104 (1982) 247-255.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array, Float

from ...checks.errors import ModelError
from ...math.compiler import kept_jit
from ...mechanics.state import State
from ..formulations.constraints import Constraints
from ..formulations.independence import DEPENDENT, longest_arm, row_scales
from ..tree.closures import TreeModel, closure_rows
from ..tree.coordinates import TreeCoordinates, read_coordinates, retract_coordinates
from ..tree.motion import compute_motion
from ..tree.parameters import TreeParameters
from ..tree.topology import SpanningTree, motion_columns

BASE = (
    *((f"r_{k}", "m") for k in "xyz"),
    *((f"theta_{k}", "rad") for k in "xyz"),
    *((f"v_{k}", "m/s") for k in "xyz"),
    *((f"omega_{k}", "rad/s") for k in "xyz"),
)


def velocity_names(tree: SpanningTree) -> tuple[tuple[str, str], ...]:
    """Name and unit of every velocity of the spanning tree, as those of its coordinate.

    The names are `joint.angle`, `joint.displacement`, `joint.angle_1` and `joint.angle_2` of a universal
    joint, `joint.rotation_x` of a spherical one, `body.displacement_x` of a free body.
    """
    name_units: list[tuple[str, str]] = []
    owners = [
        tree.joints[s.joint] if s.joint is not None else tree.bodies[s.body] for s in tree.steps
    ]
    labels = [
        [
            (owner, name.replace(" vector", "").replace(", ", "_"), unit)
            for name, unit in coordinates
        ]
        for owner, coordinates in zip(
            owners, (s.motion.coordinates for s in tree.steps), strict=True
        )
    ]
    every = [(owner, name) for step in labels for owner, name, _ in step]
    occurrences: dict[tuple[str, str], int] = {}
    for step in labels:
        for owner, name, unit in step:
            occurrences[owner, name] = occurrences.get((owner, name), 0) + 1
            number = f"_{occurrences[owner, name]}" if every.count((owner, name)) > 1 else ""
            name_units.append((f"{owner}.{name}{number}", unit))
    return tuple(name_units)


def signs_of(tree: SpanningTree) -> list[float]:
    """Signs of the tree's velocities: -1 for scalar motions of joints passed from j to i."""
    backward = {link.joint for link in tree.links if not link.forward}
    signs = []
    for f in motion_columns(tree).frame:
        step = tree.steps[f - 1]
        signs.append(-1.0 if step.joint in backward and not step.motion.velocities else 1.0)
    return signs


# The independent coordinates are followed in parts of at most `_LONGEST` [rad], [m], with `_STEPS_EACH`
# steps of Newton's method each, so that it stays on its branch; at most `_MOST_PARTS` are gone. From
# there as many steps at once are made up to `_MOST_MORE` times. A step below `_ROUND_OFF` is the last
# but for those of `refine_closing`, which square what is left.
_LONGEST, _STEPS_EACH, _MOST_PARTS, _MOST_MORE = 0.1, 3, 1000, 10
_ROUND_OFF = 1e-8

Step = Callable[[TreeCoordinates], tuple[TreeCoordinates, Float[Array, ""]]]


def search_closed(
    at: TreeCoordinates,
    displacement: Float[Array, " n"],
    approach: Callable[[TreeCoordinates, Float[Array, " n"]], tuple[TreeCoordinates, Array]],
) -> TreeCoordinates:
    """Coordinates with closed loops, without derivatives; NaN where they are too far away.

    Args:
        at: independent coordinates and dependent ones before the displacement.
        displacement: how far the independent ones are to move (n,), in the tree's velocities.
        approach: `approach_closed` for a part of the displacement.
    """
    # The independent coordinates are approached in short parts: Newton's method from far away may land on
    # another branch of the mechanism.
    parts = jnp.ceil(jnp.max(jnp.abs(displacement), initial=0.0) / _LONGEST)
    part = displacement / jnp.maximum(parts, 1.0)
    # farther away, and where the distance is no number, nothing is followed and nothing found
    is_near = parts <= _MOST_PARTS

    def is_unfinished(carry: Any) -> Array:
        _, size, k = carry
        unfinished = (size >= _ROUND_OFF) & (k < parts + _MOST_MORE)
        return is_near & ((k < parts) | unfinished)

    def go_on(carry: Any) -> Any:
        now, _, k = carry
        return *approach(now, jnp.where(k < parts, part, 0.0)), k + 1

    # with the axes of a stack from the first on: JAX goes through the loop until they do not change
    endless, none = parts + jnp.inf, 0.0 * parts
    closed = jax.lax.while_loop(is_unfinished, go_on, (at, endless, none))[0]
    mark = jnp.where(is_near, 1.0, jnp.nan)
    return closed._replace(q=tuple(mark * q for q in closed.q))


def approach_closed(
    tree: SpanningTree, at: TreeCoordinates, part: Float[Array, " n"], step: Step
) -> tuple[TreeCoordinates, Float[Array, ""]]:
    """Coordinates after a part of the way and some steps of Newton's method; size of the last."""
    start = retract_coordinates(tree, at, part)
    at, sizes = jax.lax.scan(lambda now, _: step(now), start, length=_STEPS_EACH)
    return at, sizes[-1]


def refine_closing(at: TreeCoordinates, posture: TreeCoordinates, step: Step) -> TreeCoordinates:
    """Coordinates with closed loops, with derivatives up to the third of the implicit function.

    They are NaN where Newton's method has not come to rest.

    Args:
        at: independent coordinates, which have the derivatives. posture: result of `search_closed`.
        step: Newton's, of the dependent coordinates; and its largest component.
    """
    constant = jax.lax.stop_gradient
    # The search has no derivative. The two steps that follow carry it, each of which doubles the order up
    # to which it is right.
    at = jax.tree.map(lambda a, b: b + (a - constant(a)), at, constant(posture))
    at, sizes = jax.lax.scan(lambda now, _: step(now), at, length=2)
    # loops that do not close at these coordinates have no motion
    mark = jnp.where(constant(sizes[-1]) <= _ROUND_OFF, 1.0, jnp.nan)
    return at._replace(q=tuple(mark * q for q in at.q))


# Loops count as closed if their residuals, cosines or lengths over the longest arm, are below this.
CLOSED = 1e-9
# Distance along the mechanism's motions at which a posture has its neighbours, as an angle [rad].
APART = 1e-2
# Displacement for differences [rad], [m], and the share of the rows' size that is more than their round-off.
_SHORT, _GAINED = 1e-4, 1e-5
# Weights of the columns of spherical joints and of displacements, the latter per longest arm, which make
# them dependent before angles: a component of a rotation is a poor coordinate.
_SPHERICAL, _SLIDING = 100.0, 10.0


class Selection(NamedTuple):
    """Indices of independent velocities, of dependent ones, and of rows that determine these."""

    independent: tuple[int, ...]
    dependent: tuple[int, ...]
    rows: tuple[int, ...]


def rank_of_rows(J: np.ndarray, size: float = 0.0) -> int:
    """Rank of a matrix: the number of singular values above `DEPENDENT` times the largest.

    Args:
        size: size of such matrices, in comparison with which all singular values may be zero.
    """
    if not J.size:
        return 0
    values = np.linalg.svd(J, compute_uv=False)
    return int(np.sum(values > DEPENDENT * max(values[0], size))) if values[0] > 0 else 0


def _pivot_order(matrix: np.ndarray) -> np.ndarray:
    """Order in which QR factorisation with pivoting takes the columns."""
    _, order = scipy.linalg.qr(matrix, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    return order


def select_velocities(
    J: np.ndarray, weights: np.ndarray, required: tuple[int, ...], names: tuple[str, ...]
) -> Selection:
    """Independent and dependent velocities, and independent rows, of J (m, n).

    Args:
        weights: preference (n,) of each velocity for being a dependent one.
        required: indices of velocities that must be independent. names: names of all velocities.

    Raises:
        ModelError: the chosen velocities are not independent of each other.
    """
    n = J.shape[1]
    rank = rank_of_rows(J)
    if len(required) > n - rank:
        listed = ", ".join(names[k] for k in required)
        raise ModelError(
            f"The mechanism has {n - rank} independent velocities in its joints, but {len(required)} "
            f"were chosen: {listed}."
        )
    others = np.array([k for k in range(n) if k not in required], dtype=int)
    # Pivoting takes the largest columns as dependent first; the weights make it prefer coordinates that
    # are poor independent ones.
    weighted = J[:, others] * weights[others]
    if not rank:
        return Selection(tuple(range(n)), (), ())
    # QR factorisation with column pivoting finds the set of dependent velocities that the rows determine
    # best (R. A. Wehage, E. J. Haug 1982).
    order = _pivot_order(weighted)
    dependent = np.sort(others[order[:rank]])
    rows = np.sort(_pivot_order(J[:, dependent].T)[:rank])
    values = np.linalg.svd(J[np.ix_(rows, dependent)], compute_uv=False)
    if values[-1] <= DEPENDENT * np.linalg.norm(J, 2):
        listed = ", ".join(names[k] for k in required)
        raise ModelError(
            f"The velocities {listed} depend on each other in this posture: choose others."
        )
    independent = tuple(k for k in range(n) if k not in dependent)
    return Selection(independent, tuple(map(int, dependent)), tuple(map(int, rows)))


def ranks_nearby(
    J: np.ndarray, value_and_rows: Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
) -> tuple[int, int]:
    """Rank of the rows in a posture, and the largest found near it.

    That is the largest rank in postures on the constraints, and the rank that is gained to first order
    along a free motion, which shows postures too that no motion leaves.

    Args:
        value_and_rows: constraint values (m,) and rows (m, n) after a displacement (n,).
    """
    rows_ahead, rows_behind = (
        value_and_rows(APART * sign * _mixed_direction(J.shape[1], 0))[1] for sign in (1, -1)
    )
    # rows may vanish altogether in the posture itself
    size = max(float(np.linalg.norm(x, 2)) for x in (J, rows_ahead, rows_behind)) if J.size else 0.0
    rank = rank_of_rows(J, size)
    U, _, Vt = np.linalg.svd(J)
    free = Vt[rank:]
    best = rank
    if len(free) and rank < len(J):
        step = _mixed_direction(len(free), 0) @ free
        rows_ahead, rows_behind = (value_and_rows(_SHORT * sign * step)[1] for sign in (1, -1))
        gains = U[:, rank:].T @ (rows_ahead - rows_behind) @ free.T / (2 * _SHORT)
        best += int(np.sum(np.linalg.svd(gains, compute_uv=False) > _GAINED * size))
    for seed in range(3):
        step = APART * _mixed_direction(len(free), seed) @ free
        for _ in range(30):
            value, rows = value_and_rows(step)
            if np.max(np.abs(value), initial=0.0) < 1e-14:
                break
            step = step - np.linalg.pinv(rows, rcond=1e-6) @ value
        value, rows = value_and_rows(step)
        if np.max(np.abs(value), initial=0.0) < 1e-10:
            best = max(best, rank_of_rows(rows, size))
    return rank, best


def _mixed_direction(count: int, seed: int) -> np.ndarray:
    """Direction (count,) without any pattern."""
    weights = np.random.default_rng(seed).standard_normal(count)
    return weights / max(np.linalg.norm(weights), 1e-300)


# operation by operation it is a hundred small programs
compiled_read = kept_jit(read_coordinates)


@kept_jit
def _rows_after(
    parameters: TreeParameters, constraints: Constraints, t: Array, at: TreeCoordinates, by: Array
) -> tuple[Array, Array]:
    """Values (m,) and columns (m, n) of the rows after a displacement."""
    moving = compute_motion(parameters, retract_coordinates(parameters.tree, at, by))
    rows = closure_rows(parameters, constraints, t, moving)
    return rows.value, rows.J


def choose_velocities(
    model: TreeModel, state: State, t: float, required: tuple[int, ...], names: tuple[str, ...]
) -> Selection:
    """Select the velocities at a posture; raises `ModelError` if the posture is singular."""
    tree, parameters = model.parameters.tree, model.parameters
    count = len(motion_columns(tree).frame)
    if not model.constraints.groups:
        return Selection(tuple(range(count)), (), ())
    at, time = compiled_read(parameters, state), jnp.asarray(t, dtype=float)
    rows = lambda by: _rows_after(parameters, model.constraints, time, at, jnp.asarray(by))
    after = lambda by: tuple(map(np.asarray, rows(by)))
    value, J = after(np.zeros(count))
    arm = float(longest_arm(model.system, model.constraints))
    rates = np.where(motion_columns(tree).angular > 0, 1.0, arm)
    size = np.asarray(row_scales(model.constraints, arm))

    def after_unit(by: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values and rows without units after a displacement without units."""
        residuals, matrix = after(by * rates)
        return residuals * size, matrix * size[:, None] * rates

    joints = ", ".join(tree.joints[k] for k in tree.cut)
    if np.max(np.abs(value * size), initial=0.0) > CLOSED:
        raise ModelError(
            f"The loops closed by {joints} are open by {np.max(np.abs(value)):.3g} at the given "
            "state: find a consistent one with stmuav_jax.assemble(system, state)."
        )
    present_rank, nearby_rank = ranks_nearby(J * size[:, None] * rates, after_unit)
    if nearby_rank > present_rank:
        raise ModelError(
            f"The given posture is singular: the loops closed by {joints} leave "
            f"{count - present_rank} independent velocities there, but {count - nearby_rank} in the "
            "postures around. Choose the coordinates at another posture of the same mechanism."
        )
    spherical = np.array([not tree.steps[f - 1].motion.flat for f in motion_columns(tree).frame])
    sliding = motion_columns(tree).angular <= 0
    weights = np.where(spherical, _SPHERICAL, np.where(sliding, _SLIDING, 1.0))
    return select_velocities(J * size[:, None] * rates, weights, required, names)
