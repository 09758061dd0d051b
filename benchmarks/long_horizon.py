"""Structure over long times: energy error of conservative systems against run time.

Six problems, 60 s each. Projected, unstabilised and Baumgarte-stabilised Dopri8 and Tsit5 at
tolerances 1e-4 to 1e-12, against Gauss-Legendre methods of order 2 and 4 with fixed steps, which
are symmetric (benchmarks/horizons/gauss.py), with the same projection and without.

Trajectories of the tracker diverge whatever the method, so energies are compared, not states. The
energy error is (E - E0) / scale with the largest kinetic energy of the finest run as scale; its
drift is the slope of a straight line fitted over time. The fixed steps run in a bare loop without
step size control, which favours them.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from horizons.families import FAMILIES, Family, Runner
from horizons.pages import show
from problems.conservative import PROBLEMS, Problem, simple_pendulum
from shared.clock import rounded
from shared.command import benchmark

LEVELS = (1e-3, 1e-6, 1e-9)


@dataclass(frozen=True)
class Size:
    """How much is run.

    Attributes:
        horizon, every: [s], every is the time between outputs.
        counts: fixed steps from one output to the next.
        slow: the most seconds of a run; finer settings of a family that took more are left out.
    """

    problems: tuple[Callable[[], Problem], ...] = PROBLEMS
    families: tuple[Family, ...] = FAMILIES
    horizon: float = 60.0
    every: float = 0.5
    tolerances: tuple[float, ...] = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    counts: tuple[int, ...] = (10, 20, 40, 80, 160, 320)
    repeats: int = 3
    slow: float = 1.5


QUICK = Size(
    (simple_pendulum,),
    tuple(f for f in FAMILIES if f.name in ("dopri8, projection", "gauss, projection")),
    horizon=2.0, tolerances=(1e-4, 1e-8), counts=(10, 40), repeats=1,
)  # fmt: skip
# The runs whose error over time is kept for the figure.
SERIES = {
    *((f"dopri8, {hold}", 1e-6) for hold in ("projection", "none", "baumgarte")),
    *((family, 40) for family in ("gauss, projection", "gauss, none", "midpoint, projection")),
}


def run_problem(problem: Problem, size: Size, runner: Runner) -> dict[str, Any]:
    """All families on one problem."""
    found: list[tuple[dict[str, Any], Any, float]] = []
    for family in size.families:
        for setting in size.counts if family.fixed else size.tolerances:
            row, path = runner(family, problem, setting)
            found.append((row, path, setting))
            print(f"{problem.name}: {family.name} {setting:g}: {row['seconds']:.3g} s", flush=True)
            if row["seconds"] > size.slow:
                break
    scale = finest_scale(found)
    runs = []
    for row, path, setting in found:
        row.update(energy_error(runner.ts, path, scale))
        if (row["family"], setting) in SERIES:
            row["series"] = rounded(errors(path, scale))
        runs.append(row)
    return {
        "name": problem.name,
        "title": problem.title,
        "scale": scale,
        "runs": runs,
        "cheapest": {str(level): cheapest(runs, level) for level in LEVELS},
        "answers": {cost: answer(runs, cost) for cost in ("seconds", "evaluations")},
    }


def finest_scale(found: list[tuple[dict[str, Any], Any, float]]) -> float:
    """The largest kinetic energy [J] of the finest completed run of the first family."""
    first = found[0][0]["family"]
    whole = [path for row, path, _ in found if row["family"] == first and row["completed"]]
    return float(np.max(whole[-1].kinetic))


def errors(path: Any, scale: float) -> np.ndarray:
    """(E - E0) / scale at the output times; not numbers from where the run failed."""
    return np.where(path.good, (path.total - path.total[0]) / scale, np.nan)


def energy_error(ts: Any, path: Any, scale: float) -> dict[str, float | None]:
    """The largest error, its drift [1/s] and the root mean square about the fitted line.

    Nothing for a run that did not reach the end.
    """
    error = errors(path, scale)
    if not np.all(np.isfinite(error)):
        return {"largest": None, "drift": None, "about_line": None}
    slope, offset = np.polyfit(np.asarray(ts), error, 1)
    about = float(np.sqrt(np.mean((error - slope * np.asarray(ts) - offset) ** 2)))
    values = {"largest": np.max(np.abs(error)), "drift": slope, "about_line": about}
    return {key: rounded(value) for key, value in values.items()}


def cheapest(runs: list[dict[str, Any]], level: float) -> dict[str, Any]:
    """By family: the cheapest run with an error up to the level, in seconds; None if none has."""
    best: dict[str, Any] = {row["family"]: None for row in runs}
    for row in runs:
        if row["largest"] is None or row["largest"] > level:
            continue
        now = best[row["family"]]
        if now is None or row["seconds"] < now["seconds"]:
            keys = ("seconds", "evaluations", "largest", "drift", "tolerance", "step")
            best[row["family"]] = {key: row[key] for key in keys}
    return best


def answer(runs: list[dict[str, Any]], cost: str) -> dict[str, Any]:
    """Every completed fixed-step run against the best projected explicit run that costs no more.

    The ratio is the fixed-step run's error over the explicit run's: above 1 the explicit run is
    better at equal cost. Where no explicit run is as cheap there is none to compare with.
    """
    whole = [row for row in runs if row["largest"] is not None]
    explicit = [row for row in whole if row["step"] is None and row["hold"] == "projection"]
    pairs = []
    for row in whole:
        if row["step"] is None:
            continue
        rivals = [other for other in explicit if other[cost] <= row[cost]]
        best = min(rivals, key=lambda other: other["largest"], default=None)
        ratios = {}
        if best is not None:
            for key in ("largest", "drift"):
                below = abs(best[key])
                ratios[key] = rounded(abs(row[key]) / below) if below else None
        against = None if best is None else [best["family"], best["tolerance"]]
        ratio = {"ratio": ratios.get("largest"), "drift_ratio": ratios.get("drift")}
        which = {"family": row["family"], "step": row["step"], "cost": row[cost]}
        pairs.append({**which, "against": against, **ratio})
    compared = [pair for pair in pairs if pair["ratio"] is not None]
    return {
        "pairs": pairs,
        "compared": len(compared),
        "explicit_better": sum(pair["ratio"] > 1 for pair in compared),
        "explicit_drifts_less": sum((pair["drift_ratio"] or 0) > 1 for pair in compared),
    }


def record(size: Size) -> Iterator[dict[str, Any]]:
    """What there is after each problem, so that a long run leaves what it has."""
    ts = np.linspace(0.0, size.horizon, round(size.horizon / size.every) + 1)
    runner = Runner(ts, size.repeats)
    problems: list[dict[str, Any]] = []
    for make in size.problems:
        problems.append(run_problem(make(), size, runner))
        yield {
            "what": "energy error of conservative systems over long times",
            "seconds": "processor time of the process on one core",
            "horizon": size.horizon,
            "every": size.every,
            "problems": problems,
        }


def main() -> None:
    """Run and write `long_horizon.json`."""
    benchmark("long_horizon", __doc__, record, (Size(), QUICK), show)


if __name__ == "__main__":
    main()
