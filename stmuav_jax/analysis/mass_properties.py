"""Moments of the masses of all bodies together, in the axes of the first one."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..math.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System


class Moments(NamedTuple):
    """Moments of a machine's masses about the base's centre of mass O, base axes.

    Attributes:
        mass: m [kg].
        first: p = m c (3,) [kg m]. first_rate: its rate against the base (3,) [kg m/s].
        inertia: J (3, 3) [kg m^2].
        momentum: H of the parts that move against the base (3,) [N m s].
    """

    mass: Float[Array, ""]
    first: Float[Array, "3"]
    first_rate: Float[Array, "3"]
    inertia: Float[Array, "3 3"]
    momentum: Float[Array, "3"]


def mass_moments(system: System, state: State) -> Moments:
    """Moments of all bodies of a system at a state; the first body is the base."""
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    d = (state.r - state.r[:1]) @ R_0w.T
    d_rate = (state.v - state.v[:1]) @ R_0w.T - jnp.cross(state.omega[:1], d)
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    body_inertias = jnp.einsum("nij,njk,nlk->nil", R, system.bodies.inertia, R)
    spin = jnp.einsum("nij,nj->ni", R, state.omega) - state.omega[:1]
    square = jnp.sum(mass * jnp.sum(d**2, axis=1))
    return Moments(
        jnp.sum(mass),
        mass @ d,
        mass @ d_rate,
        jnp.sum(body_inertias, axis=0)
        + square * jnp.eye(3)
        - jnp.einsum("n,ni,nj->ij", mass, d, d),
        mass @ jnp.cross(d, d_rate) + jnp.einsum("nij,nj->i", body_inertias, spin),
    )
