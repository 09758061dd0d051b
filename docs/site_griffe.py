"""Extension of griffe, which reads the docstrings for the site: sections of names and their descriptions.

Docstrings give several names before one colon, and several names with their descriptions on one line.
Griffe knows neither: it takes the second name for a type, or for a part of the first description.
"""

import re
from typing import Any

import griffe

# "r, v, a: position, ..." in a section of attributes
NAMES = re.compile(r"^( +)(\w+(?:, \w+)+):", re.MULTILINE)
# "[kg]. axis: direction" or the same at the start of a continued line, by blanks that part it from its names
NEXT = re.compile(r"(?<=[.;])(?: |\n +)(\w+(?:,[ \u00a0]\w+)*): ")
SECTION = re.compile(r"^(?:Args|Attributes|Raises):\n(?: .*\n?|\n)+", re.MULTILINE)


class JoinedNames(griffe.Extension):
    """Keep names that share one description together, and part those with descriptions of their own."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Join the names of a docstring by blanks at which griffe does not part them."""
        if obj.docstring is not None:
            obj.docstring.value = NAMES.sub(self._joined, obj.docstring.value)

    def on_function(self, *, func: griffe.Function, **_: Any) -> None:
        """Give every parameter that a function describes a line of its own."""
        if func.docstring is not None:
            known = {parameter.name for parameter in func.parameters}
            func.docstring.value = parted(func.docstring.value, known)

    def on_class_members(self, *, cls: griffe.Class, **_: Any) -> None:
        """Give every attribute that a class describes a line of its own."""
        if cls.docstring is not None:
            cls.docstring.value = parted(cls.docstring.value, set(cls.members))

    def _joined(self, found: re.Match[str]) -> str:
        return found[1] + found[2].replace(" ", "\u00a0") + ":"


def parted(text: str, known: set[str]) -> str:
    """Docstring in which each of some names, and each error, begins a line in the sections about them."""

    def line(found: re.Match[str]) -> str:
        names = re.split(r",[ \u00a0]", found[1])
        joined = found[1].replace(", ", ",\u00a0")
        described = all(name in known or name.endswith("Error") for name in names)
        return f"\n    {joined}: " if described else found[0]

    return SECTION.sub(lambda section: NEXT.sub(line, section[0]), text)
