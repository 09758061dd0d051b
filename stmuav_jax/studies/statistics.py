"""Statistics of samples with confidence intervals; the caller leaves out and counts failed ones.

Intervals hold for independent samples. Latin hypercubes and Sobol sequences estimate means at least
as well as those, as a rule much better: there the intervals are too wide rather than too narrow.

Infinite values ("never") are ordered, so they have quantiles, but no mean. NaN values are left out
and counted.

Source: Student's t (mean); Bonett (2006), Comput. Stat. Data Anal. 50, 775-782 (standard deviation,
not only of normal variables); order statistics and the binomial distribution (quantiles, David and
Nagaraja, Order Statistics, 3rd ed., section 7.1); Wilson (1927), J. Am. Stat. Assoc. 22, 209-212
(probabilities).
"""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, Shaped

from ..checks.errors import SettingError
from .columns import FINE, MISSING

LEVEL = 0.95
SHARES = (0.05, 0.25, 0.5, 0.75, 0.95)

Values = Shaped[np.ndarray, " n"]


class IntervalEstimate(NamedTuple):
    """Estimate with the ends of its confidence interval, None where there are too few samples."""

    value: float
    low: float | None
    high: float | None


class Outcomes(NamedTuple):
    """Counts of samples by their status.

    Attributes:
        missing: number of samples not computed yet.
        successful, failed: numbers of successful and failed samples.
        codes: number of failed samples by their code.
        failure: probability that a sample fails; None if none is computed.
        reasons: words and probability by code, for every code that has words or samples.
    """

    missing: int
    successful: int
    failed: int
    codes: dict[int, int]
    failure: IntervalEstimate | None
    reasons: dict[int, tuple[str, IntervalEstimate | None]]


class SampleSummary(NamedTuple):
    """Statistics of one quantity over the successful samples.

    Attributes:
        values: number of values that are not NaN, infinite ones included.
        undefined: number of NaN values, left out of all else.
        positive_infinite, negative_infinite: numbers of values +infinity and -infinity.
        infinite_probability: probability of either; None if there are none.
        minimum, maximum: smallest and largest value; None without values.
        mean: mean; None with infinite values or without values.
        standard_deviation: standard deviation; None with infinite values or fewer than two values.
        quantiles: quantiles by their probability.
    """

    values: int
    undefined: int
    positive_infinite: int
    negative_infinite: int
    infinite_probability: IntervalEstimate | None
    minimum: float | None
    maximum: float | None
    mean: IntervalEstimate | None
    standard_deviation: IntervalEstimate | None
    quantiles: dict[float, IntervalEstimate]


class Intervals(NamedTuple):
    """Estimates with the ends of their confidence intervals, NaN where there are too few samples.

    Quantiles along an axis (q, k), or sensitivities to d factors (d,).
    """

    value: Float[np.ndarray, "*k"]
    low: Float[np.ndarray, "*k"]
    high: Float[np.ndarray, "*k"]


def probability(hits: int, count: int, level: float = LEVEL) -> IntervalEstimate:
    """Probability of hits with Wilson's interval.

    Raises:
        SettingError: no samples, more hits than samples, or a level outside (0, 1).
    """
    from scipy.stats import binomtest

    _check_level(level)
    if count < 1:
        raise SettingError("A probability needs at least one sample, but there is none.")
    if not 0 <= hits <= count:
        raise SettingError(f"There cannot be {hits} hits among {count} samples.")
    # Wilson's interval keeps its level for rare events, where the normal one reaches below zero.
    ends = binomtest(hits, count).proportion_ci(level, method="wilson")
    return IntervalEstimate(hits / count, float(ends.low), float(ends.high))


