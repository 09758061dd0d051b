"""Forces and drivers that hold or move the tracker's sliders, in joints T12 and T13.

`tracker_options.py` has the options that say which there are, and with what numbers.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, check_shape, concrete
from ..checks.shapes import Numbers
from ..mechanics.forces.joint import EndStop, JointFriction, JointServo
from ..mechanics.joint import Joint, Motion, drive
from ..mechanics.load import AbstractForce
from ..parameters.table import Parameters
from .tracker_options import Friction, Servo, Stops, Strokes

SLIDER_JOINTS = ("T12", "T13")


class Rise(eqx.Module):
    """Smooth rise from zero: `to` (10 s^3 - 15 s^4 + 6 s^5) with s = t / duration within [0, 1].

    Speed and acceleration begin and end with zero; as a function of t [s] it may drive a joint.
    """

    to: Float[Array, ""]
    duration: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        s = jnp.clip(t / self.duration, 0.0, 1.0)
        return self.to * s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def stroke_motions(strokes: Strokes) -> tuple[Motion, Motion]:
    """The two motions of a rise of both strokes.

    Raises:
        ModelError: not two strokes, numbers that are not finite, a duration that is not positive.
    """
    to, duration = (jnp.asarray(x, dtype=float) for x in (strokes.to, strokes.duration))
    check_shape(to, (2,), "The strokes at the end of their rise")
    check_finite(to, "The strokes at the end of their rise", "m")
    check_finite(duration, "The duration of the strokes' rise", "s")
    if concrete(duration) and not float(duration) > 0:
        raise ModelError(
            f"The duration of the strokes' rise must be positive, but it is {float(duration):g} s."
        )
    return Rise(to[0], duration), Rise(to[1], duration)


def stroke_drivers(
    joints: Sequence[Joint], strokes: Strokes | tuple[Motion, Motion] | None
) -> tuple[Joint, ...]:
    """Drivers that prescribe both strokes, called "drive T12" and "drive T13".

    Args:
        joints: the tracker's, with T12 and T13 among them.
        strokes: functions of t [s] to the displacement [m] from the initial posture; twice
            differentiable by JAX, such as `Sampled`. A scene starts at rest: they must begin
            with zero and at zero speed. A `Strokes` is such a pair; None makes no drivers.

    Raises:
        ModelError: not two functions, or numbers that make no sense.
    """
    if strokes is None:
        return ()
    strokes = stroke_motions(strokes) if isinstance(strokes, Strokes) else strokes
    if len(strokes) != len(SLIDER_JOINTS) or not all(callable(f) for f in strokes):
        raise ModelError(
            "The strokes must be two functions of the time t [s], for the sliders of "
            f"{' and '.join(SLIDER_JOINTS)}."
        )
    by_name = {joint.name: joint for joint in joints}
    return tuple(
        drive(f"drive {name}", by_name[name], motion, coordinate="displacement")
        for name, motion in zip(SLIDER_JOINTS, strokes, strict=True)
    )


class Drive(NamedTuple):
    """Force elements in the slider joints of a scene.

    Attributes:
        forces: force elements.
        parameters: parameter table of the scene with the elements' numbers.
        unused: prefixes of the table's lines that nothing uses.
        note: description of the elements in one or two sentences.
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
    """Force elements of the given options in the slider joints; None adds no element.

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
        forces += [JointFriction(j, coordinate="displacement", **numbers) for j in SLIDER_JOINTS]
    unused = tuple(f"{group}." for group, option in options.items() if option is None)
    return Drive(tuple(forces), parameters, unused, _note(servo, stops, friction))


def _given(group: str, option: Servo | Stops | Friction) -> dict[str, Numbers]:
    """Numbers of an option that are not left to the table, by their names in the table."""
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
        JointServo(joint, target=target, coordinate="displacement", **numbers)
        for joint, target in zip(SLIDER_JOINTS, servo.targets, strict=True)
    ]


def _stops(parameters: Parameters) -> list[AbstractForce]:
    numbers = {k: parameters.value(f"stop.{k}") for k in ("stiffness", "damping", "width")}
    limits = zip(parameters.value("stop.lower"), parameters.value("stop.upper"), strict=True)
    return [
        EndStop(joint, lower=lower, upper=upper, coordinate="displacement", **numbers)
        for joint, (lower, upper) in zip(SLIDER_JOINTS, limits, strict=True)
    ]


def _note(servo: Servo | None, stops: Stops | None, friction: Friction | None) -> str:
    if servo is stops is friction is None:
        return "Nothing holds the sliders: no friction, no stops, no servo."
    options = (("servo", servo), ("stops", stops), ("friction", friction))
    used = ", ".join(name for name, option in options if option is not None)
    note = f"Not in the report, in both slider joints: {used}."
    return note if servo is None else f"{note} The servos work against the case's own forces."
