"""Payloads that a machine picks up or drops: point masses on its bodies, each for a time.

A payload is a body of its own, welded to the one that carries it, behind the base among the bodies. Before and
after it is carried it has a share of its mass that is too small to be felt, so that nothing but masses changes.
It is picked up with the velocity of its place, and dropped with it.
"""

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError, nearest_names
from ..checks.numbers import as_floats
from ..dynamics.simulation import Scene
from ..math.rotation import rotation_matrix
from ..mechanics.body import Bodies
from ..mechanics.joint import weld
from ..mechanics.state import State
from ..mechanics.system import System
from .schema import CarriedEntry

# Share of its mass that a payload has while it is not carried, and its radius of gyration [m].
_ABSENT, _RADIUS = 1e-9, 1e-3


class Payloads(eqx.Module):
    """Payloads of a machine.

    Attributes:
        bodies: names of the bodies that carry them. at, until: times for which they are carried [s].
        mass: masses (k,) [kg]. position: from the bodies' centres of mass in their axes (k, 3) [m].
    """

    bodies: tuple[str, ...] = eqx.field(static=True)
    at: tuple[float, ...] = eqx.field(static=True)
    until: tuple[float, ...] = eqx.field(static=True)
    mass: Float[Array, " k"]
    position: Float[Array, "k 3"]

    def __init__(self, entries: Sequence[CarriedEntry], names: Sequence[str]) -> None:
        for entry in entries:
            if entry.body not in names:
                raise SettingError(
                    f"A payload is on the body '{entry.body}', which the machine does not have."
                    f"{nearest_names(entry.body, names)}"
                )
            if entry.until is not None and entry.until <= entry.at:
                raise SettingError(
                    f"The payload of '{entry.body}' must be dropped after it is picked up, but it is carried from "
                    f"{entry.at:g} to {entry.until:g} s."
                )
        self.bodies = tuple(entry.body for entry in entries)
        self.at = tuple(entry.at for entry in entries)
        self.until = tuple(np.inf if entry.until is None else entry.until for entry in entries)
        self.mass = as_floats([entry.mass for entry in entries])
        self.position = as_floats([entry.position for entry in entries]).reshape(-1, 3)

    def masses(self, t: Float[Array, ""] | float) -> Float[Array, " k"]:
        """Masses of the payloads at a time [s] (k,) [kg]."""
        is_carried = (t >= jnp.array(self.at)) & (t < jnp.array(self.until))
        return self.mass * jnp.where(is_carried, 1.0, _ABSENT)

    def masses_of_all(self, mass: Float[Array, " n"], t: Float[Array, ""]) -> Float[Array, " n"]:
        """Masses of all bodies of a loaded machine at a time [s], from those at another one."""
        return mass.at[self._places].set(self.masses(t))

    @property
    def _places(self) -> slice:
        return slice(1, 1 + len(self.bodies))

    def load(self, scene: Scene) -> Scene:
        """Scene of the machine with its payloads, with the masses of the start."""
        system = scene.system
        carriers = np.array([system.index(name) for name in self.bodies])
        names = [f"payload_{k}" for k in range(1, len(self.bodies) + 1)]
        inserted = lambda x, rows: jnp.concatenate([x[:1], rows, x[1:]])
        bodies, mass = system.bodies, self.masses(0.0)
        stacked = Bodies(
            (system.names[0], *names, *system.names[1:]),
            inserted(bodies.mass, mass),
            inserted(bodies.com, jnp.zeros_like(self.position)),
            inserted(bodies.inertia, mass[:, None, None] * _RADIUS**2 * jnp.eye(3)),
            bodies.free,
        )

        def extended(state: State) -> State:
            p, omega = state.p[carriers], state.omega[carriers]
            R = [rotation_matrix(x) for x in p]
            arms = jnp.stack([a @ x for a, x in zip(R, self.position, strict=True)])
            turning = [a @ jnp.cross(w, x) for a, w, x in zip(R, omega, self.position, strict=True)]
            rows = state.r[carriers] + arms, p, state.v[carriers] + jnp.stack(turning), omega
            return State(*map(inserted, _parts(state), rows))

        welds = []
        for name, body, place, position in zip(
            names, self.bodies, carriers, self.position, strict=True
        ):
            joint, point = weld(f"{name}_weld", body, name), bodies.com[place] + position
            welds.append(dataclasses.replace(joint, in_world=False, point_i=point))
        loaded = System(
            stacked, (*system.joints, *welds), system.forces, reference=extended(system.reference),
            allow_float32=system.allow_float32,
        )  # fmt: skip
        return dataclasses.replace(scene, system=loaded, state0=extended(scene.state0))

    def changes(self, loaded: System) -> list[tuple[float, System]]:
        """Times at which payloads are picked up or dropped, and the system from then on."""
        times = sorted({t for t in (*self.at, *self.until) if 0 < t < np.inf})
        inertia = lambda mass: mass[:, None, None] * _RADIUS**2 * jnp.eye(3)
        where = lambda s: (s.bodies.mass, s.bodies.inertia)

        def at(t: float) -> System:
            mass = self.masses_of_all(loaded.bodies.mass, jnp.asarray(t))
            moments = loaded.bodies.inertia.at[self._places].set(inertia(self.masses(t)))
            return eqx.tree_at(where, loaded, (mass, moments))

        return [(t, at(t)) for t in times]

    def without(self, state: State) -> State:
        """State of the machine without its payloads, for its controller."""
        keep = np.delete(np.arange(state.r.shape[0]), self._places)
        return State(*(x[keep] for x in _parts(state)))


def _parts(state: State) -> tuple[Array, ...]:
    return state.r, state.p, state.v, state.omega


class Unloaded(eqx.Module):
    """Function of a plant's true motion that returns the estimate for the controller of a loaded machine.

    Attributes:
        payloads: payloads of the machine. observe: what it sees of the machine without them, see `Plant`.
    """

    payloads: Payloads
    observe: eqx.Module | None

    def __call__(self, t: Float[Array, ""], state: State, internal: Float[Array, " z"]) -> State:
        unloaded = self.payloads.without(state)
        return unloaded if self.observe is None else self.observe(t, unloaded, internal)  # pyright: ignore[reportCallIssue]
