"""Filters: one prediction and one measurement update, in covariance or in square-root form.

Both forms compute the same numbers. With the innovation's covariance S = Ls Ls^T, the cross
covariance C of state and measurement, and nu the innovation:

    W = Ls^-1 C^T,   mean <- mean + W^T Ls^-1 nu,   P <- P - W^T W

The covariance form does this and factorises P, which can fail if rounding makes P - W^T W
indefinite. The square-root form never subtracts squares: it triangularises the rows of the joint
deviations of measurement and state, whose root is [Ls, 0; W^T, L], or, if the state's rows are
triangular already, takes one scalar measurement after the other by Carlson's closed form.

A NaN among the measurements is a missing one: its row and column of S become those of the unit
matrix and its innovation zero, so that it changes nothing, even if its noise is correlated.
"""

import math
from abc import abstractmethod
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ..algebra.space import Composite, Point
from ..algebra.stacked import multiply, transposed_multiply
from ..checks.errors import SettingError
from .factor import cholesky, divide_lower, downdate, outer_square, reduce_root, triangularise
from .gaussians import Gaussian
from .model import Inputs, Sensor, StateSpaceModel, widened
from .sigma import AbstractRule, Cubature, Transformed

Form = Literal["square_root", "covariance"]


class Innovation(NamedTuple):
    """Innovation of one measurement, and its covariance.

    Attributes:
        error: measurement less its prediction (m, *s), zero where missing.
        normalised: Ls^-1 error, of unit covariance if the filter is consistent (m, *s).
        factor: root Ls of the innovation's covariance (m, m, *s); a missing measurement has the
            row and column of the unit matrix.
        measured: True for components that are not missing (m, *s).
    """

    error: Float[Array, "m *s"]
    normalised: Float[Array, "m *s"]
    factor: Float[Array, "m m *s"]
    measured: Bool[Array, "m *s"]

    @property
    def missing(self) -> Int[Array, "*s"]:
        """Number of missing components."""
        return jnp.sum(~self.measured, axis=0)

    @property
    def nis(self) -> Float[Array, "*s"]:
        """Normalised innovation squared nu^T S^-1 nu, chi-squared with (m - missing) degrees."""
        return jnp.sum(self.normalised**2, axis=0)

    @property
    def log_likelihood(self) -> Float[Array, "*s"]:
        """Log-likelihood log N(nu; 0, S) of the components that are not missing."""
        m = self.factor.shape[0]
        logs = jnp.stack([jnp.log(self.factor[i, i]) for i in range(m)])
        count = m - self.missing
        return -0.5 * (self.nis + count * math.log(2 * math.pi)) - jnp.sum(logs, axis=0)


def _check_form(form: str) -> None:
    known = get_args(Form)
    if form not in known:
        raise SettingError(f"'{form}' is not one of {known}.")


class AbstractFilter(eqx.Module):
    """Step of a filter, from the estimate after one measurement to that after the next.

    Attributes:
        rule: rule for the transformation of Gaussians by functions, also used by `smooth`.
    """

    rule: eqx.AbstractVar[AbstractRule]

    @abstractmethod
    def step(
        self, model: StateSpaceModel, before: Gaussian, y: Point, u: Inputs, dt: Any
    ) -> tuple[Gaussian, Innovation]:
        """Estimate after a measurement y (m, *s), NaN where missing, dt [s] after `before`."""


