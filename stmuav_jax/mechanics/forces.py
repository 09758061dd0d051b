"""Force elements: gravity, applied forces and moments, springs and dampers, contact with the ground.

The contact is a regularised, smooth force, see docs/simulation.md.
"""

from collections.abc import Callable
from typing import ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, shape_of
from ..checks.numbers import (
    as_floats,
    check_nonnegative,
    check_positive,
    check_scalar,
    check_vector,
)
from ..checks.shapes import Numbers, Scalar, Vec3
from ..math.derivative import length_and_direction, without_derivative
from ..math.rotation import cross
from ..math.stacked import apply_matrix, dot_product
from .body import GROUND
from .joint_forces import AbstractJointForce, one_sided_push, ramp_area, smooth_ramp
from .joint_states import evaluate_coordinate
from .load import AbstractForce, ActsOn, Load, Signal, check_signal, couple_load, evaluate, push
from .state import Kinematics


class Gravity(AbstractForce):
    """Uniform gravity with acceleration a (3,) [m/s^2] in the world; potential -m a . r."""

    acceleration: Vec3

    def __init__(self, acceleration: Numbers = (0.0, 0.0, -9.81)) -> None:
        self.acceleration = check_vector(acceleration, "The acceleration of gravity", "m/s^2")

    def acts_on(self) -> ActsOn:
        return ActsOn()

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        force = kin.mass[:, None] * self.acceleration[None]
        return Load(force, jnp.zeros_like(force), -jnp.sum(force * kin.r), jnp.zeros_like(t))


