"""Figures of a study: distributions, curves, failure regions, sensitivities.

Every figure is made by a function of the data and their analysis, which returns None where there is
nothing to draw. Data that are thinned or left out are mentioned in the figure.
"""

import math
import re
import textwrap
from collections.abc import Callable, Iterator, Mapping
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..studies.sensitivity import separation
from ..studies.statistics import Intervals, SampleSummary, bands, probability
from .plot import STYLES, grid
from .study_data import (
    ROWS,
    Analysis,
    QuantityAnalysis,
    StudyData,
    StudyQuantity,
    is_event,
    label_unit,
)

BLUE, ORANGE, GREEN, BLACK = (colour for colour, _ in STYLES)

# Largest numbers of panels, rows and columns in one figure.
PANELS, PANEL_ROWS, COLUMNS = 18, 4, 5
POINTS = 3000  # largest number of points in one panel
FEW = 12  # largest number of different values with a bar for each
SINGLE = 12  # largest number of single curves in a fan
NUMBERS = 2**22  # largest number of values of a fan's curves held in memory

_FAN = (0.05, 0.25, 0.5, 0.75, 0.95)


def wrap_label(description: str, unit: str, width: int = 30) -> str:
    """Label in lines of about `width` characters, escaped from matplotlib's mathematics."""
    text = label_unit(description, unit).replace("$", r"\$")
    # dotted keys such as start.roll.angle_rate are broken at their dots, not inside of a word
    lines = [""]
    for word in text.split():
        for k, part in enumerate(re.findall(r"[^._]+[._]*", word) if len(word) > width else [word]):
            space = "" if k or not lines[-1] else " "
            if lines[-1] and len(lines[-1] + space + part) > width:
                lines.append(part)
            else:
                lines[-1] += space + part
    return "\n".join(lines)


def make_panels(count: int, height: float, columns: int = 2) -> tuple[Figure, list[Axes]]:
    """Figure with `count` panels in columns; surplus panels are hidden."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, axes = grid(rows, columns, 0.7 + height * rows)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return figure, list(axes.flat[:count])


def add_caption(figure: Figure, title: str, notes: list[str]) -> None:
    """Add the title, the notes below the panels, and settings that all panels share."""
    figure.suptitle(title.replace("$", r"\$"), fontsize=10)
    said = textwrap.wrap(" ".join(note for note in notes if note), 120)
    if said:
        figure.supxlabel("\n".join(said), fontsize=8, color="0.25")
    for ax in figure.axes:
        ax.set_axisbelow(True)


def thin_indices(count: int, most: int) -> np.ndarray:
    """Evenly spread integers below `count`, at most `most` of them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def _left_out(shown_count: int, total: int, noun: str) -> str:
    return f"The first {shown_count} of {total} {noun}." if shown_count < total else ""


# --- fans


