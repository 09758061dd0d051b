"""Structure over long times: energy error of conservative systems against run time.

Six problems, 60 s each. Projected, unstabilised and Baumgarte-stabilised Dopri8 and Tsit5 at
tolerances 1e-4 to 1e-12, against Gauss-Legendre methods of order 2 and 4 with fixed steps, which
are symmetric (benchmarks/shared/gauss.py), with the same projection and without.

Trajectories of the tracker diverge whatever the method, so energies are compared, not states. The
energy error is (E - E0) / scale with the largest kinetic energy of the finest run as scale; its
drift is the slope of a straight line fitted over time. The fixed steps run in a bare loop without
step size control, which favours them.
"""

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
from sections import long_page
from shared.clock import compiled, ready, rounded, timed
from shared.command import benchmark
from shared.gauss import Gauss
from shared.methods import evaluations, trajectory

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import prepare

GAIN = 10.0  # 1/s, of Baumgarte's feedback: the package's default


@dataclass(frozen=True)
class Family:
    """A method but for its tolerance or step.

    Attributes:
        solver: "dopri8", "tsit5", "gauss" (two stages) or "midpoint".
        hold: "projection", "baumgarte" or "none".
    """

    solver: str
    hold: str

    @property
    def name(self) -> str:
        return f"{self.solver}, {self.hold}"

    @property
    def fixed(self) -> bool:
        return self.solver in ("gauss", "midpoint")

    @property
    def projected(self) -> bool:
        return self.hold == "projection"


FAMILIES = (
    *(Family(s, h) for s in ("dopri8", "tsit5") for h in ("projection", "none", "baumgarte")),
    Family("gauss", "projection"), Family("gauss", "none"), Family("midpoint", "projection"),
)  # fmt: skip
SOLVERS: dict[str, diffrax.AbstractSolver] = {
    "dopri8": diffrax.Dopri8(), "tsit5": diffrax.Tsit5(), "gauss": Gauss(2), "midpoint": Gauss(1),
}  # fmt: skip


class Path(NamedTuple):
    """Energies [J] at the output times, which of them the run reached, and what they cost."""

    good: Array
    total: Array
    kinetic: Array
    accepted: Array
    rejected: Array
    evaluations: Array
    worst: Array


def _energies(system: stm.System, states: stm.State) -> tuple[Array, Array]:
    """Total and kinetic [J]."""
    found = jax.vmap(lambda state: stm.dynamics.energy(system, state, jnp.zeros(())))(states)
    return found.kinetic + found.potential, found.kinetic


def adaptive(family: Family, redundant: bool) -> Callable[..., Path]:
    """(tolerance, gain, system, state, ts) -> Path.

    Baumgarte's equations with no gain are the unstabilised ones, so these share a compilation.
    """
    solver = SOLVERS[family.solver]

    def run(tol: Any, gain: Any, system: stm.System, state: stm.State, ts: Any) -> Path:
        hold = stm.Projection() if family.projected else stm.Baumgarte(gain, gain, gain)
        integrate = trajectory(stm.Tree(redundant=redundant), solver, stabilisation=hold)
        found = integrate(system, state, ts, tol)
        # a run that stopped keeps its last time
        good = found.ts >= ts * (1 - 1e-12)
        took, not_taken = found.counts.accepted[-1], found.counts.rejected[-1]
        worst, calls = found.worst.position[-1], evaluations(solver, took + not_taken)
        energies = _energies(system, found.states)
        return Path(good, *energies, took, not_taken, calls, worst)

    return run


