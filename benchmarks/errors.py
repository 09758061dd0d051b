"""The estimate of the global error: how near it is to the true error, and what it costs.

2 s of the tracker and of the UAV at tolerances from 1e-2 to 1e-10. The reference is a run at 3e-13.
Beside the second run of `simulate`, at a tenth of the tolerances, others: tighter, and looser, which
would cost less. One core:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/errors.py
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.dynamics.diagnostics import SecondRun, estimate_error
from stmuav_jax.dynamics.integration.advance import March
from stmuav_jax.dynamics.integration.problem import prepare_problem

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
    """Which cases, factors on the tolerances of the second run, end [s]."""

    cases: tuple[tuple[str, int, float], ...] = CASES
    factors: tuple[float, ...] = (0.01, 0.1, 1 / 3, 5.0, 10.0)
    t1: float = 2.0


QUICK = Size(cases=(("tracker", 1, 1e-2),), factors=(0.1,), t1=0.5)


def simulated(scene: stm.Scene, tolerance: float, t1: float) -> stm.Run:
    """Without an estimate: it is made here, where it can be timed."""
    method = stm.Method(rtol=tolerance, atol=tolerance)
    return stm.simulate(scene, method=method, t1=t1, error_estimate=False, analysis=False)


def attempts(march: March) -> int:
    """Steps accepted and rejected."""
    counts = march.trajectory().counts
    return int(counts.accepted[-1] + counts.rejected[-1])


def second_run(scene: stm.Scene, march: March, factor: float) -> dict[str, Any]:
    """Largest estimated position error, and step attempts."""
    first = march.trajectory()
    second = SecondRun(march.problem, scene.t0, scene.state0, factor=factor)
    second.follow(first)
    estimate = float(np.nanmax(estimate_error(first, second, None).position))
    return {"factor": factor, "estimate": estimate, "attempts": attempts(second.march)}


def record(size: Size) -> Iterator[dict[str, Any]]:
    """All cases, and how many estimates are within a factor of three."""
    rows: list[dict[str, Any]] = []
    references: dict[tuple[str, int], stm.Run] = {}
    for name, case, tolerance in size.cases:
        scene = stm.make_scene(name, case)
        if (name, case) not in references:
            references[name, case] = simulated(scene, REFERENCE, size.t1)
        run = simulated(scene, tolerance, size.t1)
        apart = np.linalg.norm(run.states.r - references[name, case].states.r, axis=-1)
        march = March(prepare_problem(scene.system, run.method), scene.t0, scene.state0)
        march.to(run.ts)
        row: dict[str, Any] = {"scene": name, "case": case, "tolerance": tolerance}
        row |= {"true": float(np.max(apart)), "attempts": attempts(march)}
        row["second"] = [second_run(scene, march, factor) for factor in size.factors]
        rows.append(row)
        each = (f"x {s['factor']:.2g}: {s['estimate']:.2e} m" for s in row["second"])
        print(f"{name} {case} {tolerance:g}: true {row['true']:.2e} m;", *each, flush=True)
    factors = {str(f): summary(rows, k) for k, f in enumerate(size.factors)}
    print(*factors.items(), sep="\n")
    what = "estimates of the largest position error [m] against the true one, and their cost"
    yield {"what": what, "t1": size.t1, "rows": rows, "factors": factors}


def summary(rows: list[dict[str, Any]], k: int) -> dict[str, Any]:
    """How many of the k-th second runs are within a factor of three; attempts in those of first runs."""
    over = lambda key, of: np.array([row["second"][k][key] / row[of] for row in rows])
    ratios, cost = over("estimate", "true"), over("attempts", "attempts")
    within = int(np.sum((ratios <= 3) & (ratios >= 1 / 3)))
    attempts = [float(f(cost)) for f in (np.min, np.median, np.max)]
    return {"within": within, "of": len(rows), "attempts": attempts}


if __name__ == "__main__":
    benchmark("errors", __doc__, record, (Size(), QUICK))
