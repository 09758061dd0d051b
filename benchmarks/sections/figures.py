"""The figures of the documentation's pages, from the stored results alone."""

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter
from shared.pages import Row, comparable, describe_scene, legend, panels

from stmuav_jax.figures import look, save_figures

# Curves of the time against the error: method and solver in the results, colour and marker.
CURVES = {
    "stmuav_jax": ("stmuav-jax, tree", "Dopri8", "#0072B2", "o"),
    "Pinocchio in C++": ("Pinocchio (C++), Boost rkf78", "rkf78", "#D55E00", "s"),
    "MuJoCo": ("MuJoCo (C), RK4", "RK4", "#009E73", "^"),
    "Exudyn": ("Exudyn, generalised-alpha", "generalised-alpha", "#CC79A7", "D"),
    "heyoka": ("heyoka, Taylor series", "taylor", "#56B4E9", "P"),
    "the report's dense system in NumPy": ("NumPy, the report's dense system", "DOP853", "#666666", "v"),
}  # fmt: skip
STIFF_SOLVERS = {"dopri8": "Dopri8", "tsit5": "Tsit5", "kvaerno5": "Kvaerno5"}
STIFF_STYLES = {
    solver: look(k) | {"label": name} for k, (solver, name) in enumerate(STIFF_SOLVERS.items())
}
LONG_SOLVERS = {
    "dopri8": "Dopri8", "tsit5": "Tsit5", "gauss": "Gauss order 4", "midpoint": "midpoint order 2",
}  # fmt: skip
HOLDS = {"projection": "projected", "none": "unstabilised", "baumgarte": "Baumgarte"}
EXPLICIT = ("dopri8", "tsit5")
# Colour and marker tell the solver; dash and filling tell what holds the joints.
LINES = {"projection": ("-", "full"), "none": ("--", "none"), "baumgarte": (":", "bottom")}
ENERGY_ERROR = "|energy error| / scale [1]"


def draw_work_precision(record: Row) -> Figure:
    """Run time against error of the UAV to the last horizon, one colour a program."""
    curve = record["curves"][0]
    end = curve["horizons"][-1]
    figure, (ax,) = panels(1, 1, 4.2)
    figure.set_size_inches(5.4, 4.2)  # so that its words are legible on a window of 420 pixels
    for name, (method, solver, color, marker) in CURVES.items():
        points = sorted(
            (row["error"], 1e3 * row["seconds"]["median"])
            for row in curve["rows"]
            if (row["method"], row["solver"], row["horizon"]) == (method, solver, end)
            and (row["error"] and row["seconds"] and not row["failure"])
        )
        style = {"color": color, "marker": marker, "markersize": 5, "linewidth": 1.6}
        ax.loglog([x for x, _ in points], [y for _, y in points], **style, label=name)
    ax.set(xlabel="error of any body [m]", ylabel="run time [ms]")
    ax.set_title(f"{end:g} s of the seven-body UAV on one core")
    figure.legend(loc="outside lower center", ncols=2, fontsize=9)
    return figure


def draw_lanes(record: Row) -> Figure:
    """Flights per second by lanes."""
    figure, (ax,) = panels(1, 1, 3.2)
    lanes = [row["lanes"] for row in record["rows"]]
    ax.plot(lanes, [row["per_second"] for row in record["rows"]], **look(0), label="stmuav-jax")
    ax.axhline(record["one_lane_per_second"], color="0.4", linestyle=":", label="one by one")
    for k, peer in enumerate(comparable(record), 1):
        ax.axhline(peer["per_second"], **look(k) | {"marker": ""}, label=peer["method"])
    ax.set_xscale("log", base=2)
    ax.set_xticks(lanes, [str(k) for k in lanes])
    ax.set_ylim(bottom=0)
    ax.set_xlabel("flights that are integrated together (lanes)")
    ax.set_ylabel("flights per second, one core [1/s]")
    ax.legend(fontsize=8)
    return figure


