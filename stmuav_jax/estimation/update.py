"""One prediction and one measurement update, in covariance or in square-root form.

Both forms compute the same numbers. With the innovation's covariance S = Ls Ls^T, the cross
covariance C of state and measurement, and nu the innovation:

    W = Ls^-1 C^T,   mean <- mean + W^T Ls^-1 nu,   P <- P - W^T W

The covariance form does this and factorises (it can fail, where rounding makes P - W^T W
indefinite); the square-root form never subtracts squares: it triangularises the rows of the joint
deviations of measurement and state, whose root is [Ls, 0; W^T, L], or, where the state's rows
are triangular already, takes one scalar measurement after the other by Carlson's closed form.

A NaN among the measurements is a missing one: its row and column of S become those of the unit
matrix, its innovation zero, so that it changes nothing, whatever correlates with it.
"""

import math
from typing import Any, Literal, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from .factor import (
    cholesky,
    cross_gram,
    divide_lower,
    downdate,
    gram,
    outer_square,
    product,
    reduce_root,
    triangularise,
)
from .gaussian import Gaussian
from .model import Inputs, Sensor, StateSpaceModel, widened
from .sigma import AbstractRule, Cubature, Transformed
from .space import Composite, Point

Form = Literal["square_root", "covariance"]


class Innovation(NamedTuple):
    """What one measurement said.

    Attributes:
        error: measured less predicted, zero where missing, (m, *s).
        scaled: Ls^-1 error, of unit covariance if the filter is right, (m, *s).
        factor: Ls, the root of the innovation's covariance (m, m, *s); a missing measurement
            has the row and column of the unit matrix.
        there: which of the m were measured, not missing (m, *s).
    """

    error: Float[Array, "m *s"]
    scaled: Float[Array, "m *s"]
    factor: Float[Array, "m m *s"]
    there: Bool[Array, "m *s"]

    @property
    def missing(self) -> Int[Array, "*s"]:
        """How many of the m were missing."""
        return jnp.sum(~self.there, axis=0)

    @property
    def nis(self) -> Float[Array, "*s"]:
        """Normalised innovation squared nu^T S^-1 nu, chi-squared with (m - missing) degrees."""
        return jnp.sum(self.scaled**2, axis=0)

    @property
    def log_likelihood(self) -> Float[Array, "*s"]:
        """log N(nu; 0, S) over the measurements that are there."""
        m = self.factor.shape[0]
        logs = jnp.stack([jnp.log(self.factor[i, i]) for i in range(m)])
        count = m - self.missing
        return -0.5 * (self.nis + count * math.log(2 * math.pi)) - jnp.sum(logs, axis=0)


def predict(
    model: StateSpaceModel,
    prior: Gaussian,
    u: Inputs = None,
    dt: Any = 1.0,
    *,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
) -> Gaussian:
    """The state one step later: x <- f(x, u, dt) + w.

    Args:
        u: inputs held over the step, components first. dt: the step [s].
        rule: default `Cubature()`.
    """
    rule = Cubature() if rule is None else rule
    moved = rule.transform(lambda x: model(x, u, dt), prior, model.space, model.space)
    noise = model.step_noise(dt, prior.factor.ndim)
    return Gaussian(moved.mean, _root(moved.rows, noise, moved.less, form))


def update(
    prior: Gaussian,
    y: Point,
    sensor: Sensor,
    u: Inputs = None,
    *,
    model: StateSpaceModel,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
) -> tuple[Gaussian, Innovation]:
    """The state given a measurement, with sigma points drawn from `prior`.

    Several sensors are used one after the other, each on the result of the one before.

    Args:
        y: measurement (m, *s), NaN where missing. u: inputs, as for the sensor's function.
        model: whose state it is (its space). rule: default `Cubature()`.
    """
    rule = Cubature() if rule is None else rule
    seen = rule.transform(lambda x: sensor(x, u), prior, model.space, sensor.space)
    error, there = _innovation(y, seen.mean, sensor)
    rows, noise = _without(seen.rows, sensor.noise, there)
    less = None if seen.less is None else seen.less * there
    seen = seen._replace(rows=rows, less=less)
    if form == "square_root" and seen.triangular and less is None:
        move, factor, scaled, Ls = _scalar_by_scalar(seen, prior.factor, noise, error)
    else:
        q, n = seen.inputs.shape[:2]
        none = jnp.zeros((rows.shape[0] - q, n, *seen.inputs.shape[2:]), rows.dtype)
        inputs = jnp.concatenate([seen.inputs, none])
        move, factor, scaled, Ls = _jointly(rows, inputs, noise, less, error, form)
    return (
        Gaussian(model.space.retract(prior.mean, move), factor),
        Innovation(error, scaled, Ls, there),
    )


