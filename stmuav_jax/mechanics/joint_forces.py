"""Forces in joint coordinates, often stiff: servos, end stops, friction, given efforts.

Each force is a law Q(x, x_rate, t) of one coordinate x of a joint (its angle or displacement) and a
potential V(x, t). `AbstractJointForce` makes the load on the bodies from them. End stops and ground
contacts push by a ramp with a smooth start. The derivations are in docs/theory.md.
"""

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, has_values
from ..checks.numbers import as_floats, check_nonnegative, check_positive, check_scalar
from ..checks.shapes import Numbers, Scalar
from .internal import AbstractTurnCounter
from .joint import Joint, Motion, Which, choose_coordinate
from .joint_states import JointCoordinate, evaluate_coordinate
from .load import ActsOn, Load
from .state import Kinematics


def smooth_ramp(d: Scalar, w: Scalar) -> Scalar:
    """Smooth ramp: 0 up to d = 0, d - w/2 from d = w, three times continuously differentiable."""
    u = jnp.clip(d / w, 0.0, 1.0)
    inner = w * u**4 * (2.5 - 3 * u + u * u)
    return jnp.where(d < w, inner, d - 0.5 * w)


def ramp_slope(d: Scalar, w: Scalar) -> Scalar:
    """Derivative of `smooth_ramp` with respect to d, from 0 to 1."""
    u = jnp.clip(d / w, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u)


def ramp_area(d: Scalar, w: Scalar) -> Scalar:
    """Integral of `smooth_ramp` from 0 to d."""
    u = jnp.clip(d / w, 0.0, 1.0)
    # The potential is the exact integral of the ramp: the energy balance of a run would show any
    # approximation as drift.
    inner = w * w * u**5 * (0.5 - 0.5 * u + u * u / 7)
    return jnp.where(d < w, inner, 0.5 * (d - 0.5 * w) ** 2 + w * w / 56)


def one_sided_push(
    depth: Scalar,
    rate: Scalar,
    stiffness: Scalar,
    damping: Scalar,
    width: Scalar,
) -> Scalar:
    """Push of a spring and damper at a depth, E/2 + ramp(E + D, E), which is never negative.

        E = stiffness ramp(depth, width)     D = damping ramp'(depth, width) rate

    It is zero up to the depth 0 and twice continuously differentiable in depth and rate. Less the
    spring's E, it is the damper's part, which always dissipates energy.

    Args:
        depth: depth of the contact d [m] or [rad]. rate: its rate [m/s] or [rad/s].
        stiffness: [N/m] or [N m/rad]. damping: [N s/m] or [N m s/rad]. width: of the ramp's start,
            as the depth.
    """
    # The push is a ramp of the sum of spring and damper, and not a sum that is clipped at zero: a clip
    # has a kink on which adaptive steps are rejected again and again.
    spring = stiffness * smooth_ramp(depth, width)
    damper = damping * ramp_slope(depth, width) * rate
    # the division's derivatives contain 1 / spring^3, which overflows for smaller values
    contact = spring > np.finfo(spring.dtype).tiny ** 0.25
    span = jnp.where(contact, spring, 1.0)
    # half of the push remains: if all of it vanished before the spring is slack, no force would
    # show the step control that the spring's potential is still being released
    return jnp.where(contact, 0.5 * span + smooth_ramp(span + damper, span), 0.0)


