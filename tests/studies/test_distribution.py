"""Distributions against SciPy's own and closed forms; what is refused, and in which words."""

import json

import numpy as np
import pytest
import scipy.stats as st

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.studies.distribution import KINDS, Distribution, as_distribution


def make(name, **parameters):
    return Distribution(name, parameters)


# Each with SciPy's distribution by another parametrisation or by its definition.
CASES = {
    "normal": (make("normal", mean=1.0, standard_deviation=0.2), st.norm(1.0, 0.2)),
    "truncated_normal": (
        make("truncated_normal", mean=1.0, standard_deviation=0.2, low=0.9, high=1.5),
        st.truncnorm(-0.5, 2.5, 1.0, 0.2),
    ),
    "one_sided": (
        make("truncated_normal", mean=0.0, standard_deviation=2.0, low=0.0), st.halfnorm(scale=2.0)
    ),
    "uniform": (make("uniform", low=-2.0, high=3.0), st.beta(1, 1, -2.0, 5.0)),
    "lognormal": (make("lognormal", median=2.0, log_standard_deviation=0.3), st.lognorm(0.3, scale=2.0)),
    "loguniform": (make("loguniform", low=0.1, high=10.0), st.reciprocal(0.1, 10.0)),
    "triangular": (make("triangular", low=0.0, mode=1.0, high=4.0), st.triang(0.25, 0.0, 4.0)),
    "beta": (make("beta", a=2.0, b=3.0, low=-1.0, high=1.0), st.beta(2.0, 3.0, -1.0, 2.0)),
    "weibull": (make("weibull", scale=5.0, shape=2.0), st.rayleigh(scale=5.0 / np.sqrt(2.0))),
    "scipy": (as_distribution(st.gamma(2.0, scale=0.5)), st.erlang(2, 0.0, 0.5)),
}  # fmt: skip
TABLES = (
    as_distribution(3.0),
    make("choice", values=[1.0, 5.0, 2.0], weights=[2, 1, 1]),
    make("empirical", values=np.array([4.0, 1.0, 1.0, 2.0])),
    make("counter", first=5.0),
)
EVERY = [one for one, _ in CASES.values()] + list(TABLES)


def test_every_kind_is_tested():
    assert {one.name for one in EVERY} == {*KINDS, "scipy.gamma"}


@pytest.mark.parametrize("name", CASES)
def test_quantiles(name):
    """To round-off of two ways through the special functions."""
    found, truth = CASES[name]
    u = np.linspace(0.001, 0.999, 999)
    np.testing.assert_allclose(found.quantile(u), truth.ppf(u), rtol=1e-9, atol=1e-12)


def test_tables_of_values():
    third, weighted, sample, _ = TABLES
    np.testing.assert_array_equal(third.quantile(np.array([0.1, 0.9])), [3.0, 3.0])
    u = np.array([0.01, 0.5, 0.50001, 0.75, 0.7501, 0.999])
    np.testing.assert_array_equal(weighted.quantile(u), [1.0, 1.0, 2.0, 2.0, 5.0, 5.0])
    u = (np.arange(4) + 0.5) / 4
    np.testing.assert_array_equal(sample.quantile(u), [1.0, 1.0, 2.0, 4.0])


@pytest.mark.parametrize("one", EVERY, ids=lambda one: one.name)
def test_plain_form_goes_through_json(one):
    again = as_distribution(json.loads(json.dumps(one.plain(), allow_nan=False)), "x")
    assert again == one


REFUSED = {
    "unknown": ({"distribution": "norml"}, "no distribution 'norml'. Did you mean 'normal'"),
    "no name": ({"mean": 0.0}, "A factor needs the entry 'distribution'"),
    "parameter": (
        {"distribution": "normal", "mean": 0.0, "standard_deviatoin": 1.0},
        "no entry 'standard_deviatoin'. Did you mean 'standard_deviation'",
    ),
    "missing": ({"distribution": "normal", "mean": 0.0}, "needs 'standard_deviation'"),
    "negative": (
        {"distribution": "normal", "mean": 0.0, "standard_deviation": -0.1},
        "'standard_deviation' must be greater than 0, but it is -0.1",
    ),
    "true": ({"distribution": "constant", "value": True}, "must be a number"),
    "nan": ({"distribution": "constant", "value": float("nan")}, "must be a finite number"),
    "order": (
        {"distribution": "uniform", "low": 2.0, "high": 1.0},
        "low must be below high, but it has low = 2, high = 1",
    ),
    "mode": (
        {"distribution": "triangular", "low": 0.0, "mode": 3.0, "high": 1.0},
        "mode must lie between low and high",
    ),
    "far limits": (
        {"distribution": "truncated_normal", "mean": 0.0, "standard_deviation": 1.0, "low": 1e200},
        "too far from the mean",
    ),
    "weights": ({"distribution": "choice", "values": [1, 2], "weights": [1]}, "one weight"),
    "weight": ({"distribution": "choice", "values": [1], "weights": [0]}, "'weights.0' must be greater than 0"),
    "empty": ({"distribution": "empirical", "values": []}, "at least 1 item"),
    "in a list": ({"distribution": "empirical", "values": [1.0, float("inf")]}, "'values.1' must be a finite number"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused_and_whose_it_is(case):
    plain, words = REFUSED[case]
    with pytest.raises(SettingError, match=r"^Factor 'mass': ") as caught:
        as_distribution(plain, "mass")
    assert words in str(caught.value)


def test_scipys_frozen_distributions():
    """Numbers are SciPy's to the last digit, whatever way the parameters are given."""
    u = np.linspace(0.01, 0.99, 99)
    for one in (st.norm(1.0, scale=2), st.gamma(2.0, 1.0), st.beta(a=2, b=3), st.poisson(4.0)):
        found = as_distribution(one)
        np.testing.assert_array_equal(found.quantile(u), one.ppf(u))
        assert as_distribution(json.loads(json.dumps(found.plain()))) == found
    assert as_distribution(st.norm(1.0, 2.0)).plain() == {
        "distribution": "scipy.norm", "loc": 1.0, "scale": 2.0
    }  # fmt: skip


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (st.norm(0.0, -1.0), "draws that are not finite"),
        (st.norm(0.0, np.ones(2)), "'scale' must be a number"),
        (st.rv_histogram(np.histogram([1.0, 2.0, 2.0]))(), "not one of scipy.stats"),
        ({"distribution": "scipy.gamma", "a": 1.0, "sale": 1.0}, "Did you mean 'scale'"),
        ({"distribution": "scipy.bootstrap"}, "no distribution"),
    ],
)
def test_distributions_of_scipy_that_are_refused(given, words):
    with pytest.raises(SettingError, match="Factor 'mass'") as caught:
        as_distribution(given, "mass")
    assert words in str(caught.value)
