"""Tuning by likelihood: known variances and a bias come back, within their standard errors."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_compilations import counted_compilations

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.likelihood import record_likelihood, standard_errors, tune
from stmuav_jax.estimation.model import Sensor, StateSpaceModel

F = jnp.array([[1.0, 0.1], [0.0, 0.98]])
TRUE = {"Q": np.array([0.02, 0.05]), "R": np.array([0.3]), "bias": np.array(0.7)}
START = {"Q": np.array([0.2, 0.005]), "R": np.array([3.0]), "bias": np.array(-0.2)}
SIGNED = {"Q": False, "R": False, "bias": True}
COUNT, RUNS = 200, 8
T = np.arange(COUNT + 1.0)
PRIOR = gaussian(np.zeros(2), np.eye(2))


def turn(x, u, dt):
    return jnp.einsum("ij,j...->i...", F, x)


class Biased(eqx.Module):
    bias: jax.Array

    def __call__(self, x, u):
        return x[:1] + self.bias


def model_of(v):
    sensor = Sensor(Biased(jnp.asarray(v.get("bias", 0.0))), jnp.diag(v["R"]), stacked=True)
    return StateSpaceModel(turn, jnp.diag(v["Q"]), sensor, stacked=True)


@pytest.fixture(scope="module")
def records():
    """Independent ones (T, 1, s)."""
    rng = np.random.default_rng(2)
    x, ys = rng.normal(size=(2, RUNS)), []
    for _ in range(COUNT):
        x = F @ x + np.sqrt(TRUE["Q"])[:, None] * rng.normal(size=(2, RUNS))
        ys.append(x[:1] + 0.7 + np.sqrt(TRUE["R"])[:, None] * rng.normal(size=(1, RUNS)))
    return jnp.asarray(np.array(ys))


@pytest.mark.slow
def test_known_variances_and_a_bias_come_back(records):
    """Within 3.3 standard errors (99.9 %), which are small enough to mean something."""
    seen = []
    options = {"t": T, "signed": SIGNED}
    found = tune(
        model_of, START, PRIOR, records, progress=lambda k, v: seen.append((k, v)), **options
    )
    errors = standard_errors(model_of, found.values, PRIOR, records, **options)
    unknown = lambda v: {"Q": np.log(v["Q"]), "R": np.log(v["R"]), "bias": v["bias"]}
    for key, value in unknown(TRUE).items():
        apart = unknown(found.values)[key] - value
        assert np.all(np.abs(apart) < 3.3 * np.asarray(errors[key]))
        assert np.all(np.asarray(errors[key]) < 0.5)
    assert found.reason == "converged"
    values = [v for _, v in seen]
    assert values == sorted(values)
    assert found.log_likelihood == max(found.history)
    with counted_compilations() as compiled:
        truth = tune(model_of, TRUE, PRIOR, records, steps=1, **options)
        standard_errors(model_of, truth.values, PRIOR, records, **options)
    assert compiled == []
    assert truth.reason == "steps"
    assert 0 < found.log_likelihood - truth.history[0] < 10
    with pytest.raises(SettingError, match="the filter cannot run with it"):
        tune(model_of, {**START, "bias": np.array(1e200)}, PRIOR, records, **options)


def test_refused(records):
    with pytest.raises(SettingError, match=r"must be positive, but one is -0\.2"):
        tune(model_of, START, PRIOR, records, t=T)
    with pytest.raises(SettingError, match="At least one step"):
        tune(model_of, START, PRIOR, records, t=T, signed=SIGNED, steps=0)
    with pytest.raises(SettingError, match="either dt"):
        tune(model_of, START, PRIOR, records, signed=SIGNED)
    with pytest.raises(SettingError, match="the filter cannot run with it"):
        tune(model_of, START, PRIOR, records.at[3].set(jnp.inf), t=T, signed=SIGNED)


def test_zero_process_noise_has_gradients(records):
    """Q is a factor times a matrix with zeros; against central differences."""

    def loss(v):
        model = model_of({"Q": v["q"] * jnp.array([1.0, 0.0]), "R": v["R"]})
        return record_likelihood(lambda _: model, None, PRIOR, records[:40], dt=1.0)

    both = jax.jit(jax.value_and_grad(loss))
    start, h = {"q": np.array(0.1), "R": np.array([0.5])}, 1e-5
    slope = both(start)[1]
    for key in start:
        up, down = (both({**start, key: start[key] + s * h})[0] for s in (1, -1))
        np.testing.assert_allclose(np.ravel(slope[key])[0], (up - down) / (2 * h), rtol=1e-6)
