"""Searching: known minima, bests kept, restarts, bad losses."""

import jax.numpy as jnp
import numpy as np
import optax
import optimistix as optx
import pytest
from scipy.optimize import least_squares

import stmuav_jax as stm
from stmuav_jax.math import CorrectedLevenbergMarquardt
from stmuav_jax.math.least_squares import SearchReason, search

LM = optx.LevenbergMarquardt(rtol=1e-10, atol=1e-12)
CORRECTED = CorrectedLevenbergMarquardt(rtol=1e-10, atol=1e-12)
both = pytest.mark.parametrize("method", [LM, CORRECTED], ids=["plain", "corrected"])


def rosenbrock(v):
    """Residuals, zero at (1, 1)."""
    return {"a": 1 - v["x"], "b": 10 * (v["y"] - v["x"] ** 2)}


START = {"x": -1.2, "y": 1.0}


@both
def test_least_squares(method):
    seen = []
    found = search(rosenbrock, START, method, report=lambda s: seen.append(s.loss))
    assert found.reason == SearchReason.CONVERGED
    np.testing.assert_allclose([found.values["x"], found.values["y"]], 1, atol=1e-8)
    assert found.history[0] == pytest.approx(0.5 * (2.2**2 + (10 * 0.44) ** 2))
    assert tuple(seen) == found.history
    assert found.steps == len(seen) - 1
    assert seen == sorted(seen, reverse=True)
    assert "Converged" in found.describe()


def test_a_minimiser_of_optax():
    adam = optx.OptaxMinimiser(optax.adam(0.05), rtol=1e-6, atol=1e-6)
    found = search(lambda v: (v - 2.0) ** 2, jnp.asarray(0.0), adam, steps=500, patience=500)
    assert float(found.values) == pytest.approx(2.0, abs=1e-3)


@both
def test_goes_on_where_it_was(method):
    first = search(rosenbrock, START, method, steps=3)
    assert first.reason == SearchReason.STEPS
    assert first.steps == 3
    again = search(rosenbrock, START, method, steps=100, resume=first)
    assert again.history[:4] == first.history
    assert again.loss < 1e-16 < first.loss
    with pytest.raises(stm.SettingError, match="values of shapes"):
        search(rosenbrock, {"x": 0.0, "y": jnp.zeros(2)}, method, resume=first)


def valley(v):
    """Residuals of a narrow curved valley, y = sin x, along which the others are small."""
    return 1e5 * (v[1] - jnp.sin(v[0])), 0.1 * (v[0] - 2), 0.1 * (v[1] + 1), 0.1 * v[2]


def test_corrections_follow_a_curved_valley():
    """The minimum of SciPy, which steps without corrections do not come near to meanwhile."""
    start = jnp.array([-1.0, 1.0, 3.0])
    corrected = search(valley, start, CorrectedLevenbergMarquardt(), steps=100, patience=100)
    plain = search(valley, start, optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8), steps=100)
    at = lambda x: np.array(valley(x))
    exact = least_squares(at, [0.8, 0.7, 0.1], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert corrected.reason == SearchReason.CONVERGED
    assert corrected.loss == pytest.approx(exact.cost, rel=1e-6)
    np.testing.assert_allclose(corrected.values, exact.x, atol=1e-4)
    assert plain.loss > 1.05 * corrected.loss


def test_a_step_out_of_the_domain_is_shortened():
    """The first step from 3 would lead to a negative logarithm's argument."""
    found = search(lambda x: jnp.log(x) ** 3, jnp.asarray(3.0), CORRECTED, steps=200, patience=200)
    assert found.reason == SearchReason.CONVERGED
    assert float(found.values) == pytest.approx(1.0, abs=1e-2)
    assert np.all(np.isfinite(found.history))


def test_interrupted():
    def stop(now):
        if now.steps == 3:
            raise KeyboardInterrupt

    found = search(rosenbrock, START, LM, report=stop)
    assert found.reason == SearchReason.INTERRUPTED
    assert found.steps == 3


def test_loss_that_is_not_finite():
    """Downhill to a cliff: what was best before is kept."""
    cliff = lambda v: jnp.where(v > 0.5, v, jnp.nan)
    descent = optx.OptaxMinimiser(optax.sgd(0.2), rtol=1e-6, atol=1e-6)
    found = search(cliff, jnp.asarray(1.0), descent)
    assert found.reason == SearchReason.NOT_FINITE
    assert 0.5 < found.loss < 0.7
    assert np.isnan(found.history[-1])
    assert "not finite at step" in found.describe()
    with pytest.raises(stm.SettingError, match="loss at the start of the search is nan"):
        search(cliff, jnp.asarray(0.0), descent)


def test_patience():
    flat = lambda v: 1.0 + 0.0 * v
    descent = optx.OptaxMinimiser(optax.sgd(0.2), rtol=1e-30, atol=1e-30)
    found = search(flat, jnp.asarray(1.0), descent, patience=4)
    assert found.reason in (SearchReason.PATIENCE, SearchReason.CONVERGED)
    assert found.steps <= 4
    with pytest.raises(stm.SettingError, match="at least one of steps, not 0"):
        search(flat, jnp.asarray(1.0), descent, steps=0)


def test_residuals_of_large_weights_have_round_off():
    """A search ends where its loss cannot be known better, and says that it has converged."""
    losses = []
    # cancellation against the offset leaves round-off, which the weight makes large
    for offset in (0.0, 1e5, 1e6):

        def residuals(x, offset=offset):
            defects = (x[:4] ** 2 + offset) - (x[1:] + offset)
            return [1e5 * defects, 0.1 * (x - 2.0)]

        found = search(
            residuals, jnp.linspace(1.5, 1.0, 5), CorrectedLevenbergMarquardt(), patience=90
        )
        assert found.reason is SearchReason.CONVERGED
        assert found.steps < 15
        losses.append(found.loss)
    np.testing.assert_allclose(losses, losses[0], rtol=1e-9)


@pytest.mark.parametrize("offset", [0.0, 1e4, 1e5, 1e6])
def test_residuals_that_can_be_zero_are_round_off_in_the_end(offset):
    """No step gains what the model promises there, though the values are known long before."""

    def residuals(x):
        defects = (x[:4] ** 2 + offset) - (x[1:] + offset)
        return [1e5 * defects, 1e5 * (x[0] - 1.01)]

    start = jnp.linspace(1.5, 1.0, 5)
    found = search(residuals, start, CorrectedLevenbergMarquardt(), patience=90)
    assert found.reason is SearchReason.CONVERGED
    assert found.steps < 12
    np.testing.assert_allclose(found.values, 1.01**2.0 ** np.arange(5), rtol=1e-8)


@pytest.mark.parametrize(("slope", "is_last"), [(1e-11, True), (1e-3, False)])
def test_a_direction_that_changes_nothing_but_round_off(slope, is_last):
    """A step gains nothing at the minimum: the search ends unless a direction that matters has a gradient."""
    J = np.array([[1e5, 0.0], [0.0, slope], [0.0, 0.0]])
    r = np.array([1e-6, 0.1, 1.0])
    noisy = lambda values: 1.0001 * r
    attempt = CorrectedLevenbergMarquardt().attempt(noisy, jnp.zeros(2), (r, J), 1e-6)
    assert not attempt.is_accepted
    assert attempt.is_last == is_last
