"""Decoders of flight logs: PX4 ULog, ArduPilot .BIN, Crazyflie micro-SD and CSV.

Each gives a `LogDraft`: topics as they are in the file, and where the channels of a `FlightLog` are among
them. Vectors keep the file's axes until the channels are made.

Sources: ULog and uORB messages of docs.px4.io; log messages of ardupilot.org/copter; the description of
the micro-SD card deck of bitcraze.io and the log variables of its firmware.
"""

import contextlib
import io
import re
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pydantic
from scipy.constants import degree as DEGREE, g as STANDARD_GRAVITY

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import Entries, Finite, Tuples, format_value, quote_name, validate_model
from .csv_table import read_csv_table, split_unit
from .netcdf import FileError, read_toml

_RPM = 2 * np.pi / 60
XYZ = ("x", "y", "z")
# Signs of components when forward-right-down and north-east-down turn to forward-left-up and z up.
_VECTOR, _QUATERNION, _SCALARS = (1.0, -1.0, -1.0), (1.0, 1.0, -1.0, -1.0), (1.0,)


class Quantity(NamedTuple):
    """Unit of a channel, its columns (none: one for each motor) and their signs in the other axes."""

    unit: str
    columns: tuple[str, ...] = ()
    signs: tuple[float, ...] = _SCALARS
    is_held: bool = False


QUANTITIES = {
    "motor_commands": Quantity("1", is_held=True),
    "thrust_commands": Quantity("1", is_held=True),
    "rotor_speeds": Quantity("rad/s"),
    "accelerometer": Quantity("m/s^2", XYZ, _VECTOR),
    "gyroscope": Quantity("rad/s", XYZ, _VECTOR),
    "attitude": Quantity("1", ("w", *XYZ), _QUATERNION),
    "euler_angles": Quantity("rad", ("roll", "pitch", "yaw"), _VECTOR),
    "position": Quantity("m", XYZ, _VECTOR),
    "velocity": Quantity("m/s", XYZ, _VECTOR),
    "acceleration": Quantity("m/s^2", XYZ, _VECTOR),
    "battery_voltage": Quantity("V", ("voltage",)),
    "battery_current": Quantity("A", ("current",)),
}
# Size of units that files have, in the channels' own unit.
UNITS = {
    "s": {"s": 1, "sec": 1, "ms": 1e-3, "us": 1e-6, "\u00b5s": 1e-6, "\u03bcs": 1e-6, "ns": 1e-9},
    "1": {"1": 1, "-": 1, "%": 0.01},
    "rad/s": {
        "rad/s": 1, "mrad/s": 1e-3, "deg/s": DEGREE, "°/s": DEGREE, "dps": DEGREE, "rpm": _RPM,
        "1/min": _RPM,
    },
    "m/s^2": {
        "m/s^2": 1, "m/s2": 1, "m/s²": 1, "m/s/s": 1, "g": STANDARD_GRAVITY,
        "mg": STANDARD_GRAVITY / 1000,
    },
    "rad": {"rad": 1, "deg": DEGREE, "°": DEGREE},
    "m": {"m": 1, "cm": 0.01, "mm": 1e-3},
    "m/s": {"m/s": 1, "cm/s": 0.01, "mm/s": 1e-3, "km/h": 1 / 3.6},
    "V": {"V": 1, "mV": 1e-3},
    "A": {"A": 1, "mA": 1e-3},
}  # fmt: skip


class LogSetting(NamedTuple):
    """Setting of the vehicle with its unit, and the parameter or document that it comes from."""

    value: Any
    unit: str
    source: str


class LogTopic(NamedTuple):
    """Rows of one topic of a file: stamps in microseconds and fields."""

    stamps: np.ndarray
    fields: Mapping[str, np.ndarray]


class LogSource(NamedTuple):
    """Place where a channel is found: topic, fields, their scale to the channel's unit, field of time."""

    channel: str
    topic: str
    fields: tuple[str, ...]
    scale: float | tuple[float, ...] = 1.0
    time: str = ""


@dataclass
class LogDraft:
    """Parts of a log while a file is read. Switches are rows (stamp, true or false)."""

    format: str
    topics: dict[str, LogTopic] = field(default_factory=dict)
    sources: list[LogSource] = field(default_factory=list)
    is_down: bool = False
    vehicle: str = "vehicle not named"
    settings: dict[str, LogSetting] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    refusals: list[str] = field(default_factory=list)
    assumptions: list[str] = field(default_factory=list)
    switches: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    is_simulated: bool = False
    # channels that are known to have no low-pass filter
    unfiltered: set[str] = field(default_factory=set)

    def refuse(self, sentence: str) -> None:
        self.notes.append(sentence)
        self.refusals.append(sentence)

    def refuse_vehicle(self, kind: str) -> None:
        self.vehicle = kind
        self.refuse(
            f"The log is of {kind}, which the models of multirotors do not describe; a multirotor would be valid."
        )

    def assume(self, assumption: str, missing: str, effect: str) -> None:
        """Note what counts in place of a setting that the log lacks, and what a wrong one changes."""
        self.assumptions.append(f"Assumed: {assumption}, because {missing}; {effect}.")

    def assume_range(self, names: str) -> None:
        self.assume(
            "pulses of 1000 to 2000 us are commands of 0 to 1",
            f"the log has no {names}",
            "another range changes the thrust curve, and all effectiveness in proportion",
        )

    def set_cutoffs(
        self, parameters: Mapping[str, Any], names: Mapping[str, tuple[str, str]]
    ) -> None:
        """Take cut-offs of low-pass filters from parameters, by channel, where the source is filtered."""
        for channel, (topic, parameter) in names.items():
            used = self.chosen(channel)
            if used and used.topic == topic and float(parameters.get(parameter, 0)) > 0:
                # A cut-off counts only for the source that is used: raw samples beside filtered
                # ones have another.
                value = float(parameters[parameter])
                self.settings[f"{channel}_cutoff"] = LogSetting(value, "Hz", parameter)
            # Zero turns a filter off, and other sources have none: neither is an assumption.
            elif used and (used.topic != topic or parameter in parameters):
                self.unfiltered.add(channel)

    def set_factor(self, parameters: Mapping[str, Any], name: str) -> None:
        if name in parameters:
            factor = LogSetting(float(parameters[name]), "1", name)
            self.settings["thrust_model_factor"] = factor

    def chosen(self, channel: str) -> LogSource | None:
        """First source of a channel that the file has, at half the rate of the fastest one or more."""
        are_numbers = lambda fields, names: all(_is_numbers(fields.get(name)) for name in names)
        sources = [s for s in self.sources if s.channel == channel and s.topic in self.topics]
        available = [s for s in sources if are_numbers(self.topics[s.topic].fields, s.fields)]
        # Firmwares log the same quantity in several messages at different rates; a slow copy is taken only
        # without a fast one.
        count = lambda source: len(self.topics[source.topic].stamps)
        most = max(map(count, available), default=0)
        return next((source for source in available if 2 * count(source) >= most), None)


