"""Inverse kinematics of the tracker: strokes, panel angles, panel normal, and their rates.

A posture is the pair of panel angles (phi, theta) [rad], R_w7 = R_x(phi) R_y(theta) in the
base's axes; the strokes are q = (q_2, q_3) [m], the heights of the rods' lower joints in the
base's frame (leg 2 first). A scene's slider joints, servos and end stops measure the displacement
q - strokes(geometry, initial_angles(table)), zero at the scene's start.

From angles to strokes there is a closed form for each leg, with two solutions: the rod
rises from its lower joint to the panel (+1, the machine as it is built) or falls (-1),

    q_i = z_O + C_iz -+ sqrt(L_i^2 - |horizontal offset of C_i from the line of B_i|^2).

From strokes to angles there is none (forward.py). Where the 2 x 2 determinant of
`loop_jacobian` is zero, two postures of the same strokes meet; its sign separates them.

Arrays have their components first and any axes of a stack last: angles (2, ...), strokes
(2, ...), directions (3, ...). Every function is elementwise and may be jitted, vmapped and
differentiated.

Source: report Part II, Eq. 3.2 to 3.20, corrected; docs/report_machine.md."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import AbstractReason, first_reason
from .geometry import Loops, TrackerGeometry, Turn, close_loops, safe_root, turn_by_angles

# Sense of the rods of legs 2 and 3: rising (+1) or falling (-1) from slider to panel.
Rods = tuple[float, float]
RISING: Rods = (1.0, 1.0)


class Reason(AbstractReason):
    """Reason for which a posture, a stroke or a direction is not valid; the first that applies."""

    VALID = 0
    NOT_FINITE = 1
    ZERO_LENGTH = 2
    TILT = 3
    POST_ROOT = 4
    ROD_2_ROOT = 5
    ROD_3_ROOT = 6
    SINGULAR = 7
    STROKE_2 = 8
    STROKE_3 = 9
    NOT_CONVERGED = 10
    BRANCH = 11
    BELOW_HORIZON = 20


# --- positions


def panel_normal(angles: Float[Array, "2 *s"]) -> Float[Array, "3 *s"]:
    """Panel normal R e_z = (sin theta, -sin phi cos theta, cos phi cos theta), base axes (3, ...).

    Source: report Part II, Eq. 3.13.
    """
    sp, cp, st, ct = turn_by_angles(angles)
    return jnp.stack([st, -sp * ct, cp * ct])


def panel_angles(direction: Float[Array | np.ndarray, "3 *s"]) -> Float[Array, "2 *s"]:
    """Panel angles (phi, theta) [rad] whose normal is along a direction of any length, base axes.

    |theta| <= 90 degrees and |phi| <= 180; phi is not determined (0 here) where the direction
    is along x.

    Source: report Part II, Eq. 3.13, solved without its restriction to n_z >= 0.
    """
    x, y, z = direction[0], direction[1], direction[2]
    return jnp.stack([jnp.arctan2(-y, z), jnp.arctan2(x, jnp.sqrt(y * y + z * z))])


def turn_by_direction(direction: Float[Array | np.ndarray, "3 *s"]) -> Turn:
    """Sines and cosines of `panel_angles`, without trigonometric functions.

    NaN for directions of zero length or along x, where phi is not determined.
    """
    x, y, z = direction[0], direction[1], direction[2]
    yz_length = jnp.sqrt(y * y + z * z)
    length = jnp.sqrt(x * x + y * y + z * z)
    return Turn(-y / yz_length, z / yz_length, x / length, yz_length / length)


def strokes_of(
    geometry: TrackerGeometry, loops: Loops, rods: Rods = RISING
) -> tuple[Float[Array, "*s"], Float[Array, "*s"]]:
    """Strokes q_2 and q_3 [m] of closed loops, NaN where a root is imaginary."""
    (_, _, z2), (_, _, z3) = loops.balls
    return (
        geometry.hinge + z2 - rods[0] * safe_root(loops.squares[0]),
        geometry.hinge + z3 - rods[1] * safe_root(loops.squares[1]),
    )


def strokes(
    geometry: TrackerGeometry, angles: Float[Array, "2 *s"], rods: Rods = RISING
) -> Float[Array, "2 *s"]:
    """Strokes (q_2, q_3) [m] at panel angles (2, ...) [rad]; NaN out of reach.

    Source: report Part II, Eq. 3.9, corrected.
    """
    loops = close_loops(geometry, turn_by_angles(angles))
    return jnp.stack(strokes_of(geometry, loops, rods))


def loop_jacobian(
    geometry: TrackerGeometry, turn: Turn, loops: Loops, rods: Rods = RISING
) -> tuple[tuple[tuple[Array, Array], tuple[Array, Array]], tuple[Array, Array]]:
    """Jacobians of the loop equations: c_i dq_i = A_i1 dphi + A_i2 dtheta.

    c_i is the z component of rod i's direction and A_i [m/rad] the motion of its ball joint
    along the rod. Where c_i = 0, the rod is level and the slider cannot set its angle (a
    singularity of the inverse map). Where det A = 0, the sliders cannot hold the panel (a
    singularity of the forward map).

    Returns:
        rows A_2 and A_3, and (c_2, c_3), each of the shape of the angles.
    """
    sp, cp, st, ct = turn
    # Derivatives are written out: a forward derivative through the roots would divide by zero on the edge
    # of the reach, where the Jacobian of the loop equations itself is finite.
    (b2, b3), (h2, h3) = geometry.panel_arms, geometry.panel_depths
    w, slope = loops.lever, -loops.lean / loops.rise
    x2 = loops.balls[0][0]
    lean_phi, lean_theta = cp * w, sp * x2
    rise_phi, rise_theta = slope * lean_phi, slope * lean_theta
    z2_phi, z2_theta = rise_phi + sp * w, rise_theta - cp * x2
    x2_theta = b2 * st - h2 * ct
    y3_phi = -lean_phi - b3 * sp + h3 * ct * cp
    z3_phi = rise_phi + b3 * cp + h3 * ct * sp
    x3_theta, y3_theta, z3_theta = -h3 * ct, -lean_theta - h3 * st * sp, rise_theta + h3 * st * cp
    c2 = rods[0] * safe_root(loops.squares[0]) / geometry.rods[0]
    c3 = rods[1] * safe_root(loops.squares[1]) / geometry.rods[1]
    along2 = loops.offsets[0][0] / geometry.rods[0]
    x, y = (part / geometry.rods[1] for part in loops.offsets[1])
    leg_2 = c2 * z2_phi, c2 * z2_theta + along2 * x2_theta
    leg_3 = c3 * z3_phi + y * y3_phi, c3 * z3_theta + x * x3_theta + y * y3_theta
    return (leg_2, leg_3), (c2, c3)


def stroke_jacobian(
    geometry: TrackerGeometry, angles: Float[Array, "2 *s"], rods: Rods = RISING
) -> Float[Array, "2 2 *s"]:
    """Stroke Jacobian dq_i / d(phi, theta) [m/rad] in closed form; NaN out of reach."""
    turn = turn_by_angles(angles)
    (leg_2, leg_3), (c2, c3) = loop_jacobian(geometry, turn, close_loops(geometry, turn), rods)
    rows = ((leg_2[0] / c2, leg_2[1] / c2), (leg_3[0] / c3, leg_3[1] / c3))
    return jnp.stack([jnp.stack(row) for row in rows])


# --- rates and accelerations


class PairMotion(NamedTuple):
    """Motion of a pair of coordinates: values, rates and accelerations, each (2, ...)."""

    value: Float[Array, "2 *s"]
    rate: Float[Array, "2 *s"]
    acceleration: Float[Array, "2 *s"]


def _apply_jacobian(J: Float[Array, "2 2 *s"], x: Float[Array, "2 *s"]) -> Float[Array, "2 *s"]:
    return jnp.stack([J[0, 0] * x[0] + J[0, 1] * x[1], J[1, 0] * x[0] + J[1, 1] * x[1]])


def solve_2x2(J: Float[Array, "2 2 *s"], x: Float[Array, "2 *s"]) -> Float[Array, "2 *s"]:
    """Solution J^-1 x by Cramer's rule."""
    # Two unknowns by Cramer's rule, elementwise: a day has thousands of postures, each too small for a
    # library.
    det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    return jnp.stack([J[1, 1] * x[0] - J[0, 1] * x[1], J[0, 0] * x[1] - J[1, 0] * x[0]]) / det


