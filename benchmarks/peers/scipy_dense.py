"""SciPy's explicit Runge-Kutta methods, and the report's dense system run by them."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from dense.system import Dense
from problems.plain import loop_seconds, why_not

from peers.adapter import Outcome, Peer, Prepared, Setting
from stmuav_jax import Scene

# Seconds of the clock after which a run is given up. Rows that depend on each other leave a method
# at small tolerances steps of round-off's length, and SciPy's have no limit of their own.
MOST_SECONDS = 20.0

# Evaluations per attempted step of SciPy's methods.
_PER_STEP = {"RK45": 6, "DOP853": 12}


@dataclass(frozen=True)
class Path:
    """States at the wanted times (k, m), not a number from where it failed; and counts."""

    states: np.ndarray
    evaluations: int
    accepted: int
    rejected: int
    failure: str

    def counts(self) -> tuple[int, int, int]:
        """Evaluations, accepted and rejected steps."""
        return self.evaluations, self.accepted, self.rejected


def follow(
    rate: Callable[[float, np.ndarray], np.ndarray],
    x: np.ndarray,
    t0: float,
    times: np.ndarray,
    method: str,
    tolerance: float,
) -> Path:
    """Integrate from t0 [s] with rtol = atol = tolerance; steps end at the wanted times.

    Every wanted time ends one solver, since the dense output is of lower order than the
    steps; the next solver begins with the last step's length.
    """
    import scipy.integrate

    make: Any = getattr(scipy.integrate, method)
    states = np.full((len(times), len(x)), np.nan)
    t, evaluations, accepted, attempts, failure = t0, 0, 0, 0, ""
    began = time.perf_counter()
    length: float | None = None
    for k, end in enumerate(times):
        if end > t:
            first = None if length is None else min(length, end - t)
            solver = make(rate, t, x, end, rtol=tolerance, atol=tolerance, first_step=first)
            while solver.status == "running":
                failure = solver.step() or ""
                accepted += solver.status != "failed"
                if time.perf_counter() - began > MOST_SECONDS:
                    failure = (
                        f"Ended by us after {MOST_SECONDS:g} s of the clock and {accepted:,} steps, "
                        f"at t = {solver.t:.3g} s."
                    )
                    break
                # the last step is cut short, so its length says little
                if solver.status == "running":
                    length = solver.h_abs
            evaluations += solver.nfev
            attempts += (solver.nfev - (2 if first is None else 1)) // _PER_STEP[method]
            t, x = solver.t, solver.y
            if failure or not np.all(np.isfinite(x)):
                failure = failure or "The state is not finite."
                break
        states[k] = x
    return Path(states, evaluations, accepted, attempts - accepted, failure)


class ScipyDense(Peer):
    """The report's method in NumPy and SciPy."""

    name = "NumPy, the report's dense system"
    packages = (("scipy", "scipy"),)
    how = (
        "One dense system per evaluation by numpy.linalg.solve; SciPy's solvers, "
        "rtol = atol = tolerance."
    )
    caveats = (
        "Planar loops of spatial joints, whose rows are dependent: least squares by numpy.linalg.lstsq.",
        "Not stabilised: violations of the constraints stay and grow.",
    )

    def version(self) -> str:
        import scipy

        return f"NumPy {np.__version__}, SciPy {scipy.__version__}"

    def unsupported(self, scene: Scene) -> str:
        return why_not(scene)

    def settings(self) -> list[Setting]:
        return [
            *(Setting("RK45", tolerance=10.0**-k) for k in (4, 6, 8)),
            *(Setting("DOP853", tolerance=10.0**-k) for k in (4, 6, 8, 10, 12)),
        ]

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        dense, tolerance = Dense(scene), setting.tolerance or 1e-6
        x0 = dense.start(scene)

        def run() -> Outcome:
            path = follow(dense.rate, x0, scene.t0, times, setting.solver, tolerance)
            finite = [x for x in path.states if np.all(np.isfinite(x))]
            gap = max((dense.gap(x) for x in finite), default=None)
            return Outcome(dense.positions(path.states), *path.counts(), gap, failure=path.failure)

        return Prepared(run)

    def acceleration_seconds(self, scene: Scene) -> float | None:
        dense = Dense(scene)
        x0 = dense.start(scene)
        return loop_seconds(lambda: dense.accelerations(scene.t0, x0), loops=200)
