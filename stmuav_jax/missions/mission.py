"""Missions from TOML files: read, checked before the flight, and prepared to fly."""

import dataclasses
import itertools
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.sensors import gravity_of
from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import as_floats
from ..checks.schema import SHOWN, validate_model
from ..control.closed_loop import inspect_plant
from ..control.instruments import whole_periods
from ..control.plant import Plant
from ..io.air_entries import BatteryEntry
from ..io.netcdf import FileError, read_toml
from ..math.compiler import quick_jit
from ..math.derivative import motion_along
from ..math.rotation import rotation_matrix
from ..math.sampled import Sampled
from ..mechanics.forces import GroundContact
from ..mechanics.parameters import Parameters
from ..mechanics.state import State
from ..uav.adaptation import AdaptiveController
from ..uav.airframe import ENERGY
from ..uav.battery import Battery
from ..uav.environment.calendar import day_zone, local_time, parse_date
from ..uav.environment.ephemeris import Place
from ..uav.environment.sun import sun_position
from ..uav.flight_controller import BaseMotion, attitude_of, base_motion, feet_of
from ..uav.joint_controller import JointController, read_joints
from ..uav.panel_servo import PanelBodies, StrokeServo, inverse_dynamics, panel_bodies, panel_motion
from ..uav.stability import MARGINAL, flight_of, make_hover, scale_pilot
from ..uav.tracker.geometry import tracker_geometry
from ..uav.tracker.kinematics import PairMotion, Reason, panel_angles, panel_normal
from ..uav.tracker.workspace import survey, why_outside
from .controller import (
    AT_ONCE,
    HeldPath,
    JointMoves,
    MissionController,
    PanelMoves,
    Pilot,
    References,
    WaypointPath,
)
from .machine import (
    BEYOND,
    Machine,
    WithoutPayload,
    check_faults,
    check_instruments,
    controller_of,
    input_names,
    machine_of,
    payloads_of,
    plant_of,
)
from .schema import MissionFile, MoveEntry, PathEntry, TimedEntry
from .signals import Gauges
from .truth import FlightBattery, Truth, apply_truth, list_truth_parameters, make_truth

LIBRARY = Path(__file__).parent / "library"
_DEGREE = math.pi / 180
# Longest time of the sun between samples of it [s].
_SUN_STEP = 600.0
# Factor by which small motions may grow in a second: slower growth, which drag may damp, is flown, and the
# verdict says it. Shares of the gains' frequencies that are tried for a loop that is unstable.
_FASTEST_GROWTH, _FACTORS = 10.0, np.geomspace(0.98, 0.02, 100)
# Steps of a reference that count as none: in position, velocity and rates [m, m/s, rad/s], in heading
# [degrees].
_STEP, _STEP_ANGLE = 1e-3, 0.1


@dataclass(frozen=True)
class Mission:
    """Mission that is ready to fly.

    Attributes:
        file: its entries, with defaults filled in. machine: scene, rotors, tracker.
        truth: plant, signals and battery, with the true parameters. table: these parameters.
        controller: controller with faults. references: function of t [s].
        growth: factor by which small motions about hover grow in a second; up to 1 for a stable loop.
        folder: folder of the model's file.
    """

    file: MissionFile
    machine: Machine
    truth: Truth
    table: Parameters
    controller: MissionController
    references: References
    growth: float = 0.0
    folder: Path = Path()

    @property
    def plant(self) -> Plant:
        """Sampled plant."""
        return self.truth.plant

    @property
    def gauges(self) -> Gauges:
        """Function of a `Sample` that returns the signals."""
        return self.truth.gauges

    @property
    def battery(self) -> Battery | None:
        """Battery that ends the flight when it is empty, or None."""
        return None if self.truth.battery is None else self.truth.battery.battery

    @property
    def samples(self) -> int:
        """Number of samples, the first at t = 0 and the last at the end."""
        return whole_periods(self.file.t1, self.plant.rate, "The time of the flight") + 1


def mission_names() -> tuple[str, ...]:
    """Names of the missions that come with the package."""
    return tuple(sorted(path.stem for path in LIBRARY.glob("*.toml")))


