"""Symmetric positive definite systems of a few rows, solved in closed form.

For up to six rows the call of a library's factorisation costs more than its arithmetic, and there
is one call per matrix of a batch. The closed form fuses with the operations before and after
it, over all matrices of a stack (`stmuav_jax.algebra.stacked`): components first, the axes of a
stack last. Up to three rows are solved by cofactors, more by two blocks,

    [P Q; Q^T R] [x; y] = [b; c]:    (R - Q^T P^-1 Q) y = c - Q^T P^-1 b,

which needs no pivoting as the matrix is positive definite.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from .stacked import multiply

# Number of rows up to which the closed form is worth its traced operations.
LARGEST = 6

Square = Float[Array, "k k *#s"]


def solve(A: Square, B: Float[Array, "k r *#s"]) -> Float[Array, "k r ..."]:
    """Solution X of A X = B for symmetric positive definite A, k <= 6; NaN for any other A."""
    k = A.shape[0]
    if k > LARGEST:
        raise ValueError(f"solve serves up to {LARGEST} rows, not {k}: use a factorisation.")
    if k <= 3:
        return multiply(inverse(A), B)
    P_inv, Q = inverse(A[:3, :3]), A[:3, 3:]
    T = multiply(P_inv, Q)
    T_t = jnp.swapaxes(T, 0, 1)
    y = multiply(inverse(A[3:, 3:] - multiply(T_t, Q)), B[3:] - multiply(T_t, B[:3]))
    return jnp.concatenate([multiply(P_inv, B[:3]) - multiply(T, y), y])


def inverse(A: Square) -> Float[Array, "k k ..."]:
    """Inverse of symmetric positive definite matrices (k, k, *s), k <= 3; NaN for any other."""
    k = A.shape[0]
    if k == 1:
        return jnp.where(A > 0, 1 / A, jnp.nan)
    if k == 2:
        signs = jnp.array([[1.0, -1.0], [-1.0, 1.0]]).reshape(2, 2, *(1,) * (A.ndim - 2))
        adjugate = signs * A[::-1, ::-1]
        fine = A[0, 0] > 0
    else:
        # rows and columns repeated in a cycle give all cofactors at once
        B = jnp.concatenate([A, A[:2]])
        B = jnp.concatenate([B, B[:, :2]], axis=1)
        adjugate = B[1:4, 1:4] * B[2:5, 2:5] - B[1:4, 2:5] * B[2:5, 1:4]
        fine = (A[0, 0] > 0) & (adjugate[2, 2] > 0)
    determinant = jnp.sum(A[0] * adjugate[0], axis=0)
    return adjugate / jnp.where(fine & (determinant > 0), determinant, jnp.nan)
