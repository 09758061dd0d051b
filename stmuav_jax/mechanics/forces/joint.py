"""Forces in joint coordinates, often stiff: servos, end stops and friction.

Each force is a law Q(x, x_rate, t) of one coordinate x of a joint (its angle or displacement) and a
potential V(x, t). `AbstractJointForce` makes the load on the bodies from them. The
derivations are in docs/dynamics.md.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...checks.errors import ModelError, concrete
from ...checks.numbers import nonnegative, positive, scalar
from ...checks.shapes import Numbers
from ..joint import Motion
from ..joint_coordinate import JointCoordinate, choose, coordinate
from ..joint_kind import Which
from ..load import AbstractForce, ActsOn, Load
from ..state import Kinematics
from .ramp import one_sided_push, ramp_area


class AbstractJointForce(AbstractForce):
    """Force that depends on, and acts on, one coordinate x of a joint.

    Subclasses define the law and its potential, both of scalars. The power on the bodies is
    Q x_rate = -dV/dt + power, which defines the power of the part without potential.

    Attributes:
        joint: name of the joint.
        coordinate: "angle", "displacement", or None for the only one that the joint leaves free.
    """

    joint: str = eqx.field(static=True)
    coordinate: Which | None = eqx.field(static=True)

    @abstractmethod
    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Generalised force Q on body j, [N] for a displacement [m], [N m] for an angle [rad]."""

    @abstractmethod
    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        """Potential energy V [J]; -dV/dx is the conservative part of Q."""

    @abstractmethod
    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """Angle [rad] around which an angle is counted, up to half a turn either way."""

    def acts_on(self) -> ActsOn:
        return ActsOn(coordinates=((self.joint, self.coordinate),))

    def at(self, t: Float[Array, ""], kin: Kinematics) -> JointCoordinate:
        """Coordinate at a state, with an angle counted around `centre`."""
        joint = kin.joint(self.joint)
        what = f"{type(self).__name__} in joint '{joint.name}'"
        found = coordinate(kin, joint, choose(joint, self.coordinate, what))
        if found.which == "displacement":
            return found
        turns = jnp.round((found.value - self.centre(t)) / (2 * jnp.pi))
        return eqx.tree_at(lambda c: c.value, found, found.value - 2 * jnp.pi * turns)

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        now = self.at(t, kin)
        effort = self.law(now.value, now.rate, t)
        potential, potential_rate = jax.jvp(
            self.potential_energy, (now.value, t), (now.rate, jnp.ones_like(t))
        )
        load = now.load(kin, effort)
        return Load(load.force, load.moment, potential, effort * now.rate + potential_rate)


