"""Markdown tables and figures of the long-horizon benchmark, from its JSON record alone."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from shared.pages import Row, legend_of, panels, save, titled

SOLVERS = {
    "dopri8": "Dopri8", "tsit5": "Tsit5", "gauss": "Gauss order 4", "midpoint": "midpoint order 2",
}  # fmt: skip
HOLDS = {"projection": "projected", "none": "unstabilised", "baumgarte": "Baumgarte"}
COLOURS = {"dopri8": "C0", "tsit5": "C1", "gauss": "C2", "midpoint": "C3"}
LINES = {"projection": "-", "none": "--", "baumgarte": ":"}
MARKS = {"projection": "o", "none": "s", "baumgarte": "^"}


def name_of(family: str) -> str:
    """A family in words."""
    solver, hold = family.split(", ")
    # with fixed steps nothing but a projection could hold the joints
    words = "no projection" if family == "gauss, none" else HOLDS[hold]
    return f"{SOLVERS[solver]}, {words}"


def show(path: Path, folder: Path) -> str:
    """Draw the figures into a folder; the tables, and where everything is."""
    return "\n".join([tables(path), *(str(figure) for figure in draw(path, folder))])


def tables(path: Path) -> str:
    """All tables of one record, for docs/long_times.md."""
    problems = json.loads(path.read_text())["problems"]
    parts = [_cheapest(problems, level) for level in problems[0]["cheapest"]]
    parts += [_held(problems), _answers(problems), _finest(problems)]
    return "\n\n".join(parts)


def _number(value: float | None, form: str = ".1e") -> str:
    return "-" if value is None else f"{value:{form}}"


def _cheapest(problems: list[Row], level: str) -> str:
    """Seconds of the cheapest run of each family that keeps the error below the level."""
    rows = []
    for family in problems[0]["cheapest"][level]:
        cells = [problem["cheapest"][level][family] for problem in problems]
        rows.append([name_of(family), *(_number(c and c["seconds"], ".2g") for c in cells)])
    title = f"Seconds for an energy error up to {float(level):.0e} over the whole horizon"
    return titled(title, ["method", *(p["title"] for p in problems)], rows)


def _held(problems: list[Row]) -> str:
    """Error and drift at one tolerance with and without projection."""
    keys = ("largest", "drift", "seconds", "residual")
    rows = [
        [problem["title"], name_of(row["family"]), *(_number(row[key]) for key in keys)]
        for problem in problems
        for row in problem["runs"]
        if row["tolerance"] == 1e-6
    ]
    head = ["problem", "method", "error", "drift [1/s]", "run [s]", "joints off by [m]"]
    return titled("At tolerance 1e-6", head, rows)


def _answers(problems: list[Row]) -> str:
    """How often a projected explicit run is better than a fixed-step run that costs as much."""
    rows = []
    for problem in problems:
        cells = [problem["title"]]
        for cost in ("seconds", "evaluations"):
            for family in ("gauss, projection", "gauss, none", "midpoint, projection"):
                pairs = [p for p in problem["answers"][cost]["pairs"] if p["family"] == family]
                ratios = [p["ratio"] for p in pairs if p["ratio"] is not None]
                better = sum(ratio > 1 for ratio in ratios)
                span = f", {min(ratios):.0e} to {max(ratios):.0e}" if ratios else ""
                cells.append(f"{better} of {len(ratios)}{span}")
        rows.append(cells)
    short = ("Gauss, projected", "Gauss, none", "midpoint, projected")
    head = ["problem", *(f"{s}, by {c}" for c in ("seconds", "evaluations") for s in short)]
    return titled("Projected explicit better at equal cost, ratios of the errors", head, rows)


def _finest(problems: list[Row]) -> str:
    """The smallest error that each family reached, and runs that failed."""
    rows = []
    for family in problems[0]["cheapest"]["0.001"]:
        cells = []
        for problem in problems:
            mine = [row for row in problem["runs"] if row["family"] == family]
            whole = [row for row in mine if row["largest"] is not None]
            best = min(whole, key=lambda row: row["largest"], default=None)
            text = "-" if best is None else f"{best['largest']:.0e} ({best['seconds']:.2g} s)"
            failed = len(mine) - len(whole)
            cells.append(text + (f", {failed} of {len(mine)} failed" if failed else ""))
        rows.append([name_of(family), *cells])
    return titled("Smallest error", ["method", *(p["title"] for p in problems)], rows)


def draw(path: Path, folder: Path) -> list[Path]:
    """Write all figures as PNG; returns their paths."""
    record = json.loads(path.read_text())
    figures = {
        "long_horizon_work": work(record, "seconds", "run time [s]"),
        "long_horizon_evaluations": work(record, "evaluations", "evaluations of x' = f(t, x)"),
        "long_horizon_energy": over_time(record),
    }
    return save(figures, folder)


def _panels(count: int) -> tuple[Figure, list[Any]]:
    columns = min(3, count)
    rows = -(-count // columns)
    return panels(rows, columns, 4 * columns + 1, 3.3 * rows + 1.2)


def _legend(figure: Figure, axes: list[Any]) -> None:
    """One legend below all panels."""
    lines = legend_of(axes)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)


def _style(row: Row) -> dict[str, Any]:
    colour, line = COLOURS[row["solver"]], LINES[row["hold"]]
    return {"color": colour, "linestyle": line, "label": name_of(row["family"])}


def work(record: Row, cost: str, label: str) -> Figure:
    """Largest energy error against cost, one panel per problem."""
    figure, axes = _panels(len(record["problems"]))
    for ax, problem in zip(axes, record["problems"], strict=True):
        rows = [row for row in problem["runs"] if row["largest"]]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            x, y = [row[cost] for row in mine], [row["largest"] for row in mine]
            ax.loglog(x, y, marker=MARKS[mine[0]["hold"]], markersize=4, **_style(mine[0]))
        ax.set(title=problem["title"], xlabel=label, ylabel="largest energy error [scale]")
        # within one decade the labels of minor ticks overlap
        ax.xaxis.set_minor_formatter(NullFormatter())
        ax.grid(alpha=0.3)
    _legend(figure, axes)
    return figure


def over_time(record: Row) -> Figure:
    """|energy error| over time of one run of some families, one panel per problem."""
    figure, axes = _panels(len(record["problems"]))
    for ax, problem in zip(axes, record["problems"], strict=True):
        for row in (row for row in problem["runs"] if "series" in row):
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
