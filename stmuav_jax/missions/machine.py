"""Machine of a mission: its scene, sensors and controller, from the entries of its file."""

import copy
import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..analysis.sensors import SENSORS, gravity_of
from ..checks.errors import SettingError, nearest_names
from ..checks.numbers import as_floats
from ..checks.schema import SHOWN, quote_name
from ..control.instruments import Instrument, SensorFault, count_periods, whole_periods
from ..control.plant import Plant
from ..dynamics.simulation import Scene
from ..io.air_entries import make_wind
from ..io.model_file import ParametricModel, read_model
from ..io.model_schema import DATASHEET
from ..math.rotation import rotation_matrix
from ..mechanics.inputs import inputs_of
from ..mechanics.load import Sine
from ..mechanics.parameters import Parameters
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.adaptation import AdaptiveController, Payload, PayloadFilter, bodies_carrying
from ..uav.airframe import PART_II
from ..uav.allocation import RotorLimits
from ..uav.drag import AirframeDrag, with_wind
from ..uav.flight_controller import FlightController, FlightGains, UavController
from ..uav.inner_motion import JointChain
from ..uav.joint_controller import DrivenJoint, JointController, JointGains, driven_joints
from ..uav.motion_estimator import MotionEstimator
from ..uav.motor import only_rotors
from ..uav.panel_servo import PanelBodies, PanelServo, StrokeServo, panel_bodies
from ..uav.rotor import Rotors
from ..uav.scenes.registry import entry_of, make_scene, options_from_plain
from ..uav.tracker.bodies import SLIDER_JOINTS, LinearActuator
from ..uav.tracker.geometry import tracker_geometry
from ..uav.tracker.workspace import Limits, tracker_limits
from .controller import Jam, MissionController, Pilot, PilotChange
from .payloads import Payloads, Unloaded
from .schema import (
    FaultEntry,
    InstrumentEntry,
    JointServoEntry,
    MissionFile,
    PayloadEntry,
    RatesEntry,
    SensorsEntry,
    ServoEntry,
)


def tracker_carrying(bodies: PanelBodies, payload: PayloadEntry) -> PanelBodies:
    """The tracker's bodies with the payload on its panel."""
    mass, place = jnp.asarray(payload.mass), jnp.asarray(payload.position, dtype=float)
    # A point mass has no inertia of its own, only that of its place (Steiner).
    inertia = mass * (place @ place * jnp.eye(3) - jnp.outer(place, place))
    return bodies_carrying(bodies, Payload(mass, mass * place, jnp.zeros(3)), inertia)


def table_carrying(table: Parameters, bodies: PanelBodies) -> Parameters:
    """Parameter table of the machine whose panel has these numbers."""
    return table.replaced(
        {
            "mass.panel_7": bodies.mass[-1],
            "geometry.panel_com": bodies.geometry.panel_com,
            "inertia.panel_7": bodies.inertia[-1],
        },
        "the table's panel with the mission's payload",
    )


class WithoutPayload(eqx.Module):
    """Function of a plant's true state that returns that of the controller's nominal model.

    The panel's row is where the panel's own centre of mass is, not where that of panel and payload is.

    Args:
        loaded, empty: systems with and without the payload.
    """

    shift: Float[Array, "3"]

    def __init__(self, loaded: System, empty: System) -> None:
        # Rows of a state are centres of mass: with a payload that of the panel moves, and a
        # controller that does not know of it would see the panel displaced.
        R = rotation_matrix(empty.reference.p[-1])
        self.shift = R.T @ (empty.reference.r[-1] - loaded.reference.r[-1])

    def __call__(self, t: Float[Array, ""], state: State, internal: Float[Array, " z"]) -> State:
        del t, internal
        R = rotation_matrix(state.p[-1])
        velocity_shift = R @ jnp.cross(state.omega[-1], self.shift)
        r, v = state.r.at[-1].add(R @ self.shift), state.v.at[-1].add(velocity_shift)
        return State(r, state.p, v, state.omega)


