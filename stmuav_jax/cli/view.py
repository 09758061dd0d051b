"""Command `stmuav view`: a run in the browser or as a film, a report of any result, a sketch of a mechanism."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import add_row, make_table, print_line
from ..uav.scenes.registry import SCENES
from .check import CheckSettings
from .options import Number, default_text, shared_option
from .output import print_paths, results_folder, show_activity, show_progress
from .scene_options import chosen_scene, command_or_scene

if TYPE_CHECKING:
    import xarray as xr


# Files of results, by the commands that write them.
NAMES = {
    "run.nc": "simulate", "flight.nc": "fly", "estimate.nc": "estimate",
    "estimate.npz": "estimate MODEL", "study.zarr": "montecarlo",
}  # fmt: skip
# Size of the report's picture of the mechanism [pixels], and the eye's elevation and azimuth [degrees].
_SIZE, _EYE = (640, 400), (24.0, -53.0)


@dataclasses.dataclass
class View:
    """Show the moving mechanism of a saved run in the browser, or write it as a page or a film; write a report
    of any result; draw a sketch of a scene or of a model's file.

    Examples: stmuav view runs/uav_tracker_2 --html flight.html --sun 135 50;
    stmuav view runs/uav_tracker_2 --gif flight.gif --span 0 0.6 --playback 0.2;
    stmuav view runs/collapse --report collapse.html; stmuav view uav_tracker --out runs/sketch
    """

    result: tyro.conf.Positional[Path]
    """File of simulate, fly, estimate or montecarlo, or its folder; or a scene or a model's file, whose sketch has
    options of its own (stmuav view SCENE --help)."""
    report: Annotated[Path | None, default_text("none")] = None
    """Write a report of the result to this file, a page with verdict, tables and figures, which works without
    network."""
    beside: Annotated[Path | None, default_text("none")] = None
    """A second run, shown next to the first."""
    html: Annotated[Path | None, default_text("a temporary file, which the browser opens")] = None
    """File for the page, which works without network; the browser is then not opened."""
    sun: Annotated[
        tuple[float, float] | None,
        Number("direction of the sun", "degrees", -360, 360),
        shared_option("sun", "no sun"),
    ] = None
    gif: Annotated[Path | None, default_text("none")] = None
    """Write a film to this file, which ends with .gif, instead of opening the browser."""
    mp4: Annotated[Path | None, default_text("none")] = None
    """Write a film to this file, which ends with .mp4. Needs ffmpeg: the extra `film`, or on the PATH."""
    fps: Annotated[float, Number("number of frames per second", "1/s", above=0.0, high=240.0)] = (
        25.0
    )
    """Frames per second of the film; at most 50 in a GIF."""
    size: Annotated[tuple[int, int], Number("size of the film", "pixels", 64, 4096)] = (640, 480)
    """Width and height of the film [pixels]."""
    span: Annotated[
        tuple[float, float] | None, Number("span of the film", "s"), default_text("all of the run")
    ] = None
    """First and last time in the film [s]."""
    eye: Annotated[tuple[float, float], Number("direction of the eye", "degrees", -360, 360)] = (
        24.0, -53.0,
    )  # fmt: skip
    """Elevation, and azimuth from x towards y, from which the film is seen [degrees]."""
    playback: Annotated[float, Number("speed of the film", "", above=0.0, high=1e6)] = 1.0
    """Seconds of the motion in a second of the film; 0.1 is slow motion."""


@dataclasses.dataclass
class SketchSettings(CheckSettings):
    """Options of a sketch, which all scenes share."""

    out: Annotated[
        Path | None, shared_option("out", "that of simulate: runs/SCENE_CASE or runs/MODEL")
    ] = None
    figures: Annotated[Literal["png", "pdf", "svg"], shared_option("figures")] = "png"


SKETCH = """Draw a scene or a model's file: bodies, joints, frames, and the graph of the joints.

