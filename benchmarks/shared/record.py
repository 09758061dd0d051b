"""Records of benchmarks: results as JSON with their commit, versions and machine; and their command line."""

import argparse
import json
import os
import platform
import subprocess
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import jax

from stmuav_jax.io.netcdf import list_versions, write_atomically
from stmuav_jax.math.native.program import describe_code

# Every benchmark computes in double precision; this comes before the package makes any array.
jax.config.update("jax_enable_x64", True)

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


def make_parser(about: str | None, **switches: str) -> argparse.ArgumentParser:
    """A parser with the option `--results` that all scripts share, and switches by name."""
    parser = argparse.ArgumentParser(
        description=about, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--results", type=Path, default=RESULTS)
    for name, help_text in switches.items():
        parser.add_argument(f"--{name}", action="store_true", help=help_text)
    return parser


def benchmark(
    name: str,
    about: str | None,
    measure: Callable[[Any], Iterator[dict[str, Any]]],
    sizes: tuple[Any, Any],
) -> None:
    """The main function of a benchmark.

    Args:
        measure: yields the record, and before it, if it takes long, what there is so far.
        sizes: the argument of `measure`, for the full run and with `--quick`.
    """
    options = make_parser(about, quick="the smallest size, for a smoke test").parse_args()
    for content in measure(sizes[options.quick]):
        print(write_record(name, content, options.results), flush=True)