def _decode_ulog(source: Path, data: bytes) -> LogDraft:
    """Topics of a PX4 ULog file."""
    try:
        import pyulog
    except ImportError:
        raise FileError(
            f"{source}: reading ULog needs pyulog: pip install '.[logs]' in a checkout."
        ) from None
    # A log that ends with the battery is truncated: what was written before is whole, and is read.
    draft, reader = LogDraft("PX4 ULog", is_down=True), _CutReader(data)
    names = {row.topic for row in _ULOG} | {"actuator_motors", "actuator_outputs", "esc_status"}
    states = ["actuator_armed", "vehicle_land_detected", "vehicle_status"]
    with contextlib.redirect_stdout(io.StringIO()):
        try:
            # Only the topics that are used are decoded; a log has many others.
            log = pyulog.ULog(reader, [*sorted(names), *states])
        # a damaged head can fail in any of its parts
        except Exception as error:
            raise FileError(
                f"{source} begins as an ULog file, but its head cannot be read ({type(error).__name__}); "
                "a whole file would be valid."
            ) from None
    for entry in log.data_list:
        # Redundant sensors are instances of one topic; the first has the plain name, by which
        # sources find it.
        name = f"{entry.name}.{entry.multi_id}" if entry.multi_id else entry.name
        if "timestamp" in entry.data:
            draft.topics[name] = LogTopic(entry.data["timestamp"].astype(np.int64), entry.data)
    if reader.is_cut:
        draft.notes.append("The file is truncated; what comes before its last message was read.")
    if log.file_corruption:
        draft.notes.append("The file is damaged; messages that cannot be decoded were left out.")
    if log.dropouts:
        lost = sum(drop.duration for drop in log.dropouts) / 1000
        draft.notes.append(f"The logger lost {lost:.2f} s of data, in {len(log.dropouts)} places.")
    parameters = _finite_parameters(log.initial_parameters)
    status = draft.topics.get("vehicle_status")
    # Hardware in the loop flies a simulator: its motors are no measurements.
    hil = status is not None and np.any(status.fields.get("hil_state", 0) == 1)
    draft.is_simulated = bool("SITL" in str(log.msg_info_dict.get("ver_hw", "")) or hil)
    _read_px4_vehicle(draft, parameters)
    draft.sources = [*_ULOG, *_px4_motors(draft, parameters), *_px4_speeds(draft)]
    filtered = {
        "gyroscope": ("vehicle_angular_velocity", "IMU_GYRO_CUTOFF"),
        "accelerometer": ("vehicle_acceleration", "IMU_ACCEL_CUTOFF"),
    }
    # The firmware filters what it logs: identification takes that phase into account, and needs
    # the cut-off.
    draft.set_cutoffs(parameters, filtered)
    draft.set_factor(parameters, "THR_MDL_FAC")
    # Source: PX4-Autopilot, msg/VehicleStatus.msg (ARMING_STATE_ARMED).
    for switch, topic, name, on in (
        ("armed", "vehicle_status", "arming_state", 2),
        ("armed", "actuator_armed", "armed", 1),
        ("landed", "vehicle_land_detected", "landed", 1),
    ):
        if topic in draft.topics and name in draft.topics[topic].fields:
            stamps, fields = draft.topics[topic]
            draft.switches[switch] = (stamps, fields[name] == on)
    return draft


def _is_numbers(values: np.ndarray | None) -> bool:
    """True for an array of numbers: damage can make text of them."""
    return values is not None and values.dtype.kind in "fiub"


def _finite_parameters(parameters: Mapping[str, Any]) -> dict[str, float]:
    """Parameters that are finite numbers: damage can make bytes of them."""
    numbers = {name: float(v) for name, v in parameters.items() if isinstance(v, int | float)}
    return {name: v for name, v in numbers.items() if np.isfinite(v)}


class _CutReader(io.BytesIO):
    """Bytes that tell whether a read ended within what was asked for.

    pyulog goes back by what it asked for, not by what it got, and would read a damaged end forever.
    """

    is_cut, missed = False, 0

    def read(self, size: int | None = -1, /) -> bytes:
        part = super().read(size)
        self.missed = size if size is not None and len(part) < size else 0
        # the file may end where a head of three bytes is expected
        self.is_cut |= bool(self.missed and (part or size != 3))
        return part

    def seek(self, offset: int, whence: int = 0, /) -> int:
        if self.missed and whence == 1 and offset == -2 - self.missed:
            raise EOFError("a message is longer than the file")
        return super().seek(offset, whence)


