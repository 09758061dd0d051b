"""Outcome of a mission's flight: its data set, largest errors, margins, energy, and the verdict."""

import json
import math
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..files.labelled import Labelled
from ..files.loop_file import Label, labelled_loop
from .flight import MissionFlight
from .gauges import GAUGES
from .schema import TolerancesEntry

if TYPE_CHECKING:
    import xarray as xr

_BATTERY: dict[str, Label] = {
    "state_of_charge": (("time",), "1", "of the battery"),
    "battery_current": (("time",), "A", "current of the battery"),
    "battery_voltage": (("time",), "V", "at the poles of the battery"),
}
# Round-off of speeds that are held at a limit, as a share of the range.
AT_LIMIT = 1e-9
_DEGREE = math.pi / 180
# Time in flight before a touchdown [s]; what follows sooner is a rebound.
_ALOFT = 0.1
# Round-off of times [s].
AT_ONCE = 1e-9


def to_data(flight: MissionFlight) -> "xr.Dataset":
    """Labelled dataset of a flight: the loop's run, the signals of `GAUGES`, and the limits."""
    return labelled_flight(flight).dataset()


def labelled_flight(flight: MissionFlight) -> Labelled:
    """Labelled arrays with the content of `to_data`."""
    machine, given = flight.mission.machine, flight.mission.file
    count = machine.rotors.spin.shape[0]
    loop = labelled_loop(
        flight.run, GAUGES | _BATTERY, title=given.title, ending=flight.ending,
        mission=json.loads(given.model_dump_json()), scene=machine.scene.name,
        watch=list(machine.scene.watch),
    )  # fmt: skip
    limits: dict[str, tuple[str, Any, str]] = {}
    names: dict[str, Any] = {"rotor": (("rotor",), np.arange(1, count + 1), {})}
    if machine.speeds is not None:
        low, high = (np.sqrt(np.asarray(x)) for x in machine.speeds.squared(count))
        limits |= {
            "lowest_speed": ("rotor", low, "rad/s"),
            "highest_speed": ("rotor", high, "rad/s"),
        }
    if machine.limits is not None:
        limits |= {
            "lowest_displacement": ("slider", np.asarray(machine.limits.lower), "m"),
            "highest_displacement": ("slider", np.asarray(machine.limits.upper), "m"),
        }
        if machine.force is not None:
            most = np.full(2, machine.force)
            limits |= {
                "lowest_force": ("slider", -most, "N"),
                "highest_force": ("slider", most, "N"),
            }
        names["slider"] = (("slider",), np.array([2, 3]), {})
        names["panel_angle"] = (("panel_angle",), ["phi", "theta"], {})
    own = {
        name: ((dim,), values, {"units": unit, "description": f"limit of {dim}s"})
        for name, (dim, values, unit) in limits.items()
    }
    return Labelled({**loop.variables, **own}, {**loop.coordinates, **names}, loop.attributes)


class Measure(NamedTuple):
    """Number in the table of a flight: name, value, unit, allowed value or None, and whether kept."""

    name: str
    value: float
    unit: str
    allowed: float | None = None
    kept: bool = True


def measures(data: "xr.Dataset") -> list[Measure]:
    """Largest errors, smallest margins of the limits, and the energy used, of a flight's dataset."""
    wanted, times = _tolerances(data), _times(data)
    off = np.linalg.norm(data.position_error.values, axis=1)
    tilt = data.tilt_error.values / _DEGREE
    found = [
        _largest(data, "position", off, "m", wanted.position, times[0]),
        _largest(data, "tilt", tilt, "degrees", wanted.tilt, times[0]),
    ]
    if "panel_error" in data:
        panel = data.panel_error.values / _DEGREE
        found.append(_largest(data, "panel", panel, "degrees", wanted.panel, times[-1]))
    for name, what, limit in (
        ("rotor_speed", "rotor speeds", "speed"), ("displacement", "strokes", "displacement"),
        ("wanted_force", "actuators' forces", "force"),
    ):  # fmt: skip
        if f"lowest_{limit}" in data:
            found.append(_margin(data, name, what, limit))
    gear = _of_gear(data, wanted) if "gear_load" in data else []
    return [*found, *gear, *_energy(data)]


def _tolerances(data: "xr.Dataset") -> TolerancesEntry:
    return TolerancesEntry(**json.loads(data.attrs["mission"])["tolerances"])


def _times(data: "xr.Dataset") -> tuple[float, float]:
    """Times from which the tolerances of the base and that of the panel hold [s]."""
    wanted = _tolerances(data)
    return wanted.after, wanted.after if wanted.panel_after is None else wanted.panel_after


def _reached(data: "xr.Dataset", after: float) -> bool:
    """True if the flight came to the time from which a tolerance holds."""
    return bool(data.time.values[-1] >= after - AT_ONCE)


