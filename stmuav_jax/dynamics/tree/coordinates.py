"""Coordinates of a spanning tree: flat vectors, small motions, and conversion from a state."""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...math import lapack
from ...math.native.program import native
from ...math.rotation import (
    conjugate,
    cross,
    euler_parameter_rate,
    normalise,
    product,
    rotation_matrix,
)
from ...math.stacked import apply_matrix, apply_transposed, dot_product, multiply_matrices
from ...mechanics.motions import RelativeFrames, reference_directions
from ...mechanics.state import State
from .parameters import Pose, TreeParameters, by_group, column_shares
from .topology import (
    SpanningTree,
    motion_columns,
    motion_groups,
    pad_lists,
    pick_entries,
    tree_levels,
)


class TreeCoordinates(NamedTuple):
    """Positions and velocities of a tree; b is 1 for a floating system and 0 otherwise.

    Attributes:
        r, p: position of the base's centre of mass in the world (3, b) [m], and the base's Euler
            parameters (4, b).
        q: positions of the steps by class of motion (`motion_groups`), (*positions of one, k):
            revolute [rad], prismatic [m] and helical [rad] ones as one class, translations [m],
            Euler parameters of spherical ones.
        v, omega: velocity of the base's centre of mass in the world (3, b) [m/s], and the base's
            angular velocity in its axes (3, b) [rad/s].
        u: velocities of the steps, in the order of the frames (m,).
    """

    r: Float[Array, "3 b *s"]
    p: Float[Array, "4 b *s"]
    q: tuple[Float[Array, "..."], ...]
    v: Float[Array, "3 b *s"]
    omega: Float[Array, "3 b *s"]
    u: Float[Array, "m *s"]


def fill_coordinates(
    tree: SpanningTree, make: Callable[[tuple[int, ...]], Array]
) -> TreeCoordinates:
    """Coordinates whose parts `make` creates from their shapes, in the flat vector's order."""
    b = int(tree.floating)
    r, p = make((3, b)), make((4, b))
    q = tuple(make((*g.motion.positions, len(g.steps))) for g in motion_groups(tree))
    v, omega = make((3, b)), make((3, b))
    return TreeCoordinates(r, p, q, v, omega, make((len(motion_columns(tree).frame),)))


def split_vector(tree: SpanningTree, x: Float[Array, "k *s"]) -> TreeCoordinates:
    """Coordinates from a flat vector, with the axes of a batch last."""
    # Slices of constant bounds: the flat vector of the solver and the structured coordinates share memory
    # in the compiled program.
    start = 0

    def take_part(shape: tuple[int, ...]) -> Array:
        nonlocal start
        first, start = start, start + math.prod(shape)
        return x[first:start].reshape(*shape, *x.shape[1:])

    return fill_coordinates(tree, take_part)


def join_coordinates(parts: TreeCoordinates) -> Float[Array, "k *s"]:
    """Flat vector of the coordinates."""
    batch = parts.u.shape[1:]
    return jnp.concatenate([part.reshape(-1, *batch) for part in jax.tree.leaves(parts)])


def unit_vectors(tree: SpanningTree, at: TreeCoordinates) -> list[Float[Array, "..."]]:
    """Unit vectors (c, k, *s) among the positions: Euler parameters of the base and of steps."""
    groups = zip(motion_groups(tree), at.q, strict=True)
    return [at.p, *(q for group, q in groups if group.motion.unit_norm)]


def normalise_vectors(tree: SpanningTree, at: TreeCoordinates) -> TreeCoordinates:
    """Coordinates with their unit vectors normalised."""
    return with_unit_vectors(tree, at, normalise)


def with_unit_vectors(
    tree: SpanningTree, at: TreeCoordinates, change: Callable[..., Array], *more: TreeCoordinates
) -> TreeCoordinates:
    """Coordinates with each unit vector v replaced by change(v, *those in its place in `more`)."""
    q = tuple(
        change(*positions) if group.motion.unit_norm else positions[0]
        for group, *positions in zip(motion_groups(tree), at.q, *(x.q for x in more), strict=True)
    )
    return at._replace(p=change(at.p, *(x.p for x in more)), q=q)


