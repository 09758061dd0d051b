"""Closing the loops of a mechanism by one small program: along coordinates, at the nearest posture, in motion.

One loop does all of it, since the equations are what takes long to compile. Its steps are the smallest in
the mass metric that close the linearised constraints, seen from one of two places: from the present
posture while joint coordinates are led to their values, and then from the guess, which makes the closed
posture the nearest one. This method of Gauss and Newton converges at once where the coordinates
determine the posture, and linearly, or not, where the guess is far away on the scale of the curvature of the
constraints; `assemble` then continues with Newton's method. At the end the velocities are found with
the rows at hand. Nothing here has a derivative.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.errors import ModelError
from ...math import lapack
from ...math.compiler import kept_jit
from ...math.derivative import held_constant
from ...math.rotation import (
    conjugate,
    from_rotation_vector,
    product,
    rotation_matrix,
    skew,
    to_rotation_vector,
)
from ...mechanics.joint import CATALOGUE, Joint
from ...mechanics.joint_states import coordinates_of, relative_motion
from ...mechanics.motions import CYCLIC, SPHERICAL, is_turning
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.augmented import AugmentedModel, evaluate_equations, move_bodies, prepare_rows
from ..formulations.constraints import Equations, group_constraints


class UniformMotion(eqx.Module):
    """Linear motion of a driver: value + rate (t - t0)."""

    value: Float[Array, ""]
    rate: Float[Array, ""]
    t0: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return self.value + self.rate * (t - self.t0)


def with_drivers(
    system: System, q: Mapping[str, Array], u: Mapping[str, Array], t: Float[Array, ""]
) -> System:
    """System with drivers for every coordinate of the given joints, one joint after the other."""
    drivers = [driver for name in q for driver in _driven(system, name, q[name], u[name], t)]
    return eqx.tree_at(lambda s: s.joints, system, (*system.joints, *drivers))


def _driven(system: System, name: str, value: Array, rate: Array, t: Array) -> list[Joint]:
    """Drivers of all coordinates of a joint."""
    joint = system.joints[system.joint_index(name)]
    drivers = []
    for word, kind, frames, x, x_rate in _drivers(joint, value, rate):
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
                motion=UniformMotion(x, x_rate, t),
            )
        )
    return drivers


def _drivers(joint: Joint, q: Array, u: Array) -> list[Any]:
    """Drivers of a joint's coordinates: name, kind, two frames with their sides, value and rate.

    The row of an angle measures it from the x axis of the first frame to that of the second,
    positive towards the first frame's y axis.

    Raises:
        ModelError: there are no such rows for the coordinates of this kind of joint.
    """
    F_i, F_j = joint.frame_i, joint.frame_j
    motions = CATALOGUE[joint.kind].motion or ()
    turns = [axis for motion, axis, _ in motions if is_turning(motion)]
    rows: list[Any] = []
    for motion, axis, _ in motions:
        x, x_rate, order = q[len(rows) :], u[len(rows) :], list(CYCLIC[axis])
        same = (("i", F_i[:, order]), ("j", F_j[:, order]))
        row_kinds = [kind for kind, *_ in rows]
        if len(motion.columns) == 1 and not is_turning(motion) and "angle" not in row_kinds:
            rows.append(("displacement", same, x[0], x_rate[0]))
        elif len(motion.columns) == 1 and turns in ([axis], [axis, CYCLIC[axis][0]]):
            rows.append(("angle", same, x[0], x_rate[0]))
        elif len(motion.columns) == 1 and turns == [CYCLIC[axis][1], axis]:
            first, third = CYCLIC[axis][1], CYCLIC[axis][0]
            back = jnp.stack([F_j[:, first], F_j[:, third], -F_j[:, axis]], axis=1)
            rows.append(
                ("angle", (("j", back), ("i", F_i[:, [first, axis, third]])), x[0], x_rate[0])
            )
        elif motion is SPHERICAL and turns == [axis]:
            # frame i turned to the given orientation: there the rates are those of three angles
            turn = rotation_matrix(from_rotation_vector(x[:3]))
            # A driver of three large angles would be singular somewhere; about the given orientation the angles
            # are zero.
            at, w = F_i @ turn, turn.T @ x_rate[:3]
            for a, cyclic in CYCLIC.items():
                frames = (("i", at[:, list(cyclic)]), ("j", F_j[:, list(cyclic)]))
                rows.append(("angle", frames, jnp.zeros_like(q[0]), w[a]))
        else:
            raise ModelError(
                f"The coordinates of joint '{joint.name}' cannot be given in a mechanism with loops, "
                f"as no rows prescribe those of a {joint.kind} joint: name other joints."
            )
    names = [word for word, _ in coordinates_of(joint.kind)]
    return [(name, *row) for name, row in zip(names, rows, strict=True)]


# A part of the way is at most `_LONGEST` [rad], [m], and there are at least `_FEWEST`. After each the
# loops are closed by `_STEPS_EACH` steps, whose last finds them open by less than `_CLOSED` [m], [rad];
# a start that need not be closed has `_STEPS_FIRST` more.
_LONGEST, _FEWEST, _STEPS_EACH, _STEPS_FIRST, _CLOSED = 0.1, 8, 4, 16, 1e-3
# Changes of the displacement below these absolute and relative ones end the steps from the guess; where
# round-off keeps them from falling, the second relative one does.
_SETTLED, _SETTLED_RELATIVE, _STALLED_RELATIVE = 1e-13, 1e-12, 1e-10
# The first pass over the velocities finds them, the second removes its round-off, the third looks at it.
_PASSES = 3

_ON_THE_WAY, _NEAREST, _MOVING, _ENDED = 0, 1, 2, 3


class Closing(NamedTuple):
    """End of `close_loops`.

    Attributes:
        state: posture with closed loops, nearest to the guess, and velocities on the constraints.
        is_nearest: true if the steps from the guess have settled, so that `state` holds.
        on_the_way: true if the loops stayed closed on the way of the joint coordinates.
        branch: posture at the end of this way; the start without coordinates.
        residuals: largest position residual of each joint and driver (j,) [m] or [rad].
        rate_residual: largest residual of the velocities, rates of joints included.
    """

    state: State
    is_nearest: Bool[Array, ""]
    on_the_way: Bool[Array, ""]
    branch: State
    residuals: Float[Array, " j"]
    rate_residual: Float[Array, ""]


class _Carry(NamedTuple):
    """State of the loop: phase, steps of the phase, and results up to now."""

    phase: Array
    steps: Array
    state: State
    branch: State
    on_the_way: Array
    change: Array
    residuals: Array
    rate_residual: Array


@kept_jit
def close_loops(
    system: System,
    guess: State,
    start: State,
    q: dict[str, Array],
    u: dict[str, Array],
    t: Float[Array, ""],
    free: Bool[Array, " k"],
    max_steps: int,
) -> Closing:
    """Closed posture nearest to a guess, on the start's branch of the given joint coordinates.

    Angles go the shorter way round from the start.

    Args:
        start: posture on the branch. q: coordinates by joint. u: rates by joint [rad/s], [m/s].
        t: time of the drivers [s]. free: mask (6 n,) of the coordinates that may move.
        max_steps: number of steps from the guess at most.
    """
    system, guess, start, q, u, t = held_constant((system, guess, start, q, u, t))
    kin = system.kinematics(start)
    joints = {name: system.joints[system.joint_index(name)] for name in {**q, **u}}
    first = {name: relative_motion(kin, joints[name])[0] for name in q}
    # Continuation from the start: a mechanism with loops has several postures for the same coordinates.
    way = {name: _shorter(joints[name], q[name] - first[name]) for name in q}
    longest = jnp.max(jnp.abs(jnp.concatenate([*way.values(), jnp.zeros(1)])))
    parts = jnp.where(longest > 0, jnp.maximum(jnp.ceil(longest / _LONGEST), _FEWEST), 0.0)
    rates = {name: u[name] if name in u else jnp.zeros_like(q[name]) for name in joints}
    prepared = prepare_rows(system)

    def driven(values: dict[str, Array]) -> AugmentedModel:
        moved_system = with_drivers(system, values, rates, t)
        return AugmentedModel(
            moved_system, group_constraints(moved_system), prepared.inverse_inertia
        )

    # Rows of the joints, and those of the drivers that hold coordinates, or rates.
    names = [name for name in joints for _ in _driven(system, name, rates[name], rates[name], t)]
    owner = np.array(driven(rates).constraints.owner, dtype=int)
    of_driver = lambda of: np.array([True] * len(system.joints) + [n in of for n in names])
    with_coordinates, with_rates = of_driver(q)[owner], of_driver(u)[owner]
    belongs = np.eye(len(system.joints) + len(names))[owner]

    def advance(carry: _Carry) -> _Carry:
        phase, state = carry.phase, carry.state
        share = jnp.maximum(jnp.floor_divide(carry.steps, _STEPS_EACH), 0.0) / jnp.maximum(
            parts, 1.0
        )
        share = jnp.where(phase == _ON_THE_WAY, share, 1.0)
        values = {name: first[name] + share * way[name] for name in q}
        if set(u) - set(q):
            kin = system.kinematics(state)
            values |= {name: relative_motion(kin, joints[name])[0] for name in u if name not in q}
        model = driven(values)
        eq = evaluate_equations(model, t, state)
        mask = jnp.where(phase == _MOVING, with_rates, with_coordinates)
        eq = jax.tree.map(lambda x: jnp.where(mask.reshape(-1, *(1,) * (x.ndim - 1)), x, 0.0), eq)
        displacement = displacement_between(state, guess)
        # from the guess: rates of rotation vectors in the place of angular velocities
        turning_rates = jnp.where(
            phase == _NEAREST,
            jax.vmap(_right_jacobian)(displacement.reshape(-1, 6)[:, 3:]),
            jnp.eye(3),
        )
        angular = jnp.einsum("mna,nab->mnb", eq.J[..., 3:], turning_rates)
        eq = eqx.tree_at(lambda e: e.J, eq, jnp.concatenate([eq.J[..., :3], angular], axis=-1))
        velocity = jnp.concatenate([state.v, state.omega], axis=1).reshape(-1)
        right_side = jnp.select(
            [phase == _ON_THE_WAY, phase == _NEAREST],
            [-eq.value, eq.matrix @ displacement - eq.value],
            eq.target - eq.matrix @ velocity,
        )
        step = nearest_step(model, eq, free)(right_side)
        base = jax.tree.map(lambda a, b: jnp.where(phase == _NEAREST, a, b), guess, state)
        r, p = move_bodies(base.r, base.p, jnp.where(phase == _MOVING, 0.0, step).reshape(-1, 6))
        velocity = (velocity + jnp.where(phase == _MOVING, step, 0.0)).reshape(-1, 6)
        next_state = State(r, p, velocity[:, :3], velocity[:, 3:])

        last = (carry.steps >= 0) & (jnp.mod(carry.steps, _STEPS_EACH) == _STEPS_EACH - 1)
        residual = jnp.abs(model.constraints.scales() * eq.value)
        is_open = (phase == _ON_THE_WAY) & last & ~(jnp.max(residual, initial=0.0) <= _CLOSED)
        size, change = jnp.max(jnp.abs(step)), jnp.max(jnp.abs(step - displacement))
        is_settled = (change <= _SETTLED + _SETTLED_RELATIVE * size) | (
            (change <= _STALLED_RELATIVE * size) & (change >= 0.5 * carry.change)
        )
        steps = carry.steps + 1
        ends = jnp.select(
            [phase == _ON_THE_WAY, phase == _NEAREST],
            [steps >= _STEPS_EACH * (parts + 1), is_settled],
            steps >= _PASSES,
        )
        exhausted = (phase == _NEAREST) & (steps >= max_steps) & ~ends
        following = jnp.where(exhausted | is_open, _ENDED, phase + ends)
        is_looking = (phase == _MOVING) & (carry.steps == 0)
        return _Carry(
            following,
            jnp.where(ends, 0.0, steps),
            next_state,
            jax.tree.map(lambda a, b: jnp.where(phase == _ON_THE_WAY, a, b), next_state, carry.branch),
            carry.on_the_way & ~is_open,
            jnp.where(phase == _NEAREST, change, jnp.inf),
            jnp.where(is_looking, jnp.max(residual[:, None] * belongs, axis=0, initial=0.0), carry.residuals),
            jnp.where(phase == _MOVING, jnp.max(jnp.abs(right_side), initial=0.0), carry.rate_residual),
        )  # fmt: skip

    is_finite, infinite = jnp.isfinite(longest), jnp.full((), jnp.inf, guess.r.dtype)
    carry = _Carry(
        jnp.where(is_finite, _ON_THE_WAY if q else _NEAREST, _ENDED),
        (-_STEPS_FIRST if q else 0) + 0.0 * parts,
        State(start.r, start.p, guess.v, guess.omega),
        start,
        is_finite,
        infinite,
        jnp.full(belongs.shape[1], jnp.inf, guess.r.dtype),
        infinite,
    )
    end = jax.lax.while_loop(lambda carry: carry.phase < _ENDED, advance, carry)
    is_nearest = jnp.isfinite(end.rate_residual)
    return Closing(
        end.state, is_nearest, end.on_the_way, end.branch, end.residuals, end.rate_residual
    )


def displacement_between(state: State, base: State) -> Float[Array, " k"]:
    """Displacement (6 n,) of a state from another: translations [m], body-frame rotation vectors [rad]."""
    turn = jax.vmap(lambda a, b: to_rotation_vector(product(conjugate(b), a)))(state.p, base.p)
    return jnp.concatenate([state.r - base.r, turn], axis=1).reshape(-1)


def _right_jacobian(turn: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Matrix from rates of a rotation vector to the angular velocity in body axes.

    Source: G. S. Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2 (2012), eq. 10.86.
    """
    square = jnp.sum(turn**2)
    is_small = square < 1e-4
    angle = jnp.sqrt(jnp.where(is_small, 1.0, square))
    first = jnp.where(is_small, 0.5 - square / 24, (1 - jnp.cos(angle)) / angle**2)
    second = jnp.where(is_small, 1 / 6 - square / 120, (angle - jnp.sin(angle)) / angle**3)
    matrix = skew(turn)
    return jnp.eye(3) - first * matrix + second * (matrix @ matrix)


def _shorter(joint: Joint, way: Float[Array, " c"]) -> Float[Array, " c"]:
    """Way of a joint's coordinates without whole turns, which a screw's displacement does tell."""
    if joint.pitched or joint.kind == "spherical":
        return way
    turns = np.array([unit == "rad" for _, unit in coordinates_of(joint.kind)])
    return jnp.where(turns, way - 2 * jnp.pi * jnp.round(way / (2 * jnp.pi)), way)


def nearest_step(
    model: AugmentedModel, eq: Equations, free: Bool[Array, " k"]
) -> Callable[[Float[Array, " m"]], Float[Array, " k"]]:
    """Function of numbers b (m,) that returns the smallest x in the mass metric with J x = b."""
    weighed = model.weigh(eq.J * free.reshape(1, -1, 6)).reshape(eq.matrix.shape) * free[None]
    inverse = lapack.pseudoinverse(weighed @ (eq.matrix * free[None]).T, 1e-11)
    return lambda b: weighed.T @ (inverse @ b)