_THREE = ("[0]", "[1]", "[2]")
_ULOG = [
    LogSource("gyroscope", "vehicle_angular_velocity", tuple(f"xyz{k}" for k in _THREE), 1.0, "timestamp_sample"),
    LogSource("gyroscope", "sensor_combined", tuple(f"gyro_rad{k}" for k in _THREE)),
    LogSource("accelerometer", "vehicle_acceleration", tuple(f"xyz{k}" for k in _THREE), 1.0, "timestamp_sample"),
    LogSource("accelerometer", "sensor_combined", tuple(f"accelerometer_m_s2{k}" for k in _THREE)),
    LogSource("attitude", "vehicle_attitude", tuple(f"q{k}" for k in (*_THREE, "[3]")), 1.0, "timestamp_sample"),
    LogSource("position", "vehicle_local_position", XYZ, 1.0, "timestamp_sample"),
    LogSource("velocity", "vehicle_local_position", ("vx", "vy", "vz"), 1.0, "timestamp_sample"),
    LogSource("battery_voltage", "battery_status", ("voltage_v",)),
    LogSource("battery_current", "battery_status", ("current_a",)),
]  # fmt: skip
# Numbers of rotors by MAV_TYPE, and words for vehicles that are no multirotors. Sources: MAVLink common.xml (MAV_TYPE);
# PX4-Autopilot, src/modules/control_allocator/module.yaml (CA_AIRFRAME).
_ROTORS = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}
_OTHERS = {
    1: "a fixed-wing aircraft", 3: "a coaxial helicopter", 4: "a helicopter", 7: "an airship", 10: "a rover",
    11: "a boat", 12: "a submarine", **dict.fromkeys(range(19, 26), "a VTOL aircraft"),
}  # fmt: skip
_AIRFRAMES = {
    1: "a fixed-wing aircraft", **dict.fromkeys((2, 3, 4), "a VTOL aircraft"),
    7: "a vehicle with motors along several axes", 8: "a multirotor with tilting rotors",
    **dict.fromkeys((5, 6, 13), "a rover"), **dict.fromkeys((10, 11, 12), "a helicopter"),
}  # fmt: skip
# Words of a map of columns for them, and ArduPilot's frames and functions of servos that only they have. Sources:
# ardupilot, libraries/AP_Motors/AP_Motors_Class.h (motor_frame_class), libraries/SRV_Channel/SRV_Channel.h (Function).
_OTHER_WORDS = re.compile(
    r"fixed.?wing|plane|vtol|helicopter|rover|boat|submarine|airship|glider", re.I
)
# Tilt of a rotor's axis up to which it counts as upright [degrees].
_TILTED = 10.0
_HELICOPTERS, _SURFACES = (6, 11, 13), (4, 19, 24, 25, 77, 78, 79, 80)
_VANES = {8: "a single rotor above vanes", 9: "a coaxial rotor above vanes", 10: "a tailsitter"}


def _read_px4_vehicle(draft: LogDraft, parameters: Mapping[str, Any]) -> None:
    """Take the kind of vehicle and the rotors' geometry, whose axes are forward-right-down."""
    kind = int(parameters.get("MAV_TYPE", 0))
    other = _OTHERS.get(kind) or _AIRFRAMES.get(int(parameters.get("CA_AIRFRAME", 0)))
    status = draft.topics.get("vehicle_status")
    if status is not None and np.any(status.fields.get("is_vtol", 0)):
        other = "a VTOL aircraft"
    if other:
        draft.refuse_vehicle(other)
        return
    # The allocator's own parameters come first: the type of the vehicle is a coarse class that
    # users leave at its default.
    count = int(parameters.get("CA_ROTOR_COUNT", 0)) or _ROTORS.get(kind, 0)
    if count:
        draft.vehicle = f"multirotor with {count} rotors"
    rotors = [f"CA_ROTOR{k}_" for k in range(count)]
    if rotors and all(f"{name}PX" in parameters for name in rotors):
        places = [[parameters.get(f"{name}P{axis}", 0.0) for axis in "XYZ"] for name in rotors]
        # Rotors push along (AX, AY, AZ), by default up; those of the model push along z.
        usual = {"X": 0.0, "Y": 0.0, "Z": -1.0}
        axes = [[parameters.get(f"{name}A{k}", x) for k, x in usual.items()] for name in rotors]
        tilts = [np.degrees(np.arctan2(np.hypot(x, y), -z)) for x, y, z in axes]
        if max(tilts) > _TILTED:
            draft.refuse(
                f"Rotor {np.argmax(tilts) + 1} is tilted by {max(tilts):.3g} degrees (CA_ROTORn_AX, AY, AZ); rotors "
                f"that push up within {_TILTED:g} degrees would be valid."
            )
        # The moment's coefficient is of unknown accuracy. It is positive for a rotor that turns anticlockwise seen
        # from above. Source: PX4-Autopilot, src/modules/control_allocator/module.yaml (CA_ROTORn_KM).
        spin = np.sign([parameters.get(f"{name}KM", 0.05) for name in rotors])
        positions = np.array(places) * _VECTOR + 0.0
        draft.settings["rotor_positions"] = LogSetting(positions, "m", "CA_ROTORn_PX, PY, PZ")
        draft.settings["rotor_spin"] = LogSetting(spin, "1", "sign of CA_ROTORn_KM")


