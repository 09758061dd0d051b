"""Trim: attitude, rotor speeds and actuator forces of steady flight.

Unknowns z = (roll, pitch, thrust, three moments, two actuator forces); the rotors' squared
speeds are those of least norm that give thrust and moments about the centre of mass, or those
within limits. The residuals are the accelerations of all eight degrees of freedom, less those
of the wanted flight: as many equations as unknowns. They are nearly linear in z.

In a steady turn everything revolves about the vertical at the wanted rate: omega is constant in
the base's axes, and the base's acceleration is rate z x v. Where the panel points at the sun its
angles follow from the attitude.

Derivatives are those of the implicit function: with r(z, q) = 0, dz/dq = -r_z^-1 r_q.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ..algebra.compiler import kept_jit
from ..algebra.rotation import product, rotation_matrix
from ..dynamics.tree import TreeModel
from ..mechanics.errors import ModelError, StateError, check_finite, concrete
from ..mechanics.force import Gravity
from ..mechanics.reason import first_reason
from ..vehicle.allocation import (
    AllocationReason,
    RotorLimits,
    allocate,
    check_lift,
    least,
    wrench_map,
)
from ..vehicle.flyer import Coordinates, Flyer, Inputs
from ..vehicle.geometry import close_loops, turn_by_angles
from ..vehicle.kinematics import panel_angles, parallel_margin, strokes
from ..vehicle.motor import MotorRotors
from ..vehicle.placement import turn_about
from .newton import Newton

# Largest residual that counts as a trim [m/s^2], [rad/s^2].
TOLERANCE = 1e-10
_MOST_STEPS = 30


class TrimReason(IntEnum):
    """Why there is no trim; the first that applies."""

    VALID = 0
    POSTURE = 1
    NOT_CONVERGED = 2
    ROTOR_STOPPED = 3
    ROTOR_LIMIT = 4
    ACTUATOR_LIMIT = 5
    ROTOR_MOMENTUM = 6


class Wanted(NamedTuple):
    """A steady flight; see `hover`, `climb`, `cruise` and `steady_turn`.

    Attributes:
        angles: of the panel (2,) [rad], or None where it points at the sun.
        sun: direction to it, world (3,), or None.
        yaw: heading [rad]. v: velocity of the base, world (3,) [m/s].
        rate: of turn about the vertical [rad/s].
        acceleration: of the base beside that of the turn, world (3,) [m/s^2].
    """

    angles: Float[Array, "2"] | None
    sun: Float[Array, "3"] | None
    yaw: Float[Array, ""]
    v: Float[Array, "3"]
    rate: Float[Array, ""]
    acceleration: Float[Array, "3"]


class TrimLimits(NamedTuple):
    """rotors: of their speeds, or None. actuator: largest force either way [N]."""

    rotors: RotorLimits | None = None
    actuator: Float[Array, ""] | float = jnp.inf


class Trim(eqx.Module):
    """A trim, or why there is none.

    Attributes:
        coordinates: at the trim, the base at the origin; attitude and angles found.
        inputs: found. speeds: of the rotors (k,) [rad/s]; all NaN where there is no trim,
            whatever the reason.
        residual: largest acceleration left [m/s^2] or [rad/s^2].
        conditioning: smallest over largest singular value of the equations, in units of a
            radian, the weight, and the weight times a metre: near zero, other trims lie near.
        choices: dimensions left to the rotors' speeds by thrust and moments.
        reason: a code of `TrimReason`. steps: of Newton's method.
    """

    coordinates: Coordinates
    inputs: Inputs
    speeds: Float[Array, " k"]
    residual: Float[Array, ""]
    conditioning: Float[Array, ""]
    reason: Int[Array, ""]
    steps: Int[Array, ""]

    @property
    def choices(self) -> int:
        return self.speeds.shape[-1] - 4


def hover(angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> Wanted:
    """Standing still with the panel at angles (2,) [rad], or at the sun (3,), world."""
    return _flight(angles, sun, yaw, jnp.zeros(3), 0.0)


def climb(speed: Any, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> Wanted:
    """Straight up at a speed [m/s]; negative for a descent."""
    return _flight(angles, sun, yaw, jnp.asarray(speed, dtype=float) * _UP, 0.0)


def cruise(
    speed: Any, course: Any = 0.0, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None
) -> Wanted:
    """Level flight at a speed [m/s] towards a course from x to y [rad]."""
    course = jnp.asarray(course, dtype=float)
    along = jnp.stack([jnp.cos(course), jnp.sin(course), jnp.zeros_like(course)])
    return _flight(angles, sun, yaw, jnp.asarray(speed, dtype=float) * along, 0.0)


def steady_turn(speed: Any, rate: Any, angles: Any, course: Any = 0.0, yaw: Any = 0.0) -> Wanted:
    """A level turn at a speed [m/s] and a rate [rad/s], positive from x to y; at its start."""
    straight = cruise(speed, course, angles, yaw)
    check_finite(rate, "The rate of turn", "rad/s")
    return straight._replace(rate=jnp.asarray(rate, dtype=float))


_UP = np.array([0.0, 0.0, 1.0])


def _flight(angles: Any, sun: Any, yaw: Any, v: Array, rate: Any) -> Wanted:
    if (angles is None) == (sun is None):
        raise ModelError(
            "A flight needs either the panel's angles or the direction to the sun, and not both."
        )
    for value, what, unit in (
        (angles, "The panel's angles", "rad"), (sun, "The direction to the sun", ""),
        (yaw, "The heading", "rad"), (v, "The velocity", "m/s"),
    ):  # fmt: skip
        if value is not None:
            check_finite(value, what, unit)
    number = lambda x: jnp.asarray(x, dtype=float)
    angles = None if angles is None else number(angles)
    sun = None if sun is None else number(sun)
    for value, size, what in ((angles, 2, "panel's angles are"), (sun, 3, "sun's direction has")):
        if value is not None and value.shape != (size,):
            raise ModelError(f"The {what} {size} numbers, not an array of shape {value.shape}.")
    if sun is not None and concrete(sun) and not float(jnp.linalg.norm(sun)) > 0:
        raise ModelError("The direction to the sun must not be zero.")
    return Wanted(angles, sun, number(yaw), v, number(rate), jnp.zeros(3))


def _attitude(tilt: Float[Array, "2"], yaw: Float[Array, ""]) -> Float[Array, "4"]:
    """Euler parameters of R_z(yaw) R_y(pitch) R_x(roll), tilt = (roll, pitch)."""
    return product(turn_about(yaw, 2), product(turn_about(tilt[1], 1), turn_about(tilt[0], 0)))


class _Setting(NamedTuple):
    flyer: Flyer
    model: TreeModel
    wanted: Wanted


def _point(tilt: Float[Array, "2"], wanted: Wanted) -> Coordinates:
    p = _attitude(tilt, wanted.yaw)
    R_wb = rotation_matrix(p)
    angles = wanted.angles
    if angles is None:
        assert wanted.sun is not None
        angles = panel_angles(R_wb.T @ wanted.sun)
    omega = wanted.rate * R_wb[2]
    return Coordinates(jnp.zeros(3), p, angles, wanted.v, omega, jnp.zeros(2))


def _map(flyer: Flyer, at: Coordinates) -> Float[Array, "4 k"]:
    """B about the system's centre of mass, in the base's axes: thrust and moments do not mix."""
    com = rotation_matrix(at.p).T @ flyer.system.com(flyer.state(at))
    return wrench_map(flyer.propellers, com)


def _left(at: Coordinates, inputs: Inputs, setting: _Setting) -> Float[Array, "8"]:
    wanted = setting.wanted
    found = setting.flyer.accelerations(at, inputs, model=setting.model)
    x, y, _ = wanted.v
    round_the_turn = wanted.rate * jnp.stack([-y, x, jnp.zeros_like(x)])
    return jnp.concatenate(
        [found.v - round_the_turn - wanted.acceleration, found.omega, found.angles]
    )


def _residual(z: Float[Array, "8"], setting: _Setting) -> Float[Array, "8"]:
    at = _point(z[:2], setting.wanted)
    squared = least(_map(setting.flyer, at), z[2:6])
    return _left(at, Inputs(squared, z[6:]), setting)


def residual(flyer: Flyer, wanted: Wanted, z: Float[Array, "8"]) -> Float[Array, "8"]:
    """What `trim` makes zero: accelerations less those wanted, at unknowns z (8,)."""
    return _residual(z, _Setting(flyer, flyer.model(), wanted))


def trim(
    flyer: Flyer, wanted: Wanted, limits: TrimLimits | None = None, *, throw: bool = True
) -> Trim:
    """Attitude, rotor speeds and actuator forces of a steady flight.

    Pure: may be jitted, vmapped over anything, and differentiated by everything.

    Args:
        wanted: see `hover`, `climb`, `cruise` and `steady_turn`.
        limits: of rotors and actuators; by default those of the motors, if there are any.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: no trim; says why, with the quantity and its limit.
        ModelError: limits that make no sense, or within which the rotors cannot carry the weight.
    """
    limits = TrimLimits() if limits is None else limits
    if limits.rotors is None and isinstance(flyer.propulsion, MotorRotors):
        limits = limits._replace(rotors=flyer.propulsion.limits)
    flyer = flyer.steady()
    if limits.rotors is not None:
        limits.rotors.squared(flyer.propellers.spin.shape[0])
        if throw:
            check_lift(flyer.propellers, limits.rotors, _weight(flyer))
    # as arrays, so that other limits do not mean another compilation
    bounds: Any = jax.tree.map(lambda x: jnp.asarray(x, dtype=float), limits)
    found = _found(_Setting(flyer, flyer.model(), wanted), bounds)
    if throw and concrete(found.reason):
        _raise(TrimReason(int(found.reason)), found, limits)
    fine = found.reason == TrimReason.VALID
    keep = lambda tree: jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), tree)
    at, inputs, speeds = keep((found.coordinates, found.inputs, found.speeds))
    return Trim(at, inputs, speeds, found.residual, found.conditioning, found.reason, found.steps)


def _weight(flyer: Flyer) -> Float[Array, ""]:
    mass = jnp.sum(flyer.system.bodies.mass)
    pull = [f.acceleration for f in flyer.system.forces if isinstance(f, Gravity)]
    return mass * jnp.linalg.norm(jnp.asarray(pull[0])) if pull else jnp.zeros(())


@kept_jit
def _found(setting: _Setting, limits: TrimLimits) -> Trim:
    """What Newton's method arrives at, whether it is a trim or not."""
    flyer = setting.flyer
    weight = _weight(flyer)
    start = jnp.zeros(8).at[2].set(weight)
    solution = optx.root_find(
        _residual,
        Newton(atol=0.1 * TOLERANCE),
        start,
        args=setting,
        max_steps=_MOST_STEPS,
        throw=False,
    )
    z, last = solution.value, jax.lax.stop_gradient(solution.state)
    # in units of a radian, the weight, and the weight times a metre
    sizes = jnp.where(jnp.arange(8) < 2, 1.0, jax.lax.stop_gradient(weight))
    values = jnp.linalg.svd(last.J * sizes, compute_uv=False)
    at = _point(z[:2], setting.wanted)
    B = _map(flyer, at)
    squared = least(B, z[2:6])
    missed = jnp.zeros((), bool)
    if limits.rotors is not None:
        # the same wrench, so the same accelerations
        given = allocate(B, z[2:6], limits.rotors)
        squared, missed = given.squared, given.reason != AllocationReason.VALID
    inputs, left = Inputs(squared, z[6:]), last.size
    spun = jnp.zeros((), bool)
    if limits.rotors is not None and isinstance(flyer.propulsion, MotorRotors):
        # ... unless the speeds have a momentum of their own
        again = jnp.max(jnp.abs(jax.lax.stop_gradient(_left(at, inputs, setting))))
        spun, left = (left <= TOLERANCE) & ~(again <= TOLERANCE), jnp.maximum(left, again)
    reason = first_reason(
        (~(_margin(flyer, at.angles) > 0), TrimReason.POSTURE),
        (missed, TrimReason.ROTOR_LIMIT),
        (spun, TrimReason.ROTOR_MOMENTUM),
        (~(left <= TOLERANCE), TrimReason.NOT_CONVERGED),
        (jnp.min(squared) < 0, TrimReason.ROTOR_STOPPED),
        (jnp.max(jnp.abs(inputs.forces)) > limits.actuator, TrimReason.ACTUATOR_LIMIT),
    )
    turning = squared > 0
    speeds = jnp.where(turning, jnp.sqrt(jnp.where(turning, squared, 1.0)), 0.0)
    steps = solution.stats["num_steps"]
    return Trim(at, inputs, speeds, left, values[-1] / values[0], reason, steps)