# Density of the accelerations of a model's joints [rad/s^2/sqrt(Hz)]: the estimate follows encoders of 1e-3 rad
# at 200 Hz with some 850 rad/s. With a tenth it lags so far behind a servo of 120 rad/s that this diverges.
JOINT_NOISE = 50.0
FORCES = ("force_slider_2", "force_slider_3")
# Seconds by which gusts are longer than a flight, whose last samples are computed and left out.
BEYOND = 10.0
# Round-off of the motors' limits, as a share.
AT_MOTORS = 1e-9
_DEGREE = np.pi / 180
# A common inertial unit at 400 Hz (0.005 degrees/s/sqrt(Hz), 100 micro-g/sqrt(Hz)), a position to
# 1 cm, an attitude to 0.5 degrees, encoders to 0.01 mm or 1e-5 rad.
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
        scene: its scene. rotors: the rotors or motors. table: its parameters.
        bodies: bodies of the tracker, and limits: of its workspace; None without a tracker.
        speeds: limits of the rotor speeds, or None.
        nominal: system of the controller's model, without the unknown payload; None where it is
            that of the scene. `bodies` are those of the controller's model.
        force: largest force of each of the tracker's actuators, either way [N]; None for no limit.
        model: the model's file; None for a built-in scene. joints: its driven joints.
    """

    scene: Scene
    rotors: Rotors
    table: Parameters
    bodies: PanelBodies | None
    limits: Limits | None
    speeds: RotorLimits | None
    nominal: System | None = None
    force: float | None = None
    model: ParametricModel | None = None
    joints: tuple[DrivenJoint, ...] = ()

    @property
    def efforts(self) -> np.ndarray:
        """Largest efforts of the driven joints (n,) [N] or [N m]; infinite for no limit."""
        forces: Any = self.scene.system.forces
        limits = [forces[drive.force].limit for drive in self.joints]
        return np.array([np.inf if limit is None else float(limit) for limit in limits])


def machine_of(mission_file: MissionFile, folder: Path) -> Machine:
    """Machine of a mission; models' files are looked for from a folder.

    Raises:
        SettingError: not one scene or model, entries that the machine does not have, limits of its
            rotors that are none.
        ModelError: numbers that the scene refuses. FileError: see `load_model`.
    """
    entry, controller = mission_file.machine, mission_file.controller
    if (entry.scene is None) == (entry.model is None):
        raise SettingError("'machine' needs a scene or a model's file, and not both.")
    has_panel, model = entry.scene == "uav_tracker", None
    if not has_panel:
        _without_tracker(mission_file)
    if entry.scene is None:
        assert entry.model is not None
        if entry.options:
            raise SettingError(
                "'machine.options' is for built-in scenes (machine.scene): a model's file has drag, motors and "
                "landing gear as forces of its own."
            )
        model = read_model(folder / entry.model)
    # A scene's own options and a mission's tables would set the same thing twice.
    for name, instead in (("wind", "[wind]"), ("strokes", "[[panel]]"), ("case", "[push]")):
        if name in entry.options:
            raise SettingError(f"'machine.options' of a mission has no {name}: use {instead}.")
    # One table for scene, controller and limits: a mass that is changed is changed in all of them,
    # unless it is drawn for the true machine alone.
    table = entry_of(str(entry.scene)).parameters if model is None else model.table
    table = table.replaced(entry.parameters)
    scene = scene_of(mission_file, table, model=model)
    motors = only_rotors(scene.system, "A mission")
    speeds = getattr(motors, "limits", None)
    if model is None and speeds is None:
        speeds = RotorLimits(table.value("motor.lowest"), table.value("motor.highest"))
    joints = () if model is None else driven_joints(scene.system)
    _check_joints(mission_file, joints)
    speeds = _speed_limits(mission_file, speeds)
    machine = Machine(scene, motors.rotors, table, None, None, speeds, model=model, joints=joints)
    if not has_panel:
        return machine
    bodies = panel_bodies(scene.system, tracker_geometry(table), table.value("mount.shift"))
    machine = machine._replace(bodies=bodies, limits=tracker_limits(table), force=controller.force)
    if mission_file.payload is None:
        return machine
    bodies = tracker_carrying(bodies, mission_file.payload)
    table = table_carrying(table, bodies)
    loaded = machine._replace(scene=scene_of(mission_file, table), table=table)
    if controller.payload == "known":
        return loaded._replace(bodies=bodies)
    # A controller that does not know of the payload flies by the model of the empty machine.
    return loaded._replace(nominal=scene.system)


def scene_of(
    mission_file: MissionFile,
    table: Parameters,
    gusts: Any = None,
    model: ParametricModel | None = None,
) -> Scene:
    """Scene of a mission's machine in its air, with a table of parameters, which may be traced.

    Args:
        gusts: seed of the gusts in place of the mission's. model: a model's file; None for a built-in scene.

    Raises:
        SettingError: wind without drag, gusts without wind, options that the scene does not have.
        ModelError: numbers that the scene refuses.
    """
    entry, wind, push = mission_file.machine, mission_file.wind, mission_file.push
    if model is not None:
        system = model.system(table)
        scene = dataclasses.replace(model.scene, system=system, state0=model.start(system, table))
        wind = wind or model.file.wind
        advice = "a force of the kind 'drag' to the model's file"
    else:
        assert entry.scene is not None
        # case 2 has actuators, whose forces are the controller's in place of the report's
        case = 2 if entry.scene == "uav_tracker" else None
        options = options_from_plain(entry.scene, entry.options)
        scene = make_scene(entry.scene, case, table, **options)
        forces = list(scene.system.forces)
        for k, actuator in enumerate(scene.system.forces):
            if isinstance(actuator, LinearActuator):
                with_force = lambda x, f=actuator: eqx.tree_at(lambda f: f.force, f, x)
                forces[k] = with_force(as_floats(0.0))
                if push is not None:
                    numbers = jnp.asarray(push.force), jnp.asarray(push.angular_frequency)
                    forces.append(with_force(Sine(*numbers)))
        system = eqx.tree_at(lambda s: s.forces, scene.system, tuple(forces))
        scene = dataclasses.replace(scene, system=system)
        advice = "'options.drag = {}' to [machine]"
    if wind is None:
        return scene
    if not any(isinstance(force, AirframeDrag) for force in scene.system.forces):
        raise SettingError(
            f"Wind acts through the airframe's drag, which this machine does not have: add {advice}."
        )
    of_gusts = PART_II if model is not None else table
    # Gusts are drawn for longer than the flight, since steps of the last period look beyond its
    # end.
    air = make_wind(wind, mission_file.t1 + BEYOND, table=of_gusts, seed=gusts)
    return dataclasses.replace(scene, system=with_wind(scene.system, air))


def _check_joints(entries: MissionFile, joints: tuple[DrivenJoint, ...]) -> None:
    """Raise `SettingError` for entries of joints that no effort and no servo of the machine drives."""
    controller = entries.controller
    if entries.machine.model is not None and controller.feedforward is not None and not joints:
        raise SettingError(
            "'controller.feedforward' needs a model with moving joints, which this model does not have: leave it out."
        )
    names = [drive.name for drive in joints]
    used = [("[[joints]]", move.joint) for move in entries.joints]
    used += [("'controller.joints'", name) for name in controller.joints]
    used += [("'tolerances.joints'", name) for name in entries.tolerances.joints]
    for place, name in used:
        if name not in names:
            raise SettingError(
                f"{place} names {quote_name(name)}, but no effort or servo of the machine drives a joint of this "
                f"name.{nearest_names(name[:SHOWN], names)}"
            )


def _without_tracker(entries: MissionFile) -> None:
    """Raise `SettingError` for entries that only a machine with a tracker can have."""
    controller, tolerances, sensors = entries.controller, entries.tolerances, entries.sensors
    is_scene = entries.machine.scene is not None
    used = {
        "[[panel]]": entries.panel, "[push]": entries.push, "'controller.servo'": controller.servo,
        "'controller.feedforward'": is_scene and controller.feedforward is not None,
        "'controller.force'": controller.force, "'sensors.encoders'": is_scene and sensors and sensors.encoders,
        "'tolerances.panel'": tolerances.panel, "[payload]": entries.payload,
        "'tolerances.panel_after'": tolerances.panel_after is not None,
        "A fault of a slider": any(fault.slider for fault in entries.faults),
    }  # fmt: skip
    owner = f"The scene {entries.machine.scene}" if is_scene else "A model's file"
    for name, value in used.items():
        if value:
            raise SettingError(
                f"{name} needs the tracker of the scene uav_tracker. {owner} has none."
            )


def _speed_limits(mission_file: MissionFile, motors: RotorLimits | None) -> RotorLimits | None:
    """Limits of the rotor speeds: the controller's, which lie within those of the motors."""
    low, high = mission_file.controller.lowest, mission_file.controller.highest
    if motors is None:
        if low is None and high is None:
            return None
        if low is None or high is None:
            raise SettingError("Limits of the rotor speeds need 'lowest' and 'highest'.")
        return RotorLimits(low, high)
    slowest = float(np.max(np.asarray(motors.lowest)))
    fastest = float(np.min(np.asarray(motors.highest)))
    # round-off of limits that are kept as squares
    for name, speed, beyond, motion in (
        ("lowest", low, low is not None and low < slowest * (1 - AT_MOTORS), f"no more slowly than {slowest:g}"),
        ("highest", high, high is not None and high > fastest * (1 + AT_MOTORS), f"no faster than {fastest:g}"),
    ):  # fmt: skip
        if beyond:
            raise SettingError(
                f"'controller.{name}' is {speed:g} rad/s, but the motors turn {motion} rad/s: "
                f"give a limit within the motors' range, or other motors ('options.motor = {{{name} = ...}}' in "
                f"[machine], machine.parameters \"motor.{name}\", or '{name}' in a model)."
            )
    return RotorLimits(
        motors.lowest if low is None else low, motors.highest if high is None else high
    )