def _px4_motors(draft: LogDraft, parameters: Mapping[str, Any]) -> list[LogSource]:
    """Sources of the commands: those of the allocator, or the outputs that drive motors."""
    topic = draft.topics.get("actuator_motors")
    if topic:
        names = [f"control[{k}]" for k in range(12) if f"control[{k}]" in topic.fields]
        # Motors that do not exist are NaN in this topic.
        used = tuple(name for name in names if np.any(np.isfinite(topic.fields[name])))
        # The allocator's values are thrusts: the output drivers solve f u^2 + (1 - f) u for the command u that the
        # motors get. Source: PX4-Autopilot, src/lib/mixer_module/functions/FunctionMotors.hpp (updateValues).
        f = parameters.get("THR_MDL_FAC", 0.0)
        if 0 < f <= 1:
            solve = lambda T: (np.sqrt((1 - f) ** 2 + 4 * f * np.maximum(T, 0.0)) - 1 + f) / (2 * f)
            commands = {f"{name} (by THR_MDL_FAC)": solve(topic.fields[name]) for name in used}
            draft.topics["actuator_motors"] = LogTopic(topic.stamps, {**topic.fields, **commands})
            used = tuple(commands)
        # the stamp of the output itself, not that of the measurement that it answers
        return [LogSource("motor_commands", "actuator_motors", used)]
    topic = draft.topics.get("actuator_outputs")
    if draft.refusals or not topic:
        return []
    function_of = lambda k: int(parameters.get(f"PWM_MAIN_FUNC{k + 1}", 0))
    functions = {function_of(k) - 101: k for k in range(16) if 101 <= function_of(k) <= 112}
    count = _ROTORS.get(int(parameters.get("MAV_TYPE", 0)), 0)
    # Outputs are in the order of the pins, motors in that of their functions: the second is the
    # order of the rotors' positions.
    outputs = [functions[k] for k in sorted(functions)] or list(range(count))

    def limit_value(word: str, k: int, usual: float) -> float:
        names = (f"PWM_MAIN_{word}{k + 1}", f"PWM_{word}")
        # 0 and -1 stand for the common parameter
        return next((float(parameters[n]) for n in names if parameters.get(n, 0) > 0), usual)

    if outputs and not functions:
        draft.assume(
            f"outputs 1 to {count} are the motors",
            "the log has no PWM_MAIN_FUNCn",
            "another order gives other responses of the motors",
        )
    ends = [(limit_value("MIN", k, 1000.0), limit_value("MAX", k, 2000.0)) for k in outputs]
    if not any(name.startswith(("PWM_MAIN_M", "PWM_M")) for name in parameters):
        draft.assume_range("PWM_MAIN_MINn and PWM_MAIN_MAXn")
    return _pulse_source(draft, "actuator_outputs", [f"output[{k}]" for k in outputs], ends)


def _pulse_source(
    draft: LogDraft, topic: str, names: Sequence[str], ends: Sequence[tuple[float, float]]
) -> list[LogSource]:
    """Source of commands from widths of pulses [us]; a pulse below its range is a motor that is off."""
    stamps, fields = draft.topics[topic]
    if not names or not all(name in fields for name in names):
        return []
    scaled = {
        # The names of the scaled fields have their ranges, which the description of a log shows: a
        # wrong range changes every command.
        f"{name} ({low:g} to {high:g} us)": np.maximum((fields[name] - low) / (high - low), 0.0)
        for name, (low, high) in zip(names, ends, strict=True)
    }
    draft.topics[topic] = LogTopic(stamps, {**fields, **scaled})
    return [LogSource("motor_commands", topic, tuple(scaled))]


def _px4_speeds(draft: LogDraft) -> list[LogSource]:
    """Source of the rotors' speeds, in the order of the motors' functions where the log has it."""
    topic = draft.topics.get("esc_status")
    if not topic:
        return []
    names = [f"esc[{k}].esc_rpm" for k in range(8)]
    available = [name for name in names if name in topic.fields and np.any(topic.fields[name])]
    order = lambda name: np.max(topic.fields.get(name.replace("esc_rpm", "actuator_function"), 0))
    return [LogSource("rotor_speeds", "esc_status", tuple(sorted(available, key=order)), _RPM)]


# Source: ardupilot, libraries/AP_Logger/AP_Logger.h (LogEvent).
_ARMED, _DISARMED, _LANDED, _NOT_LANDED = 10, 11, 18, 28
_NKF = ("XKF1", "NKF1", "EKF1")
_BIN = [
    *(LogSource("gyroscope", name, ("GyrX", "GyrY", "GyrZ")) for name in ("IMU", "GYR")),
    *(LogSource("accelerometer", name, ("AccX", "AccY", "AccZ")) for name in ("IMU", "ACC")),
    *(LogSource("attitude", name, ("Q1", "Q2", "Q3", "Q4")) for name in ("XKQ", "XKQ1", "NKQ1")),
    LogSource("euler_angles", "ATT", ("Roll", "Pitch", "Yaw"), DEGREE),
    *(LogSource("position", name, ("PN", "PE", "PD")) for name in _NKF),
    *(LogSource("velocity", name, ("VN", "VE", "VD")) for name in _NKF),
    *(LogSource("battery_voltage", name, ("Volt",)) for name in ("BAT", "CURR")),
    *(LogSource("battery_current", name, ("Curr",)) for name in ("BAT", "CURR")),
]
# Motors by FRAME_CLASS. Source: ardupilot, libraries/AP_Motors/AP_Motors_Class.h (motor_frame_class).
_CLASSES = {1: 4, 2: 6, 3: 8, 4: 8, 5: 6, 7: 3, 12: 12, 14: 10}
_FRAMES = {"TRI": 3, "QUAD": 4, "HEXA": 6, "Y6": 6, "OCTA": 8}


