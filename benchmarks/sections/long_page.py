"""Markdown tables and figures of the long-horizon benchmark, from its JSON record alone."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from shared.pages import Lines, Row, legend, number, panels, plain, power, save, table

from stmuav_jax.figures import look

SOLVERS = {
    "dopri8": "Dopri8", "tsit5": "Tsit5", "gauss": "Gauss order 4", "midpoint": "midpoint order 2",
}  # fmt: skip
HOLDS = {"projection": "projected", "none": "unstabilised", "baumgarte": "Baumgarte"}
EXPLICIT = ("dopri8", "tsit5")
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
    """The places of the figures that are drawn into a folder."""
    record = json.loads(path.read_text())
    figures = {
        "long_horizon_work": work(record, "seconds", "run time [s]", EXPLICIT),
        "long_horizon_evaluations": work(record, "evaluations", "evaluations of x' = f(t, x) [1]"),
        "long_horizon_energy": over_time(record),
    }
    return "\n".join(map(str, save(figures, folder)))


def comparisons(record: Row) -> Lines:
    """Symmetric runs against the best projected explicit run of at most as many evaluations."""
    rows = []
    for problem in record["problems"]:
        answer = problem["answers"]["evaluations"]
        count = lambda key, of=answer: f"{of[key]} of {of['compared']}"
        ratios = [pair["ratio"] for pair in answer["pairs"] if pair["family"].startswith("gauss")]
        symmetric = [row for row in problem["runs"] if row["solver"] not in EXPLICIT]
        failed = sum(not row["completed"] for row in symmetric)
        span = " to ".join(f"{ratio:.1g}" for ratio in sorted({min(ratios), max(ratios)}))
        rows.append([
            problem["title"], count("explicit_better"), span, count("explicit_drifts_less"),
            f"{failed} of {len(symmetric)}",
        ])  # fmt: skip
    head = ["problem", "explicit run has the smaller error", "error of the order-4 run / error of the explicit run",
            "explicit run drifts less", "symmetric runs that fail"]  # fmt: skip
    return table(head, rows)


def at_tolerance(record: Row) -> Lines:
    """Energy error and run time of Dopri8 at 1e-6 by stabilisation."""

    def of(problem: Row, hold: str) -> Row:
        mine = lambda row: (row["solver"], row["hold"], row["tolerance"]) == ("dopri8", hold, 1e-6)
        return next(row for row in problem["runs"] if mine(row))

    def cell(row: Row) -> str:
        if row["largest"] is None:
            return f"stops at {row['reached']:.2g} s"
        return f"{power(row['largest'])} ({plain(1e3 * row['seconds'])} ms)"

    rows = []
    for problem in record["problems"]:
        residual = number(of(problem, "none")["residual"], digits=2)
        rows.append([problem["title"], *(cell(of(problem, hold)) for hold in HOLDS), residual])
    return table(
        ["Dopri8 at 1e-6", *HOLDS.values(), "joint error of the unstabilised run [m]"], rows
    )


def cheapest(record: Row) -> Lines:
    """Milliseconds of the cheapest explicit run of each family with an energy error of at most 1e-9."""
    problems = record["problems"]
    families = [f for f in problems[0]["cheapest"]["1e-09"] if f.split(", ")[0] in EXPLICIT]

    def cell(problem: Row, family: str) -> str:
        best = problem["cheapest"]["1e-09"][family]
        return plain(best and 1e3 * best["seconds"])

    rows = [[name_of(f), *(cell(problem, f) for problem in problems)] for f in families]
    return table(["run time [ms]", *(problem["title"] for problem in problems)], rows)


def work(record: Row, cost: str, label: str, solvers: tuple[str, ...] = tuple(SOLVERS)) -> Figure:
    """Cost against largest energy error of some solvers, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        rows = [row for row in problem["runs"] if row["largest"] and row["solver"] in solvers]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            x, y = [row["largest"] for row in mine], [row[cost] for row in mine]
            ax.loglog(x, y, **style(mine[0]))
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
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
