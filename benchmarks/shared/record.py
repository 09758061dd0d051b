"""Records of benchmarks: results as JSON with their commit, versions and machine."""

import json
import os
import platform
import subprocess
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from stmuav_jax.io.netcdf import list_versions, write_atomically
from stmuav_jax.math.native.program import describe_code

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "benchmarks" / "results"
# Code that results depend on; a change of a result or a page is no change of the code.
MEASURED = ("stmuav_jax", "benchmarks", ":(exclude)benchmarks/results")


def run_git(*arguments: str) -> str | None:
    """Output of a git command in this repository; None where it fails or there is no git."""
    try:
        process = subprocess.run(
            ["git", *arguments], capture_output=True, text=True, cwd=ROOT, check=False
        )
    except OSError:
        return None
    return process.stdout.strip() if process.returncode == 0 else None


def has_code_of(commit: str) -> bool:
    """Whether the package and the benchmarks are the same files here as at a commit."""
    return run_git("diff", "--quiet", commit, "--", *MEASURED) is not None


def make_environment() -> dict[str, Any]:
    """Commit, whether its code was changed, versions, machine and date."""
    return {
        "commit": run_git("rev-parse", "HEAD") or "unknown", "dirty": not has_code_of("HEAD"),
        "versions": list_versions() | {"equations": describe_code()}, "cpu": platform.processor() or platform.machine(),
        "cores": os.cpu_count(), "load_at_start": os.getloadavg()[0],
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }  # fmt: skip


def write_record(name: str, content: dict[str, Any], folder: Path = RESULTS) -> Path:
    """Write one benchmark's result with its environment; returns the path."""
    text = json.dumps({"environment": make_environment(), **content}, indent=2) + "\n"
    return write_atomically(folder / f"{name}.json", text.encode())
