"""Structure over long times: energy error of conservative systems against run time.

Six problems, 60 s each. Projected, unstabilised and Baumgarte-stabilised Dopri8 and Tsit5 at
tolerances 1e-4 to 1e-12, against Gauss-Legendre methods of order 2 and 4 with fixed steps, which
are symmetric (benchmarks/gauss.py), with the same projection and without.

Trajectories of the tracker diverge whatever the method, so energies are compared, not states. The
energy error is (E - E0) / scale with the largest kinetic energy of the finest run as scale; its
drift is the slope of a straight line fitted over time. The fixed steps run in a bare loop without
step size control, which favours them.
"""

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
from long_figures import draw
from long_problems import PROBLEMS, Problem, simple_pendulum
from long_runs import FAMILIES, Family, Runner
from long_tables import tables
from record import add_options, begin, write
from trial import rounded

FIGURES = Path(__file__).parents[1] / "docs" / "figures" / "benchmarks"
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
    problems=(simple_pendulum,),
    families=tuple(f for f in FAMILIES if f.name in ("dopri8, projection", "gauss, projection")),
    horizon=2.0,
    tolerances=(1e-4, 1e-8),
    counts=(10, 40),
    repeats=1,
)
# The runs whose error over time is kept for the figure.
SERIES = {
    ("dopri8, projection", 1e-6),
    ("dopri8, none", 1e-6),
    ("dopri8, baumgarte", 1e-6),
    ("gauss, projection", 40),
    ("gauss, none", 40),
    ("midpoint, projection", 40),
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
        pairs.append(
            {
                "family": row["family"],
                "step": row["step"],
                "cost": row[cost],
                "against": None if best is None else [best["family"], best["tolerance"]],
                "ratio": ratios.get("largest"),
                "drift_ratio": ratios.get("drift"),
            }
        )
    compared = [pair for pair in pairs if pair["ratio"] is not None]
    return {
        "pairs": pairs,
        "compared": len(compared),
        "explicit_better": sum(pair["ratio"] > 1 for pair in compared),
        "explicit_drifts_less": sum(
            pair["drift_ratio"] is not None and pair["drift_ratio"] > 1 for pair in compared
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one problem, a few runs")
    add_options(parser)
    parser.add_argument("--figures", type=Path, default=FIGURES)
    options = parser.parse_args()
    begin(options)
    size = QUICK if options.quick else Size()
    jax.config.update("jax_enable_x64", True)
    ts = np.linspace(0.0, size.horizon, round(size.horizon / size.every) + 1)
    runner, path = Runner(ts, size.repeats), options.results / "long_horizon.json"
    results: list[dict[str, Any]] = []
    for make in size.problems:
        results.append(run_problem(make(), size, runner))
        # after each problem, so that a long run leaves what it has
        path = write("long_horizon", {**about(size), "problems": results}, options.results)
    print(tables(path))
    print(path, *draw(path, options.figures))


def about(size: Size) -> dict[str, Any]:
    """What the record holds."""
    return {
        "what": "energy error of conservative systems over long times",
        "seconds": "processor time of the process on one core",
        "horizon": size.horizon,
        "every": size.every,
    }


if __name__ == "__main__":
    main()
