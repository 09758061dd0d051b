"""Report page of a mission's flight: verdict, errors and margins with what is allowed, figures."""

import itertools
import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import xarray as xr

from ..figures.loop_report import write_loop_report
from ..figures.page import Picture, html_table, number_text, section, text, verdict_text
from ..files.layout import flattened
from ..files.netcdf import FileError
from .figures import flight_figures
from .outcome import measures, verdict

# Captions of the figures, by name.
_WORDS = {
    "errors": "Errors of position and tilt",
    "margins": "Margins from the limits",
    "panel": "Panel angles and the pointing error",
    "rotors": "Rotor speeds, with their limits as thin lines",
    "strokes": "Displacements of the sliders, with their limits as thin lines",
    "forces": "Forces that the servo asks of the actuators, with their limits as thin lines",
    "power": "Power, and what is left in the battery",
}


def write_flight_report(
    data: xr.Dataset,
    path: str | os.PathLike[str],
    format: str = "png",
    *,
    dpi: int = 160,
    pictures: Iterable[Picture] = (),
) -> list[Path]:
    """Write a self-contained page about a mission's flight; return the paths of its files.

    Args:
        data: dataset of a flight, of `stm.load` or `stm.missions.to_data`.
        path: path of the page.
        format: format of the figures: "png", "svg" or "pdf" (files beside the page).
        dpi: resolution of the figures [dots per inch].
        pictures: figures before those of the flight.

    Raises:
        FileError: the dataset is no flight of a mission.
        SettingError: another format.
    """
    if "mission" not in data.attrs:
        raise FileError("The dataset is no flight of a mission: it has no attribute 'mission'.")
    mission = json.loads(data.attrs["mission"])
    kept, words = verdict(data)
    failure = data.attrs.get("failure", "")
    head = [
        verdict_text(words, kept and not failure),
        verdict_text(failure, False) if failure else "",
        section("Errors, margins, energy", _measures(data)),
    ]
    drawn = itertools.chain(pictures, _pictures(data))
    return write_loop_report(
        data, path, format, dpi=dpi, head=head, pictures=drawn, identity=_entries(mission)
    )


def _measures(data: xr.Dataset) -> str:
    """HTML table of what a flight is judged by."""
    rows = []
    for one in measures(data):
        allowed = "" if one.allowed is None else number_text(one.allowed)
        mark = "" if one.allowed is None else "kept" if one.kept else "not kept"
        kind = "good" if one.kept else "bad"
        rows.append([
            text(one.name), number_text(one.value), text(one.unit), allowed,
            f'<strong class="{kind}">{mark}</strong>' if mark else "",
        ])  # fmt: skip
    return html_table(["", "value", "unit", "allowed", ""], rows, left=(2, 4))


def _pictures(data: xr.Dataset) -> Iterator[Picture]:
    for name, figure in flight_figures(data).items():
        yield Picture(name, _WORDS[name], figure)


def _entries(mission: dict[str, Any]) -> list[tuple[str, Any]]:
    """Entries of a mission that say something, by dotted names."""
    names = {"name": "Mission", "t1": "End wanted [s]"}
    return [
        (names.get(name, f"Mission: {name}"), value)
        for name, value in flattened(mission)
        if value not in (None, {}, [], "") and name not in ("format", "title")
    ]
