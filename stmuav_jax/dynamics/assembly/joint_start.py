"""Consistent state from joint coordinates and rates, along the tree and with closed loops."""

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.rotation import (
    conjugate,
    cross,
    from_matrix,
    from_rotation_vector,
    product,
    rotation_matrix,
)
from ...checks.errors import ModelError, StateError, check_finite, concrete, nearest_names, shape_of
from ...checks.shapes import Numbers
from ...mechanics.joint import CATALOGUE, Joint
from ...mechanics.joint_states import COORDINATES, coordinate_count, relative
from ...mechanics.motions.base import RelativePose
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import Augmented
from ..tree.topology import Link, SpanningTree, spanning_tree
from .initial import assemble, velocities

Given = Mapping[str, Numbers]

# Largest admitted difference of a joint rate from its given value [rad/s], [m/s].
_RATE_TOLERANCE = 1e-9


def state_from_joints(
    system: System,
    coordinates: Given | None = None,
    rates: Given | None = None,
    *,
    start: State | None = None,
    t: Numbers = 0.0,
) -> State:
    """State on the constraints with the given joint coordinates and rates.

    Joints that are not named, and floating bases, keep their values of `start`. In a mechanism with
    loops, the resulting posture is the guess from which the loops are assembled, and undetermined
    velocities are the nearest to those of the tree in the mass metric. The state is differentiable
    with respect to all numbers.

    Args:
        coordinates: values by joint, see `stmuav_jax.mechanics.joint_states`: an angle [rad] or a
            displacement [m]; (displacement, angle) of a cylindrical joint, the angle of a screw,
            two angles of a universal joint, a rotation vector (3,) of a spherical joint; zero at
            the reference posture.
        rates: rates by joint [rad/s], [m/s]; of a spherical joint the angular velocity of body j
            relative to i in the axes of frame i.
        start: by default the reference posture, at rest. t: time of the drivers [s].

    Raises:
        ModelError: a joint is unknown, a driver or without coordinates; or the values have a wrong
            number or are not finite.
        StateError: no state of the mechanism has all coordinates or rates together; raised only
            for concrete values, not inside `jit`.
    """
    start = system.reference if start is None else start
    check_state(system, start)
    q = _checked(system, coordinates or {}, "coordinate")
    u = _checked(system, rates or {}, "rate")
    tree = _tree_through(system, {*q, *u})
    state = _placed(system, tree, q, u, start)
    if not tree.cut:
        return state
    return _closed(system, state, q, u, jnp.asarray(t, state.r.dtype))


def _checked(system: System, given: Given, what: str) -> dict[str, Float[Array, " c"]]:
    found = {}
    names = [joint.name for joint in system.joints]
    for name, value in given.items():
        if name not in names:
            raise ModelError(f"There is no joint '{name}'.{nearest_names(name, names)}")
        joint = system.joints[names.index(name)]
        count = coordinate_count(joint)
        if joint.motion is not None:
            raise ModelError(
                f"Joint '{name}' is a driver, whose {what} is prescribed as a function of time."
            )
        words = ", ".join(f"{word} [{unit}]" for word, unit in COORDINATES[joint.kind])
        shape = shape_of(value)
        if shape != (count,) and not (count == 1 and shape == ()):
            raise ModelError(
                f"The {what} of joint '{name}' ({joint.kind}) must be {count} number"
                f"{'s' if count > 1 else ''} ({words}), but it has shape {shape}."
            )
        check_finite(value, f"The {what} of joint '{name}'", "")
        found[name] = jnp.asarray(value, dtype=float).reshape(count)
    return found


# --- along the tree


def _tree_through(system: System, given: set[str]) -> SpanningTree:
    """Spanning tree with as many of the given joints as possible."""
    cut: list[str] = []
    while True:
        tree = spanning_tree(system, cut)
        kept = [link for link in tree.links if link.joint is not None]
        other = None
        for k in tree.cut:
            if tree.joints[k] in given and tree.joints[k] not in cut:
                loop = _path(kept, *_ends(system, k))
                other = next((name for j in loop if (name := tree.joints[j]) not in given), None)
                if other is not None:
                    break
        if other is None:
            return tree
        cut.append(other)


def _ends(system: System, number: int) -> tuple[int, int]:
    names = {name: k for k, name in enumerate(system.names)}
    joint = system.joints[number]
    return names.get(joint.body_i, system.n_bodies), names.get(joint.body_j, system.n_bodies)


def _path(links: list[Link], a: int, b: int) -> list[int]:
    """Indices of the tree's joints between two bodies."""
    up = {link.child: link for link in links}

    def to_root(body: int) -> list[int]:
        found = []
        while body in up:
            found.append(up[body].joint)
            body = up[body].parent
        return found

    one, two = to_root(a), to_root(b)
    return [k for k in (*one, *two) if (k in one) != (k in two)]


