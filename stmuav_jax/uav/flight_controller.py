"""Controllers of flying machines: position and attitude by the rotors, and the UAV with its tracker.

With errors e_x, e_v of position and velocity, and R_d the attitude whose z axis is along F and whose
x axis is nearest to the target heading,

    F   = -k_x e_x - k_v e_v - k_i q - m g + m a_d,       f = F . R e_z
    e_R = vee(R_d^T R - R^T R_d) / 2,                   e_W = W - R^T R_d W_d
    M   = -k_R e_R - k_W e_W + W x (J W + h) + M_s - J (W x R^T R_d W_d - R^T R_d dW_d/dt)

where g is the acceleration of free fall, q the integral of e_x, h the angular momentum of parts that
move against the base, and M_s the moment that accelerates them. W_d and its rate follow from the
controller's own F along the motion that it asks for.

Where rotors are lost, yaw is given up: the target attitude turns with the machine about its thrust, and its
angular velocity about z is slowed down within what is left of the rotors' limits.

Source: T. Lee, M. Leok, N. H. McClamroch, Geometric tracking control of a quadrotor UAV on SE(3),
49th IEEE Conference on Decision and Control (2010), Eq. 10 to 23 (z axis down there, up here);
M. W. Mueller, R. D'Andrea, Stability and control of a quadrocopter despite the complete loss
of one, two, or three propellers, IEEE International Conference on Robotics and Automation (2014)."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..analysis.mass_properties import Moments, mass_moments
from ..analysis.sensors import gravity_of
from ..checks.errors import ModelError, has_values
from ..checks.numbers import array_module, as_floats, as_numpy, check_nonnegative, check_positive
from ..control.references import Waypoint
from ..math import lapack
from ..math.compiler import quick_jit
from ..math.rotation import rotation_matrix, skew
from ..mechanics.forces import GroundContact
from ..mechanics.state import State
from ..mechanics.system import System
from .allocation import RotorLimits, check_lift, wrench_map
from .motion_estimator import MotionEstimate, state_of
from .motor import only_rotors
from .panel_servo import PanelServo, StrokeServo, facing, panel_motion
from .rotor import Rotors
from .tracker.kinematics import PairMotion


class MassProperties(NamedTuple):
    """Mass properties of a machine, all bodies together.

    Attributes:
        mass: [kg]. centre: centre of mass from the base's, its axes (3,) [m].
        J: inertia about it, base axes (3, 3) [kg m^2].
        h: angular momentum of parts that move against the base (3,) [N m s].
        moment: moment M_s that accelerates these parts (3,) [N m].
    """

    mass: Float[Array, ""]
    centre: Float[Array, "3"]
    J: Float[Array, "3 3"]
    h: Float[Array, "3"]
    moment: Float[Array, "3"]


class FlightGains(eqx.Module):
    """Gains of `wrench_for`, per unit of mass and inertia.

    With equal gains about all axes the errors of small motions obey e'' + k_v e' + k_x e = 0.

    Attributes:
        position: k_x / m [1/s^2]. velocity: k_v / m [1/s]. integral: k_i / m [1/s^3].
        attitude: k_R / J [1/s^2]. rate: k_W / J [1/s].
    """

    position: Float[Array, ""] = eqx.field(converter=as_floats, default=9.0)
    velocity: Float[Array, ""] = eqx.field(converter=as_floats, default=5.0)
    integral: Float[Array, ""] = eqx.field(converter=as_floats, default=0.0)
    attitude: Float[Array, ""] = eqx.field(converter=as_floats, default=200.0)
    rate: Float[Array, ""] = eqx.field(converter=as_floats, default=25.0)

    def __check_init__(self) -> None:
        units = {"position": "1/s^2", "velocity": "1/s", "attitude": "1/s^2", "rate": "1/s"}
        subject = "The {} gain of the flight controller"
        for name, unit in units.items():
            check_positive(getattr(self, name), subject.format(name), unit)
        check_nonnegative(self.integral, subject.format("integral"), "1/s^3")


class BaseMotion(NamedTuple):
    """Motion of a machine's base: position, rotation, velocity (world), angular velocity (base)."""

    r: Float[Array, "3"]
    R: Float[Array, "3 3"]
    v: Float[Array, "3"]
    omega: Float[Array, "3"]