def _margin(flyer: Flyer, angles: Float[Array, "2"]) -> Float[Array, ""]:
    """Positive where the tracker can take, and its sliders hold, the panel's angles."""
    turned = turn_by_angles(angles)
    loops = close_loops(flyer.geometry, turned)
    reached = jnp.sum(strokes(flyer.geometry, angles))
    return jnp.where(jnp.isfinite(reached), parallel_margin(flyer.geometry, turned, loops), -1.0)


def _raise(reason: TrimReason, found: Trim, limits: TrimLimits) -> None:
    if reason is TrimReason.VALID:
        return
    angles = ", ".join(f"{float(a):.4g}" for a in found.coordinates.angles)
    strongest = float(jnp.max(jnp.abs(found.inputs.forces)))
    words = {
        TrimReason.POSTURE: f"the tracker cannot take the panel angles ({angles}) rad",
        TrimReason.NOT_CONVERGED: (
            f"Newton's method has stopped with accelerations of {float(found.residual):.3g} left "
            f"(tolerance {TOLERANCE:.0e})"
        ),
        TrimReason.ROTOR_STOPPED: "a rotor would have to push downwards",
        TrimReason.ROTOR_LIMIT: (
            "the rotors cannot give the thrust and moments that it needs within their limits of "
            f"{_span(limits.rotors)} rad/s"
        ),
        TrimReason.ROTOR_MOMENTUM: (
            "within the rotors' limits their angular momentum is another than without, and leaves "
            f"accelerations of {float(found.residual):.3g} in the turn"
        ),
        TrimReason.ACTUATOR_LIMIT: (
            f"an actuator would have to push with {strongest:.4g} N, but the limit is "
            f"{float(limits.actuator):.4g} N"
        ),
    }
    raise StateError(f"There is no such trim: {words[reason]}.")


def _span(limits: RotorLimits | None) -> str:
    if limits is None:
        return "any"
    low, high = (jnp.asarray(x, dtype=float) for x in (limits.lowest, limits.highest))
    return f"{float(jnp.min(low)):g} to {float(jnp.max(high)):g}"
