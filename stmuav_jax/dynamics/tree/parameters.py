"""Parameters of a spanning tree, the poses of its frames, and the spatial axes of its velocities.

Spatial vectors are (angular, linear), in the axes of frame 0 and about its origin. Frame 0 has the
axes of the world and its origin at a joint with ground or, if the system floats, the axes of the
base and its origin at the base's centre of mass. Both are near the bodies, wherever in the world
these are: a moment of inertia J about a point at a distance c from a mass m is rounded to 1e-16 m c^2,
which may be more than J.
Velocities then add from the root outwards, and inertias and wrenches from the tips inwards,
without any transformation. Frames of equal depth are evaluated together.

Arrays have their components first, then the frames (or bodies), then the axes of a batch of
states, if any (`stmuav_jax.math.stacked`).

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2, 5 and 6.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import has_values
from ...checks.numbers import as_floats, as_jax, as_numpy, stack_arrays
from ...math.compiler import compute_untraced, kept_jit
from ...math.native.program import native
from ...math.native.structure import has_structure
from ...math.rotation import conjugate, cross, from_matrix, product
from ...math.stacked import apply_matrix, dot_product, multiply_matrices
from ...mechanics.motions import CYCLIC, ColumnParts
from ...mechanics.system import System
from .topology import (
    Link,
    MotionGroup,
    SpanningTree,
    align_axes,
    find_supported,
    motion_columns,
    motion_groups,
    pick_entries,
    sum_entries,
    tree_levels,
)

_EYE = np.eye(3)


@has_structure(zero=("k", "com", "centre", "inertia"), unit=("K", "B", "K_p", "B_p"))
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
    # Known numbers are handled by NumPy, also beside traced ones such as masses: a hundred small operations,
    # none to compile.
    system = eqx.tree_at(lambda s: s.forces, system, ())
    system = jax.tree.map(as_numpy, system)
    com_ref = [*system.bodies.com, np.zeros(3)]
    K: list[Any] = []
    k: list[Any] = []
    B: dict[int, Any] = {tree.root: _EYE}
    # A tree on ground has its origin at a joint with ground rather than at the world's: a mechanism
    # kilometres away would lose digits otherwise.
    com: dict[int, Any] = {tree.root: np.zeros(3) if tree.floating else -_tree_origin(system, tree)}
    by_link = {link.child: link for link in tree.links}
    for link in tree.links:
        frame_i, point_i, frame_j, point_j = _joint_sides(system, link)
        at = com[link.parent] + B[link.parent] @ (point_i - com_ref[link.parent])
        start = B[link.parent] @ frame_i
        steps = [s for s in tree.steps if s.body == link.child]
        last = _unit_columns(steps[-1].axis) if steps else _EYE
        # a weld has no frame of its own: its body is fixed to the parent's frame
        B[link.child] = (frame_j @ last).T if steps else start @ frame_j.T
        arm = B[link.child] @ (com_ref[link.child] - point_j)
        com[link.child] = arm if steps else at + arm
    for step in tree.steps:
        link = by_link[step.body]
        frame_i, point_i, *_ = _joint_sides(system, link)
        if step.first:
            K.append(B[link.parent] @ frame_i @ _unit_columns(step.axis))
            k.append(com[link.parent] + B[link.parent] @ (point_i - com_ref[link.parent]))
        else:
            assert step.before is not None
            K.append(_unit_columns(step.before).T @ _unit_columns(step.axis))
            k.append(np.zeros(3))
    ground = system.n_bodies
    B.setdefault(ground, _EYE)
    com.setdefault(ground, np.zeros(3))
    axes = [B[b] for b in range(ground + 1)]
    mass, centre, inertia = _by_frame(system, tree, axes, com)
    rotations = (K, axes, system.reference.p)
    if has_values(rotations):
        K_p, B_p = compute_untraced(_constant_euler_parameters, tree, *rotations)
    else:
        K_p, B_p = _constant_euler_parameters(tree, *rotations)
    return TreeParameters(
        tree,
        _stack_last(K, (3, 3)),
        _stack_last(k, (3,)),
        _stack_last(axes, (3, 3)),
        _stack_last([com[b] for b in range(ground + 1)], (3,)),
        mass,
        centre,
        inertia,
        as_jax(as_numpy(mass) @ find_supported(tree).T.astype(float)),
        K_p,
        B_p,
        _step_pitches(system, tree),
    )


def _tree_origin(system: System, tree: SpanningTree) -> Any:
    """Point of the world (3,) [m] where a tree that stands on ground has the origin of frame 0."""
    for link in tree.links:
        if link.parent == tree.root and link.joint is not None:
            point = _joint_sides(system, link)[1]
            # the motion does not depend on it, and neither do derivatives
            return point if isinstance(point, np.ndarray) else jax.lax.stop_gradient(point)
    return np.zeros(3)


def _step_pitches(system: System, tree: SpanningTree) -> Float[Array, "f"] | None:
    if not np.any(motion_columns(tree).pitched):
        return None
    joints = [None if step.joint is None else system.joints[step.joint] for step in tree.steps]
    zero = np.zeros(())
    return _stack_last([j.length if j is not None and j.pitched else zero for j in joints], ())


def _by_frame(
    system: System, tree: SpanningTree, axes: list[Any], com: dict[int, Any]
) -> tuple[Float[Array, "F"], Float[Array, "3 F"], Float[Array, "3 3 F"]]:
    """Mass, centre of mass and inertia of the bodies fixed to each frame; zeros without any."""
    bodies = system.bodies
    frame_inertias: list[tuple[Any, Any, Any]] = []
    for frame in range(len(tree.steps) + 1):
        frame_bodies = [b for b in range(system.n_bodies) if tree.frame[b] == frame]
        if not frame_bodies:
            frame_inertias.append((np.zeros(()), np.zeros(3), np.zeros((3, 3))))
            continue
        # Welded bodies are one rigid body once and for all, so that they cost nothing in the passes.
        mass = sum(bodies.mass[b] for b in frame_bodies)
        centre = sum(bodies.mass[b] * com[b] for b in frame_bodies) / mass
        inertia: Any = 0.0
        for b in frame_bodies:
            arm = com[b] - centre
            square = (arm @ arm) * _EYE - arm[:, None] * arm[None]
            inertia = inertia + axes[b] @ bodies.inertia[b] @ axes[b].T + bodies.mass[b] * square
        frame_inertias.append((mass, centre, inertia))
    masses, centres, tensors = zip(*frame_inertias, strict=True)
    return (
        _stack_last(list(masses), ()),
        _stack_last(list(centres), (3,)),
        _stack_last(list(tensors), (3, 3)),
    )


def _constant_euler_parameters(
    tree: SpanningTree, K: list[Any], axes: list[Any], p: Any
) -> tuple[Float[Array, "4 f"], Float[Array, "4 N"]]:
    """Euler parameters K_p and B_p of the constant rotations, with the signs of the reference."""
    rotations = (_stack_last(K, (3, 3)), _stack_last(axes, (3, 3)))
    return _read_constant_rotations(tree, *rotations, as_jax(p))


@kept_jit
@native
def _read_constant_rotations(
    tree: SpanningTree, K: Float[Array, "3 3 f"], B: Float[Array, "3 3 N"], p: Float[Array, "n 4"]
) -> tuple[Float[Array, "4 f"], Float[Array, "4 N"]]:
    columns_of = lambda A: jax.vmap(from_matrix, in_axes=-1, out_axes=-1)(A)
    K_p = columns_of(K) if K.shape[2] else jnp.zeros((4, 0), K.dtype)
    B_p = columns_of(B)
    # all coordinates are zero at the reference posture
    step_parameters = jnp.zeros((4, len(tree.steps)), K.dtype).at[0].set(1.0)
    body_parameters = product(
        pick_entries(_compose_frames(tree, K_p, step_parameters), np.array(tree.frame), 1), B_p
    )
    unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], p.dtype)
    reference = jnp.concatenate([p, unit]).T
    if tree.floating:
        reference = product(conjugate(p[tree.root])[:, None], reference)
    # p and -p are one rotation; the sign of the reference is kept, so that saved Euler parameters are
    # continuous with those of the start.
    return K_p, jnp.where(dot_product(body_parameters, reference)[None] < 0, -B_p, B_p)


def _compose_frames(
    tree: SpanningTree, K_p: Float[Array, "4 f *s"], step_parameters: Float[Array, "4 f *s"]
) -> Float[Array, "4 f+1 *s"]:
    """Euler parameters of all frames relative to frame 0, from those of their steps."""
    relative_parameters = product(K_p, step_parameters)
    unit = (
        jnp.zeros((4, 1, *relative_parameters.shape[2:]), relative_parameters.dtype).at[0].set(1.0)
    )
    parts = [unit]
    for level in tree_levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(product(pick_entries(parts[-1], level.parents, 1), relative_parameters[:, at]))
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
    step_parameters = [
        group.motion.euler_parameters(positions, column_shares(parameters, group, u.ndim - 1))
        for group, positions in zip(groups, q, strict=True)
    ]
    step_parameters = (
        by_step(groups, step_parameters, 1) if groups else jnp.zeros((4, 0, *u.shape[1:]), u.dtype)
    )
    frames = _compose_frames(tree, parameters.K_p, step_parameters)
    return product(pick_entries(frames, np.array(tree.frame), 1), parameters.B_p)


def by_step(groups: tuple[MotionGroup, ...], parts: Sequence[Array], axis: int) -> Array:
    """Concatenate the arrays of all groups in the order of the tree's steps along an axis."""
    if len(groups) == 1:
        return parts[0]
    # The inverse permutation brings groups of one class back into the order of the steps, by a constant
    # index.
    order = np.argsort(np.concatenate([group.steps for group in groups]))
    return pick_entries(jnp.concatenate(parts, axis=axis), order, axis)


