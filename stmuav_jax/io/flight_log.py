"""Flight logs of multirotors as one `FlightLog`: SI units, forward-left-up body axes, a z-up world.

The formats are PX4 ULog, ArduPilot .BIN, the micro-SD log of Crazyflie, and CSV with a map of columns.
Vectors in forward-right-down axes or in a north-east-down world turn about x by half a turn, so their
world is north-west-up. Nothing is repaired without a sentence: `FlightLog.notes` has all of them, and
`FlightLog.refusals` those that no identification of a multirotor can pass over.
"""

import dataclasses
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.constants import g as STANDARD_GRAVITY
from scipy.spatial.transform import Rotation

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import format_value, quote_name
from ..uav.flight_identification.record import (
    SHORTEST_RECORD,
    FlightRecord,
    RotorLayout,
    make_layout,
)
from .csv_table import write_csv_table
from .log_consistency import find_contradictions, interpolate
from .log_formats import (
    DECODERS,
    FOREIGN_FORMATS,
    QUANTITIES,
    UNITS,
    XYZ,
    LogDraft,
    LogSetting,
    LogSource,
    LogTopic,
    decode_csv,
)
from .netcdf import FileError, read_toml, regular_file

# Shortest flight, and longest stop of the motors within one [s].
_SHORTEST, _STOP = 1.0, 1.0
# Share of the usual command above which a multirotor counts as in flight, and commands that are none.
_IN_FLIGHT, _OFF = 0.3, 0.02
# Specific force of an impact [m/s^2], time before the end in which it counts, and cut before it [s].
_IMPACT, _LAST, _BEFORE_IMPACT = 5 * STANDARD_GRAVITY, 3.0, 0.5
# Specific force at rest that counts as gravity, and in flight where there is no rest [m/s^2].
_GRAVITY, _IN_AIR = (9.5, 10.1), (7.0, 14.0)
# Share of the mean specific force in flight along z, from which the accelerometer is upright.
_UPRIGHT = 0.8
# Largest turning rate that gyroscopes of multirotors measure [rad/s].
_FASTEST = 40.0
# Lowest rate of commands that resolves the lag of motors [Hz].
_SLOWEST_COMMANDS = 50.0
# Range of commands from which their ends may be limits.
_MOVES = 0.1
# Share of samples at a limit, or without an order in time, that is said or refused.
_SAID, _REFUSED = 0.01, 0.1
# Highest rate of a record for identification [Hz], longest gap that is bridged, and margins at its ends [s].
_RECORD_RATE, _BRIDGED, _TAKE_OFF, _LANDING = 500.0, 0.05, 1.0, 0.5
# Largest number of steps of a grid.
_MOST_STEPS = 4e6
# Share of rows with the commands of the row before from which they were sampled, not stamped when they changed.
_REPEATED = 0.2
# Resolution of the stamps [s]: a grid this close to a sample is on it.
_TICK = 1e-6


class Gap(NamedTuple):
    """Stretch from one sample to the next [s] that is too long for the channel's rate."""

    channel: str
    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Channel:
    """Quantity of a log with its own time stamps.

    Attributes:
        ts: time stamps (k,) [s] from the log's start, increasing.
        values: samples (k, m) in `unit`.
        unit: unit of the values. columns: names of the m components.
        clock: name of the topic; channels of one clock were sampled at the same instants.
        source: topic and fields of the file that the values come from.
        is_held: true if a value holds until the next one, as a command does.
    """

    ts: np.ndarray
    values: np.ndarray
    unit: str
    columns: tuple[str, ...]
    clock: str
    source: str
    is_held: bool = False

    @property
    def rate(self) -> float:
        """Samples per second, by the median of the steps [Hz]."""
        return 1 / float(np.median(np.diff(self.ts))) if len(self.ts) > 1 else 0.0