def load_mission(
    source: str | os.PathLike[str],
    *,
    t1: float | None = None,
    true_states: bool = False,
    truth: Mapping[str, float] | None = None,
) -> Mission:
    """Mission from a TOML file, or one of `mission_names` by name.

    Args:
        t1: end of the flight [s] in place of the file's.
        true_states: leave the mission's sensors out, so that the controller receives the true states.
        truth: parameters of the true machine that differ from the controller's model, in addition to the file's
            `truth`, by the names of factors of a mission's study.

    Raises:
        FileError: the file is missing or not valid TOML; an entry is unknown, missing or out of
            range; the machine cannot fly; or a reference is out of the machine's reach. The message
            names the file.
        SettingError: an unknown name.
    """
    text = os.fspath(source)
    path = Path(text)
    if path.suffix != ".toml" and os.sep not in text:
        if text not in mission_names():
            raise SettingError(
                f"There is no mission '{text[:SHOWN]}'.{nearest_names(text[:SHOWN], mission_names())} "
                "A file's name ends in .toml."
            )
        path = LIBRARY / f"{text}.toml"
    content: dict[str, Any] = {"name": path.stem} | read_toml(path)
    if "bodies" in content:
        raise FileError(
            f'{path} is a model, not a mission: a mission names it with model = "{path.name}" in its '
            "table [machine] (docs/control_and_missions.md)."
        )
    if t1 is not None:
        content["t1"] = t1
    if true_states:
        content.pop("sensors", None)
    if truth:
        content["truth"] = {**content.get("truth", {}), **truth}
    try:
        return make_mission(content, path.parent)
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{path}: {error}") from error


def make_mission(plain: Mapping[str, Any], folder: str | os.PathLike[str] = ".") -> Mission:
    """Mission from plain data, such as those of a TOML file.

    Args:
        folder: folder from which a model's file is looked for.

    Raises:
        SettingError: an entry is unknown, missing or out of range, or a reference is out of reach.
        ModelError, StateError: invalid parameters of the machine.
    """
    entries = validate_model(MissionFile, plain, "A mission")
    # what the entries tell alone, before anything is compiled
    whole_periods(entries.t1, entries.rates.control, "The time of the flight")
    whole_periods(entries.rates.delay, entries.rates.control, "The delay of the inputs")
    check_faults(entries)
    check_instruments(entries)
    _check_moves(entries)
    battery = _make_battery(entries) if entries.machine.model is None else None
    machine = machine_of(entries, Path(folder))
    if machine.model is not None:
        battery = _make_battery(entries, machine.model.file.battery)
    # From here on numbers are computed; the entries by themselves are consistent.
    plant = inspect_plant(plant_of(entries, machine))
    panel = _make_moves(entries, machine) if machine.bodies is not None else None
    has_gear = any(isinstance(force, GroundContact) for force in plant.system.forces)
    for name in ("touchdown", "sink"):
        if getattr(entries.tolerances, name) is not None and not has_gear:
            raise SettingError(
                f"'tolerances.{name}' needs a landing gear, which this machine does not have: add "
                "'options.gear = {}' to [machine]."
            )
    gauges = Gauges(machine, plant.system, payloads_of(entries, machine.scene))
    believed = Truth(plant, gauges, machine.speeds, battery)
    table = apply_truth(entries, machine, list_truth_parameters(entries, machine, battery))
    controller = controller_of(entries, machine, plant)
    path, joints = _make_path(entries.path, machine), _joint_moves(entries, machine)
    mission = Mission(
        entries, machine, believed, table, controller, References(path, panel, joints), folder=Path(folder)
    )  # fmt: skip
    assert mission.samples > 1
    # Checks go from cheap to expensive: the start, thrusts along the path, the linear loop, and
    # last the panel's workspace, which compiles the kinematics.
    _check_start(mission)
    _check_thrust(mission)
    mission = dataclasses.replace(mission, growth=_check_stability(mission))
    if panel is not None:
        _check_panel(mission)
        check_forces(entries, machine, mission.references)
    if not entries.truth:
        return mission
    # Checks are of the mission as the controller has it; from here on the truth flies.
    return dataclasses.replace(mission, truth=make_truth(entries, machine, believed, table))