def predict_and_update(
    model: StateSpaceModel,
    prior: Gaussian,
    y: Point,
    u: Inputs,
    dt: Any,
    *,
    rule: AbstractRule,
    form: Form,
) -> tuple[Gaussian, Innovation]:
    """One step in which the predicted sigma points are used again for the measurement.

    They do not have the spread that the process noise adds. For a linear system the result is
    therefore not the Kalman filter's; FilterPy up to 1.4.5 worked in this way (its issue 172).
    """
    sensor, n = model.sensor, model.space.size
    joint = Composite(x=model.space, y=sensor.space)

    def both(x: Point) -> Point:
        moved = model(x, u, dt)
        return {"x": moved, "y": sensor(moved, u)}

    sent = rule.transform(both, prior, model.space, joint)
    error, there = _innovation(y, sent.mean["y"], sensor)
    rows, noise = _without(sent.rows[:, n:], sensor.noise, there)
    states = jnp.swapaxes(model.step_noise(dt, prior.factor.ndim), 0, 1)
    states = jnp.broadcast_to(states, (n, n, *rows.shape[2:]))
    none = jnp.zeros((n, *rows.shape[1:]), rows.dtype)
    less = None if sent.less is None else jnp.concatenate([sent.less[n:] * there, sent.less[:n]])
    move, factor, scaled, Ls = _jointly(
        jnp.concatenate([rows, none]),
        jnp.concatenate([sent.rows[:, :n], states]),
        noise,
        less,
        error,
        form,
    )
    mean = model.space.retract(sent.mean["x"], move)
    return Gaussian(mean, factor), Innovation(error, scaled, Ls, there)


def _root(rows: Array, noise: Array, less: Array | None, form: Form) -> Array:
    """The root of rows^T rows + noise noise^T - less less^T."""
    if form == "covariance":
        P = gram(rows) + outer_square(noise)
        return cholesky(P if less is None else P - less[:, None] * less[None])
    turned = jnp.broadcast_to(jnp.swapaxes(noise, 0, 1), (*noise.shape[:2], *rows.shape[2:]))
    L = triangularise(jnp.concatenate([rows, turned]))
    return L if less is None else downdate(L, less)


def _innovation(
    y: Point, predicted: Point, sensor: Sensor
) -> tuple[Float[Array, "m *s"], Bool[Array, "m *s"]]:
    """Measured less predicted, and which measurements are there."""
    error = sensor.space.difference(y, predicted)
    # a NaN of the prediction does not pass for a missing measurement: it is in the rows too
    there = ~jnp.isnan(error)
    return jnp.where(there, error, 0.0), there


def _without(rows: Array, noise: Array, there: Array) -> tuple[Array, Array]:
    """The measurement's rows without the missing ones, and rows of the noise."""
    noise = widened(noise, rows.ndim, 2)
    unit = jnp.eye(noise.shape[0], dtype=noise.dtype)
    unit = unit.reshape(*unit.shape, *(1,) * (rows.ndim - 2))
    gone = jnp.where(there, 0.0, 1.0)
    parts = [jnp.swapaxes(noise, 0, 1) * there[None], unit * gone[None]]
    return rows * there[None], jnp.concatenate(parts).astype(rows.dtype)


def _scalar_by_scalar(
    seen: Transformed, L: Array, noise: Array, error: Array
) -> tuple[Array, Array, Array, Array]:
    """Move of the mean, posterior root, scaled innovation, Ls; rows as in the module's text.

    Divided by the root of what is not explained by the state, the measurements are
    independent and of unit noise: a row of A = Le^-1 H L and an error of each.
    """
    n, m = L.shape[0], error.shape[0]
    Le = triangularise(jnp.concatenate([seen.rows[n:], noise]))
    right = jnp.concatenate([jnp.swapaxes(seen.rows[:n], 0, 1), error[:, None]], axis=1)
    independent = divide_lower(Le, right)
    A, nu = independent[:, :n], independent[:, n]
    # state above, measurements still to come below
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
        # the column of Ls for independent noise: gains, with the noise on the diagonal
        head = jnp.sqrt(s)[None]
        none = jnp.zeros((i, *head.shape[1:]), head.dtype)
        unit_factor.append(jnp.concatenate([none, head, gains[n + 1 :]]))
        M = reduce_root(jnp.concatenate([M[:n], M[n + 1 :]]), a, one)
    Ls = product(Le, jnp.stack(unit_factor, axis=1))
    return move, M[:n], jnp.stack(scaled), Ls


def _jointly(
    rows: Array, inputs: Array, noise: Array, less: Array | None, error: Array, form: Form
) -> tuple[Array, Array, Array, Array]:
    """As `_scalar_by_scalar`, for any rows: (r, m) of the measurement, (r, n) of the state."""
    m, n = rows.shape[1], inputs.shape[1]
    if form == "covariance":
        S = gram(rows) + gram(noise)
        C = cross_gram(rows, inputs)
        P = gram(inputs)
        if less is not None:
            S = S - less[:m, None] * less[None, :m]
            if less.shape[0] > m:
                C = C - less[:m, None] * less[None, m:]
                P = P - less[m:, None] * less[None, m:]
        Ls = cholesky(S)
        W = divide_lower(Ls, C)
        scaled = divide_lower(Ls, error[:, None])[:, 0]
        factor = cholesky(P - gram(W))
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