def draw_machine_code(record: Row) -> Figure:
    """Operations before and after, and time per state against lanes."""
    figure = Figure(figsize=(8, 3.2), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(1, 2))
    operations = record["operations"]
    places = np.arange(len(operations))
    for k, (key, label) in enumerate((("traced", "as traced"), ("left", "machine code"))):
        left.bar(places + 0.4 * k, [o[key] for o in operations.values()], 0.4, label=label)
    left.set_xticks(places + 0.2, list(operations))
    left.set_ylabel("operations of one evaluation")
    rows = [row for row in record["rows"] if row["function"] == "right-hand side"]
    lanes = [row["lanes"] for row in rows]
    for key, label in (("xla", "XLA"), ("machine_code", "machine code")):
        right.loglog(lanes, [row[key]["us_per_state"] for row in rows], "o-", label=label)
    chains = [row["us_per_state"] for row in record["limit"]]
    right.loglog(lanes, chains, "k--", label="as many in short chains")
    right.set_xticks(lanes, [str(k) for k in lanes])
    right.set_xticks([], minor=True)
    right.set_xlabel("states at once")
    right.set_ylabel("time per right-hand side [us]")
    left.margins(y=0.35)
    left.legend(frameon=False, loc="upper right")
    right.legend(frameon=False, loc="center right")
    return figure


def completed(scene: Row, solver: str) -> list[Row]:
    """A solver's runs that reached the end."""
    return [r for r in scene["runs"] if r["solver"] == solver and r["completed"]]


