"""The page's section "State of the results": which code each result was measured on."""

import json
from pathlib import Path
from typing import Any

from shared.pages import Lines, table
from shared.record import commit, git, moved, traced

WORDS = """Every result names the commit that it was measured on. This table was made at {now} and
says of each result whether that commit, or another one with the same files of the package and the
benchmarks, is in the history of this repository. It says whether the tree had
changes beside the commit, how many commits have changed the package since, and how many processes
were running when it began. All cores count: what runs on one core has that core for itself, but shares
cache and memory with the others, so that above some 2 times and ratios of short runs scatter. Numbers of a result
that is not of the present package are those of an earlier one; times and errors may have changed.
`python benchmarks/all.py` measures again whatever is not of the present code."""


def age(about: dict[str, Any]) -> tuple[str, str]:
    """Whether the commit is in the history, and how far the package has moved since."""
    if git("rev-parse", "HEAD") is None:
        return "no history here", "-"
    if name := traced(about):
        there = "yes" if name == about["commit"] else f"as {name[:10]}, the same files"
        return there, str(moved(name, "stmuav_jax"))
    later = git("rev-list", "--count", f"--since={about['date']}", "HEAD", "--", "stmuav_jax")
    return "no", "-" if later is None else f"{later}, by date"


def rows_of(path: Path) -> list[list[str]]:
    """One row for a result, or one for each of its parts that were measured apart."""
    content = json.loads(path.read_text())
    told = content.get("measured") or {"": content["environment"]}
    rows = []
    for part, about in told.items():
        there, since = age(about)
        dirty = "yes" if about["dirty"] else "no"
        if about.get("package_from_elsewhere"):
            dirty += ", and a package from elsewhere"
        name = f"{path.stem}, {part}" if part else path.stem
        load = f"{about['load_at_start']:.0f}" if "load_at_start" in about else "-"
        rows.append([name, about["commit"][:10], about["date"][:10], dirty, there, since, load])
    return rows


def state(folder: Path) -> Lines:
    """The section, from all results in a folder."""
    head = ["result", "commit", "date", "tree with changes", "commit in the history",
            "commits to the package since", "load"]  # fmt: skip
    rows = [row for path in sorted(folder.glob("*.json")) for row in rows_of(path)]
    return ["## State of the results", "", WORDS.format(now=commit()[:10]), "", *table(head, rows)]
