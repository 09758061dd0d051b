"""Sensitivity analysis: Sobol indices, first-order indices of any study, rank correlations.

The first-order index of a factor is the share of a quantity's variance explained by its conditional
mean at fixed factor; the total index is the share that is left on average when all other factors
are fixed:

    S_j = V[E(f | x_j)] / V[f],   T_j = E(V[f | x_others]) / V[f]

for independent factors. `sobol` needs a study of the design "saltelli"; `spline_shares` estimates
first-order indices from the samples of any other.
"""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from ..checks.errors import SettingError
from .columns import FINE, MISSING
from .statistics import LEVEL, Intervals, check_samples

# Largest number of doubles in one batch of the bootstrap, 128 MiB.
_BATCH = 2**24


class SobolIndices(NamedTuple):
    """Sobol indices, first-order and total, and numbers of base points.

    Attributes:
        first, total: first-order and total indices (d,).
        used, lost, pending: numbers of base points used, lost to failures, and not computed yet.
    """

    first: Intervals
    total: Intervals
    used: int
    lost: int
    pending: int


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
    # A base point counts only with all of its d + 2 samples: a difference of two needs both.
    complete_mask = np.all(codes == FINE, axis=1)
    used, lost = int(np.sum(complete_mask)), int(np.sum(~complete_mask & ~pending))
    if lost > allowed * (used + lost):
        raise SettingError(
            f"{lost} of {used + lost} base points have samples that failed, more than the share "
            f"{allowed:g} that is allowed: indices of the others would be biased."
        )
    if used < 2:
        raise SettingError(
            f"Sobol indices need at least 2 whole base points, but there are {used}."
        )
    y = _check_varying(table[complete_mask].ravel(), "Sobol indices").reshape(used, rows)
    # Products of values with a large mean would lose the digits of the variance; the mean over A and B is
    # subtracted first.
    y = np.ascontiguousarray((y - np.mean(y[:, :2])).T)
    result = scipy.stats.bootstrap(
        (*y,), _sobol_indices, paired=True, vectorized=True, n_resamples=resamples,
        batch=max(1, _BATCH // y.size), confidence_level=level, method="percentile",
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    results = np.stack([_sobol_indices(*y, axis=-1), *result.confidence_interval])
    first, total = np.split(results, 2, axis=1)
    return SobolIndices(Intervals(*first), Intervals(*total), used, lost, int(np.sum(pending)))


def _sobol_indices(a: np.ndarray, b: np.ndarray, *mixed: np.ndarray, axis: int) -> np.ndarray:
    """First-order indices, then total ones, stacked on the first axis."""
    # Each resample is centred by its own mean, which keeps the estimates unbiased under the bootstrap.
    middle = (np.mean(a, axis, keepdims=True) + np.mean(b, axis, keepdims=True)) / 2
    a, b = a - middle, b - middle
    variance = (np.mean(a**2, axis) + np.mean(b**2, axis)) / 2
    differences = [m - middle - a for m in mixed]
    first = [np.mean(b * x, axis) / variance for x in differences]
    total = [np.mean(x**2, axis) / (2 * variance) for x in differences]
    return np.stack(first + total)


def spline_shares(
    inputs: Float[np.ndarray, "n d"], values: Shaped[np.ndarray, " n"], level: float = LEVEL
) -> Intervals:
    """First-order indices from any independent samples, by regression on splines of each factor.

        S_j = 1 - mean(e_i^2 / (1 - h_ii)) / V

    with the residuals e and the leverages h of the regression on cubic splines of the factor, whose
    knots are its quantiles; a factor of few levels has the means of its levels instead. The weights
    make the residual variance unbiased, so that the index is 0 on average where a factor has no
    influence (and may then be negative). The regression has 1.5 n^(1/3) columns, from 4 to 24. The
    interval is normal, of the estimate's influence function and of the variance 2 k (1 - S)^2 / n^2
    that k columns have by chance; below some 100 samples it is rather too short.

    Args:
        inputs: values of the factors (n, d).
        values: values of the quantity (n,).
        level: confidence level of the intervals.

    Raises:
        SettingError: fewer than 8 samples, values not finite or all the same.

    Source: Saltelli et al. (2008), Global Sensitivity Analysis, ch. 5 (shares by regression);
    MacKinnon and White (1985), J. Econometrics 29, 305-325 (the weights).
    """
    from scipy.special import ndtri

    n = len(values)
    if n < 8:
        raise SettingError(f"Shares of the variance need at least 8 samples, but there are {n}.")
    y = _check_varying(values, "Shares of the variance")
    y = y - np.mean(y)
    y /= np.max(np.abs(y))
    variance = np.sum(y**2) / (n - 1)
    # The number of columns grows with the samples: bias of the splines and variance of their coefficients
    # are then of one size.
    columns = min(max(round(1.5 * n ** (1 / 3)), 4), 24)
    shares, errors = np.zeros(inputs.shape[1]), np.zeros(inputs.shape[1])
    for k, x in enumerate(inputs.T):
        basis = _spline_basis(x, columns)
        leverage = np.sum(basis**2, axis=1)
        residual = y - basis @ (basis.T @ y)
        # a sample with a level of its own has no residual, and says nothing of their variance
        alone = leverage > 1 - 1e-9
        square = np.where(alone, 0.0, residual**2 / np.where(alone, 1.0, 1 - leverage))
        shares[k] = 1 - np.sum(square) / max(n - np.sum(alone), 1) / variance
        influence = (square - (1 - shares[k]) * y**2) / variance
        chance = 2 * (basis.shape[1] - 1) * ((1 - shares[k]) / n) ** 2
        errors[k] = np.sqrt(np.var(influence) / n + chance)
    half = ndtri(0.5 + level / 2) * errors
    return Intervals(shares, shares - half, shares + half)


def _spline_basis(x: Float[np.ndarray, " n"], columns: int) -> Float[np.ndarray, "n k"]:
    """Orthonormal basis of the cubic splines of a factor at its samples, k <= columns."""
    from scipy.interpolate import BSpline

    levels, place = np.unique(x, return_inverse=True)
    if len(levels) <= columns:
        design = np.eye(len(levels))[place]
    else:
        # quantiles that coincide, of a factor with frequent values, are one knot
        knots = np.unique(np.quantile(x, np.linspace(0.0, 1.0, columns - 2)))
        ends = np.repeat(knots[:1], 3), np.repeat(knots[-1:], 3)
        design = BSpline.design_matrix(x, np.concatenate([ends[0], knots, ends[1]]), 3).toarray()
    # An orthonormal basis gives residuals and leverages by products; the normal equations would square
    # the condition of close knots.
    basis, singular_values, _ = np.linalg.svd(design, full_matrices=False)
    return basis[:, singular_values > 1e-10 * singular_values[0]]


def spearman(
    inputs: Float[np.ndarray, "n d"], values: Shaped[np.ndarray, " n"], level: float = LEVEL
) -> Intervals:
    """Rank correlation of each factor with a quantity; infinite values have ranks too.

    Raises:
        SettingError: fewer than 4 samples, numbers that are all the same.

    Source: interval by Bonett and Wright (2000), Psychometrika 65, 23-28.
    """
    from scipy.special import ndtri
    from scipy.stats import rankdata

    n = len(values)
    if n < 4:
        raise SettingError(f"A rank correlation needs at least 4 samples, but there are {n}.")
    # Ties get mean ranks, as an event or a count has many of them.
    ranked = [_check_varying(rankdata(x), "Rank correlations") for x in (*inputs.T, values)]
    r = np.clip(np.corrcoef(np.stack(ranked))[-1, :-1], -1.0, 1.0)  # against round-off
    half = ndtri(0.5 + level / 2) * np.sqrt((1 + r**2 / 2) / (n - 3))
    # correlations of +-1 have infinite arctanh, and an interval of zero length
    with np.errstate(divide="ignore"):
        z = np.arctanh(r)
    return Intervals(r, np.tanh(z - half), np.tanh(z + half))


def separation(
    inputs: Float[np.ndarray, "n d"], hits: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " d"]:
    """Kolmogorov-Smirnov distance, 0 to 1, of each factor's distributions in hits and elsewhere.

    Hits are samples with a certain outcome, such as failures.

    Raises:
        SettingError: no hits, or hits only.

    Source: Monte Carlo filtering, Hornberger and Spear (1981), J. Environ. Manage. 12, 7-18.
    """
    from scipy.stats import ks_2samp

    k, n = int(np.sum(hits)), len(hits)
    if k in (0, n):
        raise SettingError(f"A comparison needs hits and others, but {k} of {n} samples are hits.")
    test: Any = ks_2samp
    return np.array([test(x[hits], x[~hits], method="asymp").statistic for x in inputs.T])


def _check_varying(values: np.ndarray, statistic_name: str) -> np.ndarray:
    y = check_samples(values, f"{statistic_name} need")
    if len(y) == 0 or np.ptp(y) == 0:
        raise SettingError(
            f"{statistic_name} need values that vary, but all {len(y)} are the same."
        )
    return y
