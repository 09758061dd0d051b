"""Missions from TOML files: read, checked before the flight, and made ready to fly."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime, time, timedelta
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import rotation_matrix
from ..algebra.sampled import Sampled
from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import floats
from ..checks.schema import SHOWN, checked
from ..control.closed_loop import inspected
from ..control.geometric import attitude_of
from ..control.instruments import whole_periods
from ..control.panel import panel_motion
from ..control.plant import Plant
from ..environment.ephemeris import Place
from ..environment.sun import sun_position
from ..files.netcdf import FileError, read_toml
from ..mechanics.forces.contact import GroundContact
from ..mechanics.state import State
from ..parameters.energy import ENERGY
from ..rotorcraft.battery import Battery
from ..sensing.sensors import gravity_of
from ..tracker.day import day_zone, parse_date
from ..tracker.kinematics import Reason, panel_angles, panel_normal
from ..tracker.pointing import why_outside
from ..tracker.workspace import survey
from .disturbance import MissionController
from .effort import check_forces
from .gauges import Gauges
from .machine import BEYOND, Machine, controller_of, machine_of, plant_of
from .reference import DirectionMotion, HeldPath, PanelMoves, References, WaypointPath
from .schema import MissionFile, MoveEntry, PathEntry, SunEntry

LIBRARY = Path(__file__).parent / "library"
_DEGREE = math.pi / 180
# Times at which references are checked, and longest time of the sun between samples of it [s].
_CHECKED, _SUN_STEP = 1001, 600.0


@dataclass(frozen=True)
class Mission:
    """Mission that is ready to fly.

    Attributes:
        file: its entries, with defaults filled in. machine: scene, rotors, tracker.
        plant: sampled plant. controller: controller with faults. references: function of t [s].
        gauges: function of a `Sample` that returns the signals.
        battery: battery that ends the flight when it is empty, or None.
    """

    file: MissionFile
    machine: Machine
    plant: Plant
    controller: MissionController
    references: References
    gauges: Gauges
    battery: Battery | None

    @property
    def samples(self) -> int:
        """Number of samples, the first at t = 0 and the last at the end."""
        return whole_periods(self.file.t1, self.plant.rate, "The time of the flight") + 1


def mission_names() -> tuple[str, ...]:
    """Names of the missions that come with the package."""
    return tuple(sorted(path.stem for path in LIBRARY.glob("*.toml")))


def load_mission(
    source: str | os.PathLike[str], *, t1: float | None = None, true_states: bool = False
) -> Mission:
    """Mission from a TOML file, or one of `mission_names` by name.

    Args:
        t1: end of the flight [s] in place of the file's.
        true_states: leave the mission's sensors out, so that the controller knows the true states.

    Raises:
        FileError: the file is missing or not valid TOML; an entry is unknown, missing or out of
            range; the machine cannot fly; or a reference is out of the machine's reach. The message
            names the file.
        SettingError: a name that is none.
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
    content = {"name": path.stem} | read_toml(path)
    if "bodies" in content:
        raise FileError(
            f'{path} is a model, not a mission: a mission names it with model = "{path.name}" in its '
            "table [machine] (docs/missions.md)."
        )
    if t1 is not None:
        content["t1"] = t1
    if true_states:
        content.pop("sensors", None)
    try:
        return make_mission(content, path.parent)
    except FileError:
        raise
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{path}: {error}") from error


def make_mission(plain: Mapping[str, Any], folder: str | os.PathLike[str] = ".") -> Mission:
    """Mission from plain data, such as those of a TOML file.

    Args:
        folder: folder from which a model's file is looked for.

    Raises:
        SettingError: an entry is unknown, missing or out of range, or a reference is out of reach.
        ModelError, StateError: the machine's numbers make no sense.
    """
    given = checked(MissionFile, plain, "A mission")
    machine = machine_of(given, Path(folder))
    plant = inspected(plant_of(given, machine))
    panel = _moves(given, machine) if machine.bodies is not None else None
    if given.battery is not None and given.battery.state_of_charge <= (given.battery.reserve or 0):
        raise SettingError("'battery.state_of_charge' must be above its reserve.")
    _check_gear(given, plant)
    mission = Mission(
        given, machine, plant, controller_of(given, machine, plant),
        References(_path(given.path, machine), panel), Gauges(machine, plant.system), _battery(given),
    )  # fmt: skip
    assert mission.samples > 1
    _check_thrust(mission)
    if panel is not None:
        _check_panel(mission)
        check_forces(given, machine, mission.references)
    return mission