def _decode_bin(source: Path, data: bytes) -> LogDraft:
    """Messages of an ArduPilot .BIN file, of the first instance where there are several."""
    try:
        from pymavlink import DFReader
    except ImportError:
        raise FileError(
            f"{source}: reading ArduPilot's .BIN needs pymavlink: pip install '.[logs]' in a checkout."
        ) from None

    class Index(DFReader.DFReader_binary):
        """Places and formats of the messages, without dates, by the indexer whose words can be caught."""

        def init_arrays_fast(self, progress_callback: Any = None) -> None:
            self.init_arrays(progress_callback)

        def init_clock(self) -> None:
            pass

    draft, said = LogDraft("ArduPilot .BIN", is_down=True), io.StringIO()
    # the reader leaves its file open where it fails on a damaged head
    log: Any = object.__new__(Index)
    with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
        try:
            log.__init__(str(source))
        # a damaged head can fail in any of its parts
        except Exception as error:
            raise FileError(
                f"{source} begins as an ArduPilot .BIN file, but cannot be read ({type(error).__name__}); "
                "a whole file would be valid."
            ) from None
        finally:
            for name in ("filehandle", "data_map"):
                with contextlib.suppress(AttributeError, BufferError):
                    getattr(log, name).close()
    # The last message that was found tells whether the file ends within it.
    found_messages = [(int(o[-1]), k) for k, o in enumerate(log.offsets) if len(o)]
    if not found_messages:
        raise FileError(
            f"{source} begins as an ArduPilot .BIN file, but has no message; a whole file would be valid."
        )
    begin, last = max(found_messages)
    is_known = last in log.formats
    end = begin + (log.formats[last].len if is_known else 0)
    if said.getvalue():
        # the reader stops at a message of an unknown kind
        place = f"; it was read up to byte {end} of {len(data)}" if end < len(data) - 528 else ""
        draft.notes.append(
            f"The file is damaged; messages that cannot be decoded were left out{place}."
        )
    if end > len(data) or (not is_known and not said.getvalue()):
        draft.notes.append("The file is truncated; what comes before its last message was read.")
    tables = {
        fmt.name: _read_messages(data, log.offsets[k], fmt, DFReader.FORMAT_TO_STRUCT)
        for k, fmt in log.formats.items()
        if fmt.name in {row.topic for row in _BIN} | {"RCOU", "ESC", "PARM", "MSG", "ARM", "EV"}
    }
    for kind, table in tables.items():
        clock = "TimeUS" if "TimeUS" in table else "TimeMS"
        # The field of an instance has had several names in the firmware's versions.
        instances = next((table[c] for c in ("I", "C", "Instance", "Inst") if c in table), None)
        for number in (0,) if instances is None else np.unique(instances):
            part = {c: v if instances is None else v[instances == number] for c, v in table.items()}
            if _is_numbers(part.get(clock)) and len(part[clock]):
                stamps = part[clock].astype(np.int64) * (1 if clock == "TimeUS" else 1000)
                draft.topics[f"{kind}.{number}" if number else kind] = LogTopic(stamps, part)
    decode = lambda text: str(text, "ascii", "replace")
    texts = [decode(text) for text in tables.get("MSG", {}).get("Message", ())]
    pairs = zip(*(tables.get("PARM", {}).get(c, ()) for c in ("Name", "Value")), strict=False)
    parameters = _finite_parameters({decode(name): float(value) for name, value in pairs})
    _read_ardupilot_vehicle(draft, parameters, texts)
    draft.sources = [*_BIN, *_ardupilot_motors(draft, parameters, texts), *_ardupilot_speeds(draft)]
    filters = {"gyroscope": "INS_GYRO_FILTER", "accelerometer": "INS_ACCEL_FILTER"}
    draft.set_cutoffs(parameters, {channel: ("IMU", name) for channel, name in filters.items()})
    draft.set_factor(parameters, "MOT_THST_EXPO")
    if "EV" in draft.topics and "Id" in draft.topics["EV"].fields:
        stamps, events = draft.topics["EV"].stamps, draft.topics["EV"].fields["Id"]
        for switch, on, stop in (("armed", _ARMED, _DISARMED), ("landed", _LANDED, _NOT_LANDED)):
            rows_of = np.isin(events, (on, stop))
            if np.any(rows_of):
                draft.switches[switch] = (stamps[rows_of], events[rows_of] == on)
    if "ARM" in draft.topics and "ArmState" in draft.topics["ARM"].fields:
        stamps, table = draft.topics["ARM"]
        draft.switches["armed"] = (stamps, table["ArmState"] == 1)
    return draft


def _read_messages(
    data: bytes,
    places: Sequence[int],
    fmt: Any,
    structs: Mapping[str, tuple[str, float | None, Any]],
) -> dict[str, np.ndarray]:
    """Columns of one kind of message, from the places of its heads of three bytes."""
    kinds = [structs[letter][0] for letter in fmt.msg_fmts]
    codes = [f"S{kind[:-1]}" if kind.endswith("s") else f"<{kind}" for kind in kinds]
    columns = fmt.columns[: len(codes)]
    if len(set(columns)) < len(codes) or "" in columns:
        return {}
    dtype = np.dtype(list(zip(columns, codes, strict=True)))
    heads = np.array(places, np.int64)
    # The last message may be cut; all whole ones are read.
    heads = heads[heads + fmt.len <= len(data)]
    if dtype.itemsize != fmt.len - 3 or not len(heads):
        return {}
    # All messages of a kind at once as a structured array; one by one they would be a loop in Python.
    packed = np.frombuffer(data, np.uint8)[heads[:, None] + np.arange(3, fmt.len)]
    rows: Any = packed.view(dtype)[:, 0]
    sizes = [structs[letter][1] for letter in fmt.msg_fmts]
    pairs = zip(columns, sizes, strict=True)
    return {name: rows[name] if size is None else rows[name] * size for name, size in pairs}


def _read_ardupilot_vehicle(
    draft: LogDraft, parameters: Mapping[str, float], texts: list[str]
) -> None:
    text = " ".join(texts)
    draft.is_simulated = "SITL" in text or any(name.startswith("SIM_") for name in parameters)
    firmware = re.search(r"(ArduPlane|ArduRover|Rover|ArduSub|Blimp|AntennaTracker)", text)
    functions = {v for name, v in parameters.items() if re.fullmatch(r"SERVO\d+_FUNCTION", name)}
    if firmware:
        draft.refuse_vehicle(f"a vehicle with the firmware {firmware[0]}")
    elif parameters.get("Q_ENABLE", 0) > 0:
        draft.refuse_vehicle("a VTOL aircraft")
    elif functions.intersection(_SURFACES):
        draft.refuse_vehicle("an aircraft with control surfaces (SERVOn_FUNCTION)")
    elif parameters.get("FRAME_CLASS") in _HELICOPTERS or "Frame: HELI" in text:
        draft.refuse_vehicle("a helicopter")
    elif parameters.get("FRAME_CLASS") in _VANES:
        draft.refuse_vehicle(_VANES[int(parameters["FRAME_CLASS"])])
    elif "Copter" in text:
        draft.vehicle = "multirotor"


