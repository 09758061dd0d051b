"""Entries of the wind and of the battery, which a model's file and a mission share."""

from typing import Annotated, Any

import jax.numpy as jnp
import numpy as np
from pydantic import Field

from ..checks.errors import SettingError
from ..checks.schema import Entries, NotNegative, Positive, Seed, Triple
from ..checks.shapes import Numbers
from ..mechanics.parameters import Parameters
from ..uav.airframe import PART_II
from ..uav.environment.wind import ChangingWind, Gusts, dryden, low_altitude


class ChangeEntry(Entries):
    """Entry for a change of the wind to another velocity [m/s], over a time [s]."""

    to: Triple
    at: NotNegative
    rise: Positive = 0.2


class GustsEntry(Entries):
    """Entry for Dryden gusts that pass at the steady wind's speed: seed, height [m], wind at 20 feet [m/s]."""

    seed: Seed = 0
    height: Positive | None = None
    speed_20ft: Positive | None = None


class WindEntry(Entries):
    """Entry for the wind: steady velocity, world [m/s], a change of it, gusts about it."""

    steady: Triple = (0.0, 0.0, 0.0)
    change: ChangeEntry | None = None
    gusts: GustsEntry | None = None


class BatteryEntry(Entries):
    """Entry for a battery: capacity [C], resistance [ohm], reserve [1]; what is left out is of `ENERGY`."""

    capacity: Positive | None = None
    resistance: NotNegative | None = None
    reserve: Annotated[float, Field(ge=0, lt=1)] | None = None


def make_wind(
    entry: WindEntry, duration: float, *, table: Parameters = PART_II, seed: Any = None
) -> Numbers | Gusts | ChangingWind:
    """Velocity of the air, world (3,) [m/s], or a function of time that returns it.

    Args:
        duration: time that gusts cover [s]. table: has the height and the wind of gusts that the entry
            leaves out. seed: seed of the gusts in place of the entry's.

    Raises:
        SettingError: gusts without a steady wind. ModelError: numbers that `dryden` refuses.
    """
    steady = jnp.asarray(entry.steady, dtype=float)
    before: Any = steady
    if entry.gusts is not None:
        gusts, speed = entry.gusts, float(np.linalg.norm(entry.steady))
        choose = lambda name, number: table.value(f"gust.{name}") if number is None else number
        height = choose("height", gusts.height)
        speed_20ft = choose("speed_20ft", gusts.speed_20ft)
        if speed == 0.0:
            raise SettingError(
                "Gusts pass at the speed of the steady wind, which must not be zero."
            )
        spectrum, seed = low_altitude(height, speed_20ft), gusts.seed if seed is None else seed
        before = dryden(seed, spectrum, airspeed=speed, duration=duration, mean=steady)
    change = entry.change
    if change is None:
        return before
    added = jnp.asarray(change.to, dtype=float) - steady
    return ChangingWind(before, added, jnp.asarray(change.at), jnp.asarray(change.rise))
