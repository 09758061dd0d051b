"""Structure over long times: energy error of conservative systems against run time.

Six problems, 60 s each. Projected, unstabilised and Baumgarte-stabilised Dopri8 and Tsit5 at
tolerances 1e-4 to 1e-12. Gauss-Legendre methods of order 2 and 4, which are symmetric, were compared
with them once; their runs and the comparison stay in the record, and docs/validation.md says by
which commit's scripts they were made.

Trajectories of the tracker diverge whatever the method, so energies are compared, not states. The
energy error is (E - E0) / scale with the largest kinetic energy of the finest run as scale; its
drift is the slope of a straight line fitted over time.
"""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array
from problems.conservative import PROBLEMS, Problem, simple_pendulum
from shared.clock import compiled, measure_processor, rounded
from shared.methods import evaluations, trajectory
from shared.record import RESULTS, benchmark, make_environment

import stmuav_jax as stm

GAIN = 10.0  # 1/s, of Baumgarte's feedback: the package's default
LEVELS = (1e-3, 1e-6, 1e-9)
SOLVERS = {"dopri8": diffrax.Dopri8(), "tsit5": diffrax.Tsit5()}
SYMMETRIC = ("gauss", "midpoint")
# The tolerance whose error over time is kept for the figure, with Dopri8.
SERIES = 1e-6


@dataclass(frozen=True)
class Size:
    """How much is run.

    Attributes:
        families: solvers, and what holds the joints: "projection", "baumgarte" or "none".
        horizon, every: [s], every is the time between outputs.
        slow: the most seconds of a run; finer settings of a family that took more are left out.
    """

    problems: tuple[Callable[[], Problem], ...] = PROBLEMS
    families: tuple[tuple[str, str], ...] = tuple(
        (s, h) for s in SOLVERS for h in ("projection", "none", "baumgarte")
    )
    horizon: float = 60.0
    every: float = 0.5
    tolerances: tuple[float, ...] = (1e-4, 1e-6, 1e-8, 1e-10, 1e-12)
    repeats: int = 3
    slow: float = 1.5


QUICK = Size(
    (simple_pendulum,), (("dopri8", "projection"),), horizon=2.0, tolerances=(1e-4, 1e-8), repeats=1
)


class Path(NamedTuple):
    """Energies [J] at the output times, which of them the run reached, and what they cost."""

    good: Array
    total: Array
    kinetic: Array
    accepted: Array
    rejected: Array
    worst: Array


def integration(solver: diffrax.AbstractSolver, hold: str, redundant: bool) -> Callable[..., Path]:
    """(tolerance, gain, system, state, ts) -> Path.

    Baumgarte's equations with no gain are the unstabilised ones, so these share a compilation.
    """

    def run(tol: Any, gain: Any, system: stm.System, state: stm.State, ts: Any) -> Path:
        held = stm.Projection() if hold == "projection" else stm.Baumgarte(gain, gain, gain)
        tree = stm.Tree(redundant=redundant)
        found = trajectory(tree, solver, steps=200_000, stabilisation=held)(system, state, ts, tol)
        # a run that stopped keeps its last time
        good = found.ts >= ts * (1 - 1e-12)
        of = jax.vmap(lambda state: stm.dynamics.energy(system, state, jnp.zeros(())))(found.states)
        steps = found.counts.accepted[-1], found.counts.rejected[-1]
        return Path(good, of.kinetic + of.potential, of.kinetic, *steps, found.worst.position[-1])

    return run


