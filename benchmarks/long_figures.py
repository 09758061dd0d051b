"""Figures of the long-horizon benchmark, from its JSON record alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from long_tables import NAMES
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter

COLOURS = {"dopri8": "C0", "tsit5": "C1", "gauss": "C2", "midpoint": "C3"}
LINES = {"projection": "-", "none": "--", "baumgarte": ":"}
MARKS = {"projection": "o", "none": "s", "baumgarte": "^"}


def draw(path: Path, folder: Path) -> list[Path]:
    """Write all figures as PNG; returns their paths."""
    record = json.loads(path.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    figures = {
        "long_horizon_work": work(record, "seconds", "run time [s]"),
        "long_horizon_evaluations": work(record, "evaluations", "evaluations of x' = f(t, x)"),
        "long_horizon_energy": over_time(record),
    }
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        FigureCanvasAgg(figure).print_png(str(paths[-1]))
    return paths


def _panels(count: int) -> tuple[Figure, list[Any]]:
    columns = min(3, count)
    rows = -(-count // columns)
    figure = Figure(figsize=(4 * columns + 1, 3.3 * rows + 1.2), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    return figure, list(axes)


def _legend(figure: Figure, axes: list[Any]) -> None:
    """One legend below all panels."""
    lines = {}
    for ax in axes:
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True):
            lines[label] = line
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)


def _style(row: dict[str, Any]) -> dict[str, Any]:
    colour, line = COLOURS[row["solver"]], LINES[row["hold"]]
    return {"color": colour, "linestyle": line, "label": NAMES[row["family"]]}


def work(record: dict[str, Any], cost: str, label: str) -> Figure:
    """Largest energy error against cost, one panel per problem."""
    figure, axes = _panels(len(record["problems"]))
    for ax, problem in zip(axes, record["problems"], strict=True):
        rows = [row for row in problem["runs"] if row["largest"]]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            ax.loglog(
                [row[cost] for row in mine],
                [row["largest"] for row in mine],
                marker=MARKS[mine[0]["hold"]],
                markersize=4,
                **_style(mine[0]),
            )
        ax.set(title=problem["title"], xlabel=label, ylabel="largest energy error [scale]")
        # within one decade the labels of minor ticks overlap
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    _legend(figure, axes)
    return figure


def over_time(record: dict[str, Any]) -> Figure:
    """|energy error| over time of one run of some families, one panel per problem."""
    figure, axes = _panels(len(record["problems"]))
    for ax, problem in zip(axes, record["problems"], strict=True):
        for row in problem["runs"]:
            if "series" not in row:
                continue
            size = np.abs(np.array(row["series"], dtype=float))[1:]
            ts = record["every"] * np.arange(1, size.size + 1)
            setting = "1e-6" if row["step"] is None else f"h = {1e3 * row['step']:g} ms"
            style = _style(row)
            style["label"] += f", {setting}"
            # round-off may give exactly zero, which a logarithm cannot show
            ax.semilogy(ts, np.maximum(size, 1e-17), linewidth=1, **style)
        ax.set(title=problem["title"], xlabel="t [s]", ylabel="|energy error| [scale]")
        ax.grid(alpha=0.3)
    _legend(figure, axes)
    return figure
