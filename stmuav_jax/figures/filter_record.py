"""Records of filters with known truth, as the files of `stmuav estimate` hold them."""

import io
import json
import os
import zipfile
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from matplotlib.figure import Figure

from ..estimation.consistency import mean_interval
from ..io.netcdf import FileError, list_versions, regular_file, utc_now
from .plot import STYLES, grid

if TYPE_CHECKING:
    import xarray as xr

# Format of the dataset of estimate.nc.
FORMAT = "stmuav_jax estimate"
FORMAT_VERSION = 1

# Level of the intervals in which consistent filters stay.
LEVEL = 0.999
# Largest number of seeds whose errors are drawn.
_SEEDS = 20
# Entries of estimate.npz that a record needs.
_ARRAYS = ("states", "t", "error", "deviation", "nees", "nis", "degrees", "ok")
_UNITS = {"Omega": "rad/s", "offset": "m"}


class FilterRecord(NamedTuple):
    """Filters of d tunings over s seeds of their noise, at T times.

    Attributes:
        title: what was estimated. t: times (T,) [s]. tunings: their names.
        states: "name [unit]" of the n states.
        error, deviation: estimates less truth, and the filters' standard deviations (d, T, n, s).
        verdicts: sentence on each tuning, and whether it is good, None where that is undecided.
        about: options and other plain data on what was run.
    """

    title: str
    t: np.ndarray
    tunings: tuple[str, ...]
    states: tuple[str, ...]
    error: np.ndarray
    deviation: np.ndarray
    verdicts: tuple[tuple[str, bool | None], ...]
    about: Mapping[str, Any]


class Consistency(NamedTuple):
    """Mean of a chi-squared quantity of consistent filters, and the interval that it should be in."""

    statistic: str
    value: float
    low: float
    high: float

    @property
    def holds(self) -> bool:
        """True within the interval."""
        return bool(self.low < self.value < self.high)

    @property
    def explanation(self) -> str:
        """Sentence with the numbers."""
        return f"{self.statistic}: {self.value:.4g}, consistent within {self.low:.4g} and {self.high:.4g}."


def end_consistency(
    nees: np.ndarray, size: int, nis: np.ndarray, degrees: np.ndarray
) -> list[Consistency]:
    """Mean NEES at the end over the seeds, and mean NIS per measured number, with their intervals.

    Args:
        nees, nis: (T, s). size: degrees of freedom of NEES. degrees: those of NIS (T,).
    """
    seeds, readings = nees.shape[1], int(np.sum(degrees))
    tests = [
        Consistency("NEES at the end", float(nees[-1].mean()), *mean_interval(size, seeds, LEVEL))
    ]
    if readings:
        # A sum over sensors of different sizes has as many degrees of freedom as numbers were read.
        value = float(nis.sum() / readings / seeds)
        tests.append(Consistency("NIS", value, *mean_interval(1, seeds * readings, LEVEL)))
    return tests


def normalised_innovations(result: Any) -> np.ndarray:
    """Normalised innovations (T, m, ...) of a filter, NaN where a reading is missing."""
    normalised, measured = np.asarray(result.normalised), np.asarray(result.measured)
    measured_mask = measured.reshape(measured.shape + (1,) * (normalised.ndim - measured.ndim))
    return np.where(measured_mask, normalised, np.nan)


def record_content(
    title: str,
    names: Sequence[tuple[str, str]],
    arrays: Mapping[str, Any],
    about: Mapping[str, Any],
) -> bytes:
    """Content of estimate.npz: arrays, names of the states with units, and what was run as JSON."""
    said = {"title": title, "about": dict(about), "versions": list_versions(), "date": utc_now()}
    states = np.array([f"{name} [{unit}]" for name, unit in names])
    content = io.BytesIO()
    np.savez(content, states=states, head=np.array(json.dumps(said)), **arrays)
    return content.getvalue()


