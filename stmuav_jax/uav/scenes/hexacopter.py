"""Scene `hexacopter`: one free body and six rotors (report Part II, section 5.1)."""

from collections.abc import Callable

import jax.numpy as jnp

from ...checks.shapes import Numbers
from ...dynamics.simulation import Scene
from ...mechanics.body import Body
from ...mechanics.forces import Gravity
from ...mechanics.parameters import Parameters
from ...mechanics.system import System
from ..airframe import PART_II
from ..rotor import Rotors, hover_speed_squared
from .flight_options import STARTED, BaseStart, Drag, Gear, Motor, Wind, base_state, flight_forces


def hexacopter_rotors(body: str, parameters: Parameters, speed_squared: object) -> Rotors:
    """Six rotors of the parameter table on a body."""
    return Rotors(
        body,
        arms=parameters.value("rotor.arms"),
        spin=parameters.value("rotor.spin"),
        k_f=parameters.value("rotor.k_f"),
        k_tau=parameters.value("rotor.k_tau"),
        speed_squared=speed_squared,  # pyright: ignore[reportArgumentType]
    )


def hexacopter(
    parameters: Parameters = PART_II,
    *,
    drag: Drag | None = None,
    wind: Wind | Numbers | Callable[..., object] | None = None,
    motor: Motor | None = None,
    gear: Gear | None = None,
    start: BaseStart | None = None,
) -> Scene:
    """Scene of the bare hexacopter rising with constant, equal rotor speeds; it has no joints.

    The arms' centroid lies 1.1 mm off the centre of mass (Table 5.2), so equal speeds also
    turn it slowly.

    Args:
        drag: drag of the airframe; the report has none.
        wind: a `Wind`, or the air's velocity, world (3,) [m/s], or a function of
            (t, kinematics); it needs drag.
        motor: lag, inertia and limits of the rotors; the report has none.
        gear: landing gear on level ground; the report has none.
        start: of the flight; the report's is level and at rest at the origin.

    Raises:
        ModelError: numbers of the options that make no sense.
    """
    mass = parameters.value("bare.mass")
    gravity = parameters.value("gravity")
    hover = hover_speed_squared(mass, gravity, parameters.value("rotor.k_f"), 6)
    lift = parameters.value("bare.lift_factor")
    weight = mass * jnp.linalg.norm(jnp.asarray(gravity, dtype=float))
    air = flight_forces(
        hexacopter_rotors("hexacopter", parameters, lift * hover), weight, parameters,
        drag=drag, wind=wind, motor=motor, gear=gear,
    )  # fmt: skip
    system = System(
        [Body("hexacopter", mass, parameters.value("bare.inertia"), free=True)],
        forces=[Gravity(gravity), *air.forces],
    )
    options = tuple(
        g for g in ("drag.", "wind.", "gust.", "motor.", "gear.") if g not in air.unused
    )
    keep = ("bare.", "rotor.", "gravity", *options)
    return Scene(
        name="hexacopter",
        title="Bare hexacopter, constant equal rotor speeds",
        system=system,
        state0=system.reference if start is None else base_state(start),
        parameters={k: v for k, v in air.parameters.to_dict().items() if k.startswith(keep)},
        notes=(
            "The report prints no rotor speeds: 1.1 times the weight is chosen here.",
            "J_zz of section 5.1 is printed ten times too large; corrected to 86.6e-3 kg m^2.",
            *air.notes,
            *((STARTED,) if start is not None else ()),
        ),
        watch=("hexacopter",),
    )
