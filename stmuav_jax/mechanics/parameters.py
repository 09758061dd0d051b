"""Tables of physical parameters, each with its value, unit and source."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..checks.errors import ModelError, check_finite, check_shape, has_values, nearest_names
from ..checks.numbers import check_inertia
from ..checks.schema import SHOWN, Entries, format_value, quote_name

# Largest permitted depth of nested lists; arrays have fewer axes.
_DEEPEST = 4


class ParameterEntry(Entries):
    """Parameter in a file with its unit: {value = 0.95, unit = "kg"}."""

    value: Any
    unit: str | None = None


@dataclass(frozen=True)
class Parameter:
    """Physical parameter, one line of a table.

    Attributes:
        value: a number, or a nested tuple or array of numbers; may be traced by JAX.
        unit: in SI units; "1" where there is none.
        source: source of the value.
        tolerance: relative tolerance of the physical check of a rounded printed value that would
            fail it; 0 otherwise.
    """

    value: Any
    unit: str
    source: str
    tolerance: float = 0.0

    def plain(self) -> dict[str, object]:
        """Value, unit and source as plain numbers and strings."""
        value = np.asarray(self.value).tolist() if has_values(self.value) else "traced"
        return {"value": value, "unit": self.unit, "source": self.source}


class Parameters(Mapping[str, Parameter]):
    """Immutable table of parameters, by names such as "mass.panel_7"."""

    def __init__(self, name: str, entries: Mapping[str, Parameter]) -> None:
        self.name = name
        self._entries = dict(entries)

    def __getitem__(self, key: str) -> Parameter:
        if key not in self._entries:
            raise ModelError(
                f"{self.name} has no parameter {quote_name(key)}.{self._suggest_key(key)}"
            )
        return self._entries[key]

    def __contains__(self, key: object) -> bool:
        return key in self._entries

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)

    def __repr__(self) -> str:
        return f"Parameters({self.name!r}, {len(self)} entries)"

    def _suggest_key(self, key: str) -> str:
        group = [k for k in self._entries if k.split(".")[0] == key.split(".")[0]]
        return nearest_names(key[:SHOWN], group or self._entries)

    def value(self, key: str) -> Any:
        """Value of a parameter."""
        return self[key].value

    def replaced(
        self, values: Mapping[str, Any], source: str = "given by the user"
    ) -> "Parameters":
        """Table with some values replaced; units stay.

        Args:
            values: new values by name, of the shapes of the old.

        Raises:
            ModelError: an unknown name, a wrong shape, a number that is not finite, a mass that is
                not positive, or an inertia tensor that no body can have.
        """
        entries = dict(self._entries)
        for key, value in values.items():
            old = self[key]
            _check_value(key, value, old)
            entries[key] = replace(old, value=value, source=source, tolerance=0.0)
        return Parameters(self.name, entries)

    def to_dict(self) -> dict[str, dict[str, object]]:
        """Plain numbers and strings, to be saved with results."""
        return {key: parameter.plain() for key, parameter in self._entries.items()}


def _check_value(key: str, value: Any, old: Parameter) -> None:
    subject = f"Parameter '{key}'"
    wrong = f"{subject} must be numbers [{old.unit}], not {format_value(value)}."
    if _is_other(value):
        raise ModelError(wrong)
    if not has_values(value):
        return
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError, OverflowError):
        raise ModelError(wrong) from None
    check_shape(array, np.shape(old.value), subject)
    check_finite(array, subject, old.unit)
    if old.unit == "kg" and not np.all(array > 0):
        raise ModelError(
            f"{subject} is a mass and must be positive, but it is {format_value(array.tolist())} kg."
        )
    if old.unit == "kg m^2" and array.shape == (3, 3):
        check_inertia(array, f"parameter '{key}'", old.tolerance)


def _is_other(value: Any, depth: int = 0) -> bool:
    """Test whether nested lists contain anything but numbers: text, truth values, tables."""
    if isinstance(value, list | tuple):
        return depth > _DEEPEST or any(_is_other(element, depth + 1) for element in value)
    return value is None or isinstance(value, bool | str | bytes | Mapping)