def _check_gear(given: MissionFile, plant: Plant) -> None:
    """Raise `SettingError` for tolerances of a landing gear that the machine does not have."""
    wanted = [k for k in ("touchdown", "sink") if getattr(given.tolerances, k) is not None]
    if wanted and not any(isinstance(f, GroundContact) for f in plant.system.forces):
        raise SettingError(
            f"'tolerances.{wanted[0]}' needs a landing gear, which this machine does not have: add "
            "'options.gear = {}' to [machine]."
        )


def _path(given: PathEntry, machine: Machine) -> HeldPath | WaypointPath:
    """Path; by default the one that holds the place of the start."""
    if given.waypoints is not None:
        if (given.position, given.heading, given.acceleration) != (None, None, None):
            raise SettingError(
                "'path' has waypoints, and then neither position nor heading nor acceleration."
            )
        ts = np.array([point.t for point in given.waypoints])
        rows = [(*point.position, _DEGREE * point.heading) for point in given.waypoints]
        return WaypointPath(ts, np.array(rows).reshape(len(ts), 4))
    start = machine.scene.state0.r[0] if given.position is None else given.position
    a = (0.0, 0.0, 0.0) if given.acceleration is None else given.acceleration
    numbers = (start, a, _DEGREE * (given.heading or 0.0))
    return HeldPath(*(jnp.asarray(x, dtype=float) for x in numbers))


def _moves(given: MissionFile, machine: Machine) -> PanelMoves:
    """Moves of the panel, the first of them from its place at the start."""
    state = machine.scene.state0
    angles = panel_motion(state).value
    kinds = set()
    for move in given.panel:
        own = [name for name in ("angles", "direction", "sun") if getattr(move, name) is not None]
        if len(own) != 1:
            raise SettingError(
                "A move of the panel needs one of angles, direction and sun, but it has "
                f"{' and '.join(own) or 'none'}."
            )
        kinds.add(own[0] != "angles")
    if len(kinds) == 2:
        raise SettingError(
            "The moves of the panel must all be to angles in the base's axes, or all to directions "
            "of the world and the sun."
        )
    world = kinds == {True}
    start = _normal(state, angles) if world else angles
    targets = tuple(_target(move, given.t1) for move in given.panel)
    ats, durations = (
        tuple(jnp.asarray(getattr(move, name)) for move in given.panel)
        for name in ("at", "duration")
    )
    shapes = tuple(jnp.asarray(move.shape, dtype=float) for move in given.panel)
    return PanelMoves(start, targets, ats, durations, world, shapes)


@quick_jit
def _normal(state: State, angles: Float[Array, "2"]) -> Float[Array, "3"]:
    """Normal of the panel in the world."""
    return rotation_matrix(state.p[0]) @ panel_normal(angles)


def _target(move: MoveEntry, t1: float) -> Any:
    if move.angles is not None:
        return _DEGREE * jnp.asarray(move.angles)
    if move.direction is not None:
        length = float(np.linalg.norm(move.direction))
        if length == 0.0:
            raise SettingError("A direction for the panel has zero length; give any vector to it.")
        return jnp.asarray(move.direction) / length
    assert move.sun is not None
    return _sun(move.sun, t1)


