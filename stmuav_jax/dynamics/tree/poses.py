"""Poses of the frames of a tree, and the spatial axes (motion subspaces) of its velocities."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.derivative import directional
from ...algebra.rotation import cross
from ...algebra.stacked import apply, multiply
from .frames import aligned, columns, forward_pass, gathered, levels, motion_groups, pick
from .parameters import TreeParameters, by_step, shares
from .topology import SpanningTree

_EYE = np.eye(3)


class Pose(NamedTuple):
    """Axes (3, 3, f + 1, *s) and origins (3, f + 1, *s) [m] of all frames, frame 0 first."""

    E: Float[Array, "3 3 f *s"]
    o: Float[Array, "3 f *s"]


@eqx.filter_custom_jvp
def place(parameters: TreeParameters, q: tuple[Float[Array, "..."], ...]) -> Pose:
    """Poses of all frames of a tree with at least one step, at positions q by class of motion."""
    return _forward(parameters, q)


@place.def_jvp
def _place_jvp(primals: Any, tangents: Any) -> tuple[Pose, Pose]:
    """Derivative of `place`: dE = w x E, do = v + w x o, with (w, v) = sum S_k du_k."""
    parameters, _ = primals
    tree, groups = parameters.tree, motion_groups(parameters.tree)
    change, q_dot = tangents
    of_groups = zip(groups, q_dot, strict=True)
    flat = all(dot is None or group.motion.flat for group, dot in of_groups)
    if not flat or change.K is not None or change.pitch is not None:
        # a change of K need not be a rotation, nor are the rates of q velocities
        return directional(_forward, primals, tangents)
    pose = place(*primals)
    zero = lambda group: jnp.zeros(
        (*group.motion.velocities, len(group.steps), *pose.o.shape[2:]), pose.o.dtype
    )
    parts = tuple(
        zero(group) if dot is None else dot for group, dot in zip(groups, q_dot, strict=True)
    )
    own = by_frame(tree, axes(parameters, pose) * from_groups(tree, parts))
    if change.k is not None:
        parent = np.array([step.parent for step in tree.steps])
        along = apply(pick(pose.E, parent, 2), change.k)
        own = own + jnp.concatenate([jnp.zeros_like(along), along])
    V = forward_pass(tree, jnp.zeros_like(own[:, :1]), own)
    w = V[:3]
    return pose, Pose(cross(w[:, None], pose.E), V[3:] + cross(w, pose.o))


def _forward(parameters: TreeParameters, q: tuple[Float[Array, "..."], ...]) -> Pose:
    X, d = relative(parameters, q)
    origin = rest(d.shape[2:], d.dtype)
    E, o = [origin.E], [origin.o]
    for level in levels(parameters.tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        if level.frames.start == 1:
            # frame 0 is the identity
            E.append(X[:, :, at])
            o.append(d[:, at])
            continue
        before = pick(E[-1], level.parents, 2)
        o.append(pick(o[-1], level.parents, 1) + apply(before, d[:, at]))
        E.append(multiply(before, X[:, :, at]))
    return Pose(jnp.concatenate(E, axis=2), jnp.concatenate(o, axis=1))


def rest(batch: tuple[int, ...], dtype: Any) -> Pose:
    """Pose of frame 0 alone, for a batch of states."""
    unit = jnp.broadcast_to(aligned(_EYE[:, :, None], 3 + len(batch)), (3, 3, 1, *batch))
    return Pose(unit, jnp.zeros((3, 1, *batch), dtype))


def relative(
    parameters: TreeParameters, q: tuple[Float[Array, "..."], ...]
) -> tuple[Float[Array, "3 3 f *s"], Float[Array, "3 f *s"]]:
    """Rotations and positions [m] of all frames in their parents."""
    groups = motion_groups(parameters.tree)
    found = []
    for group, own in zip(groups, q, strict=True):
        K, k = pick(parameters.K, group.steps, 2), pick(parameters.k, group.steps, 1)
        of_batch = own.shape[len(group.motion.positions) + 1 :]
        X, d = group.motion.relative(own, K, k, shares(parameters, group, len(of_batch)))
        spread = lambda x, n, of_batch=of_batch: jnp.broadcast_to(x, (*x.shape[:n], *of_batch))
        found.append((spread(X, 3), spread(d, 2)))
    X, d = zip(*found, strict=True)
    return by_step(groups, X, 2), by_step(groups, d, 1)


def axes(parameters: TreeParameters, pose: Pose) -> Float[Array, "6 m *s"]:
    """Spatial axes (angular, linear) of all velocities of the tree's steps."""
    table = columns(parameters.tree)
    frame, column = table.frame, table.axis
    if np.all(column == 2) and np.array_equal(frame, np.arange(1, len(frame) + 1)):
        a, o = pose.E[:, 2, 1:], pose.o[:, 1:]
    else:
        a, o = pose.E[:, column, frame], pick(pose.o, frame, 1)
    angular = aligned(table.angular, a.ndim - 1)
    linear = aligned(table.linear, a.ndim - 1)
    if np.any(table.pitched):
        assert parameters.pitch is not None
        pitch = pick(parameters.pitch, frame - 1, 0)
        pitch = pitch.reshape(*pitch.shape, *(1,) * (a.ndim - 1 - pitch.ndim))
        linear = linear + aligned(table.pitched, a.ndim - 1) * pitch
    return jnp.concatenate([angular * a, angular * cross(o, a) + linear * a])


def by_frame(tree: SpanningTree, rows: Float[Array, "6 m *s"]) -> Float[Array, "6 f *s"]:
    """Sums of the columns of each frame over its velocities."""
    frame = columns(tree).frame
    count = len(tree.steps)
    if len(frame) == count:
        return rows
    return gathered(rows, [[int(k) for k in np.flatnonzero(frame == f + 1)] for f in range(count)])


def by_group(tree: SpanningTree, u: Float[Array, "m *s"]) -> tuple[Array, ...]:
    """Velocities of every class of motion, each of shape (*velocities of one frame, k, *s)."""
    found = []
    for group in motion_groups(tree):
        own = pick(u, group.velocities, 0)
        shape = group.motion.velocities
        if shape:
            own = own.reshape(len(group.steps), *shape, *u.shape[1:])
            own = jnp.moveaxis(own, 0, len(shape))
        found.append(own)
    return tuple(found)


def from_groups(tree: SpanningTree, parts: tuple[Array, ...]) -> Float[Array, "m *s"]:
    """Flat vector of the velocities of all classes of motion; the inverse of `by_group`."""
    groups, found = motion_groups(tree), []
    for group, own in zip(groups, parts, strict=True):
        wide = len(group.motion.velocities)
        if wide:
            own = jnp.moveaxis(own, wide, 0)
            own = own.reshape(len(group.velocities), *own.shape[wide + 1 :])
        found.append(own)
    if len(found) == 1:
        return found[0]
    if not found:
        return jnp.zeros((0,))
    order = np.argsort(np.concatenate([group.velocities for group in groups]))
    return pick(jnp.concatenate(found), order, 0)
