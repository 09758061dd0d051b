"""Consistent state from joint coordinates and rates, along the tree and with closed loops.

Most loops close in more than one way: a four-bar's coupler lies on either side of a line. Coordinates
that are led from the start in small parts, with the loops closed after each, say which is meant.
"""

from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.errors import (
    ModelError,
    StateError,
    check_finite,
    has_values,
    nearest_names,
    shape_of,
)
from ...checks.shapes import Numbers
from ...math.native.program import native
from ...math.rotation import (
    conjugate,
    cross,
    from_matrix,
    product,
    rotation_matrix,
)
from ...mechanics.internal import counted_hinges, internal_states
from ...mechanics.joint import Joint
from ...mechanics.joint_states import (
    coordinate_count,
    coordinates_of,
    relative_motion,
    relative_pose,
)
from ...mechanics.motions import RelativePose
from ...mechanics.state import State
from ...mechanics.system import System, check_state
from ..formulations.augmented import evaluate_equations, prepare_rows
from ..tree.topology import Link, SpanningTree, spanning_tree
from .closing import Closing, close_loops, with_drivers
from .initial import assemble, project_velocities
from .rank import rank

Given = Mapping[str, Numbers]

# Largest residual of a posture [m], [rad], and difference of a joint rate from its given value [rad/s],
# [m/s]; number of steps without second derivatives.
_TOLERANCE, _RATE_TOLERANCE, _STEPS = 1e-11, 1e-9, 40


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
        ModelError: a joint is unknown, a driver or without coordinates; the values have a wrong number
            or are not finite; or a force counts the turns of a hinge from another angle, see
            `with_start_angles`.
        StateError: no state of the mechanism has all coordinates or rates together, or the loops do not stay
            closed on the path from the start; raised only for concrete values, not inside `jit`.
    """
    start = system.reference if start is None else start
    check_state(system, start)
    q = _check_values(system, coordinates or {}, "coordinate")
    _check_turns(system, q)
    u = _check_values(system, rates or {}, "rate")
    tree = _tree_through(system, {*q, *u})
    state = _place_bodies(system, tree, q, u, start)
    if not tree.cut:
        return state
    time = jnp.asarray(t, state.r.dtype)
    free = jnp.ones(6 * system.n_bodies, dtype=bool)
    if not q:
        start = state  # of the branches the one at the tree's posture
    closing = close_loops(system, state, start, q, u, time, free, _STEPS)
    if has_values(closing) and bool(_is_closed(closing)):
        return closing.state
    # with derivatives, or where steps without second derivatives do not settle
    return _close_loops(
        system, state, closing.branch, closing.on_the_way if q else None, q, u, time
    )


def _is_closed(closing: Closing) -> Bool[Array, ""]:
    """True if a state holds to the tolerances of `assemble` and of the rates."""
    is_placed = jnp.all(closing.residuals <= _TOLERANCE)
    moves = closing.rate_residual <= _RATE_TOLERANCE
    return closing.is_nearest & closing.on_the_way & is_placed & moves


def _check_values(system: System, values: Given, quantity: str) -> dict[str, Float[Array, " c"]]:
    values_by_joint = {}
    names = [joint.name for joint in system.joints]
    for name, value in values.items():
        if name not in names:
            raise ModelError(f"There is no joint '{name}'.{nearest_names(name, names)}")
        joint = system.joints[names.index(name)]
        count = coordinate_count(joint)
        if joint.motion is not None:
            raise ModelError(
                f"Joint '{name}' is a driver, whose {quantity} is prescribed as a function of time."
            )
        component_text = ", ".join(f"{word} [{unit}]" for word, unit in coordinates_of(joint.kind))
        shape = shape_of(value)
        if shape != (count,) and not (count == 1 and shape == ()):
            raise ModelError(
                f"The {quantity} of joint '{name}' ({joint.kind}) must be {count} number"
                f"{'s' if count > 1 else ''} ({component_text}), but it has shape {shape}."
            )
        check_finite(value, f"The {quantity} of joint '{name}'", "")
        values_by_joint[name] = jnp.asarray(value, dtype=float).reshape(count)
    return values_by_joint


def _check_turns(system: System, q: dict[str, Array]) -> None:
    """Raise `ModelError` for angles whose turns forces count, but from another angle than these."""
    z = internal_states(system)
    if not has_values((z, q)):
        return
    for place, name in enumerate(counted_hinges(system)):
        if name is None or name not in q:
            continue
        kind = system.joints[system.joint_index(name)].kind
        angle = float(q[name][[label for label, _ in coordinates_of(kind)].index("angle")])
        counted = float(z[place])
        # A spring wound by whole turns has another force at the same posture.
        if np.round((counted - angle) / (2 * np.pi)) != 0:
            raise ModelError(
                f"The angle of joint '{name}' is to be {angle:.6g} rad, but a spring, servo or end stop "
                f"counts its turns from {counted:.6g} rad, which a state does not contain. Give this function "
                f"and the simulation the system with_start_angles(system, {{'{name}': {angle:.6g}}}), or an "
                f"angle from {counted - np.pi:.4g} to {counted + np.pi:.4g} rad."
            )


# --- along the tree


def _tree_through(system: System, preferred_names: set[str]) -> SpanningTree:
    """Spanning tree with as many of the given joints as possible."""
    cut: list[str] = []
    while True:
        tree = spanning_tree(system, cut)
        tree_links = [link for link in tree.links if link.joint is not None]
        other = None
        for k in tree.cut:
            if tree.joints[k] in preferred_names and tree.joints[k] not in cut:
                loop = _tree_path(tree_links, *_joint_bodies(system, k))
                other = next(
                    (name for j in loop if (name := tree.joints[j]) not in preferred_names), None
                )
                if other is not None:
                    break
        if other is None:
            return tree
        # A given joint that closes a loop changes places with one of the loop that is not given.
        cut.append(other)


def _joint_bodies(system: System, number: int) -> tuple[int, int]:
    names = {name: k for k, name in enumerate(system.names)}
    joint = system.joints[number]
    return names.get(joint.body_i, system.n_bodies), names.get(joint.body_j, system.n_bodies)


def _tree_path(links: list[Link], a: int, b: int) -> list[int]:
    """Indices of the tree's joints between two bodies."""
    up = {link.child: link for link in links}

    def to_root(body: int) -> list[int]:
        joints = []
        while body in up:
            joints.append(up[body].joint)
            body = up[body].parent
        return joints

    first_path, second_path = to_root(a), to_root(b)
    return [k for k in (*first_path, *second_path) if (k in first_path) != (k in second_path)]


