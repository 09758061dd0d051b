"""Markdown tables and figures of the long-horizon benchmark, from its JSON record alone."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullFormatter
from shared.pages import Row, legend_of, number, panels, power, save, shown, titled

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
    """The tables for docs/long_times.md, and where the figures are that are drawn into a folder."""
    record = json.loads(path.read_text())
    problems = record["problems"]
    parts = [cheapest(problems, level) for level in problems[0]["cheapest"]]
    parts += [at_tolerance(problems), finest(problems)]
    figures = {
        "long_horizon_work": work(record, "seconds", "run time [s]"),
        "long_horizon_evaluations": work(record, "evaluations", "evaluations of x' = f(t, x)"),
        "long_horizon_energy": over_time(record),
    }
    return shown(parts, save(figures, folder))


def by_family(title: str, problems: list[Row], cell: Callable[[Row, str], str]) -> str:
    """A table with a line for each family and a column for each problem."""
    families = [{"family": family} for family in problems[0]["cheapest"]["0.001"]]
    of = lambda problem: (problem["title"], "family", lambda family: cell(problem, family))
    return titled(title, families, ("method", "family", name_of), *map(of, problems))


def cheapest(problems: list[Row], level: str) -> str:
    """Seconds of the cheapest run of each family that keeps the error below the level."""
    title = f"Seconds for an energy error up to {float(level):.0e} over the whole horizon"

    def cell(problem: Row, family: str) -> str:
        best = problem["cheapest"][level][family]
        return number(best and best["seconds"], digits=2)

    return by_family(title, problems, cell)


def finest(problems: list[Row]) -> str:
    """The smallest error that each family reached, and runs that failed."""

    def cell(problem: Row, family: str) -> str:
        mine = [row for row in problem["runs"] if row["family"] == family]
        whole = [row for row in mine if row["largest"] is not None]
        best = min(whole, key=lambda row: row["largest"], default=None)
        text = "-" if best is None else f"{best['largest']:.0e} ({best['seconds']:.2g} s)"
        failed = len(mine) - len(whole)
        return text + (f", {failed} of {len(mine)} failed" if failed else "")

    return by_family("Smallest error", problems, cell)


def at_tolerance(problems: list[Row]) -> str:
    """Error and drift at one tolerance with and without projection."""
    rows = [
        {"problem": problem["title"], **row}
        for problem in problems
        for row in problem["runs"]
        if row["tolerance"] == 1e-6
    ]
    return titled(
        "At tolerance 1e-6", rows, "problem", ("method", "family", name_of),
        ("error", "largest", power), ("drift [1/s]", "drift", power),
        ("run [s]", "seconds", power), ("joints off by [m]", "residual", power),
    )  # fmt: skip


def work(record: Row, cost: str, label: str) -> Figure:
    """Largest energy error against cost, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        rows = [row for row in problem["runs"] if row["largest"]]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            x, y = [row[cost] for row in mine], [row["largest"] for row in mine]
            ax.loglog(x, y, marker=MARKS[mine[0]["hold"]], markersize=4, **style(mine[0]))
        ax.set(title=problem["title"], xlabel=label, ylabel="largest energy error [scale]")
        # within one decade the labels of minor ticks overlap
        ax.xaxis.set_minor_formatter(NullFormatter())

    return each(record["problems"], draw)


def over_time(record: Row) -> Figure:
    """|energy error| over time of one run of some families, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        for row in (row for row in problem["runs"] if "series" in row):
            size = np.abs(np.array(row["series"], dtype=float))[1:]
            ts = record["every"] * np.arange(1, size.size + 1)
            setting = "1e-6" if row["step"] is None else f"h = {1e3 * row['step']:g} ms"
            # round-off may give exactly zero, which a logarithm cannot show
            ax.semilogy(ts, np.maximum(size, 1e-17), linewidth=1, **style(row, f", {setting}"))
        ax.set(title=problem["title"], xlabel="t [s]", ylabel="|energy error| [scale]")

    return each(record["problems"], draw)


def each(problems: list[Row], draw: Callable[[Any, Row], None]) -> Figure:
    """One panel per problem, and one legend below all of them."""
    columns = min(3, len(problems))
    rows = -(-len(problems) // columns)
    figure, axes = panels(rows, columns, 4 * columns + 1, 3.3 * rows + 1.2)
    for ax, problem in zip(axes, problems, strict=True):
        draw(ax, problem)
        ax.grid(alpha=0.3)
    lines = legend_of(axes)
    figure.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=3)
    return figure


def style(row: Row, more: str = "") -> dict[str, Any]:
    """Colour, line and label of a run."""
    colour, line = COLOURS[row["solver"]], LINES[row["hold"]]
    return {"color": colour, "linestyle": line, "label": name_of(row["family"]) + more}
