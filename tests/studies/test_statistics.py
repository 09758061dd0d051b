"""Estimates against SciPy and closed forms; coverage of the intervals by simulation."""

import math

import numpy as np
import pytest
import scipy.stats as st

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.studies.statistics import (
    bands,
    mean,
    outcomes,
    probability,
    quantiles,
    standard_deviation,
    summarise,
)

INF = math.inf


def covered(trials: np.ndarray, low: float, high: float = 1.0) -> None:
    """The share of trials that were right lies in [low, high], give or take 4 deviations."""
    slack = 4 * math.sqrt(0.25 * 0.2 / len(trials))  # of a share of about 0.95
    assert low - slack <= np.mean(trials) <= high + slack


def inside(found, truth: float) -> bool:
    return found.low <= truth <= found.high


DRAWS = {
    "normal": (lambda rng, n: rng.normal(3.0, 2.0, n), 3.0, 2.0),
    "exponential": (lambda rng, n: rng.exponential(2.0, n), 2.0, 2.0),
    "uniform": (lambda rng, n: rng.uniform(0.0, 1.0, n), 0.5, math.sqrt(1 / 12)),
}


@pytest.mark.parametrize("name", DRAWS)
def test_intervals_of_mean_and_deviation_cover_the_truth(name):
    """Nominally 95 %; skew distributions lose a few per cent at n = 300."""
    draw, middle, spread = DRAWS[name]
    rng = np.random.default_rng(1)
    tries = [draw(rng, 300) for _ in range(800)]
    covered(np.array([inside(mean(y), middle) for y in tries]), 0.94, 0.96)
    least = 0.93 if name == "exponential" else 0.94
    covered(np.array([inside(standard_deviation(y), spread) for y in tries]), least, 0.965)


def test_deviation_of_normal_numbers_is_as_by_chi_square():
    """Bonett's interval comes close to the exact one, which holds for normal numbers only."""
    y = np.random.default_rng(4).normal(0.0, 1.0, 2000)
    found = standard_deviation(y, 0.9)
    ends = np.sqrt(1999 * np.var(y, ddof=1) / st.chi2.ppf([0.95, 0.05], 1999))
    assert found.value == pytest.approx(np.std(y, ddof=1), rel=1e-12)
    assert [found.low, found.high] == pytest.approx(ends, rel=2e-3)


def test_mean_is_as_by_scipy():
    y = np.random.default_rng(4).normal(0.0, 1.0, 50)
    ends = st.ttest_1samp(y, 0.0).confidence_interval(0.9)
    found = mean(y, 0.9)
    assert found == pytest.approx((np.mean(y), ends.low, ends.high), rel=1e-12)


@pytest.mark.parametrize("n", [20, 100, 500])
def test_intervals_of_quantiles_cover_the_truth_for_every_distribution(n):
    """At least the level, and not much more where the ranks are fine enough."""
    rng, shares = np.random.default_rng(3), (0.25, 0.5, 0.9)
    for draw, quantile in (
        (rng.standard_cauchy, st.cauchy.ppf),
        (rng.standard_exponential, st.expon.ppf),
    ):
        found = bands(draw((n, 4000)), shares)
        for i, share in enumerate(shares):
            low = np.where(np.isnan(found.low[i]), -INF, found.low[i])
            high = np.where(np.isnan(found.high[i]), INF, found.high[i])
            truth = quantile(share)
            most = 0.99 if n < 500 else 0.965
            covered((low <= truth) & (truth <= high), 0.95, most)


def test_quantiles_and_ranks_are_as_by_scipy():
    rng = np.random.default_rng(8)
    for n in (1, 2, 7, 20, 100, 333):
        y = rng.normal(size=n)
        for share, found in quantiles(y, (0.05, 0.0725, 0.5, 0.95), 0.9).items():
            expected = np.quantile(y, share, method="inverted_cdf")
            assert found.value == expected
            ends = st.quantile_test(y, q=0, p=share).confidence_interval(0.9)
            assert [found.low, found.high] == [
                None if np.isnan(end) else end for end in (ends.low, ends.high)
            ]


def test_rounded_shares_take_the_right_value():
    """0.07 * 100 is more than 7 in doubles."""
    y = np.arange(1.0, 101.0)
    for k in range(1, 100):
        assert quantiles(y, (k / 100,))[k / 100].value == k


def test_too_few_samples_for_an_end():
    found = quantiles(np.arange(10.0), (0.05, 0.95))
    assert found[0.05].low is None
    assert found[0.95].high is None
    assert found[0.95].low is not None
    assert mean(np.array([2.0])) == (2.0, None, None)
    assert standard_deviation(np.array([1.0, 2.0]))[1:] == (None, None)
    assert standard_deviation(np.full(50, 0.1)) == (0.0, None, None)


