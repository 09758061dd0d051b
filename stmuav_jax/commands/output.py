"""What every command prints at its end."""

from collections.abc import Iterable
from pathlib import Path

from rich.console import Console


def written(out: Console, paths: Iterable[Path]) -> None:
    """Say which files there are now."""
    out.print("Written:", highlight=False)
    for path in paths:
        out.print(f"  {path}", highlight=False, soft_wrap=True, markup=False, emoji=False)
