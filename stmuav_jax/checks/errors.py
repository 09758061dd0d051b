"""Exceptions for bad input, codes for what is not valid, and small checks that raise or give them.

A check reads only concrete values: inside `jax.jit`, `vmap` or `grad` an argument is a tracer,
and the check is skipped. A model that is built once outside is checked.
"""

import difflib
from collections.abc import Iterable
from enum import IntEnum
from typing import Any

import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Int

_LONGEST = 200  # characters of a name that are compared: the time grows with their square


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


class AbstractReason(IntEnum):
    """Code for the reason why a value is not valid or a computation ended; 0 if all is well.

    Each kind of value has its own enumeration; one array holds codes of one enumeration.
    """

    @property
    def label(self) -> str:
        """Name of the code as words in lower case."""
        return self.name.lower().replace("_", " ")


def first_reason(*checks: tuple[Bool[Array, "*#s"], IntEnum]) -> Int[Array, "*s"]:
    """Code of the first check that is true, of the checks' shape (*s); 0 where none is true."""
    code = jnp.zeros(jnp.shape(checks[0][0]), dtype=jnp.int8)
    for wrong, reason in reversed(checks):
        code = jnp.where(wrong, jnp.int8(reason), code)
    return code


def has_values(*values: object) -> bool:
    """Test whether all values are concrete, i.e. none is a tracer of JAX."""
    return not any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(values))


def check_finite(
    value: object, subject: str, unit: str, error: type[Exception] = ModelError
) -> None:
    """Raise `error` unless every number in `value` is finite."""
    for part in jax.tree.leaves(value) if has_values(value) else ():
        numbers = np.asarray(part, dtype=float)
        if not np.all(np.isfinite(numbers)):
            sentence = f"{subject} must be finite, but it is {numbers.tolist()} {unit}"
            raise error(f"{sentence.rstrip()}.")


def check_shape(value: Any, shape: tuple[int, ...], subject: str) -> None:
    """Raise `ModelError` unless `value` has the given shape."""
    if shape_of(value) != shape:
        raise ModelError(f"{subject} must have shape {shape}, but it has {shape_of(value)}.")


def shape_of(value: Any) -> tuple[int, ...]:
    """Shape of a number, an array or a sequence of them, concrete or traced by JAX."""
    return np.shape(value) if has_values(value) else jnp.shape(jnp.asarray(value))


def closest_name(name: str, names: Iterable[str], *, count: int = 1) -> str:
    """Hint for an error message about an unknown name: the closest known name, or '' if none is close.

    Case is ignored. With a `count` above one, so many names that are somewhat like it follow.
    """
    query = name[:_LONGEST].lower()
    lower = {entry[:_LONGEST].lower(): entry for entry in reversed(list(names))}
    close = difflib.get_close_matches(query, lower, n=1)
    hint = f" Did you mean '{lower[close[0]]}'?" if close else ""
    if count > 1:
        alike = difflib.get_close_matches(query, lower, n=count, cutoff=0.3)
        hint += f" Names like it: {', '.join(lower[entry] for entry in alike)}." if alike else ""
    return hint


def nearest_names(name: str, known_names: Iterable[str]) -> str:
    """Hint for an error message about an unknown name: the closest known name and all of them."""
    known_names = list(known_names)
    return f"{closest_name(name, known_names)} Known names: {', '.join(known_names) if known_names else '(none)'}."


def named_places(names: Any, known_names: list[str], subject: str, kind: str) -> tuple[int, ...]:
    """Indices, among the known names, of the names that a user gave.

    Args:
        subject: subject of the error's sentence, such as "The free states".
        kind: noun for one of the known names, such as "state".

    Raises:
        SettingError: `names` is not a list of names, or has an unknown or a repeated name.
    """
    if isinstance(names, str) or not all(isinstance(name, str) for name in names):
        example = f", such as ['{known_names[0]}']" if known_names else ""
        raise SettingError(f"{subject} must be a list of names of {kind}s{example}, not {names!r}.")
    for name in names:
        if name not in known_names:
            raise SettingError(
                f"{subject} name '{name}', which is no {kind}.{nearest_names(name, known_names)}"
            )
    twice = {name for name in names if list(names).count(name) > 1}
    if twice:
        raise SettingError(f"{subject} name {', '.join(sorted(twice))} twice.")
    return tuple(known_names.index(name) for name in names)
