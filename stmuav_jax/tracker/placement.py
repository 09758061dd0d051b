"""Poses and velocities of the tracker's six bodies, and its eight joints, by panel orientation."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import angular_velocity, product, rotation_matrix, turn_about
from ..mechanics.state import State
from .geometry import TrackerGeometry, close_loops, turn_by_angles
from .kinematics import RISING, Rods, strokes_of

# Bodies of the tracker, in the order of its arrays.
TRACKER_BODIES = ("slider_2", "slider_3", "post_4", "rod_5", "rod_6", "panel_7")


class Placement(NamedTuple):
    """Bodies and joints of the tracker at one posture, in the base's frame.

    Attributes:
        r: centres of mass of the bodies, in the order of `TRACKER_BODIES` (6, 3) [m].
        p: Euler parameters of the bodies, body to base (6, 4).
        points: points of the joints by joint name (3,) [m].
        axes: axes of the joints by joint name (3,), those of universal joints as "U35.i" and
            "U35.j".
    """

    r: Float[Array, "6 3"]
    p: Float[Array, "6 4"]
    points: dict[str, Float[Array, "3"]]
    axes: dict[str, Float[Array, "3"]]


class _PlacedBodies(NamedTuple):
    """Bodies of a `Placement`, and what its joints' points and axes are made of."""

    r: Float[Array, "6 3"]
    p: Float[Array, "6 4"]
    hinge: Float[Array, "3"]
    top: Float[Array, "3"]
    low: tuple[Float[Array, "3"], Float[Array, "3"]]
    balls: tuple[Float[Array, "3"], Float[Array, "3"]]
    R_panel: Float[Array, "3 3"]


def _bodies(geometry: TrackerGeometry, angles: Float[Array, "2"], rods: Rods) -> _PlacedBodies:
    loops = close_loops(geometry, turn_by_angles(angles))
    q2, q3 = strokes_of(geometry, loops, rods)
    x, y, z = jnp.eye(3)
    hinge = jnp.stack([geometry.axis[0], geometry.axis[1], geometry.hinge])
    foot = jnp.stack([geometry.axis[0], geometry.axis[1], jnp.zeros(())])
    top = hinge + loops.rise * z - loops.lean * y
    ball_2, ball_3 = (hinge + jnp.stack(ball) for ball in loops.balls)
    low_2 = foot - geometry.arms[0] * x + q2 * z
    low_3 = foot + geometry.arms[1] * y + q3 * z
    along_2, along_3 = ball_2 - low_2, ball_3 - low_3
    aside = jnp.arctan2(along_3[0], along_3[2])
    forth = jnp.arctan2(-along_3[1], jnp.sqrt(along_3[0] ** 2 + along_3[2] ** 2))
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    post = turn_about(jnp.arctan2(loops.lean, loops.rise), 0)
    rod_5 = product(turn_about(aside, 1), turn_about(forth, 0))
    rod_6 = turn_about(jnp.arctan2(along_2[0], along_2[2]), 1)
    panel = product(turn_about(angles[0], 0), turn_about(angles[1], 1))
    R_panel = rotation_matrix(panel)
    out, up = geometry.slider_out, geometry.slider_up
    r = jnp.stack(
        [
            low_2 - out[0] * x + up[0] * z,
            low_3 + out[1] * y + up[1] * z,
            hinge + rotation_matrix(post) @ geometry.post_com,
            low_3 + geometry.rod_com[1] * along_3,
            low_2 + geometry.rod_com[0] * along_2,
            top + R_panel @ geometry.panel_com,
        ]
    )
    p = jnp.stack([level, level, post, rod_5, rod_6, panel])
    return _PlacedBodies(r, p, hinge, top, (low_2, low_3), (ball_2, ball_3), R_panel)


def place(geometry: TrackerGeometry, angles: Float[Array, "2"], rods: Rods = RISING) -> Placement:
    """Place every body and joint at panel angles (phi, theta) (2,) [rad]; NaN out of reach.

    Body axes: z along the post and the rods, upward from the lower joint; post R_x, rod 6
    R_y, rod 5 R_y R_x (the y axis of universal joint 3-5 is in the slider, its x axis in the
    rod), panel R_x R_y.

    Source: report Part II, section 3.1 and Eq. 3.10; docs/geometry.md.
    """
    at = _bodies(geometry, angles, rods)
    x, y, z = jnp.eye(3)
    points = {
        "T12": at.r[0], "T13": at.r[1], "R14": at.hinge, "R26": at.low[0],
        "U35": at.low[1], "U47": at.top, "S57": at.balls[1], "S67": at.balls[0],
    }  # fmt: skip
    axes = {
        "T12": z, "T13": z, "R14": x, "R26": y,
        "U35.i": y, "U35.j": rotation_matrix(at.p[3])[:, 0],
        "U47.i": x, "U47.j": at.R_panel[:, 1],
    }  # fmt: skip
    return Placement(at.r, at.p, points, axes)


@quick_jit
def posture(
    geometry: TrackerGeometry,
    angles: Float[Array, "2"],
    rates: Float[Array, "2"] | None = None,
    rods: Rods = RISING,
) -> State:
    """State of the six bodies on a base at rest.

    Args:
        angles: panel angles (phi, theta) (2,) [rad].
        rates: rates of the panel angles (2,) [rad/s], by default zero.
    """

    def poses(x: Array) -> tuple[Array, Array]:
        at = _bodies(geometry, x, rods)
        return at.r, at.p

    if rates is None:
        r, p = poses(angles)
        return State(r, p, jnp.zeros_like(r), jnp.zeros_like(r))
    (r, p), (v, p_rate) = jax.jvp(poses, (angles,), (rates,))
    return State(r, p, v, jax.vmap(angular_velocity)(p, p_rate))
