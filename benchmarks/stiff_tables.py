"""The stiff record as Markdown tables, for docs/stiff.md."""

import json
from pathlib import Path
from typing import Any

NAMES = {"dopri8": "Dopri8", "tsit5": "Tsit5", "rodas5p": "Rodas5P", "kvaerno5": "Kvaerno5"}


def tables(path: Path) -> str:
    """All tables of one record."""
    record = json.loads(path.read_text())
    levels = list(record["scenes"][0]["cheapest"])
    parts = [_cheapest(record, level) for level in levels]
    parts += [_eigenvalues(record), _runs(record, 1e-6), json.dumps(record["crossover"], indent=1)]
    return "\n\n".join([*parts, f"compile: {record['compile_seconds']}"])


def _table(title: str, head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return title + "\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _best(row: dict[str, Any] | None) -> str:
    if row is None:
        return "-"
    return f"{row['seconds']:.2g} s, {NAMES[row['solver']]} {row['tolerance']:.0e}"


def _cheapest(record: dict[str, Any], level: str) -> str:
    rows = []
    for scene in record["scenes"]:
        best = scene["cheapest"][level]
        ratio = best["explicit_over_implicit"]
        size = f"{scene['eigenvalue']['start']:.2g}"
        cells = [_best(best["explicit"]), _best(best["implicit"])]
        rows.append([scene["name"], size, *cells, "-" if ratio is None else f"{ratio:.2g}"])
    head = ["scene", "eigenvalue at the start [1/s]", "explicit", "implicit", "ratio"]
    return _table(f"Fastest run with an error up to {float(level):.0e} m", head, rows)


def _eigenvalues(record: dict[str, Any]) -> str:
    rows = []
    for scene in record["scenes"]:
        found = scene["eigenvalue"]
        real, imaginary = found["start_value"]
        apart = scene["reference"]["dopri8_apart"]
        rows.append(
            [
                scene["name"],
                f"{real:.2g} {imaginary:+.2g} i",
                f"{found['median']:.2g}",
                f"{found['largest']:.2g} at {found['largest_at']:g} s",
                ", ".join("-" if a is None else f"{a:.0e}" for a in apart),
            ]
        )
    head = ["scene", "at the start", "median", "largest on the way", "references apart [m]"]
    return _table("Largest eigenvalue in size [1/s]", head, rows)


def _runs(record: dict[str, Any], tol: float) -> str:
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
    return _table(f"At tolerance {tol:.0e}: steps+rejected, run, error", head, rows)
