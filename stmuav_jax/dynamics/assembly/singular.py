"""Singular postures and jumping drivers: messages on failures of the constraints, and the branches that meet.

In a singular posture, rows of the constraint Jacobian J are dependent that are independent nearby.
With W the combinations of rows that vanish there, and N the free velocities, both orthonormal, the
rank that a free velocity u gains is, to first order, that of

    W^T (dJ/dq u) N.

It is zero for every u where rows are dependent all along the motion. Velocities that gain as much
rank as any others say along which branch the motion goes on. At rest nothing says so.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...mechanics.joint import Which, free_coordinates
from ...mechanics.joint_states import evaluate_coordinate, joint_motion
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.augmented import AugmentedModel, prepare_rows
from ..formulations.independence import DEPENDENT, displace_postures
from .rank import evaluate_jacobian, singular_values

# Distances from a time within which a jump is looked for, relative to the time.
_WITHIN = (1e-12, 1e-9, 1e-6)
# A change is a jump if it exceeds this many times what the slopes at both ends explain, and round-off.
_EXCESS, _ROUND_OFF = 10.0, 1e-12
# A run that stops this near to half a turn of a coupled joint has stopped there [rad].
_NEAR_HALF_TURN = 1e-3


def describe_driver_jump(system: System, t: float) -> str:
    """Text on the first driver whose position or velocity jumps at time t [s]; empty if none does.

    A jump of the position takes an infinite velocity, a jump of the velocity an infinite force. Only
    the acceleration may jump.
    """
    for joint in system.joints:
        if joint.motion is None:
            continue
        unit = "rad" if joint.kind == "drive_angle" else "m"
        position = lambda s, joint=joint: jnp.asarray(joint.motion(s), s.dtype)  # pyright: ignore[reportOptionalCall]
        for share in _WITHIN:
            h = share * max(abs(t), 1e-3)
            first, last = (_driver_jet(position, t + side * h) for side in (-1, 1))
            names = (("position", unit), ("velocity", f"{unit}/s"))
            for k, (quantity, rate_unit) in enumerate(names):
                change = abs(last[k] - first[k])
                smooth = _EXCESS * h * (abs(first[k + 1]) + abs(last[k + 1]))
                if change > smooth + _ROUND_OFF * (abs(first[k]) + abs(last[k])):
                    return (
                        f"the {quantity} of the driver '{joint.name}' jumps there, from {first[k]:.6g} to "
                        f"{last[k]:.6g} {rate_unit}, which takes an infinite force. A driver's position and "
                        "velocity must be continuous, only its acceleration may jump: give it a motion "
                        "that changes over a finite time"
                    )
    return ""


def describe_half_turn(system: System, state: State) -> str:
    """Text on the first coupling of two angles that has come to half a turn and counts none; empty if none has."""
    for joint in system.joints:
        mate = joint.mate
        if mate is None or mate.coordinates != ("angle", "angle") or np.isfinite(mate.period):
            continue
        for name in (mate.dependent, mate.joint.name):
            angle = float(np.asarray(joint_motion(system, state, name).angle))
            if np.pi - abs(angle) < _NEAR_HALF_TURN:
                return (
                    f"the joint '{name}' has come to half a turn, within which the coupling '{joint.name}' "
                    f"holds: its ratio of {float(mate.ratio):.6g} is no fraction with a denominator of at "
                    "most 64, with which whole turns count"
                )
    return ""


def _driver_jet(position: Callable[..., Array], t: float) -> tuple[float, float, float]:
    """Position, velocity and acceleration of a driver at time t [s]."""
    unit_rate = jnp.ones(())
    rate = lambda s: jax.jvp(position, (s,), (unit_rate,))[1]
    value = position(jnp.asarray(t, float))
    velocity, acceleration = jax.jvp(rate, (jnp.asarray(t, float),), (unit_rate,))
    return tuple(float(np.asarray(x)) for x in (value, velocity, acceleration))  # pyright: ignore[reportReturnType]


# A run ended in a singular posture if the smallest singular value is below this fraction of that at
# its start.
_SINGULAR = 1e-3
# It began in one if a singular value that was zero there has come to this fraction of the largest.
_RISEN = 1e-10


def weakest_rows(
    system: System, model: AugmentedModel, state: State, t: float, rank: int
) -> tuple[float, tuple[str, ...]]:
    """Singular value number `rank` of the constraint Jacobian, and the joints of its rows.

    Returns:
        The value, and the names of the joints that own the corresponding combination of rows, see
        `name_owners`.
    """
    vectors, values, _ = np.linalg.svd(evaluate_jacobian(model, state, t), full_matrices=False)
    return float(values[rank - 1]), name_owners(model, vectors[:, rank - 1] ** 2)


def name_owners(model: AugmentedModel, weights: Float[np.ndarray, " m"]) -> tuple[str, ...]:
    """Names of joints that own rows of some weight: drivers first, then those with the largest shares.

    A share counts if it is at least a tenth, or half of the largest where all are smaller.
    """
    joints = model.system.joints
    share = np.zeros(len(joints))
    np.add.at(share, np.array(model.constraints.owner), weights / np.sum(weights))
    driver = np.array([joint.kind.startswith("drive") for joint in joints])
    order = np.lexsort((-share, ~driver))
    least = min(0.1, 0.5 * np.max(share))
    named = [k for k in order if share[k] >= (1e-6 if driver[k] else least)]
    return tuple(joints[k].name for k in named)


def singular_posture(
    system: System, states: State, t: float, rank: int, followed: bool = False
) -> str:
    """Text on a run that ended or began in a singular posture, with joints and drivers; else "".

    Args:
        states: first and last state of the run (2, n, .). t: time of the last [s].
        rank: rank at the start. followed: true if the start's velocities say along which branch of a
            singular posture the motion goes on.
    """
    if not rank:
        return ""
    model = prepare_rows(system)
    values = np.asarray(singular_values(model, states, jnp.asarray(t, dtype=states.r.dtype)))
    state = _state_at(states, -1)
    if rank < values.shape[1] and values[-1, rank] > _RISEN * values[0, 0] > values[0, rank]:
        where = _state_at(states, 0), state
        return "" if followed else singular_start(system, model, *where, t, rank)
    if not values[-1, rank - 1] < _SINGULAR * values[0, rank - 1]:
        return ""
    smallest, names = weakest_rows(system, model, state, t, rank)
    return (
        f"the mechanism comes to a singular posture of {format_joints(system, state, names)}: the "
        f"smallest singular value of the constraint Jacobian is {smallest:.3g} there and "
        f"{values[0, rank - 1]:.3g} at the start. What these joints or drivers demand takes "
        "unbounded velocities or forces; plan the motion around that posture"
    )


def singular_start(
    system: System, model: AugmentedModel, start: State, later: State, t: float, rank: int
) -> str:
    """Text on a start in a singular posture, whose dependent rows are independent at a later state.

    Args:
        t: time of the later state [s]. rank: rank at the start.
    """
    _, names = weakest_rows(system, model, later, t, rank + 1)
    return branches_meet(system, start, names)


def branches_meet(system: System, start: State, names: tuple[str, ...]) -> str:
    """Text on a start in a singular posture of some joints, from which several motions lead."""
    return (
        f"the start is a singular posture of {format_joints(system, start, names)}: "
        "branches of the motion meet there, and nothing determines which one it follows. "
        "Start near that posture, on the intended branch, or with velocities along it"
    )


def _state_at(states: State, k: int) -> State:
    return State(*(x[k] for x in (states.r, states.p, states.v, states.omega)))


def format_joints(system: System, state: State, names: tuple[str, ...]) -> str:
    """Names of joints with their present angles and displacements, where one is free."""
    kin = system.kinematics(state)
    units: dict[Which, str] = {"angle": "rad", "displacement": "m"}
    descriptions = []
    for name in names:
        joint = system.joints[system.joint_index(name)]
        free = free_coordinates(joint)
        at = [f"{float(evaluate_coordinate(kin, joint, w).value):.6g} {units[w]}" for w in free]
        descriptions.append(f"{name} (at {', '.join(at)})" if at else name)
    return ", ".join(descriptions)


# Displacement for differences, as an angle [rad], and the gain that is not their round-off.
_STEP, _GAINED = 1e-4, 1e-5
# Velocities up to this many radians, or lengths of the mechanism, per second count as rest.
RESTING = 1e-6

Look = Callable[[State], Float[np.ndarray, "k m v"]]


class Branching(NamedTuple):
    """Rank that the constraint Jacobian gains near a posture.

    Attributes:
        gained: largest rank that is gained along a free motion; zero unless the posture is singular.
        followed: rank that is gained along the velocities of the state.
        resting: true if the velocities are zero.
        names: names of the joints whose rows are dependent in this posture alone.
        free: free velocities (6 n, d), in the order of the columns of the Jacobian.
    """

    gained: int
    followed: int
    resting: bool
    names: tuple[str, ...]
    free: Float[np.ndarray, "v d"]

    @property
    def undetermined(self) -> bool:
        """True if the velocities do not say along which branch the motion goes on."""
        return self.followed < self.gained


def find_branches(
    model: AugmentedModel, state: State, matrix: Float[np.ndarray, "m v"], look: Look
) -> Branching:
    """Rank gained near a posture, along its velocities and along any.

    Args:
        model: system prepared for maximal coordinates, with the rows of all joints.
        matrix: constraint Jacobian in (v, omega') at the state.
        look: function that returns the constraint Jacobians of states (k, n, .).
    """
    units = _column_units(model, matrix)
    sizes = np.linalg.norm(matrix * units, axis=1, keepdims=True)
    scaled = lambda J: J * units / np.where(sizes > 0, sizes, 1.0)
    left_vectors, values, right = np.linalg.svd(scaled(matrix))
    rank = int(np.sum(values > DEPENDENT * values[0]))
    W, N = left_vectors[:, rank:], right[rank:].T
    u = np.concatenate([np.asarray(state.v), np.asarray(state.omega)], axis=1).reshape(-1) / units
    speed = np.max(np.abs(u))
    none = Branching(0, 0, bool(speed <= RESTING), (), units[:, None] * N)
    if not W.size or not N.size:
        return none
    ways = [*(N / np.max(np.abs(N), axis=0)).T, *([] if none.resting else [u / speed])]
    steps = _STEP * units * np.array(ways)
    forward_jacobians, backward_jacobians = np.split(
        scaled(look(displace_postures(state, np.concatenate([steps, -steps])))), 2
    )
    gains = W.T @ ((forward_jacobians - backward_jacobians) / (2 * _STEP)) @ N
    count = N.shape[1]
    # a combination without any pattern gains as much as any
    mixed = np.tensordot(np.random.default_rng(0).normal(size=count), gains[:count], 1)
    gained = _count_rank(mixed / np.sqrt(count))
    if not gained:
        return none
    followed = 0 if none.resting else min(_count_rank(gains[-1]), gained)
    vectors, values, _ = np.linalg.svd(np.concatenate(gains[:count], axis=1))
    momentary = W @ vectors[:, : np.sum(values > _GAINED)]
    names = name_owners(model, np.sum(momentary**2, axis=1))
    return none._replace(gained=gained, followed=followed, names=names)


def _column_units(
    model: AugmentedModel, matrix: Float[np.ndarray, "m v"]
) -> Float[np.ndarray, " v"]:
    """Sizes of the columns: the longest arm of a joint [m] for velocities, one for rates of turning."""
    rows = matrix[~model.constraints.angular].reshape(-1, matrix.shape[1] // 6, 6)
    push, turn = (np.max(np.abs(x), initial=0.0) for x in (rows[..., :3], rows[..., 3:]))
    arm = turn / push if push > 0 and turn > 0 else 1.0
    return np.tile(np.repeat([arm, 1.0], 3), matrix.shape[1] // 6)


def _count_rank(gain: Float[np.ndarray, "a b"]) -> int:
    return int(np.sum(np.linalg.svd(gain, compute_uv=False) > _GAINED))
