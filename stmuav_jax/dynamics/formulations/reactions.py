"""Joint reaction wrenches from Lagrange multipliers.

Source: report Part I, Eq. 4.10 to 4.12, corrected: the joints of body i exert the world
force Phi_r^T lambda and the body-frame moment L Phi_p^T lambda / 2 on it.
"""

from typing import Literal

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError
from ...mechanics.constraint import ROWS
from ...mechanics.state import Kinematics, State
from ...mechanics.system import System
from .base import Reactions
from .constraints import Constraints, kinematic_sides

Frame = Literal["world", "joint"]


def joint_reactions(
    system: System,
    constraints: Constraints,
    t: Float[Array, ""],
    state: State,
    multipliers: Float[Array, " m"],
) -> Reactions:
    """Reaction force and moment at every joint in world axes, in the order of `system.joints`.

    They are zero for joints that own none of the rows.
    """
    kin = system.kinematics(state)
    sides = kinematic_sides(kin)
    names = list(kin.names)
    i = np.array([names.index(joint.body_i) for joint in system.joints], dtype=int)
    wrench_i = jnp.zeros((len(system.joints), 6), state.r.dtype)
    start = 0
    for group in constraints.groups:
        rows = group.rows(sides, t, "omega")
        count = ROWS[group.kind] * len(group.i)
        share = multipliers[start : start + count].reshape(-1, ROWS[group.kind])
        belongs = np.eye(len(system.joints))[list(group.joints)]
        wrench_i = wrench_i + belongs.T @ jnp.einsum("kc,cwk->kw", share, rows.J_i)
        start += count
    force = wrench_i[:, :3]
    moment = jnp.einsum("kab,kb->ka", kin.R_wb[i], wrench_i[:, 3:])
    moment = moment + jnp.cross(kin.r[i] - joint_points(system, kin)[0], force)
    return Reactions(-force, -moment)


def in_joint_axes(system: System, state: State, found: Reactions) -> Reactions:
    """Reactions in the axes of every joint's frame fixed in body i."""
    axes = joint_points(system, system.kinematics(state))[1]
    turn = lambda x: jnp.einsum("kba,kb->ka", axes, x)
    return Reactions(turn(found.force), turn(found.moment))


def reaction_on(
    system: System, found: Reactions, joint: str, body: str
) -> tuple[Float[Array | np.ndarray, "... 3"], Float[Array | np.ndarray, "... 3"]]:
    """Force [N] and moment [N m] that a joint exerts on one of its two bodies, (..., 3) each.

    The moment is about the joint's point on body j, where the force acts, for either body; the axes
    are those of the given reactions. `Reactions` hold the load of body i on body j; the opposite
    load acts on body i.

    Args:
        found: reactions at all joints, at one time or along a run (..., joints, 3).
        joint: name of the joint. body: name of one of its bodies, which may be "ground".

    Raises:
        ModelError: the joint is unknown, or does not join the body.
    """
    k = system.joint_index(joint)
    ends = (system.joints[k].body_i, system.joints[k].body_j)
    if body not in ends:
        raise ModelError(
            f"Joint '{joint}' joins '{ends[0]}' and '{ends[1]}', and exerts nothing on '{body}'."
        )
    sign = 1.0 if body == ends[1] else -1.0
    return sign * found.force[..., k, :], sign * found.moment[..., k, :]


def joint_points(system: System, kin: Kinematics) -> tuple[Array, Array]:
    """World position of every joint's point on body j, and axes of its frame on body i."""
    points = [kin.point(joint.body_j, joint.point_j)[0] for joint in system.joints]
    axes = [kin.R_wb[kin.index(joint.body_i)] @ joint.frame_i for joint in system.joints]
    if not points:
        return jnp.zeros((0, 3), kin.r.dtype), jnp.zeros((0, 3, 3), kin.r.dtype)
    return jnp.stack(points), jnp.stack(axes)
