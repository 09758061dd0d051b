"""Singular postures: the joints that a mechanism's constraints fail at, in words."""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.joint_coordinate import coordinate, free_coordinates
from ...mechanics.joint_kind import Which
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.augmented import Augmented, AugmentedModel
from .initial import jacobian, singular_values

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
        `owners`.
    """
    vectors, values, _ = np.linalg.svd(jacobian(model, state, t), full_matrices=False)
    return float(values[rank - 1]), owners(model, vectors[:, rank - 1] ** 2)


def owners(model: AugmentedModel, weights: Float[np.ndarray, " m"]) -> tuple[str, ...]:
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
    model = Augmented().prepare(system)
    values = np.asarray(singular_values(model, states, jnp.asarray(t, dtype=states.r.dtype)))
    state = _one(states, -1)
    if rank < values.shape[1] and values[-1, rank] > _RISEN * values[0, 0] > values[0, rank]:
        where = _one(states, 0), state
        return "" if followed else singular_start(system, model, *where, t, rank)
    if not values[-1, rank - 1] < _SINGULAR * values[0, rank - 1]:
        return ""
    smallest, names = weakest_rows(system, model, state, t, rank)
    return (
        f"the mechanism comes to a singular posture of {standing(system, state, names)}: the "
        f"smallest singular value of the constraint Jacobian is {smallest:.3g} there and "
        f"{values[0, rank - 1]:.3g} at the start. What these joints or drivers demand takes "
        "unbounded velocities or forces; lead the motion around that posture"
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
        f"the start is a singular posture of {standing(system, start, names)}: "
        "branches of the motion meet there, and nothing says which one it follows. Start "
        "beside that posture, on the branch that is meant, or with velocities along it"
    )


def _one(states: State, k: int) -> State:
    return State(*(x[k] for x in (states.r, states.p, states.v, states.omega)))


def standing(system: System, state: State, names: tuple[str, ...]) -> str:
    """Names of joints with their present angles and displacements, where one is free."""
    kin = system.kinematics(state)
    units: dict[Which, str] = {"angle": "rad", "displacement": "m"}
    found = []
    for name in names:
        joint = system.joints[system.joint_index(name)]
        free = free_coordinates(joint)
        at = [f"{float(coordinate(kin, joint, w).value):.6g} {units[w]}" for w in free]
        found.append(f"{name} (at {', '.join(at)})" if at else name)
    return ", ".join(found)
