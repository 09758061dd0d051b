"""Filters on linear systems against the textbook; D1, D4, D8 of the reference figures."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear import random_linear, textbook, textbook_smoother

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.bank import filter_bank
from stmuav_jax.estimation.filter import EstimationError, kalman_filter
from stmuav_jax.estimation.gaussians import Gaussian, gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.estimation.sigma import AbstractRule
from stmuav_jax.estimation.smoother import smooth
from stmuav_jax.estimation.update import DEFAULT, AbstractFilter, GaussianFilter, ReusingFilter

CASE = random_linear()
MEANS, COVARIANCES, LIKELIHOOD, NIS = textbook(CASE)


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
    case = random_linear(seed=1, n=3, m=2, count=50)
    fifth = GaussianFilter(sigma.Cubature5())
    out = kalman_filter(case.model(), case.prior(), case.y, dt=1.0, method=fifth)
    np.testing.assert_allclose(out.mean, textbook(case)[0], rtol=0, atol=1e-10)
    with pytest.raises(SettingError, match="negative weights for n = 6"):
        kalman_filter(CASE.model(), CASE.prior(), CASE.y, dt=1.0, method=fifth)


def test_invariants_and_likelihood():
    """D8: symmetric exactly, no negative eigenvalue, likelihood a sum of log-densities."""
    out = kalman_filter(CASE.model(), CASE.prior(), CASE.y, dt=1.0)
    P = np.asarray(out.covariance)
    assert np.array_equal(P, np.swapaxes(P, 1, 2))
    least = np.linalg.eigvalsh(P)[:, 0]
    assert np.all(least >= -1e-14 * np.trace(P, axis1=1, axis2=2))
    error, L = out.innovations.error, out.innovations.factor
    density = jax.scipy.stats.multivariate_normal.logpdf
    each = jax.vmap(lambda e, L: density(e, jnp.zeros_like(e), L @ L.T))(error, L)
    np.testing.assert_allclose(out.log_likelihood, jnp.sum(each), rtol=1e-12)


@pytest.mark.parametrize("form", ["square_root", "covariance"])
def test_missing_measurements(form):
    """Whole and single ones, with correlated noise; all missing is prediction only."""
    y = CASE.y[:40].copy()
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
    H = jnp.asarray(CASE.H)
    variances = np.array([0.3, 0.5, 0.2])
    alone = [Sensor(lambda x, u, i=i: H[i : i + 1] @ x, [[variances[i]]]) for i in range(3)]
    whole = Sensor(lambda x, u: H @ x, np.diag(variances))
    model, y = CASE.model(), jnp.asarray(CASE.y[0])
    first = jax.jit(lambda g: DEFAULT.predict(model, g))(CASE.prior())
    together = jax.jit(lambda g: DEFAULT.update(g, y, whole, model=model)[0])(first)

    @jax.jit
    def one_by_one(state, order):
        for i in range(3):
            # the sensor of this turn, chosen without compiling another program
            branches = [
                lambda g, i=i: DEFAULT.update(g, y[i : i + 1], alone[i], model=model)[0]
                for i in range(3)
            ]
            state = jax.lax.switch(order[i], branches, state)
        return state

    for order in ([0, 1, 2], [2, 0, 1]):
        state = one_by_one(first, jnp.array(order))
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


@pytest.mark.parametrize(
    ("kind", "mean", "P"),
    [
        (
            GaussianFilter,
            (1.5029754602711, -0.11622200002662),
            (0.099604026563276, 0.00042517479266623, 0.10027379155236),
        ),
        (ReusingFilter, (1.5029755883481, -0.11673295239971), None),
    ],
)
def test_pendulum(kind, mean, P):
    """D4: the first step by both conventions."""
    model, prior, y, dt = pendulum()
    method = kind(sigma.Unscented(1.0, 2.0, 1.0))
    out = kalman_filter(model, prior, y, dt=dt, method=method)
    np.testing.assert_allclose(out.mean[0], mean, rtol=0, atol=1e-10)
    if P:
        found = np.asarray(out.covariance[0])
        np.testing.assert_allclose(found[[0, 0, 1], [0, 1, 1]], P, rtol=0, atol=1e-10)


def test_forms_agree_where_the_system_is_not_linear():
    model, prior, y, dt = pendulum()
    for kind, rule in (
        (GaussianFilter, sigma.Unscented(0.5, 0.0, -1.5)),
        (ReusingFilter, sigma.Cubature5()),
    ):
        a = kalman_filter(model, prior, y, dt=dt, method=kind(rule))
        b = kalman_filter(model, prior, y, dt=dt, method=kind(rule, "covariance"))
        np.testing.assert_allclose(a.mean, b.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)


def test_smoother():
    out = kalman_filter(CASE.model(), CASE.prior(), CASE.y, dt=1.0)
    smoothed = smooth(CASE.model(), out)
    m, P = textbook_smoother(CASE, MEANS, COVARIANCES)
    np.testing.assert_allclose(smoothed.mean, m, rtol=0, atol=1e-11)
    np.testing.assert_allclose(smoothed.covariance, P, rtol=0, atol=1e-11)
    # the downdate's way, with a negative weight
    other = smooth(CASE.model(), out, rule=sigma.Unscented(1.0, 0.0, -3.0))
    np.testing.assert_allclose(other.covariance, P, rtol=0, atol=1e-11)


def test_bank_is_many_single_filters():
    case = random_linear(n=4, m=2, count=12)
    y = case.y[:, :, None] + 0.1 * np.random.default_rng(5).normal(size=(12, 2, 5))
    y[3, 1, 2] = np.nan
    model, y = case.model(), jnp.asarray(y)
    bank = jax.jit(lambda y: filter_bank(model, case.prior(), y, dt=1.0, group=2))(y)
    single = jax.jit(lambda y: kalman_filter(model, case.prior(), y, dt=1.0))
    assert bank.mean.shape == (12, 4, 5)
    for i in (0, 2, 4):
        one = single(y[..., i])
        np.testing.assert_allclose(bank.mean[..., i], one.mean, rtol=0, atol=1e-12)
        np.testing.assert_allclose(bank.factor[..., i], one.factor, rtol=0, atol=1e-12)
        np.testing.assert_allclose(bank.nis[..., i], one.nis, rtol=0, atol=1e-10)
    mapped = jax.jit(jax.vmap(lambda y: single(y).mean))(jnp.moveaxis(y, -1, 0))
    np.testing.assert_allclose(jnp.moveaxis(bank.mean, -1, 0), mapped, rtol=0, atol=1e-12)


def test_online_is_the_same_filter():
    model = CASE.model()
    out = kalman_filter(model, CASE.prior(), CASE.y[:5], t=np.arange(6) * 0.1)
    online = OnlineFilter(model, CASE.prior())
    online.warm_up()
    given = np.array(CASE.y)
    found = [online.step(given[k], t=0.1 * (k + 1)) for k in range(5)]
    # what was returned before stays as it was, and so does what was given
    for k in range(5):
        np.testing.assert_allclose(found[k].mean, out.mean[k], rtol=0, atol=1e-14)
        np.testing.assert_allclose(found[k].state.factor, out.factor[k], rtol=0, atol=1e-14)
    np.testing.assert_array_equal(given, CASE.y)
    np.testing.assert_allclose(online.state.mean, out.mean[-1], rtol=0, atol=1e-14)
    np.testing.assert_allclose(online.nis, out.nis, rtol=1e-12)
    with pytest.raises(SettingError, match=r"after t = 0.5 s comes 0.4 s"):
        online.step(CASE.y[5], t=0.4)
    with pytest.raises(ModelError, match="3 components"):
        online.step([1.0, 2.0], t=0.6)
    online.step(np.full(3, np.nan), t=0.6)
    assert online.missing == 3


class Fading(AbstractFilter):
    """Kalman filter that forgets: the covariance grows by a factor before each step."""

    growth: float
    rule: AbstractRule = eqx.field(default_factory=sigma.Cubature)

    def step(self, model, before, y, u, dt):
        wider = Gaussian(before.mean, jnp.sqrt(self.growth) * before.factor)
        return DEFAULT.step(model, wider, y, u, dt)


def test_a_filter_of_ones_own_is_one_class():
    """A single one, banks and the online filter take it; against the equations in NumPy."""
    case, fading = random_linear(n=3, m=2, count=6), Fading(growth=1.3)
    out = kalman_filter(case.model(), case.prior(), case.y, dt=1.0, method=fading)
    m, P = case.m0, case.P0
    for y, mean, covariance in zip(case.y, out.mean, out.covariance, strict=True):
        m, P = case.F @ m, 1.3 * case.F @ P @ case.F.T + case.Q
        K = P @ case.H.T @ np.linalg.inv(case.H @ P @ case.H.T + case.R)
        m, P = m + K @ (y - case.H @ m), P - K @ case.H @ P
        np.testing.assert_allclose(mean, m, rtol=0, atol=1e-12)
        np.testing.assert_allclose(covariance, P, rtol=0, atol=1e-12)
    y = jnp.asarray(case.y)
    bank = filter_bank(case.model(), case.prior(), y[..., None], dt=1.0, method=fading)
    np.testing.assert_allclose(bank.mean[..., 0], out.mean, rtol=0, atol=1e-12)
    online = OnlineFilter(case.model(), case.prior(), method=fading)
    for k in range(6):
        online.step(case.y[k], t=float(k + 1))
    np.testing.assert_allclose(online.state.mean, out.mean[-1], rtol=0, atol=1e-14)


class Watched(AbstractFilter):
    """Kalman filter that notes how many filters it runs side by side."""

    widths: list = eqx.field(static=True)
    rule: AbstractRule = eqx.field(default_factory=sigma.Cubature)

    def step(self, model, before, y, u, dt):
        self.widths.append(before.factor.shape[2])
        return DEFAULT.step(model, before, y, u, dt)


@pytest.mark.parametrize(("count", "most", "width"), [(5, 4, 3), (50, 32, 25), (3, 64, 3)])
def test_groups_of_a_bank_have_no_more_copies_than_needed(count, most, width):
    """A group that is filled up with copies of a filter costs as much as one of other filters."""
    case, watched = random_linear(n=2, m=1, count=3), Watched(widths=[])
    run = lambda y: (
        filter_bank(case.model(), case.prior(), y, dt=1.0, method=watched, group=most).mean
    )
    out = jax.eval_shape(run, jax.ShapeDtypeStruct((3, 1, count), float))
    assert out.shape == (3, 2, count)
    assert set(watched.widths) == {width}


def test_likelihood_gradient():
    """By R's scale, against central differences."""
    case = random_linear(n=2, m=1, count=6)
    F, H = jnp.asarray(case.F), jnp.asarray(case.H)

    def value(scale):
        sensor = Sensor(lambda x, u: H @ x, jnp.exp(scale) * jnp.asarray(case.R))
        model = StateSpaceModel(lambda x, u, dt: F @ x, case.Q, sensor)
        return kalman_filter(model, case.prior(), case.y, dt=1.0).log_likelihood

    both = jax.jit(jax.value_and_grad(value))
    step = 1e-5
    expected = (both(0.3 + step)[0] - both(0.3 - step)[0]) / (2 * step)
    np.testing.assert_allclose(both(0.3)[1], expected, rtol=1e-7)