def _ardupilot_motors(
    draft: LogDraft, parameters: Mapping[str, float], texts: list[str]
) -> list[LogSource]:
    """Source of the commands: outputs whose function is a motor, or the first ones of the frame."""
    if "RCOU" not in draft.topics or draft.refusals:
        return []
    # Motors 1 to 8 have the functions 33 to 40, motors 9 to 12 the functions 82 to 85.
    numbers = {33 + k: k for k in range(8)} | {82 + k: 8 + k for k in range(4)}
    motors = {
        numbers[int(value)]: int(name[5:-9])
        for name, value in parameters.items()
        if re.fullmatch(r"SERVO\d+_FUNCTION", name) and int(value) in numbers
    }
    outputs = [motors[k] for k in sorted(motors)]
    if not outputs:
        frame = re.search(r"\b(TRI|QUAD|HEXA|Y6|OCTA)", " ".join(texts).upper())
        by_text = _FRAMES[frame[1]] if frame else 0
        count = _CLASSES.get(int(parameters.get("FRAME_CLASS", 0)), by_text)
        outputs = list(range(1, count + 1))
        if outputs:
            draft.assume(
                f"outputs 1 to {count} are the motors, by the frame",
                "the log has no SERVOn_FUNCTION",
                "another order gives other responses of the motors",
            )
    if outputs:
        draft.vehicle = f"multirotor with {len(outputs)} rotors"
    prefix = "C" if "C1" in draft.topics["RCOU"].fields else "Ch"
    low = parameters.get("MOT_PWM_MIN", 0) or parameters.get("RC3_MIN", 0) or 1000.0
    high = parameters.get("MOT_PWM_MAX", 0) or parameters.get("RC3_MAX", 0) or 2000.0
    if outputs and not {"MOT_PWM_MIN", "RC3_MIN"} & set(parameters):
        draft.assume_range("MOT_PWM_MIN and MOT_PWM_MAX")
    # The command of the thrust curve f u^2 + (1 - f) u, f = MOT_THST_EXPO, is 0 at MOT_SPIN_MIN and 1 at MOT_SPIN_MAX.
    # Source: ardupilot, libraries/AP_Motors/AP_Motors_Thrust_Linearization.cpp (thrust_to_actuator).
    span = high - low
    high = low + span * parameters.get("MOT_SPIN_MAX", 1.0)
    low = low + span * parameters.get("MOT_SPIN_MIN", 0.0)
    names = [f"{prefix}{k}" for k in outputs]
    return _pulse_source(draft, "RCOU", names, [(low, high)] * len(outputs))


def _ardupilot_speeds(draft: LogDraft) -> list[LogSource]:
    """Source of the rotors' speeds; those of further instances are interpolated to the first's times."""
    keys = sorted(key for key in draft.topics if key == "ESC" or key.startswith("ESC."))
    if not keys or "RPM" not in draft.topics[keys[0]].fields:
        return []
    stamps = draft.topics[keys[0]].stamps
    speeds = {
        f"{key}.RPM": np.interp(stamps, draft.topics[key].stamps, draft.topics[key].fields["RPM"])
        for key in keys
    }
    draft.topics["ESC"] = LogTopic(stamps, {**draft.topics["ESC"].fields, **speeds})
    return [LogSource("rotor_speeds", "ESC", tuple(speeds), _RPM)]


_MOTORS, _CARD = range(1, 5), "*"
_CRAZYFLIE = [
    LogSource("accelerometer", _CARD, ("acc.x", "acc.y", "acc.z"), STANDARD_GRAVITY),
    LogSource("gyroscope", _CARD, ("gyro.x", "gyro.y", "gyro.z"), DEGREE),
    LogSource(
        "gyroscope", _CARD, tuple(f"stateEstimateZ.rate{k}" for k in ("Roll", "Pitch", "Yaw")), 1e-3
    ),
    LogSource("motor_commands", _CARD, tuple(f"pwm.m{k}_pwm" for k in _MOTORS), 1 / 65535),
    LogSource("motor_commands", _CARD, tuple(f"motor.m{k}" for k in _MOTORS), 1 / 65535),
    LogSource("rotor_speeds", _CARD, tuple(f"rpm.m{k}" for k in _MOTORS), _RPM),
    LogSource("attitude", _CARD, tuple(f"stateEstimate.q{k}" for k in "wxyz")),
    LogSource("attitude", _CARD, tuple(f"kalman.q{k}" for k in range(4))),
    # the firmware's pitch is positive nose up
    LogSource(
        "euler_angles", _CARD, tuple(f"stateEstimate.{k}" for k in ("roll", "pitch", "yaw")),
        (DEGREE, -DEGREE, DEGREE),
    ),
    LogSource("euler_angles", _CARD, ("stateEstimate.roll", "stateEstimate.yaw"), DEGREE),
    *(
        LogSource(channel, _CARD, tuple(f"stateEstimate{z}.{prefix}{k}" for k in XYZ), scale * unit)
        for channel, prefix, unit in (
            ("position", "", 1.0), ("velocity", "v", 1.0), ("acceleration", "a", STANDARD_GRAVITY),
        )
        for z, scale in (("", 1.0), ("Z", 1e-3 if unit == 1.0 else 1e-3 / STANDARD_GRAVITY))
    ),
    LogSource("battery_voltage", _CARD, ("pm.vbat",)),
    LogSource("battery_voltage", _CARD, ("pm.vbatMV",), 1e-3),
]  # fmt: skip
_CHIP = "Crazyflie's firmware (sensors_bmi088_bmp388.c, two poles), not the log"
_TYPES = {
    "f": "f4", "d": "f8", "b": "i1", "B": "u1", "h": "i2", "H": "u2", "i": "i4", "I": "u4",
    "l": "i4", "L": "u4", "q": "i8", "Q": "u8", "?": "?",
}  # fmt: skip


