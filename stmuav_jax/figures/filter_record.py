"""Records of filters with known truth, as the files of `stmuav estimate` hold them."""

import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ..estimation.consistency import mean_interval
from ..files.netcdf import FileError, now, versions

if TYPE_CHECKING:
    import xarray as xr

# Format of the datasets of estimate.nc and hover.nc.
FORMAT = "stmuav_jax estimate"
FORMAT_VERSION = 1

# Level of the intervals in which consistent filters stay.
LEVEL = 0.999
# Entries of estimate.npz that a record needs.
_ARRAYS = ("states", "t", "error", "deviation", "nees", "nis", "degrees", "ok")
_UNITS = {"Omega": "rad/s", "offset": "m"}


class FilterRecord(NamedTuple):
    """Filters of d tunings over s seeds of their noise, at T times.

    Attributes:
        title: what was estimated. t: times (T,) [s]. tunings: their names.
        states: "name [unit]" of the n states.
        error, deviation: estimates less truth, and the filters' standard deviations (d, T, n, s).
        truth: true states (d, T, n, s); None where only errors were kept.
        nees, nis: normalised errors and innovations squared (d, T, s).
        size: degrees of freedom of NEES. degrees: those of NIS at each time (d, T).
        innovation: normalised innovations (d, T, m, s), NaN where missing; None in older files.
        ok: whether the filters kept their covariances (d, s).
        summaries: what was found of each tuning, by its name.
        about: options and other plain data on what was run.
        versions: versions of the software.
    """

    title: str
    t: np.ndarray
    tunings: tuple[str, ...]
    states: tuple[str, ...]
    error: np.ndarray
    deviation: np.ndarray
    truth: np.ndarray | None
    nees: np.ndarray
    nis: np.ndarray
    size: int
    degrees: np.ndarray
    innovation: np.ndarray | None
    ok: np.ndarray
    summaries: Mapping[str, Mapping[str, Any]]
    about: Mapping[str, Any]
    versions: Mapping[str, str]


class Consistency(NamedTuple):
    """Mean of a chi-squared quantity of consistent filters, and the interval that it should be in."""

    what: str
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """True within the interval."""
        return bool(self.low < self.value < self.high)

    @property
    def words(self) -> str:
        """Sentence with the numbers."""
        return (
            f"{self.what}: {self.value:.4g}, consistent within {self.low:.4g} and {self.high:.4g}."
        )


def end_consistency(
    nees: np.ndarray, size: int, nis: np.ndarray, degrees: np.ndarray
) -> list[Consistency]:
    """Mean NEES at the end over the seeds, and mean NIS per measured number, with their intervals.

    Args:
        nees, nis: (T, s). size: degrees of freedom of NEES. degrees: those of NIS (T,).
    """
    seeds, readings = nees.shape[1], int(np.sum(degrees))
    found = [
        Consistency("NEES at the end", float(nees[-1].mean()), *mean_interval(size, seeds, LEVEL))
    ]
    if readings:
        value = float(nis.sum() / readings / seeds)
        found.append(Consistency("NIS", value, *mean_interval(1, seeds * readings, LEVEL)))
    return found


def normalised_innovations(found: Any) -> np.ndarray:
    """Normalised innovations (T, m, ...) of a filter, NaN where a reading is missing."""
    normalised, measured = np.asarray(found.normalised), np.asarray(found.measured)
    there = measured.reshape(measured.shape + (1,) * (normalised.ndim - measured.ndim))
    return np.where(there, normalised, np.nan)


def record_content(
    title: str,
    names: Sequence[tuple[str, str]],
    arrays: Mapping[str, Any],
    about: Mapping[str, Any],
) -> bytes:
    """Content of estimate.npz: arrays, names of the states with units, and what was run as JSON."""
    said = {"title": title, "about": dict(about), "versions": versions(), "date": now()}
    states = np.array([f"{name} [{unit}]" for name, unit in names])
    content = io.BytesIO()
    np.savez(content, states=states, head=np.array(json.dumps(said)), **arrays)
    return content.getvalue()


def record_of_file(path: str | os.PathLike[str]) -> FilterRecord:
    """Record of a file estimate.npz, as `stmuav estimate MODEL` writes it.

    Raises:
        FileError: the file is damaged or holds something else.
    """
    source = Path(path)
    try:
        with np.load(source, allow_pickle=False) as file:
            found = {name: file[name] for name in file.files}
            head = json.loads(str(found.get("head", "{}")))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(f"{source} is damaged or no npz file ({type(error).__name__}).") from error
    missing = [name for name in _ARRAYS if name not in found]
    if missing:
        raise FileError(
            f"{source} is no record of filters: it holds {', '.join(found) or 'nothing'}, and lacks "
            f"{', '.join(missing)}."
        )
    many = lambda name: found[name][None]
    innovation = many("innovation") if "innovation" in found else None
    return FilterRecord(
        head.get("title", source.parent.name), found["t"], ("filter",), tuple(map(str, found["states"])),
        many("error"), many("deviation"), None, many("nees"), many("nis"), found["error"].shape[1],
        many("degrees"), innovation, many("ok"), {},
        head.get("about", {}) | ({"date": head["date"]} if "date" in head else {}),
        head.get("versions", {}),
    )  # fmt: skip


def record_of_dataset(data: "xr.Dataset") -> FilterRecord:
    """Record of a dataset of estimate.nc or hover.nc, as `stmuav estimate` writes them.

    Raises:
        FileError: the dataset is something else, or of another version.
    """
    kind, version = data.attrs.get("format", ""), int(data.attrs.get("format_version", 0))
    if (kind, version) != (FORMAT, FORMAT_VERSION):
        raise FileError(
            f"The dataset is no record of filters: its format is '{kind}' {version}, not '{FORMAT}' "
            f"{FORMAT_VERSION}."
        )
    # only hovers hold positions
    size, readings = (14, 6) if "position" in data else (5, 3)
    mean = data["estimate"].values
    # a hover is flown by the estimate, and has a truth of its own with each tuning
    truth = np.broadcast_to(data["truth"].values, mean.shape)
    count = mean.shape[:2]
    innovation = data["innovation"].values if "innovation" in data else None
    if innovation is not None:
        degrees = np.isfinite(innovation[..., 0]).sum(axis=2)
    else:
        degrees = np.full(count, readings)
    names = [str(name) for name in data["component"].values]
    states = tuple(f"{name} [{_UNITS[name.rpartition('_')[0]]}]" for name in names)
    summaries = json.loads(data.attrs.get("summaries", "{}"))
    seeds = {"seeds": data.sizes["seed"], "date": data.attrs.get("date", "")}
    return FilterRecord(
        str(data.attrs.get("title", "")), data["time"].values, tuple(map(str, data["tuning"].values)),
        states, mean - truth, data["standard_deviation"].values, truth, data["nees"].values,
        data["nis"].values, size, degrees, innovation, data["ok"].values[:, -1].astype(bool),
        summaries, seeds, json.loads(data.attrs.get("versions", "{}")),
    )  # fmt: skip
