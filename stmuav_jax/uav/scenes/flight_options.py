"""Options of flying scenes: drag, wind, motors, landing gear, the start; and the forces that they build.

Numbers left out are those of the scene's parameter table ("drag.", "wind.", "gust.", "motor.", "gear.");
given numbers replace those of the table that is saved with the results. Each field says what it is, its unit
and its
number of entries.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError, StateError, check_finite, has_values
from ...checks.numbers import array_module, as_floats, as_numpy, stack_arrays
from ...checks.schema import quantity
from ...checks.shapes import Numbers
from ...math.compiler import quick_jit
from ...math.rotation import product, turn_about
from ...mechanics.forces import GroundContact
from ...mechanics.load import AbstractForce
from ...mechanics.parameters import Parameters
from ...mechanics.state import State
from ..allocation import RotorLimits, check_lift
from ..drag import AirframeDrag
from ..environment.wind import Gusts, dryden, low_altitude
from ..motor import MotorRotors
from ..rotor import Rotors
from ..tracker.bodies import OptionForces, PanelStart, place_on_base, posture, replace_numbers
from ..tracker.geometry import initial_angles, tracker_geometry


@dataclass(frozen=True)
class Drag:
    """Aerodynamic drag of the hexacopter's airframe."""

    linear: Numbers | None = quantity("linear coefficients in body axes", "N s/m", 3)
    quadratic: Numbers | None = quantity("quadratic coefficients in body axes", "N s^2/m^2", 3)
    centre: Numbers | None = quantity("centre of pressure in body axes", "m", 3)


@dataclass(frozen=True)
class Wind:
    """Steady wind, and low-altitude Dryden gusts that pass at its speed.

    A run beyond the gusts' duration stops with an error.
    """

    mean: Numbers | None = quantity("mean wind in world axes", "m/s", 3)
    gusts: bool = quantity("Dryden gusts about the mean wind", kind=bool, default=False)
    seed: int = quantity("seed of the gusts", kind=int, default=0)
    height: Numbers | None = quantity("height above ground, for the gusts", "m")
    speed_20ft: Numbers | None = quantity("wind at 20 feet, for the gusts' intensity", "m/s")
    duration: float = quantity("time for which gusts are drawn", "s", default=60.0)
    spacing: float = quantity("spacing of the gusts' samples", "s", default=0.01)


@dataclass(frozen=True)
class Motor:
    """Motors of the rotors with lag, inertia and limits.

    They start at their commands.
    """

    time_constant: Numbers | None = quantity("time constant of the speeds", "s")
    inertia: Numbers | None = quantity("inertia of a rotor about its axis", "kg m^2")
    lowest: Numbers | None = quantity("lowest speed", "rad/s")
    highest: Numbers | None = quantity("highest speed", "rad/s")


@dataclass(frozen=True)
class Gear:
    """Landing gear of the hexacopter on level ground, four feet at the corners of a square."""

    spread: Numbers | None = quantity("half the side of the feet's square", "m")
    depth: Numbers | None = quantity("depth of the feet below the base's centre of mass", "m")
    ground: Numbers | None = quantity("height of the ground", "m")
    stiffness: Numbers | None = quantity("stiffness of each foot", "N/m")
    damping: Numbers | None = quantity("damping of each foot", "N s/m")
    width: Numbers | None = quantity("width of the smoothing", "m")
    friction: Numbers | None = quantity("coefficient of friction", "1")
    slip_speed: Numbers | None = quantity("speed of the friction's smoothing", "m/s")


@dataclass(frozen=True)
class AbstractStart:
    """Start of a hexacopter; numbers left out are zero.

    The attitude is R_z(yaw) R_y(pitch) R_x(roll), the velocity in world axes, the angular velocity in its own.
    """

    x: Numbers = quantity("position, x", "m", default=0.0)
    y: Numbers = quantity("position, y", "m", default=0.0)
    z: Numbers = quantity("position, height", "m", default=0.0)
    roll: Numbers = quantity("attitude, turn about x", "rad", default=0.0)
    pitch: Numbers = quantity("attitude, turn about y", "rad", default=0.0)
    yaw: Numbers = quantity("attitude, turn about z", "rad", default=0.0)
    vx: Numbers = quantity("velocity, x", "m/s", default=0.0)
    vy: Numbers = quantity("velocity, y", "m/s", default=0.0)
    vz: Numbers = quantity("velocity, upwards", "m/s", default=0.0)
    p: Numbers = quantity("angular velocity about its x axis", "rad/s", default=0.0)
    q: Numbers = quantity("angular velocity about its y axis", "rad/s", default=0.0)
    r: Numbers = quantity("angular velocity about its z axis", "rad/s", default=0.0)


