"""Records in the forms that users have, and numbers in them that are not finite."""

from typing import cast

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.estimation.filter import EstimationError, Filtered, filter_bank, kalman_filter
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.likelihood import record_likelihood, standard_errors, tune
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.observable import observability
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.estimation.records import as_numbers, step_lengths
from stmuav_jax.math.space import Composite, Concatenated, CyclicVector, Rotation, Vector

COUNT = 12
STEP = lambda x, u, dt: x + dt * jnp.stack([x[1], u[0]])
SENSOR = Sensor(lambda x, u: x, np.diag([0.01, 0.04]), names=("height", "speed"))
SECOND = StateSpaceModel(STEP, np.diag([1e-4, 0.01]), SENSOR, noise_per="second")
STEPWISE = StateSpaceModel(STEP, np.diag([1e-4, 0.01]), SENSOR)
PRIOR = gaussian([0.0, 0.0], np.eye(2))
rng = np.random.default_rng(0)
Y, U = rng.normal(size=(COUNT, 2)), rng.normal(size=(COUNT, 1))
Y[3, 1] = np.nan
T = np.cumsum(np.r_[0.0, rng.uniform(0.05, 0.2, COUNT)])
EXPECTED = kalman_filter(SECOND, PRIOR, Y, u=U, t=T)


def same(out, tol=1e-12):
    np.testing.assert_allclose(out.mean, EXPECTED.mean, rtol=0, atol=tol)
    np.testing.assert_allclose(out.factor, EXPECTED.factor, rtol=0, atol=tol)
    assert int(out.missing) == 1


MASKED = np.ma.masked_equal(np.where(np.isnan(Y), -999.0, Y), -999.0)
TABLE = pd.DataFrame(Y, columns=["height", "speed"])
NONE = [[None if np.isnan(v) else float(v) for v in row] for row in Y]


@pytest.mark.parametrize(
    "y", [MASKED, list(MASKED), TABLE, TABLE.convert_dtypes(), NONE], ids=lambda y: type(y).__name__
)
def test_measurements_of_any_form_are_the_same_record(y):
    same(kalman_filter(SECOND, PRIOR, y, u=U, t=T))


@pytest.mark.parametrize(
    "u", [pd.DataFrame(U), U.tolist(), np.ma.array(U)], ids=lambda u: str(type(u))
)
def test_inputs_of_any_form_are_the_same_record(u):
    same(kalman_filter(SECOND, PRIOR, Y, u=u, t=T))


START = pd.Timestamp("2026-11-25 10:00", tz="Asia/Seoul")
DATES = pd.DatetimeIndex([START + pd.Timedelta(round(1e6 * s), "us") for s in T])


@pytest.mark.parametrize(
    "t",
    [
        T.tolist(),
        pd.Series(T),
        DATES,
        pd.Series(DATES),
        DATES.tz_convert(None).to_numpy(),
        list(DATES.to_pydatetime()),
        pd.to_timedelta(T, unit="s"),
        1.7e9 + T,
    ],
    ids=[
        "list",
        "Series",
        "dates",
        "dates of a table",
        "datetime64",
        "datetime",
        "durations",
        "epoch",
    ],
)
def test_times_of_any_form_have_the_same_steps(t):
    """Dates round to 1e-6 s, numbers of 1.7e9 s to 2.4e-7 s."""
    np.testing.assert_allclose(step_lengths(None, t, COUNT, float), np.diff(T), rtol=0, atol=2e-6)


def test_times_are_differenced_before_they_become_single_precision():
    """Steps of 0.01 s at 1.7e9 s, which single precision resolves to 128 s."""
    t = 1.7e9 + 0.01 * np.arange(101)
    found = step_lengths(None, t, 100, jnp.float32)
    np.testing.assert_allclose(found, 0.01, rtol=0, atol=3e-7)
    for coarse in (t.astype(np.float32), jnp.asarray(t, jnp.float32), np.float32(1e5 + t - 1.7e9)):
        with pytest.raises(SettingError, match=r"precision .float32. is too coarse"):
            step_lengths(None, coarse, 100, float)
    # up to 100 s it resolves 8e-6 s, and that will do
    step_lengths(None, (t - 1.7e9).astype(np.float32), 100, float)


