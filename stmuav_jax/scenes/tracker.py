"""`tracker`: the tracker on fixed ground, three loads (report Part I, chapter 5)."""

from typing import Literal

import jax.numpy as jnp

from ..dynamics.scene import Scene
from ..mechanics.body import GROUND
from ..mechanics.errors import SettingError
from ..mechanics.force import AppliedForce, AppliedMoment
from ..mechanics.load import AbstractForce, Sine
from ..mechanics.system import System
from ..vehicle.airframe import PART_I
from ..vehicle.parameters import Parameters
from ..vehicle.tracker import tracker_bodies, tracker_joints

TITLES = {
    1: "Tracker on ground, both sliders pushed by 4 sin(4 pi t) N",
    2: "Tracker on ground, panel pushed down by 3 N",
    3: "Tracker on ground, panel turned by 0.1 N m about its y axis",
}


def tracker(case: Literal[1, 2, 3] = 1, parameters: Parameters = PART_I) -> Scene:
    """The report's tracker on ground; the base has no coordinates, and there is no gravity.

    Args:
        case: 1 slider forces, 2 panel force, 3 panel moment.

    Raises:
        SettingError: another case.
    """
    if case not in TITLES:
        raise SettingError(f"tracker has cases 1, 2 and 3, not {case}.")
    system = System(
        tracker_bodies(parameters), tracker_joints(parameters, GROUND), _loads(case, parameters)
    )
    return Scene(
        name=f"tracker_{case}",
        title=TITLES[case],
        system=system,
        state0=system.reference,
        parameters={k: v for k, v in parameters.to_dict().items() if not k.startswith("spin.")},
        notes=(
            "Joint positions are reconstructed, not printed (docs/geometry.md).",
            "J'_7 of Table 6.2 breaks the triangle inequality by 0.7 % through rounding; admitted.",
            "Nothing holds the sliders: no friction, no stops, no servo. No gravity, as printed.",
        ),
        watch=("slider_2", "slider_3", "panel_7"),
    )


def _loads(case: int, parameters: Parameters) -> tuple[AbstractForce, ...]:
    if case == 2:
        return (AppliedForce("panel_7", parameters.value("case_2.force")),)
    if case == 3:
        return (AppliedMoment("panel_7", parameters.value("case_3.moment"), frame="body"),)
    peak = jnp.array([0.0, 0.0, 1.0]) * parameters.value("case_1.force")
    lift = Sine(peak, parameters.value("case_1.angular_frequency"))
    return tuple(AppliedForce(name, lift) for name in ("slider_2", "slider_3"))
