"""Figures of a study's results: fans of curves, histograms, quantities against inputs.

Every figure is made by a function of the data and their analysis, which returns None where there is
nothing to draw. Data that are thinned or left out are mentioned in the figure.
"""

import textwrap

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ...montecarlo.statistics import SampleSummary, bands
from ..plot import STYLES, grid
from .analysis import Analysis, QuantityAnalysis, is_event
from .data import Curve, StudyData, StudyQuantity, label

BLUE, ORANGE, GREEN, BLACK = (colour for colour, _ in STYLES)

# Largest numbers of panels, rows and columns in one figure.
PANELS, ROWS, COLUMNS = 18, 4, 5
POINTS = 3000  # largest number of points in one panel
FEW = 12  # largest number of different values with a bar for each
SINGLE = 12  # largest number of single curves in a fan
NUMBERS = 2**22  # largest number of values of a fan's curves held in memory

_FAN = (0.05, 0.25, 0.5, 0.75, 0.95)


def wrapped(words: str, unit: str, width: int = 30) -> str:
    """Label in lines of about `width` characters, escaped from matplotlib's mathematics."""
    text = label(words, unit).replace("$", r"\$")
    return "\n".join(textwrap.wrap(text, width)) or text


def panels(count: int, height: float, columns: int = 2) -> tuple[Figure, list[Axes]]:
    """Figure with `count` panels in columns; surplus panels are hidden."""
    columns = min(columns, count)
    rows = -(-count // columns)
    figure, axes = grid(rows, columns, 0.7 + height * rows)
    for ax in axes.flat[count:]:
        ax.set_axis_off()
    return figure, list(axes.flat[:count])


def caption(figure: Figure, title: str, notes: list[str]) -> None:
    """Add the title, the notes below the panels, and settings that all panels share."""
    figure.suptitle(title.replace("$", r"\$"), fontsize=10)
    said = textwrap.wrap(" ".join(note for note in notes if note), 120)
    if said:
        figure.supxlabel("\n".join(said), fontsize=8, color="0.25")
    for ax in figure.axes:
        ax.set_axisbelow(True)


def thinned(count: int, most: int) -> np.ndarray:
    """Evenly spread integers below `count`, at most `most` of them."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def _left_out(shown: int, there: int, what: str) -> str:
    return f"The first {shown} of {there} {what}." if shown < there else ""


# --- fans


def fans(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of quantile bands and single curves over time or another axis, a panel per curve."""
    del analysis
    if not data.curves or not len(data.fine):
        return None
    shown = data.curves[:PANELS]
    figure, axes = panels(len(shown), 2.5)
    used = [_fan(data, curve, ax) for curve, ax in zip(shown, axes, strict=True)]
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, ncols=4, fontsize=8, loc="outside lower center")
    taken = (
        f"{min(used):,} of {len(data.fine):,} fine samples." if min(used) < len(data.fine) else ""
    )
    notes = [taken, _left_out(len(shown), len(data.curves), "curves")]
    caption(figure, f"{data.title}: quantiles at each place, and single samples", notes)
    return figure


