"""Outcome of a mission's flight: its data set, largest errors, margins, energy, and the verdict."""

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..checks.errors import SettingError
from ..io.netcdf import Labelled
from ..io.run_file import Label, labelled_loop
from ..uav.flight_identification.record import FlightRecord
from .controller import AT_ONCE
from .flight import MissionFlight
from .schema import TolerancesEntry
from .signals import EFFORT_UNIT, GAUGES, JOINT_UNIT

if TYPE_CHECKING:
    import xarray as xr

_BATTERY: dict[str, Label] = {
    "state_of_charge": (("time",), "1", "of the battery"),
    "battery_current": (("time",), "A", "current of the battery"),
    "battery_voltage": (("time",), "V", "at the poles of the battery"),
}
# Signals with limits: name, words for a table, and what the limits are of.
MARGINS = (
    ("rotor_speed", "rotor speeds", "speed"),
    ("displacement", "strokes", "displacement"),
    ("commanded_force", "actuators' forces", "force"),
    ("commanded_effort", "joint efforts", "effort"),
)
# Round-off of speeds that are held at a limit, as a share of the range.
AT_LIMIT = 1e-9
# Errors below this are those of the arithmetic [m, degrees].
ROUND_OFF = 1e-9
_DEGREE = math.pi / 180
# Time in flight before a touchdown [s]; what follows sooner is a rebound.
_ALOFT = 0.1


def to_data(flight: MissionFlight) -> "xr.Dataset":
    """Labelled dataset of a flight: the loop's run, the signals of `GAUGES`, and the limits."""
    return labelled_flight(flight).dataset()


def labelled_flight(flight: MissionFlight) -> Labelled:
    """Labelled arrays with the content of `to_data`."""
    machine, entries = flight.mission.machine, flight.mission.file
    count = machine.rotors.spin.shape[0]
    units = [drive.unit for drive in machine.joints]
    effort_units = [{"rad": "N m", "m": "N"}[unit] for unit in units]
    # One unit of all joints is named where the reader looks first, several in coordinates.
    one_unit = {JOINT_UNIT: units[0], EFFORT_UNIT: effort_units[0]} if len({*units}) == 1 else {}
    labels = {
        name: (dims, one_unit.get(unit, unit), description)
        for name, (dims, unit, description) in (GAUGES | _BATTERY).items()
    }
    loop = labelled_loop(
        flight.run, labels, title=entries.title, ending=flight.ending,
        mission=json.loads(entries.model_dump_json()), scene=machine.scene.name,
        watch=list(machine.scene.watch), growth=flight.mission.growth,
    )  # fmt: skip
    # dimension, lowest and highest values, and unit of what has limits
    limits: dict[str, tuple[str, Any, Any, str]] = {}
    names: dict[str, Any] = {"rotor": np.arange(1, count + 1)}
    speeds = flight.mission.truth.speeds
    if speeds is not None:
        low, high = (np.sqrt(np.asarray(x)) for x in speeds.squared(count))
        limits["speed"] = ("rotor", low, high, "rad/s")
    if machine.limits is not None:
        low, high = np.asarray(machine.limits.lower), np.asarray(machine.limits.upper)
        limits["displacement"] = ("slider", low, high, "m")
        if machine.force is not None:
            most = np.full(2, machine.force)
            limits["force"] = ("slider", -most, most, "N")
        names |= {"slider": np.array([2, 3]), "panel_angle": ["phi", "theta"]}
    if machine.joints:
        names["driven_joint"] = [drive.name for drive in machine.joints]
        names |= {"driven_joint_unit": units, "driven_joint_effort_unit": effort_units}
        efforts = machine.efforts
        if np.any(np.isfinite(efforts)):
            effort_unit = one_unit.get(EFFORT_UNIT, EFFORT_UNIT)
            limits["effort"] = ("driven_joint", -efforts, efforts, effort_unit)
    limit_variables = {
        f"{end}_{name}": ((dim,), values, {"units": unit, "description": f"limit of {dim}s"})
        for name, (dim, low, high, unit) in limits.items()
        for end, values in (("lowest", low), ("highest", high))
    }
    dims = {name: "driven_joint" if "driven_joint" in name else name for name in names}
    coordinates = {name: ((dims[name],), values, {}) for name, values in names.items()}
    return Labelled(
        {**loop.variables, **limit_variables}, {**loop.coordinates, **coordinates}, loop.attributes
    )