class Runner:
    """Runs families on problems, with one compilation for problems of one structure."""

    def __init__(self, ts: np.ndarray, repeats: int) -> None:
        self.ts, self.repeats = jnp.asarray(ts), repeats
        self.compiled: dict[Any, tuple[Any, float]] = {}

    def __call__(
        self, family: tuple[str, str], problem: Problem, tolerance: float
    ) -> tuple[dict[str, Any], Path]:
        """One run: its record, its path."""
        solver, hold = family
        gain = jnp.asarray(GAIN if hold == "baumgarte" else 0.0)
        given = (jnp.asarray(tolerance), gain, problem.system, problem.state, self.ts)
        joints = tuple((joint.name, problem.redundant) for joint in problem.system.joints)
        key = (solver, hold == "projection", joints)
        if key not in self.compiled:
            run = integration(SOLVERS[solver], hold, problem.redundant)
            self.compiled[key] = compiled(run, *given, clock=time.process_time)
        call, seconds = self.compiled[key]
        timing, path = measure_processor(lambda: call(*given), repeats=self.repeats)
        path = jax.device_get(path)
        accepted, rejected = int(path.accepted), int(path.rejected)
        row = {
            "family": f"{solver}, {hold}", "solver": solver, "hold": hold, "tolerance": tolerance,
            "step": None, "seconds": rounded(timing.median), "compile_seconds": rounded(seconds),
            "accepted": accepted, "rejected": rejected,
            "evaluations": evaluations(SOLVERS[solver], accepted + rejected),
            "residual": rounded(path.worst),
            "reached": float(self.ts[int(np.flatnonzero(path.good)[-1])]),
            "completed": bool(np.all(path.good)),
        }  # fmt: skip
        return row, path


def run_problem(
    problem: Problem, size: Size, runner: Runner, former: dict[str, Any]
) -> dict[str, Any]:
    """All families on one problem, beside the symmetric methods of the former record."""
    found: list[tuple[dict[str, Any], Any]] = []
    for family in size.families:
        for tolerance in size.tolerances:
            row, path = runner(family, problem, tolerance)
            found.append((row, path))
            said = f"{row['family']} {tolerance:g}: {row['seconds']:.3g} s"
            print(f"{problem.name}: {said}", flush=True)
            if row["seconds"] > size.slow:
                break
    # the largest kinetic energy [J] of the finest completed run of the first family
    first = found[0][0]["family"]
    whole = [path for row, path in found if row["family"] == first and row["completed"]]
    scale = float(np.max(whole[-1].kinetic))
    for row, path in found:
        row.update(energy_error(runner.ts, path, scale))
        if (row["solver"], row["tolerance"]) == ("dopri8", SERIES):
            row["series"] = rounded(errors(path, scale))
    kept = [row for row in former.get("runs", []) if row["solver"] in SYMMETRIC]
    runs = [*(row for row, _ in found), *kept]
    return {
        "name": problem.name, "title": problem.title, "scale": scale, "runs": runs,
        "cheapest": {str(level): cheapest(runs, level) for level in LEVELS},
        "answers": former.get("answers", {}),
    }  # fmt: skip


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
    keys = ("seconds", "evaluations", "largest", "drift", "tolerance", "step")
    fine = [row for row in runs if row["largest"] is not None and row["largest"] <= level]
    for row in sorted(fine, key=lambda row: -row["seconds"]):
        best[row["family"]] = {key: row[key] for key in keys}
    return best


def record(size: Size) -> Iterator[dict[str, Any]]:
    """What there is after each problem, so that a long run leaves what it has."""
    former = json.loads((RESULTS / "long_horizon.json").read_text())
    once = former.get("measured", {}).get("symmetric", former["environment"])
    same = size.horizon == former["horizon"]
    kept = {row["name"]: row for row in former["problems"]} if same else {}
    ts = np.linspace(0.0, size.horizon, round(size.horizon / size.every) + 1)
    runner = Runner(ts, size.repeats)
    problems: list[dict[str, Any]] = []
    for make in size.problems:
        problem = make()
        problems.append(run_problem(problem, size, runner, kept.get(problem.name, {})))
        # written at once, over the former record
        left = [row for name, row in kept.items() if name not in {p["name"] for p in problems}]
        yield {
            "what": "energy error of conservative systems over long times",
            "seconds": "processor time of the process on one core",
            "horizon": size.horizon,
            "every": size.every,
            "measured": {"explicit": make_environment(), **({"symmetric": once} if same else {})},
            "problems": [*problems, *left],
        }


if __name__ == "__main__":
    benchmark("long_horizon", __doc__, record, (Size(), QUICK))
