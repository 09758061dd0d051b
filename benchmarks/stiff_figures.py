"""Figures of the stiff benchmark, from its JSON record alone."""

import json
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from stiff_tables import NAMES

STYLES = {"dopri8": "C0o-", "tsit5": "C1s-", "rodas5p": "C2^--", "kvaerno5": "C3v--"}


def draw(path: Path, folder: Path) -> list[Path]:
    """Write all figures as PNG; returns their paths."""
    record = json.loads(path.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    figures = {"stiff_work": work(record), "stiff_crossover": crossover(record)}
    paths = []
    for name, figure in figures.items():
        paths.append(folder / f"{name}.png")
        FigureCanvasAgg(figure).print_png(str(paths[-1]))
    return paths


def work(record: dict[str, Any]) -> Figure:
    """Error against run time of every solver, one panel per scene."""
    scenes = record["scenes"]
    columns = min(4, len(scenes))
    rows = -(-len(scenes) // columns)
    figure = Figure(figsize=(3.6 * columns + 1, 3.2 * rows + 0.8), layout="constrained", dpi=110)
    axes = figure.subplots(rows, columns, squeeze=False, sharex=True, sharey=True).ravel()
    lines = {}
    for ax, scene in zip(axes, scenes, strict=False):
        for solver in dict.fromkeys(row["solver"] for row in scene["runs"]):
            fine = [r for r in scene["runs"] if r["solver"] == solver and r["completed"]]
            seconds, errors = [r["seconds"] for r in fine], [r["error"] for r in fine]
            (lines[NAMES[solver]],) = ax.loglog(seconds, errors, STYLES[solver], markersize=4)
        ax.set_title(scene["name"])
        ax.grid(alpha=0.3)
    for ax in axes[len(scenes) :]:
        ax.set_axis_off()
    figure.supxlabel(f"run time for {record['t1']:g} s [s]")
    figure.supylabel("largest position error [m]")
    figure.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=4)
    return figure


def crossover(record: dict[str, Any]) -> Figure:
    """Fastest run time to 1e-6 m against the largest eigenvalue at the start, by solver."""
    figure = Figure(figsize=(8, 4.6), layout="constrained", dpi=110)
    ax = figure.subplots()
    servos = [s for s in record["scenes"] if s["stiffness"] > 0]
    servos.sort(key=lambda s: s["eigenvalue"]["start"])
    for solver in dict.fromkeys(row["solver"] for row in record["scenes"][0]["runs"]):
        points = []
        for scene in servos:
            fine = [
                row["seconds"]
                for row in scene["runs"]
                if row["solver"] == solver and row["completed"] and row["error"] <= 1e-6
            ]
            if fine:
                points.append((scene["eigenvalue"]["start"], min(fine)))
        if points:
            ax.loglog(*zip(*points, strict=True), STYLES[solver], label=NAMES[solver])
    beside: dict[str, Any] = {"rotation": 90, "ha": "right", "fontsize": 8, "color": "0.4"}
    for scene in servos:
        at = scene["eigenvalue"]["start"]
        ax.text(at, 0.03, scene["name"] + " ", transform=ax.get_xaxis_transform(), **beside)
        ax.axvline(at, color="0.9", zorder=0)
    ax.set(
        xlabel="largest |eigenvalue| at the start [1/s]",
        ylabel=f"fastest run for {record['t1']:g} s to 1e-6 m [s]",
    )
    # room for the scenes' names below the curves
    ax.set_ylim(bottom=0.2 * ax.dataLim.ymin)
    ax.grid(alpha=0.3)
    ax.legend()
    return figure
