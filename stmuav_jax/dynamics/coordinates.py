"""The coordinates of a spanning tree: as a flat vector, and read off a state of all bodies."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import conjugate, cross, product, rotation_matrix
from ..algebra.stacked import apply, apply_transposed, dot, eye, multiply
from ..mechanics.state import State
from .chain import Chain
from .frames import columns, levels, of_kind, pick
from .pose import Pose
from .topology import CYCLIC, SpanningTree


class Coordinates(NamedTuple):
    """Positions and velocities of a tree; those of the base are empty where nothing floats.

    Attributes:
        r, p: of the base's centre of mass (3, b) [m] and axes (4, b), world; b is 0 or 1.
        q1: turns [rad] and slides [m], in the order of the frames.
        shift: (3, s) [m]. balls: Euler parameters (4, c).
        v: of the base, world (3, b) [m/s]. omega: in its axes (3, b) [rad/s].
        u: velocities of the steps, in the order of the frames.
    """

    r: Float[Array, "3 b *s"]
    p: Float[Array, "4 b *s"]
    q1: Float[Array, "a *s"]
    shift: Float[Array, "3 s *s"]
    balls: Float[Array, "4 c *s"]
    v: Float[Array, "3 b *s"]
    omega: Float[Array, "3 b *s"]
    u: Float[Array, "m *s"]


def shapes(tree: SpanningTree) -> tuple[tuple[int, ...], ...]:
    """The shape of every part of `Coordinates`."""
    b = int(tree.floating)
    a = len(of_kind(tree, "turn", "slide"))
    s, c = len(of_kind(tree, "shift")), len(of_kind(tree, "ball"))
    return (3, b), (4, b), (a,), (3, s), (4, c), (3, b), (3, b), (a + 3 * s + 3 * c,)


def split(tree: SpanningTree, x: Float[Array, "k *s"]) -> Coordinates:
    """The parts of a flat vector; the axes of a batch come last."""
    parts, start = [], 0
    for shape in shapes(tree):
        size = int(np.prod(shape))
        parts.append(x[start : start + size].reshape(*shape, *x.shape[1:]))
        start += size
    return Coordinates(*parts)


def join(parts: Coordinates) -> Float[Array, "k *s"]:
    """The flat vector of the parts."""
    batch = parts.u.shape[1:]
    return jnp.concatenate([part.reshape(-1, *batch) for part in parts])


def read(chain: Chain, state: State) -> Coordinates:
    """The coordinates of a state of all bodies that satisfies the tree's joints.

    Angles come out in (-pi, pi].
    """
    tree = chain.tree
    base = slice(tree.root, tree.root + tree.floating)
    own = Coordinates(*(jnp.zeros(shape, state.r.dtype) for shape in shapes(tree)))
    own = own._replace(
        r=state.r[base].T, p=state.p[base].T, v=state.v[base].T, omega=state.omega[base].T
    )
    if not tree.steps:
        return own
    ends = _ends(chain, state)
    pose, values = _positions(chain, ends)
    single, shifts = of_kind(tree, "turn", "slide"), of_kind(tree, "shift")
    return own._replace(
        q1=pick(values[2], single, 0),
        shift=pick(values, shifts, 1),
        balls=_balls(chain, state),
        u=_velocities(chain, pose, ends),
    )


class _Ends(NamedTuple):
    """Bodies and ground, seen from frame 0: axes of their frames, centres of mass, velocities."""

    E: Float[Array, "3 3 N"]
    r: Float[Array, "3 N"]
    v: Float[Array, "3 N"]
    omega: Float[Array, "3 N"]


def _ends(chain: Chain, state: State) -> _Ends:
    tree = chain.tree
    none = jnp.zeros((3, 1), state.r.dtype)
    unit = jnp.eye(3, dtype=state.r.dtype)[:, :, None]
    R_wb = jnp.concatenate([rotation_matrix(state.p.T), unit], axis=2)
    r, v = (jnp.concatenate([x.T, none], axis=1) for x in (state.r, state.v))
    omega = apply(R_wb, jnp.concatenate([state.omega.T, none], axis=1))
    at = slice(tree.root, tree.root + 1)
    R_w0 = R_wb[:, :, at]
    E = multiply(jnp.swapaxes(R_w0, 0, 1), multiply(R_wb, jnp.swapaxes(chain.B, 0, 1)))
    seen = lambda x: apply_transposed(R_w0, x)
    return _Ends(E, seen(r - r[:, at]), seen(v), seen(omega))


def _references(tree: SpanningTree) -> tuple[np.ndarray, np.ndarray]:
    """For every step a direction fixed in the body behind, and the same at zero of the step.

    In the axes of the joint's last frame, and in those of the step's own frame.
    """
    behind = np.tile([[1.0], [0.0], [0.0]], (1, len(tree.steps)))
    own = behind.copy()
    for step in tree.steps:
        if not step.first and step.kind == "turn":
            # what the step before does to the axis of this one, which this one leaves alone
            behind[:, step.parent - 1] = [0.0, 0.0, 1.0]
            assert step.before is not None
            own[:, step.parent - 1] = np.eye(3)[list(CYCLIC[step.before])] @ np.eye(3)[step.axis]
    return behind, own


def _positions(chain: Chain, ends: _Ends) -> tuple[Pose, Array]:
    """Frames, and (0, 0, q) or the shift of every step."""
    tree = chain.tree
    behind, own = _references(tree)
    E, o = [jnp.eye(3, dtype=ends.r.dtype)[:, :, None]], [jnp.zeros((3, 1), ends.r.dtype)]
    values = []
    z = np.array([[0.0], [0.0], [1.0]])
    for level in levels(tree):
        at = np.arange(level.frames.start, level.frames.stop) - 1
        steps = [tree.steps[f] for f in at]
        body = np.array([step.body for step in steps])
        turn, slide, shift, ball = (
            jnp.array([float(step.kind == kind) for step in steps])
            for kind in ("turn", "slide", "shift", "ball")
        )
        before = pick(E[-1], level.parents, 2)
        G = multiply(before, pick(chain.K, at, 2))
        origin = pick(o[-1], level.parents, 1) + apply(before, pick(chain.k, at, 1))
        end = pick(ends.E, body, 2)
        point = pick(ends.r, body, 1) - apply(end, pick(chain.com, body, 1))
        turned = multiply(jnp.swapaxes(G, 0, 1), end)
        seen = apply(turned, jnp.asarray(behind[:, at]))
        x, y = jnp.asarray(own[0, at]), jnp.asarray(own[1, at])
        angle = jnp.arctan2(x * seen[1] - y * seen[0], x * seen[0] + y * seen[1])
        along = (slide * z + shift) * apply_transposed(G, point - origin)
        values.append(turn * angle * z + along)
        half = jnp.stack([jnp.cos(angle / 2), 0 * angle, 0 * angle, jnp.sin(angle / 2)])
        X = turn * rotation_matrix(half) + ball * turned + (1 - turn - ball) * eye(half[1:])
        E.append(multiply(G, X))
        o.append(origin + apply(G, along))
    pose = Pose(jnp.concatenate(E, axis=2), jnp.concatenate(o, axis=1))
    return pose, jnp.concatenate(values, axis=1)


def _balls(chain: Chain, state: State) -> Float[Array, "4 c"]:
    """Euler parameters of the balls, with the signs that the bodies' have."""
    tree = chain.tree
    balls = of_kind(tree, "ball")
    if not len(balls):
        return jnp.zeros((4, 0), state.r.dtype)
    front, behind = _neighbours(tree)
    unit = jnp.array([[1.0, 0.0, 0.0, 0.0]], state.p.dtype)
    p = jnp.concatenate([state.p, unit]).T
    # of the bodies' frames in the world
    frames = product(p, conjugate(chain.B_p))
    before = product(pick(frames, front[balls], 1), pick(chain.K_p, balls, 1))
    return product(conjugate(before), pick(frames, behind[balls], 1))


def _velocities(chain: Chain, pose: Pose, ends: _Ends) -> Array:
    """Velocities of all steps: of the body behind against the body in front, along the axes."""
    tree = chain.tree
    front, behind = _neighbours(tree)
    frame, column, turns = columns(tree)
    axis, at = pose.E[:, column, frame], pick(pose.o, frame, 1)
    b, f = behind[frame - 1], front[frame - 1]
    omega_b, omega_f = pick(ends.omega, b, 1), pick(ends.omega, f, 1)
    v_b = pick(ends.v, b, 1) + cross(omega_b, at - pick(ends.r, b, 1))
    v_f = pick(ends.v, f, 1) + cross(omega_f, at - pick(ends.r, f, 1))
    turning, sliding = dot(axis, omega_b - omega_f), dot(axis, v_b - v_f)
    return jnp.where(turns > 0, turning, sliding)


def _neighbours(tree: SpanningTree) -> tuple[np.ndarray, np.ndarray]:
    """For every step the bodies in front of its joint and behind it."""
    parent = {link.child: link.parent for link in tree.links}
    behind = [step.body for step in tree.steps]
    return np.array([parent[b] for b in behind]), np.array(behind)
