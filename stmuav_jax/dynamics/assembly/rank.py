"""Rank of the constraints at a posture: degrees of freedom, redundant rows, singular values."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...math import lapack
from ...math.compiler import kept_jit
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.augmented import AugmentedModel, evaluate_equations, prepare_rows
from ..formulations.independence import count_independent, find_independent_rows, scale_matrix


class Rank(NamedTuple):
    """Rank of the constraint Jacobian at one posture.

    Attributes:
        rows: number of constraint rows. rank: number of independent rows.
        dof: degrees of freedom, 6 n - rank.
        smallest_singular_value: smallest non-zero singular value of the velocity Jacobian in (v,
            omega'), which has units.
        redundant: names of joints that own a dependent row, by pivoting.
    """

    rows: int
    rank: int
    dof: int
    smallest_singular_value: float
    redundant: tuple[str, ...]


def rank(system: System, state: State, t: float = 0.0) -> Rank:
    """Rank and redundant rows of the constraint Jacobian in (v, omega'), for concrete values."""
    return rank_of(system, prepare_rows(system), state, t)


def rank_of(
    system: System,
    model: AugmentedModel,
    state: State,
    t: float = 0.0,
    matrix: np.ndarray | None = None,
) -> Rank:
    """Rank as by `rank`, for a prepared model and with the constraint Jacobian if it is known.

    The rank is that of the matrix without units, whose singular values below `DEPENDENT` times the
    largest count as zero, and at most that of closed loops: at a posture on the joints up to a
    tolerance only, rows that repeat others seem to differ from them.
    """
    owner, columns = model.constraints.owner, 6 * system.n_bodies
    if not owner:
        return Rank(0, 0, columns, float("inf"), ())
    matrix = evaluate_jacobian(model, state, t) if matrix is None else matrix
    scaled = scale_matrix(system, model.constraints, matrix)
    count = int(count_independent(np.linalg.svd(scaled, compute_uv=False)))
    # A rank at one posture may be that of a singular one; the generic rank bounds it.
    count = min(count, find_independent_rows(system).rank)
    names: tuple[str, ...] = ()
    if count < len(owner):
        dependent = _dependent_rows(scaled, count)
        names = tuple(dict.fromkeys(system.joints[owner[k]].name for k in dependent))
    values = np.linalg.svd(matrix, compute_uv=False)
    return Rank(len(owner), count, columns - count, float(values[count - 1]), names)


def ranks(system: System, states: State, t: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Rank as by `rank`, and the smallest non-zero singular value, at k postures.

    Args:
        states: states (k, n, .).

    Returns:
        Integers (k,) and values (k,), the latter of the Jacobian in (v, omega'), which has units.
    """
    model = prepare_rows(system)
    matrices = np.asarray(_evaluate_jacobians(model, states, jnp.asarray(t, dtype=states.r.dtype)))
    scaled = scale_matrix(system, model.constraints, matrices)
    count = count_independent(np.linalg.svd(scaled, compute_uv=False))
    count = np.minimum(count, find_independent_rows(system).rank)
    values = np.linalg.svd(matrices, compute_uv=False)
    return count, np.take_along_axis(values, count[:, None] - 1, axis=1)[:, 0]


@kept_jit
def _evaluate_jacobians(
    model: AugmentedModel, states: State, t: Float[Array, ""]
) -> Float[Array, "k m v"]:
    return jax.vmap(lambda state: _evaluate_jacobian(model, state, t))(states)


@kept_jit
def singular_values(
    model: AugmentedModel, states: State, t: Float[Array, ""]
) -> Float[Array, "k m"]:
    """Singular values of the unscaled constraint Jacobian at states (k, n, .), the largest first."""
    matrices = jax.vmap(lambda state: _evaluate_jacobian(model, state, t))(states)
    return jax.vmap(lapack.singular_values)(matrices)


def _dependent_rows(J: np.ndarray, count: int) -> list[int]:
    """Rows that Gram-Schmidt orthogonalisation with row pivoting leaves after `count` rows."""
    rest = J.copy()
    order = list(range(len(J)))
    for k in range(count):
        sizes = np.linalg.norm(rest[order[k:]], axis=1)
        # The largest remaining row is taken next, so that redundant rows are those that are left.
        pick = k + int(np.argmax(sizes))
        order[k], order[pick] = order[pick], order[k]
        direction = rest[order[k]] / np.linalg.norm(rest[order[k]])
        rest = rest - np.outer(rest @ direction, direction)
    return sorted(order[count:])


def evaluate_jacobian(model: AugmentedModel, state: State, t: float = 0.0) -> np.ndarray:
    """Constraint Jacobian in (v, omega') as a NumPy matrix (m, 6 n)."""
    return np.asarray(_evaluate_jacobian(model, state, jnp.asarray(t, dtype=state.r.dtype)))


@kept_jit
def _evaluate_jacobian(
    model: AugmentedModel, state: State, t: Float[Array, ""]
) -> Float[Array, "m k"]:
    return evaluate_equations(model, t, state).matrix
