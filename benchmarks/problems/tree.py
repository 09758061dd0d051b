"""A spanning tree of a scene for programs in relative coordinates: Pinocchio and MuJoCo.

The joints with the most rows are kept, the others are cut and closed by constraints: ball joints,
and hinges of planar mechanisms, where two rows in the plane say all that is left to say. Joints
are listed depth first, parents before children; Pinocchio gives a wrong mass matrix otherwise.
"""

from dataclasses import dataclass

import numpy as np
from problems.plain import ROWS, Plain, PlainJoint, Start, UnsupportedError
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Frame:
    """A placement: rotation R (3, 3) and origin x (3,) [m] in a body's axes and from its centre."""

    R: np.ndarray
    x: np.ndarray

    def inverse(self) -> "Frame":
        """From the other side."""
        return Frame(self.R.T, -self.R.T @ self.x)

    def __matmul__(self, other: "Frame") -> "Frame":
        return Frame(self.R @ other.R, self.R @ other.x + self.x)


IDENTITY = Frame(np.eye(3), np.zeros(3))


@dataclass(frozen=True)
class Link:
    """A joint of the tree. `kind`: "free", "ball", "turn" and "slide" (z), "universal" (x, then y).

    Attributes:
        parent, child: bodies (ground is n). ahead: number of the parent's link, -1: ground.
        on_parent, on_child: the joint's frame on each. joint: where it comes from.
    """

    kind: str
    parent: int
    child: int
    ahead: int
    on_parent: Frame
    on_child: Frame
    joint: PlainJoint | None = None


@dataclass(frozen=True)
class Tree:
    """Links, depth first; the joints that are cut; the link that carries each body.

    plane: (2, 3) world directions in which cut joints are closed; None: in all three.
    """

    links: tuple[Link, ...]
    cuts: tuple[PlainJoint, ...]
    carrier: tuple[int, ...]
    plane: np.ndarray | None = None


KINDS = {
    "translational": "slide", "revolute": "turn", "universal": "universal", "spherical": "ball",
}  # fmt: skip


def span(model: Plain) -> Tree:
    """A spanning tree from ground, or from the first body where nothing is tied to ground."""
    kept = _kruskal(model)
    tied = any(model.n in (joint.i, joint.j) for joint in model.joints)
    links: list[Link] = []
    carrier = {model.n: -1}

    def grow(body: int) -> None:
        for joint in kept:
            if body not in (joint.i, joint.j):
                continue
            child = joint.j if joint.i == body else joint.i
            if child not in carrier:
                links.append(_link(joint, body, child, carrier[body]))
                carrier[child] = len(links) - 1
                grow(child)

    if not tied:
        links.append(Link("free", model.n, 0, -1, IDENTITY, IDENTITY))
        carrier[0] = 0
    grow(model.n if tied else 0)
    if len(carrier) != model.n + 1:
        raise UnsupportedError("More than one floating part is not written.")
    cuts = tuple(joint for joint in model.joints if joint not in kept)
    spatial = all(joint.kind == "spherical" for joint in cuts)
    plane = None if spatial else in_plane(model)
    if plane is None and not spatial:
        said = "Cutting a spatial loop at a joint that is not spherical is not written."
        raise UnsupportedError(said)
    return Tree(tuple(links), cuts, tuple(carrier[k] for k in range(model.n)), plane)


def in_plane(model: Plain) -> np.ndarray | None:
    """Two world directions across all axes, (2, 3), if all joints are parallel hinges on ground.

    Parallel axes on every body are parallel in the world in every posture.
    """
    normals: dict[int, np.ndarray] = {}
    for joint in model.joints:
        if joint.kind != "revolute":
            return None
        for body, frame in ((joint.i, joint.frame_i), (joint.j, joint.frame_j)):
            first = normals.setdefault(body, frame[:, 2])
            if np.abs(np.cross(first, frame[:, 2])).max() > 1e-12:
                return None
    if model.n not in normals:
        return None
    return np.linalg.svd(normals[model.n][None])[2][1:]


def why_no_tree(model: Plain) -> str:
    """Why there is no tree that the peers can use; empty if there is one."""
    try:
        span(model)
    except UnsupportedError as error:
        return str(error)
    return ""


def _kruskal(model: Plain) -> list[PlainJoint]:
    """The joints that close no loop, those with the most rows first."""
    group = list(range(model.n + 1))
    kept = []
    for joint in sorted(model.joints, key=lambda joint: -ROWS[joint.kind]):
        a, b = group[joint.i], group[joint.j]
        if a != b:
            group = [a if g == b else g for g in group]
            kept.append(joint)
    return kept


def _link(joint: PlainJoint, parent: int, child: int, ahead: int) -> Link:
    first, second = Frame(joint.frame_i, joint.point_i), Frame(joint.frame_j, joint.point_j)
    if joint.kind not in KINDS or (joint.kind == "universal" and parent != joint.i):
        said = f"A {joint.kind} joint from its second body to its first is not written."
        raise UnsupportedError(said)
    if parent != joint.i:
        first, second = second, first
    return Link(KINDS[joint.kind], parent, child, ahead, first, second, joint)


def coordinates(tree: Tree, state: Start) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each link's coordinates and their rates in a consistent state.

    A free link has r and Euler parameters (7,), world velocity and body angular velocity (6,); a
    ball Euler parameters (4,) and the relative angular velocity in the child's frame (3,).
    """
    R = np.concatenate([state.R_wb, np.eye(3)[None]])
    r, v = (np.concatenate([x, np.zeros((1, 3))]) for x in (state.r, state.v))
    w = np.einsum("nab,nb->na", R, np.concatenate([state.omega, np.zeros((1, 3))]))
    result = []
    for link in tree.links:
        a, b = link.parent, link.child
        if link.kind == "free":
            rates = np.concatenate([state.v[b], state.omega[b]])
            result.append((np.concatenate([state.r[b], state.p[b]]), rates))
            continue
        F = R[a] @ link.on_parent.R
        T = F.T @ R[b] @ link.on_child.R
        turning = F.T @ (w[b] - w[a])
        if link.kind == "ball":
            p = Rotation.from_matrix(T).as_quat(scalar_first=True)
            result.append((p, T.T @ turning))
        elif link.kind == "turn":
            result.append((np.array([np.arctan2(T[1, 0], T[0, 0])]), turning[2:]))
        elif link.kind == "universal":
            first, second = np.arctan2(T[2, 1], T[1, 1]), np.arctan2(T[0, 2], T[0, 0])
            swing = np.array([0.0, np.cos(first), np.sin(first)])
            rates = np.array([turning[0], swing @ turning])
            result.append((np.array([first, second]), rates))
        else:
            arm_a, arm_b = R[a] @ link.on_parent.x, R[b] @ link.on_child.x
            d = r[b] + arm_b - r[a] - arm_a
            d_rate = v[b] + np.cross(w[b], arm_b) - v[a] - np.cross(w[a], arm_a)
            z = F[:, 2]
            rates = np.array([z @ (d_rate - np.cross(w[a], d))])
            result.append((np.array([z @ d]), rates))
    return result