def input_names(machine: Machine) -> list[str]:
    """Names of the inputs that a mission's controller sets."""
    of_joints = [drive.input for drive in machine.joints]
    return ["speed_squared", *(FORCES if machine.bodies is not None else of_joints)]


def plant_of(mission_file: MissionFile, machine: Machine) -> Plant:
    """Sampled plant of a machine, with instruments and estimator if the mission has them.

    Raises:
        SettingError: rates or delays that do not divide, instruments that do not suffice, a start that
            moves although it is to stand first.
    """
    system, rates = machine.scene.system, mission_file.rates
    # The controller uses its own numbers; only the plant has the true ones.
    nominal_system = system if machine.nominal is None else machine.nominal
    names, count = input_names(machine), machine.rotors.spin.shape[0]
    mass = float(np.sum(np.asarray(nominal_system.bodies.mass)))
    rest = np.zeros(len(names) - 1)
    if machine.joints:
        rest = inputs_of(system, names).values(system)[count:]
    # Until the first command arrives the rotors carry the weight: with a delay the machine would
    # otherwise begin with a fall.
    hover = np.asarray(machine.rotors.hover(mass, gravity_of(system)))
    settings: dict[str, Any] = {
        "inputs": names,
        "before": np.concatenate([hover, np.asarray(rest)]),
    }
    settings |= {"rate": rates.control, "steps": rates.steps, "delay": rates.delay}
    payloads, scene = payloads_of(mission_file, machine.scene), machine.scene
    if payloads is not None:
        scene = payloads.load(scene)
        settings["changes"] = payloads.changes(scene.system)
    if mission_file.sensors is None:
        # True states are those of the true machine; a controller without the payload has to get
        # those of its own model.
        observe = None if machine.nominal is None else WithoutPayload(system, nominal_system)
        observe = observe if payloads is None else Unloaded(payloads, observe)
        return Plant(scene, observe=observe, **settings)
    chain = None if machine.model is None or not system.joints else JointChain(nominal_system)
    instruments = _make_instruments(mission_file.sensors, machine, chain, mission_file.faults)
    joint_settings = {} if chain is None else {"joints": chain, "panel_noise": JOINT_NOISE}
    estimator = MotionEstimator(
        system, rates.control, instruments, tracker=machine.bodies, **joint_settings
    )
    # The estimator starts at the mission's start with its usual deviations, as a vehicle does
    # whose pose on the ground was measured.
    memory = estimator.start(machine.scene.state0)
    settings |= {"sensors": instruments, "standing": mission_file.sensors.standing}
    return Plant(scene, estimator=estimator, memory=memory, **settings)


