"""The verdict: its level over healthy records, its power against what is wrong, its words."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.checks.errors import SettingError
from stmuav_jax.estimation.consistency import (
    TESTS,
    inconsistent,
    judge_innovations,
    verdict,
    verdicts,
)
from stmuav_jax.estimation.filter import filter_bank, kalman_filter
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.uav.quadrotor.assessment import consistent_tuning, report_tuning
from stmuav_jax.uav.quadrotor.cases import simulate_case
from stmuav_jax.uav.quadrotor.model import PART_III

F = np.array([[1.0, 0.1], [-0.1, 0.98]])
H = np.array([[1.0, 0.0], [0.3, 1.0]])
Q, R, P0 = np.diag([0.01, 0.04]), np.array([[0.2, 0.05], [0.05, 0.3]]), np.eye(2)
COUNT = 400


def records(runs, seed=0, *, q=1.0, r=1.0, start=(0.0, 0.0)):
    """Measurements (T, 2, s) of an oscillator with noise as given, from N(start, P0)."""
    rng = np.random.default_rng(seed)
    x = np.array(start)[:, None] + rng.normal(size=(2, runs))
    root_q, root_r = np.sqrt(q) * np.linalg.cholesky(Q), np.sqrt(r) * np.linalg.cholesky(R)
    y = np.empty((COUNT, 2, runs))
    for k in range(COUNT):
        x = F @ x + root_q @ rng.normal(size=(2, runs))
        y[k] = H @ x + root_r @ rng.normal(size=(2, runs))
    return y


MODEL = StateSpaceModel(
    lambda x, u, dt: jnp.einsum("ij,j...->i...", jnp.asarray(F), x),
    Q,
    Sensor(lambda x, u: jnp.einsum("ij,j...->i...", jnp.asarray(H), x), R, stacked=True),
    stacked=True,
)
PRIOR = gaussian(np.zeros(2), P0)
RUNS = 1000


def judged(y, **options):
    return verdicts(filter_bank(MODEL, PRIOR, jnp.asarray(y), dt=0.1, group=250), **options)


def share(found):
    return np.mean([v.status == "inconsistent" for v in found])


def test_false_alarms():
    """1 %: 0.5 to 2 % of 1,000 healthy records (chance alone gives 0.4 to 1.9 % at 99 %)."""
    found = judged(records(RUNS))
    assert 0.005 <= share(found) <= 0.02
    # no test has the alarms to itself: each is held to an eighth of them
    spoke = [name for v in found for name in v.significant_tests]
    assert max(spoke.count(name) for name in TESTS) <= 7
    assert np.mean([v.settling_time == 0 for v in found]) > 0.99
    # each p-value is uniform (Kolmogorov's distance, 99.9 % at 1000: 0.062)
    for name in ("start", "size", "memory", "slow drift", "bias"):
        p = np.sort([v.p_values[name] for v in found])
        assert np.max(np.abs(p - (np.arange(RUNS) + 0.5) / RUNS)) < 0.062
    assert "Consistent" in found[0].explanation or found[0].status == "inconsistent"


def test_level_with_missing_measurements():
    """The degrees of freedom are those of what was measured."""
    y = records(RUNS, seed=1)
    rng = np.random.default_rng(2)
    y[rng.uniform(size=y.shape) < 0.3] = np.nan
    y[200:230] = np.nan
    found = judged(y)
    assert share(found) <= 0.02
    assert abs(found[0].missing - 0.35) < 0.03
    assert "% of the measurements are missing" in found[0].explanation


@pytest.mark.parametrize(
    ("given", "tests", "words"),
    [
        ({"r": 5.0}, {"size", "sliding"}, "R is too small"),
        ({"r": 0.2}, {"size", "sliding"}, "R is too large, so that the filter follows too slowly"),
        ({"q": 8.0}, {"size", "memory"}, "larger than the filter expects, and successive ones are"),
        ({"start": (30.0, 0.0)}, {"start"}, "the prior is too narrow"),
    ],
)
def test_power(given, tests, words):
    """At least 95 % of 200 records each, by the tests that should see it."""
    found = judged(records(250, seed=3, **given))
    assert share(found) >= 0.95
    for name in tests:
        assert np.mean([name in v.significant_tests for v in found]) >= 0.95
    assert np.mean([words in v.explanation for v in found]) >= 0.5


def test_bias_and_outliers():
    """A sensor's bias by its name; outliers as such, not as a wrong R."""
    y = records(250, seed=4)
    biased = y.copy()
    biased[:, 1] += 1.0
    found = judged(biased, names=("x of the sensor", "y of the sensor"))
    assert share(found) >= 0.95
    assert np.mean(["the sensor is not zero: a bias of" in v.explanation for v in found]) >= 0.95
    hit = np.random.default_rng(5).uniform(size=y.shape) < 0.02
    found = judged(np.where(hit, y + 20 * np.sqrt(0.3), y))
    assert share(found) == 1.0
    assert np.mean(["outliers." in v.explanation for v in found]) >= 0.95


