"""Schema of a mission's file, format 1: names, types and ranges of all its entries.

docs/control_and_missions.md lists them. Angles in a mission's file are in degrees, all else in SI units.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from ..checks.schema import (
    Count,
    Entries,
    Finite,
    Name,
    NotNegative,
    Positive,
    Seed,
    Triple,
    Tuples,
    format_value,
)
from ..io.air_entries import BatteryEntry, WindEntry
from ..io.model_schema import Size
from ..studies.schema import MissionStudyFile as MissionStudyFile

MISSION_FORMAT = 1
# Longest flight [s]: its samples are kept in memory.
LONGEST = 3600.0

Share = Annotated[float, Field(ge=0, le=1)]
PanelAngles = Annotated[tuple[Finite, Finite], Tuples]


def _check_format(value: int) -> int:
    if value != MISSION_FORMAT:
        raise ValueError(
            f"is {format_value(value)}, but this version reads format {MISSION_FORMAT} alone."
        )
    return value


class MachineEntry(Entries):
    """Entry for the machine: a scene with its options, or a model's file."""

    scene: Literal["hexacopter", "uav_tracker"] | None = None
    model: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    parameters: dict[str, Any] = Field(default_factory=dict)


class RatesEntry(Entries):
    """Entry for the control rate [Hz], the steps in a period, and the delay of the inputs [s]."""

    control: Positive = 400.0
    steps: Count = 1
    delay: NotNegative = 0.0


def _not_negative(value: Size | None) -> Size | None:
    if value is not None and min(value if isinstance(value, tuple | list) else (value,)) < 0:
        raise ValueError(
            f"must not be negative, but it is {format_value(value)}: it is a deviation."
        )
    return value


class InstrumentEntry(Entries):
    """Entry for an instrument: rate [Hz], noise and bias in its own units, delay [s]."""

    rate: Positive | None = None
    noise: Annotated[Size | None, AfterValidator(_not_negative)] = None
    bias: Size | None = None
    delay: NotNegative | None = None


class SensorsEntry(Entries):
    """Entry for the instruments, which feed an estimator; see `machine.INSTRUMENTS` for defaults.

    They read for a time of `standing` [s] before the flight, while the machine is held at its start.
    """

    seed: Seed = 0
    standing: NotNegative = 3.0
    gyroscope: InstrumentEntry = InstrumentEntry()
    accelerometer: InstrumentEntry = InstrumentEntry()
    position: InstrumentEntry = InstrumentEntry()
    attitude: InstrumentEntry = InstrumentEntry()
    encoders: InstrumentEntry | None = None


class GainsEntry(Entries):
    """Entry for the gains of the flight controller, as those of `FlightGains`."""

    position: Positive | None = None
    velocity: Positive | None = None
    integral: NotNegative | None = None
    attitude: Positive | None = None
    rate: Positive | None = None


class ServoEntry(Entries):
    """Entry for the panel's servo: computed torque of the angles, or plain control of the strokes."""

    kind: Literal["computed_torque", "strokes"] = "computed_torque"
    frequency: Positive | None = None
    damping: Positive | None = None
    stiffness: Positive | None = None


class JointServoEntry(Entries):
    """Entry for the servo of a joint that an effort drives, see `stmuav_jax.uav.JointGains`: computed torque
    with frequency [rad/s] and damping ratio [1], or PD with stiffness and damping in the joint's units."""

    kind: Literal["computed_torque", "pd"] = "computed_torque"
    frequency: Positive | None = None
    damping: NotNegative | None = None
    stiffness: Positive | None = None


class PayloadEntry(Entries):
    """Entry for a payload: a point mass [kg] on the panel, at a position from the panel's centre of mass
    in its axes [m]."""

    mass: Positive
    position: Triple


class CarriedEntry(Entries):
    """Entry for a payload that is picked up, or dropped: a point mass [kg] on a body, at a position from its
    centre of mass in its axes [m], from a time [s] on or until one. The controller's model omits it."""

    body: str
    mass: Positive
    position: Triple = (0.0, 0.0, 0.0)
    at: NotNegative = 0.0
    until: Positive | None = None


class ControllerEntry(Entries):
    """Entry for the controller; the limits of the rotor speeds are in rad/s, the largest force of each of
    the tracker's actuators in N.

    Its model omits the payload, contains it, or estimates it.
    """

    gains: GainsEntry = GainsEntry()
    lowest: NotNegative | None = None
    highest: Positive | None = None
    force: Positive | None = None
    servo: ServoEntry | None = None
    joints: dict[str, JointServoEntry] = Field(default_factory=dict)
    feedforward: bool | None = None
    payload: Literal["unknown", "estimated", "known"] = "unknown"