def stroke_motion(geometry: TrackerGeometry, angles: PairMotion) -> PairMotion:
    """Stroke motion [m], [m/s], [m/s^2] of a moving panel [rad], [rad/s], [rad/s^2].

    q' = J x', q'' = J x'' + J' x'.
    """
    jacobian = lambda x: stroke_jacobian(geometry, x)
    J, J_rate = jax.jvp(jacobian, (angles.value,), (angles.rate,))
    return PairMotion(
        strokes(geometry, angles.value),
        _apply_jacobian(J, angles.rate),
        _apply_jacobian(J, angles.acceleration) + _apply_jacobian(J_rate, angles.rate),
    )


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
        margin: margin det A / (b_2 b_3) at these angles (...).
    """

    angles: Float[Array, "2 *s"]
    reason: Int[Array, "*s"]
    margin: Float[Array, "*s"]


def _newton_step(
    geometry: TrackerGeometry, q: Array, angles: Array
) -> tuple[Float[Array, "2 *s"], Float[Array, "*s"]]:
    """Full Newton step [rad] towards strokes q, and the parallel margin."""
    turn = turn_by_angles(angles)
    loops = close_loops(geometry, turn)
    (a, b), c = loop_jacobian(geometry, turn, loops)
    current_strokes = strokes_of(geometry, loops)
    # rows of the loop equations and not of q, which would be divided by zero for a level rod
    loop_residuals = [c[k] * (q[k] - current_strokes[k]) for k in (0, 1)]
    step = solve_2x2(jnp.stack([jnp.stack(a), jnp.stack(b)]), jnp.stack(loop_residuals))
    margin = (a[1] * b[0] - a[0] * b[1]) / (geometry.panel_arms[0] * geometry.panel_arms[1])
    return step, margin


class _Search(NamedTuple):
    """State of Newton's method: angles, full step, margin, damping factor, number of steps."""

    angles: Array
    step: Array
    margin: Array
    scale: Array
    steps: Array