Example: stmuav view uav_tracker writes runs/uav_tracker_2/mechanism.png, beside the results of simulate (2 is the
case); stmuav view docs/models/four_bar.toml --out sketches writes sketches/mechanism.png. The table lists the joints,
and says which of them close loops of the mechanism.
"""

_result_or_scene = command_or_scene(View, "ViewScene", SketchSettings, SKETCH)


def view_options(arguments: Sequence[str]) -> type:
    """The command for tyro: of a result, also one in a folder that has the name of a scene, or of a scene."""
    is_folder = any(Path(word).is_dir() for word in arguments if word in SCENES)
    return View if is_folder else _result_or_scene(arguments)


def run_view(command: Any) -> int:
    """Write report, page, films or sketch, or open the page; return the exit code."""
    if not isinstance(command, View):
        return _run_sketch(command)
    targets = {suffix: getattr(command, suffix) for suffix in ("gif", "mp4")}
    films = {suffix: target for suffix, target in targets.items() if target is not None}
    for suffix, target in films.items():
        if target.suffix.lower() != f".{suffix}":
            raise SettingError(
                f"The file of --{suffix} must end with .{suffix}, but it is '{target.name}'."
            )
    for option in ("beside", "sun"):
        if films and command.html is None and getattr(command, option) is not None:
            raise SettingError(
                f"--{option} is for the page: a film shows one run without the sun. Give --html too, or "
                f"leave --{option} out."
            )
    out, paths = Console(), []
    if command.report is not None:
        with show_activity("Reading the result and drawing"):
            paths.append(_write_report(command.result, command.report))
    if command.html is not None or not (films or paths):
        with show_activity("Reading the run and writing the page"):
            # The page holds its data and scripts, so that it can be sent to someone without this package.
            from ..figures.page import dataset_of, view

            sources = [command.result, *([] if command.beside is None else [command.beside])]
            runs = [dataset_of(path) for path in sources]
            page = view(*runs, sun=None if command.sun is None else towards_sun(*command.sun))
            paths += [page.save(command.html)] if command.html is not None else []
        run_table = make_table("run", "bodies", "joints", "saved times", "from [s]", "to [s]")
        for path, run in zip(sources, runs, strict=True):
            ts = run["time"].values
            sizes = (run.sizes["body"], run.sizes.get("joint", 0), len(ts))
            add_row(run_table, path, *sizes, f"{ts[0]:g}", f"{ts[-1]:g}")
        out.print(run_table)
        if command.html is None:
            print_line(out, f"If no browser has opened, open this page: {page.show()}")
            return 0
    if films:
        from ..figures.films import film

        for target in films.values():
            with show_progress(f"Drawing {target.name}") as progress:
                paths.append(
                    film(
                        command.result, target, fps=command.fps, size=command.size, span=command.span,
                        view=command.eye, speed=command.playback, progress=progress,
                    )
                )  # fmt: skip
    print_paths(out, paths)
    return 0


def _run_sketch(command: Any) -> int:
    """Draw the mechanism of a scene, print its joints and write the picture; return the exit code."""
    from ..dynamics.tree.topology import spanning_tree
    from ..figures.plot import save_figures
    from ..figures.sketch import draw

    scene, settings = chosen_scene(command), command.settings
    folder = results_folder(settings.out, scene.name)
    paths = save_figures({"mechanism": draw(scene)}, folder, settings.figures)
    closing = set(spanning_tree(scene.system).cut)
    heads = ("joint", "kind", "from", "to", "graph")
    joint_table = make_table(*heads, title=scene.title or scene.name)
    for k, joint in enumerate(scene.system.joints):
        place, kind = "closes a loop" if k in closing else "spanning tree", joint.kind
        kind = kind.replace("_", " ")
        add_row(joint_table, joint.name, kind, joint.body_i, joint.body_j, place)
    out = Console()
    out.print(joint_table)
    print_paths(out, paths)
    return 0


# --- reports


def _write_report(source: Path, target: Path) -> Path:
    """Write the report of a result; return its path."""
    from ..figures.filter_record import load_record
    from ..figures.report import write_report
    from ..io.netcdf import regular_file
    from ..studies.store import open_store

    source = find_result(source)
    if source.is_dir():
        with open_store(source) as store:
            store.verify()
            return write_report(store.dataset(), target)
    with regular_file(source).open("rb") as file:
        # The first bytes decide, not the name: users rename their files.
        begin = file.read(2)
    if begin == b"PK":
        return write_report(load_record(source), target)
    data = _load_dataset(source)
    return write_report(data, target, **_mission_content(data))


def _mission_content(data: "xr.Dataset") -> dict[str, Any]:
    """Verdict, table and figures of a report: the mechanism of any run, and what a mission's flight has more."""
    from ..figures.films import draw_mechanism
    from ..figures.page import check_viewable, finite_times
    from ..figures.report import ReportTable
    from ..missions.figures import flight_figures
    from ..missions.outcome import measures, verdict

    if "position" not in data or "body" not in data.dims:
        return {}
    figures = []
    check_viewable(data)
    ts = data["time"].values[finite_times(data)]
    if len(ts) > 1:
        figure, draw = draw_mechanism(data, ts, _SIZE, _EYE)
        draw(len(ts) - 1)
        figures.append((f"The mechanism at t = {ts[-1]:g} s, and its path", figure))
    if "mission" not in data.attrs:
        return {"figures": figures}
    is_success, sentence = verdict(data)
    failure = data.attrs.get("failure", "")
    rows = [
        (measure.name, measure.text, "" if measure.allowed is None else f"{measure.allowed:g}",
         "" if measure.allowed is None else "met" if measure.is_met else "not met")
        for measure in measures(data)
    ]  # fmt: skip
    figures += [(name.capitalize(), figure) for name, figure in flight_figures(data).items()]
    return {
        "verdict": (f"{sentence} {failure}".strip(), is_success and not failure),
        "tables": [ReportTable("Errors, margins, energy", ("", "value", "allowed", ""), rows)],
        "figures": figures,
    }