def payloads_of(entries: MissionFile, scene: Scene) -> Payloads | None:
    """Payloads that the machine of a mission picks up or drops; None without any."""
    return Payloads(entries.payloads, scene.system.names) if entries.payloads else None


def _make_instruments(
    sensor_entries: SensorsEntry,
    machine: Machine,
    chain: JointChain | None,
    faults: tuple[FaultEntry, ...],
) -> list[Instrument]:
    """Instruments of the estimator, with the numbers of the mission, else of the model, else the usual ones."""
    body = machine.scene.system.names[0]
    names = ("gyroscope", "accelerometer", "position", "attitude")
    kinds: dict[str, list[Any]] = {name: [SENSORS[name](body)] for name in names}
    joints = SLIDER_JOINTS if machine.bodies is not None else ()
    joints = joints if chain is None else chain.encoders
    kinds["encoders"] = [SENSORS["encoder"](joint) for joint in joints]
    if not joints and any(fault.sensor == "encoders" for fault in faults):
        raise SettingError("A fault of encoders needs a machine with joints.")
    owner = lambda x: (type(x), getattr(x, "body", None), getattr(x, "joint", None))
    of_model = {owner(x.sensor): x for x in reversed([*machine.scene.sensors.values()])}
    instruments = []
    for name, sensors in kinds.items():
        entry = getattr(sensor_entries, name)
        numbers = {} if entry is None else entry.model_dump(exclude_none=True)
        numbers |= {key: np.asarray(numbers[key]) for key in ("noise", "bias") if key in numbers}
        numbers["faults"] = tuple(
            SensorFault(
                fault.at,
                np.inf if fault.until is None else fault.until,
                None if fault.bias is None else np.asarray(fault.bias),
            )
            for fault in faults
            if fault.sensor == name
        )
        # Numbers of the mission come before those of the model, and these before the usual ones:
        # the more special file decides.
        for sensor in sensors:
            sheet: dict[str, Any] = {}
            if (of_file := of_model.get(owner(sensor))) is not None:
                # The estimator finds instruments by the usual names; a model's file gives them names
                # of its own.
                usual_name, sensor = sensor.name, copy.copy(of_file.sensor)
                object.__setattr__(sensor, "name", usual_name)
                sheet = {k: x for k in DATASHEET if (x := getattr(of_file, k)) is not None}
            instruments.append(Instrument(sensor, **(INSTRUMENTS[name] | sheet | numbers)))
    return instruments