def base_motion(state: State) -> BaseMotion:
    """Motion of the first body of a state."""
    return BaseMotion(state.r[0], rotation_matrix(state.p[0]), state.v[0], state.omega[0])


class WantedWrench(NamedTuple):
    """Wrench that a flight controller asks for, and its errors.

    Attributes:
        wrench: thrust along the base's z axis [N] and moments about the centre of mass [N m] (4,).
        force: F, world (3,) [N].
        attitude_error: e_R (3,) [rad]. rate_error: e_W (3,) [rad/s].
    """

    wrench: Float[Array, "4"]
    force: Float[Array, "3"]
    attitude_error: Float[Array, "3"]
    rate_error: Float[Array, "3"]


def vee_vector(M: Float[Array, "3 3"]) -> Float[Array, "3"]:
    """Vector of the antisymmetric part of a matrix."""
    return 0.5 * jnp.stack([M[2, 1] - M[1, 2], M[0, 2] - M[2, 0], M[1, 0] - M[0, 1]])


def attitude_of(force: Float[Array, "3"], heading: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Attitude R_d with z along a force and x nearest to a heading [rad]; NaN for a level heading
    along the force."""
    z = force / jnp.sqrt(jnp.sum(force * force))
    heading_vector = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)])
    y = jnp.cross(z, heading_vector)
    y = y / jnp.sqrt(jnp.sum(y * y))
    return jnp.stack([jnp.cross(y, z), y, z], axis=1)


def wrench_for(
    base: BaseMotion,
    target: Waypoint,
    mass: MassProperties,
    gains: FlightGains,
    gravity: Float[Array, "3"],
    integral: Float[Array, "3"],
) -> WantedWrench:
    """Thrust and moments of the geometric controller; the module's docstring has its equations.

    Args:
        gravity: acceleration of free fall (3,) [m/s^2]. integral: q (3,) [m s].
    """
    m, R, W = mass.mass, base.R, base.omega

    def control_force(r: Array, v: Array, at: Waypoint, sum_of: Array) -> Array:
        pull = gains.position * (at.r - r) + gains.velocity * (at.v - v) - gains.integral * sum_of
        return m * (pull + at.a - gravity)

    F = control_force(base.r, base.v, target, integral)
    thrust = F @ R[:, 2]
    # the acceleration that the thrust gives, and its rate as the machine turns
    a = thrust / m * R[:, 2] + gravity
    F_rate = m * (
        gains.position * (target.v - base.v)
        + gains.velocity * (target.a - a)
        - gains.integral * (base.r - target.r)
        + target.jerk
    )
    thrust_axis_rate = R @ jnp.cross(W, jnp.array([0.0, 0.0, 1.0]))
    a_rate = ((F_rate @ R[:, 2] + F @ thrust_axis_rate) * R[:, 2] + thrust * thrust_axis_rate) / m

    def force_after(s: Array) -> Array:
        """F a time s later, along the motion with this acceleration's own rate."""
        step = target._replace(
            r=target.r + s * target.v + s**2 / 2 * target.a,
            v=target.v + s * target.a + s**2 / 2 * target.jerk,
            a=target.a + s * target.jerk + s**2 / 2 * target.snap,
        )
        r, v = base.r + s * base.v + s**2 / 2 * a, base.v + s * a + s**2 / 2 * a_rate
        return control_force(r, v, step, integral + s * (base.r - target.r))

    def target_turning(s: Array) -> tuple[Array, Array]:
        """R_d a time s later, and W_d."""
        yaw = lambda s: target.heading + s * target.turning + s**2 / 2 * target.turning_rate
        attitude = lambda s: attitude_of(force_after(s), yaw(s))
        R_d, rate = jax.jvp(attitude, (s,), (jnp.ones_like(s),))
        return R_d, vee_vector(R_d.T @ rate)

    zero, unit = jnp.zeros_like(thrust), jnp.ones_like(thrust)
    (R_d, W_d), (_, W_d_rate) = jax.jvp(target_turning, (zero,), (unit,))
    e_R = vee_vector(R_d.T @ R)
    R_error = R.T @ R_d
    e_W = W - R_error @ W_d
    J = mass.J
    moment = J @ (-gains.attitude * e_R - gains.rate * e_W + R_error @ W_d_rate)
    moment = moment - J @ jnp.cross(W, R_error @ W_d) + jnp.cross(W, J @ W + mass.h) + mass.moment
    return WantedWrench(jnp.concatenate([thrust[None], moment]), F, e_R, e_W)


# Part of the turning moments of the rotors, below which no change of speeds turns without tilting.
_TURNS = 1e-9


def inverse_without_yaw(
    wrenches: Float[Array, "4 k"],
    working: tuple[int, ...],
    limits: tuple[Float[Array, " k"], Float[Array, " k"]] | None,
    weight: Float[Array, ""],
    quantity: tuple[str, str],
) -> Float[Array, "w 4"]:
    """Squared speeds, or thrusts, of the working rotors per unit of thrust and moments.

    Those of thrust and tilt are of minimum norm without regard to yaw; those of yaw change neither
    thrust nor tilt, and are zero where there are none such.

    Args:
        wrenches: thrust and moments per unit of them.
        limits: lower and upper ones of them. weight: thrust in hover [N]. quantity: their name and unit.

    Raises:
        ModelError: no limits, or limits within which the working rotors do not hover.
    """
    lost = [str(k + 1) for k in range(wrenches.shape[1]) if k not in working]
    loss_text = f"without rotor{'s' if len(lost) > 1 else ''} {', '.join(lost)}"
    if limits is None:
        raise ModelError(
            f"A flight {loss_text} needs limits of the rotor speeds: rotors cannot push down."
        )
    working_wrenches = np.asarray(wrenches)[:, list(working)]
    # Roll, pitch and thrust have priority: without them the machine falls, while a turning machine still
    # holds its place.
    inverse = np.linalg.pinv(working_wrenches[:3])
    lower, upper = (np.asarray(x)[list(working)] for x in limits)
    u = inverse[:, 0] * float(weight)
    is_right_inverse = np.allclose(working_wrenches[:3] @ inverse, np.eye(3), atol=1e-9)
    if not is_right_inverse or np.any(inverse[:, 0] <= 0) or np.any((u <= lower) | (u >= upper)):
        name, unit = quantity
        raise ModelError(
            f"Thrust and tilt cannot be held {loss_text}: the hover needs {name} of "
            f"{np.array2string(u, precision=3)} {unit}, and the limits are "
            f"{np.array2string(lower, precision=3)} to {np.array2string(upper, precision=3)}."
        )
    # The part of the yaw moment in the null space of thrust and tilt slows the turning without a cost to
    # them.
    turn = working_wrenches[3] - inverse @ (working_wrenches[:3] @ working_wrenches[3])
    size = turn @ turn
    is_turning = size > _TURNS**2 * (working_wrenches[3] @ working_wrenches[3])
    turn = turn / size if is_turning else np.zeros_like(turn)
    return jnp.asarray(np.concatenate([inverse, turn[:, None]], axis=1))


def as_it_turns(target: Waypoint, base: BaseMotion) -> Waypoint:
    """Waypoint whose heading and turn rate are those of the base."""
    # A heading that cannot be controlled is taken from the machine itself, else its error would saturate
    # the rotors.
    x, rate = base.R[:, 0], (base.R @ skew(base.omega))[:, 0]
    turning = (x[0] * rate[1] - x[1] * rate[0]) / (x[0] ** 2 + x[1] ** 2)
    return target._replace(
        heading=jnp.arctan2(x[1], x[0]), turning=turning, turning_rate=jnp.zeros_like(turning)
    )


# Round-off of squared speeds, as a share.
_ROUND_OFF = 1e-9


# Repetitions of the allocation to rotors with curves: each multiplies the error of yaw by the relative change
# of the slope of torque by thrust, which is zero where both curves have one shape.
_YAW_STEPS = 6


class FlightMemory(NamedTuple):
    """Memory of a `FlightController`.

    Attributes:
        integral: integral of the position error (3,) [m s].
    """

    integral: Float[Array, "3"]


class Feet(eqx.Module):
    """Feet of the base of a machine, in its controller's model.

    Attributes:
        places: from the base's centre of mass, its axes (k, 3) [m].
        ground: heights of the ground under them, world (k,) [m].
    """

    places: Float[Array, "k 3"]
    ground: Float[Array, " k"]

    def touches(self, base: BaseMotion) -> Bool[Array, ""]:
        """True if a foot is below the ground's height."""
        return jnp.any(base.r[2] + self.places @ base.R[2] < self.ground)


class FlightController(eqx.Module):
    """Controller of the rotors: position and heading of the machine's base follow a `Waypoint`.

    The estimate is a `State` of all bodies, a `MotionEstimate`, or the `BaseMotion` of the base; the
    reference is a `Waypoint`, the memory a `FlightMemory`. While the rotors cannot give the target wrench, and
    while the estimate has a foot of the base's landing gear (`GroundContact`) below the ground, the integral of
    the position error is frozen.

    Rotors with curves are allocated thrusts, whose wrench is linear except for yaw, and commanded the speeds
    that give them.

    Args:
        system: machine with one set of rotors and with gravity.
        rate: control rate [Hz], for the integral.
        gains: gains of the controller.
        limits: limits of the rotor speeds, within those of the machine's motors, which are the default.
        mass: mass properties of all bodies, or a function of the estimate that returns them; by
            default those of the system's reference posture.
        lost: numbers of rotors that are lost, the first being 1. The controller then does not hold yaw: thrust
            and tilt are allocated to the working rotors first, and the remaining margin to their limits, which
            are required, reduces the yaw rate.

    Raises:
        ModelError: not one set of rotors, no gravity, limits that cannot carry the weight or that the
            motors do not reach, or lost rotors without which the others cannot hold thrust and tilt.
    """

    gains: FlightGains
    mass: MassProperties | Callable[[Any], MassProperties]
    gravity: Float[Array, "3"]
    wrenches: Float[Array, "4 k"]
    inverse: Float[Array, "k 4"]
    limits: RotorLimits | None
    rotors: Rotors | None
    period: Float[Array, ""]
    feet: Feet | None
    working: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        *,
        gains: FlightGains | None = None,
        limits: RotorLimits | None = None,
        mass: MassProperties | Callable[[Any], MassProperties] | None = None,
        lost: Sequence[int] = (),
    ) -> None:
        motors, self.gravity = only_rotors(system, "A flight controller"), gravity_of(system)
        if not np.any(as_numpy(self.gravity) != 0):
            raise ModelError(
                "A flight controller needs gravity: add Gravity() to the forces of the system."
            )
        rotors, count = motors.rotors, motors.rotors.spin.shape[0]
        motor_limits = getattr(motors, "squared_limits", None)
        # The motors clip commands beyond their range; the controller has to know these limits to keep tilt
        # before thrust.
        if limits is None and motor_limits is not None:
            limits = RotorLimits(jnp.sqrt(motor_limits[0]), jnp.sqrt(motor_limits[1]))
        mass_of_all, g = as_numpy((system.bodies.mass, self.gravity))
        xp = array_module(mass_of_all, g)
        weight = as_floats(xp.sum(mass_of_all) * xp.linalg.norm(g))
        if limits is not None:
            check_lift(rotors, limits, weight)
            if motor_limits is not None and has_values(limits, motor_limits):
                _check_reached(as_numpy(limits.squared(count)), as_numpy(motor_limits))
        hovering = rotors.hover(xp.sum(mass_of_all), g)
        # moments are about the base's centre of mass: the map does not change with the posture
        self.wrenches = wrench_map(rotors, system.bodies.com[0], hovering)
        self.rotors, self.limits = None, limits
        if rotors.has_curves:
            self.rotors = rotors
            self.wrenches = self.wrenches / jax.grad(lambda u: jnp.sum(rotors.thrusts(u)))(hovering)
        for rotor in lost:
            if rotor != int(rotor) or not 1 <= rotor <= count:
                raise ModelError(
                    f"The machine has rotors 1 to {count}, but no rotor {rotor} to be lost."
                )
        self.working = tuple(k for k in range(count) if k + 1 not in lost) if len(lost) else None
        if self.working is None:
            self.inverse = _wrench_pseudoinverse(self.wrenches)
            if not np.all(np.asarray(self.inverse)[:, 0] > 0):
                raise ModelError(
                    "The base's centre of mass is too far from the rotors' centre for this flight "
                    "controller: not every rotor adds to the thrust where its moments balance."
                )
        else:
            bounds = None if limits is None else self._bounds()
            names = ("squared speeds", "rad^2/s^2") if self.rotors is None else ("thrusts", "N")
            self.inverse = inverse_without_yaw(self.wrenches, self.working, bounds, weight, names)
        self.gains = FlightGains() if gains is None else gains
        self.period = as_floats(1.0 / rate)
        self.mass = mass_properties(system, system.reference) if mass is None else mass
        self.feet = feet_of(system)

    def start(self) -> FlightMemory:
        """First memory."""
        return FlightMemory(jnp.zeros(3))

    def __call__(
        self, estimate: Any, reference: Waypoint, memory: FlightMemory
    ) -> tuple[Float[Array, " k"], FlightMemory]:
        """Squared rotor speeds (k,) [rad^2/s^2], and the memory."""
        estimate = state_of(estimate)
        mass = self.mass(estimate) if callable(self.mass) else self.mass
        return self.command(estimate, reference, memory, mass)

    def command(
        self, estimate: Any, reference: Waypoint, memory: FlightMemory, mass: MassProperties
    ) -> tuple[Float[Array, " k"], FlightMemory]:
        """Squared rotor speeds (k,) and the memory, with given mass properties."""
        base = base_motion(estimate) if isinstance(estimate, State) else estimate
        target = reference if self.working is None else as_it_turns(reference, base)
        demand = wrench_for(base, target, mass, self.gains, self.gravity, memory.integral)
        # The rotors' map is about the base's centre of mass; the thrust acts there with a lever about that of
        # the whole machine, which moves with the panel.
        lever = jnp.cross(mass.centre, jnp.array([0.0, 0.0, 1.0]) * demand.wrench[0])
        wrench = demand.wrench.at[1:].add(lever)
        if self.working is not None:
            # Without control of yaw its rate is only damped.
            wrench = wrench.at[3].add(-self.gains.rate * mass.J[2, 2] * base.omega[2])
        squared, is_attained = self._allocate(wrench)
        if self.rotors is not None:
            thrusts = squared
            for _ in range(_YAW_STEPS):
                squared = self.rotors.squared_speeds(thrusts)
                yaw = -self.rotors.spin @ self.rotors.torques(squared)
                beside_tangent = yaw - self.wrenches[3] @ thrusts
                thrusts, is_attained = self._allocate(wrench.at[3].add(-beside_tangent))
            squared = self.rotors.squared_speeds(thrusts)
        # The integral stands still while the rotors saturate or a foot carries weight: it would wind up
        # against a force that it cannot overcome.
        error = base.r - reference.r
        if self.feet is not None:
            is_attained = is_attained & ~self.feet.touches(base)
        integral = memory.integral + jnp.where(is_attained, self.period, 0.0) * error
        return squared, FlightMemory(integral)

    def _bounds(self) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Lower and upper squared speeds (k,), or thrusts of rotors with curves."""
        assert self.limits is not None
        lower, upper = self.limits.squared(self.wrenches.shape[1])
        if self.rotors is None:
            return lower, upper
        return self.rotors.thrusts(lower), self.rotors.thrusts(upper)

    def _allocate(self, wrench: Float[Array, "4"]) -> tuple[Float[Array, " k"], Array]:
        """Squared speeds, or thrusts of rotors with curves, those of lost rotors zero.

        With them whether they give the wrench; with lost rotors, whether they give thrust and tilt.
        """
        if self.working is not None:
            places, count = jnp.array(self.working), self.wrenches.shape[1]
            lower, upper = (x[places] for x in self._bounds())
            u, is_attained = _allocate_tilt(self.inverse, wrench, lower, upper)
            # yaw is what the others leave of it, and is changed where the limits still allow it
            turn = self.inverse[:, 3] * (wrench[3] - self.wrenches[3, places] @ u)
            b = _largest_share(jnp.abs(turn), jnp.where(turn > 0, upper - u, u - lower))
            return jnp.zeros(count).at[places].set(u + b * turn), is_attained
        if self.limits is None:
            return self.inverse @ wrench, jnp.ones((), bool)
        return within_limits(self.inverse, wrench, *self._bounds())


def _check_reached(squared: Any, squared_motors: Any) -> None:
    """Raise `ModelError` for limits beyond those of the motors, both as squared speeds."""
    (low, high), (lowest, highest) = squared, squared_motors
    # round-off of the squares
    if np.any(low < lowest * (1 - _ROUND_OFF)) or np.any(high > highest * (1 + _ROUND_OFF)):
        raise ModelError(
            f"The controller's limits of the rotor speeds, {np.sqrt(np.min(low)):g} to {np.sqrt(np.max(high)):g} "
            f"rad/s, must lie within those of the motors, {np.sqrt(np.max(lowest)):g} to "
            f"{np.sqrt(np.min(highest)):g} rad/s, which turn no faster and no more slowly."
        )


def within_limits(
    inverse: Float[Array, "k 4"],
    wrench: Float[Array, "4"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """Squared rotor speeds within limits, and whether they give the wrench.

    Minimum-norm speeds where these are within the limits. Otherwise, in this order: the largest
    share of the tilting moment that some thrust allows, the thrust nearest to the target, and
    the largest share of the turning moment. Other speeds than those of minimum norm, which might give
    the wrench, are not searched for.

    Args:
        inverse: minimum-norm squared speeds per unit of the wrench; those of thrust positive.
        lower, upper: limits (k,) [rad^2/s^2].
    """
    u, is_lift_attained = _allocate_tilt(inverse, wrench, lower, upper)
    # Yaw comes last: its moment arm is short, and it may take only what thrust and tilt leave of the
    # limits.
    turn = inverse[:, 3] * wrench[3]
    b = _largest_share(jnp.abs(turn), jnp.where(turn > 0, upper - u, u - lower))
    return u + b * turn, is_lift_attained & (b == 1.0)


def _allocate_tilt(
    inverse: Float[Array, "k 4"],
    wrench: Float[Array, "4"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """Squared speeds for thrust and tilting moments, and whether they give these."""
    # All rotors share thrust and tilt in fixed proportions, so that the largest attainable share is a
    # minimum over pairs of rotors and needs no search at 400 Hz.
    lift, tilt = inverse[:, 0], inverse[:, 1:3] @ wrench[1:3]
    # lower_i <= lift_i T + a tilt_i <= upper_i has a solution T where, for all i and j,
    #   a (tilt_j / lift_j - tilt_i / lift_i) <= upper_j / lift_j - lower_i / lift_i
    slope = tilt / lift
    rise = slope[None, :] - slope[:, None]
    room = (upper / lift)[None, :] - (lower / lift)[:, None]
    a = _largest_share(rise, room)
    smallest, largest = jnp.max((lower - a * tilt) / lift), jnp.min((upper - a * tilt) / lift)
    thrust = jnp.minimum(jnp.maximum(wrench[0], smallest), largest)
    return lift * thrust + a * tilt, (a == 1.0) & (thrust == wrench[0])


def _largest_share(rise: Float[Array, "*s"], room: Float[Array, "*s"]) -> Float[Array, ""]:
    """Largest share a in [0, 1] with a rise <= room everywhere; NaN stays NaN."""
    # Only entries that would pass their limit bound the share; division by the others could give 0 / 0.
    limited = rise > jnp.maximum(room, 0.0)
    shares = jnp.where(limited, jnp.maximum(room, 0.0) / jnp.where(limited, rise, 1.0), 1.0)
    return jnp.min(shares) + 0.0 * jnp.sum(rise)


def feet_of(system: System) -> Feet | None:
    """Feet of the ground contacts of a system's first body; None without any."""
    contacts = [
        f for f in system.forces if isinstance(f, GroundContact) and system.index(f.body) == 0
    ]
    if not contacts:
        return None
    heights = [jnp.full(len(f.feet), f.height) for f in contacts]
    places = jnp.concatenate([f.feet - system.bodies.com[0] for f in contacts])
    return Feet(places, jnp.concatenate(heights))


