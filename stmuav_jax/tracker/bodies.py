"""Tracker mechanism: bodies 2 to 7 and their eight joints, on ground or on a vehicle.

    T 1-2, T 1-3 (z)   R 1-4 (x)   R 2-6 (y)   U 3-5   U 4-7   S 5-7   S 6-7

All positions follow from a table's lengths ("geometry.") and the panel's initial angles
("posture."), so that a changed length moves every joint and the loops stay closed.

Source: report Part II, section 3.1 (joints); docs/geometry.md (lengths).
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..checks.errors import concrete
from ..checks.numbers import floats
from ..checks.shapes import Numbers
from ..mechanics.body import Body
from ..mechanics.joint import Joint, revolute, spherical, translational, universal
from ..parameters.table import Parameters
from .geometry import TrackerGeometry, check_closure, initial_angles, tracker_geometry
from .placement import TRACKER_BODIES, place


class _Posture(NamedTuple):
    """Poses of the bodies, points and axes of the joints by name, in the world."""

    poses: dict[str, tuple[Any, Any]]
    points: dict[str, Any]
    axes: dict[str, Any]


_POINTS = ("T12", "T13", "R14", "R26", "U35", "U47", "S57", "S67")
_AXES = ("T12", "T13", "R14", "R26", "U35.i", "U35.j", "U47.i", "U47.j")


@kept_jit
def _place_all(
    geometry: TrackerGeometry, angles: Float[Array, "2"], displacement: Float[Array, "3"]
) -> tuple[Array, ...]:
    """Arrays of `_Posture`, compiled as one: each small operation alone would cost a compilation."""
    at = place(geometry, angles)
    points = jnp.stack([at.points[name] for name in _POINTS])
    return (
        at.r + displacement,
        at.p,
        points + displacement,
        jnp.stack([at.axes[name] for name in _AXES]),
    )


def _placed(parameters: Parameters, displacement: Numbers) -> _Posture:
    geometry, angles = tracker_geometry(parameters), initial_angles(parameters)
    arrays = _place_all(geometry, angles, floats(displacement))
    if concrete(arrays):
        arrays = tuple(np.asarray(array) for array in arrays)
        if not np.all(np.isfinite(arrays[0])):
            check_closure(geometry, angles)
    r, p, points, axes = arrays
    return _Posture(
        {name: (r[k], p[k]) for k, name in enumerate(TRACKER_BODIES)},
        {name: points[k] for k, name in enumerate(_POINTS)},
        {name: axes[k] for k, name in enumerate(_AXES)},
    )


def tracker_bodies(
    parameters: Parameters, displacement: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Body, ...]:
    """Bodies 2 to 7 of the tracker at the initial posture, displaced by `displacement` (3,) [m].

    Raises:
        ModelError: numbers that no body can have, or lengths with which the tracker cannot take
            that posture; the message says which leg, or the post, does not reach.
    """
    placed = _placed(parameters, displacement)
    return tuple(
        Body(
            name,
            parameters.value(f"mass.{name}"),
            parameters.value(f"inertia.{name}"),
            position=placed.poses[name][0],
            orientation=placed.poses[name][1],
            triangle_tolerance=parameters[f"inertia.{name}"].tolerance,
        )
        for name in TRACKER_BODIES
    )


def tracker_joints(
    parameters: Parameters, base: str, displacement: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Joint, ...]:
    """Eight joints of the tracker on body `base` ("ground" if fixed), displaced by `displacement` [m].

    Raises:
        ModelError: lengths that cannot be assembled.
    """
    placed = _placed(parameters, displacement)
    points, axes = placed.points, placed.axes

    def slide(name: str, slider: str) -> Joint:
        return translational(name, base, slider, axis=axes[name], point=points[name])

    def hinge(name: str, i: str, j: str) -> Joint:
        return revolute(name, i, j, point=points[name], axis=axes[name])

    def cross(name: str, i: str, j: str) -> Joint:
        axis_i, axis_j = axes[f"{name}.i"], axes[f"{name}.j"]
        return universal(name, i, j, point=points[name], axis_i=axis_i, axis_j=axis_j)

    return (
        slide("T12", "slider_2"),
        slide("T13", "slider_3"),
        hinge("R14", base, "post_4"),
        hinge("R26", "slider_2", "rod_6"),
        cross("U35", "slider_3", "rod_5"),
        cross("U47", "post_4", "panel_7"),
        spherical("S57", "rod_5", "panel_7", point=points["S57"]),
        spherical("S67", "rod_6", "panel_7", point=points["S67"]),
    )
