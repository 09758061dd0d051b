"""Scene `tracker`: the tracker on fixed ground, three loads (report Part I, chapter 5)."""

from typing import Literal

import jax.numpy as jnp

from ...checks.errors import SettingError
from ...dynamics.simulation import Scene
from ...mechanics.body import GROUND
from ...mechanics.forces import AppliedForce, AppliedMoment
from ...mechanics.joint import Motion
from ...mechanics.load import AbstractForce, Sine
from ...mechanics.parameters import Parameters
from ...mechanics.system import System
from ..airframe import PART_I
from ..tracker.bodies import (
    Friction,
    PanelStart,
    Servo,
    Stops,
    Strokes,
    slider_drive,
    stroke_drivers,
    tracker_bodies,
    tracker_joints,
)
from .flight_options import STARTED, panel_state

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
    strokes: Strokes | tuple[Motion, Motion] | None = None,
    start: PanelStart | None = None,
) -> Scene:
    """Scene of the report's tracker on the ground, which has no coordinates, without gravity.

    Args:
        case: 1 slider forces, 2 panel force, 3 panel moment.
        servo: holds both sliders, in addition to the case's forces; the report has none.
        stops: at the ends of both sliders' strokes. friction: in both slider joints.
        strokes: prescribe both sliders' displacements from the initial posture: a `Strokes`, or
            functions of t [s] to [m] (see `stmuav_jax.uav.tracker.bodies.stroke_drivers`); the
            case's own forces then only load the drivers.
        start: of the panel; the report's is at rest in the initial posture.

    Raises:
        SettingError: another case.
        ModelError: numbers of the options that make no sense.
    """
    if case not in TITLES:
        raise SettingError(f"tracker has cases 1, 2 and 3, not {case}.")
    drive = slider_drive(parameters, servo=servo, stops=stops, friction=friction)
    unused = ("spin.", "workspace.", *drive.unused)
    joints = tracker_joints(parameters, GROUND)
    loads: tuple[AbstractForce, ...]
    if case == 2:
        loads = (AppliedForce("panel_7", parameters.value("case_2.force")),)
    elif case == 3:
        loads = (AppliedMoment("panel_7", parameters.value("case_3.moment"), frame="body"),)
    else:
        peak = jnp.array([0.0, 0.0, 1.0]) * parameters.value("case_1.force")
        lift = Sine(peak, parameters.value("case_1.angular_frequency"))
        loads = tuple(AppliedForce(name, lift) for name in ("slider_2", "slider_3"))
    system = System(
        tracker_bodies(parameters),
        (*joints, *stroke_drivers(joints, strokes)),
        (*loads, *drive.forces),
    )
    return Scene(
        name=f"tracker_{case}",
        title=TITLES[case],
        system=system,
        state0=system.reference if start is None else panel_state(start, parameters),
        parameters={
            k: v for k, v in drive.parameters.to_dict().items() if not k.startswith(unused)
        },
        notes=(
            "Joint positions are reconstructed, not printed (docs/report_machine.md).",
            "J'_7 of Table 6.2 violates the triangle inequality by 0.7 % through rounding; admitted.",
            f"{drive.notes[0]} No gravity, as printed.",
            *((STARTED,) if start is not None else ()),
        ),
        watch=("slider_2", "slider_3", "panel_7"),
    )