def check_instruments(mission_file: MissionFile) -> None:
    """Raise `SettingError` for instruments' rates and delays that cannot be flown."""
    sensors, control_rate = mission_file.sensors, mission_file.rates.control
    if sensors is None:
        return
    whole_periods(sensors.standing, control_rate, "The time of standing")
    for name, usual in INSTRUMENTS.items():
        entry = getattr(sensors, name) or InstrumentEntry()
        numbers = {"rate": control_rate, "delay": 0.0} | usual | entry.model_dump(exclude_none=True)
        rate, delay = numbers["rate"], numbers["delay"]
        # The estimator's prediction runs on these two at each period.
        if name in ("gyroscope", "accelerometer") and (rate != control_rate or delay):
            raise SettingError(
                f"'sensors.{name}' must read at every control period, at {control_rate:g} Hz, and without delay, "
                f"because the estimator integrates it, but it reads at {rate:g} Hz, late by {delay:g} s: leave "
                "'rate' and 'delay' out, or set 'rates.control' to its rate."
            )
        count_periods(rate, control_rate, f"'sensors.{name}'")
        whole_periods(delay, control_rate, f"'sensors.{name}.delay'")


def controller_of(mission_file: MissionFile, machine: Machine, plant: Plant) -> MissionController:
    """Controller of a mission with its faults.

    Raises:
        SettingError: entries that do not fit the servo, faults that the machine cannot have.
        ModelError: a machine that the controller cannot fly.
    """
    controller = _add_faults(mission_file, machine, _make_pilot(mission_file, machine, plant, ()))
    # Controllers for lost rotors differ in structure and cannot be made within the compiled flight. Each
    # known loss has a controller for all losses so far; all of them are built before the flight.
    losses = [(fault.at, fault.rotor) for fault in mission_file.faults if fault.known]
    pilot_changes = []
    for at in sorted({t for t, _ in losses}):
        lost = tuple(rotor for t, rotor in sorted(losses) if t <= at and rotor is not None)
        pilot = _make_pilot(mission_file, machine, plant, lost)
        pilot_changes.append(PilotChange(jnp.asarray(at), pilot))
    return dataclasses.replace(controller, pilot_changes=tuple(pilot_changes))


