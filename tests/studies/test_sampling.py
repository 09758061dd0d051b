"""Sample i depends on the seed and on i alone; designs, correlations, and what is refused."""

import itertools
import json
import pickle

import numpy as np
import pytest
import scipy.stats as st
from scipy.stats import qmc

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.checks.schema import validate_model
from stmuav_jax.studies.sampling import SOBOL_POINTS, Sampling
from stmuav_jax.studies.schema import Drawing

FACTORS = {
    "a": st.norm(1.0, 0.1),
    "b": {
        "distribution": "truncated_normal",
        "mean": 0.0,
        "standard_deviation": 1.0,
        "low": -0.5,
        "high": 2.0,
    },
    "c": {"distribution": "lognormal", "median": 2.0, "log_standard_deviation": 0.3},
    "d": st.loguniform(0.1, 1.0),
    "e": {"distribution": "triangular", "low": 0.0, "mode": 1.0, "high": 2.0},
    "f": st.beta(2.0, 3.0),
    "g": {"distribution": "weibull", "scale": 5.0, "shape": 2.0},
    "h": {"distribution": "choice", "values": [1.0, 2.0, 4.0]},
    "i": {"distribution": "uniform", "low": -1.0, "high": 1.0},
}
CORRELATION = [("a", "c", 0.6), ("a", "g", -0.5), ("c", "i", 0.3)]


def empirical(values):
    return {"distribution": "empirical", "values": values}


TABLE = {"x": empirical(np.arange(600.0)[::-1]), "y": 2.0}
SAMPLINGS = {
    "random": Sampling(FACTORS, 7),
    "random, correlated": Sampling(FACTORS, 7, correlation=CORRELATION),
    "latin": Sampling(FACTORS, 7, "latin", stratum=100),
    "latin, correlated": Sampling(FACTORS, 7, "latin", CORRELATION, 64),
    "sobol": Sampling(FACTORS, 7, "sobol"),
    "sobol, correlated": Sampling(FACTORS, 7, "sobol", CORRELATION),
    "saltelli": Sampling(FACTORS, 7, "saltelli"),
    "table": Sampling(TABLE, 7, "table"),
}
# A table ends; the others are asked for far-off samples too (a Sobol sequence counts up to there).
FAR = {
    "random": 10**12 + 7,
    "latin": 10**9 + 7,
    "sobol": 2 * 10**6 + 7,
    "saltelli": 10**7 + 7,
    "table": 100,
}
each = pytest.mark.parametrize("name", SAMPLINGS)


def read(plain):
    """Sampling of a study's file, checked by its schema."""
    rest = {name: value for name, value in plain.items() if name != "factors"}
    return Sampling(plain["factors"], **validate_model(Drawing, rest, "A sampling").model_dump())


@each
def test_any_splitting_gives_the_same_bits(name):
    sampling = SAMPLINGS[name]
    for base in (0, FAR[sampling.design]):
        whole = sampling.draw(base, 500)
        assert whole.shape == (500, len(sampling.factors))
        assert np.all(np.isfinite(whole))
        cuts = np.random.default_rng(3).integers(0, 500, (1, 12))
        for cut in [*cuts, np.arange(1, 9), np.array([255, 256, 257])]:
            edges = np.unique([0, *cut, 500])
            parts = [sampling.draw(base + i, j - i) for i, j in itertools.pairwise(edges.tolist())]
            np.testing.assert_array_equal(np.concatenate(parts), whole)


@each
def test_seed_and_only_the_seed_decides(name):
    sampling = SAMPLINGS[name]
    other = Sampling(sampling.factors, 8, sampling.design, sampling.correlation, sampling.stratum)
    same = np.array_equal(other.draw(0, 50), sampling.draw(0, 50))
    assert same == (sampling.design == "table")
    copy = pickle.loads(pickle.dumps(sampling))
    np.testing.assert_array_equal(copy.draw(3, 50), sampling.draw(3, 50))


