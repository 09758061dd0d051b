"""Command `stmuav view`: the moving mechanism of a saved run in the browser."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import line
from .options import Number, default
from .output import written


@dataclasses.dataclass
class View:
    """Show the moving mechanism of a saved run in the browser, or write the page to a file.

    Example: stmuav view runs/uav_tracker_2 --html flight.html --sun 135 50
    """

    run: tyro.conf.Positional[Path]
    """The file run.nc of `stmuav simulate` or flight.nc of `stmuav fly`, or its folder."""
    beside: Path | None = None
    """A second run, shown beside the first."""
    html: Annotated[Path | None, default("a temporary file, which the browser opens")] = None
    """Write the page to this file instead of opening the browser; it works without network."""
    sun: Annotated[
        tuple[float, float] | None, Number("direction of the sun", "degrees", -360, 360),
        default("no sun"),
    ] = None  # fmt: skip
    """Azimuth clockwise from north (y) and elevation of the sun [degrees]."""


def run_view(command: View) -> int:
    """Write the page, or open it; return the exit code."""
    from ..viewer.page import view

    runs = [command.run] if command.beside is None else [command.run, command.beside]
    page = view(*runs, sun=None if command.sun is None else towards_sun(*command.sun))
    out = Console()
    if command.html is not None:
        written(out, [page.save(command.html)])
        return 0
    path = page.show()
    line(out, f"If no browser has opened, open this page: {path}")
    return 0


def towards_sun(azimuth: float, elevation: float) -> tuple[float, float, float]:
    """Unit vector towards the sun in axes east, north, up; angles [degrees].

    Raises:
        SettingError: an elevation beyond -90 to 90 degrees.
    """
    if abs(elevation) > 90:
        raise SettingError(
            f"The elevation of the sun must lie within -90 and 90 degrees, but it is {elevation:g} degrees."
        )
    a, h = math.radians(azimuth), math.radians(elevation)
    return math.sin(a) * math.cos(h), math.cos(a) * math.cos(h), math.sin(h)