def _check_moves(mission_file: MissionFile) -> None:
    """Raise `SettingError` for moves of the panel of two kinds, or moves that do not follow one another."""
    kinds = set()
    for move in mission_file.panel:
        goals = [name for name in ("angles", "direction", "sun") if getattr(move, name) is not None]
        # Angles turn with the base, and directions are of the world: one path between both is not defined.
        if len(goals) != 1:
            raise SettingError(
                "A move of the panel needs one of angles, direction and sun, but it has "
                f"{' and '.join(goals) or 'none'}."
            )
        kinds.add(goals[0] != "angles")
    if len(kinds) == 2:
        raise SettingError(
            "The moves of the panel must all be to angles in the base's axes, or all to directions "
            "of the world and the sun."
        )
    moves: dict[str, list[TimedEntry]] = {"the panel": [*mission_file.panel]}
    for move in mission_file.joints:
        moves.setdefault(f"joint '{move.joint[:SHOWN]}'", []).append(move)
    for subject, of_subject in moves.items():
        for k, (first, second) in enumerate(itertools.pairwise(of_subject), 1):
            if second.at < first.at + first.duration - AT_ONCE:
                raise SettingError(
                    f"The moves of {subject} must follow one another, but move {k + 1} begins at t = {second.at:g} s, "
                    f"before the end of move {k} at {first.at + first.duration:g} s: list them by their times, and "
                    "give each its time."
                )


def _make_path(entry: PathEntry, machine: Machine) -> HeldPath | WaypointPath:
    """Path; by default the one that holds the place of the start."""
    if entry.waypoints is not None:
        if (entry.position, entry.heading, entry.acceleration) != (None, None, None):
            raise SettingError(
                "'path' must have either waypoints or a position, heading and acceleration, and not both."
            )
        ts = np.array([point.t for point in entry.waypoints])
        rows = [(*point.position, _DEGREE * point.heading) for point in entry.waypoints]
        return WaypointPath(ts, np.array(rows).reshape(len(ts), 4))
    start = base_motion(machine.scene.state0)
    r = start.r if entry.position is None else entry.position
    a = (0.0, 0.0, 0.0) if entry.acceleration is None else entry.acceleration
    yaw = _base_heading(start) if entry.heading is None else _DEGREE * entry.heading
    return HeldPath(*(jnp.asarray(x, dtype=float) for x in (r, a, yaw)))


def _base_heading(base: BaseMotion) -> float:
    """Heading of a base [rad]."""
    x, y = np.asarray(base.R)[:2, 0]
    return math.atan2(y, x)


def _check_start(mission: Mission) -> None:
    """Raise `SettingError` for references that begin elsewhere than the machine does.

    The path of a machine that stands on the ground may begin below it.
    """
    if mission.file.path.step:
        return
    state = mission.machine.scene.state0
    base, goal = base_motion(state), _evaluate_path(mission.references.path, as_floats(np.zeros(1)))
    r, v = np.asarray(goal.r)[0], np.asarray(goal.v)[0]
    # A reference that begins with a step is answered by a jump of the commands, and counts as an
    # error of the controller.
    offset, velocity_step = r - np.asarray(base.r), np.asarray(base.v) - v
    feet = feet_of(mission.plant.system)
    # A machine on its feet may stand lower than its path by the springs' deflection.
    if feet is not None and offset[2] < 0:
        heights = np.asarray(base.r[2] + feet.places @ base.R[2] - feet.ground)
        offset = offset * [1.0, 1.0, 0.0] if np.min(heights) < _STEP else offset
    yaw, heading = _base_heading(base) / _DEGREE, float(goal.heading[0]) / _DEGREE
    heading_step, omega = math.remainder(heading - yaw, 360.0), np.asarray(base.omega)
    rates = np.zeros(2) if mission.machine.bodies is None else np.asarray(panel_motion(state).rate)
    steps = [
        (offset, _STEP, "m", f"the path begins at {_text(r)} m and the machine at {_text(base.r)} m"),
        (heading_step, _STEP_ANGLE, "degrees", f"the path begins with a heading of {heading:.4g} degrees and the "
         f"machine with {yaw:.4g} degrees"),
        (velocity_step, _STEP, "m/s", f"the path begins with {_text(v)} m/s and the machine with {_text(base.v)} m/s"),
        (omega, _STEP, "rad/s", f"the machine begins with angular velocities of {_text(omega)} rad/s"),
        (rates, _STEP, "rad/s", f"the panel begins with angular rates of {_text(rates)} rad/s"),
    ]  # fmt: skip
    for step, most, unit, places in steps:
        size = float(np.linalg.norm(step))
        if size > most:
            raise SettingError(
                f"The reference begins with a step of {size:.4g} {unit}: {places}. Let it begin where the machine "
                "does ('machine.options.start' moves the machine), or allow the step by "
                "'path.step = true'."
            )


