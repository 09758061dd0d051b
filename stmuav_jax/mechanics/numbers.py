"""Numbers that a user gives: of the right kind, shape and size, or an error that names them."""

import reprlib

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .errors import ModelError, check_finite, concrete


def numbers(
    value: object,
    shape: tuple[int, ...],
    what: str,
    unit: str,
    error: type[Exception] = ModelError,
) -> Array:
    """An array of finite numbers of a given shape, in double precision where that is on.

    Args:
        what: the subject of the error's sentence, such as "The speed of the climb".
        unit: of the numbers, "" for none.

    Raises:
        error: text, None, another shape, or a number that is not finite; says which.
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