# --- bad input


def test_times_and_shapes():
    model, prior = CASE.model(), CASE.prior()
    y = CASE.y[:3]
    with pytest.raises(SettingError, match=r"after t = 1 s comes 0.5 s"):
        kalman_filter(model, prior, y, t=[0.0, 1.0, 0.5, 2.0])
    with pytest.raises(SettingError, match="backwards"):
        kalman_filter(model, prior, y, dt=-0.1)
    with pytest.raises(SettingError, match="either dt"):
        kalman_filter(model, prior, y)
    with pytest.raises(ModelError, match="3 components"):
        kalman_filter(model, prior, y[:, :2], dt=1.0)
    with pytest.raises(ModelError, match="5 x 5"):
        kalman_filter(model, gaussian(np.zeros(5), np.eye(5)), y, dt=1.0)
    with pytest.raises(ModelError, match="T = 3"):
        kalman_filter(model, prior, y, dt=1.0, u=np.zeros((2, 1)))


def test_single_precision_refuses_a_small_alpha():
    """D1 in single precision: 1e-4 for alpha >= 0.1, refused below."""
    single = lambda a: jnp.asarray(a, jnp.float32)
    F, H = single(CASE.F), single(CASE.H)
    R, Q, P0 = (np.asarray(a, np.float32) for a in (CASE.R, CASE.Q, CASE.P0))
    model = StateSpaceModel(lambda x, u, dt: F @ x, Q, Sensor(lambda x, u: H @ x, R))
    prior = gaussian(single(CASE.m0), P0)
    assert prior.factor.dtype == jnp.float32
    with pytest.raises(SettingError, match=r"alpha = 0.001 cannot work in float32"):
        kalman_filter(model, prior, CASE.y, dt=1.0, method=GaussianFilter(sigma.Unscented(1e-3)))
    for rule in (sigma.Unscented(0.1), sigma.Cubature()):
        out = kalman_filter(model, prior, CASE.y, dt=1.0, method=GaussianFilter(rule))
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
    lost = jax.jit(lambda P: gaussian(jnp.zeros(4), P).factor)(D5)
    model = StateSpaceModel(lambda x, u, dt: x, np.eye(4), Sensor(lambda x, u: x[:1], [[1.0]]))
    out = kalman_filter(model, Gaussian(jnp.zeros(4), lost), np.zeros((2, 1)), dt=1.0, throw=False)
    assert not np.any(out.ok)


def test_singular_covariance_is_allowed():
    """States that are known, and states without process noise."""
    case = random_linear(n=4, m=2, count=20)
    case = case._replace(Q=np.diag([0.1, 0.0, 0.2, 0.0]), P0=np.diag([1.0, 0.0, 2.0, 0.5]))
    out = kalman_filter(case.model(), case.prior(), case.y, dt=1.0)
    np.testing.assert_allclose(out.mean, textbook(case)[0], rtol=0, atol=1e-11)
