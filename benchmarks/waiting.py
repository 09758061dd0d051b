"""How long each command of the command line keeps its user waiting: times and peak memory.

Each command with the example of its help, as a process of its own. Cold is a new cache folder for
each run, warm the same folder again. CPU time is that of all threads, user and system.
"""

import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from shared.record import benchmark

# Words of each command, with the folder for its results in the place of {out}.
COMMANDS = {
    "list": "list",
    "view, sketch": "view uav_tracker --out {out}",
    "check": "check uav_tracker --case 2",
    "simulate": "simulate uav_tracker --case 2 --out {out}",
    "simulate, loads": "simulate uav_tracker --case 2 --t1 1 --loads --out {out}",
    "view": "view {out} --html {out}/flight.html --sun 135 50",
    "fly": "fly case-1 --t1 5 --out {out}",
    "sun": "sun --lat 11.55 --lon 104.92 --date 2024-03-21 --timezone Asia/Phnom_Penh --out {out}",
    "trim": "trim --phi 10 --theta -5 --out {out}",
    "trim, sensitivities": "trim --phi 10 --theta -5 --by mass.panel_7 geometry.rods --out {out}",
    "trim, linear model": "trim --sun 150 60 --linear trim --out {out}",
    "tune hold": "tune hold uav_tracker --t1 0.4 --segments 8 --inputs speed_squared force_slider_2 "
    "force_slider_3 --out {out}",
    "tune slew": "tune slew uav_tracker --to U47.angle_1=0.4 U47.angle_2=0.3 --t1 1 --segments 5 --inputs "
    "speed_squared force_slider_2 force_slider_3 --out {out}",
    "estimate": "estimate --out {out}",
    "estimate, one case": "estimate --case 4 --seeds 20 --out {out}",
    "montecarlo": "montecarlo collapse --samples 64 --out {out}",
    "view, report": "view {out}/study.zarr --report {out}/report.html",
}
# Exit codes of commands that did their work; 3 is a verdict, such as that of an inconsistent filter.
DONE = (0, 3)
# Commands that read what another has written, which is run before them and not measured.
BEFORE = {"view": "simulate", "view, report": "montecarlo"}


def one(words: str, cache: Path, out: Path) -> dict[str, Any]:
    """Times [s] and peak memory [MB] of one run of the command line, which must succeed."""
    given = words.format(out=out).split()
    command = [sys.executable, "-m", "stmuav_jax", *given]
    clock = time.perf_counter()
    # Python keeps its bytecode, as it does of an installed package.
    ambient = {k: v for k, v in os.environ.items() if k != "PYTHONDONTWRITEBYTECODE"}
    process = subprocess.Popen(
        command,
        env={**ambient, "XDG_CACHE_HOME": str(cache)},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    _, status, used = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode not in DONE:
        raise SystemExit(f"`stmuav {' '.join(given)}` ended with exit code {process.returncode}.")
    return {
        "wall": time.perf_counter() - clock,
        "cpu": used.ru_utime + used.ru_stime,
        "memory": used.ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3),
        **split(out),
    }


def split(out: Path) -> dict[str, float]:
    """Seconds of a simulation's parts by its certificate; empty for other commands."""
    path = out / "certificate.json"
    told = json.loads(path.read_text())["certificate"] if path.exists() else {}
    return {part: told[f"{part}_seconds"] for part in ("compile", "run", "analysis") if told}


def least(runs: list[dict[str, Any]]) -> dict[str, float]:
    """Least CPU time, which the machine's other work lengthens, and medians of the rest."""
    medians = {k: statistics.median(run[k] for run in runs) for k in ("wall", "memory")}
    return {"cpu": min(run["cpu"] for run in runs), **medians}


def measured(name: str, repeats: int) -> dict[str, Any]:
    """Cold and warm runs of one command."""
    words = COMMANDS[name]
    runs: dict[str, list[dict[str, Any]]] = {"cold": [], "warm": []}
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            for kind in runs:
                # a study does not write over another
                out = Path(folder) / kind
                if name in BEFORE:
                    one(COMMANDS[BEFORE[name]], Path(folder) / "other", out)
                runs[kind].append(one(words, Path(folder) / "cache", out))
    return {"words": words, **{kind: {**least(own), "runs": own} for kind, own in runs.items()}}


def record(size: tuple[list[str], int]) -> Iterator[dict[str, Any]]:
    """What there is so far after each command, of so many repeats."""
    names, repeats = size
    found: dict[str, Any] = {}
    for name in names:
        found[name] = measured(name, repeats)
        for kind in ("cold", "warm"):
            told = (f"{k} {found[name][kind][k]:.1f}" for k in ("cpu", "wall", "memory"))
            print(f"{name}, {kind}:", *told)
        yield {
            "what": "stmuav, whole process: CPU and wall time [s], peak memory [MB]",
            "commands": found,
        }


if __name__ == "__main__":
    benchmark("waiting", __doc__, record, ((list(COMMANDS), 3), (["list"], 1)))
