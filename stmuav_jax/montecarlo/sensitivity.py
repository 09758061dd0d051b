"""Which uncertain numbers decide: Sobol indices, shares from any random study, correlations, gradients.

The first-order index of a factor is the share of a quantity's variance that its mean at fixed factor
has, the total index the share that is left on average when all other factors are fixed:

    S_j = V[E(f | x_j)] / V[f],   T_j = E(V[f | x_others]) / V[f]

for independent factors. `sobol` needs a study of the design "saltelli"; `binned` estimates first-order
indices from the samples of any other.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from ..mechanics.errors import SettingError
from .distribution import Distribution
from .statistics import LEVEL, Estimate, mean
from .work import FINE, MISSING

# Numbers that one batch of the bootstrap may hold at once, 128 MiB of doubles.
_BATCH = 2**24


class Shares(NamedTuple):
    """A number per factor with the ends of its confidence interval, each (d,)."""

    value: Float[np.ndarray, " d"]
    low: Float[np.ndarray, " d"]
    high: Float[np.ndarray, " d"]


class SobolIndices(NamedTuple):
    """First-order and total indices, and how many base points were used, lost to failures, pending."""

    first: Shares
    total: Shares
    used: int
    lost: int
    pending: int


class Binned(NamedTuple):
    """First-order indices (d,) from samples, and what a factor without influence stays below."""

    value: Float[np.ndarray, " d"]
    chance: float
    bins: int


class Regression(NamedTuple):
    """Standardised coefficients (d,) of a linear fit, and the share of the variance that it explains."""

    coefficients: Float[np.ndarray, " d"]
    explained: float


class DerivativeMeasures(NamedTuple):
    """From gradients, one per factor.

    Attributes:
        square: means of the squared derivatives, with intervals [(unit / factor's unit)^2].
        bound: what the total index does not exceed (d,); not a number where no bound is known.
        share: of each factor in the linearised variance (d,); they sum to 1.
    """

    square: tuple[Estimate, ...]
    bound: Float[np.ndarray, " d"]
    share: Float[np.ndarray, " d"]


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
    """Sobol indices of a quantity of a study of the design "saltelli", from its first sample on.

        S_j = mean(f_B (f_ABj - f_A)) / V,   T_j = mean((f_A - f_ABj)^2) / (2 V)

    with V the variance over A and B together, values taken from their mean. Intervals are percentiles
    of a bootstrap over base points, as if these were random; from about 1000 points on the errors of a
    Sobol sequence are smaller than that.

    Args:
        values: (n,), status: (n,) codes: of samples 0, 1, ..., n - 1.
        factors: d. resamples, seed: of the bootstrap.
        allowed: share of base points that may be lost because one of their samples failed.

    Raises:
        SettingError: too many points lost, too few left, values not finite or all the same.

    Source: Saltelli et al. (2010), Comput. Phys. Commun. 181, 259-270, table 2 (b) and (f), the latter
    by Jansen (1999).
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
    return SobolIndices(Shares(*first), Shares(*total), used, lost, int(np.sum(pending)))


def _indices(a: np.ndarray, b: np.ndarray, *mixed: np.ndarray, axis: int) -> np.ndarray:
    """First-order indices, then total ones, on the first axis."""
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
    """First-order indices from any independent samples: variance of the means over bins of a factor.

        S_j = 1 - (n - 1) / (n - M) V_within / V

    with M bins of equally many samples. It is 0 on average where a factor has no influence (and may
    then be negative), and sees influences that are not monotonic.

    Args:
        bins: M; by default n^(1/3), from 4 to 50.

    Raises:
        SettingError: fewer than 2 samples a bin, values not finite or all the same.

    Source: Pearson's correlation ratio, corrected for the bins (Kelley 1935); Plischke, Borgonovo and
    Smith (2013), Eur. J. Oper. Res. 226, 536-550.
    """
    import scipy.stats

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
    ratio = scipy.stats.f.ppf(level, m - 1, n - m)
    return Binned(np.array(found), float(1 - (n - 1) / ((m - 1) * ratio + n - m)), m)


def spearman(
    inputs: Float[np.ndarray, "n d"], values: Shaped[np.ndarray, " n"], level: float = LEVEL
) -> Shares:
    """Rank correlation of each factor with a quantity; infinite values have ranks too.

    Raises:
        SettingError: fewer than 4 samples, numbers that are all the same.

    Source: interval by Bonett and Wright (2000), Psychometrika 65, 23-28.
    """
    import scipy.stats

    n = len(values)
    if n < 4:
        raise SettingError(f"A rank correlation needs at least 4 samples, but there are {n}.")
    ranks = [_varying(scipy.stats.rankdata(x), "Rank correlations") for x in (*inputs.T, values)]
    r = np.clip(np.corrcoef(np.stack(ranks))[-1, :-1], -1.0, 1.0)  # round-off
    half = scipy.stats.norm.ppf(0.5 + level / 2) * np.sqrt((1 + r**2 / 2) / (n - 3))
    # whole correlations have infinite arctanh, and no interval but themselves
    with np.errstate(divide="ignore"):
        z = np.arctanh(r)
    return Shares(r, np.tanh(z - half), np.tanh(z + half))


def regression(
    inputs: Float[np.ndarray, "n d"], values: Shaped[np.ndarray, " n"], *, ranks: bool = False
) -> Regression:
    """Standardised coefficients of a linear fit by least squares, of the numbers or of their ranks.

    For independent factors and a linear quantity the square of a coefficient is its Sobol index.

    Raises:
        SettingError: not more samples than factors, numbers not finite or all the same, factors that
            depend on each other linearly.
    """
    import scipy.stats

    n, d = inputs.shape
    if n <= d + 1:
        raise SettingError(
            f"A fit of {d} factors needs more than {d + 1} samples, but there are {n}."
        )
    columns = [*inputs.T, values]
    if ranks:
        columns = [scipy.stats.rankdata(x) for x in columns]
    checked = [_varying(x, "Linear fits") for x in columns]
    scaled = np.stack([(x - np.mean(x)) / np.std(x) for x in checked], axis=1)
    solution, _, rank, _ = np.linalg.lstsq(scaled[:, :-1], scaled[:, -1])
    if rank < d:
        raise SettingError(f"Of {d} factors only {rank} are linearly independent; leave some out.")
    rest = scaled[:, -1] - scaled[:, :-1] @ solution
    return Regression(solution, float(1 - np.mean(rest**2)))


def separation(
    inputs: Float[np.ndarray, "n d"], hits: Bool[np.ndarray, " n"]
) -> Float[np.ndarray, " d"]:
    """How differently each factor is distributed in hits, such as failures, and elsewhere: 0 to 1.

    Kolmogorov and Smirnov's distance between the two.

    Raises:
        SettingError: no hits, or hits only.

    Source: Monte Carlo filtering, Hornberger and Spear (1981), J. Environ. Manage. 12, 7-18.
    """
    import scipy.stats

    k, n = int(np.sum(hits)), len(hits)
    if k in (0, n):
        raise SettingError(f"A comparison needs hits and others, but {k} of {n} samples are hits.")
    # the first of the result is the distance
    compare = lambda x: scipy.stats.ks_2samp(x[hits], x[~hits], method="asymp")[0]
    return np.array([float(compare(x)) for x in inputs.T])


def derivative_measures(
    gradients: Float[np.ndarray, "n d"],
    factors: Sequence[Distribution],
    variance: float,
    level: float = LEVEL,
) -> DerivativeMeasures:
    """What gradients at random samples say of total Sobol indices.

        nu_j = E((df/dx_j)^2),   T_j <= C_j nu_j / V[f],   share_j = sigma_j^2 nu_j / sum_k sigma_k^2 nu_k

    C_j is Poincare's constant of the factor: sigma^2 of a normal one, which bounds that of a truncated
    one of the same sigma too, and (high - low)^2 / pi^2 of a uniform one. For a linear quantity of normal
    factors the bound is the index itself.

    Args:
        gradients: (n, d), by the factors in their own units. factors: the d distributions.
        variance: V[f] > 0, such as `deviation(...).value**2`.

    Raises:
        SettingError: numbers of another shape, not finite, a variance that is not positive.

    Source: Sobol and Kucherenko (2009), Math. Comput. Simul. 79, 3009-3017, uniform and normal factors;
    Lamboni et al. (2013), Math. Comput. Simul. 87, 45-54, log-concave ones.
    """
    n, d = gradients.shape
    if d != len(factors):
        raise SettingError(f"Gradients have {d} columns, but there are {len(factors)} factors.")
    if not (math.isfinite(variance) and variance > 0):
        raise SettingError(f"The variance must be positive and finite, but it is {variance:g}.")
    square = tuple(mean(g**2, level) for g in gradients.T)
    nu = np.array([one.value for one in square])
    weighted = np.array([one.variance for one in factors]) * nu
    if not np.sum(weighted) > 0:
        raise SettingError(f"All {n} gradients are zero: there are no shares of the variance.")
    constants = np.array([_poincare(one) for one in factors])
    return DerivativeMeasures(square, constants * nu / variance, weighted / np.sum(weighted))


def _poincare(one: Distribution) -> float:
    """Poincare's constant [unit^2]; not a number where none is known here."""
    p = one.parameters
    if one.name in ("normal", "truncated_normal"):
        return p["deviation"] ** 2
    if one.name == "uniform":
        return (p["high"] - p["low"]) ** 2 / math.pi**2
    return 0.0 if one.name == "constant" else math.nan


def _varying(values: np.ndarray, what: str) -> np.ndarray:
    y = np.asarray(values, dtype=float)
    bad = int(np.sum(~np.isfinite(y)))
    if bad:
        raise SettingError(f"{what} need finite values, but {bad} of {len(y)} are not.")
    if len(y) == 0 or np.ptp(y) == 0:
        raise SettingError(f"{what} need values that vary, but all {len(y)} are the same.")
    return y
