"""Provenance of benchmark results: the commit, versions and machine that each of them names.

A result says which commit it was measured on. That is only worth something if the tree was that
commit: results that are kept in the repository are not overwritten from a tree with changes, nor
by a package from elsewhere, unless `--allow-dirty` says so, which the result then records.

A commit's name is lost when commits are put together into one. Results therefore also name their
sources: a digest of the package's and the benchmarks' files, by which any commit that has these
files is found.
"""

import hashlib
import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import stmuav_jax
from stmuav_jax.files.netcdf import versions, write_atomically

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
# What benchmarks measure: commits that touch nothing of it leave results valid.
MEASURED = ("stmuav_jax", "benchmarks", ":(exclude)benchmarks/results")
# What benchmarks write into the tree; a change there is a result, not a change of the code.
WRITTEN = tuple(
    f":(exclude){place}"
    for place in (
        "benchmarks/results",
        "docs/benchmarks.md",
        "docs/throughput.md",
        "docs/hard.md",
        "docs/figures",
    )
)
# `--allow-dirty` for scripts that are started by others.
ALLOW = "STMUAV_BENCHMARKS_ALLOW_DIRTY"


class DirtyTreeError(RuntimeError):
    """Committed results would be overwritten by what no commit can reproduce."""


def git(*arguments: str) -> str | None:
    """Output of a git command in this repository; None where it fails or there is no git."""
    try:
        done = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, cwd=ROOT, check=False
        )
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def commit() -> str:
    """The commit that is checked out; "unknown" without a repository."""
    return git("rev-parse", "HEAD") or "unknown"


def in_history(name: str) -> bool:
    """Whether a commit is one of those that led to what is checked out."""
    return git("merge-base", "--is-ancestor", name, "HEAD") is not None


def sources(name: str = "HEAD") -> str | None:
    """Digest of the package's and the benchmarks' files at a commit, results left out."""
    listed = git("ls-tree", "-r", name, "--", "stmuav_jax", "benchmarks")
    if not listed:
        return None
    kept = [line for line in listed.splitlines() if "\tbenchmarks/results/" not in line]
    return hashlib.sha256("\n".join(kept).encode()).hexdigest()[:40]


def traced(about: dict[str, Any]) -> str | None:
    """The commit of the history that has the code of a result; None if there is none.

    Args:
        about: the result's environment, or that of one of its parts.
    """
    if in_history(about["commit"]):
        return about["commit"]
    wanted = about.get("sources")
    if wanted is None:
        return None
    # a commit that touches neither has the sources of the one before
    touching = git("log", "--format=%H", "HEAD", "--", *MEASURED) or ""
    return next((name for name in touching.split() if sources(name) == wanted), None)


def moved(since: str, *places: str) -> int | None:
    """How many later commits touch the places; None if the commit is not in the history."""
    if not in_history(since):
        return None
    count = git("rev-list", "--count", f"{since}..HEAD", "--", *places)
    return None if count is None else int(count)


def changes() -> list[str]:
    """Files that differ from the commit, those that benchmarks write left out.

    Untracked files count where Python would import them.
    """
    tracked = git("diff", "--name-only", "HEAD", "--", ".", *WRITTEN) or ""
    new = git("ls-files", "--others", "--exclude-standard", "--", *MEASURED) or ""
    fresh = (name for name in new.splitlines() if name.endswith(".py"))
    return sorted({*tracked.splitlines(), *fresh})


def elsewhere() -> str:
    """Where the measured package lies if not in this tree; empty if it does."""
    place = Path(stmuav_jax.__file__).resolve().parents[1]
    return "" if place == ROOT.resolve() else str(place)


def environment() -> dict[str, Any]:
    """Commit, what differs from it, versions, machine and date."""
    changed = changes()
    return {
        "commit": commit(), "sources": sources(), "dirty": bool(changed), "changed": changed,
        "package_from_elsewhere": bool(elsewhere()), "allow_dirty": allowed(),
        "versions": versions(), "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(), "load_at_start": os.getloadavg()[0],
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def allowed() -> bool:
    """Whether committed results may be overwritten from a tree with changes."""
    return os.environ.get(ALLOW) == "1"


def refuse(folder: Path) -> None:
    """Raise where results of this tree may not be kept in the folder.

    Raises:
        DirtyTreeError: the folder is that of the committed results, and the tree differs from its
            commit or the package is not the tree's, and nobody allowed it.
    """
    if folder.resolve() != RESULTS.resolve() or allowed():
        return
    advice = "Commit first, give --results another folder, or say --allow-dirty."
    if found := changes():
        listed = ", ".join(found[:5]) + (f" and {len(found) - 5} more" if found[5:] else "")
        raise DirtyTreeError(
            f"The committed results would be overwritten from a tree that differs from its "
            f"commit in {listed}, so that nobody could reproduce them. {advice}"
        )
    if place := elsewhere():
        raise DirtyTreeError(
            f"The measured package lies in {place}, not in this tree ({ROOT}), so that the commit "
            f"of the results would be another's. {advice}"
        )


def write(name: str, content: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write one benchmark's result; returns the path.

    Raises:
        DirtyTreeError: committed results, and a tree with changes; the result is then kept in a
            folder beside, which the message names.
    """
    text = json.dumps({"environment": environment(), **content}, indent=2) + "\n"
    try:
        refuse(folder)
    except DirtyTreeError as error:
        # what took hours is not thrown away
        kept = write_atomically(ROOT / "build" / "results" / f"{name}.json", text.encode())
        raise DirtyTreeError(f"{error} The result is kept as {kept}.") from None
    return write_atomically(folder / f"{name}.json", text.encode())