def outcomes(
    status: Int[np.ndarray, " n"], reasons: Mapping[int, str], level: float = LEVEL
) -> Outcomes:
    """Counts of the codes of a study's status, and probabilities among the computed samples."""
    counts = dict(zip(*(x.tolist() for x in np.unique(status, return_counts=True)), strict=True))
    missing, fine_count = counts.pop(MISSING, 0), counts.pop(FINE, 0)
    computed, failed = len(status) - missing, sum(counts.values())
    share = lambda k: probability(k, computed, level) if computed else None
    # A code that nobody explains still counts, and a reason without samples shows that it never
    # occurred.
    outcome_by_code = {
        code: (reasons.get(code, "no reason known"), share(counts.get(code, 0)))
        for code in sorted({*reasons, *counts})
    }
    return Outcomes(missing, fine_count, failed, counts, share(failed), outcome_by_code)


def mean(values: Values, level: float = LEVEL) -> IntervalEstimate:
    """Mean with Student's interval.

    Raises:
        SettingError: no values, values that are not finite, a level outside (0, 1).
    """
    from scipy.special import stdtrit

    _check_level(level)
    y, n = check_samples(values, "A mean needs", 1), len(values)
    middle = float(np.mean(y))
    if n == 1:
        return IntervalEstimate(middle, None, None)
    half = stdtrit(n - 1, 0.5 + level / 2) * _standard_deviation(y) / math.sqrt(n)
    return IntervalEstimate(middle, middle - float(half), middle + float(half))


def standard_deviation(values: Values, level: float = LEVEL) -> IntervalEstimate:
    """Standard deviation (divisor n - 1) with Bonett's interval, which needs 5 values.

        s sqrt(c) exp(+-(z c / 2) sqrt((g - (n - 3) / n) / (n - 1))),  c = n / (n - z)

    with z of the normal distribution and the kurtosis g about a mean trimmed by
    1 / (2 sqrt(n - 4)).

    Raises:
        SettingError: fewer than 2 values, values that are not finite, a level outside (0, 1).
    """
    from scipy.special import ndtri

    _check_level(level)
    y, n = check_samples(values, "A standard deviation needs", 2), len(values)
    spread = _standard_deviation(y)
    z = float(ndtri(0.5 + level / 2))
    # The trimmed mean and the correction c exist for more values only, and equal values have no
    # kurtosis.
    if n < 5 or n <= z or np.ptp(y) == 0:
        return IntervalEstimate(spread, None, None)
    # Fourth powers of unscaled values overflow for lengths in nanometres and distances in kilometres
    # alike.
    scaled = (y - np.mean(y)) / np.max(np.abs(y - np.mean(y)))
    cut = int(0.5 / math.sqrt(n - 4) * n)
    trimmed = np.mean(np.partition(scaled, (cut, n - cut - 1))[cut : n - cut])
    kurtosis = n * np.sum((scaled - trimmed) ** 4) / np.sum(scaled**2) ** 2
    c = n / (n - z)
    half = z * c * math.sqrt((kurtosis - (n - 3) / n) / (n - 1)) / 2
    middle = spread * math.sqrt(c)
    return IntervalEstimate(spread, middle * math.exp(-half), middle * math.exp(half))


def quantiles(
    values: Values, shares: Sequence[float] = SHARES, level: float = LEVEL
) -> dict[float, IntervalEstimate]:
    """Quantiles by their probabilities, with intervals that hold for every distribution.

    A quantile is the smallest value that at least this share of the values does not exceed; its
    interval lies between two order statistics. Infinite values are included.

    Raises:
        SettingError: no values, one that is not a number, a share or level outside (0, 1).
    """
    result = bands(np.asarray(values, dtype=float)[:, None], shares, level)
    if np.any(np.isnan(result.value)):
        raise SettingError("Quantiles need values, but there are none, or some are not a number.")
    optional = lambda x: None if math.isnan(x) else float(x)
    return {
        share: IntervalEstimate(
            float(result.value[i, 0]), optional(result.low[i, 0]), optional(result.high[i, 0])
        )
        for i, share in enumerate(shares)
    }