def retract_coordinates(
    tree: SpanningTree, at: TreeCoordinates, step: Float[Array, "k *s"]
) -> TreeCoordinates:
    """Coordinates after a small motion along the velocities of the steps."""
    parts = zip(motion_groups(tree), at.q, by_group(tree, step), strict=True)
    return at._replace(q=tuple(group.motion.retract(q, increment) for group, q, increment in parts))


def coordinate_rates(
    tree: SpanningTree, at: TreeCoordinates, u_rate: Float[Array, "l *s"]
) -> TreeCoordinates:
    """Rates of all coordinates at the given accelerations, in the order of `mass_matrix`."""
    parts = zip(motion_groups(tree), at.q, by_group(tree, at.u), strict=True)
    q = tuple(group.motion.rates(q, velocities) for group, q, velocities in parts)
    # The base's position and velocity are integrated in the world's axes, its angular velocity in its
    # own, as bodies are given.
    if not tree.floating:
        return TreeCoordinates(at.r, at.p, q, at.v, at.omega, u_rate)
    return TreeCoordinates(
        r=at.v,
        p=euler_parameter_rate(at.p, at.omega),
        q=q,
        v=apply_matrix(rotation_matrix(at.p), u_rate[3:6, None]),
        omega=u_rate[:3, None],
        u=u_rate[6:],
    )


@native
def read_coordinates(parameters: TreeParameters, state: State) -> TreeCoordinates:
    """Coordinates of a state of all bodies that satisfies the tree's joints.

    Angles are in (-pi, pi], except those of screws, whose displacement counts whole turns.
    """
    tree = parameters.tree
    base = slice(tree.root, tree.root + tree.floating)
    coordinates = fill_coordinates(tree, lambda shape: jnp.zeros(shape, state.r.dtype))
    coordinates = coordinates._replace(
        r=state.r[base].T, p=state.p[base].T, v=state.v[base].T, omega=state.omega[base].T
    )
    if not tree.steps:
        return coordinates
    ends = _joint_ends(parameters, state)
    pose, q = _read_positions(parameters, ends, state)
    return coordinates._replace(q=q, u=_read_velocities(parameters, pose, ends))


class _Ends(NamedTuple):
    """Bodies and ground in the axes of frame 0: axes of their frames, positions, velocities.

    The positions are those of the centres of mass from frame 0's origin; the velocities are absolute.
    """

    E: Float[Array, "3 3 N"]
    r: Float[Array, "3 N"]
    v: Float[Array, "3 N"]
    omega: Float[Array, "3 N"]


def _joint_ends(parameters: TreeParameters, state: State) -> _Ends:
    tree = parameters.tree
    none = jnp.zeros((3, 1), state.r.dtype)
    unit = jnp.eye(3, dtype=state.r.dtype)[:, :, None]
    R_wb = jnp.concatenate([rotation_matrix(state.p.T), unit], axis=2)
    r, v = (jnp.concatenate([x.T, none], axis=1) for x in (state.r, state.v))
    omega = apply_matrix(R_wb, jnp.concatenate([state.omega.T, none], axis=1))
    at = slice(tree.root, tree.root + 1)
    R_w0 = R_wb[:, :, at]
    E = multiply_matrices(
        jnp.swapaxes(R_w0, 0, 1), multiply_matrices(R_wb, jnp.swapaxes(parameters.B, 0, 1))
    )
    # Relative to the root before anything else is computed, so that the coordinates of joints have the
    # round-off of the mechanism's size and not of its distance.
    to_root_axes = lambda x: apply_transposed(R_w0, x)
    # in the world the root is ground, whose position in frame 0 is not zero
    return _Ends(
        E, to_root_axes(r - r[:, at]) + parameters.com[:, at], to_root_axes(v), to_root_axes(omega)
    )