@dataclass(frozen=True, eq=False)
class FlightLog:
    """Log of a multirotor in SI units, forward-left-up body axes and a z-up world.

    Attributes:
        name: name of the file. format: kind of file. vehicle: description of the vehicle.
        start: the vehicle's clock at the log's start [s]; all times count from there.
        duration: length of the log [s].
        channels: those that the log has of `motor_commands` (0 to 1), `thrust_commands` (before
            compensation of the battery), `rotor_speeds`, `accelerometer` (specific force), `gyroscope`,
            `attitude` (unit quaternion w, x, y, z from body to world), `euler_angles` where they are no
            whole attitude, `position`, `velocity`, `acceleration`, `battery_voltage`, `battery_current`.
        flights: start and end (n, 2) [s] of each flight segment. A crash is cut off.
        gaps: intervals without samples.
        settings: `gyroscope_cutoff` and `accelerometer_cutoff` [Hz] of low-pass filters that the
            channels went through, `filter_rate` [Hz] of the filters' clock, `rotor_positions` (n, 3) [m],
            `rotor_spin` (n,) as in `Rotors`, and `thrust_model_factor` f of thrust f u^2 + (1 - f) u; those
            that are known.
        notes: sentences on data that were cut or are doubtful, and on values assumed for missing settings.
        refusals: sentences, which are among the notes, why no multirotor can be identified.
        is_simulated: true if the file says that a simulator wrote it.
    """

    name: str
    format: str
    vehicle: str
    start: float
    duration: float
    channels: Mapping[str, Channel]
    flights: np.ndarray
    gaps: tuple[Gap, ...]
    settings: Mapping[str, LogSetting]
    notes: tuple[str, ...] = ()
    refusals: tuple[str, ...] = ()
    is_simulated: bool = False

    def __contains__(self, channel: str) -> bool:
        return channel in self.channels

    def __getitem__(self, channel: str) -> Channel:
        if channel not in self.channels:
            raise SettingError(
                f"{self.name} has no {quote_name(channel)}.{nearest_names(str(channel), self.channels)}"
            )
        return self.channels[channel]

    def flight(self, index: int | None = None) -> "FlightLog":
        """Log of one flight segment, by default the longest.

        Raises:
            SettingError: the log has refusals, or no flight of that index.
        """
        if self.refusals:
            raise SettingError(" ".join(self.refusals))
        if index is None and len(self.flights):
            index = int(np.argmax(self.flights[:, 1] - self.flights[:, 0]))
        if index is None or not 0 <= index < len(self.flights):
            raise SettingError(
                f"{self.name} has {len(self.flights)} flight segments, which are numbered from 0, but "
                f"not number {index or 0}."
            )
        return self.window(*map(float, self.flights[index]))

    def window(self, t0: float | int, t1: float | int) -> "FlightLog":
        """Log from t0 to t1 [s]; its times still count from the start of the whole log.

        Raises:
            SettingError: t0 is not before t1, or the log has no sample between them.
        """
        if not t0 < t1:
            raise SettingError(f"A window must end after its start, but it is {t0:g} to {t1:g} s.")
        cut = {}
        for name, channel in self.channels.items():
            inside = (channel.ts >= t0) & (channel.ts <= t1)
            if np.any(inside):
                parts = {"ts": channel.ts[inside], "values": channel.values[inside]}
                cut[name] = dataclasses.replace(channel, **parts)
        if not cut:
            raise SettingError(
                f"The window {t0:g} to {t1:g} s has no samples: {self.name} ends at {self.duration:g} s."
            )
        clipped = np.clip(self.flights, t0, t1)
        gaps = tuple(gap for gap in self.gaps if gap.end > t0 and gap.start < t1)
        return dataclasses.replace(
            self, channels=cut, gaps=gaps, flights=clipped[clipped[:, 1] > clipped[:, 0]]
        )

    def resample(self, rate: float | int) -> "FlightLog":
        """Log with all channels on one grid of times, which begins at a sample of the IMU.

        Channels of one clock keep their simultaneity: they share the interpolation's weights, and a
        sample on the grid is kept exactly. A channel that is at least a tenth faster than the grid is
        averaged over each step, which keeps its phase; slower ones are interpolated, commands held.
        Values in a gap, and before or after a channel's samples, are NaN. Quaternions have unit length,
        and Euler angles continue beyond half a turn.

        Args:
            rate: samples per second of the grid [Hz].

        Raises:
            SettingError: the rate is not positive, or the grid has more than four million steps.
        """
        if not 0 < rate <= 1 / _TICK:
            raise SettingError(f"The rate must be between 0 and 1e6 Hz, but it is {rate:g} Hz.")
        order = ("gyroscope", "accelerometer", "motor_commands", "rotor_speeds", *self.channels)
        ts = self.channels[next(name for name in order if name in self.channels)].ts
        if (ts[-1] - ts[0]) * rate > _MOST_STEPS:
            raise SettingError(
                f"A grid of {rate:g} Hz over {ts[-1] - ts[0]:.3g} s has more than {_MOST_STEPS:g} steps; a lower "
                "rate or a window would be valid."
            )
        grid = ts[0] + np.arange(int((ts[-1] - ts[0]) * rate + 1e-6) + 1) / rate
        channels = {}
        for name, channel in self.channels.items():
            values = channel.values
            if name == "attitude":
                values = _align_signs(values)
            elif name == "euler_angles":
                values = np.unwrap(values, axis=0)
            gaps = [(gap.start, gap.end) for gap in self.gaps if gap.channel == name]
            width = 1 / rate if channel.rate > 1.1 * rate else 0.0
            values = _on_grid(grid, width, channel.ts, values, channel.is_held, gaps)
            if name == "attitude":
                # a missing attitude has no length
                with np.errstate(invalid="ignore"):
                    values = values / np.linalg.norm(values, axis=1, keepdims=True)
            parts = {"ts": grid, "values": values, "clock": "grid"}
            channels[name] = dataclasses.replace(channel, **parts)
        return dataclasses.replace(self, channels=channels)

    def to_record(self, index: int | None = None) -> FlightRecord:
        """Record of one flight segment, by default the longest, for `stm.uav.identify_flight`.

        It leaves out a second after take-off and half a second before landing, has the rate of the IMU
        but at most 500 Hz, and bridges gaps of up to 50 ms; a longer gap splits it, and the longer part is
        returned. If the log has rotor speeds only, commands are fractions of the highest speed in the log.

        Raises:
            SettingError: the log has refusals or no such flight, lacks commands and speeds, gyroscope or
                accelerometer, its commands are slower than the lag of motors, or gaps leave less than 10 s.
        """
        flight = self.flight(index)
        # speeds that were measured take the place of commands, as shares of the highest
        motors = "motor_commands"
        if motors not in flight and "rotor_speeds" in flight:
            motors = "rotor_speeds"
        names = (motors, "gyroscope", "accelerometer")
        for name in names:
            if name not in flight:
                raise SettingError(f"{self.name} has no {name}, which an identification needs.")
        rate = flight[motors].rate
        # A fast logger repeats slow commands. What never changes is said where the record is identified.
        steps = np.diff(flight[motors].values, axis=0)
        changes = rate * np.count_nonzero(np.any(steps, axis=1)) / max(len(steps), 1)
        if rate < _SLOWEST_COMMANDS or 0 < changes < _SLOWEST_COMMANDS:
            is_slow = rate < _SLOWEST_COMMANDS
            fact = f"come at {rate:.3g} Hz" if is_slow else f"change at {changes:.3g} Hz"
            raise SettingError(
                f"{motors} of {self.name} {fact}, which is slower than the lag of motors; {_SLOWEST_COMMANDS:g} Hz or "
                "more would be valid (a high-rate logging profile)."
            )
        relevant = [gap for gap in flight.gaps if gap.channel in names]
        gaps = [(gap.start, gap.end) for gap in relevant if gap.end - gap.start > _BRIDGED]
        t0, t1 = flight.flights[0] + [_TAKE_OFF, -_LANDING]
        # Ends of gaps, in order, are the edges of the segments between them.
        edges = np.array([t0, *np.ravel(sorted(gaps)), t1]).reshape(-1, 2)
        whole_length = t1 - t0
        t0, t1 = edges[np.argmax(edges[:, 1] - edges[:, 0])].tolist()
        if t1 - t0 < SHORTEST_RECORD <= whole_length:
            raise SettingError(
                f"Gaps of more than {_BRIDGED:g} s leave at most {t1 - t0:.3g} s of the flight of {self.name} without "
                f"one; {SHORTEST_RECORD:g} s or more would be valid."
            )
        rates = (flight["gyroscope"].rate, flight["accelerometer"].rate)
        rate = float(round(min(_RECORD_RATE, *rates)))
        part = flight.window(t0, t1)
        grid = part.resample(rate)
        ts = grid["gyroscope"].ts
        columns = {name: grid[name].values for name in (*names, "battery_voltage") if name in grid}
        resolution = 0.0
        if motors == "motor_commands":
            columns[motors], resolution = _hold_commands(part, ts, rate)
        whole = np.all([np.all(np.isfinite(columns[name]), axis=1) for name in names], axis=0)
        for name, values in columns.items():
            present = np.all(np.isfinite(values), axis=1)
            if np.any(present):
                columns[name] = interpolate(ts, ts[present], values[present])
        inside = slice(int(np.argmax(whole)), len(whole) - int(np.argmax(whole[::-1])))
        number = lambda key, usual: (
            float(self.settings[key].value) if key in self.settings else usual
        )
        cutoffs = number("gyroscope_cutoff", np.inf), number("accelerometer_cutoff", np.inf)
        filter_rate = number("filter_rate", None)
        voltage = columns["battery_voltage"][inside, 0] if "battery_voltage" in columns else None
        commands, gyroscope, accelerometer = (columns[name][inside] for name in names)
        if motors == "rotor_speeds":
            # commands hold over the step after them, speeds change through it
            after = np.append(commands[1:], commands[-1:], axis=0)
            commands = (commands + after) / (2 * np.max(self[motors].values))
            voltage = None
        channels = (commands, gyroscope, accelerometer, voltage)
        return FlightRecord(ts[inside], *channels, cutoffs, resolution, filter_rate)

    def to_layout(self, mass: float | int | None = None) -> RotorLayout:
        """Layout of the rotors that the vehicle's parameters give.

        Args:
            mass: of the vehicle [kg], which no log has.

        Raises:
            SettingError: the log has no rotor positions.
        """
        if "rotor_positions" not in self.settings:
            raise SettingError(
                f"{self.name} has no positions of the rotors; give them in a TOML file (`read_rotor_layout`)."
            )
        factor = self.settings.get("thrust_model_factor")
        return make_layout(
            self.settings["rotor_positions"].value, self.settings["rotor_spin"].value, mass,
            1.0 if factor is None else factor.value,
        )  # fmt: skip

    def describe(self) -> str:
        """Text with a table of the channels, flights, settings and notes."""
        flights = ", ".join(f"{a:.1f} to {b:.1f} s" for a, b in self.flights) or "never"
        heads = ("channel", "unit", "columns", "samples", "rate [Hz]", "from [s]", "to [s]", "gaps")
        rows = [(*heads, "source")]
        for name, c in self.channels.items():
            gaps = sum(gap.channel == name for gap in self.gaps)
            numbers = (f"{c.rate:.4g}", f"{c.ts[0]:.2f}", f"{c.ts[-1]:.2f}", gaps)
            rows.append((name, c.unit, " ".join(c.columns), len(c.ts), *numbers, c.source))  # pyright: ignore
        lines = [
            f"{self.name}: {self.format}, {self.vehicle}; {self.duration:.1f} s from {self.start:.2f} s "
            "of its clock",
            f"in flight: {flights}",
            *_align_columns(rows),
        ]
        rows = [("setting", "value", "unit", "source")]
        for name, setting in self.settings.items():
            value = np.array2string(np.asarray(setting.value), precision=4).replace("\n", "")
            rows.append((name, value, setting.unit, setting.source))
        return "\n".join([*lines, *(_align_columns(rows) if self.settings else ()), *self.notes])


