"""Topology of a system: the spanning tree of its joint graph and the joints that close loops.

The tree keeps the joints with the most rows, so that the loop-closing joints leave the fewest
constraints (Kruskal's method); among equals it prefers those nearer to the root, for short
chains. A part of the system that no joint with relative coordinates ties to ground floats: the
six motions of one of its bodies are coordinates, and if this is the whole system, that body is
the base. The module holds no numerical parameters.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4; J. B. Kruskal, Proc.
Amer. Math. Soc. 7 (1956) 48-50.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ...checks.errors import ModelError, nearest_names
from ...mechanics.body import GROUND
from ...mechanics.joint import CATALOGUE
from ...mechanics.joint_kind import Freedom
from ...mechanics.motions.base import AbstractRelativeMotion
from ...mechanics.motions.spherical import SPHERICAL
from ...mechanics.motions.translation import TRANSLATION
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
            how = "free" if link.joint is None else self.joints[link.joint]
            lines.append(f"{names[link.parent]} -> {names[link.child]}: {how}")
        cut = ", ".join(self.joints[k] for k in self.cut) or "none"
        return "\n".join([*lines, f"cut: {cut}", f"velocities: {self.n_velocities}"])


# The motion of a body that no joint ties to the tree.
_FREE = (Freedom(TRANSLATION), Freedom(SPHERICAL))


def order_of(motion: AbstractRelativeMotion) -> tuple[int, str]:
    """Sorting key of a class of motions, in the state and within a level."""
    return math.prod(motion.positions), type(motion).__name__


def spanning_tree(system: System, cut: Sequence[str] = ()) -> SpanningTree:
    """Choose the spanning tree of a system.

    Args:
        cut: names of joints that must close loops; others are added as the module describes.

    Raises:
        ModelError: `cut` names an unknown joint.
    """
    joints = [joint.name for joint in system.joints]
    for name in cut:
        if name not in joints:
            raise ModelError(f"There is no joint '{name}' to cut.{nearest_names(name, joints)}")
    ends = _ends(system)
    kept = _keep(system, ends, set(cut))
    links, root = _links(system, ends, kept)
    steps, frame = _steps(system, links, root)
    rest = tuple(k for k in range(len(joints)) if k not in kept)
    return SpanningTree((*system.names, GROUND), tuple(joints), root, links, rest, steps, frame)


def _ends(system: System) -> list[tuple[int, int]]:
    place = {name: k for k, name in enumerate((*system.names, GROUND))}
    return [(place[joint.body_i], place[joint.body_j]) for joint in system.joints]


def _distances(system: System, ends: list[tuple[int, int]]) -> list[int]:
    """Distance of every body in joints from ground, or from body 0 if no joint is on ground."""
    n = system.n_bodies
    far = [n + 1] * (n + 1)
    start = n if any(n in pair for pair in ends) else 0
    far[start], todo = 0, [start]
    for at in todo:
        for pair in ends:
            for here, there in (pair, pair[::-1]):
                if here == at and far[there] > far[at] + 1:
                    far[there] = far[at] + 1
                    todo.append(there)
    return far


def _keep(system: System, ends: list[tuple[int, int]], cut: set[str]) -> set[int]:
    """Numbers of the joints of the tree."""
    far = _distances(system, ends)
    able = [
        k
        for k, joint in enumerate(system.joints)
        if joint.name not in cut and CATALOGUE[joint.kind].motion is not None
    ]
    able.sort(key=lambda k: (-system.joints[k].n_rows, sum(far[b] for b in ends[k]), k))
    group = list(range(system.n_bodies + 1))

    def leader(b: int) -> int:
        while group[b] != b:
            b = group[b]
        return b

    kept = set()
    for k in able:
        i, j = map(leader, ends[k])
        if i != j:
            group[i] = j
            kept.add(k)
    return kept


def _links(
    system: System, ends: list[tuple[int, int]], kept: set[int]
) -> tuple[tuple[Link, ...], int]:
    """Joints of the tree, from the root outwards, and the root."""
    ground = system.n_bodies
    links: list[Link] = []
    reached: set[int] = set()

    def grow(start: int) -> None:
        reached.add(start)
        todo = [start]
        for at in todo:
            for k in sorted(kept):
                for here, there, forward in ((*ends[k], True), (*ends[k][::-1], False)):
                    if here == at and there not in reached:
                        links.append(Link(k, at, there, forward))
                        reached.add(there)
                        todo.append(there)

    if system.floating and len(kept) == system.n_bodies - 1:
        root = _base(system, ends, kept)
        grow(root)
        return tuple(links), root
    grow(ground)
    while len(reached) <= system.n_bodies:
        start = min(set(range(ground)) - reached)
        links.append(Link(None, ground, start, True))
        grow(start)
    return tuple(links), ground


def _base(system: System, ends: list[tuple[int, int]], kept: set[int]) -> int:
    """Body with the most tree joints, the first among equals, which gives short chains."""
    count = [0] * system.n_bodies
    for k in kept:
        for body in ends[k]:
            count[body] += 1
    return count.index(max(count))


def _steps(
    system: System, links: tuple[Link, ...], root: int
) -> tuple[tuple[Step, ...], tuple[int, ...]]:
    """Steps of all links, sorted by level, and the frame of every body."""
    frame = {root: -1}
    found: list[Step] = []
    for link in links:
        if link.joint is None:
            motion = _FREE
        else:
            motion = CATALOGUE[system.joints[link.joint].kind].motion or ()
            motion = motion if link.forward else motion[::-1]
        at, before = frame[link.parent], None
        for number, (moves, axis, _) in enumerate(motion):
            level = 1 + (found[at].level if at >= 0 else 0)
            last = number == len(motion) - 1
            step = Step(moves, axis, before, at, level, link.joint, link.child, number == 0, last)
            found.append(step)
            at, before = len(found) - 1, axis
        frame[link.child] = at
    place = lambda k: (found[k].level, order_of(found[k].motion), k)
    order = sorted(range(len(found)), key=place)
    new = {old: place + 1 for place, old in enumerate(order)} | {-1: 0}
    steps = tuple(found[k]._replace(parent=new[found[k].parent]) for k in order)
    ground = system.n_bodies
    return steps, tuple(new[frame.get(b, -1)] for b in range(ground + 1))
