"""Runs, references and eigenvalues of the stiff benchmark; one compilation for all scenes."""

import time
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from shared.clock import compiled, ready, rounded, timed
from shared.methods import trajectory

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.rosenbrock import Rodas5P

SOLVERS: dict[str, Any] = {
    "dopri8": diffrax.Dopri8,
    "tsit5": diffrax.Tsit5,
    "rodas5p": Rodas5P,
    "kvaerno5": stm.dynamics.kvaerno5,
}
EXPLICIT, IMPLICIT = ("dopri8", "tsit5"), ("rodas5p", "kvaerno5")
TIGHT = 1e-11


def _jacobian(system: stm.System, state: stm.State, t: Any) -> Any:
    """df/dx of x' = f(t, x) in the tree's coordinates, unstabilised."""
    formulation = stm.Tree()
    model = formulation.prepare(system)
    field = lambda x: formulation.derivative(model, t, x, stm.Unstabilised())[0]
    return jax.jacfwd(field)(formulation.to_vector(model, state))


def as_given(scene: stm.Scene) -> tuple[stm.System, stm.State]:
    """System and start as arrays that are not weakly typed, so that all scenes share a trace."""
    strong = lambda x: jnp.asarray(x, x.dtype) if eqx.is_array(x) else x
    return jax.tree.map(strong, (scene.system, scene.state0))


class Runner:
    """Compiles on first use.

    Attributes:
        ends: output times (3,) [s], the start, the middle, the end.
    """

    def __init__(self, t1: float, repeats: int) -> None:
        self.ends, self.repeats = jnp.array([0.0, 0.5 * t1, t1]), repeats
        self._calls: dict[str, Any] = {}
        self.compile_seconds: dict[str, float] = {}
        self._eigen: Any = None

    def call(self, solver: str, *arguments: Any) -> Any:
        """The compiled integration by a solver."""
        if solver not in self._calls:
            run = trajectory(stm.Tree(), SOLVERS[solver]())
            done, seconds = compiled(run, *arguments, clock=time.process_time)
            self._calls[solver], self.compile_seconds[solver] = done, seconds
        return self._calls[solver]

    def tight(self, solver: str, scene: stm.Scene) -> np.ndarray:
        """Positions (2, n, 3) [m] at the middle and the end, at the tightest tolerance."""
        arguments = (*as_given(scene), self.ends, jnp.asarray(TIGHT))
        return self._positions(self.call(solver, *arguments)(*arguments))

    def _positions(self, found: Any) -> np.ndarray:
        """Not numbers if the run did not reach the end."""
        there = bool(np.all(np.asarray(found.ts) >= np.asarray(self.ends) * (1 - 1e-12)))
        positions = np.asarray(found.states.r[1:])
        return positions if there else np.full_like(positions, np.nan)

    def run(self, solver: str, tol: float, scene: stm.Scene, exact: np.ndarray) -> dict[str, Any]:
        """One timed run: counts, seconds, largest position error over all bodies [m]."""
        arguments = (*as_given(scene), self.ends, jnp.asarray(tol))
        call = self.call(solver, *arguments)
        cost, found = timed(call, *arguments, repeats=self.repeats)
        found = ready(found)
        off = np.max(np.linalg.norm(self._positions(found) - exact, axis=-1), axis=-1)
        return {
            "solver": solver, "tolerance": tol,
            "accepted": int(found.counts.accepted[-1]),
            "rejected": int(found.counts.rejected[-1]),
            "seconds": rounded(cost.processor.median), "cost": cost.to_dict(),
            "error_middle": rounded(off[0]), "error_end": rounded(off[1]),
            "error": rounded(np.max(off)), "completed": bool(np.all(np.isfinite(off))),
        }  # fmt: skip

    def along(self, scene: stm.Scene, pieces: int, tol: float) -> list[tuple[float, stm.State]]:
        """Times and states along a run by Rodas5P: pieces of two, in the same compilation."""
        system, state = as_given(scene)
        times = np.linspace(0.0, float(self.ends[-1]), 2 * pieces + 1)
        path = [(0.0, state)]
        for k in range(pieces):
            ts = jnp.asarray(times[2 * k : 2 * k + 3])
            arguments = (system, state, ts, jnp.asarray(tol))
            found = self.call("rodas5p", *arguments)(*arguments)
            for i in (1, 2):
                state = jax.tree.map(lambda x, i=i: x[i], found.states)
                path.append((float(ts[i]), state))
        return path

    def eigenvalues(self, scene: stm.Scene, pieces: int) -> dict[str, Any]:
        """The eigenvalue of df/dx that is largest in size, at the start and along the run."""
        system, _ = as_given(scene)
        largest, times = [], []
        for t, state in self.along(scene, pieces, 1e-8):
            arguments = (system, state, jnp.asarray(t))
            if self._eigen is None:
                made = compiled(_jacobian, *arguments, clock=time.process_time)
                self._eigen, self.compile_seconds["jacobian"] = made
            J = np.asarray(self._eigen(*arguments))
            if not np.all(np.isfinite(J)):
                break
            values = np.linalg.eigvals(J)
            largest.append(values[np.argmax(np.abs(values))])
            times.append(t)
        sizes = np.abs(largest)
        peak = int(np.argmax(sizes))
        parts = lambda value: [rounded(value.real), rounded(value.imag)]
        return {
            "start": rounded(sizes[0]), "start_value": parts(largest[0]),
            "median": rounded(np.median(sizes)),
            "largest": rounded(sizes[peak]), "largest_value": parts(largest[peak]),
            "largest_at": times[peak], "states": len(times),
        }  # fmt: skip
