"""Forward kinematics of the tracker: panel angles from strokes, on one branch.

q_2 and q_3 both depend on both angles: q_2 on theta through rod 6 and on phi through the post's
lean. Eliminating one angle gives a polynomial of high degree without an explicit solution, so
Newton's method solves the two equations together, with the closed-form Jacobian. Several postures
have the same strokes. Two of them meet where the parallel margin is zero, and its sign separates
them: every iterate here has the sign of the start.

Source: the equations are report Part II, Eq. 3.9, corrected; docs/geometry.md.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..checks.reason import first_reason
from .geometry import TrackerGeometry, close_loops, turn_by_angles
from .kinematics import RISING, Reason, Rods, loop_jacobian, solve_2x2, strokes_of

# Largest length of a Newton step [rad]; solutions lie much farther apart.
_LONGEST_STEP = 0.2
_MOST_STEPS = 60
# Step length [rad] at which the loop ends; two full steps after it square the error twice.
_CLOSE = 1e-7
_SMALLEST_SCALE = 1e-6


class Found(NamedTuple):
    """Panel angles found for strokes.

    Attributes:
        angles: panel angles (phi, theta) (2, ...) [rad], NaN where not found.
        reason: codes of `Reason` (...).
        margin: `parallel_margin` at these angles (...).
    """

    angles: Float[Array, "2 *s"]
    reason: Int[Array, "*s"]
    margin: Float[Array, "*s"]


def _look(
    geometry: TrackerGeometry, q: Array, angles: Array, rods: Rods
) -> tuple[Float[Array, "2 *s"], Float[Array, "*s"]]:
    """Full Newton step [rad] towards strokes q, and the parallel margin."""
    turn = turn_by_angles(angles)
    loops = close_loops(geometry, turn)
    (a, b), c = loop_jacobian(geometry, turn, loops, rods)
    reached = strokes_of(geometry, loops, rods)
    # rows of the loop equations and not of q, which would be divided by zero for a level rod
    wanted = [c[k] * (q[k] - reached[k]) for k in (0, 1)]
    step = solve_2x2(jnp.stack([jnp.stack(a), jnp.stack(b)]), jnp.stack(wanted))
    margin = (a[1] * b[0] - a[0] * b[1]) / (geometry.panel_arms[0] * geometry.panel_arms[1])
    return step, margin


class _Search(NamedTuple):
    """State of Newton's method: angles, full step, margin, damping factor, number of steps."""

    angles: Array
    step: Array
    margin: Array
    scale: Array
    steps: Array


def _size(step: Array) -> Array:
    return jnp.sqrt(step[0] ** 2 + step[1] ** 2)


def _search(
    geometry: TrackerGeometry, q: Array, start: Array, rods: Rods
) -> tuple[Float[Array, "2 *s"], Bool[Array, "*s"]]:
    """Newton's method with every iterate on the start's side of det A = 0 and within reach."""
    step, margin = _look(geometry, q, start, rods)
    side = jnp.sign(margin)
    finite = jnp.isfinite(step[0] + step[1])

    def open_(s: _Search) -> Array:
        return finite & (_size(s.step) > _CLOSE) & (s.scale > _SMALLEST_SCALE)

    def again(s: _Search) -> Array:
        return (s.steps < _MOST_STEPS) & jnp.any(open_(s))

    def advance(s: _Search) -> _Search:
        part = s.scale * jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(_size(s.step), _CLOSE))
        angles = s.angles + part * s.step
        step, margin = _look(geometry, q, angles, rods)
        allowed = jnp.isfinite(step[0] + step[1]) & (side * margin > 0)
        take = allowed & open_(s)
        return _Search(
            jnp.where(take, angles, s.angles),
            jnp.where(take, step, s.step),
            jnp.where(take, margin, s.margin),
            jnp.where(allowed, jnp.minimum(1.0, 2 * s.scale), s.scale / 4),
            s.steps + 1,
        )

    first = _Search(start, step, margin, jnp.ones_like(margin), jnp.asarray(0))
    last = jax.lax.while_loop(again, advance, first)
    return last.angles, finite & (_size(last.step) <= _CLOSE)