class JointServo(AbstractJointForce):
    """Position servo: Q = -k (x - x_ref(t)) - c (x_rate - x_ref_rate(t)).

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        stiffness: k >= 0 [N/m] or [N m/rad]. damping: c >= 0 [N s/m] or [N m s/rad].
        target: x_ref, a number [m] or [rad], or a function of t [s] alone that JAX can
            differentiate twice; JAX computes its rate.
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.

    The potential is k (x - x_ref)^2 / 2; a moving target does work at the rate Q x_ref_rate, the
    damper dissipates c (x_rate - x_ref_rate)^2. An angle may follow its target over any number of
    turns, but the force jumps when it lags by more than half a turn.

    Raises:
        ModelError: a number is negative or not finite, or the target is no function of t.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("target", "m or rad"),)
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    target: Float[Array, ""] | Motion

    def __init__(
        self,
        joint: str,
        *,
        stiffness: Numbers,
        damping: Numbers,
        target: Numbers | Callable[..., object],
        coordinate: Which | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        of = f"of the servo in joint '{joint}'"
        self.stiffness = nonnegative(stiffness, f"The stiffness {of}", _STIFFNESS[coordinate])
        self.damping = nonnegative(damping, f"The damping {of}", _DAMPING[coordinate])
        self.target = time_signal(target, f"The target {of}", _LENGTH[coordinate])

    def reference(self, t: Float[Array, ""]) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Target x_ref and its rate at time t [s]."""
        target = self.target
        if not callable(target):
            return target, jnp.zeros_like(target)
        return jax.jvp(lambda s: jnp.asarray(target(s), s.dtype), (t,), (jnp.ones_like(t),))

    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        target, target_rate = self.reference(t)
        return -self.stiffness * (x - target) - self.damping * (x_rate - target_rate)

    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        return 0.5 * self.stiffness * (x - self.reference(t)[0]) ** 2

    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.reference(t)[0]


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
        lower, upper: limits [m] or [rad], at least one of them; the limits of an angle must
            be less than a turn apart.
        stiffness: k > 0 [N/m] or [N m/rad]. damping: c >= 0 [N s/m] or [N m s/rad].
        width: depth w > 0 over which the spring reaches its stiffness [m] or [rad].
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.

    Raises:
        ModelError: a number is not finite or out of its range, there is no limit, or the limits
            are in the wrong order.
    """

    lower: Float[Array, ""] | None
    upper: Float[Array, ""] | None
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    width: Float[Array, ""]

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
        self.stiffness = positive(stiffness, f"The stiffness {of}", _STIFFNESS[coordinate])
        self.damping = nonnegative(damping, f"The damping {of}", _DAMPING[coordinate])
        self.width = positive(width, f"The width {of}", unit)
        self.lower = None if lower is None else scalar(lower, f"The lower limit {of}", unit)
        self.upper = None if upper is None else scalar(upper, f"The upper limit {of}", unit)
        if lower is None and upper is None:
            raise ModelError(f"The end stop in joint '{joint}' needs a lower or an upper limit.")
        ends = (self.lower, self.upper)
        if lower is not None and upper is not None and concrete(ends):
            low, high = float(self.lower), float(self.upper)  # pyright: ignore[reportArgumentType]
            if low >= high:
                raise ModelError(
                    f"The limits {of} must be lower < upper, but they are {low} and {high} {unit}."
                )

    def _push(self, depth: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        return one_sided_push(depth, rate, self.stiffness, self.damping, self.width)

    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        effort = jnp.zeros_like(x)
        if self.lower is not None:
            effort = effort + self._push(self.lower - x, -x_rate)
        if self.upper is not None:
            effort = effort - self._push(x - self.upper, x_rate)
        return effort

    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        area = jnp.zeros_like(x)
        if self.lower is not None:
            area = area + ramp_area(self.lower - x, self.width)
        if self.upper is not None:
            area = area + ramp_area(x - self.upper, self.width)
        return self.stiffness * area

    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        limits = [limit for limit in (self.lower, self.upper) if limit is not None]
        return sum(limits, start=jnp.zeros_like(limits[0])) / len(limits)


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

    coulomb: Float[Array, ""]
    viscous: Float[Array, ""]
    speed: Float[Array, ""]

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
        self.coulomb = nonnegative(coulomb, f"The Coulomb force {of}", _EFFORT[coordinate])
        self.viscous = nonnegative(viscous, f"The viscous coefficient {of}", _DAMPING[coordinate])
        self.speed = positive(speed, f"The smoothing speed {of}", f"{unit}/s")

    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        return -self.coulomb * jnp.tanh(x_rate / self.speed) - self.viscous * x_rate

    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.zeros_like(x)

    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.zeros_like(t)


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


def time_signal(
    value: Numbers | Callable[..., object], what: str, unit: str
) -> Float[Array, ""] | Motion:
    """Checked number as an array, or a function of t, tried without evaluating it."""
    if not callable(value):
        return scalar(value, what, unit)
    must = f"{what} must be a number or a function of the time t [s] alone that returns one"
    try:
        shape = jax.eval_shape(lambda t: jnp.asarray(value(t), t.dtype), jnp.zeros(())).shape
    except TypeError as error:
        raise ModelError(f"{must} [{unit}], but calling it with t failed: {error}") from error
    if shape != ():
        raise ModelError(f"{must} [{unit}], but it returns an array of shape {shape}.")
    return value  # pyright: ignore[reportReturnType]