def _text(values: Any) -> str:
    return f"({', '.join(f'{float(x):.4g}' for x in np.asarray(values))})"


def _make_moves(entries: MissionFile, machine: Machine) -> PanelMoves:
    """Moves of the panel, the first of them from its place at the start."""
    state = machine.scene.state0
    angles = panel_motion(state).value
    # Moves in the world go on from the direction of the panel's normal at the start, moves of
    # angles from the angles.
    world = bool(entries.panel) and entries.panel[0].angles is None
    start = _panel_normal(state, angles) if world else angles
    targets = [_move_target(move, entries.t1) for move in entries.panel]
    return _follow_moves(start, targets, entries.panel, world)


def _follow_moves(
    start: Any, targets: Sequence[Any], moves: Sequence[TimedEntry], world: bool
) -> PanelMoves:
    """Moves to the targets with the times and shapes of their entries."""
    ats, durations = (
        tuple(jnp.asarray(getattr(move, name)) for move in moves) for name in ("at", "duration")
    )
    shapes = tuple(jnp.asarray(move.shape, dtype=float) for move in moves)
    return PanelMoves(start, tuple(targets), ats, durations, world, shapes)


@quick_jit
def _panel_normal(state: State, angles: Float[Array, "2"]) -> Float[Array, "3"]:
    """Normal of the panel in the world."""
    return rotation_matrix(state.p[0]) @ panel_normal(angles)


def _move_target(move: MoveEntry, t1: float) -> Any:
    """Target of a move: angles (2,) [rad], a direction of the world (3,), or a function of t [s] for the sun's."""
    if move.angles is not None:
        return _DEGREE * jnp.asarray(move.angles)
    if move.direction is not None:
        length = float(np.linalg.norm(move.direction))
        if length == 0.0:
            raise SettingError("A direction for the panel has zero length; give any vector to it.")
        return jnp.asarray(move.direction) / length
    entry = move.sun
    assert entry is not None
    zone = day_zone(entry.timezone, entry.lon)
    begin = local_time(parse_date(entry.date), entry.hour, zone)
    place = Place.degrees(entry.lat, entry.lon, entry.altitude)
    # A little longer than the flight, as the last samples of a chunk lie beyond its end.
    end = t1 + BEYOND
    ts = np.linspace(0.0, end, max(8, math.ceil(end * entry.speed / _SUN_STEP) + 1))
    # The sun is slow: samples ten minutes apart and a spline of fifth degree are exact to micro-radians.
    sun = sun_position(begin.timestamp() + entry.speed * ts, place)
    down = ~np.asarray(sun.is_up) & (ts <= t1)
    if np.any(down):
        k = int(np.argmax(down))
        # by way of UTC, because the clocks may change during the flight
        when = datetime.fromtimestamp(begin.timestamp() + float(entry.speed * ts[k]), zone)
        raise SettingError(
            f"The sun is {-math.degrees(float(sun.elevation[k])):.3g} degrees below the horizon at "
            f"{entry.lat:g} degrees north, {entry.lon:g} east on {when.isoformat(timespec='seconds')}, "
            f"t = {ts[k]:.4g} s of the flight: there is nothing to point at. Is the time zone right?"
        )
    return Sampled(ts, np.asarray(sun.s_w).T)


def _joint_moves(entries: MissionFile, machine: Machine) -> JointMoves | None:
    """Moves of a model's driven joints, from their targets or from where they are at the start."""
    if not machine.joints:
        return None
    system = machine.scene.system
    forces: Any = system.forces
    values = np.asarray(read_joints(system, machine.joints, machine.scene.state0)[0])
    moves = []
    for drive, value in zip(machine.joints, values, strict=True):
        of_joint = [move for move in entries.joints if move.joint == drive.name]
        unit = _DEGREE if drive.kind == "angle" else 1.0
        # A servo holds its target, from which a loaded joint differs by the load over the
        # stiffness: the reference goes on from there without a step.
        start = as_floats([value if drive.is_effort else forces[drive.force].target])
        targets = [as_floats([unit * move.to]) for move in of_joint]
        moves.append(_follow_moves(start, targets, of_joint, False))
    return JointMoves(tuple(moves))


