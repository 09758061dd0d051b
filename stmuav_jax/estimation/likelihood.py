"""Covariances and other parameters from measurements alone: those that make a record most likely.

The logarithms of the variances are moved along the gradient of the filter's log-likelihood
(optax), so that they stay positive; parameters of either sign are moved themselves. The curvature
at the optimum gives their standard errors: for independent records the estimate of ln(variance) has
the covariance H^-1, H the Hessian of the negative log-likelihood.

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
from .filter import kalman_filter, step_lengths
from .gaussian import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule
from .update import Form

ModelOf = Callable[[Any], StateSpaceModel]


class Tuned(NamedTuple):
    """What maximising the likelihood has found.

    Attributes:
        values: the best parameters, a pytree like the start's.
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
    dt: Any = None,
    t: Any = None,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
) -> Float[Array, ""]:
    """Log-likelihood of a record (T, m), or of independent ones (T, m, s), by the parameters.

    Args:
        model_of: makes the model of `values`. The others as `kalman_filter`.
    """
    if y.ndim == 3 and prior.factor.ndim == 2:
        wide = lambda a: jnp.broadcast_to(a[..., None], (*a.shape, y.shape[2]))
        prior = jax.tree.map(wide, prior)
    out = kalman_filter(
        model_of(values), prior, y, u=u, dt=dt, t=t, rule=rule, form=form, throw=False
    )
    return jnp.sum(out.log_likelihood)


def tune(
    model_of: ModelOf,
    start: Any,
    prior: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    optimiser: optax.GradientTransformation | None = None,
    signed: Any = False,
    steps: int = 100,
    tolerance: float = 1e-3,
    progress: Callable[[int, float], None] | None = None,
) -> Tuned:
    """Variances that make the measurements most likely, from a start.

    Args:
        model_of: makes the model of the variances, a pytree of positive numbers: of whole
            diagonals of Q and R, of some of their entries, or of factors of them.
        start: where to begin. prior, y, u, dt, t, rule, form: as `kalman_filter`; y may hold
            independent records (T, m, s).
        signed: True, or a pytree of booleans like `start`, for parameters that may have either sign
            (a bias, an offset): they are moved themselves, variances by their logarithms.
        optimiser: of optax; default L-BFGS with its line search.
        steps: at most. tolerance: a gain of log-likelihood below this ends it, as does a
            gradient (by ln variance) below it.
        progress: called with the step and the log-likelihood so far.

    Raises:
        SettingError: a start that is not positive and not `signed`, no step, or one that the filter
            cannot run with.
    """
    signs = _signs(signed, start)
    for leaf, either in zip(jax.tree.leaves(start), jax.tree.leaves(signs), strict=True):
        if not either and not np.all(np.asarray(leaf) > 0):
            raise SettingError(
                f"Variances to tune must be positive, but one is {np.min(leaf):g}. Parameters of "
                "either sign are named by `signed`."
            )
    if steps < 1:
        raise SettingError(f"At least one step is needed, not {steps}.")
    lengths = step_lengths(dt, t, y.shape[0], prior.factor.dtype)

    def loss(p: Any, y: Array, u: Inputs) -> Array:
        now = _given(p, signs)
        return -record_likelihood(model_of, now, prior, y, u=u, dt=lengths, rule=rule, form=form)

    search = optax.with_extra_args_support(optax.lbfgs() if optimiser is None else optimiser)

    def step(p: Any, state: Any, y: Array, u: Inputs) -> tuple:
        value, slope = jax.value_and_grad(loss)(p, y, u)
        moves, state = search.update(
            slope, state, p, value=value, grad=slope, value_fn=lambda q: loss(q, y, u)
        )
        return optax.apply_updates(p, moves), state, value, optax.tree.norm(slope)

    p = _free(jax.tree.map(lambda leaf: jnp.asarray(leaf, prior.factor.dtype), start), signs)
    u = jax.tree.map(jnp.asarray, u)
    found = _climb(
        outer_jit(step), p, search.init(p), (jnp.asarray(y), u), steps, tolerance, progress
    )
    return found._replace(values=jax.tree.map(np.asarray, _given(found.values, signs)))


def _signs(signed: Any, values: Any) -> Any:
    """Whether each leaf of the parameters may have either sign."""
    if isinstance(signed, bool):
        return jax.tree.map(lambda leaf: signed, values)
    if jax.tree.structure(signed) != jax.tree.structure(values):
        raise SettingError(
            "`signed` must be True, False, or have the structure of the parameters, "
            f"{jax.tree.structure(values)}, not {jax.tree.structure(signed)}."
        )
    return signed


def _free(values: Any, signs: Any) -> Any:
    """What is moved: logarithms of positive parameters, the others themselves."""
    return jax.tree.map(lambda leaf, either: leaf if either else jnp.log(leaf), values, signs)


def _given(p: Any, signs: Any) -> Any:
    """The parameters of what is moved."""
    return jax.tree.map(lambda leaf, either: leaf if either else jnp.exp(leaf), p, signs)


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
                    f"The gradient's norm is {float(slope)}. Usual causes: variances that are too "
                    "small for the record (begin with larger ones), a record or inputs that are not "
                    "finite, a model that diverges."
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
    return Tuned(best, highest, np.array(history), reason)


def standard_errors(
    model_of: ModelOf,
    values: Any,
    prior: Gaussian,
    y: Array,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    rule: AbstractRule | None = None,
    form: Form = "square_root",
    signed: Any = False,
) -> Any:
    """Standard errors, a pytree like `values`; NaN where nothing is known.

    They are those of ln(variance), and of `signed` parameters themselves.

    Args:
        as `tune`.
    """
    signs = _signs(signed, values)
    lengths = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    flat, back = ravel_pytree(_free(jax.tree.map(jnp.asarray, values), signs))

    def loss(p: Array, y: Array, u: Inputs) -> Array:
        now = _given(back(p), signs)
        return -record_likelihood(model_of, now, prior, y, u=u, dt=lengths, rule=rule, form=form)

    curve = outer_jit(jax.jacfwd(jax.grad(loss)))
    H = np.asarray(curve(flat, jnp.asarray(y), jax.tree.map(jnp.asarray, u)))
    variance = np.diag(np.linalg.inv(H))
    return back(jnp.sqrt(jnp.where(variance > 0, variance, jnp.nan)))
