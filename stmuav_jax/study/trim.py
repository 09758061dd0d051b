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
from ..mechanics.errors import ModelError, StateError, concrete
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
from ..vehicle.geometry import turn_by_angles
from ..vehicle.kinematics import RISING, Reason, panel_angles
from ..vehicle.motor import MotorRotors
from ..vehicle.placement import turn_about
from ..vehicle.pointing import why_outside
from ..vehicle.workspace import Limits, measure, reasons, survey
from .newton import Implicit, Newton
from .steady import Wanted
from .steady import climb as climb
from .steady import cruise as cruise
from .steady import hover as hover
from .steady import steady_turn as steady_turn

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
    TILT = 7
    SINGULAR = 8
    STROKE_2 = 9
    STROKE_3 = 10


# Limits that a balanced flight breaks: its values are given beside the reason.
_OUTSIDE = {
    TrimReason.TILT: Reason.TILT,
    TrimReason.SINGULAR: Reason.SINGULAR,
    TrimReason.STROKE_2: Reason.STROKE_2,
    TrimReason.STROKE_3: Reason.STROKE_3,
}


class TrimLimits(NamedTuple):
    """What bounds a trim.

    Attributes:
        rotors: of their speeds; None for those of the motors, if there are any.
        actuator: largest force either way [N].
        workspace: of the panel's tilt, the sliders' strokes and the distance from the
            singularity; None for those of the flyer.
    """

    rotors: RotorLimits | None = None
    actuator: Float[Array, ""] | float = jnp.inf
    workspace: Limits | None = None


class Trim(eqx.Module):
    """A trim, or why there is none.

    Attributes:
        coordinates: at the trim, the base at the origin; attitude and angles found.
        inputs: found. speeds: of the rotors (k,) [rad/s]; all NaN where there is no trim.
            A flight that balances, but outside a limit of the actuators or of the tracker's
            workspace, keeps its values: `reason` alone says whether it is allowed.
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
        limits: of rotors, actuators and the tracker; by default those of the motors, if there
            are any, and of the flyer's workspace.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: no trim; says why, with the quantity and its limit.
        ModelError: limits that make no sense, or within which the rotors cannot carry the weight;
            something else in the place of the flyer, the flight or the limits.
    """
    limits = TrimLimits() if limits is None else limits
    _check_kinds(flyer, wanted, limits)
    if limits.rotors is None and isinstance(flyer.propulsion, MotorRotors):
        limits = limits._replace(rotors=flyer.propulsion.limits)
    if limits.workspace is None:
        limits = limits._replace(workspace=_workspace(flyer))
    flyer = flyer.steady()
    if limits.rotors is not None:
        limits.rotors.squared(flyer.propellers.spin.shape[0])
        if throw:
            check_lift(flyer.propellers, limits.rotors, _weight(flyer))
    # as arrays, so that other limits do not mean another compilation
    bounds: Any = jax.tree.map(lambda x: jnp.asarray(x, dtype=float), limits)
    found = _found(_Setting(flyer, flyer.model(), wanted), bounds)
    if throw and concrete(found.reason):
        _raise(TrimReason(int(found.reason)), found, flyer, limits)
    balanced = (TrimReason.VALID, TrimReason.ACTUATOR_LIMIT, *_OUTSIDE)
    fine = jnp.isin(found.reason, jnp.array(balanced, found.reason.dtype))
    keep = lambda tree: jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), tree)
    at, inputs, speeds = keep((found.coordinates, found.inputs, found.speeds))
    return Trim(at, inputs, speeds, found.residual, found.conditioning, found.reason, found.steps)


def _check_kinds(flyer: Any, wanted: Any, limits: Any) -> None:
    for value, kind, what, how in (
        (flyer, Flyer, "flies", "a Flyer, such as uav_flyer() makes"),
        (wanted, Wanted, "is wanted", "a steady flight, such as hover() makes"),
        (limits, TrimLimits, "bounds the trim", "a TrimLimits"),
    ):
        if not isinstance(value, kind):
            raise ModelError(f"What {what} must be {how}, not {_shown(value)}.")
    if np.ndim(limits.actuator) or (concrete(limits.actuator) and not limits.actuator > 0):
        raise ModelError(
            f"The limit of the actuators' forces must be a positive number of newtons, not {limits.actuator}."
        )


def _shown(value: object) -> str:
    return repr(value) if isinstance(value, str | int | float) else f"a {type(value).__name__}"


def _workspace(flyer: Flyer) -> Limits:
    """The flyer's, or all that its rods reach and its sliders hold."""
    if flyer.limits is not None:
        return flyer.limits
    return Limits(home=(0.0, 0.0), tilt=np.pi, margin=0.0)


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
        adjoint=Implicit(),
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
    assert limits.workspace is not None
    turned = turn_by_angles(at.angles)
    strokes, margins, _ = measure(flyer.geometry, limits.workspace, turned, RISING)
    # whether the rods reach, and the sliders hold the panel at all
    held = margins.parallel + limits.workspace.margin > 0
    outside = reasons(margins)
    reason = first_reason(
        (~(jnp.isfinite(jnp.sum(strokes)) & held), TrimReason.POSTURE),
        (missed, TrimReason.ROTOR_LIMIT),
        (spun, TrimReason.ROTOR_MOMENTUM),
        (~(left <= TOLERANCE), TrimReason.NOT_CONVERGED),
        (jnp.min(squared) < 0, TrimReason.ROTOR_STOPPED),
        (jnp.max(jnp.abs(inputs.forces)) > limits.actuator, TrimReason.ACTUATOR_LIMIT),
        *((outside == why, own) for own, why in _OUTSIDE.items()),
    )
    turning = squared > 0
    speeds = jnp.where(turning, jnp.sqrt(jnp.where(turning, squared, 1.0)), 0.0)
    steps = solution.stats["num_steps"]
    return Trim(at, inputs, speeds, left, values[-1] / values[0], reason, steps)


def _raise(reason: TrimReason, found: Trim, flyer: Flyer, limits: TrimLimits) -> None:
    if reason is TrimReason.VALID:
        return
    phi, theta = np.degrees(np.asarray(found.coordinates.angles))
    angles = f"phi = {phi:.4g}, theta = {theta:.4g} degrees"
    if reason in _OUTSIDE:
        assert limits.workspace is not None
        at = survey(flyer.geometry, found.coordinates.angles, limits.workspace)
        why = why_outside(flyer.geometry, limits.workspace, at.margins, _OUTSIDE[reason])
        raise StateError(f"The panel at {angles} is outside the tracker's workspace: {why}")
    strongest = float(jnp.max(jnp.abs(found.inputs.forces)))
    words = {
        TrimReason.POSTURE: f"the tracker cannot take the panel angles {angles}",
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