def draw_fans(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of quantile bands and single curves over time or another axis, a panel per curve."""
    del analysis
    if not data.curves or not len(data.completed):
        return None
    curves = data.curves[:PANELS]
    figure, axes = make_panels(len(curves), 2.5)
    used = [_draw_fan(data, curve, ax) for curve, ax in zip(curves, axes, strict=True)]
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, ncols=4, fontsize=8, loc="outside lower center")
    notes = [_left_out(len(curves), len(data.curves), "curves")]
    if min(used) < len(data.completed):
        notes.insert(0, f"{min(used):,} of {len(data.completed):,} completed samples.")
    add_caption(figure, f"{data.title}: quantiles and single samples", notes)
    return figure


def _draw_fan(data: StudyData, curve: StudyQuantity, ax: Axes) -> int:
    # A study may be larger than memory; a median of this many samples is exact enough for a picture.
    limit = max(1, NUMBERS // max(data.dataset.sizes[curve.axis], 1))
    x, y = data.curve(curve, limit)
    # A quantile between a number and infinity has no place in a picture.
    y = np.where(np.isinf(y), np.nan, y)
    outer, inner, middle, inner_high, outer_high = bands(y, _FAN).value
    if len(y) > 1:
        ax.fill_between(x, outer, outer_high, color=BLUE, alpha=0.18, lw=0, label="5 to 95 %")
        ax.fill_between(x, inner, inner_high, color=BLUE, alpha=0.32, lw=0, label="25 to 75 %")
    single = y[thin_indices(len(y), SINGLE)]
    lines = ax.plot(x, single.T, color="0.35", linewidth=0.45)
    lines[0].set_label("single samples")
    if len(y) > 1:
        ax.plot(x, middle, color=BLUE, linewidth=1.6, label="median")
    ax.set_xlabel(wrap_label(curve.axis_words, curve.axis_unit), fontsize=9)
    ax.set_ylabel(wrap_label(curve.label, curve.unit), fontsize=9)
    ax.margins(x=0)
    return len(y)


# --- histograms


def draw_quantities(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of a histogram of each quantity over the completed samples, with quantiles."""
    if not analysis.findings or not len(data.completed):
        return None
    findings = analysis.findings[:PANELS]
    figure, axes = make_panels(len(findings), 2.2)
    for finding, ax in zip(findings, axes, strict=True):
        _draw_histogram(ax, finding.quantity, data.values(finding.quantity), finding.summary, 34)
    notes = [
        "Dashed: 5, 50 and 95 % quantiles.",
        _left_out(len(findings), len(analysis.findings), "quantities"),
    ]
    add_caption(figure, f"{data.title}: {len(data.completed):,} completed samples", notes)
    return figure


def _draw_histogram(
    ax: Axes, quantity: StudyQuantity, values: np.ndarray, summary: SampleSummary, width: int
) -> None:
    finite = values[np.isfinite(values)]
    ax.set_xlabel(wrap_label(quantity.label, quantity.unit, width), fontsize=9)
    ax.set_ylabel("samples", fontsize=9)
    ax.grid(False, axis="x")
    if is_event(quantity, values):
        yes = int(np.sum(values))
        ax.bar([0, 1], [len(values) - yes, yes], 0.6, color=BLUE, alpha=0.75)
        ax.set_xticks([0, 1], ["no", "yes"])
        ax.set_xlim(-0.6, 1.6)
        return
    remarks = []
    few, counts = np.unique(finite, return_counts=True)
    if len(few) == 1 or (3 * len(few) <= len(finite) and len(few) <= FEW):
        ax.bar(few, counts, 0.6 * np.min(np.diff(few), initial=1.0), color=BLUE, alpha=0.75)
        ax.set_xticks(few if len(few) < 7 else few[[0, -1]])
        ax.margins(x=0.15)
    elif len(few):
        # A few outliers would press all others into one bar; they are counted in the title.
        low, high = _histogram_range(finite)
        beyond = int(np.sum((finite < low) | (finite > high)))
        remarks.append(f"{beyond} outside" if beyond else "")
        # Rice's rule.
        bins = min(max(round(2 * len(finite) ** (1 / 3)), 5), 60)
        ax.hist(finite, bins, range=(low, high), color=BLUE, alpha=0.75)
        ax.set_xlim(low - 0.04 * (high - low), high + 0.04 * (high - low))
        limit_ticks(ax, 3 if width < 30 else 6)
    for share in (0.05, 0.5, 0.95) if len(few) > 1 else ():
        mark = summary.quantiles[share].value
        if np.isfinite(mark):
            ax.axvline(mark, color=BLACK, linewidth=0.9, linestyle="--")
    if summary.infinite_probability:
        remarks.append(f"infinite: {100 * summary.infinite_probability.value:.3g} %")
    if summary.undefined:
        remarks.append(f"undefined: {summary.undefined}")
    ax.set_title("; ".join(text for text in remarks if text), fontsize=8)


def _histogram_range(finite: np.ndarray) -> tuple[float, float]:
    """Range of a histogram: all values, unless a few outliers would leave one bar for the rest."""
    low, high = float(np.min(finite)), float(np.max(finite))
    inner = np.quantile(finite, [0.005, 0.995])
    wide = float(inner[1] - inner[0])
    if wide > 0 and high - low > 4 * wide:
        return max(low, float(inner[0]) - 0.5 * wide), min(high, float(inner[1]) + 0.5 * wide)
    return low, high


# --- quantities against inputs


def draw_scatter(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of quantities, by rows, against the most influential inputs, by columns."""
    keys = {quantity.key: quantity for quantity in analysis.varying}
    # Yes and no against an input is a map of probabilities, which has a figure of its own.
    findings = [f for f in analysis.findings if f.event is None and f.summary.values > 1]
    if not keys or not findings:
        return None
    strongest = sorted(findings, key=lambda f: -np.max(influence_strength(f), initial=0.0))
    rows = [f for f in findings if f in strongest[:PANEL_ROWS]]
    names = [name for name in sort_inputs(rows) if name in keys][:COLUMNS] or list(keys)[:COLUMNS]
    figure, axes = grid(len(rows), len(names), 1.0 + 1.75 * len(rows))
    picked = thin_indices(len(data.completed), POINTS)
    columns = {name: data.values(keys[name])[picked] for name in names}
    for i, finding in enumerate(rows):
        y = data.values(finding.quantity)[picked]
        for j, name in enumerate(names):
            _draw_points(axes[i, j], columns[name], y)
            axes[i, j].set_title(_strength_words(finding, name), fontsize=7.5, pad=6)
            limit_ticks(axes[i, j], 3)
            axes[i, j].tick_params(labelsize=7, labelleft=j == 0, labelbottom=i == len(rows) - 1)
        label = wrap_label(finding.quantity.label, finding.quantity.unit, 22)
        axes[i, 0].set_ylabel(label, fontsize=8)
    for j, name in enumerate(names):
        axes[-1, j].set_xlabel(wrap_label(keys[name].label, keys[name].unit, 18), fontsize=8)
    figure.align_ylabels(axes[:, 0])
    notes = []
    if len(picked) < len(data.completed):
        notes.append(f"{len(picked):,} of {len(data.completed):,} completed samples.")
    if len(rows) < len(findings) or len(names) < len(analysis.varying):
        notes.append(
            f"{len(rows)} of {len(findings)} quantities and {len(names)} of {len(analysis.varying)} inputs: "
            "those with the largest shares."
        )
    is_saltelli = data.design == "saltelli"
    letters = ", T: with its interactions." if is_saltelli else ", $\\rho$: rank correlation."
    notes.append(f"S: first-order share of the variance{letters}")
    if any(f.summary.infinite_probability for f in rows):
        notes.append("Triangles: infinite.")
    add_caption(figure, f"{data.title}: quantities against inputs", notes)
    return figure


def influence_strength(finding: QuantityAnalysis) -> np.ndarray:
    """Influence of each named input on a quantity: total or first-order indices."""
    influence = finding.influence
    if influence.indices:
        return influence.indices.total.value
    if influence.first is not None:
        return influence.first.value
    if influence.ranks:
        return influence.ranks.value**2
    return np.zeros(len(influence.names))


def sort_inputs(findings: list[QuantityAnalysis]) -> list[str]:
    """Keys of the inputs, sorted by their largest influence on one of the quantities."""
    names = findings[0].influence.names
    most = np.max([influence_strength(finding) for finding in findings], axis=0, initial=0.0)
    return [names[k] for k in np.argsort(-most, kind="stable")]


def limit_ticks(ax: Axes, most: int) -> None:
    """Limit the number of steps between ticks along x, for narrow panels."""
    ax.xaxis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))


def format_two(value: float) -> str:
    """Text of a value with two decimals, a minus sign, and no minus zero."""
    return f"{round(float(value), 2) + 0.0:.2f}".replace("-", "\N{MINUS SIGN}")


def _strength_words(finding: QuantityAnalysis, name: str) -> str:
    influence = finding.influence
    if name not in influence.names:
        return ""
    k = influence.names.index(name)
    total = influence.indices.total if influence.indices else None
    parts = (("S", influence.first), ("T", total), ("$\\rho$", influence.ranks))
    return ", ".join(f"{sign} {format_two(x.value[k])}" for sign, x in parts if x is not None)


def _draw_points(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    size = 3.0 if len(x) > 500 else 8.0
    # More points are fainter, so that their density remains visible.
    alpha = min(1.0, max(0.15, 300 / max(len(x), 1)))
    finite = np.isfinite(y)
    ax.scatter(x[finite], y[finite], size, color=BLUE, alpha=alpha, linewidths=0, rasterized=True)
    for end, height, marker in ((np.inf, 1.0, "^"), (-np.inf, 0.0, "v")):
        mask = y == end
        if np.any(mask):
            ax.scatter(x[mask], np.full(np.sum(mask), height), 10, color=ORANGE, marker=marker,
                       alpha=alpha, linewidths=0, transform=ax.get_xaxis_transform(),
                       clip_on=False, rasterized=True)  # fmt: skip


BARS = 12  # largest number of inputs in one panel of sensitivities
CELLS = 8  # largest number of cells along each side of a map of probabilities
_SHADES = LinearSegmentedColormap.from_list("shades", ["#FFFFFF", "#F3B383", ORANGE, "#5F2A00"])


# --- regions


def draw_failures(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of failed samples over the two inputs in which they differ most from the others."""
    failed = ~np.isin(data.computed[:ROWS], data.completed)
    labels = ("did not complete", "runs that did not complete")
    return _draw_region(data, analysis, failed, labels, "computed")


def draw_event(data: StudyData, analysis: Analysis, quantity: StudyQuantity) -> Figure | None:
    """Figure of a yes-or-no quantity over the completed samples, in the form of `draw_failures`."""
    values = data.values(quantity, limit=ROWS)
    if not is_event(quantity, values):
        return None
    return _draw_region(data, analysis, values == 1, ("yes", quantity.label), "fine")


def _draw_region(
    data: StudyData, analysis: Analysis, hits: np.ndarray, labels: tuple[str, str],
    of: Literal["fine", "computed"],
) -> Figure | None:  # fmt: skip
    varying = list(analysis.varying)
    if not varying or not 0 < np.sum(hits) < len(hits):
        return None
    columns = [data.values(quantity, of, ROWS) for quantity in varying]
    distance = separation(np.stack(columns, axis=1), hits)
    most = np.argsort(-distance, kind="stable")[:2].tolist()
    x, first = columns[most[0]], varying[most[0]]
    notes = []
    if len(hits) < len(data.computed if of == "computed" else data.completed):
        notes.append(f"The first {len(hits):,} samples.")
    if len(varying) > 2:
        notes.append(
            f"The 2 of {len(varying)} inputs in whose distribution these samples differ most."
        )
    if len(most) == 1:
        figure, axes = grid(1, 1, 3.0)
        _plot_share(axes[0, 0], x, hits, analysis.level)
    else:
        y, second = columns[most[1]], varying[most[1]]
        figure, axes = grid(1, 2, 3.9)
        notes.append(_draw_sides(axes[0, 0], x, y, hits, labels[0]))
        notes[-1] += " In the cells: numbers of samples."
        _draw_map(figure, axes[0, 1], x, y, hits)
        axes[0, 0].set_ylabel(wrap_label(second.label, second.unit), fontsize=9)
    for ax in axes.flat:
        ax.set_xlabel(wrap_label(first.label, first.unit), fontsize=9)
    add_caption(figure, f"{data.title}: {labels[1]}", notes)
    return figure


def _draw_sides(ax: Axes, x: np.ndarray, y: np.ndarray, hits: np.ndarray, yes: str) -> str:
    """Plot points of both kinds, thinned to a largest number; return a note on what is shown."""
    said = []
    looks = ((~hits, BLUE, "o", 5.0, "others"), (hits, ORANGE, "x", 11.0, yes))
    for mask, colour, marker, size, name in looks:
        numbers = np.flatnonzero(mask)
        # Each kind is thinned by itself, because the rarer one is what the figure is about.
        picked = numbers[thin_indices(len(numbers), POINTS // 2)]
        alpha = min(1.0, max(0.35, 300 / len(picked)))
        ax.scatter(x[picked], y[picked], size, color=colour, marker=marker, label=name, alpha=alpha,
                   linewidths=0 if marker == "o" else 0.7, rasterized=True)  # fmt: skip
        said.append(f"{len(picked):,} of {len(numbers):,} ({name})")
    legend = ax.legend(fontsize=8, loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
    for handle in legend.legend_handles:
        if handle is not None:
            handle.set_alpha(1.0)
    return f"Points: {', '.join(said)}."


def _draw_map(figure: Figure, ax: Axes, x: np.ndarray, y: np.ndarray, hits: np.ndarray) -> None:
    """Plot the share of hits and the number of samples on a grid of equal cells."""
    # About 15 samples in a cell on average; fewer would make the map noise.
    cells = min(max(int(math.sqrt(len(x) / 15)), 2), CELLS)
    counts, x_edges, y_edges = np.histogram2d(x, y, cells)
    hit_counts = np.histogram2d(x[hits], y[hits], [x_edges, y_edges])[0]
    share = np.divide(hit_counts, counts, out=np.full_like(counts, np.nan), where=counts > 0)
    most = float(np.nanmax(share))
    ax.set_facecolor("0.93")  # colour of cells without samples
    mesh = ax.pcolormesh(x_edges, y_edges, share.T, cmap=_SHADES, vmin=0.0, vmax=most)
    ax.grid(False)
    middles = [(edges[1:] + edges[:-1]) / 2 for edges in (x_edges, y_edges)]
    for i, j in np.ndindex(counts.shape):
        dark = share[i, j] > 0.6 * most
        count = int(counts[i, j])
        text = f"{count}" if count < 10_000 else f"{count // 1000}k"
        ax.text(float(middles[0][i]), float(middles[1][j]), text, fontsize=5.5, ha="center", va="center",
                color="white" if dark else "0.3")  # fmt: skip
    bar = figure.colorbar(mesh, ax=ax, fraction=0.06)
    bar.set_label("estimated probability", fontsize=8)
    bar.ax.tick_params(labelsize=8)


def _plot_share(ax: Axes, x: np.ndarray, hits: np.ndarray, level: float) -> None:
    """Plot the share of hits with Wilson's interval in ranges of one input of equal counts."""
    parts = min(max(len(x) // 30, 2), 12)
    # Ranges of equal counts have intervals of similar width.
    edges = np.unique(np.quantile(x, np.arange(parts + 1) / parts))
    place = np.clip(np.searchsorted(edges, x, side="right") - 1, 0, max(len(edges) - 2, 0))
    for k in np.unique(place):
        inside = place == k
        estimate = probability(int(np.sum(hits[inside])), int(np.sum(inside)), level)
        ends = [[estimate.value - (estimate.low or 0.0)], [(estimate.high or 0.0) - estimate.value]]
        middle = np.median(x[inside])
        ax.errorbar(middle, estimate.value, ends, fmt="o", color=BLUE, capsize=2.5, ms=4)
    ax.set_ylim(bottom=0.0)
    ax.set_ylabel("estimated probability", fontsize=9)


# --- sensitivities


def draw_sensitivities(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of Sobol indices, or of first-order indices and rank correlations, by quantity."""
    findings = [entry for entry in analysis.findings if entry.influence.first is not None]
    if not findings:
        return None
    panel_findings = findings[:PANELS]
    names = sort_inputs(panel_findings)[:BARS]
    figure, axes = make_panels(len(panel_findings), 0.75 + 0.29 * len(names), 2)
    input_labels = {entry.key: wrap_label(entry.label, "1", 24) for entry in data.inputs}
    labels = [input_labels.get(name, name) for name in names]
    for entry, ax in zip(panel_findings, axes, strict=True):
        (_sobol_bars if entry.influence.indices else _share_bars)(ax, entry, names)
        ax.set_yticks(range(len(names)), labels, fontsize=7.5)
        ax.invert_yaxis()
        ax.set_title(wrap_label(entry.quantity.label, "1", 34), fontsize=8.5, loc="left")
        ax.grid(False, axis="y")
        ax.axvline(0.0, color=BLACK, linewidth=0.6)
    for k, ax in enumerate(axes):
        ax.tick_params(labelleft=k % 2 == 0)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, fontsize=8, loc="outside lower center")
    inputs = len(findings[0].influence.names)
    few = f"{len(names)} of {inputs} inputs." if len(names) < inputs else ""
    count, total = len(panel_findings), len(findings)
    more = f"{count} of {total} quantities." if count < total else ""
    level = f"{100 * analysis.level:g} %"
    bars = f"Bars: estimates with {level} intervals; those below 0 are drawn at 0."
    add_caption(figure, f"{data.title}: influence of the inputs", [bars, few, more])
    return figure


def _sobol_bars(ax: Axes, finding: QuantityAnalysis, names: list[str]) -> None:
    indices = finding.influence.indices
    assert indices is not None
    picked = [finding.influence.names.index(name) for name in names]
    places = np.arange(len(names))
    _draw_bars(ax, places - 0.2, indices.first, picked, 0.38, BLUE, "alone (first order)")
    _draw_bars(ax, places + 0.2, indices.total, picked, 0.38, ORANGE, "with interactions (total)")
    ax.set_xlim(left=0.0)
    ax.set_xlabel("share of the variance", fontsize=8)


def _draw_bars(
    ax: Axes, places: np.ndarray, shares: Intervals, picked: list[int], height: float,
    colour: str, legend_label: str,
) -> float:  # fmt: skip
    """Draw shares with their intervals from 0 to 1, where all shares lie; the largest end."""
    # Estimates of small shares may be negative by noise.
    value, low, high = (np.clip(part[picked], 0.0, 1.0) for part in shares)
    ends = np.maximum([value - low, high - value], 0.0)
    ax.barh(places, value, height, xerr=ends, color=colour, label=legend_label,
            error_kw={"elinewidth": 0.8, "capsize": 1.5})  # fmt: skip
    return float(np.max(high))


def _share_bars(ax: Axes, finding: QuantityAnalysis, names: list[str]) -> None:
    influence = finding.influence
    assert influence.first is not None
    picked = [influence.names.index(name) for name in names]
    places, legend_label = np.arange(len(names)), "first-order share"
    widest = _draw_bars(ax, places, influence.first, picked, 0.6, BLUE, legend_label)
    widest = max(widest, 0.05)
    if influence.ranks:
        style: Any = {"fontsize": 7, "ha": "right", "va": "center", "color": "0.25"}
        for row, k in enumerate(picked):
            ax.text(1.2 * widest, row, format_two(influence.ranks.value[k]), **style)
        ax.set_title("rank correlation", loc="right", fontsize=6.5, color="0.25")
    ax.set_xlim(0.0, 1.23 * widest)
    ax.set_xlabel("share of the variance", fontsize=8)


# Functions and captions of the figures, by name.
FIGURES: Mapping[str, tuple[Callable[[StudyData, Analysis], Figure | None], str]] = {
    "quantities": (draw_quantities, "Distributions of the quantities"),
    "fans": (draw_fans, "Curves: quantiles and some single samples"),
    "failures": (draw_failures, "Runs that did not complete"),
    "sensitivities": (draw_sensitivities, "Influence of the inputs"),
    "scatter": (draw_scatter, "Quantities against the inputs of largest influence"),
}
EVENTS = 4  # largest number of events with a figure of their own


def study_figures(data: StudyData, analysis: Analysis) -> Iterator[tuple[str, str, Figure]]:
    """Names, captions and figures of a study, drawn one at a time."""
    for name, (draw, description) in FIGURES.items():
        figure = draw(data, analysis)
        if figure is not None:
            yield name, description, figure
    events = [quantity.quantity for quantity in analysis.findings if quantity.event][:EVENTS]
    for k, quantity in enumerate(events, 1):
        figure = draw_event(data, analysis, quantity)
        if figure is not None:
            yield f"event_{k}", f"Samples for which it holds: {quantity.label}", figure