def _make_pilot(
    entries: MissionFile, machine: Machine, plant: Plant, lost: tuple[int, ...]
) -> Pilot:
    """Controller of a machine whose model has the lost rotors."""
    entry = entries.controller
    system = machine.scene.system if machine.nominal is None else machine.nominal
    gains = FlightGains(**entry.gains.model_dump(exclude_none=True))
    # The same flight controller under all of them: joints and panel only add what they need from
    # the rotors.
    flight = FlightController(system, plant.rate, gains=gains, limits=machine.speeds, lost=lost)
    pilot: FlightController | UavController | JointController = flight
    if machine.joints:
        usual = JointGains(frequency=default_servo_frequency(entries.rates))
        gains = {drive.name: usual for drive in machine.joints if drive.is_effort}
        gains |= {name: _joint_gains(name, of, usual) for name, of in entry.joints.items()}
        pilot = JointController(system, flight, gains, feedforward=entry.feedforward is not False)
    if machine.bodies is not None:
        servo = _make_servo(entry.servo or ServoEntry(), machine.bodies, entries.rates)
        pilot = UavController(system, flight, servo, entry.feedforward is not False)
    if entry.payload == "known" and entries.payload is None:
        raise SettingError("'controller.payload' is known, but the mission has no [payload].")
    if entry.payload != "estimated":
        return pilot
    if isinstance(pilot, JointController):
        raise SettingError(
            "'controller.payload' cannot be estimated by a machine with driven joints."
        )
    if entries.sensors is None:
        raise SettingError(
            "'controller.payload' is estimated from gyroscope and accelerometer, which only a mission with "
            "[sensors] has."
        )
    # The filter of the payload is tuned by the gyroscope's datasheet, as on a real machine.
    noise = entries.sensors.gyroscope.noise
    noise = np.asarray(INSTRUMENTS["gyroscope"]["noise"] if noise is None else noise)
    payload_filter = PayloadFilter(
        system, plant.rate, delay=entries.rates.delay, gyroscope=float(np.sqrt(np.mean(noise**2)))
    )
    return AdaptiveController(pilot, payload_filter)


def default_servo_frequency(rates: RatesEntry) -> float:
    """Natural frequency of the panel's servo [rad/s]: 120, or less where commands act late.

    With the damping ratio 1 the servo's phase margin without delay is 76 degrees, at a crossover of 2.06
    times its frequency. Half a period of hold and the delay take 35 degrees of it at this frequency.
    """
    return min(120.0, 0.3 / (rates.delay + 0.5 / rates.control))


def _joint_gains(name: str, entry: JointServoEntry, usual: JointGains) -> JointGains:
    """Gains of a joint's servo; what is left out is usual."""
    numbers = entry.model_dump(exclude_none=True, exclude={"kind"})
    is_direct = entry.kind == "pd"
    if ("stiffness" in numbers) != is_direct or (is_direct and "frequency" in numbers):
        rule = "has 'frequency' and 'damping', and no stiffness"
        rule = "needs 'stiffness' and 'damping', and no frequency" if is_direct else rule
        raise SettingError(f"'controller.joints.{name}' of the kind {entry.kind} {rule}.")
    if is_direct:
        return JointGains(**numbers)
    ratio = numbers.pop("damping", usual.damping_ratio)
    return usual._replace(damping_ratio=ratio, **numbers)


def _make_servo(
    entry: ServoEntry, bodies: PanelBodies, rates: RatesEntry
) -> PanelServo | StrokeServo:
    numbers = entry.model_dump(exclude_none=True, exclude={"kind"})
    is_torque = entry.kind == "computed_torque"
    names = ("frequency" if is_torque else "stiffness", "damping")
    for name in numbers:
        if name not in names:
            raise SettingError(
                f"'controller.servo' of the kind {entry.kind} has no {name}; it has {' and '.join(names)}."
            )
    if is_torque:
        return PanelServo(bodies, **({"frequency": default_servo_frequency(rates)} | numbers))
    return StrokeServo(bodies, **numbers)


