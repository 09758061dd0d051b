"""Factors of a study that are numbers of a parameter table."""

import difflib
import re
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import rotation_matrix
from ..checks.errors import SettingError
from ..checks.schema import named
from ..mechanics.state import State
from ..parameters.table import Parameters

# Relative tolerance for round-off in the check of sampled inertia tensors.
ROUND_OFF = 1e-12


class FactorTarget(NamedTuple):
    """Target of a factor: a parameter and places in its value, or a number not in the table."""

    name: str
    places: tuple[tuple[int, ...], ...]
    unit: str


def table_entry(
    table: Parameters,
    factor: str,
    relative: bool,
    unknown: Callable[[], str] = lambda: "is unknown.",
) -> FactorTarget:
    """Target of a factor that is a parameter of a table, or one entry of it.

    Args:
        relative: True for a factor that multiplies the value. unknown: function that makes the end of
            the message on a name that the table does not have.

    Raises:
        SettingError: an unknown name, or a place that the parameter does not have.
    """
    match = re.fullmatch(r"([\w.]+)(?:\[([\d, ]+)\])?", factor)
    if match is None or match[1] not in set(table):
        raise SettingError(f"{named(factor)} {unknown()}")
    name = match[1]
    try:
        place = tuple(int(k) for k in match[2].split(",")) if match[2] else ()
    except ValueError:
        raise SettingError(
            f"{named(factor)} names no entry; one is written such as {name}[0, 1]."
        ) from None
    value = np.asarray(table.value(name), dtype=float)
    if place and (
        len(place) != value.ndim or any(k >= n for k, n in zip(place, value.shape, strict=True))
    ):
        raise SettingError(f"'{name}' has shape {value.shape}; it has no entry {list(place)}.")
    if not place and value.ndim and not relative:
        raise SettingError(
            f"'{name}' has shape {value.shape}: name one entry, such as "
            f"{name}[{', '.join('0' * value.ndim)}], or make the factor relative."
        )
    places = (place,) if place else ()
    # an inertia tensor stays symmetric, "bare.inertia" of the hexacopter too
    tensor = table[name].unit == "kg m^2" and len(place) == 2
    across = place[::-1]
    if tensor and place != across:
        places = (place, across)
    return FactorTarget(name, places, "1" if relative else table[name].unit)


def drawn_table(
    table: Parameters, values: Mapping[str, Array], relative: frozenset[str]
) -> Parameters:
    """Table with drawn values, which may be traced, of factors that are its parameters.

    Args:
        relative: factors that multiply the table's value.
    """
    new: dict[str, Array] = {}
    for factor, value in values.items():
        name, places, _ = table_entry(table, factor, factor in relative)
        now = new.get(name, table.value(name))
        if factor in relative:
            share = lambda x, value=value: jnp.asarray(x, dtype=float) * value
            if not places:
                new[name] = share(now)
                continue
            value = share(np.asarray(table.value(name))[places[0]])
        now = jnp.asarray(now, dtype=float)
        for place in places or ((),):
            now = now.at[place].set(value)
        new[name] = now
    return table.replaced(new, source="drawn") if new else table


def possible_tables(
    table: Parameters,
    factors: tuple[str, ...],
    drawn: Float[np.ndarray, "n d"],
    relative: frozenset[str],
) -> Bool[np.ndarray, " n"]:
    """True for samples with masses and inertia tensors that bodies can have (n,).

    The checks are those of `Body`, which does not check traced numbers: masses are positive,
    tensors positive definite, and no principal moment exceeds the sum of the other two.
    """
    fine = np.ones(len(drawn), bool)
    entry = lambda name: table_entry(table, name, name in relative).name
    chosen = {entry(name): table[entry(name)] for name in factors}
    if not {p.unit for p in chosen.values()} & {"kg", "kg m^2"}:
        return fine
    own = lambda row: drawn_table(table, dict(zip(factors, row, strict=True)), relative)
    sampled = lambda row: {name: jnp.asarray(own(row).value(name)) for name in chosen}
    values = jax.vmap(sampled)(jnp.asarray(drawn))
    for name, parameter in chosen.items():
        value = np.asarray(values[name], dtype=float)
        if parameter.unit == "kg":
            fine &= (np.isfinite(value) & (value > 0)).reshape(len(drawn), -1).all(axis=1)
        elif parameter.unit == "kg m^2" and value.shape[1:] == (3, 3):
            fine &= _tensors(value, parameter.tolerance)
        elif parameter.unit == "kg m^2" and value.shape[1:] == (3,):
            # three moments of a model's body
            fine &= _tensors(value[:, :, None] * np.eye(3), parameter.tolerance)
        elif parameter.unit == "kg m^2" and value.ndim == 1:
            fine &= np.isfinite(value) & (value > 0)
    return fine


_rotation = quick_jit(rotation_matrix)


def faced(start: State) -> np.ndarray:
    """World direction of the last body's z axis in a state (3,); a panel faces it."""
    return np.asarray(_rotation(start.p[-1]))[:, 2]


def alike(name: str, known: list[str]) -> str:
    """Hint with the nearest of very many names, and some similar ones."""
    some = difflib.get_close_matches(name, known, n=8, cutoff=0.3)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f" Did you mean '{close[0]}'?" if close else ""
    like = f" Names like it: {', '.join(some)}." if some else ""
    return f"{hint}{like} docs/studies.md says which there are."


def _tensors(inertia: Float[np.ndarray, "n 3 3"], tolerance: float) -> Bool[np.ndarray, " n"]:
    """True for inertia tensors that a body can have, with a relative tolerance of the moments."""
    finite = np.all(np.isfinite(inertia), axis=(1, 2))
    moments = np.linalg.eigvalsh(np.where(finite[:, None, None], inertia, np.eye(3)))
    with np.errstate(over="ignore"):
        most = (moments[:, 0] + moments[:, 1]) * (1 + max(tolerance, ROUND_OFF))
    return finite & (moments[:, 0] > 0) & (moments[:, 2] <= most)