def column_shares(parameters: TreeParameters, group: MotionGroup, batch: int) -> ColumnParts:
    """Angular and linear parts of a group's columns, shaped as its velocities.

    Args:
        batch: number of axes of a batch of states.
    """
    table = motion_columns(parameters.tree)
    shape = lambda x: np.moveaxis(
        x[group.velocities].reshape(len(group.steps), *group.motion.velocities), 0, -1
    )
    angular, linear, pitched = (shape(x) for x in (table.angular, table.linear, table.pitched))
    axes = angular.ndim + batch
    if not np.any(pitched):
        return ColumnParts(align_axes(angular, axes), align_axes(linear, axes), pitched)
    assert parameters.pitch is not None
    pitch = pick_entries(parameters.pitch, group.steps, 0)
    linear_share = jnp.where(align_axes(pitched, pitched.ndim + pitch.ndim - 1) > 0, pitch, linear)
    return ColumnParts(
        align_axes(angular, axes),
        linear_share.reshape(*linear_share.shape, *(1,) * (axes - linear_share.ndim)),
        pitched,
    )


def _stack_last(rows: list[Any], shape: tuple[int, ...]) -> Array:
    if not rows:
        return as_floats(np.zeros((*shape, 0)))
    return stack_arrays(rows, axis=-1)


