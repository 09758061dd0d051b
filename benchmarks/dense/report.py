"""The report's dense system as it was run: guarded, and with the measure of its errors."""

from typing import Any

import numpy as np
from dense.steps import History, Scheme, integrate
from dense.system import Dense
from dense.tables import Array, Variant

from stmuav_jax import Scene


class Report(Dense):
    """The dense system of a scene."""

    def derivative(self, t: float, y: Array) -> Array:
        """y'. A state that is not finite gives one that is not, and no error."""
        try:
            return self.rate(t, y) if np.all(np.isfinite(y)) else np.full_like(y, np.nan)
        except np.linalg.LinAlgError:
            return np.full_like(y, np.nan)

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
    model = Report(scene, variant)
    return model, integrate(model.derivative, model.start(scene, p), times, scheme)
