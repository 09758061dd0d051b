"""What is derived from a failed filter, perfect sensors, and programs that are compiled once."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from linear import random_linear, textbook, textbook_smoother
from scipy.stats import multivariate_normal
from test_compilations import check_compiled_once

from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.consistency import nees, path_nees
from stmuav_jax.estimation.filter import (
    EstimationError,
    GaussianFilter,
    filter_bank,
    kalman_filter,
)
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.likelihood import standard_errors
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.observable import observability
from stmuav_jax.estimation.smoother import smooth

CASE = random_linear(n=3, m=2, count=30)
MODEL, PRIOR = CASE.model(), CASE.prior()


# --- failed filters


@pytest.mark.slow
def test_smoothing_starts_at_the_last_good_step_and_says_where_there_is_nothing():
    """The good part is that of the record up to the failure; all else is NaN or infinite."""
    y, short = CASE.y.copy(), CASE.y.copy()
    # missing readings tell nothing about what was before
    y[20], short[20:] = np.inf, np.nan
    out = kalman_filter(MODEL, PRIOR, y, dt=1.0, throw=False)
    late = smooth(MODEL, out, throw=False)
    assert late.ok.tolist() == [True] * 20 + [False] * 10
    expected = smooth(MODEL, kalman_filter(MODEL, PRIOR, short, dt=1.0))
    np.testing.assert_allclose(late.mean[:20], expected.mean[:20], rtol=0, atol=1e-13)
    np.testing.assert_allclose(late.covariance[:20], expected.covariance[:20], rtol=0, atol=1e-13)
    np.testing.assert_allclose(late.start.mean, expected.start.mean, rtol=0, atol=1e-13)
    assert np.all(np.isnan(late.mean[20:]))
    assert np.all(np.isnan(late.standard_deviation[20:]))
    with pytest.raises(EstimationError, match="no smoothed estimate at measurement 20: the filter"):
        smooth(MODEL, out)
    found = path_nees(late, jnp.asarray(CASE.x), MODEL.space)
    assert np.all(np.isfinite(found[:20]))
    assert np.all(np.isinf(found[20:]))
    # one of many does not spoil the others
    both = jnp.asarray(np.stack([y, CASE.y], axis=-1))
    bank = smooth(MODEL, filter_bank(MODEL, PRIOR, both, dt=1.0))
    np.testing.assert_array_equal(bank.ok[:, 0], late.ok)
    np.testing.assert_allclose(bank.mean[:20, :, 0], expected.mean[:20], rtol=0, atol=1e-13)
    whole = smooth(MODEL, kalman_filter(MODEL, PRIOR, CASE.y, dt=1.0))
    np.testing.assert_allclose(bank.mean[..., 1], whole.mean, rtol=0, atol=1e-13)
    # a filter that fails at once leaves the start
    out = kalman_filter(MODEL, PRIOR, np.full((30, 2), np.inf), dt=1.0, throw=False)
    late = smooth(MODEL, out, throw=False)
    assert not np.any(late.ok)
    np.testing.assert_array_equal(late.start.mean, PRIOR.mean)


# --- perfect sensors


PERFECT = [GaussianFilter(), GaussianFilter(form="covariance"), GaussianFilter(sigma.Linearised()),
           GaussianFilter(sigma.Unscented(0.5, 2.0, 0.1))]  # fmt: skip


@pytest.mark.parametrize("method", PERFECT, ids=str)
def test_perfect_sensors_are_those_of_the_textbook(method):
    """All or one of two without noise, one reading missing; by the Joseph form."""
    for variances in ([0.0, 0.0], [0.0, 0.3], [0.3, 1e-300]):
        case = CASE._replace(R=np.diag(variances))
        y = case.y.copy()
        y[5:6, 0] = np.nan
        means, covariances, likelihood, nis = textbook(case, y)
        out = kalman_filter(case.model(), case.prior(), y, dt=1.0, method=method)
        np.testing.assert_allclose(out.mean, means, rtol=0, atol=1e-11)
        np.testing.assert_allclose(out.covariance, covariances, rtol=0, atol=1e-11)
        np.testing.assert_allclose(out.nis, nis, rtol=1e-9)
        np.testing.assert_allclose(out.log_likelihood, likelihood, rtol=1e-10)
        late = smooth(case.model(), out)
        m, P = textbook_smoother(case, means, covariances)
        np.testing.assert_allclose(late.mean, m, rtol=0, atol=1e-9)
        np.testing.assert_allclose(late.covariance, P, rtol=0, atol=1e-9)


@pytest.mark.parametrize("form", ["square_root", "covariance"])
def test_perfect_sensor_of_the_whole_state(form):
    """x = y and P = 0; the same again agrees, another reading of what is known exactly fails."""
    model = StateSpaceModel(
        lambda x, u, dt: x, np.zeros((2, 2)), Sensor(lambda x, u: x, np.zeros((2, 2)))
    )
    prior = gaussian([0.1, 0.2], [[1.0, 0.5], [0.5, 2.0]])
    y = np.array([[0.7, -0.3], [0.7, -0.3], [0.7, 0.1]])
    run = lambda y: kalman_filter(model, prior, y, dt=1.0, method=GaussianFilter(form=form))
    again = y[[0, 1, 1]]
    out = run(again)
    np.testing.assert_allclose(out.mean, again, rtol=0, atol=1e-15)
    np.testing.assert_allclose(out.covariance, 0.0, atol=1e-15)
    normal: Any = multivariate_normal
    density = normal(prior.mean, prior.covariance).logpdf(y[0])
    np.testing.assert_allclose(out.log_likelihood, density, rtol=1e-13)
    np.testing.assert_array_equal(nees(out.mean[1], out.factor[1], y[1], model.space), 0.0)
    assert np.isinf(nees(out.mean[1], out.factor[1], y[2], model.space))
    with pytest.raises(EstimationError, match=r"measurement 2 .*an exact reading \(R = 0\)"):
        run(y)


def test_perfect_sensor_counts_for_observability():
    sensor = Sensor(lambda x, u: x[:1], [[0.0]])
    model = StateSpaceModel(lambda x, u, dt: x + dt * jnp.stack([x[1], 0.0]), np.eye(2), sensor)
    assert observability(model, [0.0, 0.0], dt=0.1, count=3).rank == 2


# --- parameters that a record does not determine


def test_parameters_that_only_their_product_determines_have_no_standard_error():
    """R = a b is known, a and b are not; Q is."""
    rng = np.random.default_rng(0)
    x = np.cumsum(0.3 * rng.normal(size=200))
    y = (x + 0.5 * rng.normal(size=200))[:, None]
    sensor = lambda v: Sensor(lambda x, u: x, jnp.diag(v["a"] * v["b"]), stacked=True)
    model_of = lambda v: StateSpaceModel(
        lambda x, u, dt: x, jnp.diag(v["Q"]), sensor(v), stacked=True
    )
    one = lambda value: np.array([value])
    values = {"a": one(0.5), "b": one(0.5), "Q": one(0.09)}
    found = standard_errors(model_of, values, gaussian([0.0], [[1.0]]), y, dt=1.0)
    assert np.isnan(found["a"][0])
    assert np.isnan(found["b"][0])
    assert 0.1 < found["Q"][0] < 0.6


# --- compiled once


def test_second_call_with_other_numbers_compiles_nothing():
    """The filter, the smoother, banks, observability; `test_likelihood.py` looks at the search."""

    def run(prior, y, dt):
        out = kalman_filter(MODEL, prior, y, dt=dt)
        bank = filter_bank(MODEL, prior, y[:, :, None], dt=dt)
        seen = observability(MODEL, CASE.m0 + dt, dt=dt, count=4)
        return out.mean, smooth(MODEL, out).mean, bank.mean, seen.singular_values

    check_compiled_once(
        lambda numbers: run(*numbers),
        (PRIOR, CASE.y, 1.0),
        (gaussian(CASE.m0 + 0.1, 2 * CASE.P0), CASE.y + 0.1, 0.5),
    )
