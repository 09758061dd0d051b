"""Kalman filters over a record of measurements: one, or a bank side by side.

Each step predicts to the time of a measurement and updates with it. The rule (sigma points or
linearisation), the form (square root or covariance) and what becomes of the sigma points between
the two halves ("redraw": drawn anew from the predicted Gaussian; "reuse") are explicit choices,
because libraries differ in them.

A step that leaves numbers that are not finite (a covariance that is not positive definite makes
NaN in JAX, silently) ends a filter: it keeps its last good estimate, `ok` is False from there on,
and its NIS is infinite.
"""

from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..algebra.shapes import Numbers
from ..mechanics.errors import SettingError, check_finite, concrete
from .check import check_filter
from .factor import outer_square
from .gaussian import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule, Cubature
from .space import Point
from .update import Form, Innovation, predict, predict_and_update, update

Points = Literal["redraw", "reuse"]


class EstimationError(RuntimeError):
    """A filter that could not go on; `filtered` holds what was reached."""

    def __init__(self, message: str, filtered: object = None) -> None:
        super().__init__(message)
        self.filtered = filtered


class Filtered(eqx.Module):
    """The estimates after each of T measurements.

    Attributes:
        mean: points with T first: an array (T, n, *s), or a pytree of such.
        factor: roots of the covariances (T, n, n, *s).
        innovations: error, scaled, factor and which were measured, of each step, T first.
        ok: False from the step on at which a filter failed (T, *s).
        u, dt: inputs and steps [s] (T,), as used.
        prior: where it started.
    """

    mean: Point
    factor: Float[Array, "T n n *s"]
    innovations: Innovation
    ok: Bool[Array, "T *s"]
    u: Inputs
    dt: Float[Array, " T"]
    prior: Gaussian

    @property
    def covariance(self) -> Float[Array, "T n n *s"]:
        """P after each measurement."""
        return jax.vmap(outer_square)(self.factor)

    @property
    def deviation(self) -> Float[Array, "T n *s"]:
        """Standard deviations after each measurement."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=2))

    @property
    def nis(self) -> Float[Array, "T *s"]:
        """Normalised innovations squared; infinite from a failure on."""
        return jnp.where(self.ok, jax.vmap(lambda i: i.nis)(self.innovations), jnp.inf)

    @property
    def log_likelihood(self) -> Float[Array, "*s"]:
        """Of all measurements; minus infinity where the filter failed."""
        each = jax.vmap(lambda i: i.log_likelihood)(self.innovations)
        return jnp.sum(jnp.where(self.ok, each, -jnp.inf), axis=0)

    @property
    def missing(self) -> Int[Array, "*s"]:
        """How many single measurements were missing (NaN)."""
        return jnp.sum(~self.innovations.there, axis=(0, 1))

    def at(self, k: int) -> Gaussian:
        """The estimate after measurement k."""
        return Gaussian(jax.tree.map(lambda leaf: leaf[k], self.mean), self.factor[k])


def kalman_filter(
    model: StateSpaceModel,
    prior: Gaussian,
    y: Numbers,
    *,
    u: Inputs = None,
    dt: Numbers | None = None,
    t: Numbers | None = None,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    points: Points = "redraw",
    throw: bool = True,
) -> Filtered:
    """Estimate the states at the times of T measurements.

    For a bank of filters give priors and measurements a last axis: mean (n, s), factor (n, n, s),
    y (T, m, s); inputs, Q and R may have it too. There `throw` has no effect.

    Args:
        prior: the state at the time before the first step.
        y: measurements (T, m, *s); NaN is a missing one.
        u: inputs held over each step: a pytree of arrays (T, k, *s).
        dt: step [s], or steps (T,); or t: times (T + 1,) [s], that of the prior first.
        rule: `Cubature()` by default. form: "square_root" or "covariance".
        points: "redraw" or "reuse" of sigma points after the prediction.
        throw: whether a failure raises (outside of jit) or is only flagged in `ok`.

    Raises:
        ModelError: shapes that do not fit. SettingError: times that go backwards, a rule that
            cannot work in this precision. EstimationError: a covariance was lost.
    """
    rule = Cubature() if rule is None else rule
    if not isinstance(y, jax.Array):
        y = jnp.asarray(y, dtype=prior.factor.dtype)
    check_choices(form, points)
    check_filter(model, prior, y, u, rule)
    steps = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    if u is not None:
        u = jax.tree.map(jnp.asarray, u)
    _, out = jax.lax.scan(
        lambda carry, now: _step(model, carry, now, rule, form, points),
        (prior, jnp.ones(prior.factor.shape[2:], bool)),
        (y, u, steps),
    )
    estimate, innovations, ok = out
    filtered = Filtered(estimate.mean, estimate.factor, innovations, ok, u, steps, prior)
    if throw and ok.ndim == 1 and concrete(ok) and not bool(ok[-1]):
        raise EstimationError(failure_message(filtered), filtered)
    return filtered


def _step(
    model: StateSpaceModel,
    carry: tuple[Gaussian, Bool[Array, "*s"]],
    now: tuple[Any, Inputs, Any],
    rule: AbstractRule,
    form: Form,
    points: Points,
) -> tuple[tuple[Gaussian, Bool[Array, "*s"]], tuple[Gaussian, Innovation, Bool[Array, "*s"]]]:
    """One measurement; the carry is the estimate, and whether the filter still runs."""
    before, running = carry
    y, u, dt = now
    after, innovation = one_step(model, before, y, u, dt, rule=rule, form=form, points=points)
    ok = running & is_finite(after)
    kept = jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, before)
    return (kept, ok), (kept, innovation, ok)


def one_step(
    model: StateSpaceModel,
    before: Gaussian,
    y: Point,
    u: Inputs,
    dt: Any,
    *,
    rule: AbstractRule,
    form: Form,
    points: Points = "redraw",
) -> tuple[Gaussian, Innovation]:
    """Predict to a measurement's time and update with it."""
    if points == "reuse":
        return predict_and_update(model, before, y, u, dt, rule=rule, form=form)
    predicted = predict(model, before, u, dt, rule=rule, form=form)
    return update(predicted, y, model.sensor, u, model=model, rule=rule, form=form)


