"""Controller that adapts to a payload: a pilot that is told what a filter finds."""

from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...checks.errors import SettingError
from ..estimator import MotionEstimate
from ..flying import FlightController, FlightMemory
from ..uav import UavController
from .moments import bodies_carrying, carrier, carrying, moments, properties
from .payload_filter import PayloadFilter, PayloadMemory


class AdaptiveMemory(NamedTuple):
    """Memory of an `AdaptiveController`.

    Attributes:
        flight: memory of the pilot. payload: memory of the filter.
        centre: centre of mass that was fed forward, from the base's in its axes (3,) [m].
    """

    flight: FlightMemory
    payload: PayloadMemory
    centre: Float[Array, "3"]


class AdaptiveController(eqx.Module):
    """Pilot whose mass, centre of mass and inertia are those of the machine with an estimated payload.

    At each sample the filter is carried on by what the rotors were last told, and the mass properties
    with its payload, at the estimated posture, go to the pilot: to its thrust and moments, to the
    allocation, and to the servo of a panel.

    Args:
        pilot: controller of the rotors, or of a UAV with its tracker; it believes the machine without
            payload.
        filter: filter of the payload, for the same machine.

    Raises:
        SettingError: a `UavController` without feedforward; at the first call, an estimate that is no
            `MotionEstimate` of the filter's machine.
    """

    pilot: FlightController | UavController
    filter: PayloadFilter

    def __check_init__(self) -> None:
        if isinstance(self.pilot, UavController) and not self.pilot.feedforward:
            raise SettingError(
                "A payload is fed forward with the moving tracker: it needs a UavController with its "
                "feedforward."
            )

    def start(self) -> AdaptiveMemory:
        """First memory."""
        return AdaptiveMemory(self.pilot.start(), self.filter.start(), jnp.zeros(3))

    def __call__(
        self, estimate: Any, reference: Any, memory: AdaptiveMemory
    ) -> tuple[Float[Array, " m"], AdaptiveMemory]:
        """Inputs of the pilot (m,), and the memory."""
        state = self._state(estimate)
        about, on = moments(self.filter.system, state), carrier(state)
        found = self.filter.updated(estimate, about, on, memory.payload)
        payload = self.filter.payload(found)
        mass, pilot = properties(carrying(about, on, payload)), self.pilot
        if isinstance(pilot, UavController):
            bodies = bodies_carrying(pilot.servo.bodies, payload)
            servo = eqx.tree_at(lambda s: s.bodies, pilot.servo, bodies)
            inputs, flight = pilot.command(state, reference, memory.flight, mass, servo)
        else:
            inputs, flight = pilot.command(state, reference, memory.flight, mass)
        sent = self.filter.sent(found, inputs[: found.sent.shape[1]])
        return inputs, AdaptiveMemory(flight, sent, mass.centre)

    def _state(self, estimate: Any) -> Any:
        if not isinstance(estimate, MotionEstimate):
            raise SettingError(
                "A payload is estimated from a MotionEstimate, whose accelerometer and gyroscope it needs, "
                f"but the estimate is of the kind {type(estimate).__name__}."
            )
        has, needs = estimate.state.r.shape[0], len(self.filter.system.names)
        if has != needs:
            raise SettingError(
                f"The payload's filter is of a machine of {needs} bodies, but the estimate has {has}."
            )
        return estimate.state
