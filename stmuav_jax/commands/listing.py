"""`stmuav list`: the scenes."""

import dataclasses

from rich.console import Console

from ..figures.terminal import row, table
from ..scenes.registry import SCENES


@dataclasses.dataclass
class List:
    """List the scenes, their cases and where the report describes them.

    Example: stmuav list
    """


def run_list(_: List) -> int:
    """Print the scenes; the exit code."""
    shown = table("scene", "cases", "what it is", "report", "end [s]")
    for name, entry in SCENES.items():
        cases = ", ".join(map(str, entry.cases)) or "-"
        row(shown, name, cases, entry.summary, entry.source, f"{entry.t1:g}")
    Console().print(shown)
    return 0