@each
def test_plain_form_goes_through_json_with_sorted_keys(name):
    sampling = SAMPLINGS[name]
    text = json.dumps(sampling.plain(), sort_keys=True, allow_nan=False)
    plain = json.loads(text)
    factors = {entry.pop("name"): entry for entry in plain.pop("factors")}
    again = read(plain | {"factors": factors})
    assert again == sampling
    np.testing.assert_array_equal(again.draw(5, 20), sampling.draw(5, 20))


@pytest.mark.parametrize("name", [n for n in SAMPLINGS if n != "table"])
def test_marginals(name):
    """Kolmogorov and Smirnov, at the level 1e-4 over nine factors and seven designs."""
    sampling = SAMPLINGS[name]
    x = sampling.draw(0, 3003 if sampling.design == "saltelli" else 3000)
    if sampling.design == "saltelli":
        x = x.reshape(-1, 11, 9)[:, 0]
    truths = {
        "a": st.norm(1.0, 0.1), "b": st.truncnorm(-0.5, 2.0), "c": st.lognorm(0.3, scale=2.0),
        "d": st.loguniform(0.1, 1.0), "e": st.triang(0.5, 0.0, 2.0), "f": st.beta(2.0, 3.0),
        "g": st.weibull_min(2.0, scale=5.0), "i": st.uniform(-1.0, 2.0),
    }  # fmt: skip
    for factor, truth in truths.items():
        column = x[:, sampling.names.index(factor)]
        assert st.kstest(column, truth.cdf).pvalue > 1e-4 / 63
    counts = np.unique(x[:, 7], return_counts=True)[1]
    assert st.chisquare(counts).pvalue > 1e-4 / 63


def test_random_samples_are_independent():
    """Neighbouring samples and neighbouring factors: correlations within 4.5 deviations of 0."""
    n = 20000
    x = Sampling({str(k): st.uniform() for k in range(5)}, 1).draw(0, n)
    table = np.corrcoef(np.concatenate([x[:-1], x[1:]], axis=1).T)
    assert np.max(np.abs(table - np.eye(10))) < 4.5 / np.sqrt(n)


def test_random_keeps_away_from_zero_and_one():
    x = Sampling({"x": st.uniform()}, 1).draw(0, 10**6)[:, 0]
    assert 0 < x.min() < 1e-5
    assert 1 - 1e-5 < x.max() < 1


def test_correlation_in_ranks():
    """Spearman's correlation is (6 / pi) asin(rho / 2) whatever the distributions; 4.5 deviations."""
    n = 20000
    for name in ("random, correlated", "latin, correlated", "sobol, correlated"):
        x = SAMPLINGS[name].draw(0, n)
        found = np.corrcoef(st.rankdata(x, axis=0).T)
        truth = np.eye(9)
        for a, b, rho in CORRELATION:
            i, j = "abcdefghi".index(a), "abcdefghi".index(b)
            truth[i, j] = truth[j, i] = 6 / np.pi * np.arcsin(rho / 2)
        assert np.max(np.abs(found - truth)) < 4.5 / np.sqrt(n)


def test_latin_fills_every_stratum_of_each_hypercube():
    sampling = Sampling({"x": st.uniform(), "y": st.uniform()}, 3, "latin", stratum=50)
    x = sampling.draw(0, 150).reshape(3, 50, 2)
    cells = np.sort((x * 50).astype(int), axis=1)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(50)[:, None], (3, 50, 2)))
    assert not np.array_equal(x[0], x[1])


def test_sobol_is_a_net():
    """Of 2^m scrambled points each of 2^m slices of a factor holds one; low discrepancy."""
    x = Sampling({str(k): st.uniform() for k in range(4)}, 3, "sobol").draw(0, 256)
    cells = np.sort((x * 256).astype(int), axis=0)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(256)[:, None], (256, 4)))
    random = Sampling({str(k): st.uniform() for k in range(4)}, 3).draw(0, 256)
    assert qmc.discrepancy(x) < 0.2 * qmc.discrepancy(random)


