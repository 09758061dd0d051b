"""Exceptions for bad input, and small checks that raise them.

A check reads only concrete values: inside `jax.jit`, `vmap` or `grad` an argument is a tracer,
and the check is skipped. A model that is built once outside is checked.
"""

import difflib
from collections.abc import Iterable
from typing import Any

import numpy as np


class ModelError(ValueError):
    """Error of a model that is not physical or not connected; the message names the fault."""


class StateError(ValueError):
    """Error of a state that does not fit its system: not unit, not finite, or not consistent."""


class SettingError(ValueError):
    """Error of an unusable setting: a time span, a tolerance, a solver's name or a data type."""


class SimulationError(RuntimeError):
    """Error of a simulation that ended early; `run` holds the part that was computed."""

    def __init__(self, message: str, run: object = None) -> None:
        super().__init__(message)
        self.run = run


def concrete(*values: object) -> bool:
    """Test whether all values are concrete, i.e. none is a tracer of JAX."""
    # imported here, because the command line needs the exceptions before it needs JAX
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
    """Shape of a number, an array or a sequence of them, concrete or traced by JAX."""
    if concrete(value):
        return np.shape(value)
    import jax.numpy as jnp

    return jnp.shape(jnp.asarray(value))


def nearest_names(name: str, known: Iterable[str]) -> str:
    """Hint for an error message about an unknown name: the closest known name and all of them."""
    known = list(known)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    return f"{hint} Known names: {', '.join(known) if known else '(none)'}."


def named_places(names: Any, known: list[str], what: str, kind: str) -> tuple[int, ...]:
    """Indices, among the known names, of the names that a user gave.

    Args:
        what: subject of the error's sentence, such as "The free states".
        kind: noun for one of the known names, such as "state".

    Raises:
        SettingError: `names` is not a list of names, or has an unknown or a repeated name.
    """
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        example = f", such as ['{known[0]}']" if known else ""
        raise SettingError(f"{what} must be a list of names of {kind}s{example}, not {names!r}.")
    for name in names:
        if name not in known:
            raise SettingError(
                f"{what} name '{name}', which is no {kind}.{nearest_names(name, known)}"
            )
    twice = {name for name in names if list(names).count(name) > 1}
    if twice:
        raise SettingError(f"{what} name {', '.join(sorted(twice))} twice.")
    return tuple(known.index(name) for name in names)