def _step_size(step: Array) -> Array:
    return jnp.sqrt(step[0] ** 2 + step[1] ** 2)


def _search_angles(
    geometry: TrackerGeometry, q: Array, start: Array
) -> tuple[Float[Array, "2 *s"], Bool[Array, "*s"]]:
    """Newton's method with every iterate on the start's side of det A = 0 and within reach."""
    step, margin = _newton_step(geometry, q, start)
    side = jnp.sign(margin)
    finite = jnp.isfinite(step[0] + step[1])

    def is_open(s: _Search) -> Array:
        return finite & (_step_size(s.step) > _CLOSE) & (s.scale > _SMALLEST_SCALE)

    def is_unfinished(s: _Search) -> Array:
        return (s.steps < _MOST_STEPS) & jnp.any(is_open(s))

    def newton_update(s: _Search) -> _Search:
        # The step is bounded so that an iterate cannot jump over the curve det A = 0, on whose other side
        # another assembly has the same strokes.
        part = s.scale * jnp.minimum(1.0, _LONGEST_STEP / jnp.maximum(_step_size(s.step), _CLOSE))
        angles = s.angles + part * s.step
        step, margin = _newton_step(geometry, q, angles)
        # A step that leaves the reach or changes the side is taken again with a quarter of its length.
        allowed = jnp.isfinite(step[0] + step[1]) & (side * margin > 0)
        take = allowed & is_open(s)
        pairs = zip((angles, step, margin), (s.angles, s.step, s.margin), strict=True)
        parts = (jnp.where(take, candidate, present) for candidate, present in pairs)
        scale = jnp.where(allowed, jnp.minimum(1.0, 2 * s.scale), s.scale / 4)
        return _Search(*parts, scale=scale, steps=s.steps + 1)

    initial_search = _Search(start, step, margin, jnp.ones_like(margin), jnp.asarray(0))
    final_search = jax.lax.while_loop(is_unfinished, newton_update, initial_search)
    return final_search.angles, finite & (_step_size(final_search.step) <= _CLOSE)


