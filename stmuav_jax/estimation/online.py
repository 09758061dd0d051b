"""One measurement at a time, from Python: for use beside a machine that runs."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from ..mechanics.errors import ModelError, SettingError
from .filter import EstimationError, is_finite, one_step
from .gaussian import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule, Cubature
from .update import Form


class Estimate(NamedTuple):
    """What is known after a measurement.

    Attributes:
        t: its time [s]. state: the Gaussian. nis: normalised innovation squared.
        missing: how many of its components were NaN.
    """

    t: float
    state: Gaussian
    nis: float
    missing: int


class OnlineFilter:
    """A filter that waits for measurements.

    The first call compiles (`warm_up` does it beforehand); all later ones run the same code as
    `kalman_filter`.

    Attributes:
        t: time of the estimate [s]. state: the estimate. count, missing: measurements so far,
            and how many of their components were NaN. nis: one number per measurement.
    """

    def __init__(
        self,
        model: StateSpaceModel,
        prior: Gaussian,
        *,
        t: float = 0.0,
        rule: AbstractRule | None = None,
        form: Form = "square_root",
    ) -> None:
        rule = Cubature() if rule is None else rule
        n = model.space.size
        if prior.factor.shape != (n, n):
            raise ModelError(
                f"The prior's covariance must be {n} x {n}, but it is {prior.factor.shape}."
            )
        model.space.check(prior.mean, "The prior's mean")
        rule.check(n, prior.factor.dtype)
        self.model, self.state, self.t = model, prior, float(t)
        self.count, self.missing = 0, 0
        self.nis: list[float] = []

        def step(state: Gaussian, y: Any, u: Inputs, dt: Any) -> tuple:
            after, innovation = one_step(model, state, y, u, dt, rule=rule, form=form)
            return after, innovation.nis, innovation.missing, is_finite(after)

        self._step = eqx.filter_jit(step)

    def warm_up(self, u: Inputs = None) -> None:
        """Compile, with inputs of the kind that will be given."""
        m = self.model.sensor.space.size
        self._step(self.state, self._measured(np.full(m, np.nan)), self._inputs(u), self._time(0.0))

    def step(self, y: Any, t: float, u: Inputs = None) -> Estimate:
        """Predict to time t with inputs u held since the last measurement, and update with y.

        Raises:
            ModelError: y has another size. SettingError: t before the last measurement.
            EstimationError: the covariance was lost; the last good estimate stays.
        """
        if not t >= self.t:
            raise SettingError(f"Time goes backwards: after t = {self.t:g} s comes {t:g} s.")
        y = self._measured(y)
        self.model.sensor.space.check(y, "A measurement")
        after, nis, missing, fine = self._step(
            self.state, y, self._inputs(u), self._time(t - self.t)
        )
        if not bool(fine):
            raise EstimationError(
                f"The filter failed at t = {t:g} s, measurement {self.count}: its covariance was "
                f"not positive definite or its state not finite. The last NIS: {self.nis[-3:]}."
            )
        self.state, self.t = after, float(t)
        self.count += 1
        self.missing += int(missing)
        self.nis.append(float(nis))
        return Estimate(self.t, after, self.nis[-1], int(missing))

    def _measured(self, y: Any) -> np.ndarray:
        return np.asarray(y, dtype=self.state.factor.dtype)

    def _time(self, dt: float) -> np.ndarray:
        return np.asarray(dt, dtype=self.state.factor.dtype)

    def _inputs(self, u: Inputs) -> Inputs:
        return jax.tree.map(lambda leaf: np.asarray(leaf, self.state.factor.dtype), u)
