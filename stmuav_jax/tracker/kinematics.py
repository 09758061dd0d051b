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

Source: report Part II, Eq. 3.2 to 3.20, corrected; docs/geometry.md.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.reason import AbstractReason
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
    across = jnp.sqrt(y * y + z * z)
    length = jnp.sqrt(x * x + y * y + z * z)
    return Turn(-y / across, z / across, x / length, across / length)


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
    along2 = loops.beside[0][0] / geometry.rods[0]
    x, y = (part / geometry.rods[1] for part in loops.beside[1])
    leg_2 = c2 * z2_phi, c2 * z2_theta + along2 * x2_theta
    leg_3 = c3 * z3_phi + y * y3_phi, c3 * z3_theta + x * x3_theta + y * y3_theta
    return (leg_2, leg_3), (c2, c3)


def stroke_jacobian(
    geometry: TrackerGeometry, angles: Float[Array, "2 *s"], rods: Rods = RISING
) -> Float[Array, "2 2 *s"]:
    """Stroke Jacobian dq_i / d(phi, theta) [m/rad] in closed form; NaN out of reach."""
    turn = turn_by_angles(angles)
    (leg_2, leg_3), (c2, c3) = loop_jacobian(geometry, turn, close_loops(geometry, turn), rods)
    return jnp.stack(
        [jnp.stack([leg_2[0] / c2, leg_2[1] / c2]), jnp.stack([leg_3[0] / c3, leg_3[1] / c3])]
    )


def parallel_margin(
    geometry: TrackerGeometry, turn: Turn, loops: Loops, rods: Rods = RISING
) -> Float[Array, "*s"]:
    """Margin det A / (b_2 b_3), about 1 for a level panel, 0 where the sliders cannot hold it."""
    (leg_2, leg_3), _ = loop_jacobian(geometry, turn, loops, rods)
    determinant = leg_2[1] * leg_3[0] - leg_2[0] * leg_3[1]
    return determinant / (geometry.panel_arms[0] * geometry.panel_arms[1])


# --- rates and accelerations


class PairMotion(NamedTuple):
    """Motion of a pair of coordinates: values, rates and accelerations, each (2, ...)."""

    value: Float[Array, "2 *s"]
    rate: Float[Array, "2 *s"]
    acceleration: Float[Array, "2 *s"]


def _times(J: Float[Array, "2 2 *s"], x: Float[Array, "2 *s"]) -> Float[Array, "2 *s"]:
    return jnp.stack([J[0, 0] * x[0] + J[0, 1] * x[1], J[1, 0] * x[0] + J[1, 1] * x[1]])


def solve_2x2(J: Float[Array, "2 2 *s"], x: Float[Array, "2 *s"]) -> Float[Array, "2 *s"]:
    """Solution J^-1 x by Cramer's rule."""
    det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    return jnp.stack([J[1, 1] * x[0] - J[0, 1] * x[1], J[0, 0] * x[1] - J[1, 0] * x[0]]) / det


def _jacobian_and_rate(
    geometry: TrackerGeometry, angles: Array, rates: Array, rods: Rods
) -> tuple[Float[Array, "2 2 *s"], Float[Array, "2 2 *s"]]:
    """Stroke Jacobian and its time derivative, by one forward derivative of the closed form."""
    return jax.jvp(lambda x: stroke_jacobian(geometry, x, rods), (angles,), (rates,))


def stroke_motion(geometry: TrackerGeometry, angles: PairMotion, rods: Rods = RISING) -> PairMotion:
    """Stroke motion [m], [m/s], [m/s^2] of a moving panel [rad], [rad/s], [rad/s^2].

    q' = J x', q'' = J x'' + J' x'.
    """
    J, J_rate = _jacobian_and_rate(geometry, angles.value, angles.rate, rods)
    return PairMotion(
        strokes(geometry, angles.value, rods),
        _times(J, angles.rate),
        _times(J, angles.acceleration) + _times(J_rate, angles.rate),
    )


def angle_accelerations(
    geometry: TrackerGeometry,
    angles: Float[Array, "2 *s"],
    rates: Float[Array, "2 *s"] | None,
    stroke_accelerations: Float[Array, "2 *s"],
    rods: Rods = RISING,
) -> Float[Array, "2 *s"]:
    """Accelerations of the panel angles [rad/s^2], x'' = J^-1 (q'' - J' x').

    Args:
        rates: rates of the angles x' [rad/s]; None for a panel at rest.
    """
    if rates is None:
        return solve_2x2(stroke_jacobian(geometry, angles, rods), stroke_accelerations)
    J, J_rate = _jacobian_and_rate(geometry, angles, rates, rods)
    return solve_2x2(J, stroke_accelerations - _times(J_rate, rates))
