"""Checks of users' files against pydantic models, with errors in the users' own words.

A model states the names, types and ranges that a file may hold. `checked` validates plain data,
such as a TOML file's, by a model; its error gives the place of the first entry that does not fit,
the value found there, and what would be valid.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import pydantic
from pydantic import ConfigDict, Field

from .errors import SettingError, nearest_names

Model = TypeVar("Model", bound=pydantic.BaseModel)

# Characters of a value or a name that an error message shows.
SHOWN = 80


class Entries(pydantic.BaseModel):
    """Table of a file: exactly the named entries, each of its type without conversion."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


def _tuples(given: Any) -> Any:
    """Convert lists and arrays to tuples, as strict models require."""
    given = given.tolist() if hasattr(given, "tolist") else given
    return tuple(_tuples(x) for x in given) if isinstance(given, list) else given


Tuples = pydantic.BeforeValidator(_tuples)
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
# Numbers of samples, chunks or steps: integers from 1 on that doubles represent exactly.
MOST = 10**12
Count = Annotated[int, Field(strict=True, ge=1, le=MOST)]


def shown(value: Any, most: int = SHOWN) -> str:
    """Text of a value for an error message: its Python form, shortened in the middle.

    Large integers and nested lists are shortened before they are written out.
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
    """Text of a name for an error message, quoted and shortened."""
    return shown(str(name), most)


def checked(model: type[Model], given: Any, what: str) -> Model:
    """Validate plain data and return them as a model.

    Args:
        what: owner of the entries, such as "A study"; it begins some of the messages.

    Raises:
        SettingError: an entry does not fit; the message says where the first one is, what it
            holds and what would be valid, and for an unknown entry the nearest known name.
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
        # an unknown name often explains why another name is missing
        first = next((one for one in found if one["type"] == "extra_forbidden"), found[0])
        raise SettingError(_words(first, model, what)) from None
    except (OverflowError, RecursionError) as error:
        raise SettingError(f"{what} has entries that cannot be read: {error}.") from None


def _words(error: Any, model: type[pydantic.BaseModel], what: str) -> str:
    """Sentence that describes one of pydantic's errors."""
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
        # the message names the choices already
        near = near.partition(" Known names")[0]
        words = " or ".join((", ".join(choices[:-1]), choices[-1])) if choices[1:] else choices[0]
        return f"'{where}' must be {words}, not {shown(given)}.{near}"
    if kind == "value_error":
        return f"'{where}' {limits['error']}"
    return f"'{where}' must be {_wanted(kind, limits)}, but it is {shown(given)}."


def _owner(error: Any, what: str) -> str:
    """Owner of the entry in an error: the whole file or a table within it."""
    inner = ".".join(str(part)[:SHOWN] for part in error["loc"][:-1])
    return f"'{inner}'" if inner else what


_TYPES = {
    "float": "a number", "int": "a whole number", "bool": "true or false", "string": "text",
    "list": "a list", "tuple": "a list", "dict": "a table", "model": "a table",
    "mapping": "a table",
}  # fmt: skip


def _wanted(kind: str, limits: Mapping[str, Any]) -> str:
    """Description of a valid value for a kind of pydantic error."""
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
    """Names of the entries of a model, or of a table within it."""
    for part in where:
        fields = getattr(model, "model_fields", {})
        if part in fields:
            model = _inner(fields[part].annotation)
        # other parts are names in a table of tables of one kind
    return list(getattr(model, "model_fields", {}))


def _inner(annotation: Any) -> Any:
    """Model inside an annotation such as `dict[str, Model]` or `Model | None`; None without one."""
    if isinstance(annotation, type) and issubclass(annotation, pydantic.BaseModel):
        return annotation
    for part in getattr(annotation, "__args__", ()):
        if (found := _inner(part)) is not None:
            return found
    return None