class AbstractJointForce(AbstractTurnCounter):
    """Force that depends on, and acts on, one coordinate x of a joint.

    Subclasses define the law and its potential, both of scalars. The power on the bodies is
    Q x_rate = -dV/dt + power, which defines the power of the part without potential.

    The angle of a hinge counts whole turns, as that of `Run.joint` does: it starts in (-pi, pi], or near the
    angle of `with_start_angles`, and is continuous from there.

    Attributes:
        joint: name of the joint.
        coordinate: "angle", "displacement", or None for the only one that the joint leaves free.
        internal: angle that counts the turns (1,) [rad]; (0,) where there are none to count. A
            `System` sets it.
        depends_on_position: False for a law that depends on the rate and the time alone.
    """

    depends_on_position: ClassVar[bool] = True
    joint: str = eqx.field(static=True)
    coordinate: Which | None = eqx.field(static=True)
    internal: Float[Array, " m"] | None = eqx.field(default=None, kw_only=True)  # pyright: ignore[reportIncompatibleVariableOverride]

    @abstractmethod
    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        """Generalised force Q on body j, [N] for a displacement [m], [N m] for an angle [rad]."""

    @abstractmethod
    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        """Potential energy V [J]; -dV/dx is the conservative part of Q."""

    def acts_on(self) -> ActsOn:
        return ActsOn(coordinates=((self.joint, self.coordinate),))

    def resolve(self, joints: Sequence[Joint]) -> "AbstractJointForce":
        joint = next(joint for joint in joints if joint.name == self.joint)
        size = int(self.depends_on_position and self._counts_turns(joint))
        if self.internal is not None and self.internal.shape[-1] == size:
            return self
        # a subclass's __init__ need not set the field, and what is not set is no leaf for `tree_at`
        # A new element instead of a change of this one: force elements are immutable and may belong to
        # several systems.
        element = copy.copy(self)
        object.__setattr__(element, "internal", as_floats([0.0] * size))
        return element

    def _counts_turns(self, joint: Joint) -> bool:
        """True if the coordinate is an angle that a posture gives up to whole turns."""
        return (
            choose_coordinate(joint, self.coordinate, self._describe_owner()) == "angle"
            and not joint.pitched
        )

    def _describe_owner(self) -> str:
        return f"{type(self).__name__} in joint '{self.joint}'"

    def coordinate_at(self, kin: Kinematics) -> JointCoordinate:
        """Coordinate at a state; an angle has the whole turns that `internal` counts.

        Raises:
            ModelError: the element counts turns, but no `System` was made with it.
        """
        joint = kin.joint(self.joint)
        joint_coordinate = evaluate_coordinate(
            kin, joint, choose_coordinate(joint, self.coordinate, self._describe_owner())
        )
        if not (self.depends_on_position and self._counts_turns(joint)):
            return joint_coordinate
        if self.internal is None:
            raise ModelError(
                f"{self._describe_owner()} counts the turns of a hinge in a state of its own, which it gets from "
                "System(...): make the system with this element, or give the element resolve(joints)."
            )
        # Only the number of whole turns comes from the integrated angle; its error has no effect below half a
        # turn, and the derivative of the angle is that of the posture.
        turns = jnp.round((self.internal[0] - joint_coordinate.value) / (2 * jnp.pi))
        return eqx.tree_at(
            lambda c: c.value, joint_coordinate, joint_coordinate.value + 2 * jnp.pi * turns
        )

    def internal_rate(self, t: Scalar, kin: Kinematics) -> Float[Array, " m"]:
        return self.coordinate_at(kin).rate[None]

    def internal_names(self) -> tuple[str, ...]:
        return (f"{type(self).__name__} {self.joint}.angle [rad]",)

    def counted_angle(self, kin: Kinematics) -> Float[Array, " m"]:
        return self.coordinate_at(kin).value[None]

    def counted_hinge(self) -> str:
        return self.joint

    def load(self, t: Scalar, kin: Kinematics) -> Load:
        now = self.coordinate_at(kin)
        effort = self.law(now.value, now.rate, t)
        # The power without potential follows from the law and the potential, so that a subclass cannot state
        # it inconsistently.
        potential, potential_rate = jax.jvp(
            self.potential_energy, (now.value, t), (now.rate, jnp.ones_like(t))
        )
        load = now.load(kin, effort)
        return Load(load.force, load.moment, potential, effort * now.rate + potential_rate)


