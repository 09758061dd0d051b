"""Tuning by likelihood: known variances come back, within their standard errors."""

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.likelihood import record_likelihood, standard_errors, tune
from stmuav_jax.estimation.model import Sensor, StateSpaceModel

F = np.array([[1.0, 0.1], [0.0, 0.98]])
TRUE = {"Q": np.array([0.02, 0.05]), "R": np.array([0.3])}
COUNT, RUNS = 200, 8


def model_of(v):
    sensor = Sensor(lambda x, u: x[:1], jnp.diag(v["R"]), stacked=True)
    A = jnp.asarray(F)
    step = lambda x, u, dt: jnp.einsum("ij,j...->i...", A, x)
    return StateSpaceModel(step, jnp.diag(v["Q"]), sensor, stacked=True)


PRIOR = gaussian(np.zeros(2), np.eye(2))


@pytest.fixture(scope="module")
def records():
    """Independent ones (T, 1, s)."""
    rng = np.random.default_rng(2)
    x, ys = rng.normal(size=(2, RUNS)), []
    for _ in range(COUNT):
        x = F @ x + np.sqrt(TRUE["Q"])[:, None] * rng.normal(size=(2, RUNS))
        ys.append(x[:1] + np.sqrt(TRUE["R"])[:, None] * rng.normal(size=(1, RUNS)))
    return jnp.asarray(np.array(ys))


START = {"Q": np.array([0.2, 0.005]), "R": np.array([3.0])}


@pytest.fixture(scope="module")
def tuned(records):
    seen = []
    found = tune(model_of, START, PRIOR, records, dt=1.0, progress=lambda k, v: seen.append((k, v)))
    return found, seen


def test_known_variances_come_back(records, tuned):
    """Within 3.3 standard errors (99.9 %), which are small enough to mean something."""
    found, seen = tuned
    errors = standard_errors(model_of, found.values, PRIOR, records, dt=1.0)
    for key in TRUE:
        apart = np.log(found.values[key]) - np.log(TRUE[key])
        assert np.all(np.abs(apart) < 3.3 * np.asarray(errors[key]))
        assert np.all(np.asarray(errors[key]) < 0.5)
    assert found.reason == "converged"
    # progress is the best so far, and what is returned is the best
    values = [v for _, v in seen]
    assert values == sorted(values)
    assert found.log_likelihood == max(found.history)
    truth = record_likelihood(model_of, TRUE, PRIOR, records, dt=1.0)
    assert 0 < found.log_likelihood - float(truth) < 10


def test_gradient_against_differences(records):
    """By ln variance, central differences."""
    loss = jax.jit(
        lambda p: record_likelihood(model_of, jax.tree.map(jnp.exp, p), PRIOR, records[:40], dt=1.0)
    )
    p = jax.tree.map(lambda v: jnp.log(jnp.asarray(v)), START)
    slope = jax.jit(jax.grad(loss))(p)
    h = 1e-4
    for key, i in (("Q", 0), ("Q", 1), ("R", 0)):
        moved = [{**p, key: p[key].at[i].add(s * h)} for s in (1, -1)]
        expected = (loss(moved[0]) - loss(moved[1])) / (2 * h)
        np.testing.assert_allclose(slope[key][i], expected, rtol=1e-6)


def test_what_is_not_finite_stops_and_the_best_stays(records):
    """Steps of 1000 in ln variance: overflow at the first."""
    found = tune(model_of, START, PRIOR, records[:40], dt=1.0, optimiser=optax.sgd(1e4), steps=5)
    assert found.reason == "not finite"
    assert np.isfinite(found.log_likelihood)
    for key in START:
        np.testing.assert_allclose(found.values[key], START[key], rtol=1e-12)


def test_refused(records):
    with pytest.raises(SettingError, match="must be positive, but one is 0"):
        tune(model_of, {**START, "R": np.array([0.0])}, PRIOR, records, dt=1.0)
    with pytest.raises(SettingError, match="At least one step"):
        tune(model_of, START, PRIOR, records, dt=1.0, steps=0)
    bad = records.at[3].set(jnp.inf)
    with pytest.raises(SettingError, match="the filter cannot run with it"):
        tune(model_of, START, PRIOR, bad, dt=1.0)


def with_zeros(v):
    """The second state has no noise of its own; Q is a factor times a matrix with zeros."""
    A = jnp.asarray(F)
    sensor = Sensor(lambda x, u: x[:1], jnp.diag(v["R"]), stacked=True)
    step = lambda x, u, dt: jnp.einsum("ij,j...->i...", A, x)
    return StateSpaceModel(step, v["q"] * jnp.diag(jnp.array([1.0, 0.0])), sensor, stacked=True)


def test_zero_process_noise_has_gradients(records):
    """Against central differences; and `tune` finds its way."""
    start = {"q": np.array(0.1), "R": np.array([0.5])}
    loss = jax.jit(lambda v: record_likelihood(with_zeros, v, PRIOR, records[:40], dt=1.0))
    slope = jax.jit(jax.grad(loss))(start)
    for key in start:
        h = 1e-5
        up, down = ({**start, key: start[key] + s * h} for s in (1, -1))
        expected = (loss(up) - loss(down)) / (2 * h)
        np.testing.assert_allclose(np.ravel(slope[key])[0], expected, rtol=1e-6)


def test_signed_parameters_and_times(records):
    """A bias by the identity instead of the logarithm, from times instead of a step."""
    y, t = records[:100] + 0.7, np.arange(101.0)

    def biased(v):
        sensor = Sensor(lambda x, u: x[:1] + v["bias"], jnp.diag(v["R"]), stacked=True)
        step = lambda x, u, dt: jnp.einsum("ij,j...->i...", jnp.asarray(F), x)
        return StateSpaceModel(step, jnp.diag(jnp.asarray(TRUE["Q"])), sensor, stacked=True)

    start = {"bias": np.array(-0.2), "R": np.array([1.0])}
    signed = {"bias": True, "R": False}
    found = tune(biased, start, PRIOR, y, t=t, signed=signed, steps=25)
    errors = standard_errors(biased, found.values, PRIOR, y, t=t, signed=signed)
    assert abs(found.values["bias"] - 0.7) < 3.3 * float(errors["bias"])
    # the states wander too: half of the start's error of 0.9 is what 100 steps can tell
    assert float(errors["bias"]) < 0.45
    with pytest.raises(SettingError, match=r"must be positive, but one is -0\.2"):
        tune(biased, start, PRIOR, y, t=t)
    with pytest.raises(SettingError, match="either dt"):
        tune(biased, start, PRIOR, y, signed=signed)
