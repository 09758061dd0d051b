"""Distributions against SciPy's own and closed forms; what is refused, and in which words."""

import json
import tomllib

import numpy as np
import pytest
import scipy.stats as st

from stmuav_jax.mechanics.errors import SettingError
from stmuav_jax.montecarlo.distribution import (
    KINDS,
    Distribution,
    beta,
    choice,
    constant,
    empirical,
    from_plain,
    lognormal,
    loguniform,
    normal,
    triangular,
    truncated_normal,
    uniform,
    weibull,
)

# Each with SciPy's distribution by another parametrisation or by its definition.
CASES = {
    "normal": (normal(1.0, 0.2), st.norm(1.0, 0.2)),
    "truncated_normal": (
        truncated_normal(1.0, 0.2, low=0.9, high=1.5), st.truncnorm(-0.5, 2.5, 1.0, 0.2)
    ),
    "one_sided": (truncated_normal(0.0, 2.0, low=0.0), st.halfnorm(scale=2.0)),
    "uniform": (uniform(-2.0, 3.0), st.beta(1, 1, -2.0, 5.0)),
    "lognormal": (lognormal(2.0, 0.3), st.lognorm(0.3, scale=2.0)),
    "loguniform": (loguniform(0.1, 10.0), st.reciprocal(0.1, 10.0)),
    "triangular": (triangular(0.0, 1.0, 4.0), st.triang(0.25, 0.0, 4.0)),
    "beta": (beta(2.0, 3.0, -1.0, 1.0), st.beta(2.0, 3.0, -1.0, 2.0)),
    "weibull": (weibull(5.0, 2.0), st.rayleigh(scale=5.0 / np.sqrt(2.0))),
}  # fmt: skip
TABLES = (constant(3.0), choice([1.0, 5.0, 2.0], [2, 1, 1]), empirical([4.0, 1.0, 1.0, 2.0]))
EVERY = [one for one, _ in CASES.values()] + list(TABLES)


def test_every_kind_is_tested():
    assert {one.name for one in EVERY} == set(KINDS)


@pytest.mark.parametrize("name", CASES)
def test_quantiles_and_variance(name):
    """To round-off of two ways through the special functions."""
    found, truth = CASES[name]
    u = np.linspace(0.001, 0.999, 999)
    np.testing.assert_allclose(found.quantile(u), truth.ppf(u), rtol=1e-9, atol=1e-12)
    assert found.variance == pytest.approx(truth.var(), rel=1e-9)


@pytest.mark.parametrize("name", CASES)
def test_draws_follow_the_distribution(name):
    """Kolmogorov and Smirnov at the level 1e-4, fixed seed."""
    found, truth = CASES[name]
    draws = found.quantile(np.random.default_rng(5).uniform(size=5000))
    assert st.kstest(draws, truth.cdf).pvalue > 1e-4


def test_tables_of_values():
    third, weighted, sample = TABLES
    np.testing.assert_array_equal(third.quantile(np.array([0.1, 0.9])), [3.0, 3.0])
    assert third.variance == 0.0
    u = np.array([0.01, 0.5, 0.50001, 0.75, 0.7501, 0.999])
    np.testing.assert_array_equal(weighted.quantile(u), [1.0, 1.0, 2.0, 2.0, 5.0, 5.0])
    assert weighted.variance == pytest.approx(np.var([1.0, 1.0, 2.0, 5.0]))
    u = (np.arange(4) + 0.5) / 4
    np.testing.assert_array_equal(sample.quantile(u), [1.0, 1.0, 2.0, 4.0])
    assert sample.variance == pytest.approx(np.var([1.0, 1.0, 2.0, 4.0]))


def test_shares_of_a_weighted_choice():
    """Chi-square at the level 1e-4."""
    draws = choice([1.0, 2.0, 7.0], [1, 2, 5]).quantile(np.random.default_rng(2).uniform(size=8000))
    counts = [np.sum(draws == value) for value in (1.0, 2.0, 7.0)]
    assert st.chisquare(counts, [1000, 2000, 5000]).pvalue > 1e-4


@pytest.mark.parametrize("one", EVERY, ids=lambda one: one.name)
def test_plain_form_goes_through_json(one):
    again = from_plain(json.loads(json.dumps(one.plain(), allow_nan=False)), "x")
    assert again == one


def test_plain_form_from_toml():
    text = """
    mass = {distribution = "normal", mean = 1, deviation = 0.02}
    gain = 3
    """
    table = tomllib.loads(text)
    assert from_plain(table["mass"], "mass") == normal(1.0, 0.02)
    assert from_plain(table["gain"], "gain") == constant(3.0)


REFUSED = {
    "unknown": ({"distribution": "norml"}, "no distribution 'norml'. Did you mean 'normal'"),
    "no name": ({"mean": 0.0}, "'distribution' with its name is missing"),
    "parameter": (
        {"distribution": "normal", "mean": 0.0, "deviatoin": 1.0},
        "no parameter 'deviatoin'. Did you mean 'deviation'",
    ),
    "missing": ({"distribution": "normal", "mean": 0.0}, "needs 'deviation'"),
    "negative": (
        {"distribution": "normal", "mean": 0.0, "deviation": -0.1},
        "'deviation' of the distribution 'normal' must be positive, but it is -0.1",
    ),
    "zero": ({"distribution": "weibull", "scale": 0.0, "shape": 1.0}, "must be positive"),
    "not a number": ({"distribution": "normal", "mean": "0", "deviation": 1.0}, "must be a number"),
    "true": ({"distribution": "constant", "value": True}, "must be a number"),
    "nan": ({"distribution": "constant", "value": float("nan")}, "must be finite"),
    "infinite": ({"distribution": "uniform", "low": 0.0, "high": float("inf")}, "must be finite"),
    "order": (
        {"distribution": "uniform", "low": 2.0, "high": 1.0},
        "low must be below high, but it has low = 2, high = 1",
    ),
    "mode": (
        {"distribution": "triangular", "low": 0.0, "mode": 3.0, "high": 1.0},
        "mode must lie between low and high",
    ),
    "far limits": (
        {"distribution": "truncated_normal", "mean": 0.0, "deviation": 1.0, "low": 1e200},
        "too far from the mean",
    ),
    "weights": ({"distribution": "choice", "values": [1, 2], "weights": [1]}, "one weight"),
    "weight": ({"distribution": "choice", "values": [1], "weights": [0]}, "Number 0 in 'weights'"),
    "empty": ({"distribution": "empirical", "values": []}, "at least one number"),
    "no list": ({"distribution": "empirical", "values": 3}, "must be a list"),
    "in a list": ({"distribution": "empirical", "values": [1.0, float("inf")]}, "Number 1 in"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_and_whose_it_is(case):
    plain, words = REFUSED[case]
    with pytest.raises(SettingError, match=r"^Factor 'mass': ") as caught:
        from_plain(plain, "mass")
    assert words in str(caught.value)


def test_a_distribution_checks_itself():
    with pytest.raises(SettingError, match="must be positive"):
        Distribution("normal", {"mean": 0.0, "deviation": 0.0})
