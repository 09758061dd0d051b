"""Integrators with a guard: every run ends, and says when and why.

MATLAB's rule for the step size of ode45 (Shampine and Reichelt, The MATLAB ODE Suite, SIAM J. Sci.
Comput. 18, 1997: error in the maximum norm), and the classical Runge-Kutta method with fixed steps.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import RK45

Array = np.ndarray
Field = Callable[[float, Array], Array]


@dataclass(frozen=True)
class Limits:
    """When a run is given up.

    Attributes:
        evaluations: of the accelerations. seconds: of wall time.
        step: an adaptive step shorter than this [s] counts as collapsed.
        size: largest entry of the state.
    """

    evaluations: int = 60_000
    seconds: float = 3600.0
    step: float = 1e-9
    size: float = 1e7


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
    """States (k, 99) at the wanted times that were reached, steps taken, and how it ended.

    `ends` and `sizes` are of accepted steps [s]; `failure` is empty if the end was reached. They
    are lists while the run goes on, and arrays when it has ended.
    """

    times: Any
    states: Any
    ends: Any
    sizes: Any
    evaluations: int = 0
    seconds: float = 0.0
    failure: str = ""
    stopped_at: float = 0.0

    def summary(self) -> dict[str, Any]:
        """How far it came, why no farther, and in how many steps."""
        return {"reached": self.stopped_at, "failure": self.failure, "steps": len(self.sizes)}


class Ode45:
    """Dormand and Prince's 5(4) pair under MATLAB's step size rule, last entry unchecked."""

    def __init__(self, f: Field, y: Array, t1: float, rtol: float, atol: float) -> None:
        self.f, self.t, self.y, self.t1 = f, 0.0, y, t1
        self.rtol, self.threshold = rtol, atol / rtol
        self.first = f(0.0, y)
        self.largest = 0.1 * t1
        rate = self._relative(self.first, y, y) / (0.8 * rtol**0.2)
        self.h = min(self.largest, 1 / rate if rate > 0 else self.largest)
        self.status = "running"
        self.old: tuple[float, Array, Array] = (0.0, y, self.first)

    def _relative(self, change: Array, a: Array, b: Array) -> float:
        size = np.maximum(np.maximum(np.abs(a), np.abs(b)), self.threshold)
        return float(np.max(np.abs(change / size)[:-1]))

    def _attempt(self, h: float) -> tuple[Array, Array, float]:
        k = [self.first]
        for a, c in zip(RK45.A[1:], RK45.C[1:], strict=True):
            slope = sum(float(w) * x for w, x in zip(a, k, strict=False))
            k.append(self.f(self.t + c * h, self.y + h * slope))
        y = self.y + h * sum(float(w) * x for w, x in zip(RK45.B, k, strict=True))
        k.append(self.f(self.t + h, y))
        error = h * np.sum([float(w) * x for w, x in zip(RK45.E, k, strict=True)], axis=0)
        return y, k[-1], self._relative(error, self.y, y)

    def step(self) -> None:
        """One accepted step, or status "failed"."""
        smallest = 16 * np.spacing(self.t)
        h = min(max(self.h, smallest), self.largest, self.t1 - self.t)
        failed = False
        while True:
            y, last, error = self._attempt(h)
            if error <= self.rtol:
                break
            if h <= smallest or not np.isfinite(self.t + h):
                self.status = "failed"
                return
            shrink = 0.8 * (self.rtol / error) ** 0.2 if np.isfinite(error) else 0.1
            h = max(smallest, h * (0.5 if failed else max(0.1, shrink)))
            failed = True
        self.old = (self.t, self.y, self.first)
        self.t, self.y, self.first = self.t + h, y, last
        grow = 1.25 * (error / self.rtol) ** 0.2
        self.h = h if failed else h / max(grow, 0.2)
        self.status = "finished" if self.t >= self.t1 - 1e-14 else "running"

    def dense_output(self) -> Callable[[float], Array]:
        """Between the last two states, cubic in their values and rates."""
        (t0, y0, f0), y1, f1 = self.old, self.y, self.first
        h = self.t - t0

        def at(t: float) -> Array:
            x = (t - t0) / h
            bend = (1 - 2 * x) * (y1 - y0) + h * ((x - 1) * f0 + x * f1)
            return (1 - x) * y0 + x * y1 + x * (x - 1) * bend

        return at


class Fixed:
    """The classical Runge-Kutta method of order 4 with a fixed step."""

    def __init__(self, f: Field, y: Array, t1: float, h: float) -> None:
        self.f, self.y, self.t, self.h = f, y, 0.0, h
        self.count, self.total, self.status = 0, round(t1 / h), "running"
        self.old: tuple[float, Array] = (0.0, y)

    def step(self) -> None:
        """One step."""
        t, y, h = self.t, self.y, self.h
        a = self.f(t, y)
        b = self.f(t + h / 2, y + h / 2 * a)
        c = self.f(t + h / 2, y + h / 2 * b)
        slope = (a + 2 * b + 2 * c + self.f(t + h, y + h * c)) / 6
        self.old = (t, y)
        self.y, self.count = y + h * slope, self.count + 1
        self.t = self.count * h
        self.status = "finished" if self.count >= self.total else "running"

    def dense_output(self) -> Callable[[float], Array]:
        """Linear: wanted times are meant to be those of steps."""
        (t0, y0), t1, y1 = self.old, self.t, self.y
        return lambda t: y0 + (t - t0) / (t1 - t0) * (y1 - y0)


def integrate(
    f: Field, y0: Array, times: Array, scheme: Scheme, limits: Limits | None = None
) -> History:
    """Integrate y' = f(t, y) from times[0] = 0 and keep the states at `times`."""
    log = History([0.0], [y0], [], [])

    def counted(t: float, y: Array) -> Array:
        log.evaluations += 1
        return f(t, y)

    started = time.perf_counter()
    with np.errstate(all="ignore"):
        end = float(times[-1])
        adaptive = lambda: Ode45(counted, y0, end, scheme.rtol, scheme.atol)
        stepper = Fixed(counted, y0, end, scheme.step) if scheme.step else adaptive()
        while not log.failure and len(log.times) < len(times):
            log.failure = _advance(stepper, times, log, limits or Limits(), started)
    log.seconds, log.stopped_at = time.perf_counter() - started, float(stepper.t)
    for name in ("times", "states", "ends", "sizes"):
        setattr(log, name, np.array(getattr(log, name)))
    return log


def _advance(stepper: Any, times: Array, log: History, limits: Limits, started: float) -> str:
    """Make one step and keep it; why the run stops there, in words."""
    before = stepper.t
    stepper.step()
    if stepper.status == "failed":
        return "step size below the spacing of numbers"
    if not np.all(np.isfinite(stepper.y)):
        return "state not finite"
    if np.max(np.abs(stepper.y[:-1])) > limits.size:
        return f"state above {limits.size:.0e}"
    log.ends.append(stepper.t)
    log.sizes.append(stepper.t - before)
    between = stepper.dense_output()
    for t in times[len(log.times) :][times[len(log.times) :] <= stepper.t + 1e-12]:
        log.times.append(float(t))
        log.states.append(np.array(between(t)))
    if log.sizes[-1] < limits.step and stepper.status != "finished":
        return f"step size below {limits.step:.0e} s"
    if log.evaluations >= limits.evaluations:
        return f"{limits.evaluations} evaluations"
    if time.perf_counter() - started > limits.seconds:
        return f"{limits.seconds:g} s of wall time"
    return ""
