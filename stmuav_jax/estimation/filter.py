"""Kalman filters over a record of measurements, alone or in a bank.

Each step predicts to the time of a measurement and updates with it, by an `AbstractFilter`. With the
innovation's covariance S = Ls Ls^T, the cross covariance C of state and measurement, and nu the innovation:

    W = Ls^-1 C^T,   mean <- mean + W^T Ls^-1 nu,   P <- P - W^T W

The covariance form does this and factorises P, which can fail if rounding makes P - W^T W
indefinite. The square-root form never subtracts squares: it triangularises the rows of the joint
deviations of measurement and state, whose root is [Ls, 0; W^T, L], or, if the state's rows are
triangular already, takes one scalar measurement after the other by Carlson's closed form. Variances
may be zero, also those of a sensor: what it reads is then known exactly. A reading that contradicts
what is known exactly makes NaN.

A NaN among the measurements is a missing one: its row and column of S become those of the unit
matrix and its innovation zero, so that it changes nothing, even if its noise is correlated.

A filter fails at a step whose numbers are not finite (JAX makes NaN, without notice, of a
covariance that is not positive definite): it keeps its last good estimate, `ok` is False from
there on, and its NIS is infinite.

In a bank the filters are the last axis of every array. They run in groups whose numbers fit into the
processor's nearest cache: larger ones are up to twice as slow.
"""