class PointEntry(Entries):
    """Entry for a waypoint: time [s], position [m], heading [degrees]."""

    t: Finite
    position: Triple
    heading: Finite = 0.0


class PathEntry(Entries):
    """Entry for the path: a place to hold, waypoints, or a constant acceleration [m/s^2].

    It begins where the machine starts, or elsewhere with a `step`.
    """

    step: bool = False
    position: Triple | None = None
    heading: Finite | None = None
    waypoints: Annotated[tuple[PointEntry, ...], Tuples] | None = None
    acceleration: Triple | None = None


class SunEntry(Entries):
    """Entry for the sun of a place [degrees, m] on a date from an hour of local time on.

    The sun moves `speed` times as fast as it does.
    """

    lat: Annotated[float, Field(ge=-90, le=90)]
    lon: Annotated[float, Field(ge=-360, le=360)]
    date: str
    hour: Annotated[float, Field(ge=0, lt=24)]
    timezone: str | None = None
    altitude: Annotated[float, Field(ge=-500, le=11000)] = 0.0
    speed: Annotated[float, Field(ge=0, le=3600)] = 1.0


class TimedEntry(Entries):
    """Entries for a move that begins at a time [s] and is done after a duration [s], with the coefficients of
    `stmuav_jax.control.Slew` as its shape."""

    at: NotNegative = 0.0
    duration: Positive = 1.0
    shape: Annotated[tuple[Finite, ...], Tuples] = ()


class MoveEntry(TimedEntry):
    """Entry for a move of the panel: to angles [degrees] in the base's axes, to a direction of the
    world, or to the sun."""

    angles: PanelAngles | None = None
    direction: Triple | None = None
    sun: SunEntry | None = None


class JointMoveEntry(TimedEntry):
    """Entry for a move of a driven joint of a model: to a value [degrees] or [m]."""

    joint: str
    to: Finite


class PushEntry(Entries):
    """Entry for sinusoidal forces on both sliders [N], which are not in the controller's model."""

    force: Finite
    angular_frequency: Positive


class FaultEntry(Entries):
    """Entry for a fault: a rotor keeps a share of its thrust, a slider jams, or a sensor fails, from a time [s] on.

    A rotor may have several, one after the other; each share is one of the whole thrust.
    Of a rotor that is lost altogether the controller may be told: it is `known`. A sensor gives no readings,
    or, with a `bias` in its units, readings with that error more, `until` a time [s] or for good.
    """

    rotor: Count | None = None
    share: Share | None = None
    slider: Literal[2, 3] | None = None
    sensor: Literal["gyroscope", "accelerometer", "position", "attitude", "encoders"] | None = None
    bias: Size | None = None
    known: bool = False
    at: NotNegative
    until: Positive | None = None


class FlightBatteryEntry(BatteryEntry):
    """Entry for the battery of a flight; what is left out is the model's, else of the table `ENERGY`."""

    state_of_charge: Annotated[float, Field(gt=0, le=1)] = 1.0


class TolerancesEntry(Entries):
    """Entry for what the verdict allows: the largest errors from a time [s] on, the largest speed at
    which a landing gear touches down [m/s], and its deepest sink into the ground [m].

    The panel's may have a time of its own, `panel_after`; by default it is `after`. Those of joints are by
    name, in [degrees] or [m].
    """

    after: NotNegative = 0.0
    panel_after: NotNegative | None = None
    position: Positive | None = None
    tilt: Positive | None = None
    panel: Positive | None = None
    joints: dict[str, Positive] = Field(default_factory=dict)
    touchdown: Positive | None = None
    sink: Positive | None = None


class MissionFile(Entries):
    """Entries of a mission."""

    format: Annotated[int, AfterValidator(_check_format)]
    name: Name
    title: str = ""
    t1: Annotated[float, Field(gt=0, le=LONGEST)]
    machine: MachineEntry
    truth: dict[str, Finite] = Field(default_factory=dict)
    rates: RatesEntry = RatesEntry()
    sensors: SensorsEntry | None = None
    controller: ControllerEntry = ControllerEntry()
    payload: PayloadEntry | None = None
    path: PathEntry = PathEntry()
    panel: Annotated[tuple[MoveEntry, ...], Tuples] = ()
    joints: Annotated[tuple[JointMoveEntry, ...], Tuples] = ()
    wind: WindEntry | None = None
    push: PushEntry | None = None
    faults: Annotated[tuple[FaultEntry, ...], Tuples] = ()
    payloads: Annotated[tuple[CarriedEntry, ...], Tuples] = ()
    battery: FlightBatteryEntry | None = None
    tolerances: TolerancesEntry = TolerancesEntry()
