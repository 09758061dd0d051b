"""Machine of a mission: its scene, sensors and controller, from the entries of its file."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..checks.errors import SettingError
from ..checks.numbers import floats
from ..control.adaptation.adaptive import AdaptiveController
from ..control.adaptation.payload_filter import PayloadFilter
from ..control.estimator import MotionEstimator
from ..control.flying import FlightController
from ..control.geometric import FlightGains
from ..control.instruments import Instrument
from ..control.panel import PanelBodies, PanelServo, StrokeServo, panel_bodies
from ..control.plant import Plant
from ..control.uav import UavController
from ..dynamics.scene import Scene
from ..environment.wind import dryden, low_altitude
from ..files.model_file import load_model
from ..mechanics.load import Sine
from ..mechanics.system import System
from ..parameters.table import Parameters
from ..rotorcraft.allocation import RotorLimits
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors, hover_speed_squared
from ..scenes.registry import entry_of, make_scene, options_from_plain
from ..sensing.sensors import SENSORS, gravity_of
from ..tracker.actuator import LinearActuator
from ..tracker.drive import SLIDER_JOINTS
from ..tracker.geometry import tracker_geometry
from ..tracker.workspace import Limits, tracker_limits
from .disturbance import Jam, MissionController, MissionWind, Pilot, Told
from .payload import WithoutPayload, table_carrying, tracker_carrying
from .schema import MissionFile, SensorsEntry, ServoEntry, WindEntry

FORCES = ("force_slider_2", "force_slider_3")
# Seconds by which gusts are longer than a flight, whose last samples are computed and left out.
BEYOND = 10.0
_DEGREE = np.pi / 180
# A common inertial unit at 400 Hz (0.005 degrees/s/sqrt(Hz), 100 micro-g/sqrt(Hz)), a position to
# 1 cm, an attitude to 0.5 degrees, encoders to 0.01 mm.
INSTRUMENTS: dict[str, dict[str, Any]] = {
    "gyroscope": {"noise": 1.75e-3},
    "accelerometer": {"noise": 0.02},
    "position": {"rate": 50.0, "noise": 0.01, "delay": 0.02},
    "attitude": {"rate": 100.0, "noise": 0.5 * _DEGREE, "delay": 0.01},
    "encoders": {"noise": 1e-5},
}


class Machine(NamedTuple):
    """Machine of a mission.

    Attributes:
        scene: its scene. rotors: the rotors or motors. table: its parameters; None for a model.
        bodies: bodies of the tracker, and limits: of its workspace; None without a tracker.
        speeds: limits of the rotor speeds, or None.
        believed: system without the payload, of which the controller does not know; None where it is
            that of the scene. `bodies` are those that the controller believes.
        force: largest force of each of the tracker's actuators, either way [N]; None for no limit.
    """

    scene: Scene
    rotors: Rotors
    table: Parameters | None
    bodies: PanelBodies | None
    limits: Limits | None
    speeds: RotorLimits | None
    believed: System | None = None
    force: float | None = None


def machine_of(given: MissionFile, folder: Path) -> Machine:
    """Machine of a mission; models' files are looked for from a folder.

    Raises:
        SettingError: not one scene or model, entries that the machine does not have, limits of its
            rotors that are none.
        ModelError: numbers that the scene refuses. FileError: see `load_model`.
    """
    entry = given.machine
    if (entry.scene is None) == (entry.model is None):
        raise SettingError("'machine' needs a scene or a model's file, and not both.")
    if entry.model is not None:
        return _model(given, folder / entry.model)
    assert entry.scene is not None
    has_panel = entry.scene == "uav_tracker"
    if not has_panel:
        _without_tracker(given, f"The scene {entry.scene}")
    for name, instead in (("wind", "[wind]"), ("strokes", "[[panel]]"), ("case", "[push]")):
        if name in entry.options:
            raise SettingError(
                f"'machine.options' of a mission has no {name}: {instead} takes its place."
            )
    table = entry_of(entry.scene).parameters.replaced(entry.parameters)
    scene = scene_of(given, table)
    motors = next(f for f in scene.system.forces if isinstance(f, Rotors | MotorRotors))
    own = getattr(motors, "limits", None)
    usual = RotorLimits(table.value("motor.lowest"), table.value("motor.highest"))
    speeds = _speeds(given, own or usual)
    rotors = motors.rotors if isinstance(motors, MotorRotors) else motors
    if not has_panel:
        return Machine(scene, rotors, table, None, None, speeds)
    geometry, shift = tracker_geometry(table), table.value("mount.shift")
    bodies = panel_bodies(scene.system, geometry, shift)
    limits, force = tracker_limits(table), given.controller.force
    empty = Machine(scene, rotors, table, bodies, limits, speeds, force=force)
    return empty if given.payload is None else _loaded(empty, given)


def _loaded(empty: Machine, given: MissionFile) -> Machine:
    """Machine with the mission's payload, from the one without."""
    assert given.payload is not None
    assert empty.bodies is not None
    assert empty.table is not None
    bodies = tracker_carrying(empty.bodies, given.payload)
    table = table_carrying(empty.table, bodies)
    loaded = empty._replace(scene=scene_of(given, table), table=table)
    if given.controller.payload == "known":
        return loaded._replace(bodies=bodies)
    return loaded._replace(believed=empty.scene.system)


