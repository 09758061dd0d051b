"""Topology of a system: the spanning tree of its joint graph, the joints that close loops, and passes along it.

The tree keeps the joints with the most rows, so that the loop-closing joints leave the fewest
constraints (Kruskal's method); among equals it prefers those nearer to the root, for short
chains. A part of the system that no joint with relative coordinates ties to ground floats: the
six motions of one of its bodies are coordinates, the one declared free or else its first, and if
this is the whole system, that body is the base. Frame 0 is the root; the frames of the steps are
numbered from 1. The module holds no numerical parameters.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4; J. B. Kruskal, Proc.
Amer. Math. Soc. 7 (1956) 48-50.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError, nearest_names
from ...math.stacked import gather_entries
from ...mechanics.body import GROUND
from ...mechanics.joint import CATALOGUE, Freedom
from ...mechanics.motions import SPHERICAL, TRANSLATION, AbstractRelativeMotion
from ...mechanics.system import System


class Step(NamedTuple):
    """One relative motion of the tree, which leads to one frame.

    Attributes:
        motion: relative motion, in the axes of this frame.
        axis: axis of the joint's frame that is the z axis of this step.
        before: `axis` of the preceding step of the same joint; None for the first.
        parent, level: number of the parent frame, and depth in frames from the root.
        joint, body: numbers of the joint (None for the free motion of a floating body) and of the
            body behind it.
        first, last: True for the first and for the last step of the joint.
    """

    motion: AbstractRelativeMotion
    axis: int
    before: int | None
    parent: int
    level: int
    joint: int | None
    body: int
    first: bool
    last: bool


class Link(NamedTuple):
    """Joint of the tree: number (None: free motion), parent, child, and True if it leads i to j."""

    joint: int | None
    parent: int
    child: int
    forward: bool


@dataclass(frozen=True)
class SpanningTree:
    """Spanning tree of a system's joint graph, with frame 0 as the root.

    Attributes:
        bodies: names of the bodies and, last, "ground".
        joints: names of all joints.
        root: body of frame 0: ground, or the base of a system that floats.
        links: joints of the tree, parents first.
        cut: numbers of the loop-closing joints.
        steps: steps to frames 1, 2, ..., sorted by level, then by class of motion (`order_of`).
        frame: number of the frame to which each body, and ground, is fixed.
    """

    bodies: tuple[str, ...]
    joints: tuple[str, ...]
    root: int
    links: tuple[Link, ...]
    cut: tuple[int, ...]
    steps: tuple[Step, ...]
    frame: tuple[int, ...]

    @property
    def floating(self) -> bool:
        """True if the root is the base of a floating system."""
        return self.root != len(self.bodies) - 1

    @property
    def n_velocities(self) -> int:
        """Number of the tree's velocities: its degrees of freedom with all loops open."""
        return 6 * self.floating + sum(len(s.motion.columns) for s in self.steps)

    @property
    def n_positions(self) -> int:
        """Number of the tree's positions, with Euler parameters for rotations in space."""
        return 7 * self.floating + sum(math.prod(s.motion.positions) for s in self.steps)

    def behind(self) -> list[tuple[int, float, set[int]]]:
        """Number, sign and bodies behind every joint of the tree; +1 from body i to j, else -1."""
        below: dict[int, set[int]] = {}
        for link in reversed(self.links):
            below.setdefault(link.child, set()).add(link.child)
            below.setdefault(link.parent, set()).update(below[link.child])
        return [
            (link.joint, 1.0 if link.forward else -1.0, below[link.child])
            for link in self.links
            if link.joint is not None
        ]

    def __str__(self) -> str:
        names = self.bodies
        lines = [f"root: {names[self.root]}{' (floats)' if self.floating else ''}"]
        for link in self.links:
            connection = "free" if link.joint is None else self.joints[link.joint]
            lines.append(f"{names[link.parent]} -> {names[link.child]}: {connection}")
        cut = ", ".join(self.joints[k] for k in self.cut) or "none"
        return "\n".join([*lines, f"cut: {cut}", f"velocities: {self.n_velocities}"])