def angles_from_strokes(
    geometry: TrackerGeometry,
    q: Float[Array | np.ndarray, "2 *s"],
    start: Float[Array | np.ndarray, "2 *#s"] | None = None,
) -> Found:
    """Panel angles that given strokes hold with rods that rise, on the branch of `start`.

    There is no closed form. Newton's method starts from `start`, takes steps of at most 0.2
    rad, and refuses those that leave the reach or pass det A = 0: the solution has the start's
    sign of det A. With the adopted lengths that posture is the only one up to 66
    degrees of tilt; at 70 there are others on the same side, so that the start must be near the target (as it
    is in `follow`).

    Derivatives by q and the lengths are right up to the third order.

    Args:
        q: strokes (2, ...) [m].
        start: initial angles (2, ...) [rad]; by default those of a level panel.

    Returns:
        angles, and `Reason.NOT_FINITE` or `Reason.NOT_CONVERGED` where there are none.

    Source: the equations are report Part II, Eq. 3.9, corrected.
    """
    q = jnp.asarray(q)
    begin = jnp.zeros_like(q) if start is None else jnp.broadcast_to(jnp.asarray(start), q.shape)
    finite = jnp.isfinite(q[0] + q[1]) & jnp.isfinite(begin[0] + begin[1])
    # The search finds numbers alone; two full Newton steps after it carry the derivatives, as each of
    # them doubles the order to which the series of the solution is right.
    fixed = jax.lax.stop_gradient((geometry, q, begin))
    angles, converged = _search_angles(*fixed)
    # each full step squares the error of the value and of its Taylor series in q and lengths
    for _ in (0, 1):
        angles = angles + _newton_step(geometry, q, angles)[0]
    _, margin = _newton_step(geometry, q, angles)
    reason = first_reason((~finite, Reason.NOT_FINITE), (~converged, Reason.NOT_CONVERGED))
    valid = reason == Reason.VALID
    return Found(jnp.where(valid, angles, jnp.nan), reason, jnp.where(valid, margin, jnp.nan))


def follow(
    geometry: TrackerGeometry,
    q: Float[Array | np.ndarray, "2 n"],
    start: Float[Array | np.ndarray, "2"],
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
        candidate = angles_from_strokes(geometry, target, angles)
        is_too_far = _step_size(candidate.angles - angles) > max_distance
        branch_causes = (lost, Reason.BRANCH), (is_too_far, Reason.BRANCH)
        reason = jnp.where(candidate.reason == 0, first_reason(*branch_causes), candidate.reason)
        reason = jnp.where(lost, jnp.int8(Reason.BRANCH), reason)
        is_valid = reason == Reason.VALID
        hide = lambda x: jnp.where(is_valid, x, jnp.nan)
        path_point = Found(hide(candidate.angles), reason, hide(candidate.margin))
        return (jnp.where(is_valid, candidate.angles, angles), ~is_valid), path_point

    initial_carry = (jnp.asarray(start, dtype=float), jnp.asarray(False))
    _, path = jax.lax.scan(next_point, initial_carry, jnp.asarray(q).T)
    return Found(path.angles.T, path.reason, path.margin)
