"""Integrators with a guard: every run ends, and says when and why.

MATLAB's rule for the step size of ode45 (Shampine and Reichelt, The MATLAB ODE Suite, SIAM J. Sci.
Comput. 18, 1997: error in the maximum norm), and the classical Runge-Kutta method with fixed steps.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import RK45
from scipy.interpolate import CubicHermiteSpline

Array = np.ndarray
Field = Callable[[float, Array], Array]
# Accepted steps: the time and state at the end of each, and the states between [s].
Steps = Iterator[tuple[float, Array, Callable[[float], Array]]]


# When a run is given up: accelerations evaluated, an adaptive step that counts as collapsed [s], the largest
# entry of the state.
MOST_EVALUATIONS, LEAST_STEP, LARGEST = 60_000, 1e-9, 1e7


@dataclass(frozen=True)
class Scheme:
    """A method: "ode45" with tolerances, or "rk4" with a step [s]."""

    method: str
    rtol: float = 1e-3
    atol: float = 1e-6
    step: float = 0.0

    @property
    def label(self) -> str:
        """For tables."""
        if self.step:
            return f"{self.method} h={1e3 * self.step:g} ms"
        return f"{self.method} {self.rtol:.0e}/{self.atol:.0e}"


@dataclass
class History:
    """States (k, m) at the wanted times that were reached, and how the run ended.

    `sizes` are those of accepted steps [s]; `failure` is empty if the end was reached.
    """

    times: Array
    states: Array
    sizes: Array
    failure: str
    stopped_at: float

    @property
    def ends(self) -> Array:
        """Times at which the accepted steps end [s]."""
        return np.cumsum(self.sizes)

    def summary(self) -> dict[str, Any]:
        """How far it came, why no farther, and in how many steps."""
        return {"reached": self.stopped_at, "failure": self.failure, "steps": len(self.sizes)}


def ode45(f: Field, y: Array, t1: float, rtol: float, atol: float) -> Steps:
    """Dormand and Prince's 5(4) pair under MATLAB's step size rule, with cubics between."""

    def relative(change: Array, a: Array, b: Array) -> float:
        size = np.maximum(np.maximum(np.abs(a), np.abs(b)), atol / rtol)
        return float(np.max(np.abs(change / size)))

    def attempt(h: float) -> tuple[Array, Array, float]:
        k = [slope]
        for a, c in zip(RK45.A[1:], RK45.C[1:], strict=True):
            k.append(f(t + c * h, y + h * sum(float(w) * x for w, x in zip(a, k, strict=False))))
        end = y + h * sum(float(w) * x for w, x in zip(RK45.B, k, strict=True))
        k.append(f(t + h, end))
        error = h * np.sum([float(w) * x for w, x in zip(RK45.E, k, strict=True)], axis=0)
        return end, k[-1], relative(error, y, end)

    t, slope, largest = 0.0, f(0.0, y), 0.1 * t1
    rate = relative(slope, y, y) / (0.8 * rtol**0.2)
    wanted = min(largest, 1 / rate if rate > 0 else largest)
    while t < t1 - 1e-14:
        smallest = 16 * np.spacing(t)
        h = min(max(wanted, smallest), largest, t1 - t)
        failed = False
        while (tried := attempt(h))[2] > rtol or not np.isfinite(tried[2]):
            error = tried[2]
            if h <= smallest or not np.isfinite(t + h):
                raise FloatingPointError("step size below the spacing of numbers")
            shrink = 0.8 * (rtol / error) ** 0.2 if np.isfinite(error) else 0.1
            h = max(smallest, h * (0.5 if failed else max(0.1, shrink)))
            failed = True
        end, last, error = tried
        wanted = h if failed else h / max(1.25 * (error / rtol) ** 0.2, 0.2)
        nodes = [t, t + h], [y, end], [slope, last]
        t, y, slope = t + h, end, last
        yield t, y, lambda s, nodes=nodes: CubicHermiteSpline(*nodes)(s)


def runge_kutta(f: Field, y: Array, t1: float, h: float) -> Steps:
    """The classical method of order 4; wanted times are meant to be those of steps."""
    for count in range(round(t1 / h)):
        t = count * h
        a = f(t, y)
        b = f(t + h / 2, y + h / 2 * a)
        c = f(t + h / 2, y + h / 2 * b)
        first, y = y, y + h * (a + 2 * b + 2 * c + f(t + h, y + h * c)) / 6
        line = lambda s, t=t, a=first, b=y: a + (s - t) / h * (b - a)
        yield (count + 1) * h, y, line


def integrate(
    f: Field, y0: Array, times: Array, scheme: Scheme, most_evaluations: int = MOST_EVALUATIONS
) -> History:
    """Integrate y' = f(t, y) from times[0] = 0 and keep the states at `times`."""
    states, sizes, failure, stopped_at, end = [y0], [], "", 0.0, float(times[-1])
    evaluations = 0

    def counted(t: float, y: Array) -> Array:
        """y'. A state that is not finite gives one that is not, and no error."""
        nonlocal evaluations
        evaluations += 1
        try:
            return f(t, y) if np.all(np.isfinite(y)) else np.full_like(y, np.nan)
        except np.linalg.LinAlgError:
            return np.full_like(y, np.nan)

    adaptive = lambda: ode45(counted, y0, end, scheme.rtol, scheme.atol)
    steps = runge_kutta(counted, y0, end, scheme.step) if scheme.step else adaptive()
    with np.errstate(all="ignore"):
        try:
            for t, y, between in steps:
                h, stopped_at = t - stopped_at, t
                if not np.all(np.isfinite(y)):
                    raise FloatingPointError("state not finite")
                if np.max(np.abs(y)) > LARGEST:
                    raise FloatingPointError(f"state above {LARGEST:.0e}")
                sizes.append(h)
                left = times[len(states) :]
                states += [np.array(between(wanted)) for wanted in left[left <= t + 1e-12]]
                if len(states) < len(times) and h < LEAST_STEP:
                    raise FloatingPointError(f"step size below {LEAST_STEP:.0e} s")
                if evaluations >= most_evaluations:
                    raise FloatingPointError(f"{most_evaluations} evaluations")
        except FloatingPointError as stop:
            failure = str(stop)
    reached = np.array(times[: len(states)], dtype=float)
    return History(reached, np.array(states), np.array(sizes), failure, stopped_at)
