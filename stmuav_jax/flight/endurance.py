"""Endurance of the UAV in hover, with its tracker and without, over a day in the sun.

Power from the battery, at a mass m and with panel power p(t) from the day's light:

    P(t) = hover_power(m) / efficiency + other - p(t)

The actuators' work is left out, which favours the tracker.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..algebra.compiler import outer_jit
from ..checks.errors import ModelError, SettingError, concrete, nearest_names
from ..checks.numbers import floats
from ..checks.shapes import Numbers
from ..parameters.airframe import PART_II
from ..parameters.energy import ENERGY
from ..parameters.table import Parameters
from ..rotorcraft.battery import Battery, discharge
from ..rotorcraft.power import hover_power
from ..tracker.cells import SolarCells
from ..tracker.day import PANELS, Day


class Outfit(NamedTuple):
    """Equipment of the UAV: its mass [kg], and which of a day's panels gives power, None for none."""

    mass: Numbers
    panel: str | None


class HoverEndurance(NamedTuple):
    """Endurance in hover of one outfit, for flights that begin at n times of a day.

    Attributes:
        hours: beginnings since local midnight (n,) [h].
        endurance: times until the battery is empty (n,) [s].
        panel_power: power of the panel at the beginning (n,) [W].
        demand: power of rotors and electronics [W].
        reason: codes of `BatteryReason` (n,).
    """

    hours: Float[Array, " n"]
    endurance: Float[Array, " n"]
    panel_power: Float[Array, " n"]
    demand: Float[Array, ""]
    reason: Int[Array, " n"]


def uav_outfits(parameters: Parameters = PART_II) -> dict[str, Outfit]:
    """Outfits of the report's UAV: with tracker, that in the dark, with a fixed panel, and bare.

    A fixed panel has the mass of the panel alone and lies on the bare hexacopter; in the dark the
    tracker is carried and gives nothing.
    """
    value = parameters.value
    panel, bare = value("mass.panel_7"), value("bare.mass")
    tracker = uav_mass(parameters)
    return {
        "tracker": Outfit(tracker, "tracker"),
        "tracker in the dark": Outfit(tracker, None),
        "fixed panel": Outfit(bare + panel, "airframe"),
        "bare": Outfit(bare, None),
    }


def uav_mass(parameters: Parameters = PART_II) -> Float[Array, ""]:
    """Total mass of the report's UAV with its tracker [kg]."""
    parts = ["hexacopter_1", "slider_2", "slider_3", "post_4", "rod_5", "rod_6", "panel_7"]
    return floats(sum(parameters.value(f"mass.{part}") for part in parts))


def hover_demand(
    mass: Numbers, parameters: Parameters = PART_II, energy: Parameters = ENERGY
) -> Float[Array, "*s"]:
    """Electrical power of the UAV in hover at masses (...) [kg], in W (...).

    Args:
        mass: total masses.
        parameters: table with the rotors' coefficients and gravity.
        energy: table with the motors' efficiency and the power of everything else.

    Raises:
        ModelError: an efficiency that is not positive.
    """
    efficiency = energy.value("rotor.efficiency")
    if concrete(efficiency) and not 0.0 < float(efficiency) <= 1.0:
        raise ModelError(
            f"The efficiency of the motors must lie above 0 and up to 1, but it is {efficiency}."
        )
    mechanical = hover_power(
        mass,
        gravity=parameters.value("gravity"),
        k_f=parameters.value("rotor.k_f"),
        k_tau=parameters.value("rotor.k_tau"),
        count=len(parameters.value("rotor.arms")),
    )
    return mechanical / efficiency + energy.value("other.power")


def day_endurance(
    day: Day,
    outfit: Outfit,
    hours: Numbers,
    *,
    battery: Battery | None = None,
    cells: SolarCells | None = None,
    parameters: Parameters = PART_II,
    energy: Parameters = ENERGY,
    longest: float = 86400.0,
) -> HoverEndurance:
    """Endurance in hover for flights that begin at some hours of a day, with a full battery.

    The light changes during the flight, along straight lines between the day's times; after the
    last of them it stays.

    Args:
        day: day of pointing at the sun, from `track_day`.
        outfit: equipment, such as one of `uav_outfits`.
        hours: beginnings since local midnight (n,) [h].
        battery, cells: by default those of the table `energy`.
        parameters: table with the rotors' coefficients and gravity.
        energy: table with everything else.
        longest: time after which a flight ends in any case [s].

    Raises:
        SettingError: a panel that the day does not have, or hours outside the day.
    """
    if outfit.panel is not None and outfit.panel not in day.irradiance:
        raise SettingError(f"The day has no panel '{outfit.panel}'.{nearest_names(outfit.panel, PANELS)}")  # fmt: skip
    starts = np.asarray(hours, dtype=float)
    if starts.ndim != 1 or np.any(starts < 0) or np.any(starts > day.hours[-1]):
        raise SettingError(
            f"The hours must be a list of times from 0 to {day.hours[-1]:g} h since midnight, but "
            f"they are {starts.tolist()}."
        )
    battery = Battery.of(energy) if battery is None else battery
    cells = SolarCells.of(energy) if cells is None else cells
    light = np.zeros_like(day.unix) if outfit.panel is None else day.irradiance[outfit.panel]
    demand = hover_demand(outfit.mass, parameters, energy)
    end, reason, first = _endurances(
        battery, demand, cells.power(light), 3600.0 * day.hours, 3600.0 * starts, floats(longest)
    )
    return HoverEndurance(floats(starts), end, first, demand, reason)


@outer_jit
def _endurances(
    battery: Battery, demand: Array, panel: Array, seconds: Array, starts: Array, longest: Array
) -> tuple[Array, Array, Array]:
    def one(start: Array) -> tuple[Array, Array, Array]:
        given = lambda t: jnp.interp(start + t, seconds, panel)
        span = jnp.stack([jnp.zeros_like(longest), longest])
        found = discharge(battery, lambda t: demand - given(t), span)
        return found.end, found.reason, given(0.0)

    return jax.vmap(one)(starts)
