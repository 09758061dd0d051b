"""SciPy's explicit Runge-Kutta methods, and the report's dense system run by them."""

import time
from collections.abc import Callable

import numpy as np
from dense.system import Dense
from problems.plain import why_not

from peers.adapter import Outcome, Peer, Prepared, Setting, looked_at, tolerances
from stmuav_jax import Scene

# Seconds of the clock after which a run is given up. Rows that depend on each other leave a method
# at small tolerances steps of round-off's length, and SciPy's have no limit of their own.
MOST_SECONDS = 20.0

# Evaluations per attempted step of SciPy's methods.
_PER_STEP = {"RK45": 6, "DOP853": 12}


def follow(
    rate: Callable[[float, np.ndarray], np.ndarray],
    x: np.ndarray,
    t0: float,
    times: np.ndarray,
    method: str,
    tolerance: float,
) -> tuple[np.ndarray, tuple[int, int, int], str]:
    """Integrate from t0 [s] with rtol = atol = tolerance; steps end at the wanted times.

    Returns:
        States at the wanted times (k, m), not a number from where it failed; evaluations, accepted and
        rejected steps; why it failed, or nothing.
    """
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
    return states, (evaluations, accepted, rejected), failure


class ScipyDense(Peer):
    """The report's method in NumPy and SciPy."""

    name = "NumPy, the report's dense system"
    packages = (("numpy", "numpy"), ("scipy", "scipy"))
    how = (
        "One dense system per evaluation by numpy.linalg.solve; SciPy's solvers, "
        "rtol = atol = tolerance."
    )
    caveats = (
        "Planar loops of spatial joints, whose rows are dependent: least squares by numpy.linalg.lstsq.",
        "Not stabilised: constraint violations persist and grow.",
    )

    def unsupported(self, scene: Scene) -> str:
        return why_not(scene)

    def settings(self, scene: Scene | None = None) -> list[Setting]:
        return [*tolerances("RK45", (4, 6, 8)), *tolerances("DOP853", (4, 6, 8, 10, 12))]

    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        dense, tolerance = Dense(scene), setting.tolerance or 1e-6
        x0 = dense.start(scene)

        def run() -> Outcome:
            states, counts, failure = follow(
                dense.rate, x0, scene.t0, times, setting.solver, tolerance
            )
            look = lambda x: (dense.positions(x), dense.gap(x))
            return looked_at(states, look, dense.model.n, counts, failure)

        return Prepared(run)
