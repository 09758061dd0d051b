"""How long a new user waits: `stmuav simulate uav_tracker --case 2`, whole process.

Cold is a new cache folder for each run, warm the same folder again. The split comes from the
program's own certificate; "rest" is what remains of the whole process: building the scene,
results, figures.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from shared.command import begin, parser
from shared.record import write


def one(cache: Path, out: Path, t1: float) -> dict[str, float]:
    """Wall times of one run of the command line [s]."""
    command = [sys.executable, "-m", "stmuav_jax.cli", "simulate", "uav_tracker", "--case", "2"]
    clock = time.perf_counter()
    subprocess.run(
        [*command, "--t1", str(t1), "--out", str(out)],
        env={**os.environ, "XDG_CACHE_HOME": str(cache)},
        capture_output=True,
        text=True,
        check=True,
    )
    total = time.perf_counter() - clock
    c = json.loads((out / "certificate.json").read_text())["certificate"]
    split = {
        "compile": c["compile_seconds"],
        "run": c["run_seconds"],
        "checks": c["analysis_seconds"],
    }
    return {**split, "rest": total - sum(split.values()), "total": total}


def median(rows: list[dict[str, float]]) -> dict[str, float]:
    """Median of every figure."""
    return {key: statistics.median(row[key] for row in rows) for key in rows[0]}


def main() -> None:
    """Run and write `first_result.json`."""
    made = parser(__doc__)
    made.add_argument("--repeats", type=int, default=3)
    made.add_argument("--t1", type=float, default=2.0)
    options = made.parse_args()
    begin(options)
    cold, warm = [], []
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            cache, out = Path(folder) / "cache", Path(folder) / "out"
            cold.append(one(cache, out, options.t1))
            warm.append(one(cache, out, options.t1))
    result = {
        "what": f"stmuav simulate uav_tracker --case 2 --t1 {options.t1:g}, seconds",
        "cold": {"median": median(cold), "runs": cold},
        "warm": {"median": median(warm), "runs": warm},
    }
    path = write("first_result", result, options.results)
    for kind in ("cold", "warm"):
        line = ", ".join(f"{k} {v:.2f}" for k, v in result[kind]["median"].items())
        print(f"{kind}: {line}")
    print(path)


if __name__ == "__main__":
    main()
