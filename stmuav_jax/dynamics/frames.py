"""A spanning tree's structure as tables, and sums along its chains; frame numbers start at 1."""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.stacked import summed
from .topology import SpanningTree


class Level(NamedTuple):
    """Frames of one depth: their places, and their parents' among the level before."""

    frames: slice
    parents: np.ndarray


def levels(tree: SpanningTree) -> tuple[Level, ...]:
    """The levels of a tree, from the root outwards; frame numbers start at 1."""
    found = []
    before = 0
    for depth in sorted({step.level for step in tree.steps}):
        at = [f + 1 for f, step in enumerate(tree.steps) if step.level == depth]
        parents = np.array([tree.steps[f - 1].parent for f in at]) - before
        found.append(Level(slice(at[0], at[-1] + 1), parents))
        before = at[0]
    return tuple(found)


def of_kind(tree: SpanningTree, *kinds: str) -> np.ndarray:
    """Places, among `tree.steps`, of the steps of some kinds."""
    return np.array([f for f, step in enumerate(tree.steps) if step.kind in kinds], dtype=int)


def columns(tree: SpanningTree) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of every velocity of the tree's steps: its frame, its column there, 1.0 if it turns."""
    rows = []
    for f, step in enumerate(tree.steps):
        turns = float(step.kind in ("turn", "ball"))
        wide = step.kind in ("ball", "shift")
        rows += [(f + 1, c, turns) for c in (range(3) if wide else (2,))]
    table = np.array(rows, dtype=float).reshape(-1, 3)
    return table[:, 0].astype(int), table[:, 1].astype(int), table[:, 2]


def carries(tree: SpanningTree) -> np.ndarray:
    """carries[f, g]: whether frame g moves with frame f (f = g included), (f + 1, f + 1)."""
    count = len(tree.steps) + 1
    table = np.eye(count, dtype=bool)
    for g, step in enumerate(tree.steps, start=1):
        table[:, g] |= table[:, step.parent]
    return table


def padded(lists: list[list[int]], pad: int) -> np.ndarray:
    """Lists of unequal length as a table, filled up with `pad`."""
    width = max((len(row) for row in lists), default=0)
    return np.array([row + [pad] * (width - len(row)) for row in lists], dtype=int).reshape(
        len(lists), width
    )


def pick(table: Float[Array, "..."], index: np.ndarray, axis: int) -> Float[Array, "..."]:
    """Entries of a table at known places along an axis; no copy of all in their order."""
    if index.ndim == 1 and np.array_equal(index, np.arange(table.shape[axis])):
        return table
    if index.ndim != 1:
        return _gathered(table, index, axis)
    return _picked(tuple(map(int, index)), axis, table)


def _gathered(table: Array, index: np.ndarray, axis: int) -> Array:
    return table.at[(slice(None),) * axis + (index,)].get(
        mode="promise_in_bounds", wrap_negative_indices=False
    )


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _picked(index: tuple[int, ...], axis: int, table: Array) -> Array:
    return _gathered(table, np.array(index, int), axis)


@_picked.defjvp
def _picked_jvp(index: tuple[int, ...], axis: int, primals: Any, tangents: Any) -> Any:
    # as sums with constant weights: the transpose of a gather is a scatter, which does not fuse
    (table,), (tangent,) = primals, tangents
    weights = np.eye(table.shape[axis])[:, list(index)]
    weights = weights.reshape(*weights.shape, *(1,) * (table.ndim - axis - 1))
    return _picked(index, axis, table), jnp.sum(
        jnp.expand_dims(tangent, axis + 1) * weights, axis=axis
    )


def aligned(constant: np.ndarray, axes: int) -> np.ndarray:
    """A constant with axes of length one added at its end, `axes` in all."""
    return constant.reshape(constant.shape + (1,) * (axes - constant.ndim))


# --- recursions


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def outwards(tree: SpanningTree, root: Array, own: Array) -> Array:
    """Sums of `own` along the chains, from frame 0's value outwards: (w, f + 1, *s).

    Args:
        root: of frame 0 (w, 1, *s). own: of the other frames (w, f, *s).
    """
    parts = [root]
    for level in levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(pick(parts[-1], level.parents, 1) + own[:, at])
    return jnp.concatenate(parts, axis=1) if len(parts) > 1 else root


@outwards.defjvp
def _outwards_jvp(tree: SpanningTree, primals: Any, tangents: Any) -> Any:
    # in one sum, whose transpose is another; level by level it is one padded array for each
    return outwards(tree, *primals), summed(jnp.concatenate(tangents, axis=1), carries(tree))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def inwards(tree: SpanningTree, own: Float[Array, "w f *s"]) -> Float[Array, "w f *s"]:
    """For every frame the sum of `own` over itself and all frames that it carries."""
    layers = [Level(slice(0, 1), np.zeros(1, int)), *levels(tree)]
    sums = [own[:, layers[-1].frames]]
    for level, behind in zip(layers[-2::-1], layers[:0:-1], strict=True):
        count = level.frames.stop - level.frames.start
        children: list[list[int]] = [[] for _ in range(count)]
        for child, parent in enumerate(behind.parents):
            children[parent].append(child)
        sums.insert(0, own[:, level.frames] + gathered(sums[0], children))
    return jnp.concatenate(sums, axis=1) if len(sums) > 1 else sums[0]


@inwards.defjvp
def _inwards_jvp(tree: SpanningTree, primals: Any, tangents: Any) -> Any:
    return inwards(tree, *primals), summed(tangents[0], carries(tree).T)


def gathered(rows: Float[Array, "w k *s"], lists: list[list[int]]) -> Float[Array, "w m *s"]:
    """Sums of the rows that each list names."""
    table = padded(lists, rows.shape[1])
    more = jnp.concatenate([rows, jnp.zeros_like(rows[:, :1])], axis=1)
    total = pick(more, table[:, 0], 1)
    for slot in range(1, table.shape[1]):
        total = total + pick(more, table[:, slot], 1)
    return total
