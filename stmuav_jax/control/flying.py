"""Controller of a flying machine's rotors: the geometric controller with control allocation."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra import lapack
from ..algebra.compiler import quick_jit
from ..checks.errors import ModelError
from ..checks.numbers import array_module, as_numpy, floats
from ..flight.mass_properties import centre_of_mass, inertia_about_centre, inner_momentum
from ..mechanics.forces.contact import GroundContact
from ..mechanics.state import State
from ..mechanics.system import System
from ..rotorcraft.allocation import RotorLimits, check_lift, wrench_map
from ..rotorcraft.motor import MotorRotors
from ..rotorcraft.rotor import Rotors
from ..sensing.sensors import gravity_of
from .estimator import state_of
from .geometric import (
    BaseMotion,
    FlightGains,
    MassProperties,
    Waypoint,
    base_motion,
    wrench_for,
)
from .outage import as_it_turns, inverse_without_yaw, working_rotors


class FlightMemory(NamedTuple):
    """Memory of a `FlightController`.

    Attributes:
        integral: integral of the position error (3,) [m s].
    """

    integral: Float[Array, "3"]


class Feet(eqx.Module):
    """Feet of the base of a machine, as its controller knows them.

    Attributes:
        places: from the base's centre of mass, its axes (k, 3) [m].
        ground: heights of the ground under them, world (k,) [m].
    """

    places: Float[Array, "k 3"]
    ground: Float[Array, " k"]

    def touches(self, base: BaseMotion) -> Bool[Array, ""]:
        """True if a foot is below the ground's height."""
        return jnp.any(base.r[2] + self.places @ base.R[2] < self.ground)