def _align_columns(rows: Sequence[Sequence[Any]]) -> list[str]:
    """Lines of a table whose columns are aligned."""
    widths = [max(len(str(row[k])) for row in rows) for k in range(len(rows[0]))]
    cells = lambda row: (f"{cell!s:<{w}}" for cell, w in zip(row, widths, strict=True))
    return ["", *("  ".join(cells(row)).rstrip() for row in rows), ""]


def _align_signs(q: np.ndarray) -> np.ndarray:
    """Quaternions (k, 4) with signs by which each is close to the one before."""
    turns = np.sum(q[1:] * q[:-1], axis=1) < 0
    return q * np.where(np.cumsum(np.append(False, turns)) % 2, -1.0, 1.0)[:, None]


def _on_grid(
    grid: np.ndarray, width: float, ts: np.ndarray, values: np.ndarray, is_held: bool,
    gaps: Sequence[tuple[float, float]],
) -> np.ndarray:  # fmt: skip
    """Values (k, m) at the times of a grid, or their means over `width` [s] around each."""
    if len(ts) < 2:
        return np.full((len(grid), values.shape[1]), np.nan)
    nearest = np.clip(np.searchsorted(ts, grid), 1, len(ts) - 1)
    # A time of the grid that is a sample's up to the stamps' resolution takes that sample itself,
    # without a share of its neighbour.
    nearest -= grid - ts[nearest - 1] < ts[nearest] - grid
    grid = np.where(np.abs(grid - ts[nearest]) < _TICK / 2, ts[nearest], grid)
    steps, slopes = np.diff(ts), np.diff(values, axis=0)
    slopes = np.zeros_like(slopes) if is_held else slopes / steps[:, None]

    # Means over a step are differences of the integral, which is exact for lines between samples:
    # averaging needs no window and shifts no phase.
    def values_at(x: np.ndarray, *, integral: bool) -> np.ndarray:
        k = np.clip(np.searchsorted(ts, x, side="right") - 1, 0, len(ts) - 2)
        after = (x - ts[k])[:, None]
        if integral:
            return sums[k] + after * (values[k] + after / 2 * slopes[k])
        now = values[k] + after * slopes[k]
        # the last sample is that of no interval
        return np.where((x == ts[-1])[:, None], values[-1], now)

    if width:
        areas = steps[:, None] * (values[:-1] + steps[:, None] / 2 * slopes)
        sums = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(areas, axis=0)])
        ends = [values_at(grid + side * width / 2, integral=True) for side in (1, -1)]
        result = (ends[0] - ends[1]) / width
    else:
        result = values_at(grid, integral=False)
    missing = (grid - width / 2 < ts[0]) | (grid + width / 2 > ts[-1])
    if gaps:
        # of the gaps that begin before a step's end, the last one ends latest
        begins, ends = np.array(gaps).T
        k = np.searchsorted(begins, grid + width / 2) - 1
        missing |= (k >= 0) & (grid - width / 2 < ends[k])
    result[missing] = np.nan
    return result


