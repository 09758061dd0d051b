"""Sensitivities against closed forms, SciPy's estimator and simulation."""

import numpy as np
import pytest
import scipy.stats as st

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.studies.sampling import Sampling
from stmuav_jax.studies.sensitivity import separation, sobol, spearman, spline_shares

PI = np.pi
UNIFORM = st.uniform(-PI, 2 * PI)
ISHIGAMI = Sampling({name: UNIFORM for name in "xyz"}, 1, "saltelli")


def ishigami(x):
    """sin x + 7 sin^2 y + z^4 sin(x) / 10 (Ishigami and Homma, 1990)."""
    return np.sin(x[:, 0]) + 7 * np.sin(x[:, 1]) ** 2 + 0.1 * x[:, 2] ** 4 * np.sin(x[:, 0])


VARIANCE = 7**2 / 8 + 0.1 * PI**4 / 5 + 0.01 * PI**8 / 18 + 0.5
FIRST = np.array([0.5 * (1 + 0.1 * PI**4 / 5) ** 2, 7**2 / 8, 0.0]) / VARIANCE
TOTAL = FIRST + np.array([1.0, 0.0, 1.0]) * 0.01 * 8 * PI**8 / 225 / VARIANCE


def flown(sampling, points, f):
    x = sampling.draw(0, points * (len(sampling.factors) + 2))
    return x, f(x), np.ones(len(x), dtype=np.int8)


def test_sobol_indices_of_ishigami():
    """At 4096 base points errors of this sequence are about 0.005; the intervals hold the truth."""
    _, y, fine = flown(ISHIGAMI, 4096, ishigami)
    found = sobol(y, fine, 3)
    np.testing.assert_allclose(found.first.value, FIRST, atol=0.02)
    np.testing.assert_allclose(found.total.value, TOTAL, atol=0.02)
    for part, truth in ((found.first, FIRST), (found.total, TOTAL)):
        assert np.all((part.low <= truth) & (truth <= part.high))
        assert np.all(part.high - part.low < 0.12)
    assert (found.used, found.lost, found.pending) == (4096, 0, 0)