def test_start_and_settling():
    """A wrong start is told apart from the rest: nothing speaks after it; or a time is given."""
    y = records(8, seed=6, start=(30.0, 0.0))
    found = judged(y, settle=20.0)
    np.testing.assert_allclose([v.settling_time for v in found], 20.0)
    assert all("size" not in v.significant_tests and "start" in v.significant_tests for v in found)
    assert all("From 20 s on no test rejects" in v.explanation for v in found)


def test_inputs_that_the_model_takes_with_a_wrong_gain():
    """5 % too little, below the noise of each step, are seen by the inputs' test and said."""
    rng, runs = np.random.default_rng(10), 200
    u = (
        np.sin(0.13 * np.arange(COUNT))[:, None]
        + 0.3 * np.sin(0.041 * np.arange(COUNT) ** 1.2)[:, None]
    )
    sensor = Sensor(lambda x, u: x, [[0.04]], stacked=True)
    push = StateSpaceModel(lambda x, u, dt: 0.9 * x + u, [[0.01]], sensor, stacked=True)
    x, y = np.zeros((1, runs)), np.empty((COUNT, 1, runs))
    for k in range(COUNT):
        x = 0.9 * x + u[k] + 0.1 * rng.normal(size=x.shape)
        y[k] = x + 0.2 * rng.normal(size=x.shape)
    run = lambda gain: verdicts(
        filter_bank(push, gaussian([0.0], [[1e-4]]), jnp.asarray(y), u=gain * u, dt=1.0, group=200)
    )
    assert share(run(1.0)) <= 0.04
    found = run(0.95)
    assert share(found) >= 0.95
    assert np.mean(["inputs" in v.significant_tests for v in found]) >= 0.95
    assert np.mean(["the model's gain of an input" in v.explanation for v in found]) >= 0.95


def test_predictions_made_of_past_innovations_raise_no_alarm():
    """A random walk's prediction is a sum of them; centred by its mean, 1.4 % had p < 9e-4."""
    rng, runs = np.random.default_rng(11), 2000
    z = rng.normal(size=(COUNT, 1, runs))
    predicted = np.cumsum(z, axis=0) - z
    full = np.ones_like(z, bool), np.ones((COUNT, runs), bool)
    found = judge_innovations(z, *full, 0.1, inputs=predicted, predicted=predicted)
    for name in ("inputs", "prediction"):
        p = np.array([v.p_values[name] for v in found])
        # 99.9 % of binomial counts: 72 to 132 and 0 to 7
        assert 72 <= np.sum(p < 0.05) <= 132
        assert np.sum(p < 9e-4) <= 7


def test_start_that_is_wrong_by_four_stated_deviations():
    """It is called a wrong start, not an outlier, by a sensor of the state and without a name."""
    rng, runs = np.random.default_rng(12), 300
    sensor = Sensor(lambda x, u: x, [[0.01]], stacked=True)
    model = StateSpaceModel(lambda x, u, dt: x, [[1e-4]], sensor, stacked=True)
    x = 4.0 + np.cumsum(0.01 * rng.normal(size=(COUNT, 1, runs)), axis=0)
    y = jnp.asarray(x + 0.1 * rng.normal(size=x.shape))
    found = verdicts(filter_bank(model, gaussian([0.0], [[1.0]]), y, dt=0.1, group=300))
    assert share(found) >= 0.95
    for v in found:
        if v.status == "inconsistent":
            assert "start" in v.significant_tests
            assert "The first innovation of component 0 is" in v.explanation
    assert np.mean(["outliers" in v.significant_tests for v in found]) <= 0.01


def test_one_record():
    y = records(1, seed=9)[..., 0]
    out = kalman_filter(MODEL, PRIOR, y, dt=0.1)
    one = verdict(out)
    assert one.status == "consistent", one
    assert "mean NIS" in one.explanation
    assert verdict(kalman_filter(MODEL, PRIOR, y[:10], dt=0.1)).status == "undecided"
    bank = filter_bank(MODEL, PRIOR, jnp.asarray(y[..., None]), dt=0.1)
    np.testing.assert_allclose(
        [*one.p_values.values()], [*verdicts(bank)[0].p_values.values()], rtol=1e-9
    )
    with pytest.raises(SettingError, match="verdicts for a bank"):
        verdict(bank)
    wrong: dict[str, Any]
    for wrong in ({"level": 0.0}, {"window": 1}, {"settle": 1e9}):
        with pytest.raises(SettingError):
            verdict(out, **wrong)
    with pytest.raises(SettingError, match="at least 1 step"):
        inconsistent(out, window=0)