def test_wilson_interval():
    """Wilson (1927), written out; and its coverage."""
    k, n, z = 7, 50, st.norm.ppf(0.975)
    p = k / n
    middle = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * math.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    found = probability(k, n)
    assert found == pytest.approx((p, middle - half, middle + half), rel=1e-12)
    assert probability(0, 30)[:2] == (0.0, 0.0)
    assert probability(30, 30).high == 1.0
    hits = np.random.default_rng(1).binomial(200, 0.03, 3000)
    table = {int(k): inside(probability(int(k), 200), 0.03) for k in np.unique(hits)}
    covered(np.array([table[int(k)] for k in hits]), 0.93, 0.97)


def test_never_is_a_value_for_quantiles_and_not_for_means():
    y = np.concatenate([np.arange(60.0), np.full(40, INF), [np.nan]])
    found = summarise(y, (0.5, 0.9))
    assert (found.values, found.undefined, found.positive_infinite, found.negative_infinite) == (
        100,
        1,
        40,
        0,
    )
    assert found.mean is None
    assert found.standard_deviation is None
    assert found.infinite_probability == probability(40, 100)
    assert found.quantiles[0.5].value == 49.0
    assert found.quantiles[0.9].value == INF
    # ranks of the 95 % intervals: 40 to 61 and 31 to 51; from 61 on it is never
    assert found.quantiles[0.5][1:] == (39.0, INF)
    assert quantiles(y[:-1], (0.4,))[0.4][1:] == (30.0, 50.0)
    assert (found.minimum, found.maximum) == (0.0, INF)
    with pytest.raises(SettingError, match="finite values, but 40 of 100"):
        mean(y[:-1])


def test_summary_of_nothing_and_of_one():
    nothing = summarise(np.array([]))
    assert nothing.values == 0
    assert nothing.mean is None
    assert nothing.quantiles == {}
    one = summarise(np.array([3]))
    assert one.mean == (3.0, None, None)
    assert one.standard_deviation is None
    assert one.quantiles[0.5] == (3.0, None, None)
    assert summarise(np.array([np.nan])).undefined == 1


def test_huge_values_do_not_overflow():
    y = np.array([1e200, -1e200, 3e200, 0.0, 1e200, 2e200])
    expected = np.array(standard_deviation(y / 1e200), dtype=float)
    np.testing.assert_allclose(
        np.array(standard_deviation(y), dtype=float), 1e200 * expected, rtol=1e-12
    )


def test_bands_are_quantiles_at_every_place():
    y = np.random.default_rng(2).normal(size=(40, 3))
    y[7, 1] = np.nan
    found = bands(y, (0.25, 0.75))
    for k in (0, 2):
        for i, (_, one) in enumerate(quantiles(y[:, k], (0.25, 0.75)).items()):
            assert (found.value[i, k], found.low[i, k], found.high[i, k]) == one
    assert np.all(np.isnan(found.value[:, 1]))
    assert np.all(np.isnan(bands(np.empty((0, 3))).value))


def test_outcomes():
    status = np.array([0, 0, 1, 1, 1, 2, 3, 3, 9], dtype=np.int8)
    found = outcomes(status, {2: "too stiff", 3: "left the ground", 4: "never seen"})
    assert (found.missing, found.successful, found.failed) == (2, 3, 4)
    assert found.codes == {2: 1, 3: 2, 9: 1}
    assert found.failure == probability(4, 7)
    assert found.reasons[3] == ("left the ground", probability(2, 7))
    assert found.reasons[4] == ("never seen", probability(0, 7))
    assert found.reasons[9][0] == "no reason known"
    nothing = outcomes(np.zeros(5, dtype=np.int8), {})
    assert nothing.failure is None
    assert nothing.missing == 5


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: mean(np.array([])), "at least 1 values, but there are 0"),
        (lambda: probability(0, 0), "at least one sample"),
        (lambda: probability(3, 2), "cannot be 3 hits among 2 samples"),
        (lambda: mean(np.array([1.0]), 1.0), "must lie in (0, 1), but it is 1"),
        (lambda: quantiles(np.array([1.0]), (1.5,)), "share of a quantile"),
        (lambda: quantiles(np.array([np.nan])), "not a number"),
    ],
)
def test_what_is_refused(call, words):
    with pytest.raises(SettingError) as caught:
        call()
    assert words in str(caught.value)
