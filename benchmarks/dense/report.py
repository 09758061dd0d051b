"""The report's dense system as it was run: guarded, with the work done and measures of its errors."""

from dataclasses import replace
from typing import Any

import numpy as np
from dense.steps import History, Limits, Scheme, integrate
from dense.system import Dense
from dense.tables import Array, Variant, g_and_l, times as product

from stmuav_jax import Scene


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


def attempt(
    scene: Scene,
    times: Array,
    scheme: Scheme,
    variant: Variant | None = None,
    p: dict[str, Any] | None = None,
) -> tuple[Report, History]:
    """One run of the dense system, its states kept at `times`."""
    model, limits = Report(scene, variant), Limits()
    limits = replace(limits, size=limits.size / model.variant.metres)
    return model, integrate(model.derivative, model.begin(scene, p), times, scheme, limits)
