"""Tracker mechanism: bodies 2 to 7, their eight joints, and what moves or holds its sliders.

    T 1-2, T 1-3 (z)   R 1-4 (x)   R 2-6 (y)   U 3-5   U 4-7   S 5-7   S 6-7

All positions follow from a table's lengths ("geometry.") and the panel's initial angles
("posture."), so that a changed length moves every joint and the loops stay closed.

Source: report Part II, section 3.1 (joints); docs/report_machine.md (lengths)."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import (
    ModelError,
    SettingError,
    check_finite,
    check_shape,
    has_values,
    shape_of,
)
from ...checks.numbers import as_floats, as_numpy
from ...checks.schema import quantity
from ...checks.shapes import Numbers
from ...math.compiler import kept_jit, quick_jit
from ...math.native.program import native
from ...math.rotation import angular_velocity, product, rotation_matrix, turn_about
from ...mechanics.body import Body
from ...mechanics.joint import Joint, Motion, drive, revolute, spherical, translational, universal
from ...mechanics.joint_forces import EndStop, JointFriction, JointServo
from ...mechanics.load import AbstractForce, ActsOn, Load, Signal, check_signal, evaluate, push
from ...mechanics.parameters import Parameters
from ...mechanics.state import Kinematics, State
from .geometry import (
    TrackerGeometry,
    check_closure,
    close_loops,
    initial_angles,
    tracker_geometry,
    turn_by_angles,
)
from .kinematics import RISING, Rods, strokes_of

# --- options of scenes with the tracker

# Numbers left out are those of the scene's parameter table ("servo.", "stop.", "friction."); numbers given go
# into the table that is kept with the results. A stroke is the slider's displacement along its joint's z axis
# from the initial posture, where it is zero.

Target = Numbers | Callable[..., object]


@dataclass(frozen=True)
class Servo:
    """Position servo in each slider joint, in addition to the forces of the scene.

    Attributes:
        stiffness: [N/m]. damping: [N s/m].
        targets: strokes to hold for sliders 2 and 3, numbers [m] or functions of t [s];
            by default the initial ones.
    """

    stiffness: Numbers | None = quantity("stiffness", "N/m")
    damping: Numbers | None = quantity("damping", "N s/m")
    targets: tuple[Target, Target] = quantity(
        "strokes to hold, of sliders 2 and 3", "m", 2, default=(0.0, 0.0)
    )


@dataclass(frozen=True)
class Stops:
    """End stops of both sliders' strokes.

    Attributes:
        lower, upper: strokes [m], one for both sliders or one for each.
        stiffness: [N/m]. damping: [N s/m]. width: of the smoothing [m].
    """

    lower: Numbers | None = quantity("lowest stroke, of both sliders or of each", "m", 1, 2)
    upper: Numbers | None = quantity("highest stroke, of both sliders or of each", "m", 1, 2)
    stiffness: Numbers | None = quantity("stiffness", "N/m")
    damping: Numbers | None = quantity("damping", "N s/m")
    width: Numbers | None = quantity("width of the smoothing", "m")


@dataclass(frozen=True)
class Friction:
    """Friction in each slider joint.

    Attributes:
        coulomb: [N]. viscous: [N s/m]. speed: of the smoothing [m/s].
    """

    coulomb: Numbers | None = quantity("Coulomb's part", "N")
    viscous: Numbers | None = quantity("viscous part", "N s/m")
    speed: Numbers | None = quantity("speed of the smoothing", "m/s")


@dataclass(frozen=True)
class Strokes:
    """Prescribed strokes of both sliders, which rise smoothly from zero.

    Attributes:
        to: strokes at the end, of sliders 2 and 3 (2,) [m]. duration: of the rise [s].
    """

    to: Numbers = quantity("strokes at the end, of sliders 2 and 3", "m", 2, default=(0.0, 0.0))
    duration: Numbers = quantity("duration of the rise", "s", default=1.0)


@dataclass(frozen=True)
class PanelStart:
    """Start of the tracker's panel; numbers left out are the initial posture's, at rest.

    Attributes:
        phi, theta: panel angles [rad]. phi_rate, theta_rate: theirs [rad/s].
    """

    phi: Numbers | None = quantity("first panel angle", "rad")
    theta: Numbers | None = quantity("second panel angle", "rad")
    phi_rate: Numbers = quantity("rate of the first panel angle", "rad/s", default=0.0)
    theta_rate: Numbers = quantity("rate of the second panel angle", "rad/s", default=0.0)


# --- bodies and joints

# Bodies of the tracker, in the order of its arrays.
TRACKER_BODIES = ("slider_2", "slider_3", "post_4", "rod_5", "rod_6", "panel_7")


class Placement(NamedTuple):
    """Bodies and joints of the tracker at one posture, in the base's frame.

    Attributes:
        r: centres of mass of the bodies, in the order of `TRACKER_BODIES` (6, 3) [m].
        p: Euler parameters of the bodies, body to base (6, 4).
        points: points of the joints by joint name (3,) [m].
        axes: axes of the joints by joint name (3,), those of universal joints as "U35.i" and
            "U35.j".
    """

    r: Float[Array, "6 3"]
    p: Float[Array, "6 4"]
    points: dict[str, Float[Array, "3"]]
    axes: dict[str, Float[Array, "3"]]


def place(geometry: TrackerGeometry, angles: Float[Array, "2"], rods: Rods = RISING) -> Placement:
    """Place every body and joint at panel angles (phi, theta) (2,) [rad]; NaN out of reach.

    Body axes: z along the post and the rods, upward from the lower joint; post R_x, rod 6
    R_y, rod 5 R_y R_x (the y axis of universal joint 3-5 is in the slider, its x axis in the
    rod), panel R_x R_y.

    Source: report Part II, section 3.1 and Eq. 3.10; docs/report_machine.md.
    """
    # From the panel down: its angles place the ball joints, these the rods, and the rods the
    # sliders, in closed form.
    loops = close_loops(geometry, turn_by_angles(angles))
    q2, q3 = strokes_of(geometry, loops, rods)
    x, y, z = jnp.eye(3)
    hinge = jnp.stack([geometry.axis[0], geometry.axis[1], geometry.hinge])
    foot = jnp.stack([geometry.axis[0], geometry.axis[1], jnp.zeros(())])
    top = hinge + loops.rise * z - loops.lean * y
    ball_2, ball_3 = (hinge + jnp.stack(ball) for ball in loops.balls)
    low_2 = foot - geometry.arms[0] * x + q2 * z
    low_3 = foot + geometry.arms[1] * y + q3 * z
    along_2, along_3 = ball_2 - low_2, ball_3 - low_3
    # The universal joint of rod 5 turns about y first and then about x; rod 6 has its hinge about y
    # alone.
    rod_5_tilt_y = jnp.arctan2(along_3[0], along_3[2])
    rod_5_tilt_x = jnp.arctan2(-along_3[1], jnp.sqrt(along_3[0] ** 2 + along_3[2] ** 2))
    level = jnp.array([1.0, 0.0, 0.0, 0.0])
    post = turn_about(jnp.arctan2(loops.lean, loops.rise), 0)
    rod_5 = product(turn_about(rod_5_tilt_y, 1), turn_about(rod_5_tilt_x, 0))
    rod_6 = turn_about(jnp.arctan2(along_2[0], along_2[2]), 1)
    panel = product(turn_about(angles[0], 0), turn_about(angles[1], 1))
    R_panel = rotation_matrix(panel)
    slider_out, slider_up = geometry.slider_out, geometry.slider_up
    r = jnp.stack(
        [
            low_2 - slider_out[0] * x + slider_up[0] * z,
            low_3 + slider_out[1] * y + slider_up[1] * z,
            hinge + rotation_matrix(post) @ geometry.post_com,
            low_3 + geometry.rod_com[1] * along_3,
            low_2 + geometry.rod_com[0] * along_2,
            top + R_panel @ geometry.panel_com,
        ]
    )
    p = jnp.stack([level, level, post, rod_5, rod_6, panel])
    points = {
        "T12": r[0], "T13": r[1], "R14": hinge, "R26": low_2,
        "U35": low_3, "U47": top, "S57": ball_3, "S67": ball_2,
    }  # fmt: skip
    axes = {
        "T12": z, "T13": z, "R14": x, "R26": y,
        "U35.i": y, "U35.j": rotation_matrix(rod_5)[:, 0],
        "U47.i": x, "U47.j": R_panel[:, 1],
    }  # fmt: skip
    return Placement(r, p, points, axes)


@quick_jit
def posture(
    geometry: TrackerGeometry, angles: Float[Array, "2"], rates: Float[Array, "2"] | None = None
) -> State:
    """State of the six bodies on a base at rest.

    Args:
        angles: panel angles (phi, theta) (2,) [rad].
        rates: rates of the panel angles (2,) [rad/s], by default zero.
    """

    def body_poses(x: Array) -> tuple[Array, Array]:
        placement = place(geometry, x)
        return placement.r, placement.p

    if rates is None:
        r, p = body_poses(angles)
        return State(r, p, jnp.zeros_like(r), jnp.zeros_like(r))
    # Velocities are the derivative of the poses: no second set of formulas can disagree with the first.
    (r, p), (v, p_rate) = jax.jvp(body_poses, (angles,), (rates,))
    return State(r, p, v, jax.vmap(angular_velocity)(p, p_rate))


@quick_jit
def place_on_base(
    geometry: TrackerGeometry,
    displacement: Float[Array, "3"],
    angles: Float[Array, "2"],
    rates: Float[Array, "2"] | None,
    r: Float[Array, "3"],
    p: Float[Array, "4"],
    v: Float[Array, "3"],
    omega: Float[Array, "3"],
) -> State:
    """State of a moving base and of the six bodies on it, base first.

    Args:
        displacement: displacement of the tracker in the base's frame (3,) [m].
        angles, rates: panel angles (2,) [rad] and their rates [rad/s]; rates None for zero.
        r, p, v, omega: position (3,) [m], Euler parameters (4,), velocity (3,) [m/s] and angular
            velocity in its axes (3,) [rad/s] of the base.
    """
    tracker = posture(geometry, angles, rates)
    R = rotation_matrix(p)
    # The tracker is placed on a base at rest and carried along: the base adds its translation, and
    # its rotation times the arms.
    arms = tracker.r + displacement[None]
    turning = jax.vmap(rotation_matrix)(tracker.p)
    r_all = r[None] + arms @ R.T
    v_all = v[None] + (tracker.v + jnp.cross(omega[None], arms)) @ R.T
    p_all = jax.vmap(product, in_axes=(None, 0))(p, tracker.p)
    omega_all = tracker.omega + jnp.einsum("nji,j->ni", turning, omega)
    stack = lambda first, others: jnp.concatenate([first[None], others])
    return State(stack(r, r_all), stack(p, p_all), stack(v, v_all), stack(omega, omega_all))


@kept_jit
@native
def _place_displaced(
    geometry: TrackerGeometry, angles: Float[Array, "2"], displacement: Float[Array, "3"]
) -> Placement:
    """Displaced placement, compiled as one: each small operation alone would cost a compilation."""
    placement = place(geometry, angles)
    points = {name: point + displacement for name, point in placement.points.items()}
    return placement._replace(r=placement.r + displacement[None], points=points)


def _place_tracker(parameters: Parameters, displacement: Numbers) -> Placement:
    geometry, angles = tracker_geometry(parameters), initial_angles(parameters)
    placement = as_numpy(_place_displaced(geometry, angles, as_floats(displacement)))
    # NaN means that a root of the closed form was imaginary; which leg does not reach is then
    # found for the message.
    if has_values(placement) and not np.all(np.isfinite(placement.r)):
        check_closure(geometry, angles)
    return placement


def tracker_bodies(
    parameters: Parameters, displacement: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Body, ...]:
    """Bodies 2 to 7 of the tracker at the initial posture, displaced by `displacement` (3,) [m].

    Raises:
        ModelError: numbers that no body can have, or lengths with which the tracker cannot take
            that posture; the message names the leg, or the post, that does not reach.
    """
    placement = _place_tracker(parameters, displacement)
    return tuple(
        Body(
            name,
            parameters.value(f"mass.{name}"),
            parameters.value(f"inertia.{name}"),
            position=placement.r[k],
            orientation=placement.p[k],
            triangle_tolerance=parameters[f"inertia.{name}"].tolerance,
        )
        for k, name in enumerate(TRACKER_BODIES)
    )


def tracker_joints(
    parameters: Parameters, base: str, displacement: Numbers = (0.0, 0.0, 0.0)
) -> tuple[Joint, ...]:
    """Eight joints of the tracker on body `base` ("ground" if fixed), displaced by `displacement` [m].

    Raises:
        ModelError: lengths that cannot be assembled.
    """
    _, _, points, axes = _place_tracker(parameters, displacement)

    rows = (
        (translational, "T12", base, "slider_2"), (translational, "T13", base, "slider_3"),
        (revolute, "R14", base, "post_4"), (revolute, "R26", "slider_2", "rod_6"),
        (universal, "U35", "slider_3", "rod_5"), (universal, "U47", "post_4", "panel_7"),
        (spherical, "S57", "rod_5", "panel_7"), (spherical, "S67", "rod_6", "panel_7"),
    )  # fmt: skip
    joints = []
    for make_joint, name, i, j in rows:
        # a universal joint has an axis in each body, a spherical one none
        numbers = {"axis": name, "axis_i": f"{name}.i", "axis_j": f"{name}.j"}
        numbers = {key: axes[place] for key, place in numbers.items() if place in axes}
        joints.append(make_joint(name, i, j, point=points[name], **numbers))
    return tuple(joints)


class LinearActuator(AbstractForce):
    """Force u between a base and a slider, along the base's z axis through one point.

    The slider gets +u, the base -u, both on the line through `axis_point`, so that the pair
    conserves momentum. `couple="printed"` follows the report: the slider's force acts at its
    centre of mass without a moment, which adds a net couple of about 8 mN m per newton.

    Args:
        base, slider: names of the bodies.
        axis_point: point of the actuator's axis in the base's reference frame (3,) [m].
        force: u [N], or a function of (t, kinematics).
        couple: "consistent" or "printed".

    Source: report Part II, Eq. 4.25 and 4.26; the slider's moment is added here.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("force", "N"),)
    base: str = eqx.field(static=True)
    slider: str = eqx.field(static=True)
    axis_point: Float[Array, "3"]
    force: Signal
    couple: str = eqx.field(static=True)

    def __init__(
        self,
        base: str,
        slider: str,
        *,
        axis_point: Numbers,
        force: Numbers | Callable[..., object],
        couple: str = "consistent",
    ) -> None:
        if couple not in ("consistent", "printed"):
            raise SettingError(
                f"The actuators' couple must be 'consistent' or 'printed', not '{couple}'."
            )
        self.base, self.slider, self.couple = base, slider, couple
        self.axis_point = as_floats(axis_point)
        self.force = check_signal(force, f"The actuator force on body '{slider}'", (), "N")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.base, self.slider))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        force_label = f"LinearActuator: the force on body '{self.slider}'"
        u = evaluate(self.force, t, kin, force_label, ())
        base, slider = kin.index(self.base), kin.index(self.slider)
        # Both forces act on one line, so that the pair has no moment and its power is force times
        # the rate of the stroke.
        arm = kin.arm(self.base, self.axis_point)
        axial_force = u * kin.R_wb[base][:, 2]
        on_base = push(kin, self.base, -axial_force, arm)
        if self.couple == "printed":
            # The report's equations leave out the couple of two forces on different lines; it is kept for
            # comparison.
            return on_base + push(kin, self.slider, u * kin.R_wb[slider][:, 2])
        return on_base + push(kin, self.slider, axial_force, kin.r[base] + arm - kin.r[slider])


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
    if has_values(duration) and not float(duration) > 0:
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