@pytest.mark.parametrize(
    ("t", "words"),
    [
        (np.where(np.arange(COUNT + 1) == 5, np.nan, T), "number 5 is nan"),
        (pd.DatetimeIndex([*DATES[:7], pd.NaT, *DATES[8:]]), "number 7 is nan"),
        (np.r_[T[:4], T[3] - 1.0, T[5:]], r"must not decrease.*number 4"),
        ([str(v) for v in T], "the text '0.0'"),
    ],
)
def test_times_that_cannot_be_used_are_named_by_their_index(t, words):
    with pytest.raises(SettingError, match=words) as caught:
        kalman_filter(SECOND, PRIOR, Y, u=U, t=t)
    assert len(str(caught.value)) < 250


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([["0,95", "1,0"]], r"entry \(0, 0\) is '0,95'.*decimal commas"),
        (np.array([[1.0, 2.0]]) + 1j, "must be numbers, but entry"),
        (np.array([["2026-11-25"]], "datetime64[D]"), "must be numbers, but entry"),
        ([[1.0], [1.0, 2.0]], "rows have different lengths"),
        ([[{}]], "must be numbers, but entry"),
    ],
)
def test_entries_that_are_no_numbers_are_refused_by_their_index(value, words):
    """In one sentence of the package, at every entrance."""
    calls = [
        lambda: kalman_filter(SECOND, PRIOR, value, u=U, t=T),
        lambda: filter_bank(SECOND, PRIOR, value, u=U, t=T),
        lambda: record_likelihood(lambda _: SECOND, None, PRIOR, value, u=U, t=T),
        lambda: tune(lambda _: SECOND, 1.0, PRIOR, value, u=U, t=T),
        lambda: standard_errors(lambda _: SECOND, 1.0, PRIOR, value, u=U, t=T),
        lambda: OnlineFilter(SECOND, PRIOR).step(value, 1.0, [1.0]),
    ]
    for call in calls:
        with pytest.raises(ModelError, match=words):
            call()


def test_lists_are_accepted_everywhere():
    bank = filter_bank(SECOND, PRIOR, Y[..., None].tolist(), u=U.tolist(), t=T.tolist())
    np.testing.assert_allclose(bank.mean[..., 0], EXPECTED.mean, rtol=0, atol=1e-12)
    seen = observability(SECOND, [0.0, 0.0], u=U.tolist(), dt=0.1, count=COUNT)
    assert seen.rank == 2
    value = record_likelihood(lambda _: SECOND, None, PRIOR, NONE, u=U.tolist(), t=T.tolist())
    np.testing.assert_allclose(value, EXPECTED.log_likelihood, rtol=1e-12)
    online = OnlineFilter(SECOND, PRIOR)
    for k in range(COUNT):
        online.step(MASKED[k] if k % 2 else NONE[k], T[k + 1], U[k].tolist())
    np.testing.assert_allclose(online.state.mean, EXPECTED.mean[-1], rtol=0, atol=1e-12)
    assert online.missing == 1


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"y": np.where(np.arange(2) == 1, np.inf, 0.0)}, "the measurement of speed is inf"),
        ({"u": [np.nan]}, "input 0 is nan, and the filter cannot run with it"),
        ({"u": [-np.inf]}, "input 0 is -inf"),
    ],
)
def test_numbers_that_are_not_finite_are_named(change, words):
    """With the step; a filter that does not raise flags it, a search and the online filter refuse."""
    y, u = Y.copy(), U.copy()
    {"y": y, "u": u}[next(iter(change))][7] = next(iter(change.values()))
    with pytest.raises(EstimationError, match=f"measurement 7 .*{words}") as caught:
        kalman_filter(SECOND, PRIOR, y, u=u, t=T)
    assert cast(Filtered, caught.value.filtered).ok.tolist() == [True] * 7 + [False] * 5
    for call in (tune, standard_errors):
        with pytest.raises(SettingError, match=f"step 7 {words}"):
            call(lambda _: SECOND, 1.0, PRIOR, y, u=u, t=T)
    online = OnlineFilter(SECOND, PRIOR)
    with pytest.raises(EstimationError, match=f"measurement 0: {words}"):
        online.step(y[7], 1.0, u[7])
    # it goes on
    online.step(Y[0], 1.0, U[0])


def test_infinite_angle_is_no_missing_one():
    model = StateSpaceModel(
        lambda x, u, dt: x,
        np.eye(1),
        Sensor(lambda x, u: x, np.eye(1), space=CyclicVector((True,))),
        space=CyclicVector((True,)),
    )
    with pytest.raises(EstimationError, match=r"measurement 1 .*the measurement of y0 is inf"):
        kalman_filter(model, gaussian([0.0], [[1.0]]), [[0.1], [np.inf]], dt=1.0)