import math
from abc import abstractmethod
from collections.abc import Callable, Hashable
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..checks.errors import ModelError, SettingError, has_values
from ..math.compiler import is_transformed, outer_jit
from ..math.native.program import evaluate
from ..math.space import Point, as_reading
from ..math.stacked import multiply_matrices, transposed_multiply
from .gaussians import (
    Gaussian,
    divide_lower,
    downdate_factor,
    factor_semidefinite,
    has_contradiction,
    in_lanes,
    outer_square,
    reduce_root,
    triangularise_rows,
)
from .model import Inputs, Sensor, StateSpaceModel, insert_axes
from .records import (
    check_functions,
    check_prior,
    check_record,
    check_steps,
    find_fault,
    read_inputs,
    read_measurements,
    step_lengths,
)
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
        predicted: predicted measurement, a point of the sensor's space; None if a user-defined filter does not
            provide it.
    """

    error: Float[Array, "m *s"]
    normalised: Float[Array, "m *s"]
    factor: Float[Array, "m m *s"]
    measured: Bool[Array, "m *s"]
    predicted: Point = None

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
        pivots = jnp.stack([self.factor[i, i] for i in range(self.factor.shape[0])])
        # what was known exactly has no density
        uncertain = pivots != 0
        logs = jnp.where(uncertain, jnp.log(jnp.where(uncertain, pivots, 1.0)), 0.0)
        count = jnp.sum(self.measured & uncertain, axis=0)
        return -0.5 * (self.nis + count * math.log(2 * math.pi)) - jnp.sum(logs, axis=0)


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
        if self.form not in get_args(Form):
            raise SettingError(
                f"form must be one of {', '.join(get_args(Form))}, not '{self.form}'."
            )

    def predict(
        self, model: StateSpaceModel, prior: Gaussian, u: Inputs = None, dt: Any = 1.0
    ) -> Gaussian:
        """Predicted state after a step, x <- f(x, u, dt) + w.

        Args:
            u: inputs held over the step, components first.
            dt: length of the step [s].
        """
        propagated = self.rule.transform(lambda x: model(x, u, dt), prior, model.space, model.space)
        # Process noise is added after the points have been propagated, so that sigma points are drawn anew
        # for the update: they then carry the effect of Q into the prediction of the reading.
        noise = model.step_noise(dt, prior.factor.ndim)
        rows, less = propagated.rows, propagated.less
        if self.form == "covariance":
            # The covariance form is kept for comparison: it squares the rows, and half of the digits of small
            # variances are lost.
            P = transposed_multiply(rows, rows) + outer_square(noise)
            scale = jnp.stack([P[i, i] for i in range(P.shape[0])])
            P = P if less is None else P - less[:, None] * less[None]
            return Gaussian(propagated.mean, factor_semidefinite(P, scale))
        noise_rows = jnp.swapaxes(noise, 0, 1)
        noise_rows = jnp.broadcast_to(noise_rows, (*noise.shape[:2], *rows.shape[2:]))
        L = triangularise_rows(jnp.concatenate([rows, noise_rows]))
        return Gaussian(propagated.mean, L if less is None else downdate_factor(L, less))

    def update(
        self, prior: Gaussian, y: Point, sensor: Sensor, u: Inputs = None, *, model: StateSpaceModel
    ) -> tuple[Gaussian, Innovation]:
        """State given a measurement, and its innovation.

        Several sensors are used one after the other, each on the result of the previous one.

        Args:
            y: measurement (m, *s), NaN where missing.
            u: inputs of the sensor's function.
            model: model whose space the state belongs to.
        """
        image = self.rule.transform(lambda x: sensor(x, u), prior, model.space, sensor.space)
        # Differences are taken in the sensor's own space: two angles of nearly a turn apart are close, and
        # two quaternions of opposite sign are one attitude.
        y = as_reading(sensor.space, y)
        error = sensor.space.difference(y, image.mean)
        # an infinite angle has no difference, and would pass for a missing one
        error = jnp.where(jnp.any(jnp.isinf(y), axis=0)[None], jnp.inf, error)
        # a NaN of the prediction does not pass for a missing measurement: the rows contain it too
        present = ~jnp.isnan(error)
        # largest measurement, for the rounding of an error that should be zero
        size = jnp.max(jnp.where(jnp.isnan(y), 0.0, jnp.abs(y)), axis=0)
        error = jnp.where(present, error, 0.0)
        # A missing component gets a row of zeros and a noise of its own: it changes nothing, and the arrays
        # keep their shape for every pattern of missing readings. Unit noise in its place keeps the innovation's
        # covariance regular and adds exactly zero to the log-likelihood's quadratic form.
        noise = insert_axes(sensor.noise, image.rows.ndim, 2)
        unit = insert_axes(jnp.eye(noise.shape[0], dtype=noise.dtype), image.rows.ndim, 2)
        absent = jnp.where(present, 0.0, 1.0)
        parts = [jnp.swapaxes(noise, 0, 1) * present[None], unit * absent[None]]
        noise = jnp.concatenate(parts).astype(image.rows.dtype)
        less = None if image.less is None else image.less * present
        image = image._replace(rows=image.rows * present[None], less=less)
        if self.form == "square_root" and image.triangular and less is None:
            move, factor, scaled, Ls = _scalar_by_scalar(
                prior.factor, image.rows, noise, error, size
            )
        else:
            move, factor, scaled, Ls = _update_jointly(image, noise, error, size, self.form)
        after = Gaussian(model.space.retract(prior.mean, move), factor)
        return after, Innovation(error, scaled, Ls, present, image.mean)

    def step(
        self, model: StateSpaceModel, before: Gaussian, y: Point, u: Inputs, dt: Any
    ) -> tuple[Gaussian, Innovation]:
        predicted = self.predict(model, before, u, dt)
        return self.update(predicted, y, model.sensor, u, model=model)


# The default filter.
DEFAULT = GaussianFilter()


@in_lanes
def _scalar_by_scalar(
    L: Array, rows: Array, noise: Array, error: Array, size: Array
) -> tuple[Array, Array, Array, Array]:
    """Update by one scalar measurement after the other, for triangular rows of the state.

    The root of the covariance that the state does not explain is Le = U D, with ones on the
    diagonal of U and D diagonal. Divided by U, the measurements have independent noise of variances
    D^2, which may be zero: each has a row of A = U^-1 H L and an error.

    Args:
        L: root of the state's covariance. rows: image of the sensor, the first n of them by the state's columns.
        size: largest measurement (*s), for the rounding of an error that should be zero.

    Returns:
        Displacement of the mean, posterior root, scaled innovation, and Ls.
    """
    n, m = L.shape[0], error.shape[0]
    # The triangular root is split into unit columns and a diagonal, because scalar updates need
    # independent noise and have to survive a reading without any.
    Le = triangularise_rows(jnp.concatenate([rows[n:], noise]))
    right = jnp.concatenate([jnp.swapaxes(rows[:n], 0, 1), error[:, None]], axis=1)
    D = jnp.stack([Le[i, i] for i in range(m)])
    unit = jnp.eye(m, dtype=Le.dtype).reshape(m, m, *(1,) * (Le.ndim - 2))
    # a column of Le whose diagonal is zero is zero
    U = jnp.where((D == 0)[None], unit, Le / jnp.where(D == 0, 1.0, D)[None])
    independent = divide_lower(U, right)
    A, nu = independent[:, :n], independent[:, n]
    # the state above, the remaining measurements below
    # State and remaining measurements are reduced together, since each scalar measurement tells about the
    # later ones too.
    M = jnp.concatenate([L, A])
    rounding = jnp.sqrt(jnp.finfo(L.dtype).eps) * size
    move, scaled, unit_factor = jnp.zeros_like(L[:, 0]), [], []
    for i in range(m):
        a = M[n]
        s = D[i] ** 2 + jnp.sum(a * a, axis=0)
        uncertain = s != 0
        root = jnp.sqrt(jnp.where(uncertain, s, 1.0))
        gains = jnp.sum(jnp.swapaxes(M * a[None], 0, 1), axis=0) / root[None]
        # a reading that is known beforehand tells nothing, unless it contradicts
        agrees = jnp.where(jnp.abs(nu[i]) <= rounding, 0.0, jnp.nan)
        e = jnp.where(uncertain, nu[i] / root, agrees)
        scaled.append(e)
        move = move + gains[:n] * e[None]
        nu = nu.at[i:].add(-gains[n:] * e[None]) if i + 1 < m else nu
        # the column of Ls for independent noise: the gains, with the root of s on the diagonal
        head = jnp.where(uncertain, root, 0.0)[None]
        none = jnp.zeros((i, *head.shape[1:]), head.dtype)
        unit_factor.append(jnp.concatenate([none, head, gains[n + 1 :]]))
        M = reduce_root(jnp.concatenate([M[:n], M[n + 1 :]]), a, D[i] ** 2)
    Ls = multiply_matrices(U, jnp.stack(unit_factor, axis=1))
    return move, M[:n], jnp.stack(scaled), Ls


def _update_jointly(
    sensor_image: Transformed, noise: Array, error: Array, size: Array, form: Form
) -> tuple[Array, Array, Array, Array]:
    """Update as by `_scalar_by_scalar`, for any rows of measurement and state."""
    rows, less, lanes = sensor_image.rows, sensor_image.less, sensor_image.rows.shape[2:]
    (q, n), m = sensor_image.inputs.shape[:2], rows.shape[1]
    # Rows that stem from noise have no counterpart in the state, hence zeros there.
    none = jnp.zeros((rows.shape[0] - q, n, *lanes), rows.dtype)
    inputs = jnp.concatenate([sensor_image.inputs, none])
    if form == "covariance":
        S = transposed_multiply(rows, rows) + transposed_multiply(noise, noise)
        C = transposed_multiply(rows, inputs)
        P = transposed_multiply(inputs, inputs)
        if less is not None:
            S = S - less[:, None] * less[None]
        Ls = factor_semidefinite(S)
        W = divide_lower(Ls, C)
        variances = jnp.stack([P[i, i] for i in range(n)])
        factor = factor_semidefinite(P - transposed_multiply(W, W), variances)
    else:
        none = jnp.zeros((noise.shape[0], n, *lanes), rows.dtype)
        above, below = (jnp.concatenate(pair, axis=1) for pair in ((rows, inputs), (noise, none)))
        # One triangularisation gives the innovation's root, the cross covariance over it, and the posterior
        # root: the blocks of the joint root of reading and state.
        both = triangularise_rows(jnp.concatenate([above, below]))
        if less is not None:
            both = downdate_factor(
                both, jnp.concatenate([less, jnp.zeros((n, *lanes), less.dtype)])
            )
        Ls, W, factor = both[:m, :m], jnp.swapaxes(both[m:, :m], 0, 1), both[m:, m:]
    scaled = divide_lower(Ls, error[:, None])[:, 0]
    # A reading without noise that differs from what is known exactly has probability zero: the filter
    # fails there instead of dividing by a pivot of round-off.
    scaled = jnp.where(has_contradiction(Ls, error, scaled, size), jnp.nan, scaled)
    return jnp.sum(W * scaled[:, None], axis=0), factor, scaled, Ls


class EstimationError(RuntimeError):
    """Failure of a filter; `filtered` holds the estimates before it, if there are any."""

    def __init__(self, message: str, filtered: object = None) -> None:
        super().__init__(message)
        self.filtered = filtered


class AbstractPath(eqx.Module):
    """Estimates at T times: points with T first, an array or a pytree, and roots of their covariances."""

    mean: eqx.AbstractVar[Point]
    factor: eqx.AbstractVar[Float[Array, "T n n *s"]]

    @property
    def covariance(self) -> Float[Array, "T n n *s"]:
        """Covariances P at each time."""
        return jax.vmap(outer_square)(self.factor)

    @property
    def standard_deviation(self) -> Float[Array, "T n *s"]:
        """Standard deviations at each time."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=2))


