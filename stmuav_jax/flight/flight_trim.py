"""Trim of the UAV: attitude, rotor speeds and actuator forces of steady flight.

The unknowns are z = (roll, pitch, thrust, three moments, two actuator forces). The rotors' squared
speeds are the minimum-norm ones that give thrust and moments about the centre of mass, or those
within limits. The residuals are the accelerations of all eight degrees of freedom, less those
of the wanted flight: as many equations as unknowns. They are nearly linear in z.

In a steady turn the machine revolves about the vertical at the wanted rate: omega is constant in
the base's axes, and the base's acceleration is rate z x v. Where the panel points at the sun, its
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

from ..algebra import lapack
from ..algebra.compiler import kept_jit
from ..algebra.derivative import sharp_sqrt
from ..algebra.newton import Implicit, Newton
from ..algebra.rotation import product, rotation_matrix, to_rotation_vector, turn_about
from ..checks.errors import ModelError, StateError, concrete
from ..checks.numbers import floats
from ..checks.reason import first_reason
from ..dynamics.tree.formulation import TreeModel
from ..mechanics.forces.applied import Gravity
from ..rotorcraft.allocation import (
    AllocationReason,
    RotorLimits,
    allocate,
    check_lift,
    minimum_norm,
    wrench_map,
)
from ..rotorcraft.motor import MotorRotors
from ..tracker.geometry import turn_by_angles
from ..tracker.kinematics import RISING, Reason, panel_angles
from ..tracker.pointing import why_outside
from ..tracker.workspace import Limits, measure, reasons, survey
from .flyer import Flyer, FlyerPoint, RotorsAndForces
from .steady import (
    FlightCondition,
    climb as climb,
    cruise as cruise,
    hover as hover,
    steady_turn as steady_turn,
    turn_acceleration,
)

# Largest residual that counts as a trim [m/s^2], [rad/s^2].
TOLERANCE = 1e-10
_MOST_STEPS = 30


class TrimReason(IntEnum):
    """Reason for which there is no trim; the first that applies."""

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


# Limits that a flight in equilibrium may break: its values are given beside the reason.
_OUTSIDE = {
    TrimReason.TILT: Reason.TILT,
    TrimReason.SINGULAR: Reason.SINGULAR,
    TrimReason.STROKE_2: Reason.STROKE_2,
    TrimReason.STROKE_3: Reason.STROKE_3,
}


class TrimLimits(NamedTuple):
    """Limits within which a trim must lie.

    Attributes:
        rotors: limits of the rotor speeds; None for those of the motors, if there are any.
        actuator: largest absolute force of an actuator [N].
        workspace: limits of the panel's tilt, the sliders' strokes and the distance from the
            singularity; None for those of the flyer.
    """

    rotors: RotorLimits | None = None
    actuator: Float[Array, ""] | float = jnp.inf
    workspace: Limits | None = None


class FlightTrim(eqx.Module):
    """Result of a flight trim: its values, NaN where there is none, and a reason code.

    A flight in equilibrium outside a limit of the actuators or of the tracker's workspace keeps
    its values: `reason` alone says whether it is allowed.

    Attributes:
        coordinates: coordinates at the trim, with the base at the origin.
        inputs: inputs at the trim.
        speeds: rotor speeds (k,) [rad/s], zero for a negative square. A speed of zero has no derivative,
            NaN, but within limits of the speeds it is a rotor at its limit, see `Allocation`.
        residual: largest residual acceleration [m/s^2] or [rad/s^2].
        conditioning: smallest over largest singular value of the Jacobian, in units of a
            radian, the weight, and the weight times a metre; near zero, other trims lie near.
        null_space_dimension: that of the allocation: rotors less thrust and moments.
        reason: code of `TrimReason`.
        steps: number of steps of Newton's method.
    """

    coordinates: FlyerPoint
    inputs: RotorsAndForces
    speeds: Float[Array, " k"]
    residual: Float[Array, ""]
    conditioning: Float[Array, ""]
    reason: Int[Array, ""]
    steps: Int[Array, ""]

    @property
    def null_space_dimension(self) -> int:
        return self.speeds.shape[-1] - 4

    @property
    def vector(self) -> Float[Array, " n"]:
        """Values of the trim: rotation vector of the attitude [degrees], speeds, forces (n,)."""
        return _vector(self.coordinates.p, self.speeds, self.inputs.forces)

    @property
    def names(self) -> list[tuple[str, str]]:
        """Names and units of `vector`."""
        turns = [(f"turn_{k}", "degrees") for k in "xyz"]
        speeds = [(f"speed_{k + 1}", "rad/s") for k in range(self.speeds.shape[-1])]
        return [*turns, *speeds, ("force_2", "N"), ("force_3", "N")]


def _attitude(tilt: Float[Array, "2"], yaw: Float[Array, ""]) -> Float[Array, "4"]:
    """Euler parameters of the attitude R_z(yaw) R_y(pitch) R_x(roll), tilt = (roll, pitch)."""
    return product(turn_about(yaw, 2), product(turn_about(tilt[1], 1), turn_about(tilt[0], 0)))


class _TrimProblem(NamedTuple):
    flyer: Flyer
    model: TreeModel
    wanted: FlightCondition


def _point(tilt: Float[Array, "2"], wanted: FlightCondition) -> FlyerPoint:
    p = _attitude(tilt, wanted.yaw)
    R_wb = rotation_matrix(p)
    angles = wanted.angles
    if angles is None:
        assert wanted.sun is not None
        angles = panel_angles(R_wb.T @ wanted.sun)
    omega = wanted.rate * R_wb[2]
    return FlyerPoint(jnp.zeros(3), p, angles, wanted.v, omega, jnp.zeros(2))


def _map(flyer: Flyer, at: FlyerPoint) -> Float[Array, "4 k"]:
    """Allocation matrix B about the centre of mass, base axes: thrust and moments are decoupled."""
    com = flyer.system.com(flyer.level_state(at.angles, None))
    return wrench_map(flyer.propellers, com)


def _left(at: FlyerPoint, inputs: RotorsAndForces, setting: _TrimProblem) -> Float[Array, "8"]:
    found = setting.flyer.accelerations(at, inputs, model=setting.model, resting=True)
    return jnp.concatenate([found.v - turn_acceleration(setting.wanted), found.omega, found.angles])


def _residual(z: Float[Array, "8"], setting: _TrimProblem) -> Float[Array, "8"]:
    at = _point(z[:2], setting.wanted)
    squared = minimum_norm(_map(setting.flyer, at), z[2:6])
    return _left(at, RotorsAndForces(squared, z[6:]), setting)


def residual(flyer: Flyer, wanted: FlightCondition, z: Float[Array, "8"]) -> Float[Array, "8"]:
    """Residual of `trim_flight`: accelerations less those wanted, at unknowns z (8,)."""
    return _residual(z, _TrimProblem(flyer, flyer.model(), wanted))


def trim_flight(
    flyer: Flyer, wanted: FlightCondition, limits: TrimLimits | None = None, *, throw: bool = True
) -> FlightTrim:
    """Attitude, rotor speeds and actuator forces of a steady flight.

    The function is pure: it may be jitted, vmapped and differentiated in all arguments.

    Args:
        wanted: flight condition, see `hover`, `climb`, `cruise` and `steady_turn`.
        limits: limits of rotors, actuators and the tracker; by default those of the motors, if
            there are any, and of the flyer's workspace.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: there is no trim; the message gives the reason, with the quantity and its limit.
        ModelError: impossible limits, or limits within which the rotors cannot carry the weight;
            an argument of another kind.
    """
    limits = TrimLimits() if limits is None else limits
    _check_kinds(flyer, wanted, limits)
    if limits.rotors is None and isinstance(flyer.propulsion, MotorRotors):
        limits = limits._replace(rotors=flyer.propulsion.limits)
    if limits.workspace is None:
        limits = limits._replace(workspace=_workspace(flyer))
    lagging, flyer = flyer.lagging, flyer.steady()
    if limits.rotors is not None:
        limits.rotors.squared(flyer.propellers.spin.shape[0])
        if throw:
            check_lift(flyer.propellers, limits.rotors, _weight(flyer))
    # limits are arrays, so that other values do not need another compilation
    bounds: Any = jax.tree.map(floats, limits)
    found = _found(_TrimProblem(flyer, flyer.model(), wanted), bounds)
    if throw and concrete(found.reason):
        _raise(TrimReason(int(found.reason)), found, flyer, limits)
    balanced = (TrimReason.VALID, TrimReason.ACTUATOR_LIMIT, *_OUTSIDE)
    own = (found.coordinates, found.inputs, found.speeds)
    at, inputs, speeds = own
    if not concrete(found.reason) or int(found.reason) not in balanced:
        fine = jnp.isin(found.reason, jnp.array(balanced, found.reason.dtype))
        at, inputs, speeds = jax.tree.map(lambda x: jnp.where(fine, x, jnp.nan), own)
    at = at._replace(internal=speeds) if lagging else at
    return FlightTrim(
        at, inputs, speeds, found.residual, found.conditioning, found.reason, found.steps
    )


@kept_jit
def _vector(p: Array, speeds: Array, forces: Array) -> Array:
    return jnp.concatenate([jnp.degrees(to_rotation_vector(p)), speeds, forces])


def _check_kinds(flyer: Any, wanted: Any, limits: Any) -> None:
    for value, kind, what, how in (
        (flyer, Flyer, "flies", "a Flyer, such as uav_flyer() makes"),
        (wanted, FlightCondition, "is wanted", "a steady flight, such as hover() makes"),
        (limits, TrimLimits, "bounds the trim", "a TrimLimits"),
    ):
        if not isinstance(value, kind):
            raise ModelError(f"What {what} must be {how}, not {_shown(value)}.")
    if wanted.angles is None and wanted.sun is None:
        raise ModelError(
            "A flight of the UAV needs either the panel's angles or the direction to the sun."
        )
    if np.ndim(limits.actuator) or (concrete(limits.actuator) and not limits.actuator > 0):
        raise ModelError(
            f"The limit of the actuators' forces must be a positive number of newtons, not {limits.actuator}."
        )


def _shown(value: object) -> str:
    return repr(value) if isinstance(value, str | int | float) else f"a {type(value).__name__}"


def _workspace(flyer: Flyer) -> Limits:
    """Workspace limits of the flyer, or else all that its rods reach and its sliders hold."""
    if flyer.limits is not None:
        return flyer.limits
    return Limits(home=(0.0, 0.0), tilt=np.pi, margin=0.0)


def _weight(flyer: Flyer) -> Float[Array, ""]:
    mass = jnp.sum(flyer.system.bodies.mass)
    pull = [f.acceleration for f in flyer.system.forces if isinstance(f, Gravity)]
    return mass * jnp.linalg.norm(jnp.asarray(pull[0])) if pull else jnp.zeros(())


@kept_jit
def _found(setting: _TrimProblem, limits: TrimLimits) -> FlightTrim:
    """Result of Newton's method, converged or not, with the reason code."""
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
    # the Jacobian is scaled in units of a radian, the weight, and the weight times a metre
    sizes = jnp.where(jnp.arange(8) < 2, 1.0, jax.lax.stop_gradient(weight))
    values = lapack.singular_values(last.J * sizes)
    at = _point(z[:2], setting.wanted)
    B = _map(flyer, at)
    squared = minimum_norm(B, z[2:6])
    speeds = sharp_sqrt(squared)
    missed = jnp.zeros((), bool)
    if limits.rotors is not None:
        # the wrench is the same, and so are the accelerations
        given = allocate(B, z[2:6], limits.rotors)
        squared, speeds = given.speed_squared, given.speeds
        missed = given.reason != AllocationReason.VALID
    inputs, left = RotorsAndForces(squared, z[6:]), last.size
    spun = jnp.zeros((), bool)
    if limits.rotors is not None and isinstance(flyer.propulsion, MotorRotors):
        # ... except where the rotors' angular momentum depends on the speeds
        again = jnp.max(jnp.abs(jax.lax.stop_gradient(_left(at, inputs, setting))))
        spun, left = (left <= TOLERANCE) & ~(again <= TOLERANCE), jnp.maximum(left, again)
    assert limits.workspace is not None
    turned = turn_by_angles(at.angles)
    strokes, margins, _ = measure(flyer.geometry, limits.workspace, turned, RISING)
    # the posture exists if the rods reach and the sliders hold the panel
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
    steps = solution.stats["num_steps"]
    return FlightTrim(at, inputs, speeds, left, values[-1] / values[0], reason, steps)


def _raise(reason: TrimReason, found: FlightTrim, flyer: Flyer, limits: TrimLimits) -> None:
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
