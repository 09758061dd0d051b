"""Reactions at all joints of a spanning tree."""

import jax.numpy as jnp
import numpy as np

from ...mechanics.load import Load
from ...mechanics.state import Kinematics
from ...mechanics.system import System
from ..formulations.base import Accelerations, Reactions
from ..formulations.reactions import joint_points
from .topology import SpanningTree


def tree_reactions(
    system: System,
    tree: SpanningTree,
    kin: Kinematics,
    load: Load,
    rates: Accelerations,
    cut: Reactions,
) -> Reactions:
    """Reactions at all joints, from those of the loop-closing joints.

    A joint of the tree transmits the wrench that the bodies behind it need for their
    accelerations beyond the loads and the reactions of loop-closing joints.

    Args:
        load: sum of the loads of all force elements.
        cut: reactions at the loop-closing joints, with zeros for the joints of the tree.
    """
    n = system.n_bodies
    bodies = system.bodies
    origin = kin.r[0]
    R, omega = kin.R_wb[:-1], kin.omega[:-1]
    spin = jnp.einsum("nab,nb->na", bodies.inertia, omega)
    turning = jnp.einsum("nab,nb->na", bodies.inertia, rates.omega_rate) + jnp.cross(omega, spin)
    force = bodies.mass[:, None] * rates.v_rate - load.force[:-1]
    moment = jnp.einsum("nab,nb->na", R, turning - load.moment[:-1])
    moment = moment + jnp.cross(kin.r[:-1] - origin, force)
    points = joint_points(system, kin)[0] if system.joints else jnp.zeros((0, 3))
    about = cut.moment + jnp.cross(points - origin, cut.force)
    ends = np.zeros((n + 1, len(system.joints)))
    names = list(kin.names)
    for k, joint in enumerate(system.joints):
        ends[names.index(joint.body_j), k] += 1.0
        ends[names.index(joint.body_i), k] -= 1.0
    force, moment = force - ends[:n] @ cut.force, moment - ends[:n] @ about
    behind = np.zeros((len(system.joints), n))
    for joint, sign, below in tree.behind():
        behind[joint, list(below)] = sign
    force, moment = behind @ force, behind @ moment
    moment = moment - jnp.cross(points - origin, force)
    return Reactions(cut.force + force, cut.moment + moment)
