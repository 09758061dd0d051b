"""Tables of a spanning tree's structure, and its forward and backward passes.

Frame 0 is the root; the frames of the steps are numbered from 1.
"""

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.stacked import summed
from ...mechanics.motions.base import AbstractRelativeMotion
from .topology import SpanningTree, order_of


class Level(NamedTuple):
    """Frames of one depth: their places, and the places of their parents in the level before."""

    frames: slice
    parents: np.ndarray


def levels(tree: SpanningTree) -> tuple[Level, ...]:
    """Levels of a tree, outwards from the root, which is not among them."""
    found = []
    before = 0
    for depth in sorted({step.level for step in tree.steps}):
        at = [f + 1 for f, step in enumerate(tree.steps) if step.level == depth]
        parents = np.array([tree.steps[f - 1].parent for f in at]) - before
        found.append(Level(slice(at[0], at[-1] + 1), parents))
        before = at[0]
    return tuple(found)


class MotionGroup(NamedTuple):
    """Group of the frames whose motions are of one class, which are evaluated together.

    Attributes:
        motion: relative motion of one of the frames.
        steps: places of the frames among `tree.steps`.
        velocities: places of their velocities, those of one frame together.
    """

    motion: AbstractRelativeMotion
    steps: np.ndarray
    velocities: np.ndarray

    def restricted(self, steps: np.ndarray) -> "MotionGroup":
        """Group of some of these steps."""
        kept = np.repeat(np.isin(self.steps, steps), len(self.motion.columns))
        return MotionGroup(self.motion, steps, self.velocities[kept])


def motion_groups(tree: SpanningTree) -> tuple[MotionGroup, ...]:
    """Classes of motions that occur in a tree, in the order of their positions in the state."""
    frame = columns(tree).frame
    found = []
    for order in sorted({order_of(step.motion) for step in tree.steps}):
        steps = [f for f, step in enumerate(tree.steps) if order_of(step.motion) == order]
        velocities = np.flatnonzero(np.isin(frame - 1, steps))
        found.append(MotionGroup(tree.steps[steps[0]].motion, np.array(steps, int), velocities))
    return tuple(found)


class Columns(NamedTuple):
    """Columns of the motion subspaces of a tree, one for every velocity of its steps.

    Attributes:
        frame: frame that moves.
        axis: axis of that frame, 0, 1 or 2.
        angular, linear: angular velocity about, and velocity along, the axis per unit.
        pitched: 1.0 where the joint's pitch takes the place of `linear`, which is then zero.
    """

    frame: np.ndarray
    axis: np.ndarray
    angular: np.ndarray
    linear: np.ndarray
    pitched: np.ndarray


def columns(tree: SpanningTree) -> Columns:
    """Motion subspaces of a tree, without the pitches of its joints."""
    rows = [
        (f, c.axis, c.angular, c.linear or 0.0, c.linear is None)
        for f, step in enumerate(tree.steps, start=1)
        for c in step.motion.columns
    ]
    table = np.array(rows, dtype=float).reshape(-1, 5).T
    return Columns(table[0].astype(int), table[1].astype(int), *table[2:])


def support(tree: SpanningTree) -> np.ndarray:
    """Mask of the frames that each frame supports (f + 1, f + 1).

    Entry [f, g] is True if frame g moves with frame f; f = g is included.
    """
    count = len(tree.steps) + 1
    table = np.eye(count, dtype=bool)
    for g, step in enumerate(tree.steps, start=1):
        table[:, g] |= table[:, step.parent]
    return table


def padded(lists: list[list[int]], pad: int) -> np.ndarray:
    """Table of lists of unequal length, padded with `pad`."""
    width = max((len(row) for row in lists), default=0)
    return np.array([row + [pad] * (width - len(row)) for row in lists], dtype=int).reshape(
        len(lists), width
    )


def pick(table: Float[Array, "..."], index: np.ndarray, axis: int) -> Float[Array, "..."]:
    """Entries of a table at known places along an axis; the table itself if these are all."""
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
    # sums with constant weights: the transpose of a gather is a scatter, which does not fuse
    (table,), (tangent,) = primals, tangents
    weights = np.eye(table.shape[axis])[:, list(index)]
    weights = weights.reshape(*weights.shape, *(1,) * (table.ndim - axis - 1))
    return _picked(index, axis, table), jnp.sum(
        jnp.expand_dims(tangent, axis + 1) * weights, axis=axis
    )


def aligned(constant: np.ndarray, axes: int) -> np.ndarray:
    """Constant with axes of length one appended, so that it has `axes` axes in all."""
    return constant.reshape(constant.shape + (1,) * (axes - constant.ndim))


# --- recursions


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def forward_pass(tree: SpanningTree, root: Array, own: Array) -> Array:
    """Forward pass: sums of `own` from the root to every frame, (w, f + 1, *s).

    Args:
        root: value of frame 0 (w, 1, *s).
        own: values of the other frames (w, f, *s).
    """
    parts = [root]
    for level in levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(pick(parts[-1], level.parents, 1) + own[:, at])
    return jnp.concatenate(parts, axis=1) if len(parts) > 1 else root


@forward_pass.defjvp
def _forward_pass_jvp(tree: SpanningTree, primals: Any, tangents: Any) -> Any:
    # one sum, whose transpose is a sum too; level by level the transpose pads an array each time
    return forward_pass(tree, *primals), summed(jnp.concatenate(tangents, axis=1), support(tree))


@partial(jax.custom_jvp, nondiff_argnums=(0,))
def backward_pass(tree: SpanningTree, own: Float[Array, "w f *s"]) -> Float[Array, "w f *s"]:
    """Backward pass: sums of `own` over every frame and all frames that it supports."""
    layers = [Level(slice(0, 1), np.zeros(1, int)), *levels(tree)]
    sums = [own[:, layers[-1].frames]]
    for level, behind in zip(layers[-2::-1], layers[:0:-1], strict=True):
        count = level.frames.stop - level.frames.start
        children: list[list[int]] = [[] for _ in range(count)]
        for child, parent in enumerate(behind.parents):
            children[parent].append(child)
        sums.insert(0, own[:, level.frames] + gathered(sums[0], children))
    return jnp.concatenate(sums, axis=1) if len(sums) > 1 else sums[0]


@backward_pass.defjvp
def _backward_pass_jvp(tree: SpanningTree, primals: Any, tangents: Any) -> Any:
    return backward_pass(tree, *primals), summed(tangents[0], support(tree).T)


def gathered(rows: Float[Array, "w k *s"], lists: list[list[int]]) -> Float[Array, "w m *s"]:
    """Sums of the entries along the second axis that each list names."""
    table = padded(lists, rows.shape[1])
    more = jnp.concatenate([rows, jnp.zeros_like(rows[:, :1])], axis=1)
    total = pick(more, table[:, 0], 1)
    for slot in range(1, table.shape[1]):
        total = total + pick(more, table[:, slot], 1)
    return total
