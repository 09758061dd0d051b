"""Rules: exactness of the transform (D2, D3), and rotations (D7)."""

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.algebra.rotation import from_rotation_vector, product
from stmuav_jax.algebra.space import Vector
from stmuav_jax.algebra.stacked import transposed_multiply
from stmuav_jax.estimation import sigma
from stmuav_jax.estimation.gaussians import Gaussian, gaussian
from stmuav_jax.estimation.update import DEFAULT, GaussianFilter
from stmuav_jax.quadrotor.attitude import attitude_model, attitude_space
from stmuav_jax.quadrotor.model import PART_III, rates


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


def test_polar_to_cartesian():
    """D3: against the exact moments, what a second-order rule leaves; none gives them exactly.

    Exact: E y = exp(-s^2 / 2), Var x and Var y of Julier and Uhlmann's example.
    """
    s = math.radians(15)
    P = np.diag([0.02**2, s**2])
    polar = lambda x: jnp.stack([x[0] * jnp.cos(x[1]), x[0] * jnp.sin(x[1])])
    m = np.array([1.0, math.pi / 2])
    exact_mean = math.exp(-s * s / 2)
    second = (1 + 0.02**2) * (1 + math.exp(-2 * s * s)) / 2
    exact = np.array([(1 + 0.02**2) * (1 - math.exp(-2 * s * s)) / 2, second - exact_mean**2])
    # the formulas against the published numbers
    np.testing.assert_allclose(exact_mean, 0.966311087632226, rtol=0, atol=1e-12)
    np.testing.assert_allclose(
        exact, [6.407444174544179e-2, 2.568440173582265e-3], rtol=0, atol=1e-12
    )
    errors = {}
    for name, rule in {
        "linear": sigma.Linearised(),
        "unscented": sigma.Unscented(1.0, 2.0, 1.0),
        "fifth": sigma.Cubature5(),
    }.items():
        mean, covariance = moments(sent(rule, polar, m, P))
        errors[name] = max(abs(mean[1] - exact_mean), *np.abs(np.diag(covariance) - exact))
    assert errors["linear"] > 30e-3
    assert errors["unscented"] < 5e-3
    assert errors["fifth"] < 2e-4


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


def test_mean_of_rotations():
    """The found mean has no mean error left, and the points are unit."""
    start = prior(Q0)
    send = lambda g: sigma.Cubature().transform(lambda x: x, g, SPACE, SPACE)[:2]
    mean, rows = jax.jit(send)(start)
    difference, retract = jax.jit(SPACE.difference), jax.jit(SPACE.retract)
    np.testing.assert_allclose(difference(mean, start.mean), 0, atol=1e-12)
    np.testing.assert_allclose(transposed_multiply(rows, rows), P0, rtol=0, atol=1e-12)
    moves = jnp.concatenate([start.factor, -start.factor], axis=1)
    points = retract(jax.tree.map(lambda a: a[:, None], start.mean), moves)
    np.testing.assert_allclose(jnp.linalg.norm(points["p"], axis=0), 1, atol=1e-14)
    np.testing.assert_allclose(
        difference(points, jax.tree.map(lambda a: a[:, None], start.mean)), moves, atol=1e-14
    )


def test_small_covariance_is_an_extended_filter():
    small = prior(Q0, 1e-6)
    extended = jax.jit(lambda g: GaussianFilter(sigma.Linearised()).step(MODEL, g, Y, U, 0.01)[0])
    a, b = stepped(small), extended(small)
    np.testing.assert_allclose(SPACE.difference(a.mean, b.mean), 0, atol=1e-6)
    np.testing.assert_allclose(a.factor, b.factor, rtol=0, atol=1e-9)


def test_attitude_step_is_of_fourth_order():
    """Against many small steps; body rates against the Euler-angle model's."""
    start = prior(Q0).mean

    def run(n):
        x = start
        for _ in range(n):
            x = step(x, 0.08 / n)
        return x

    step = jax.jit(lambda x, h: MODEL.function(x, U, h))
    exact = run(64)
    errors = [float(jnp.max(jnp.abs(SPACE.difference(run(n), exact)))) for n in (1, 2)]
    assert 12 < errors[0] / errors[1] < 40
    q = jnp.asarray(PART_III.value("true.start"))
    slope = rates()(q, U)[3:6]
    small = step({"p": Q0, "omega": q[3:6], "offset": q[6:]}, 1e-6)
    np.testing.assert_allclose((small["omega"] - q[3:6]) / 1e-6, slope, rtol=1e-3)


def test_gaussian_is_a_pytree():
    assert len(jax.tree.leaves(Gaussian(jnp.zeros(2), jnp.eye(2)))) == 2
