"""Report page of filters with known truth: verdicts, errors, consistency, innovations."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..estimation.consistency import mean_interval
from ..files.layout import flattened
from .filter_record import LEVEL, FilterRecord, end_consistency
from .page import (
    Picture,
    entries_table,
    html_table,
    number_text,
    section,
    text,
    verdict_text,
    write_page,
)
from .plot import STYLES, grid

# Largest numbers of states or readings in a figure, and of seeds whose errors are drawn.
_ROWS, _SEEDS = 6, 20
# Share of the record after which errors count as settled.
_SETTLED = 0.5
# Words for the numbers of a summary of the report's cases, with units and factors.
_SUMMARY = {
    "to_2cm": ("Median time to an error below 2 cm", "s", 1.0),
    "to_5mm": ("Median time to an error below 5 mm", "s", 1.0),
    "rmse": ("RMSE of the centre of mass, x and y, when settled", "mm", 1e3),
    "nees_offset": ("Mean NEES of the offset, 2 is right", "", 1.0),
    "nees": ("Mean NEES of rates and offset, 5 is right", "", 1.0),
    "nis": ("Mean NIS, 3 is right", "", 1.0),
}


def write_filter_report(
    record: FilterRecord, path: str | os.PathLike[str], format: str = "png", *, dpi: int = 160
) -> list[Path]:
    """Write a self-contained page about filters with known truth; return the paths of its files.

    Args:
        record: record of `record_of_dataset` or `record_of_file`.
        path: path of the page.
        format: format of the figures: "png", "svg" or "pdf" (files beside the page).
        dpi: resolution of the figures [dots per inch].

    Raises:
        SettingError: another format.
    """
    seeds = record.nees.shape[2]
    words = (
        f"{seeds} runs with noise of their own, {len(record.t):,} times to t = {record.t[-1]:g} s."
    )
    head = [
        f"<p>{text(words)}</p>",
        *(part for k in range(len(record.tunings)) for part in _verdict(record, k)),
        section("Errors", _errors_table(record)),
        section("Convergence and consistency", _summaries(record.summaries)),
    ]
    said = [(k, v) for k, v in flattened(record.about) if v not in ({}, [], "", None)]
    about = [("States", ", ".join(record.states)), *said]
    tail = [
        section("What was run", entries_table(about)),
        section("Versions", entries_table(record.versions.items())),
    ]
    return write_page(record.title, head, _pictures(record), tail, path, format, dpi)


def _verdict(record: FilterRecord, which: int) -> Iterator[str]:
    """Paragraphs with the verdict on one tuning."""
    name, seeds = record.tunings[which], record.ok.shape[1]
    lost = int(np.sum(~record.ok[which]))
    title = "" if record.tunings == ("filter",) else f"{name.capitalize()} tuning: "
    given = record.summaries.get(name, {}).get("verdict")
    if lost:
        yield verdict_text(f"{title}{lost} of {seeds} filters lost their covariance.", False)
    if given is not None:
        good = {"consistent": True, "undecided": None}.get(given["status"], False)
        yield verdict_text(f"{title}{given['status']}. {given['words']}", good)
        return
    if lost:
        return
    parts = record.nees[which], record.size, record.nis[which], record.degrees[which]
    found = end_consistency(*parts)
    good = all(one.holds for one in found)
    said = "consistent" if good else "inconsistent: the filter's own account of its errors is wrong"
    words = " ".join(one.words for one in found)
    sentence = f"{title}{said}. {words}"
    yield verdict_text(sentence[0].upper() + sentence[1:], good)


def _errors_table(record: FilterRecord) -> str:
    """HTML table of root-mean-square errors at the end, and what the filters say of them."""
    several = len(record.tunings) > 1
    rows = []
    for which, name in enumerate(record.tunings):
        error = np.sqrt(np.mean(record.error[which, -1] ** 2, axis=-1))
        own = np.sqrt(np.mean(record.deviation[which, -1] ** 2, axis=-1))
        for state, found, said in zip(record.states, error, own, strict=True):
            words, unit = state.rstrip("]").rsplit(" [", 1)
            label = f"{words}, {name}" if several else words
            rows.append([text(label), number_text(found), number_text(said), text(unit)])
    head = ["", "RMS error at the end", "standard deviation by the filter", "unit"]
    return html_table(head, rows, left=(3,))


def _summaries(found: Mapping[str, Mapping[str, Any]]) -> str:
    """HTML table of the numbers of the report's cases; empty without them."""
    kept = {name: one for name, one in found.items() if "rmse" in one}
    if not kept:
        return ""
    rows = []
    for key, (words, unit, factor) in _SUMMARY.items():
        cells = [_numbers(one.get(key), factor) for one in kept.values()]
        rows.append([text(words), *cells, text(unit)])
    return html_table(["", *(text(name) for name in kept), "unit"], rows, left=(len(kept) + 1,))


def _numbers(value: Any, factor: float) -> str:
    values = value if isinstance(value, list) else [value]
    return ", ".join(number_text(None if x is None else factor * x) or "never" for x in values)


# --- figures


def _pictures(record: FilterRecord) -> Iterator[Picture]:
    """Figures of a record, one at a time."""
    count = len(record.states)
    for first in range(0, count, _ROWS):
        part = range(first, min(first + _ROWS, count))
        more = "" if count <= _ROWS else f", states {first + 1} to {part[-1] + 1} of {count}"
        page = first // _ROWS + 1
        if record.truth is not None:
            figure = estimates_figure(record, part)
            yield Picture(f"estimates_{page}", f"Estimates and truth, first run{more}", figure)
        words = f"Errors of up to {_SEEDS} runs, and the filters' 3-sigma bands{more}"
        yield Picture(f"errors_{page}", words, error_figure(record, part))
    yield Picture("consistency", "NEES and NIS, means over the runs", consistency_figure(record))
    if record.innovation is not None:
        readings = range(min(record.innovation.shape[2], _ROWS))
        words = "Normalised innovations of the first run: white and within 3 if the filter is consistent"
        yield Picture("innovations", words, innovation_figure(record, readings))


def _look(which: int) -> dict[str, Any]:
    color, dash = STYLES[which % len(STYLES)]
    return {"color": color, "linestyle": dash, "linewidth": 1.3}


def estimates_figure(record: FilterRecord, part: range) -> Figure:
    """Figure of the truth and of the estimates of each tuning over time, of some states."""
    assert record.truth is not None
    figure, axes = grid(len(part), 1, 0.9 + 1.3 * len(part), sharex=True)
    for ax, k in zip(axes[:, 0], part, strict=True):
        for which, name in enumerate(record.tunings):
            truth = record.truth[which, :, k, 0]
            # one line where all tunings share their truth
            if which == 0 or np.any(truth != record.truth[0, :, k, 0]):
                label = "truth" if which == 0 else f"truth, {name}"
                ax.plot(record.t, truth, color="0.6", linewidth=3.0, label=label)
            ax.plot(record.t, truth + record.error[which, :, k, 0], label=name, **_look(which))
        _labelled(ax, record.states[k])
    axes[0, 0].legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return _finished(figure, axes, record.title)


def error_figure(record: FilterRecord, part: range) -> Figure:
    """Figure of errors over time, a column for each tuning, with the band of the first run.

    The axes are those of the settled half; what is larger before is cut.
    """
    columns = len(record.tunings)
    figure, axes = grid(len(part), columns, 0.9 + 1.3 * len(part), sharex=True)
    late = record.t >= record.t[0] + _SETTLED * (record.t[-1] - record.t[0])
    for which, name in enumerate(record.tunings):
        for ax, k in zip(axes[:, which], part, strict=True):
            error = record.error[which, :, k, :_SEEDS]
            band = 3 * record.deviation[which, :, k, 0]
            ax.plot(record.t, error, color="0.65", linewidth=0.5)
            for sign in (1, -1):
                ax.plot(record.t, sign * band, **_look(which) | {"linestyle": "-"})
            sizes = np.concatenate([np.abs(error[late]).ravel(), band[late]])
            most = float(np.max(sizes[np.isfinite(sizes)], initial=0.0))
            if most > 0:
                ax.set_ylim(-1.5 * most, 1.5 * most)
            _labelled(ax, record.states[k] if which == 0 else "")
        if columns > 1:
            axes[0, which].set_title(f"{name} tuning", fontsize=9, parse_math=False)
    return _finished(figure, axes, record.title)


def consistency_figure(record: FilterRecord) -> Figure:
    """Figure of NEES and NIS per degree of freedom, means over the runs, with 99.9 % intervals."""
    figure, axes = grid(2, 1, 4.8, sharex=True)
    seeds = record.nees.shape[2]
    sizes = np.full((len(record.tunings), len(record.t)), record.size)
    for ax, words, values, degrees in (
        (axes[0, 0], f"NEES / {record.size}", record.nees, sizes),
        (axes[1, 0], "NIS / readings", record.nis, record.degrees),
    ):
        low, high = _interval(degrees[0], seeds)
        there = np.isfinite(low)
        ax.fill_between(record.t[there], low[there], high[there], color="0.85", linewidth=0,
                        label="consistent: 99.9 %")  # fmt: skip
        for which, name in enumerate(record.tunings):
            mean = np.mean(values[which], axis=1) / np.maximum(degrees[which], 1)
            mean = np.where(degrees[which] > 0, mean, np.nan)
            good = np.isfinite(mean)
            ax.plot(record.t[good], mean[good], label=name, **_look(which) | {"linewidth": 0.9})
        ax.set_yscale("log")
        _labelled(ax, f"{words}, mean")
        ax.legend(fontsize=8, ncols=3, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    return _finished(figure, axes, record.title)


def _interval(degrees: np.ndarray, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """Ends of the intervals per degree of freedom (T,); NaN where there is none."""
    ends = np.full((2, len(degrees)), np.nan)
    for d in np.unique(degrees[degrees > 0]):
        ends[:, degrees == d] = np.array(mean_interval(int(d), seeds, LEVEL))[:, None] / d
    return ends[0], ends[1]


def innovation_figure(record: FilterRecord, part: range) -> Figure:
    """Figure of normalised innovations of the first run, a column for each tuning."""
    assert record.innovation is not None
    columns = len(record.tunings)
    figure, axes = grid(len(part), columns, 0.9 + 1.2 * len(part), sharex=True, sharey="row")
    for which, name in enumerate(record.tunings):
        for ax, k in zip(axes[:, which], part, strict=True):
            ax.plot(
                record.t, record.innovation[which, :, k, 0], ".", markersize=2, color=STYLES[0][0]
            )
            for level in (-3.0, 3.0):
                ax.axhline(level, color="0.3", linewidth=0.8, linestyle="--")
            _labelled(ax, f"reading {k + 1} [1]" if which == 0 else "")
        if columns > 1:
            axes[0, which].set_title(f"{name} tuning", fontsize=9, parse_math=False)
    return _finished(figure, axes, record.title)


def _labelled(ax: Axes, words: str) -> None:
    ax.set_ylabel(words.replace(" [", "\n["), fontsize=8, parse_math=False)


def _finished(figure: Figure, axes: np.ndarray, title: str) -> Figure:
    for ax in axes[-1]:
        ax.set_xlabel("time [s]", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure
