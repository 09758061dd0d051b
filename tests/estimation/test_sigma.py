"""Rules: exactness of the transform (D2), and rotations (D7)."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.filter import DEFAULT, GaussianFilter
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.math.rotation import from_rotation_vector, product
from stmuav_jax.math.space import Vector
from stmuav_jax.math.stacked import transposed_multiply
from stmuav_jax.uav.quadrotor.model import attitude_model, attitude_space


def moments(out):
    less = 0.0 if out.less is None else np.outer(out.less, out.less)
    return np.asarray(out.mean), np.asarray(transposed_multiply(out.rows, out.rows)) - less


def sent(rule, function, mean, P):
    prior = gaussian(mean, P)
    target = Vector(jax.eval_shape(function, prior.mean).shape[0])
    return jax.jit(lambda g: Sent(*rule.transform(function, g, Vector(len(mean)), target)[:4]))(
        prior
    )


class Sent(NamedTuple):
    """What comes out of a rule, arrays only."""

    mean: jax.Array
    rows: jax.Array
    less: jax.Array | None
    inputs: jax.Array


@pytest.mark.parametrize(
    "rule",
    [
        sigma.Unscented(1.0, 2.0, 0.0),
        sigma.Unscented(1e-3, 2.0, 0.0),
        sigma.Unscented(0.7, 2.0, 0.0),
        sigma.Unscented(0.5, 0.0, 1.0),
        sigma.Unscented(1.0, 0.0, -0.5),
    ],
    ids=str,
)
def test_square_of_a_number(rule):
    """D2: mean m^2 + P for any parameters, variance 4 m^2 P + P^2 (alpha^2 kappa + beta)."""
    m, P = 1.5, 0.7
    mean, variance = moments(sent(rule, lambda x: x * x, np.array([m]), [[P]]))
    tol = 1e-9 if rule.alpha < 0.01 else 1e-12
    np.testing.assert_allclose(mean, [m * m + P], rtol=0, atol=tol)
    expected = 4 * m * m * P + P * P * (rule.alpha**2 * rule.kappa + rule.beta)
    np.testing.assert_allclose(variance, [[expected]], rtol=0, atol=100 * tol)


def test_every_rule_is_exact_for_cubics():
    """Means of polynomials up to the third degree in three variables, by Isserlis' theorem."""
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3, 3))
    P, m = a @ a.T, rng.normal(size=3)

    def cubic(x):
        return jnp.stack([x[0] * x[1] * x[2], x[0] ** 3 - x[1] ** 2])

    triple = m.prod() + m[0] * P[1, 2] + m[1] * P[0, 2] + m[2] * P[0, 1]
    second = m[0] ** 3 + 3 * m[0] * P[0, 0] - m[1] ** 2 - P[1, 1]
    for rule in (sigma.Unscented(0.3), sigma.Cubature(), sigma.Cubature5()):
        mean, _ = moments(sent(rule, cubic, m, P))
        np.testing.assert_allclose(mean, [triple, second], rtol=0, atol=1e-11)


def test_weighted_sum_of_the_textbook():
    """Rows and the square taken away, against weights as printed in books."""
    rng = np.random.default_rng(2)
    a = rng.normal(size=(4, 4))
    P, m = a @ a.T, rng.normal(size=4)
    function = lambda x: jnp.stack([jnp.sin(x[0]) * x[1], x[2] ** 2 + x[3], jnp.exp(0.3 * x[0])])
    L = np.linalg.cholesky(P)
    for rule in (sigma.Unscented(0.1, 2.0, 0.1), sigma.Unscented(0.9, 0.0, -1.0)):
        square = rule.alpha**2 * (4 + rule.kappa)
        steps = math.sqrt(square) * L
        X = np.concatenate([m[None], m + steps.T, m - steps.T])
        wm = np.full(9, 0.5 / square)
        wm[0] = 1 - 4 / square
        wc = wm.copy()
        wc[0] += 1 - rule.alpha**2 + rule.beta
        Y = np.asarray(function(jnp.asarray(X.T))).T
        mean = wm @ Y
        cov = (Y - mean).T @ np.diag(wc) @ (Y - mean)
        cross = (X - m).T @ np.diag(wc) @ (Y - mean)
        out = sent(rule, function, m, P)
        found, covariance = moments(out)
        np.testing.assert_allclose(found, mean, rtol=0, atol=1e-11)
        np.testing.assert_allclose(covariance, cov, rtol=0, atol=1e-9)
        seen = transposed_multiply(out.inputs, out.rows[: out.inputs.shape[0]])
        np.testing.assert_allclose(seen, cross, rtol=0, atol=1e-11)


# --- D7: attitude

SPACE = attitude_space()
MODEL = attitude_model(np.full(8, 1e-8), np.full(6, 1e-3), mass=4.08)
U = jnp.asarray([7.0, 9.0, 11.0, 13.0])
Y = jnp.array([0.2, 0.1, 0.3, 0.1, -0.2, 9.9])
P0 = np.diag([0.2, 0.3, 0.1, 0.5, 0.4, 0.3, 0.01, 0.02]) ** 2


def prior(p, scale=1.0):
    mean = {"p": p, "omega": jnp.array([0.1, 0.2, 0.3]), "offset": jnp.array([0.05, 0.1])}
    return gaussian(mean, P0 * scale**2)


@jax.jit
def stepped(start):
    return DEFAULT.step(MODEL, start, Y, U, 0.01)[0]


Q0 = from_rotation_vector(jnp.array([0.3, -0.4, 0.9]))


@pytest.mark.slow
def test_rotations_have_no_sign_and_no_frame():
    a, b = stepped(prior(Q0)), stepped(prior(-Q0))
    np.testing.assert_allclose(SPACE.difference(a.mean, b.mean), 0, atol=1e-12)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)
    turn = from_rotation_vector(jnp.array([1.0, 2.0, -0.5]))
    c = stepped(prior(product(turn, Q0)))
    np.testing.assert_allclose(c.mean["p"], product(turn, a.mean["p"]), rtol=0, atol=1e-10)
    np.testing.assert_allclose(a.covariance, c.covariance, rtol=0, atol=1e-10)
    for state in (a, c):
        assert abs(jnp.linalg.norm(state.mean["p"]) - 1) < 1e-14


@pytest.mark.slow
def test_small_covariance_is_an_extended_filter():
    small = prior(Q0, 1e-6)
    extended = jax.jit(lambda g: GaussianFilter(sigma.Linearised()).step(MODEL, g, Y, U, 0.01)[0])
    a, b = stepped(small), extended(small)
    np.testing.assert_allclose(SPACE.difference(a.mean, b.mean), 0, atol=1e-6)
    np.testing.assert_allclose(a.factor, b.factor, rtol=0, atol=1e-9)
