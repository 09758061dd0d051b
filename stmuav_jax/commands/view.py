"""Command `stmuav view`: the moving mechanism of a saved run in the browser."""

import dataclasses
import math
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import line, row, table
from .options import Number, default, shared
from .output import written


@dataclasses.dataclass
class View:
    """Show the moving mechanism of a saved run in the browser, or write the page to a file.

    Example: stmuav view runs/uav_tracker_2 --html flight.html --sun 135 50
    """

    run: tyro.conf.Positional[Path]
    """The file run.nc of `stmuav simulate` or flight.nc of `stmuav fly`, or its folder."""
    beside: Annotated[Path | None, default("none")] = None
    """A second run, shown beside the first."""
    html: Annotated[Path | None, default("a temporary file, which the browser opens")] = None
    """File for the page, which works without network; the browser is then not opened."""
    sun: Annotated[
        tuple[float, float] | None, Number("direction of the sun", "degrees", -360, 360),
        shared("sun"), default("no sun"),
    ] = None  # fmt: skip


def run_view(command: View) -> int:
    """Write the page, or open it, and print what it shows; return the exit code."""
    from ..viewer.page import saved_run, view

    paths = [command.run] if command.beside is None else [command.run, command.beside]
    runs = [saved_run(path) for path in paths]
    page = view(*runs, sun=None if command.sun is None else towards_sun(*command.sun))
    out = Console()
    shown = table("run", "bodies", "joints", "saved times", "from [s]", "to [s]")
    for path, run in zip(paths, runs, strict=True):
        ts = run["time"].values
        sizes = (run.sizes["body"], run.sizes.get("joint", 0), len(ts))
        row(shown, path, *sizes, f"{ts[0]:g}", f"{ts[-1]:g}")
    out.print(shown)
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