def _fan(data: StudyData, curve: Curve, ax: Axes) -> int:
    limit = max(1, NUMBERS // max(data.dataset.sizes[curve.axis], 1))
    x, y = data.curve(curve, limit)
    y = np.where(np.isinf(y), np.nan, y)
    outer, inner, middle, inner_high, outer_high = bands(y, _FAN).value
    if len(y) > 1:
        ax.fill_between(x, outer, outer_high, color=BLUE, alpha=0.18, lw=0, label="5 to 95 %")
        ax.fill_between(x, inner, inner_high, color=BLUE, alpha=0.32, lw=0, label="25 to 75 %")
    single = y[thinned(len(y), SINGLE)]
    lines = ax.plot(x, single.T, color="0.35", linewidth=0.45)
    lines[0].set_label("single samples")
    if len(y) > 1:
        ax.plot(x, middle, color=BLUE, linewidth=1.6, label="median")
    ax.set_xlabel(wrapped(curve.axis_words, curve.axis_unit), fontsize=9)
    ax.set_ylabel(wrapped(curve.words, curve.unit), fontsize=9)
    ax.margins(x=0)
    return len(y)


# --- histograms


def inputs(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of a histogram of each input over all computed samples."""
    if not data.inputs or not len(data.computed):
        return None
    shown = data.inputs[:PANELS]
    figure, axes = panels(len(shown), 1.75, 3)
    for one, ax in zip(shown, axes, strict=True):
        _histogram(ax, one, data.values(one, "computed"), analysis.inputs[one.key], 24)
    notes = [_left_out(len(shown), len(data.inputs), "inputs")]
    caption(figure, f"{data.title}: what was drawn ({len(data.computed):,} samples)", notes)
    return figure


def quantities(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of a histogram of each quantity over the completed samples, with quantiles."""
    if not analysis.findings or not len(data.fine):
        return None
    shown = analysis.findings[:PANELS]
    figure, axes = panels(len(shown), 2.2)
    for one, ax in zip(shown, axes, strict=True):
        _histogram(ax, one.quantity, data.values(one.quantity), one.summary, 34)
    notes = [
        "Dashed: 5, 50 and 95 % quantiles.",
        _left_out(len(shown), len(analysis.findings), "quantities"),
    ]
    caption(figure, f"{data.title}: {len(data.fine):,} fine samples", notes)
    return figure


def _histogram(
    ax: Axes, one: StudyQuantity, values: np.ndarray, summary: SampleSummary, width: int
) -> None:
    finite = values[np.isfinite(values)]
    ax.set_xlabel(wrapped(one.words, one.unit, width), fontsize=9)
    ax.set_ylabel("samples", fontsize=9)
    ax.grid(False, axis="x")
    if is_event(one, values):
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
        low, high = _window(finite)
        beyond = int(np.sum((finite < low) | (finite > high)))
        remarks.append(f"{beyond} outside" if beyond else "")
        bins = min(max(round(2 * len(finite) ** (1 / 3)), 5), 60)
        ax.hist(finite, bins, range=(low, high), color=BLUE, alpha=0.75)
        ax.set_xlim(low - 0.04 * (high - low), high + 0.04 * (high - low))
        sparse(ax, 3 if width < 30 else 6)
    for share in (0.05, 0.5, 0.95) if len(few) > 1 else ():
        mark = summary.quantiles[share].value
        if np.isfinite(mark):
            ax.axvline(mark, color=BLACK, linewidth=0.9, linestyle="--")
    if summary.infinite_probability:
        remarks.append(f"infinite: {100 * summary.infinite_probability.value:.3g} %")
    if summary.undefined:
        remarks.append(f"undefined: {summary.undefined}")
    ax.set_title("; ".join(text for text in remarks if text), fontsize=8)


def _window(finite: np.ndarray) -> tuple[float, float]:
    """Range of a histogram: all values, unless a few outliers would leave one bar for the rest."""
    low, high = float(np.min(finite)), float(np.max(finite))
    inner = np.quantile(finite, [0.005, 0.995])
    wide = float(inner[1] - inner[0])
    if wide > 0 and high - low > 4 * wide:
        return max(low, float(inner[0]) - 0.5 * wide), min(high, float(inner[1]) + 0.5 * wide)
    return low, high


# --- quantities against inputs


def scatter(data: StudyData, analysis: Analysis) -> Figure | None:
    """Figure of quantities, by rows, against the most influential inputs, by columns."""
    keys = {one.key: one for one in analysis.varying}
    findings = [f for f in analysis.findings if f.event is None and f.summary.values > 1]
    if not keys or not findings:
        return None
    strongest = sorted(findings, key=lambda f: -np.max(strength(f), initial=0.0))[:ROWS]
    rows = [f for f in findings if f in strongest]
    names = [name for name in ordered(rows) if name in keys][:COLUMNS] or list(keys)[:COLUMNS]
    figure, axes = grid(len(rows), len(names), 1.0 + 1.75 * len(rows))
    picked = thinned(len(data.fine), POINTS)
    columns = {name: data.values(keys[name])[picked] for name in names}
    for i, one in enumerate(rows):
        y = data.values(one.quantity)[picked]
        for j, name in enumerate(names):
            _points(axes[i, j], columns[name], y)
            axes[i, j].set_title(_strength_words(one, name), fontsize=7.5, pad=6)
            sparse(axes[i, j], 3)
            axes[i, j].tick_params(labelsize=7, labelleft=j == 0, labelbottom=i == len(rows) - 1)
        axes[i, 0].set_ylabel(wrapped(one.quantity.words, one.quantity.unit, 22), fontsize=8)
    for j, name in enumerate(names):
        axes[-1, j].set_xlabel(wrapped(keys[name].words, keys[name].unit, 18), fontsize=8)
    figure.align_ylabels(axes[:, 0])
    notes = _scatter_notes(data, analysis, len(picked), rows, names)
    caption(figure, f"{data.title}: quantities against inputs", notes)
    return figure


def strength(one: QuantityAnalysis) -> np.ndarray:
    """Influence of each named input on a quantity: total or first-order indices."""
    found = one.influence
    if found.indices:
        return found.indices.total.value
    if found.first is not None:
        return found.first
    if found.ranks:
        return found.ranks.value**2
    return np.zeros(len(found.names))


def ordered(findings: list[QuantityAnalysis]) -> list[str]:
    """Keys of the inputs, sorted by their largest influence on one of the quantities."""
    names = findings[0].influence.names
    most = np.max([strength(one) for one in findings], axis=0, initial=0.0)
    return [names[k] for k in np.argsort(-most, kind="stable")]


def sparse(ax: Axes, most: int) -> None:
    """Limit the number of steps between ticks along x, for narrow panels."""
    ax.xaxis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))