def draw_stiff_work(record: Row) -> Figure:
    """Run time against error of every solver, one panel per scene."""
    scenes = record["scenes"]
    columns = min(3, len(scenes))
    rows = -(-len(scenes) // columns)
    figure, axes = panels(rows, columns, 2.1 * rows + 0.8, sharex=True, sharey=True)
    for ax, scene in zip(axes, scenes, strict=False):
        for solver in dict.fromkeys(row["solver"] for row in scenes[0]["runs"]):
            fine = completed(scene, solver)
            errors, seconds = ([r[key] for r in fine] for key in ("error", "seconds"))
            ax.loglog(errors, seconds, **STIFF_STYLES[solver])
        ax.set_title(describe_scene(scene))
    for ax in axes[len(scenes) :]:
        ax.set_axis_off()
    # of shared axes only the last row has labels, which an incomplete row leaves out for some columns
    for ax in axes[len(scenes) - columns : len(scenes)]:
        ax.tick_params(labelbottom=True)
    figure.supxlabel("largest position error [m]", fontsize=9)
    figure.supylabel(f"run time for {record['t1']:g} s of motion [s]", fontsize=9)
    legend(figure, axes, 4, loc="outside upper center")
    return figure


def draw_stiff_crossover(record: Row) -> Figure:
    """Fastest run time to 1e-6 m against the largest eigenvalue at the start, by solver."""
    figure, (ax,) = panels(1, 1, 3.8)
    start = lambda scene: scene["eigenvalue"]["start"]
    servos = sorted((s for s in record["scenes"] if s["stiffness"] > 0), key=start)
    for solver in dict.fromkeys(row["solver"] for row in record["scenes"][0]["runs"]):
        points = []
        for scene in servos:
            fine = [row for row in completed(scene, solver) if row["error"] <= 1e-6]
            if fine:
                points.append((start(scene), min(row["seconds"] for row in fine)))
        if points:
            ax.loglog(*zip(*points, strict=True), **STIFF_STYLES[solver])
    beside = {"rotation": 90, "ha": "right", "fontsize": 7, "color": "0.4"}
    for scene in servos:
        label = describe_scene(scene).replace(", ", "\n")
        ax.text(start(scene), 0.03, label, transform=ax.get_xaxis_transform(), **beside)
        ax.axvline(start(scene), color="0.9", zorder=0)
    seconds = f"fastest run for {record['t1']:g} s of motion,\nerror up to 1e-6 m [s]"
    ax.set(xlabel="largest |eigenvalue| at the start [1/s]", ylabel=seconds)
    # room for the scenes' names below the curves
    ax.set_ylim(bottom=0.05 * ax.dataLim.ymin)
    ax.legend(fontsize=8, handlelength=3, loc="upper left")
    return figure


def name_family(family: str) -> str:
    """A family of long runs in words."""
    solver, hold = family.split(", ")
    # with fixed steps nothing but a projection could hold the joints
    words = "no projection" if family == "gauss, none" else HOLDS[hold]
    return f"{LONG_SOLVERS[solver]}, {words}"


def style_run(row: Row, more: str = "") -> dict[str, Any]:
    """Colour, marker, line and label of a long run."""
    line, filling = LINES[row["hold"]]
    own = {"linestyle": line, "fillstyle": filling, "markerfacecoloralt": "white"}
    label = name_family(row["family"]) + more
    return look(list(LONG_SOLVERS).index(row["solver"])) | own | {"label": label}


def draw_problems(problems: list[Row], draw: Callable[[Any, Row], None], note: str) -> Figure:
    """One panel per problem, and one legend below all of them under a note."""
    columns = min(2, len(problems))
    rows = -(-len(problems) // columns)
    figure, axes = panels(rows, columns, 2.4 * rows + 1.0)
    for ax, problem in zip(axes, problems, strict=True):
        draw(ax, problem)
    legend(figure, axes, 3, 7, title=note)
    return figure


def draw_long_work(record: Row, cost: str, label: str, solvers: tuple[str, ...]) -> Figure:
    """Cost against largest energy error of some solvers, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        rows = [row for row in problem["runs"] if row["largest"] and row["solver"] in solvers]
        for family in dict.fromkeys(row["family"] for row in rows):
            mine = [row for row in rows if row["family"] == family]
            ax.loglog([r["largest"] for r in mine], [r[cost] for r in mine], **style_run(mine[0]))
        ax.yaxis.set_major_locator(LogLocator(subs=(1, 3)))
        ax.yaxis.set_major_formatter("{x:g}")
        ax.yaxis.set_minor_formatter(NullFormatter())
        ax.set(title=problem["title"], xlabel=f"largest {ENERGY_ERROR}", ylabel=label)

    note = "Where a method has fewer points than elsewhere, its other runs did not reach the end."
    return draw_problems(record["problems"], draw, note)


def draw_long_energy(record: Row) -> Figure:
    """|energy error| over time of one run of some families, one panel per problem."""

    def draw(ax: Any, problem: Row) -> None:
        for row in (row for row in problem["runs"] if "series" in row):
            size = np.abs(np.array(row["series"], dtype=float))[1:]
            ts = record["every"] * np.arange(1, size.size + 1)
            setting = "1e-6" if row["step"] is None else f"h = {1e3 * row['step']:g} ms"
            # round-off may give exactly zero, which a logarithm cannot show
            style = style_run(row, f", {setting}")
            ax.semilogy(ts, np.maximum(size, 1e-17), markevery=20, **style)
        ax.set(title=problem["title"], xlabel="time [s]", ylabel=ENERGY_ERROR)

    return draw_problems(record["problems"], draw, "Where a curve ends early, so did the run.")


# File of a figure -> its result, and the function that draws it.
FIGURES: dict[str, tuple[str, Callable[[Row], Figure]]] = {
    "work_precision": ("suite_work_precision", draw_work_precision),
    "lanes": ("montecarlo", draw_lanes),
    "machine_code": ("machine_code", draw_machine_code),
    "stiff_work": ("stiff", draw_stiff_work),
    "stiff_crossover": ("stiff", draw_stiff_crossover),
    "long_horizon_work": ("long_horizon", partial(
        draw_long_work, cost="seconds", label="run time [s]", solvers=EXPLICIT,
    )),
    "long_horizon_evaluations": ("long_horizon", partial(
        draw_long_work, cost="evaluations", label="evaluations of x' = f(t, x) [1]",
        solvers=tuple(LONG_SOLVERS),
    )),
    "long_horizon_energy": ("long_horizon", draw_long_energy),
}  # fmt: skip


def draw_figures(results: Path, folder: Path) -> list[Path]:
    """Write the figures of all results in a folder, as PNG for print; returns their paths."""
    figures = {}
    for name, (result, draw) in FIGURES.items():
        if (path := results / f"{result}.json").exists():
            figures[name] = draw(json.loads(path.read_text()))
            for ax in figures[name].axes:
                for text in (ax.title, ax.xaxis.label, ax.yaxis.label):
                    text.set_fontsize(9)
    return save_figures(figures, folder, dpi=160)
