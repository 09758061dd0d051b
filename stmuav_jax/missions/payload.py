"""Payload of a mission: a point mass on the panel, in the machine and out of its controller's sight."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..control.adaptation.moments import Payload, bodies_carrying
from ..control.panel import PanelBodies
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.table import Parameters
from .schema import PayloadEntry


def tracker_carrying(bodies: PanelBodies, given: PayloadEntry) -> PanelBodies:
    """The tracker's bodies with the payload on its panel."""
    mass, place = jnp.asarray(given.mass), jnp.asarray(given.position, dtype=float)
    inertia = mass * (place @ place * jnp.eye(3) - jnp.outer(place, place))
    return bodies_carrying(bodies, Payload(mass, mass * place, jnp.zeros(3)), inertia)


def table_carrying(table: Parameters, bodies: PanelBodies) -> Parameters:
    """Parameter table of the machine whose panel has these numbers."""
    return table.replaced(
        {
            "mass.panel_7": bodies.mass[-1],
            "geometry.panel_com": bodies.geometry.panel_com,
            "inertia.panel_7": bodies.inertia[-1],
        },
        "the table's panel with the mission's payload",
    )


class WithoutPayload(eqx.Module):
    """Function of a plant's true state that returns that of the machine which its controller believes.

    The panel's row is where the panel's own centre of mass is, not where that of panel and payload is.

    Args:
        loaded, empty: systems with and without the payload.
    """

    shift: Float[Array, "3"]

    def __init__(self, loaded: System, empty: System) -> None:
        R = rotation_matrix(empty.reference.p[-1])
        self.shift = R.T @ (empty.reference.r[-1] - loaded.reference.r[-1])

    def __call__(self, t: Float[Array, ""], state: State, internal: Float[Array, " z"]) -> State:
        del t, internal
        R = rotation_matrix(state.p[-1])
        moved = R @ jnp.cross(state.omega[-1], self.shift)
        r, v = state.r.at[-1].add(R @ self.shift), state.v.at[-1].add(moved)
        return State(r, state.p, v, state.omega)
