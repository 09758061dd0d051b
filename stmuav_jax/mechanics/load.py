"""What forces do: loads on bodies, and signals that say how large they are.

A force maps the kinematics of all bodies and the time to a `Load`: world force and
body-frame moment about the centre of mass for every body, the potential energy it has (if
any), and the power of its part that has none. Values may be numbers or functions of
(t, kinematics); numbers are leaves of the pytree, so they can be differentiated.
"""

import inspect
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import cross
from ..algebra.shapes import Numbers
from ..algebra.stacked import apply_transposed, dot
from .errors import ModelError, check_finite, check_shape, concrete
from .state import Kinematics

Signal = Float[Array, "..."] | Callable[[Float[Array, ""], Kinematics], Float[Array, "..."]]


def signal(
    value: "Numbers | Callable[..., object]", what: str, shape: tuple[int, ...], unit: str
) -> Signal:
    """A constant as an array, or a function of (t, kinematics); both checked.

    Raises:
        ModelError: a shape that is not the given one, a number that is not finite, a function
            that does not take these two arguments.
    """
    if callable(value):
        check_arguments(value, what)
        return value  # pyright: ignore[reportReturnType]
    check_shape(value, shape, what)
    check_finite(value, what, unit)
    return jnp.asarray(value, dtype=float)


def check_arguments(function: Callable[..., object], what: str) -> None:
    """Raise `ModelError` unless the function can be called with (t, kinematics)."""
    try:
        inspect.signature(function).bind(None, None)
    except TypeError as error:
        raise ModelError(
            f"{what} must be given by a function of two arguments, the time and the kinematics "
            f"(lambda t, kin: ...), but calling it with two is not possible: {error}."
        ) from None
    except ValueError:
        pass  # a built-in function that does not say what it takes


def evaluate(
    value: Signal, t: Float[Array, ""], kin: Kinematics, what: str, shape: tuple[int, ...]
) -> Float[Array, "..."]:
    """The signal's value at time t [s].

    Args:
        what: which signal, for the message. shape: what it must return.

    Raises:
        ModelError: a function that returns another shape, or nothing that is an array.
    """
    if not callable(value):
        return value
    found: Any = value(t, kin)
    try:
        array = jnp.asarray(found, dtype=kin.r.dtype)
    except (TypeError, ValueError):
        kind = type(found).__name__
        raise ModelError(
            f"{what} must be numbers of shape {shape}, but its function returns {kind}."
        ) from None
    if array.shape != shape:
        raise ModelError(
            f"{what} must have shape {shape}, but its function returns shape {array.shape}."
        )
    return array


class Sine(eqx.Module):
    """The signal amplitude sin(omega t), its numbers leaves like all others.

    Args:
        amplitude: of any shape. angular_frequency: omega [rad/s].
    """

    amplitude: Float[Array, "*shape"]
    angular_frequency: Float[Array, ""]

    def __init__(self, amplitude: Numbers, angular_frequency: Numbers) -> None:
        check_finite((amplitude, angular_frequency), "A sine signal", "")
        self.amplitude = jnp.asarray(amplitude, dtype=float)
        self.angular_frequency = jnp.asarray(angular_frequency, dtype=float)

    def __call__(self, t: Float[Array, ""], kin: Kinematics) -> Float[Array, "*shape"]:
        del kin
        return self.amplitude * jnp.sin(self.angular_frequency * t)


class Load(eqx.Module):
    """What a force does to all bodies, ground included as the last row.

    Attributes:
        force: world (n + 1, 3) [N], at the centres of mass.
        moment: body axes (n + 1, 3) [N m], about the centres of mass.
        potential: [J].
        power: of the part of the force that has no potential [W].
    """

    force: Float[Array, "N 3"]
    moment: Float[Array, "N 3"]
    potential: Float[Array, ""]
    power: Float[Array, ""]

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
    force_w: Float[Array, "3"],
    arm_w: Float[Array, "3"] | None = None,
    moment_w: Float[Array, "3"] | None = None,
) -> Load:
    """A world force [N] at `arm_w` [m] from the body's centre of mass, and a moment [N m].

    Its power is counted as that of a force without potential.
    """
    k = kin.index(body)
    zero = jnp.zeros(3, kin.r.dtype)
    total = zero if moment_w is None else moment_w
    if arm_w is not None:
        total = total + cross(arm_w, force_w)
    row = jnp.asarray(np.eye(len(kin.names))[:, k, None])
    power = dot(force_w, kin.v[k]) + dot(total, kin.omega_w[k])
    return Load(
        row * force_w, row * apply_transposed(kin.R_wb[k], total), jnp.zeros((), kin.r.dtype), power
    )


def total_load(forces: "Sequence[AbstractForce]", t: Float[Array, ""], kin: Kinematics) -> Load:
    """The sum of all force elements at time t [s].

    Raises:
        ModelError: a force whose load has not the shapes of `Load`; names its class and where
            it acts.
    """
    total = no_load(kin)
    for force in forces:
        found = force.load(t, kin)
        _check_load(force, found, total)
        total = total + found
    return total


def _check_load(force: "AbstractForce", found: object, expected: Load) -> None:
    for name in ("force", "moment", "potential", "power"):
        must = jnp.shape(getattr(expected, name))
        shape = jnp.shape(getattr(found, name)) if isinstance(found, Load) else None
        if shape != must:
            where = ", ".join((*force.bodies(), *force.joint_names())) or "all bodies"
            given = f"has {name} of shape {shape}" if shape is not None else "is none"
            raise ModelError(
                f"The load of {type(force).__name__} on {where} must be a Load with {name} of "
                f"shape {must}, a row for every body and one for ground, but it {given}."
                if must
                else f"The load of {type(force).__name__} on {where} must be a Load with {name} a "
                f"single number, but it {given}."
            )


class AbstractForce(eqx.Module):
    """A force element. Subclasses define `load` and the names of the bodies they act on."""

    @abstractmethod
    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        """The load at time t [s] on all bodies."""

    @abstractmethod
    def bodies(self) -> tuple[str, ...]:
        """The names that must be known bodies (or "ground") for this force to act."""

    @abstractmethod
    def joint_names(self) -> tuple[str, ...]:
        """The names that must be known joints for this force to act."""


def couple(kin: Kinematics, body_i: str, body_j: str, moment_w: Float[Array, "3"]) -> Load:
    """`moment_w` [N m] on body i and its opposite on body j."""
    none = jnp.zeros_like(moment_w)
    return push(kin, body_i, none, moment_w=moment_w) + push(kin, body_j, none, moment_w=-moment_w)


def vector(value: Numbers, what: str, unit: str) -> Float[Array, "3"]:
    """A vector (3,) that a user gave; raises `ModelError` for a bad shape or number."""
    check_shape(value, (3,), what)
    check_finite(value, what, unit)
    return jnp.asarray(value, dtype=float)


def scalar(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """A number that a user gave; raises `ModelError` for a bad shape or number."""
    check_shape(value, (), what)
    check_finite(value, what, unit)
    return jnp.asarray(value, dtype=float)


def nonnegative(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """A number >= 0 that a user gave; raises `ModelError` for any other."""
    number = scalar(value, what, unit)
    if concrete(number) and float(number) < 0:
        raise ModelError(f"{what} must not be negative, but it is {float(number):g} {unit}.")
    return number


def positive(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """A number > 0 that a user gave; raises `ModelError` for any other."""
    number = scalar(value, what, unit)
    if concrete(number) and float(number) <= 0:
        raise ModelError(f"{what} must be positive, but it is {float(number):g} {unit}.")
    return number