class JointServo(AbstractJointForce):
    """Position servo: Q = -k (x - x_ref(t)) - c (x_rate - x_ref_rate(t)), within its limit.

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        stiffness: k >= 0 [N/m] or [N m/rad]. damping: c >= 0 [N s/m] or [N m s/rad].
        target: x_ref, a number [m] or [rad], or a function of t [s] alone that JAX can
            differentiate twice; JAX computes its rate.
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.
        limit: largest |Q| > 0 [N] or [N m]; by default none. Q saturates at the limit.

    The potential is k (x - x_ref)^2 / 2; a moving target does work at the rate Q x_ref_rate, the
    damper dissipates c (x_rate - x_ref_rate)^2. Angle and target may differ by any number of turns.

    Raises:
        ModelError: a number is negative or not finite, or the target is no function of t.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("target", "m or rad"),)
    stiffness: Scalar
    damping: Scalar
    target: Scalar | Motion
    limit: Scalar | None

    def __init__(
        self,
        joint: str,
        *,
        stiffness: Numbers,
        damping: Numbers,
        target: Numbers | Callable[..., object],
        coordinate: Which | None = None,
        limit: Numbers | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        of = f"of the servo in joint '{joint}'"
        self.stiffness = check_nonnegative(stiffness, f"The stiffness {of}", _STIFFNESS[coordinate])
        self.damping = check_nonnegative(damping, f"The damping {of}", _DAMPING[coordinate])
        self.target = time_signal(target, f"The target {of}", _LENGTH[coordinate])
        self.limit = _check_limit(limit, f"The limit {of}", _EFFORT[coordinate])

    def reference(self, t: Scalar) -> tuple[Scalar, Scalar]:
        """Target x_ref and its rate at time t [s]."""
        target = self.target
        if not callable(target):
            return target, jnp.zeros_like(target)
        # The rate of the target is the derivative of the given function: a damper against a wrong rate would
        # pull in steady motion.
        return jax.jvp(lambda s: jnp.asarray(target(s), s.dtype), (t,), (jnp.ones_like(t),))

    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        target, target_rate = self.reference(t)
        effort = -self.stiffness * (x - target) - self.damping * (x_rate - target_rate)
        return effort if self.limit is None else jnp.clip(effort, -self.limit, self.limit)

    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        return 0.5 * self.stiffness * (x - self.reference(t)[0]) ** 2


class EndStop(AbstractJointForce):
    """Smooth spring and damper beyond a limit of a joint coordinate, which only pushes.

    With the depth d beyond a limit, d_rate its rate, w the width and u = d / w in [0, 1]:

        ramp(d, w) = 0 | w (5/2 u^4 - 3 u^5 + u^6) | d - w/2      d <= 0 | in between | d >= w
        E = k ramp(d, w)     D = c ramp'(d, w) d_rate             spring | damper
        push = E/2 + ramp(E + D, E)                 = E + D for D >= 0, E/2 for D <= -E

    The force is exactly zero inside the limits, twice continuously differentiable in x and x_rate,
    and never pulls: the damper adds to the spring while the stop is pressed in, and reduces its
    push by at most half while the stop is left. The damper always dissipates energy.

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        lower, upper: limits [m] or [rad], at least one of them; those of an angle may be any number
            of turns apart.
        stiffness: k > 0 [N/m] or [N m/rad]. damping: c >= 0 [N s/m] or [N m s/rad].
        width: depth w > 0 over which the spring reaches its stiffness [m] or [rad].
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.

    Raises:
        ModelError: a number is not finite or out of its range, there is no limit, or the limits
            are in the wrong order.
    """

    lower: Scalar | None
    upper: Scalar | None
    stiffness: Scalar
    damping: Scalar
    width: Scalar

    def __init__(
        self,
        joint: str,
        *,
        lower: Numbers | None = None,
        upper: Numbers | None = None,
        stiffness: Numbers,
        damping: Numbers,
        width: Numbers,
        coordinate: Which | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        of, unit = f"of the end stop in joint '{joint}'", _LENGTH[coordinate]
        self.stiffness = check_positive(stiffness, f"The stiffness {of}", _STIFFNESS[coordinate])
        self.damping = check_nonnegative(damping, f"The damping {of}", _DAMPING[coordinate])
        self.width = check_positive(width, f"The width {of}", unit)
        self.lower = None if lower is None else check_scalar(lower, f"The lower limit {of}", unit)
        self.upper = None if upper is None else check_scalar(upper, f"The upper limit {of}", unit)
        if lower is None and upper is None:
            raise ModelError(f"The end stop in joint '{joint}' needs a lower or an upper limit.")
        ends = (self.lower, self.upper)
        if lower is not None and upper is not None and has_values(ends):
            low, high = float(self.lower), float(self.upper)  # pyright: ignore[reportArgumentType]
            if low >= high:
                raise ModelError(
                    f"The limits {of} must be lower < upper, but they are {low} and {high} {unit}."
                )

    def _stop_force(self, depth: Scalar, rate: Scalar) -> Scalar:
        return one_sided_push(depth, rate, self.stiffness, self.damping, self.width)

    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        effort = jnp.zeros_like(x)
        if self.lower is not None:
            effort = effort + self._stop_force(self.lower - x, -x_rate)
        if self.upper is not None:
            effort = effort - self._stop_force(x - self.upper, x_rate)
        return effort

    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        area = jnp.zeros_like(x)
        if self.lower is not None:
            area = area + ramp_area(self.lower - x, self.width)
        if self.upper is not None:
            area = area + ramp_area(x - self.upper, self.width)
        return self.stiffness * area


class JointFriction(AbstractJointForce):
    """Smoothed Coulomb and viscous friction: Q = -F tanh(x_rate / v0) - c x_rate.

    The joint creeps under any load: near rest the friction is a damper of coefficient F / v0.

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        coulomb: F >= 0 [N] or [N m]. viscous: c >= 0 [N s/m] or [N m s/rad].
        speed: smoothing speed v0 > 0 [m/s] or [rad/s]; friction is 76 % of F at v0, 96 % at 2 v0.
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.

    Raises:
        ModelError: a number is not finite or out of its range.
    """

    depends_on_position: ClassVar[bool] = False
    coulomb: Scalar
    viscous: Scalar
    speed: Scalar

    def __init__(
        self,
        joint: str,
        *,
        coulomb: Numbers,
        viscous: Numbers = 0.0,
        speed: Numbers,
        coordinate: Which | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        of, unit = f"of the friction in joint '{joint}'", _LENGTH[coordinate]
        self.coulomb = check_nonnegative(coulomb, f"The Coulomb force {of}", _EFFORT[coordinate])
        self.viscous = check_nonnegative(
            viscous, f"The viscous coefficient {of}", _DAMPING[coordinate]
        )
        self.speed = check_positive(speed, f"The smoothing speed {of}", f"{unit}/s")

    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        return -self.coulomb * jnp.tanh(x_rate / self.speed) - self.viscous * x_rate

    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        return jnp.zeros_like(x)


# --- checks of user input

_LENGTH = {"displacement": "m", "angle": "rad", None: "m or rad"}
_EFFORT = {"displacement": "N", "angle": "N m", None: "N or N m"}
_STIFFNESS = {"displacement": "N/m", "angle": "N m/rad", None: "N/m or N m/rad"}
_DAMPING = {"displacement": "N s/m", "angle": "N m s/rad", None: "N s/m or N m s/rad"}


def which_coordinate(value: Which | None) -> Which | None:
    """Check the name of a coordinate and return it; raises `ModelError` for any other word."""
    if value not in (None, "angle", "displacement"):
        raise ModelError(f"A joint's coordinate is 'angle' or 'displacement', not '{value}'.")
    return value


def _check_limit(limit: Numbers | None, subject: str, unit: str) -> Scalar | None:
    """Checked largest effort as an array, or none."""
    return None if limit is None else check_positive(limit, subject, unit)


def time_signal(value: Numbers | Callable[..., object], subject: str, unit: str) -> Scalar | Motion:
    """Checked number as an array, or a function of t, tried without evaluating it."""
    if not callable(value):
        return check_scalar(value, subject, unit)
    must = f"{subject} must be a number or a function of the time t [s] alone that returns one"
    try:
        shape = jax.eval_shape(lambda t: jnp.asarray(value(t), t.dtype), jnp.zeros(())).shape
    except TypeError as error:
        raise ModelError(f"{must} [{unit}], but calling it with t failed: {error}") from error
    if shape != ():
        raise ModelError(f"{must} [{unit}], but it returns an array of shape {shape}.")
    return value  # pyright: ignore[reportReturnType]


class JointEffort(AbstractJointForce):
    """Prescribed effort Q(t) on one coordinate of a joint, acting on body j and oppositely on body i.

    It is the counterpart of a driver (`stmuav_jax.drive`): the efforts that `driver_efforts`
    computes reproduce the driver's motion if this class applies them.

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        effort: [N] along a displacement, [N m] about an angle; a number or a function of t [s].
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.
        limit: largest |Q| > 0 [N] or [N m], at which the effort saturates; by default none.

    Raises:
        ModelError: the effort is not finite, or a function with other arguments than t; or a limit that is not
            positive.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("effort", "N or N m"),)
    depends_on_position: ClassVar[bool] = False
    effort: Scalar | Motion
    limit: Scalar | None

    def __init__(
        self,
        joint: str,
        effort: Numbers | Callable[..., object],
        *,
        coordinate: Which | None = None,
        limit: Numbers | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        quantity = f"effort in joint '{joint}'"
        self.effort = time_signal(effort, f"The {quantity}", "N or N m")
        self.limit = _check_limit(limit, f"The limit of the {quantity}", "N or N m")

    def law(self, x: Scalar, x_rate: Scalar, t: Scalar) -> Scalar:
        effort = jnp.asarray(self.effort(t) if callable(self.effort) else self.effort, x.dtype)
        return effort if self.limit is None else jnp.clip(effort, -self.limit, self.limit)

    def potential_energy(self, x: Scalar, t: Scalar) -> Scalar:
        return jnp.zeros_like(x)