@dataclass(frozen=True)
class BaseStart(AbstractStart):
    """Start of the bare hexacopter, as described by `AbstractStart`."""


@dataclass(frozen=True)
class FlightStart(AbstractStart):
    """Start of the hexacopter and of its tracker's panel.

    Numbers of the hexacopter left out are zero; those of the panel are the initial posture's, at rest.
    """

    phi: Numbers | None = quantity("first panel angle", "rad")
    theta: Numbers | None = quantity("second panel angle", "rad")
    phi_rate: Numbers = quantity("rate of the first panel angle", "rad/s", default=0.0)
    theta_rate: Numbers = quantity("rate of the second panel angle", "rad/s", default=0.0)


# --- what the options build


def flight_forces(
    rotors: Rotors,
    weight: Numbers,
    parameters: Parameters,
    *,
    drag: Drag | None = None,
    wind: Wind | Numbers | Callable[..., object] | None = None,
    motor: Motor | None = None,
    gear: Gear | None = None,
) -> OptionForces:
    """The rotors and what the given options add; None costs nothing.

    Args:
        weight: of the machine [N], which rotors with limits must be able to carry.
        wind: a `Wind`, or the velocity of the air itself, world (3,) [m/s], or a function of
            (t, kinematics) that returns it.

    Raises:
        ModelError: a number that an element refuses, wind without drag, motors that cannot
            carry the weight.
    """
    # Wind acts through drag alone: without it the option would have no effect and no message.
    if wind is not None and drag is None:
        raise ModelError(
            "Wind acts through the airframe's drag: give drag=Drag() with it (--drag)."
        )
    table = replace_numbers(parameters, {"drag": drag, "motor": motor, "gear": gear})
    take = lambda group, *names: {k: table.value(f"{group}.{k}") for k in names}
    air: Any = wind
    if isinstance(wind, Wind):
        wind_values = {
            "wind.mean": wind.mean, "gust.height": wind.height, "gust.speed_20ft": wind.speed_20ft,
        }  # fmt: skip
        table = table.replaced({k: v for k, v in wind_values.items() if v is not None})
        air = _make_wind(table, wind)
    forces: list[AbstractForce] = [rotors]
    if motor is not None:
        limits = RotorLimits(**take("motor", "lowest", "highest"))
        check_lift(rotors, limits, weight)
        numbers = take("motor", "time_constant", "inertia")
        forces = [MotorRotors(rotors, **numbers, limits=limits)]
    if drag is not None:
        numbers, centre = take("drag", "linear", "quadratic"), table.value("drag.centre")
        forces.append(AirframeDrag(rotors.body, **numbers, point=centre, wind=air))
    if gear is not None:
        # Plain numbers stay with NumPy, since each operation of JAX outside of a program costs a compilation.
        lengths = take("gear", "spread", "depth").values()
        spread, depth = as_numpy([as_floats(length) for length in lengths])
        corners = np.array([[1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0], [1.0, -1.0]])
        feet = array_module(spread, depth).concatenate(
            [spread * corners, -depth * np.ones((4, 1))], axis=1
        )
        numbers = take("gear", "stiffness", "damping", "width", "friction", "slip_speed")
        height = table.value("gear.ground")
        forces.append(GroundContact(rotors.body, feet=feet, height=height, **numbers))
    is_wind = isinstance(wind, Wind)
    used = {
        "drag.": drag is not None, "wind.": is_wind, "gust.": is_wind and wind.gusts,
        "motor.": motor is not None, "gear.": gear is not None,
    }  # fmt: skip
    options_by_label = {"drag": drag, "wind": wind, "motors": motor, "landing gear": gear}
    names = ", ".join(name for name, option in options_by_label.items() if option is not None)
    notes = (f"Not in the report: {names}.",) if names else ()
    unused = tuple(group for group, is_used in used.items() if not is_used)
    return OptionForces(tuple(forces), table, unused, notes)


