"""The numbers of a spanning tree, and the recursions along it.

Everything is expressed in the axes of frame 0 and about its origin: the world, or the base
of a system that floats, at its centre of mass. Spatial vectors are (angular, linear), so
that velocities add along a chain and inertias and wrenches back along it without any
transformation. Frames of equal depth are evaluated together.

Arrays have their components first, then the frames (or bodies); states of a batch, if any,
come last and are carried along (`stmuav_jax.algebra.stacked`).

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 2, 5 and 6.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..algebra.rotation import conjugate, from_matrix, product
from ..algebra.stacked import dot, summed
from ..mechanics.errors import concrete
from ..mechanics.system import System
from .frames import aligned, carries, levels, of_kind, pick
from .topology import CYCLIC, Link, SpanningTree

_EYE = np.eye(3)


class Chain(eqx.Module):
    """A tree with its numbers; f frames besides frame 0, n bodies.

    Attributes:
        K, k: rotation (3, 3, f) and position (3, f) [m] of every frame in its parent, at
            zero of its own step.
        B: body (or ground) axes in the axes of its frame (3, 3, n + 1).
        com: centres of mass in the bodies' frames (3, n + 1) [m].
        mass, centre, inertia: of all that is fixed to a frame, as one body: (f + 1,) [kg],
            centre of mass (3, f + 1) [m], about it in frame axes (3, 3, f + 1) [kg m^2].
        carried: mass that moves with a frame (f + 1,) [kg].
        K_p, B_p: Euler parameters of K (4, f) and B (4, n + 1), signs such that the bodies'
            are those of the reference posture there.
    """

    tree: SpanningTree = eqx.field(static=True)
    K: Float[Array, "3 3 f *s"]
    k: Float[Array, "3 f *s"]
    B: Float[Array, "3 3 N *s"]
    com: Float[Array, "3 N *s"]
    mass: Float[Array, "F *s"]
    centre: Float[Array, "3 F *s"]
    inertia: Float[Array, "3 3 F *s"]
    carried: Float[Array, "F *s"]
    K_p: Float[Array, "4 f *s"]
    B_p: Float[Array, "4 N *s"]


def chain(system: System, tree: SpanningTree) -> Chain:
    """Gather the numbers of a tree from the joints and bodies of its system."""
    # known numbers are handled by NumPy: a hundred small operations, none to compile
    system = eqx.tree_at(lambda s: s.forces, system, ())
    system = jax.tree.map(np.asarray, system) if concrete(system) else system
    com_ref = [*system.bodies.com, np.zeros(3)]
    K: list[Any] = []
    k: list[Any] = []
    B: dict[int, Any] = {tree.root: _EYE}
    com: dict[int, Any] = {tree.root: np.zeros(3)}
    by_link = {link.child: link for link in tree.links}
    for link in tree.links:
        frame_i, point_i, frame_j, point_j = _sides(system, link)
        at = com[link.parent] + B[link.parent] @ (point_i - com_ref[link.parent])
        start = B[link.parent] @ frame_i
        steps = [s for s in tree.steps if s.body == link.child]
        last = _columns(steps[-1].axis) if steps else _EYE
        # a weld has no frame of its own: its body rides on the parent's
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
    K_p, B_p = _parameters(tree, stacked_K, stacked_B, jnp.asarray(system.reference.p))
    return Chain(
        tree,
        stacked_K,
        _stack(k, (3,)),
        stacked_B,
        _stack([com[b] for b in range(ground + 1)], (3,)),
        mass,
        centre,
        inertia,
        summed(mass[None], carries(tree).T)[0],
        K_p,
        B_p,
    )


def _by_frame(
    system: System, tree: SpanningTree, axes: list[Any], com: dict[int, Any]
) -> tuple[Float[Array, "F"], Float[Array, "3 F"], Float[Array, "3 3 F"]]:
    """Mass, centre of mass and inertia of what is fixed to each frame; zeros for no body."""
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
def _parameters(
    tree: SpanningTree, K: Float[Array, "3 3 f"], B: Float[Array, "3 3 N"], p: Float[Array, "n 4"]
) -> tuple[Float[Array, "4 f"], Float[Array, "4 N"]]:
    """Euler parameters of the constant rotations; only their signs are a choice."""
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
    """Euler parameters of all frames against frame 0, from those of their steps."""
    own = product(K_p, turned)
    unit = jnp.zeros((4, 1, *own.shape[2:]), own.dtype).at[0].set(1.0)
    parts = [unit]
    for level in levels(tree):
        at = slice(level.frames.start - 1, level.frames.stop - 1)
        parts.append(product(pick(parts[-1], level.parents, 1), own[:, at]))
    return jnp.concatenate(parts, axis=1)


def parameters(
    chain: Chain, q1: Float[Array, "a *s"], p: Float[Array, "4 c *s"]
) -> Float[Array, "4 N *s"]:
    """Euler parameters of all bodies and ground against frame 0, continuous in the coordinates."""
    tree = chain.tree
    single = of_kind(tree, "turn", "slide")
    shifts, balls = of_kind(tree, "shift"), of_kind(tree, "ball")
    turns = aligned(np.array([tree.steps[f].kind == "turn" for f in single], float), q1.ndim)
    half, zero = 0.5 * turns * q1, jnp.zeros_like(q1)
    turned = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
    unit = jnp.zeros((4, len(shifts), *q1.shape[1:]), q1.dtype).at[0].set(1.0)
    order = np.argsort(np.concatenate([single, shifts, balls]))
    turned = pick(jnp.concatenate([turned, unit, p], axis=1), order, 1)
    return product(pick(_frames(tree, chain.K_p, turned), np.array(tree.frame), 1), chain.B_p)


def _stack(rows: list[Any], shape: tuple[int, ...]) -> Array:
    if not rows:
        return jnp.zeros((*shape, 0))
    known = all(isinstance(row, np.ndarray | np.floating) for row in rows)
    return jnp.asarray(np.stack(rows, axis=-1)) if known else jnp.stack(rows, axis=-1)


def _columns(axis: int) -> np.ndarray:
    return _EYE[:, CYCLIC[axis]]


def _sides(system: System, link: Link) -> tuple[Any, Any, Any, Any]:
    """Joint frame and point on the body in front, then on the body behind."""
    if link.joint is None:
        # the free motion of a body is that of its centre of mass, in its own axes
        return _EYE, np.zeros(3), _EYE, system.bodies.com[link.child]
    joint = system.joints[link.joint]
    sides = ((joint.frame_i, joint.point_i), (joint.frame_j, joint.point_j))
    front, behind = sides if link.forward else sides[::-1]
    return *front, *behind
