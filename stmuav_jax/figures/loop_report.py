"""Report page of a closed loop's saved run: outcome, numbers, certificate, figures."""

import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..files.netcdf import LOOP_FORMAT, FileError
from .numbers import saved_numbers
from .page import Picture, entries_table, section, verdict_text, write_page
from .plot import curves, grid
from .run_report import about_parts, motion_rows, numbers_table, run_pictures

# Largest number of curves in a panel: each has a style of its own.
_CURVES = 4
# Words and unit of the entries of a loop's certificate.
_ENTRIES = {
    "position_violation": ("Constraint violation, lengths", "m"),
    "angle_violation": ("Constraint violation, angles", "rad"),
    "velocity_violation": ("Violation of the lengths' rates", "m/s"),
    "angular_velocity_violation": ("Violation of the angles' rates", "rad/s"),
    "norm_violation": ("Violation of the Euler parameters' norm", ""),
    "relative_energy_error": ("Energy balance, of the largest energy", ""),
    "position_difference": ("Difference from half as long steps, positions", "m"),
    "angle_difference": ("Difference from half as long steps, orientations", "rad"),
    "compile_seconds": ("Time to compile", "s"),
    "run_seconds": ("Time to run", "s"),
}


def write_loop_report(
    data: xr.Dataset,
    path: str | os.PathLike[str],
    format: str = "png",
    *,
    dpi: int = 160,
    head: Iterable[str] | None = None,
    pictures: Iterable[Picture] = (),
    identity: Iterable[tuple[str, Any]] = (),
) -> list[Path]:
    """Write a self-contained page about a closed loop's saved run; return the paths of its files.

    Args:
        data: dataset of a closed loop, of `stm.load` or `stm.files.loop_to_dataset`.
        path: path of the page.
        format: format of the figures: "png", "svg" or "pdf" (files beside the page).
        dpi: resolution of the figures [dots per inch].
        head: parts of the page, HTML already, in place of the sentence on the outcome.
        pictures: figures before those of the motion.
        identity: names and values of what was run, before those of the loop.

    Raises:
        FileError: the dataset is no run of a closed loop.
        SettingError: another format.
    """
    if data.attrs.get("format") != LOOP_FORMAT:
        raise FileError(
            f"The dataset is no run of a closed loop: its format is '{data.attrs.get('format', '')}', "
            f"not '{LOOP_FORMAT}'."
        )
    certificate, numbers = json.loads(data.attrs["certificate"]), saved_numbers(data)
    title = data.attrs.get("title") or data.attrs.get("scene") or "Run of a closed loop"
    failure = data.attrs.get("failure", "")
    words = failure or f"The loop ran to its end at t = {certificate['t_end']:g} s."
    first = [verdict_text(words, not failure)] if head is None else head
    ts = data["time"].values
    about = [
        *identity,
        ("Samples", f"{len(ts):,}, from {ts[0]:g} s to {ts[-1]:g} s, {float(data.attrs['rate']):g} in a second"),
        ("Inputs", ", ".join(map(str, data["input"].values))),
        ("Bodies", ", ".join(map(str, data["body"].values))),
        ("Date", data.attrs.get("date", "")),
    ]  # fmt: skip
    before = [
        *first,
        section("Numbers of the motion", numbers_table(motion_rows(numbers))),
        section("Certificate", entries_table(_certificate_rows(certificate))),
    ]
    after = [section("What was run", entries_table(about)), *about_parts(data)]
    return write_page(title, before, _pictures(data, pictures), after, path, format, dpi)


def _pictures(data: xr.Dataset, before: Iterable[Picture]) -> Iterator[Picture]:
    """Figures of a loop, one at a time; each name once."""
    shown = set()
    for picture in before:
        shown.add(picture.name)
        yield picture
    for picture in run_pictures(data, saved_numbers(data), None):
        if picture.name not in shown:
            yield picture
    if data.sizes.get("input", 0):
        yield Picture("inputs", "Inputs from the controller", inputs_figure(data))


def _certificate_rows(certificate: Mapping[str, Any]) -> list[tuple[str, str]]:
    rows = [("Result", f"{certificate['result']} at t = {certificate['t_end']:g} s")]
    for name, (words, unit) in _ENTRIES.items():
        value = certificate.get(name)
        said = "not computed" if value is None else f"{value:.3g} {unit}".rstrip()
        rows.append((words, said))
    speed = certificate.get("speed")
    rows.append(
        ("Steps, of them rejected", f"{certificate['steps']:,}, {certificate['rejected_steps']:,}")
    )
    if speed is not None and math.isfinite(speed):
        rows.append(("Time simulated per time of computing", f"{speed:.3g}"))
    return rows


def inputs_figure(data: xr.Dataset) -> Figure:
    """Figure of the inputs of a closed loop over time, with one unit to a panel."""
    units = [str(unit) for unit in data["input_unit"].values]
    names = [str(name) for name in data["input"].values]
    panels: list[tuple[str, list[int]]] = []
    for unit in dict.fromkeys(units):
        own = [k for k, each in enumerate(units) if each == unit]
        panels += [(unit, own[k : k + _CURVES]) for k in range(0, len(own), _CURVES)]
    figure, axes = grid(len(panels), 1, 0.9 + 1.9 * len(panels), sharex=True)
    ts, values = data["time"].values, data["command"].values
    for k, (ax, (unit, own)) in enumerate(zip(axes[:, 0], panels, strict=True)):
        labels = [f"{names[n]} {n + 1}" if names.count(names[n]) > 1 else names[n] for n in own]
        curves(ax, ts, np.asarray(values[:, own]), tuple(labels))
        ax.set_ylabel(f"input [{unit}]", fontsize=9, parse_math=False)
        ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        ax.set_xlabel("time [s]" if k == len(panels) - 1 else "", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(str(data.attrs.get("title", "")), fontsize=10, parse_math=False)
    return figure
