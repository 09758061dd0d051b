"""Euler parameters: the identities of G, L and bar, exp and log, and gradients everywhere."""

import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from helpers import np_bar, np_g, np_l, np_rotation, np_skew, random_quaternion, turn, unit

from stmuav_jax.math import rotation as rot

AXES = [np.array(a, dtype=float) for a in ([1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -2, 3])]


@pytest.fixture
def rng():
    return np.random.default_rng(100)


def close(got, expected, tolerance=1e-14):
    np.testing.assert_allclose(np.asarray(got), np.asarray(expected), rtol=0, atol=tolerance)


def test_matrices_equal_their_definitions(rng):
    p, a, b = random_quaternion(rng), rng.normal(size=3), rng.normal(size=3)
    close(rot.matrix_g(jnp.asarray(p)), np_g(p))
    close(rot.matrix_l(jnp.asarray(p)), np_l(p))
    close(rot.skew(jnp.asarray(a)) @ b, np.cross(a, b))
    close(rot.rotation_matrix(jnp.asarray(p)), np_rotation(p))


def test_identities(rng):
    p, a = jnp.asarray(random_quaternion(rng)), jnp.asarray(rng.normal(size=3))
    G, L, A = rot.matrix_g(p), rot.matrix_l(p), rot.rotation_matrix(p)
    close(L @ L.T, np.eye(3))
    close(G @ G.T, np.eye(3))
    close(L.T @ L, np.eye(4) - np.outer(p, p))
    close(G @ L.T, A)
    close(L @ p, np.zeros(3))
    close(G @ p, np.zeros(3))
    close(L.T @ a, np_bar(np.asarray(a)) @ p, 1e-13)
    close(A @ A.T, np.eye(3))
    assert np.linalg.det(np.asarray(A)) == pytest.approx(1, abs=1e-14)


def test_off_unit_norm_scales_the_rotation(rng):
    p = random_quaternion(rng)
    close(rot.rotation_matrix(jnp.asarray(0.7 * p)), 0.49 * np_rotation(p))
    close(rot.normalise(jnp.asarray(0.7 * p)), p)


def test_rates(rng):
    p, omega = random_quaternion(rng), rng.normal(size=3)
    p_rate = rot.euler_parameter_rate(jnp.asarray(p), jnp.asarray(omega))
    close(p_rate, 0.5 * np_l(p).T @ omega)
    close(p_rate @ p, 0)
    close(rot.angular_velocity(jnp.asarray(p), p_rate), omega)
    # A^T dA/dt is the cross-product matrix of the body-frame angular velocity
    A, A_rate = jax.jvp(rot.rotation_matrix, (jnp.asarray(p),), (p_rate,))
    close(A.T @ A_rate, np_skew(omega), 1e-13)
    G, G_rate = jax.jvp(rot.matrix_g, (jnp.asarray(p),), (p_rate,))
    L, L_rate = jax.jvp(rot.matrix_l, (jnp.asarray(p),), (p_rate,))
    close(G_rate @ L.T, G @ L_rate.T)
    close(A_rate, 2 * G_rate @ L.T, 1e-13)
    close(2 * L @ L_rate.T, np_skew(omega), 1e-13)
    close(L_rate @ p_rate, np.zeros(3))


def test_product_and_conjugate(rng):
    p, q = random_quaternion(rng), random_quaternion(rng)
    both = rot.product(jnp.asarray(p), jnp.asarray(q))
    close(rot.rotation_matrix(both), np_rotation(p) @ np_rotation(q))
    close(rot.product(jnp.asarray(p), rot.conjugate(jnp.asarray(p))), [1, 0, 0, 0])
    close(rot.rotation_matrix(rot.conjugate(jnp.asarray(p))), np_rotation(p).T)


@pytest.mark.parametrize("angle", [0, 1e-12, 1e-5, 3.1e-3, 3.2e-3, 2.0, np.pi])
@pytest.mark.parametrize("axis", AXES[2:], ids=str)
def test_exp_and_log(angle, axis):
    v = angle * unit(axis)
    p = rot.from_rotation_vector(jnp.asarray(v))
    with mpmath.workdps(40):
        exact = [mpmath.mpf(float(x)) for x in v]
        length = mpmath.sqrt(sum(x * x for x in exact))
        half = mpmath.sin(length / 2) / length if length else mpmath.mpf(0.5)
        expected = [float(str(x)) for x in (mpmath.cos(length / 2), *(half * y for y in exact))]
    close(p, expected, 2e-16)
    # at a half turn v and -v are the same rotation
    back = np.asarray(rot.to_rotation_vector(p))
    if angle == np.pi:
        back = back * np.sign(back @ v)
    close(back, v, 1e-15 * max(angle, 1e-3))
    close(rot.rotation_matrix(p), np_rotation(turn(axis, angle)), 1e-15)


