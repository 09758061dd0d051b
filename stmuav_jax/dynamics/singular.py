"""Rows that depend on each other, always or for a moment, and motion through singular postures.

Where a mechanism passes through a singular posture, its accelerations and the projection onto
its constraints are smooth along the motion, but their equations lose rank: round-off is divided
by a singular value that goes through zero. Near by they are interpolated, from

    f(0) = sum_j w_j f(s_j) + O(s^10),    s_j = +-s, +-2 s, ..., +-5 s,

with f(s_j) at postures a little before and after along the velocities, on the constraints, where
the equations have their rank.
"""

from collections.abc import Callable
from math import factorial
from typing import Any, NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.linalg import cholesky, independent_rows, solve_lower
from ..mechanics.constraint import ROWS
from .closing import TreeModel, rows_after
from .coordinates import Coordinates
from .differential import Constraints

# Rows are dependent where the square of their distance from others is below this, in terms of the
# longest row of their kind. It is measured here and `AHEAD` [rad], [m] further along the
# velocities, but not below `_SLOW` [1/s], where they are round-off: a posture that is singular for
# a moment only gives some AHEAD^2 there, and rows that depend on each other where they hold
# AHEAD^4, as they hold up to AHEAD^2.
DEPENDENT = 1e-12
AHEAD = 1e-4
_SLOW = 1e-6

# Postures are near a singular one where the smallest singular value is less than this share of
# that in the postures around, `_APART` [rad], [m] apart: it goes through zero linearly, however
# large the mechanism and however small the value itself. They are not looked at where the value
# exceeds `_CLEAR`, and are of no use where it is below `_LOST` there too.
NEARER = 0.5
_CLEAR = 0.03
_LOST = 1e-6
_APART = 0.06
_HALF = 5


def _weights(half: int) -> np.ndarray:
    """Of values at -half, ..., -1, 1, ..., half in the one at 0 of the polynomial through them."""
    one_side = [
        (-1.0) ** (j + 1) * factorial(half) ** 2 / (factorial(half - j) * factorial(half + j))
        for j in range(1, half + 1)
    ]
    return np.array(one_side[::-1] + one_side)


_PLACES = np.array([*range(-_HALF, 0), *range(1, _HALF + 1)])
_WEIGHTS = _weights(_HALF)
# of the polynomial through all but the outermost, to see how good the interpolation is
_FEWER = np.array([0.0, *_weights(_HALF - 1), 0.0])
# What round-off makes of the equations themselves, times a power of the smallest singular value:
# the second for velocities brought onto the constraints, the third for accelerations.
_ROUND_OFF = 1e-15
_UNCERTAIN = 1e-6

T = TypeVar("T")


def _along(u: Float[Array, "k"]) -> Float[Array, "k"]:
    """Velocities scaled to a largest of one [rad], [m]; much less where they are round-off."""
    return jax.lax.stop_gradient(u / (_SLOW + jnp.max(jnp.abs(u), initial=0.0)))


class Nearness(NamedTuple):
    """Whether a posture is near a singular one, and the smallest singular value there."""

    near: Bool[Array, ""]
    smallest: Float[Array, ""]


def interpolated(
    at: Nearness, u: Float[Array, "k"], one: Callable[[Float[Array, "k"]], T], *, power: int
) -> T:
    """one(0); near a singular posture what lies between one(displacement) before and after.

    It is one(0) all the same where one order less makes a difference of more than what
    round-off makes of one(0), or of more than 1e-6: a motion that is no longer smooth there, as
    that of a linkage which misses the singular posture.

    Args:
        u: velocities. one: a displacement (k,) -> arrays.
        power: of the singular value that round-off is divided by.
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

    # the posture itself comes last, and only where it is needed: near a singular one its
    # derivatives need not be numbers
    end = lambda x: jnp.asarray([*x, 0.0], u.dtype)
    (found, _), _ = jax.lax.scan(add, (none, none), (end(_PLACES), end(_WEIGHTS), end(_FEWER)))
    return found


def _scaled(constraints: Constraints, J: Float[Array, "m k"]) -> Float[Array, "m k"]:
    """Rows in terms of the longest row of their kind, as numbers without a derivative."""
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
    """The smallest singular value of the kept rows, from below and to a factor sqrt(m).

    It is 1 / |L^-1| in Frobenius' norm, with J J^T = L L^T; zero where that has no factor.
    """
    J = jnp.where(kept[:, None], _scaled(constraints, J), 0.0)
    one = jnp.eye(len(J), dtype=J.dtype)
    # rows that are left out get a large diagonal, and no share of the norm
    inverse = solve_lower(cholesky(J @ J.T + jnp.where(kept, 0.0, 1.0) * one), one)
    square = jnp.sum(jnp.where(kept[:, None], inverse, 0.0) ** 2)
    return jnp.where(jnp.isfinite(square), 1 / jnp.sqrt(square), 0.0)


def independent(
    constraints: Constraints, J: Float[Array, "m k"], tolerance: float
) -> Bool[Array, " m"]:
    """Independent rows, in terms of the longest row of their kind."""
    J = _scaled(constraints, J)
    return independent_rows(J @ J.T, tolerance)


def kept_rows(model: TreeModel, t: Float[Array, ""], at: Coordinates) -> Bool[Array, " m"]:
    """Independent rows (m,) through a step that starts here.

    They are looked for here and a little way ahead, and the more taken: in a singular posture
    rows depend on each other that do not before and after.
    """
    ahead = AHEAD * _along(at.u)
    J_after = lambda share: rows_after(model, t, at, share * ahead)
    one = lambda share: independent(model.constraints, J_after(share), DEPENDENT)
    here, there = jax.vmap(one)(jnp.array([0.0, 1.0], at.u.dtype))
    return jnp.where(jnp.sum(here) >= jnp.sum(there), here, there)


def nearness(model: TreeModel, t: Float[Array, ""], at: Coordinates) -> Nearness:
    """Whether this posture is near a singular one, and those before and after are less so."""
    kept = model.kept
    assert kept is not None
    model, at = _still(model), _still(at)
    step = _APART * _along(at.u)

    def clearance(place: Float[Array, ""]) -> Float[Array, ""]:
        return smallest(model.constraints, rows_after(model, t, at, place * step), kept)

    here = clearance(jnp.zeros((), at.u.dtype))

    def less_near(places: np.ndarray) -> Bool[Array, ""]:
        there = jax.lax.map(clearance, jnp.asarray(places, at.u.dtype))
        return jnp.all((there > here / NEARER) & (there > _LOST))

    # most postures are told by the two next to them
    no = lambda: jnp.asarray(False)
    others = lambda: less_near(_PLACES[np.abs(_PLACES) > 1])
    around = lambda: jax.lax.cond(less_near(_PLACES[np.abs(_PLACES) == 1]), others, no)
    return Nearness(jax.lax.cond(here < _CLEAR, around, no), here)


def _still(tree: T) -> T:
    still = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x
    return jax.tree.map(still, tree)
