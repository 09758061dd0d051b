"""Closures over numbers that are differentiated or batched, as pytrees.

A force written as `lambda t, kin: jnp.stack([a * jnp.sin(t), 0.0, 0.0])` hides the number a from
JAX's rules for reverse mode. This module replaces such a function by a `Closure`, a callable with
these numbers as leaves, like an `equinox.Module` written for the purpose.
"""

import functools
import types
from typing import Any

import equinox as eqx
import jax
import jax.core


class _Same:
    """Wrapper that equals itself alone, for objects beside numbers that a function closes over."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Closure(eqx.Module):
    """Function whose leaves are the numbers that it closes over or has as defaults.

    Attributes:
        values: numbers by place in the function's closure, or under "defaults" and "keywords".
        function: code, globals, closure and defaults of the function.
    """

    values: dict[str, Any]
    function: _Same = eqx.field(static=True)

    def __call__(self, *args: Any, **more: Any) -> Any:
        code, names, cells, defaults, by_name = self.function.value
        at = self.values
        places = enumerate(cells)
        closure = tuple(types.CellType(at[str(k)]) if str(k) in at else c for k, c in places)
        function = types.FunctionType(
            code, names, code.co_name, at.get("defaults", defaults), closure
        )
        function.__kwdefaults__ = at.get("keywords", by_name)
        return function(*args, **more)


def opened(tree: Any) -> Any:
    """Pytree whose functions that close over tracers are replaced by `Closure`s."""
    return jax.tree.map(lambda leaf: _opened(leaf, ()), tree)


def _opened(leaf: Any, above: tuple[int, ...]) -> Any:
    """Leaf, or its `Closure`; `above` are functions that close over it, maybe itself."""
    if id(leaf) in above:
        return leaf
    above = (*above, id(leaf))
    if isinstance(leaf, functools.partial):
        inner = jax.tree.map(lambda x: _opened(x, above), (leaf.func, leaf.args, leaf.keywords))
        return eqx.Partial(inner[0], *inner[1], **inner[2]) if _traced(inner) else leaf
    if not isinstance(leaf, types.FunctionType):
        return leaf
    cells = leaf.__closure__ or ()
    held = {str(k): _contents(c) for k, c in enumerate(cells)}
    held |= {"defaults": leaf.__defaults__, "keywords": leaf.__kwdefaults__}
    found = {k: jax.tree.map(lambda x: _opened(x, above), v) for k, v in held.items()}
    values = {k: v for k, v in found.items() if _traced(v)}
    if not values:
        return leaf
    rest = (leaf.__code__, leaf.__globals__, cells, leaf.__defaults__, leaf.__kwdefaults__)
    return Closure(values, _Same(rest))


def _contents(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _traced(tree: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))