class Filtered(AbstractPath):
    """Filtered estimates, after each of T measurements.

    Attributes:
        mean: points with T first: an array (T, n, *s), or a pytree of such arrays.
        factor: roots of the covariances (T, n, n, *s).
        innovations: innovations of all steps, T first.
        ok: False from the step at which a filter failed (T, *s).
        u, dt: inputs, and lengths of the steps (T,) [s].
        prior: estimate before the first step.
        method: filter that was used.
    """

    mean: Point
    factor: Float[Array, "T n n *s"]
    innovations: Innovation
    ok: Bool[Array, "T *s"]
    u: Inputs
    dt: Float[Array, " T"]
    prior: Gaussian
    method: AbstractFilter

    @property
    def nis(self) -> Float[Array, "T *s"]:
        """Normalised innovations squared; infinite from a failure on."""
        return jnp.where(self.ok, jax.vmap(lambda i: i.nis)(self.innovations), jnp.inf)

    @property
    def log_likelihood(self) -> Float[Array, "*s"]:
        """Log-likelihood of all measurements; minus infinity for a filter that failed."""
        densities = jax.vmap(lambda i: i.log_likelihood)(self.innovations)
        return jnp.sum(jnp.where(self.ok, densities, -jnp.inf), axis=0)

    @property
    def missing(self) -> Int[Array, "*s"]:
        """Number of missing (NaN) components of measurements."""
        return jnp.sum(~self.innovations.measured, axis=(0, 1))

    def at(self, k: int) -> Gaussian:
        """Estimate after measurement k, counted from the last one if negative; the last good one from a failure on.

        Raises:
            SettingError: there is no such measurement; a traced k is not checked.
        """
        count = self.factor.shape[0]
        if has_values(k) and not -count <= k < count:
            raise SettingError(
                f"There is no estimate {k}: the record has {count} measurements, numbered from 0 to "
                f"{count - 1}, or from -{count} to -1 counted from the last."
            )
        return Gaussian(jax.tree.map(lambda leaf: leaf[k], self.mean), self.factor[k])