def fixed(family: Family, redundant: bool) -> Callable[..., Path]:
    """(steps between outputs, system, state, ts) -> Path, all steps of one length."""
    hold = stm.Projection() if family.projected else stm.Unstabilised()
    tree, solver = stm.Tree(redundant=redundant), SOLVERS[family.solver]
    method = stm.Method(formulation=tree, solver=solver, stabilisation=hold, steps="state")

    def run(count: Any, system: stm.System, state: stm.State, ts: Array) -> Path:
        problem = prepare(system, method)
        solver, terms = problem.solver(), diffrax.ODETerm(problem.field)
        h = (ts[1] - ts[0]) / count
        y0 = method.formulation.to_vector(problem.model, state)

        def step(now: Any) -> Any:
            i, t, y, inner, _ = now
            at = t + i * h
            y, _, _, inner, result = solver.step(terms, at, at + h, y, problem.model, inner, False)
            good = (result == diffrax.RESULTS.successful) & jnp.all(jnp.isfinite(y))
            return i + 1, t, y, inner, good

        def to_next(now: Any, t: Any) -> Any:
            y, inner, good = now
            start = (jnp.zeros((), int), t, y, inner, good)
            _, _, y, inner, good = jax.lax.while_loop(lambda c: (c[0] < count) & c[4], step, start)
            return (y, inner, good), (y, good)

        begin = (y0, solver.init(terms, ts[0], ts[0] + h, y0, problem.model), jnp.asarray(True))
        (_, (inner, worst), _), (ys, good) = jax.lax.scan(to_next, begin, ts[:-1])
        ys = jnp.concatenate([y0[None], ys])
        good = jnp.concatenate([jnp.ones(1, bool), good])
        states = jax.vmap(lambda y: method.formulation.to_state(problem.model, y))(ys)
        took, none = count * jnp.sum(good[1:]), jnp.zeros((), int)
        return Path(good, *_energies(system, states), took, none, inner.evaluations, worst.position)

    return run


class Runner:
    """Runs families on problems, with one compilation for problems of one structure."""

    def __init__(self, ts: np.ndarray, repeats: int) -> None:
        self.ts, self.repeats = jnp.asarray(ts), repeats
        self.compiled: dict[Any, tuple[Any, float]] = {}

    def __call__(self, family: Family, problem: Any, setting: float) -> tuple[dict[str, Any], Path]:
        """One run at a tolerance, or with so many steps between outputs: its record, its path."""
        gain = jnp.asarray(GAIN if family.hold == "baumgarte" else 0.0)
        size = (jnp.asarray(int(setting)),) if family.fixed else (jnp.asarray(setting), gain)
        arguments = (*size, problem.system, problem.state, self.ts)
        kind = "held" if family.projected else "free"
        joints = tuple((joint.name, problem.redundant) for joint in problem.system.joints)
        key = (family.solver, kind, joints)
        if key not in self.compiled:
            make = fixed if family.fixed else adaptive
            run = make(family, problem.redundant)
            self.compiled[key] = compiled(run, *arguments, clock=time.process_time)
        call, seconds = self.compiled[key]
        cost, path = timed(call, *arguments, repeats=self.repeats)
        path = ready(path)
        every, last = float(self.ts[1] - self.ts[0]), int(np.flatnonzero(path.good)[-1])
        counts = ("accepted", "rejected", "evaluations")
        row = {
            "family": family.name, "solver": family.solver, "hold": family.hold,
            "tolerance": None if family.fixed else setting,
            "step": every / setting if family.fixed else None,
            "seconds": rounded(cost.processor.median), "cost": cost.to_dict(),
            "compile_seconds": rounded(seconds),
            **{name: int(getattr(path, name)) for name in counts},
            "residual": rounded(path.worst), "reached": float(self.ts[last]),
            "completed": bool(np.all(path.good)),
        }  # fmt: skip
        return row, path


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
    # the largest kinetic energy [J] of the finest completed run of the first family
    first = size.families[0].name
    whole = [path for row, path, _ in found if row["family"] == first and row["completed"]]
    scale = float(np.max(whole[-1].kinetic))
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
        over = lambda key, a=row, b=best: rounded(abs(a[key] / b[key])) if b and b[key] else None
        against = best and [best["family"], best["tolerance"]]
        which = {"family": row["family"], "step": row["step"], "cost": row[cost]}
        pairs.append({
            **which, "against": against, "ratio": over("largest"), "drift_ratio": over("drift"),
        })  # fmt: skip
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


if __name__ == "__main__":
    benchmark("long_horizon", __doc__, record, (Size(), QUICK), long_page.show)