def _decode_crazyflie(source: Path, data: bytes) -> LogDraft:
    """Rows of a micro-SD log: head with kinds of rows, then id, stamp and packed values; CRC32."""
    draft = LogDraft("Crazyflie micro-SD", vehicle="multirotor")
    # The checksum is written last: a log that was switched off has none, and its rows are still
    # good.
    is_whole = len(data) > 9 and zlib.crc32(data[:-4]) == int.from_bytes(data[-4:], "little")
    end, kinds = len(data) - 4 * is_whole, {}
    try:
        version, count = struct.unpack_from("<HH", data, 1)
        place = 5
        for _ in range(count):
            key, place = struct.unpack_from("<H", data, place)[0], place + 2
            name, place = _read_text(data, place)
            size, place = struct.unpack_from("<H", data, place)[0], place + 2
            texts = []
            for _ in range(size):
                text, place = _read_text(data, place)
                texts.append(text)
            stamp = [("id", "<u2"), ("stamp", "<u8" if version == 2 else "<u4")]
            values = [(text[:-3], "<" + _TYPES[text[-2]]) for text in texts]
            kinds[key] = (name, np.dtype(stamp + values), [])
        if version not in (1, 2):
            raise ValueError
    except (struct.error, ValueError, KeyError, IndexError, UnicodeDecodeError):
        raise FileError(
            f"{source} is no flight log: it begins as a micro-SD log of Crazyflie, but its head does "
            "not fit version 1 or 2 of that format."
        ) from None
    sizes = {key: dtype.itemsize for key, (_, dtype, _) in kinds.items()}
    first = place
    while place + 2 <= end:
        key = data[place] | data[place + 1] << 8
        # Rows have no mark of their start: after an unknown kind nothing can be found again.
        if key not in sizes or place + sizes[key] > end:
            break
        kinds[key][2].append(place)
        place += sizes[key]
    if place < end:
        damage = "truncated" if place + max(sizes.values(), default=0) >= end else "damaged"
        draft.notes.append(
            f"The file is {damage}: its rows were read up to byte {place} of {len(data)}, and what "
            "follows was left out."
        )
    elif not is_whole:
        draft.notes.append(
            f"The file is truncated or damaged: its CRC32 does not match; all {len(data) - first} bytes "
            "of rows were read, and some numbers may be wrong."
        )
    buffer = np.frombuffer(data, np.uint8)
    for name, dtype, places in kinds.values():
        if places:
            # Views on the bytes of the file; no row is decoded by itself.
            table = buffer[np.array(places)[:, None] + np.arange(dtype.itemsize)].view(dtype)[:, 0]
            # stamps of version 1 are ticks of a millisecond
            stamps = table["stamp"].astype(np.int64) * (1 if version == 2 else 1000)
            fields = {key: table[key] for key in dtype.names or () if key not in ("id", "stamp")}
            draft.topics[name] = LogTopic(stamps, fields)
    draft.sources = [row._replace(topic=name) for row in _CRAZYFLIE for name in draft.topics]
    # Duties are preferred to thrusts, since they are what the motors got.
    both = draft.chosen("motor_commands")
    if both and both.fields[0].startswith("pwm"):
        # the duty is what the firmware makes of the thrust that is asked for and the battery's voltage
        names = tuple(f"motor.m{k}" for k in _MOTORS)
        draft.sources += [LogSource("thrust_commands", both.topic, names, 1 / 65535)]
    for channel, cutoff in (("gyroscope", 80.0), ("accelerometer", 30.0)):
        used = draft.chosen(channel)
        # the rates of stateEstimateZ are those of the same filtered gyroscope
        if used and used.fields[0] in ("acc.x", "gyro.x", "stateEstimateZ.rateRoll"):
            draft.settings[f"{channel}_cutoff"] = LogSetting(cutoff, "Hz", _CHIP)
            draft.settings["filter_rate"] = LogSetting(1000.0, "Hz", _CHIP)
    return draft


def _read_text(data: bytes, place: int) -> tuple[str, int]:
    """Text up to the next zero, and the place behind it."""
    end = data.index(0, place)
    return data[place:end].decode("ascii"), end + 1


Texts = Annotated[tuple[str, ...], Tuples]


class _TimeColumn(Entries):
    column: str
    unit: str | None = None


class _ChannelColumns(Entries):
    columns: Texts
    unit: str | None = None
    range: Annotated[tuple[Finite, Finite] | None, Tuples] = None


class _MapHead(Entries):
    axes: Literal["forward-left-up", "forward-right-down"] = "forward-left-up"
    separator: Literal[",", ";", "\t"] | None = None
    decimal: Literal[".", ","] | None = None
    vehicle: str = "multirotor"
    time: _TimeColumn
    settings: dict[str, Any] = pydantic.Field(default_factory=dict)


_CHANNELS: Any = dict.fromkeys(QUANTITIES, (_ChannelColumns | None, None))
_ColumnMap = pydantic.create_model("_ColumnMap", __base__=_MapHead, **_CHANNELS)

_SETTING_UNITS = {
    "gyroscope_cutoff": "Hz", "accelerometer_cutoff": "Hz", "filter_rate": "Hz", "thrust_model_factor": "1",
    "rotor_positions": "m", "rotor_spin": "1",
}  # fmt: skip


