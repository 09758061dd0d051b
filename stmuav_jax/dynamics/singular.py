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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.linalg import independent_rows
from ..mechanics.constraint import ROWS
from .differential import Constraints

# Rows are dependent where the square of their distance from others is below this, in terms of the
# longest row of their kind. It is measured here and `AHEAD` [rad], [m] further along the
# velocities, but not below `_SLOW` [1/s], where they are round-off: a posture that is singular for
# a moment only gives some AHEAD^2 there, and rows that depend on each other where they hold
# AHEAD^4, as they hold up to AHEAD^2.
DEPENDENT = 1e-12
AHEAD = 1e-4
_SLOW = 1e-6

# Squares of singular values below this are near a singular posture: round-off over the cube of
# the singular value comes to the tolerances in use. Postures around are `_APART` [rad], [m] apart.
NEAR = 5e-5
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
_FEWER = np.concatenate([[0.0], _weights(_HALF - 1), [0.0]])


def along(u: Float[Array, "k"]) -> Float[Array, "k"]:
    """Velocities scaled to a largest of one [rad], [m]; much less where they are round-off."""
    return u / (_SLOW + jnp.max(jnp.abs(u), initial=0.0))


def around(u: Float[Array, "k"]) -> Float[Array, "p k"]:
    """Displacements to the postures before and after."""
    return _APART * jnp.asarray(_PLACES, u.dtype)[:, None] * along(u)


def interpolated(values: Any) -> tuple[Any, Float[Array, ""]]:
    """Values between those of the postures before and after (p, .); what one order less changes."""
    between = lambda x, w: jnp.tensordot(jnp.asarray(w, x.dtype), x, 1)
    found = jax.tree.map(lambda x: between(x, _WEIGHTS), values)
    fewer = jax.tree.map(lambda x: between(x, _FEWER), values)
    off = jax.tree.map(lambda x, y: jnp.max(jnp.abs(x - y), initial=0.0), found, fewer)
    return found, jnp.max(jnp.stack(jax.tree.leaves(off)))


def independent(
    constraints: Constraints, J: Float[Array, "m k"], tolerance: float
) -> Bool[Array, " m"]:
    """Independent rows, in terms of the longest row of their kind."""
    J = jax.lax.stop_gradient(J)
    square, sizes, start = jnp.sum(J**2, axis=1), [], 0
    for group in constraints.groups:
        count = ROWS[group.kind] * len(group.i)
        sizes.append(jnp.full(count, jnp.max(square[start : start + count])))
        start += count
    size = jnp.sqrt(jnp.concatenate(sizes))
    J = J / jnp.where(size > 0, size, 1.0)[:, None]
    return independent_rows(J @ J.T, tolerance)


def kept_rows(
    constraints: Constraints,
    u: Float[Array, "k"],
    J_after: Callable[[Float[Array, "k"]], Float[Array, "m k"]],
) -> Bool[Array, " m"]:
    """Independent rows (m,) through a step.

    They are looked for here and a little way ahead, and the more taken: in a singular posture
    rows depend on each other that do not before and after.

    Args:
        J_after: a displacement -> the rows there.
    """
    one = lambda share: independent(constraints, J_after(share * AHEAD * along(u)), DEPENDENT)
    here, there = jax.vmap(one)(jnp.array([0.0, 1.0], u.dtype))
    return jnp.where(jnp.sum(here) >= jnp.sum(there), here, there)


def is_near(
    constraints: Constraints,
    u: Float[Array, "k"],
    J_after: Callable[[Float[Array, "k"]], Float[Array, "m k"]],
    J: Float[Array, "m k"],
    kept: Bool[Array, " m"],
) -> Bool[Array, ""]:
    """Whether this posture is near a singular one, and those before and after are not."""
    count = lambda J: jnp.sum(independent(constraints, J, NEAR))
    rank = jnp.sum(kept)

    def clear() -> Bool[Array, ""]:
        return jnp.all(jax.vmap(lambda by: count(J_after(by)) >= rank)(around(u)))

    return jax.lax.cond(count(J) < rank, clear, lambda: jnp.asarray(False))
