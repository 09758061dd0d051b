"""Controller of the UAV with its tracker: rotors and sliders together."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System
from ..tracker.kinematics import PairMotion
from .estimator import MotionEstimate, state_of
from .flying import FlightController, FlightMemory, mass_properties
from .geometric import MassProperties, Waypoint
from .panel import PanelServo, StrokeServo, facing, panel_motion


class UavReference(NamedTuple):
    """Reference of a `UavController`.

    Attributes:
        waypoint: wanted motion of the base.
        panel: wanted panel angles in the base's axes, with rates and accelerations; or the
            direction (3,) in the world that the panel is to face.
    """

    waypoint: Waypoint
    panel: PairMotion | Float[Array, "3"]


class UavController(eqx.Module):
    """Controller of the scene `uav_tracker`: six rotors first, then the forces of two sliders.

    The estimate is the `State` of all bodies, or a `MotionEstimate`. Centre of mass, inertia and
    angular momentum of the moving tracker are fed forward to the rotors, as is the moment that its servo takes.

    Attributes:
        system: machine whose masses the controller believes.
        flight: controller of the rotors. servo: servo of the panel.
        feedforward: false for a controller that takes the tracker for a rigid part in the reference
            posture.
    """

    system: System
    flight: FlightController
    servo: PanelServo | StrokeServo
    feedforward: bool = eqx.field(static=True, default=True)

    def start(self) -> FlightMemory:
        """First memory."""
        return self.flight.start()

    def __call__(
        self, estimate: State | MotionEstimate, reference: UavReference, memory: FlightMemory
    ) -> tuple[Float[Array, " m"], FlightMemory]:
        """Inputs (k + 2,): squared rotor speeds [rad^2/s^2] and forces [N]; and the memory."""
        state: State = state_of(estimate)
        own = self.flight.mass
        assert isinstance(own, MassProperties)
        mass = mass_properties(self.system, state) if self.feedforward else own
        return self.command(state, reference, memory, mass, self.servo)

    def command(
        self,
        state: State,
        reference: UavReference,
        memory: FlightMemory,
        mass: MassProperties,
        servo: PanelServo | StrokeServo,
    ) -> tuple[Float[Array, " m"], FlightMemory]:
        """Inputs (k + 2,) and the memory, with given mass properties and a given servo."""
        flight, at = self.flight, reference.waypoint
        gravity_b = rotation_matrix(state.p[0]).T @ (flight.gravity - at.a)
        wanted = reference.panel
        if not isinstance(wanted, PairMotion):
            wanted = facing(jnp.asarray(wanted), state)
        moved = servo.command(panel_motion(state), wanted, gravity_b, mass.centre)
        if self.feedforward:
            mass = mass._replace(moment=moved.moment)
        squared, after = flight.command(state, at, memory, mass)
        return jnp.concatenate([squared, moved.forces]), after
