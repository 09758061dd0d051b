"""Factorisations of small matrices as loops over their columns, without a library call.

XLA compiles a loop of array operations into one native function only if no library is called in it
(`native`). LAPACK's calls for the small matrices of a mechanism cost little themselves, but they keep
all around them from becoming native. Each pass of these loops computes one column by a product of the
columns before it, so that only this column is written:

    v = S_j - L L_j,    L_j = v / sqrt(v_j).

There is no such loop for an LU factorisation: with pivots it takes three times as long as LAPACK's. The
implicit methods have one a step, and its call keeps their steps, with all that is in them, from becoming
one function, which would compile for minutes.

The functions take part in derivatives by rules for the solution, not by differentiation of the loops.

Source: N. J. Higham, Accuracy and Stability of Numerical Algorithms (2002), ch. 10.1
(Cholesky's method).
"""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.shapes import Matrix

# Largest matrices for which loops are taken: beyond, LAPACK's blocks of columns outweigh its calls.
LARGEST = 64

_put = jax.lax.dynamic_update_index_in_dim


def _pick(A: Array, j: Any, axis: int = 0) -> Array:
    return jax.lax.dynamic_index_in_dim(A, j, axis, keepdims=False)


def cholesky(S: Matrix) -> Matrix:
    """Lower Cholesky factor (n, n) of a symmetric positive definite matrix; NaN for any other."""
    order = jnp.arange(S.shape[0])

    def column(j: Any, L: Matrix) -> Matrix:
        v = _pick(S, j) - L @ _pick(L, j)
        pivot = jnp.where(v[j] > 0, v[j], jnp.nan)
        return _put(L, jnp.where(order >= j, v / jnp.sqrt(pivot), 0.0), j, 1)

    return jax.lax.fori_loop(0, S.shape[0], column, jnp.zeros_like(S))


def solve_columns(columns: Matrix, b: Float[Array, "n *r"], *, upper: bool) -> Float[Array, "n *r"]:
    """Solution of a triangular system by subtraction of one column after the other.

    Args:
        columns: columns of the triangular matrix as rows (n, n); entries outside are not read.
        b: right-hand sides (n,) or (n, r).
        upper: the matrix is upper triangular, otherwise lower.
    """
    n = b.shape[0]
    place = jnp.arange(n)

    def subtract(k: Any, b: Array) -> Array:
        j = n - 1 - k if upper else k
        column = _pick(columns, j)
        x = _pick(b, j) / column[j]
        later = place < j if upper else place > j
        left = b - jnp.where(later, column, 0.0).reshape(n, *(1,) * (b.ndim - 1)) * x
        return _put(left, x, j, 0)

    return jax.lax.fori_loop(0, n, subtract, b)


def multiply_rows(A: Float[Array, "m k"], B: Float[Array, "n k"]) -> Float[Array, "m n"]:
    """Product A B^T, row by row.

    In a native loop XLA would compute the entries of A and B again for each of their products; a loop
    over the rows has them stored first.
    """
    return jax.lax.map(lambda row: B @ row, A)