@quick_jit
def _wrench_pseudoinverse(wrenches: Float[Array, "4 k"]) -> Float[Array, "k 4"]:
    return lapack.pseudoinverse(wrenches, 1e-14)


def central_properties(about: Moments, moment: Float[Array, "3"] | None = None) -> MassProperties:
    """Mass properties about the centre of mass, from moments about the base's."""
    m, c = about.mass, about.first / about.mass
    # The parallel axis theorem moves the inertia from the base's centre of mass, where everything is
    # summed, to that of the whole machine.
    J = about.inertia - m * (c @ c * jnp.eye(3) - jnp.outer(c, c))
    h = about.momentum - jnp.cross(about.first, about.first_rate) / m
    return MassProperties(m, c, J, h, jnp.zeros(3) if moment is None else moment)


@quick_jit
def mass_properties(
    system: System, state: State, moment: Float[Array, "3"] | None = None
) -> MassProperties:
    """Mass properties of all bodies at a state; the first body is the base.

    Args:
        moment: moment that accelerates the other parts against the base (3,) [N m], by default zero.
    """
    return central_properties(mass_moments(system, state), moment)


class UavReference(NamedTuple):
    """Reference of a `UavController`.

    Attributes:
        waypoint: target motion of the base.
        panel: target panel angles in the base's axes, with rates and accelerations; or the
            direction (3,) in the world that the panel is to face.
    """

    waypoint: Waypoint
    panel: PairMotion | Float[Array, "3"]