def _sun(given: SunEntry, t1: float) -> Sampled:
    """Direction to the sun, world (3,), as a function of the flight's time [s]."""
    zone = day_zone(given.timezone, given.lon)
    begin = datetime.combine(parse_date(given.date), time(), zone) + timedelta(hours=given.hour)
    place = Place.degrees(given.lat, given.lon, given.altitude)
    end = t1 + BEYOND
    ts = np.linspace(0.0, end, max(8, math.ceil(end * given.speed / _SUN_STEP) + 1))
    sun = sun_position(begin.timestamp() + given.speed * ts, place)
    down = ~np.asarray(sun.is_up) & (ts <= t1)
    if np.any(down):
        k = int(np.argmax(down))
        when = begin + timedelta(seconds=float(given.speed * ts[k]))
        raise SettingError(
            f"The sun is {-math.degrees(float(sun.elevation[k])):.3g} degrees below the horizon at "
            f"{given.lat:g} degrees north, {given.lon:g} east on {when.isoformat(timespec='seconds')}, "
            f"t = {ts[k]:.4g} s of the flight: there is nothing to point at. Is the time zone right?"
        )
    return Sampled(ts, np.asarray(sun.s_w).T)


def _battery(given: MissionFile) -> Battery | None:
    if given.battery is None:
        return None
    own = given.battery.model_dump(exclude_none=True, exclude={"state_of_charge"})
    return Battery.of(ENERGY.replaced({f"battery.{name}": value for name, value in own.items()}))


# Compiled once for all missions of a process.
_surveyed = quick_jit(survey)


@quick_jit
def _along(path: HeldPath | WaypointPath, ts: Float[Array, " k"]) -> Any:
    """Path at times ts [s]."""
    return jax.vmap(path)(ts)


def _check_thrust(mission: Mission) -> None:
    """Raise `SettingError` for a path whose accelerations the rotors cannot give."""
    machine, speeds = mission.machine, mission.machine.speeds
    if speeds is None:
        return
    ts = floats(np.linspace(0.0, mission.file.t1, _CHECKED))
    wanted = _along(mission.references.path, ts)
    system = mission.plant.system
    a, gravity, mass = map(np.asarray, (wanted.a, gravity_of(system), system.bodies.mass))
    needed = np.sum(mass) * np.linalg.norm(a - gravity, axis=1)
    limits = speeds.squared(machine.rotors.spin.shape[0])
    least, most = (float(machine.rotors.k_f) * float(np.sum(np.asarray(x))) for x in limits)
    beyond = (needed > most) | (needed < least)
    if np.any(beyond):
        k = int(np.argmax(beyond))
        raise SettingError(
            f"The path needs a thrust of {float(needed[k]):.4g} N at t = {float(ts[k]):.4g} s, but the "
            f"rotors give {least:.4g} to {most:.4g} N within their limits: give it more time."
        )


def _check_panel(mission: Mission) -> None:
    """Raise `SettingError` for a panel's reference outside the workspace.

    The base is taken to have the attitude that its path needs.
    """
    machine, references = mission.machine, mission.references
    assert machine.bodies is not None
    assert machine.limits is not None
    gravity, panel = gravity_of(mission.plant.system), references.panel
    ends = [t for move in mission.file.panel for t in (move.at, move.at + move.duration)]
    every = np.linspace(0.0, mission.file.t1, _CHECKED)
    ts = np.union1d(every, [t for t in ends if t <= mission.file.t1])

    def wanted(references: References, t: Any) -> Any:
        at = references(t)
        if not isinstance(at.panel, DirectionMotion):
            return references.panel.value(t)  # pyright: ignore[reportOptionalMemberAccess]
        R = attitude_of(at.waypoint.a - gravity, at.waypoint.heading)
        return panel_angles(R.T @ at.panel.value)

    angles = quick_jit(lambda r, ts: jax.vmap(lambda t: wanted(r, t))(ts))(references, floats(ts))
    geometry, limits = machine.bodies.geometry, machine.limits
    found = _surveyed(geometry, floats(np.asarray(angles).T), limits)
    reason = np.asarray(found.reason)
    if not np.any(reason):
        return
    k = int(np.argmax(reason != 0))
    margins = jax.tree.map(lambda x: x[..., k], found.margins)
    why = why_outside(geometry, limits, margins, Reason(int(reason[k])))
    phi, theta = np.degrees(np.asarray(angles)[k])
    frame = "a direction of the world" if panel is not None and panel.world else "these angles"
    raise SettingError(
        f"The panel cannot follow its reference, {frame}: at t = {ts[k]:.4g} s it would have to stand at "
        f"phi = {phi:.4g} and theta = {theta:.4g} degrees in the base's axes, and {why}"
    )
