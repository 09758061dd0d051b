"""Command `stmuav view`: the moving mechanism of a saved run in the browser, or as a film."""

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console
from rich.table import Table

from ..checks.errors import SettingError
from ..figures.terminal import line, row, table
from .options import Number, default, shared
from .output import progressing, working, written

if TYPE_CHECKING:
    from ..viewer.page import RunPage


@dataclasses.dataclass
class View:
    """Show the moving mechanism of a saved run in the browser, or write it as a page or a film.

    Examples: stmuav view runs/uav_tracker_2 --html flight.html --sun 135 50;
    stmuav view runs/uav_tracker_2 --gif flight.gif --span 0 0.6 --playback 0.2
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
    gif: Annotated[Path | None, default("none")] = None
    """Write a film to this file, which ends with .gif, instead of opening the browser."""
    mp4: Annotated[Path | None, default("none")] = None
    """Write a film to this file, which ends with .mp4. Needs ffmpeg: the extra `film`, or on the PATH."""
    fps: Annotated[float, Number("number of frames per second", "1/s", above=0.0, high=240.0)] = (
        25.0
    )
    """Frames per second of the film; at most 50 in a GIF."""
    size: Annotated[tuple[int, int], Number("size of the film", "pixels", 64, 4096)] = (640, 480)
    """Width and height of the film [pixels]."""
    span: Annotated[
        tuple[float, float] | None, Number("span of the film", "s"), default("all of the run"),
    ] = None  # fmt: skip
    """First and last time in the film [s]."""
    eye: Annotated[tuple[float, float], Number("direction of the eye", "degrees", -360, 360)] = (
        24.0, -53.0,
    )  # fmt: skip
    """Elevation, and azimuth from x towards y, from which the film is seen [degrees]."""
    playback: Annotated[float, Number("speed of the film", "", above=0.0, high=1e6)] = 1.0
    """Seconds of the motion in a second of the film; 0.1 is slow motion."""


def run_view(command: View) -> int:
    """Write the page and films, or open the page; return the exit code."""
    films, out = _films(command), Console()
    paths = []
    if command.html is not None or not films:
        with working("Reading the run and writing the page"):
            page, shown = _page(command)
            paths += [page.save(command.html)] if command.html is not None else []
        if not films and command.html is None:
            path = page.show()
            out.print(shown)
            line(out, f"If no browser has opened, open this page: {path}")
            return 0
        out.print(shown)
    if films:
        from ..viewer.filming import film

        for target in films:
            with progressing(f"Drawing {target.name}") as progress:
                paths.append(
                    film(
                        command.run, target, fps=command.fps, size=command.size, span=command.span,
                        view=command.eye, speed=command.playback, progress=progress,
                    )
                )  # fmt: skip
    written(out, paths)
    return 0


def _films(command: View) -> list[Path]:
    """Files of the films that are asked for."""
    films = []
    for suffix in ("gif", "mp4"):
        target = getattr(command, suffix)
        if target is None:
            continue
        if target.suffix.lower() != f".{suffix}":
            raise SettingError(
                f"The file of --{suffix} must end with .{suffix}, but it is '{target.name}'."
            )
        films.append(target)
    if films and command.html is None:
        for option in ("beside", "sun"):
            if getattr(command, option) is not None:
                raise SettingError(
                    f"--{option} is for the page: a film shows one run without the sun. Give --html too, or "
                    f"leave --{option} out."
                )
    return films


def _page(command: View) -> "tuple[RunPage, Table]":
    """The page, and a table of what it shows."""
    from ..viewer.page import dataset_of, view

    paths = [command.run] if command.beside is None else [command.run, command.beside]
    runs = [dataset_of(path) for path in paths]
    page = view(*runs, sun=None if command.sun is None else towards_sun(*command.sun))
    shown = table("run", "bodies", "joints", "saved times", "from [s]", "to [s]")
    for path, run in zip(paths, runs, strict=True):
        ts = run["time"].values
        sizes = (run.sizes["body"], run.sizes.get("joint", 0), len(ts))
        row(shown, path, *sizes, f"{ts[0]:g}", f"{ts[-1]:g}")
    return page, shown


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
