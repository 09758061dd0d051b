"""Maximum-likelihood estimation of covariances and other parameters from measurements alone.

The unknowns are the logarithms of the variances, which therefore stay positive, and parameters
of either sign themselves; optax moves them along the gradient of the filter's log-likelihood. The
curvature at the optimum gives their standard errors: for independent records the covariance of
the estimate is H^-1, with H the Hessian of the negative log-likelihood.

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
from ..checks.errors import SettingError
from .filter import kalman_filter, step_lengths
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .update import DEFAULT, AbstractFilter

ModelOf = Callable[[Any], StateSpaceModel]


class Tuned(NamedTuple):
    """Result of maximising the likelihood.

    Attributes:
        values: best parameters, a pytree like the start.
        log_likelihood: log-likelihood of the records with them.
        history: log-likelihood at every step, that of the start first.
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
    method: AbstractFilter = DEFAULT,
) -> Float[Array, ""]:
    """Log-likelihood of a record (T, m), or of independent ones (T, m, s), for given parameters.

    Args:
        model_of: function that returns the model for `values`.
        prior, y, u, dt, t, method: as in `kalman_filter`.
    """
    if y.ndim == 3 and prior.factor.ndim == 2:
        wide = lambda a: jnp.broadcast_to(a[..., None], (*a.shape, y.shape[2]))
        prior = jax.tree.map(wide, prior)
    out = kalman_filter(model_of(values), prior, y, u=u, dt=dt, t=t, method=method, throw=False)
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
    method: AbstractFilter = DEFAULT,
    optimiser: optax.GradientTransformation | None = None,
    signed: Any = False,
    steps: int = 100,
    tolerance: float = 1e-3,
    progress: Callable[[int, float], None] | None = None,
) -> Tuned:
    """Maximum-likelihood estimate of variances and other parameters, from an initial guess.

    Args:
        model_of: function that returns the model for the parameters, a pytree of positive
            numbers: whole diagonals of Q and R, some of their entries, or factors of them.
        start: initial guess of the parameters.
        prior, y, u, dt, t, method: as in `kalman_filter`; y may hold independent records (T, m, s).
        optimiser: optimiser of optax; by default L-BFGS with its line search.
        signed: True, or a pytree of booleans like `start`, for parameters that may have either
            sign (a bias, an offset); the unknowns are they themselves and not their logarithms.
        steps: largest number of steps.
        tolerance: gain of log-likelihood, or norm of its gradient, below which the search ends.
        progress: function called with the step and the log-likelihood so far.

    Raises:
        SettingError: parameters of the start are neither positive nor `signed`, `steps` is less
            than one, or the filter cannot run with the start.
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
        return -record_likelihood(model_of, now, prior, y, u=u, dt=lengths, method=method)

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
    """Pytree of booleans, True for each leaf of the parameters that may have either sign."""
    if isinstance(signed, bool):
        return jax.tree.map(lambda leaf: signed, values)
    if jax.tree.structure(signed) != jax.tree.structure(values):
        raise SettingError(
            "`signed` must be True, False, or have the structure of the parameters, "
            f"{jax.tree.structure(values)}, not {jax.tree.structure(signed)}."
        )
    return signed


def _free(values: Any, signs: Any) -> Any:
    """Unknowns of the search: logarithms of positive parameters, the others themselves."""
    return jax.tree.map(lambda leaf, either: leaf if either else jnp.log(leaf), values, signs)


def _given(p: Any, signs: Any) -> Any:
    """Parameters from the unknowns of the search."""
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
    """Repeat steps of the search until nothing is gained, and return the best parameters."""
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
    method: AbstractFilter = DEFAULT,
    signed: Any = False,
) -> Any:
    """Standard errors of ln(variance), and of `signed` parameters themselves.

    The result is a pytree like `values`, NaN where the curvature is not positive. The arguments
    are those of `tune`, with `values` at the optimum.
    """
    signs = _signs(signed, values)
    lengths = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    flat, back = ravel_pytree(_free(jax.tree.map(jnp.asarray, values), signs))

    def loss(p: Array, y: Array, u: Inputs) -> Array:
        now = _given(back(p), signs)
        return -record_likelihood(model_of, now, prior, y, u=u, dt=lengths, method=method)

    curve = outer_jit(jax.jacfwd(jax.grad(loss)))
    H = np.asarray(curve(flat, jnp.asarray(y), jax.tree.map(jnp.asarray, u)))
    variance = np.diag(np.linalg.inv(H))
    return back(jnp.sqrt(jnp.where(variance > 0, variance, jnp.nan)))
