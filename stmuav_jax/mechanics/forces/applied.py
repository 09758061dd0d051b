"""Force elements: gravity, applied forces and moments, springs and dampers."""

from collections.abc import Callable
from typing import ClassVar, Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.derivative import length_and_direction, without_derivative
from ...algebra.stacked import apply, dot
from ...checks.errors import ModelError
from ...checks.numbers import nonnegative, scalar, vector
from ...checks.shapes import Numbers
from ..body import GROUND
from ..joint_coordinate import coordinate
from ..load import AbstractForce, ActsOn, Load, Signal, couple, evaluate, push, signal
from ..state import Kinematics
from .joint import AbstractJointForce


class Gravity(AbstractForce):
    """Uniform gravity with acceleration a (3,) [m/s^2] in the world; potential -m a . r."""

    acceleration: Float[Array, "3"]

    def __init__(self, acceleration: Numbers = (0.0, 0.0, -9.81)) -> None:
        self.acceleration = vector(acceleration, "The acceleration of gravity", "m/s^2")

    def acts_on(self) -> ActsOn:
        return ActsOn()

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        force = kin.mass[:, None] * self.acceleration
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
        ModelError: a number is not finite, the shape or frame is another, a function has other
            arguments; or, at its first evaluation, a function returns another shape.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("force", "N"),)
    body: str = eqx.field(static=True)
    force: Signal
    frame: Literal["world", "body"] = eqx.field(static=True)
    point: Float[Array, "3"] | None

    def __init__(
        self,
        body: str,
        force: "Numbers | Callable[..., object]",
        *,
        frame: Literal["world", "body"] = "world",
        point: Numbers | None = None,
    ) -> None:
        self.body = body
        self.force = signal(force, self._what(body), (3,), "N")
        self.frame = _frame(frame)
        what = f"The point of the force on body '{body}'"
        self.point = None if point is None else vector(point, what, "m")

    @staticmethod
    def _what(body: str) -> str:
        return f"AppliedForce: the force on body '{body}'"

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        value = evaluate(self.force, t, kin, self._what(self.body), (3,))
        force_w = apply(kin.R_wb[kin.index(self.body)], value) if self.frame == "body" else value
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
        self.body = body
        self.moment = signal(moment, self._what(body), (3,), "N m")
        self.frame = _frame(frame)

    @staticmethod
    def _what(body: str) -> str:
        return f"AppliedMoment: the moment on body '{body}'"

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        value = evaluate(self.moment, t, kin, self._what(self.body), (3,))
        moment_w = apply(kin.R_wb[kin.index(self.body)], value) if self.frame == "body" else value
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
    point_i: Float[Array, "3"]
    point_j: Float[Array, "3"]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    length: Float[Array, ""]

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
        _two_bodies("A spring-damper", body_i, body_j)
        self.body_i, self.body_j = body_i, body_j
        of = f"of the spring between '{body_i}' and '{body_j}'"
        self.point_i = vector(point_i, f"The point on '{body_i}' {of}", "m")
        self.point_j = vector(point_j, f"The point on '{body_j}' {of}", "m")
        self.stiffness = nonnegative(stiffness, f"The stiffness {of}", "N/m")
        self.damping = nonnegative(damping, f"The damping {of}", "N s/m")
        self.length = nonnegative(length, f"The length {of}", "m")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body_i, self.body_j))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        a, a_rate = kin.point(self.body_i, self.point_i)
        b, b_rate = kin.point(self.body_j, self.point_j)
        d, d_rate = b - a, b_rate - a_rate
        length, direction, apart = length_and_direction(d)
        stretch, rate = length - self.length, dot(direction, d_rate)
        away = (self.stiffness * stretch + self.damping * rate) * direction
        # a spring is smooth at d = 0 only if its free length is zero
        met = without_derivative(d, ~apart & (self.length != 0))
        pull = jnp.where(apart, away, self.stiffness * met + self.damping * d_rate)
        square = jnp.where(apart, stretch**2, dot(met, met) + self.length**2)
        rate_square = jnp.where(apart, rate**2, dot(d_rate, d_rate))
        load = push(kin, self.body_i, pull, kin.arm(self.body_i, self.point_i)) + push(
            kin, self.body_j, -pull, kin.arm(self.body_j, self.point_j)
        )
        return Load(
            load.force,
            load.moment,
            0.5 * self.stiffness * square,
            -self.damping * rate_square,
        )


class TorsionalSpringDamper(AbstractJointForce):
    """Torsional spring and damper about the z axis of a joint, from body i to body j.

    Args:
        joint: name of a revolute or cylindrical joint.
        stiffness: k >= 0 [N m/rad]. damping: c >= 0 [N m s/rad]. angle: free angle [rad].

    The moment jumps when the spring is wound past half a turn.

    Raises:
        ModelError: a number is not finite, or stiffness or damping is negative.
    """

    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    angle: Float[Array, ""]

    def __init__(
        self, joint: str, *, stiffness: Numbers, damping: Numbers = 0.0, angle: Numbers = 0.0
    ) -> None:
        self.joint, self.coordinate = joint, "angle"
        of = f"of the torsional spring in joint '{joint}'"
        self.stiffness = nonnegative(stiffness, f"The stiffness {of}", "N m/rad")
        self.damping = nonnegative(damping, f"The damping {of}", "N m s/rad")
        self.angle = scalar(angle, f"The angle {of}", "rad")

    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        return -self.stiffness * (x - self.angle) - self.damping * x_rate

    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        return 0.5 * self.stiffness * (x - self.angle) ** 2

    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.angle


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
    turning: Float[Array, ""]
    sliding: Float[Array, ""]

    def __init__(self, joint: str, *, turning: Numbers = 0.0, sliding: Numbers = 0.0) -> None:
        self.joint = joint
        self.turning = nonnegative(turning, f"The turning damping of joint '{joint}'", "N m s/rad")
        self.sliding = nonnegative(sliding, f"The sliding damping of joint '{joint}'", "N s/m")

    def acts_on(self) -> ActsOn:
        return ActsOn(joints=(self.joint,))

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        joint = kin.joint(self.joint)
        i, j = kin.index(joint.body_i), kin.index(joint.body_j)
        slide = coordinate(kin, joint, "displacement")
        drag = slide.load(kin, -self.sliding * slide.rate)
        spin = self.turning * (kin.omega_w[j] - kin.omega_w[i])
        return drag + couple(kin, joint.body_i, joint.body_j, spin)


def _frame(frame: str) -> Literal["world", "body"]:
    if frame not in ("world", "body"):
        raise ModelError(f"The frame of a load must be 'world' or 'body', not '{frame}'.")
    return frame  # pyright: ignore[reportReturnType]


def _two_bodies(what: str, body_i: str, body_j: str) -> None:
    if body_i == body_j:
        raise ModelError(f"{what} joins body '{body_i}' to itself.")
    if not body_i or not body_j:
        raise ModelError(f"{what} needs two bodies; the fixed one is called '{GROUND}'.")
