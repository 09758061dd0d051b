"""The two linear solves against NumPy, and their gradients against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central

from stmuav_jax.algebra.linalg import factorise, solve_general

N = 7


@pytest.fixture(scope="module")
def rng():
    return np.random.default_rng(1)


def definite(rng, spread=1.0):
    B = rng.normal(size=(N, 2 * N)) * np.logspace(0, spread, N)[:, None]
    return B @ B.T


def deficient(rng, rank=5):
    B = rng.normal(size=(N, rank))
    return B @ B.T


@pytest.mark.parametrize("spread", [0, 6])
def test_cholesky(rng, spread):
    """Rows of mixed units, up to a condition of 1e14, are solved to round-off of the scaled."""
    S, b = definite(rng, spread), rng.normal(size=N)
    x = factorise(jnp.asarray(S), redundant=False, rcond=1e-11).solve(jnp.asarray(b))
    scale = 1 / np.sqrt(np.diag(S))
    expected = scale * np.linalg.solve(scale[:, None] * S * scale, scale * b)
    np.testing.assert_allclose(x, expected, rtol=1e-11)


def test_one_factor_serves_many_right_hand_sides(rng):
    S = definite(rng)
    factor = factorise(jnp.asarray(S), redundant=False, rcond=1e-11)
    for _ in range(3):
        b = rng.normal(size=N)
        np.testing.assert_allclose(S @ np.asarray(factor.solve(jnp.asarray(b))), b, atol=1e-11)


def test_singular_cholesky_is_nan_and_never_a_number():
    S = jnp.diag(jnp.asarray([1.0, 2.0, 0.0]))
    x = factorise(S, redundant=False, rcond=1e-11).solve(jnp.ones(3))
    assert not np.any(np.isfinite(np.asarray(x)[2]))


@pytest.mark.parametrize("rank", [3, 6, 7])
def test_svd_gives_the_minimum_norm(rng, rank):
    S, b = deficient(rng, rank), rng.normal(size=N)
    x = factorise(jnp.asarray(S), redundant=True, rcond=1e-11).solve(jnp.asarray(b))
    expected = np.linalg.lstsq(S, b, rcond=1e-11)[0]
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-10 * np.max(np.abs(expected)))


def test_rcond_is_relative_to_the_largest_value():
    S = jnp.diag(jnp.asarray([100.0, 1.0, 1e-6]))
    cut = factorise(S, redundant=True, rcond=1e-7).solve(jnp.ones(3))
    kept = factorise(S, redundant=True, rcond=1e-9).solve(jnp.ones(3))
    np.testing.assert_allclose(cut, [0.01, 1, 0], rtol=1e-12)
    np.testing.assert_allclose(kept, [0.01, 1, 1e6], rtol=1e-9)


@pytest.mark.parametrize("redundant", [False, True])
def test_solve_general(rng, redundant):
    K, b = rng.normal(size=(N, N)), rng.normal(size=N)
    if redundant:
        K = K[:, :4] @ rng.normal(size=(4, N))
    x = solve_general(jnp.asarray(K), jnp.asarray(b), redundant=redundant, rcond=1e-11)
    expected = np.linalg.lstsq(K, b, rcond=1e-11)[0] if redundant else np.linalg.solve(K, b)
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("redundant", [False, True])
@pytest.mark.parametrize("which", ["symmetric", "general"])
def test_gradients(rng, redundant, which):
    """Along matrices of one rank: there, the minimum-norm solution is differentiable."""
    rank = 4 if redundant else 2 * N
    B, B1 = rng.normal(size=(2, N, rank))
    C = B if which == "symmetric" else rng.normal(size=(N, rank))
    C1 = B1 if which == "symmetric" else rng.normal(size=(N, rank))
    b, b1, w = rng.normal(size=(3, N))

    def solution(t):
        S = (B + t * B1) @ (C + t * C1).T
        if which == "symmetric":
            return factorise(S, redundant=redundant, rcond=1e-11).solve(b + t * b1)
        return solve_general(S, b + t * b1, redundant=redundant, rcond=1e-11)

    solution = jax.jit(solution)
    rate = jax.jvp(solution, (0.0,), (1.0,))[1]
    expected = central(lambda t: solution(t), 1e-4)
    np.testing.assert_allclose(rate, expected, rtol=1e-6, atol=1e-7 * np.max(np.abs(expected)))
    gradient = jax.grad(lambda t: w @ solution(t))(0.0)
    assert float(gradient) == pytest.approx(float(w @ rate), rel=1e-9)
