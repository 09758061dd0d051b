"""A scene in plain NumPy numbers, from which every peer builds its own model.

All is measured from the bodies' centres of mass, in body axes, so that a peer needs no
reference frames. Ground is body n, at the origin.
"""

import timeit
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy.spatial.transform import Rotation

from stmuav_jax import AppliedForce, AppliedMoment, Gravity, LinearSpringDamper, Scene, State
from stmuav_jax.mechanics import JointServo, Sine
from stmuav_jax.uav import LinearActuator, Rotors

# Rows that each joint removes; also the joints that a peer has to know.
ROWS = {"translational": 5, "revolute": 5, "universal": 4, "spherical": 3}


class UnsupportedError(Exception):
    """A scene holds something that our adapters for the peers do not hand over."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what} is not supported by our adapters.")


@dataclass(frozen=True)
class Sinus:
    """The signal amplitude * sin(rate * t + phase)."""

    amplitude: np.ndarray
    rate: float
    phase: float

    def __call__(self, t: float) -> np.ndarray:
        return self.amplitude * np.sin(self.rate * t + self.phase)


@dataclass(frozen=True)
class PlainJoint:
    """A joint: name, kind, bodies, and on each body a point (3,) [m] and a frame (3, 3)."""

    name: str
    kind: str
    i: int
    j: int
    point_i: np.ndarray
    point_j: np.ndarray
    frame_i: np.ndarray
    frame_j: np.ndarray


@dataclass(frozen=True)
class Actuator:
    """A force pair along the base's z axis through the point `arm` of the base.

    paired: whether the slider feels the couple, too; the report's printed equations leave it out.
    """

    base: int
    slider: int
    arm: np.ndarray
    force: Sinus
    paired: bool = True


@dataclass(frozen=True)
class Spring:
    """A spring and damper between points of two bodies: [N/m], [N s/m], length at rest [m]."""

    i: int
    j: int
    point_i: np.ndarray
    point_j: np.ndarray
    stiffness: float
    damping: float
    length: float


@dataclass(frozen=True)
class Servo:
    """The force -k (x - target) - c x_rate on the displacement x of a translational joint.

    joint: its number. stiffness k [N/m], damping c [N s/m], target [m].
    """

    joint: int
    stiffness: float
    damping: float
    target: float


@dataclass(frozen=True)
class Plain:
    """Bodies, joints and loads of a scene.

    Attributes:
        mass (n,) [kg], inertia (n, 3, 3) [kg m^2].
        wrenches: (body, force, moment), constant in body axes.
        forces: (body, force), at the centre of mass in world axes.
        moments: (body, moment), constant in world axes.
    """

    names: tuple[str, ...]
    mass: np.ndarray
    inertia: np.ndarray
    joints: tuple[PlainJoint, ...]
    gravity: np.ndarray
    wrenches: tuple[tuple[int, np.ndarray, np.ndarray], ...]
    actuators: tuple[Actuator, ...]
    forces: tuple[tuple[int, Sinus], ...]
    moments: tuple[tuple[int, np.ndarray], ...] = ()
    springs: tuple[Spring, ...] = ()
    servos: tuple[Servo, ...] = ()

    @property
    def n(self) -> int:
        """Number of moving bodies."""
        return len(self.names)


def start(scene: Scene) -> State:
    """The scene's initial state in NumPy."""
    return jax.tree.map(np.asarray, scene.state0)


def axes(p: Any) -> np.ndarray:
    """Body-to-world rotations (..., 3, 3) of Euler parameters."""
    return Rotation.from_quat(p, scalar_first=True).as_matrix()


