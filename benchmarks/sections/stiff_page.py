"""Markdown table and figures of the stiff benchmark, from its JSON record alone."""

import json
from pathlib import Path

from matplotlib.figure import Figure
from shared.pages import Lines, Row, legend, panels, plain, save, table

from stmuav_jax.figures import look

NAMES = {"dopri8": "Dopri8", "tsit5": "Tsit5", "kvaerno5": "Kvaerno5"}
STYLES = {solver: look(k) | {"label": name} for k, (solver, name) in enumerate(NAMES.items())}


def show(path: Path, folder: Path) -> str:
    """The places of the figures that are drawn into a folder."""
    record = json.loads(path.read_text())
    figures = {"stiff_work": work(record), "stiff_crossover": crossover(record)}
    return "\n".join(map(str, save(figures, folder)))


def fastest(record: Row) -> Lines:
    """The fastest explicit and implicit run with an error of at most 1e-6 m, by scene."""

    def best(row: Row | None) -> str:
        if row is None:
            return "not reached"
        return f"{plain(1e3 * row['seconds'])} ms, {NAMES[row['solver']]} {row['tolerance']:.0e}"

    rows = []
    for scene in record["scenes"]:
        found, eigenvalue = scene["cheapest"]["1e-06"], scene["eigenvalue"]
        rows.append([
            named(scene), *(plain(eigenvalue[key]) for key in ("start", "median", "largest")),
            best(found["explicit"]), best(found["implicit"]), plain(found["explicit_over_implicit"]),
        ])  # fmt: skip
    head = ["scene", "largest eigenvalue at the start [1/s]", "median", "largest", "explicit", "implicit",
            "explicit / implicit"]  # fmt: skip
    return table(head, rows)


def solvers(scenes: list[Row]) -> list[str]:
    """All solvers, in order."""
    return list(dict.fromkeys(row["solver"] for row in scenes[0]["runs"]))


def completed(scene: Row, solver: str) -> list[Row]:
    """A solver's runs that reached the end."""
    return [r for r in scene["runs"] if r["solver"] == solver and r["completed"]]


def named(scene: Row) -> str:
    """A scene in words, with the stiffness and the damping of its servos."""
    if scene["stiffness"]:
        return f"servo {scene['stiffness']:.0e} N/m, {scene['damping']:,g} N s/m"
    return "no force on the sliders" if scene["name"] == "free" else scene["name"]


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
        label = named(scene).replace(", ", "\n")
        ax.text(at, 0.03, label, transform=place, **beside)
        ax.axvline(at, color="0.9", zorder=0)
    seconds = f"fastest run for {record['t1']:g} s of motion,\nerror up to 1e-6 m [s]"
    ax.set(xlabel="largest |eigenvalue| at the start [1/s]", ylabel=seconds)
    # room for the scenes' names below the curves
    ax.set_ylim(bottom=0.05 * ax.dataLim.ymin)
    ax.legend(fontsize=8, handlelength=3, loc="upper left")
    return figure
