"""Energy and momentum of a system, for the balances of both."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..mechanics.state import State
from ..mechanics.system import System


class Energy(eqx.Module):
    """Kinetic and potential energy [J], each of shape ()."""

    kinetic: Float[Array, ""]
    potential: Float[Array, ""]

    @property
    def total(self) -> Float[Array, ""]:
        """Total energy, kinetic plus potential [J]."""
        return self.kinetic + self.potential


def energy(system: System, state: State, t: Float[Array, ""]) -> Energy:
    """Energy at one state, with the potential of conservative forces (gravity, springs)."""
    kin = system.kinematics(state)
    bodies = system.bodies
    spin = jnp.einsum("na,nab,nb->", state.omega, bodies.inertia, state.omega)
    kinetic = 0.5 * (jnp.sum(bodies.mass[:, None] * state.v**2) + spin)
    loads = [force.load(t, kin).potential for force in system.forces]
    return Energy(kinetic, sum(loads, start=jnp.zeros_like(kinetic)))


def momentum(system: System, state: State) -> Float[Array, "6"]:
    """Linear momentum [N s], then angular momentum about the world's origin [N m s], (6,)."""
    kin = system.kinematics(state)
    linear = system.bodies.mass[:, None] * state.v
    spin = jnp.einsum("nab,nbc,nc->na", kin.R_wb[:-1], system.bodies.inertia, state.omega)
    angular = jnp.cross(state.r, linear) + spin
    return jnp.concatenate([jnp.sum(linear, axis=0), jnp.sum(angular, axis=0)])
