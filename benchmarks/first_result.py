"""How long a new user waits: `stmuav simulate uav_tracker --case 2`, whole process.

Cold is a new cache folder for each run, warm the same folder again. The split comes from the
program's own certificate; "rest" is what remains of the whole process: building the scene,
results, figures.
"""

import json
import statistics
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import waiting
from shared.command import benchmark


def one(words: str, cache: Path, out: Path) -> dict[str, float]:
    """Wall times of one run of the command line [s]."""
    whole = waiting.one(words + " --out {out}", cache, out)
    if whole["exit"]:
        raise RuntimeError(f"stmuav {words} ended with exit code {whole['exit']}.")
    c = json.loads((out / "certificate.json").read_text())["certificate"]
    split = {"compile": "compile", "run": "run", "checks": "analysis"}
    parts = {name: c[f"{key}_seconds"] for name, key in split.items()}
    return {**parts, "rest": whole["wall"] - sum(parts.values()), "total": whole["wall"]}


def record(size: tuple[int, float]) -> Iterator[dict[str, Any]]:
    """Cold and warm runs, so many of each, to an end [s]."""
    repeats, t1 = size
    words = f"simulate uav_tracker --case 2 --t1 {t1:g}"
    runs: dict[str, list[dict[str, float]]] = {"cold": [], "warm": []}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            for rows in runs.values():
                rows.append(one(words, Path(folder) / "cache", Path(folder) / "out"))
    result: dict[str, Any] = {"what": f"stmuav {words}, seconds"}
    for kind, rows in runs.items():
        median = {key: statistics.median(row[key] for row in rows) for key in rows[0]}
        result[kind] = {"median": median, "runs": rows}
        print(f"{kind}: {', '.join(f'{k} {v:.2f}' for k, v in median.items())}")
    yield result


if __name__ == "__main__":
    benchmark("first_result", __doc__, record, ((3, 2.0), (1, 0.01)))
