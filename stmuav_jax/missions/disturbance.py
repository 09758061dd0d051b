"""Disturbances of a mission: air that moves, and faults of rotors and sliders."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..control.adaptation.adaptive import AdaptiveController, AdaptiveMemory
from ..control.flying import FlightController, FlightMemory
from ..control.panel import panel_motion
from ..control.uav import UavController, UavReference
from ..environment.wind import Gusts
from ..mechanics.state import State
from ..tracker.geometry import TrackerGeometry
from ..tracker.kinematics import PairMotion, stroke_motion
from .reference import MissionReference, facing_motion

# Stiffness [N/m] and damping [N s/m] with which a jammed slider is held.
JAM = (2e4, 200.0)


class MissionWind(eqx.Module):
    """Velocity of the air, world (3,) [m/s]: steady wind or gusts, and a smooth change.

    Attributes:
        before: steady wind (3,), or gusts about it. change: added velocity (3,).
        at, rise: beginning and duration of the change [s].
    """

    before: Float[Array, "3"] | Gusts
    change: Float[Array, "3"]
    at: Float[Array, ""]
    rise: Float[Array, ""]

    def __call__(self, t: Float[Array, ""], kin: object = None) -> Float[Array, "3"]:
        before = self.before(t, kin) if callable(self.before) else self.before
        s = jnp.clip((t - self.at) / self.rise, 0.0, 1.0)
        return before + s**2 * (3 - 2 * s) * self.change


class Jam(eqx.Module):
    """Slider that is held, from a time [s] on, where it was.

    Attributes:
        geometry: lengths of the tracker. at: time of the fault of each slider (2,) [s], infinite
            for none.
    """

    geometry: TrackerGeometry
    at: Float[Array, "2"]

    def forces(
        self, t: Float[Array, ""], state: State, forces: Float[Array, "2"], held: Float[Array, "2"]
    ) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
        """Forces of the actuators [N], and the strokes at which sliders are held [m]."""
        now = stroke_motion(self.geometry, panel_motion(state))
        jammed = t >= self.at
        held = jnp.where(jammed & jnp.isfinite(held), held, jnp.where(jammed, now.value, jnp.inf))
        pull = JAM[0] * (jnp.where(jammed, held, now.value) - now.value) - JAM[1] * now.rate
        return jnp.where(jammed, pull, forces), held


Pilot = FlightController | UavController | AdaptiveController


class MissionMemory(NamedTuple):
    """Memory of a mission's controller.

    Attributes:
        flight: memory of the pilot.
        held: strokes of jammed sliders (2,) [m], infinite for others.
        asked: forces that the servo last asked of the actuators (2,) [N]; (0,) without a tracker.
    """

    flight: FlightMemory | AdaptiveMemory
    held: Float[Array, "2"]
    asked: Float[Array, " a"]


class Told(NamedTuple):
    """Controller that takes over at a time [s], because it is told of lost rotors."""

    at: Float[Array, ""]
    pilot: Pilot


class MissionController(eqx.Module):
    """Controller of a mission whose commands go through the limits of its actuators, and through its
    faults, of which it may be told.

    Attributes:
        pilot: controller of the machine. told: those that follow it, by rising times.
        lost: time at which each rotor fails (k,) [s], infinite for none.
        share: share of its thrust that it keeps (k,).
        jam: faults of the sliders, or None.
        force: largest force that each actuator gives, either way (2,) [N], infinite for no limit; (0,)
            without a tracker.
    """

    pilot: Pilot
    lost: Float[Array, " k"]
    share: Float[Array, " k"]
    jam: Jam | None
    force: Float[Array, " a"]
    told: tuple[Told, ...] = ()

    def start(self) -> MissionMemory:
        """First memory."""
        # not weakly typed, as no later memory is: a flight's program is compiled for one type
        held = jnp.full(2, jnp.inf, dtype=float)
        return MissionMemory(
            self.pilot.start(), held, jnp.zeros(jnp.shape(self.force), dtype=float)
        )

    def __call__(
        self, estimate: Any, reference: MissionReference, memory: MissionMemory
    ) -> tuple[Float[Array, " m"], MissionMemory]:
        """Inputs of the machine (m,), and the memory."""
        t, held = reference.t, memory.held
        inputs, after = _commanded(self.pilot, estimate, reference, memory.flight)
        for told in self.told:
            # the parts that all pilots share are compiled once
            own = _commanded(told.pilot, estimate, reference, memory.flight)
            inputs, after = jax.tree.map(
                lambda new, old, late=t >= told.at: jnp.where(late, new, old), own, (inputs, after)
            )
        k = self.lost.shape[0]
        rotors = jnp.where(t >= self.lost, self.share, 1.0) * inputs[:k]
        asked = inputs[k:]
        forces = jnp.clip(asked, -self.force, self.force)
        if self.jam is not None:
            forces, held = self.jam.forces(t, estimate, forces, held)
        return jnp.concatenate([rotors, forces]), MissionMemory(after, held, asked)


def _commanded(pilot: Any, estimate: Any, reference: MissionReference, memory: Any) -> Any:
    own = pilot.pilot if isinstance(pilot, AdaptiveController) else pilot
    if isinstance(own, FlightController):
        return pilot(estimate, reference.waypoint, memory)
    state = getattr(estimate, "state", estimate)
    return pilot(estimate, UavReference(reference.waypoint, wanted_panel(reference, state)), memory)


def wanted_panel(reference: MissionReference, state: State) -> PairMotion:
    """Wanted motion of the panel angles, at the base's attitude in a state."""
    wanted = reference.panel
    assert wanted is not None
    return wanted if isinstance(wanted, PairMotion) else facing_motion(wanted, state)