def kalman_filter(
    model: StateSpaceModel,
    prior: Gaussian,
    y: Any,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    method: AbstractFilter = DEFAULT,
    throw: bool = True,
) -> Filtered:
    """Estimate the states at the times of T measurements.

    For a bank of filters, priors and measurements have a last axis: mean (n, s), factor (n, n, s),
    y (T, m, s); inputs, Q and R may have it too. A bank ignores `throw`.

    The first call compiles, later ones with the same model, functions and shapes do not.

    Args:
        prior: estimate before the first step.
        y: measurements (T, m, *s) as an array, a table of numbers or a list; NaN, masked or None
            where missing. Euler parameters are normalised if their norm is within 0.01 of one, and
            missing if it is zero.
        u: inputs held over each step, a pytree of arrays, tables or lists (T, k, *s), all finite.
        dt: length of all steps [s], or of each (T,).
        t: instead of dt, the times of the prior and of the measurements (T + 1,), numbers [s] or
            dates. Steps of no length, for rows of one time, add no process noise.
        method: filter, by default a `GaussianFilter` with cubature and square roots.
        throw: True if a failure raises (outside of jit); otherwise it is only flagged in `ok`.

    Raises:
        ModelError: shapes do not fit.
        SettingError: times go backwards, or the rule cannot work in this precision.
        EstimationError: a covariance was lost, or a measurement or an input is not finite.

    Warns:
        UserWarning: Q is given per step, and the steps have different lengths.
    """
    y, u = read_measurements(y, prior.factor.dtype), read_inputs(u)
    steps = _read_steps(model, prior, y, u, dt, t, method)
    estimate, innovations, ok = compiled_once(_run_filter)(model, prior, y, u, steps, method)
    filtered = Filtered(estimate.mean, estimate.factor, innovations, ok, u, steps, prior, method)
    if throw and ok.ndim == 1 and has_values(ok) and not bool(ok[-1]):
        raise EstimationError(_failure_message(model, filtered, y), filtered)
    return filtered