def plain(scene: Scene, *, any_couple: bool = False) -> Plain:
    """The scene in plain numbers; actuators without a consistent couple only with `any_couple`.

    Raises:
        UnsupportedError: a joint or force that no adapter hands over.
    """
    system = scene.system
    com = np.concatenate([np.asarray(system.bodies.com, dtype=float), np.zeros((1, 3))])
    index = {name: k for k, name in enumerate((*system.names, "ground"))}
    joints = []
    for joint in system.joints:
        if joint.kind not in ROWS:
            raise UnsupportedError(f"A joint of kind {joint.kind}")
        i, j = index[joint.body_i], index[joint.body_j]
        points = np.asarray(joint.point_i) - com[i], np.asarray(joint.point_j) - com[j]
        frames = np.asarray(joint.frame_i), np.asarray(joint.frame_j)
        joints.append(PlainJoint(joint.name, joint.kind, i, j, *points, *frames))
    loads: dict[str, tuple[Any, ...]] = {kind: () for kind in ("wrenches", "actuators", "forces")}
    gravity = np.zeros(3)
    for force in system.forces:
        kind, load = _load(force, scene, index, com, any_couple)
        if kind == "gravity":
            gravity = gravity + load
        else:
            loads[kind] = (*loads.get(kind, ()), load)
    mass = np.asarray(system.bodies.mass, dtype=float)
    inertia = np.asarray(system.bodies.inertia, dtype=float)
    return Plain(system.names, mass, inertia, tuple(joints), gravity, **loads)


def _load(
    force: object, scene: Scene, index: dict[str, int], com: np.ndarray, any_couple: bool
) -> tuple[str, Any]:
    """One force of the scene, and the field of `Plain` to which it belongs."""
    match force:
        case Gravity():
            return "gravity", np.asarray(force.acceleration)
        case Rotors() if not callable(force.speed_squared):
            k = index[force.body]
            wrench = np.asarray(force.wrench(force.speed_squared, scene.system.bodies.com[k]))
            return "wrenches", (k, wrench[:3], wrench[3:])
        case LinearActuator() if any_couple or force.couple == "consistent":
            base, slider = index[force.base], index[force.slider]
            arm, paired = np.asarray(force.axis_point) - com[base], force.couple == "consistent"
            return "actuators", Actuator(base, slider, arm, _sinus(force.force), paired)
        case AppliedForce(frame="world", point=None):
            return "forces", (index[force.body], _sinus(force.force))
        case AppliedMoment() if not callable(force.moment):
            k, moment = index[force.body], np.asarray(force.moment)
            if force.frame == "body":
                return "wrenches", (k, np.zeros(3), moment)
            return "moments", (k, moment)
        case LinearSpringDamper():
            i, j = index[force.body_i], index[force.body_j]
            points = np.asarray(force.point_i) - com[i], np.asarray(force.point_j) - com[j]
            numbers = float(force.stiffness), float(force.damping), float(force.length)
            return "springs", Spring(i, j, *points, *numbers)
        case JointServo():
            joints = scene.system.joints
            number = next(k for k, joint in enumerate(joints) if joint.name == force.joint)
            if joints[number].kind != "translational":
                raise UnsupportedError("A servo in a joint that turns")
            if callable(force.target):
                raise UnsupportedError("A servo with a moving target")
            numbers = float(force.stiffness), float(force.damping), float(force.target)
            return "servos", Servo(number, *numbers)
    kind = type(force).__name__
    raise UnsupportedError(f"A force of kind {kind}, as used here,")


def _sinus(value: object) -> Sinus:
    if isinstance(value, Sine):
        return Sinus(np.asarray(value.amplitude), float(value.angular_frequency), 0.0)
    if callable(value):
        raise UnsupportedError("A force that is a function of the state")
    return Sinus(np.asarray(value, dtype=float), 0.0, 0.5 * np.pi)


def why_not(scene: Scene, make: Callable[[Scene], object] = plain) -> str:
    """What all our adapters, or those that make more of it, lack for a scene; empty if nothing."""
    try:
        make(scene)
    except UnsupportedError as error:
        return str(error)
    return ""


def starts(states: State) -> list[State]:
    """Stacked states, arrays (k, n, .), one by one in NumPy."""
    return [jax.tree.map(lambda x, k=k: np.asarray(x)[k], states) for k in range(len(states.r))]


def loop_seconds(call: Callable[[], object], loops: int = 2000, repeats: int = 5) -> float:
    """Median over repeats of the mean time of a call [s]."""
    return float(np.median(timeit.repeat(call, number=loops, repeat=repeats))) / loops
