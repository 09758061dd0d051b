"""Signals of a mission's flight: errors from the reference, speeds, strokes, powers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..analysis.sensors import gravity_of
from ..checks.numbers import as_floats
from ..control.closed_loop import Sample
from ..math.rotation import rotation_matrix
from ..mechanics.forces import GroundContact
from ..mechanics.internal import internal_names
from ..mechanics.joint_forces import JointServo
from ..mechanics.system import System
from ..studies.signal import angle_between
from ..uav.adaptation import AdaptiveMemory
from ..uav.airframe import ENERGY
from ..uav.joint_controller import DrivenJoint, joint_errors, read_joints
from ..uav.motion_estimator import MotionEstimate
from ..uav.panel_servo import PanelBodies, panel_motion
from ..uav.rotor import Rotors
from ..uav.tracker.kinematics import PairMotion, panel_normal, stroke_motion
from .controller import compute_panel_reference
from .machine import Machine
from .payloads import Payloads

_AXES, _ROTORS = ("time", "axis"), ("time", "rotor")
_JOINTS = ("time", "driven_joint")
_ANGLES, _SLIDERS, _TIME = ("time", "panel_angle"), ("time", "slider"), ("time",)
# Units of the signals of joints: coordinates with the unit of each joint, where hinges and slides have several.
JOINT_UNIT, EFFORT_UNIT = "see driven_joint_unit", "see driven_joint_effort_unit"
# Dimensions, unit and description of each signal.
GAUGES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "reference_position": (_AXES, "m", "reference of the base, world axes"),
    "position_error": (_AXES, "m", "of the base from its reference, world axes"),
    "reference_heading": (_TIME, "rad", "reference of the base's yaw"),
    "heading_error": (_TIME, "rad", "of the base's yaw from its reference"),
    "tilt_error": (_TIME, "rad", "angle of the base's z axis from the thrust that the path needs"),
    "rotor_speed": (
        _ROTORS,
        "rad/s",
        "speeds of the rotors, as commanded before the delay if motors have no lag",
    ),
    "gyroscope": (_AXES, "rad/s", "readings of the base's gyroscope, its axes"),
    "accelerometer": (_AXES, "m/s^2", "readings of the base's accelerometer, its axes"),
    "rotor_power": (_TIME, "W", "mechanical power of all rotors"),
    "electric_power": (_TIME, "W", "of motors, actuators and joints that push, and electronics"),
    "estimated_position": (_AXES, "m", "of the base, by the estimator"),
    "panel_angles": (_ANGLES, "rad", "of the panel in the base's axes"),
    "reference_panel_angles": (
        _ANGLES,
        "rad",
        "reference of the panel, at the base's true attitude",
    ),
    "panel_error": (_TIME, "rad", "angle of the panel's normal from its reference"),
    "displacement": (_SLIDERS, "m", "of the sliders from the initial posture"),
    "commanded_force": (_SLIDERS, "N", "that the servo asks of the actuators, before their limits"),
    "actuator_power": (_TIME, "W", "mechanical power of both actuators"),
    "joint_position": (_JOINTS, JOINT_UNIT, "coordinates of driven joints"),
    "reference_joint_position": (_JOINTS, JOINT_UNIT, "reference of the driven joints"),
    "joint_error": (_JOINTS, JOINT_UNIT, "of the driven joints from their reference"),
    "commanded_effort": (_JOINTS, EFFORT_UNIT, "efforts in joints, before their limits"),
    "joint_power": (_TIME, "W", "mechanical power of the efforts in joints, within their limits"),
    "gear_load": (_TIME, "N", "of the ground on all feet of the landing gear, upwards"),
    "gear_depth": (_TIME, "m", "of the lowest foot below the ground's height, negative in flight"),
    "payload_mass": (_TIME, "kg", "mass of the payload, estimated"),
    "payload_mass_deviation": (_TIME, "kg", "standard deviation of payload_mass"),
    "payload_moment": (_AXES, "kg m", "first moment of the payload, estimated; its carrier's axes"),
    "payload_moment_deviation": (_AXES, "kg m", "standard deviation of payload_moment"),
    "centre_of_mass": (_AXES, "m", "of all bodies from the base's, base axes"),
    "estimated_centre_of_mass": (_AXES, "m", "centre of mass that was fed forward"),
}


class Gauges(eqx.Module):
    """Function of a `Sample` that returns the signals of `GAUGES` that a machine has.

    Attributes:
        rotors: their curves.
        bodies: of the tracker, and home: strokes at the start (2,) [m]; None without a tracker.
        gravity: acceleration of free fall (3,) [m/s^2].
        efficiency: of the motors [1]. other: power of everything else [W].
        mass: of the bodies (n,) [kg], at the start. payloads: those that are picked up or dropped, or None.
        base: name of the base. places: places of the rotor speeds among the states of force elements; none without lag.
        grounded: system of a machine with a landing gear, else None.
        jointed: system of a machine with driven joints, else None. joints: these.
        efforts: largest efforts of the joints (n,).
    """

    rotors: Rotors
    bodies: PanelBodies | None
    home: Float[Array, "2"] | None
    gravity: Float[Array, "3"]
    efficiency: Float[Array, ""]
    other: Float[Array, ""]
    grounded: System | None
    jointed: System | None
    efforts: Float[Array, " n"]
    mass: Float[Array, " n"]
    payloads: Payloads | None
    base: str = eqx.field(static=True)
    places: tuple[int, ...] = eqx.field(static=True)
    joints: tuple[DrivenJoint, ...] = eqx.field(static=True)

    def __init__(self, machine: Machine, system: System, payloads: Payloads | None = None) -> None:
        self.payloads = payloads
        self.rotors, self.bodies = machine.rotors, machine.bodies
        self.home = None if machine.limits is None else machine.limits.home
        self.gravity, self.mass = gravity_of(system), system.bodies.mass
        self.efficiency = jnp.asarray(ENERGY.value("rotor.efficiency"), dtype=float)
        self.other = jnp.asarray(ENERGY.value("other.power"), dtype=float)
        self.base, names = system.names[0], internal_names(system)
        self.places = tuple(k for k, name in enumerate(names) if ": speed of rotor " in name)
        has_gear = any(isinstance(force, GroundContact) for force in system.forces)
        self.grounded = system if has_gear else None
        self.jointed, self.joints = system if machine.joints else None, machine.joints
        self.efforts = as_floats(machine.efforts)

    def __call__(self, sample: Sample) -> dict[str, Any]:
        """Signals by name."""
        state, targets = sample.state, sample.reference.waypoint
        R, count = rotation_matrix(state.p[0]), self.rotors.spin.shape[0]
        yaw = jnp.arctan2(R[1, 0], R[0, 0]) - targets.heading
        if self.places:
            squared = sample.internal[jnp.array(self.places)] ** 2
        else:
            squared = sample.held_inputs[:count]
        power = jnp.sum(self.rotors.power(squared))
        result = {
            "reference_position": targets.r,
            "position_error": state.r[0] - targets.r,
            "reference_heading": targets.heading,
            "heading_error": jnp.arctan2(jnp.sin(yaw), jnp.cos(yaw)),
            "tilt_error": angle_between(R[:, 2], targets.a - self.gravity),
            "rotor_speed": jnp.sqrt(squared),
            "rotor_power": power,
        }
        if isinstance(sample.estimate, MotionEstimate):
            result["estimated_position"] = sample.estimate.state.r[0]
            for kind in ("gyroscope", "accelerometer"):
                result[kind] = sample.readings[f"{kind} {self.base}"].value
        if self.grounded is not None:
            kin = self.grounded.kinematics(state)
            contacts = [f for f in self.grounded.forces if isinstance(f, GroundContact)]
            result["gear_load"] = sum(jnp.sum(contact.normal_forces(kin)) for contact in contacts)
            depths = [jnp.max(contact.depths(kin)) for contact in contacts]
            result["gear_depth"] = jnp.max(jnp.stack(depths))
        flight = getattr(sample.memory, "flight", None)
        if isinstance(flight, AdaptiveMemory):
            payload, payloads = flight.payload, self.payloads
            spread = jnp.sqrt(jnp.diagonal(payload.covariance))
            mass = self.mass if payloads is None else payloads.masses_of_all(self.mass, sample.t)
            centre = mass @ (state.r - state.r[0]) / jnp.sum(mass)
            result |= {
                "payload_mass": payload.mean[3], "payload_mass_deviation": spread[3],
                "payload_moment": payload.mean[4:7], "payload_moment_deviation": spread[4:7],
                "centre_of_mass": R.T @ centre, "estimated_centre_of_mass": flight.centre,
            }  # fmt: skip
        pushing = jnp.zeros(())
        if self.bodies is not None:
            panel_signals, powers = self._panel_signals(sample, sample.held_inputs[count:])
            # each actuator of its own: what one brakes does not drive the other
            pushing = jnp.sum(jnp.maximum(powers, 0.0))
            result |= panel_signals
        if self.jointed is not None:
            joint_signals, powers = self._joint_signals(self.jointed, sample)
            pushing = pushing + jnp.sum(jnp.maximum(powers, 0.0))
            result |= joint_signals | {"joint_power": jnp.sum(powers)}
        return result | {"electric_power": power / self.efficiency + pushing + self.other}

    def _joint_signals(
        self, system: System, sample: Sample
    ) -> tuple[dict[str, Any], Float[Array, " n"]]:
        """Signals of the driven joints, and the powers of their efforts (n,) [W]."""
        values, rates = read_joints(system, self.joints, sample.state)
        targets = sample.reference.joints.value
        commands = sample.held_inputs[self.rotors.spin.shape[0] :]
        efforts = []
        for k, drive in enumerate(self.joints):
            force = system.forces[drive.force]
            if isinstance(force, JointServo):
                lag = values[k] - commands[k]
                efforts.append(-force.stiffness * lag - force.damping * rates[k])
            else:
                efforts.append(sample.memory.commanded[k])
        demanded_efforts = jnp.stack(efforts)
        signals = {
            "joint_position": values,
            "reference_joint_position": targets,
            "joint_error": joint_errors(self.joints, values, targets),
            "commanded_effort": demanded_efforts,
        }
        return signals, jnp.clip(demanded_efforts, -self.efforts, self.efforts) * rates

    def _panel_signals(
        self, sample: Sample, forces: Float[Array, "2"]
    ) -> tuple[dict[str, Any], Float[Array, "2"]]:
        """Signals of the panel, and the powers of its actuators (2,) [W]."""
        assert self.bodies is not None
        assert self.home is not None
        state, target = sample.state, sample.reference.panel
        angles, targets = panel_motion(state), compute_panel_reference(sample.reference, state)
        slider_motion = stroke_motion(self.bodies.geometry, angles)
        if isinstance(target, PairMotion):
            error = angle_between(panel_normal(angles.value), panel_normal(target.value))
        else:
            assert target is not None
            error = angle_between(rotation_matrix(state.p[-1])[:, 2], target.value)
        signals = {
            "panel_angles": angles.value,
            "reference_panel_angles": targets.value,
            "panel_error": error,
            "displacement": slider_motion.value - self.home,
            "commanded_force": sample.memory.commanded,
            "actuator_power": forces @ slider_motion.rate,
        }
        return signals, forces * slider_motion.rate
