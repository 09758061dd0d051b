"""SciPy's explicit Runge-Kutta methods, and the report's dense system run by them."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from dense.system import Dense
from problems.plain import loop_seconds, why_not

from peers.adapter import Outcome, Peer, Prepared, Setting, tolerances
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
    """Integrate from t0 [s] with rtol = atol = tolerance; steps end at the wanted times."""
    from scipy.integrate import solve_ivp

    states, counts, failure = np.full((len(times), len(x)), np.nan), np.zeros(3, int), ""
    began = time.perf_counter()

    def watched(t: float, x: np.ndarray) -> np.ndarray:
        if time.perf_counter() - began > MOST_SECONDS:
            said = f"Ended by us after {MOST_SECONDS:g} s of the clock, at t = {t:.3g} s."
            raise TimeoutError(said)
        return rate(t, x)

    for k, end in enumerate(times):
        try:
            done = solve_ivp(watched, (t0, end), x, method, rtol=tolerance, atol=tolerance)
        except TimeoutError as late:
            failure = str(late)
            break
        # two evaluations choose the first step
        accepted, tried = len(done.t) - 1, (done.nfev - 2) // _PER_STEP[method]
        counts += (done.nfev, accepted, tried - accepted)
        t0, x, failure = end, done.y[:, -1], "" if done.success else done.message
        if failure or not np.all(np.isfinite(x)):
            failure = failure or "The state is not finite."
            break
        states[k] = x
    evaluations, accepted, rejected = map(int, counts)
    return Path(states, evaluations, accepted, rejected, failure)


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
        "Not stabilised: constraint violations persist and grow.",
    )

    def version(self) -> str:
        import scipy

        return f"NumPy {np.__version__}, SciPy {scipy.__version__}"

    def unsupported(self, scene: Scene) -> str:
        return why_not(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return [*tolerances("RK45", (4, 6, 8)), *tolerances("DOP853", (4, 6, 8, 10, 12))]

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
