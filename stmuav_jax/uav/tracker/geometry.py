"""Lengths of the tracker, and positions of its joints for an orientation of the panel.

Leg 2 (slider 2, rod 6) stands on the -x side of the post, leg 3 (slider 3, rod 5) on its +y
side; pairs of numbers are in that order. The base's frame is the tracker frame of Part I of
the report, z along the sliders. With R = R_x(phi) R_y(theta) the panel's orientation:

    hinge O      on the post's axis, turning about x
    top O3       O + r (0, -sin gamma, cos gamma)
    balls C_i    O3 + R (-b_2, 0, -h_2),  O3 + R (0, b_3, -h_3)
    feet B_i     on lines parallel to z, at (-a_2, 0) and (0, a_3) from the post's axis

Leg 2 keeps C_2 in the plane of the post's axis and its own foot, which fixes gamma:
r sin gamma = (R (-b_2, 0, -h_2))_y. The designs need not be symmetric.

Source: report Part II, section 3.1 and Eq. 3.2 to 3.20, corrected; docs/report_machine.md.
"""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError, check_finite, check_shape, has_values
from ...checks.numbers import as_floats
from ...math.compiler import kept_jit
from ...math.derivative import safe_sqrt
from ...mechanics.parameters import Parameters

LEGS = (2, 3)

_SHAPES: dict[str, tuple[int, ...]] = {
    "axis": (2,), "hinge": (), "post": (), "arms": (2,), "panel_arms": (2,),
    "panel_depths": (2,), "rods": (2,), "slider_out": (2,), "slider_up": (2,),
    "post_com": (3,), "rod_com": (2,), "panel_com": (3,),
}  # fmt: skip
_POSITIVE = ("post", "arms", "panel_arms", "rods")


class TrackerGeometry(eqx.Module):
    """Lengths of the tracker [m]; pairs are (leg 2, leg 3).

    Args:
        axis: x and y of the post's axis in the base's frame (2,).
        hinge: z_O, height of the revolute joint 1-4 ().
        post: r, distance from revolute joint 1-4 to universal joint 4-7 ().
        arms: a, distances of the rods' lower joints from the post's axis (2,).
        panel_arms: b, distances of the ball joints from the universal joint along the panel (2,).
        panel_depths: h, depths of the ball joints below the universal joint, normal to the panel
            (2,); they may be negative.
        rods: L, distances from lower joint to ball joint (2,).
        slider_out, slider_up: distances of the sliders' centres of mass outside and above their
            rods' lower joints (2,).
        post_com: centre of mass of the post from the hinge, post axes (3,).
        rod_com: centres of mass of the rods, as fractions of L from the lower joint (2,) [1].
        panel_com: centre of mass of the panel from the universal joint, panel axes (3,).

    Raises:
        ModelError: a wrong shape, a number that is not finite, or r, a, b, L not positive.
    """

    axis: Float[Array, "2"] = eqx.field(converter=as_floats)
    hinge: Float[Array, ""] = eqx.field(converter=as_floats)
    post: Float[Array, ""] = eqx.field(converter=as_floats)
    arms: Float[Array, "2"] = eqx.field(converter=as_floats)
    panel_arms: Float[Array, "2"] = eqx.field(converter=as_floats)
    panel_depths: Float[Array, "2"] = eqx.field(converter=as_floats)
    rods: Float[Array, "2"] = eqx.field(converter=as_floats)
    slider_out: Float[Array, "2"] = eqx.field(converter=as_floats)
    slider_up: Float[Array, "2"] = eqx.field(converter=as_floats)
    post_com: Float[Array, "3"] = eqx.field(converter=as_floats)
    rod_com: Float[Array, "2"] = eqx.field(converter=as_floats)
    panel_com: Float[Array, "3"] = eqx.field(converter=as_floats)

    def __check_init__(self) -> None:
        for name, shape in _SHAPES.items():
            value, quantity = getattr(self, name), f"geometry.{name} of the tracker"
            check_shape(value, shape, quantity)
            check_finite(value, quantity, "m")
            if name in _POSITIVE and has_values(value) and not np.all(np.asarray(value) > 0):
                lengths_mm = (1e3 * np.asarray(value)).round(9).tolist()
                raise ModelError(f"{quantity} must be positive, but it is {lengths_mm} mm.")


def tracker_geometry(parameters: Parameters) -> TrackerGeometry:
    """Lengths of the tracker from a table's "geometry." lines.

    Raises:
        ModelError: numbers that `TrackerGeometry` refuses.
    """
    return TrackerGeometry(**{name: parameters.value(f"geometry.{name}") for name in _SHAPES})


def initial_angles(parameters: Parameters) -> Float[Array, "2"]:
    """Panel angles (phi, theta) of a table's initial posture (2,) [rad].

    Raises:
        ModelError: an angle that is not finite.
    """
    angles = as_floats([parameters.value(f"posture.{k}") for k in ("phi", "theta")])
    check_finite(angles, "posture.phi and posture.theta of the tracker", "rad")
    return angles


class Turn(NamedTuple):
    """Sines and cosines of the panel's angles phi and theta, all of one shape (...)."""

    sin_phi: Float[Array, "*s"]
    cos_phi: Float[Array, "*s"]
    sin_theta: Float[Array, "*s"]
    cos_theta: Float[Array, "*s"]


def turn_by_angles(angles: Float[Array, "2 *s"]) -> Turn:
    """Sines and cosines of the panel angles (phi, theta) [rad]."""
    phi, theta = angles[0], angles[1]
    return Turn(jnp.sin(phi), jnp.cos(phi), jnp.sin(theta), jnp.cos(theta))