def scene_of(given: MissionFile, table: Parameters, gusts: Any = None) -> Scene:
    """Scene of a mission's machine in its air, with a table of parameters, which may be traced.

    Args:
        gusts: seed of the gusts in place of the mission's.

    Raises:
        SettingError: wind without drag, gusts without wind, options that the scene does not have.
        ModelError: numbers that the scene refuses.
    """
    entry = given.machine
    assert entry.scene is not None
    options = options_from_plain(entry.scene, entry.options)
    if given.wind is not None:
        if "drag" not in options:
            raise SettingError(
                "Wind acts through the airframe's drag, which this machine does not have: add "
                "'options.drag = {}' to [machine]."
            )
        options["wind"] = _wind(given.wind, table, given.t1, gusts)
    # case 2 has actuators; a mission's own forces take the place of the report's
    has_panel = entry.scene == "uav_tracker"
    scene = make_scene(entry.scene, 2 if has_panel else None, table, **options)
    return _pushed(scene, given) if has_panel else scene


def _model(given: MissionFile, path: Path) -> Machine:
    _without_tracker(given, "A model's file")
    for name in ("options", "parameters"):
        if getattr(given.machine, name):
            raise SettingError(
                f"'machine.{name}' is for scenes; a model's file has its own numbers."
            )
    if given.wind is not None:
        raise SettingError("[wind] is for scenes; a model's file has no drag.")
    scene = load_model(path)
    found = [f for f in scene.system.forces if isinstance(f, Rotors)]
    if len(found) != 1:
        raise SettingError(
            f"A mission needs a machine with one set of rotors, but {path} has {len(found)}."
        )
    return Machine(scene, found[0], None, None, None, _speeds(given, None))


def _without_tracker(given: MissionFile, what: str) -> None:
    """Raise `SettingError` for entries that only a machine with a tracker can have."""
    used = {
        "[[panel]]": given.panel, "[push]": given.push, "'controller.servo'": given.controller.servo,
        "'controller.feedforward'": given.controller.feedforward is not None,
        "'controller.force'": given.controller.force is not None,
        "'sensors.encoders'": given.sensors and given.sensors.encoders,
        "'tolerances.panel'": given.tolerances.panel, "[payload]": given.payload,
        "'tolerances.panel_after'": given.tolerances.panel_after is not None,
        "A fault of a slider": any(fault.slider for fault in given.faults),
    }  # fmt: skip
    for name, value in used.items():
        if value:
            raise SettingError(
                f"{name} needs the tracker of the scene uav_tracker. {what} has none."
            )


def _speeds(given: MissionFile, own: RotorLimits | None) -> RotorLimits | None:
    low, high = given.controller.lowest, given.controller.highest
    if own is None and (low is None) != (high is None):
        raise SettingError("Limits of the rotor speeds need 'lowest' and 'highest'.")
    if own is None and low is None:
        return None
    lowest = low if low is not None else getattr(own, "lowest", 0.0)
    return RotorLimits(lowest, high if high is not None else getattr(own, "highest", 0.0))