def _make_battery(
    entries: MissionFile, of_model: BatteryEntry | None = None
) -> FlightBattery | None:
    if entries.battery is None:
        return None
    battery_values = {} if of_model is None else of_model.model_dump(exclude_none=True)
    battery_values |= entries.battery.model_dump(exclude_none=True, exclude={"state_of_charge"})
    battery = Battery.of(
        ENERGY.replaced({f"battery.{name}": value for name, value in battery_values.items()})
    )
    charge, reserve = entries.battery.state_of_charge, float(battery.reserve)
    if charge <= reserve:
        raise SettingError(
            f"'battery.state_of_charge' must be above its reserve of {reserve:g}, but it is {charge:g}: the "
            "battery would be empty at the start."
        )
    return FlightBattery(battery, as_floats(charge))


# Compiled once for all missions of a process.
_surveyed = quick_jit(survey)


@quick_jit
def _evaluate_path(path: HeldPath | WaypointPath, ts: Float[Array, " k"]) -> Any:
    """Path at times ts [s]."""
    return jax.vmap(path)(ts)


def _check_thrust(mission: Mission) -> None:
    """Raise `SettingError` for a path whose accelerations the rotors cannot give."""
    machine, speeds = mission.machine, mission.machine.speeds
    ts = as_floats(times_of(mission.file))
    waypoints = _evaluate_path(mission.references.path, ts)
    system = machine.scene.system
    a, gravity = map(np.asarray, (waypoints.a, gravity_of(system)))
    mass, carried = np.sum(np.asarray(system.bodies.mass)), mission.gauges.payloads
    if carried is not None:
        mass = mass + np.array([np.sum(np.asarray(carried.masses(float(t)))) for t in ts])
    # Rotors push along their own axis only: a path that falls faster than gravity would need them upside
    # down.
    lift = (gravity - a) @ gravity
    if np.any(lift <= 0):
        k = int(np.argmax(lift <= 0))
        raise SettingError(
            f"The path needs a thrust that points downwards at t = {float(ts[k]):.4g} s, where it accelerates by "
            f"{_text(a[k])} m/s^2: rotors cannot push down. Give it an acceleration above free fall, or more time."
        )
    if speeds is None:
        return
    # Moments need a margin beyond this, which depends on gusts and errors: only what no controller
    # could fly is refused.
    needed = mass * np.linalg.norm(a - gravity, axis=1)
    limits = speeds.squared(machine.rotors.spin.shape[0])
    least, most = (float(jnp.sum(machine.rotors.thrusts(x))) for x in limits)
    beyond = (needed > most) | (needed < least)
    if np.any(beyond):
        k = int(np.argmax(beyond))
        raise SettingError(
            f"The path needs a thrust of {float(needed[k]):.4g} N at t = {float(ts[k]):.4g} s, but the "
            f"rotors give {least:.4g} to {most:.4g} N within their limits: give it more time."
        )


def _check_stability(mission: Mission) -> float:
    """Factor by which small motions about hover grow in a second, with the mission's gains, rate and delay.

    It raises `SettingError` where this is more than tenfold.
    The controllers for lost rotors are checked too, as if the machine did not turn. The
    estimator, limits and drag are left out.
    """
    controller = mission.controller
    pilots = [controller.pilot, *(change.pilot for change in controller.pilot_changes)]
    return max(_check_pilot(mission, pilot) for pilot in pilots)