class FlightController(eqx.Module):
    """Controller of the rotors: position and heading of the machine's base follow a `Waypoint`.

    The estimate is a `State` of all bodies, a `MotionEstimate`, or the `BaseMotion` of the base; the
    reference is a `Waypoint`, the memory a `FlightMemory`. While the rotors cannot give the wanted wrench, and
    while a foot of the base's landing gear (`GroundContact`) is below the ground's height by the estimate, the
    integral of the position error stands still.

    Args:
        system: machine with one set of rotors and with gravity.
        rate: control rate [Hz], for the integral.
        gains: gains of the controller.
        limits: limits of the rotor speeds; by default those of the machine's motors, if any.
        mass: mass properties of all bodies, or a function of the estimate that returns them; by
            default those of the system's reference posture.
        lost: numbers of rotors that are lost, the first being 1. The controller then gives up
            yaw: thrust and tilt are allocated to the working rotors first, and with what is left
            of their limits, which it needs, the turning about the base's z axis is slowed down.

    Raises:
        ModelError: not one set of rotors, no gravity, limits that cannot carry the weight, or lost
            rotors without which the others cannot hold thrust and tilt.
    """

    gains: FlightGains
    mass: MassProperties | Callable[[Any], MassProperties]
    gravity: Float[Array, "3"]
    wrenches: Float[Array, "4 k"]
    inverse: Float[Array, "k 4"]
    limits: RotorLimits | None
    period: Float[Array, ""]
    feet: Feet | None
    working: tuple[int, ...] | None = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        *,
        gains: FlightGains | None = None,
        limits: RotorLimits | None = None,
        mass: MassProperties | Callable[[Any], MassProperties] | None = None,
        lost: Sequence[int] = (),
    ) -> None:
        found = [f for f in system.forces if isinstance(f, Rotors | MotorRotors)]
        self.gravity = gravity_of(system)
        if len(found) != 1 or not np.any(as_numpy(self.gravity) != 0):
            raise ModelError(
                "A flight controller needs one set of rotors and gravity, but the system has "
                f"{len(found)} sets and gravity of {jnp.asarray(self.gravity).tolist()} m/s^2."
            )
        motors = found[0]
        if system.index(_rotors(motors).body) != 0:
            raise ModelError(
                f"A flight controller needs its rotors on the first body, '{system.names[0]}', but they "
                f"are on '{_rotors(motors).body}'."
            )
        rotors = _rotors(motors)
        own = getattr(motors, "squared_limits", None)
        if limits is None and own is not None:
            limits = RotorLimits(jnp.sqrt(own[0]), jnp.sqrt(own[1]))
        mass_of_all, g = as_numpy((system.bodies.mass, self.gravity))
        xp = array_module(mass_of_all, g)
        weight = floats(xp.sum(mass_of_all) * xp.linalg.norm(g))
        if limits is not None:
            check_lift(rotors, limits, weight)
        # moments are about the base's centre of mass: the map does not change with the posture
        self.wrenches = wrench_map(rotors, system.bodies.com[0])
        self.working = working_rotors(lost, rotors.spin.shape[0])
        if self.working is None:
            self.inverse = _pseudoinverse(self.wrenches)
            if not np.all(np.asarray(self.inverse)[:, 0] > 0):
                raise ModelError(
                    "Not every rotor adds to the thrust where its moments balance: the base's centre "
                    "of mass is too far from the rotors' middle for this flight controller."
                )
        else:
            self.inverse = inverse_without_yaw(self.wrenches, self.working, limits, weight)
        self.gains = FlightGains() if gains is None else gains
        self.limits, self.period = limits, floats(1.0 / rate)
        self.mass = mass_properties(system, system.reference) if mass is None else mass
        self.feet = feet_of(system)

    def start(self) -> FlightMemory:
        """First memory."""
        return FlightMemory(jnp.zeros(3))

    def __call__(
        self, estimate: Any, reference: Waypoint, memory: FlightMemory
    ) -> tuple[Float[Array, " k"], FlightMemory]:
        """Squared rotor speeds (k,) [rad^2/s^2], and the memory."""
        estimate = state_of(estimate)
        mass = self.mass(estimate) if callable(self.mass) else self.mass
        return self.command(estimate, reference, memory, mass)

    def command(
        self, estimate: Any, reference: Waypoint, memory: FlightMemory, mass: MassProperties
    ) -> tuple[Float[Array, " k"], FlightMemory]:
        """Squared rotor speeds (k,) and the memory, with given mass properties."""
        base = base_motion(estimate) if isinstance(estimate, State) else estimate
        wanted = reference if self.working is None else as_it_turns(reference, base)
        found = wrench_for(base, wanted, mass, self.gains, self.gravity, memory.integral)
        lever = jnp.cross(mass.centre, jnp.array([0.0, 0.0, 1.0]) * found.wrench[0])
        wrench = found.wrench.at[1:].add(lever)
        if self.working is None:
            squared, given = self._allocated(wrench)
        else:
            wrench = wrench.at[3].add(-self.gains.rate * mass.J[2, 2] * base.omega[2])
            squared, given = self._allocated_to_working(wrench)
        error = base.r - reference.r
        if self.feet is not None:
            given = given & ~self.feet.touches(base)
        integral = memory.integral + jnp.where(given, self.period, 0.0) * error
        return squared, FlightMemory(integral)

    def _allocated(self, wrench: Float[Array, "4"]) -> tuple[Float[Array, " k"], Array]:
        """Squared speeds, and whether they give the wrench."""
        least = self.inverse @ wrench
        if self.limits is None:
            return least, jnp.ones((), bool)
        lower, upper = self.limits.squared(least.shape[0])
        return within_limits(self.inverse, wrench, lower, upper)

    def _allocated_to_working(self, wrench: Float[Array, "4"]) -> tuple[Float[Array, " k"], Array]:
        """Squared speeds, those of lost rotors zero, and whether they give thrust and tilt."""
        assert self.limits is not None
        places, count = jnp.array(self.working), self.wrenches.shape[1]
        lower, upper = (x[places] for x in self.limits.squared(count))
        u, given = _lifted(self.inverse, wrench, lower, upper)
        # yaw is what the others leave of it, and is changed where the limits still allow it
        turn = self.inverse[:, 3] * (wrench[3] - self.wrenches[3, places] @ u)
        b = _share(jnp.abs(turn), jnp.where(turn > 0, upper - u, u - lower))
        return jnp.zeros(count).at[places].set(u + b * turn), given


