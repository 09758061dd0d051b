"""Kalman filters over a record of measurements, alone or in a bank.

Each step predicts to the time of a measurement and updates with it, by an `AbstractFilter`
(update.py). Its rule (sigma points or linearisation), its form (square root or covariance) and the
use of sigma points in the update are explicit choices, because libraries differ in them.

A filter fails at a step whose numbers are not finite (JAX makes NaN, without notice, of a
covariance that is not positive definite): it keeps its last good estimate, `ok` is False from
there on, and its NIS is infinite.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..algebra.space import Point
from ..checks.errors import SettingError, check_finite, concrete
from ..checks.shapes import Numbers
from .check import check_filter
from .factor import outer_square
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .update import DEFAULT, AbstractFilter, Innovation


class EstimationError(RuntimeError):
    """Failure of a filter; `filtered` holds the estimates before it, if there are any."""

    def __init__(self, message: str, filtered: object = None) -> None:
        super().__init__(message)
        self.filtered = filtered


class Filtered(eqx.Module):
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
    def covariance(self) -> Float[Array, "T n n *s"]:
        """Covariances P after each measurement."""
        return jax.vmap(outer_square)(self.factor)

    @property
    def standard_deviation(self) -> Float[Array, "T n *s"]:
        """Standard deviations after each measurement."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=2))

    @property
    def nis(self) -> Float[Array, "T *s"]:
        """Normalised innovations squared; infinite from a failure on."""
        return jnp.where(self.ok, jax.vmap(lambda i: i.nis)(self.innovations), jnp.inf)

    @property
    def log_likelihood(self) -> Float[Array, "*s"]:
        """Log-likelihood of all measurements; minus infinity for a filter that failed."""
        each = jax.vmap(lambda i: i.log_likelihood)(self.innovations)
        return jnp.sum(jnp.where(self.ok, each, -jnp.inf), axis=0)

    @property
    def missing(self) -> Int[Array, "*s"]:
        """Number of missing (NaN) components of measurements."""
        return jnp.sum(~self.innovations.measured, axis=(0, 1))

    def at(self, k: int) -> Gaussian:
        """Estimate after measurement k."""
        return Gaussian(jax.tree.map(lambda leaf: leaf[k], self.mean), self.factor[k])


def kalman_filter(
    model: StateSpaceModel,
    prior: Gaussian,
    y: Numbers,
    *,
    u: Inputs = None,
    dt: Numbers | None = None,
    t: Numbers | None = None,
    method: AbstractFilter = DEFAULT,
    throw: bool = True,
) -> Filtered:
    """Estimate the states at the times of T measurements.

    For a bank of filters, priors and measurements have a last axis: mean (n, s), factor (n, n, s),
    y (T, m, s); inputs, Q and R may have it too. A bank ignores `throw`.

    Args:
        prior: estimate before the first step.
        y: measurements (T, m, *s), NaN where missing.
        u: inputs held over each step, a pytree of arrays (T, k, *s).
        dt: length of all steps [s], or of each (T,).
        t: instead of dt, the times of the prior and of the measurements (T + 1,) [s].
        method: filter, by default a `GaussianFilter` with cubature and square roots.
        throw: True if a failure raises (outside of jit); otherwise it is only flagged in `ok`.

    Raises:
        ModelError: shapes do not fit.
        SettingError: times go backwards, or the rule cannot work in this precision.
        EstimationError: a covariance was lost.
    """
    if not isinstance(y, jax.Array):
        y = jnp.asarray(y, dtype=prior.factor.dtype)
    check_filter(model, prior, y, u, method.rule)
    steps = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    if u is not None:
        u = jax.tree.map(jnp.asarray, u)
    _, out = jax.lax.scan(
        lambda carry, now: _step(model, carry, now, method),
        (prior, jnp.ones(prior.factor.shape[2:], bool)),
        (y, u, steps),
    )
    estimate, innovations, ok = out
    filtered = Filtered(estimate.mean, estimate.factor, innovations, ok, u, steps, prior, method)
    if throw and ok.ndim == 1 and concrete(ok) and not bool(ok[-1]):
        raise EstimationError(failure_message(filtered), filtered)
    return filtered


def _step(
    model: StateSpaceModel,
    carry: tuple[Gaussian, Bool[Array, "*s"]],
    now: tuple[Any, Inputs, Any],
    method: AbstractFilter,
) -> tuple[tuple[Gaussian, Bool[Array, "*s"]], tuple[Gaussian, Innovation, Bool[Array, "*s"]]]:
    """Step to one measurement; the carry is the estimate, and True while the filter runs."""
    before, running = carry
    y, u, dt = now
    after, innovation = method.step(model, before, y, u, dt)
    ok = running & is_finite(after)
    kept = jax.tree.map(lambda new, old: jnp.where(ok, new, old), after, before)
    return (kept, ok), (kept, innovation, ok)


def is_finite(g: Gaussian) -> Bool[Array, "*s"]:
    """True if all numbers of a Gaussian are finite, for each filter of a bank."""
    # one sum over all numbers, which NaN and infinity pass through
    L = g.factor
    total = jnp.sum(L.reshape(-1, *L.shape[2:]), axis=0)
    for leaf in jax.tree.leaves(g.mean):
        total = total + jnp.sum(leaf, axis=0)
    return jnp.isfinite(total)


def failure_message(filtered: Filtered) -> str:
    """Message with the time at which a single filter failed, and the usual causes."""
    k = int(np.argmin(np.asarray(filtered.ok)))
    nis = np.asarray(filtered.nis)[max(k - 3, 0) : k]
    return (
        f"The filter failed at measurement {k} (after {float(np.sum(filtered.dt[: k + 1])):.6g} s): "
        "its covariance was not positive definite or its state not finite. NIS before: "
        f"{', '.join(f'{v:.3g}' for v in nis) or 'none'}. Usual causes: the covariance form with "
        "a small alpha, single precision, states that are not observable, a model that diverges. "
        "throw=False returns what was reached."
    )


def step_lengths(dt: Any, t: Any, count: int, dtype: Any) -> Float[Array, " T"]:
    """Lengths of the T steps [s].

    Raises:
        SettingError: both or none of dt and t are given, their shape is wrong, or time goes
            backwards.
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