class _BodyMotion(NamedTuple):
    """Pose and velocity of one body: Euler parameters, centre of mass, world omega, velocity."""

    p: Array
    r: Array
    omega_w: Array
    v: Array


@native
def _place_bodies(
    system: System, tree: SpanningTree, q: dict[str, Array], u: dict[str, Array], start: State
) -> State:
    """State of the bodies, placed one after the other from the root to the leaves."""
    kin = system.kinematics(start)
    ground = system.n_bodies
    zero, unit = jnp.zeros(3, start.r.dtype), jnp.array([1.0, 0, 0, 0], start.r.dtype)
    at = lambda b: _BodyMotion(start.p[b], start.r[b], kin.omega_w[b], start.v[b])
    body_motions = {ground: _BodyMotion(unit, zero, zero, zero)}
    if tree.floating:
        body_motions[tree.root] = at(tree.root)
    for link in tree.links:
        if link.joint is None:
            body_motions[link.child] = at(link.child)
            continue
        joint = system.joints[link.joint]
        x, x_rate = (jnp.zeros(0), jnp.zeros(0))
        if coordinates_of(joint.kind):
            x, x_rate = relative_motion(kin, joint)
        step = relative_pose(joint, q.get(joint.name, x), u.get(joint.name, x_rate))
        body = _child_motion if link.forward else _in_front
        com = lambda b: system.bodies.com[b] if b < ground else zero
        body_motion = body(
            body_motions[link.parent], joint, step, com(link.parent), com(link.child)
        )
        # without the barrier XLA merges a chain into one expression, which takes very long to
        # compile
        body_motions[link.child] = jax.lax.optimization_barrier(body_motion)
    bodies = [body_motions[b] for b in range(ground)]
    # Euler parameters have two signs for a rotation; the one nearer the start keeps histories continuous.
    sign = lambda p, like: jnp.where(jnp.sum(p * like) < 0, -p, p)
    p = jnp.stack([sign(body.p, start.p[b]) for b, body in enumerate(bodies)])
    omega = jnp.stack([rotation_matrix(body.p).T @ body.omega_w for body in bodies])
    return State(jnp.stack([b.r for b in bodies]), p, jnp.stack([b.v for b in bodies]), omega)