def test_rows_of_one_time_add_process_noise_once():
    """A log with a row for each sensor and time is the table with a row for each time, by step too."""
    rows = np.full((2 * COUNT, 2), np.nan)
    rows[::2, 0], rows[1::2, 1] = Y[:, 0], Y[:, 1]
    t = 0.1 * np.r_[0.0, np.repeat(np.arange(1, COUNT + 1), 2)]
    for model in (SECOND, STEPWISE):
        long = kalman_filter(model, PRIOR, rows, u=np.repeat(U, 2, axis=0), t=t)
        wide = kalman_filter(model, PRIOR, Y, u=U, dt=0.1)
        np.testing.assert_allclose(long.mean[1::2], wide.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(long.covariance[1::2], wide.covariance, rtol=0, atol=1e-12)


def test_noise_per_step_along_different_steps_is_said():
    with pytest.warns(UserWarning, match="noise_per='second'"):
        kalman_filter(STEPWISE, PRIOR, Y, u=U, t=T)
    online = OnlineFilter(STEPWISE, PRIOR)
    online.step(Y[0], 0.1, U[0])
    online.step(Y[1], 0.2, U[1])
    with pytest.warns(UserWarning, match=r"0.1 to 0.5 s add the same"):
        online.step(Y[2], 0.7, U[2])
    # once
    online.step(Y[3], 1.7, U[3])


def test_traced_times_that_go_backwards_are_flagged():
    t = np.r_[T[:6], T[5] - 0.01, T[7:]]
    run = jax.jit(lambda t: kalman_filter(SECOND, PRIOR, Y, u=U, t=t, throw=False).ok)
    assert run(T).tolist() == [True] * COUNT
    assert run(t).tolist() == [True] * 5 + [False] * (COUNT - 5)
    assert not run(np.where(np.arange(COUNT + 1) == 5, np.nan, T))[-1]


def attitude():
    """Rotation that wanders, measured with a number beside it."""
    sensor = Sensor(
        lambda x, u: jnp.concatenate([jnp.zeros(1), x["p"]]),
        1e-4 * np.eye(4),
        space=Concatenated(Vector(1), Rotation()),
        names=("n", "phi", "theta", "psi"),
    )
    return StateSpaceModel(
        lambda x, u, dt: x, 1e-4 * np.eye(3), sensor, space=Composite(p=Rotation())
    )


def test_rounded_euler_parameters_are_normalised_and_zeros_are_missing():
    """A norm of 0.98 is no rotation."""
    model, prior = attitude(), gaussian({"p": jnp.eye(4)[0]}, 0.1 * np.eye(3))
    p = np.random.default_rng(1).normal(size=(6, 4)) * 0.1 + np.eye(4)[0]
    p /= np.linalg.norm(p, axis=1)[:, None]
    y = np.concatenate([np.zeros((6, 1)), p], axis=1)
    rounded, scaled = np.round(y, 3), y * np.r_[1.0, 4 * [1.009]]
    run = lambda y: kalman_filter(model, prior, y, dt=1.0, throw=False)
    out = run(y)
    np.testing.assert_allclose(run(rounded).mean["p"], out.mean["p"], rtol=0, atol=1e-3)
    np.testing.assert_allclose(run(scaled).mean["p"], out.mean["p"], rtol=0, atol=1e-14)
    nothing = y.copy()
    nothing[2, 1:] = 0.0
    assert int(run(nothing).missing) == 3
    nothing[2, 1:] = y[2, 1:] * 0.98
    assert run(nothing).ok.tolist() == [True] * 2 + [False] * 4
    with pytest.raises(EstimationError, match=r"measurement 2 .*not of unit length within 0.01"):
        kalman_filter(model, prior, nothing, dt=1.0)


def test_masks_of_integers_and_nested_lists_are_kept():
    found = as_numbers(np.ma.masked_equal([[1, -999], [3, 4]], -999), "Measurements")
    np.testing.assert_array_equal(found, [[1.0, np.nan], [3.0, 4.0]])
    found = as_numbers([[1.0, np.ma.masked], [pd.NA, None]], "Measurements")
    np.testing.assert_array_equal(found, [[1.0, np.nan], [np.nan, np.nan]])