class UavController(eqx.Module):
    """Controller of the scene `uav_tracker`: six rotors first, then the forces of two sliders.

    The estimate is the `State` of all bodies, or a `MotionEstimate`. Centre of mass, inertia and
    angular momentum of the moving tracker are fed forward to the rotors, as is the moment that its servo takes.

    Attributes:
        system: machine whose masses the controller uses.
        flight: controller of the rotors. servo: servo of the panel.
        feedforward: false for a controller that treats the tracker as a rigid part in the reference posture.
    """

    system: System
    flight: FlightController
    servo: PanelServo | StrokeServo
    feedforward: bool = eqx.field(static=True, default=True)

    def start(self) -> FlightMemory:
        """First memory."""
        return self.flight.start()

    def __call__(
        self, estimate: State | MotionEstimate, reference: UavReference, memory: FlightMemory
    ) -> tuple[Float[Array, " m"], FlightMemory]:
        """Inputs (k + 2,): squared rotor speeds [rad^2/s^2] and forces [N]; and the memory."""
        state: State = state_of(estimate)
        rigid_properties = self.flight.mass
        assert isinstance(rigid_properties, MassProperties)
        mass = mass_properties(self.system, state) if self.feedforward else rigid_properties
        return self.command(state, reference, memory, mass, self.servo)

    def command(
        self,
        state: State,
        reference: UavReference,
        memory: FlightMemory,
        mass: MassProperties,
        servo: PanelServo | StrokeServo,
    ) -> tuple[Float[Array, " m"], FlightMemory]:
        """Inputs (k + 2,) and the memory, with given mass properties and a given servo."""
        flight, waypoint = self.flight, reference.waypoint
        gravity_b = rotation_matrix(state.p[0]).T @ (flight.gravity - waypoint.a)
        panel_target = reference.panel
        if not isinstance(panel_target, PairMotion):
            panel_target = facing(jnp.asarray(panel_target), state)
        panel_reaction = servo.command(panel_motion(state), panel_target, gravity_b, mass.centre)
        if self.feedforward:
            mass = mass._replace(moment=panel_reaction.moment)
        squared, next_memory = flight.command(state, waypoint, memory, mass)
        return jnp.concatenate([squared, panel_reaction.forces]), next_memory
