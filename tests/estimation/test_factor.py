"""Square roots: against NumPy's factorisations, alone and in stacks."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.estimation import gaussians as factor

RNG = np.random.default_rng(0)
triangularise = jax.jit(factor.triangularise_rows)


def stacked(function, *arrays):
    """A function of stacks, and NumPy's of each, side by side."""
    return np.moveaxis(np.asarray(jax.jit(function)(*(jnp.asarray(a) for a in arrays))), -1, 0)


@pytest.mark.parametrize(("r", "k"), [(12, 5), (3, 5), (7, 2)])
def test_triangularise(r, k):
    rows = RNG.normal(size=(r, k, 4))
    many = stacked(factor.triangularise_rows, rows)
    for i in range(4):
        L = np.asarray(triangularise(jnp.asarray(rows[..., i])))
        np.testing.assert_allclose(L @ L.T, rows[..., i].T @ rows[..., i], atol=1e-13)
        np.testing.assert_allclose(np.abs(many[i] @ many[i].T), np.abs(L @ L.T), atol=1e-13)
        assert np.all(np.triu(L, 1) == 0)
        assert np.all(np.diag(L) >= 0)


def test_no_library_is_called_where_rows_become_machine_code(monkeypatch):
    """A call of LAPACK has no scalar form, and would leave a filter's step to XLA."""
    rows = jnp.asarray(RNG.normal(size=(25, 8)))
    found, called = [], []
    for on in (False, True):
        monkeypatch.setattr(factor, "is_on", lambda on=on: on)
        program = jax.jit(lambda rows: factor.triangularise_rows(rows))
        called.append("lapack" in program.lower(rows).as_text())
        found.append(program(rows))
    assert called == [True, False]
    np.testing.assert_allclose(*found, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("lanes", [1, 3, 11])
def test_filters_of_a_bank_go_through_machine_code_side_by_side(lanes, machine_code):
    """Each as it is alone, to the last bit, and as by XLA."""
    rows = jnp.asarray(RNG.normal(size=(40, 17, lanes)))
    machine_code(True)
    many = np.asarray(jax.jit(factor.triangularise_rows)(rows))
    alone = jax.jit(lambda rows: factor.triangularise_rows(rows))
    for k in range(lanes):
        np.testing.assert_array_equal(many[..., k], alone(rows[..., k]))
    machine_code(False)
    np.testing.assert_allclose(
        many, jax.jit(lambda x: factor.triangularise_rows(x))(rows), atol=1e-12
    )


def test_small_parts_keep_their_digits():
    """A direction 1e-12 of the other: its square is lost beside 1, its root is not."""
    rows = jnp.array([[1.0, 1.0], [0.0, 1e-12]])
    for stack in (rows, jnp.stack([rows, rows], axis=-1)):
        L = np.asarray(triangularise(stack)).reshape(2, 2, -1)[..., 0]
        np.testing.assert_allclose(L, [[1, 0], [1, 1e-12]], rtol=1e-14)


def test_division():
    A = RNG.normal(size=(6, 9, 3))
    L = np.linalg.cholesky(np.einsum("irs,jrs->sij", A, A))
    B = RNG.normal(size=(6, 2, 3))
    quotient = stacked(factor.divide_lower, np.moveaxis(L, 0, -1), B)
    for i in range(3):
        np.testing.assert_allclose(quotient[i], np.linalg.solve(L[i], B[..., i]), atol=1e-12)


def test_rank_one_changes():
    A = RNG.normal(size=(5, 9))
    L = np.linalg.cholesky(A @ A.T)
    v = 0.3 * L @ RNG.normal(size=5)
    down = np.asarray(jax.jit(factor.downdate_factor)(jnp.asarray(L), jnp.asarray(v)))
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
    assert np.isnan(np.asarray(factor.factor_semidefinite(P))).any()
    big = 2 * jnp.eye(5)[0]
    assert np.isnan(np.asarray(jax.jit(factor.downdate_factor)(jnp.eye(5), big))).any()


def test_semidefinite():
    """Zero variances, rank one, banks; the square comes back, what is no covariance is NaN."""
    g = np.array([0.5, 0.0, 2.0])
    single = [
        np.diag([2.0, 0.0, 3.0]),
        np.outer(g, g),
        np.zeros((3, 3)),
        np.eye(3) + np.outer(g, g),
    ]
    L = jax.jit(factor.factor_semidefinite)(jnp.stack([jnp.asarray(P) for P in single], -1))
    square = np.asarray(factor.outer_square(L))
    np.testing.assert_allclose(square, np.stack(single, -1), rtol=0, atol=1e-14)
    for P in ([[0.0, 1.0], [1.0, 0.0]], [[1.0, 2.0], [2.0, 1.0]], [[-1.0, 0.0], [0.0, 1.0]]):
        assert np.any(np.isnan(factor.factor_semidefinite(jnp.array(P))))