def _unit_columns(axis: int) -> np.ndarray:
    return _EYE[:, CYCLIC[axis]]


def _joint_sides(system: System, link: Link) -> tuple[Any, Any, Any, Any]:
    """Joint frame and point on the parent body, then on the child body."""
    if link.joint is None:
        # the free motion of a body is the motion of its centre of mass and of its own axes
        return _EYE, np.zeros(3), _EYE, system.bodies.com[link.child]
    joint = system.joints[link.joint]
    sides = ((joint.frame_i, joint.point_i), (joint.frame_j, joint.point_j))
    front, behind = sides if link.forward else sides[::-1]
    return *front, *behind


class Pose(NamedTuple):
    """Axes (3, 3, f + 1, *s) and origins (3, f + 1, *s) [m] of all frames, frame 0 first."""

    E: Float[Array, "3 3 f *s"]
    o: Float[Array, "3 f *s"]


def place(parameters: TreeParameters, q: tuple[Float[Array, "..."], ...]) -> Pose:
    """Poses of all frames of a tree with at least one step, at positions q by class of motion."""
    X, d = relative_poses(parameters, q)
    origin = root_pose(d.shape[2:], d.dtype)
    E, o = [origin.E], [origin.o]
    for level in tree_levels(parameters.tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        if level.frames.start == 1:
            # frame 0 is the identity
            E.append(X[:, :, at])
            o.append(d[:, at])
            continue
        before = pick_entries(E[-1], level.parents, 2)
        o.append(pick_entries(o[-1], level.parents, 1) + apply_matrix(before, d[:, at]))
        E.append(multiply_matrices(before, X[:, :, at]))
    return Pose(jnp.concatenate(E, axis=2), jnp.concatenate(o, axis=1))


def root_pose(batch: tuple[int, ...], dtype: Any) -> Pose:
    """Pose of frame 0 alone, for a batch of states."""
    unit = jnp.broadcast_to(align_axes(_EYE[:, :, None], 3 + len(batch)), (3, 3, 1, *batch))
    return Pose(unit, jnp.zeros((3, 1, *batch), dtype))


def relative_poses(
    parameters: TreeParameters, q: tuple[Float[Array, "..."], ...]
) -> tuple[Float[Array, "3 3 f *s"], Float[Array, "3 f *s"]]:
    """Rotations and positions [m] of all frames in their parents."""
    groups = motion_groups(parameters.tree)
    relative_poses = []
    for group, positions in zip(groups, q, strict=True):
        K, k = (
            pick_entries(parameters.K, group.steps, 2),
            pick_entries(parameters.k, group.steps, 1),
        )
        of_batch = positions.shape[len(group.motion.positions) + 1 :]
        X, d = group.motion.relative(
            positions, K, k, column_shares(parameters, group, len(of_batch))
        )
        spread = lambda x, n, of_batch=of_batch: jnp.broadcast_to(x, (*x.shape[:n], *of_batch))
        relative_poses.append((spread(X, 3), spread(d, 2)))
    X, d = zip(*relative_poses, strict=True)
    return by_step(groups, X, 2), by_step(groups, d, 1)


def spatial_axes(parameters: TreeParameters, pose: Pose) -> Float[Array, "6 m *s"]:
    """Spatial axes (angular, linear) of all velocities of the tree's steps."""
    table = motion_columns(parameters.tree)
    frame, column = table.frame, table.axis
    if np.all(column == 2) and np.array_equal(frame, np.arange(1, len(frame) + 1)):
        a, o = pose.E[:, 2, 1:], pose.o[:, 1:]
    else:
        a, o = pose.E[:, column, frame], pick_entries(pose.o, frame, 1)
    angular = align_axes(table.angular, a.ndim - 1)[None]
    linear = align_axes(table.linear, a.ndim - 1)[None]
    if np.any(table.pitched):
        assert parameters.pitch is not None
        pitch = pick_entries(parameters.pitch, frame - 1, 0)
        pitch = pitch.reshape(*pitch.shape, *(1,) * (a.ndim - 1 - pitch.ndim))
        linear = linear + (align_axes(table.pitched, a.ndim - 1) * pitch)[None]
    return jnp.concatenate([angular * a, angular * cross(o, a) + linear * a])


def by_frame(tree: SpanningTree, rows: Float[Array, "6 m *s"]) -> Float[Array, "6 f *s"]:
    """Sums of the columns of each frame over its velocities."""
    frame = motion_columns(tree).frame
    count = len(tree.steps)
    if len(frame) == count:
        return rows
    return sum_entries(
        rows, [[int(k) for k in np.flatnonzero(frame == f + 1)] for f in range(count)]
    )


def by_group(tree: SpanningTree, u: Float[Array, "m *s"]) -> tuple[Array, ...]:
    """Velocities of every class of motion, each of shape (*velocities of one frame, k, *s)."""
    velocity_groups = []
    for group in motion_groups(tree):
        velocities = pick_entries(u, group.velocities, 0)
        shape = group.motion.velocities
        if shape:
            velocities = velocities.reshape(len(group.steps), *shape, *u.shape[1:])
            velocities = jnp.moveaxis(velocities, 0, len(shape))
        velocity_groups.append(velocities)
    return tuple(velocity_groups)


def from_groups(tree: SpanningTree, parts: tuple[Array, ...]) -> Float[Array, "m *s"]:
    """Flat vector of the velocities of all classes of motion; the inverse of `by_group`."""
    groups, flat_parts = motion_groups(tree), []
    for group, part in zip(groups, parts, strict=True):
        wide = len(group.motion.velocities)
        if wide:
            part = jnp.moveaxis(part, wide, 0)
            part = part.reshape(len(group.velocities), *part.shape[wide + 1 :])
        flat_parts.append(part)
    if len(flat_parts) == 1:
        return flat_parts[0]
    if not flat_parts:
        return jnp.zeros((0,))
    order = np.argsort(np.concatenate([group.velocities for group in groups]))
    return pick_entries(jnp.concatenate(flat_parts), order, 0)
