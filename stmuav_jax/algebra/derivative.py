"""Directional derivatives where some arguments do not change, as custom rules need them."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax


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
