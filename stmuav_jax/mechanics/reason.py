"""Codes for why a value is not valid, where many are looked at together."""

from enum import IntEnum

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


def first_reason(*checks: tuple[Bool[Array, "*s"], IntEnum]) -> Int[Array, "*s"]:
    """The code of the first check that is true, 0 where none is; of the checks' shape (*s)."""
    code = jnp.zeros(jnp.shape(checks[0][0]), dtype=jnp.int8)
    for wrong, reason in reversed(checks):
        code = jnp.where(wrong, jnp.int8(reason), code)
    return code
