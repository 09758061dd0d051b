"""Mass properties of all bodies together, in the axes of the first one."""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System


def centre_of_mass(system: System, state: State) -> Float[Array, "3"]:
    """Centre of mass of all bodies, from the first one's origin in its axes [m]."""
    return rotation_matrix(state.p[0]).T @ (system.com(state) - state.r[0])


def inertia_about_centre(system: System, state: State) -> Float[Array, "3 3"]:
    """Inertia of all bodies together about their centre of mass, axes of the first one [kg m^2]."""
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    arms = (state.r - system.com(state)[None]) @ R_0w.T
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    body_inertia = jnp.einsum("nij,njk,nlk->il", R, system.bodies.inertia, R)
    square = jnp.sum(mass * jnp.sum(arms**2, axis=1))
    return body_inertia + square * jnp.eye(3) - jnp.einsum("n,ni,nj->ij", mass, arms, arms)


def inner_momentum(system: System, state: State) -> Float[Array, "3"]:
    """Angular momentum of the bodies relative to the first one, in its axes [N m s].

    The reference point is the centre of mass.
    """
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    arms = (state.r - system.com(state)[None]) @ R_0w.T
    from_base = (state.r - state.r[:1]) @ R_0w.T
    v = (state.v - state.v[:1]) @ R_0w.T - jnp.cross(state.omega[:1], from_base)
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    spin = jnp.einsum("nij,nj->ni", R, state.omega) - state.omega[:1]
    spin_momentum = jnp.einsum("nij,njk,nlk,nl->i", R, system.bodies.inertia, R, spin)
    return spin_momentum + jnp.einsum("n,ni->i", mass, jnp.cross(arms, v))