def _hold_commands(flight: FlightLog, grid: np.ndarray, rate: float) -> tuple[np.ndarray, float]:
    """Commands (k, n) that a record holds over the step after each time of a grid, and when they changed [s].

    The second is the standard deviation of the times at which they changed.
    """
    channel = flight["motor_commands"]
    ts, values, late = channel.ts, channel.values, 0.0
    # Rows that repeat their commands are samples of what changed at any time since the row before: by half a step
    # before the row, up to the deviation of a uniform distribution.
    if np.mean(np.all(values[1:] == values[:-1], axis=1)) > _REPEATED:
        late = 1 / channel.rate
    gaps = [(gap.start, gap.end) for gap in flight.gaps if gap.channel == "motor_commands"]
    # The mean over the step has the same integral as the commands: a mean around its start would act half a step late.
    held_commands = _on_grid(grid + 0.5 / rate, 1 / rate, ts - 0.5 * late, values, True, gaps)
    return held_commands, late / 12**0.5


def read_flight_log(
    path: str | os.PathLike[str], columns: str | os.PathLike[str] | Mapping[str, Any] | None = None
) -> FlightLog:
    """Read a flight log: PX4 ULog, ArduPilot .BIN, micro-SD log of Crazyflie, or CSV.

    A truncated or damaged file is read up to the damage; a note says so.

    Args:
        path: the file; its content, not its name, tells the format.
        columns: TOML file, or its content, with the map of columns of a CSV, as below. By default the
            header has names such as "t [s]", "accelerometer.x [g]" and "motor_commands.1".

    A map has a table for the time and for each channel; a unit may stand in the header instead, as in
    "ax [g]". The settings are those of `FlightLog`. All but `time` and one channel may be left out:

        axes = "forward-right-down"    # of body, world and settings; or "forward-left-up"
        separator = ";"                # or "," or a tab; by default the header's most frequent one
        decimal = ","                  # by default a comma is one unless it separates
        time = {column = "t", unit = "ms"}
        accelerometer = {columns = ["ax", "ay", "az"], unit = "g"}
        motor_commands = {columns = ["m1", "m2", "m3", "m4"], range = [1000, 2000]}
        settings = {gyroscope_cutoff = 80.0}

    Raises:
        FileError: the file is missing, is no flight log, or has no channel that is known; or pyulog
            or pymavlink is missing.
        SettingError: the map of columns does not fit.
    """
    source = regular_file(path)
    data = source.read_bytes()
    # An empty file begins with no mark of a format, and would be read as a CSV.
    if not data:
        raise FileError(f"{source} is empty; a flight log would be valid.")
    # Formats that are known but not read are named: as a CSV, their bytes would only raise errors
    # of columns.
    for magic, kind in FOREIGN_FORMATS.items():
        if data.startswith(magic):
            raise FileError(f"{source} is {kind}, which is not read; export it as CSV.")
    decode = next((read for magic, read in DECODERS.items() if data.startswith(magic)), None)
    if decode and columns is not None:
        raise SettingError(f"{source} is no CSV file: leave out the map of columns.")
    # numbers that are not finite are left out, and said
    with np.errstate(all="ignore"):
        draft = decode(source, data) if decode else decode_csv(source, columns)
        return _assemble_log(source, draft)


