"""Loads of forces on bodies, and signals that give the values of forces.

A force maps the kinematics of all bodies and the time to a `Load`: world force and
body-frame moment about the centre of mass for every body, the potential energy of its
conservative part, and the power of the rest. Values may be numbers or functions of (t, kinematics);
numbers are leaves of the pytree, so that they can be differentiated.
"""

import inspect
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, check_shape
from ..checks.numbers import as_floats, check_scalar
from ..checks.shapes import Numbers, Scalar, Vec3
from ..math.rotation import cross
from ..math.stacked import apply_transposed, dot_product
from .joint import Which
from .state import Kinematics

if TYPE_CHECKING:
    from .joint import Joint

Signal = Float[Array, "..."] | Callable[[Scalar, Kinematics], Float[Array, "..."]]


def check_signal(
    value: "Numbers | Callable[..., object]", subject: str, shape: tuple[int, ...], unit: str
) -> Signal:
    """Check a constant or a function of (t, kinematics); return the constant as an array.

    Raises:
        ModelError: the shape is not the given one, a number is not finite, or a function does not
            take these two arguments.
    """
    if callable(value):
        check_arguments(value, subject)
        return value  # pyright: ignore[reportReturnType]
    # Constants are checked when a force is made and functions when they are called, since only
    # then have they a value.
    check_shape(value, shape, subject)
    check_finite(value, subject, unit)
    return as_floats(value)


def check_arguments(function: Callable[..., object], subject: str) -> None:
    """Raise `ModelError` unless the function can be called with (t, kinematics)."""
    try:
        # A wrong signature is told here, by name, and not in the middle of a trace.
        inspect.signature(function).bind(None, None)
    except TypeError as error:
        raise ModelError(
            f"{subject} must be given by a function of two arguments, the time and the kinematics "
            f"(lambda t, kin: ...), but calling it with two is not possible: {error}."
        ) from None
    except ValueError:
        pass  # a built-in function without a signature


