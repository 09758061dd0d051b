"""The errors that bad input raises, and the small checks that raise them.

Checks look at values only where there are values: inside `jax.jit`, `vmap` or `grad` an
argument is a tracer, and the check is skipped there (build the model once outside to have
it checked).
"""

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np


class ModelError(ValueError):
    """A model that is not physical or not connected; the message says what and where."""


class StateError(ValueError):
    """A state that does not fit its system: not unit, not finite, or not consistent."""


class SettingError(ValueError):
    """A setting (time span, tolerance, name of a solver, data type) that cannot be used."""


class SimulationError(RuntimeError):
    """A simulation that did not reach its end; `run` holds what was reached."""

    def __init__(self, message: str, run: object = None) -> None:
        super().__init__(message)
        self.run = run


def concrete(*values: object) -> bool:
    """Whether none of the values is a tracer, so that their numbers can be looked at."""
    # here: the command line knows the errors before it needs JAX
    import jax
    import jax.core

    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def check_finite(value: object, what: str, unit: str, error: type[Exception] = ModelError) -> None:
    """Raise `error` unless every number in `value` is finite."""
    if not concrete(value):
        return
    import jax

    for part in jax.tree.leaves(value):
        if not np.all(np.isfinite(np.asarray(part, dtype=float))):
            shown = np.asarray(part, dtype=float).tolist()
            raise error(f"{what} must be finite, but it is {shown} {unit}".rstrip() + ".")


def check_shape(value: Any, shape: tuple[int, ...], what: str) -> None:
    """Raise `ModelError` unless `value` has the given shape."""
    found = shape_of(value)
    if found != shape:
        raise ModelError(f"{what} must have shape {shape}, but it has {found}.")


def shape_of(value: Any) -> tuple[int, ...]:
    """The shape of a number, an array, or a sequence of them, traced by JAX or not."""
    if concrete(value):
        return np.shape(value)
    import jax.numpy as jnp

    return jnp.shape(jnp.asarray(value))


def nearest_names(name: str, known: Iterable[str]) -> str:
    """' Did you mean ...? Known: ...' for error messages about unknown names."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    return f"{hint} Known names: {', '.join(known) if known else '(none)'}."
