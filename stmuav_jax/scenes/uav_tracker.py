"""`uav_tracker`: the hexacopter with the tracker, seven bodies (report Part II, section 5.2)."""

from typing import Any, Literal

import jax.numpy as jnp

from ..dynamics.scene import Scene
from ..mechanics.body import Body
from ..mechanics.errors import SettingError
from ..mechanics.force import Gravity
from ..mechanics.load import AbstractForce, Sine
from ..mechanics.system import System
from ..vehicle.actuator import LinearActuator
from ..vehicle.airframe import PART_II
from ..vehicle.parameters import Parameters
from ..vehicle.rotor import hover_speed_squared
from ..vehicle.tracker import TRACKER_BODIES, tracker_bodies, tracker_joints
from .hexacopter import rotors

BASE = "hexacopter_1"

TITLES = {
    1: "Hexacopter with tracker at hover thrust, actuators idle",
    2: "Hexacopter with tracker at hover thrust, actuators 3 sin(4 pi t) N",
    3: "Hexacopter with tracker, actuators 3 sin(4 pi t) N, raised thrust",
}


def uav_tracker(
    case: Literal[1, 2, 3] = 2,
    parameters: Parameters = PART_II,
    *,
    actuators: Literal["consistent", "printed"] = "consistent",
) -> Scene:
    """The report's seven-body UAV.

    Args:
        case: 1 hover thrust; 2 with actuator forces; 3 with these and the thrust raised by
            the parameter "lift_factor" (the report gives no number).
        actuators: "consistent" puts each actuator's force pair on its axis; "printed" is
            the report's, which adds a net couple.

    Raises:
        SettingError: another case or couple.
    """
    if case not in TITLES:
        raise SettingError(f"uav_tracker has cases 1, 2 and 3, not {case}.")
    shift = parameters.value("mount.shift")
    base = Body(
        BASE, parameters.value(f"mass.{BASE}"), parameters.value(f"inertia.{BASE}"), free=True
    )
    system = System(
        [base, *tracker_bodies(parameters, shift)],
        tracker_joints(parameters, BASE, shift),
        _forces(case, parameters, actuators),
    )
    return Scene(
        name=f"uav_tracker_{case}",
        title=TITLES[case],
        system=system,
        state0=system.reference,
        parameters={k: v for k, v in parameters.to_dict().items() if not k.startswith("bare.")},
        notes=(
            "Joint positions are reconstructed, not printed (docs/geometry.md).",
            "J'_3 (1, 1) of Table 5.3 is corrected to the mirror of J'_2.",
            f"Actuator couple: {actuators}. Equal rotor speeds are not a trim.",
            "Nothing holds the sliders: no friction, no stops, no servo.",
        ),
        watch=(BASE, "slider_2", "slider_3", "panel_7"),
    )


def _forces(case: int, parameters: Parameters, couple: Any) -> tuple[AbstractForce, ...]:
    gravity = parameters.value("gravity")
    names = (BASE, *TRACKER_BODIES)
    total = sum(jnp.asarray(parameters.value(f"mass.{name}"), dtype=float) for name in names)
    hover = hover_speed_squared(total, gravity, parameters.value("rotor.k_f"), 6)
    lift = parameters.value("lift_factor") if case == 3 else 1.0
    forces: list[AbstractForce] = [Gravity(gravity), rotors(BASE, parameters, lift * hover)]
    if case == 1:
        return tuple(forces)
    push = Sine(parameters.value("actuator.force"), parameters.value("actuator.angular_frequency"))
    for slider, axis in (("slider_2", "actuator.axis_2"), ("slider_3", "actuator.axis_3")):
        forces.append(
            LinearActuator(
                BASE, slider, axis_point=parameters.value(axis), force=push, couple=couple
            )
        )
    return tuple(forces)