def _reference_directions(tree: SpanningTree) -> tuple[np.ndarray, np.ndarray]:
    """Reference directions (3, f) of all steps, see `reference_directions`."""
    behind, zero = np.zeros((2, 3, len(tree.steps)))
    for step_indices in {steps[-1]: steps for steps in _in_joint(tree, whole=True)}.values():
        steps = [tree.steps[f] for f in step_indices]
        joint = steps[0].joint
        owner_text = "A free body" if joint is None else f"Joint '{tree.joints[joint]}'"
        directions = reference_directions([(step.motion, step.axis) for step in steps], owner_text)
        behind[:, step_indices], zero[:, step_indices] = directions
    return behind, zero


def _in_joint(tree: SpanningTree, *, whole: bool = False) -> list[list[int]]:
    """Steps of the joint of every step, up to the step itself or all of them."""
    by_body: dict[int, list[int]] = {}
    up_to = []
    # the steps of a joint are sorted by their level
    for f, step in enumerate(tree.steps):
        joint_steps = by_body.setdefault(step.body, [])
        joint_steps.append(f)
        up_to.append(joint_steps if whole else list(joint_steps))
    return up_to


def _read_positions(
    parameters: TreeParameters, ends: _Ends, state: State
) -> tuple[Pose, tuple[Array, ...]]:
    """Poses of all frames, and the positions of every class of motion."""
    tree = parameters.tree
    groups = motion_groups(tree)
    behind, zero = _reference_directions(tree)
    between = _relative_parameters(parameters, state)
    E, o = [jnp.eye(3, dtype=ends.r.dtype)[:, :, None]], [jnp.zeros((3, 1), ends.r.dtype)]
    values: list[list[Array]] = [[] for _ in groups]
    for level in tree_levels(tree):
        at = np.arange(level.frames.start, level.frames.stop) - 1
        body = np.array([tree.steps[f].body for f in at])
        # Frames are read outwards: the pose of a parent is rebuilt from its own coordinates, so that a
        # violation of one joint does not enter those behind it.
        before = pick_entries(E[-1], level.parents, 2)
        G = multiply_matrices(before, pick_entries(parameters.K, at, 2))
        origin = pick_entries(o[-1], level.parents, 1) + apply_matrix(
            before, pick_entries(parameters.k, at, 1)
        )
        end = pick_entries(ends.E, body, 2)
        point = pick_entries(ends.r, body, 1) - apply_matrix(
            end, pick_entries(parameters.com, body, 1)
        )
        relative_rotation = multiply_matrices(jnp.swapaxes(G, 0, 1), end)
        offset = apply_transposed(G, point - origin)
        X, translations = [], []
        # frames of a level are sorted by class
        for group, group_values in zip(groups, values, strict=True):
            indices = np.flatnonzero(np.isin(at, group.steps))
            if not len(indices):
                continue
            part = group.restricted(at[indices])
            relative_frames = RelativeFrames(
                pick_entries(relative_rotation, indices, 2),
                behind[:, at[indices]],
                zero[:, at[indices]],
                pick_entries(offset, indices, 1),
                lambda part=part: between(part.steps),
            )
            q, *pose_parts = group.motion.read(relative_frames, column_shares(parameters, part, 0))
            group_values.append(q)
            X.append(pose_parts[0])
            translations.append(pose_parts[1])
        E.append(multiply_matrices(G, _concatenate_parts(X)))
        o.append(origin + apply_matrix(G, _concatenate_parts(translations)))
    pose = Pose(jnp.concatenate(E, axis=2), jnp.concatenate(o, axis=1))
    return pose, tuple(_concatenate_parts(parts) for parts in values)


def _concatenate_parts(parts: list[Array]) -> Array:
    return parts[0] if len(parts) == 1 else jnp.concatenate(parts, axis=-1)


