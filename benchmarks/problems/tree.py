"""A scene's spanning tree for programs in relative coordinates: Pinocchio and MuJoCo.

Tree and joint coordinates are the package's, so that all integrate in the same coordinates. The
joints that it cuts are closed by constraints: ball joints, and hinges of planar mechanisms, where two
rows in the plane say all that is left to say. Joints are listed depth first, parents before
children; Pinocchio gives a wrong mass matrix otherwise.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from problems.plain import Plain, PlainJoint, UnsupportedError, plain

from stmuav_jax import Scene, State
from stmuav_jax.dynamics.tree.coordinates import read_coordinates
from stmuav_jax.dynamics.tree.parameters import TreeParameters, by_group, tree_parameters
from stmuav_jax.dynamics.tree.topology import motion_groups, spanning_tree


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
    parameters: the package's of this tree.
    """

    links: tuple[Link, ...]
    cuts: tuple[PlainJoint, ...]
    carrier: tuple[int, ...]
    plane: np.ndarray | None
    parameters: TreeParameters


KINDS = {
    "translational": "slide", "revolute": "turn", "universal": "universal", "spherical": "ball",
}  # fmt: skip


def span(scene: Scene, model: Plain | None = None) -> Tree:
    """The scene's spanning tree, from ground or from the body that floats."""
    model, spanned = model or plain(scene), spanning_tree(scene.system)
    links: list[Link] = []
    carrier = {model.n: -1}

    def grow(body: int) -> None:
        for number, parent, child, forward in spanned.links:
            if parent != body:
                continue
            if number is None:
                raise UnsupportedError("More than one floating part")
            links.append(_link(model.joints[number], parent, child, carrier[body], forward))
            carrier[child] = len(links) - 1
            grow(child)

    if spanned.floating:
        links.append(Link("free", model.n, spanned.root, -1, IDENTITY, IDENTITY))
        carrier[spanned.root] = 0
    grow(spanned.root)
    cuts = tuple(model.joints[k] for k in spanned.cut)
    spatial = all(joint.kind == "spherical" for joint in cuts)
    plane = None if spatial else in_plane(model)
    if plane is None and not spatial:
        raise UnsupportedError("Cutting a spatial loop at a joint that is not spherical")
    bodies = tuple(carrier[k] for k in range(model.n))
    return Tree(tuple(links), cuts, bodies, plane, tree_parameters(scene.system, spanned))


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


def _link(joint: PlainJoint, parent: int, child: int, ahead: int, forward: bool) -> Link:
    ends = Frame(joint.frame_i, joint.point_i), Frame(joint.frame_j, joint.point_j)
    if joint.kind not in KINDS or (joint.kind == "universal" and not forward):
        raise UnsupportedError(f"A {joint.kind} joint from its second body to its first")
    first, second = ends if forward else ends[::-1]
    return Link(KINDS[joint.kind], parent, child, ahead, first, second, joint)


_read = eqx.filter_jit(read_coordinates)


def coordinates(tree: Tree, state: State) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each link's coordinates and their rates in a consistent state.

    A free link has r and Euler parameters (7,), world velocity and body angular velocity (6,); a
    ball Euler parameters (4,) and the relative angular velocity in the child's frame (3,).
    """
    steps = tree.parameters.tree
    parts = (state.r, state.p, state.v, state.omega)
    at = _read(tree.parameters, jax.tree.map(jnp.asarray, state))
    found: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for group, *own in zip(motion_groups(steps), at.q, by_group(steps, at.u), strict=True):
        for k, step in enumerate(group.steps):
            q, v = (np.atleast_1d(np.asarray(x)[..., k]) for x in own)
            found.setdefault(steps.steps[step].body, []).append((q, v))
    for link in tree.links[:1]:
        if link.kind == "free":
            r, p, v, omega = (x[link.child] for x in parts)
            found[link.child] = [(np.concatenate([r, p]), np.concatenate([v, omega]))]
    each = [zip(*found[link.child], strict=True) for link in tree.links]
    return [(np.concatenate(q), np.concatenate(v)) for q, v in each]