class _Placed(NamedTuple):
    """Pose and velocity of one body: Euler parameters, centre of mass, world omega, velocity."""

    p: Array
    r: Array
    omega_w: Array
    v: Array


@eqx.filter_jit
def _placed(
    system: System, tree: SpanningTree, q: dict[str, Array], u: dict[str, Array], start: State
) -> State:
    """State of the bodies, placed one after the other from the root to the leaves."""
    kin = system.kinematics(start)
    ground = system.n_bodies
    zero, unit = jnp.zeros(3, start.r.dtype), jnp.array([1.0, 0, 0, 0], start.r.dtype)
    at = lambda b: _Placed(start.p[b], start.r[b], kin.omega_w[b], start.v[b])
    found = {ground: _Placed(unit, zero, zero, zero)}
    if tree.floating:
        found[tree.root] = at(tree.root)
    for link in tree.links:
        if link.joint is None:
            found[link.child] = at(link.child)
            continue
        joint = system.joints[link.joint]
        x, x_rate = (jnp.zeros(0), jnp.zeros(0))
        if joint.kind in COORDINATES:
            x, x_rate = relative(kin, joint)
        step = _relative_pose(joint, q.get(joint.name, x), u.get(joint.name, x_rate))
        body = _behind if link.forward else _in_front
        com = lambda b: system.bodies.com[b] if b < ground else zero
        placed = body(found[link.parent], joint, step, com(link.parent), com(link.child))
        # without the barrier XLA merges a chain into one expression, which takes very long to
        # compile
        found[link.child] = jax.lax.optimization_barrier(placed)
    bodies = [found[b] for b in range(ground)]
    sign = lambda p, like: jnp.where(jnp.sum(p * like) < 0, -p, p)
    p = jnp.stack([sign(body.p, start.p[b]) for b, body in enumerate(bodies)])
    own = jnp.stack([rotation_matrix(body.p).T @ body.omega_w for body in bodies])
    return State(jnp.stack([b.r for b in bodies]), p, jnp.stack([b.v for b in bodies]), own)


def _relative_pose(joint: Joint, q: Float[Array, " c"], u: Float[Array, " c"]) -> RelativePose:
    """Pose of frame j in frame i from a joint's coordinates and rates; a weld has no motion."""
    zero = jnp.zeros(3, q.dtype)
    found = RelativePose(from_rotation_vector(zero), zero, zero, zero)
    start = 0
    for number, freedom in enumerate(CATALOGUE[joint.kind].motion or ()):
        own = slice(start, start + len(freedom.motion.coordinates))
        step = freedom.motion.pose(q[own], u[own], freedom.axis, joint.length)
        found, start = step if number == 0 else _after(found, step), own.stop
    return found


def _after(first: RelativePose, then: RelativePose) -> RelativePose:
    """Pose of the child frame of two successive motions in the parent frame of the first."""
    R = rotation_matrix(first.p)
    d = R @ then.d
    return RelativePose(
        product(first.p, then.p),
        first.d + d,
        first.w + R @ then.w,
        first.v + R @ then.v + cross(first.w, d),
    )


def _behind(i: _Placed, joint: Joint, step: RelativePose, com_i: Array, com_j: Array) -> _Placed:
    """Pose and velocity of body j from those of body i."""
    front = product(i.p, from_matrix(joint.frame_i))
    p = product(product(front, step.p), conjugate(from_matrix(joint.frame_j)))
    F_i, R_j = rotation_matrix(front), rotation_matrix(p)
    point = i.r + rotation_matrix(i.p) @ (joint.point_i - com_i) + F_i @ step.d
    omega = i.omega_w + F_i @ step.w
    arm = R_j @ (com_j - joint.point_j)
    at_point = i.v + cross(i.omega_w, point - i.r) + F_i @ step.v
    return _Placed(p, point + arm, omega, at_point + cross(omega, arm))


def _in_front(j: _Placed, joint: Joint, step: RelativePose, com_j: Array, com_i: Array) -> _Placed:
    """Pose and velocity of body i from those of body j."""
    back = product(product(j.p, from_matrix(joint.frame_j)), conjugate(step.p))
    p = product(back, conjugate(from_matrix(joint.frame_i)))
    F_i, R_i = rotation_matrix(back), rotation_matrix(p)
    point = j.r + rotation_matrix(j.p) @ (joint.point_j - com_j)
    omega = j.omega_w - F_i @ step.w
    at_point = j.v + cross(j.omega_w, point - j.r) - F_i @ step.v
    arm = R_i @ (com_i - joint.point_i) - F_i @ step.d
    return _Placed(p, point + arm, omega, at_point + cross(omega, arm))


# --- closing the loops


class _Line(eqx.Module):
    """Linear motion of a driver: value + rate (t - t0)."""

    value: Float[Array, ""]
    rate: Float[Array, ""]
    t0: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.value + self.rate * (t - self.t0)


