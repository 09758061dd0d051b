"""Consistent state from joint coordinates and rates, along the tree and with closed loops."""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...algebra.rotation import (
    conjugate,
    cross,
    from_matrix,
    product,
    rotation_matrix,
)
from ...checks.errors import ModelError, StateError, check_finite, concrete, nearest_names, shape_of
from ...checks.shapes import Numbers
from ...mechanics.joint import Joint
from ...mechanics.joint_states import coordinate_count, coordinates_of, relative, relative_pose
from ...mechanics.motions.base import RelativePose
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import Augmented
from ..tree.topology import Link, SpanningTree, spanning_tree
from .following import followed
from .initial import assemble, rank, velocities
from .joint_drivers import with_drivers

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
    loops, this posture of the tree is not closed yet: the result is nearest to it in the mass metric, on the
    branch that is continuous with `start` as the coordinates move there from their values (angles
    the shorter way round). Undetermined velocities are the nearest to those of the tree. The state is
    differentiable with respect to all numbers.

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
        StateError: no state of the mechanism has all coordinates or rates together, or none on the way
            there from the start, but one beyond; raised only for concrete values, not inside `jit`.
    """
    start = system.reference if start is None else start
    check_state(system, start)
    q = _checked(system, coordinates or {}, "coordinate")
    u = _checked(system, rates or {}, "rate")
    tree = _tree_through(system, {*q, *u})
    state = _placed(system, tree, q, u, start)
    if not tree.cut:
        return state
    time = jnp.asarray(t, state.r.dtype)
    near, on_the_way = followed(system, start, q, time) if q else (state, None)
    return _closed(system, state, near, on_the_way, q, u, time)


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
        words = ", ".join(f"{word} [{unit}]" for word, unit in coordinates_of(joint.kind))
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


class _BodyMotion(NamedTuple):
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
    at = lambda b: _BodyMotion(start.p[b], start.r[b], kin.omega_w[b], start.v[b])
    found = {ground: _BodyMotion(unit, zero, zero, zero)}
    if tree.floating:
        found[tree.root] = at(tree.root)
    for link in tree.links:
        if link.joint is None:
            found[link.child] = at(link.child)
            continue
        joint = system.joints[link.joint]
        x, x_rate = (jnp.zeros(0), jnp.zeros(0))
        if coordinates_of(joint.kind):
            x, x_rate = relative(kin, joint)
        step = relative_pose(joint, q.get(joint.name, x), u.get(joint.name, x_rate))
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


def _behind(
    i: _BodyMotion, joint: Joint, step: RelativePose, com_i: Array, com_j: Array
) -> _BodyMotion:
    """Pose and velocity of body j from those of body i."""
    front = product(i.p, from_matrix(joint.frame_i))
    p = product(product(front, step.p), conjugate(from_matrix(joint.frame_j)))
    F_i, R_j = rotation_matrix(front), rotation_matrix(p)
    point = i.r + rotation_matrix(i.p) @ (joint.point_i - com_i) + F_i @ step.d
    omega = i.omega_w + F_i @ step.w
    arm = R_j @ (com_j - joint.point_j)
    at_point = i.v + cross(i.omega_w, point - i.r) + F_i @ step.v
    return _BodyMotion(p, point + arm, omega, at_point + cross(omega, arm))


def _in_front(
    j: _BodyMotion, joint: Joint, step: RelativePose, com_j: Array, com_i: Array
) -> _BodyMotion:
    """Pose and velocity of body i from those of body j."""
    back = product(product(j.p, from_matrix(joint.frame_j)), conjugate(step.p))
    p = product(back, conjugate(from_matrix(joint.frame_i)))
    F_i, R_i = rotation_matrix(back), rotation_matrix(p)
    point = j.r + rotation_matrix(j.p) @ (joint.point_j - com_j)
    omega = j.omega_w - F_i @ step.w
    at_point = j.v + cross(j.omega_w, point - j.r) - F_i @ step.v
    arm = R_i @ (com_i - joint.point_i) - F_i @ step.d
    return _BodyMotion(p, point + arm, omega, at_point + cross(omega, arm))


# --- closing the loops


def _closed(
    system: System,
    guess: State,
    near: State,
    on_the_way: Bool[Array, ""] | None,
    q: dict[str, Array],
    u: dict[str, Array],
    t: Float[Array, ""],
) -> State:
    """State with closed loops and the given joints locked, and velocities with the given rates."""
    zero = {name: jnp.zeros_like(value) for name, value in q.items()}
    locked = with_drivers(system, q, zero, t)
    if on_the_way is not None:
        near = jax.tree.map(lambda a, b: jnp.where(on_the_way, a, b), near, guess)
    found = assemble(locked, guess, t, near=near, throw=False)
    if concrete(found) and not bool(found.converged):
        open_by = np.asarray(found.residuals)
        k = int(np.argmax(np.where(np.isfinite(open_by), open_by, np.inf)))
        raise StateError(
            f"The mechanism has no posture with {_listed(q) or 'closed loops'} that is found from this "
            f"start: joint '{locked.joints[k].name}' stays off by {open_by[k]:.3g}. Name fewer "
            "coordinates, choose values that fit together, or give a start nearer to the posture."
        )
    if on_the_way is not None and concrete(found, on_the_way) and not bool(on_the_way):
        _check_branch(system, locked, found.state, q, float(t))
    there = State(found.state.r, found.state.p, guess.v, guess.omega)
    kin = system.kinematics(there)
    now = {name: relative(kin, system.joints[system.joint_index(name)])[0] for name in u}
    state, off = _moving(with_drivers(system, now, u, t), there, t)
    if concrete(off) and not bool(off <= _RATE_TOLERANCE):
        raise StateError(
            f"No velocities of the mechanism have the joint rates {_listed(u)} in this "
            f"posture: they miss each other, or the constraints, by {float(off):.3g}. Name fewer "
            "rates, or values that fit together."
        )
    return state


def _check_branch(
    system: System, locked: System, state: State, q: dict[str, Array], t: float
) -> None:
    """Raise `StateError` where the loops closed at the end, but not on the way from the start.

    More coordinates than there are freedoms fit together along curves only, not on a straight way;
    they say the branch themselves.
    """
    held, before = rank(locked, state, t), rank(system, state, t)
    if held.rank - before.rank == held.rows - before.rows:
        raise StateError(
            f"The loops do not stay closed on the way from the start to {_listed(q)}, so that it is not "
            "known which of the postures with these values is meant. Give a start on its branch, "
            "from which the values can be reached with closed loops."
        )


@eqx.filter_jit
def _moving(system: System, state: State, t: Float[Array, ""]) -> tuple[State, Float[Array, ""]]:
    """State with velocities on the constraints, and the largest residual of the rates."""
    model = Augmented().prepare(system)
    found = velocities(model, t, state, jnp.ones(6 * system.n_bodies, dtype=bool))
    eq = model.constraints.equations(t, system.kinematics(found))
    now = jnp.concatenate([found.v, found.omega], axis=1).reshape(-1)
    return found, jnp.max(jnp.abs(eq.matrix @ now - eq.target), initial=0.0)


def _listed(given: Mapping[str, Array]) -> str:
    """Text such as 'A = 0.3, B = (1, 2)' of given values."""
    parts = []
    for name, value in given.items():
        numbers = ", ".join(f"{float(x):.6g}" for x in value)
        parts.append(f"{name} = {numbers if len(value) == 1 else f'({numbers})'}")
    return ", ".join(parts)
