"""Square roots of covariances, lower triangular L with P = L L^T, and operations on them.

Arrays have their components first and the axes of a stack (the filters of a bank) last. Roots are
formed without squaring by `triangularise`, the QR decomposition of rows whose Gram matrix is P. A
rank-one change of a root has the closed form of Carlson and needs no decomposition: with
d_j = d_0 - a_1^2 - ... - a_j^2 the lower Cholesky factor T of I - a a^T / d_0 is

    T_jj = sqrt(d_j / d_(j-1)),    T_ij = -a_i a_j / sqrt(d_j d_(j-1)),  i > j.

The result for a matrix that is not positive definite is NaN, which callers test for.

Source: N. A. Carlson, Fast triangular formulation of the square root filter, AIAA Journal 11
(1973); Gram-Schmidt's R is as accurate as Householder's: N. J. Higham, Accuracy and Stability
of Numerical Algorithms (2002), theorem 19.13.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra import lapack, linalg
from ..algebra.native import native_loops
from ..algebra.stacked import multiply

Root = Float[Array, "k k *s"]

# Round-off in a pivot that should be zero, in units of epsilon.
_ROUND_OFF = 100

# Number of columns up to which written-out code is faster than LAPACK for a single matrix, and
# that in native loops, which LAPACK's calls would prevent.
_FEW, _FEW_NATIVE = 3, 12


def triangularise(rows: Float[Array, "r k *s"]) -> Root:
    """Lower triangular L with diagonal >= 0 and L L^T = rows^T rows.

    The rows are never squared, so parts of L that are small beside others keep their digits.
    """
    r, k = rows.shape[:2]
    if rows.ndim == 2 and k > (_FEW_NATIVE if native_loops() else _FEW):
        if r < k:
            rows = jnp.concatenate([rows, jnp.zeros((k - r, k), rows.dtype)])
        R = lapack.upper(rows)
        return (jnp.where(jnp.diagonal(R) < 0, -1.0, 1.0)[:, None].astype(R.dtype) * R).T
    return _assemble(_gram_schmidt(rows))


def _gram_schmidt(rows: Float[Array, "r k *s"]) -> list[Float[Array, "_ *s"]]:
    """Columns of L, from the diagonal down, by modified Gram-Schmidt.

    Every pair of columns is one pass over numbers that stay in registers, which takes half the
    time of updating all later columns at once.
    """
    left = [rows[:, j] for j in range(rows.shape[1])]
    columns = []
    while left:
        first, *left = left
        square = jnp.sum(first * first, axis=0)
        # a direction without variance: its column of L is zero
        fine = square > 0
        inverse = jnp.where(fine, 1 / jnp.sqrt(jnp.where(fine, square, 1.0)), 0.0)
        inverse = jnp.where(jnp.isnan(square), jnp.nan, inverse)
        unit = first * inverse[None]
        along = [jnp.sum(other * unit, axis=0) for other in left]
        left = [other - c[None] * unit for other, c in zip(left, along, strict=True)]
        columns.append(jnp.stack([square * inverse, *along]))
    return columns


def _assemble(columns: list[Float[Array, "_ *s"]]) -> Root:
    """Lower triangular matrix from its columns, each from the diagonal down."""
    k = len(columns)
    padded = [
        jnp.concatenate([jnp.zeros((j, *c.shape[1:]), c.dtype), c]) if j else c
        for j, c in enumerate(columns)
    ]
    return jnp.stack(padded, axis=1) if k else jnp.zeros((0, 0))


def cholesky(P: Root) -> Root:
    """Lower Cholesky factor of positive definite matrices; NaN for any other."""
    k = P.shape[0]
    if P.ndim == 2 and k > _FEW:
        return linalg.cholesky(P)
    columns = []
    for _ in range(k):
        pivot = P[:1, 0]
        column = P[:, 0] / jnp.sqrt(jnp.where(pivot > 0, pivot, jnp.nan))
        columns.append(column)
        P = P[1:, 1:] - column[1:, None] * column[None, 1:]
    return _assemble(columns)


def semidefinite(P: Root) -> Root:
    """Lower Cholesky factor of positive semi-definite matrices; NaN for any other.

    A pivot of zero, within rounding of its diagonal entry, makes a column of zeros. The factor
    is differentiable as long as the null directions stay: a variance of zero is treated as a
    constant, since its root has no derivative.
    """
    scale = jnp.stack([P[i, i] for i in range(P.shape[0])])
    allowed = _ROUND_OFF * jnp.finfo(P.dtype).eps * scale
    columns = []
    for k in range(P.shape[0]):
        pivot, below = P[0, 0], P[1:, 0]
        some = pivot > allowed[k]
        # |P_ij| <= sqrt(P_ii P_jj): the entries beside a pivot of zero are zero
        none = (pivot >= -allowed[k]) & jnp.all(below**2 <= allowed[k] * scale[k + 1 :], axis=0)
        inverse = jnp.where(some, 1 / jnp.sqrt(jnp.where(some, pivot, 1.0)), 0.0)
        inverse = jnp.where(some | none, inverse, jnp.nan)
        column = P[:, 0] * inverse
        columns.append(column)
        P = P[1:, 1:] - column[1:, None] * column[None, 1:]
    return _assemble(columns)


def outer_square(L: Root) -> Root:
    """Product L L^T, exactly symmetric."""
    return multiply(L, jnp.swapaxes(L, 0, 1))


def divide_lower(L: Root, B: Float[Array, "k r *s"]) -> Float[Array, "k r *s"]:
    """Solution L^-1 B for lower triangular L."""
    k = L.shape[0]
    if L.ndim == 2 and B.ndim == 2 and k > _FEW:
        return linalg.solve_lower(L, B)
    done: list[Array] = []
    for _ in range(k):
        row = B[0] / L[0, 0]
        done.append(row)
        B = B[1:] - L[1:, 0][:, None] * row[None]
        L = L[1:, 1:]
    return jnp.stack(done)


def reduce_root(
    M: Float[Array, "i k *s"], a: Float[Array, "k *s"], last: Float[Array, "*#s"]
) -> Float[Array, "i k *s"]:
    """Product M T, T the lower Cholesky factor of I - a a^T / (last + a^T a); see the module.

    With last > 0 all sums have positive terms, so that nothing cancels.
    """
    d = [jnp.broadcast_to(last, a.shape[1:])]
    for value in a[::-1]:
        d.append(d[-1] + value * value)
    return _columns(M, a, jnp.stack(d[::-1]))


def _columns(
    M: Float[Array, "i k *s"], a: Float[Array, "k *s"], d: Float[Array, "_ *s"]
) -> Float[Array, "i k *s"]:
    """Product M T for T with the given d_0, ..., d_k."""
    inverse = 1 / jnp.sqrt(d[1:] * d[:-1])
    kept, taken = d[1:] * inverse, a * inverse
    # sums over later columns, in reverse order
    later, columns = jnp.zeros_like(M[:, 0]), []
    for j in reversed(range(a.shape[0])):
        columns.append(M[:, j] * kept[None, j] - taken[None, j] * later)
        later = later + M[:, j] * a[None, j]
    return jnp.stack(columns[::-1], axis=1)


def downdate(L: Root, v: Float[Array, "k *s"]) -> Root:
    """Lower Cholesky factor of L L^T - v v^T; NaN where that is not positive definite."""
    a = divide_lower(L, v[:, None])[:, 0]
    k = a.shape[0]
    upto = jnp.asarray([[float(i < j) for i in range(k)] for j in range(k + 1)], a.dtype)
    upto = upto.reshape(k + 1, k, *(1,) * (a.ndim - 1))
    d = 1 - jnp.sum(jnp.swapaxes(upto, 0, 1) * (a * a)[:, None], axis=0)
    return _columns(L, a, jnp.where(d > 0, d, jnp.nan))