def evaluate(
    value: Signal, t: Scalar, kin: Kinematics, subject: str, shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """Value of a signal at time t [s].

    Args:
        subject: name of the signal for the message. shape: shape of its value.

    Raises:
        ModelError: the function returns another shape, or no array.
    """
    if not callable(value):
        return value
    signal_value: Any = value(t, kin)
    try:
        # The type of the state decides: a Python integer from a user's function must not make a
        # program of other types.
        array = jnp.asarray(signal_value, dtype=kin.r.dtype)
    except (TypeError, ValueError):
        kind = type(signal_value).__name__
        raise ModelError(
            f"{subject} must be numbers of shape {shape}, but its function returns {kind}."
        ) from None
    # A scalar would be broadcast to three equal components, which is hardly ever a force that was
    # meant.
    if array.shape != shape:
        raise ModelError(
            f"{subject} must have shape {shape}, but its function returns shape {array.shape}."
        )
    return array


class Sine(eqx.Module):
    """Signal amplitude sin(omega t), whose numbers are differentiable leaves.

    Args:
        amplitude: amplitude of any shape. angular_frequency: omega [rad/s].
    """

    amplitude: Float[Array, "*shape"]
    angular_frequency: Scalar

    def __init__(self, amplitude: Numbers, angular_frequency: Numbers) -> None:
        check_finite((amplitude, angular_frequency), "A sine signal", "")
        self.amplitude = as_floats(amplitude)
        self.angular_frequency = as_floats(angular_frequency)

    def __call__(self, t: Scalar, kin: Kinematics) -> Float[Array, "*shape"]:
        return self.amplitude * jnp.sin(self.angular_frequency * t)


class SineMotion(eqx.Module):
    """Motion start + rate t + amplitude sin(omega t + phase) of a driver; its numbers are leaves.

    Args:
        start: [m] or [rad]. rate: [m/s] or [rad/s]. amplitude: [m] or [rad].
        angular_frequency: omega [rad/s]. phase: [rad].

    Raises:
        ModelError: a number is not finite.
    """

    start: Scalar
    rate: Scalar
    amplitude: Scalar
    angular_frequency: Scalar
    phase: Scalar

    def __init__(
        self,
        start: Numbers = 0.0,
        rate: Numbers = 0.0,
        amplitude: Numbers = 0.0,
        angular_frequency: Numbers = 0.0,
        phase: Numbers = 0.0,
    ) -> None:
        self.start = check_scalar(start, "The start of a driver's motion", "m or rad")
        self.rate = check_scalar(rate, "The rate of a driver's motion", "m/s or rad/s")
        self.amplitude = check_scalar(amplitude, "The amplitude of a driver's motion", "m or rad")
        self.angular_frequency = check_scalar(angular_frequency, "The angular frequency", "rad/s")
        self.phase = check_scalar(phase, "The phase of a driver's motion", "rad")

    def __call__(self, t: Scalar) -> Scalar:
        swing = self.amplitude * jnp.sin(self.angular_frequency * t + self.phase)
        return self.start + self.rate * t + swing


class Load(eqx.Module):
    """Load of a force on all bodies, with ground as the last row.

    Attributes:
        force: forces in the world at the centres of mass (n + 1, 3) [N].
        moment: moments in body axes about the centres of mass (n + 1, 3) [N m].
        potential: potential energy [J].
        power: power of the part of the force that has no potential [W].
    """

    force: Float[Array, "N 3"]
    moment: Float[Array, "N 3"]
    potential: Scalar
    power: Scalar

    def __add__(self, other: "Load") -> "Load":
        return Load(
            self.force + other.force,
            self.moment + other.moment,
            self.potential + other.potential,
            self.power + other.power,
        )


def no_load(kin: Kinematics) -> Load:
    """Zero load on every body."""
    zero = jnp.zeros((), kin.r.dtype)
    return Load(jnp.zeros_like(kin.r), jnp.zeros_like(kin.r), zero, zero)


def push(
    kin: Kinematics,
    body: str,
    force_w: Vec3,
    arm_w: Vec3 | None = None,
    moment_w: Vec3 | None = None,
) -> Load:
    """Load of a world force [N] at `arm_w` [m] from a body's centre of mass, and a moment [N m].

    Its power counts as that of a force without potential.
    """
    k = kin.index(body)
    zero = jnp.zeros(3, kin.r.dtype)
    total = zero if moment_w is None else moment_w
    if arm_w is not None:
        total = total + cross(arm_w, force_w)
    # A product with a constant row instead of an update at an index, which compiles to a slower scatter.
    row = jnp.asarray(np.eye(len(kin.names))[:, k, None])
    # Power of the load is integrated beside the motion, for the balance of energy.
    power = dot_product(force_w, kin.v[k]) + dot_product(total, kin.omega_w[k])
    return Load(
        row * force_w[None],
        # Moments are kept in body axes, in which inertia tensors are constant; forces in the
        # world's, in which positions are.
        row * apply_transposed(kin.R_wb[k], total)[None],
        jnp.zeros((), kin.r.dtype),
        power,
    )


def total_load(forces: "Sequence[AbstractForce]", t: Scalar, kin: Kinematics) -> Load:
    """Sum of the loads of all force elements at time t [s].

    Raises:
        ModelError: a force's load does not have the shapes of `Load`; the message names the class
            of the force and the bodies and joints on which it acts.
    """
    total = no_load(kin)
    for force in forces:
        element_load = force.load(t, kin)
        _check_load(force, element_load, total)
        total = total + element_load
    return total


def _check_load(force: "AbstractForce", element_load: object, expected: Load) -> None:
    for name in ("force", "moment", "potential", "power"):
        # Loads are added, and addition broadcasts: a wrong shape would be spread over all bodies.
        must = jnp.shape(getattr(expected, name))
        shape = jnp.shape(getattr(element_load, name)) if isinstance(element_load, Load) else None
        if shape != must:
            mismatch = f"has {name} of shape {shape}" if shape is not None else "is none"
            rows = f"of shape {must}, a row for every body and one for ground"
            raise ModelError(
                f"The load of {type(force).__name__} on {force.acts_on()} must be a Load with {name} "
                f"{rows if must else 'a single number'}, but it {mismatch}."
            )


class ActsOn(NamedTuple):
    """Names of bodies and joints that a force element uses; a `System` checks that they exist.

    Attributes:
        bodies: names of bodies, which may include "ground".
        joints: names of joints.
        coordinates: joints with the coordinate that they must leave free, "angle" or "displacement";
            None for the only free one.
    """

    bodies: tuple[str, ...] = ()
    joints: tuple[str, ...] = ()
    coordinates: tuple[tuple[str, Which | None], ...] = ()

    def __str__(self) -> str:
        names = (*self.bodies, *self.joints, *(name for name, _ in self.coordinates))
        return ", ".join(names) or "all bodies"


class AbstractForce(eqx.Module):
    """Force element, whose subclasses define its `load` and the objects on which it acts.

    Attributes:
        inputs: fields that are inputs of a system, with their units; see `inputs_of`.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = ()

    @abstractmethod
    def load(self, t: Scalar, kin: Kinematics) -> Load:
        """Load on all bodies at time t [s]."""

    @abstractmethod
    def acts_on(self) -> ActsOn:
        """Names of the bodies and joints on which this force acts."""

    def resolve(self, joints: "Sequence[Joint]") -> "AbstractForce":
        """Force element for a system with these joints; by default it is unchanged."""
        return self


def couple_load(kin: Kinematics, body_i: str, body_j: str, moment_w: Vec3) -> Load:
    """Load of the moment `moment_w` [N m] on body i and its opposite on body j."""
    none = jnp.zeros_like(moment_w)
    return push(kin, body_i, none, moment_w=moment_w) + push(kin, body_j, none, moment_w=-moment_w)
