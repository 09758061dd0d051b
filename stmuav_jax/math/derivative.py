"""Derivatives along some of the arguments, and safe derivatives at singular points."""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .stacked import dot_product

T = TypeVar("T")


def directional_derivative(
    function: Callable[..., Any], primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[Any, Any]:
    """Value of a function and its derivative along tangents, which are None for constant leaves.

    The form of `tangents` is that of `equinox.filter_custom_jvp`.
    """
    is_none = lambda leaf: leaf is None
    changes = jax.tree.map(lambda leaf: leaf is not None, tangents, is_leaf=is_none)
    moves, fixed = eqx.partition(primals, changes)
    return jax.jvp(lambda x: function(*eqx.combine(x, fixed)), (moves,), (tangents,))


def value_and_jacobian(
    function: Callable[[Float[Array, " n"]], Any], x: Float[Array, " n"]
) -> tuple[Any, Any]:
    """Value of a function of a vector, and its Jacobian with the columns last, in one pass."""
    push = lambda e: jax.jvp(function, (x,), (e,))
    value, columns = jax.vmap(push, out_axes=(0, -1))(jnp.eye(x.shape[0], dtype=x.dtype))
    # the value is the same along every direction
    return jax.tree.map(lambda v: v[0], value), columns


def motion_along(
    path: Callable[[Float[Array, ""]], Float[Array, " n"]], t: Float[Array, ""]
) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
    """Value of a function of time, its rate and its acceleration, each (n,), by derivatives."""
    moving = lambda t: jax.jvp(path, (t,), (jnp.ones_like(t),))
    (value, rate), (_, acceleration) = jax.jvp(moving, (t,), (jnp.ones_like(t),))
    return value, rate, acceleration


def held_constant(tree: T) -> T:
    """Pytree with the same leaves, of which no floating-point array has a derivative."""
    constant_leaf = lambda x: jax.lax.stop_gradient(x) if eqx.is_inexact_array(x) else x
    return jax.tree.map(constant_leaf, tree)


@jax.custom_jvp
def without_derivative(x: Float[Array, "*s"], mask: Bool[Array, "..."]) -> Float[Array, "*s"]:
    """Identity x -> x whose derivative is NaN where `mask` is true, as x has none there."""
    del mask
    return x


@without_derivative.defjvp
def _without_derivative_jvp(primals: Any, tangents: Any) -> Any:
    x, mask = primals
    return x, tangents[0] * jnp.where(mask, jnp.nan, 1.0).astype(x.dtype)


def safe_sqrt(square: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root that is zero, with zero derivatives, where `square` is <= 0; NaN stays NaN."""
    none = square <= 0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))


def sharp_sqrt(square: Float[Array, "*s"]) -> Float[Array, "*s"]:
    """Square root that is zero where `square` is < 0; NaN derivatives at zero, where there are none."""
    zero = square == 0
    return jnp.where(zero, without_derivative(square, zero), safe_sqrt(square))


def safe_norm(vectors: Float[Array | np.ndarray, "..."], axis: int = 0) -> Float[Array, "..."]:
    """Euclidean norm along an axis; its derivatives at zero are set to zero."""
    return safe_sqrt(jnp.sum(vectors * vectors, axis=axis))


def length_and_direction(
    d: Float[Array, "k"],
) -> tuple[Float[Array, ""], Float[Array, "k"], Bool[Array, ""]]:
    """Length |d|, unit vector d / |d|, and a flag that d is not zero.

    At d = 0 length and vector are zero, with zero derivatives. For any other d they are exact with
    all derivatives: the components are first divided by the largest, so that no square over- or
    underflows.
    """
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(d)))
    is_nonzero = largest != 0
    n = d / jnp.where(is_nonzero, largest, 1.0)
    root = jnp.sqrt(jnp.where(is_nonzero, dot_product(n, n), 1.0))
    return largest * root, n / root, is_nonzero
