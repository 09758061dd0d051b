"""`tracker`: the tracker on fixed ground, three loads (report Part I, chapter 5)."""

from typing import Literal

import jax.numpy as jnp

from ..dynamics.scene import Scene
from ..mechanics.body import GROUND
from ..mechanics.errors import SettingError
from ..mechanics.force import AppliedForce, AppliedMoment
from ..mechanics.joint import Motion
from ..mechanics.load import AbstractForce, Sine
from ..mechanics.system import System
from ..vehicle.airframe import PART_I
from ..vehicle.drive import Friction, Servo, Stops, slider_drive, stroke_drivers
from ..vehicle.parameters import Parameters
from ..vehicle.tracker import tracker_bodies, tracker_joints

TITLES = {
    1: "Tracker on ground, both sliders pushed by 4 sin(4 pi t) N",
    2: "Tracker on ground, panel pushed down by 3 N",
    3: "Tracker on ground, panel turned by 0.1 N m about its y axis",
}


def tracker(
    case: Literal[1, 2, 3] = 1,
    parameters: Parameters = PART_I,
    *,
    servo: Servo | None = None,
    stops: Stops | None = None,
    friction: Friction | None = None,
    strokes: tuple[Motion, Motion] | None = None,
    allow_float32: bool = False,
) -> Scene:
    """The report's tracker on ground; the base has no coordinates, and there is no gravity.

    Args:
        case: 1 slider forces, 2 panel force, 3 panel moment.
        servo: holds both sliders, beside the case's forces; the report has none.
        stops: at the ends of both sliders' strokes. friction: in both slider joints.
        strokes: prescribe both sliders' displacements from the initial posture, functions of
            t [s] to [m] (see `stmuav_jax.vehicle.drive.stroke_drivers`); the case's own
            forces then only load the drivers.
        allow_float32: see `System`.

    Raises:
        SettingError: another case.
        ModelError: numbers of the options that make no sense.
    """
    if case not in TITLES:
        raise SettingError(f"tracker has cases 1, 2 and 3, not {case}.")
    drive = slider_drive(parameters, servo=servo, stops=stops, friction=friction)
    unused = ("spin.", "workspace.", *drive.unused)
    joints = tracker_joints(parameters, GROUND)
    system = System(
        tracker_bodies(parameters),
        (*joints, *stroke_drivers(joints, strokes)) if strokes is not None else joints,
        (*_loads(case, parameters), *drive.forces),
        allow_float32=allow_float32,
    )
    return Scene(
        name=f"tracker_{case}",
        title=TITLES[case],
        system=system,
        state0=system.reference,
        parameters={
            k: v for k, v in drive.parameters.to_dict().items() if not k.startswith(unused)
        },
        notes=(
            "Joint positions are reconstructed, not printed (docs/geometry.md).",
            "J'_7 of Table 6.2 breaks the triangle inequality by 0.7 % through rounding; admitted.",
            f"{drive.note} No gravity, as printed.",
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
