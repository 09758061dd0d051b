"""Closed-form solves of small systems against NumPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.stacked import MOST_ROWS, invert_definite, solve_definite


def positive(k, stack=(), seed=0):
    """Random positive definite matrices with rows of mixed units."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(*stack, k, k))
    units = 10.0 ** rng.integers(-2, 3, size=k)
    return units * (A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(k)) * units[:, None]


@pytest.mark.parametrize("k", range(1, MOST_ROWS + 1))
def test_solve(k):
    A, B = positive(k, (5,)), np.random.default_rng(1).normal(size=(5, k, 2))
    last = lambda x: jnp.asarray(np.moveaxis(x, 0, -1))
    found = np.moveaxis(np.asarray(jax.jit(solve_definite)(last(A), last(B))), -1, 0)
    left = np.abs(A @ found - B)
    # backward error: round-off of the products that make up each row
    assert np.all(left <= 1e-12 * (np.abs(A) @ np.abs(found) + np.abs(B)))
    alone = solve_definite(jnp.asarray(A[0]), jnp.asarray(B[0]))
    np.testing.assert_allclose(alone, found[0], rtol=1e-9)


@pytest.mark.parametrize("k", [1, 2, 3])
def test_inverse(k):
    A = positive(k, seed=2)
    np.testing.assert_allclose(
        np.asarray(invert_definite(jnp.asarray(A))) @ A, np.eye(k), atol=1e-7
    )


@pytest.mark.parametrize("k", range(1, MOST_ROWS + 1))
def test_not_positive_definite_is_nan(k):
    for place in range(k):
        A = positive(k)
        A[place, place] = -1.0
        assert np.all(np.isnan(solve_definite(jnp.asarray(A), jnp.ones((k, 1)))[-1]))


@pytest.mark.slow
def test_derivative():
    A, B = jnp.asarray(positive(5)), jnp.ones((5, 1))
    f = lambda s: jnp.sum(solve_definite(A + s * jnp.eye(5), B) ** 2)
    exact = lambda s: jnp.sum(jnp.linalg.solve(A + s * jnp.eye(5), B) ** 2)
    at = jnp.asarray(0.3)
    for derivative in (jax.grad, jax.jacfwd):
        np.testing.assert_allclose(derivative(f)(at), derivative(exact)(at), rtol=1e-8)


def test_too_large_is_refused():
    with pytest.raises(ValueError, match="7"):
        solve_definite(jnp.eye(7), jnp.ones((7, 1)))


def test_compiler_options_compile():
    options = stm.math.compiler_options()
    f = jax.jit(lambda x: jnp.sum(x[:, :, None] * x[:, None], axis=1), compiler_options=options)
    x = jnp.ones((512, 8))
    assert "__ynn_fusion" not in str(f.lower(x).compile().as_text())
    np.testing.assert_array_equal(f(x), np.full((512, 8), 8.0))
