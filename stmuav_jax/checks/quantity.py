"""Options of a scene as dataclasses of described numbers, and their making from plain data.

A field made by `quantity` carries its description, unit and size, so that the command line and
study files read the options from the classes themselves. Nothing here needs JAX.
"""

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from .errors import SettingError, nearest_names

if TYPE_CHECKING:
    from .shapes import Numbers as Numbers
else:
    # the shapes' names need JAX, which is slow to import
    Numbers = Any

Option = TypeVar("Option")

_KEY = "quantity"


class OptionField(NamedTuple):
    """Description of one field of an option.

    Attributes:
        what: a noun phrase for the help. unit: SI, "" where there is none.
        counts: how many numbers it may consist of. kind: float, int, or bool for a switch that is
            off by default.
    """

    what: str
    unit: str = ""
    counts: tuple[int, ...] = (1,)
    kind: type = float


def quantity(
    what: str, unit: str = "", *counts: int, kind: type = float, default: Any = None
) -> Any:
    """Field of an option's dataclass; None by default, which leaves the number to the scene."""
    described = OptionField(what, unit, counts or (1,), kind)
    return dataclasses.field(default=default, metadata={_KEY: described})


def quantities(option: Any) -> dict[str, OptionField]:
    """Descriptions of an option's fields by name; empty for any other class."""
    if not dataclasses.is_dataclass(option):
        return {}
    described = {field.name: field.metadata.get(_KEY) for field in dataclasses.fields(option)}
    return {name: each for name, each in described.items() if each is not None}


def option_from_plain(kind: type[Option], plain: Any, where: str) -> Option:
    """An option from plain data, such as {"stiffness": 1e6}.

    Args:
        where: the option's name, for messages.

    Raises:
        SettingError: no table, an unknown field (with the known ones), a value of another type or
            of another number of entries. Ranges are the business of what the option builds.
    """
    # slow to import: only where there is something to check
    from .schema import SHOWN, named, shown

    if not isinstance(plain, Mapping):
        raise SettingError(f"Option '{where}' must be a table of its fields, not {shown(plain)}.")
    known = quantities(kind)
    for name, value in plain.items():
        if name not in known:
            near = nearest_names(str(name)[:SHOWN], known)
            raise SettingError(f"Option '{where}' has no field {named(name)}.{near}")
        _check(known[name], value, f"{where}.{name}")
    return kind(**{name: _value(value, known[name].counts) for name, value in plain.items()})


def _value(value: Any, counts: tuple[int, ...]) -> Any:
    """A number, or a tuple; one entry alone is a number where that is admitted."""
    if not isinstance(value, list | tuple):
        return value
    return value[0] if len(value) == 1 and 1 in counts else tuple(value)


def _check(quantity: OptionField, value: Any, where: str) -> None:
    entries = value if isinstance(value, list | tuple) else (value,)
    words = {float: "number", int: "whole number", bool: "true or false"}[quantity.kind]
    admitted = (int, float) if quantity.kind is float else (quantity.kind,)
    fine = all(
        isinstance(x, admitted) and (quantity.kind is bool or not isinstance(x, bool))
        for x in entries
    )
    if not fine or len(entries) not in quantity.counts:
        unit = f" [{quantity.unit}]" if quantity.unit else ""
        counts = " or ".join(map(str, quantity.counts))
        wanted = f"{counts} {words}s" if quantity.counts != (1,) else f"a {words}"
        wanted = words if quantity.kind is bool else wanted
        from .schema import shown

        raise SettingError(f"'{where}' must be {wanted}{unit}, not {shown(value)}.")