class GaussianFilter(AbstractFilter):
    """Kalman filter with new sigma points (or linearisation) for prediction and update.

    Attributes:
        rule: rule for the transformation of Gaussians, by default `Cubature()`.
        form: "square_root" or "covariance".

    Raises:
        SettingError: an unknown form.
    """

    rule: AbstractRule = eqx.field(default_factory=Cubature)
    form: Form = eqx.field(static=True, default="square_root")

    def __check_init__(self) -> None:
        _check_form(self.form)

    def predict(
        self, model: StateSpaceModel, prior: Gaussian, u: Inputs = None, dt: Any = 1.0
    ) -> Gaussian:
        """Predicted state after a step, x <- f(x, u, dt) + w.

        Args:
            u: inputs held over the step, components first.
            dt: length of the step [s].
        """
        moved = self.rule.transform(lambda x: model(x, u, dt), prior, model.space, model.space)
        noise = model.step_noise(dt, prior.factor.ndim)
        return Gaussian(moved.mean, _root(moved.rows, noise, moved.less, self.form))

    def update(
        self,
        prior: Gaussian,
        y: Point,
        sensor: Sensor,
        u: Inputs = None,
        *,
        model: StateSpaceModel,
    ) -> tuple[Gaussian, Innovation]:
        """State given a measurement, and its innovation.

        Several sensors are used one after the other, each on the result of the previous one.

        Args:
            y: measurement (m, *s), NaN where missing.
            u: inputs of the sensor's function.
            model: model whose space the state belongs to.
        """
        seen = self.rule.transform(lambda x: sensor(x, u), prior, model.space, sensor.space)
        error, there = _innovation(y, seen.mean, sensor)
        rows, noise = _without(seen.rows, sensor.noise, there)
        less = None if seen.less is None else seen.less * there
        seen = seen._replace(rows=rows, less=less)
        if self.form == "square_root" and seen.triangular and less is None:
            move, factor, scaled, Ls = _scalar_by_scalar(seen, prior.factor, noise, error)
        else:
            q, n = seen.inputs.shape[:2]
            none = jnp.zeros((rows.shape[0] - q, n, *seen.inputs.shape[2:]), rows.dtype)
            inputs = jnp.concatenate([seen.inputs, none])
            move, factor, scaled, Ls = _jointly(rows, inputs, noise, less, error, self.form)
        return (
            Gaussian(model.space.retract(prior.mean, move), factor),
            Innovation(error, scaled, Ls, there),
        )

    def step(
        self, model: StateSpaceModel, before: Gaussian, y: Point, u: Inputs, dt: Any
    ) -> tuple[Gaussian, Innovation]:
        predicted = self.predict(model, before, u, dt)
        return self.update(predicted, y, model.sensor, u, model=model)


class ReusingFilter(AbstractFilter):
    """Kalman filter that uses the predicted sigma points again for the measurement.

    These points lack the spread that the process noise adds. For a linear system the result is
    therefore not the Kalman filter's; FilterPy up to 1.4.5 worked in this way (its issue 172).
    The attributes and errors are those of `GaussianFilter`.
    """

    rule: AbstractRule = eqx.field(default_factory=Cubature)
    form: Form = eqx.field(static=True, default="square_root")

    def __check_init__(self) -> None:
        _check_form(self.form)

    def step(
        self, model: StateSpaceModel, before: Gaussian, y: Point, u: Inputs, dt: Any
    ) -> tuple[Gaussian, Innovation]:
        sensor, n = model.sensor, model.space.size
        joint = Composite(x=model.space, y=sensor.space)

        def both(x: Point) -> Point:
            moved = model(x, u, dt)
            return {"x": moved, "y": sensor(moved, u)}

        sent = self.rule.transform(both, before, model.space, joint)
        error, there = _innovation(y, sent.mean["y"], sensor)
        rows, noise = _without(sent.rows[:, n:], sensor.noise, there)
        states = jnp.swapaxes(model.step_noise(dt, before.factor.ndim), 0, 1)
        states = jnp.broadcast_to(states, (n, n, *rows.shape[2:]))
        none = jnp.zeros((n, *rows.shape[1:]), rows.dtype)
        less = (
            None if sent.less is None else jnp.concatenate([sent.less[n:] * there, sent.less[:n]])
        )
        move, factor, scaled, Ls = _jointly(
            jnp.concatenate([rows, none]),
            jnp.concatenate([sent.rows[:, :n], states]),
            noise,
            less,
            error,
            self.form,
        )
        mean = model.space.retract(sent.mean["x"], move)
        return Gaussian(mean, factor), Innovation(error, scaled, Ls, there)


# The default filter.
DEFAULT = GaussianFilter()


def _root(rows: Array, noise: Array, less: Array | None, form: Form) -> Array:
    """Root of rows^T rows + noise noise^T - less less^T."""
    if form == "covariance":
        P = transposed_multiply(rows, rows) + outer_square(noise)
        return cholesky(P if less is None else P - less[:, None] * less[None])
    turned = jnp.broadcast_to(jnp.swapaxes(noise, 0, 1), (*noise.shape[:2], *rows.shape[2:]))
    L = triangularise(jnp.concatenate([rows, turned]))
    return L if less is None else downdate(L, less)


def _innovation(
    y: Point, predicted: Point, sensor: Sensor
) -> tuple[Float[Array, "m *s"], Bool[Array, "m *s"]]:
    """Measurement less its prediction, and the mask of components that are not missing."""
    error = sensor.space.difference(y, predicted)
    # a NaN of the prediction does not pass for a missing measurement: the rows contain it too
    there = ~jnp.isnan(error)
    return jnp.where(there, error, 0.0), there


