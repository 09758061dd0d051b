"""Extension of griffe, which reads the docstrings for the site: several names before one colon."""

import re
from typing import Any

import griffe

# "r, v, a: position, ..." in a section of attributes
NAMES = re.compile(r"^( +)(\w+(?:, \w+)+):", re.MULTILINE)


class JoinedNames(griffe.Extension):
    """Keep names that share one description together; griffe takes the second one for a type."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Join the names of a docstring by blanks at which griffe does not part them."""
        if obj.docstring is not None:
            obj.docstring.value = NAMES.sub(self._joined, obj.docstring.value)

    def _joined(self, found: re.Match[str]) -> str:
        return found[1] + found[2].replace(" ", "\u00a0") + ":"
