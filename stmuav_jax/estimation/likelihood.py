"""Maximum-likelihood estimation of covariances and other parameters from measurements alone.

The unknowns are the logarithms of the variances, which therefore stay positive, and parameters
of either sign themselves; SciPy's L-BFGS-B moves them along the gradient of the log-likelihood. The
curvature at the optimum gives their standard errors: for independent records the covariance of
the estimate is H^-1, with H the Hessian of the negative log-likelihood.

Source: S. Sarkka, L. Svensson, Bayesian filtering and smoothing, 2nd ed. (2023), ch. 16.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float
from scipy.optimize import minimize

from ..checks.errors import ModelError, SettingError
from .filter import DEFAULT, AbstractFilter, compiled_once, kalman_filter
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .records import check_numbers, check_steps, read_inputs, read_measurements, step_lengths

# Loss that the search sees where the filter cannot run, in units of that of the start: it turns back.
_FAR = 1e3

# Curvature, in the largest, below which a direction counts as undetermined: derivatives are that exact.
_FLAT = 1e-8

ModelOf = Callable[[Any], StateSpaceModel]


class Tuned(NamedTuple):
    """Result of maximising the likelihood.

    Attributes:
        values: best parameters, a pytree like the start.
        log_likelihood: log-likelihood of the records with them.
        history: log-likelihood at every step, that of the start first.
        reason: "converged", "steps" (all used) or "stalled" (no gain along the gradient).
    """

    values: Any
    log_likelihood: float
    history: np.ndarray
    reason: str


def record_likelihood(
    model_of: ModelOf,
    values: Any,
    prior: Gaussian,
    y: Any,
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
    y = read_measurements(y, prior.factor.dtype)
    if y.ndim == 3 and prior.factor.ndim == 2:
        wide = lambda a: jnp.broadcast_to(a[..., None], (*a.shape, y.shape[2]))
        prior = jax.tree.map(wide, prior)
    # A parameter may be too bad for the filter; the search must go on from there.
    out = kalman_filter(model_of(values), prior, y, u=u, dt=dt, t=t, method=method, throw=False)
    return jnp.sum(out.log_likelihood)


def tune(
    model_of: ModelOf,
    start: Any,
    prior: Gaussian,
    y: Any,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    method: AbstractFilter = DEFAULT,
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
        signed: True, or a pytree of booleans like `start`, for parameters that may have either
            sign (a bias, an offset); the unknowns are they themselves and not their logarithms.
        steps: largest number of steps.
        tolerance: gain of log-likelihood, or norm of its gradient, below which the search ends.
        progress: function called with the step and the log-likelihood so far.

    Raises:
        ModelError: the record does not fit, or has something else than numbers.
        SettingError: parameters of the start are neither positive nor `signed`, `steps` is less
            than one, a measurement is infinite or an input not finite, or the filter cannot run
            with the start.
    """
    signs = _sign_flags(signed, start)
    for leaf, either in zip(jax.tree.leaves(start), jax.tree.leaves(signs), strict=True):
        if not either and not np.all(np.asarray(leaf) > 0):
            raise SettingError(
                f"Variances to tune must be positive, but one is {np.min(leaf):g}. Parameters of "
                "either sign are named by `signed`."
            )
    if steps < 1:
        raise SettingError(f"At least one step is needed, not {steps}.")
    record = _read_record(model_of(start), prior, y, u, dt, t)
    # The search is over logarithms of variances: they stay positive, and one step means one factor at any
    # size.
    first = _to_unknowns(
        jax.tree.map(lambda leaf: jnp.asarray(leaf, prior.factor.dtype), start), signs
    )
    flat, unravel = ravel_pytree(first)
    unknowns = lambda x: unravel(jnp.asarray(x, flat.dtype))

    def evaluate_loss(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = compiled_once(_loss_and_slope)(
            unknowns(x), model_of, signs, prior, record, method
        )
        return float(value), np.asarray(ravel_pytree(slope)[0], dtype=float)

    value, slope = evaluate_loss(np.asarray(flat))
    if not (np.isfinite(value) and np.all(np.isfinite(slope))):
        raise SettingError(
            f"The log-likelihood of the start is {-value}: the filter cannot run with it. "
            f"The gradient's norm is {np.linalg.norm(slope)}. Usual causes: variances that are too "
            "small for the record (begin with larger ones), a record or inputs that are not "
            "finite, a model that diverges."
        )
    # A finite wall lets the line search halve its step; NaN or infinity would end it.
    wall, history = value + _FAR * (1 + abs(value)), [-value]

    def evaluate_nearby(x: np.ndarray) -> tuple[float, np.ndarray]:
        value, slope = evaluate_loss(x)
        is_usable = np.isfinite(value) and np.all(np.isfinite(slope))
        return (value, slope) if is_usable else (wall, np.zeros_like(slope))

    def record_step(intermediate_result: Any) -> None:
        history.append(-float(intermediate_result.fun))
        if progress is not None:
            progress(len(history) - 1, history[-1])
        if history[-1] - history[-2] < tolerance:
            raise StopIteration

    outcome = minimize(
        # A quasi-Newton method needs gradients only, of which one costs a few runs of the filter for any
        # number of parameters.
        evaluate_nearby, np.asarray(flat, dtype=float), jac=True, method="L-BFGS-B",
        callback=record_step, options={"maxiter": steps, "ftol": 0.0, "gtol": tolerance},
    )  # fmt: skip
    stopped = len(history) > 1 and history[-1] - history[-2] < tolerance
    reason = "converged" if outcome.success or stopped else "stalled"
    if reason == "stalled" and outcome.nit >= steps:
        reason = "steps"
    values = jax.tree.map(np.asarray, _to_parameters(unknowns(outcome.x), signs))
    return Tuned(values, -float(outcome.fun), np.array(history), reason)


# Measurements (T, m, *s), inputs (T, k, *s), and lengths of the steps (T,) [s].
_Record = tuple[Array, Inputs, Float[Array, " T"]]


def _read_record(
    model: StateSpaceModel, prior: Gaussian, y: Any, u: Inputs, dt: Any, t: Any
) -> _Record:
    """Record of a search, all of whose numbers must be finite or missing.

    Raises:
        ModelError, SettingError: as in `kalman_filter`, and for a number that is not finite.
    """
    y, u = read_measurements(y, prior.factor.dtype), read_inputs(u)
    if y.ndim < 2:
        raise ModelError(f"Measurements must have shape (T, m) or (T, m, s), but it is {y.shape}.")
    check_numbers(y, u, model.sensor)
    steps = step_lengths(dt, t, y.shape[0], prior.factor.dtype)
    check_steps(model, steps)
    return y, u, steps


def _negative_likelihood(
    p: Any, model_of: ModelOf, signs: Any, prior: Gaussian, record: _Record, method: AbstractFilter
) -> Float[Array, ""]:
    """Negative log-likelihood of the unknowns."""
    model = model_of(_to_parameters(p, signs))
    y, u, steps = record
    return -record_likelihood(lambda _: model, None, prior, y, u=u, dt=steps, method=method)


def _loss_and_slope(p: Any, *rest: Any) -> tuple[Float[Array, ""], Any]:
    return jax.value_and_grad(_negative_likelihood)(p, *rest)


def _sign_flags(signed: Any, values: Any) -> Any:
    """Booleans by leaf of the parameters, True where they may have either sign."""
    if isinstance(signed, bool):
        return jax.tree.map(lambda leaf: signed, values)
    if jax.tree.structure(signed) != jax.tree.structure(values):
        raise SettingError(
            "`signed` must be True, False, or have the structure of the parameters, "
            f"{jax.tree.structure(values)}, not {jax.tree.structure(signed)}."
        )
    return signed


def _to_unknowns(values: Any, signs: Any) -> Any:
    """Unknowns of the search: logarithms of positive parameters, the others themselves."""
    return jax.tree.map(lambda leaf, either: leaf if either else jnp.log(leaf), values, signs)


def _to_parameters(p: Any, signs: Any) -> Any:
    """Parameters from the unknowns of the search."""
    return jax.tree.map(lambda leaf, either: leaf if either else jnp.exp(leaf), p, signs)


def standard_errors(
    model_of: ModelOf,
    values: Any,
    prior: Gaussian,
    y: Any,
    *,
    u: Inputs = None,
    dt: Any = None,
    t: Any = None,
    method: AbstractFilter = DEFAULT,
    signed: Any = False,
) -> Any:
    """Standard errors of ln(variance), and of `signed` parameters themselves.

    The result is a pytree like `values`. It is NaN for parameters that the record does not determine
    (only a combination of them, such as a product), and where the curvature is not positive. The
    arguments are those of `tune`, with `values` at the optimum.
    """
    signs = _sign_flags(signed, values)
    record = _read_record(model_of(values), prior, y, u, dt, t)
    p = _to_unknowns(
        jax.tree.map(lambda leaf: jnp.asarray(leaf, prior.factor.dtype), values), signs
    )
    H = np.asarray(compiled_once(_loss_curvature)(p, model_of, signs, prior, record, method))
    return ravel_pytree(p)[1](jnp.asarray(_curvature_deviations(H), prior.factor.dtype))


def _loss_curvature(
    p: Any, model_of: ModelOf, signs: Any, prior: Gaussian, record: _Record, method: AbstractFilter
) -> Float[Array, "k k"]:
    """Second derivatives of the loss by all unknowns."""
    flat, back = ravel_pytree(p)
    loss = lambda q: _negative_likelihood(back(q), model_of, signs, prior, record, method)
    return jax.jacfwd(jax.grad(loss))(flat)


def _curvature_deviations(H: np.ndarray) -> np.ndarray:
    """Roots of the diagonal of H^-1, NaN for unknowns in a direction without positive curvature."""
    # Curvatures in logarithms and in signed parameters differ by many orders; a unit diagonal makes them
    # comparable.
    scale = np.sqrt(np.abs(np.diag(H)))
    scale = np.where(scale > 0, scale, 1.0)
    if not np.all(np.isfinite(H)):
        return np.full(len(H), np.nan)
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    flat = values <= _FLAT * max(values[-1], 0.0)
    inverse = np.where(flat, 0.0, 1 / np.where(flat, 1.0, values))
    determined = np.max(np.abs(vectors[:, flat]), axis=1, initial=0.0) < np.sqrt(_FLAT)
    return np.where(determined, np.sqrt(vectors**2 @ inverse) / scale, np.nan)
