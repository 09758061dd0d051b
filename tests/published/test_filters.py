"""Published figures of Kalman filters, D1 to D8 (sources with each); the rest is beside the code.

D1, D2, D4, D5, D7 and D8 are in tests/estimation (test_filter, test_sigma); here are what those
do not have: the exactness and the rows of D1, the exact moments of D3, all windows and the power
of D6, the attitude's consistency, D7's residual along a path.
"""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import quad

from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.consistency import autocorrelation, mean_interval, nees
from stmuav_jax.estimation.filter import filter_bank
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.math.compiler import outer_jit
from stmuav_jax.math.rotation import from_rotation_vector, product
from stmuav_jax.math.space import Vector
from stmuav_jax.math.stacked import transposed_multiply
from stmuav_jax.uav.quadrotor.model import attitude_model

# --- D2: weights


@pytest.mark.parametrize(("alpha", "kappa", "n"), [(1.0, 0.0, 1), (1e-3, 2.0, 6), (0.1, 0.1, 8)])
def test_weights(alpha, kappa, n):
    """sum Wm = 1, sum Wc = 1 + (1 - alpha^2 + beta), from pairs and the extra central weight."""
    _, weights, extra = sigma.Unscented(alpha, 2.0, kappa).points(n)
    whole = alpha**2 * (n + kappa)  # n + lambda
    np.testing.assert_allclose(weights, 0.5 / whole, rtol=1e-12)
    pairs = 2 * np.sum(weights)
    central = 1 - n / whole
    np.testing.assert_allclose(central + pairs, 1.0, rtol=1e-9)
    np.testing.assert_allclose(central + extra + pairs, 1 + (1 - alpha**2 + 2.0), rtol=1e-9)


# --- D3: polar to Cartesian, S. J. Julier and J. K. Uhlmann, Proc. IEEE 92 (2004)

S = math.radians(15)
EXACT = {"mean": 0.966311087632226, "x": 6.407444174544179e-2, "y": 2.568440173582265e-3}


def polar(x):
    return jnp.stack([x[0] * jnp.cos(x[1]), x[0] * jnp.sin(x[1])])


def polar_moments(rule, s=S, r=0.02):
    prior = gaussian(np.array([1.0, math.pi / 2]), np.diag([r**2, s**2]))
    out = rule.transform(polar, prior, Vector(2), Vector(2))
    less = 0.0 if out.less is None else np.outer(out.less, out.less)
    return np.asarray(out.mean), np.asarray(transposed_multiply(out.rows, out.rows)) - less


def test_exact_moments_by_quadrature():
    """The truth, to 1e-12: closed forms, and integrals over the angle."""
    density = lambda a: math.exp(-(a**2) / (2 * S**2)) / (S * math.sqrt(2 * math.pi))
    of = lambda f: quad(lambda a: f(a) * density(a), -12 * S, 12 * S, epsabs=1e-14)[0]
    second = 1 + 0.02**2
    mean = of(math.cos)
    x = second * of(lambda a: math.sin(a) ** 2)
    y = second * of(lambda a: math.cos(a) ** 2) - mean**2
    for found, name in ((mean, "mean"), (x, "x"), (y, "y")):
        np.testing.assert_allclose(found, EXACT[name], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("rule", "closed"),
    [
        (sigma.Cubature(), lambda s: (1 + math.cos(math.sqrt(2) * s)) / 2),
        (sigma.Unscented(1.0, 2.0, 1.0), lambda s: (2 + math.cos(math.sqrt(3) * s)) / 3),
        (sigma.Cubature5(), lambda s: (5 + math.cos(2 * s) + 2 * math.cos(math.sqrt(2) * s)) / 8),
    ],
    ids=["cubature", "unscented", "fifth"],
)
def test_rules_give_their_own_quadrature_exactly(rule, closed):
    """The mean of r sin(angle) in closed form for each rule, to 1e-12."""
    mean, _ = polar_moments(rule)
    np.testing.assert_allclose(mean, [0.0, closed(S)], rtol=0, atol=1e-12)


def test_rules_approach_the_exact_moments():
    """With the spread of the angle going down, errors of the mean fall as s^4 (third degree) and
    s^6 (fifth); linearisation only as s^2."""
    orders = {"linear": (sigma.Linearised(), 2), "third": (sigma.Unscented(1.0, 2.0, 1.5), 4),
              "fifth": (sigma.Cubature5(), 6)}  # fmt: skip
    for rule, order in orders.values():
        errors = [
            abs(polar_moments(rule, s, 0.0002)[0][1] - math.exp(-s * s / 2)) for s in (S, S / 2)
        ]
        assert abs(math.log2(errors[0] / errors[1]) - order) < 0.15
    _, covariance = polar_moments(sigma.Cubature5())
    np.testing.assert_allclose(np.diag(covariance), [EXACT["x"], EXACT["y"]], rtol=0, atol=2e-4)


# --- D6: consistency

WINDOWS = [
    (1, (0.7422, 1.2956), (0.5990, 1.5317), (0.8049, 1.2213)),
    (2, (1.6273, 2.4106), (1.4066, 2.7242), (1.7187, 2.3075)),
    (3, (2.5391, 3.4987), (2.2589, 3.8720), (2.6526, 3.3736)),
    (6, (5.3402, 6.6977), (4.9252, 7.2058), (5.5033, 6.5229)),
    (12, (11.0589, 12.9790), (10.4532, 13.6778), (11.2922, 12.7340)),
]


@pytest.mark.parametrize(("n", "low", "high", "many"), WINDOWS)
def test_windows(n, low, high, many):
    """The whole table, half of the last digit."""
    for count, level, window in ((100, 0.95, low), (100, 0.999, high), (500, 0.999, many)):
        np.testing.assert_allclose(mean_interval(n, count, level), window, rtol=0, atol=5.1e-5)