def _largest(
    data: "xr.Dataset",
    of: str,
    values: np.ndarray,
    unit: str,
    allowed: float | None,
    after: float,
) -> Measure:
    """Largest error from the time on from which its tolerance holds.

    Where nothing is as late, it is that of the whole flight, and nothing is asked of it. With a landing
    gear it is that of the samples at which the ground carries nothing; there may be none.
    """
    if not _reached(data, after):
        after, allowed = 0.0, None
    since = f" from {after:g} s on" if after else ""
    late = data.time.values >= after - AT_ONCE
    if "gear_load" in data:
        late, since = late & (data.gear_load.values == 0.0), f"{since} in flight"
    value = float(np.max(values[late], initial=0.0))
    kept = allowed is None or value <= allowed
    return Measure(f"Largest {of} error{since}", value, unit, allowed, kept)


def _of_gear(data: "xr.Dataset", wanted: TolerancesEntry) -> list[Measure]:
    """Speed of the touchdowns, which follow some time in flight, and how deep the feet sank."""
    ts, aloft = data.time.values, data.gear_load.values == 0.0
    period = float(ts[1] - ts[0]) if len(ts) > 1 else 1.0
    window = max(round(_ALOFT / period), 1)
    # samples in flight among the last ones, and the samples at which all of them are
    count = np.cumsum(aloft)
    before = count[window - 1 : -1] - np.concatenate([[0], count[: -window - 1]])
    down = np.flatnonzero((before == window) & ~aloft[window:]) + window
    found = []
    if len(down):
        fastest = float(np.max(-data.velocity.values[down - 1, 0, 2]))
        kept = wanted.touchdown is None or fastest <= wanted.touchdown
        found.append(Measure("Largest touchdown speed", fastest, "m/s", wanted.touchdown, kept))
    deepest = max(float(np.max(data.gear_depth.values)), 0.0)
    kept = wanted.sink is None or deepest <= wanted.sink
    found.append(Measure("Deepest sink of the landing gear", deepest, "m", wanted.sink, kept))
    carried = float(data.gear_load.values[-1])
    return [*found, Measure("Load of the landing gear at the end", carried, "N")]


def _margin(data: "xr.Dataset", name: str, what: str, limit: str) -> Measure:
    """Smallest distance from the limits as a share of the range."""
    least = float(np.nanmin(margin_history(data, name, limit), initial=0.5))
    name, kept = f"Smallest margin of the {what}", least >= -AT_LIMIT
    return Measure(name, 100 * least, "% of the range", 0.0, kept)


def margin_history(data: "xr.Dataset", name: str, limit: str) -> np.ndarray:
    """Distances of a signal (k, n) from its limits as shares of the ranges, to the nearer limit each.

    They are NaN for rotors that have failed and for the forces of a jammed slider.
    """
    low, high = data[f"lowest_{limit}"].values, data[f"highest_{limit}"].values
    values = np.array(data[name].values)
    # a rotor that has failed is within no limits, and the servo of a jammed slider asks in vain
    kind, first = {"rotor_speed": ("rotor", 1), "wanted_force": ("slider", 2)}.get(name, ("", 0))
    for fault in json.loads(data.attrs["mission"])["faults"] if kind else ():
        if fault[kind] is not None:
            values[data.time.values >= fault["at"], fault[kind] - first] = np.nan
    return np.minimum(values - low, high - values) / (high - low)


def _energy(data: "xr.Dataset") -> list[Measure]:
    """Energies used, the powers held from sample to sample."""
    ts = data.time.values
    spent = lambda name: float(np.sum(np.diff(ts) * data[name].values[:-1])) / 3600
    found = [
        Measure("Energy of the rotors, mechanical", spent("rotor_power"), "Wh"),
        Measure("Energy used, electrical", spent("electric_power"), "Wh"),
    ]
    if "actuator_power" in data:
        found.append(Measure("Work of the actuators", 3600 * spent("actuator_power"), "J"))
    if "state_of_charge" in data:
        left = float(data.state_of_charge.values[-1])
        found.append(Measure("Charge left", 100 * left, "%"))
    return found


def verdict(data: "xr.Dataset") -> tuple[bool, str]:
    """True if a flight did all that its mission asks for, and a sentence about it."""
    end, t1 = float(data.time.values[-1]), json.loads(data.attrs["mission"])["t1"]
    ending = data.attrs["ending"]
    broken = [one.name.lower() for one in measures(data) if not one.kept]
    words = f"It flew to t = {end:g} s of {t1:g} s"
    words += f", and ended there: {ending}" if ending else ""
    if broken:
        return False, f"{words}. Not kept: {', '.join(broken)}."
    base, panel = _times(data)
    if not _reached(data, base):
        return not ending, f"{words}. Limits were kept; tolerances hold from {base:g} s on."
    if "panel_error" in data and not _reached(data, panel):
        words = f"{words}. Tolerances and limits were kept; the panel's holds from {panel:g} s on."
        return not ending, words
    return not ending, f"{words}. All tolerances and limits were kept."
