"""Conversion of a user's numbers to arrays, and checks of masses, inertia tensors and Euler parameters."""

import reprlib
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .errors import ModelError, SettingError, check_finite, check_shape, has_values
from .shapes import Numbers

Tree = TypeVar("Tree")

# Admitted difference of |p| from 1 in user input; beyond it the user has to decide.
UNIT_TOLERANCE = 1e-9
# Relative tolerance of the symmetry and triangle checks, for round-off in rotated tensors.
_ROUND_OFF = 1e-12
# A principal moment below this fraction of the largest one is zero up to round-off.
_SINGULAR = 1e-15


def as_floats(value: object) -> Array:
    """Convert numbers to an array of floating-point numbers, of JAX's default data type.

    Numbers that are not traced pass through NumPy. JAX would compile a program for each shape.
    """
    if has_values(value):
        value = np.asarray(value, dtype=jax.dtypes.canonicalize_dtype(float))
    return jnp.asarray(value, dtype=float)  # pyright: ignore[reportArgumentType]


def stack_arrays(rows: Sequence[Any], axis: int = 0) -> Array:
    """Stack arrays along a new axis, by NumPy if none is traced, which compiles nothing."""
    if not has_values(rows):
        return jnp.stack(rows, axis=axis)
    return as_jax(np.stack([np.asarray(row) for row in rows], axis=axis))


def as_jax(array: Array | np.ndarray) -> Array:
    """Convert a NumPy array to one of JAX of the same data type, without compiling."""
    # without a data type `jnp.asarray` compiles a program for each shape
    return jnp.asarray(array, dtype=jax.dtypes.canonicalize_dtype(array.dtype))


def as_numpy(tree: Tree) -> Tree:
    """Pytree with its arrays as NumPy arrays, or the same pytree if one of them is traced.

    Operations on NumPy arrays compile nothing; `array_module` has the functions for them.
    """
    if not has_values(tree):
        return tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def array_module(*values: object) -> Any:
    """The module `numpy` if none of the values is traced by JAX, else `jax.numpy`."""
    return np if has_values(values) else jnp


def check_numbers(
    value: object,
    shape: tuple[int, ...],
    subject: str,
    unit: str,
    error: type[Exception] = ModelError,
) -> Array:
    """Convert a user's value to an array of finite numbers of the given shape.

    The data type is JAX's default for floating-point numbers: double precision if enabled.

    Args:
        subject: subject of the error's sentence, such as "The speed of the climb".
        unit: unit of the numbers; "" for none.

    Raises:
        error: the value is text or None, has another shape, or holds a number that is not finite.
    """
    requirement = "a number" if shape == () else f"numbers of shape {shape}"
    requirement += f" [{unit}]" if unit else ""
    if has_values(value):
        try:
            raw_array = np.asarray(value)
        except (TypeError, ValueError):
            raw_array = np.asarray(None)
        if raw_array.dtype.kind not in "biuf":
            raise error(f"{subject} must be {requirement}, but it is {reprlib.repr(value)}.")
    array = as_floats(value)
    if array.shape != shape:
        raise error(f"{subject} must be {requirement}, but its shape is {array.shape}.")
    check_finite(array, subject, unit, error)
    return array


def check_vector(value: Numbers, subject: str, unit: str) -> Float[Array, "3"]:
    """Convert a user's vector (3,) to an array; `ModelError` for a bad shape or number."""
    check_shape(value, (3,), subject)
    check_finite(value, subject, unit)
    return as_floats(value)


