"""The families of methods of the long-horizon benchmark, each compiled once per structure."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from horizons.gauss import Gauss
from jaxtyping import Array, Float
from shared.clock import compiled, ready, rounded, timed
from shared.methods import trajectory

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.explicit import coefficients
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


ADAPTIVE = tuple(
    Family(s, h) for s in ("dopri8", "tsit5") for h in ("projection", "none", "baumgarte")
)
FIXED = (Family("gauss", "projection"), Family("gauss", "none"), Family("midpoint", "projection"))
FAMILIES = (*ADAPTIVE, *FIXED)
_EXPLICIT = {"dopri8": diffrax.Dopri8, "tsit5": diffrax.Tsit5}


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
    solver = _EXPLICIT[family.solver]()
    stages = len(coefficients(solver)[3])

    def run(tol: Any, gain: Any, system: stm.System, state: stm.State, ts: Any) -> Path:
        hold = stm.Projection() if family.projected else stm.Baumgarte(gain, gain, gain)
        integrate = trajectory(stm.Tree(redundant=redundant), solver, stabilisation=hold)
        found = integrate(system, state, ts, tol)
        # a run that stopped keeps its last time
        good = found.ts >= ts * (1 - 1e-12)
        took, not_taken = found.counts.accepted[-1], found.counts.rejected[-1]
        worst, calls = found.worst.position[-1], stages * (took + not_taken)
        energies = _energies(system, found.states)
        return Path(good, *energies, took, not_taken, calls, worst)

    return run


def fixed(family: Family, redundant: bool) -> Callable[..., Path]:
    """(steps between outputs, system, state, ts) -> Path, all steps of one length."""
    hold = stm.Projection() if family.projected else stm.Unstabilised()
    stages = 2 if family.solver == "gauss" else 1
    tree = stm.Tree(redundant=redundant)
    method = stm.Method(formulation=tree, solver=Gauss(stages), stabilisation=hold, steps="state")

    def run(count: Any, system: stm.System, state: stm.State, ts: Float[Array, " k"]) -> Path:
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
        arguments = self._arguments(family, problem, setting)
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

    def _arguments(self, family: Family, problem: Any, setting: float) -> tuple[Any, ...]:
        if family.fixed:
            return jnp.asarray(int(setting)), problem.system, problem.state, self.ts
        gain = jnp.asarray(GAIN if family.hold == "baumgarte" else 0.0)
        return jnp.asarray(float(setting)), gain, problem.system, problem.state, self.ts
