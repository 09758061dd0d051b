"""The tracker: bodies 2 to 7 and their eight joints, on ground or on a vehicle.

    T 1-2, T 1-3 (z)   R 1-4 (x)   R 2-6 (y)   U 3-5   U 4-7   S 5-7   S 6-7

Source: report Part II, section 3.1 (joints); docs/geometry.md (where they are).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..algebra.shapes import Numbers
from ..mechanics.body import Body
from ..mechanics.errors import StateError, concrete
from ..mechanics.joint import Joint, revolute, spherical, translational, universal
from .parameters import Parameters

TRACKER_BODIES = ("slider_2", "slider_3", "post_4", "rod_5", "rod_6", "panel_7")

# Body, and the joints whose points lie along its z axis, lower one first.
_LINKS = (("post_4", "R14", "U47"), ("rod_5", "U35", "S57"), ("rod_6", "R26", "S67"))
_LINK_TOLERANCE = 1e-3  # [rad]


def tracker_bodies(parameters: Parameters, shift: Numbers = (0.0, 0.0, 0.0)) -> tuple[Body, ...]:
    """Bodies 2 to 7 at the initial posture, displaced by `shift` (3,) [m].

    Raises:
        ModelError: numbers that no body can have.
        StateError: Euler parameters that turn a link away from the line of its joints.
    """
    offset = jnp.asarray(shift, dtype=float)
    bodies = tuple(
        Body(
            name,
            parameters.value(f"mass.{name}"),
            parameters.value(f"inertia.{name}"),
            position=jnp.asarray(parameters.value(f"position.{name}"), dtype=float) + offset,
            orientation=parameters.value(f"orientation.{name}"),
            triangle_tolerance=parameters[f"inertia.{name}"].tolerance,
        )
        for name in TRACKER_BODIES
    )
    for body in bodies:
        _check_link(body, parameters)
    return bodies


def _check_link(body: Body, parameters: Parameters) -> None:
    for name, lower, upper in _LINKS:
        if body.name != name:
            continue
        ends = parameters.value(f"point.{lower}"), parameters.value(f"point.{upper}")
        if not concrete(ends, body.orientation):
            return
        along = np.asarray(ends[1], dtype=float) - np.asarray(ends[0], dtype=float)
        axis = np.asarray(rotation_matrix(body.orientation))[:, 2]
        angle = float(np.arctan2(np.linalg.norm(np.cross(axis, along)), axis @ along))
        if angle > _LINK_TOLERANCE:
            raise StateError(
                f"The Euler parameters of '{name}' turn it {np.degrees(angle):.3g} degrees away from "
                f"the line of its joints {lower} and {upper}. The report's Table 6.1 prints e1 of p4 "
                "with the wrong sign and p5, p6, p7 with few digits: keep the table's posture, or "
                "take the nearest one that closes from stmuav_jax.assemble."
            )


def tracker_joints(
    parameters: Parameters, base: str, shift: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Joint, ...]:
    """The eight joints on body `base` ("ground" for a fixed tracker), displaced by `shift` [m]."""
    offset = jnp.asarray(shift, dtype=float)

    def point(name: str) -> Float[Array, "3"]:
        return jnp.asarray(parameters.value(f"point.{name}"), dtype=float) + offset

    def slide(name: str, slider: str) -> Joint:
        at = jnp.asarray(parameters.value(f"position.{slider}"), dtype=float) + offset
        return translational(name, base, slider, axis=parameters.value(f"axis.{name}"), point=at)

    def hinge(name: str, i: str, j: str) -> Joint:
        return revolute(name, i, j, point=point(name), axis=parameters.value(f"axis.{name}"))

    def cross(name: str, i: str, j: str) -> Joint:
        axes = (parameters.value(f"axis_{side}.{name}") for side in "ij")
        axis_i, axis_j = axes
        return universal(name, i, j, point=point(name), axis_i=axis_i, axis_j=axis_j)

    return (
        slide("T12", "slider_2"),
        slide("T13", "slider_3"),
        hinge("R14", base, "post_4"),
        hinge("R26", "slider_2", "rod_6"),
        cross("U35", "slider_3", "rod_5"),
        cross("U47", "post_4", "panel_7"),
        spherical("S57", "rod_5", "panel_7", point=point("S57")),
        spherical("S67", "rod_6", "panel_7", point=point("S67")),
    )