def _check_pilot(mission: Mission, pilot: Pilot) -> float:
    """Growth of small motions in a second with one of the controllers of `_check_stability`."""
    machine, plant = mission.machine, mission.plant
    pilot = pilot.controller if isinstance(pilot, AdaptiveController) else pilot
    system, start, observe = machine.scene.system, machine.scene.state0, None
    if machine.nominal is not None:
        observe = WithoutPayload(system, machine.nominal)
    hover = make_hover(system, start, input_names(machine), pilot, plant.rate, observe)
    # The machine is linearised once; delays and gains only close the loop anew.
    make_loop = lambda delay, pilot=pilot: hover.close(pilot, delay)
    is_stable = lambda loop: loop.compute_spectral_radius() <= 1 + MARGINAL
    loop, period = make_loop(plant.late), 1e3 / plant.rate
    radius = loop.compute_spectral_radius()
    # Stability of the linear loop in hover is a necessary condition.
    if radius <= _FASTEST_GROWTH ** (1 / plant.rate):
        return 1.0 if radius <= 1 + MARGINAL else float(radius**plant.rate)
    of_joints, advice = loop.compute_joint_share() > 0.5, []
    # The message gives numbers that work, found by scaling the closed loop's frequency.
    faster = lambda x: scale_pilot(pilot, x, of_joints)
    factor = next((x for x in _FACTORS if is_stable(make_loop(plant.late, faster(x)))), None)
    if factor is not None:
        entry = _gains_entry(faster(factor), of_joints)
        advice.append(f"with this delay, [controller] {entry} is about the fastest that is stable")
    delay = next((d for d in range(plant.late - 1, -1, -1) if is_stable(make_loop(d))), None)
    if delay is not None:
        advice.append(f"with these gains, a delay of {delay * period:g} ms is stable")
    advice_text = "; ".join(advice) or "no slower gains are stable at this rate"
    loop_name = "panel's servo" if machine.bodies is not None else "joints"
    loop_name = loop_name if of_joints else "position and attitude"
    working = flight_of(pilot).working
    if working is not None:
        count = machine.rotors.spin.shape[0]
        lost = [str(k + 1) for k in range(count) if k not in working]
        loop_name += f" without rotor{'s' if len(lost) > 1 else ''} {', '.join(lost)}"
    raise SettingError(
        f"The closed loop of the {loop_name} is unstable, without any noise or wind: at {plant.rate:g} Hz, with "
        f"inputs late by {plant.late * period:g} ms ({plant.late} periods), small motions about hover grow by a "
        f"factor of {radius:.4g} in a period. {advice_text[0].upper()}{advice_text[1:]}."
    )


def _gains_entry(pilot: Any, of_joints: bool) -> str:
    """Entry of a mission's controller that gives it these gains."""
    if of_joints and isinstance(pilot, JointController):
        entries = []
        for drive, is_direct, gains in zip(
            pilot.joints, pilot.is_direct, pilot.gains.T, strict=True
        ):
            W, ratio, k, c = map(float, gains)
            if not drive.is_effort:
                continue
            numbers = f'kind = "pd", stiffness = {k:.3g}, damping = {c:.3g}'
            numbers = numbers if is_direct else f"frequency = {W:.3g}, damping = {ratio:.3g}"
            entries.append(f"joints.{drive.name} = {{ {numbers} }}")
        return ", ".join(entries)
    gains = pilot.servo if of_joints else flight_of(pilot).gains
    names = [field.name for field in dataclasses.fields(gains) if field.name != "bodies"]
    numbers = ", ".join(f"{name} = {float(getattr(gains, name)):.3g}" for name in names)
    kind = 'kind = "strokes", ' if isinstance(gains, StrokeServo) else ""
    return f"servo = {{ {kind}{numbers} }}" if of_joints else f"gains = {{ {numbers} }}"


def _check_panel(mission: Mission) -> None:
    """Raise `SettingError` for a panel's reference outside the workspace.

    The base is taken to have the attitude that its path needs.
    """
    machine, references = mission.machine, mission.references
    assert machine.bodies is not None
    assert machine.limits is not None
    assert references.panel is not None
    ts, geometry, limits = times_of(mission.file), machine.bodies.geometry, machine.limits
    angles = _reference_angles(references, gravity_of(mission.plant.system), as_floats(ts))
    result = _surveyed(geometry, as_floats(np.asarray(angles).T), limits)
    reason = np.asarray(result.reason)
    if not np.any(reason):
        return
    k = int(np.argmax(reason != 0))
    margins = jax.tree.map(lambda x: x[..., k], result.margins)
    reason_text = why_outside(geometry, limits, margins, Reason(int(reason[k])))
    phi, theta = np.degrees(np.asarray(angles)[k])
    frame = "a direction of the world" if references.panel.world else "these angles"
    raise SettingError(
        f"The panel cannot follow its reference, {frame}: at t = {ts[k]:.4g} s it would have to stand at "
        f"phi = {phi:.4g} and theta = {theta:.4g} degrees in the base's axes, and {reason_text}"
    )


