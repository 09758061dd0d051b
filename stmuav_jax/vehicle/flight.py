"""What a flying scene may have beside the report's rotors: drag, wind, motors.

Each is an option of a scene. Numbers left out are those of the scene's parameter table
("drag.", "wind.", "gust.", "motor."); numbers given go into the table that is kept with the
results.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp

from ..algebra.shapes import Numbers
from ..mechanics.errors import ModelError, concrete
from ..mechanics.load import AbstractForce
from .allocation import RotorLimits, check_lift
from .drag import AirframeDrag
from .gust import Gusts, dryden, low_altitude
from .motor import MotorRotors
from .parameters import Parameters
from .rotor import Rotors


@dataclass(frozen=True)
class Drag:
    """`AirframeDrag` of the hexacopter.

    Attributes:
        linear: (3,) [N s/m]. quadratic: (3,) [N s^2/m^2]. centre: of pressure (3,) [m].
    """

    linear: Numbers | None = None
    quadratic: Numbers | None = None
    centre: Numbers | None = None


@dataclass(frozen=True)
class Wind:
    """Steady wind, and low-altitude Dryden gusts carried past at its speed.

    Attributes:
        mean: world (3,) [m/s]. gusts: whether there are any. seed: of their noise.
        height: above ground [m]. speed_20ft: the wind at 20 feet [m/s], for their intensity.
        duration: for which the gusts are drawn [s]; a run beyond it stops with an error.
        spacing: of their samples [s].
    """

    mean: Numbers | None = None
    gusts: bool = False
    seed: int = 0
    height: Numbers | None = None
    speed_20ft: Numbers | None = None
    duration: float = 60.0
    spacing: float = 0.01


@dataclass(frozen=True)
class Motor:
    """Motors of the rotors: see `MotorRotors`; they start at their commands.

    Attributes:
        time_constant: [s]. inertia: of a rotor about its axis [kg m^2].
        lowest, highest: speeds [rad/s].
    """

    time_constant: Numbers | None = None
    inertia: Numbers | None = None
    lowest: Numbers | None = None
    highest: Numbers | None = None


class Flight(NamedTuple):
    """Rotors and air of a scene.

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
) -> Flight:
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
        raise ModelError("Wind acts through the airframe's drag: give drag=Drag() with it.")
    groups: dict[str, object] = {"drag": drag, "motor": motor}
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
    used = {
        "drag.": drag is not None,
        "wind.": isinstance(wind, Wind),
        "gust.": isinstance(wind, Wind) and wind.gusts,
        "motor.": motor is not None,
    }
    words = {"drag": drag, "wind": wind, "motors": motor}
    names = ", ".join(name for name, option in words.items() if option is not None)
    notes = (f"Not in the report: {names}.",) if names else ()
    unused = tuple(group for group, is_used in used.items() if not is_used)
    return Flight(tuple(forces), parameters, unused, notes)


def _motors(rotors: Rotors, weight: Numbers, parameters: Parameters) -> MotorRotors:
    limits = RotorLimits(parameters.value("motor.lowest"), parameters.value("motor.highest"))
    check_lift(rotors, limits, weight)
    numbers = {k: parameters.value(f"motor.{k}") for k in ("time_constant", "inertia")}
    return MotorRotors(rotors, **numbers, limits=limits)


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