# The motion of a body that no joint ties to the tree.
_FREE = (Freedom(TRANSLATION), Freedom(SPHERICAL))


def order_of(motion: AbstractRelativeMotion) -> tuple[int, str]:
    """Sorting key of a class of motions, in the state and within a level."""
    return math.prod(motion.positions), type(motion).__name__


def spanning_tree(
    system: System, cut: Sequence[str] = (), *, base: str | None = None
) -> SpanningTree:
    """Choose the spanning tree of a system.

    Args:
        cut: names of joints that must close loops; others are added as the module describes.
        base: body of frame 0 of a floating system; by default `System.base`, the one declared free.

    Raises:
        ModelError: `cut` names an unknown joint.
    """
    joints = [joint.name for joint in system.joints]
    for name in cut:
        if name not in joints:
            raise ModelError(f"There is no joint '{name}' to cut.{nearest_names(name, joints)}")
    ends = _joint_ends(system)
    # The user's body, even if another one gave shorter chains: names, gains, postures and exported
    # models count from it.
    base_row = system.base if base is None else system.index(base)
    tree_joints = _choose_joints(system, ends, set(cut), base_row)
    links, root = _sort_links(system, ends, tree_joints, base_row)
    steps, frame = _sort_steps(system, links, root)
    rest = tuple(k for k in range(len(joints)) if k not in tree_joints)
    return SpanningTree((*system.names, GROUND), tuple(joints), root, links, rest, steps, frame)


def _joint_ends(system: System) -> list[tuple[int, int]]:
    place = {name: k for k, name in enumerate((*system.names, GROUND))}
    return [(place[joint.body_i], place[joint.body_j]) for joint in system.joints]


def _joint_distances(system: System, ends: list[tuple[int, int]], base: int) -> list[int]:
    """Distance of every body in joints from ground, or from the base if no joint is on ground."""
    n = system.n_bodies
    distances = [n + 1] * (n + 1)
    start = n if any(n in pair for pair in ends) else base
    distances[start], todo = 0, [start]
    for at in todo:
        for pair in ends:
            for body, neighbour in (pair, pair[::-1]):
                if body == at and distances[neighbour] > distances[at] + 1:
                    distances[neighbour] = distances[at] + 1
                    todo.append(neighbour)
    return distances


def _choose_joints(
    system: System, ends: list[tuple[int, int]], cut: set[str], base: int
) -> set[int]:
    """Numbers of the joints of the tree."""
    distances = _joint_distances(system, ends, base)
    able = [
        k
        for k, joint in enumerate(system.joints)
        if joint.name not in cut and CATALOGUE[joint.kind].motion is not None
    ]
    # Joints with many rows belong into the tree, where they cost nothing; the few rows of a ball are the
    # cheapest to keep as constraints.
    able.sort(key=lambda k: (-system.joints[k].n_rows, sum(distances[b] for b in ends[k]), k))
    # Kruskal's method with union-find: a joint is kept unless its bodies are connected already.
    group = list(range(system.n_bodies + 1))

    def find_leader(b: int) -> int:
        while group[b] != b:
            b = group[b]
        return b

    tree_joints = set()
    for k in able:
        i, j = map(find_leader, ends[k])
        if i != j:
            group[i] = j
            tree_joints.add(k)
    return tree_joints


def _sort_links(
    system: System, ends: list[tuple[int, int]], tree_joints: set[int], base: int
) -> tuple[tuple[Link, ...], int]:
    """Joints of the tree, from the root outwards, and the root."""
    ground = system.n_bodies
    links: list[Link] = []
    reached_bodies: set[int] = set()

    def grow_tree(start: int) -> None:
        reached_bodies.add(start)
        # Breadth first, so that the chains from the root are as short as the kept joints allow: the passes
        # cost one stage per level.
        todo = [start]
        for at in todo:
            for k in sorted(tree_joints):
                for body, neighbour, forward in ((*ends[k], True), (*ends[k][::-1], False)):
                    if body == at and neighbour not in reached_bodies:
                        links.append(Link(k, at, neighbour, forward))
                        reached_bodies.add(neighbour)
                        todo.append(neighbour)

    if system.floating and len(tree_joints) == system.n_bodies - 1:
        grow_tree(base)
        return tuple(links), base
    grow_tree(ground)
    free = {system.index(name) for name in system.bodies.free}
    while len(reached_bodies) <= system.n_bodies:
        rest = set(range(ground)) - reached_bodies
        start = min(rest & free or rest)
        # A part that no joint ties to ground gets six free motions of its own.
        links.append(Link(None, ground, start, True))
        grow_tree(start)
    return tuple(links), ground


