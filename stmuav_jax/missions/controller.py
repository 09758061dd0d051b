"""Controller of a mission: references of the base's path and the panel's moves, air that moves, and faults."""

import math
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..control.references import Waypoint, at_point, follow_path, quintic_share
from ..math.derivative import motion_along
from ..math.rotation import rotation_matrix
from ..math.sampled import Sampled, evaluate_piecewise
from ..mechanics.state import State
from ..uav.adaptation import AdaptiveController, AdaptiveMemory
from ..uav.flight_controller import FlightController, FlightMemory, UavController, UavReference
from ..uav.joint_controller import JointController, JointMotions, JointReference
from ..uav.panel_servo import panel_motion
from ..uav.rotor import Rotors
from ..uav.tracker.geometry import TrackerGeometry
from ..uav.tracker.kinematics import PairMotion, panel_angles, stroke_motion

# Round-off of times [s].
AT_ONCE = 1e-9


class HeldPath(eqx.Module):
    """Path that holds a place, or leaves it with a constant acceleration.

    Attributes:
        r: place at t = 0 (3,) [m]. a: acceleration (3,) [m/s^2]. heading: yaw [rad].
    """

    r: Float[Array, "3"]
    a: Float[Array, "3"]
    heading: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Waypoint:
        result = at_point(self.r, self.heading)
        return result._replace(r=self.r + t**2 / 2 * self.a, v=t * self.a, a=self.a)


class WaypointPath(eqx.Module):
    """Path of the least integral of squared snap through waypoints, at rest at both ends.

    It is a spline of degree 7 in position and heading; before the first waypoint and after the last
    it holds them. From waypoint to waypoint the heading turns the nearer way round.

    Args:
        ts: times of the waypoints (k,), rising [s]. places: position [m] and heading [rad] (k, 4).

    Raises:
        SettingError: fewer than two waypoints, or times that do not rise.

    Source: D. Mellinger, V. Kumar, Minimum snap trajectory generation and control for quadrotors,
    IEEE Conference on Robotics and Automation (2011), section IV; I. J. Schoenberg's natural splines.
    """

    breaks: Float[Array, " k"]
    coefficients: Float[Array, "8 s 4"]

    def __init__(self, ts: np.ndarray, places: np.ndarray) -> None:
        if len(ts) < 2 or np.any(np.diff(ts) <= 0):
            raise SettingError(
                "The waypoints of a path must be two or more, with times that rise, but the times are "
                f"{np.asarray(ts).tolist()} s."
            )
        # imported here, because SciPy's interpolation is slow to import
        from scipy.interpolate import make_interp_spline

        # Headings are unwrapped, so that the spline takes the shorter turn.
        places = np.column_stack([places[:, :3], np.unwrap(places[:, 3])])
        rest = [(order, np.zeros(4)) for order in (1, 2, 3)]
        spline = make_interp_spline(ts, places, k=7, bc_type=(rest, rest))
        rows = [spline(ts[:-1], nu=k) / math.factorial(k) for k in range(7, -1, -1)]
        self.breaks, self.coefficients = jnp.asarray(ts, float), jnp.asarray(np.stack(rows))

    def place(self, t: Float[Array, ""]) -> Float[Array, "4"]:
        """Position [m] and heading [rad] at a time [s]."""
        # Outside of its waypoints the path holds their places: a polynomial would run away.
        t = jnp.clip(t, self.breaks[0], self.breaks[-1])
        return evaluate_piecewise(self.breaks, self.coefficients, t)

    def __call__(self, t: Float[Array, ""]) -> Waypoint:
        return follow_path(lambda t: self.place(t)[:3], lambda t: self.place(t)[3])(t)


class DirectionMotion(NamedTuple):
    """Motion of a direction of the world: values, rates and accelerations, each (3,)."""

    value: Float[Array, "3"]
    rate: Float[Array, "3"]
    acceleration: Float[Array, "3"]


