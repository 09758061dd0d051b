"""Products of small matrices and vectors in stacks.

Components come first, then any axes of a stack: bodies, joints, states of a batch. Sums over
components are written out, so that they fuse with the operations before and after them into loops
over the last axes; the call of a library's product of 3x3 matrices costs more than its arithmetic.
"""

from collections.abc import Sequence

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


def gather_entries(
    table: Float[Array, "..."], places: np.ndarray | Sequence[int], axis: int = 0
) -> Float[Array, "..."]:
    """Entries of a table at known places along an axis, none of which is negative or beyond its end."""
    return table.at[(slice(None),) * axis + (np.asarray(places, int),)].get(
        mode="promise_in_bounds", wrap_negative_indices=False
    )