def check_faults(mission_file: MissionFile) -> None:
    """Raise `SettingError` for faults that contradict themselves or each other."""
    places: dict[str, FaultEntry] = {}
    for fault in sorted(mission_file.faults, key=lambda fault: fault.at):
        if sum(x is not None for x in (fault.rotor, fault.slider, fault.sensor)) != 1:
            raise SettingError("A fault needs one of a rotor, a slider and a sensor.")
        if fault.sensor is not None:
            _check_sensor_fault(mission_file, fault)
            continue
        if fault.bias is not None or fault.until is not None:
            raise SettingError(
                "'bias' and 'until' are for faults of sensors: leave them out of a fault of a rotor or slider."
            )
        if fault.slider is not None and fault.share is not None:
            raise SettingError("'share' is for faults of rotors: a jammed slider does not move.")
        if fault.known and (fault.rotor is None or fault.share):
            raise SettingError(
                "A fault that is 'known' must be the loss of a rotor, without a share of its thrust: "
                "the controller cannot compensate a jammed slider or a weak rotor."
            )
        place = f"Rotor {fault.rotor}" if fault.rotor is not None else f"Slider {fault.slider}"
        # Faults of one part are looked at in the order of time: one after a final fault, or at the
        # same time, would silently have no effect.
        before = places.get(place)
        if before is not None and before.at == fault.at:
            raise SettingError(
                f"{place} has two faults at t = {fault.at:g} s: leave one of them out."
            )
        if before is not None and (before.known or fault.slider is not None):
            raise SettingError(
                f"{place} {'is lost' if before.known else 'is jammed'} from t = {before.at:g} s on, so that "
                f"its fault at t = {fault.at:g} s has no effect: leave one of them out."
            )
        places[place] = fault


def _check_sensor_fault(entries: MissionFile, fault: FaultEntry) -> None:
    """Raise `SettingError` for a fault of a sensor that the mission cannot have."""
    if entries.sensors is None:
        raise SettingError("A fault of a sensor needs a mission with [sensors].")
    if fault.known or fault.share is not None:
        raise SettingError(
            "'known' and 'share' are for faults of rotors: leave them out of a fault of a sensor."
        )
    if fault.until is not None and fault.until <= fault.at:
        raise SettingError(
            f"A fault of a sensor must end after it begins, but it lasts from {fault.at:g} to {fault.until:g} s."
        )


def _add_faults(entries: MissionFile, machine: Machine, pilot: Any) -> MissionController:
    count, jammed = machine.rotors.spin.shape[0], np.full(2, np.inf)
    of_rotors: list[list[tuple[float, float]]] = [[] for _ in range(count)]
    for fault in sorted(entries.faults, key=lambda fault: fault.at):
        if fault.slider is not None:
            jammed[fault.slider - 2] = fault.at
        if fault.rotor is None:
            continue
        if fault.rotor > count:
            raise SettingError(
                f"The machine has rotors 1 to {count}, but no rotor {fault.rotor} to fail."
            )
        of_rotors[fault.rotor - 1].append((fault.at, fault.share or 0.0))
    # a row for each rotor, its faults in the order of their times, filled up with faults that never come
    most = max(1, *map(len, of_rotors))
    rows = [[*faults, *[(np.inf, 1.0)] * (most - len(faults))] for faults in of_rotors]
    # Arrays of times and shares, padded: the number of faults is structure, their times and sizes
    # are numbers that a study may draw.
    lost, share = np.moveaxis(np.array(rows), -1, 0)
    # A lost rotor stands still, which motors with a lowest speed could not.
    motors = getattr(only_rotors(machine.scene.system, "A mission"), "limits", None)
    if np.any(np.isfinite(lost)) and motors is not None and np.max(np.asarray(motors.lowest)) > 0:
        raise SettingError(
            "A rotor that fails turns more slowly than the motors' lowest speed: give "
            "'options.motor = {lowest = 0.0}' (a model's motors 'lowest = 0.0'), and the controller's limit as "
            "'controller.lowest'."
        )
    jam = None
    if np.any(np.isfinite(jammed)):
        if entries.sensors is not None:
            raise SettingError(
                "A jammed slider needs true states: leave [sensors] out of the mission."
            )
        assert machine.bodies is not None
        jam = Jam(machine.bodies.geometry, jnp.asarray(jammed))
    # a servo's input is a target, which no limit of its effort cuts off
    is_effort = np.array([drive.is_effort for drive in machine.joints], bool)
    force = np.where(is_effort, machine.efforts, np.inf)
    if machine.bodies is not None:
        force = np.full(2, np.inf if machine.force is None else machine.force)
    rotors = machine.rotors if machine.rotors.has_curves else None
    return MissionController(
        pilot, as_floats(lost), as_floats(share), jam, as_floats(force), rotors
    )
