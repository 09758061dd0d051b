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
from typing import Any

from shared.command import begin, parser
from shared.record import write


def one(cache: Path, out: Path, t1: float) -> dict[str, float]:
    """Wall times of one run of the command line [s]."""
    command = [sys.executable, "-m", "stmuav_jax.cli", "simulate", "uav_tracker", "--case", "2"]
    command += ["--t1", str(t1), "--out", str(out)]
    clock = time.perf_counter()
    caches = {**os.environ, "XDG_CACHE_HOME": str(cache)}
    subprocess.run(command, env=caches, capture_output=True, check=True)
    total = time.perf_counter() - clock
    c = json.loads((out / "certificate.json").read_text())["certificate"]
    split = {"compile": "compile", "run": "run", "checks": "analysis"}
    parts = {name: c[f"{key}_seconds"] for name, key in split.items()}
    return {**parts, "rest": total - sum(parts.values()), "total": total}


def main() -> None:
    """Run and write `first_result.json`."""
    made = parser(__doc__)
    made.add_argument("--repeats", type=int, default=3)
    made.add_argument("--t1", type=float, default=2.0)
    options = made.parse_args()
    begin(options)
    runs: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for _ in range(options.repeats):
        with tempfile.TemporaryDirectory() as folder:
            for rows in runs.values():
                rows.append(one(Path(folder) / "cache", Path(folder) / "out", options.t1))
    result: dict[str, Any] = {
        "what": f"stmuav simulate uav_tracker --case 2 --t1 {options.t1:g}, seconds"
    }
    for kind, rows in runs.items():
        median = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
        result[kind] = {"median": median, "runs": rows}
        print(f"{kind}: {', '.join(f'{k} {v:.2f}' for k, v in median.items())}")
    print(write("first_result", result, options.results))


if __name__ == "__main__":
    main()