class AppliedForce(AbstractForce):
    """Force on a body at one of its points.

    Args:
        body: name of the body.
        force: (3,) [N], or a function of (t, kinematics) that returns it, also for a force that
            depends on the time alone.
        frame: axes of `force`: "world" or "body".
        point: point in the body's reference frame (3,) [m]; by default the centre of mass.

    Raises:
        ModelError: a number is not finite, a shape or the frame is invalid, or a function has the wrong
            arguments or, at its first evaluation, returns the wrong shape.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("force", "N"),)
    body: str = eqx.field(static=True)
    force: Signal
    frame: Literal["world", "body"] = eqx.field(static=True)
    point: Vec3 | None

    def __init__(
        self,
        body: str,
        force: "Numbers | Callable[..., object]",
        *,
        frame: Literal["world", "body"] = "world",
        point: Numbers | None = None,
    ) -> None:
        self.body, self.frame = body, _check_frame(frame)
        self.force = check_signal(force, f"AppliedForce: the force on body '{body}'", (3,), "N")
        subject = f"The point of the force on body '{body}'"
        self.point = None if point is None else check_vector(point, subject, "m")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        subject = f"AppliedForce: the force on body '{self.body}'"
        force_w = _evaluate_in_world(self.force, t, kin, subject, self.body, self.frame)
        arm = None if self.point is None else kin.arm(self.body, self.point)
        return push(kin, self.body, force_w, arm)


class AppliedMoment(AbstractForce):
    """Moment on a body: (3,) [N m] or a function of (t, kinematics), in `frame` axes."""

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("moment", "N m"),)
    body: str = eqx.field(static=True)
    moment: Signal
    frame: Literal["world", "body"] = eqx.field(static=True)

    def __init__(
        self,
        body: str,
        moment: "Numbers | Callable[..., object]",
        *,
        frame: Literal["world", "body"] = "world",
    ) -> None:
        subject = f"AppliedMoment: the moment on body '{body}'"
        self.body, self.frame = body, _check_frame(frame)
        self.moment = check_signal(moment, subject, (3,), "N m")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        subject = f"AppliedMoment: the moment on body '{self.body}'"
        moment_w = _evaluate_in_world(self.moment, t, kin, subject, self.body, self.frame)
        return push(kin, self.body, jnp.zeros_like(moment_w), moment_w=moment_w)


class LinearSpringDamper(AbstractForce):
    """Spring and damper between a point of body i and a point of body j.

    Args:
        point_i, point_j: points in the bodies' reference frames (3,) [m] (world for ground).
        stiffness: k >= 0 [N/m]. damping: c >= 0 [N s/m]. length: free length l >= 0 [m].

    With d from the point on i to the point on j and d_rate its rate, body i is pulled by

        k d - k l d / |d| + c (d . d_rate) d / |d|^2.

    Where the ends meet (d = 0) the first term is smooth. The second term has no direction and
    is left out; for l > 0 it jumps there, and the derivatives of force and energy with
    respect to d are NaN. The third term becomes c d_rate, its value before and after in a motion
    straight through the point, with the derivative along such motions: across them it jumps.

    Raises:
        ModelError: a number is not finite or is negative.
    """

    body_i: str = eqx.field(static=True)
    body_j: str = eqx.field(static=True)
    point_i: Vec3
    point_j: Vec3
    stiffness: Scalar
    damping: Scalar
    length: Scalar

    def __init__(
        self,
        body_i: str,
        body_j: str,
        *,
        point_i: Numbers = (0.0, 0.0, 0.0),
        point_j: Numbers = (0.0, 0.0, 0.0),
        stiffness: Numbers,
        damping: Numbers = 0.0,
        length: Numbers = 0.0,
    ) -> None:
        if body_i == body_j:
            raise ModelError(
                f"A spring-damper joins body '{body_i}' to itself: name two different bodies."
            )
        if not body_i or not body_j:
            raise ModelError(
                f"A spring-damper needs two bodies; the fixed one is called '{GROUND}'."
            )
        self.body_i, self.body_j = body_i, body_j
        of = f"of the spring between '{body_i}' and '{body_j}'"
        self.point_i = check_vector(point_i, f"The point on '{body_i}' {of}", "m")
        self.point_j = check_vector(point_j, f"The point on '{body_j}' {of}", "m")
        self.stiffness = check_nonnegative(stiffness, f"The stiffness {of}", "N/m")
        self.damping = check_nonnegative(damping, f"The damping {of}", "N s/m")
        self.length = check_nonnegative(length, f"The length {of}", "m")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body_i, self.body_j))

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        a, a_rate = kin.point(self.body_i, self.point_i)
        b, b_rate = kin.point(self.body_j, self.point_j)
        d, d_rate = b - a, b_rate - a_rate
        # A direction does not exist where the ends meet. Its derivative would be NaN for a whole batch, and
        # is therefore replaced before the division.
        length, direction, is_separate = length_and_direction(d)
        stretch, rate = length - self.length, dot_product(direction, d_rate)
        axial_force = (self.stiffness * stretch + self.damping * rate) * direction
        # a spring is smooth at d = 0 only if its free length is zero
        met = without_derivative(d, ~is_separate & (self.length != 0))
        pull = jnp.where(is_separate, axial_force, self.stiffness * met + self.damping * d_rate)
        square = jnp.where(is_separate, stretch**2, dot_product(met, met) + self.length**2)
        rate_square = jnp.where(is_separate, rate**2, dot_product(d_rate, d_rate))
        load = push(kin, self.body_i, pull, kin.arm(self.body_i, self.point_i)) + push(
            kin, self.body_j, -pull, kin.arm(self.body_j, self.point_j)
        )
        energy = 0.5 * self.stiffness * square
        return Load(load.force, load.moment, energy, -self.damping * rate_square)


class TorsionalSpringDamper(AbstractJointForce):
    """Torsional spring and damper about the z axis of a joint, from body i to body j.

    Args:
        joint: name of a revolute or cylindrical joint.
        stiffness: k >= 0 [N m/rad]. damping: c >= 0 [N m s/rad]. angle: free angle [rad], any number
            of turns away from the joint's angle at the start (a preload).

    Raises:
        ModelError: a number is not finite, or stiffness or damping is negative.
    """

    stiffness: Scalar
    damping: Scalar
    angle: Scalar

    def __init__(
        self, joint: str, *, stiffness: Numbers, damping: Numbers = 0.0, angle: Numbers = 0.0
    ) -> None:
        self.joint, self.coordinate = joint, "angle"
        of = f"of the torsional spring in joint '{joint}'"
        self.stiffness = check_nonnegative(stiffness, f"The stiffness {of}", "N m/rad")
        self.damping = check_nonnegative(damping, f"The damping {of}", "N m s/rad")
        self.angle = check_scalar(angle, f"The angle {of}", "rad")

    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        return -self.stiffness * (x - self.angle) - self.damping * x_rate

    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        return 0.5 * self.stiffness * (x - self.angle) ** 2


class JointDamping(AbstractForce):
    """Viscous damping in a joint.

    Args:
        joint: name of the joint.
        turning: coefficient >= 0 [N m s/rad] of the relative angular velocity.
        sliding: coefficient >= 0 [N s/m] of the velocity of j's point along the joint's z axis.

    Raises:
        ModelError: a number is not finite or is negative.
    """

    joint: str = eqx.field(static=True)
    turning: Scalar
    sliding: Scalar

    def __init__(self, joint: str, *, turning: Numbers = 0.0, sliding: Numbers = 0.0) -> None:
        self.joint = joint
        of = f"damping of joint '{joint}'"
        self.turning = check_nonnegative(turning, f"The turning {of}", "N m s/rad")
        self.sliding = check_nonnegative(sliding, f"The sliding {of}", "N s/m")

    def acts_on(self) -> ActsOn:
        return ActsOn(joints=(self.joint,))

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        joint = kin.joint(self.joint)
        i, j = kin.index(joint.body_i), kin.index(joint.body_j)
        # Damping acts on the relative motion in the joint as a pair of forces, so that it neither pushes nor
        # turns the machine as a whole.
        slide = evaluate_coordinate(kin, joint, "displacement")
        drag = slide.load(kin, -self.sliding * slide.rate)
        spin = self.turning * (kin.omega_w[j] - kin.omega_w[i])
        return drag + couple_load(kin, joint.body_i, joint.body_j, spin)


def _evaluate_in_world(
    signal: Signal, t: Scalar, kin: Kinematics, subject: str, body: str, frame: str
) -> Vec3:
    """World vector of a signal in the axes of the world or of a body.

    A function is called with time and kinematics even if it uses the time alone, so that a force has one
    signature.
    """
    value = evaluate(signal, t, kin, subject, (3,))
    return apply_matrix(kin.R_wb[kin.index(body)], value) if frame == "body" else value


def _check_frame(frame: str) -> Literal["world", "body"]:
    if frame not in ("world", "body"):
        raise ModelError(f"The frame of a load must be 'world' or 'body', not '{frame}'.")
    return frame  # pyright: ignore[reportReturnType]


class GroundContact(AbstractForce):
    """Springs, dampers and friction between feet of a body and level ground, which only push.

    With the depth d of a foot below the ground's height, its horizontal velocity v_t, and ramp, E
    and D as of `EndStop`:

        N = E/2 + ramp(E + D, E)               upwards,   E = k ramp(d, w), D = c ramp'(d, w) d_rate
        F = -mu N v_t / sqrt(|v_t|^2 + v0^2)   along the ground

    The force is zero above the ground and twice continuously differentiable in the motion. A foot
    that carries a weight W rests at the depth W / k + w / 2, and impacts last some
    pi sqrt(m / k): the stiffness sets the step size. The friction is a damper of mu N / v0 near
    rest, so that a foot creeps under any load along the ground: on a slope of angle theta, with
    tan(theta) below mu, at v0 tan(theta) / sqrt(mu^2 - tan(theta)^2). It never sticks.

    Args:
        body: name of the body.
        feet: points of the body that may touch the ground, in its reference frame (k, 3) [m].
        height: height of the ground, z in the world [m].
        stiffness: k > 0 of each foot [N/m]. damping: c >= 0 of each foot [N s/m].
        width: depth w > 0 over which a foot's spring reaches its stiffness [m].
        friction: coefficient mu >= 0 [1].
        slip_speed: smoothing speed v0 > 0 [m/s]; friction is 71 % of mu N at v0, 98 % at 5 v0.

    Raises:
        ModelError: a number is not finite or out of its range, there is no foot, or the body is
            ground.
    """

    body: str = eqx.field(static=True)
    feet: Float[Array, "k 3"]
    height: Scalar
    stiffness: Scalar
    damping: Scalar
    width: Scalar
    friction: Scalar
    slip_speed: Scalar

    def __init__(
        self,
        body: str,
        *,
        feet: Numbers,
        height: Numbers = 0.0,
        stiffness: Numbers,
        damping: Numbers,
        width: Numbers,
        friction: Numbers,
        slip_speed: Numbers,
    ) -> None:
        if body == GROUND:
            raise ModelError("A ground contact needs a body that moves, but it is given ground.")
        self.body = body
        of = f"of the ground contact of body '{body}'"
        self.feet = _check_feet(feet, f"The feet {of}")
        self.height = check_scalar(height, f"The height {of}", "m")
        self.stiffness = check_positive(stiffness, f"The stiffness {of}", "N/m")
        self.damping = check_nonnegative(damping, f"The damping {of}", "N s/m")
        self.width = check_positive(width, f"The width {of}", "m")
        self.friction = check_nonnegative(friction, f"The friction coefficient {of}", "1")
        self.slip_speed = check_positive(slip_speed, f"The slip speed {of}", "m/s")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def depths(self, kin: Kinematics) -> Float[Array, " k"]:
        """Depths of the feet below the ground's height (k,) [m], negative above it."""
        return self.height - self._foot_motion(kin)[0][:, 2]

    def normal_forces(self, kin: Kinematics) -> Float[Array, " k"]:
        """Forces N of the ground on the feet, upwards (k,) [N]."""
        place, velocity = self._foot_motion(kin)
        return self._normal_forces(self.height - place[:, 2], -velocity[:, 2])

    def _foot_motion(self, kin: Kinematics) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
        """Positions [m] and velocities [m/s] of the feet, world."""
        return jax.vmap(lambda foot: kin.point(self.body, foot))(self.feet)

    def _normal_forces(
        self, depth: Float[Array, " k"], rate: Float[Array, " k"]
    ) -> Float[Array, " k"]:
        law = self.stiffness, self.damping, self.width
        return jax.vmap(lambda d, d_rate: one_sided_push(d, d_rate, *law))(depth, rate)

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        place, velocity = self._foot_motion(kin)
        depth, rate = self.height - place[:, 2], -velocity[:, 2]
        normal = self._normal_forces(depth, rate)
        # Coulomb's law jumps at rest, where an integrator would chatter. Smoothed over a speed it
        # is a damper there, with continuous derivatives.
        slip_velocity = velocity[:, :2]
        slip_square = jnp.sum(slip_velocity * slip_velocity, axis=1)
        drag = self.friction * normal / jnp.sqrt(slip_square + self.slip_speed**2)
        force = jnp.concatenate([-drag[:, None] * slip_velocity, normal[:, None]], axis=1)
        total = jnp.sum(force, axis=0)
        # The opposite load on ground is kept: the balance of a system's momentum counts it, and a
        # contact's reaction can be read.
        arms = place - kin.r[kin.index(self.body)]
        moments = [jnp.sum(cross(at.T, force.T), axis=1) for at in (arms, place)]
        # ground has its centre of mass at the origin of the world
        load = push(kin, self.body, total, moment_w=moments[0])
        load = load + push(kin, GROUND, -total, moment_w=-moments[1])
        of_springs = self.stiffness * jax.vmap(lambda d: smooth_ramp(d, self.width))(depth)
        # Potential energy is that of the springs alone, which the damper's part of the force is
        # not: that part, and friction, is power without a potential.
        lost = (of_springs - normal) * rate - drag * slip_square
        energy = self.stiffness * jax.vmap(lambda d: ramp_area(d, self.width))(depth)
        return Load(load.force, load.moment, jnp.sum(energy), jnp.sum(lost))


def _check_feet(value: Numbers, subject: str) -> Float[Array, "k 3"]:
    """Checked points (k, 3) [m], at least one."""
    try:
        shape = shape_of(value)
    except ValueError:
        shape = None
    if shape is None or len(shape) != 2 or shape[0] == 0 or shape[1] != 3:
        shape_text = "rows of unequal length" if shape is None else f"of shape {shape}"
        raise ModelError(
            f"{subject} must be points of shape (k, 3) [m], at least one, but are {shape_text}."
        )
    check_finite(value, subject, "m")
    return as_floats(value)
