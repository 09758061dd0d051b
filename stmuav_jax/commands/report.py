"""Command `stmuav report`: a page about a run, a flight, a filter's record or a study."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from ..figures.terminal import line
from .options import default, shared
from .output import written

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    import xarray as xr

    from ..figures.filter_record import FilterRecord
    from ..figures.page import Picture

# Files of results that have a report, by the commands that write them.
NAMES = {
    "run.nc": "simulate", "flight.nc": "fly", "estimate.nc": "estimate", "hover.nc": "estimate --hover",
    "estimate.npz": "estimate MODEL", "study.zarr": "montecarlo",
}  # fmt: skip
# Size of the picture of the mechanism [pixels], and the eye's elevation and azimuth [degrees], as of a film.
_SIZE, _EYE = (640, 400), (24.0, -53.0)
_ESTIMATE = "stmuav_jax estimate"
_HDF5, _ZIP = b"\x89HDF\r\n\x1a\n", b"PK"


@dataclasses.dataclass
class Report:
    """Make a self-contained page from the results of simulate, fly, estimate or montecarlo.

    Examples: stmuav report runs/uav_tracker_2; stmuav report runs/case-1/flight.nc --out pages;
    stmuav report runs/estimate_4; stmuav report runs/collapse/study.zarr --figures svg. The page works without network.
    Figures in png and svg are in it; those in pdf lie beside it.
    """

    results: tyro.conf.Positional[Path]
    """The file run.nc, flight.nc, estimate.nc, hover.nc or estimate.npz, the folder study.zarr, or a folder
    that holds one of these."""
    out: Annotated[Path | None, shared("out"), default("beside the results")] = None
    figures: Annotated[Literal["png", "pdf", "svg"], shared("figures")] = "png"


def run_report(command: Report) -> int:
    """Write the page, and print what it is about; return the exit code."""
    out, source = Console(), found_results(command.results)
    folder = command.out if command.out is not None else source.resolve().parent
    if source.is_dir():
        from .montecarlo import report_study

        written(out, report_study(source, folder, command.figures, out))
        return 0
    words, write = _writer(source)
    line(out, words)
    written(out, write(folder / "report.html", command.figures))
    return 0


def found_results(path: Path) -> Path:
    """File or store of the results: the path itself, or the one that its folder holds.

    Raises:
        FileError: there is nothing, or none or several results of the names in `NAMES`.
    """
    from ..files.netcdf import FileError

    valid = ", ".join(f"{name} (of stmuav {command})" for name, command in NAMES.items())
    if not path.exists():
        raise FileError(f"There is no file or folder {path}. A report is made of {valid}.")
    if not path.is_dir() or (path / "zarr.json").exists():
        return path
    there = sorted(each.name for each in path.iterdir())
    found = [name for name in NAMES if name in there]
    if len(found) == 1:
        return path / found[0]
    if found:
        raise FileError(
            f"{path} holds several results: {', '.join(found)}. Name one, such as {path / found[0]}."
        )
    holds = ", ".join(there[:5]) + (f" and {len(there) - 5} more" if there[5:] else "")
    raise FileError(f"{path} holds {holds or 'nothing'}. A report is made of {valid}.")


def _writer(source: Path) -> "tuple[str, Callable[[Path, Any], list[Path]]]":
    """Sentence on what a file is, and the function that writes its page.

    Raises:
        FileError: the file is damaged, or of a kind that has no report.
    """
    from ..files.netcdf import FORMAT, FileError

    with source.open("rb") as file:
        begin = file.read(len(_HDF5))
    if begin.startswith(_ZIP):
        from ..figures.filter_record import record_of_file

        return _of_filters(record_of_file(source))
    if begin != _HDF5:
        valid = ", ".join(name for name in NAMES if name != "study.zarr")
        what = f"begins with {begin!r}" if begin else "is empty"
        raise FileError(
            f"{source} is no file of results: it {what}. A report is made of the files {valid} and of the "
            "folder study.zarr."
        )
    data = _dataset(source)
    if data.attrs["format"] == _ESTIMATE:
        from ..figures.filter_record import record_of_dataset

        return _of_filters(record_of_dataset(data))
    title, drawn = data.attrs.get("title") or data.attrs.get("scene", ""), _mechanism(data)
    if data.attrs["format"] == FORMAT:
        from ..figures.run_report import write_run_report

        return f"Run: {title}.", lambda path, kind: write_run_report(
            data, path, kind, pictures=drawn
        )
    if "mission" in data.attrs:
        from ..missions.report import write_flight_report

        return f"Flight: {title}.", lambda path, kind: write_flight_report(
            data, path, kind, pictures=drawn
        )
    from ..figures.loop_report import write_loop_report

    return f"Closed loop: {title}.", lambda path, kind: write_loop_report(
        data, path, kind, pictures=drawn
    )


def _mechanism(data: "xr.Dataset") -> "Iterator[Picture]":
    """Picture of the mechanism at the last time with finite poses, if there are two."""
    from ..figures.page import Picture
    from ..viewer.content import check_viewable, finite_times
    from ..viewer.stage import Stage

    check_viewable(data)
    ts = data["time"].values[finite_times(data)]
    if len(ts) > 1:
        span = (float(ts[0]), float(ts[-1]))
        stage = Stage(data, _SIZE, _EYE, span)
        stage.draw(span[1])
        yield Picture(
            "mechanism", f"The mechanism at t = {span[1]:g} s, and its way there", stage.figure
        )


def _of_filters(record: "FilterRecord") -> "tuple[str, Callable[[Path, Any], list[Path]]]":
    from ..figures.filter_report import write_filter_report

    return f"Filters: {record.title}.", lambda path, kind: write_filter_report(record, path, kind)


def _dataset(source: Path) -> "xr.Dataset":
    """Dataset of a NetCDF file of this package; runs and flights are verified by their seals."""
    import io

    import xarray as xr

    from ..files.netcdf import FileError, is_sealed, load

    if is_sealed(source):
        return load(source)
    try:
        with xr.open_dataset(io.BytesIO(source.read_bytes()), engine="h5netcdf") as dataset:
            data = dataset.load()
    # HDF5 has many errors for files that are damaged
    except Exception as error:
        raise FileError(
            f"{source} cannot be read: it is damaged ({type(error).__name__})."
        ) from error
    kind = data.attrs.get("format", "")
    if kind == _ESTIMATE:
        return data
    if kind.startswith("stmuav_jax"):
        raise FileError(f"{source} is damaged: it was cut, or changed since it was saved.")
    raise FileError(
        f"{source} is a NetCDF file of another program: it has the variables {', '.join(map(str, data))[:200]}. "
        f"A report is made of {', '.join(NAMES)}."
    )