def _assemble_log(source: Path, draft: LogDraft) -> FlightLog:
    """Log of what was decoded, with clocks, flights and units checked."""
    used = {name: row for name in QUANTITIES if (row := draft.chosen(name)) and row.fields}
    if not used:
        raise FileError(
            f"{source} has none of the quantities of a flight log: {', '.join(QUANTITIES)} would be valid."
        )
    stamps = {name: _stamps_of(draft.topics[row.topic], row.time) for name, row in used.items()}
    # Stamps stay whole microseconds until the start is subtracted: as seconds since the vehicle's
    # boot they would lose digits.
    start = min(int(np.min(ticks)) for ticks in stamps.values())
    channels = {
        name: _convert_channel(draft, name, row, (stamps[name] - start) / 1e6)
        for name, row in used.items()
    }
    for name in ("battery_voltage", "battery_current"):
        if name in channels and len(channels) > 1 and not np.any(channels[name].values):
            del channels[name]
            draft.notes.append(f"The {name} is 0 throughout, so it was not measured.")
    angles = channels.get("euler_angles")
    if angles and len(angles.columns) == 3 and "attitude" not in channels:
        # roll, pitch and yaw about the body's x, y and z
        attitude = Rotation.from_euler("ZYX", angles.values[:, ::-1]).as_quat(scalar_first=True)
        parts = {"values": attitude, "unit": "1", "columns": ("w", *XYZ)}
        channels["attitude"] = dataclasses.replace(angles, **parts)
        del channels["euler_angles"]
    gaps = tuple(gap for name, channel in channels.items() for gap in _find_gaps(name, channel))
    duration = max(float(channel.ts[-1]) for channel in channels.values())
    if draft.is_simulated:
        draft.notes.append("The log was written by a simulator, not by a real vehicle.")
    switches = {}
    for name, (ticks, states) in draft.switches.items():
        order = np.argsort(ticks, kind="stable")
        switches[name] = ((ticks[order] - start) / 1e6, states[order])
    flights = _find_flights(draft, channels, switches, duration)
    flights = _cut_crashes(draft, channels, flights)
    _check_channels(draft, channels, gaps)
    _check_units(draft, channels, flights)
    _check_commands(draft, channels, flights)
    for sentence, is_refused in find_contradictions(channels, flights):
        (draft.refuse if is_refused else draft.notes.append)(sentence)
    _note_assumptions(draft, channels, flights)
    return FlightLog(
        source.name, draft.format, draft.vehicle, start / 1e6, duration, channels, flights, gaps,
        draft.settings, (*draft.notes, *draft.assumptions), tuple(draft.refusals), draft.is_simulated,
    )  # fmt: skip


def _stamps_of(topic: LogTopic, time: str) -> np.ndarray:
    """Stamps of a topic [us], by its field of the time of sampling where that is filled in."""
    sampled = topic.fields.get(time)
    if sampled is not None and np.all(np.asarray(sampled) > 0):
        return np.asarray(sampled).astype(np.int64)
    return topic.stamps


def _convert_channel(draft: LogDraft, name: str, row: LogSource, ts: np.ndarray) -> Channel:
    """Channel in its own unit and axes, with increasing times; rows that are left out are said."""
    quantity, topic = QUANTITIES[name], draft.topics[row.topic]
    # + 0.0 below turns the -0.0 of a changed sign into 0.0.
    signs = np.array(quantity.signs)
    columns = quantity.columns or tuple(str(k + 1) for k in range(len(row.fields)))
    if name == "euler_angles" and len(row.fields) == 2:
        columns, signs = ("roll", "yaw"), signs[[0, 2]]
    values = np.stack([np.asarray(topic.fields[c], float) for c in row.fields], axis=1) * row.scale
    values = values * signs + 0.0 if draft.is_down else values
    good = np.all(np.isfinite(values), axis=1)
    if not np.all(good):
        draft.notes.append(f"{np.sum(~good)} rows of {name} are not finite and were left out.")
    # a stamp that is not after all earlier ones, or not before all later ones, whichever are fewer
    after_all = np.append(True, ts[1:] > np.maximum.accumulate(ts)[:-1])
    before_all = np.append(ts[:-1] < np.minimum.accumulate(ts[::-1])[::-1][1:], True)
    ordered = before_all if np.sum(before_all) > np.sum(after_all) else after_all
    equal = np.diff(ts) == 0
    repeated = ~ordered & (np.append(False, equal) | np.append(equal, False))
    if np.any(repeated):
        draft.notes.append(
            f"{np.sum(repeated)} of {len(ts)} samples of {name} repeat the time of their neighbour and were "
            "left out."
        )
    wrong = ~ordered & ~repeated
    if np.any(wrong):
        sentence = (
            f"The clock of {name} goes backwards near {ts[np.argmax(wrong)]:.3f} s: {np.sum(wrong)} of "
            f"{len(ts)} samples were left out, as times must increase."
        )
        (draft.refuse if np.mean(wrong) > _REFUSED else draft.notes.append)(sentence)
    keep = good & ordered
    if not np.any(keep):
        raise FileError(f"No sample of {name} has finite numbers and an increasing time.")
    place = row.topic if not row.topic.startswith("rows ") else "CSV"
    plain = ", ".join(c.partition(":")[2] or c for c in row.fields)
    source = f"{place}: {plain}"
    about = (quantity.unit, columns, row.topic, source, quantity.is_held)
    return Channel(ts[keep], values[keep], *about)


