"""Checks of files that users write, by models of pydantic, with errors in the users' own words.

A model says what a file may hold: names, types and ranges. `checked` reads plain data, such as
those of a TOML file, by a model, and says of the first entry that does not fit where it is, what is
there and what would be valid.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic import ConfigDict, Field

from .errors import SettingError, nearest_names

Model = TypeVar("Model", bound=pydantic.BaseModel)

# Characters of a value, or of a name, that a message repeats.
SHOWN = 80


class Entries(pydantic.BaseModel):
    """A table of a file: its entries and no others, each of its type without conversion."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
# Samples, chunks, steps: whole numbers from 1 on that doubles can count.
MOST = 10**12
Count = Annotated[int, Field(strict=True, ge=1, le=MOST)]


def shown(value: Any, most: int = SHOWN) -> str:
    """A value for a message: as Python writes it, shortened in its middle.

    Large numbers and nested lists are shortened before they are written out.
    """
    if isinstance(value, int) and abs(value) >= 10**40:
        return f"a whole number of about {int(value.bit_length() * math.log10(2)) + 1} digits"
    if isinstance(value, str):
        value = value if len(value) <= 4 * most else value[: 2 * most] + value[-2 * most :]
        text = repr(value)
    elif isinstance(value, Mapping):
        names = ", ".join(shown(k, 20) for k in list(value)[:4])
        text = f"a table of {names}" if names else "an empty table"
    elif isinstance(value, list | tuple):
        few = ", ".join(
            "..." if isinstance(x, list | tuple | Mapping) else shown(x, 20) for x in value[:6]
        )
        text = f"[{few}{', ...' if len(value) > 6 else ''}]"
    else:
        text = repr(value)
    half = most // 2
    return text if len(text) <= most else f"{text[: half - 3]} ... {text[-half + 2 :]}"


def named(name: Any, most: int = SHOWN) -> str:
    """A name for a message, in quotes and shortened."""
    return shown(str(name), most)


def checked(model: type[Model], given: Any, what: str) -> Model:
    """Plain data as a model.

    Args:
        what: whose entries they are, such as "A study"; the first words of some messages.

    Raises:
        SettingError: says of the first entry that does not fit where it is, what is there, and
            what would be valid; of an unknown entry the nearest that is known.
    """
    if not isinstance(given, Mapping):
        raise SettingError(f"{what} must be a table of entries, but it is {shown(given)}.")
    for key in given:
        if not isinstance(key, str):
            raise SettingError(f"{what} has the entry {shown(key)}, which is no name.")
    try:
        return model.model_validate(dict(given))
    except pydantic.ValidationError as error:
        found = error.errors(include_url=False, include_context=True)
        # an unknown name is often the reason why another is missing
        first = next((one for one in found if one["type"] == "extra_forbidden"), found[0])
        raise SettingError(_words(first, model, what)) from None
    except (OverflowError, RecursionError) as error:
        raise SettingError(f"{what} has entries that cannot be read: {error}.") from None


def _words(error: Any, model: type[pydantic.BaseModel], what: str) -> str:
    """One of pydantic's errors as a sentence."""
    kind, given, limits = error["type"], error["input"], error.get("ctx", {})
    loc = [part for part in error["loc"] if part != "[key]"]
    where = ".".join(shown(part, 60).strip("'\"") for part in loc)
    if kind == "missing" and isinstance(loc[-1], int):
        where = where.rpartition(".")[0]
        return f"'{where}' must have more entries, but it is {shown(given)}."
    if kind == "missing":
        return f"{_owner(error, what)} needs '{error['loc'][-1]}'."
    if kind == "extra_forbidden":
        known = _known(model, error["loc"][:-1])
        name = str(error["loc"][-1])
        near = nearest_names(name[:SHOWN], known)
        return f"{_owner(error, what)} has no entry {named(name)}.{near}"
    if kind == "literal_error":
        said = limits["expected"].replace("'", "")
        choices = [word.strip() for part in said.split(" or ") for word in part.split(",")]
        near = nearest_names(given[:SHOWN], choices) if isinstance(given, str) else ""
        # the choices have been said
        near = near.partition(" Known names")[0]
        words = " or ".join((", ".join(choices[:-1]), choices[-1])) if choices[1:] else choices[0]
        return f"'{where}' must be {words}, not {shown(given)}.{near}"
    if kind == "value_error":
        return f"'{where}' {limits['error']}"
    return f"'{where}' must be {_wanted(kind, limits)}, but it is {shown(given)}."


def _owner(error: Any, what: str) -> str:
    """Whose entry it is: the file's, or that of a table within it."""
    inner = ".".join(str(part)[:SHOWN] for part in error["loc"][:-1])
    return f"'{inner}'" if inner else what


_TYPES = {
    "float": "a number", "int": "a whole number", "bool": "true or false", "string": "text",
    "list": "a list", "tuple": "a list", "dict": "a table", "model": "a table",
    "mapping": "a table",
}  # fmt: skip


def _wanted(kind: str, limits: Mapping[str, Any]) -> str:
    """What would be valid, by the kind of error."""
    if kind == "greater_than" and limits["gt"] == 0:
        return "finite and positive"
    for name, key, words in (
        ("greater_than_equal", "ge", "at least"), ("greater_than", "gt", "greater than"),
        ("less_than_equal", "le", "at most"), ("less_than", "lt", "less than"),
        ("multiple_of", "multiple_of", "a multiple of"),
    ):  # fmt: skip
        if kind == name:
            return f"{words} {limits[key]:g}" if isinstance(limits[key], float) else (
                f"{words} {limits[key]}"
            )  # fmt: skip
    if kind == "finite_number":
        return "finite"
    if kind in ("too_short", "too_long"):
        least = limits.get("min_length", limits.get("max_length"))
        return f"of {'at least' if kind == 'too_short' else 'at most'} {least} entries"
    if kind == "int_parsing_size":
        return "a whole number of fewer digits"
    return _TYPES.get(kind.split("_")[0], "of another kind")


def _known(model: Any, where: Iterable[Any]) -> list[str]:
    """Names of a model's entries, or of those of a table within it."""
    for part in where:
        fields = getattr(model, "model_fields", {})
        if part in fields:
            model = _inner(fields[part].annotation)
        # other parts are names in a table of tables of one kind
    return list(getattr(model, "model_fields", {}))


def _inner(annotation: Any) -> Any:
    """The model that an annotation such as `dict[str, Model]` or `Model | None` holds."""
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return annotation
    for part in getattr(annotation, "__args__", ()):
        if (found := _inner(part)) is not None:
            return found
    return None