def _child_motion(
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


def _close_loops(
    system: System,
    guess: State,
    start_posture: State,
    on_the_way: Bool[Array, ""] | None,
    q: dict[str, Array],
    u: dict[str, Array],
    t: Float[Array, ""],
) -> State:
    """State with closed loops and the given joints locked, and velocities with the given rates."""
    zero = {name: jnp.zeros_like(value) for name, value in q.items()}
    locked = with_drivers(system, q, zero, t)
    if on_the_way is not None:
        start_posture = jax.tree.map(lambda a, b: jnp.where(on_the_way, a, b), start_posture, guess)
    assembly = assemble(locked, guess, t, start=start_posture, throw=False)
    if has_values(assembly) and not bool(assembly.converged):
        open_by = np.asarray(assembly.residuals)
        k = int(np.argmax(np.where(np.isfinite(open_by), open_by, np.inf)))
        raise StateError(
            f"No posture with {_format_values(q) or 'closed loops'} was found from this start: "
            f"joint '{locked.joints[k].name}' stays off by {open_by[k]:.3g}. Name fewer "
            "coordinates, choose values that fit together, or give a start nearer to the posture."
        )
    if on_the_way is not None and has_values(assembly, on_the_way) and not bool(on_the_way):
        _check_branch(system, locked, assembly.state, q, float(t))
    closed_posture = State(assembly.state.r, assembly.state.p, guess.v, guess.omega)
    kin = system.kinematics(closed_posture)
    now = {name: relative_motion(kin, system.joints[system.joint_index(name)])[0] for name in u}
    state, rate_residual = _project_rates(with_drivers(system, now, u, t), closed_posture, t)
    if has_values(rate_residual) and not bool(rate_residual <= _RATE_TOLERANCE):
        raise StateError(
            f"The joint rates {_format_values(u)} are inconsistent in this posture: they contradict each other, "
            f"or the constraints, by {float(rate_residual):.3g}. Name fewer "
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
    locked_rank, unlocked_rank = rank(locked, state, t), rank(system, state, t)
    # Coordinates that depend on each other disagree on the way by themselves, which says nothing of a branch.
    if locked_rank.rank - unlocked_rank.rank == locked_rank.rows - unlocked_rank.rows:
        raise StateError(
            f"The loops do not stay closed between the start and {_format_values(q)}, so that the branch of "
            "these values is ambiguous. Give a start on its branch, "
            "from which the values can be reached with closed loops."
        )


@eqx.filter_jit
def _project_rates(
    system: System, state: State, t: Float[Array, ""]
) -> tuple[State, Float[Array, ""]]:
    """State with velocities on the constraints, and the largest residual of the rates."""
    model = prepare_rows(system)
    moving_state = project_velocities(model, t, state, jnp.ones(6 * system.n_bodies, dtype=bool))
    eq = evaluate_equations(model, t, moving_state)
    now = jnp.concatenate([moving_state.v, moving_state.omega], axis=1).reshape(-1)
    return moving_state, jnp.max(jnp.abs(eq.matrix @ now - eq.target), initial=0.0)


def _format_values(values: Mapping[str, Array]) -> str:
    """Text such as 'A = 0.3, B = (1, 2)' of given values."""
    parts = []
    for name, value in values.items():
        numbers = ", ".join(f"{float(x):.6g}" for x in value)
        parts.append(f"{name} = {numbers if len(value) == 1 else f'({numbers})'}")
    return ", ".join(parts)
