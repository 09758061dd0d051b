"""Sensitivity analysis: Sobol indices, first-order indices of any study, rank correlations.

The first-order index of a factor is the share of a quantity's variance explained by its conditional
mean at fixed factor; the total index is the share that is left on average when all other factors
are fixed:

    S_j = V[E(f | x_j)] / V[f],   T_j = E(V[f | x_others]) / V[f]

for independent factors. `sobol` needs a study of the design "saltelli"; `binned` estimates
first-order indices from the samples of any other.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from ..checks.errors import SettingError
from .statistics import LEVEL, value_ranks
from .work import FINE, MISSING

# Largest number of doubles in one batch of the bootstrap, 128 MiB.
_BATCH = 2**24


class IndexIntervals(NamedTuple):
    """Estimates for d factors with the ends of their confidence intervals, each (d,)."""

    value: Float[np.ndarray, " d"]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]


class SobolIndices(NamedTuple):
    """Sobol indices, first-order and total, and numbers of base points.

    Attributes:
        first, total: first-order and total indices (d,).
        used, lost, pending: numbers of base points used, lost to failures, and not computed yet.
    """

    first: IndexIntervals
    total: IndexIntervals
    used: int
    lost: int
    pending: int


class Binned(NamedTuple):
    """First-order indices estimated from bins of samples.

    Attributes:
        value: first-order indices (d,).
        noise_bound: bound that the index of a factor without influence exceeds with small probability.
        bins: number of bins.
    """

    value: Float[np.ndarray, " d"]
    noise_bound: float
    bins: int


def sobol(
    values: Shaped[np.ndarray, " n"],
    status: Integer[np.ndarray, " n"],
    factors: int,
    *,
    level: float = LEVEL,
    resamples: int = 499,
    seed: int = 0,
    allowed: float = 0.1,
) -> SobolIndices:
    """Sobol indices of a quantity in a study of the design "saltelli".

        S_j = mean(f_B (f_ABj - f_A)) / V,   T_j = mean((f_A - f_ABj)^2) / (2 V)

    with V the variance over A and B together, values taken from their mean. Intervals are
    percentiles of a bootstrap over base points, as if these were random; from about 1000 points on
    the errors of a Sobol sequence are smaller than that. `scipy.stats.sobol_indices` has the same
    estimates, but only for 2^k base points, of which none may be lost, and resamples without a seed.

    Args:
        values: values of samples 0, 1, ..., n - 1 (n,).
        status: status codes of these samples (n,).
        factors: number d of factors.
        level: confidence level of the intervals.
        resamples, seed: number of resamples and seed of the bootstrap.
        allowed: share of base points that may be lost because one of their samples failed.

    Raises:
        SettingError: too many points lost, too few left, values not finite or all the same.

    Source: Saltelli et al. (2010), Comput. Phys. Commun. 181, 259-270, table 2 (b) and (f), the
    latter by Jansen (1999).
    """
    import scipy.stats

    rows = factors + 2
    points = len(values) // rows
    table = np.asarray(values[: points * rows], dtype=float).reshape(points, rows)
    codes = np.asarray(status[: points * rows]).reshape(points, rows)
    pending = np.any(codes == MISSING, axis=1)
    fine = np.all(codes == FINE, axis=1)
    used, lost = int(np.sum(fine)), int(np.sum(~fine & ~pending))
    _check_points(used, lost, allowed)
    y = _varying(table[fine].ravel(), "Sobol indices").reshape(used, rows)
    y = np.ascontiguousarray((y - np.mean(y[:, :2])).T)
    result = scipy.stats.bootstrap(
        (*y,), _indices, paired=True, vectorized=True, n_resamples=resamples,
        batch=max(1, _BATCH // y.size), confidence_level=level, method="percentile",
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    found = np.stack([_indices(*y, axis=-1), *result.confidence_interval])
    first, total = np.split(found, 2, axis=1)
    return SobolIndices(
        IndexIntervals(*first), IndexIntervals(*total), used, lost, int(np.sum(pending))
    )


def _indices(a: np.ndarray, b: np.ndarray, *mixed: np.ndarray, axis: int) -> np.ndarray:
    """First-order indices, then total ones, stacked on the first axis."""
    middle = (np.mean(a, axis, keepdims=True) + np.mean(b, axis, keepdims=True)) / 2
    a, b = a - middle, b - middle
    variance = (np.mean(a**2, axis) + np.mean(b**2, axis)) / 2
    away = [m - middle - a for m in mixed]
    first = [np.mean(b * x, axis) / variance for x in away]
    total = [np.mean(x**2, axis) / (2 * variance) for x in away]
    return np.stack(first + total)


def _check_points(used: int, lost: int, allowed: float) -> None:
    if lost > allowed * (used + lost):
        raise SettingError(
            f"{lost} of {used + lost} base points have samples that failed, more than the share "
            f"{allowed:g} that is allowed: indices of the rest would not be those of the study."
        )
    if used < 2:
        raise SettingError(
            f"Sobol indices need at least 2 whole base points, but there are {used}."
        )


def binned(
    inputs: Float[np.ndarray, "n d"],
    values: Shaped[np.ndarray, " n"],
    *,
    bins: int | None = None,
    level: float = LEVEL,
) -> Binned:
    """First-order indices from any independent samples, by the variance of the means over bins.

        S_j = 1 - (n - 1) / (n - M) V_within / V

    with M bins of equally many samples. The index is 0 on average where a factor has no influence
    (and may then be negative), and includes influences that are not monotonic.

    Args:
        inputs: values of the factors (n, d).
        values: values of the quantity (n,).
        bins: number M of bins; by default n^(1/3), from 4 to 50.
        level: probability that `chance` is not exceeded by a factor without influence.

    Raises:
        SettingError: fewer than 2 samples a bin, values not finite or all the same.

    Source: Pearson's correlation ratio, corrected for the bins (Kelley 1935); Plischke, Borgonovo
    and Smith (2013), Eur. J. Oper. Res. 226, 536-550.
    """
    from scipy.special import fdtri

    n = len(values)
    m = bins if bins is not None else min(max(round(n ** (1 / 3)), 4), 50)
    if m < 2 or n < 2 * m:
        raise SettingError(
            f"Shares from bins need at least 2 bins of 2 samples, but there are {m} bins and {n} samples."
        )
    y = _varying(values, "Shares of the variance")
    y = (y - np.mean(y)) / np.max(np.abs(y - np.mean(y)))
    whole = np.sum((y - np.mean(y)) ** 2)
    found = []
    for x in inputs.T:
        edges = np.unique(np.quantile(x, np.arange(1, m) / m))
        place = np.searchsorted(edges, x, side="right")
        count = np.bincount(place, minlength=len(edges) + 1)
        sums = np.bincount(place, weights=y, minlength=len(edges) + 1)
        taken = count > 0
        within = np.sum(y**2) - np.sum(sums[taken] ** 2 / count[taken])
        found.append(1 - (n - 1) / (n - np.sum(taken)) * within / whole)
    ratio = fdtri(m - 1, n - m, level)
    return Binned(np.array(found), float(1 - (n - 1) / ((m - 1) * ratio + n - m)), m)


def spearman(
    inputs: Float[np.ndarray, "n d"], values: Shaped[np.ndarray, " n"], level: float = LEVEL
) -> IndexIntervals:
    """Rank correlation of each factor with a quantity; infinite values have ranks too.

    Raises:
        SettingError: fewer than 4 samples, numbers that are all the same.

    Source: interval by Bonett and Wright (2000), Psychometrika 65, 23-28.
    """
    from scipy.special import ndtri

    n = len(values)
    if n < 4:
        raise SettingError(f"A rank correlation needs at least 4 samples, but there are {n}.")
    ranked = [_varying(value_ranks(x), "Rank correlations") for x in (*inputs.T, values)]
    r = np.clip(np.corrcoef(np.stack(ranked))[-1, :-1], -1.0, 1.0)  # against round-off
    half = ndtri(0.5 + level / 2) * np.sqrt((1 + r**2 / 2) / (n - 3))
    # correlations of +-1 have infinite arctanh, and an interval of zero length
    with np.errstate(divide="ignore"):
        z = np.arctanh(r)
    return IndexIntervals(r, np.tanh(z - half), np.tanh(z + half))


def separation(
    inputs: Float[np.ndarray, "n d"], hits: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " d"]:
    """Kolmogorov-Smirnov distance, 0 to 1, of each factor's distributions in hits and elsewhere.

    Hits are samples with a certain outcome, such as failures.

    Raises:
        SettingError: no hits, or hits only.

    Source: Monte Carlo filtering, Hornberger and Spear (1981), J. Environ. Manage. 12, 7-18.
    """
    k, n = int(np.sum(hits)), len(hits)
    if k in (0, n):
        raise SettingError(f"A comparison needs hits and others, but {k} of {n} samples are hits.")
    below = lambda part, x: np.searchsorted(np.sort(part), x, side="right") / len(part)
    return np.array([np.max(np.abs(below(x[hits], x) - below(x[~hits], x))) for x in inputs.T])


def _varying(values: np.ndarray, what: str) -> np.ndarray:
    y = np.asarray(values, dtype=float)
    bad = int(np.sum(~np.isfinite(y)))
    if bad:
        raise SettingError(f"{what} need finite values, but {bad} of {len(y)} are not.")
    if len(y) == 0 or np.ptp(y) == 0:
        raise SettingError(f"{what} need values that vary, but all {len(y)} are the same.")
    return y
