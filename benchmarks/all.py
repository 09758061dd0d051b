"""Run every benchmark of the documentation's pages again, in order, on one commit.

    python benchmarks/all.py            what has no result of this code yet, then the pages
    python benchmarks/all.py --list     what there is, and what would be run
    python benchmarks/all.py --only stiff suite_batch

Each benchmark is a process of its own on one core. A result is there if it was measured on a
clean tree at a commit since which neither the package nor the benchmarks have changed; so an
interrupted call goes on where it was, and committing results in between is no reason to measure
again (`--again` is one). What fails is named at the end, and the others are run all the same.
"""

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

from report import PARTS
from shared.command import begin, parser
from shared.record import ALLOW, MEASURED, RESULTS, ROOT, commit, moved, traced

FOLDER = Path(__file__).parent
ALONE = (
    "stiff", "hard", "long_horizon", "trims", "singular", "errors", "estimation", "waiting",
    "failure", "compile_times", "montecarlo", "batch_sizes", "missions",
)  # fmt: skip
# Result -> the script that measures it, with its arguments, in the order of running.
BENCHMARKS: dict[str, tuple[str, ...]] = {
    **{f"suite_{name}": ("suite.py", "--only", name, "--no-report") for name in PARTS},
    **{name: (f"{name}.py",) for name in ALONE},
}
# Parts of a result that no script measures any more: their question is settled, and they stay as
# they were measured (docs/failure.md and docs/long_times.md name the commits of their scripts).
FINISHED = {
    "failure": {"trials", "stiffness", "long", "alignment", "nature", "collapses"},
    "long_horizon": {"symmetric"},
}
# These measure more than one core, or the command line as a user starts it.
ALL_CORES = ("montecarlo", "waiting")
THREADS = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def why_again(name: str, results: Path) -> str:
    """Why a benchmark has to be run; empty if its result is that of this code."""
    path = results / f"{name}.json"
    if not path.exists():
        return "There is no result."
    content = json.loads(path.read_text())
    about = content["environment"]
    # a result made of parts says for each where it was measured
    parts = content.get("measured", {})
    now = [part for key, part in parts.items() if key not in FINISHED.get(name, ())]
    for part in (about, *now):
        if part["dirty"] or part.get("package_from_elsewhere"):
            return f"Measured on {part['commit'][:10]} with changes."
        code = traced(part)
        since = code and moved(code, *MEASURED)
        if since is None:
            return f"Measured on {part['commit'][:10]}, which is not in the history."
        if since:
            return f"Measured {since} commits ago, on {part['commit'][:10]}."
    return ""


def run(name: str, results: Path, *, allow_dirty: bool) -> tuple[bool, float]:
    """Run one benchmark; whether it succeeded, and its seconds."""
    script, *arguments = BENCHMARKS[name]
    pin = ["taskset", "-c", "1"] if name not in ALL_CORES and shutil.which("taskset") else []
    if (os.cpu_count() or 1) < 2:
        pin = []
    command = [*pin, sys.executable, str(FOLDER / script), *arguments, "--results", str(results)]
    told = {ALLOW: "1"} if allow_dirty else {}
    clock = time.perf_counter()
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **THREADS, **told}, check=False)
    return done.returncode == 0, time.perf_counter() - clock


def main() -> None:
    """Run what is missing, then write the suite's page."""
    made = parser(__doc__, again="run also what is there", list="say what would be run, and end")
    made.add_argument("--only", nargs="+", choices=list(BENCHMARKS), default=list(BENCHMARKS))
    options = made.parse_args()
    results = options.results.resolve()
    reasons = {name: why_again(name, results) for name in options.only}
    todo = [name for name, reason in reasons.items() if reason or options.again]
    for name, reason in reasons.items():
        print(f"{name:20s} {reason or 'There, of this code.'}", flush=True)
    if options.list:
        return
    begin(options)
    failed = []
    for k, name in enumerate(todo, start=1):
        load = os.getloadavg()[0]
        print(f"\n[{k}/{len(todo)}] {name} on {commit()[:10]}, load {load:.1f}", flush=True)
        fine, seconds = run(name, results, allow_dirty=options.allow_dirty)
        failed += [] if fine else [name]
        print(f"[{k}/{len(todo)}] {name}: {'done' if fine else 'FAILED'} in {seconds:.0f} s")
    if results == RESULTS.resolve():
        subprocess.run([sys.executable, str(FOLDER / "report.py")], cwd=ROOT, check=True)
    if failed:
        raise SystemExit(f"Failed: {', '.join(failed)}. The next call runs them again.")


if __name__ == "__main__":
    main()