def to_flight_record(flight: MissionFlight) -> FlightRecord:
    """Record of a flight as its instruments and commands show it, for `stm.uav.identify_flight`.

    A command u, from 0 to 1, stands for the speed lowest + (highest - lowest) u of a rotor.

    Raises:
        SettingError: the mission has no sensors, or its rotors have no limits.
    """
    rollout, speeds = flight.run.rollout, flight.mission.truth.speeds
    if "gyroscope" not in rollout.signals:
        raise SettingError(
            "A log of a flight needs the mission's [sensors], whose readings it holds."
        )
    if speeds is None:
        raise SettingError(
            "A log of a flight needs limits of the rotor speeds, from which commands count."
        )
    count = flight.mission.machine.rotors.spin.shape[0]
    low, high = (np.sqrt(np.asarray(x)) for x in speeds.squared(count))
    squared = np.clip(np.asarray(rollout.inputs)[:, :count], low**2, high**2)
    signals = {name: np.asarray(value, float) for name, value in rollout.signals.items()}
    return FlightRecord(
        np.asarray(rollout.ts, float), (np.sqrt(squared) - low) / (high - low), signals["gyroscope"],
        signals["accelerometer"], signals.get("battery_voltage"),
    )  # fmt: skip


class Measure(NamedTuple):
    """Number in the table of a flight: name, value, unit, allowed value or None, and whether met."""

    name: str
    value: float
    unit: str
    allowed: float | None = None
    is_met: bool = True

    @classmethod
    def within(cls, name: str, value: float, unit: str, allowed: float | None) -> "Measure":
        """Number that must not exceed an allowed value, if there is one."""
        return cls(name, value, unit, allowed, allowed is None or value <= allowed)

    @property
    def text(self) -> str:
        """Value with its unit for a table; 0 for round-off."""
        is_round_off = self.unit in ("m", "degrees") and abs(self.value) < ROUND_OFF
        return f"{0.0 if is_round_off else self.value:.4g} {self.unit}"


def measures(data: "xr.Dataset") -> list[Measure]:
    """Largest errors, smallest margins of the limits, and the energy used, of a flight's dataset."""
    tolerances = _read_tolerances(data)
    distances = np.linalg.norm(data.position_error.values, axis=1)
    tilt = data.tilt_error.values / _DEGREE
    result = [
        _largest_error(data, "position", distances, "m", tolerances.position, tolerances.after),
        _largest_error(data, "tilt", tilt, "degrees", tolerances.tilt, tolerances.after),
    ]
    if "panel_error" in data:
        panel, after = data.panel_error.values / _DEGREE, tolerances.panel_after
        result.append(_largest_error(data, "panel", panel, "degrees", tolerances.panel, after))
    if "joint_error" in data:
        for joint in data.driven_joint.values:
            error = np.abs(data.joint_error.sel(driven_joint=joint))
            is_angle = str(error.driven_joint_unit.values) == "rad"
            scale, unit = (_DEGREE, "degrees") if is_angle else (1.0, "m")
            name, most = str(joint), tolerances.joints.get(str(joint))
            error = error.values / scale
            result.append(_largest_error(data, name, error, unit, most, tolerances.after))
    for name, quantity_label, limit in MARGINS:
        if f"lowest_{limit}" in data:
            # smallest distance from the limits as a share of the range
            least = float(np.nanmin(margin_history(data, name, limit), initial=0.5))
            name = f"Smallest margin of the {quantity_label}"
            result.append(Measure(name, 100 * least, "% of the range", 0.0, least >= -AT_LIMIT))
    if "gear_load" in data:
        result += _of_gear(data, tolerances)
    # energies used, the powers held from sample to sample
    durations = np.diff(data.time.values)
    spent = lambda name: float(np.sum(durations * data[name].values[:-1])) / 3600
    for quantity_label, name, factor, unit in _ENERGIES:
        if name in data:
            result.append(Measure(quantity_label, factor * spent(name), unit))
    if "state_of_charge" in data:
        result.append(Measure("Charge left", 100 * float(data.state_of_charge.values[-1]), "%"))
    return result