def test_a_transient_that_ends_on_the_other_side():
    """NIS far too large at first and too small afterwards, with no window between."""
    z = np.random.default_rng(1).normal(size=(400, 2, 2)) * np.array([0.3, 3.0])
    z[:100] = np.array([3.0, 0.3]) * z[:100] / np.array([0.3, 3.0])
    for found, sign in zip(
        judge_innovations(z, np.ones_like(z, bool), np.ones((400, 2), bool), 0.1),
        (1, -1),
        strict=True,
    ):
        assert found.settling_time == pytest.approx(10.0)
        assert (found.initial_nis > 1) == (found.settled_nis < 1) == (sign > 0)
        assert "From 10 s" not in found.explanation
        assert "In the settled part, from 10 s on" in found.explanation
        assert ("smaller than" if sign > 0 else "larger than") in found.explanation
    # all windows on one side: no settled part
    found = judge_innovations(z[:100], np.ones((100, 2, 2), bool), np.ones((100, 2), bool), 0.1)
    assert all(
        v.settling_time == 0 and "No window of the first half" in v.explanation for v in found
    )


def test_failed():
    """A lost covariance is said, with its time."""
    z = np.random.default_rng(0).normal(size=(100, 2, 1))
    ok = (np.arange(100) < 60)[:, None]
    (found,) = judge_innovations(np.where(ok[:, None], z, np.nan), np.ones_like(z, bool), ok, 0.1)
    assert found.status == "failed"
    assert "lost its covariance at 6.1 s" in found.explanation


# --- the quadrotor: what an independent check found visible, 60 seeds of 2 s


SEEDS = 60


@pytest.fixture(scope="module")
def quadrotor(optimised):
    """Healthy records of case 8 and a consistent filter."""
    return simulate_case(8, seeds=SEEDS), consistent_tuning(8)


def of(tuning, y, u):
    found = filter_bank(
        tuning.model, tuning.prior, jnp.asarray(y), u=u, dt=1e-3, method=tuning.method
    )
    return verdicts(found, names=tuning.model.sensor.names)


@pytest.mark.slow
def test_wrong_measurements_of_the_quadrotor(quadrotor):
    record, tuning = quadrotor
    y, deviation = np.asarray(record.y), np.sqrt(PART_III.value("true.R"))[:, None]
    rng = np.random.default_rng(8)
    hit = rng.uniform(size=y.shape) < 0.05
    large = 20 * deviation * rng.normal(size=y.shape)
    for wrong in (y + 0.5, y + 0.05, np.where(hit, y + large, y)):
        assert share(of(tuning, wrong, record.u)) >= 0.95
    missing = np.where(rng.uniform(size=y.shape) < 0.3, np.nan, y)
    assert share(of(tuning, missing, record.u)) <= 0.06
    # thrust 20 % and 5 % more than the filter is told
    assert share(of(tuning, y, record.u / 1.2)) >= 0.95
    assert share(of(tuning, y, record.u / 1.05)) >= 0.95
    # the model with a fixed centre of mass
    assert share(of(consistent_tuning(1), y, record.u)) >= 0.95


@pytest.mark.slow
def test_wrong_parameters_of_the_quadrotor(quadrotor):
    _, tuning = quadrotor
    value = lambda name: np.array(PART_III.value(name))
    for wrong in (
        {"true.R": (10 * value("true.R")).tolist()},
        {"true.R": (value("true.R") / 10).tolist()},
        {"true.Q": (10 * value("true.Q")).tolist()},
        {"inertia": (1.2 * value("inertia")).tolist()},
    ):
        record = simulate_case(8, seeds=SEEDS, parameters=PART_III.replaced(wrong))
        assert share(of(tuning, record.y, record.u)) >= 0.95


@pytest.mark.slow
def test_report_tuning_is_seen_through(quadrotor):
    """Its lag hides below too large an R, where the one-sided flag is silent."""
    record, _ = quadrotor
    tuning = report_tuning("observable")
    found = of(tuning, record.y, record.u)
    assert share(found) == 1.0
    assert all({"start", "size", "memory"} <= set(v.significant_tests) for v in found)
    assert all("its lag hides below" in v.explanation for v in found)
    assert all(0.3 < v.settling_time < 1.1 and v.settled_nis < 1 for v in found)


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_false_alarms_of_the_quadrotor():
    """0.5 to 2 % of 1,000 healthy records of 1 s, case 4."""
    record, tuning = simulate_case(4, seeds=1000, t1=1.0, seed=100), consistent_tuning(4)
    assert 0.005 <= share(of(tuning, record.y, record.u)) <= 0.02
