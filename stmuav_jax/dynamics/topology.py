"""Which joints span a system as a tree, and which are cut: structure only, no numbers.

The tree keeps the joints with the most rows, so that the cut ones leave the fewest
constraints (Kruskal's method); among equals those nearer to the root, for short chains.
A part of the system that no joint with relative coordinates ties to ground floats: all six
motions of one of its bodies, its base, are coordinates.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4; J. B. Kruskal, Proc.
Amer. Math. Soc. 7 (1956) 48-50.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..mechanics.body import GROUND
from ..mechanics.errors import ModelError, nearest_names
from ..mechanics.joint import CATALOGUE, X, Y, Z
from ..mechanics.system import System


class Step(NamedTuple):
    """One step of relative motion; the frame behind it turns or slides about its own z axis.

    Attributes:
        kind: "turn", "slide", "ball" or "shift".
        axis: the axis of the joint's frame that is the z axis of this step.
        before: the axis that was so for the step before, within the same joint.
        parent: the frame in front of it. level: how many frames deep.
        joint: its number; None for the free motion of a floating body.
        body: the body behind the joint. first, last: of the joint's steps.
    """

    kind: str
    axis: int
    before: int | None
    parent: int
    level: int
    joint: int | None
    body: int
    first: bool
    last: bool


class Link(NamedTuple):
    """A tree joint: its number (None: free), the bodies in front and behind, its direction."""

    joint: int | None
    parent: int
    child: int
    forward: bool


@dataclass(frozen=True)
class SpanningTree:
    """A spanning tree of a system's joint graph, with frame 0 the root.

    Attributes:
        bodies: names, the last is "ground". joints: names.
        root: the body of frame 0: ground, or the base of a system that floats.
        links: the joints of the tree, parents first. cut: numbers of the cut joints.
        steps: frames 1, 2, ... sorted by level, then by kind.
        frame: of every body and ground, the frame that carries it.
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
        """Whether the root moves."""
        return self.root != len(self.bodies) - 1

    @property
    def n_velocities(self) -> int:
        """Degrees of freedom of the tree, the cut joints left open."""
        return 6 * self.floating + sum(_WIDTH[step.kind] for step in self.steps)

    def behind(self) -> list[tuple[int, float, set[int]]]:
        """For every joint of the tree: its number, +1 if it leads from i to j, else -1, and the
        bodies behind it."""
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


_WIDTH = {"turn": 1, "slide": 1, "ball": 3, "shift": 3}
_FREE = (("shift", Z), ("ball", Z))


def spanning_tree(system: System, cut: Sequence[str] = ()) -> SpanningTree:
    """Choose the tree of a system.

    Args:
        cut: names of joints that must be cut; the others are chosen as said above.

    Raises:
        ModelError: an unknown joint to cut.
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
    """Of every body, how many joints from ground, or from the first body where it floats."""
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
    """The tree's joints from the root outwards, and the root."""
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
    """The body with the most tree joints, the first of equals: the shortest chains."""
    count = [0] * system.n_bodies
    for k in kept:
        for body in ends[k]:
            count[body] += 1
    return count.index(max(count))


def _steps(
    system: System, links: tuple[Link, ...], root: int
) -> tuple[tuple[Step, ...], tuple[int, ...]]:
    """The frames behind all links, sorted by level, and the frame of every body."""
    frame = {root: -1}
    found: list[Step] = []
    for link in links:
        if link.joint is None:
            motion = _FREE
        else:
            motion = CATALOGUE[system.joints[link.joint].kind].motion or ()
            motion = motion if link.forward else motion[::-1]
        at, before = frame[link.parent], None
        for number, (kind, axis) in enumerate(motion):
            level = 1 + (found[at].level if at >= 0 else 0)
            last = number == len(motion) - 1
            step = Step(kind, axis, before, at, level, link.joint, link.child, number == 0, last)
            found.append(step)
            at, before = len(found) - 1, axis
        frame[link.child] = at
    rank = {"turn": 0, "slide": 0, "shift": 1, "ball": 2}
    order = sorted(range(len(found)), key=lambda k: (found[k].level, rank[found[k].kind], k))
    new = {old: place + 1 for place, old in enumerate(order)} | {-1: 0}
    steps = tuple(found[k]._replace(parent=new[found[k].parent]) for k in order)
    ground = system.n_bodies
    return steps, tuple(new[frame.get(b, -1)] for b in range(ground + 1))


# Columns of a joint's frame in the order that makes the given axis the third.
CYCLIC = {X: (Y, Z, X), Y: (Z, X, Y), Z: (X, Y, Z)}
