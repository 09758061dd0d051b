"""Report page of a saved run: what was run, how good it is, its numbers, its figures."""

import itertools
import json
import math
import os
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..files.layout import flattened
from ..files.netcdf import FORMAT, FileError
from .numbers import NOTHING, Numbers, SavedLoads, saved_loads, saved_numbers
from .page import (
    Picture,
    entries_table,
    folded,
    html_table,
    number_text,
    section,
    text,
    verdict_text,
    write_page,
)
from .plot import DRAWN, curves, grid
from .report import certificate_from, rows_of

# Captions of the figures, by name.
_WORDS = {
    "pose": "Position, tilt and angular velocity of the base",
    "joints": "Strokes and angles of the joints",
    "balances": "Energies, estimated error and constraint violations",
}
# Largest number of joints with reaction loads in one figure.
_JOINTS = 10
# Number in a table: words, value, unit.
Row = tuple[str, float | str, str]


def write_run_report(
    data: xr.Dataset,
    path: str | os.PathLike[str],
    format: str = "png",
    *,
    dpi: int = 160,
    pictures: Iterable[Picture] = (),
) -> list[Path]:
    """Write a self-contained page about a saved run of a scene; return the paths of its files.

    The page contains its figures (png, svg), or refers to them in a folder beside it (pdf).

    Args:
        data: dataset of a run, of `stm.load` or `stm.files.to_dataset`.
        path: path of the page.
        format: format of the figures: "png", "svg" or "pdf".
        dpi: resolution of the figures [dots per inch].
        pictures: figures before those of the run.

    Raises:
        FileError: the dataset is no run of a scene.
        SettingError: another format.
    """
    if data.attrs.get("format") != FORMAT:
        raise FileError(
            f"The dataset is no run of a scene: its format is '{data.attrs.get('format', '')}', not "
            f"'{FORMAT}'."
        )
    plain, numbers, loads = (
        json.loads(data.attrs["certificate"]),
        saved_numbers(data),
        saved_loads(data),
    )
    certificate = certificate_from(plain)
    title = data.attrs.get("title") or data.attrs.get("scene", "")
    head = [
        verdict_text(_verdict(plain), plain["result"] in ("successful", "event occurred")),
        *(f"<p>Note: {text(note)}</p>" for note in json.loads(data.attrs.get("notes", "[]"))),
        section("Numbers", numbers_table(motion_rows(numbers) + load_rows(loads))),
        section("Certificate", entries_table(rows_of(certificate))),
    ]
    tail = [section("What was run", _identity(data)), *about_parts(data)]
    drawn = itertools.chain(pictures, run_pictures(data, numbers, loads))
    return write_page(title, head, drawn, tail, path, format, dpi)


def _verdict(certificate: Mapping[str, Any]) -> str:
    """Sentences on the quality of a run, from the plain data of its certificate."""
    c = {k: math.nan if v is None else v for k, v in certificate.items()}
    end = f"{c['t_end']:g} s"
    if c["result"] == "successful":
        words = f"The run reached its end at t = {end}."
    elif c["result"] == "event occurred":
        words = f"The run ended by an event at t = {end}."
    else:
        words = f"The run did not reach its end: it stopped at t = {end}, {c['result']}."
    if math.isfinite(c["position_error"]):
        words += (
            f" Its distance from the exact motion is estimated as at most {c['position_error']:.2g} m and "
            f"{c['angle_error']:.2g} rad."
        )
    words += (
        f" Constraints hold within {c['position_violation']:.2g} m and {c['angle_violation']:.2g} rad, "
        f"the energy balance within {c['relative_energy_error']:.2g} of the largest energy."
    )
    return f"{words} {certificate['error_words']}".strip()


def _identity(data: xr.Dataset) -> str:
    """HTML table of the scene, the method and the times of a run."""
    ts = data["time"].values
    entries: list[tuple[str, Any]] = [
        ("Scene", data.attrs.get("scene", "")),
        ("Saved times", f"{len(ts):,}, from {ts[0]:g} s to {ts[-1]:g} s"),
        ("Bodies", ", ".join(map(str, data["body"].values))),
    ]
    for name, value in flattened(json.loads(data.attrs.get("settings", "{}"))):
        entries.append((f"Method: {name.replace('_', ' ')}", value))
    return entries_table([*entries, ("Date", data.attrs.get("date", ""))])


# --- parts that the reports of runs and of flights share


def about_parts(data: xr.Dataset) -> list[str]:
    """Sections with the parameters that were changed, all others, and the versions."""
    given = json.loads(data.attrs.get("parameters", "{}"))
    changed = {k: v for k, v in given.items() if str(v.get("source", "")).startswith("given")}
    others = {k: v for k, v in given.items() if k not in changed}
    versions = json.loads(data.attrs.get("versions", "{}"))
    said = "<p>None: all have the values of the scene's table.</p>" if given else ""
    return [
        section("Parameters that were changed", _parameters(changed) or said),
        folded(f"The other {len(others)} parameters", _parameters(others)) if others else "",
        section("Versions", entries_table(versions.items())),
    ]


