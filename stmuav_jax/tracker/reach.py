"""Posture nearest to a direction that the tracker cannot face; not traceable.

Where the sun leaves the workspace, the panel faces the reachable direction at the smallest angle
from it. The workspace has no simple boundary (strokes, singularities and tilt each form a part),
so the posture is searched: first on a grid, then on ever finer patterns around the best.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import in_blocks, quick_jit
from ..checks.errors import ModelError
from .geometry import TrackerGeometry
from .kinematics import Reason, panel_normal
from .workspace import Limits, survey

_COARSE = np.radians(0.5)
_BLOCK = 32  # directions refined in one call, so that all calls share one program
_FINER, _SIZES, _AGAIN = 4.0, 6, 20  # ratio of pattern sizes, their number, and repetitions of each


def _steps(count: int, ratio: float) -> Float[np.ndarray, " k"]:
    """Geometric sequence of offsets -1, ..., 0, ..., 1, each a ratio smaller than the last."""
    steps = ratio ** -np.arange(count)
    return np.concatenate([-steps, [0.0], steps[::-1]])


# Offsets along the boundary and towards the direction. At the best posture the boundary is normal
# to the gradient, and a smooth one departs from its tangent by the square of the offset only:
# the steps towards the direction therefore go down to very small ones.
_ALONG, _TOWARDS = (part.reshape(-1, 1) for part in np.meshgrid(_steps(3, 2.0), _steps(6, 4.0)))


class ReachableGrid(NamedTuple):
    """Reachable postures of a grid of half a degree.

    Attributes:
        angles: panel angles (phi, theta) (2, m) [rad].
        normals: normals of the panel, base axes (3, m).
    """

    angles: Float[np.ndarray, "2 m"]
    normals: Float[np.ndarray, "3 m"]


def _inside(
    geometry: TrackerGeometry, limits: Limits, angles: Float[Array, "2 *s"]
) -> Bool[Array, "*s"]:
    return survey(geometry, angles, limits).reason == Reason.VALID


@quick_jit
def _surveyed(
    geometry: TrackerGeometry, limits: Limits, angles: Float[Array, "2 n"]
) -> tuple[Bool[Array, " n"], Float[Array, "3 n"]]:
    return _inside(geometry, limits, angles), panel_normal(angles)


def reachable_grid(geometry: TrackerGeometry, limits: Limits) -> ReachableGrid:
    """Reachable postures of a grid of half a degree, with their normals.

    Raises:
        ModelError: no posture is reachable.
    """
    phi = np.arange(-np.pi / 2, np.pi / 2 + 1e-9, _COARSE)
    grid = np.stack(np.meshgrid(phi, phi)).reshape(2, -1)
    inside, normals = map(np.asarray, _surveyed(geometry, limits, grid))
    if not np.any(inside):
        raise ModelError(
            "The tracker reaches no posture at all with these lengths and limits of strokes."
        )
    return ReachableGrid(grid[:, inside], normals[:, inside])


def nearest_reachable(
    geometry: TrackerGeometry,
    directions_b: Float[np.ndarray, "3 n"],
    limits: Limits,
    grid: ReachableGrid | None = None,
) -> Float[np.ndarray, "2 n"]:
    """Postures of the workspace whose normals are nearest to directions, to 0.001 degrees.

    Args:
        directions_b: unit vectors in the base's axes (3, n).
        grid: `reachable_grid` of the same tracker and limits, if there is one already.

    Returns:
        panel angles (phi, theta) (2, n) [rad].

    Raises:
        ModelError: the workspace is empty.
    """
    if directions_b.shape[1] == 0:
        return np.zeros((2, 0))
    grid = reachable_grid(geometry, limits) if grid is None else grid
    # rows of the product are contiguous, in which the largest number is found ten times as fast
    first = grid.angles[:, np.argmax(directions_b.T @ grid.normals, axis=1)]
    one = lambda rows, start: np.asarray(_refine(geometry, limits, rows.T, start.T)).T
    return in_blocks(one, _BLOCK, directions_b.T, first.T).T


@quick_jit
def _refine(
    geometry: TrackerGeometry, limits: Limits, directions_b: Array, start: Array
) -> Float[Array, "2 n"]:
    """Refine postures by a pattern search: the best of 91 around each, on ever finer patterns."""

    def closeness(angles: Array) -> Array:
        return jnp.sum(panel_normal(angles) * directions_b, axis=0)

    def search(count: int | Array, best: Array) -> Array:
        value, pull = jax.vjp(closeness, best)
        (slope,) = pull(jnp.ones_like(value))
        towards = slope / jnp.maximum(jnp.linalg.norm(slope, axis=0), 1e-12)
        along = jnp.stack([-towards[1], towards[0]])
        size = _COARSE * _FINER ** -jnp.floor(count / _AGAIN)
        near = best[:, None] + size * (_ALONG * along[:, None] + _TOWARDS * towards[:, None])
        close = jnp.sum(panel_normal(near) * directions_b[:, None], axis=0)
        close = jnp.where(_inside(geometry, limits, near), close, -jnp.inf)
        return jnp.take_along_axis(near, jnp.argmax(close, axis=0)[None, None], axis=1)[:, 0]

    return jax.lax.fori_loop(0, _SIZES * _AGAIN, search, start)