def test_log_takes_the_short_way(rng):
    p = random_quaternion(rng)
    v = rot.to_rotation_vector(jnp.asarray(p))
    close(v, rot.to_rotation_vector(jnp.asarray(-p)))
    assert float(v @ v) <= np.pi**2 * (1 + 1e-15)


HALF_TURNS = [np.concatenate([[0.0], unit(a)]) for a in (*AXES, [-1, 0, 1])]
ON_EACH_BRANCH = [
    unit(x) for x in ([5, 1, -2, 1], [1, 5, 2, -1], [-1, 2, 5, 1], [1, -1, 2, 5], [-5, 1, 1, 2])
]


@pytest.mark.parametrize(
    "p", [np.array([1.0, 0, 0, 0]), np.full(4, 0.5), *ON_EACH_BRANCH, *HALF_TURNS], ids=str
)
def test_from_matrix(p):
    A = np_rotation(p)
    q = np.asarray(rot.from_matrix(jnp.asarray(A)))
    close(np_rotation(q), A, 2e-15)
    close(abs(q @ p), 1, 2e-15)
    assert q[np.argmax(np.abs(q))] > 0
    close(q @ q, 1, 1e-15)


# --- gradients at the places where formulas usually break

IDENTITY = np.array([1.0, 0, 0, 0])
AT = {"identity": IDENTITY, **{f"half turn {k}": p for k, p in enumerate(HALF_TURNS)}}


def check_derivatives(f, x, directions, step=1e-4, inward=False):
    """jvp and grad at x are finite and equal to finite differences along each direction."""
    f = jax.jit(f)
    weights = np.arange(1, 1 + f(x).size).reshape(f(x).shape) / f(x).size
    gradient = jax.grad(lambda y: jnp.sum(weights * f(y)))(x)
    assert np.all(np.isfinite(gradient))
    for d in directions:
        rate = jax.jvp(f, (x,), (jnp.asarray(d),))[1]
        at = lambda k, d=d: np.asarray(f(x + k * step * d))
        if inward:
            expected = (-25 * at(0) + 48 * at(1) - 36 * at(2) + 16 * at(3) - 3 * at(4)) / 12
        else:
            expected = (at(-2) - 8 * at(-1) + 8 * at(1) - at(2)) / 12
        close(rate, expected / step, 1e-8)
        assert float(jnp.sum(gradient * d)) == pytest.approx(
            float(jnp.sum(weights * rate)), abs=1e-12
        )


@pytest.mark.parametrize("v", [np.zeros(3), *(np.pi * unit(a) for a in AXES)], ids=str)
def test_gradient_of_exp(v):
    check_derivatives(rot.from_rotation_vector, jnp.asarray(v), [*np.eye(3), np.ones(3)])
    assert np.all(np.isfinite(jax.hessian(lambda x: rot.from_rotation_vector(x)[0])(v)))


def test_exp_is_its_series_to_second_order_at_zero():
    second = jax.hessian(lambda x: rot.from_rotation_vector(x)[0])(jnp.zeros(3))
    close(second, -np.eye(3) / 4)


@pytest.mark.parametrize("where", AT)
def test_gradient_of_log(where):
    p = AT[where]
    directions = np.eye(4)
    if where != "identity":
        # e0 < 0 is the other vector of the same rotation: look along e0 = 0 and into e0 > 0
        directions = [d + 0.5 * IDENTITY for d in np.eye(4)]
    check_derivatives(
        rot.to_rotation_vector, jnp.asarray(p), directions, inward=where != "identity"
    )


@pytest.mark.parametrize("where", ["identity", *(f"half turn {k}" for k in range(4))])
def test_gradient_of_from_matrix(where):
    A = np_rotation(AT[where])
    tilts = [A @ np_skew(d) for d in (*np.eye(3), np.ones(3))]
    check_derivatives(rot.from_matrix, jnp.asarray(A), tilts)
