"""Conversion of a user's numbers to arrays, with errors that name a bad kind, shape or size."""

import reprlib
from collections.abc import Sequence
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .errors import ModelError, SettingError, check_finite, check_shape, concrete
from .shapes import Numbers

Tree = TypeVar("Tree")


def floats(value: object) -> Array:
    """Convert numbers to an array of floating-point numbers, of JAX's default data type.

    Numbers that are not traced pass through NumPy. JAX would compile a program for each shape.
    """
    if concrete(value):
        value = np.asarray(value, dtype=jax.dtypes.canonicalize_dtype(float))
    return jnp.asarray(value, dtype=float)  # pyright: ignore[reportArgumentType]


def stacked(rows: Sequence[Any], axis: int = 0) -> Array:
    """Stack arrays along a new axis, by NumPy if none is traced, which compiles nothing."""
    if not concrete(rows):
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
    if not concrete(tree):
        return tree
    return jax.tree.map(lambda x: np.asarray(x) if isinstance(x, jax.Array) else x, tree)


def array_module(*values: object) -> Any:
    """The module `numpy` if none of the values is traced by JAX, else `jax.numpy`."""
    return np if concrete(values) else jnp


def numbers(
    value: object,
    shape: tuple[int, ...],
    what: str,
    unit: str,
    error: type[Exception] = ModelError,
) -> Array:
    """Convert a user's value to an array of finite numbers of the given shape.

    The data type is JAX's default for floating-point numbers: double precision if enabled.

    Args:
        what: subject of the error's sentence, such as "The speed of the climb".
        unit: unit of the numbers; "" for none.

    Raises:
        error: the value is text or None, has another shape, or holds a number that is not finite.
    """
    wanted = "a number" if shape == () else f"numbers of shape {shape}"
    if concrete(value):
        try:
            found = np.asarray(value)
        except (TypeError, ValueError):
            found = np.asarray(None)
        if found.dtype.kind not in "biuf":
            raise error(f"{what} must be {_with(wanted, unit)}, but it is {reprlib.repr(value)}.")
    array = floats(value)
    if array.shape != shape:
        raise error(f"{what} must be {_with(wanted, unit)}, but its shape is {array.shape}.")
    check_finite(array, what, unit, error)
    return array


def _with(wanted: str, unit: str) -> str:
    return f"{wanted} [{unit}]" if unit else wanted


def vector(value: Numbers, what: str, unit: str) -> Float[Array, "3"]:
    """Convert a user's vector (3,) to an array; `ModelError` for a bad shape or number."""
    check_shape(value, (3,), what)
    check_finite(value, what, unit)
    return floats(value)


def scalar(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number to an array (); `ModelError` for a bad shape or number."""
    check_shape(value, (), what)
    check_finite(value, what, unit)
    return floats(value)


def nonnegative(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number >= 0 to an array (); `ModelError` for any other value."""
    number = scalar(value, what, unit)
    if concrete(number) and float(number) < 0:
        raise ModelError(f"{what} must not be negative, but it is {float(number):g} {unit}.")
    return number


def positive(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number > 0 to an array (); `ModelError` for any other value."""
    number = scalar(value, what, unit)
    if concrete(number) and float(number) <= 0:
        raise ModelError(f"{what} must be positive, but it is {float(number):g} {unit}.")
    return number


def increasing_times(ts: Any, what: str) -> np.ndarray:
    """Convert a user's times (k,) [s] to a NumPy array of finite, increasing numbers.

    Args:
        what: subject of the error's sentence, such as "The times of the record".

    Raises:
        SettingError: there is none, one is not finite, or one does not follow the one before.
    """
    times = np.asarray(ts, dtype=float)
    if times.ndim != 1 or times.size < 1 or not np.all(np.isfinite(times)):
        raise SettingError(f"{what} must be a list of finite numbers.")
    if np.any(times[1:] <= times[:-1]):
        k = int(np.argmax(times[1:] <= times[:-1]))
        raise SettingError(
            f"{what} must increase, but ts[{k + 1}] = {times[k + 1]} s follows ts[{k}] = {times[k]} s."
        )
    return times
