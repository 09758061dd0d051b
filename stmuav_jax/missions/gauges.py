"""Signals of a mission's flight: errors from the reference, speeds, strokes, powers."""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..control.adaptation.adaptive import AdaptiveMemory
from ..control.estimator import MotionEstimate
from ..control.panel import PanelBodies, panel_motion
from ..control.rolling import Sample
from ..mechanics.forces.contact import GroundContact
from ..mechanics.internal import internal_names
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.energy import ENERGY
from ..rotorcraft.power import drag_power
from ..sensing.sensors import gravity_of
from ..tracker.kinematics import PairMotion, panel_normal, stroke_motion
from .disturbance import wanted_panel
from .machine import Machine
from .reference import MissionReference

_AXES, _ROTORS = ("time", "axis"), ("time", "rotor")
_ANGLES, _SLIDERS, _TIME = ("time", "panel_angle"), ("time", "slider"), ("time",)
# Dimensions, unit and description of each signal.
GAUGES: dict[str, tuple[tuple[str, ...], str, str]] = {
    "wanted_position": (_AXES, "m", "reference of the base, world axes"),
    "position_error": (_AXES, "m", "of the base from its reference, world axes"),
    "wanted_heading": (_TIME, "rad", "reference of the base's yaw"),
    "heading_error": (_TIME, "rad", "of the base's yaw from its reference"),
    "tilt_error": (_TIME, "rad", "angle of the base's z axis from the thrust that the path needs"),
    "rotor_speed": (_ROTORS, "rad/s", "speeds of the rotors, as commanded if motors have no lag"),
    "rotor_power": (_TIME, "W", "mechanical power of all rotors"),
    "electric_power": (_TIME, "W", "of motors, actuators that push, and electronics"),
    "estimated_position": (_AXES, "m", "of the base, by the estimator"),
    "panel_angles": (_ANGLES, "rad", "of the panel in the base's axes"),
    "wanted_panel_angles": (_ANGLES, "rad", "reference of the panel, at the base's true attitude"),
    "panel_error": (_TIME, "rad", "angle of the panel's normal from its reference"),
    "displacement": (_SLIDERS, "m", "of the sliders from the initial posture"),
    "wanted_force": (_SLIDERS, "N", "that the servo asks of the actuators, before their limits"),
    "actuator_power": (_TIME, "W", "mechanical power of both actuators"),
    "gear_load": (_TIME, "N", "of the ground on all feet of the landing gear, upwards"),
    "gear_depth": (_TIME, "m", "of the lowest foot below the ground's height, negative in flight"),
    "payload_mass": (_TIME, "kg", "mass of the payload, estimated"),
    "payload_mass_deviation": (_TIME, "kg", "standard deviation of payload_mass"),
    "payload_moment": (_AXES, "kg m", "first moment of the payload, estimated; its carrier's axes"),
    "payload_moment_deviation": (_AXES, "kg m", "standard deviation of payload_moment"),
    "centre_of_mass": (_AXES, "m", "of all bodies from the base's, base axes"),
    "believed_centre_of_mass": (_AXES, "m", "centre of mass that was fed forward"),
}


