"""Covariances from measurements alone: those that make a record most likely.

The logarithms of the variances are moved along the gradient of the filter's log-likelihood
(optax), so that they stay positive. The curvature at the optimum gives their standard errors:
for independent records the estimate of ln(variance) has the covariance H^-1, H the Hessian of
the negative log-likelihood.

Source: S. Sarkka, L. Svensson, Bayesian filtering and smoothing, 2nd ed. (2023), ch. 16.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

from ..algebra.compiler import outer_jit
from ..mechanics.errors import SettingError
from .filter import kalman_filter
from .gaussian import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule
from .update import Form

ModelOf = Callable[[Any], StateSpaceModel]


class Tuned(NamedTuple):
    """What maximising the likelihood has found.

    Attributes:
        values: the best variances, a pytree like the start's.
        log_likelihood: of the records with them.
        history: log-likelihood at every step, the start's first.
        reason: "converged", "steps" (all used) or "not finite" (the best before that is kept).
    """

    values: Any
    log_likelihood: float
    history: np.ndarray
    reason: str


def record_likelihood(
    model_of: ModelOf,
    values: Any,
    prior: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
) -> Float[Array, ""]:
    """Log-likelihood of a record (T, m), or of independent ones (T, m, s), by the variances."""
    if y.ndim == 3 and prior.factor.ndim == 2:
        wide = lambda a: jnp.broadcast_to(a[..., None], (*a.shape, y.shape[2]))
        prior = jax.tree.map(wide, prior)
    out = kalman_filter(model_of(values), prior, y, u=u, dt=dt, rule=rule, form=form, throw=False)
    return jnp.sum(out.log_likelihood)


def tune(
    model_of: ModelOf,
    start: Any,
    prior: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    optimiser: optax.GradientTransformation | None = None,
    steps: int = 100,
    tolerance: float = 1e-3,
    progress: Callable[[int, float], None] | None = None,
) -> Tuned:
    """Variances that make the measurements most likely, from a start.

    Args:
        model_of: makes the model of the variances, a pytree of positive numbers: of whole
            diagonals of Q and R, of some of their entries, or of factors of them.
        start: where to begin. prior, y, u, dt, rule, form: as `kalman_filter`; y may hold
            independent records (T, m, s).
        optimiser: of optax; default L-BFGS with its line search.
        steps: at most. tolerance: a gain of log-likelihood below this ends it, as does a
            gradient (by ln variance) below it.
        progress: called with the step and the log-likelihood so far.

    Raises:
        SettingError: a start that is not positive, no step, or one that the filter cannot run with.
    """
    for leaf in jax.tree.leaves(start):
        if not np.all(np.asarray(leaf) > 0):
            raise SettingError(f"Variances to tune must be positive, but one is {np.min(leaf):g}.")
    if steps < 1:
        raise SettingError(f"At least one step is needed, not {steps}.")
    as_given = lambda p: jax.tree.map(jnp.exp, p)

    def loss(p: Any, y: Array, u: Inputs) -> Array:
        found = record_likelihood(model_of, as_given(p), prior, y, u=u, dt=dt, rule=rule, form=form)
        return -found

    search = optax.with_extra_args_support(optax.lbfgs() if optimiser is None else optimiser)

    def step(p: Any, state: Any, y: Array, u: Inputs) -> tuple:
        value, slope = jax.value_and_grad(loss)(p, y, u)
        moves, state = search.update(
            slope, state, p, value=value, grad=slope, value_fn=lambda q: loss(q, y, u)
        )
        return optax.apply_updates(p, moves), state, value, optax.tree.norm(slope)

    p = jax.tree.map(lambda leaf: jnp.log(jnp.asarray(leaf, prior.factor.dtype)), start)
    u = jax.tree.map(jnp.asarray, u)
    return _climb(
        outer_jit(step), p, search.init(p), (jnp.asarray(y), u), steps, tolerance, progress
    )


def _climb(
    step: Callable[..., tuple],
    p: Any,
    state: Any,
    record: tuple,
    steps: int,
    tolerance: float,
    progress: Callable[[int, float], None] | None,
) -> Tuned:
    """Step until nothing is gained; the best so far is kept."""
    best, highest, history, reason = p, -np.inf, [], "steps"
    for k in range(steps + 1):
        after, state, value, slope = step(p, state, *record)
        gained = -float(value)
        history.append(gained)
        if not (np.isfinite(gained) and np.isfinite(float(slope))):
            reason = "not finite"
            if k == 0:
                raise SettingError(
                    f"The log-likelihood of the start is {gained}: the filter cannot run with it. "
                    "Begin with larger variances."
                )
            break
        if progress is not None:
            progress(k, max(gained, highest))
        last, better = highest, gained > highest
        if better:
            best, highest = p, gained
        if float(slope) < tolerance or (k > 0 and better and gained - last < tolerance):
            reason = "converged"
            break
        p = after
    values = jax.tree.map(lambda leaf: np.exp(np.asarray(leaf)), best)
    return Tuned(values, highest, np.array(history), reason)


def standard_errors(
    model_of: ModelOf,
    values: Any,
    prior: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
) -> Any:
    """Standard errors of ln(variance), a pytree like `values`; NaN where nothing is known."""
    flat, back = ravel_pytree(jax.tree.map(lambda leaf: jnp.log(jnp.asarray(leaf)), values))

    def loss(p: Array, y: Array, u: Inputs) -> Array:
        now = jax.tree.map(jnp.exp, back(p))
        return -record_likelihood(model_of, now, prior, y, u=u, dt=dt, rule=rule, form=form)

    curve = outer_jit(jax.jacfwd(jax.grad(loss)))
    H = np.asarray(curve(flat, jnp.asarray(y), jax.tree.map(jnp.asarray, u)))
    variance = np.diag(np.linalg.inv(H))
    return back(jnp.sqrt(jnp.where(variance > 0, variance, jnp.nan)))