def angles_from_strokes(
    geometry: TrackerGeometry,
    q: Float[Array | np.ndarray, "2 *s"],
    start: Float[Array | np.ndarray, "2 *#s"] | None = None,
    rods: Rods = RISING,
) -> Found:
    """Panel angles that given strokes hold, on the branch of `start`.

    There is no closed form. Newton's method starts from `start`, takes steps of at most 0.2
    rad, and refuses those that leave the reach or pass det A = 0: the solution has the start's
    sign of `parallel_margin`. With the adopted lengths that posture is the only one up to 66
    degrees of tilt; at 70 there are others on the same side, so that the start must be near the
    wanted one (as it is in `follow`).

    Derivatives by q and the lengths are right up to the third order.

    Args:
        q: strokes (2, ...) [m].
        start: initial angles (2, ...) [rad]; by default those of a level panel.
        rods: sense in which the rods rise (+1) or fall (-1).

    Returns:
        angles, and `Reason.NOT_FINITE` or `Reason.NOT_CONVERGED` where there are none.

    Source: the equations are report Part II, Eq. 3.9, corrected.
    """
    q = jnp.asarray(q)
    begin = jnp.zeros_like(q) if start is None else jnp.broadcast_to(jnp.asarray(start), q.shape)
    finite = jnp.isfinite(q[0] + q[1]) & jnp.isfinite(begin[0] + begin[1])
    fixed = jax.lax.stop_gradient((geometry, q, begin))
    angles, converged = _search(*fixed, rods)
    # each full step squares the error of the value and of its Taylor series in q and lengths
    for _ in (0, 1):
        angles = angles + _look(geometry, q, angles, rods)[0]
    _, margin = _look(geometry, q, angles, rods)
    reason = first_reason((~finite, Reason.NOT_FINITE), (~converged, Reason.NOT_CONVERGED))
    valid = reason == Reason.VALID
    return Found(jnp.where(valid, angles, jnp.nan), reason, jnp.where(valid, margin, jnp.nan))


def follow(
    geometry: TrackerGeometry,
    q: Float[Array | np.ndarray, "2 n"],
    start: Float[Array | np.ndarray, "2"],
    rods: Rods = RISING,
    *,
    max_distance: float = 0.2,
) -> Found:
    """Panel angles along a path of strokes, continued from `start` on the same branch.

    The search at each point starts from the one before. Where it fails, or finds angles farther
    than `max_distance` away, the path ends: that point and all later ones are NaN, with
    `Reason.NOT_CONVERGED` or `Reason.BRANCH` at the first of them and `BRANCH` after it.

    Args:
        q: strokes at n points of the path (2, n) [m].
        start: angles near the first point (2,) [rad].
        max_distance: largest distance between neighbouring points [rad].
    """

    def next_point(at: tuple[Array, Array], target: Array) -> tuple[tuple[Array, Array], Found]:
        angles, lost = at
        found = angles_from_strokes(geometry, target, angles, rods)
        far = _size(found.angles - angles) > max_distance
        wrong = (lost, Reason.BRANCH), (far, Reason.BRANCH)
        reason = jnp.where(found.reason == 0, first_reason(*wrong), found.reason)
        reason = jnp.where(lost, jnp.int8(Reason.BRANCH), reason)
        good = reason == Reason.VALID
        kept = Found(
            jnp.where(good, found.angles, jnp.nan), reason, jnp.where(good, found.margin, jnp.nan)
        )
        return (jnp.where(good, found.angles, angles), ~good), kept

    first = (jnp.asarray(start, dtype=float), jnp.asarray(False))
    _, path = jax.lax.scan(next_point, first, jnp.asarray(q).T)
    return Found(path.angles.T, path.reason, path.margin)
