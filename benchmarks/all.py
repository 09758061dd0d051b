"""Run every benchmark of the documentation's pages, in order, then write the pages' tables.

    python benchmarks/all.py            what has no result of this code yet
    python benchmarks/all.py --list     what would be run, and why
    python benchmarks/all.py --only stiff suite_batch

Each benchmark is a process on one core. A result is current if it was measured on a clean tree
whose package and benchmarks have the files of this one, so that an interrupted call is resumed by
the next (`--again` measures all). Benchmarks that fail are named at the end.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from shared.record import ROOT, has_code_of, make_parser

FOLDER = Path(__file__).parent
SCRIPTS = (
    "stiff", "hard", "long_horizon", "trims", "singular", "errors", "estimation", "waiting",
    "failure", "compile_times", "structures", "montecarlo", "batch_sizes", "machine_code", "by_mechanism",
    "missions", "flight_logs",
)  # fmt: skip
# Sections of suite.py, in the order of running.
SUITE = (
    "work_precision", "batch", "scaling", "gradient", "vector_steps", "hexacopter", "published", "stiff",
)  # fmt: skip
# Result -> the script that measures it, with its arguments, in the order of running.
BENCHMARKS: dict[str, tuple[str, ...]] = {
    **{f"suite_{name}": ("suite.py", "--only", name) for name in SUITE},
    **{name: (f"{name}.py",) for name in SCRIPTS},
}
# Parts of a result that no script measures any more: their question is settled, and they stay as
# they were measured (docs/validation.md names the commits of their scripts).
FINISHED = {
    "failure": {"trials", "stiffness", "long", "alignment", "nature", "collapses"},
    "long_horizon": {"symmetric"},
}
# These measure more than one core, or the command line as a user starts it.
ALL_CORES = ("montecarlo", "waiting")
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def describe_age(path: Path) -> str:
    """Why a result has to be measured again; empty if it is that of this code."""
    if not path.exists():
        return "There is no result."
    content = json.loads(path.read_text())
    parts = content.get("measured", {})
    current = [part for key, part in parts.items() if key not in FINISHED.get(path.stem, ())]
    for environment in (content["environment"], *current):
        commit = environment["commit"]
        if environment["dirty"]:
            return f"Measured on {commit[:10]} with changes."
        if not has_code_of(commit):
            return f"Measured on {commit[:10]}, which has other code."
    return ""


def run_benchmark(name: str, results: Path) -> bool:
    """Run one benchmark; whether it succeeded."""
    script, *arguments = BENCHMARKS[name]
    is_pinned = name not in ALL_CORES and shutil.which("taskset") and (os.cpu_count() or 1) > 1
    pin = ["taskset", "-c", "1"] if is_pinned else []
    command = [*pin, sys.executable, str(FOLDER / script), *arguments, "--results", str(results)]
    return subprocess.run(command, cwd=ROOT, env={**os.environ, **THREADS}).returncode == 0


def main() -> None:
    """Run the benchmarks that have no current result, then write the page."""
    options = make_parser(__doc__, again="run also what is current", list="say what would be run")
    options.add_argument("--only", nargs="+", choices=list(BENCHMARKS), default=list(BENCHMARKS))
    chosen = options.parse_args()
    results = chosen.results.resolve()
    ages = {name: describe_age(results / f"{name}.json") for name in chosen.only}
    for name, age in ages.items():
        print(f"{name:20s} {age or 'Current.'}", flush=True)
    if chosen.list:
        return
    failures = []
    due = [name for name, age in ages.items() if age or chosen.again]
    for k, name in enumerate(due, start=1):
        print(f"\n[{k}/{len(due)}] {name}, load {os.getloadavg()[0]:.1f}", flush=True)
        clock = time.perf_counter()
        if not run_benchmark(name, results):
            failures.append(name)
        print(f"[{k}/{len(due)}] {name} took {time.perf_counter() - clock:.0f} s", flush=True)
    subprocess.run([sys.executable, str(FOLDER / "report.py")], cwd=ROOT, check=True)
    if failures:
        raise SystemExit(f"Failed: {', '.join(failures)}. The next call runs them again.")


if __name__ == "__main__":
    main()
