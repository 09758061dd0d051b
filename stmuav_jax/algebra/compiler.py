"""Options for XLA that suit programs of many small products."""

from collections.abc import Callable
from functools import cache
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

# XLA's CPU compiler hands sums of products above some size to a library meant for large
# single-precision matrices. The sums here are over three to thirteen terms, many at once.
_NO_LIBRARY = {"xla_cpu_experimental_ynn_fusion_type": ""}


@cache
def compiler_options() -> dict[str, str | bool | int | float]:
    """For `jax.jit(..., compiler_options=...)` or `eqx.filter_jit`, of the outermost function.

    On a CPU they make a batch of right-hand sides faster and leave a single one as it
    is. Empty on other devices, and where this version of XLA does not have them.
    `simulate` uses them; in a program of your own use `outer_jit`, or set
    XLA_FLAGS=--xla_cpu_experimental_ynn_fusion_type= before JAX is imported.
    """
    if jax.default_backend() != "cpu":
        return {}
    try:
        jax.jit(jnp.cos, compiler_options=dict(_NO_LIBRARY)).lower(0.0).compile()
    except jax.errors.JaxRuntimeError:
        return {}
    return dict(_NO_LIBRARY)


def outer_jit(function: Callable[..., Any]) -> Any:
    """`eqx.filter_jit` with `compiler_options`, for the outermost function of a program."""
    return eqx.filter_jit(function, compiler_options=compiler_options())  # pyright: ignore[reportCallIssue]