def _parameters(given: Mapping[str, Mapping[str, Any]]) -> str:
    rows = [
        [text(name), text(_values(one["value"])), text(one.get("unit", "")), text(one.get("source", ""))]
        for name, one in given.items()
    ]  # fmt: skip
    return html_table(["", "value", "unit", "source"], rows, left=(1, 3)) if rows else ""


def _values(value: Any) -> str:
    flat = np.asarray(value).ravel()
    if flat.dtype.kind not in "if":
        return str(value)
    said = ", ".join(f"{x:.6g}" for x in flat[:9])
    return said if len(flat) <= 9 else f"{said}, ... ({len(flat):,} in all)"


def numbers_table(rows: Iterable[Row]) -> str:
    """HTML table of numbers with units; empty without rows."""
    cells = [
        [text(words), value if isinstance(value, str) else number_text(value), text(unit)]
        for words, value, unit in rows
    ]
    return html_table(["", "value", "unit"], cells, left=(2,)) if cells else ""


def motion_rows(numbers: Numbers) -> list[Row]:
    """Largest tilt, distances and speeds of the base, and ranges of the joints."""
    _, name, ts, r, tilt, omega = numbers["pose"]
    base = name.replace("_", " ")
    off = np.linalg.norm(r - r[0], axis=1)
    rows: list[Row] = [
        ("Time at the end", float(ts[-1]), "s"),
        (f"Largest distance of {base} from its start", largest(off), "m"),
        (f"Distance of {base} from its start at the end", float(off[-1]), "m"),
        (f"Largest tilt of {base}", largest(tilt), "degrees"),
        (f"Largest angular velocity of {base}", largest(np.linalg.norm(omega, axis=1)), "rad/s"),
    ]
    for words, labels, values in numbers["joints"][2] if "joints" in numbers else ():
        what, unit = words.rstrip("]").rsplit(" [", 1)
        for k, label in enumerate(labels):
            plain = label.strip("$").replace("\\varphi", "phi").replace("\\theta", "theta")
            low, high = -largest(-values[:, k]), largest(values[:, k])
            said = f"{number_text(low)} to {number_text(high)}"
            rows.append((f"{what.capitalize()}: {plain}, smallest and largest", said, unit))
    return rows


def largest(values: np.ndarray) -> float:
    """Largest finite entry; NaN without one."""
    finite = values[np.isfinite(values)]
    return float(np.max(finite)) if finite.size else math.nan


def load_rows(loads: SavedLoads | None) -> list[Row]:
    """Largest reaction force and moment over all joints, and where they act."""
    if loads is None:
        return []
    rows: list[Row] = []
    for words, values, unit in (("force", loads.force, "N"), ("moment", loads.moment, "N m")):
        size = np.linalg.norm(values, axis=-1)
        if largest(size) > NOTHING:
            k, joint = np.unravel_index(np.nanargmax(size), size.shape)
            where = f"at {loads.joints[joint]}, t = {float(loads.ts[k]):.4g} s"
            said = f"Largest reaction {words} at a saved time, {where}"
            rows.append((said, float(size[k, joint]), unit))
    return rows


def run_pictures(data: xr.Dataset, numbers: Numbers, loads: SavedLoads | None) -> Iterator[Picture]:
    """Figures of a saved run, one at a time."""
    for name, words in _WORDS.items():
        if name in numbers:
            yield Picture(name, words, DRAWN[name](*numbers[name]))
    title = str(data.attrs.get("title", ""))
    count = 0 if loads is None else len(loads.joints)
    for first in range(0, count, _JOINTS):
        assert loads is not None
        part = slice(first, first + _JOINTS)
        some = SavedLoads(loads.ts, loads.force[:, part], loads.moment[:, part], loads.joints[part])
        words = "Reaction loads of the joints at the saved times"
        words += (
            "" if count <= _JOINTS else f", {first + 1} to {min(first + _JOINTS, count)} of {count}"
        )
        yield Picture(f"loads_{first // _JOINTS + 1}", words, DRAWN["loads"](title, some))
    if "rotor_speed" in data:
        yield Picture("rotors", "Speeds of the rotors", _rotors(data, title))


def _rotors(data: xr.Dataset, title: str) -> Any:
    """Figure of the rotor speeds, four to a panel."""
    speeds = data["rotor_speed"].values
    rows = -(-speeds.shape[1] // 4)
    figure, axes = grid(rows, 1, 0.9 + 2.1 * rows, sharex=True)
    for k, ax in enumerate(axes[:, 0]):
        part = range(4 * k, min(4 * k + 4, speeds.shape[1]))
        curves(
            ax, data["time"].values, speeds[:, list(part)], tuple(f"rotor {n + 1}" for n in part)
        )
        ax.set_ylabel("rotor speed [rad/s]", fontsize=9)
        ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
        ax.set_xlabel("time [s]" if k == rows - 1 else "", fontsize=9)
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure
