"""Figures of a study: failure regions, sensitivities, and convergence of estimates."""

import math
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure

from ...montecarlo.sensitivity import separation
from ...montecarlo.statistics import convergence, probability
from ..plot import grid
from .analysis import ROWS, Analysis, QuantityAnalysis, is_event
from .data import StudyData, StudyQuantity
from .plot import (
    BLACK,
    BLUE,
    ORANGE,
    PANELS,
    POINTS,
    caption,
    ordered,
    panels,
    thinned,
    two,
    wrapped,
)

BARS = 12  # largest number of inputs in one panel of sensitivities
CELLS = 8  # largest number of cells along each side of a map of probabilities
_SHADES = LinearSegmentedColormap.from_list("shades", ["#FFFFFF", "#F3B383", ORANGE, "#5F2A00"])


# --- regions


def failures(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of failed samples over the two inputs in which they differ most from the others."""
    failed = ~np.isin(data.computed[:ROWS], data.fine)
    return _region(
        data, analysis, failed, ("did not complete", "runs that did not complete"), "computed"
    )


def event(data: StudyData, analysis: Analysis, one: StudyQuantity) -> Figure | None:
    """Figure of a yes-or-no quantity over the completed samples, in the form of `failures`."""
    values = data.values(one, limit=ROWS)
    if not is_event(one, values):
        return None
    return _region(data, analysis, values == 1, ("yes", one.words), "fine")


def _region(
    data: StudyData, analysis: Analysis, hits: np.ndarray, words: tuple[str, str],
    of: Literal["fine", "computed"],
) -> Figure | None:  # fmt: skip
    varying = list(analysis.varying)
    if not varying or not 0 < np.sum(hits) < len(hits):
        return None
    columns = [data.values(one, of, ROWS) for one in varying]
    distance = separation(np.stack(columns, axis=1), hits)
    most = np.argsort(-distance, kind="stable")[:2].tolist()
    x, first = columns[most[0]], varying[most[0]]
    notes = []
    if len(hits) < len(data.computed if of == "computed" else data.fine):
        notes.append(f"The first {len(hits):,} samples.")
    if len(varying) > 2:
        notes.append(
            f"The 2 of {len(varying)} inputs in whose distribution these samples differ most."
        )
    if len(most) == 1:
        figure, axes = grid(1, 1, 3.0)
        _along(axes[0, 0], x, hits, analysis.level)
    else:
        y, second = columns[most[1]], varying[most[1]]
        figure, axes = grid(1, 2, 3.9)
        notes.append(_sides(axes[0, 0], x, y, hits, words[0]))
        notes[-1] += " In the cells: how many samples there are."
        _map(figure, axes[0, 1], x, y, hits)
        axes[0, 0].set_ylabel(wrapped(second.words, second.unit), fontsize=9)
    for ax in axes.flat:
        ax.set_xlabel(wrapped(first.words, first.unit), fontsize=9)
    caption(figure, f"{data.title}: {words[1]}", notes)
    return figure


def _sides(ax: Axes, x: np.ndarray, y: np.ndarray, hits: np.ndarray, yes: str) -> str:
    """Plot points of both kinds, thinned to a largest number; return a note on what is shown."""
    said = []
    looks = ((~hits, BLUE, "o", 5.0, "others"), (hits, ORANGE, "x", 11.0, yes))
    for mask, colour, marker, size, name in looks:
        numbers = np.flatnonzero(mask)
        picked = numbers[thinned(len(numbers), POINTS // 2)]
        alpha = min(1.0, max(0.35, 300 / len(picked)))
        ax.scatter(x[picked], y[picked], size, color=colour, marker=marker, label=name, alpha=alpha,
                   linewidths=0 if marker == "o" else 0.7, rasterized=True)  # fmt: skip
        said.append(f"{len(picked):,} of {len(numbers):,} ({name})")
    legend = ax.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)
    return f"Points: {', '.join(said)}."


def _map(figure: Figure, ax: Axes, x: np.ndarray, y: np.ndarray, hits: np.ndarray) -> None:
    """Plot the share of hits and the number of samples on a grid of equal cells."""
    cells = min(max(int(math.sqrt(len(x) / 15)), 2), CELLS)
    counts, x_edges, y_edges = np.histogram2d(x, y, cells)
    found = np.histogram2d(x[hits], y[hits], [x_edges, y_edges])[0]
    share = np.divide(found, counts, out=np.full_like(counts, np.nan), where=counts > 0)
    most = float(np.nanmax(share))
    ax.set_facecolor("0.93")  # colour of cells without samples
    mesh = ax.pcolormesh(x_edges, y_edges, share.T, cmap=_SHADES, vmin=0.0, vmax=most)
    ax.grid(False)
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in (x_edges, y_edges)]
    for i, j in np.ndindex(counts.shape):
        dark = share[i, j] > 0.6 * most
        ax.text(float(middles[0][i]), float(middles[1][j]), _short(int(counts[i, j])), fontsize=5.5, ha="center",
                va="center", color="white" if dark else "0.3")  # fmt: skip
    bar = figure.colorbar(mesh, ax=ax, fraction=0.06)
    bar.set_label("estimated probability", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _short(count: int) -> str:
    return f"{count}" if count < 10_000 else f"{count // 1000}k"


def _along(ax: Axes, x: np.ndarray, hits: np.ndarray, level: float) -> None:
    """Plot the share of hits with Wilson's interval in ranges of one input of equal counts."""
    parts = min(max(len(x) // 30, 2), 12)
    edges = np.unique(np.quantile(x, np.arange(parts + 1) / parts))
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))
    for k in np.unique(place):
        here = place == k
        found = probability(int(np.sum(hits[here])), int(np.sum(here)), level)
        ends = [[found.value - (found.low or 0.0)], [(found.high or 0.0) - found.value]]
        ax.errorbar(np.median(x[here]), found.value, ends, fmt="o", color=BLUE, capsize=2.5, ms=4)
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel("estimated probability", fontsize=9)


# --- convergence of estimates


def settling(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of estimates over the number of samples.

    The estimates are the probability that a sample fails and, for each quantity, the probability
    that it is yes or infinite, or else its mean.
    """
    shown = analysis.findings[: PANELS - 1]
    shown = tuple(one for one in shown if one.summary.values > 1)
    several = len(data.computed) > 1
    if not several:
        return None
    figure, axes = panels(len(shown) + 1, 1.9)
    failed = ~np.isin(data.computed, data.fine)
    _settle(axes[0], failed, "probability", analysis.level)
    axes[0].set_ylabel("share that did not complete", fontsize=9)
    for one, ax in zip(shown, axes[1:], strict=True):
        values = data.values(one.quantity)
        values = values[~np.isnan(values)]
        never = one.summary.infinite_probability is not None
        what = "mean" if one.summary.mean and not one.event else "probability"
        _settle(ax, np.isinf(values) if never else values, what, analysis.level)
        name = "share that is infinite" if never else "probability" if one.event else "mean"
        unit = one.quantity.unit if what == "mean" else "1"
        ax.set_ylabel(wrapped(f"{name}: {one.quantity.words}", unit, 28), fontsize=8)
    for ax in axes[-2:]:
        ax.set_xlabel("samples", fontsize=9)
    note = f"Bands: {100 * analysis.level:g} % intervals; broken line: from all samples."
    caption(figure, f"{data.title}: estimates from the first samples", [note])
    return figure


def _settle(
    ax: Axes, values: np.ndarray, what: Literal["mean", "probability"], level: float
) -> None:
    found = convergence(values, what, level)
    kept = found.sizes >= min(8, found.sizes[-1])
    sizes, value, low, high = (part[kept] for part in found)
    ax.set_xscale("log", base=2)
    ax.fill_between(sizes, low, high, color=BLUE, alpha=0.25, linewidth=0)
    ax.plot(sizes, value, color=BLUE, marker=".", linewidth=1.2)
    ax.axhline(value[-1], color=BLACK, linewidth=0.8, linestyle="--")


# --- sensitivities


def sensitivities(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of Sobol indices, or of first-order indices and rank correlations, by quantity."""
    there = [one for one in analysis.findings if one.influence.first is not None]
    if not there:
        return None
    shown = there[:PANELS]
    names = ordered(shown)[:BARS]
    figure, axes = panels(len(shown), 0.75 + 0.29 * len(names), 2)
    words = {one.key: wrapped(one.words, "1", 24) for one in data.inputs}
    for one, ax in zip(shown, axes, strict=True):
        (_sobol_bars if one.influence.indices else _share_bars)(ax, one, names)
        ax.set_yticks(range(len(names)), [words.get(name, name) for name in names], fontsize=7.5)
        ax.invert_yaxis()
        ax.set_title(wrapped(one.quantity.words, "1", 34), fontsize=8.5, loc="left")
        ax.grid(False, axis="y")
        ax.axvline(0.0, color=BLACK, linewidth=0.6)
    for k, ax in enumerate(axes):
        ax.tick_params(labelleft=k % 2 == 0)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, fontsize=8, loc="outside lower center")
    inputs = len(there[0].influence.names)
    few = f"{len(names)} of {inputs} inputs." if len(names) < inputs else ""
    more = f"{len(shown)} of {len(there)} quantities." if len(shown) < len(there) else ""
    caption(figure, f"{data.title}: which inputs decide", [few, more])
    return figure


def _sobol_bars(ax: Axes, one: QuantityAnalysis, names: list[str]) -> None:
    found = one.influence.indices
    assert found is not None
    picked = [one.influence.names.index(name) for name in names]
    looks = (
        (found.first, -0.2, BLUE, "alone (first order)"),
        (found.total, 0.2, ORANGE, "with interactions (total)"),
    )
    for part, shift, colour, words in looks:
        value = part.value[picked]
        ends = np.maximum([value - part.low[picked], part.high[picked] - value], 0.0)
        ax.barh(np.arange(len(names)) + shift, value, 0.38, xerr=ends, color=colour, label=words,
                error_kw={"elinewidth": 0.8, "capsize": 1.5})  # fmt: skip
    # estimates of indices may be negative, and their intervals reach further
    least = min(float(np.min(part.low[picked])) for part, *_ in looks)
    ax.set_xlim(left=min(1.1 * least, -0.02))
    ax.set_xlabel("share of the variance", fontsize=8)


def _share_bars(ax: Axes, one: QuantityAnalysis, names: list[str]) -> None:
    found = one.influence
    assert found.first is not None
    picked = [found.names.index(name) for name in names]
    value = found.first[picked]
    ax.barh(
        np.arange(len(names)), value, 0.6, color=BLUE, label="share that the input alone decides"
    )
    if found.noise_bound is not None:
        ax.axvline(
            found.noise_bound,
            color=BLACK,
            linewidth=0.9,
            linestyle=":",
            label="what chance stays below",
        )
    widest = max(float(np.max(value)), found.noise_bound or 0.0, 0.05)
    if found.ranks:
        for row, k in enumerate(picked):
            ax.text(
                1.2 * widest,
                row,
                two(found.ranks.value[k]),
                fontsize=7,
                ha="right",
                va="center",
                color="0.25",
            )
        ax.set_title("rank correlation", loc="right", fontsize=6.5, color="0.25")
    # an estimate of an index may be negative
    ax.set_xlim(min(0.0, 1.1 * float(np.min(value))), 1.23 * widest)
    ax.set_xlabel("share of the variance", fontsize=8)
