"""Parameters of a spanning tree: its constant rotations, positions, masses and inertias.

Spatial vectors are (angular, linear), in the axes of frame 0 and about its origin. Frame 0 has the
axes of the world and its origin at a joint with ground or, if the system floats, the axes of the
base and its origin at the base's centre of mass. Both are near the bodies, wherever in the world
these are: a moment of inertia J about a point at a distance c from a mass m is rounded to 1e-16 m c^2,
which may be more than J.
Velocities then add from the root outwards, and inertias and wrenches from the tips inwards,
without any transformation. Frames of equal depth are evaluated together.

Arrays have their components first, then the frames (or bodies), then the axes of a batch of
states, if any (`stmuav_jax.algebra.stacked`).

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2, 5 and 6.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.compiler import kept_jit
from ...algebra.rotation import conjugate, from_matrix, product
from ...algebra.stacked import dot
from ...checks.numbers import as_jax, as_numpy, floats, stacked
from ...mechanics.motions.base import CYCLIC, ColumnParts
from ...mechanics.system import System
from .frames import MotionGroup, aligned, columns, levels, motion_groups, pick, support
from .topology import Link, SpanningTree

_EYE = np.eye(3)


class TreeParameters(eqx.Module):
    """Parameters of a tree with f frames besides frame 0 and n bodies.

    Attributes:
        K, k: rotation (3, 3, f) and position (3, f) [m] of every frame in its parent, where
            the coordinates of the frame's own step are zero.
        B: axes of the bodies and of ground in those of their frames (3, 3, n + 1).
        com: centres of mass in the axes and about the origins of their frames (3, n + 1) [m]; that
            of ground is the world's origin.
        mass: mass of all bodies fixed to a frame, taken as one (f + 1,) [kg].
        centre: their centre of mass in the frame (3, f + 1) [m].
        inertia: their inertia about it in the frame's axes (3, 3, f + 1) [kg m^2].
        subtree_mass: mass of all bodies that a frame supports (f + 1,) [kg].
        K_p, B_p: Euler parameters of K (4, f) and B (4, n + 1), with the signs for which the
            bodies' Euler parameters at the reference posture are those of the reference.
        pitch: pitch of the joint of every frame (f,) [m/rad]; None where no joint is a screw.
    """

    tree: SpanningTree = eqx.field(static=True)
    K: Float[Array, "3 3 f *s"]
    k: Float[Array, "3 f *s"]
    B: Float[Array, "3 3 N *s"]
    com: Float[Array, "3 N *s"]
    mass: Float[Array, "F *s"]
    centre: Float[Array, "3 F *s"]
    inertia: Float[Array, "3 3 F *s"]
    subtree_mass: Float[Array, "F *s"]
    K_p: Float[Array, "4 f *s"]
    B_p: Float[Array, "4 N *s"]
    pitch: Float[Array, "f *s"] | None = None


def tree_parameters(system: System, tree: SpanningTree) -> TreeParameters:
    """Parameters of a tree, from the joints and bodies of its system."""
    # concrete numbers are handled by NumPy: a hundred small operations, none to compile
    system = eqx.tree_at(lambda s: s.forces, system, ())
    system = as_numpy(system)
    com_ref = [*system.bodies.com, np.zeros(3)]
    K: list[Any] = []
    k: list[Any] = []
    B: dict[int, Any] = {tree.root: _EYE}
    com: dict[int, Any] = {tree.root: np.zeros(3) if tree.floating else -_origin(system, tree)}
    by_link = {link.child: link for link in tree.links}
    for link in tree.links:
        frame_i, point_i, frame_j, point_j = _sides(system, link)
        at = com[link.parent] + B[link.parent] @ (point_i - com_ref[link.parent])
        start = B[link.parent] @ frame_i
        steps = [s for s in tree.steps if s.body == link.child]
        last = _columns(steps[-1].axis) if steps else _EYE
        # a weld has no frame of its own: its body is fixed to the parent's frame
        B[link.child] = (frame_j @ last).T if steps else start @ frame_j.T
        arm = B[link.child] @ (com_ref[link.child] - point_j)
        com[link.child] = arm if steps else at + arm
    for step in tree.steps:
        link = by_link[step.body]
        frame_i, point_i, *_ = _sides(system, link)
        if step.first:
            K.append(B[link.parent] @ frame_i @ _columns(step.axis))
            k.append(com[link.parent] + B[link.parent] @ (point_i - com_ref[link.parent]))
        else:
            assert step.before is not None
            K.append(_columns(step.before).T @ _columns(step.axis))
            k.append(np.zeros(3))
    ground = system.n_bodies
    B.setdefault(ground, _EYE)
    com.setdefault(ground, np.zeros(3))
    axes = [B[b] for b in range(ground + 1)]
    mass, centre, inertia = _by_frame(system, tree, axes, com)
    stacked_K, stacked_B = _stack(K, (3, 3)), _stack(axes, (3, 3))
    p = as_jax(system.reference.p)
    K_p, B_p = _constant_euler_parameters(tree, stacked_K, stacked_B, p)
    return TreeParameters(
        tree,
        stacked_K,
        _stack(k, (3,)),
        stacked_B,
        _stack([com[b] for b in range(ground + 1)], (3,)),
        mass,
        centre,
        inertia,
        as_jax(as_numpy(mass) @ support(tree).T.astype(float)),
        K_p,
        B_p,
        _pitches(system, tree),
    )


def _origin(system: System, tree: SpanningTree) -> Any:
    """Point of the world (3,) [m] where a tree that stands on ground has the origin of frame 0."""
    for link in tree.links:
        if link.parent == tree.root and link.joint is not None:
            point = _sides(system, link)[1]
            # the motion does not depend on it, and neither do derivatives
            return point if isinstance(point, np.ndarray) else jax.lax.stop_gradient(point)
    return np.zeros(3)


def _pitches(system: System, tree: SpanningTree) -> Float[Array, "f"] | None:
    if not np.any(columns(tree).pitched):
        return None
    joints = [None if step.joint is None else system.joints[step.joint] for step in tree.steps]
    zero = np.zeros(())
    return _stack([j.length if j is not None and j.pitched else zero for j in joints], ())


def _by_frame(
    system: System, tree: SpanningTree, axes: list[Any], com: dict[int, Any]
) -> tuple[Float[Array, "F"], Float[Array, "3 F"], Float[Array, "3 3 F"]]:
    """Mass, centre of mass and inertia of the bodies fixed to each frame; zeros without any."""
    bodies = system.bodies
    found: list[tuple[Any, Any, Any]] = []
    for frame in range(len(tree.steps) + 1):
        own = [b for b in range(system.n_bodies) if tree.frame[b] == frame]
        if not own:
            found.append((np.zeros(()), np.zeros(3), np.zeros((3, 3))))
            continue
        mass = sum(bodies.mass[b] for b in own)
        centre = sum(bodies.mass[b] * com[b] for b in own) / mass
        inertia: Any = 0.0
        for b in own:
            arm = com[b] - centre
            square = (arm @ arm) * _EYE - arm[:, None] * arm[None]
            inertia = inertia + axes[b] @ bodies.inertia[b] @ axes[b].T + bodies.mass[b] * square
        found.append((mass, centre, inertia))
    masses, centres, tensors = zip(*found, strict=True)
    return _stack(list(masses), ()), _stack(list(centres), (3,)), _stack(list(tensors), (3, 3))


@kept_jit
def _constant_euler_parameters(
    tree: SpanningTree, K: Float[Array, "3 3 f"], B: Float[Array, "3 3 N"], p: Float[Array, "n 4"]
) -> tuple[Float[Array, "4 f"], Float[Array, "4 N"]]:
    """Euler parameters K_p and B_p of the constant rotations, with the signs of the reference."""
    columns_of = lambda A: jax.vmap(from_matrix, in_axes=-1, out_axes=-1)(A)
    K_p = columns_of(K) if K.shape[2] else jnp.zeros((4, 0), K.dtype)
    B_p = columns_of(B)
    # all coordinates are zero at the reference posture
    turned = jnp.zeros((4, len(tree.steps)), K.dtype).at[0].set(1.0)
    found = product(pick(_frames(tree, K_p, turned), np.array(tree.frame), 1), B_p)
    unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], p.dtype)
    reference = jnp.concatenate([p, unit]).T
    if tree.floating:
        reference = product(conjugate(p[tree.root])[:, None], reference)
    return K_p, jnp.where(dot(found, reference) < 0, -B_p, B_p)


def _frames(
    tree: SpanningTree, K_p: Float[Array, "4 f *s"], turned: Float[Array, "4 f *s"]
) -> Float[Array, "4 f+1 *s"]:
    """Euler parameters of all frames relative to frame 0, from those of their steps."""
    own = product(K_p, turned)
    unit = jnp.zeros((4, 1, *own.shape[2:]), own.dtype).at[0].set(1.0)
    parts = [unit]
    for level in levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(product(pick(parts[-1], level.parents, 1), own[:, at]))
    return jnp.concatenate(parts, axis=1)


def euler_parameters(
    parameters: TreeParameters, q: tuple[Float[Array, "..."], ...], u: Float[Array, "m *s"]
) -> Float[Array, "4 N *s"]:
    """Euler parameters of all bodies and ground relative to frame 0, continuous in q.

    Args:
        q: positions by class of motion, see `TreeCoordinates`.
        u: velocities, of which only the shape is used.
    """
    tree = parameters.tree
    groups = motion_groups(tree)
    turned = [
        group.motion.euler_parameters(own, shares(parameters, group, u.ndim - 1))
        for group, own in zip(groups, q, strict=True)
    ]
    turned = by_step(groups, turned, 1) if groups else jnp.zeros((4, 0, *u.shape[1:]), u.dtype)
    frames = _frames(tree, parameters.K_p, turned)
    return product(pick(frames, np.array(tree.frame), 1), parameters.B_p)


def by_step(groups: tuple[MotionGroup, ...], parts: Sequence[Array], axis: int) -> Array:
    """Concatenate the arrays of all groups in the order of the tree's steps along an axis."""
    if len(groups) == 1:
        return parts[0]
    order = np.argsort(np.concatenate([group.steps for group in groups]))
    return pick(jnp.concatenate(parts, axis=axis), order, axis)