def test_saltelli_layout():
    """A, B, then A with one factor after the other from B; the halves of one Sobol sequence."""
    factors = {"x": st.uniform(), "y": st.uniform(0.0, 2.0), "z": st.norm(0.0, 1.0)}
    sampling = Sampling(factors, 3, "saltelli")
    rows = sampling.draw(0, 64 * 5).reshape(64, 5, 3)
    a, b = rows[:, 0], rows[:, 1]
    assert not np.any(a == b)
    for j in range(3):
        mixed = a.copy()
        mixed[:, j] = b[:, j]
        np.testing.assert_array_equal(rows[:, 2 + j], mixed)
    halves = np.concatenate([a[:, :1], a[:, 1:2] / 2, b[:, :1], b[:, 1:2] / 2], axis=1)
    cells = np.sort((halves * 64).astype(int), axis=0)
    np.testing.assert_array_equal(cells, np.broadcast_to(np.arange(64)[:, None], (64, 4)))


def test_table_gives_its_rows():
    sampling = Sampling({"x": empirical([3.0, 1.0, 2.0]), "y": empirical([1, 1, 5])}, 0, "table")
    np.testing.assert_array_equal(sampling.draw(1, 2), [[1.0, 1.0], [2.0, 5.0]])
    assert sampling.limit == 3
    assert SAMPLINGS["sobol"].limit == SOBOL_POINTS


@pytest.mark.parametrize(
    ("name", "first", "words"),
    [
        ("table", 599, "table has 600 rows, but samples up to 601"),
        ("sobol", SOBOL_POINTS - 1, "has 2147483648 samples"),
        ("random", -1, "count from 0"),
    ],
)
def test_samples_beyond_the_ends_are_refused(name, first, words):
    with pytest.raises(SettingError, match=words):
        SAMPLINGS[name].draw(first, 2)


PLAIN = {
    "factors": {
        "x": {"distribution": "normal", "mean": 0.0, "standard_deviation": 1.0},
        "y": {"distribution": "uniform", "low": 0.0, "high": 1.0},
        "z": {"distribution": "uniform", "low": 0.0, "high": 1.0},
        "k": 3.0,
    },
    "seed": 1,
}
BAD_MATRIX = [["x", "y", 0.9], ["y", "z", 0.9], ["x", "z", -0.9]]
REFUSED = {
    "entry": ({"sed": 1}, "no entry 'sed'. Did you mean 'seed'"),
    "no factors": ({"factors": {}}, "at least one factor"),
    "design": ({"design": "sobel"}, "but it is 'sobel'. Did you mean 'sobol'"),
    "seed": ({"seed": -1}, "'seed' must be at least 0, but it is -1"),
    "stratum missing": ({"design": "latin"}, "needs 'stratum'"),
    "stratum of another": ({"stratum": 10}, "design is 'random' and the stratum 10"),
    "eigenvalue": ({"correlation": BAD_MATRIX}, "smallest eigenvalue is -0.8"),
    "unknown pair": ({"correlation": [["x", "w", 0.1]]}, "names 'w', which is no factor"),
    "range": ({"correlation": [["x", "y", 1.0]]}, "'correlation.0.2' must be less than 1"),
    "twice": ({"correlation": [["x", "y", 0.1], ["y", "x", 0.1]]}, "given twice"),
    "itself": ({"correlation": [["x", "x", 0.1]]}, "with itself"),
    "constant": ({"correlation": [["x", "k", 0.1]]}, "'k' is constant"),
    "saltelli": ({"correlation": [["x", "y", 0.1]], "design": "saltelli"}, "cannot have corr"),
    "table": ({"design": "table"}, "Factor 'x': in a table factors are columns"),
    "columns": (
        {"design": "table", "factors": {
            "x": {"distribution": "empirical", "values": [1, 2]},
            "y": {"distribution": "empirical", "values": [1]}}},
        "equally long, but they have {'x': 2, 'y': 1} rows",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    change, words = REFUSED[case]
    read(PLAIN)
    with pytest.raises(SettingError) as caught:
        read(PLAIN | change)
    assert words in str(caught.value)