def _wind(given: WindEntry, table: Parameters, t1: float, seed: Any) -> MissionWind:
    steady = jnp.asarray(given.steady, dtype=float)
    before: Any = steady
    if given.gusts is not None:
        numbers = [
            table.value(f"gust.{name}") if (own := getattr(given.gusts, name)) is None else own
            for name in ("height", "speed_20ft")
        ]
        speed = float(np.linalg.norm(given.steady))
        if speed == 0.0:
            raise SettingError(
                "Gusts pass at the speed of the steady wind, which must not be zero."
            )
        before = dryden(
            given.gusts.seed if seed is None else seed,
            low_altitude(*numbers),
            airspeed=speed,
            duration=t1 + BEYOND,
            mean=steady,
        )
    change = given.change
    if change is None:
        return MissionWind(before, jnp.zeros(3), jnp.zeros(()), jnp.ones(()))
    added = jnp.asarray(change.to, dtype=float) - steady
    return MissionWind(before, added, jnp.asarray(change.at), jnp.asarray(change.rise))


def _pushed(scene: Scene, given: MissionFile) -> Scene:
    """Scene whose own actuators have plain forces, and others with sinusoidal ones if wanted."""
    forces, own = list(scene.system.forces), []
    for k, force in enumerate(forces):
        if isinstance(force, LinearActuator):
            own.append(force)
            forces[k] = eqx.tree_at(lambda f: f.force, force, floats(0.0))
    if given.push is not None:
        sine = Sine(jnp.asarray(given.push.force), jnp.asarray(given.push.angular_frequency))
        forces += [eqx.tree_at(lambda f: f.force, f, sine) for f in own]
    system = eqx.tree_at(lambda s: s.forces, scene.system, tuple(forces))
    return dataclasses.replace(scene, system=system)


def input_names(machine: Machine) -> list[str]:
    """Names of the inputs that a mission's controller sets."""
    return ["speed_squared", *(FORCES if machine.bodies is not None else ())]


def plant_of(given: MissionFile, machine: Machine) -> Plant:
    """Sampled plant of a machine, with instruments and estimator if the mission has them.

    Raises:
        SettingError: rates or delays that do not divide, instruments that do not suffice, a start that
            moves although it is to stand first.
    """
    system, rate = machine.scene.system, given.rates.control
    known = system if machine.believed is None else machine.believed
    names = input_names(machine)
    count, mass = machine.rotors.spin.shape[0], float(np.sum(np.asarray(known.bodies.mass)))
    hover = hover_speed_squared(mass, gravity_of(system), machine.rotors.k_f, count)
    before = np.concatenate([np.asarray(hover), np.zeros(len(names) - 1)])
    settings: dict[str, Any] = {"inputs": names, "before": before, "rate": rate}
    settings |= {"steps": given.rates.steps, "delay": given.rates.delay}
    if given.sensors is None:
        observe = None if machine.believed is None else WithoutPayload(system, known)
        return Plant(machine.scene, observe=observe, **settings)
    instruments = _instruments(given.sensors, machine)
    estimator = MotionEstimator(system, rate, instruments, tracker=machine.bodies)
    memory = estimator.start(machine.scene.state0)
    settings |= {"sensors": instruments, "standing": given.sensors.standing}
    return Plant(machine.scene, estimator=estimator, memory=memory, **settings)


def _instruments(given: SensorsEntry, machine: Machine) -> list[Instrument]:
    body = machine.scene.system.names[0]
    names = ("gyroscope", "accelerometer", "position", "attitude")
    kinds: dict[str, list[Any]] = {name: [SENSORS[name](body)] for name in names}
    if machine.bodies is not None:
        kinds["encoders"] = [SENSORS["encoder"](joint) for joint in SLIDER_JOINTS]
    found = []
    for name, sensors in kinds.items():
        entry = getattr(given, name)
        own = {} if entry is None else entry.model_dump(exclude_none=True)
        numbers: dict[str, Any] = INSTRUMENTS[name] | {
            key: np.asarray(value) if key in ("noise", "bias") else value
            for key, value in own.items()
        }
        found += [Instrument(sensor, **numbers) for sensor in sensors]
    return found


def controller_of(given: MissionFile, machine: Machine, plant: Plant) -> MissionController:
    """Controller of a mission with its faults.

    Raises:
        SettingError: entries that do not fit the servo, faults that the machine cannot have.
        ModelError: a machine that the controller cannot fly.
    """
    pilot = _pilot(given, machine, plant, ())
    found = _faulty(given, machine, pilot)
    known: dict[float, list[int]] = {}
    for fault in given.faults:
        if not fault.known:
            continue
        if fault.rotor is None or fault.share:
            raise SettingError(
                "A fault that is 'known' must be the loss of a rotor, without a share of its thrust: "
                "the controller has no other way to fly with a jammed slider or a weak rotor."
            )
        known.setdefault(fault.at, []).append(fault.rotor)
    lost: list[int] = []
    told = []
    for at in sorted(known):
        lost = lost + known[at]
        told.append(Told(jnp.asarray(at), _pilot(given, machine, plant, tuple(lost))))
    return dataclasses.replace(found, told=tuple(told))