_ENERGIES = (
    ("Energy of the rotors, mechanical", "rotor_power", 1, "Wh"),
    ("Energy used, electrical", "electric_power", 1, "Wh"),
    ("Work of the actuators", "actuator_power", 3600, "J"),
    ("Work of the joints", "joint_power", 3600, "J"),
)


def _read_tolerances(data: "xr.Dataset") -> TolerancesEntry:
    """Tolerances of a flight's mission, with the time from which the panel's holds."""
    entries = json.loads(data.attrs["mission"])["tolerances"]
    if entries.get("panel_after") is None:
        entries["panel_after"] = entries.get("after", 0.0)
    return TolerancesEntry(**entries)


def _has_reached(data: "xr.Dataset", after: float | None) -> bool:
    """True if the flight came to the time from which a tolerance holds."""
    return bool(data.time.values[-1] >= (after or 0.0) - AT_ONCE)


def _largest_error(
    data: "xr.Dataset",
    of: str,
    values: np.ndarray,
    unit: str,
    allowed: float | None,
    after: float | None,
) -> Measure:
    """Largest error from the time on from which its tolerance holds.

    Where nothing is as late, it is that of the whole flight, and nothing is asked of it. With a landing
    gear it is that of the samples at which the ground carries nothing; there may be none.
    """
    if not _has_reached(data, after):
        after, allowed = 0.0, None
    since = f" from {after:g} s on" if after else ""
    late = data.time.values >= (after or 0.0) - AT_ONCE
    if "gear_load" in data:
        late, since = late & (data.gear_load.values == 0.0), f"{since} in flight"
    value = float(np.max(values[late], initial=0.0))
    return Measure.within(f"Largest {of} error{since}", value, unit, allowed)


def _of_gear(data: "xr.Dataset", tolerances: TolerancesEntry) -> list[Measure]:
    """Speed of the touchdowns, which follow some time in flight, and how deep the feet sank."""
    ts, aloft = data.time.values, data.gear_load.values == 0.0
    period = float(ts[1] - ts[0]) if len(ts) > 1 else 1.0
    window = max(round(_ALOFT / period), 1)
    # samples in flight among the last ones, and the samples at which all of them are
    count = np.cumsum(aloft)
    before = count[window - 1 : -1] - np.concatenate([[0], count[: -window - 1]])
    down = np.flatnonzero((before == window) & ~aloft[window:]) + window
    result = []
    if len(down):
        fastest = float(np.max(-data.velocity.values[down - 1, 0, 2]))
        name = "Largest touchdown speed"
        result.append(Measure.within(name, fastest, "m/s", tolerances.touchdown))
    deepest = max(float(np.max(data.gear_depth.values)), 0.0)
    carried = float(data.gear_load.values[-1])
    return [
        *result,
        Measure.within("Deepest sink of the landing gear", deepest, "m", tolerances.sink),
        Measure("Load of the landing gear at the end", carried, "N"),
    ]