def test_sobol_indices_are_scipys():
    _, y, fine = flown(ISHIGAMI, 256, ishigami)
    rows = y.reshape(256, 5)
    parts = {"f_A": rows[:, 0], "f_B": rows[:, 1], "f_AB": rows[:, None, 2:].T}
    expected = st.sobol_indices(func=parts, n=256)
    found = sobol(y, fine, 3)
    np.testing.assert_allclose(found.first.value, expected.first_order, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(found.total.value, expected.total_order, rtol=1e-10, atol=1e-12)


def test_bootstrap_intervals_cover():
    """A sum with a product, 200 base points that are random indeed: at least 90 % of 95 % intervals."""
    covered = []
    for seed in range(60):
        ab = Sampling({str(k): st.norm(0.0, 1.0) for k in range(6)}, seed).draw(0, 200)
        rows = np.repeat(ab[:, None, :3], 5, axis=1)
        rows[:, 1] = ab[:, 3:]
        for j in range(3):
            rows[:, 2 + j, j] = ab[:, 3 + j]
        x = rows.reshape(-1, 3)
        y = 2 * x[:, 0] + x[:, 1] * x[:, 2]
        found = sobol(y, np.ones(len(y), dtype=np.int8), 3, resamples=199)
        for part, truth in ((found.first, [0.8, 0, 0]), (found.total, [0.8, 0.2, 0.2])):
            covered.append((part.low <= truth) & (truth <= part.high))
    assert np.mean(covered) > 0.9
    assert np.all(np.mean(covered, axis=0) > 0.8)


def test_failed_samples_take_their_base_point_with_them():
    _, y, status = flown(ISHIGAMI, 512, ishigami)
    status[[7, 8, 1003]] = 2  # points 1 (twice) and 200
    status[5 * 500 :] = 0
    y[[7, 8, 1003]] = np.nan
    found = sobol(y, status, 3)
    assert (found.used, found.lost, found.pending) == (498, 2, 12)
    kept = np.delete(y[:2500].reshape(500, 5), [1, 200], axis=0).ravel()
    again = sobol(kept, np.ones(len(kept), dtype=np.int8), 3)
    np.testing.assert_array_equal(found.first.value, again.first.value)
    np.testing.assert_array_equal(found.total.high, again.total.high)
    cut = sobol(y[:2498], status[:2498], 3)
    assert cut.used + cut.lost == 499


def line(x):
    return x[:, 0] + 0.03466 * x[:, 1]


def product(x):
    return np.prod(1 + np.array([1.0, 0.5, 0.2]) * x, axis=1)


SQUARES = np.array([1.0, 0.5, 0.2]) ** 2


@pytest.mark.parametrize(
    ("f", "truth", "uniform"),
    [
        (line, np.array([1.0, 0.03466**2, 0.0]) / (1 + 0.03466**2), False),
        (product, SQUARES / (np.prod(1 + SQUARES) - 1), False),
        (ishigami, FIRST, True),
    ],
)
def test_shares_are_unbiased_and_their_intervals_hold_the_truth(f, truth, uniform):
    """Of 100 studies with 200 samples: the mean within 4 standard errors, or 0.01 for splines of
    nine columns; intervals of 95 % hold it in 86 % at least, 4 deviations below."""
    rng = np.random.default_rng(3)
    draw = (
        (lambda: rng.uniform(-PI, PI, (200, 3))) if uniform else lambda: rng.normal(size=(200, 3))
    )
    studies = [spline_shares(x, f(x)) for x in (draw() for _ in range(100))]
    value, low, high = (np.array(part) for part in zip(*studies, strict=True))
    error = np.std(value, axis=0) / 10
    assert np.all(np.abs(np.mean(value, axis=0) - truth) < np.maximum(4 * error, 0.01))
    if f is line:
        # bins of the samples gave 0.92
        assert np.mean(value[:, 0]) == pytest.approx(0.9988, abs=1e-4)
    assert np.all(np.mean((low <= truth) & (truth <= high), axis=0) > 0.86)


def test_shares_of_factors_without_influence_are_zero_on_average():
    """Five per cent of the intervals, at most, do not hold 0, to 4 deviations."""
    rng = np.random.default_rng(4)
    shares = spline_shares(rng.uniform(size=(400, 1500)), rng.normal(size=400))
    assert abs(np.mean(shares.value)) < 4 * np.std(shares.value) / np.sqrt(1500)
    missed = np.mean((shares.low > 0) | (shares.high < 0))
    assert missed < 0.05 + 4 * np.sqrt(0.05 * 0.95 / 1500)


def test_shares_of_discrete_factors():
    rng = np.random.default_rng(4)
    x = rng.choice([1.0, 2.0, 5.0], size=3000)
    y = x + rng.normal(size=3000)
    # levels of one frequent value and many rare ones too
    mixed = np.where(rng.uniform(size=3000) < 0.9, 0.0, rng.normal(size=3000))
    shares = spline_shares(np.stack([x, np.ones(3000), mixed], axis=1), y)
    truth = np.var([1.0, 2.0, 5.0]) / (np.var([1.0, 2.0, 5.0]) + 1)
    assert shares.low[0] < truth < shares.high[0]
    assert shares.value[1] == pytest.approx(0.0, abs=1e-12)
    assert shares.low[2] < 0 < shares.high[2]


def test_rank_correlations_are_scipys_and_their_intervals_cover():
    rng, rho = np.random.default_rng(2), 0.6
    x = rng.normal(size=(300, 100))
    y = rho * x + np.sqrt(1 - rho**2) * rng.normal(size=(300, 100))
    truth, hits = 6 / PI * np.arcsin(rho / 2), 0
    for a, b in zip(x.T, y.T, strict=True):
        found = spearman(a[:, None], np.exp(b))
        hits += int(found.low[0] <= truth <= found.high[0])
    assert found.value[0] == pytest.approx(st.spearmanr(a, b)[0], rel=1e-12)  # type: ignore
    assert hits > 95 - 4 * np.sqrt(100 * 0.95 * 0.05)


def test_rank_correlations_of_never_and_of_order_itself():
    x = np.arange(20.0)[:, None]
    y = np.where(x[:, 0] > 15, np.inf, x[:, 0])
    assert spearman(x, y).value[0] > 0.95
    assert [part[0] for part in spearman(x, -(x[:, 0] ** 3))] == [-1.0, -1.0, -1.0]


def test_separation_finds_what_failures_have_in_common():
    rng = np.random.default_rng(2)
    x = rng.uniform(-1, 1, size=(5000, 3))
    found = separation(x, np.abs(x[:, 1]) > 0.8)
    assert found[1] == pytest.approx(0.5, abs=0.03)
    assert np.all(found[[0, 2]] < 0.06)


ONES = np.ones(40, dtype=np.int8)
RNG = np.random.default_rng(1)
Y, X = RNG.normal(size=40), RNG.normal(size=(40, 2))
FAILING = np.where(np.arange(40) % 8 == 0, 2, 1).astype(np.int8)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: sobol(Y, FAILING, 2), "5 of 10 base points have samples that failed"),
        (lambda: sobol(Y, 0 * ONES, 2), "at least 2 whole base points, but there are 0"),
        (lambda: sobol(0 * Y + 3, ONES, 2), "all 40 are the same"),
        (lambda: sobol(np.full(40, np.inf), ONES, 2), "finite values, but 40 of 40"),
        (lambda: spline_shares(X[:7], Y[:7]), "at least 8 samples, but there are 7"),
        (lambda: spline_shares(X, np.full(40, np.inf)), "finite values, but 40 of 40"),
        (lambda: spearman(X[:3], Y[:3]), "at least 4 samples, but there are 3"),
        (lambda: spearman(X, 0 * Y), "all 40 are the same"),
        (lambda: separation(X, Y > 100), "0 of 40 samples are hits"),
    ],
)
@pytest.mark.filterwarnings("ignore:divide by zero")
def test_what_is_refused(call, words):
    with pytest.raises(SettingError) as caught:
        call()
    assert words in str(caught.value)