def is_finite(g: Gaussian) -> Bool[Array, "*s"]:
    """Whether all numbers of a Gaussian are finite, for each of a bank."""
    # one sum over everything: NaN and infinity come through it
    L = g.factor
    total = jnp.sum(L.reshape(-1, *L.shape[2:]), axis=0)
    for leaf in jax.tree.leaves(g.mean):
        total = total + jnp.sum(leaf, axis=0)
    return jnp.isfinite(total)


def failure_message(filtered: Filtered) -> str:
    """When a single filter failed, and the usual reasons."""
    k = int(np.argmin(np.asarray(filtered.ok)))
    nis = np.asarray(filtered.nis)[max(k - 3, 0) : k]
    return (
        f"The filter failed at measurement {k} (after {float(np.sum(filtered.dt[: k + 1])):.6g} s): "
        "its covariance was not positive definite or its state not finite. NIS before: "
        f"{', '.join(f'{v:.3g}' for v in nis) or 'none'}. Usual causes: the covariance form with "
        "a small alpha, single precision, states that are not observable, a model that diverges. "
        "throw=False returns what was reached."
    )


def check_choices(form: str, points: str = "redraw") -> None:
    """Raise `SettingError` for a form, or a treatment of sigma points, that there is not."""
    for value, known in ((form, ("square_root", "covariance")), (points, ("redraw", "reuse"))):
        if value not in known:
            raise SettingError(f"'{value}' is not one of {known}.")


def step_lengths(dt: Any, t: Any, count: int, dtype: Any) -> Float[Array, " T"]:
    """Lengths of the T steps [s].

    Raises:
        SettingError: both or neither given, a wrong number of them, or time going backwards.
    """
    if (dt is None) == (t is None):
        raise SettingError("Give either dt, the step, or t, the times with the prior's first.")
    if t is not None:
        if np.shape(t) != (count + 1,):
            raise SettingError(
                f"t must have the prior's time and {count} more, but its shape is {np.shape(t)}."
            )
        check_times(t)
        return jnp.diff(jnp.asarray(t)).astype(dtype)
    if np.shape(dt) not in ((), (count,)):
        raise SettingError(f"dt must be a number or have shape ({count},), not {np.shape(dt)}.")
    check_finite(dt, "dt", "s", SettingError)
    if concrete(dt) and not np.all(np.asarray(dt) >= 0):
        raise SettingError(f"Time goes backwards: the least step is {np.min(np.asarray(dt)):g} s.")
    return jnp.broadcast_to(jnp.asarray(dt, dtype=dtype), (count,))


def check_times(t: Any) -> None:
    """Raise `SettingError` unless times are finite and do not decrease."""
    if not concrete(t):
        return
    check_finite(t, "The times", "s", SettingError)
    times = np.asarray(t, dtype=float)
    back = ~(np.diff(times) >= 0)
    if np.any(back):
        k = int(np.argmax(back))
        raise SettingError(
            f"Time goes backwards: after t = {times[k]:g} s comes {times[k + 1]:g} s (number {k + 1})."
        )
