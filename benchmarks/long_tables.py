"""The long-horizon record as Markdown tables, for docs/long_times.md."""

import json
from pathlib import Path
from typing import Any

NAMES = {
    "dopri8, projection": "Dopri8, projected",
    "dopri8, none": "Dopri8, unstabilised",
    "dopri8, baumgarte": "Dopri8, Baumgarte",
    "tsit5, projection": "Tsit5, projected",
    "tsit5, none": "Tsit5, unstabilised",
    "tsit5, baumgarte": "Tsit5, Baumgarte",
    "gauss, projection": "Gauss order 4, projected",
    "gauss, none": "Gauss order 4, no projection",
    "midpoint, projection": "midpoint order 2, projected",
}


def tables(path: Path) -> str:
    """All tables of one record."""
    problems = json.loads(path.read_text())["problems"]
    parts = [_cheapest(problems, level) for level in problems[0]["cheapest"]]
    parts += [_held(problems), _answers(problems), _finest(problems)]
    return "\n\n".join(parts)


def _table(title: str, head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return title + "\n\n" + "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _number(value: float | None, form: str = ".1e") -> str:
    return "-" if value is None else f"{value:{form}}"


def _cheapest(problems: list[dict[str, Any]], level: str) -> str:
    """Seconds of the cheapest run of each family that keeps the error below the level."""
    rows = []
    for family in problems[0]["cheapest"][level]:
        cells = [problem["cheapest"][level][family] for problem in problems]
        rows.append([NAMES[family], *(_number(c and c["seconds"], ".2g") for c in cells)])
    title = f"Seconds for an energy error up to {float(level):.0e} over the whole horizon"
    return _table(title, ["method", *(p["title"] for p in problems)], rows)


def _held(problems: list[dict[str, Any]]) -> str:
    """Error and drift at one tolerance with and without projection."""
    rows = []
    for problem in problems:
        for row in problem["runs"]:
            if row["tolerance"] == 1e-6:
                numbers = (row["largest"], row["drift"], row["seconds"], row["residual"])
                rows.append(
                    [problem["title"], NAMES[row["family"]], *(_number(n) for n in numbers)]
                )
    head = ["problem", "method", "error", "drift [1/s]", "run [s]", "joints off by [m]"]
    return _table("At tolerance 1e-6", head, rows)


def _answers(problems: list[dict[str, Any]]) -> str:
    """How often a projected explicit run is better than a fixed-step run that costs as much."""
    rows = []
    for problem in problems:
        cells = [problem["title"]]
        for cost in ("seconds", "evaluations"):
            for family in ("gauss, projection", "gauss, none", "midpoint, projection"):
                pairs = [p for p in problem["answers"][cost]["pairs"] if p["family"] == family]
                ratios = [p["ratio"] for p in pairs if p["ratio"] is not None]
                better = sum(ratio > 1 for ratio in ratios)
                span = f", {min(ratios):.0e} to {max(ratios):.0e}" if ratios else ""
                cells.append(f"{better} of {len(ratios)}{span}")
        rows.append(cells)
    short = ("Gauss, projected", "Gauss, none", "midpoint, projected")
    head = ["problem", *(f"{s}, by {c}" for c in ("seconds", "evaluations") for s in short)]
    return _table("Projected explicit better at equal cost, ratios of the errors", head, rows)


def _finest(problems: list[dict[str, Any]]) -> str:
    """The smallest error that each family reached, and runs that failed."""
    rows = []
    for family in problems[0]["cheapest"]["0.001"]:
        cells = []
        for problem in problems:
            mine = [row for row in problem["runs"] if row["family"] == family]
            whole = [row for row in mine if row["largest"] is not None]
            best = min(whole, key=lambda row: row["largest"], default=None)
            text = "-" if best is None else f"{best['largest']:.0e} ({best['seconds']:.2g} s)"
            failed = len(mine) - len(whole)
            cells.append(text + (f", {failed} of {len(mine)} failed" if failed else ""))
        rows.append([NAMES[family], *cells])
    return _table("Smallest error", ["method", *(p["title"] for p in problems)], rows)
