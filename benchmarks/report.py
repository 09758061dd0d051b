"""The suite's page, from its JSON files alone, and the figures of docs/failure.md from its own.

python benchmarks/report.py
"""

import argparse
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sections import failure_page, tables
from sections.figures import draw
from sections.state import state
from shared.pages import Lines, listed, save, table
from shared.record import RESULTS, ROOT

from stmuav_jax.files.netcdf import write_atomically

PAGE = ROOT / "docs" / "benchmarks.md"
# Section -> its title and what writes it, in the page's order.
PARTS: dict[str, tuple[str, Callable[[dict[str, Any]], Lines]]] = {
    "work_precision": ("Time against error, seven-body UAV", tables.curves),
    "acceleration": ("One acceleration", tables.acceleration),
    "batch": ("Many trajectories", tables.batch),
    "scaling": ("Chains of closed loops", tables.scaling),
    "gradient": ("Gradients", tables.gradient),
    "vector_steps": ("Steps of many flights at once", tables.vector_steps),
    "hexacopter": ("One free body against the same by hand", tables.hexacopter),
    "scenes": ("All scenes", tables.scenes),
    "published": ("Time against error, published problems", tables.curves),
    "stiff": ("Time against error, stiff variants", tables.curves),
}

# What is waited for: the file of the result, the title, and what writes it.
WAITING = (
    ("compile_times", "Compile times", tables.compile_times),
    ("waiting", "Commands", tables.commands),
)

HEAD = """# Benchmarks

Made by `python benchmarks/suite.py` from the files `suite_*.json` in `benchmarks/results/`; do not
edit. Times are medians of repeated runs after a warm-up, in brackets the distance between their
quartiles; runs longer than the time budget are timed once, without warm-up. Compilation, which for
JAX includes tracing, is apart. Errors are the largest distance of any body's centre of mass from a
converged reference at the end of the run. What failed or could not be run stays in the tables with
its reason.
"""


def load(folder: Path) -> dict[str, dict[str, Any]]:
    """The sections that have been run, in the page's order."""
    files = {name: folder / f"suite_{name}.json" for name in PARTS}
    return {name: json.loads(f.read_text()) for name, f in files.items() if f.exists()}


def circumstances(results: dict[str, dict[str, Any]]) -> Lines:
    """Where and on what every section was measured."""
    rows = []
    for name, result in results.items():
        e = result["environment"]
        commit = e["commit"][:10] + (" with changes" if e["dirty"] else "")
        took, machine = f"{result['took_seconds']:.0f}", result.get("machine", e["cpu"])
        rows.append([name, e["date"], commit, machine, e["cores"], e["versions"]["device"], took])
    head = ["section", "date", "commit", "processor", "cores", "device", "took [s]"]
    versions = next(iter(results.values()))["environment"]["versions"]
    listed = ", ".join(f"{k} {v}" for k, v in versions.items() if k != "device")
    return [*table(head, rows), "", f"Versions (first section): {listed}."]


def compared(results: dict[str, dict[str, Any]]) -> Lines:
    """The peers, with versions and caveats, and those that were skipped."""

    def unique(key: str) -> list[dict[str, Any]]:
        found = (row for result in results.values() for row in result[key])
        return list({row["method"]: row for row in found}.values())

    there, absent = unique("peers"), unique("skipped")
    how = ("how it is run", None, lambda peer: peer.get("how", "not recorded"))
    left = ("what is left out or done differently", "caveats", " ".join)
    lines = listed(there, ("program", "method"), "version", how, left)
    lines = lines if there else ["No other program was run."]
    gone = ["", *listed(absent, ("skipped", "method"), ("why", "reason"))] if absent else []
    return [*lines, *gone]


def build(results: Path, page: Path) -> Path:
    """Write the page; beside it in `figures` its figures and docs/failure.md's; returns its path."""
    found = load(results)
    if not found:
        raise SystemExit(f"There are no results in {results}.")
    folder = page.parent / "figures"
    figures = draw(found, folder / "benchmarks")
    if (failure := results / "failure.json").exists():
        save(failure_page.figures(json.loads(failure.read_text())), folder / "failure")
    lines = [HEAD]
    if any(result["size"] != "full" for result in found.values()):
        lines += ["**Some sections were run at the smallest size: no measurements.**", ""]
    lines += [*circumstances(found), "", *state(results), ""]
    lines += ["## Compared with", "", *compared(found)]
    for name, result in found.items():
        title, write = PARTS[name]
        lines += ["", f"## {title}", "", f"{result['what'][0].upper()}{result['what'][1:]}.", ""]
        for figure in figures.get(name, []):
            place = os.path.relpath(figure, page.parent)
            lines += [f"![{figure.stem.replace('_', ' ')}]({place})", ""]
        lines += write(result)
    for name, title, write in WAITING:
        if (file := results / f"{name}.json").exists():
            lines += ["", f"## {title}", "", *write(json.loads(file.read_text()))]
    text = "\n".join(lines).rstrip() + "\n"
    return write_atomically(page, text.encode())


def main() -> None:
    """Make the page from the results that are there."""
    parser = argparse.ArgumentParser(description="Write the benchmark page.")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--page", type=Path, default=PAGE)
    options = parser.parse_args()
    print(build(options.results, options.page))


if __name__ == "__main__":
    main()
