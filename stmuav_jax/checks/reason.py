"""Codes for the reason why a value is not valid, for arrays of many values.

Each kind of value has its own enumeration, derived from `AbstractReason`; one array holds codes
of one enumeration.
"""

from enum import IntEnum

import jax.numpy as jnp
from jaxtyping import Array, Bool, Int


class AbstractReason(IntEnum):
    """Code for the reason why a value is not valid or a computation ended; 0 if all is well."""

    @property
    def words(self) -> str:
        """Name of the code as words in lower case."""
        return self.name.lower().replace("_", " ")


def first_reason(*checks: tuple[Bool[Array, "*#s"], IntEnum]) -> Int[Array, "*s"]:
    """Code of the first check that is true, of the checks' shape (*s); 0 where none is true."""
    code = jnp.zeros(jnp.shape(checks[0][0]), dtype=jnp.int8)
    for wrong, reason in reversed(checks):
        code = jnp.where(wrong, jnp.int8(reason), code)
    return code
