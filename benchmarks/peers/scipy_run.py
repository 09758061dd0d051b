"""SciPy's explicit Runge-Kutta methods, stepped to each wanted time and counted."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

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
    length: float | None = None
    for k, end in enumerate(times):
        if end > t:
            first = None if length is None else min(length, end - t)
            solver = make(rate, t, x, end, rtol=tolerance, atol=tolerance, first_step=first)
            while solver.status == "running":
                failure = solver.step() or ""
                accepted += solver.status != "failed"
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