class Loops(NamedTuple):
    """Positions of the joints from the hinge, and quantities of the loop closure, all (...).

    Attributes:
        lever: w = h_2 cos theta - b_2 sin theta, depth of C_2 below O3 in the plane turned by
            phi [m].
        lean: r sin gamma [m].
        post_square: (r cos gamma)^2 [m^2], negative where the post is too short to lean that far.
        rise: r cos gamma, height of O3 over the hinge [m].
        balls: positions of C_2 and C_3 as (x, y, z) [m].
        offsets: horizontal offsets (x, y) of C_i from the line of B_i [m].
        squares: squared heights of C_i over B_i [m^2], negative where a rod is too short.
    """

    lever: Float[Array, "*s"]
    lean: Float[Array, "*s"]
    post_square: Float[Array, "*s"]
    rise: Float[Array, "*s"]
    balls: tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]
    offsets: tuple[tuple[Array, Array], tuple[Array, Array]]
    squares: tuple[Array, Array]


def safe_root(square: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root where it is real, else NaN with zero derivatives.

    A sum that leaves out the NaN elements therefore keeps its derivatives.
    """
    return jnp.where(square > 0, safe_sqrt(square), jnp.nan)


def close_loops(geometry: TrackerGeometry, turn: Turn) -> Loops:
    """Positions of the joints for a panel orientation, in closed form and elementwise.

    Source: report Part II, Eq. 3.2 to 3.9 and 3.20 (last line), corrected.
    """
    sp, cp, st, ct = turn
    (b2, b3), (h2, h3), (a2, a3) = geometry.panel_arms, geometry.panel_depths, geometry.arms
    # Leg 2 has a revolute joint and stays in the plane y = 0, which fixes the post's lean: the loops are
    # closed one after the other instead of together.
    lever = h2 * ct - b2 * st
    lean = sp * lever
    post_square = geometry.post**2 - lean**2
    rise = safe_root(post_square)
    x2, z2 = -(b2 * ct + h2 * st), rise - cp * lever
    x3, y3, z3 = -h3 * st, b3 * cp + h3 * ct * sp - lean, rise + b3 * sp - h3 * ct * cp
    none = jnp.zeros_like(x2)
    offsets = (x2 + a2, none), (x3, y3 - a3)
    # Squared heights are kept apart from their roots: they stay smooth, and tell by how much a rod is too
    # short where the root is imaginary.
    squares = (
        geometry.rods[0] ** 2 - offsets[0][0] ** 2,
        geometry.rods[1] ** 2 - (offsets[1][0] ** 2 + offsets[1][1] ** 2),
    )
    balls = (x2, none, z2), (x3, y3, z3)
    return Loops(lever, lean, post_square, rise, balls, offsets, squares)


@kept_jit
def _loops_at(geometry: TrackerGeometry, angles: Float[Array, "2"]) -> Loops:
    return close_loops(geometry, turn_by_angles(angles))


def check_closure(geometry: TrackerGeometry, angles: Float[Array, "2"]) -> None:
    """Raise `ModelError` unless post and rods reach at one posture.

    The message says which triangle fails, with its lengths and the valid ones. Nothing is
    checked inside a transformation.

    Args:
        angles: panel angles (phi, theta) (2,) [rad].
    """
    if not has_values(geometry, angles):
        return
    loops = _loops_at(geometry, angles)
    phi, theta = np.degrees(np.asarray(angles))
    posture = f"at phi = {phi:.4g}, theta = {theta:.4g} degrees"
    lean = abs(float(loops.lean))
    if float(loops.post_square) <= 0:
        b, h = np.asarray(geometry.panel_arms)[0], np.asarray(geometry.panel_depths)[0]
        raise ModelError(
            f"The tracker cannot be assembled {posture}: leg 2 (panel arm {_as_mm(b)}, depth {_as_mm(h)}) "
            f"needs the post to lean {_as_mm(lean)} sideways, but the post is only "
            f"{_as_mm(geometry.post)} long. Make geometry.post longer than {_as_mm(lean)}, or phi smaller."
        )
    for k, leg in enumerate(LEGS):
        if float(loops.squares[k]) <= 0:
            raise ModelError(
                f"Leg {leg} cannot be assembled {posture}: {_describe_span(geometry, loops, k)}"
            )


def _as_mm(length: object) -> str:
    return f"{1e3 * float(np.asarray(length)):.6g} mm"


def _describe_span(geometry: TrackerGeometry, loops: Loops, k: int) -> str:
    """Text with the horizontal distance that a rod has to span, and the lengths that would do."""
    rod, arm, b, h = (
        float(np.asarray(pair)[k])
        for pair in (geometry.rods, geometry.arms, geometry.panel_arms, geometry.panel_depths)
    )
    x, y = (float(part) for part in loops.offsets[k])
    # distances from the post's axis: outward along the arm, and across it
    arm_reach, lateral_offset = (arm - x, 0.0) if k == 0 else (arm + y, x)
    needed_length = float(np.hypot(x, y))
    text = (
        f"its rod is {_as_mm(rod)} long, but it must span {_as_mm(needed_length)} sideways, from its lower joint "
        f"(arm {_as_mm(arm)}) to its ball joint (panel arm {_as_mm(b)}, depth {_as_mm(h)}). Make its "
        f"geometry.rods longer than {_as_mm(needed_length)}"
    )
    if rod <= abs(lateral_offset):
        return text + "."
    room = np.sqrt(rod**2 - lateral_offset**2)
    return f"{text}, or its geometry.arms between {_as_mm(max(arm_reach - room, 0.0))} and {_as_mm(arm_reach + room)}."
