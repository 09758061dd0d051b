"""Checks of entries in files and options, with errors that name the entry, its value and the valid values.

A pydantic model states the names, types and ranges of a file's entries; `validate_model` validates plain data by
it. An option of a scene is a dataclass whose fields `quantity` describes; `option_from_plain` makes one.
"""

import dataclasses
import math
import re
import reprlib
import unicodedata
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, NamedTuple, TypeVar

import pydantic
from pydantic import AfterValidator, ConfigDict, Field

from .errors import SettingError, closest_name, nearest_names

Model = TypeVar("Model", bound=pydantic.BaseModel)
Option = TypeVar("Option")

# Characters of a value or a name that an error message shows.
SHOWN = 80


class Entries(pydantic.BaseModel):
    """Table of a file: exactly the named entries, each of its type without conversion."""

    model_config = ConfigDict(strict=True, extra="forbid", allow_inf_nan=False, frozen=True)


def _convert_lists(value: Any) -> Any:
    """Convert lists and arrays to tuples, as strict models require."""
    value = value.tolist() if hasattr(value, "tolist") else value
    return tuple(_convert_lists(x) for x in value) if isinstance(value, list) else value


Tuples = pydantic.BeforeValidator(_convert_lists)
Finite = Annotated[float, Field(strict=True, allow_inf_nan=False)]
Positive = Annotated[float, Field(strict=True, gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Triple = Annotated[tuple[Finite, Finite, Finite], Tuples]
# Largest seed that the store's column types can hold.
MOST_SEED = 2**63 - 1
Seed = Annotated[int, Field(ge=0, le=MOST_SEED)]
# Numbers of samples, chunks or steps: integers from 1 on that doubles represent exactly.
MOST = 10**12
Count = Annotated[int, Field(strict=True, ge=1, le=MOST)]


class _Shortened(reprlib.Repr):
    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxlist, self.maxstring, self.maxother = 2, 6, SHOWN, SHOWN

    def repr_int(self, x: int, level: int) -> str:
        if abs(x) < 10**40:
            return repr(x)
        # Python refuses to write out integers of thousands of digits
        return f"a whole number of about {int(x.bit_length() * math.log10(2)) + 1} digits"


def format_value(value: Any) -> str:
    """Text of a value for an error message: its Python form, shortened to `SHOWN` characters."""
    text = _Shortened().repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN // 2 - 3]} ... {text[-SHOWN // 2 + 2 :]}"


def quote_name(name: Any) -> str:
    """Text of a name for an error message, quoted and shortened."""
    return format_value(str(name))


def validate_model(model: type[Model], data: Any, owner: str) -> Model:
    """Validate plain data and return them as a model.

    Args:
        owner: owner of the entries, such as "A study"; it begins some of the messages.

    Raises:
        SettingError: an entry does not fit; the message says where the first one is, what it
            holds and what would be valid, and for an unknown entry the nearest known name.
    """
    if not isinstance(data, Mapping):
        raise SettingError(f"{owner} must be a table of entries, but it is {format_value(data)}.")
    for key in data:
        if not isinstance(key, str):
            raise SettingError(f"{owner} has the entry {format_value(key)}, which is no name.")
    try:
        return model.model_validate(dict(data))
    except pydantic.ValidationError as error:
        # an unknown name often explains why another name is missing
        is_late = lambda entry: entry["type"] != "extra_forbidden"
        first = min(error.errors(include_url=False), key=is_late)
        raise SettingError(_describe_error(first, model, owner)) from None
    except (OverflowError, RecursionError) as error:
        raise SettingError(f"{owner} has entries that cannot be read: {error}.") from None


# Words of pydantic's messages, and those of a user.
_WORDS = {
    r"^(Input|\w+) should ": "must ", r" after validation, not .*": "", r", got .*": "",
    "a valid number": "a number", "a valid integer": "a whole number",
    "a valid boolean": "true or false", "a valid string": "text", "a valid (tuple|list)": "a list",
    "a valid dictionary.*": "a table", "greater than or equal to": "at least",
    "less than or equal to": "at most",
}  # fmt: skip


def _describe_error(error: Any, model: type[pydantic.BaseModel], subject: str) -> str:
    """Sentence that describes one of pydantic's errors."""
    kind, value, path = error["type"], error["input"], [x for x in error["loc"] if x != "[key]"]
    if not path:
        return f"{subject} {error['ctx']['error']}"
    *outer, last = path
    inner = ".".join(str(part)[:SHOWN] for part in outer)
    owner = f"'{inner}'" if inner else subject
    where = ".".join([*inner.split(".")[: len(outer)], str(last)[:SHOWN]])
    if kind == "missing" and isinstance(last, int):
        return f"'{inner}' must have more entries, but it is {format_value(value)}."
    if kind == "missing":
        return f"{owner} needs '{last}'."
    if kind == "extra_forbidden":
        return f"{owner} has no entry {quote_name(last)}.{nearest_names(str(last), _entry_names(model, outer))}"
    if kind == "value_error":
        return f"'{where}' {error['ctx']['error']}"
    message, name_hint = error["msg"], ""
    if kind == "literal_error" and isinstance(value, str):
        name_hint = closest_name(value, re.findall(r"'(.*?)'", message))
    for pattern, replacement in _WORDS.items():
        message = re.sub(pattern, replacement, message)
    # pydantic writes small limits out
    message = re.sub(r"\b0\.0000\d+", lambda number: f"{float(number[0]):g}", message)
    return f"'{where}' {message}, but it is {format_value(value)}.{name_hint}"


def _entry_names(model: Any, path: Iterable[Any]) -> list[str]:
    """Names of the entries of a model, or of a table within it."""
    for part in path:
        if field := getattr(model, "model_fields", {}).get(part):
            kinds = [field.annotation]
            # the model in an annotation such as `dict[str, Model]` or `Model | None`
            while kinds and not hasattr(kinds[0], "model_fields"):
                kinds = [*kinds[1:], *getattr(kinds[0], "__args__", ())]
            model = kinds[0] if kinds else None
    return list(getattr(model, "model_fields", {}))


class OptionField(NamedTuple):
    """Description of one field of an option.

    Attributes:
        description: a noun phrase for the help. unit: SI, "" where there is none.
        counts: how many numbers it may consist of. kind: float, int, or bool for a switch that is
            off by default.
    """

    description: str
    unit: str = ""
    counts: tuple[int, ...] = (1,)
    kind: type = float


def quantity(
    description: str, unit: str = "", *counts: int, kind: type = float, default: Any = None
) -> Any:
    """Field of an option's dataclass; None by default, which leaves the number to the scene."""
    described = OptionField(description, unit, counts or (1,), kind)
    return dataclasses.field(default=default, metadata={"quantity": described})


def quantity_fields(option: Any) -> dict[str, OptionField]:
    """Descriptions of an option's fields by name; empty for any other class."""
    fields = dataclasses.fields(option) if dataclasses.is_dataclass(option) else ()
    return {f.name: f.metadata["quantity"] for f in fields if "quantity" in f.metadata}


def option_from_plain(kind: type[Option], plain: Any, where: str) -> Option:
    """An option from plain data, such as {"stiffness": 1e6}.

    Args:
        where: the option's name, for messages.

    Raises:
        SettingError: no table, an unknown field (with the known ones), a value of another type or
            of another number of entries. Ranges are the business of what the option builds.
    """
    if not isinstance(plain, Mapping):
        raise SettingError(
            f"Option '{where}' must be a table of its fields, not {format_value(plain)}."
        )
    field_quantities, values = quantity_fields(kind), {}
    for name, value in plain.items():
        if name not in field_quantities:
            name_hint = nearest_names(str(name), field_quantities)
            raise SettingError(f"Option '{where}' has no field {quote_name(name)}.{name_hint}")
        _, unit, counts, number = field_quantities[name]
        entries = tuple(value) if isinstance(value, list | tuple) else (value,)
        types, noun = {
            float: (float | int, "number"), int: (int, "whole number"), bool: (bool, "true or false"),
        }[number]  # fmt: skip
        # a truth value is an integer to Python
        fits = all(
            isinstance(x, types) and isinstance(x, bool) == (number is bool) for x in entries
        )
        if not fits or len(entries) not in counts:
            requirement = noun if number is bool else f"a {noun}"
            if number is not bool and counts != (1,):
                requirement = f"{' or '.join(map(str, counts))} {noun}s"
            unit = f" [{unit}]" if unit else ""
            raise SettingError(
                f"'{where}.{name}' must be {requirement}{unit}, not {format_value(value)}."
            )
        alone = len(entries) == 1 and 1 in counts
        values[name] = entries[0] if alone else entries
    return kind(**values)


# Longest name of a study, mission or model, which a folder has too.
LONGEST_NAME = 100


def name_fault(name: str) -> str | None:
    """Requirement that a study's name, used for a folder, breaks: words after 'must', or None."""
    if not 1 <= len(name) <= LONGEST_NAME:
        return f"have 1 to {LONGEST_NAME} characters"
    if name.startswith(".") or name != name.strip():
        return "begin with neither a dot nor a space, nor end with one"
    if any(c in '/\\:*?"<>|' or unicodedata.category(c).startswith("C") for c in name):
        return "have no separators of folders, no wildcards and no control characters"
    return None


def _check_name(name: str) -> str:
    if fault := name_fault(name):
        raise ValueError(
            f"must {fault}, since it also names a folder, but it is {format_value(name)}."
        )
    return name


Name = Annotated[str, AfterValidator(_check_name)]