class PanelMoves(eqx.Module):
    """Moves of the panel one after the other, each with rest at its beginning and end.

    In the base's axes the moves are between panel angles (2,); in the world, between directions of
    any length (3,). A target may itself move.

    Attributes:
        start: angles or direction before the first move.
        targets: constant or function of t [s] for each move.
        ats, durations: beginnings and durations of the moves [s].
        world: true for directions of the world.
        shapes: coefficients of the shape of each move (k,), see `stmuav_jax.control.Slew`; empty where
            all are quintics.
    """

    start: Float[Array, " n"]
    targets: tuple[Float[Array, " n"] | Sampled, ...]
    ats: tuple[Float[Array, ""], ...]
    durations: tuple[Float[Array, ""], ...]
    world: bool = eqx.field(static=True)
    shapes: tuple[Float[Array, " _"], ...] = ()

    def value(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """Target angles [rad] or direction (n,) at a time [s]."""
        result, shapes = self.start, self.shapes or (jnp.zeros(0),) * len(self.targets)
        for target, at, duration, shape in zip(
            self.targets, self.ats, self.durations, shapes, strict=True
        ):
            # Each move starts from the value of all before it: a target that moves, such as the
            # sun, is followed after its move without a case of its own.
            s = jnp.clip((t - at) / duration, 0.0, 1.0)
            goal = target(t) if callable(target) else target
            result = result + quintic_share(s, shape) * (goal - result)
        return result

    def __call__(self, t: Float[Array, ""]) -> PairMotion | DirectionMotion:
        """Target motion of the angles [rad], or of the direction."""
        motion = motion_along(self.value, t)
        return DirectionMotion(*motion) if self.world else PairMotion(*motion)


def facing_motion(target: DirectionMotion, state: State) -> PairMotion:
    """Panel angles that face a moving direction of the world, their rates and accelerations.

    The base's own angular acceleration is left out.
    """
    R_bw, omega = rotation_matrix(state.p[0]).T, state.omega[0]
    across = lambda x: jnp.cross(omega, x)
    direction, rate = R_bw @ target.value, R_bw @ target.rate
    # Rates in turning axes: the panel must turn against the base to keep a direction of the world.
    first = rate - across(direction)
    second = R_bw @ target.acceleration - 2 * across(rate) + across(across(direction))

    def angles_at(s: Array) -> Array:
        return panel_angles(direction + s * first + s**2 / 2 * second)

    return PairMotion(*motion_along(angles_at, jnp.zeros(())))


class JointMoves(eqx.Module):
    """Moves of joints, each joint's one after the other; a function of t [s].

    Attributes:
        moves: moves of each joint, of a single value.
    """

    moves: tuple[PanelMoves, ...]

    def __call__(self, t: Float[Array, ""]) -> JointMotions:
        """Target motion of all joints (n,)."""
        return JointMotions(*motion_along(self.value, t))

    def value(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """Target values (n,) [rad] or [m] at a time [s]."""
        return jnp.concatenate([of_joint.value(t) for of_joint in self.moves])


class MissionReference(NamedTuple):
    """Reference of a mission at one time: time [s], waypoint, and motion of panel and of joints, or None."""

    t: Float[Array, ""]
    waypoint: Waypoint
    panel: PairMotion | DirectionMotion | None
    joints: JointMotions | None = None


class References(eqx.Module):
    """Function of t [s] that returns the `MissionReference`."""

    path: HeldPath | WaypointPath
    panel: PanelMoves | None
    joints: JointMoves | None = None

    def __call__(self, t: Float[Array, ""]) -> MissionReference:
        panel = None if self.panel is None else self.panel(t)
        joints = None if self.joints is None else self.joints(t)
        return MissionReference(t, self.path(t), panel, joints)


# Stiffness [N/m] and damping [N s/m] with which a jammed slider is held.
JAM = (2e4, 200.0)


class Jam(eqx.Module):
    """Slider that is held, from a time [s] on, where it was.

    Attributes:
        geometry: lengths of the tracker. at: time of the fault of each slider (2,) [s], infinite
            for none.
    """

    geometry: TrackerGeometry
    at: Float[Array, "2"]

    def forces(
        self,
        t: Float[Array, ""],
        state: State,
        forces: Float[Array, "2"],
        held_strokes: Float[Array, "2"],
    ) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Forces of the actuators [N], and the strokes at which sliders are held [m]."""
        now = stroke_motion(self.geometry, panel_motion(state))
        # The stroke at the fault is stored by the first sample after it. A force holds it, since a
        # joint cannot be locked within a compiled flight.
        jammed = t >= self.at
        held_strokes = jnp.where(
            jammed & jnp.isfinite(held_strokes), held_strokes, jnp.where(jammed, now.value, jnp.inf)
        )
        pull = JAM[0] * (jnp.where(jammed, held_strokes, now.value) - now.value) - JAM[1] * now.rate
        return jnp.where(jammed, pull, forces), held_strokes


Pilot = FlightController | UavController | AdaptiveController | JointController


class MissionMemory(NamedTuple):
    """Memory of a mission's controller.

    Attributes:
        flight: memory of the pilot.
        held_strokes: strokes of jammed sliders (2,) [m], infinite for others.
        commanded: forces that the servo last commanded, or inputs of a model's joints (a,).
    """

    flight: FlightMemory | AdaptiveMemory
    held_strokes: Float[Array, "2"]
    commanded: Float[Array, " a"]


class PilotChange(NamedTuple):
    """Controller from a time [s] on, whose model has the lost rotors."""

    at: Float[Array, ""]
    pilot: Pilot


class MissionController(eqx.Module):
    """Controller of a mission whose commands pass the limits of its actuators and its faults, which its model
    may include.

    Attributes:
        pilot: controller of the machine. pilot_changes: those that follow it, by rising times.
        lost: rising times of the faults of each rotor (k, f) [s], infinite for none.
        share: share of its thrust that it keeps from each on (k, f).
        jam: faults of the sliders, or None.
        rotors: rotors with curves, which keep a share of their thrust; None for a share of the squared speed.
        force: largest force of each actuator of the tracker, or effort of each driven joint of a model,
            either way (a,) [N] or [N m], infinite for no limit.
    """

    pilot: Pilot
    lost: Float[Array, "k f"]
    share: Float[Array, "k f"]
    jam: Jam | None
    force: Float[Array, " a"]
    rotors: Rotors | None = None
    pilot_changes: tuple[PilotChange, ...] = ()

    def start(self) -> MissionMemory:
        """First memory."""
        # not weakly typed, as no later memory is: a flight's program is compiled for one type
        zeros = jnp.zeros(jnp.shape(self.force), dtype=float)
        return MissionMemory(self.pilot.start(), jnp.full(2, jnp.inf, dtype=float), zeros)

    def __call__(
        self, estimate: Any, reference: MissionReference, memory: MissionMemory
    ) -> tuple[Float[Array, " m"], MissionMemory]:
        """Inputs of the machine (m,), and the memory."""
        t, jam_strokes = reference.t, memory.held_strokes
        inputs, after = _command_pilot(self.pilot, estimate, reference, memory.flight)
        for pilot_change in self.pilot_changes:
            # the parts that all pilots share are compiled once
            candidate = _command_pilot(pilot_change.pilot, estimate, reference, memory.flight)
            choose = lambda new, old, late=t >= pilot_change.at: jnp.where(late, new, old)
            inputs, after = jax.tree.map(choose, candidate, (inputs, after))
        k, faults = self.lost.shape
        # Faults act behind the controller, on its commands: it is not informed of them.
        share = jnp.ones(k)
        for fault in range(faults):
            share = jnp.where(t >= self.lost[:, fault], self.share[:, fault], share)
        rotors = share * inputs[:k]
        if self.rotors is not None:
            weakened = self.rotors.squared_speeds(share * self.rotors.thrusts(inputs[:k]))
            rotors = jnp.where(share == 0, 0.0, jnp.where(share == 1, inputs[:k], weakened))
        demanded_forces = inputs[k:]
        forces = jnp.clip(demanded_forces, -self.force, self.force)
        if self.jam is not None:
            forces, jam_strokes = self.jam.forces(t, estimate, forces, jam_strokes)
        return jnp.concatenate([rotors, forces]), MissionMemory(after, jam_strokes, demanded_forces)


def _command_pilot(pilot: Any, estimate: Any, reference: MissionReference, memory: Any) -> Any:
    inner_pilot = pilot.controller if isinstance(pilot, AdaptiveController) else pilot
    if isinstance(inner_pilot, FlightController):
        return pilot(estimate, reference.waypoint, memory)
    if isinstance(inner_pilot, JointController):
        assert reference.joints is not None
        return pilot(estimate, JointReference(reference.waypoint, reference.joints), memory)
    panel = compute_panel_reference(reference, getattr(estimate, "state", estimate))
    return pilot(estimate, UavReference(reference.waypoint, panel), memory)


def compute_panel_reference(reference: MissionReference, state: State) -> PairMotion:
    """Reference motion of the panel angles, at the base's attitude in a state."""
    target = reference.panel
    assert target is not None
    return target if isinstance(target, PairMotion) else facing_motion(target, state)