def bands(
    values: Float[np.ndarray, "n k"], shares: Sequence[float] = SHARES, level: float = LEVEL
) -> Intervals:
    """Quantiles (q, k) at each of k points; NaN where a value is NaN, or without values.

    Intervals hold at each point, not at all points simultaneously.

    Raises:
        SettingError: a share or level outside (0, 1).
    """
    n, k = values.shape
    result = Intervals(*np.full((3, len(shares), k), np.nan))
    for share in shares:
        if not 0 < share < 1:
            raise SettingError(f"The share of a quantile must lie in (0, 1), but it is {share:g}.")
    _check_level(level)
    if n == 0:
        return result
    # Order statistics need no assumption on the distribution, and infinite values have a place among
    # them.
    ranked = np.sort(values, axis=0)  # NaN comes last
    for i, share in enumerate(shares):
        # the product may exceed a whole number by round-off
        result.value[i] = ranked[max(math.ceil(n * share * (1 - 1e-14)), 1) - 1]
        low, high = _quantile_ranks(n, share, level)
        if low >= 1:
            result.low[i] = ranked[low - 1]
        if high <= n:
            result.high[i] = ranked[high - 1]
    undefined = np.isnan(ranked[-1])
    for part in result:
        part[:, undefined] = np.nan
    return result


@functools.lru_cache(maxsize=256)
def _quantile_ranks(n: int, share: float, level: float) -> tuple[int, int]:
    """Ranks (from 1) of the values that enclose the quantile with at least the given probability.

    The number of values below the quantile is binomial. Ranks 0 and n + 1 stand for an open end.
    """
    from scipy.stats import binom

    low, high = binom.ppf([(1 - level) / 2, (1 + level) / 2], n, share)
    return int(low), int(high) + 1


def summarise(
    values: Values, shares: Sequence[float] = SHARES, level: float = LEVEL
) -> SampleSummary:
    """Statistics of one quantity, as far as its values allow them."""
    y = np.asarray(values, dtype=float)
    defined_values = y[~np.isnan(y)]
    count, undefined = len(defined_values), len(y) - len(defined_values)
    never, below = (int(np.sum(defined_values == end)) for end in (np.inf, -np.inf))
    finite = count > 0 and never + below == 0
    return SampleSummary(
        count, undefined, never, below,
        infinite_probability=probability(never + below, count, level) if never + below else None,
        minimum=float(np.min(defined_values)) if count else None,
        maximum=float(np.max(defined_values)) if count else None,
        mean=mean(defined_values, level) if finite else None,
        standard_deviation=standard_deviation(defined_values, level) if finite and count > 1 else None,
        quantiles=quantiles(defined_values, shares, level) if count else {},
    )  # fmt: skip


def _standard_deviation(y: np.ndarray) -> float:
    """Standard deviation (divisor n - 1), 0 for equal values, without overflow of the squares."""
    deviations = y - np.mean(y)
    scale = float(np.max(np.abs(deviations)))
    if np.ptp(y) == 0 or scale == 0:
        return 0.0
    return scale * math.sqrt(float(np.sum((deviations / scale) ** 2)) / (len(y) - 1))


def check_samples(values: np.ndarray, need: str, least: int = 0) -> np.ndarray:
    """Values as doubles, all of which have to be finite.

    Args:
        need: subject and verb of the error's sentence, such as "A mean needs". least: smallest number of values.
    """
    y = np.asarray(values, dtype=float)
    if len(y) < least:
        raise SettingError(f"{need} at least {least} values, but there are {len(y)}.")
    bad = int(np.sum(~np.isfinite(y)))
    if bad:
        raise SettingError(f"{need} finite values, but {bad} of {len(y)} are not.")
    return y


def _check_level(level: float) -> None:
    if not 0 < level < 1:
        raise SettingError(f"The level of confidence must lie in (0, 1), but it is {level:g}.")
