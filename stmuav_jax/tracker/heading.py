"""Heading of a level or tilted UAV at which its panel receives the most energy on a day."""

import math
from collections.abc import Callable
from datetime import date, tzinfo
from typing import Any

from ..environment.ephemeris import Place
from ..parameters.airframe import PART_II
from ..parameters.table import Parameters
from .day import track_day
from .geometry import tracker_geometry
from .reach import reachable_grid
from .workspace import tracker_limits

# Spacings of the headings tried [degrees]: coarse ones, then fine ones beside the best of them.
_COARSE, _FINE = 45, 15
# Time between samples [s]: short enough to rank headings, but not for the day's figures.
_STEP = 1800.0


def best_heading(
    place: Place,
    day: date,
    zone: tzinfo,
    turn: Callable[[float], Any],
    *,
    parameters: Parameters = PART_II,
    **settings: Any,
) -> float:
    """Yaw [rad], a multiple of 15 degrees, at which `track_day` collects the most energy.

    Args:
        turn: function of a yaw [rad] that returns the attitude R_wb (3, 3).
        parameters: table with the tracker's lengths and strokes.
        settings: other keyword arguments of `track_day`, such as the turbidity.

    Raises:
        StateError, SettingError, ModelError: see `track_day`.
    """

    grid = reachable_grid(tracker_geometry(parameters), tracker_limits(parameters))
    same: dict[str, Any] = {"parameters": parameters, "step": _STEP, "grid": grid, **settings}

    def energy(degrees: int) -> float:
        return track_day(place, day, zone, turn(math.radians(degrees)), **same).energy["tracker"]

    found = {degrees: energy(degrees) for degrees in range(-180 + _COARSE, 181, _COARSE)}
    first = max(found, key=lambda degrees: found[degrees])
    found |= {degrees: energy(degrees) for degrees in (first - _FINE, first + _FINE)}
    return math.radians(max(found, key=lambda degrees: found[degrees]))