def _base_pose(
    references: References, gravity: Float[Array, "3"], t: Float[Array, ""]
) -> tuple[Float[Array, "3 3"], Float[Array, "3"]]:
    """Attitude of the base that its path needs, and the acceleration of free fall less its own in its axes."""
    at = references.path(t)
    R = attitude_of(at.a - gravity, at.heading)
    return R, R.T @ (gravity - at.a)


def _panel_angles_at(
    references: References, gravity: Float[Array, "3"], t: Float[Array, ""]
) -> Float[Array, "2"]:
    """Reference of the panel angles; directions of the world are turned into the axes of the base."""
    assert references.panel is not None
    value = references.panel.value(t)
    if not references.panel.world:
        return value
    return panel_angles(_base_pose(references, gravity, t)[0].T @ value)


@quick_jit
def _reference_angles(
    references: References, gravity: Float[Array, "3"], ts: Float[Array, " k"]
) -> Float[Array, "k 2"]:
    """Reference of the panel angles at times ts [s] (k, 2) [rad]."""
    return jax.vmap(lambda t: _panel_angles_at(references, gravity, t))(ts)


# Times of a flight and of each move at which forces are checked.
_OF_FLIGHT, _OF_MOVE = 1001, 101


def check_forces(mission_file: MissionFile, machine: Machine, references: References) -> None:
    """Raise `SettingError` for a reference of the panel that is beyond the actuators.

    The forces are those of the inverse dynamics of the machine with its payload. The base has the
    attitude and the acceleration that its path needs; that it turns is left out, as are friction,
    gusts and pushes, for which a margin must be left.
    """
    if machine.force is None or references.panel is None:
        return
    ts = times_of(mission_file)
    system, shift = machine.scene.system, machine.table.value("mount.shift")
    bodies = panel_bodies(system, tracker_geometry(machine.table), shift)
    forces = np.asarray(needed_forces(bodies, references, gravity_of(system), jnp.asarray(ts)))
    beyond = np.abs(forces) > machine.force
    if not np.any(beyond):
        return
    k = int(np.argmax(np.any(beyond, axis=1)))
    slider = int(np.argmax(np.abs(forces[k])))
    most, late = np.max(np.abs(forces)), int(np.argmax(np.max(np.abs(forces), axis=1)))
    raise SettingError(
        f"The panel cannot follow its reference: at t = {ts[k]:.4g} s slider {slider + 2} needs a force of "
        f"{forces[k, slider]:.4g} N, but its actuator gives at most {machine.force:g} N either way "
        f"('controller.force'). The largest force is {most:.4g} N, at t = {ts[late]:.4g} s: give the move "
        "more time, or another target."
    )


def times_of(mission_file: MissionFile) -> np.ndarray:
    """Times at which references are checked (k,) [s]: of the flight, each move, and between waypoints."""
    spans = [(0.0, mission_file.t1, _OF_FLIGHT)]
    # Moves are short, and points spread over the flight could miss the fastest part of one.
    spans += [(move.at, move.at + move.duration, _OF_MOVE) for move in mission_file.panel]
    points = [point.t for point in mission_file.path.waypoints or ()]
    spans += [(first, second, _OF_MOVE) for first, second in itertools.pairwise(points)]
    # as many for other times, so that nothing is compiled anew
    return np.sort(
        np.clip(np.concatenate([np.linspace(*span) for span in spans]), 0.0, mission_file.t1)
    )


@quick_jit
def needed_forces(
    bodies: PanelBodies,
    references: References,
    gravity: Float[Array, "3"],
    ts: Float[Array, " k"],
) -> Float[Array, "k 2"]:
    """Forces of the actuators along references at times ts [s], by `inverse_dynamics` (k, 2) [N].

    Args:
        gravity: acceleration of free fall (3,) [m/s^2].
    """

    def at_one(t: Array) -> Array:
        motion = PairMotion(*motion_along(lambda t: _panel_angles_at(references, gravity, t), t))
        free_fall = _base_pose(references, gravity, t)[1]
        return inverse_dynamics(bodies, motion, free_fall, jnp.zeros(3)).forces

    return jax.vmap(at_one)(ts)
