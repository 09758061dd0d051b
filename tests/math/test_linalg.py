"""The two linear solves against NumPy, and their gradients against finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.linalg
from helpers import central

from stmuav_jax.math import linalg
from stmuav_jax.math.linalg import (
    Factor,
    count_products,
    factor_cholesky,
    factor_minimum_norm,
    factor_proximal,
    factor_saddle,
    independent_rows,
)

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


def factor_definite(S):
    return Factor(factor_cholesky(jnp.asarray(S)))


@pytest.mark.parametrize("spread", [0, 6])
def test_cholesky(rng, spread):
    """Rows of mixed units, up to a condition of 1e14, are solved to round-off of the scaled."""
    S, b = definite(rng, spread), rng.normal(size=N)
    x = factor_definite(S).solve(jnp.asarray(b))
    scale = 1 / np.sqrt(np.diag(S))
    expected = scale * np.linalg.solve(scale[:, None] * S * scale, scale * b)
    np.testing.assert_allclose(x, expected, rtol=1e-11)


def test_singular_cholesky_is_nan_and_never_a_number():
    x = factor_definite(np.diag([1.0, 2.0, 0.0])).solve(jnp.ones(3))
    assert not np.any(np.isfinite(np.asarray(x)[2]))


@pytest.mark.parametrize("rank", [3, 6, 7])
def test_svd_gives_the_minimum_norm(rng, rank):
    S, b = deficient(rng, rank), rng.normal(size=N)
    x = factor_minimum_norm(jnp.asarray(S)).solve(jnp.asarray(b))
    scale = 1 / np.sqrt(np.diag(S))
    expected = scale * np.linalg.lstsq(scale[:, None] * S * scale, scale * b, rcond=1e-11)[0]
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-10 * np.max(np.abs(expected)))


@pytest.mark.parametrize("redundant", [False, True])
def test_gradients(rng, redundant):
    """Along matrices of one rank: there, the minimum-norm solution is differentiable."""
    rank = 4 if redundant else 2 * N
    B, B1 = rng.normal(size=(2, N, rank))
    b, b1, w = rng.normal(size=(3, N))

    def solution(t):
        S, vector = (B + t * B1) @ (B + t * B1).T, b + t * b1
        return (factor_minimum_norm if redundant else factor_definite)(S).solve(vector)

    solution = jax.jit(solution)
    rate = jax.jvp(solution, (0.0,), (1.0,))[1]
    expected = central(lambda t: solution(t), 1e-4)
    np.testing.assert_allclose(rate, expected, rtol=1e-6, atol=1e-7 * np.max(np.abs(expected)))
    gradient = jax.grad(lambda t: w @ solution(t))(0.0)
    assert float(gradient) == pytest.approx(float(w @ rate), rel=1e-9)


@pytest.mark.parametrize("rank", [3, 6, 7])
def test_proximal_solves_dependent_rows(rng, rank):
    """B^T x, the effect of x, is determined even where x is not."""
    B = rng.normal(size=(N, rank)) * np.logspace(0, 3, N)[:, None]
    S = B @ B.T
    b = S @ rng.normal(size=N)
    x = np.asarray(factor_proximal(jnp.asarray(S)).solve(jnp.asarray(b)))
    effect, expected = B.T @ x, B.T @ (np.linalg.pinv(S, rcond=1e-13) @ b)
    np.testing.assert_allclose(effect, expected, rtol=0, atol=1e-8 * np.max(np.abs(expected)))


@pytest.mark.parametrize("redundant", [False, "fast", "minimum norm"])
def test_saddle(rng, redundant):
    """Against the whole matrix, solved by NumPy."""
    M, J = definite(rng), rng.normal(size=(3, N))
    if redundant:
        J = np.vstack([J, J[0] + 2 * J[1]])
    f, g = rng.normal(size=N), J @ rng.normal(size=N)
    M, J, f, g = (jnp.asarray(a) for a in (M, J, f, g))
    x, y = factor_saddle(M, J, redundant=redundant).solve(f, g)
    K = np.block([[M, -J.T], [J, np.zeros((len(J), len(J)))]])
    expected = np.linalg.lstsq(K, np.concatenate([f, g]), rcond=1e-11)[0]
    np.testing.assert_allclose(x, expected[:N], rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(J.T @ y, J.T @ expected[N:], rtol=1e-8, atol=1e-8)


@pytest.mark.parametrize("redundant", [False, "fast"])
def test_solutions_do_not_depend_on_the_order_of_elimination(rng, redundant):
    sizes = ((3, N), N, 3)
    J, f, g = (jnp.asarray(rng.normal(size=size)) for size in sizes)
    M = jnp.asarray(definite(rng))
    saddles = [
        factor_saddle(M, J, redundant=redundant, order=order)
        for order in (None, rng.permutation(N).tolist())
    ]
    results = [(*s.solve(f, g), s.right_inverse(), s.share_multipliers(J, g)) for s in saddles]
    for ours, theirs in zip(*results, strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-10)


def test_products_of_an_elimination():
    """An arrow of five unknowns and a row in its tip, by hand for both ends first."""
    couples = np.eye(5, dtype=bool)
    couples[0], couples[:, 0] = True, True
    touches = np.zeros((5, 1), bool)
    touches[0] = True
    # each of the four others: factor 1, change 1, two solutions 2; the tip: row 1, two solutions 2
    assert count_products(couples, touches, range(5)[::-1]) == 4 * 4 + 3
    # tip first: all is full
    full = sum(c + c * (c + 1) // 2 + c + 1 + 2 * (c + 1) for c in range(5))
    assert count_products(couples, touches, range(5)) == full


@pytest.mark.parametrize("redundant", [False, "fast"])
def test_right_inverse_is_the_smallest_in_the_metric(rng, redundant):
    M, J = definite(rng), rng.normal(size=(3, N))
    if redundant:
        J = np.vstack([J, J[0] - J[2]])
    b = J @ rng.normal(size=N)
    saddle = factor_saddle(jnp.asarray(M), jnp.asarray(J), redundant=redundant)
    x = np.asarray(saddle.right_inverse()) @ b
    np.testing.assert_allclose(J @ x, b, rtol=1e-8, atol=1e-9)
    # M x lies in the range of J^T
    rest = M @ x - J.T @ np.linalg.lstsq(J.T, M @ x, rcond=1e-11)[0]
    assert np.max(np.abs(rest)) < 1e-8 * np.max(np.abs(M @ x))


@pytest.mark.parametrize("rank", [2, 4, 6])
def test_independent_rows_span_all(rng, rank):
    """As many as the rank, spanning the same space; also of dependent rows off by 1e-8."""
    J = rng.normal(size=(N, rank)) @ rng.normal(size=(rank, 2 * N))
    off = J + 1e-8 * rng.normal(size=J.shape)
    for rows in (J, off):
        kept = np.asarray(jax.jit(independent_rows)(jnp.asarray(rows @ rows.T), 1e-12))
        assert kept.sum() == rank
        assert np.linalg.matrix_rank(rows[kept], tol=1e-6) == rank
    assert not np.any(independent_rows(jnp.zeros((3, 3)), 1e-12))


def test_rows_left_out_have_no_effect(rng):
    """With `kept`, M x - J^T y = f and J x = g of these rows only, whatever the others demand."""
    M, J, f = definite(rng), rng.normal(size=(3, N)), rng.normal(size=N)
    wrong = np.vstack([J, J[0] + 1e-9 * rng.normal(size=N)])
    g = rng.normal(size=3)
    M, wrong, f, g = (jnp.asarray(a) for a in (M, wrong, f, g))
    kept = jnp.array([True, True, True, False])
    saddle = factor_saddle(M, wrong, redundant="fast", row_mask=kept)
    x, y = saddle.solve(f, jnp.append(g, 0.0))
    expected, multipliers = factor_saddle(M, wrong[:3], redundant=False).solve(f, g)
    np.testing.assert_allclose(x, expected, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(y, np.append(multipliers, 0.0), rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(J @ saddle.right_inverse(), np.eye(3, 4), atol=1e-10)


# --- factorisations


def test_factorisations_against_scipy():
    rng = np.random.default_rng(1)
    for k in (1, 4, 9):
        A = rng.normal(size=(k, k))
        S = A @ A.T + np.eye(k)
        L = np.asarray(linalg.factor_cholesky(jnp.asarray(S)))
        np.testing.assert_allclose(L, scipy.linalg.cholesky(S, lower=True), atol=1e-13)
        for transpose in (False, True):
            x = linalg.solve_lower(jnp.asarray(L), jnp.asarray(A), transpose=transpose)
            expected = scipy.linalg.solve_triangular(L, A, lower=True, trans=int(transpose))
            np.testing.assert_allclose(x, expected, atol=1e-12)