def _sort_steps(
    system: System, links: tuple[Link, ...], root: int
) -> tuple[tuple[Step, ...], tuple[int, ...]]:
    """Steps of all links, sorted by level, and the frame of every body."""
    frame = {root: -1}
    unsorted_steps: list[Step] = []
    for link in links:
        if link.joint is None:
            motion = _FREE
        else:
            motion = CATALOGUE[system.joints[link.joint].kind].motion or ()
            motion = motion if link.forward else motion[::-1]
        at, before = frame[link.parent], None
        for number, (moves, axis, _) in enumerate(motion):
            level = 1 + (unsorted_steps[at].level if at >= 0 else 0)
            last = number == len(motion) - 1
            step = Step(moves, axis, before, at, level, link.joint, link.child, number == 0, last)
            unsorted_steps.append(step)
            at, before = len(unsorted_steps) - 1, axis
        frame[link.child] = at
    # Sorted by level and then by class of motion: every level is a contiguous slice, and each class in it
    # a contiguous part.
    place = lambda k: (unsorted_steps[k].level, order_of(unsorted_steps[k].motion), k)
    order = sorted(range(len(unsorted_steps)), key=place)
    new = {old: place + 1 for place, old in enumerate(order)} | {-1: 0}
    steps = tuple(unsorted_steps[k]._replace(parent=new[unsorted_steps[k].parent]) for k in order)
    ground = system.n_bodies
    return steps, tuple(new[frame.get(b, -1)] for b in range(ground + 1))


class Level(NamedTuple):
    """Frames of one depth: their places, and the places of their parents in the level before."""

    frames: slice
    parents: np.ndarray


def tree_levels(tree: SpanningTree) -> tuple[Level, ...]:
    """Levels of a tree, outwards from the root, which is not among them."""
    tree_levels = []
    before = 0
    for depth in sorted({step.level for step in tree.steps}):
        at = [f + 1 for f, step in enumerate(tree.steps) if step.level == depth]
        parents = np.array([tree.steps[f - 1].parent for f in at]) - before
        tree_levels.append(Level(slice(at[0], at[-1] + 1), parents))
        before = at[0]
    return tuple(tree_levels)


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
        velocity_mask = np.repeat(np.isin(self.steps, steps), len(self.motion.columns))
        return MotionGroup(self.motion, steps, self.velocities[velocity_mask])


def motion_groups(tree: SpanningTree) -> tuple[MotionGroup, ...]:
    """Classes of motions that occur in a tree, in the order of their positions in the state."""
    frame = motion_columns(tree).frame
    groups = []
    for order in sorted({order_of(step.motion) for step in tree.steps}):
        steps = [f for f, step in enumerate(tree.steps) if order_of(step.motion) == order]
        velocities = np.flatnonzero(np.isin(frame - 1, steps))
        groups.append(MotionGroup(tree.steps[steps[0]].motion, np.array(steps, int), velocities))
    return tuple(groups)


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


def motion_columns(tree: SpanningTree) -> Columns:
    """Motion subspaces of a tree, without the pitches of its joints."""
    rows = [
        (f, c.axis, c.angular, c.linear or 0.0, c.linear is None)
        for f, step in enumerate(tree.steps, start=1)
        for c in step.motion.columns
    ]
    table = np.array(rows, dtype=float).reshape(-1, 5).T
    return Columns(table[0].astype(int), table[1].astype(int), *table[2:])


