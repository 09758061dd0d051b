"""The heading of a level or tilted UAV at which its panel gets the most energy on a day."""

import math
from collections.abc import Callable
from datetime import date, tzinfo
from typing import Any

from ..vehicle.ephemeris import Place
from .day import track_day

# Headings tried [degrees]: a third of the coarse spacing round the best of them.
_COARSE, _FINE = 45, 15
# Between samples [s]: enough to tell headings apart, not for the day's figures.
_STEP = 1800.0


def best_heading(
    place: Place, day: date, zone: tzinfo, turn: Callable[[float], Any], **settings: Any
) -> float:
    """Yaw [rad], a multiple of 15 degrees, at which `track_day` collects most.

    Args:
        turn: R_wb (3, 3) of a yaw [rad]. settings: of `track_day`, such as parameters.

    Raises:
        StateError, SettingError, ModelError: see `track_day`.
    """

    def energy(degrees: int) -> float:
        R_wb = turn(math.radians(degrees))
        return track_day(place, day, zone, R_wb, step=_STEP, **settings).energy["tracker"]

    found = {degrees: energy(degrees) for degrees in range(-180 + _COARSE, 181, _COARSE)}
    first = max(found, key=lambda degrees: found[degrees])
    found |= {degrees: energy(degrees) for degrees in (first - _FINE, first + _FINE)}
    return math.radians(max(found, key=lambda degrees: found[degrees]))
