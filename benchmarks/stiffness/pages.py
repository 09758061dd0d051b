"""Markdown tables and figures of the stiff benchmark, from its JSON record alone."""

import json
from pathlib import Path

from matplotlib.figure import Figure
from shared.pages import Row, panels, save, titled

NAMES = {"dopri8": "Dopri8", "tsit5": "Tsit5", "rodas5p": "Rodas5P", "kvaerno5": "Kvaerno5"}
STYLES = {"dopri8": "C0o-", "tsit5": "C1s-", "rodas5p": "C2^--", "kvaerno5": "C3v--"}


def show(path: Path, folder: Path) -> str:
    """Draw the figures into a folder; the tables, and where everything is."""
    return "\n".join([tables(path), *(str(figure) for figure in draw(path, folder))])


def tables(path: Path) -> str:
    """All tables of one record, for docs/stiff.md."""
    record = json.loads(path.read_text())
    levels = list(record["scenes"][0]["cheapest"])
    parts = [_cheapest(record, level) for level in levels]
    parts += [_eigenvalues(record), _runs(record, 1e-6), json.dumps(record["crossover"], indent=1)]
    return "\n\n".join([*parts, f"compile: {record['compile_seconds']}"])


def _best(row: Row | None) -> str:
    if row is None:
        return "-"
    return f"{row['seconds']:.2g} s, {NAMES[row['solver']]} {row['tolerance']:.0e}"


def _cheapest(record: Row, level: str) -> str:
    rows = []
    for scene in record["scenes"]:
        best = scene["cheapest"][level]
        ratio = best["explicit_over_implicit"]
        size = f"{scene['eigenvalue']['start']:.2g}"
        cells = [_best(best["explicit"]), _best(best["implicit"])]
        rows.append([scene["name"], size, *cells, "-" if ratio is None else f"{ratio:.2g}"])
    head = ["scene", "eigenvalue at the start [1/s]", "explicit", "implicit", "ratio"]
    return titled(f"Fastest run with an error up to {float(level):.0e} m", head, rows)


def _eigenvalues(record: Row) -> str:
    rows = []
    for scene in record["scenes"]:
        found = scene["eigenvalue"]
        real, imaginary = found["start_value"]
        apart = scene["reference"]["dopri8_apart"]
        start, median = f"{real:.2g} {imaginary:+.2g} i", f"{found['median']:.2g}"
        largest = f"{found['largest']:.2g} at {found['largest_at']:g} s"
        off = ", ".join("-" if a is None else f"{a:.0e}" for a in apart)
        rows.append([scene["name"], start, median, largest, off])
    head = ["scene", "at the start", "median", "largest on the way", "references apart [m]"]
    return titled("Largest eigenvalue in size [1/s]", head, rows)


def _runs(record: Row, tol: float) -> str:
    rows = []
    for scene in record["scenes"]:
        cells = [scene["name"]]
        for row in scene["runs"]:
            if row["tolerance"] == tol:
                error = "failed" if row["error"] is None else f"{row['error']:.0e} m"
                steps = f"{row['accepted']}+{row['rejected']}"
                cells.append(f"{steps}, {row['seconds']:.2g} s, {error}")
        rows.append(cells)
    solvers = dict.fromkeys(row["solver"] for row in record["scenes"][0]["runs"])
    head = ["scene", *(NAMES[solver] for solver in solvers)]
    return titled(f"At tolerance {tol:.0e}: steps+rejected, run, error", head, rows)


def draw(path: Path, folder: Path) -> list[Path]:
    """Write all figures as PNG; returns their paths."""
    record = json.loads(path.read_text())
    return save({"stiff_work": work(record), "stiff_crossover": crossover(record)}, folder)


def _completed(scene: Row) -> dict[str, list[Row]]:
    """Runs that reached the end, by solver."""
    solvers = dict.fromkeys(row["solver"] for row in scene["runs"])
    fine = lambda solver: [r for r in scene["runs"] if r["solver"] == solver and r["completed"]]
    return {solver: fine(solver) for solver in solvers}


def work(record: Row) -> Figure:
    """Error against run time of every solver, one panel per scene."""
    scenes = record["scenes"]
    columns = min(4, len(scenes))
    rows = -(-len(scenes) // columns)
    width, height = 3.6 * columns + 1, 3.2 * rows + 0.8
    figure, axes = panels(rows, columns, width, height, sharex=True, sharey=True)
    lines = {}
    for ax, scene in zip(axes, scenes, strict=False):
        for solver, fine in _completed(scene).items():
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


def crossover(record: Row) -> Figure:
    """Fastest run time to 1e-6 m against the largest eigenvalue at the start, by solver."""
    figure, (ax,) = panels(1, 1, 8, 4.6)
    start = lambda scene: scene["eigenvalue"]["start"]
    servos = sorted((s for s in record["scenes"] if s["stiffness"] > 0), key=start)
    for solver in dict.fromkeys(row["solver"] for row in record["scenes"][0]["runs"]):
        points = []
        for scene in servos:
            runs = _completed(scene).get(solver, [])
            if fine := [row["seconds"] for row in runs if row["error"] <= 1e-6]:
                points.append((start(scene), min(fine)))
        if points:
            ax.loglog(*zip(*points, strict=True), STYLES[solver], label=NAMES[solver])
    for scene in servos:
        at, place = start(scene), ax.get_xaxis_transform()
        beside = {"rotation": 90, "ha": "right", "fontsize": 8, "color": "0.4"}
        ax.text(at, 0.03, scene["name"] + " ", transform=place, **beside)
        ax.axvline(at, color="0.9", zorder=0)
    seconds = f"fastest run for {record['t1']:g} s to 1e-6 m [s]"
    ax.set(xlabel="largest |eigenvalue| at the start [1/s]", ylabel=seconds)
    # room for the scenes' names below the curves
    ax.set_ylim(bottom=0.2 * ax.dataLim.ymin)
    ax.grid(alpha=0.3)
    ax.legend()
    return figure