def margin_history(data: "xr.Dataset", name: str, limit: str) -> np.ndarray:
    """Distances of a signal (k, n) from its limits as shares of the ranges, to the nearer limit each.

    They are NaN for rotors that have failed and for the forces of a jammed slider.
    """
    low, high = data[f"lowest_{limit}"].values, data[f"highest_{limit}"].values
    values = np.array(data[name].values)
    # a rotor that has failed is within no limits, and the servo of a jammed slider asks in vain
    kind, first = {"rotor_speed": ("rotor", 1), "commanded_force": ("slider", 2)}.get(name, ("", 0))
    for fault in json.loads(data.attrs["mission"])["faults"] if kind else ():
        if fault[kind] is not None:
            values[data.time.values >= fault["at"], fault[kind] - first] = np.nan
    with np.errstate(invalid="ignore"):
        # NaN where there is no limit
        return np.minimum(values - low, high - values) / (high - low)


def list_unreached(mission: Mapping[str, Any], end: float) -> list[str]:
    """Entries of a mission, plain data, that a flight until a time [s] does not come to."""
    # Name, time, and whether the last sample reaches it: a fault there needs some time to show.
    entries: list[tuple[str, Any, bool]] = [
        (f"waypoint {k}", point["t"], True)
        for k, point in enumerate((mission.get("path") or {}).get("waypoints") or (), 1)
    ]
    moves = [(f"move {k} of the panel", x) for k, x in enumerate(mission.get("panel") or (), 1)]
    moves += [(f"a move of joint {move['joint']}", move) for move in mission.get("joints") or ()]
    entries += [(f"the end of {name}", x["at"] + x["duration"], True) for name, x in moves]
    for fault in mission.get("faults") or ():
        kind = next(kind for kind in ("rotor", "slider", "sensor") if fault.get(kind) is not None)
        name = f"the fault of {kind} {fault[kind]}"
        entries.append((name, fault["at"], False))
        entries.append((f"the end of {name}", fault.get("until"), True))
    for payload in mission.get("payloads") or ():
        name = f"of the payload of {payload['body']}"
        entries.append((f"the pick-up {name}", payload["at"] or None, False))
        entries.append((f"the drop {name}", payload["until"], False))
    change = (mission.get("wind") or {}).get("change")
    if change is not None:
        entries.append(("the end of the wind's change", change["at"] + change["rise"], True))
    return [
        f"{name} at t = {t:g} s"
        for name, t, counts in entries
        if t is not None and (t > end + AT_ONCE if counts else t >= end - AT_ONCE)
    ]


def verdict(data: "xr.Dataset") -> tuple[bool, str]:
    """True if a flight completed its mission and met all limits, and a sentence about it.

    A flight that ends before a waypoint, a move of the panel, a fault or a change of the wind fails.
    """
    mission, tolerances = json.loads(data.attrs["mission"]), _read_tolerances(data)
    end, ending = float(data.time.values[-1]), data.attrs["ending"]
    broken = [measure.name.lower() for measure in measures(data) if not measure.is_met]
    sentence = f"It flew to t = {end:g} s of {mission['t1']:g} s"
    sentence += f", and ended there: {ending}" if ending else ""
    unreached = list_unreached(mission, end)
    sentence += f". It ended before {', '.join(unreached)}" if unreached else ""
    is_complete, growth = not ending and not unreached, float(data.attrs.get("growth", 0.0))
    if growth > 1.0:
        sentence += f". Its closed loop is unstable: small motions about hover grow {growth:.3g}-fold in a second"
    if any(fault.get("known") for fault in mission["faults"]):
        sentence += ". With lost rotors its closed loop was checked as if the machine did not turn"
    if broken:
        return False, f"{sentence}. Not met: {', '.join(broken)}."
    if not tolerances.model_dump(exclude={"after", "panel_after"}, exclude_defaults=True):
        judged = "Limits were met; the mission has no tolerances."
    elif not _has_reached(data, tolerances.after):
        judged = f"Limits were met; tolerances hold from {tolerances.after:g} s on."
    elif "panel_error" in data and not _has_reached(data, tolerances.panel_after):
        after = tolerances.panel_after
        judged = f"Tolerances and limits were met; the panel's holds from {after:g} s on."
    elif not is_complete:
        judged = "Until then, tolerances and limits were met."
    else:
        judged = "All tolerances and limits were met."
    return is_complete, f"{sentence}. {judged}"