def _without(rows: Array, noise: Array, there: Array) -> tuple[Array, Array]:
    """Rows of the measurement and of its noise, with missing components replaced."""
    noise = widened(noise, rows.ndim, 2)
    unit = jnp.eye(noise.shape[0], dtype=noise.dtype)
    unit = unit.reshape(*unit.shape, *(1,) * (rows.ndim - 2))
    gone = jnp.where(there, 0.0, 1.0)
    parts = [jnp.swapaxes(noise, 0, 1) * there[None], unit * gone[None]]
    return rows * there[None], jnp.concatenate(parts).astype(rows.dtype)


def _scalar_by_scalar(
    seen: Transformed, L: Array, noise: Array, error: Array
) -> tuple[Array, Array, Array, Array]:
    """Update by one scalar measurement after the other, for triangular rows of the state.

    Divided by the root Le of the covariance that the state does not explain, the measurements
    are independent and of unit noise: each has a row of A = Le^-1 H L and an error.

    Returns:
        Displacement of the mean, posterior root, scaled innovation, and Ls.
    """
    n, m = L.shape[0], error.shape[0]
    Le = triangularise(jnp.concatenate([seen.rows[n:], noise]))
    right = jnp.concatenate([jnp.swapaxes(seen.rows[:n], 0, 1), error[:, None]], axis=1)
    independent = divide_lower(Le, right)
    A, nu = independent[:, :n], independent[:, n]
    # the state above, the remaining measurements below
    M = jnp.concatenate([L, A])
    one = jnp.ones_like(nu[0])
    move, scaled, unit_factor = jnp.zeros_like(L[:, 0]), [], []
    for i in range(m):
        a = M[n]
        s = one + jnp.sum(a * a, axis=0)
        gains = jnp.sum(jnp.swapaxes(M * a[None], 0, 1), axis=0) / jnp.sqrt(s)
        e = nu[i] / jnp.sqrt(s)
        scaled.append(e)
        move = move + gains[:n] * e
        nu = nu.at[i:].add(-gains[n:] * e) if i + 1 < m else nu
        # the column of Ls for independent noise: the gains, with the root of s on the diagonal
        head = jnp.sqrt(s)[None]
        none = jnp.zeros((i, *head.shape[1:]), head.dtype)
        unit_factor.append(jnp.concatenate([none, head, gains[n + 1 :]]))
        M = reduce_root(jnp.concatenate([M[:n], M[n + 1 :]]), a, one)
    Ls = multiply(Le, jnp.stack(unit_factor, axis=1))
    return move, M[:n], jnp.stack(scaled), Ls


def _jointly(
    rows: Array, inputs: Array, noise: Array, less: Array | None, error: Array, form: Form
) -> tuple[Array, Array, Array, Array]:
    """Update as by `_scalar_by_scalar`, for any rows (r, m) of measurement and (r, n) of state."""
    m, n = rows.shape[1], inputs.shape[1]
    if form == "covariance":
        S = transposed_multiply(rows, rows) + transposed_multiply(noise, noise)
        C = transposed_multiply(rows, inputs)
        P = transposed_multiply(inputs, inputs)
        if less is not None:
            S = S - less[:m, None] * less[None, :m]
            if less.shape[0] > m:
                C = C - less[:m, None] * less[None, m:]
                P = P - less[m:, None] * less[None, m:]
        Ls = cholesky(S)
        W = divide_lower(Ls, C)
        scaled = divide_lower(Ls, error[:, None])[:, 0]
        factor = cholesky(P - transposed_multiply(W, W))
    else:
        none = jnp.zeros((noise.shape[0], n, *noise.shape[2:]), rows.dtype)
        joint = jnp.concatenate(
            [
                jnp.concatenate([rows, inputs], axis=1),
                jnp.concatenate([noise, none], axis=1),
            ]
        )
        both = triangularise(joint)
        if less is not None:
            absent = jnp.zeros((m + n - less.shape[0], *less.shape[1:]), less.dtype)
            both = downdate(both, jnp.concatenate([less, absent]))
        Ls, W, factor = both[:m, :m], jnp.swapaxes(both[m:, :m], 0, 1), both[m:, m:]
        scaled = divide_lower(Ls, error[:, None])[:, 0]
    return jnp.sum(W * scaled[:, None], axis=0), factor, scaled, Ls