def _read_steps(
    model: StateSpaceModel, prior: Gaussian, y: Array, u: Inputs, dt: Any, t: Any,
    method: AbstractFilter,
) -> Float[Array, " T"]:  # fmt: skip
    """Lengths of the steps of a record that fits model, prior and rule; refused as in `kalman_filter`."""
    check_prior(model, prior, method.rule)
    check_record(model, prior, y, u)
    steps = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    check_steps(model, steps)
    return steps


def compiled_once(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function by a program that is kept for the next call with the same structure.

    Within a transformation, and for a model whose functions cannot be hashed, it runs as it is.
    """

    def call_program(*args: Any) -> Any:
        # Functions of a model are part of the program's key. One that cannot be hashed would compile at every
        # call or, worse, meet a program of another.
        rest = jax.tree.leaves(eqx.filter(args, eqx.is_array, inverse=True))
        if is_transformed(args) or not all(isinstance(leaf, Hashable) for leaf in rest):
            return function(*args)
        return _compile_program(function)(*args)

    return call_program


_compile_program = cache(outer_jit)


def _run_filter(
    model: StateSpaceModel,
    prior: Gaussian,
    y: Array,
    u: Inputs,
    steps: Array,
    method: AbstractFilter,
) -> tuple[Gaussian, Innovation, Bool[Array, "T *s"]]:
    """Estimates, innovations and flags of success after each step, for parts that fit."""
    now = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), u)
    check_functions(model, prior, now, y.shape[1])

    def advance(before: Gaussian, y: Array, u: Inputs, dt: Array) -> tuple[Gaussian, Innovation]:
        if prior.factor.ndim == 2:
            return evaluate(method.step, model, before, y, u, dt)
        # Machine code takes the filters of a bank one by one, in the lanes of the processor's vectors; compiled
        # by XLA, each operation is one over all of them.
        axes = jax.tree.map(lambda a: -1 if jnp.ndim(a) == 2 else None, u)
        first = jax.tree.map(lambda a: a[..., 0], (before, y))
        inputs = jax.tree.map(lambda a: a[..., 0] if jnp.ndim(a) == 2 else a, u)
        if not evaluate.has_code(method.step, model, *first, inputs, dt):  # pyright: ignore
            return method.step(model, before, y, u, dt)
        step = lambda before, y, u: evaluate(method.step, model, before, y, u, dt)
        return jax.vmap(step, in_axes=(-1, -1, axes), out_axes=-1)(before, y, u)

    def filter_step(carry: tuple, now: tuple) -> tuple:
        before, running = carry
        y, u, dt = now
        after, innovation = advance(before, y, u, dt)
        # traced times are checked here: they may go backwards, or be NaN
        ok = running & is_finite(after) & (dt >= 0)
        of_batch = lambda x: ok.reshape((1,) * (jnp.ndim(x) - ok.ndim) + ok.shape)
        select = lambda new, old: jnp.where(of_batch(new), new, old)
        kept_estimate = jax.tree.map(select, after, before)
        return (kept_estimate, ok), (kept_estimate, innovation, ok)

    # After a failure the last good estimate is kept rather than NaN, so that a bank shows when and with
    # what each of its members failed.
    start = prior, jnp.ones(prior.factor.shape[2:], bool)
    return jax.lax.scan(filter_step, start, (y, u, steps))[1]


def is_finite(g: Gaussian) -> Bool[Array, "*s"]:
    """True if all numbers of a Gaussian are finite, for each filter of a bank."""
    # one sum over all numbers, which NaN and infinity pass through
    L = g.factor
    total = jnp.sum(L.reshape(-1, *L.shape[2:]), axis=0)
    for leaf in jax.tree.leaves(g.mean):
        total = total + jnp.sum(leaf, axis=0)
    return jnp.isfinite(total)


def _failure_message(model: StateSpaceModel, filtered: Filtered, y: Array) -> str:
    """Message with the time at which a single filter failed, and its cause or the usual ones."""
    k = int(np.argmin(np.asarray(filtered.ok)))
    start = (
        f"The filter failed at measurement {k} "
        f"(after {float(np.sum(np.asarray(filtered.dt)[: k + 1])):.6g} s): "
    )
    fault = find_fault(y[k], jax.tree.map(lambda leaf: leaf[k], filtered.u), model.sensor)
    if fault:
        return f"{start}{fault} throw=False returns what was reached."
    nis = np.asarray(filtered.nis)[max(k - 3, 0) : k]
    return (
        f"{start}its covariance was not positive definite or its state not finite. NIS before: "
        f"{', '.join(f'{v:.3g}' for v in nis) or 'none'}. Usual causes: the covariance form with "
        "a small alpha, single precision, states that are not observable, a model that diverges, "
        "an exact reading (R = 0) that contradicts what is known exactly. "
        "throw=False returns what was reached."
    )


def filter_bank(
    model: StateSpaceModel,
    priors: Gaussian,
    y: Any,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    method: AbstractFilter = DEFAULT,
    group: int = 64,
) -> Filtered:
    """Run s filters, each on its own measurements; a failed one is flagged in `ok`.

    Args:
        priors: priors with mean (n, s) and factor (n, n, s), or one Gaussian for all.
        y: measurements (T, m, s), as in `kalman_filter`.
        u: inputs with leaves (T, k), the same for all filters, or (T, k, s).
        dt, t, method: as in `kalman_filter`.
        group: largest number of filters that run at once; all groups have the same size.

    Raises:
        ModelError: shapes do not fit.
        SettingError: `group` is less than one; otherwise as in `kalman_filter`.
    """
    y, u = read_measurements(y, priors.factor.dtype), read_inputs(u)
    if y.ndim != 3:
        raise ModelError(f"Measurements of a bank must have shape (T, m, s), not {y.shape}.")
    if group < 1:
        raise SettingError(f"A group needs at least one filter, not {group}.")
    count = y.shape[2]
    if priors.factor.ndim == 2:
        priors = jax.tree.map(lambda a: jnp.broadcast_to(a[..., None], (*a.shape, count)), priors)
    if priors.factor.shape[2:] != (count,):
        raise ModelError(
            f"The priors have stack axes {priors.factor.shape[2:]}, but there are {count} records."
        )
    steps = _read_steps(model, priors, y, u, dt, t, method)
    # no group is larger than it has to be: the last one is filled up with copies, which cost as much
    size = math.ceil(count / math.ceil(count / group))
    estimate, innovations, ok = compiled_once(_in_groups)(model, priors, y, u, steps, method, size)
    return Filtered(
        estimate.mean, estimate.factor, innovations, ok, u=u, dt=steps, prior=priors, method=method
    )


def _in_groups(
    model: StateSpaceModel, priors: Gaussian, y: Array, u: Inputs, steps: Array,
    method: AbstractFilter, group: int,
) -> tuple[Gaussian, Innovation, Bool[Array, "T s"]]:  # fmt: skip
    """Run the bank, one group after the other."""
    count = y.shape[2]
    has_lanes = jax.tree.map(lambda a: jnp.ndim(a) == 3, u)

    def run_group(parts: tuple) -> Any:
        prior, measured, lane_inputs = parts
        inputs = jax.tree.map(
            lambda a, b, has_lane: b if has_lane else a, u, lane_inputs, has_lanes
        )
        return _run_filter(model, prior, measured, inputs, steps, method)

    def split_groups(a: Array) -> Array:
        """Array with the groups first, the last one padded with copies of the last filter."""
        more = -a.shape[-1] % group
        a = jnp.concatenate([a, jnp.repeat(a[..., -1:], more, axis=-1)], axis=-1)
        return jnp.moveaxis(a.reshape(*a.shape[:-1], a.shape[-1] // group, group), -2, 0)

    lane_inputs = jax.tree.map(
        lambda a, has_lane: a if has_lane else jnp.zeros((1, 1, count)), u, has_lanes
    )
    out = jax.lax.map(run_group, jax.tree.map(split_groups, (priors, y, lane_inputs)))

    def join_groups(a: Array) -> Array:
        a = jnp.moveaxis(a, 0, -2)
        return a.reshape(*a.shape[:-2], a.shape[-2] * a.shape[-1])[..., :count]

    return jax.tree.map(join_groups, out)
