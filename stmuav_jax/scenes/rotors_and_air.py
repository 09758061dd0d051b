"""Rotors, air and gear of a flying scene: what its options of drag, wind, motors and gear build."""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from ..checks.errors import ModelError, concrete
from ..checks.numbers import array_module, as_numpy, floats
from ..checks.shapes import Numbers
from ..environment.wind import Gusts, dryden, low_altitude
from ..mechanics.forces.contact import GroundContact
from ..mechanics.load import AbstractForce
from ..parameters.table import Parameters
from ..rotorcraft.allocation import RotorLimits, check_lift
from ..rotorcraft.drag import AirframeDrag
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors
from .flight_options import Drag, Gear, Motor, Wind


class RotorsAndAir(NamedTuple):
    """Rotors, air and gear of a scene.

    Attributes:
        forces: the elements. parameters: the scene's table with the numbers they have.
        unused: prefixes of the table's lines that nothing uses. notes: a sentence, or none.
    """

    forces: tuple[AbstractForce, ...]
    parameters: Parameters
    unused: tuple[str, ...]
    notes: tuple[str, ...]


def flight(
    rotors: Rotors,
    weight: Numbers,
    parameters: Parameters,
    *,
    drag: Drag | None = None,
    wind: Wind | Numbers | Callable[..., object] | None = None,
    motor: Motor | None = None,
    gear: Gear | None = None,
) -> RotorsAndAir:
    """The rotors and what the given options add; None costs nothing.

    Args:
        weight: of the machine [N], which rotors with limits must be able to carry.
        wind: a `Wind`, or the velocity of the air itself, world (3,) [m/s], or a function of
            (t, kinematics) that returns it.

    Raises:
        ModelError: a number that an element refuses, wind without drag, motors that cannot
            carry the weight.
    """
    if wind is not None and drag is None:
        raise ModelError(
            "Wind acts through the airframe's drag: give drag=Drag() with it (--drag)."
        )
    groups: dict[str, object] = {"drag": drag, "motor": motor, "gear": gear}
    for group, option in groups.items():
        if option is not None:
            given = {f"{group}.{k}": v for k, v in vars(option).items() if v is not None}
            parameters = parameters.replaced(given)
    if isinstance(wind, Wind):
        wanted = {
            "wind.mean": wind.mean, "gust.height": wind.height, "gust.speed_20ft": wind.speed_20ft,
        }  # fmt: skip
        parameters = parameters.replaced({k: v for k, v in wanted.items() if v is not None})
        air = _wind(parameters, wind)
    else:
        air = wind
    forces: list[AbstractForce] = [_motors(rotors, weight, parameters) if motor else rotors]
    if drag is not None:
        numbers = {k: parameters.value(f"drag.{k}") for k in ("linear", "quadratic")}
        centre = parameters.value("drag.centre")
        forces.append(AirframeDrag(rotors.body, **numbers, point=centre, wind=air))
    if gear is not None:
        forces.append(_gear(rotors.body, parameters))
    used = {
        "drag.": drag is not None,
        "wind.": isinstance(wind, Wind),
        "gust.": isinstance(wind, Wind) and wind.gusts,
        "motor.": motor is not None,
        "gear.": gear is not None,
    }
    words = {"drag": drag, "wind": wind, "motors": motor, "landing gear": gear}
    names = ", ".join(name for name, option in words.items() if option is not None)
    notes = (f"Not in the report: {names}.",) if names else ()
    unused = tuple(group for group, is_used in used.items() if not is_used)
    return RotorsAndAir(tuple(forces), parameters, unused, notes)


def _motors(rotors: Rotors, weight: Numbers, parameters: Parameters) -> MotorRotors:
    limits = RotorLimits(parameters.value("motor.lowest"), parameters.value("motor.highest"))
    check_lift(rotors, limits, weight)
    numbers = {k: parameters.value(f"motor.{k}") for k in ("time_constant", "inertia")}
    return MotorRotors(rotors, **numbers, limits=limits)


def _gear(body: str, parameters: Parameters) -> GroundContact:
    lengths = [floats(parameters.value(f"gear.{k}")) for k in ("spread", "depth")]
    spread, depth = as_numpy(lengths)
    module = array_module(spread, depth)
    corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
    feet = module.concatenate([spread * corners, -depth * np.ones((4, 1))], axis=1)
    keys = ("stiffness", "damping", "width", "friction", "slip_speed")
    numbers = {k: parameters.value(f"gear.{k}") for k in keys}
    return GroundContact(body, feet=feet, height=parameters.value("gear.ground"), **numbers)


def _wind(parameters: Parameters, wind: Wind) -> Numbers | Gusts:
    mean = jnp.asarray(parameters.value("wind.mean"), dtype=float)
    if not wind.gusts:
        return mean
    speed = jnp.sqrt(jnp.sum(mean * mean))
    if concrete(speed) and not float(speed) > 0:
        raise ModelError("Gusts are carried past by the mean wind, which must not be zero.")
    turbulence = low_altitude(parameters.value("gust.height"), parameters.value("gust.speed_20ft"))
    return dryden(
        wind.seed, turbulence, airspeed=speed, duration=wind.duration, dt=wind.spacing, mean=mean
    )
