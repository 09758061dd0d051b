"""Scene `uav_tracker`: hexacopter with tracker, seven bodies (report Part II, section 5.2)."""

from collections.abc import Callable
from typing import Any, Literal

from ...checks.errors import SettingError
from ...checks.numbers import array_module, as_floats, as_numpy
from ...checks.shapes import Numbers
from ...dynamics.simulation import Scene
from ...dynamics.statespace.selection import Selection, velocity_names
from ...dynamics.statespace.tree import TreeSpace
from ...dynamics.tree.topology import spanning_tree
from ...mechanics.body import Body
from ...mechanics.forces import Gravity
from ...mechanics.joint import Motion
from ...mechanics.load import AbstractForce, Sine
from ...mechanics.parameters import Parameters
from ...mechanics.system import System
from ..airframe import PART_II
from ..flight import PANEL_COORDINATES, Uav
from ..rotor import hover_speed_squared
from ..tracker.bodies import (
    TRACKER_BODIES,
    Friction,
    LinearActuator,
    Servo,
    Stops,
    Strokes,
    slider_drive,
    stroke_drivers,
    tracker_bodies,
    tracker_joints,
)
from ..tracker.geometry import tracker_geometry
from ..tracker.workspace import tracker_limits
from .flight_options import (
    STARTED,
    Drag,
    FlightStart,
    Gear,
    Motor,
    Wind,
    flight_forces,
    flight_state,
)
from .hexacopter import hexacopter_rotors

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
    servo: Servo | None = None,
    stops: Stops | None = None,
    friction: Friction | None = None,
    strokes: Strokes | tuple[Motion, Motion] | None = None,
    drag: Drag | None = None,
    wind: Wind | Numbers | Callable[..., object] | None = None,
    motor: Motor | None = None,
    gear: Gear | None = None,
    start: FlightStart | None = None,
) -> Scene:
    """Scene of the report's seven-body UAV.

    Args:
        case: 1 hover thrust; 2 with actuator forces; 3 with these and the thrust raised by
            the parameter "lift_factor" (the report gives no number).
        actuators: "consistent" puts each actuator's force pair on its axis; "printed" is
            the report's, which adds a net couple.
        servo: holds both sliders, in addition to the actuators' forces; the report has none.
        stops: at the ends of both sliders' strokes. friction: in both slider joints.
        strokes: prescribe both sliders' displacements from the initial posture: a `Strokes`, or
            functions of t [s] to [m] (see `stmuav_jax.uav.tracker.bodies.stroke_drivers`); the
            case's own forces then only load the drivers.
        drag: of the hexacopter's airframe; the report has none. wind: a `Wind`, or the air's
            velocity, world (3,) [m/s], or a function of (t, kinematics); needs drag.
        motor: lag, inertia and limits of the rotors; the report has none.
        gear: landing gear on level ground; the report has none.
        start: of base and panel; the report's is level and at rest in the initial posture.

    Raises:
        SettingError: another case or couple.
        ModelError: numbers of the options that make no sense.
    """
    if case not in TITLES:
        raise SettingError(f"uav_tracker has cases 1, 2 and 3, not {case}.")
    shift = parameters.value("mount.shift")
    base = Body(
        BASE, parameters.value(f"mass.{BASE}"), parameters.value(f"inertia.{BASE}"), free=True
    )
    drive = slider_drive(parameters, servo=servo, stops=stops, friction=friction)
    gravity, *masses = as_numpy([
        as_floats(parameters.value(key))
        for key in ("gravity", *(f"mass.{name}" for name in (BASE, *TRACKER_BODIES)))
    ])  # fmt: skip
    hover = hover_speed_squared(sum(masses), gravity, parameters.value("rotor.k_f"), 6)
    lift = parameters.value("lift_factor") if case == 3 else 1.0
    air = flight_forces(
        hexacopter_rotors(BASE, drive.parameters, lift * as_numpy(hover)),
        sum(masses) * array_module(gravity).linalg.norm(gravity), drive.parameters,
        drag=drag, wind=wind, motor=motor, gear=gear,
    )  # fmt: skip
    forces: list[AbstractForce] = [Gravity(gravity), *air.forces]
    if case > 1:
        names = ("actuator.force", "actuator.angular_frequency")
        push = Sine(*(parameters.value(name) for name in names))
        forces += [
            LinearActuator(
                BASE, f"slider_{k}", axis_point=parameters.value(f"actuator.axis_{k}"), force=push,
                couple=actuators,
            )
            for k in (2, 3)
        ]  # fmt: skip
    unused = ("bare.", "workspace.", *drive.unused, *air.unused)
    joints = tracker_joints(parameters, BASE, shift)
    system = System(
        [base, *tracker_bodies(parameters, shift)],
        (*joints, *stroke_drivers(joints, strokes)),
        (*forces, *drive.forces),
    )
    return Scene(
        name=f"uav_tracker_{case}",
        title=TITLES[case],
        system=system,
        state0=system.reference if start is None else flight_state(start, parameters),
        parameters={k: v for k, v in air.parameters.to_dict().items() if not k.startswith(unused)},
        notes=(
            "Joint positions are reconstructed, not printed (docs/report_machine.md).",
            "J'_3 (1, 1) of Table 5.3 is corrected to the mirror of J'_2.",
            f"Actuator couple: {actuators}. Equal rotor speeds are not a trim.",
            *drive.notes,
            *air.notes,
            *((STARTED,) if start is not None else ()),
        ),
        watch=(BASE, "slider_2", "slider_3", "panel_7"),
    )


def make_uav(parameters: Parameters = PART_II, **options: Any) -> Uav:
    """The UAV with its state space, for trim, linearisation and tuning.

    Args:
        parameters: parameters, which may be traced.
        options: options of `uav_tracker`, such as friction or drag; the case is 2, which has
            actuators.
    """
    system = uav_tracker(2, parameters, **options).system
    tree = spanning_tree(system)
    names = [name for name, _ in velocity_names(tree)]
    panel = tuple(names.index(name) for name in PANEL_COORDINATES)
    others = tuple(k for k in range(len(names)) if k not in panel)
    # all rows of its loops are independent: none has to be selected at known numbers
    space = TreeSpace(system, selection=Selection(panel, others, tuple(range(len(others)))))
    shift, limits = parameters.value("mount.shift"), tracker_limits(parameters)
    return Uav(space, tracker_geometry(parameters), shift, limits)