def check_scalar(value: Numbers, subject: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number to an array (); `ModelError` for a bad shape or number."""
    check_shape(value, (), subject)
    check_finite(value, subject, unit)
    return as_floats(value)


def check_nonnegative(value: Numbers, subject: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number >= 0 to an array (); `ModelError` for any other value."""
    number = check_scalar(value, subject, unit)
    if has_values(number) and float(number) < 0:
        raise ModelError(f"{subject} must not be negative, but it is {float(number):g} {unit}.")
    return number


def check_positive(value: Numbers, subject: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number > 0 to an array (); `ModelError` for any other value."""
    number = check_scalar(value, subject, unit)
    if has_values(number) and float(number) <= 0:
        raise ModelError(f"{subject} must be positive, but it is {float(number):g} {unit}.")
    return number


def increasing_times(ts: Any, subject: str) -> np.ndarray:
    """Convert a user's times (k,) [s] to a NumPy array of finite, increasing numbers.

    Args:
        subject: subject of the error's sentence, such as "The times of the record".

    Raises:
        SettingError: there is none, one is not finite, or one does not follow the one before.
    """
    times = np.asarray(ts, dtype=float)
    if times.ndim != 1 or times.size < 1 or not np.all(np.isfinite(times)):
        raise SettingError(f"{subject} must be a list of finite numbers.")
    if np.any(times[1:] <= times[:-1]):
        k = int(np.argmax(times[1:] <= times[:-1]))
        raise SettingError(
            f"{subject} must increase, but ts[{k + 1}] = {times[k + 1]} s follows ts[{k}] = {times[k]} s."
        )
    return times


def check_mass(mass: Numbers, owner: str) -> None:
    """Raise `ModelError` unless the mass [kg] is finite and positive."""
    if has_values(mass) and not (np.isfinite(mass) and float(mass) > 0):  # pyright: ignore
        raise ModelError(f"The mass of {owner} must be finite and positive, but it is {mass} kg.")


def check_inertia(inertia: Numbers, owner: str, tolerance: float) -> None:
    """Raise `ModelError` unless a rigid body can have the inertia tensor (3, 3) [kg m^2]."""
    if not has_values(inertia):
        return
    tensor = np.asarray(inertia, dtype=float)
    if not np.all(np.isfinite(tensor)):
        raise ModelError(
            f"The inertia tensor of {owner} must be finite, but it is {tensor.tolist()}."
        )
    size = np.abs(tensor).max()
    if np.abs(tensor - tensor.T).max() > _ROUND_OFF * size:
        raise ModelError(
            f"The inertia tensor of {owner} must be symmetric, but it is {tensor.tolist()}."
        )
    moments = np.linalg.eigvalsh(tensor)
    listed = ", ".join(f"{m:.6g}" for m in moments)
    if moments[0] <= _SINGULAR * moments[2]:
        raise ModelError(
            f"The inertia tensor of {owner} must be positive definite, but its principal moments "
            f"are {listed} kg m^2.{_advise_inertia(moments)}"
        )
    excess = moments[2] / (moments[0] + moments[1]) - 1
    if excess > max(tolerance, _ROUND_OFF):
        raise ModelError(
            f"The inertia tensor of {owner} violates the triangle inequality: of its principal moments "
            f"{listed} kg m^2 the largest exceeds the sum of the other two by "
            f"{100 * excess:.3g} %. Correct the entry, or accept a rounded table by "
            f"triangle_tolerance={excess * 1.01:.2g}."
        )


def _advise_inertia(moments: np.ndarray) -> str:
    """Advice for an error message, from principal moments in ascending order [kg m^2]."""
    size = np.abs(moments).max()
    if size == 0:
        return (
            " A point mass has no inertia to turn: give it that of a small sphere, 2 m r^2 / 5 "
            "(stmuav_jax.mechanics.sphere); where nothing turns it, the value does not matter."
        )
    if abs(moments[0]) <= _SINGULAR * size and moments[1] > _SINGULAR * size:
        return (
            " A rod without thickness has no inertia about its own axis, so that nothing would "
            "resist a turn about it: give it the moment that its thickness gives, m r^2 / 2 for "
            "the radius r (stmuav_jax.mechanics.cylinder); where joints keep it from that turn, the "
            "value does not matter."
        )
    return ""


def check_unit(p: Numbers, subject: str, error: type[Exception]) -> None:
    """Raise `error` unless p (4,) is finite and |p| = 1 within `UNIT_TOLERANCE`."""
    if not has_values(p):
        return
    values = np.asarray(p, dtype=float)
    if not np.all(np.isfinite(values)):
        raise error(
            f"The Euler parameters of {subject} must be finite, but they are {values.tolist()}."
        )
    norm = float(np.sqrt(values @ values))
    if abs(norm - 1) <= UNIT_TOLERANCE:
        return
    if norm == 0:
        raise error(f"The Euler parameters of {subject} are all zero, but a rotation needs norm 1.")
    raise error(
        f"The Euler parameters of {subject} must have norm 1, but {values.tolist()} has norm "
        f"{norm:.12g}. If only their scale is wrong, divide them by their norm "
        "(stmuav_jax.rotation.normalise); if they were printed with few digits, find the nearest posture "
        "that the joints allow with stmuav_jax.assemble."
    )
