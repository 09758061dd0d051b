"""Factorisations by LAPACK: values, derivatives, large stacks, and calls that do not wait for each other."""

import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.math import lapack

PACKAGE = Path(lapack.__file__).parents[1]
RNG = np.random.default_rng(18)
SQUARE, TALL = RNG.standard_normal((6, 6)), RNG.standard_normal((7, 4))
COLUMNS = RNG.standard_normal((6, 2))

# ours, NumPy's or JAX's, arguments
CASES = {
    "solve": (lapack.solve, jnp.linalg.solve, (SQUARE, COLUMNS)),
    "solve, one column": (lapack.solve, jnp.linalg.solve, (SQUARE, COLUMNS[:, 0])),
    "inverse": (lapack.inverse, jnp.linalg.inv, (SQUARE,)),
    "upper": (lapack.upper_factor, lambda A: jnp.linalg.qr(A, mode="r"), (TALL,)),
    "singular values": (
        lapack.singular_values,
        lambda A: jnp.linalg.svd(A, compute_uv=False),
        (TALL,),
    ),
    "pseudoinverse": (
        lambda A: lapack.pseudoinverse(A, 1e-12),
        lambda A: jnp.linalg.pinv(A, rtol=1e-12),
        (TALL,),
    ),
    "pseudoinverse of a wide matrix": (
        lambda A: lapack.pseudoinverse(A, 1e-12),
        lambda A: jnp.linalg.pinv(A, rtol=1e-12),
        (TALL.T,),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_values_and_derivatives_are_those_of_jax(name):
    """Values, tangents and gradients; a stack that is factorised in blocks gives the same."""
    ours, known, given = CASES[name]
    given = tuple(map(jnp.asarray, given))
    moved = tuple(jnp.asarray(RNG.standard_normal(a.shape)) for a in given)
    value, tangent = jax.jvp(ours, given, moved)
    exact = jax.jvp(known, given, moved)
    np.testing.assert_allclose(value, exact[0], atol=1e-13)
    np.testing.assert_allclose(tangent, exact[1], atol=1e-12)
    weights = jnp.asarray(RNG.standard_normal(value.shape))
    gradient = lambda f: jax.grad(lambda *a: jnp.sum(weights * f(*a)), argnums=0)
    own = gradient(ours)(*given)
    np.testing.assert_allclose(own, gradient(known)(*given), atol=1e-12)
    # more operations than stay in one block, in two axes
    count = 3 * lapack._MOST_WORK // (10 * np.prod(given[0].shape) * min(given[0].shape))
    stack = [jnp.stack([jnp.stack([a, 1.1 * a])] * count) for a in given]
    twice = lambda f: jax.jit(jax.vmap(jax.vmap(f)))
    np.testing.assert_allclose(twice(ours)(*stack)[count // 2, 0], value, atol=1e-13)
    np.testing.assert_allclose(twice(gradient(ours))(*stack)[-1, 0], own, atol=1e-12)


def test_a_stack_in_blocks_is_that_of_numpy():
    """Cholesky, QR, SVD, eigenvalues of 900 matrices, none of them like the ones beside it."""
    A = RNG.standard_normal((900, 6, 6))
    S = A @ np.swapaxes(A, 1, 2) + np.eye(6)
    stacked = lambda f, x: jax.jit(jax.vmap(f))(x)
    np.testing.assert_allclose(
        stacked(lapack.factor_cholesky, S), np.linalg.cholesky(S), atol=1e-12
    )
    Q, R = stacked(lapack.factor_qr, A)
    np.testing.assert_allclose(Q @ R, A, atol=1e-12)
    U, values, V_t = stacked(lapack.factor_svd, A)
    np.testing.assert_allclose((U * values[:, None]) @ V_t, A, atol=1e-12)
    found = np.sort_complex(np.asarray(stacked(lapack.compute_eigenvalues, S)))
    np.testing.assert_allclose(found, np.linalg.eigvalsh(S), rtol=1e-9)
    signs = stacked(lapack.sign_of_determinant, A)
    np.testing.assert_array_equal(signs, np.sign(np.linalg.det(A)))


def test_a_singular_matrix_is_not_solved():
    assert not np.isfinite(lapack.solve(jnp.zeros((3, 3)), jnp.ones(3))).any()
    for size in (2, 3, 8):
        A = np.random.default_rng(size).standard_normal((size, size)) * 10.0 ** np.arange(size)
        for singular in (np.vstack([A[:-1], 2 * A[:1]]), np.hstack([A[:, :-1], A[:, :1]])):
            assert not np.isfinite(lapack.solve(jnp.asarray(singular), jnp.ones(size))).any()
        # columns of other units are no columns that depend on others
        assert np.isfinite(lapack.solve(jnp.asarray(A), jnp.ones(size))).all()
    assert lapack.sign_of_determinant(jnp.zeros((3, 3))) == 0
    np.testing.assert_array_equal(lapack.pseudoinverse(jnp.zeros((3, 2)), 1e-9), np.zeros((2, 3)))


@pytest.mark.parametrize("size", [1, 2, 12, 13])
def test_systems_whose_rows_have_other_units_and_no_leading_entries(size):
    """Solutions to their condition, which scaling of rows leaves as it is; the largest is LAPACK's."""
    rng = np.random.default_rng(size)
    A = rng.standard_normal((size, size)) + 2 * np.eye(size)[::-1]
    A[0, 0] = 0.0 if size > 1 else 3.0
    units = 10.0 ** rng.integers(-9, 9, size)
    b = rng.standard_normal((size, 2))
    solved = jax.jit(lapack.solve)(units[:, None] * A, units[:, None] * b)
    bound = 10 * np.finfo(float).eps * np.linalg.cond(A)
    exact = np.linalg.solve(A, b)
    assert np.max(np.abs(solved - exact)) < bound * np.max(np.abs(exact))


@pytest.mark.parametrize("shape", [(4, 4), (3, 5), (5, 3)])
def test_pseudoinverses_of_a_stack_in_which_some_matrices_have_dependent_rows(shape):
    """Each is NumPy's, and that of the matrix alone; NaN stays in its place."""
    stack = np.random.default_rng(3).standard_normal((6, *shape))
    stack[1, :, 0] = 2 * stack[1, :, 1]
    stack[2, 0] = stack[2, 1]
    stack[3] = 0.0
    stack[4, 0, 0] = np.nan
    invert = lambda A: lapack.pseudoinverse(A, 1e-12)
    together = np.asarray(jax.jit(jax.vmap(invert))(stack))
    alone = np.stack([jax.jit(invert)(A) for A in stack])
    exact = np.stack([np.linalg.pinv(A, rcond=1e-12) for A in np.delete(stack, 4, 0)])
    np.testing.assert_allclose(np.delete(together, 4, 0), exact, atol=1e-13)
    np.testing.assert_allclose(alone, together, atol=1e-13)
    assert np.isnan(together[4]).all()


def test_a_solver_of_lineax_takes_dependent_rows():
    """The solution of minimum norm, forwards and transposed, as SciPy's least squares."""
    import lineax as lx

    A = np.stack([TALL[:, 0], TALL[:, 1], TALL[:, 0] - 2 * TALL[:, 1]])
    b = A @ np.ones(7)
    solver = lapack.PseudoinverseSolver(1e-11)
    operator = lx.MatrixLinearOperator(jnp.asarray(A))
    solved = lambda b: lx.linear_solve(operator, b, solver, throw=False).value
    exact = np.linalg.lstsq(A, b, rcond=1e-11)[0]
    np.testing.assert_allclose(solved(jnp.asarray(b)), exact, atol=1e-13)
    back = jax.grad(lambda b: jnp.sum(solved(b)))(jnp.asarray(b))
    np.testing.assert_allclose(back, np.linalg.pinv(A, rcond=1e-11).T @ np.ones(7), atol=1e-13)


CALLS = """
import jax, jax.numpy as jnp, numpy as np
jax.config.update("jax_enable_x64", True)
from stmuav_jax.math import lapack
functions = {
    "solve": lambda A: lapack.solve(A, A[:, :3]), "cholesky": lapack.factor_cholesky, "upper": lapack.upper_factor,
    "values": lapack.singular_values, "eigenvalues": lapack.compute_eigenvalues,
}
A = 0.1 * np.random.default_rng(0).standard_normal((24, 64, 18, 18)) + np.eye(18)
# each factorisation has work of its own before it, so that XLA gives them to several threads
for one in functions.values():
    many = jax.jit(lambda A: [jax.vmap(one)(jnp.sin(a) * jnp.cos(a)) for a in A])
    for _ in range(5):
        jax.block_until_ready(many(list(A)))
print("done")
"""


@pytest.mark.slow
def test_calls_at_once_do_not_wait_for_each_other():
    """24 independent factorisations of 64 matrices each: by `jax.numpy.linalg` they stand still."""
    given = {**os.environ, "PJRT_NPROC": "2", "JAX_PLATFORMS": "cpu"}
    ran = subprocess.run(
        [sys.executable, "-c", CALLS], env=given, timeout=300, capture_output=True, text=True
    )
    assert ran.stdout.strip() == "done", ran.stderr


def test_the_package_takes_its_factorisations_from_here():
    """No other module calls a factorisation of JAX, SciPy's for JAX, or lineax."""
    names = (
        "solve|inv|qr|svd|svdvals|pinv|eig|eigh|eigvals|eigvalsh|det|slogdet|cholesky|lstsq|cond|lu"
    )
    call = re.compile(
        rf"(jnp|jax\.lax|jax\.scipy|lax)\.linalg\.({names})\w*\(|\blx\.[A-Z]\w+\(|norm\(\w+, 2\)"
    )
    for path in PACKAGE.rglob("*.py"):
        if path.name == "lapack.py":
            continue
        lines = [line for line in path.read_text().splitlines() if "np.linalg.norm" not in line]
        found = [line for line in lines if call.search(line) and " np.linalg" not in line]
        assert not found, f"{path.name}: {found}"
