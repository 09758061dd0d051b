"""Conversion of a user's numbers to arrays, with errors that name a bad kind, shape or size."""

import reprlib

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .errors import ModelError, check_finite, check_shape, concrete
from .shapes import Numbers


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
    array = jnp.asarray(value, dtype=float)  # pyright: ignore[reportArgumentType]
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
    return jnp.asarray(value, dtype=float)


def scalar(value: Numbers, what: str, unit: str) -> Float[Array, ""]:
    """Convert a user's number to an array (); `ModelError` for a bad shape or number."""
    check_shape(value, (), what)
    check_finite(value, what, unit)
    return jnp.asarray(value, dtype=float)


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
