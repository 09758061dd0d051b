"""Markdown tables and figures of the long-horizon benchmark, from its JSON record alone."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from shared.pages import Row, legend, number, panels, power, save, shown, titled

from stmuav_jax.figures import look

SOLVERS = {
    "dopri8": "Dopri8", "tsit5": "Tsit5", "gauss": "Gauss order 4", "midpoint": "midpoint order 2",
}  # fmt: skip
HOLDS = {"projection": "projected", "none": "unstabilised", "baumgarte": "Baumgarte"}
ERROR = "|energy error| / scale [1]"
# Colour and marker tell the solver; dash and filling tell what holds the joints.
LINES = {"projection": ("-", "full"), "none": ("--", "none"), "baumgarte": (":", "bottom")}


def name_of(family: str) -> str:
    """A family in words."""
    solver, hold = family.split(", ")
    # with fixed steps nothing but a projection could hold the joints
    words = "no projection" if family == "gauss, none" else HOLDS[hold]
    return f"{SOLVERS[solver]}, {words}"


def show(path: Path, folder: Path) -> str:
    """The tables for docs/simulation.md, and where the figures are that are drawn into a folder."""
    record = json.loads(path.read_text())
    problems = record["problems"]
    parts = [cheapest(problems, level) for level in problems[0]["cheapest"]]
    parts += [at_tolerance(problems), finest(problems)]
    figures = {
        "long_horizon_work": work(record, "seconds", "run time [s]"),
        "long_horizon_evaluations": work(record, "evaluations", "evaluations of x' = f(t, x) [1]"),
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
    """Cost against largest energy error, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        rows = [row for row in problem["runs"] if row["largest"]]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            x, y = [row["largest"] for row in mine], [row[cost] for row in mine]
            ax.loglog(x, y, **style(mine[0]))
        ax.set(title=problem["title"], xlabel=f"largest {ERROR}", ylabel=label)

    note = "Where a method has fewer points than elsewhere, its other runs did not reach the end."
    return each(record["problems"], draw, note)


def over_time(record: Row) -> Figure:
    """|energy error| over time of one run of some families, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        for row in (row for row in problem["runs"] if "series" in row):
            size = np.abs(np.array(row["series"], dtype=float))[1:]
            ts = record["every"] * np.arange(1, size.size + 1)
            setting = "1e-6" if row["step"] is None else f"h = {1e3 * row['step']:g} ms"
            # round-off may give exactly zero, which a logarithm cannot show
            ax.semilogy(ts, np.maximum(size, 1e-17), markevery=20, **style(row, f", {setting}"))
        ax.set(title=problem["title"], xlabel="time [s]", ylabel=ERROR)

    return each(record["problems"], draw, "Where a curve ends early, so did the run.")


def each(problems: list[Row], draw: Callable[[Any, Row], None], note: str) -> Figure:
    """One panel per problem, and one legend below all of them under a note."""
    columns = min(2, len(problems))
    rows = -(-len(problems) // columns)
    figure, axes = panels(rows, columns, 2.4 * rows + 1.0)
    for ax, problem in zip(axes, problems, strict=True):
        draw(ax, problem)
    legend(figure, axes, 3, 7, title=note)
    return figure


def style(row: Row, more: str = "") -> dict[str, Any]:
    """Colour, marker, line and label of a run."""
    line, filling = LINES[row["hold"]]
    own = {"linestyle": line, "fillstyle": filling, "markerfacecoloralt": "white"}
    return look(list(SOLVERS).index(row["solver"])) | own | {"label": name_of(row["family"]) + more}