def _pilot(given: MissionFile, machine: Machine, plant: Plant, lost: tuple[int, ...]) -> Pilot:
    """Controller of a machine that knows of lost rotors."""
    entry = given.controller
    system = plant.system if machine.believed is None else machine.believed
    gains = FlightGains(**entry.gains.model_dump(exclude_none=True))
    flight = FlightController(system, plant.rate, gains=gains, limits=machine.speeds, lost=lost)
    pilot: FlightController | UavController = flight
    if machine.bodies is not None:
        servo = _servo(entry.servo or ServoEntry(), machine.bodies)
        pilot = UavController(system, flight, servo, entry.feedforward is not False)
    if entry.payload == "known" and given.payload is None:
        raise SettingError("'controller.payload' is known, but the mission has no [payload].")
    if entry.payload != "estimated":
        return pilot
    if given.sensors is None:
        raise SettingError(
            "'controller.payload' is estimated from gyroscope and accelerometer, which only a mission with "
            "[sensors] has."
        )
    own = given.sensors.gyroscope.noise
    noise = np.asarray(INSTRUMENTS["gyroscope"]["noise"] if own is None else own)
    found = PayloadFilter(
        system, plant.rate, delay=given.rates.delay, gyroscope=float(np.sqrt(np.mean(noise**2)))
    )
    return AdaptiveController(pilot, found)


def _servo(entry: ServoEntry, bodies: PanelBodies) -> PanelServo | StrokeServo:
    own = entry.model_dump(exclude_none=True, exclude={"kind"})
    kinds: dict[str, tuple[Callable[..., Any], tuple[str, ...]]] = {
        "computed_torque": (PanelServo, ("frequency", "damping")),
        "strokes": (StrokeServo, ("stiffness", "damping")),
    }
    make, known = kinds[entry.kind]
    for name in own:
        if name not in known:
            raise SettingError(
                f"'controller.servo' of the kind {entry.kind} has no {name}; it has {' and '.join(known)}."
            )
    return make(bodies, **own)


def _faulty(given: MissionFile, machine: Machine, pilot: Any) -> MissionController:
    count = machine.rotors.spin.shape[0]
    lost, share, jammed = np.full(count, np.inf), np.ones(count), np.full(2, np.inf)
    for fault in given.faults:
        if (fault.rotor is None) == (fault.slider is None):
            raise SettingError("A fault needs a rotor or a slider, and not both.")
        if fault.slider is not None:
            if fault.share is not None:
                raise SettingError(
                    "'share' is for faults of rotors: a jammed slider does not move."
                )
            jammed[fault.slider - 2] = fault.at
            continue
        assert fault.rotor is not None
        if fault.rotor > count:
            raise SettingError(
                f"The machine has rotors 1 to {count}, but no rotor {fault.rotor} to fail."
            )
        lost[fault.rotor - 1] = fault.at
        share[fault.rotor - 1] = fault.share or 0.0
    motors = [f for f in machine.scene.system.forces if isinstance(f, MotorRotors)]
    slowest = [f.limits.lowest for f in motors if f.limits is not None]
    if np.any(np.isfinite(lost)) and slowest and float(np.max(np.asarray(slowest[0]))) > 0:
        raise SettingError(
            "A rotor that fails turns more slowly than the motors' lowest speed: give "
            "'options.motor = {lowest = 0.0}', and the controller's limit as 'controller.lowest'."
        )
    jam = None
    if np.any(np.isfinite(jammed)):
        if given.sensors is not None:
            raise SettingError(
                "A jammed slider is held by its true stroke, which only a mission without [sensors] has."
            )
        assert machine.bodies is not None
        jam = Jam(machine.bodies.geometry, jnp.asarray(jammed))
    most = np.inf if machine.force is None else machine.force
    force = floats(np.full(0 if machine.bodies is None else 2, most))
    return MissionController(pilot, floats(lost), floats(share), jam, force)