def within_limits(
    inverse: Float[Array, "k 4"],
    wrench: Float[Array, "4"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """Squared rotor speeds within limits, and whether they give the wrench.

    Minimum-norm speeds where these are within the limits. Otherwise, in this order: the largest
    share of the tilting moment that some thrust allows, the thrust nearest to the wanted one, and
    the largest share of the turning moment. `rotorcraft.allocate` also finds the other speeds that
    give a wrench; this takes no search, and next to no time.

    Args:
        inverse: minimum-norm squared speeds per unit of the wrench; those of thrust positive.
        lower, upper: limits (k,) [rad^2/s^2].
    """
    u, held = _lifted(inverse, wrench, lower, upper)
    turn = inverse[:, 3] * wrench[3]
    b = _share(jnp.abs(turn), jnp.where(turn > 0, upper - u, u - lower))
    return u + b * turn, held & (b == 1.0)


def _lifted(
    inverse: Float[Array, "k 4"],
    wrench: Float[Array, "4"],
    lower: Float[Array, " k"],
    upper: Float[Array, " k"],
) -> tuple[Float[Array, " k"], Bool[Array, ""]]:
    """Squared speeds for thrust and tilting moments, and whether they give these."""
    lift, tilt = inverse[:, 0], inverse[:, 1:3] @ wrench[1:3]
    # lower_i <= lift_i T + a tilt_i <= upper_i has a solution T where, for all i and j,
    #   a (tilt_j / lift_j - tilt_i / lift_i) <= upper_j / lift_j - lower_i / lift_i
    slope = tilt / lift
    rise = slope[None, :] - slope[:, None]
    room = (upper / lift)[None, :] - (lower / lift)[:, None]
    a = _share(rise, room)
    least, most = jnp.max((lower - a * tilt) / lift), jnp.min((upper - a * tilt) / lift)
    thrust = jnp.minimum(jnp.maximum(wrench[0], least), most)
    return lift * thrust + a * tilt, (a == 1.0) & (thrust == wrench[0])


def _share(rise: Float[Array, "*s"], room: Float[Array, "*s"]) -> Float[Array, ""]:
    """Largest share a in [0, 1] with a rise <= room everywhere; NaN stays NaN."""
    limited = rise > jnp.maximum(room, 0.0)
    shares = jnp.where(limited, jnp.maximum(room, 0.0) / jnp.where(limited, rise, 1.0), 1.0)
    return jnp.min(shares) + 0.0 * jnp.sum(rise)


def feet_of(system: System) -> Feet | None:
    """Feet of the ground contacts of a system's first body; None without any."""
    own = [f for f in system.forces if isinstance(f, GroundContact) and system.index(f.body) == 0]
    if not own:
        return None
    heights = [jnp.full(len(f.feet), f.height) for f in own]
    places = jnp.concatenate([f.feet - system.bodies.com[0] for f in own])
    return Feet(places, jnp.concatenate(heights))


def _rotors(force: Rotors | MotorRotors) -> Rotors:
    return force.rotors if isinstance(force, MotorRotors) else force


@quick_jit
def _pseudoinverse(wrenches: Float[Array, "4 k"]) -> Float[Array, "k 4"]:
    return lapack.pseudoinverse(wrenches, 1e-14)


@quick_jit
def mass_properties(
    system: System, state: State, moment: Float[Array, "3"] | None = None
) -> MassProperties:
    """Mass properties of all bodies at a state; the first body is the base.

    Args:
        moment: moment that accelerates the other parts against the base (3,) [N m], by default zero.
    """
    return MassProperties(
        jnp.sum(system.bodies.mass),
        centre_of_mass(system, state),
        inertia_about_centre(system, state),
        inner_momentum(system, state),
        jnp.zeros(3) if moment is None else moment,
    )