class Gauges(eqx.Module):
    """Function of a `Sample` that returns the signals of `GAUGES` that a machine has.

    Attributes:
        k_tau: drag torque coefficient of the rotors [N m s^2/rad^2]. rotors: their number.
        bodies: of the tracker, and home: strokes at the start (2,) [m]; None without a tracker.
        gravity: acceleration of free fall (3,) [m/s^2].
        efficiency: of the motors [1]. other: power of everything else [W].
        mass: of the bodies (n,) [kg].
        places: places of the rotor speeds among the states of force elements; none without lag.
        grounded: system of a machine with a landing gear, else None.
    """

    k_tau: Float[Array, ""]
    bodies: PanelBodies | None
    home: Float[Array, "2"] | None
    gravity: Float[Array, "3"]
    efficiency: Float[Array, ""]
    other: Float[Array, ""]
    grounded: System | None
    mass: Float[Array, " n"]
    places: tuple[int, ...] = eqx.field(static=True)
    rotors: int = eqx.field(static=True)

    def __init__(self, machine: Machine, system: System) -> None:
        self.k_tau, self.bodies = machine.rotors.k_tau, machine.bodies
        self.home = None if machine.limits is None else machine.limits.home
        self.gravity, self.mass = gravity_of(system), system.bodies.mass
        self.efficiency = jnp.asarray(ENERGY.value("rotor.efficiency"), dtype=float)
        self.other = jnp.asarray(ENERGY.value("other.power"), dtype=float)
        names = internal_names(system)
        self.places = tuple(k for k, name in enumerate(names) if ": speed of rotor " in name)
        self.rotors = machine.rotors.spin.shape[0]
        has_gear = any(isinstance(force, GroundContact) for force in system.forces)
        self.grounded = system if has_gear else None

    def __call__(self, sample: Sample) -> dict[str, Any]:
        """Signals by name."""
        state, wanted = sample.state, sample.reference.waypoint
        R = rotation_matrix(state.p[0])
        yaw = jnp.arctan2(R[1, 0], R[0, 0]) - wanted.heading
        if self.places:
            squared = sample.internal[jnp.array(self.places)] ** 2
        else:
            squared = sample.inputs[: self.rotors]
        power = jnp.sum(drag_power(squared, self.k_tau))
        found = {
            "wanted_position": wanted.r,
            "position_error": state.r[0] - wanted.r,
            "wanted_heading": wanted.heading,
            "heading_error": jnp.arctan2(jnp.sin(yaw), jnp.cos(yaw)),
            "tilt_error": _between(R[:, 2], wanted.a - self.gravity),
            "rotor_speed": jnp.sqrt(squared),
            "rotor_power": power,
        }
        if isinstance(sample.estimate, MotionEstimate):
            found["estimated_position"] = sample.estimate.state.r[0]
        if self.grounded is not None:
            found |= gear_signals(self.grounded, state)
        flight = getattr(sample.memory, "flight", None)
        if isinstance(flight, AdaptiveMemory):
            found |= self._payload(state, flight)
        pushing = jnp.zeros(())
        if self.bodies is not None:
            own = self._panel(state, sample.reference, sample.inputs[self.rotors :])
            own["wanted_force"] = sample.memory.asked
            pushing = jnp.maximum(own["actuator_power"], 0.0)
            found |= own
        return found | {"electric_power": power / self.efficiency + pushing + self.other}

    def _payload(self, state: State, memory: AdaptiveMemory) -> dict[str, Any]:
        spread = jnp.sqrt(jnp.diagonal(memory.payload.covariance))
        centre = self.mass @ (state.r - state.r[0]) / jnp.sum(self.mass)
        return {
            "payload_mass": memory.payload.mean[3],
            "payload_mass_deviation": spread[3],
            "payload_moment": memory.payload.mean[4:7],
            "payload_moment_deviation": spread[4:7],
            "centre_of_mass": rotation_matrix(state.p[0]).T @ centre,
            "believed_centre_of_mass": memory.centre,
        }

    def _panel(
        self, state: State, reference: MissionReference, forces: Float[Array, "2"]
    ) -> dict[str, Any]:
        assert self.bodies is not None
        assert self.home is not None
        angles, wanted = panel_motion(state), wanted_panel(reference, state)
        moved = stroke_motion(self.bodies.geometry, angles)
        target = reference.panel
        if isinstance(target, PairMotion):
            error = _between(panel_normal(angles.value), panel_normal(target.value))
        else:
            assert target is not None
            error = _between(rotation_matrix(state.p[-1])[:, 2], target.value)
        return {
            "panel_angles": angles.value,
            "wanted_panel_angles": wanted.value,
            "panel_error": error,
            "displacement": moved.value - self.home,
            "actuator_power": forces @ moved.rate,
        }


def gear_signals(system: System, state: State) -> dict[str, Any]:
    """Load on a landing gear [N] and depth of its lowest foot [m]."""
    kin = system.kinematics(state)
    contacts = [force for force in system.forces if isinstance(force, GroundContact)]
    loads = [jnp.sum(force.normal_forces(kin)) for force in contacts]
    depths = [jnp.max(force.depths(kin)) for force in contacts]
    return {"gear_load": sum(loads), "gear_depth": jnp.max(jnp.stack(depths))}


def _between(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, ""]:
    """Angle between two directions of any length [rad]."""
    across = jnp.cross(a, b)
    return jnp.arctan2(jnp.sqrt(jnp.sum(across * across)), jnp.sum(a * b))