class OptionForces(NamedTuple):
    """Force elements that options of a scene build.

    Attributes:
        forces: the elements. parameters: the scene's table with the numbers they have.
        unused: prefixes of the table's lines that nothing uses. notes: sentences about the elements.
    """

    forces: tuple[AbstractForce, ...]
    parameters: Parameters
    unused: tuple[str, ...]
    notes: tuple[str, ...]


def replace_numbers(parameters: Parameters, options: Mapping[str, object]) -> Parameters:
    """Table with the numbers of options, by their groups in the table; one number stands for a pair of them.

    Numbers that a user leaves out, which are None, stay those of the table, with their sources.
    """
    values = {}
    for group, option in options.items():
        for key, value in vars(option).items() if option is not None else ():
            if value is not None and (name := f"{group}.{key}") in parameters:
                pair = np.shape(parameters.value(name)) == (2,) and shape_of(value) == ()
                values[name] = jnp.stack([as_floats(value)] * 2) if pair else value
    # Results carry the table with which they were computed, so that a run can be repeated from its file.
    return parameters.replaced(values)


def slider_drive(
    parameters: Parameters,
    *,
    servo: Servo | None = None,
    stops: Stops | None = None,
    friction: Friction | None = None,
) -> OptionForces:
    """Force elements of the given options in the slider joints; None adds no element.

    Raises:
        ModelError: a number that an element refuses, or targets that are not two.
    """
    options = {"servo": servo, "stop": stops, "friction": friction}
    table = replace_numbers(parameters, options)
    take = lambda group, *names: {k: table.value(f"{group}.{k}") for k in names}
    forces: list[AbstractForce] = []
    if servo is not None:
        if len(servo.targets) != len(SLIDER_JOINTS):
            raise ModelError(
                f"The targets of the servo must be two, for the sliders of {' and '.join(SLIDER_JOINTS)}, "
                f"but they are {len(servo.targets)}."
            )
        numbers = take("servo", "stiffness", "damping")
        for joint, target in zip(SLIDER_JOINTS, servo.targets, strict=True):
            forces.append(JointServo(joint, target=target, coordinate="displacement", **numbers))
    if stops is not None:
        numbers = take("stop", "stiffness", "damping", "width")
        ends = (table.value("stop.lower"), table.value("stop.upper"))
        for joint, low, high in zip(SLIDER_JOINTS, *ends, strict=True):
            forces.append(
                EndStop(joint, lower=low, upper=high, coordinate="displacement", **numbers)
            )
    if friction is not None:
        numbers = take("friction", "coulomb", "viscous", "speed")
        forces += [JointFriction(j, coordinate="displacement", **numbers) for j in SLIDER_JOINTS]
    # A user who sets a parameter of an element that is not there is told so.
    unused = tuple(f"{group}." for group, option in options.items() if option is None)
    labels = {"servo": servo, "stops": stops, "friction": friction}
    used = ", ".join(name for name, option in labels.items() if option is not None)
    note = "Nothing holds the sliders: no friction, no stops, no servo."
    if used:
        note = f"Not in the report, in both slider joints: {used}."
    if servo is not None:
        note += " The servos work against the case's own forces."
    return OptionForces(tuple(forces), table, unused, (note,))
