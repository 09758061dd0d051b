"""Where the frames of a tree are, and the axes about which and along which they move."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.derivative import directional
from ..algebra.rotation import cross, rotation_matrix
from ..algebra.stacked import apply, multiply
from .chain import Chain
from .frames import aligned, columns, gathered, levels, of_kind, outwards, pick
from .topology import SpanningTree

_EYE = np.eye(3)


class Pose(NamedTuple):
    """Axes (3, 3, f + 1, *s) and origins (3, f + 1, *s) [m] of all frames, frame 0 first."""

    E: Float[Array, "3 3 f *s"]
    o: Float[Array, "3 f *s"]


@eqx.filter_custom_jvp
def place(
    chain: Chain,
    q1: Float[Array, "a *s"],
    shift: Float[Array, "3 b *s"],
    p: Float[Array, "4 c *s"],
) -> Pose:
    """All frames at the given turns and slides, shifts [m], and Euler parameters of balls."""
    return _recursion(chain, q1, shift, p)


@place.def_jvp
def _place_jvp(primals: Any, tangents: Any) -> tuple[Pose, Pose]:
    """By the frames' velocities: dE = w x E, do = v + w x o, with (w, v) = sum S_k du_k."""
    chain, q1, shift, p = primals
    tree = chain.tree
    numbers, q1_dot, shift_dot, p_dot = tangents
    if not tree.steps or numbers.K is not None or (p_dot is not None and p.shape[1]):
        # what changes need not be a rotation
        return directional(_recursion, primals, tangents)
    pose = place(*primals)
    parts = (
        jnp.zeros_like(q1) if q1_dot is None else q1_dot,
        jnp.zeros_like(shift) if shift_dot is None else shift_dot,
        jnp.zeros_like(p[1:]),
    )
    own = by_frame(tree, axes(tree, pose) * from_kinds(tree, *parts))
    if numbers.k is not None:
        parent = np.array([step.parent for step in tree.steps])
        along = apply(pick(pose.E, parent, 2), numbers.k)
        own = own + jnp.concatenate([jnp.zeros_like(along), along])
    V = outwards(tree, jnp.zeros_like(own[:, :1]), own)
    w = V[:3]
    return pose, Pose(cross(w[:, None], pose.E), V[3:] + cross(w, pose.o))


def _recursion(
    chain: Chain,
    q1: Float[Array, "a *s"],
    shift: Float[Array, "3 b *s"],
    p: Float[Array, "4 c *s"],
) -> Pose:
    X, d = relative(chain, q1, shift, p)
    like = d.shape[2:]
    unit = jnp.broadcast_to(aligned(_EYE[:, :, None], 3 + len(like)), (3, 3, 1, *like))
    E, o = [unit], [jnp.zeros((3, 1, *like), d.dtype)]
    for level in levels(chain.tree):
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


def relative(
    chain: Chain,
    q1: Float[Array, "a *s"],
    shift: Float[Array, "3 b *s"],
    p: Float[Array, "4 c *s"],
) -> tuple[Float[Array, "3 3 f *s"], Float[Array, "3 f *s"]]:
    """Rotation and position of every frame in its parent."""
    tree = chain.tree
    single = of_kind(tree, "turn", "slide")
    shifts, balls = of_kind(tree, "shift"), of_kind(tree, "ball")
    turns = np.array([tree.steps[f].kind == "turn" for f in single], dtype=float)
    turns = aligned(turns, q1.ndim)
    K, k = pick(chain.K, single, 2), pick(chain.k, single, 1)
    c, s = jnp.cos(turns * q1), jnp.sin(turns * q1)
    z = jnp.broadcast_to(K[:, 2], (3, *c.shape))
    X = jnp.stack([c * K[:, 0] + s * K[:, 1], c * K[:, 1] - s * K[:, 0], z], axis=1)
    d = k + ((1 - turns) * q1) * K[:, 2]
    if not (len(shifts) or len(balls)):
        return X, d
    full = q1.shape[1:]
    spread = lambda x, n: jnp.broadcast_to(x, (*x.shape[:n], *full))
    K_s, K_b = pick(chain.K, shifts, 2), pick(chain.K, balls, 2)
    d_s = pick(chain.k, shifts, 1) + apply(K_s, shift)
    order = np.argsort(np.concatenate([single, shifts, balls]))
    X = jnp.concatenate([X, spread(K_s, 3), multiply(K_b, rotation_matrix(p))], axis=2)
    d = jnp.concatenate([d, d_s, spread(pick(chain.k, balls, 1), 2)], axis=1)
    return pick(X, order, 2), pick(d, order, 1)


def axes(tree: SpanningTree, pose: Pose) -> Float[Array, "6 m *s"]:
    """Spatial axes of all velocities of the tree's steps."""
    frame, column, turns = columns(tree)
    if np.all(column == 2) and np.array_equal(frame, np.arange(1, len(frame) + 1)):
        a, o = pose.E[:, 2, 1:], pose.o[:, 1:]
    else:
        a, o = pose.E[:, column, frame], pick(pose.o, frame, 1)
    turns = aligned(turns, a.ndim - 1)
    return jnp.concatenate([turns * a, turns * cross(o, a) + (1 - turns) * a])


def by_frame(tree: SpanningTree, rows: Float[Array, "6 m *s"]) -> Float[Array, "6 f *s"]:
    """Sums over the velocities that belong to one frame."""
    frame = columns(tree)[0]
    count = len(tree.steps)
    if len(frame) == count:
        return rows
    return gathered(rows, [[int(k) for k in np.flatnonzero(frame == f + 1)] for f in range(count)])


def kinds(tree: SpanningTree, u: Float[Array, "k *s"]) -> tuple[Array, Array, Array]:
    """Velocities of turns and slides (a, *s), of shifts (3, s, *s), of balls (3, c, *s)."""
    single, shifts, balls = (pick(u, places, 0) for places in _places(tree))
    threes = lambda rows: jnp.swapaxes(rows.reshape(-1, 3, *rows.shape[1:]), 0, 1)
    return single, threes(shifts), threes(balls)


def from_kinds(
    tree: SpanningTree,
    single: Float[Array, "a *s"],
    shifts: Float[Array, "3 b *s"],
    balls: Float[Array, "3 c *s"],
) -> Float[Array, "k *s"]:
    """The inverse of `kinds`."""
    flat = lambda rows: jnp.swapaxes(rows, 0, 1).reshape(-1, *rows.shape[2:])
    parts = [single, flat(shifts), flat(balls)]
    return pick(jnp.concatenate(parts), np.argsort(np.concatenate(_places(tree))), 0)


def _places(tree: SpanningTree) -> list[np.ndarray]:
    of = [tree.steps[f - 1].kind for f in columns(tree)[0]]
    groups = (("turn", "slide"), ("shift",), ("ball",))
    return [np.array([k for k, kind in enumerate(of) if kind in g], int) for g in groups]