def _find_gaps(name: str, channel: Channel) -> Iterable[Gap]:
    """Steps longer than two and a half usual ones, and than two of the long ones among them."""
    steps = np.diff(channel.ts)
    if len(steps) < 10:
        return
    # The second bound is for channels whose steps alternate, as of a scheduler: these are no gaps.
    longest = max(2.5 * float(np.median(steps)), 2 * float(np.percentile(steps, 95)))
    for k in np.flatnonzero(steps > longest):
        yield Gap(name, float(channel.ts[k]), float(channel.ts[k + 1]))


def _motor_level(channels: Mapping[str, Channel]) -> tuple[np.ndarray, np.ndarray] | None:
    """Times and mean command of the motors, or mean squared speed as a share of the largest."""
    if channel := channels.get("motor_commands"):
        return channel.ts, np.mean(channel.values, axis=1)
    if channel := channels.get("rotor_speeds"):
        power = np.mean(channel.values**2, axis=1)
        return channel.ts, power / max(float(np.max(power)), 1e-300)
    return None


def _hold_values(grid: np.ndarray, ts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Last value before each time of a grid; the first one before all."""
    return values[np.clip(np.searchsorted(ts, grid, side="right") - 1, 0, len(ts) - 1)]


def _find_flights(
    draft: LogDraft,
    channels: Mapping[str, Channel],
    switches: Mapping[str, tuple[np.ndarray, np.ndarray]],
    duration: float,
) -> np.ndarray:
    """Stretches in flight (n, 2) [s]: armed, not landed and with motors that carry, as far as is known."""
    level = _motor_level(channels)
    clocks = [ts for ts, _ in switches.values()]
    if level is not None:
        clocks += [level[0], level[0] + _TICK]
    # All clocks' stamps together are the grid: between two of them no state changes, so that ends
    # of flights are exact.
    grid = np.unique(np.clip(np.concatenate([*clocks, [0.0, duration]]), 0.0, duration))
    flying = np.ones(len(grid), bool)
    if level is None and not draft.refusals:
        draft.refuse(
            "The log has neither motor_commands nor rotor_speeds; one of them is needed to identify a "
            "multirotor."
        )
    turning = level is not None and bool(np.any(level[1] > _OFF))
    if level is not None:
        # The hovering command is not known, and differs between vehicles: the threshold is a share
        # of what this one usually needs.
        usual = np.percentile(level[1][level[1] > _OFF], 90) if turning else 1.0
        # the motors' state is not known in a long gap, which ends a flight
        before = np.flatnonzero(np.diff(level[0]) > _STOP) + 1
        ts = np.insert(level[0], before, level[0][before - 1] + _TICK)
        states = np.insert(level[1] > max(_IN_FLIGHT * usual, _OFF), before, False)
        flying &= _hold_values(grid, ts, states)
    for name, (ts, states) in switches.items():
        flying &= _hold_values(grid, ts, states == (name == "armed"))
    if level is None and not switches:
        return np.zeros((0, 2))
    # a state holds to the next stamp, the last one to the end
    flying[-1] = False
    edges = grid[np.flatnonzero(np.diff(np.append(False, flying).astype(int)))]
    merged: list[list[float]] = []
    for begin, end in edges.reshape(-1, 2).tolist():
        if merged and begin - merged[-1][1] < _STOP:
            merged[-1][1] = end
        else:
            merged.append([begin, end])
    flights = [(a, b) for a, b in merged if b - a >= _SHORTEST]
    if not flights:
        armed = switches.get("armed")
        disarmed = not np.any(armed[1]) if armed else level is not None and not turning
        few = f"has no flight of {_SHORTEST:g} s or more"
        state = "is disarmed throughout" if disarmed else few
        draft.refuse(f"The log {state}; a log with a flight would be valid.")
    return np.array(flights, float).reshape(-1, 2)


def _cut_crashes(
    draft: LogDraft, channels: Mapping[str, Channel], flights: np.ndarray
) -> np.ndarray:
    """Flights that end before an impact in their last seconds or just after."""
    if "accelerometer" not in channels:
        return flights
    channel = channels["accelerometer"]
    force = np.linalg.norm(channel.values, axis=1)
    remaining = []
    for begin, end in flights:
        # Only late impacts are crashes: hard manoeuvres before them belong to the flight. The
        # motors may stop before the impact.
        late = (channel.ts > max(begin, end - _LAST)) & (channel.ts < end + 0.5)
        hits = channel.ts[late & (force > _IMPACT)]
        if len(hits):
            cut = float(hits[0]) - _BEFORE_IMPACT
            draft.notes.append(
                f"The flight from {begin:.1f} s ends in a crash at {hits[0]:.2f} s (accelerometer above "
                f"{_IMPACT:.0f} m/s^2); it was cut at {cut:.2f} s."
            )
            end = min(end, cut)
        hits = channel.ts[(channel.ts > begin) & (channel.ts < end) & (force > _IMPACT)]
        if len(hits):
            draft.notes.append(
                f"The accelerometer exceeds {_IMPACT:.0f} m/s^2 in flight, first at {hits[0]:.2f} s: an impact or a "
                "fault, which no model of the flight explains."
            )
        if end - begin >= _SHORTEST:
            remaining.append((begin, end))
    if len(flights) and not remaining:
        draft.refuse(
            "No flight of a second or more comes before a crash; a longer one would be valid."
        )
    return np.array(remaining, float).reshape(-1, 2)


def _note_assumptions(
    draft: LogDraft, channels: Mapping[str, Channel], flights: np.ndarray
) -> None:
    """Note what an identification assumes in place of settings and channels that the log lacks."""
    if draft.refusals or not len(flights) or not {"accelerometer", "gyroscope"} <= set(channels):
        return
    is_known = lambda name: f"{name}_cutoff" in draft.settings or name in draft.unfiltered
    unknown = [name for name in ("gyroscope", "accelerometer") if not is_known(name)]
    if unknown:
        names = " and ".join(f"{name}_cutoff" for name in unknown)
        place = "settings of the map of columns" if draft.format == "CSV" else "record's cutoffs"
        draft.assume(
            f"{' and '.join(unknown)} went through no low-pass filter",
            f"the log has no {names}",
            "the delay of one, 2.8 ms of two poles at 80 Hz and 7.5 ms at 30 Hz, would count as delay and lag of the "
            f"motors; the {place} take cut-offs [Hz]",
        )
    if "rotor_positions" in draft.settings and "thrust_model_factor" not in draft.settings:
        draft.assume(
            "thrust is the square of the command",
            "the log has no thrust_model_factor",
            "another curve changes effectiveness at other commands than the mean one",
        )
    if "motor_commands" not in channels:
        draft.assume(
            "measured rotor_speeds over the highest of them are the commands",
            "the log has no motor_commands",
            "effectiveness is that of the highest speed in the log, and no lag is identified",
        )
    elif "battery_voltage" not in channels:
        draft.assume(
            "the battery's voltage is constant",
            "the log has no battery_voltage",
            "as it falls, so does the effectiveness, in which windows then differ",
        )


def _check_channels(draft: LogDraft, channels: Mapping[str, Channel], gaps: Sequence[Gap]) -> None:
    """Note sensors that are missing, gaps, and quaternions that are not of unit length."""
    for name in ("accelerometer", "gyroscope"):
        if name not in channels:
            draft.notes.append(f"The log has no {name}.")
    # A logger that stops loses all channels at once: they share one sentence.
    alike: dict[tuple[tuple[float, float], ...], list[str]] = {}
    for name in channels:
        intervals = tuple((gap.start, gap.end) for gap in gaps if gap.channel == name)
        alike.setdefault(intervals, []).append(name)
    alike.pop((), None)
    for intervals, names in alike.items():
        k = int(np.argmax([end - begin for begin, end in intervals]))
        count = "once, at" if len(intervals) == 1 else f"{len(intervals)} times, the longest at"
        draft.notes.append(
            f"Samples are missing {count} {intervals[k][0]:.2f} s for "
            f"{intervals[k][1] - intervals[k][0]:.3g} s: {', '.join(names)}."
        )
    if "attitude" in channels:
        norm = np.linalg.norm(channels["attitude"].values, axis=1)
        if np.max(np.abs(norm - 1)) > 0.05:
            draft.refuse(
                f"The attitude's quaternions have lengths of {np.min(norm):.3g} to {np.max(norm):.3g}; 1 would "
                "be valid."
            )


def _check_units(draft: LogDraft, channels: Mapping[str, Channel], flights: np.ndarray) -> None:
    """Refuse an accelerometer that does not measure gravity, and a gyroscope beyond all of them."""
    if "gyroscope" in channels:
        rates = channels["gyroscope"]
        fastest = float(np.max(np.abs(rates.values)))
        if fastest > _FASTEST:
            draft.refuse(
                f"The gyroscope reaches {fastest:.4g} rad/s; up to {_FASTEST:g} rad/s would be valid: is its "
                "unit deg/s?"
            )
    if "accelerometer" not in channels:
        return
    channel = channels["accelerometer"]
    ts, force = channel.ts, np.linalg.norm(channel.values, axis=1)
    resting = np.ones(len(ts), bool)
    in_flight = np.zeros(len(ts), bool)
    for begin, end in flights:
        # After landing a vehicle still rocks, and its motors run down.
        resting &= (ts < begin - 0.2) | (ts > end + 1.5)
        in_flight |= (ts > begin) & (ts < end)
    level = _motor_level(channels)
    if level is not None:
        resting &= _hold_values(ts, level[0], level[1]) < _OFF
    if "gyroscope" in channels:
        rates = channels["gyroscope"]
        resting &= _hold_values(ts, rates.ts, np.linalg.norm(rates.values, axis=1)) < 0.2
    period = float(np.median(np.diff(ts))) if len(ts) > 1 else 1.0
    is_checked = np.sum(resting) * period > 0.5
    flies = bool(np.any(in_flight))
    mean = np.mean(channel.values[in_flight], axis=0) if flies else np.array([0, 0, 1.0])
    if mean[2] < _UPRIGHT * np.linalg.norm(mean):
        numbers = ", ".join(f"{x:.3g}" for x in mean)
        draft.refuse(
            f"The accelerometer measures ({numbers}) m/s^2 on average in flight, where thrust along +z would be "
            "valid: are its axes others, such as forward-right-down?"
        )
    if not is_checked and not flies:
        return
    (low, high), place = _GRAVITY, "at rest"
    if not is_checked:
        (low, high), place = _IN_AIR, "in flight, as a median,"
        draft.notes.append(
            "The log has no rest, so gravity checks the accelerometer's scale by the mean in flight only."
        )
    gravity = float(np.median(force[resting if is_checked else in_flight]))
    if not low <= gravity <= high:
        # The unit by which the value would be gravity is most likely the true one.
        sizes = {name: size for name, size in UNITS["m/s^2"].items() if size != 1}
        hints = [name for name, size in sizes.items() if low <= gravity * size <= high]
        hint = f": is its unit {hints[0]}?" if hints else ": its scale or its unit is not m/s^2."
        draft.refuse(
            f"The accelerometer measures {gravity:.4g} m/s^2 {place} where {low:g} to {high:g} m/s^2 would be "
            f"valid{hint}"
        )


def _check_commands(draft: LogDraft, channels: Mapping[str, Channel], flights: np.ndarray) -> None:
    """Note commands that are slower than motors, or at a limit in flight."""
    if "motor_commands" not in channels:
        return
    channel = channels["motor_commands"]
    if 0 < channel.rate < _SLOWEST_COMMANDS:
        draft.notes.append(
            f"motor_commands come at {channel.rate:.3g} Hz; the lag of motors (20 to 100 ms) needs "
            f"{_SLOWEST_COMMANDS:g} Hz or more."
        )
    inside = np.zeros(len(channel.ts), bool)
    for begin, end in flights:
        inside |= (channel.ts >= begin) & (channel.ts <= end)
    if not np.any(inside):
        return
    values = channel.values[inside]
    # A firmware may limit its commands to less than the whole range: motors then stay at the largest or the
    # smallest of all commands, which in free flight few samples are.
    highest, lowest = float(np.max(values)), float(np.min(values))
    shares = [values >= min(highest, 0.995), values <= max(lowest, 0.005)]
    shares = [np.mean(at_limit, axis=0) for at_limit in shares]
    for limit, bound, share in zip(("upper", "lower"), (highest, lowest), shares, strict=True):
        is_end = not 0.005 < bound < 0.995
        # One sentence on the worst motor is enough to doubt the record.
        k = int(np.argmax(share))
        if share[k] > (_SAID if is_end else _REFUSED) and (is_end or highest - lowest > _MOVES):
            draft.notes.append(
                f"motor_commands are saturated: motor {k + 1} is at its {limit} limit of {bound:.3g} in "
                f"{100 * share[k]:.0f} % of the flight; commands between the limits would be valid."
            )


def read_rotor_layout(path: str | os.PathLike[str]) -> RotorLayout:
    """Read the layout of a multirotor's rotors, in the order of its motors, from a TOML file such as

        mass = 0.027                        # [kg]; may be left out, then only ratios are identified
        positions = [[0.0283, -0.0283], [-0.0283, -0.0283], [-0.0283, 0.0283], [0.0283, 0.0283]]
        spin = [1, -1, 1, -1]               # +1: anticlockwise seen from above
        thrust_model_factor = 1.0           # f of thrust f u^2 + (1 - f) u; by default 1
        inertia = [1.5e-5, 1.6e-5, 2.9e-5]  # [kg m^2]; for a model, about axes that the flight does not excite
        torque_ratio = 0.006                # of a rotor, over its thrust [m]; likewise
        highest_speed = 2600.0              # of a rotor at the command 1 [rad/s]; for a model
        centre_height = 0.0                 # of the centre of mass above the origin [m]; likewise

    Args:
        path: the file; positions are forward and left, or forward, left and up [m].

    Raises:
        FileError: the file is missing or no TOML file.
        SettingError: an entry is missing, unknown or not valid.
    """
    source, entries, names = Path(path), read_toml(path), RotorLayout._fields
    for name in entries:
        if name not in names:
            raise SettingError(
                f"{source} has an unknown entry {quote_name(name)}.{nearest_names(name, names)}"
            )
    for name in names:
        if name in ("positions", "spin") and name not in entries:
            raise SettingError(f"{source} lacks the entry '{name}'.")
        value = entries.get(name, 0.0)
        if name not in ("positions", "spin", "inertia") and type(value) not in (int, float):
            raise SettingError(
                f"The entry '{name}' of {source} must be a number, but it is {format_value(value)}."
            )
    try:
        return make_layout(**entries)
    except (TypeError, ValueError) as error:
        # A SettingError is a ValueError too, and has its sentence already.
        if isinstance(error, SettingError):
            raise
        raise SettingError(f"{source} has an entry that is no number: {error}.") from error


def save_flight_record(record: FlightRecord, path: str | os.PathLike[str]) -> Path:
    """Save a record as a CSV file that `read_flight_log` reads; return the path."""
    heads = ["t [s]"]
    heads += [f"accelerometer.{x} [m/s^2]" for x in XYZ] + [f"gyroscope.{x} [rad/s]" for x in XYZ]
    heads += [f"motor_commands.{k + 1} [1]" for k in range(record.commands.shape[1])]
    columns = [record.ts, record.accelerometer, record.gyroscope, record.commands]
    if record.voltage is not None:
        heads.append("battery_voltage.voltage [V]")
        columns.append(record.voltage)
    return write_csv_table(path, heads, columns, "%.9g")
