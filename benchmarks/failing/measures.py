"""Runs of the report's dense system and their records: residuals, energy, norms, eigenvalues."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import numpy as np
from dense.system import Dense
from dense.tables import Array, Variant, g_and_l, times as product
from failing.steps import History, Limits, Scheme, integrate

from stmuav_jax import Method, Scene, State, simulate

EVERY = 0.01  # spacing of looked-at times [s]


class Report(Dense):
    """The dense system of a scene, its state followed by the work done so far [J]."""

    def begin(self, scene: Scene, p: dict[str, Array] | None = None) -> Array:
        """The start, no work done; `p` replaces Euler parameters by name, as they are."""
        return np.append(self.start(scene, p), 0.0)

    def derivative(self, t: float, y: Array) -> Array:
        """y'. A state that is not finite gives one that is not, and no error."""
        try:
            rate = self.rate(t, y) if np.all(np.isfinite(y)) else None
        except np.linalg.LinAlgError:
            rate = None
        return np.full_like(y, np.nan) if rate is None else np.append(rate, self._power(t, y))

    def turning(self, y: Array) -> Array:
        """Angular rates in body axes (n, 3) [rad/s]."""
        q, u = self.split(y)
        return 2 * product(g_and_l(q[:-1, 3:])[1], u[:-1, 3:])

    def _power(self, t: float, y: Array) -> float:
        """Power of rotors and actuators [W]."""
        q, u = self.split(y)
        G, L = g_and_l(q[:, 3:])
        force, moment = self.loads(t, q[:, :3], G @ L.transpose(0, 2, 1), gravity=False)
        work = np.sum(force * u[:, :3]) + np.sum(moment[:-1] * self.turning(y))
        return float(work) * self.variant.metres**2

    def energy(self, y: Array) -> float:
        """Kinetic and potential energy less the work done so far [J]."""
        (q, u), omega, model = self.split(y), self.turning(y), self.model
        kinetic = np.sum(model.mass * np.sum(u[:-1, :3] ** 2, 1))
        kinetic += np.sum(omega * product(model.inertia, omega))
        potential = -np.sum(model.mass[:, None] * model.gravity * q[:-1, :3])
        return float(0.5 * kinetic + potential) * self.variant.metres**2 - float(y[-1])

    def violation(self, y: Array) -> float:
        """Largest residual, all three rows of cross products counted [m], axes' rows [1]."""
        found = self.residuals(y)
        return max(self.gap(y), found["n1"], found["p1"])

    def norm_error(self, y: Array) -> float:
        """Largest | |p| - 1 |."""
        return float(np.max(np.abs(np.linalg.norm(self.split(y)[0][:-1, 3:], axis=1) - 1)))

    def condition(self, t: float, y: Array) -> float:
        """2-norm condition number of the large matrix."""
        return float(np.linalg.cond(self.matrix(t, y)[0]))


@dataclass(frozen=True)
class Reference:
    """Converged positions (k, 7, 3) [m] at `times`, and how far two tolerances differ (k,)."""

    scene: Scene
    times: Array
    positions: Array
    uncertainty: Array
    states: State

    def start_at(self, model: Report, k: int) -> Array:
        """The dense system's state at the k-th time."""
        state = jax.tree.map(lambda x: np.asarray(x)[k], self.states)
        return model.begin(replace(self.scene, state0=state))


def grid(t1: float) -> Array:
    """The times that are looked at, to t1 [s]."""
    return EVERY * np.arange(round(t1 / EVERY) + 1)


def reference(scene: Scene, t1: float) -> Reference:
    """The scene by the package at 1e-11, with its difference from 1e-9."""
    times = grid(t1)
    fine, coarse = (
        simulate(scene, method=Method(rtol=tol, atol=tol), ts=times) for tol in (1e-11, 1e-9)
    )
    r = np.asarray(fine.states.r)
    apart = np.max(np.abs(r - np.asarray(coarse.states.r)), axis=(1, 2))
    return Reference(scene, times, r, apart, fine.states)


def attempt(
    scene: Scene,
    times: Array,
    scheme: Scheme,
    variant: Variant | None = None,
    p: dict[str, Any] | None = None,
) -> tuple[Report, History]:
    """One run of the dense system."""
    model = Report(scene, variant)
    limits = Limits(size=Limits().size / model.variant.metres)
    return model, integrate(model.derivative, model.begin(scene, p), times, scheme, limits)


def describe(
    model: Report, history: History, ref: Reference | None = None, every: int = 10, *, series=False
) -> dict[str, Any]:
    """The record of one run, numbers only; conditions and eigenvalues at every `every`-th time."""
    times, states, steps = history.times, history.states, history.sizes
    violation = [model.violation(y) for y in states]
    energy = np.array([model.energy(y) for y in states])
    pick = range(0, len(times), every)
    condition = [model.condition(times[k], states[k]) for k in pick]
    values = np.concatenate([eigenvalues(model, times[k], states[k]) for k in pick])
    values = values[np.isfinite(values)]
    most = lambda what, values: float(what(values)) if values.size else None
    out: dict[str, Any] = {
        **history.summary(),
        "evaluations": history.evaluations,
        "seconds": history.seconds,
        "step_median": most(np.median, steps),
        "step_smallest": most(np.min, steps[:-1]),
        "violation": at_times(times, violation),
        "energy_drift": at_times(times, energy - energy[0]),
        "norm_error": at_times(times, [model.norm_error(y) for y in states]),
        "condition": [float(np.min(condition)), float(np.max(condition))],
        "fastest_rate": most(np.max, np.abs(values)),
        "most_negative_real": most(np.min, np.real(values)),
        "largest_imaginary": most(np.max, np.imag(values)),
    }
    if series:
        short = lambda values: [float(f"{x:.3g}") if np.isfinite(x) else None for x in values]
        drawn = {"violation": short(violation), "energy_drift": short(energy - energy[0])}
        out["series"] = {"t": np.round(times, 6).tolist(), **drawn}
    if ref is not None:
        apart = np.abs(model.positions(states) - ref.positions[: len(times)])
        out["position_error"] = at_times(times, np.max(apart, axis=(1, 2)))
    return out


def at_times(times: Array, values: Any) -> dict[str, float | None]:
    """The values at a few fixed times, None where the run did not get there."""
    out: dict[str, float | None] = {}
    for t in (0.1, 0.35, 0.5, 1.0, 2.0):
        k = int(np.argmin(np.abs(times - t)))
        out[f"{t:g}"] = float(values[k]) if abs(times[k] - t) < 1e-9 else None
    return out


def eigenvalues(model: Report, t: float, y: Array) -> Array:
    """Eigenvalues of dy'/dy of the dense system as integrated (98), by central differences."""
    size = y.size - 1
    jacobian = np.empty((size, size))
    for k in range(size):
        step = np.zeros_like(y)
        step[k] = 1e-6 * max(1.0, abs(y[k]))
        change = model.derivative(t, y + step) - model.derivative(t, y - step)
        jacobian[:, k] = change[:-1] / (2 * step[k])
    if not np.all(np.isfinite(jacobian)):
        return np.full(size, np.nan + 0j)
    return np.linalg.eigvals(jacobian)
