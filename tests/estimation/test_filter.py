"""Filters on linear systems against the textbook; D1, D4, D8 of the reference figures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear import Product, random_linear, textbook, textbook_smoother
from scipy.stats import multivariate_normal

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.filter import (
    DEFAULT,
    AbstractFilter,
    EstimationError,
    GaussianFilter,
    filter_bank,
    kalman_filter,
)
from stmuav_jax.estimation.gaussians import Gaussian, gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.estimation.sigma import AbstractRule
from stmuav_jax.estimation.smoother import smooth

CASE = random_linear()
MEANS, COVARIANCES, LIKELIHOOD, NIS = textbook(CASE)
SMALL = random_linear(seed=1, n=3, m=2, count=12)


@pytest.fixture(scope="module")
def whole():
    return kalman_filter(CASE.model(), CASE.prior(), CASE.y, dt=1.0)


@pytest.mark.parametrize(
    ("rule", "form", "tol"),
    [
        (sigma.Cubature(), "square_root", 1e-10),
        (sigma.Linearised(), "square_root", 1e-10),
        # rounding of the function itself, over alpha^2 n: no form can be better
        (sigma.Unscented(1e-3), "square_root", 1e-9),
        (sigma.Unscented(1.0, 0.0, -3.0), "square_root", 1e-10),
        (sigma.Unscented(1e-3), "covariance", 1e-9),
    ],
    ids=str,
)
def test_linear_system_is_a_kalman_filter(rule, form, tol):
    """D1: full random Q, R, P0, 200 steps; with kappa = -3 a central weight is negative."""
    out = kalman_filter(
        CASE.model(), CASE.prior(), CASE.y, dt=1.0, method=GaussianFilter(rule, form)
    )
    np.testing.assert_allclose(out.mean, MEANS, rtol=0, atol=tol)
    np.testing.assert_allclose(out.covariance, COVARIANCES, rtol=0, atol=tol)
    np.testing.assert_allclose(out.nis, NIS, rtol=0, atol=1e3 * tol)
    np.testing.assert_allclose(out.log_likelihood, LIKELIHOOD, rtol=max(tol, 1e-10))


def test_fifth_degree():
    fifth = GaussianFilter(sigma.Cubature5())
    out = kalman_filter(SMALL.model(), SMALL.prior(), SMALL.y, dt=1.0, method=fifth)
    np.testing.assert_allclose(out.mean, textbook(SMALL)[0], rtol=0, atol=1e-10)
    with pytest.raises(SettingError, match="negative weights for n = 6"):
        kalman_filter(CASE.model(), CASE.prior(), CASE.y, dt=1.0, method=fifth)


def test_invariants_and_likelihood(whole):
    """D8: symmetric exactly, no negative eigenvalue, likelihood a sum of log-densities."""
    P = np.asarray(whole.covariance)
    assert np.array_equal(P, np.swapaxes(P, 1, 2))
    least = np.linalg.eigvalsh(P)[:, 0]
    assert np.all(least >= -1e-14 * np.trace(P, axis1=1, axis2=2))
    error, L = np.asarray(whole.innovations.error), np.asarray(whole.innovations.factor)
    each = [
        multivariate_normal(cov=root @ root.T).logpdf(e) for e, root in zip(error, L, strict=True)
    ]
    np.testing.assert_allclose(whole.log_likelihood, np.sum(each), rtol=1e-12)


@pytest.mark.parametrize("form", ["square_root", "covariance"])
def test_missing_measurements(form):
    """Whole and single ones, with correlated noise; all missing is prediction only."""
    y = CASE.y.copy()
    y[5:9] = np.nan
    y[20, 1] = np.nan
    y[30, 0] = y[31, 2] = np.nan
    means, covariances, likelihood, _ = textbook(CASE, y)
    out = kalman_filter(CASE.model(), CASE.prior(), y, dt=1.0, method=GaussianFilter(form=form))
    np.testing.assert_allclose(out.mean, means, rtol=0, atol=1e-10)
    np.testing.assert_allclose(out.covariance, covariances, rtol=0, atol=1e-10)
    np.testing.assert_allclose(out.log_likelihood, likelihood, rtol=1e-10)
    assert int(out.missing) == 15


def test_sequential_measurements_in_any_order():
    """Sensors of independent noise one by one: order does not matter, nor being together."""
    variances, model, y = np.array([0.3, 0.5, 0.2]), SMALL.model(), jnp.array([0.1, -0.2, 0.3])
    H = jnp.asarray(np.random.default_rng(4).normal(size=(3, 3)))
    update = jax.jit(lambda g, y, sensor: DEFAULT.update(g, y, sensor, model=model)[0])
    first = jax.jit(lambda g: DEFAULT.predict(model, g))(SMALL.prior())
    together = update(first, y, Sensor(Product(H), np.diag(variances)))
    for order in ([0, 1, 2], [2, 0, 1]):
        state = first
        for i in order:
            state = update(state, y[i : i + 1], Sensor(Product(H[i : i + 1]), [[variances[i]]]))
        np.testing.assert_allclose(state.mean, together.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(state.covariance, together.covariance, rtol=0, atol=1e-12)


def pendulum():
    dt, g = 0.0125, 9.8
    Q = 0.01 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    k = np.arange(1, 201)
    y = np.sin(1.2 * np.cos(2.8 * k * dt)) + 0.1 * np.sin(7 * k)

    def step(x, u, dt):
        return jnp.stack([x[0] + x[1] * dt, x[1] - g * jnp.sin(x[0]) * dt])

    model = StateSpaceModel(step, Q, Sensor(lambda x, u: jnp.sin(x[:1]), [[0.1]]), stacked=True)
    return model, gaussian([1.5, 0.0], 0.1 * np.eye(2)), y[:, None], dt


def test_pendulum():
    """D4: the first step."""
    model, prior, y, dt = pendulum()
    method = GaussianFilter(sigma.Unscented(1.0, 2.0, 1.0))
    out = kalman_filter(model, prior, y[:1], dt=dt, method=method)
    mean, P = np.asarray(out.mean[0]), np.asarray(out.covariance[0])
    np.testing.assert_allclose(mean, (1.5029754602711, -0.11622200002662), rtol=0, atol=1e-10)
    expected = (0.099604026563276, 0.00042517479266623, 0.10027379155236)
    np.testing.assert_allclose(P[[0, 0, 1], [0, 1, 1]], expected, rtol=0, atol=1e-10)


def test_forms_agree_where_the_system_is_not_linear():
    model, prior, y, dt = pendulum()
    for rule in (sigma.Unscented(0.5, 0.0, -1.5), sigma.Cubature5()):
        a, b = (
            kalman_filter(model, prior, y, dt=dt, method=GaussianFilter(rule, form))
            for form in ("square_root", "covariance")
        )
        np.testing.assert_allclose(a.mean, b.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)


@pytest.mark.slow
def test_smoother(whole):
    smoothed = smooth(CASE.model(), whole)
    m, P = textbook_smoother(CASE, MEANS, COVARIANCES)
    np.testing.assert_allclose(smoothed.mean, m, rtol=0, atol=1e-11)
    np.testing.assert_allclose(smoothed.covariance, P, rtol=0, atol=1e-11)
    # the downdate's way, with a negative weight
    other = smooth(CASE.model(), whole, rule=sigma.Unscented(1.0, 0.0, -3.0))
    np.testing.assert_allclose(other.covariance, P, rtol=0, atol=1e-11)


def test_bank_is_many_single_filters():
    """In groups of two, of which the last is filled up, and under `vmap`."""
    y = SMALL.y[:, :, None] + 0.1 * np.random.default_rng(5).normal(size=(12, 2, 5))
    y[3, 1, 2] = np.nan
    model, y = SMALL.model(), jnp.asarray(y)
    bank = filter_bank(model, SMALL.prior(), y, dt=1.0, group=2)
    assert bank.mean.shape == (12, 3, 5)

    def single(y):
        one = kalman_filter(model, SMALL.prior(), y, dt=1.0)
        return one.mean, one.factor, one.nis

    many = jax.jit(jax.vmap(single, in_axes=-1, out_axes=-1))(y)
    np.testing.assert_allclose(bank.mean, many[0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(bank.factor, many[1], rtol=0, atol=1e-12)
    np.testing.assert_allclose(bank.nis, many[2], rtol=0, atol=1e-10)


def test_online_is_the_same_filter():
    model = SMALL.model()
    out = kalman_filter(model, SMALL.prior(), SMALL.y, t=np.arange(13) * 0.1)
    online = OnlineFilter(model, SMALL.prior())
    online.warm_up()
    given = np.array(SMALL.y)
    found = [online.step(given[k], t=0.1 * (k + 1)) for k in range(12)]
    # what was returned before stays as it was, and so does what was given
    for k in range(12):
        np.testing.assert_allclose(found[k].mean, out.mean[k], rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[k].state.factor, out.factor[k], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(given, SMALL.y)
    np.testing.assert_allclose(online.state.mean, out.mean[-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(online.nis, out.nis, rtol=1e-12)
    with pytest.raises(SettingError, match=r"after t = 1.2 s comes 0.4 s"):
        online.step(SMALL.y[5], t=0.4)
    with pytest.raises(ModelError, match="2 components"):
        online.step([1.0, 2.0, 3.0], t=1.3)
    online.step(np.full(2, np.nan), t=1.3)
    assert online.missing == 2


class Fading(AbstractFilter):
    """Kalman filter that forgets: the covariance grows by a factor before each step."""

    growth: float
    rule: AbstractRule = eqx.field(default_factory=sigma.Cubature)

    def step(self, model, before, y, u, dt):
        wider = Gaussian(before.mean, jnp.sqrt(self.growth) * before.factor)
        return DEFAULT.step(model, wider, y, u, dt)


def test_a_filter_of_ones_own_is_one_class():
    """A single one and the online filter take it; against the equations in NumPy."""
    case, fading = SMALL, Fading(growth=1.3)
    out = kalman_filter(case.model(), case.prior(), case.y, dt=1.0, method=fading)
    m, P = case.m0, case.P0
    for y, mean, covariance in zip(case.y, out.mean, out.covariance, strict=True):
        m, P = case.F @ m, 1.3 * case.F @ P @ case.F.T + case.Q
        K = P @ case.H.T @ np.linalg.inv(case.H @ P @ case.H.T + case.R)
        m, P = m + K @ (y - case.H @ m), P - K @ case.H @ P
        np.testing.assert_allclose(mean, m, rtol=0, atol=1e-12)
        np.testing.assert_allclose(covariance, P, rtol=0, atol=1e-12)
    online = OnlineFilter(case.model(), case.prior(), method=fading)
    for k in range(12):
        online.step(case.y[k], t=float(k + 1))
    np.testing.assert_allclose(online.state.mean, out.mean[-1], rtol=0, atol=1e-14)


def test_an_estimate_outside_the_record_is_refused(whole):
    count = len(CASE.y)
    np.testing.assert_array_equal(whole.at(-count).mean, whole.mean[0])
    for k in (count, -count - 1):
        with pytest.raises(SettingError, match=f"no estimate {k}: the record has {count} meas"):
            whole.at(k)


# --- bad input


def test_single_precision_refuses_a_small_alpha():
    """D1 in single precision: 1e-4 for alpha >= 0.1, refused below."""
    single = lambda a: jnp.asarray(a, jnp.float32)
    F, H = single(CASE.F), single(CASE.H)
    R, Q, P0 = (np.asarray(a, np.float32) for a in (CASE.R, CASE.Q, CASE.P0))
    model = StateSpaceModel(lambda x, u, dt: F @ x, Q, Sensor(lambda x, u: H @ x, R))
    prior = gaussian(single(CASE.m0), P0)
    assert prior.factor.dtype == jnp.float32
    with pytest.raises(SettingError, match=r"alpha = 0.001 is too small for float32"):
        kalman_filter(model, prior, CASE.y, dt=1.0, method=GaussianFilter(sigma.Unscented(1e-3)))
    method = GaussianFilter(sigma.Unscented(0.1))
    out = kalman_filter(model, prior, CASE.y, dt=1.0, method=method)
    np.testing.assert_allclose(out.mean, MEANS, rtol=0, atol=1e-4)


def test_lost_covariance_is_flagged_not_nan():
    """The state becomes NaN at the fourth step: last good estimate, infinite NIS, message."""

    def step(x, u, dt):
        return jnp.where(u[0] > 2.5, jnp.nan, 1.0) * x

    model = StateSpaceModel(step, np.eye(2), Sensor(lambda x, u: x, np.eye(2)), stacked=True)
    prior, y = gaussian(np.zeros(2), np.eye(2)), np.ones((6, 2))
    u = np.arange(6.0)[:, None]
    with pytest.raises(EstimationError, match=r"measurement 3 \(after 4 s\)"):
        kalman_filter(model, prior, y, u=u, dt=1.0)
    out = kalman_filter(model, prior, y, u=u, dt=1.0, throw=False)
    assert np.asarray(out.ok).tolist() == [True] * 3 + [False] * 3
    assert np.all(np.isfinite(out.mean))
    assert np.all(np.isfinite(out.factor))
    assert np.asarray(np.isinf(out.nis)).tolist() == [False] * 3 + [True] * 3
    np.testing.assert_array_equal(out.mean[-1], out.mean[2])


D5 = np.array(
    [
        [0.05201447, 0.02882126, -0.00569971, -0.00733617],
        [0.02882126, 0.01642966, -0.00862847, -0.00673035],
        [-0.00569971, -0.00862847, 0.06570757, 0.03251551],
        [-0.00733617, -0.00673035, 0.03251551, 0.01648615],
    ]
)


def test_bad_covariances_are_named():
    """D5 and others: the matrix's name, and its eigenvalue."""
    with pytest.raises(ModelError, match=r"P0 must be positive semi-definite.*-3\.157e-09"):
        gaussian(np.zeros(4), D5)
    with pytest.raises(ModelError, match=r"R must be symmetric"):
        Sensor(lambda x, u: x, [[1.0, 0.5], [0.0, 1.0]])
    with pytest.raises(ModelError, match=r"Q must be finite"):
        StateSpaceModel(lambda x, u, dt: x, [[np.nan]], Sensor(lambda x, u: x, [[1.0]]))
    with pytest.raises(ModelError, match=r"mean that belongs to P0 must have 4"):
        gaussian(np.zeros(3), np.eye(4))
    # inside jit nothing can be looked at: a flag
    assert np.any(np.isnan(jax.jit(lambda P: gaussian(jnp.zeros(4), P).factor)(D5)))


def test_singular_covariance_is_allowed():
    """States that are known, and states without process noise."""
    case = SMALL._replace(Q=np.diag([0.1, 0.0, 0.0]), P0=np.diag([1.0, 0.0, 0.5]))
    out = kalman_filter(case.model(), case.prior(), case.y, dt=1.0)
    np.testing.assert_allclose(out.mean, textbook(case)[0], rtol=0, atol=1e-11)
