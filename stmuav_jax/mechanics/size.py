"""Size and weight of a mechanism: the scales of its moments and forces."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math.native.program import native
from .forces import Gravity
from .state import State
from .system import System

# Standard gravity, the scale of weight where a system has none [m/s^2].
STANDARD_GRAVITY = 9.80665


@native
def mechanism_size(system: System, state: State) -> Float[Array, ""]:
    """Size of a mechanism [m]: the longest edge of the box about its mass centres and joints.

    For a single body without joints it is twice its largest radius of gyration.
    """
    kin = system.kinematics(state)
    ends = [(j.body_i, j.point_i) for j in system.joints]
    ends += [(j.body_j, j.point_j) for j in system.joints]
    points = jnp.stack([*state.r, *(kin.point(*end)[0] for end in ends)])
    edge = jnp.max(jnp.max(points, axis=0) - jnp.min(points, axis=0))
    moments = jnp.trace(system.bodies.inertia, axis1=1, axis2=2)
    gyration = 2 * jnp.sqrt(jnp.max(moments / (2 * system.bodies.mass)))
    return jnp.where(edge > 0, edge, gyration)


def mechanism_weight(system: System) -> Float[Array, ""]:
    """Weight of all bodies [N], by standard gravity where the system has none."""
    pulls = [force.acceleration for force in system.forces if isinstance(force, Gravity)]
    pull = jnp.linalg.norm(sum(pulls, jnp.zeros(3)))
    return jnp.sum(system.bodies.mass) * jnp.where(pull > 0, pull, STANDARD_GRAVITY)