def _make_wind(parameters: Parameters, wind: Wind) -> Numbers | Gusts:
    mean = jnp.asarray(parameters.value("wind.mean"), dtype=float)
    if not wind.gusts:
        return mean
    # For a UAV that hovers the wind's speed is the airspeed.
    speed = jnp.sqrt(jnp.sum(mean * mean))
    if has_values(speed) and not float(speed) > 0:
        raise ModelError("Gusts need a mean wind that is not zero, since it carries them past.")
    turbulence = low_altitude(parameters.value("gust.height"), parameters.value("gust.speed_20ft"))
    return dryden(
        wind.seed, turbulence, airspeed=speed, duration=wind.duration, dt=wind.spacing, mean=mean
    )


# --- states of the starts

# Note of a scene that starts elsewhere.
STARTED = "The start is not the report's."


def _option_numbers(start: object, *names: str) -> Float[Array, " k"]:
    values = [getattr(start, name) for name in names]
    for name, value in zip(names, values, strict=True):
        check_finite(value, f"The start's {name}", "")
    return stack_arrays([as_floats(value) for value in values])


def _base_start(start: AbstractStart) -> tuple[Array, Array, Array, Array]:
    """Position, Euler parameters, velocity and angular velocity of the base."""
    turns = _option_numbers(start, "yaw", "pitch", "roll")
    r, v, omega = (
        _option_numbers(start, *names)
        for names in (("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r"))
    )
    return r, _compose_turns(turns), v, omega


@quick_jit
def _compose_turns(turns: Float[Array, "3"]) -> Float[Array, "4"]:
    """Euler parameters of turns about z, y and x, one after the other [rad]."""
    yaw, pitch, roll = (turn_about(turns[k], axis) for k, axis in enumerate((2, 1, 0)))
    return product(product(yaw, pitch), roll)


def _panel_start(start: PanelStart | FlightStart, table: Parameters) -> tuple[Array, Array]:
    """Panel angles and their rates."""
    start_angles, usual = (start.phi, start.theta), initial_angles(table)
    for name, value in zip(("phi", "theta"), start_angles, strict=True):
        if value is not None:
            check_finite(value, f"The start's {name}", "rad")
    angles = [
        u if g is None else as_floats(g) for g, u in zip(start_angles, as_numpy(usual), strict=True)
    ]
    return stack_arrays(angles), _option_numbers(start, "phi_rate", "theta_rate")


def base_state(start: BaseStart) -> State:
    """State of the bare hexacopter."""
    r, p, v, omega = _base_start(start)
    return State(*(stack_arrays([x]) for x in (r, p, v, omega)))


def panel_state(start: PanelStart, table: Parameters) -> State:
    """State of the tracker's six bodies on fixed ground.

    Raises:
        StateError: a posture out of the rods' reach; traced numbers give NaN there.
    """
    angles, rates = _panel_start(start, table)
    return _check_reach(posture(tracker_geometry(table), angles, rates), angles)


def flight_state(start: FlightStart, table: Parameters) -> State:
    """State of the seven bodies.

    Raises:
        StateError: a posture out of the rods' reach; traced numbers give NaN there.
    """
    r, p, v, omega = _base_start(start)
    angles, rates = _panel_start(start, table)
    shift = as_floats(table.value("mount.shift"))
    state = place_on_base(tracker_geometry(table), shift, angles, rates, r, p, v, omega)
    return _check_reach(state, angles)


def _check_reach(state: State, angles: Float[Array, "2"]) -> State:
    if has_values(state.r) and not np.all(np.isfinite(np.asarray(state.r))):
        phi, theta = (float(angle) for angle in angles)
        raise StateError(
            f"The tracker cannot start with the panel angles phi = {phi:g} rad, theta = {theta:g} "
            "rad: its rods do not reach so far."
        )
    return state
