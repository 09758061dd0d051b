"""Derivatives along some arguments only, and at places where there are none."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .stacked import dot


def directional(
    function: Callable[..., Any], primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Any, Any]:
    """function(*primals) and its derivative along tangents, None for leaves that do not change.

    The form of `tangents` is that of `equinox.filter_custom_jvp`.
    """
    is_none = lambda leaf: leaf is None
    changes = jax.tree.map(lambda leaf: leaf is not None, tangents, is_leaf=is_none)
    moves, fixed = eqx.partition(primals, changes)
    return jax.jvp(lambda x: function(*eqx.combine(x, fixed)), (moves,), (tangents,))


@jax.custom_jvp
def without_derivative(x: Float[Array, "*s"], there: Bool[Array, "..."]) -> Float[Array, "*s"]:
    """x itself, which has no derivative where `there` is true: it is NaN, not a number made up."""
    del there
    return x


@without_derivative.defjvp
def _without_derivative_jvp(primals: Any, tangents: Any) -> Any:
    x, there = primals
    return x, tangents[0] * jnp.where(there, jnp.nan, 1.0).astype(x.dtype)


def length_and_direction(
    d: Float[Array, "k"],
) -> tuple[Float[Array, ""], Float[Array, "k"], Bool[Array, ""]]:
    """|d|, d / |d| and whether d is not zero; both are zero, with zero derivatives, where it is.

    Exact with all derivatives for any other d: the components are divided by the largest
    first, so that no square over- or underflows.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(d)))
    apart = largest != 0
    n = d / jnp.where(apart, largest, 1.0)
    root = jnp.sqrt(jnp.where(apart, dot(n, n), 1.0))
    return largest * root, n / root, apart