def find_supported(tree: SpanningTree) -> np.ndarray:
    """Mask of the frames that each frame supports (f + 1, f + 1).

    Entry [f, g] is True if frame g moves with frame f; f = g is included.
    """
    count = len(tree.steps) + 1
    table = np.eye(count, dtype=bool)
    for g, step in enumerate(tree.steps, start=1):
        # Parents have smaller numbers than their children, so that one pass completes the ancestors.
        table[:, g] |= table[:, step.parent]
    return table


def pad_lists(lists: list[list[int]], pad: int) -> np.ndarray:
    """Table of lists of unequal length, padded with `pad`."""
    width = max((len(row) for row in lists), default=0)
    return np.array([row + [pad] * (width - len(row)) for row in lists], dtype=int).reshape(
        len(lists), width
    )


def pick_entries(table: Float[Array, "..."], index: np.ndarray, axis: int) -> Float[Array, "..."]:
    """Entries of a table at known places along an axis; the table itself if these are all."""
    # The identity is frequent (each body has a frame of its own) and must not cost a copy.
    if index.ndim == 1 and np.array_equal(index, np.arange(table.shape[axis])):
        return table
    if index.ndim != 1:
        return gather_entries(table, index, axis)
    return _pick_constant(tuple(map(int, index)), axis, table)


@partial(jax.custom_jvp, nondiff_argnums=(0, 1))
def _pick_constant(index: tuple[int, ...], axis: int, table: Array) -> Array:
    return gather_entries(table, index, axis)


@_pick_constant.defjvp
def _picked_jvp(index: tuple[int, ...], axis: int, primals: Any, tangents: Any) -> Any:
    # sums with constant weights: the transpose of a gather is a scatter, which does not fuse
    (table,), (tangent,) = primals, tangents
    weights = np.eye(table.shape[axis])[:, list(index)]
    weights = weights.reshape(*(1,) * axis, *weights.shape, *(1,) * (table.ndim - axis - 1))
    return _pick_constant(index, axis, table), jnp.sum(
        jnp.expand_dims(tangent, axis + 1) * weights, axis=axis
    )


def align_axes(constant: np.ndarray, axes: int) -> np.ndarray:
    """Constant with axes of length one appended, so that it has `axes` axes in all."""
    return constant.reshape(constant.shape + (1,) * (axes - constant.ndim))


# --- recursions


def forward_pass(tree: SpanningTree, root: Array, values: Array) -> Array:
    """Forward pass: sums of `values` from the root to every frame, (w, f + 1, *s).

    Args:
        root: value of frame 0 (w, 1, *s).
        values: values of the other frames (w, f, *s).
    """
    # Level by level: all frames of one depth are one vector operation, so that a wide tree costs no more
    # operations than a chain of its depth.
    parts = [root]
    for level in tree_levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(pick_entries(parts[-1], level.parents, 1) + values[:, at])
    return jnp.concatenate(parts, axis=1) if len(parts) > 1 else root


def backward_pass(tree: SpanningTree, values: Float[Array, "w f *s"]) -> Float[Array, "w f *s"]:
    """Backward pass: sums of `values` over every frame and all frames that it supports."""
    layers = [Level(slice(0, 1), np.zeros(1, int)), *tree_levels(tree)]
    sums = [values[:, layers[-1].frames]]
    for level, behind in zip(layers[-2::-1], layers[:0:-1], strict=True):
        count = level.frames.stop - level.frames.start
        children: list[list[int]] = [[] for _ in range(count)]
        for child, parent in enumerate(behind.parents):
            children[parent].append(child)
        sums.insert(0, values[:, level.frames] + sum_entries(sums[0], children))
    return jnp.concatenate(sums, axis=1) if len(sums) > 1 else sums[0]


def sum_entries(rows: Float[Array, "w k *s"], lists: list[list[int]]) -> Float[Array, "w m *s"]:
    """Sums of the entries along the second axis that each list names."""
    table = pad_lists(lists, rows.shape[1])
    more = jnp.concatenate([rows, jnp.zeros_like(rows[:, :1])], axis=1)
    total = pick_entries(more, table[:, 0], 1)
    for slot in range(1, table.shape[1]):
        total = total + pick_entries(more, table[:, slot], 1)
    return total
