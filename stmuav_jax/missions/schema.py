"""Schema of a mission's file, format 1: names, types and ranges of all its entries.

docs/missions.md lists them. Angles in a mission's file are in degrees, all else in SI units.
"""

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from ..checks.schema import Count, Entries, Finite, Positive, Tuples, shown
from ..files.model_schema import Size, Triple
from ..montecarlo.schema import MOST_STEPS, Drawing, Factor, Name, Seed

MISSION_FORMAT = 1
# Longest flight [s]: its samples are kept in memory.
LONGEST = 3600.0

NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]
PanelAngles = Annotated[tuple[Finite, Finite], Tuples]


def _format(value: int) -> int:
    if value != MISSION_FORMAT:
        raise ValueError(
            f"is {shown(value)}, but this version reads format {MISSION_FORMAT} alone."
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


class InstrumentEntry(Entries):
    """Entry for an instrument: rate [Hz], noise and bias in its own units, delay [s]."""

    rate: Positive | None = None
    noise: Size | None = None
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


class PayloadEntry(Entries):
    """Entry for a payload: a point mass [kg] on the panel, at a position from the panel's centre of mass
    in its axes [m]."""

    mass: Positive
    position: Triple


class ControllerEntry(Entries):
    """Entry for the controller; the limits of the rotor speeds are in rad/s, the largest force of each of
    the tracker's actuators in N.

    Of the payload it knows nothing, or all, or it estimates it.
    """

    gains: GainsEntry = GainsEntry()
    lowest: NotNegative | None = None
    highest: Positive | None = None
    force: Positive | None = None
    servo: ServoEntry | None = None
    feedforward: bool | None = None
    payload: Literal["unknown", "estimated", "known"] = "unknown"


class PointEntry(Entries):
    """Entry for a waypoint: time [s], position [m], heading [degrees]."""

    t: Finite
    position: Triple
    heading: Finite = 0.0


class PathEntry(Entries):
    """Entry for the path: a place to hold, waypoints, or a constant acceleration [m/s^2]."""

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


class MoveEntry(Entries):
    """Entry for a move of the panel: to angles [degrees] in the base's axes, to a direction of the
    world, or to the sun; begun at a time [s], done after a duration [s]. Its shape has the coefficients
    of `stmuav_jax.control.Slew`."""

    angles: PanelAngles | None = None
    direction: Triple | None = None
    sun: SunEntry | None = None
    at: NotNegative = 0.0
    duration: Positive = 1.0
    shape: Annotated[tuple[Finite, ...], Tuples] = ()


class ChangeEntry(Entries):
    """Entry for a change of the wind to another velocity [m/s], over a time [s]."""

    to: Triple
    at: NotNegative
    rise: Positive = 0.2


class GustsEntry(Entries):
    """Entry for Dryden gusts that pass at the steady wind's speed."""

    seed: Seed = 0
    height: Positive | None = None
    speed_20ft: Positive | None = None


class WindEntry(Entries):
    """Entry for the wind: steady velocity, world [m/s], a change of it, gusts about it."""

    steady: Triple = (0.0, 0.0, 0.0)
    change: ChangeEntry | None = None
    gusts: GustsEntry | None = None


class PushEntry(Entries):
    """Entry for sinusoidal forces on both sliders [N], which the controller does not know."""

    force: Finite
    angular_frequency: Positive


class FaultEntry(Entries):
    """Entry for a fault: a rotor keeps a share of its thrust, or a slider jams, from a time [s] on.

    Of a rotor that is lost altogether the controller may be told: it is `known`.
    """

    rotor: Count | None = None
    share: Share | None = None
    slider: Literal[2, 3] | None = None
    known: bool = False
    at: NotNegative


class BatteryEntry(Entries):
    """Entry for the battery; what is left out is of the table `ENERGY`."""

    state_of_charge: Annotated[float, Field(gt=0, le=1)] = 1.0
    capacity: Positive | None = None
    resistance: NotNegative | None = None
    reserve: Annotated[float, Field(ge=0, lt=1)] | None = None


class TolerancesEntry(Entries):
    """Entry for what the verdict allows: the largest errors from a time [s] on, the largest speed at
    which a landing gear touches down [m/s], and its deepest sink into the ground [m].

    The panel's may have a time of its own, `panel_after`; by default it is `after`.
    """

    after: NotNegative = 0.0
    panel_after: NotNegative | None = None
    position: Positive | None = None
    tilt: Positive | None = None
    panel: Positive | None = None
    touchdown: Positive | None = None
    sink: Positive | None = None


class MissionFile(Entries):
    """Entries of a mission."""

    format: Annotated[int, AfterValidator(_format)]
    name: Name
    title: str = ""
    t1: Annotated[float, Field(gt=0, le=LONGEST)]
    machine: MachineEntry
    rates: RatesEntry = RatesEntry()
    sensors: SensorsEntry | None = None
    controller: ControllerEntry = ControllerEntry()
    payload: PayloadEntry | None = None
    path: PathEntry = PathEntry()
    panel: Annotated[tuple[MoveEntry, ...], Tuples] = ()
    wind: WindEntry | None = None
    push: PushEntry | None = None
    faults: Annotated[tuple[FaultEntry, ...], Tuples] = ()
    battery: BatteryEntry | None = None
    tolerances: TolerancesEntry = TolerancesEntry()


class MissionStudyFile(Drawing):
    """Entries of a Monte Carlo study of a mission, which is a ready one or a file beside the study's.

    Its end `t1` [s] takes the place of the mission's.
    """

    kind: Literal["missions"]
    name: Name = "missions"
    mission: str
    t1: Annotated[float, Field(gt=0, le=LONGEST)] | None = None
    factors: Annotated[dict[str, Factor], Field(min_length=1, max_length=1000)]
    samples: Count | None = None
    chunk: Annotated[int, Field(ge=1, le=MOST_STEPS)] | None = None