def load_record(path: str | os.PathLike[str]) -> FilterRecord:
    """Record of a file estimate.npz, as `stmuav estimate MODEL` writes it.

    Raises:
        FileError: the file is damaged or holds something else.
    """
    source = regular_file(path)
    try:
        # A pickle in a file from elsewhere could run any code.
        with np.load(source, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
            head = json.loads(str(arrays.get("head", "{}")))
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise FileError(f"{source} is damaged or no npz file ({type(error).__name__}).") from error
    missing = [name for name in _ARRAYS if name not in arrays]
    if missing:
        raise FileError(
            f"{source} is not a filter record: it holds {', '.join(arrays) or 'nothing'}, and lacks "
            f"{', '.join(missing)}."
        )
    lost = int(np.sum(~arrays["ok"]))
    nees, nis, size = arrays["nees"], arrays["nis"], arrays["error"].shape[1]
    tests = end_consistency(nees, size, nis, arrays["degrees"])
    is_good = all(test.holds for test in tests) and not lost
    verdict_text = f"{lost} filters lost their covariance. " if lost else ""
    inconsistent = "Inconsistent: the covariance is not that of the errors. "
    verdict_text += "Consistent. " if is_good else inconsistent
    verdict_text += " ".join(test.explanation for test in tests)
    about = {**head.get("about", {}), **{k: head[k] for k in ("versions", "date") if k in head}}
    return FilterRecord(
        head.get("title", source.parent.name), arrays["t"], ("filter",),
        tuple(map(str, arrays["states"])), arrays["error"][None], arrays["deviation"][None],
        ((verdict_text, is_good),), about,
    )  # fmt: skip


def record_of_dataset(data: "xr.Dataset") -> FilterRecord:
    """Record of a dataset of estimate.nc, as `stmuav estimate` writes it."""
    mean = data["estimate"].values
    # one truth for all tunings
    truth = np.broadcast_to(data["truth"].values, mean.shape)
    names = [str(name) for name in data["component"].values]
    states = tuple(f"{name} [{_UNITS[name.rpartition('_')[0]]}]" for name in names)
    tunings = tuple(map(str, data["tuning"].values))
    verdicts = []
    for tuning, summary in json.loads(data.attrs.get("summaries", "{}")).items():
        if "verdict" in summary:
            status, verdict_text = summary["verdict"]["status"], summary["verdict"]["explanation"]
            is_good = {"consistent": True, "undecided": None}.get(status, False)
            verdicts.append((f"{tuning.capitalize()} tuning: {status}. {verdict_text}", is_good))
    about = {k: data.attrs[k] for k in ("versions", "date") if k in data.attrs}
    return FilterRecord(
        str(data.attrs.get("title", "")), data["time"].values, tunings, states, mean - truth,
        data["standard_deviation"].values, tuple(verdicts), about | {"seeds": data.sizes["seed"]},
    )  # fmt: skip


def error_figure(record: FilterRecord, part: range) -> Figure:
    """Figure of errors over time, a column for each tuning, with the 3-sigma band of the first run.

    The axes are those of the second half; what is larger before is cut.

    Args:
        part: indices of the states that are shown, a row each.
    """
    columns = len(record.tunings)
    figure, axes = grid(len(part), columns, 0.9 + 1.3 * len(part), sharex=True)
    # Errors at the start would set the scale and hide those of the settled filter.
    late = record.t >= record.t[0] + 0.5 * (record.t[-1] - record.t[0])
    for tuning_index, name in enumerate(record.tunings):
        for ax, k in zip(axes[:, tuning_index], part, strict=True):
            error = record.error[tuning_index, :, k, :_SEEDS]
            band = 3 * record.deviation[tuning_index, :, k, 0]
            color, _ = STYLES[tuning_index % len(STYLES)]
            ax.plot(record.t, error, color="0.65", linewidth=0.5)
            ax.plot(record.t, np.outer(band, (1, -1)), color=color, linewidth=1.3)
            sizes = np.concatenate([np.abs(error[late]).ravel(), band[late]])
            most = float(np.max(sizes[np.isfinite(sizes)], initial=0.0))
            if most > 0:
                ax.set_ylim(-1.5 * most, 1.5 * most)
            if tuning_index == 0:
                ax.set_ylabel(record.states[k].replace(" [", "\n["), fontsize=8, parse_math=False)
        if columns > 1:
            axes[0, tuning_index].set_title(f"{name} tuning", fontsize=9, parse_math=False)
        axes[-1, tuning_index].set_xlabel("time [s]", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(record.title, fontsize=10, parse_math=False)
    return figure