def _relative_parameters(
    parameters: TreeParameters, state: State
) -> Callable[[np.ndarray], Float[Array, "4 k"]]:
    """Function of steps that gives their motions' Euler parameters, with the bodies' signs."""
    front, behind = _step_bodies(parameters.tree)
    up_to, whole = _in_joint(parameters.tree), _in_joint(parameters.tree, whole=True)

    @functools.cache
    def of_bodies() -> Float[Array, "4 N"]:
        """Euler parameters of the bodies' frames in the world."""
        unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], state.p.dtype)
        return product(jnp.concatenate([state.p, unit]).T, conjugate(parameters.B_p))

    def parameters_between(steps: np.ndarray) -> Float[Array, "4 k"]:
        # other motions of the joint do not turn, but their frames may have other axes
        earlier_steps, later_steps = (
            [up_to[f] for f in steps],
            [whole[f][: len(up_to[f]) - 1 : -1] for f in steps],
        )
        before, after = (pick_entries(of_bodies(), ends[steps], 1) for ends in (front, behind))
        before = _product_of(before, parameters.K_p, earlier_steps)
        return product(
            conjugate(before), _product_of(after, conjugate(parameters.K_p), later_steps)
        )

    return parameters_between


def _product_of(
    first: Float[Array, "4 k"], table: Float[Array, "4 f"], lists: list[list[int]]
) -> Float[Array, "4 k"]:
    """Products of quaternions with the listed ones of a table, in sequence."""
    unit = jnp.zeros_like(table[:, :1]).at[0].set(1.0)
    count = table.shape[1]
    for indices in pad_lists(lists, count).T:
        rows = table if np.all(indices < count) else jnp.concatenate([table, unit], axis=1)
        first = product(first, pick_entries(rows, indices, 1))
    return first


def _read_velocities(parameters: TreeParameters, pose: Pose, ends: _Ends) -> Array:
    """Velocities of all steps: those of the child relative to the parent body, along the axes."""
    tree = parameters.tree
    front, behind = _step_bodies(tree)
    table = motion_columns(tree)
    frame = table.frame
    axis, at = pose.E[:, table.axis, frame], pick_entries(pose.o, frame, 1)
    b, f = behind[frame - 1], front[frame - 1]
    omega_b, omega_f = pick_entries(ends.omega, b, 1), pick_entries(ends.omega, f, 1)
    v_b = pick_entries(ends.v, b, 1) + cross(omega_b, at - pick_entries(ends.r, b, 1))
    v_f = pick_entries(ends.v, f, 1) + cross(omega_f, at - pick_entries(ends.r, f, 1))
    turning, sliding = dot_product(axis, omega_b - omega_f), dot_product(axis, v_b - v_f)
    velocities = jnp.where(table.angular > 0, turning, sliding)
    for joint_columns in _long_joints(tree):
        # a slide is not at rest at its own origin where a later step turns about another one
        turn, pivot = (
            table.angular[joint_columns] * axis[:, joint_columns],
            at[:, joint_columns[-1:]],
        )
        pitch = 0.0 if parameters.pitch is None else parameters.pitch[frame[joint_columns] - 1]
        linear_share = table.linear[joint_columns] + table.pitched[joint_columns] * pitch
        S = jnp.concatenate(
            [
                turn,
                linear_share * axis[:, joint_columns] + cross(turn, pivot - at[:, joint_columns]),
            ]
        )
        twist = jnp.concatenate([omega_b - omega_f, v_b - v_f])[:, joint_columns[-1]]
        velocities = velocities.at[joint_columns].set(lapack.solve(S.T @ S, S.T @ twist))
    return velocities


def _long_joints(tree: SpanningTree) -> list[np.ndarray]:
    """Columns of each joint of three steps or more."""
    frame = motion_columns(tree).frame
    steps = [step.joint for step in tree.steps]
    joints = sorted({j for j in steps if j is not None and steps.count(j) > 2})
    return [np.array([k for k, f in enumerate(frame) if steps[f - 1] == j]) for j in joints]


def _step_bodies(tree: SpanningTree) -> tuple[np.ndarray, np.ndarray]:
    """Parent and child bodies of the joint of every step."""
    parent = {link.child: link.parent for link in tree.links}
    behind = [step.body for step in tree.steps]
    return np.array([parent[b] for b in behind]), np.array(behind)
