"""Partitioning of a spanning tree's velocities into independent and dependent ones by pivoting.

The rows J u = target of the loop-closing joints leave n - rank J of the tree's n velocities free.
A QR factorisation with column pivoting selects as dependent the velocities that the rows determine
best; the others are independent.

Source: R. A. Wehage, E. J. Haug, Generalized coordinate partitioning for dimension reduction in
analysis of constrained dynamic systems, J. Mechanical Design 104 (1982) 247-255.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import scipy.linalg
from jaxtyping import Array

from ...algebra.compiler import kept_jit
from ...checks.errors import ModelError
from ...mechanics.state import State
from ..formulations.constraints import Constraints
from ..tree.closures import closure_rows
from ..tree.coordinates import TreeCoordinates, moved, read
from ..tree.frames import columns
from ..tree.motion import motion
from ..tree.parameters import TreeParameters
from ..tree.projection import TreeModel

# Singular values below this fraction of the largest count as zero.
RANK_TOLERANCE = 1e-9
# Loops count as closed if their residuals, lengths [m] or cosines, are below this.
CLOSED = 1e-9
# Distance along the mechanism's motions at which a posture has its neighbours [rad], [m].
APART = 1e-2
# Displacement for differences [rad], [m], and the share of the rows' size that is more than their round-off.
_SHORT, _GAINED = 1e-4, 1e-5
# Weight of the columns of spherical joints, which makes them dependent before angles and
# displacements: a component of a rotation is a poor coordinate.
_SPHERICAL = 100.0


class Selection(NamedTuple):
    """Indices of independent velocities, of dependent ones, and of rows that determine these."""

    independent: tuple[int, ...]
    dependent: tuple[int, ...]
    rows: tuple[int, ...]


def rank_of_rows(J: np.ndarray, size: float = 0.0) -> int:
    """Rank of a matrix: the number of singular values above `RANK_TOLERANCE` times the largest.

    Args:
        size: size of such matrices, in comparison with which all singular values may be zero.
    """
    if not J.size:
        return 0
    values = np.linalg.svd(J, compute_uv=False)
    return int(np.sum(values > RANK_TOLERANCE * max(values[0], size))) if values[0] > 0 else 0


def _pivots(matrix: np.ndarray) -> np.ndarray:
    """Order in which QR factorisation with pivoting takes the columns."""
    _, order = scipy.linalg.qr(matrix, mode="r", pivoting=True)  # pyright: ignore[reportAssignmentType]
    return order


def select(
    J: np.ndarray, spherical: np.ndarray, wanted: tuple[int, ...], names: tuple[str, ...]
) -> Selection:
    """Independent and dependent velocities, and independent rows, of J (m, n).

    Args:
        spherical: (n,), true for velocities of spherical joints.
        wanted: indices of velocities that must be independent. names: names of all velocities.

    Raises:
        ModelError: the wanted velocities are not independent of each other.
    """
    n = J.shape[1]
    rank = rank_of_rows(J)
    if len(wanted) > n - rank:
        listed = ", ".join(names[k] for k in wanted)
        raise ModelError(
            f"The mechanism has {n - rank} independent velocities in its joints, but {len(wanted)} "
            f"are wanted: {listed}."
        )
    others = np.array([k for k in range(n) if k not in wanted], dtype=int)
    weighted = J[:, others] * np.where(spherical[others], _SPHERICAL, 1.0)
    if not rank:
        return Selection(tuple(range(n)), (), ())
    order = _pivots(weighted)
    dependent = np.sort(others[order[:rank]])
    rows = np.sort(_pivots(J[:, dependent].T)[:rank])
    values = np.linalg.svd(J[np.ix_(rows, dependent)], compute_uv=False)
    if values[-1] <= RANK_TOLERANCE * np.linalg.norm(J, 2):
        listed = ", ".join(names[k] for k in wanted)
        raise ModelError(f"The velocities {listed} depend on each other in this posture.")
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
    ahead, back = (value_and_rows(APART * sign * _mixed(J.shape[1], 0))[1] for sign in (1, -1))
    # rows may vanish altogether in the posture itself
    size = max(float(np.linalg.norm(x, 2)) for x in (J, ahead, back)) if J.size else 0.0
    rank = rank_of_rows(J, size)
    U, _, Vt = np.linalg.svd(J)
    free = Vt[rank:]
    best = rank
    if len(free) and rank < len(J):
        step = _mixed(len(free), 0) @ free
        ahead, back = (value_and_rows(_SHORT * sign * step)[1] for sign in (1, -1))
        gains = U[:, rank:].T @ (ahead - back) @ free.T / (2 * _SHORT)
        best += int(np.sum(np.linalg.svd(gains, compute_uv=False) > _GAINED * size))
    for seed in range(3):
        step = APART * _mixed(len(free), seed) @ free
        for _ in range(30):
            value, there = value_and_rows(step)
            if np.max(np.abs(value), initial=0.0) < 1e-14:
                break
            step = step - np.linalg.pinv(there, rcond=1e-6) @ value
        value, there = value_and_rows(step)
        if np.max(np.abs(value), initial=0.0) < 1e-10:
            best = max(best, rank_of_rows(there, size))
    return rank, best


def _mixed(count: int, seed: int) -> np.ndarray:
    """Direction (count,) without any pattern."""
    weights = np.random.default_rng(seed).standard_normal(count)
    return weights / max(np.linalg.norm(weights), 1e-300)


# operation by operation it is a hundred small programs
compiled_read = kept_jit(read)


@kept_jit
def _rows_after(
    parameters: TreeParameters, constraints: Constraints, t: Array, at: TreeCoordinates, by: Array
) -> tuple[Array, Array]:
    """Values (m,) and columns (m, n) of the rows after a displacement."""
    moving = motion(parameters, moved(parameters.tree, at, by))
    found = closure_rows(parameters, constraints, t, moving)
    return found.value, found.J


def chosen(
    model: TreeModel, state: State, t: float, wanted: tuple[int, ...], names: tuple[str, ...]
) -> Selection:
    """Select the velocities at a posture; raises `ModelError` if the posture is singular."""
    tree, parameters = model.parameters.tree, model.parameters
    count = len(columns(tree).frame)
    if not model.constraints.groups:
        return Selection(tuple(range(count)), (), ())
    at, time = compiled_read(parameters, state), jnp.asarray(t, dtype=float)
    rows = lambda by: _rows_after(parameters, model.constraints, time, at, jnp.asarray(by))
    after = lambda by: tuple(map(np.asarray, rows(by)))
    value, J = after(np.zeros(count))
    joints = ", ".join(tree.joints[k] for k in tree.cut)
    if np.max(np.abs(value), initial=0.0) > CLOSED:
        raise ModelError(
            f"The loops closed by {joints} are open by {np.max(np.abs(value)):.3g} at the given "
            "state: find a consistent one with stmuav_jax.assemble(system, state)."
        )
    here, nearby = ranks_nearby(J, after)  # pyright: ignore[reportArgumentType]
    if nearby > here:
        raise ModelError(
            f"The given posture is singular: the loops closed by {joints} leave "
            f"{count - here} independent velocities there, but {count - nearby} in the "
            "postures around. Choose the coordinates at another posture of the same mechanism."
        )
    spherical = np.array([not tree.steps[f - 1].motion.flat for f in columns(tree).frame])
    return select(J, spherical, wanted, names)