def shares(parameters: TreeParameters, group: MotionGroup, batch: int) -> ColumnParts:
    """Angular and linear parts of a group's columns, shaped as its velocities.

    Args:
        batch: number of axes of a batch of states.
    """
    table = columns(parameters.tree)
    shape = lambda x: np.moveaxis(
        x[group.velocities].reshape(len(group.steps), *group.motion.velocities), 0, -1
    )
    angular, linear, pitched = (shape(x) for x in (table.angular, table.linear, table.pitched))
    axes = angular.ndim + batch
    if not np.any(pitched):
        return ColumnParts(aligned(angular, axes), aligned(linear, axes), pitched)
    assert parameters.pitch is not None
    pitch = pick(parameters.pitch, group.steps, 0)
    own = jnp.where(aligned(pitched, pitched.ndim + pitch.ndim - 1) > 0, pitch, linear)
    return ColumnParts(
        aligned(angular, axes), own.reshape(*own.shape, *(1,) * (axes - own.ndim)), pitched
    )


def _stack(rows: list[Any], shape: tuple[int, ...]) -> Array:
    if not rows:
        return floats(np.zeros((*shape, 0)))
    return stacked(rows, axis=-1)


def _columns(axis: int) -> np.ndarray:
    return _EYE[:, CYCLIC[axis]]


def _sides(system: System, link: Link) -> tuple[Any, Any, Any, Any]:
    """Joint frame and point on the parent body, then on the child body."""
    if link.joint is None:
        # the free motion of a body is the motion of its centre of mass and of its own axes
        return _EYE, np.zeros(3), _EYE, system.bodies.com[link.child]
    joint = system.joints[link.joint]
    sides = ((joint.frame_i, joint.point_i), (joint.frame_j, joint.point_j))
    front, behind = sides if link.forward else sides[::-1]
    return *front, *behind
