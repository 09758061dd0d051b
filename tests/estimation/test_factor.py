"""Square roots: against NumPy's factorisations, alone and in stacks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.estimation import factor
from stmuav_jax.quadrotor.trigonometry import sine_cosine

RNG = np.random.default_rng(0)
triangularise, cholesky = jax.jit(factor.triangularise), jax.jit(factor.cholesky)


def stacked(function, *arrays):
    """A function of stacks, and NumPy's of each, side by side."""
    return np.moveaxis(np.asarray(jax.jit(function)(*(jnp.asarray(a) for a in arrays))), -1, 0)


@pytest.mark.parametrize(("r", "k"), [(12, 5), (3, 5), (7, 2)])
def test_triangularise(r, k):
    rows = RNG.normal(size=(r, k, 4))
    many = stacked(factor.triangularise, rows)
    for i in range(4):
        L = np.asarray(triangularise(jnp.asarray(rows[..., i])))
        np.testing.assert_allclose(L @ L.T, rows[..., i].T @ rows[..., i], atol=1e-13)
        np.testing.assert_allclose(np.abs(many[i] @ many[i].T), np.abs(L @ L.T), atol=1e-13)
        assert np.all(np.triu(L, 1) == 0)
        assert np.all(np.diag(L) >= 0)


def test_no_library_is_called_in_native_loops(monkeypatch):
    """LAPACK's call would keep a filter's loop from becoming one function."""
    rows = jnp.asarray(RNG.normal(size=(25, 8)))
    plain = triangularise(rows)
    monkeypatch.setattr(factor, "native_loops", lambda: True)
    program = jax.jit(lambda rows: factor.triangularise(rows))
    assert "custom_call" not in program.lower(rows).as_text()
    np.testing.assert_allclose(program(rows), plain, rtol=1e-12, atol=1e-14)


def test_small_parts_keep_their_digits():
    """A direction 1e-12 of the other: its square is lost beside 1, its root is not."""
    rows = jnp.array([[1.0, 1.0], [0.0, 1e-12]])
    for stack in (rows, jnp.stack([rows, rows], axis=-1)):
        L = np.asarray(triangularise(stack)).reshape(2, 2, -1)[..., 0]
        np.testing.assert_allclose(L, [[1, 0], [1, 1e-12]], rtol=1e-14)


def test_cholesky_and_division():
    A = RNG.normal(size=(6, 9, 3))
    P = np.einsum("irs,jrs->ijs", A, A)
    B = RNG.normal(size=(6, 2, 3))
    L = stacked(factor.cholesky, P)
    quotient = stacked(factor.divide_lower, np.moveaxis(L, 0, -1), B)
    for i in range(3):
        expected = np.linalg.cholesky(P[..., i])
        np.testing.assert_allclose(L[i], expected, atol=1e-13)
        np.testing.assert_allclose(
            np.asarray(cholesky(jnp.asarray(P[..., i]))), expected, atol=1e-13
        )
        np.testing.assert_allclose(quotient[i], np.linalg.solve(expected, B[..., i]), atol=1e-12)


def test_rank_one_changes():
    A = RNG.normal(size=(5, 9))
    L = np.linalg.cholesky(A @ A.T)
    v = 0.3 * L @ RNG.normal(size=5)
    down = np.asarray(jax.jit(factor.downdate)(jnp.asarray(L), jnp.asarray(v)))
    np.testing.assert_allclose(down, np.linalg.cholesky(L @ L.T - np.outer(v, v)), atol=1e-13)
    a = RNG.normal(size=5)
    reduced = np.asarray(
        jax.jit(factor.reduce_root)(jnp.asarray(L), jnp.asarray(a), jnp.asarray(0.7))
    )
    expected = L @ (np.eye(5) - np.outer(a, a) / (0.7 + a @ a)) @ L.T
    np.testing.assert_allclose(reduced, np.linalg.cholesky(expected), atol=1e-13)


def test_what_is_not_definite_is_nan_not_a_number():
    """jax #775: silent NaN; the filter looks for it."""
    P = jnp.diag(jnp.array([1.0, -1.0, 1.0, 2.0, 1.0]))
    assert np.isnan(np.asarray(cholesky(P))).any()
    assert np.isnan(np.asarray(cholesky(P[..., None]))).any()
    big = 2 * jnp.eye(5)[0]
    assert np.isnan(np.asarray(jax.jit(factor.downdate)(jnp.eye(5), big))).any()


def test_sine_and_cosine():
    x = np.concatenate([np.linspace(-8, 8, 4001), RNG.uniform(-1e5, 1e5, 4000)])
    s, c = jax.jit(sine_cosine)(x)
    np.testing.assert_allclose(s, np.sin(x), rtol=0, atol=1e-15)
    np.testing.assert_allclose(c, np.cos(x), rtol=0, atol=1e-15)
    slope = jax.grad(lambda v: sine_cosine(v)[0])(jnp.asarray(0.3))
    np.testing.assert_allclose(slope, np.cos(0.3), rtol=1e-15)


def test_semidefinite():
    """Zero variances, rank one, banks; the square comes back, what is no covariance is NaN."""
    g = np.array([0.5, 0.0, 2.0])
    single = [
        np.diag([2.0, 0.0, 3.0]),
        np.outer(g, g),
        np.zeros((3, 3)),
        np.eye(3) + np.outer(g, g),
    ]
    L = jax.jit(factor.semidefinite)(jnp.stack([jnp.asarray(P) for P in single], -1))
    square = np.asarray(factor.outer_square(L))
    np.testing.assert_allclose(square, np.stack(single, -1), rtol=0, atol=1e-14)
    for P in ([[0.0, 1.0], [1.0, 0.0]], [[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]):
        assert np.any(np.isnan(factor.semidefinite(jnp.array(P))))
