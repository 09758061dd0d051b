"""Markdown tables and figures of the stiff benchmark, from its JSON record alone."""

import json
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from shared.pages import Row, legend, number, panels, power, save, shown, titled

from stmuav_jax.figures import look

NAMES = {"dopri8": "Dopri8", "tsit5": "Tsit5", "rodas5p": "Rodas5P", "kvaerno5": "Kvaerno5"}
STYLES = {solver: look(k) | {"label": name} for k, (solver, name) in enumerate(NAMES.items())}


def show(path: Path, folder: Path) -> str:
    """The tables for docs/simulation.md, and where the figures are that are drawn into a folder."""
    record = json.loads(path.read_text())
    scenes = record["scenes"]
    parts = [fastest(scenes, level) for level in scenes[0]["cheapest"]]
    parts += [eigenvalues(scenes), at_tolerance(scenes, 1e-6)]
    parts += [json.dumps(record["crossover"], indent=1), f"compile: {record['compile_seconds']}"]
    drawn = save({"stiff_work": work(record), "stiff_crossover": crossover(record)}, folder)
    return shown(parts, drawn)


def fastest(scenes: list[Row], level: str) -> str:
    """The fastest runs with an error up to a level."""

    def best(kind: str) -> Any:
        def cell(scene: Row) -> str:
            row = scene["cheapest"][level][kind]
            said = row and f"{row['seconds']:.2g} s, {NAMES[row['solver']]} {row['tolerance']:.0e}"
            return said or "-"

        return (kind, None, cell)

    return titled(
        f"Fastest run with an error up to {float(level):.0e} m", scenes, ("scene", "name"),
        ("eigenvalue at the start [1/s]", "eigenvalue", lambda e: number(e["start"], digits=2)),
        best("explicit"), best("implicit"),
        ("ratio", "cheapest", lambda c: number(c[level]["explicit_over_implicit"], digits=2)),
    )  # fmt: skip


def eigenvalues(scenes: list[Row]) -> str:
    """The largest eigenvalue at the start and on the way, and what the references differ by."""
    at_start = lambda e: "{:.2g} {:+.2g} i".format(*e["start_value"])
    on_the_way = lambda e: f"{e['largest']:.2g} at {e['largest_at']:g} s"
    apart = lambda r: ", ".join(power(a, 0) for key in r if key.endswith("_apart") for a in r[key])
    return titled(
        "Largest eigenvalue in size [1/s]", scenes, ("scene", "name"),
        ("at the start", "eigenvalue", at_start),
        ("median", "eigenvalue", lambda e: f"{e['median']:.2g}"),
        ("largest on the way", "eigenvalue", on_the_way),
        ("references apart [m]", "reference", apart),
    )  # fmt: skip


def at_tolerance(scenes: list[Row], tol: float) -> str:
    """Every solver's steps, run time and error at one tolerance."""

    def of(solver: str) -> Any:
        def cell(runs: list[Row]) -> str:
            row = next(r for r in runs if (r["solver"], r["tolerance"]) == (solver, tol))
            error = "failed" if row["error"] is None else f"{row['error']:.0e} m"
            return f"{row['accepted']}+{row['rejected']}, {row['seconds']:.2g} s, {error}"

        return (NAMES[solver], "runs", cell)

    title = f"At tolerance {tol:.0e}: steps+rejected, run, error"
    return titled(title, scenes, ("scene", "name"), *map(of, solvers(scenes)))


def solvers(scenes: list[Row]) -> list[str]:
    """All solvers, in order."""
    return list(dict.fromkeys(row["solver"] for row in scenes[0]["runs"]))


def completed(scene: Row, solver: str) -> list[Row]:
    """A solver's runs that reached the end."""
    return [r for r in scene["runs"] if r["solver"] == solver and r["completed"]]


def named(scene: Row) -> str:
    """A scene's name, with the unit of the servo's stiffness."""
    return scene["name"] + (" N/m" if "e+" in scene["name"] else "")


def work(record: Row) -> Figure:
    """Run time against error of every solver, one panel per scene."""
    scenes = record["scenes"]
    columns = min(3, len(scenes))
    rows = -(-len(scenes) // columns)
    figure, axes = panels(rows, columns, 2.1 * rows + 0.8, sharex=True, sharey=True)
    for ax, scene in zip(axes, scenes, strict=False):
        for solver in solvers(scenes):
            fine = completed(scene, solver)
            ax.loglog([r["error"] for r in fine], [r["seconds"] for r in fine], **STYLES[solver])
        ax.set_title(named(scene))
    for ax in axes[len(scenes) :]:
        ax.set_axis_off()
    # of shared axes only the last row has labels, which an incomplete row leaves out for some columns
    for ax in axes[len(scenes) - columns : len(scenes)]:
        ax.tick_params(labelbottom=True)
    figure.supxlabel("largest position error [m]", fontsize=9)
    figure.supylabel(f"run time for {record['t1']:g} s of motion [s]", fontsize=9)
    legend(figure, axes, 4, loc="outside upper center")
    return figure


def crossover(record: Row) -> Figure:
    """Fastest run time to 1e-6 m against the largest eigenvalue at the start, by solver."""
    figure, (ax,) = panels(1, 1, 3.8)
    start = lambda scene: scene["eigenvalue"]["start"]
    servos = sorted((s for s in record["scenes"] if s["stiffness"] > 0), key=start)
    for solver in solvers(record["scenes"]):
        points = []
        for scene in servos:
            runs = completed(scene, solver)
            if fine := [row["seconds"] for row in runs if row["error"] <= 1e-6]:
                points.append((start(scene), min(fine)))
        if points:
            ax.loglog(*zip(*points, strict=True), **STYLES[solver])
    for scene in servos:
        at, place = start(scene), ax.get_xaxis_transform()
        beside = {"rotation": 90, "ha": "right", "fontsize": 7, "color": "0.4"}
        ax.text(at, 0.03, named(scene) + " ", transform=place, **beside)
        ax.axvline(at, color="0.9", zorder=0)
    seconds = f"fastest run for {record['t1']:g} s of motion,\nerror up to 1e-6 m [s]"
    ax.set(xlabel="largest |eigenvalue| at the start [1/s]", ylabel=seconds)
    # room for the scenes' names below the curves
    ax.set_ylim(bottom=0.05 * ax.dataLim.ymin)
    ax.legend(fontsize=8, handlelength=3, loc="upper left")
    return figure
