"""Factorisations by LAPACK that never wait for each other, and small systems without it.

On a CPU, JAX spreads LAPACK's calls for a large batch of matrices over the threads of a pool, and the
call itself waits on a thread of the same pool until they have ended. Where as many such calls run at
once as the pool has threads (two, on a machine with two cores), each waits for threads that the others
hold: the program then stands still for ever, without an error. Here a batch that JAX would spread is
factorised in blocks that are too small for it, one after the other, so that no call waits. Without
`vmap`, and for small batches, the programs are those of `jax.numpy.linalg`.

The rest of the package takes its factorisations from here; a test looks for others.

Source: `GetLapackBatchChunkSize` and `ParallelBatchMap` in jaxlib/cpu/lapack_kernels.cc of JAX 0.10,
where batches of less than 2e5 operations stay on one thread.
"""

import math
from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
from jaxtyping import Array, Complex, Float

from ..checks.shapes import Matrix, Vector
from .native.program import native

# Operations of a block, by the counts below. JAX spreads batches from 200,000 on.
_MOST_WORK = 100_000


def _in_blocks(operations: int) -> Callable[[Callable[[Array], Any]], Callable[[Array], Any]]:
    """Decorator: a factorisation of stacks (*s, m, n), block by block where a stack is large.

    Args:
        operations: of one matrix, in units of m n min(m, n); at least what JAX counts.
    """

    def decorate_factorisation(factorise: Callable[[Array], Any]) -> Callable[[Array], Any]:
        @jax.custom_batching.custom_vmap
        def call(A: Array) -> Any:
            *stack, m, n = A.shape
            most = max(1, _MOST_WORK // max(1, operations * m * n * min(m, n)))
            if math.prod(stack) <= most:
                return factorise(A)
            blocks = partial(_one_by_one, factorise, most)
            return jax.lax.platform_dependent(A, cpu=blocks, default=factorise)

        @call.def_vmap
        def stacked(axis_size: int, in_batched: Any, A: Array) -> tuple[Any, Any]:
            del axis_size, in_batched
            factors = call(A)
            return factors, jax.tree.map(lambda _: True, factors)

        return wraps(factorise)(call)

    return decorate_factorisation


def _one_by_one(factorise: Callable[[Array], Any], most: int, A: Array) -> Any:
    """Factorisations of a stack (*s, m, n), `most` matrices at a time."""
    *stack, m, n = A.shape
    count = math.prod(stack)
    # a divisor of the count needs no filling up
    size = next((k for k in range(most, most // 2, -1) if count % k == 0), most)
    rows = -(-count // size)
    matrices = _transpose_each(A.reshape(count, m, n))
    if rows * size > count:
        # the last block is filled up with identities, which every factorisation takes
        filled = jnp.broadcast_to(jnp.eye(n, m, dtype=A.dtype), (rows * size - count, n, m))
        matrices = jnp.concatenate([matrices, filled])
    # LAPACK's matrices lie column by column, those that a loop reads and writes row by row: turned
    # before and after, a matrix passes through the loop without a copy
    block = lambda B: jax.tree.map(_transpose_each, factorise(_transpose_each(B)))
    factors = jax.lax.map(block, matrices.reshape(rows, size, n, m))
    whole = lambda x: _transpose_each(x.reshape(-1, *x.shape[2:])[:count])
    return jax.tree.map(lambda x: whole(x).reshape(*stack, *whole(x).shape[1:]), factors)


def _transpose_each(X: Array) -> Array:
    """Transposes (k, n, m) of matrices (k, m, n); vectors (k, n) stay."""
    return jnp.swapaxes(X, 1, 2) if X.ndim == 3 else X


@_in_blocks(operations=1)
def _factor_lu(A: Array) -> tuple[Array, Array, Array]:
    lu, pivots, order = jax.lax.linalg.lu(A)
    return lu, pivots, order


@_in_blocks(operations=1)
def factor_cholesky(S: Array) -> Array:
    """Lower Cholesky factor (n, n) of a symmetric matrix, NaN if not positive definite; no derivative."""
    return jax.lax.linalg.cholesky(S, symmetrize_input=False)


@_in_blocks(operations=4)
def factor_qr(A: Array) -> tuple[Array, Array]:
    """Factors Q (m, k), R (k, n) of A = Q R, with k = min(m, n) orthonormal columns; no derivative."""
    Q, R = jnp.linalg.qr(A)
    return Q, R


@_in_blocks(operations=4)
def _factor_upper(A: Array) -> Array:
    return jnp.linalg.qr(A, mode="r")


@_in_blocks(operations=10)
def factor_svd(A: Array) -> tuple[Array, Array, Array]:
    """Factors U (m, k), s (k,), V^T (k, n) of A = U diag(s) V^T, k = min(m, n); no derivative."""
    U, values, V_t = jnp.linalg.svd(A, full_matrices=False)
    return U, values, V_t


@_in_blocks(operations=10)
def _singular_values(A: Array) -> Array:
    return jnp.linalg.svd(A, compute_uv=False)


@_in_blocks(operations=30)
def compute_eigenvalues(A: Array) -> Complex[Array, "*s n"]:
    """Eigenvalues (n,) of a general matrix; no derivative."""
    return jnp.linalg.eigvals(A)


# Matrices up to this size are solved without LAPACK: a call of it takes longer than their operations, and
# straight code becomes a part of the machine code around it.
_SMALL = 12


def solve(A: Matrix, b: Float[Array, "n *r"]) -> Float[Array, "n *r"]:
    """Solution x of A x = b for a general square matrix.

    Small systems are solved by Householder reflections of the rows scaled to unit size, large ones by LU
    factorisation with pivots. Derivatives of any order, in both modes, follow from A x = b. A singular
    matrix gives numbers that are not finite, or very large where round-off hides it, and raises no error.

    Args:
        A: matrix (n, n). b: right-hand side (n,), or several of them as columns (n, r).

    Returns:
        Solution of the shape of b.
    """
    constant = jax.lax.stop_gradient(A)
    columns = b[:, None] if b.ndim == 1 else b
    if len(A) <= _SMALL:
        forward_solve = lambda _, b: _solve_by_reflections(constant, b)
        transpose_solve = lambda _, b: _solve_by_reflections(constant.T, b)
    else:
        lu, _, order = _factor_lu(constant)
        forward_solve = lambda _, b: _solve_factored(lu, order, b)
        transpose_solve = lambda _, b: _solve_transposed(lu, order, b)
    x = jax.lax.custom_linear_solve(lambda x: A @ x, columns, forward_solve, transpose_solve)
    return x[:, 0] if b.ndim == 1 else x


def _solve_by_reflections(A: Matrix, b: Matrix) -> Matrix:
    # Rows of different units, cosines beside metres, would lose digits: reflections mix them.
    scale = 1 / jnp.sqrt(jnp.sum(A * A, axis=1, keepdims=True))
    return _reflect_columns(scale * A, scale * b)


@native
def _reflect_columns(A: Matrix, B: Matrix) -> Matrix:
    """Matrix X (n, r) of the least |A X - B| for A (m, n) of rank n, as straight code without pivots.

    It is not finite where a column of A depends on those before it within round-off.

    Source: G. H. Golub, C. F. Van Loan, Matrix Computations (2013), sec. 5.2 and 5.3.
    """
    m, n = A.shape
    rows, zero = jnp.arange(m), jnp.zeros((), A.dtype)
    round_off = (2 * m * jnp.finfo(A.dtype).eps) ** 2

    def reflect(rest: Matrix, at: tuple[Array, Array]) -> tuple[Matrix, Array]:
        # v is the rest of a column less its image, a multiple of a unit vector; of both signs the one that
        # cancels no digits. |v|^2 = -2 image v_k. Of a column that depends on those before it, only
        # round-off is left: an image of zero makes the result infinite or NaN.
        k, whole = at
        column = jnp.where(rows >= k, rest[:, k], zero)
        square = jnp.sum(column * column)
        length = jnp.where(square <= round_off * whole, zero, jnp.sqrt(square))
        image = jnp.where(column[k] >= 0, -length, length)
        v = jnp.where(rows == k, column - image, column)
        return rest + jnp.outer(v, v @ rest * (1 / (image * v[k]))), image

    def substitute(X: Matrix, at: tuple[Array, Array, Array]) -> tuple[Matrix, None]:
        k, row, diagonal = at
        right = jnp.where(jnp.arange(n) > k, row[:n], zero)
        return X.at[k].set((row[n:] - right @ X) / diagonal), None

    # loops, which machine code unrolls, and of which XLA compiles one pass
    columns = (jnp.arange(n), jnp.sum(A * A, axis=0))
    rest, images = jax.lax.scan(reflect, jnp.concatenate([A, B], axis=1), columns)
    parts = (jnp.arange(n), rest[:n], images)
    return jax.lax.scan(substitute, jnp.zeros_like(B[:n]), parts, reverse=True)[0]


_unit_lower = partial(
    jax.lax.linalg.triangular_solve, left_side=True, lower=True, unit_diagonal=True
)
_upper_solve = partial(jax.lax.linalg.triangular_solve, left_side=True, lower=False)


def _solve_factored(lu: Matrix, order: Array, b: Matrix) -> Matrix:
    """Solution of A x = b from P A = L U, with the rows of P in `order`."""
    return _upper_solve(lu, _unit_lower(lu, b[order]))


def _solve_transposed(lu: Matrix, order: Array, b: Matrix) -> Matrix:
    """Solution of A^T x = b from P A = L U, with the rows of P in `order`."""
    x = _unit_lower(lu, _upper_solve(lu, b, transpose_a=True), transpose_a=True)
    return x[jnp.argsort(order)]


def inverse(A: Float[Array, "*s n n"]) -> Float[Array, "*s n n"]:
    """Inverses (*s, n, n) of general square matrices (*s, n, n), with the derivatives of `solve`.

    A singular matrix gives numbers that are not finite, and raises no error.
    """
    invert = lambda A: solve(A, jnp.eye(A.shape[-1], dtype=A.dtype))
    return jnp.vectorize(invert, signature="(n,n)->(n,n)")(A)


def sign_of_determinant(A: Matrix) -> Float[Array, ""]:
    """Sign of det A: -1, 0 or 1; it has no derivative."""
    lu, pivots, _ = _factor_lu(jax.lax.stop_gradient(A))
    swaps = jnp.sum(pivots != jnp.arange(len(pivots)))
    return jnp.prod(jnp.sign(jnp.diagonal(lu))) * jnp.where(swaps % 2, -1.0, 1.0)


@jax.custom_jvp
def upper_factor(A: Matrix) -> Matrix:
    """Upper triangular R (k, n) with R^T R = A^T A, k = min(m, n), of A (m, n); signs are any.

    Derivatives exist for m >= n and full rank.
    """
    return _factor_upper(A)


@upper_factor.defjvp
def _upper_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    """R' = X R: with S = R^-T A^T A' R^-1, X is S above the diagonal plus what is below, mirrored."""
    (A,), (rate,) = primals, tangents
    R = upper_factor(A)
    right = lambda B: _upper_solve(R, B.T, transpose_a=True).T
    S = right(A).T @ right(rate)
    return R, (jnp.triu(S) + jnp.tril(S, -1).T) @ R


@jax.custom_jvp
def singular_values(A: Matrix) -> Vector:
    """Singular values (k,) of a matrix (m, n), k = min(m, n), the largest first.

    Derivatives exist where the values are distinct.
    """
    return _singular_values(A)


@singular_values.defjvp
def _values_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Vector, Vector]:
    U, values, V_t = factor_svd(primals[0])
    return values, jnp.sum(U * (tangents[0] @ V_t.T), axis=0)


@partial(jax.custom_jvp, nondiff_argnums=(1,))
def pseudoinverse(A: Matrix, rcond: float) -> Matrix:
    """Moore-Penrose inverse (n, m) of a matrix (m, n), of a small one of full rank by reflections.

    Singular values up to `rcond` times the largest count as zero.

    Derivatives exist where the rank stays the same. Source: G. H. Golub, V. Pereyra, The
    differentiation of pseudo-inverses, SIAM Journal on Numerical Analysis 10 (1973), eq. 4.12.
    """
    if max(A.shape) > _SMALL or 0 in A.shape:
        return _invert_values(A, rcond)
    is_tall = A.shape[0] >= A.shape[1]
    tall = A if is_tall else A.T
    P = _reflect_columns(tall, jnp.eye(len(tall), dtype=A.dtype))
    P = P if is_tall else P.T
    # The product of the norms is the condition number, or up to min(m, n) times it: where it is small, all
    # singular values count. A loop that ends before its first pass, and no choice: of a stack, both cases
    # of a choice would be computed. XLA would take what does not change out of a loop.
    is_regular = jnp.linalg.norm(A) * jnp.linalg.norm(P) * rcond < 0.1
    by_values = lambda now: (_invert_values(now[0].T, rcond), jnp.array(True))
    start = (jnp.where(is_regular, P, A.T), is_regular)
    return jax.lax.while_loop(lambda now: ~now[1], by_values, start)[0]


def _invert_values(A: Matrix, rcond: float) -> Matrix:
    U, values, V_t = factor_svd(A)
    counts = values > rcond * jnp.max(values, initial=0.0)
    shares = jnp.where(counts, 1 / jnp.where(counts, values, 1.0), 0.0)
    return (V_t.T * shares[None]) @ U.T


@pseudoinverse.defjvp
def _pseudoinverse_jvp(
    rcond: float, primals: tuple[Matrix], tangents: tuple[Matrix]
) -> tuple[Matrix, Matrix]:
    (A,), (rate,) = primals, tangents
    P = pseudoinverse(A, rcond)
    left_null_part, right_null_part = rate.T - (rate.T @ A) @ P, rate.T - P @ (A @ rate.T)
    return P, -P @ rate @ P + P @ (P.T @ left_null_part) + right_null_part @ (P.T @ P)


class PseudoinverseSolver(lx.AbstractLinearSolver):
    """Solver of lineax by `pseudoinverse`, for operators between vectors.

    Attributes:
        rcond: singular values up to this fraction of the largest count as zero.
    """

    rcond: float

    def init(self, operator: Any, options: dict[str, Any]) -> Matrix:
        del options
        return pseudoinverse(operator.as_matrix(), self.rcond)

    def compute(self, state: Matrix, vector: Vector, options: dict[str, Any]) -> Any:
        del options
        return state @ vector, lx.RESULTS.successful, {}

    def transpose(self, state: Matrix, options: dict[str, Any]) -> tuple[Matrix, dict[str, Any]]:
        del options
        return state.T, {}

    def conj(self, state: Matrix, options: dict[str, Any]) -> tuple[Matrix, dict[str, Any]]:
        del options
        return state, {}

    def assume_full_rank(self) -> bool:
        return False
