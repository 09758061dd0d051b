"""Joint reaction wrenches from the Lagrange multipliers.

Source: report Part I, Eq. 4.10 to 4.12, corrected: the joints of body i exert the world
force Phi_r^T lambda and the body-frame moment L Phi_p^T lambda / 2 on it.
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.constraint import ROWS
from ..mechanics.state import Kinematics, State
from ..mechanics.system import System
from .differential import Constraints, kinematic_sides

Frame = Literal["world", "joint"]


class Reactions(eqx.Module):
    """What body i of each joint exerts on its body j, about j's joint point.

    Attributes:
        force: (joints, 3) [N].
        moment: (joints, 3) [N m].
    """

    force: Float[Array, "joints 3"]
    moment: Float[Array, "joints 3"]


def joint_reactions(
    system: System,
    constraints: Constraints,
    t: Float[Array, ""],
    state: State,
    multipliers: Float[Array, " m"],
    frame: Frame = "world",
) -> Reactions:
    """Reaction force and moment at every joint, in the order of `system.joints`.

    Args:
        frame: "world", or "joint" for the axes of the joint's frame fixed in body i.
    """
    kin = system.kinematics(state)
    sides = kinematic_sides(kin, "omega")
    names = list(kin.names)
    i = np.array([names.index(joint.body_i) for joint in system.joints], dtype=int)
    wrench_i = jnp.zeros((len(system.joints), 6), state.r.dtype)
    start = 0
    for group in constraints.groups:
        rows = group.rows(sides, t, "omega")
        count = ROWS[group.kind] * len(group.i)
        share = multipliers[start : start + count].reshape(rows.value.shape)
        belongs = np.eye(len(system.joints))[list(group.joints)]
        wrench_i = wrench_i + belongs.T @ jnp.einsum("kc,kcw->kw", share, rows.J_i)
        start += count
    force = wrench_i[:, :3]
    moment = jnp.einsum("kab,kb->ka", kin.R_wb[i], wrench_i[:, 3:])
    point_j, axes = _points(system, kin)
    moment = moment + jnp.cross(kin.r[i] - point_j, force)
    result = Reactions(-force, -moment)
    if frame == "world":
        return result
    turn = lambda x: jnp.einsum("kba,kb->ka", axes, x)
    return Reactions(turn(result.force), turn(result.moment))


def _points(system: System, kin: Kinematics) -> tuple[Array, Array]:
    """World position of every joint's point on body j, and axes of its frame on body i."""
    points = [kin.point(joint.body_j, joint.point_j)[0] for joint in system.joints]
    axes = [kin.R_wb[kin.index(joint.body_i)] @ joint.frame_i for joint in system.joints]
    if not points:
        return jnp.zeros((0, 3), kin.r.dtype), jnp.zeros((0, 3, 3), kin.r.dtype)
    return jnp.stack(points), jnp.stack(axes)
