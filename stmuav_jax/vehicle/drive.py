"""What may hold or move the tracker's sliders, in joints T12 and T13.

Servos, end stops and friction are forces; strokes that are prescribed are drivers.

Each is an option of a scene. Numbers left out are those of the scene's parameter table
("servo.", "stop.", "friction."); numbers given go into the table that is kept with the
results. A stroke is the slider's displacement along its joint's z axis from the initial
posture, where it is zero.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp

from ..algebra.shapes import Numbers
from ..mechanics.errors import ModelError
from ..mechanics.joint import Joint, Motion, drive
from ..mechanics.joint_force import EndStop, JointFriction, JointServo
from ..mechanics.load import AbstractForce
from .parameters import Parameters

SLIDER_JOINTS = ("T12", "T13")

Target = Numbers | Callable[..., object]


@dataclass(frozen=True)
class Servo:
    """A `JointServo` in each slider joint, beside the forces that a scene has anyway.

    Attributes:
        stiffness: [N/m]. damping: [N s/m].
        targets: strokes to hold for sliders 2 and 3, numbers [m] or functions of t [s];
            by default the initial ones.
    """

    stiffness: Numbers | None = None
    damping: Numbers | None = None
    targets: tuple[Target, Target] = (0.0, 0.0)


@dataclass(frozen=True)
class Stops:
    """An `EndStop` at both ends of each slider's stroke.

    Attributes:
        lower, upper: strokes [m], one for both sliders or one for each.
        stiffness: [N/m]. damping: [N s/m]. width: of the smoothing [m].
    """

    lower: Numbers | None = None
    upper: Numbers | None = None
    stiffness: Numbers | None = None
    damping: Numbers | None = None
    width: Numbers | None = None


@dataclass(frozen=True)
class Friction:
    """A `JointFriction` in each slider joint.

    Attributes:
        coulomb: [N]. viscous: [N s/m]. speed: of the smoothing [m/s].
    """

    coulomb: Numbers | None = None
    viscous: Numbers | None = None
    speed: Numbers | None = None


def stroke_drivers(joints: Sequence[Joint], strokes: tuple[Motion, Motion]) -> tuple[Joint, ...]:
    """Drivers that prescribe both strokes, called "drive T12" and "drive T13".

    Args:
        joints: the tracker's, with T12 and T13 among them.
        strokes: functions of t [s] to the displacement [m] from the initial posture; twice
            differentiable by JAX, such as `Sampled`. A scene starts at rest: they must begin
            with zero and at zero speed.

    Raises:
        ModelError: not two functions.
    """
    if len(strokes) != len(SLIDER_JOINTS) or not all(callable(f) for f in strokes):
        raise ModelError(
            "The strokes must be two functions of the time t [s], for the sliders of "
            f"{' and '.join(SLIDER_JOINTS)}."
        )
    by_name = {joint.name: joint for joint in joints}
    return tuple(
        drive(f"drive {name}", by_name[name], motion, coordinate="shift")
        for name, motion in zip(SLIDER_JOINTS, strokes, strict=True)
    )


class Drive(NamedTuple):
    """What holds the sliders of a scene.

    Attributes:
        forces: the elements. parameters: the scene's table with the numbers they have.
        unused: prefixes of the table's lines that nothing uses. note: one sentence.
    """

    forces: tuple[AbstractForce, ...]
    parameters: Parameters
    unused: tuple[str, ...]
    note: str


def slider_drive(
    parameters: Parameters,
    *,
    servo: Servo | None = None,
    stops: Stops | None = None,
    friction: Friction | None = None,
) -> Drive:
    """The force elements of the given options in the slider joints; None costs nothing.

    Raises:
        ModelError: a number that an element refuses, or targets that are not two.
    """
    options = {"servo": servo, "stop": stops, "friction": friction}
    for group, option in options.items():
        if option is not None:
            parameters = parameters.replaced(_given(group, option))
    forces: list[AbstractForce] = []
    if servo is not None:
        forces += _servos(parameters, servo)
    if stops is not None:
        forces += _stops(parameters)
    if friction is not None:
        numbers = {k: parameters.value(f"friction.{k}") for k in ("coulomb", "viscous", "speed")}
        forces += [JointFriction(j, coordinate="shift", **numbers) for j in SLIDER_JOINTS]
    unused = tuple(f"{group}." for group, option in options.items() if option is None)
    return Drive(tuple(forces), parameters, unused, _note(servo, stops, friction))


def _given(group: str, option: Servo | Stops | Friction) -> dict[str, Numbers]:
    """The numbers of an option that are not left to the table, by their names there."""
    given = {k: v for k, v in vars(option).items() if v is not None and k != "targets"}
    for key in ("lower", "upper"):
        if key in given:
            limits = jnp.asarray(given[key], dtype=float)
            given[key] = jnp.stack([limits, limits]) if limits.ndim == 0 else limits
    return {f"{group}.{key}": value for key, value in given.items()}


def _servos(parameters: Parameters, servo: Servo) -> list[AbstractForce]:
    if len(servo.targets) != len(SLIDER_JOINTS):
        raise ModelError(
            f"The targets of the servo must be two, for the sliders of {' and '.join(SLIDER_JOINTS)}, "
            f"but they are {len(servo.targets)}."
        )
    numbers = {k: parameters.value(f"servo.{k}") for k in ("stiffness", "damping")}
    return [
        JointServo(joint, target=target, coordinate="shift", **numbers)
        for joint, target in zip(SLIDER_JOINTS, servo.targets, strict=True)
    ]


def _stops(parameters: Parameters) -> list[AbstractForce]:
    numbers = {k: parameters.value(f"stop.{k}") for k in ("stiffness", "damping", "width")}
    limits = zip(parameters.value("stop.lower"), parameters.value("stop.upper"), strict=True)
    return [
        EndStop(joint, lower=lower, upper=upper, coordinate="shift", **numbers)
        for joint, (lower, upper) in zip(SLIDER_JOINTS, limits, strict=True)
    ]


def _note(servo: Servo | None, stops: Stops | None, friction: Friction | None) -> str:
    if servo is stops is friction is None:
        return "Nothing holds the sliders: no friction, no stops, no servo."
    options = (("servo", servo), ("stops", stops), ("friction", friction))
    used = ", ".join(name for name, option in options if option is not None)
    note = f"Not in the report, in both slider joints: {used}."
    return note if servo is None else f"{note} The servos work against the case's own forces."
