"""Mass, first moment, inertia and angular momentum of a machine, and the part of a payload in them.

About the base's centre of mass O, in the base's axes, with bodies at d_i that turn with W_i and the
base with W,

    p = sum m_i d_i,                J = sum R_i J_i R_i^T + m_i (|d_i|^2 I - d_i d_i^T),
    H = sum m_i d_i x d_i' + R_i J_i R_i^T (W_i - W),         L = J W + H.

A payload is fixed to the last body, the machine's only one or its panel. With its mass dm, its first
moment mu about that body's centre of mass, and r, R that body's place and axes, all of these are
linear in (dm, mu):

    p += dm r + R mu,     s = R mu,     J += dm (|r|^2 I - r r^T) + 2 (r.s) I - r s^T - s r^T,
    H += dm r x r' + r x s' + s x r'.

What is left out is the payload's inertia about that centre of mass, dm |mu / dm|^2.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.rotation import rotation_matrix
from ...mechanics.state import State
from ...mechanics.system import System
from ..geometric import MassProperties
from ..panel import PanelBodies


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


class Carrier(NamedTuple):
    """Motion of the body that carries a payload, against the base and in its axes.

    Attributes:
        r: its centre of mass (3,) [m]. r_rate: velocity (3,) [m/s].
        R: its axes (3, 3). turning: its angular velocity against the base (3,) [rad/s].
    """

    r: Float[Array, "3"]
    r_rate: Float[Array, "3"]
    R: Float[Array, "3 3"]
    turning: Float[Array, "3"]


class Payload(NamedTuple):
    """Payload as a change of the machine that a controller believes in.

    Attributes:
        mass: dm [kg].
        moment: first moment mu about the carrier's centre of mass, its axes (3,) [kg m].
        inertia: changes of the machine's moments of inertia about the base's axes, as shares of them
            (3,) [1].
    """

    mass: Float[Array, ""]
    moment: Float[Array, "3"]
    inertia: Float[Array, "3"]


def payload_of(numbers: Float[Array, "7"]) -> Payload:
    """Payload from its mass, moment and inertia in one vector."""
    return Payload(numbers[0], numbers[1:4], numbers[4:])


def moments(system: System, state: State) -> Moments:
    """Moments of all bodies of a system at a state; the first body is the base."""
    mass = system.bodies.mass
    R_0w = rotation_matrix(state.p[0]).T
    d = (state.r - state.r[0]) @ R_0w.T
    d_rate = (state.v - state.v[0]) @ R_0w.T - jnp.cross(state.omega[0], d)
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(rotation_matrix)(state.p))
    own = jnp.einsum("nij,njk,nlk->nil", R, system.bodies.inertia, R)
    spin = jnp.einsum("nij,nj->ni", R, state.omega) - state.omega[0]
    square = jnp.sum(mass * jnp.sum(d**2, axis=1))
    return Moments(
        jnp.sum(mass),
        mass @ d,
        mass @ d_rate,
        jnp.sum(own, axis=0) + square * jnp.eye(3) - jnp.einsum("n,ni,nj->ij", mass, d, d),
        mass @ jnp.cross(d, d_rate) + jnp.einsum("nij,nj->i", own, spin),
    )


def carrier(state: State) -> Carrier:
    """Motion of the last body of a state against the first."""
    R_0w = rotation_matrix(state.p[0]).T
    r = R_0w @ (state.r[-1] - state.r[0])
    r_rate = R_0w @ (state.v[-1] - state.v[0]) - jnp.cross(state.omega[0], r)
    R = R_0w @ rotation_matrix(state.p[-1])
    return Carrier(r, r_rate, R, R @ state.omega[-1] - state.omega[0])


def carrying(about: Moments, on: Carrier, payload: Payload) -> Moments:
    """Moments of a machine with a payload, linear in the payload's numbers."""
    m, r, v = payload.mass, on.r, on.r_rate
    s = on.R @ payload.moment
    s_rate = jnp.cross(on.turning, s)
    one = jnp.eye(3)
    inertia = m * (r @ r * one - jnp.outer(r, r))
    inertia = inertia + 2 * (r @ s) * one - jnp.outer(r, s) - jnp.outer(s, r)
    inertia = inertia + jnp.diag(payload.inertia * jnp.diagonal(about.inertia))
    momentum = m * jnp.cross(r, v) + jnp.cross(r, s_rate) + jnp.cross(s, v)
    return Moments(
        about.mass + m,
        about.first + m * r + s,
        about.first_rate + m * v + s_rate,
        about.inertia + inertia,
        about.momentum + momentum,
    )


def properties(about: Moments) -> MassProperties:
    """Mass properties about the centre of mass, with a moment of zero."""
    m, c = about.mass, about.first / about.mass
    J = about.inertia - m * (c @ c * jnp.eye(3) - jnp.outer(c, c))
    h = about.momentum - jnp.cross(about.first, about.first_rate) / m
    return MassProperties(m, c, J, h, jnp.zeros(3))


def bodies_carrying(
    bodies: PanelBodies, payload: Payload, inertia: Float[Array, "3 3"] | None = None
) -> PanelBodies:
    """The tracker's bodies with a payload on the panel; its `inertia` as a share is not used.

    Args:
        inertia: of the payload about the panel's centre of mass, panel axes (3, 3) [kg m^2]; by
            default it is left out.
    """
    m = bodies.mass[-1] + payload.mass
    d = payload.moment / m
    about = bodies.inertia[-1] if inertia is None else bodies.inertia[-1] + inertia
    own = about - m * (d @ d * jnp.eye(3) - jnp.outer(d, d))
    com = bodies.geometry.panel_com + d
    return PanelBodies(
        eqx.tree_at(lambda g: g.panel_com, bodies.geometry, com),
        bodies.shift,
        bodies.mass.at[-1].set(m),
        bodies.inertia.at[-1].set(own),
    )
