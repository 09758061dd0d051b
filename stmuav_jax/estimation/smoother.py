"""Unscented Rauch-Tung-Striebel smoother: estimates from all measurements, also later ones.

With the prediction's joint deviations of x_k and x_(k+1), triangularised to [L-, 0; D, T],

    G = D L-^-1,   mean <- mean + G (mean_s(k+1) - mean-),   P <- T T^T + (G L_s)(G L_s)^T

so that each covariance is a sum of squares, without the subtraction of the usual form.

Source: S. Sarkka, Unscented Rauch-Tung-Striebel smoother, IEEE TAC 53 (2008); square roots:
S. Sarkka, L. Svensson, Bayesian filtering and smoothing, 2nd ed. (2023), ch. 12 and 14.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import has_values
from ..math.native.program import evaluate
from ..math.space import Point
from .filter import AbstractPath, EstimationError, Filtered, compiled_once, is_finite
from .gaussians import Gaussian, divide_lower, downdate_factor, triangularise_rows
from .model import Inputs, StateSpaceModel
from .records import check_functions, check_prior
from .sigma import AbstractRule


class Smoothed(AbstractPath):
    """Smoothed estimates, given all T measurements.

    Attributes:
        mean: T points: an array (T, n, *s) or a pytree of such arrays.
        factor: roots of the covariances (T, n, n, *s).
        start: smoothed estimate at the time of the prior.
        ok: False where there is no estimate, from the step on at which the filter failed (T, *s);
            mean and factor are NaN there.
    """

    mean: Point
    factor: Float[Array, "T n n *s"]
    start: Gaussian
    ok: Bool[Array, "T *s"]


def smooth(
    model: StateSpaceModel,
    filtered: Filtered,
    *,
    rule: AbstractRule | None = None,
    throw: bool = True,
) -> Smoothed:
    """Smooth the estimates of `kalman_filter` in a backward pass from the last good one.

    Args:
        rule: rule for the transformation of Gaussians; by default the filter's.
        throw: True if a failure of the filter or of the smoother raises (outside of jit); otherwise,
            and in a bank, it is only flagged in `ok`.

    Raises:
        ModelError, SettingError: the model does not fit the record, as in `kalman_filter`.
        EstimationError: the filter failed, or the smoothed estimates are not finite.
    """
    rule = filtered.method.rule if rule is None else rule
    prior = filtered.prior
    check_prior(model, prior, rule)
    ok, (path, start) = filtered.ok, compiled_once(_pass_back)(model, filtered, rule)
    finite = ok & jax.vmap(is_finite)(path)
    if throw and ok.ndim == 1 and has_values(finite) and not bool(jnp.all(finite)):
        k = int(np.argmin(np.asarray(finite)))
        cause = (
            "the filter had failed there" if not bool(ok[k]) else "the smoothed state is not finite"
        )
        raise EstimationError(
            f"There is no smoothed estimate at measurement {k}: {cause}. throw=False returns the others."
        )
    wide = lambda a: finite.reshape(len(finite), *(1,) * (a.ndim - finite.ndim), *finite.shape[1:])
    path = jax.tree.map(lambda a: jnp.where(wide(a), a, jnp.nan), path)
    return Smoothed(path.mean, path.factor, start, finite)


def _pass_back(
    model: StateSpaceModel, filtered: Filtered, rule: AbstractRule
) -> tuple[Gaussian, Gaussian]:
    """Smoothed estimates after each measurement, the filter's from a failure on, and at the start."""
    prior, ok = filtered.prior, filtered.ok
    now = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), filtered.u)
    check_functions(model, prior, now)
    after = filtered.mean, filtered.factor
    # the estimates before each step, the prior first
    before = jax.tree.map(
        lambda a, b: jnp.concatenate([a[None], b[:-1]]), (prior.mean, prior.factor), after
    )
    last = filtered.at(-1)

    def step(later: Gaussian, now: tuple) -> tuple[Gaussian, Gaussian]:
        (mean, factor), u, dt, succeeded = now
        estimate = Gaussian(mean, factor)
        smooth_back = _smooth_step if factor.ndim > 2 else partial(evaluate, _smooth_step)
        earlier = smooth_back(model, estimate, later, u, dt, rule)
        # nothing comes back from a step that failed: the last good estimate is the filter's
        earlier = jax.tree.map(lambda new, old: jnp.where(succeeded, new, old), earlier, estimate)
        return earlier, earlier

    start, path = jax.lax.scan(step, last, (before, filtered.u, filtered.dt, ok), reverse=True)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[1:], b[None]]), path, last)
    return path, start


def _smooth_step(
    model: StateSpaceModel,
    estimate: Gaussian,
    later: Gaussian,
    u: Inputs,
    dt: Float[Array, ""],
    rule: AbstractRule,
) -> Gaussian:
    """Smoothed estimate at k from the filter's at k and the smoothed one at k + 1 (`later`)."""
    space, n = model.space, model.space.size
    propagated = rule.transform(lambda x: model(x, u, dt), estimate, space, space)
    # The joint root of the states at k + 1 and k holds gain and smoothed covariance as blocks, so that no
    # covariance is subtracted from another (square-root form of the RTS smoother; S. Särkkä 2013, ch. 8).
    rows, inputs, lanes = propagated.rows, propagated.inputs, propagated.rows.shape[2:]
    none = jnp.zeros((len(rows) - len(inputs), n, *lanes), rows.dtype)
    above = jnp.concatenate([rows, jnp.concatenate([inputs, none])], axis=1)
    noise = jnp.swapaxes(model.step_noise(dt, rows.ndim), 0, 1)
    noise = jnp.broadcast_to(noise, (n, n, *lanes))
    below = jnp.concatenate([noise, jnp.zeros_like(noise)], axis=1)
    both = triangularise_rows(jnp.concatenate([above, below]))
    if propagated.less is not None:
        both = downdate_factor(
            both, jnp.concatenate([propagated.less, jnp.zeros_like(propagated.less)])
        )
    root, cross, rest = both[:n, :n], both[n:, :n], both[n:, n:]
    correction = space.difference(later.mean, propagated.mean)
    right = divide_lower(root, jnp.concatenate([correction[:, None], later.factor], axis=1))
    # transpose first, so that sums run over the leading axis
    transposed = jnp.swapaxes(cross, 0, 1)
    move = jnp.sum(transposed * right[:, :1], axis=0)
    spread = jnp.sum(transposed[:, :, None] * right[:, None, 1:], axis=0)
    # The smoothed covariance is a sum of two squares here, where the usual form P + G (P_s - P_p) G^T is
    # a difference.
    rows = jnp.concatenate([jnp.swapaxes(rest, 0, 1), jnp.swapaxes(spread, 0, 1)])
    return Gaussian(space.retract(estimate.mean, move), triangularise_rows(rows))
