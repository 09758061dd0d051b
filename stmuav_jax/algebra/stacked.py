"""Products of small matrices and vectors whose further axes come last.

Components first, then any axes of a stack: bodies, joints, states of a batch. Sums over
components are written out, so that they fuse with what comes before and after into loops
over the last axes; a library's matrix product of 3x3 matrices costs more to call than to do.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def dot(a: Float[Array, "k *#s"], b: Float[Array, "k *#s"]) -> Float[Array, "..."]:
    """a . b."""
    return jnp.sum(a * b, axis=0)


def apply(A: Float[Array, "i j *#s"], b: Float[Array, "j *#s"]) -> Float[Array, "i ..."]:
    """A b."""
    return jnp.sum(A * b[None], axis=1)


def apply_transposed(A: Float[Array, "i j *#s"], b: Float[Array, "i *#s"]) -> Float[Array, "j ..."]:
    """A^T b."""
    return jnp.sum(A * b[:, None], axis=0)


def multiply(A: Float[Array, "i j *#s"], B: Float[Array, "j k *#s"]) -> Float[Array, "i k ..."]:
    """A B."""
    return jnp.sum(A[:, :, None] * B[None], axis=1)


def eye(like: Float[Array | np.ndarray, "3 *#s"]) -> Float[Array, "3 3 ..."]:
    """The unit matrix, with axes of length one for those of a stack of vectors."""
    return jnp.eye(3, dtype=like.dtype).reshape(3, 3, *(1,) * (like.ndim - 1))


def summed(rows: Float[Array, "w k *s"], table: np.ndarray) -> Float[Array, "w f *s"]:
    """Sums of columns, with the weights (k, f) of a constant table."""
    weights = table.astype(float).reshape(*table.shape, *(1,) * (rows.ndim - 2))
    return jnp.sum(rows[:, :, None] * weights, axis=1)