def decode_csv(source: Path, columns: Any) -> LogDraft:
    """Columns of a CSV file; a blank cell is no sample of its channel."""
    table = columns if isinstance(columns, Mapping) or columns is None else read_toml(columns)
    plan = None if table is None else validate_model(_ColumnMap, table, "The map of columns")
    try:
        options = {} if plan is None else {"separator": plan.separator, "decimal": plan.decimal}
        cells = read_csv_table(source, admits_cut=True, **options)
    except FileError as error:
        raise FileError(
            f"{source} is no flight log, but PX4 ULog, ArduPilot .BIN, a micro-SD log of Crazyflie or a CSV file would "
            f"be valid: {error}"
        ) from None
    if plan is None:
        table = _default_map(cells.heads)
        if not table:
            raise FileError(
                f"{source} is no flight log: its first line {format_value(','.join(cells.heads))} has no time and no "
                "channel such as accelerometer.x [m/s^2]; a map of columns would make it one."
            )
        plan = validate_model(_ColumnMap, table, "The map of columns")
    draft = LogDraft("CSV", vehicle=plan.vehicle, is_down=plan.axes == "forward-right-down")
    if _OTHER_WORDS.search(plan.vehicle):
        draft.refuse_vehicle(f"a {plan.vehicle} (the map's vehicle)")
    if cells.is_cut:
        cut = "its last row is not whole or has no end of line, and was left out"
        draft.notes.append(f"The file is truncated: {cut}.")
    if "axes" not in plan.model_fields_set and columns is not None:
        draft.assume(
            "x is forward, y left and z up",
            "the map of columns has no 'axes'",
            'with axes = "forward-right-down" y and z change their signs',
        )

    def read_column(name: str, unit: str, map_unit: str | None) -> np.ndarray:
        """Numbers of a column in the channel's unit."""
        place = cells.find_column(name, with_unit=False)
        in_head = split_unit(cells.heads[place])[1]
        if map_unit and in_head and UNITS[unit].get(map_unit) != UNITS[unit].get(in_head):
            raise SettingError(
                f"Column {quote_name(name)} is in {in_head} by its header, but in {map_unit} by the map."
            )
        return cells.read_column(place) * _size_of_unit(map_unit or in_head, unit, name)

    stamps = read_column(plan.time.column, "s", plan.time.unit) * 1e6
    for name, quantity in QUANTITIES.items():
        part = getattr(plan, name)
        if part is None:
            continue
        expected = len(quantity.columns)
        if not part.columns or (expected and len(part.columns) != expected):
            raise SettingError(
                f"The map gives {name} {len(part.columns)} columns, but it has {expected or 'one or more'}"
                f"{': ' if expected else ''}{', '.join(quantity.columns)}."
            )
        if part.range is not None:
            low, high = part.range
            if low == high:
                raise SettingError(
                    f"The range of {name} must have two different ends, not {low:g} twice."
                )
            scale = {c: (read_column(c, "1", "1") - low) / (high - low) for c in part.columns}
        else:
            scale = {c: read_column(c, quantity.unit, part.unit) for c in part.columns}
        values = np.stack(list(scale.values()), axis=1)
        # Blank cells are usual where slow sensors share a table with fast ones: each channel has
        # its own rows and clock.
        complete = np.isfinite(stamps) & np.all(np.isfinite(values), axis=1)
        if not np.any(complete):
            raise FileError(
                f"{source} has no row in which time and all columns of {name} are numbers."
            )
        low, high = np.min(values[complete]), np.max(values[complete])
        if quantity.is_held and not -0.01 <= low <= high <= 1.01:
            raise SettingError(
                f"The {name} must be 0 to 1, but they are {low:g} to {high:g}: give their range in the map, such as "
                "range = [1000, 2000]."
            )
        # channels with the same rows have one clock
        clock = f"rows {zlib.crc32(np.packbits(complete).tobytes()):x}"
        fields = draft.topics[clock].fields if clock in draft.topics else {}
        named_columns = {f"{name}:{c}": values[complete, k] for k, c in enumerate(part.columns)}
        draft.topics[clock] = LogTopic(stamps[complete], {**fields, **named_columns})
        draft.sources.append(LogSource(name, clock, tuple(named_columns)))
    for name, value in plan.settings.items():
        draft.settings[name] = LogSetting(_map_setting(name, value), _SETTING_UNITS[name], "map")
    if draft.is_down and "rotor_positions" in draft.settings:
        setting = draft.settings["rotor_positions"]
        draft.settings["rotor_positions"] = setting._replace(value=setting.value * _VECTOR + 0.0)
    return draft


def _map_setting(name: str, value: Any) -> Any:
    """Number or array of a setting of the map."""
    if name not in _SETTING_UNITS:
        hint = nearest_names(name, _SETTING_UNITS)
        raise SettingError(f"The map has an unknown setting {quote_name(name)}.{hint}")
    shape = {"rotor_positions": 2, "rotor_spin": 1}.get(name, 0)
    try:
        numbers = np.array(value, float)
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    fits = numbers.ndim == shape and numbers.shape[1:] in ((), (3,))
    if not (fits and np.all(np.isfinite(numbers))):
        kind = ("a number", "a list of numbers", "a list of points [x, y, z]")[shape]
        raise SettingError(f"The setting {name} must be {kind}, but it is {format_value(value)}.")
    if _SETTING_UNITS[name] == "Hz" and not numbers > 0:
        raise SettingError(f"The setting {name} must be positive, but it is {numbers:g} Hz.")
    return numbers if shape else float(numbers)


def _size_of_unit(entry: str | None, unit: str, name: str) -> float:
    """Size of a unit of the header or the map in the channel's own one."""
    sizes = UNITS[unit]
    if entry in sizes or (not entry and unit == "1"):
        return float(sizes[entry or "1"])
    fault = f"has the unit {quote_name(entry)}" if entry else "has no unit"
    raise SettingError(f"Column {quote_name(name)} {fault}; valid are {', '.join(sizes)}.")


def _default_map(heads: Sequence[str]) -> dict[str, Any]:
    """Map of a header with this package's names: t, accelerometer.x and so on."""
    names = [split_unit(head)[0] for head in heads]
    time = next((name for name in names if name.lower() in ("t", "time", "timestamp")), None)
    channels = {}
    for channel, quantity in QUANTITIES.items():
        listed = [name for name in names if name == channel or name.startswith(f"{channel}.")]
        ordered = [f"{channel}.{c}" for c in quantity.columns if f"{channel}.{c}" in listed]
        if listed:
            channels[channel] = {"columns": ordered or listed}
    return {"time": {"column": time}, **channels} if time and channels else {}


DECODERS = {
    b"ULog\x01\x12\x35": _decode_ulog,
    b"\xa3\x95": _decode_bin,
    b"\xbc": _decode_crazyflie,
}
FOREIGN_FORMATS = {
    b"H Product:": "a blackbox log of Betaflight",
    b"#ROSBAG": "a ROS bag",
    b"\x89MCAP": "an MCAP file",
    b"\x89HDF": "an HDF5 file",
}