RUNS, COUNT, DT = 100, 50, 0.01
Q = np.array([1e-6] * 3 + [1e-4] * 3 + [1e-8] * 2)
R = np.array([1e-4] * 3 + [1e-2] * 3)
P0 = np.diag([0.1, 0.1, 0.1, 0.3, 0.3, 0.3, 0.02, 0.02]) ** 2


@pytest.fixture(scope="module")
def attitude():
    """A bank on SO(3) and its truth: a gyroscope, an accelerometer; starts drawn from the prior."""
    model = attitude_model(Q, R, mass=4.08)
    rng = np.random.default_rng(12)
    mean = {
        "p": from_rotation_vector(jnp.array([0.3, -0.4, 0.9])),
        "omega": jnp.array([0.1, 0.2, 0.3]),
        "offset": jnp.array([0.02, -0.01]),
    }
    prior = gaussian(mean, P0)
    u = np.tile([9.0, 10.0, 11.0, 10.0], (COUNT, 1))
    wide = jax.tree.map(lambda a: jnp.broadcast_to(a[:, None], (*a.shape, RUNS)), mean)
    start = model.space.retract(
        wide, jnp.asarray(np.sqrt(np.diag(P0))[:, None] * rng.normal(size=(8, RUNS)))
    )
    kicks = jnp.asarray(np.sqrt(Q)[:, None] * rng.normal(size=(COUNT, 8, RUNS)))
    noises = jnp.asarray(np.sqrt(R)[:, None] * rng.normal(size=(COUNT, 6, RUNS)))

    def step(x, now):
        u, kick, noise = now
        x = model.space.retract(model(x, u, DT), kick)
        return x, (x, model.sensor(x, u) + noise)

    _, (truth, y) = jax.jit(lambda s: jax.lax.scan(step, s, (jnp.asarray(u), kicks, noises)))(start)

    def run(scale_q, scale_r):
        wrong = attitude_model(scale_q * Q, scale_r * R, mass=4.08)
        out = filter_bank(wrong, prior, y, u=jnp.asarray(u), dt=DT)
        each = jax.vmap(lambda m, f, x: nees(m, f, x, wrong.space))(out.mean, out.factor, truth)
        return each, out.nis, out.innovations.normalised, out.mean

    return outer_jit(run)


def outside(values, degrees):
    low, high = mean_interval(degrees, RUNS)
    means = np.mean(np.asarray(values), axis=1)
    return int(np.sum((means < low) | (means > high)))


@pytest.mark.slow
def test_attitude_is_consistent(attitude):
    """NEES (8) and NIS (6) at 50 times in the 99.9 % window, at most one out; innovations white."""
    each, nis, scaled, mean = attitude(jnp.array(1.0), jnp.array(1.0))
    assert outside(each, 8) <= 1
    assert outside(nis, 6) <= 1
    low, high = mean_interval(6 * COUNT * RUNS)
    assert low < float(np.sum(nis)) < high
    for lag in range(1, 6):
        assert abs(np.mean(autocorrelation(scaled, lag))) < 3.3 / np.sqrt(6 * COUNT * RUNS)
    # D7 (e): unit Euler parameters after every update
    np.testing.assert_allclose(np.linalg.norm(mean["p"], axis=1), 1.0, rtol=0, atol=1e-13)


@pytest.mark.slow
@pytest.mark.parametrize(("q", "r"), [(1.0, 4.0), (1.0, 0.25), (4.0, 1.0), (0.25, 1.0)])
def test_wrong_noise_is_seen(attitude, q, r):
    """The power check: Q or R wrong by a factor of four must fail the same tests."""
    each, nis, _, _ = attitude(jnp.array(q), jnp.array(r))
    assert outside(each, 8) > 1
    low, high = mean_interval(6 * COUNT * RUNS)
    assert not low < float(np.sum(nis)) < high


# --- D7 along a path


@pytest.mark.slow
def test_world_frame_does_not_matter_along_a_path():
    """Twenty steps from a turned start are the turned path, to 1e-10 (D7 b), and so for -p (a)."""
    model = attitude_model(Q, R, mass=4.08)
    u = np.tile([9.0, 10.0, 11.0, 10.0], (20, 1))
    y = np.tile([0.2, 0.1, 0.3, 0.1, -0.2, 9.9], (20, 1))
    turn = from_rotation_vector(jnp.array([1.0, 2.0, -0.5]))
    p = from_rotation_vector(jnp.array([0.3, -0.4, 0.9]))
    starts = jnp.stack([p, -p, product(turn, p)], axis=1)
    wide = lambda a: jnp.broadcast_to(jnp.asarray(a)[:, None], (len(a), 3))
    mean = {"p": starts, "omega": wide([0.1, 0.2, 0.3]), "offset": wide([0.02, -0.01])}
    prior = gaussian(jax.tree.map(lambda a: a[..., 0], mean), P0)
    bank = type(prior)(mean, jnp.broadcast_to(prior.factor[..., None], (8, 8, 3)))
    out = outer_jit(
        lambda b: filter_bank(model, b, jnp.broadcast_to(jnp.asarray(y)[..., None], (20, 6, 3)),
                              u=jnp.asarray(u), dt=DT)
    )(bank)  # fmt: skip
    last = out.mean["p"][-1]
    np.testing.assert_allclose(last[:, 1], -last[:, 0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(last[:, 2], product(turn, last[:, 0]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(out.factor[-1][..., 0], out.factor[-1][..., 2], rtol=0, atol=1e-10)
