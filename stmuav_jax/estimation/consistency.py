"""Consistency tests of estimators: NEES, NIS, whiteness, and their chi-squared intervals.

    NEES = e^T P^-1 e, e the error of the state;    NIS = nu^T S^-1 nu, nu the innovation

Over N independent runs, N times the mean NEES is chi-squared with N n degrees of freedom.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with applications to tracking and
navigation (2001), ch. 5.4.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.space import AbstractSpace, Point
from ..checks.errors import SettingError
from .factor import divide_lower, triangularise
from .filter import Filtered


def nees(
    mean: Point,
    factor: Float[Array, "n n *s"],
    truth: Point,
    space: AbstractSpace,
    *,
    only: slice | None = None,
) -> Float[Array, "*s"]:
    """Normalised estimation error squared, chi-squared with n degrees if the filter is consistent.

    Args:
        only: consecutive components of the error, with their marginal covariance; None for all.
    """
    error = space.difference(truth, mean)
    if only is not None:
        error = error[only]
        factor = triangularise(jnp.swapaxes(factor[only], 0, 1))
    scaled = divide_lower(factor, error[:, None])[:, 0]
    return jnp.sum(scaled**2, axis=0)


def path_nees(
    filtered: Any, truth: Point, space: AbstractSpace, *, only: slice | None = None
) -> Float[Array, "T *s"]:
    """NEES at each time of a `Filtered` or `Smoothed` path or bank; `truth` has T first."""
    # times become one more axis of the stack
    last = lambda leaf: jnp.moveaxis(leaf, 0, -1)
    mean, true = (jax.tree.map(last, a) for a in (filtered.mean, truth))
    each = nees(mean, last(filtered.factor), true, space, only=only)
    return jnp.moveaxis(each, -1, 0)


def _quantile(degrees: Any, level: Any) -> np.ndarray:
    """Quantile of the chi-squared distribution."""
    # slow to import, hence imported only here
    from scipy.special import gammaincinv

    return 2 * gammaincinv(np.asarray(degrees) / 2, level)


def chi2_p_values(
    total: np.ndarray, degrees: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower, upper and two-sided p-values of chi-squared sums; one without degrees of freedom."""
    from scipy.special import gammainc, gammaincc

    some = degrees > 0
    a, x = np.maximum(degrees, 1) / 2, np.asarray(total) / 2
    below = np.where(some, gammainc(a, x), 1.0)
    above = np.where(some, gammaincc(a, x), 1.0)
    return below, above, np.minimum(1.0, 2 * np.minimum(below, above))


def chi2_interval(degrees: int | float, level: float = 0.999) -> tuple[float, float]:
    """Two-sided interval in which a chi-squared variable lies with probability `level`."""
    if not 0 < level < 1 or degrees <= 0:
        raise SettingError(f"A level in (0, 1) and degrees > 0, not {level} and {degrees}.")
    tail = (1 - level) / 2
    low, high = _quantile(degrees, np.array([tail, 1 - tail]))
    return float(low), float(high)


def mean_interval(degrees: int, count: int, level: float = 0.999) -> tuple[float, float]:
    """Two-sided interval for the mean of `count` independent chi-squared variables.

    Args:
        degrees: degrees of freedom of each variable: n for NEES, m for NIS.
    """
    low, high = chi2_interval(degrees * count, level)
    return low / count, high / count


def autocorrelation(scaled: Float[Array, "T m *s"], lag: int) -> Float[Array, "*s"]:
    """Autocorrelation of scaled innovations, the mean of nu_k . nu_(k + lag) / m.

    For white innovations the mean is zero and the standard deviation 1 / sqrt(m T), so that
    |value| < 3.3 / sqrt(m T) holds with a probability of 99.9 %.

    Raises:
        SettingError: `lag` is outside 1 to T - 1.
    """
    if not 0 < lag < scaled.shape[0]:
        raise SettingError(f"The lag must be in 1 to {scaled.shape[0] - 1}, not {lag}.")
    products = scaled[:-lag] * scaled[lag:]
    return jnp.mean(products, axis=(0, 1))


def inconsistent(filtered: Filtered, *, window: int = 50, level: float = 0.999) -> np.ndarray:
    """Flags (T, *s) of times at which the NIS of the last `window` steps is larger than by chance.

    The flag is True also from a failure on. Each time is tested by itself at a level of
    (1 - `level`) / 2: of records of 2000 consistent steps some 10 % have a flag somewhere. The test
    sees only innovations that are too large. A filter with too large an R lags without a flag,
    because its innovations are small and correlated; `verdict` tests both sides and the
    correlation, at a stated level.

    Raises:
        SettingError: a window of less than one step, or a level outside (0, 1).
    """
    if window < 1 or not 0 < level < 1:
        raise SettingError(
            f"A window of at least 1 step and a level in (0, 1), not {window} and {level}."
        )
    nis = np.asarray(filtered.nis)
    there = np.sum(np.asarray(filtered.innovations.measured), axis=1)
    shape = np.broadcast_shapes(nis.shape, there.shape)
    total, degrees = (
        _running(np.broadcast_to(a, shape).astype(float), window) for a in (nis, there)
    )
    limit = _quantile(np.maximum(degrees, 1e-9), (1 + level) / 2)
    return (degrees > 0) & ~(total <= limit)


def _running(values: np.ndarray, window: int) -> np.ndarray:
    """Sums over the last `window` entries, fewer at the start."""
    out = np.empty_like(values)
    for k in range(len(values)):
        out[k] = np.sum(values[max(k - window + 1, 0) : k + 1], axis=0)
    return out