def _closed(
    system: System,
    guess: State,
    q: dict[str, Array],
    u: dict[str, Array],
    t: Float[Array, ""],
) -> State:
    """State with closed loops and the given joints locked, and velocities with the given rates."""
    zero = {name: jnp.zeros_like(value) for name, value in q.items()}
    locked = _driven(system, q, zero, t)
    found = assemble(locked, guess, t, throw=False)
    if concrete(found) and not bool(found.converged):
        open_by = np.asarray(found.residuals)
        k = int(np.argmax(np.where(np.isfinite(open_by), open_by, np.inf)))
        raise StateError(
            f"The mechanism has no posture with {_listed(q) or 'closed loops'} that is found from this "
            f"start: joint '{locked.joints[k].name}' stays off by {open_by[k]:.3g}. Name fewer "
            "coordinates, choose values that fit together, or give a start nearer to the posture."
        )
    there = State(found.state.r, found.state.p, guess.v, guess.omega)
    kin = system.kinematics(there)
    now = {name: relative(kin, system.joints[system.joint_index(name)])[0] for name in u}
    state, off = _moving(_driven(system, now, u, t), there, t)
    if concrete(off) and not bool(off <= _RATE_TOLERANCE):
        raise StateError(
            f"No velocities of the mechanism have the joint rates {_listed(u)} in this "
            f"posture: they miss each other, or the constraints, by {float(off):.3g}. Name fewer "
            "rates, or values that fit together."
        )
    return state


@eqx.filter_jit
def _moving(system: System, state: State, t: Float[Array, ""]) -> tuple[State, Float[Array, ""]]:
    """State with velocities on the constraints, and the largest residual of the rates."""
    model = Augmented().prepare(system)
    found = velocities(model, t, state, jnp.ones(6 * system.n_bodies, dtype=bool))
    eq = model.constraints.equations(t, system.kinematics(found))
    now = jnp.concatenate([found.v, found.omega], axis=1).reshape(-1)
    return found, jnp.max(jnp.abs(eq.matrix @ now - eq.target), initial=0.0)


def _driven(
    system: System, q: dict[str, Array], u: dict[str, Array], t: Float[Array, ""]
) -> System:
    """System with drivers for every coordinate of the given joints."""
    drivers: list[Joint] = []
    for name, value in q.items():
        joint = system.joints[system.joint_index(name)]
        for word, kind, frames, x, x_rate in _drivers(joint, value, u[name]):
            (i, frame_i), (j, frame_j) = frames
            sides = {"i": (joint.body_i, joint.point_i), "j": (joint.body_j, joint.point_j)}
            drivers.append(
                dataclasses.replace(
                    joint,
                    name=f"{name}, given {word}",
                    kind=f"drive_{kind}",
                    body_i=sides[i][0],
                    body_j=sides[j][0],
                    point_i=sides[i][1],
                    point_j=sides[j][1],
                    frame_i=frame_i,
                    frame_j=frame_j,
                    motion=_Line(x, x_rate, t),
                )
            )
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *drivers))


def _drivers(joint: Joint, q: Array, u: Array) -> list[Any]:
    """Drivers of a joint's coordinates: name, kind, two frames with their sides, value and rate.

    The row of an angle measures it from the x axis of the first frame to that of the second,
    positive towards the first frame's y axis.
    """
    F_i, F_j = joint.frame_i, joint.frame_j
    words = [word for word, _ in COORDINATES[joint.kind]]
    same = (("i", F_i), ("j", F_j))
    if joint.kind == "universal":
        about_i = (("i", F_i[:, [1, 2, 0]]), ("j", F_j[:, [1, 2, 0]]))
        back = jnp.stack([F_j[:, 0], F_j[:, 2], -F_j[:, 1]], axis=1)
        about_j = (("j", back), ("i", F_i))
        return [
            (words[0], "angle", about_i, q[0], u[0]),
            (words[1], "angle", about_j, q[1], u[1]),
        ]
    if joint.kind == "spherical":
        # frame i turned to the given orientation: there the rates are those of three angles
        turn = rotation_matrix(from_rotation_vector(q))
        at, w = F_i @ turn, turn.T @ u
        zero = jnp.zeros_like(q[0])
        order = {axis: [(axis + 1) % 3, (axis + 2) % 3, axis] for axis in range(3)}
        return [
            (words[a], "angle", (("i", at[:, order[a]]), ("j", F_j[:, order[a]])), zero, w[a])
            for a in range(3)
        ]
    kinds = [word.removeprefix("drive_") for word in words]
    return [(w, k, same, x, x_rate) for w, k, x, x_rate in zip(words, kinds, q, u, strict=True)]


def _listed(given: Mapping[str, Array]) -> str:
    """Text such as 'A = 0.3, B = (1, 2)' of given values."""
    parts = []
    for name, value in given.items():
        numbers = ", ".join(f"{float(x):.6g}" for x in value)
        parts.append(f"{name} = {numbers if len(value) == 1 else f'({numbers})'}")
    return ", ".join(parts)
