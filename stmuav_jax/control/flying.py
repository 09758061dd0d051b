"""Controller of a flying machine's rotors: the geometric controller with control allocation."""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import ModelError
from ..mechanics.state import State
from ..mechanics.system import System
from ..rotorcraft.allocation import RotorLimits, allocate, check_lift, wrench_map
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors
from ..sensing.sensors import gravity_of
from .geometric import (
    BaseMotion,
    FlightGains,
    MassProperties,
    WantedWrench,
    Waypoint,
    base_motion,
    wrench_for,
)

# Weights of thrust and three moments where the limits do not allow all: yaw is given up first.
_PRIORITY = (1.0, 1.0, 1.0, 0.01)


class FlightMemory(NamedTuple):
    """Memory of a `FlightController`.

    Attributes:
        integral: integral of the position error (3,) [m s].
    """

    integral: Float[Array, "3"]


class FlightController(eqx.Module):
    """Controller of the rotors: position and heading of the machine's base follow a `Waypoint`.

    The estimate is a `State` of all bodies, or the `BaseMotion` of the base; the reference is a
    `Waypoint`, the memory a `FlightMemory`. While the rotors cannot give the wanted wrench, the
    integral of the position error stands still.

    Args:
        system: machine with one set of rotors and with gravity.
        rate: control rate [Hz], for the integral.
        gains: gains of the controller.
        limits: limits of the rotor speeds; by default those of the machine's motors, if any.
        mass: mass properties of all bodies, or a function of the estimate that returns them; by
            default those of the system's reference posture.

    Raises:
        ModelError: not one set of rotors, no gravity, or limits that cannot carry the weight.
    """

    gains: FlightGains
    mass: MassProperties | Callable[[Any], MassProperties]
    gravity: Float[Array, "3"]
    wrenches: Float[Array, "4 k"]
    inverse: Float[Array, "k 4"]
    limits: RotorLimits | None
    period: Float[Array, ""]
    body: int = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        *,
        gains: FlightGains | None = None,
        limits: RotorLimits | None = None,
        mass: MassProperties | Callable[[Any], MassProperties] | None = None,
    ) -> None:
        found = [f for f in system.forces if isinstance(f, Rotors | MotorRotors)]
        self.gravity = gravity_of(system)
        if len(found) != 1 or not bool(jnp.any(self.gravity != 0)):
            raise ModelError(
                "A flight controller needs one set of rotors and gravity, but the system has "
                f"{len(found)} sets and gravity of {jnp.asarray(self.gravity).tolist()} m/s^2."
            )
        motors = found[0]
        rotors = motors.rotors if isinstance(motors, MotorRotors) else motors
        own = getattr(motors, "squared_limits", None)
        if limits is None and own is not None:
            limits = RotorLimits(jnp.sqrt(own[0]), jnp.sqrt(own[1]))
        weight = jnp.sum(system.bodies.mass) * jnp.linalg.norm(self.gravity)
        if limits is not None:
            check_lift(rotors, limits, weight)
        self.body = system.index(rotors.body)
        # moments are about the base's centre of mass: the map does not change with the posture
        self.wrenches = wrench_map(rotors, system.bodies.com[self.body])
        self.inverse = jnp.linalg.pinv(self.wrenches)
        self.gains = FlightGains() if gains is None else gains
        self.limits, self.period = limits, jnp.asarray(1.0 / rate)
        self.mass = rigid(system, system.reference, self.body) if mass is None else mass

    def start(self) -> FlightMemory:
        """First memory."""
        return FlightMemory(jnp.zeros(3))

    def wanted(self, estimate: Any, reference: Waypoint, memory: FlightMemory) -> WantedWrench:
        """Wrench about the centre of mass of the whole machine."""
        base = self._base(estimate)
        mass = self.mass(estimate) if callable(self.mass) else self.mass
        return wrench_for(base, reference, mass, self.gains, self.gravity, memory.integral)

    def __call__(
        self, estimate: Any, reference: Waypoint, memory: FlightMemory
    ) -> tuple[Float[Array, " k"], FlightMemory]:
        """Squared rotor speeds (k,) [rad^2/s^2], and the memory."""
        base = self._base(estimate)
        mass = self.mass(estimate) if callable(self.mass) else self.mass
        found = wrench_for(base, reference, mass, self.gains, self.gravity, memory.integral)
        lever = jnp.cross(mass.centre, jnp.array([0.0, 0.0, 1.0]) * found.wrench[0])
        wrench = found.wrench.at[1:].add(lever)
        squared, given = self._allocated(wrench)
        error = base.r - reference.r
        integral = memory.integral + jnp.where(given, self.period, 0.0) * error
        return squared, FlightMemory(integral)

    def _base(self, estimate: Any) -> BaseMotion:
        return base_motion(estimate, self.body) if isinstance(estimate, State) else estimate

    def _allocated(self, wrench: Float[Array, "4"]) -> tuple[Float[Array, " k"], Array]:
        """Squared speeds, and whether they give the wrench."""
        least = self.inverse @ wrench
        limits = self.limits
        if limits is None:
            return least, jnp.ones((), bool)
        lower, upper = limits.squared(least.shape[0])
        inside = jnp.all((least >= lower) & (least <= upper))

        def at_limits() -> tuple[Array, Array]:
            # a wrench that is not finite has no allocation, and stays what it is
            finite = jnp.where(jnp.all(jnp.isfinite(wrench)), 1.0, jnp.nan)
            found = allocate(
                self.wrenches, jnp.nan_to_num(wrench), limits, priority=_PRIORITY
            )
            return finite * found.squared, found.reason == 0

        # the search by active sets takes much longer than the rest, and is rarely needed
        return jax.lax.cond(inside, lambda: (least, jnp.ones((), bool)), at_limits)


def rigid(system: System, state: State, body: int = 0) -> MassProperties:
    """Mass properties of all bodies at a state, parts at rest against the base, body `body`."""
    mass = system.bodies.mass
    R_0w = base_motion(state, body).R.T
    arms = (state.r - system.com(state)) @ R_0w.T
    R = jnp.einsum("ij,njk->nik", R_0w, jax.vmap(lambda k: base_motion(state, k).R)(jnp.arange(len(mass))))
    own = jnp.einsum("nij,njk,nlk->il", R, system.bodies.inertia, R)
    square = jnp.sum(mass * jnp.sum(arms**2, axis=1))
    J = own + square * jnp.eye(3) - jnp.einsum("n,ni,nj->ij", mass, arms, arms)
    zero = jnp.zeros(3)
    return MassProperties(jnp.sum(mass), R_0w @ (system.com(state) - state.r[body]), J, zero, zero)
