"""Products of small matrices and vectors in stacks, and symmetric systems of a few rows in closed form.

Components come first, then any axes of a stack: bodies, joints, states of a batch. Sums over
components are written out, so that they fuse with the operations before and after them into loops
over the last axes; the call of a library's product of 3x3 matrices costs more than its arithmetic.
So does a factorisation of up to six rows: up to three are solved by cofactors, more by two blocks,

    [P Q; Q^T R] [x; y] = [b; c]:    (R - Q^T P^-1 Q) y = c - Q^T P^-1 b,

without pivoting, as the matrix is positive definite.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def dot_product(a: Float[Array, "k *#s"], b: Float[Array, "k *#s"]) -> Float[Array, "..."]:
    """Scalar product a . b of vectors."""
    return jnp.sum(a * b, axis=0)


def apply_matrix(
    A: Float[Array, "i j *#s"], b: Float[Array | np.ndarray, "j *#s"]
) -> Float[Array, "i ..."]:
    """Product A b of a matrix and a vector."""
    return jnp.sum(A * b[None], axis=1)


def apply_transposed(A: Float[Array, "i j *#s"], b: Float[Array, "i *#s"]) -> Float[Array, "j ..."]:
    """Product A^T b of a transposed matrix and a vector."""
    return jnp.sum(A * b[:, None], axis=0)


def multiply_matrices(
    A: Float[Array, "i j *#s"], B: Float[Array, "j k *#s"]
) -> Float[Array, "i k ..."]:
    """Product A B of two matrices."""
    return jnp.sum(A[:, :, None] * B[None], axis=1)


def transposed_multiply(
    A: Float[Array, "r i *#s"], B: Float[Array, "r k *#s"]
) -> Float[Array, "i k ..."]:
    """Product A^T B of two matrices; exactly symmetric if A and B are the same array."""
    return jnp.sum(A[:, :, None] * B[:, None], axis=0)


def unit_matrix(like: Float[Array | np.ndarray, "3 *#s"]) -> Float[Array, "3 3 ..."]:
    """Unit matrix (3, 3), with axes of length one for those of a stack of vectors."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *(1,) * (like.ndim - 1))


def sum_columns(rows: Float[Array, "w k *s"], table: np.ndarray) -> Float[Array, "w f *s"]:
    """Sums of columns, weighted by a constant table (k, f)."""
    weights = table.astype(float).reshape(1, *table.shape, *(1,) * (rows.ndim - 2))
    return jnp.sum(rows[:, :, None] * weights, axis=1)


# Number of rows up to which the closed form is worth its traced operations.
MOST_ROWS = 6

Square = Float[Array, "k k *#s"]


def solve_definite(A: Square, B: Float[Array, "k r *#s"]) -> Float[Array, "k r ..."]:
    """Solution X of A X = B for symmetric positive definite A, k <= 6; NaN for any other A."""
    k = A.shape[0]
    if k > MOST_ROWS:
        raise ValueError(
            f"solve_definite serves up to {MOST_ROWS} rows, not {k}: use a factorisation."
        )
    if k <= 3:
        return multiply_matrices(invert_definite(A), B)
    # By blocks of three rows with the Schur complement: a few elementwise operations over the stack,
    # where a factorisation is one call per matrix.
    P_inv, Q = invert_definite(A[:3, :3]), A[:3, 3:]
    T = multiply_matrices(P_inv, Q)
    T_t = jnp.swapaxes(T, 0, 1)
    y = multiply_matrices(
        invert_definite(A[3:, 3:] - multiply_matrices(T_t, Q)),
        B[3:] - multiply_matrices(T_t, B[:3]),
    )
    return jnp.concatenate([multiply_matrices(P_inv, B[:3]) - multiply_matrices(T, y), y])


def invert_definite(A: Square) -> Float[Array, "k k ..."]:
    """Inverse of symmetric positive definite matrices (k, k, *s), k <= 3; NaN for any other."""
    k = A.shape[0]
    # NaN instead of a wrong number: a matrix that has lost definiteness must show in the results.
    if k == 1:
        return jnp.where(A > 0, 1 / A, jnp.nan)
    if k == 2:
        signs = jnp.array([[1.0, -1.0], [-1.0, 1.0]]).reshape(2, 2, *(1,) * (A.ndim - 2))
        adjugate = signs * A[::-1, ::-1]
        is_definite = A[0, 0] > 0
    else:
        # rows and columns repeated in a cycle give all cofactors at once
        B = jnp.concatenate([A, A[:2]])
        B = jnp.concatenate([B, B[:, :2]], axis=1)
        adjugate = B[1:4, 1:4] * B[2:5, 2:5] - B[1:4, 2:5] * B[2:5, 1:4]
        is_definite = (A[0, 0] > 0) & (adjugate[2, 2] > 0)
    determinant = jnp.sum(A[0] * adjugate[0], axis=0)
    return adjugate / jnp.where(is_definite & (determinant > 0), determinant, jnp.nan)[None, None]
