"""Dependent constraint rows, permanent or momentary, and motion through singular postures.

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

from ...algebra.derivative import held_constant
from ...algebra.linalg import cholesky, independent_rows, solve_lower
from ...mechanics.constraint import ROWS
from ..formulations.constraints import Constraints
from .coordinates import TreeCoordinates
from .projection import TreeModel, rows_after

# A row is dependent if the square of its distance from the span of the others, relative to the
# longest row of its kind, is below `DEPENDENT`. The distance is measured here and `AHEAD` [rad],
# [m] further along the velocities unless these are below `_SLOW` [1/s], hence round-off. Further
# along, its square is about AHEAD^2 if the posture is singular for a moment only, and AHEAD^4 for
# permanently dependent rows, because the constraints hold up to AHEAD^2 there.
DEPENDENT = 1e-12
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


def _weights(half: int) -> np.ndarray:
    """Weights that interpolate a polynomial at 0 from its values at +-1, ..., +-half."""
    one_side = [
        (-1.0) ** (j + 1) * factorial(half) ** 2 / (factorial(half - j) * factorial(half + j))
        for j in range(1, half + 1)
    ]
    return np.array(one_side[::-1] + one_side)


_PLACES = np.array([*range(-_HALF, 0), *range(1, _HALF + 1)])
_WEIGHTS = _weights(_HALF)
# weights of the polynomial through all places but the outermost, which estimate the error
_FEWER = np.array([0.0, *_weights(_HALF - 1), 0.0])
# Error of the equations themselves by round-off, times a power of the smallest singular value:
# the second power for velocities projected onto the constraints, the third for accelerations.
_ROUND_OFF = 1e-15
_UNCERTAIN = 1e-6

T = TypeVar("T")


def _along(u: Float[Array, "k"]) -> Float[Array, "k"]:
    """Velocities scaled to a maximum of one [rad], [m]; much less if they are round-off."""
    return jax.lax.stop_gradient(u / (_SLOW + jnp.max(jnp.abs(u), initial=0.0)))


class Nearness(NamedTuple):
    """Nearness of a posture to a singular one, and its smallest singular value."""

    near: Bool[Array, ""]
    smallest: Float[Array, ""]


def interpolated(
    at: Nearness, u: Float[Array, "k"], one: Callable[[Float[Array, "k"]], T], *, power: int
) -> T:
    """Value one(0), interpolated near a singular posture from displacements before and after.

    The value is one(0) itself wherever interpolation of lower order differs from it by more
    than the effect of round-off on one(0), or by more than 1e-6: such a motion is not smooth,
    for example that of a linkage which narrowly misses the singular posture.

    Args:
        u: velocities.
        one: function of a displacement (k,) that returns arrays.
        power: power of the smallest singular value by which round-off is divided.
    """
    step = _APART * _along(u)
    shape = jax.eval_shape(one, step)
    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shape)
    limit = jnp.minimum(_ROUND_OFF / at.smallest**power, _UNCERTAIN)

    def largest(tree: T) -> Float[Array, ""]:
        parts = [jnp.max(jnp.abs(x), initial=0.0) for x in jax.tree.leaves(tree)]
        return jnp.max(jnp.stack(parts))

    def add(sums: tuple[T, T], place_of: tuple[Any, ...]) -> tuple[tuple[T, T], None]:
        place, weight, fewer = place_of
        found, less = sums
        off = largest(jax.tree.map(jnp.subtract, found, less))
        itself = (place == 0) & ~(at.near & (off <= limit * (1 + largest(found))))
        needed = jnp.where(place == 0, itself, at.near)
        value = jax.lax.cond(needed, lambda: one(place * step), lambda: none)
        found = jax.tree.map(lambda x, y: jnp.where(itself, y, x + weight * y), found, value)
        return (found, jax.tree.map(lambda x, y: x + fewer * y, less, value)), None

    # the posture itself is evaluated last and only if needed: near a singular posture its
    # derivatives may be NaN
    end = lambda x: jnp.asarray([*x, 0.0], u.dtype)
    (found, _), _ = jax.lax.scan(add, (none, none), (end(_PLACES), end(_WEIGHTS), end(_FEWER)))
    return found


def _scaled(constraints: Constraints, J: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """Rows divided by the longest row of their kind, as constants for differentiation."""
    J = jax.lax.stop_gradient(J)
    square, sizes, start = jnp.sum(J**2, axis=1), [], 0
    for group in constraints.groups:
        count = ROWS[group.kind] * len(group.i)
        sizes.append(jnp.full(count, jnp.max(square[start : start + count])))
        start += count
    size = jnp.sqrt(jnp.concatenate(sizes))
    return J / jnp.where(size > 0, size, 1.0)[:, None]


def smallest(
    constraints: Constraints, J: Float[Array, "m k"], kept: Bool[Array, " m"]
) -> Float[Array, ""]:
    """Lower bound, within a factor sqrt(m), of the smallest singular value of the kept rows.

    The bound is 1 / |L^-1| in the Frobenius norm, with J J^T = L L^T; zero where the Cholesky
    factor does not exist.
    """
    J = jnp.where(kept[:, None], _scaled(constraints, J), 0.0)
    one = jnp.eye(len(J), dtype=J.dtype)
    # rows that are left out get ones on the diagonal and do not enter the norm
    inverse = solve_lower(cholesky(J @ J.T + jnp.where(kept, 0.0, 1.0) * one), one)
    square = jnp.sum(jnp.where(kept[:, None], inverse, 0.0) ** 2)
    return jnp.where(jnp.isfinite(square), 1 / jnp.sqrt(square), 0.0)


def independent(
    constraints: Constraints, J: Float[Array, "m k"], tolerance: float
) -> Bool[Array, " m"]:
    """Mask of independent rows, scaled by the longest row of their kind."""
    J = _scaled(constraints, J)
    return independent_rows(J @ J.T, tolerance)


def kept_rows(model: TreeModel, t: Float[Array, ""], at: TreeCoordinates) -> Bool[Array, " m"]:
    """Mask of the independent rows (m,) for a step that starts here.

    Rows are tested here and a little further along the motion, and the larger set is taken: in
    a singular posture rows may be dependent that are independent before and after it.
    """
    ahead = AHEAD * _along(at.u)
    J_after = lambda share: rows_after(model, t, at, share * ahead)
    one = lambda share: independent(model.constraints, J_after(share), DEPENDENT)
    here, there = jax.vmap(one)(jnp.array([0.0, 1.0], at.u.dtype))
    return jnp.where(jnp.sum(here) >= jnp.sum(there), here, there)


def nearness(model: TreeModel, t: Float[Array, ""], at: TreeCoordinates) -> Nearness:
    """Nearness of this posture to a singular one, in comparison with those before and after."""
    kept = model.kept
    assert kept is not None
    model, at = held_constant((model, at))
    step = _APART * _along(at.u)

    def clearance(place: Float[Array, ""]) -> Float[Array, ""]:
        return smallest(model.constraints, rows_after(model, t, at, place * step), kept)

    here = clearance(jnp.zeros((), at.u.dtype))

    def less_near(places: np.ndarray) -> Bool[Array, ""]:
        there = jax.lax.map(clearance, jnp.asarray(places, at.u.dtype))
        return jnp.all((there > here / NEARER) & (there > _LOST))

    # for most postures the two next to them decide
    no = lambda: jnp.asarray(False)
    others = lambda: less_near(_PLACES[np.abs(_PLACES) > 1])
    around = lambda: jax.lax.cond(less_near(_PLACES[np.abs(_PLACES) == 1]), others, no)
    return Nearness(jax.lax.cond(here < _CLEAR, around, no), here)