def find_result(path: Path) -> Path:
    """File or store of a result: the path itself, or the one that its folder holds.

    Raises:
        FileError: there is nothing, or none or several results of the names in `NAMES`.
    """
    from ..io.netcdf import FileError

    valid = ", ".join(f"{name} (of stmuav {command})" for name, command in NAMES.items())
    if not path.exists():
        raise FileError(f"There is no file or folder {path}. A report needs {valid}.")
    if not path.is_dir() or (path / "zarr.json").exists():
        return path
    # The folder of a command's results names the file for the user, unless it holds several.
    results = [name for name in NAMES if (path / name).exists()]
    if len(results) == 1:
        return path / results[0]
    if results:
        raise FileError(
            f"{path} holds several results: {', '.join(results)}. Name one, such as {path / results[0]}."
        )
    raise FileError(f"{path} contains no result. A report needs {valid}.")


def _load_dataset(source: Path) -> "xr.Dataset":
    """Dataset of a NetCDF file of this package; runs and flights are verified by their seals."""
    import io

    import xarray as xr

    from ..figures.filter_record import FORMAT
    from ..io.netcdf import FileError, is_sealed, load

    if is_sealed(source):
        return load(source)
    try:
        with xr.open_dataset(io.BytesIO(source.read_bytes()), engine="h5netcdf") as dataset:
            data = dataset.load()
    # HDF5 has many errors for files that are damaged
    except Exception as error:
        raise FileError(
            f"{source} cannot be read: it is damaged or no result ({type(error).__name__})."
        ) from error
    if data.attrs.get("format", "") != FORMAT:
        raise FileError(
            f"{source} is damaged, truncated or from another program. A report needs {', '.join(NAMES)}."
        )
    return data


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
