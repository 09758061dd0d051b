"""Self-contained page with the moving mechanism of one run, or of two runs side by side.

The page works without network: scripts, style and numbers are in it, and its own content security
policy forbids any request. It draws with three.js and uPlot (docs/viewer.md).
"""

import html
import json
import os
import re
import tempfile
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import xarray as xr

from ..checks.errors import SettingError
from ..checks.shapes import Numbers
from ..control.closed_loop import LoopRun
from ..dynamics.run import Run
from ..files.loop_file import loop_to_dataset
from ..files.netcdf import load, to_dataset, write_atomically
from .content import content_of
from .shapes import Shape

_PARTS = ("library.css", "viewer.css", "library.min.js", "motion.js", "machine.js", "viewer.js")


@dataclass(frozen=True)
class RunPage:
    """Self-contained page of one or two runs; a notebook shows it as the value of a cell.

    Attributes:
        html: text of the page.
        height: height in a notebook [pixels].
    """

    html: str
    height: int = 560

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the page to a file, atomically; return its path."""
        return write_atomically(path, self.html.encode())

    def show(self) -> Path:
        """Write the page to a temporary file and open it in the browser; return the file's path."""
        handle, name = tempfile.mkstemp(prefix="stmuav-view-", suffix=".html")
        os.close(handle)
        path = self.save(name)
        webbrowser.open(path.as_uri())
        return path

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.html)}" '
            f'style="width:100%;height:{self.height}px;border:0"></iframe>'
        )


def view(
    *runs: Run | LoopRun | xr.Dataset | str | os.PathLike[str],
    sun: Numbers | None = None,
    shapes: Mapping[str, Sequence[Shape]] | None = None,
) -> RunPage:
    """Page with the moving mechanism of a run, or of two runs side by side.

    Args:
        runs: one or two runs or closed loops' runs; or datasets, files or folders of saved ones.
        sun: vector towards the sun, world axes (3,), of any length; default no sun.
        shapes: shapes of bodies by name (see `Shape`); default by the dimensions in the run.

    Raises:
        FileError: a file is no saved run, or a run lacks what the page shows.
        SettingError: not one or two runs, shapes for an unknown body, or a sun without direction.
    """
    if len(runs) not in (1, 2):
        raise SettingError(f"The viewer shows one run or two side by side, not {len(runs)}.")
    content = {"runs": [content_of(dataset_of(run), sun, shapes) for run in runs]}
    titles = dict.fromkeys(each["title"] for each in content["runs"])
    # "<" within the numbers and names would end the script element
    data = json.dumps(content, separators=(",", ":")).replace("<", "\\u003c")
    parts = {name: _asset(name) for name in _PARTS}
    parts |= {"title": html.escape(" | ".join(titles)), "data": data}
    page = re.sub(r"\{\{([\w.]+)\}\}", lambda found: parts[found[1]], _asset("page.html"))
    return RunPage(page)


def dataset_of(run: Run | LoopRun | xr.Dataset | str | os.PathLike[str]) -> xr.Dataset:
    """Labelled dataset of a run: of one in memory, or of a saved one by its file or folder."""
    if isinstance(run, xr.Dataset):
        return run
    if isinstance(run, Run):
        return to_dataset(run)
    if isinstance(run, LoopRun):
        return loop_to_dataset(run)
    path = Path(run)
    if path.is_dir():
        path = next(
            (path / n for n in ("run.nc", "flight.nc") if (path / n).exists()), path / "run.nc"
        )
    return load(path)


@cache
def _asset(name: str) -> str:
    return (Path(__file__).with_name("assets") / name).read_text(encoding="utf-8")