def two(value: float) -> str:
    """Text of a value with two decimals, a minus sign, and no minus zero."""
    return f"{round(float(value), 2) + 0.0:.2f}".replace("-", "\N{MINUS SIGN}")


def _strength_words(one: QuantityAnalysis, name: str) -> str:
    found = one.influence
    if name not in found.names:
        return ""
    k = found.names.index(name)
    if found.indices:
        first, total = (two(part.value[k]) for part in (found.indices.first, found.indices.total))
        return f"S {first}, T {total}"
    words = f"S {two(found.first[k])}" if found.first is not None else ""
    return f"{words}, $\\rho$ {two(found.ranks.value[k])}" if found.ranks else words


def _points(ax: Axes, x: np.ndarray, y: np.ndarray) -> None:
    size = 3.0 if len(x) > 500 else 8.0
    alpha = min(1.0, max(0.15, 300 / max(len(x), 1)))
    finite = np.isfinite(y)
    ax.scatter(x[finite], y[finite], size, color=BLUE, alpha=alpha, linewidths=0, rasterized=True)
    for end, height, marker in ((np.inf, 1.0, "^"), (-np.inf, 0.0, "v")):
        there = y == end
        if np.any(there):
            ax.scatter(x[there], np.full(np.sum(there), height), 10, color=ORANGE, marker=marker,
                       alpha=alpha, linewidths=0, transform=ax.get_xaxis_transform(),
                       clip_on=False, rasterized=True)  # fmt: skip


def _scatter_notes(
    data: StudyData, analysis: Analysis, points: int, rows: list[QuantityAnalysis], names: list[str]
) -> list[str]:
    there = len([f for f in analysis.findings if f.event is None and f.summary.values > 1])
    notes = []
    if points < len(data.fine):
        notes.append(f"{points:,} of {len(data.fine):,} fine samples.")
    if len(rows) < there or len(names) < len(analysis.varying):
        notes.append(
            f"{len(rows)} of {there} quantities and {len(names)} of {len(analysis.varying)} inputs: "
            "those with the largest shares."
        )
    letters = "S: share of the variance that the input alone decides"
    letters += (
        ", T: with its interactions."
        if data.design == "saltelli"
        else ", $\\rho$: rank correlation."
    )
    if any(f.summary.infinite_probability for f in rows):
        letters += " Triangles: infinite."
    return [*notes, letters]
