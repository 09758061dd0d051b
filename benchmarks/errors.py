"""The estimate of the global error: how near it is to the true error, and what it costs.

The runs of the slow test in `tests/dynamics/test_accuracy.py`, 2 s of the tracker and of the UAV at
tolerances from 1e-2 to 1e-10. The reference is a run at 3e-13. Beside the second run of `simulate`, at
a tenth of the tolerances, others: tighter, and looser, which would cost less. One core:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/errors.py
"""

import argparse
import time
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from record import add_options, begin, write

jax.config.update("jax_enable_x64", True)

import stmuav_jax as sj
from stmuav_jax.dynamics.accuracy import SecondRun, estimated
from stmuav_jax.dynamics.march import March
from stmuav_jax.dynamics.problem import prepare

REFERENCE = 3e-13
CASES = (
    *(("tracker", 1, tolerance) for tolerance in (1e-2, 1e-4, 1e-6, 1e-8)),
    *(("tracker", 2, tolerance) for tolerance in (1e-4, 1e-6, 1e-8)),
    *(("uav_tracker", 1, tolerance) for tolerance in (1e-6, 1e-8)),
    *(("uav_tracker", 2, tolerance) for tolerance in (1e-6, 1e-8, 1e-10)),
    *(("uav_tracker", 3, tolerance) for tolerance in (1e-6, 1e-8, 1e-10)),
)


@dataclass(frozen=True)
class Size:
    """Which cases, factors on the tolerances of the second run, repeats, end [s]."""

    cases: tuple[tuple[str, int, float], ...] = CASES
    factors: tuple[float, ...] = (0.01, 0.1, 1 / 3, 5.0, 10.0)
    repeats: int = 3
    t1: float = 2.0


QUICK = Size(cases=(("tracker", 1, 1e-2),), factors=(0.1,), repeats=1, t1=0.5)


def simulated(scene: sj.Scene, tolerance: float, t1: float) -> sj.Run:
    """Without an estimate: it is made here, where it can be timed."""
    return sj.simulate(
        scene, rtol=tolerance, atol=tolerance, t1=t1, error_estimate=False, analysis=False
    )


def attempts(march: March) -> int:
    """Steps accepted and rejected."""
    counts = march.trajectory().counts
    return int(counts.accepted[-1] + counts.rejected[-1])


def first_run(scene: sj.Scene, run: sj.Run, repeats: int) -> tuple[March, float]:
    """The first run again, and the least processor seconds that it took."""
    best = float("inf")
    for _ in range(repeats):
        march = March(prepare(scene.system, run.method), scene.t0, scene.state0)
        clock = time.process_time()
        march.to(run.ts)
        best = min(best, time.process_time() - clock)
    return march, best  # pyright: ignore[reportPossiblyUnboundVariable]


def second_run(scene: sj.Scene, march: March, factor: float, repeats: int) -> dict[str, Any]:
    """Largest estimated position error, step attempts and least processor seconds."""
    best, first = float("inf"), march.trajectory()
    for _ in range(repeats):
        second = SecondRun(march.problem, scene.t0, scene.state0, factor=factor)
        clock = time.process_time()
        second.follow(first)
        best = min(best, time.process_time() - clock)
    found = estimated(first, second, None)  # pyright: ignore[reportPossiblyUnboundVariable]
    return {
        "factor": factor,
        "estimate": float(np.nanmax(found.position)),
        "attempts": attempts(second.march),  # pyright: ignore[reportPossiblyUnboundVariable]
        "seconds": best,
    }


def record(size: Size) -> dict[str, Any]:
    """All cases, and how many estimates are within a factor of three."""
    rows: list[dict[str, Any]] = []
    references: dict[tuple[str, int], sj.Run] = {}
    for name, case, tolerance in size.cases:
        scene = sj.make_scene(name, case)
        if (name, case) not in references:
            references[name, case] = simulated(scene, REFERENCE, size.t1)
        run = simulated(scene, tolerance, size.t1)
        apart = np.linalg.norm(run.states.r - references[name, case].states.r, axis=-1)
        march, seconds = first_run(scene, run, size.repeats)
        row: dict[str, Any] = {"scene": name, "case": case, "tolerance": tolerance}
        row |= {"true": float(np.max(apart)), "attempts": attempts(march), "seconds": seconds}
        row["second"] = [second_run(scene, march, f, size.repeats) for f in size.factors]
        rows.append(row)
        print(line(row), flush=True)
    return {
        "what": "estimates of the largest position error [m] against the true one, and their cost",
        "seconds": "processor time of the process, the least of the repeats",
        "t1": size.t1,
        "rows": rows,
        "factors": {str(f): summary(rows, k) for k, f in enumerate(size.factors)},
    }


def line(row: dict[str, Any]) -> str:
    """Of one case, the second runs behind each other."""
    each = ", ".join(
        f"x {s['factor']:.2g}: {s['estimate']:.2e} m, {s['seconds'] / row['seconds']:.2f} of the time"
        for s in row["second"]
    )
    return f"{row['scene']} {row['case']} {row['tolerance']:g}: true {row['true']:.2e} m; {each}"


def summary(rows: list[dict[str, Any]], k: int) -> dict[str, Any]:
    """How many of the k-th second runs are within a factor of three; cost in first runs."""
    of = [(row, row["second"][k]) for row in rows]
    ratios = np.array([s["estimate"] / row["true"] for row, s in of])
    cost = np.array([s["seconds"] / row["seconds"] for row, s in of])
    steps = np.array([s["attempts"] / row["attempts"] for row, s in of])
    spread = lambda x: [float(np.min(x)), float(np.median(x)), float(np.max(x))]
    within = int(np.sum((ratios <= 3) & (ratios >= 1 / 3)))
    return {"within": within, "of": len(of), "cost": spread(cost), "attempts": spread(steps)}


def main() -> None:
    """Run and write `errors.json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="the smallest size")
    add_options(parser)
    arguments = parser.parse_args()
    begin(arguments)
    content = record(QUICK if arguments.quick else Size())
    for factor, found in content["factors"].items():
        print(factor, found, flush=True)
    print(write("errors", content, arguments.results))


if __name__ == "__main__":
    main()
