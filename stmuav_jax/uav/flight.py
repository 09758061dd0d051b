"""The UAV with its tracker: its state space, and the trim of a steady flight within its limits.

`trim_flight` is the general `trim_condition` with what this machine wants of it. The rotors' squared
speeds are the minimum-norm ones that give thrust and moments,

    u = B^T (B B^T)^-1 w,

with the derivative B of the wrench at hovering speeds if the rotors have curves, so that the unknowns
are roll and pitch, the wrench w and two actuator forces: as many as the degrees of freedom. The rotors'
speeds are then compared with their limits, and the panel's posture with the workspace of the tracker; a code
gives the limit that the flight exceeds. Derivatives are those of the implicit function.
"""

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..analysis.equilibrium import TOLERANCE, FlightCondition, format_residuals, trim_condition
from ..analysis.sensors import gravity_of
from ..checks.errors import AbstractReason, ModelError, StateError, first_reason, has_values
from ..checks.numbers import as_floats
from ..checks.shapes import Numbers
from ..dynamics.statespace.tree import TreePoint, TreeSpace
from ..math.compiler import kept_jit, quick_jit
from ..math.derivative import sharp_sqrt
from ..math.rotation import rotation_matrix, to_rotation_vector, turn_about
from ..mechanics.inputs import Inputs, inputs_of
from ..mechanics.size import mechanism_weight
from ..mechanics.state import State
from ..mechanics.system import System
from .allocation import RotorLimits, check_lift, minimum_norm, wrench_map
from .motor import MotorRotors
from .rotor import Rotors
from .tracker.bodies import LinearActuator, place_on_base
from .tracker.geometry import TrackerGeometry, turn_by_angles
from .tracker.kinematics import Reason, panel_angles
from .tracker.workspace import Limits, measure, reasons, survey, why_outside

PANEL_COORDINATES = ("U47.angle_1", "U47.angle_2")
_PANEL, _SLIDERS = "panel_7", ("slider_2", "slider_3")


class Uav(eqx.Module):
    """The UAV with its tracker.

    The independent coordinates of its space are those of the base, and the angles of the universal joint
    between post and panel, `PANEL_COORDINATES`: theta, and phi less the lean of the post, both from the
    reference posture.

    Args:
        space: state space of the seven bodies, base first, with one `Rotors` or `MotorRotors` and one
            `LinearActuator` for each slider.
        geometry: lengths of the tracker.
        displacement: displacement of the tracker in the base's frame (3,) [m].
        limits: limits of the tracker's workspace (`tracker_limits`), which a trim observes;
            None for all that its rods reach.

    Raises:
        ModelError: no rotors, not two actuators, or other independent coordinates.
    """

    space: TreeSpace
    geometry: TrackerGeometry
    displacement: Float[Array, "3"]
    limits: Limits | None
    rotor_place: int = eqx.field(static=True)
    inputs: Inputs

    def __init__(
        self,
        space: TreeSpace,
        geometry: TrackerGeometry,
        displacement: Numbers,
        limits: Limits | None = None,
    ) -> None:
        forces = list(enumerate(space.system.forces))
        rotors = [k for k, f in forces if isinstance(f, Rotors | MotorRotors)]
        actuators = {f.slider: k for k, f in forces if isinstance(f, LinearActuator)}
        if len(rotors) != 1 or set(actuators) != set(_SLIDERS):
            raise ModelError(
                "The UAV needs one set of rotors and one LinearActuator for each slider, but the "
                f"system has {len(rotors)} and those for {', '.join(sorted(actuators)) or 'none'}."
            )
        if tuple(name for name, _ in space.names[6:8]) != PANEL_COORDINATES or space.dof != 8:
            raise ModelError(
                f"The independent coordinates of the UAV must be those of its base and {', '.join(PANEL_COORDINATES)}."
            )
        self.space, self.geometry = space, geometry
        self.displacement, self.limits = as_floats(displacement), limits
        self.rotor_place = rotors[0]
        entries = inputs_of(space.system).entries
        # Order of the inputs, rotors first, whatever the order of the force elements is.
        places = (rotors[0], *(actuators[slider] for slider in _SLIDERS))
        self.inputs = Inputs(tuple(e for k in places for e in entries if e.force == k))

    @property
    def system(self) -> System:
        """Bodies, joints and forces."""
        return self.space.system

    @property
    def propulsion(self) -> Rotors | MotorRotors:
        """Force element of the rotors, with their motors if they have any."""
        return self.system.forces[self.rotor_place]  # pyright: ignore[reportReturnType]

    @property
    def rotors(self) -> Rotors:
        """Rotors without their motors."""
        return self.propulsion.rotors

    @property
    def has_lag(self) -> bool:
        """True if the rotors' speeds are internal states: motors with a time constant."""
        propulsion = self.propulsion
        return isinstance(propulsion, MotorRotors) and propulsion.time_constant is not None

    def with_steady_motors(self) -> "Uav":
        """The UAV with its motors at steady speeds, see `MotorRotors.steady`."""
        if isinstance(self.propulsion, Rotors):
            return self
        forces = list(self.system.forces)
        forces[self.rotor_place] = self.propulsion.steady()
        system = eqx.tree_at(lambda s: s.forces, self.system, tuple(forces))
        return Uav(self.space.with_system(system), self.geometry, self.displacement, self.limits)

    def state(
        self,
        angles: Numbers,
        rates: Numbers | None = None,
        *,
        r: Numbers = (0.0, 0.0, 0.0),
        p: Numbers = (1.0, 0.0, 0.0, 0.0),
        v: Numbers = (0.0, 0.0, 0.0),
        omega: Numbers = (0.0, 0.0, 0.0),
    ) -> State:
        """State of all bodies, from that of the panel and of the base; by default all rests and is level.

        Args:
            angles, rates: panel angles (phi, theta) (2,) [rad] and their rates [rad/s].
            r, p, v, omega: of the base, see `place_on_base`.
        """
        rates = None if rates is None else as_floats(rates)
        base = map(as_floats, (r, p, v, omega))
        return place_on_base(self.geometry, self.displacement, as_floats(angles), rates, *base)

    def point(self, angles: Numbers, rates: Numbers | None = None, **base: Numbers) -> TreePoint:
        """Point of the space at this `state`."""
        return self.space.from_state(self.state(angles, rates, **base))

    @quick_jit
    def panel_angles(self, x: TreePoint) -> Float[Array, "2"]:
        """Panel angles (phi, theta) (2,) [rad] at a point."""
        state = self.space.to_state(x)
        R_wb, R_wp = (rotation_matrix(state.p[k]) for k in (0, self.system.index(_PANEL)))
        return panel_angles(R_wb.T @ R_wp[:, 2])


class TrimReason(AbstractReason):
    """Reason for which there is no trim; the first that applies."""

    VALID = 0
    POSTURE = 1
    NOT_CONVERGED = 2
    ROTOR_STOPPED = 3
    ROTOR_LIMIT = 4
    ACTUATOR_LIMIT = 5
    TILT = 6
    SINGULAR = 7
    STROKE_2 = 8
    STROKE_3 = 9


_OUTSIDE = {code: Reason[code.name] for code in TrimReason if code >= TrimReason.TILT}
# A flight in equilibrium may break a limit: its values are given beside the reason.
_BALANCED = (TrimReason.VALID, TrimReason.ROTOR_LIMIT, TrimReason.ACTUATOR_LIMIT, *_OUTSIDE)


class TrimLimits(NamedTuple):
    """Limits within which a trim must lie.

    Attributes:
        rotors: limits of the rotor speeds; None for those of the motors, if there are any.
        actuator: largest absolute force of an actuator [N].
        workspace: limits of the panel's tilt, the sliders' strokes and the distance from the
            singularity; None for those of the UAV.
    """

    rotors: RotorLimits | None = None
    actuator: Float[Array, ""] | float = jnp.inf
    workspace: Limits | None = None


class FlightTrim(eqx.Module):
    """Result of a flight trim: its values, NaN where there is none, and a reason code.

    A flight in equilibrium outside a limit of rotors, actuators or the tracker's workspace keeps
    its values: `reason` alone says whether it is allowed.

    Attributes:
        point: point of the UAV's space, with the base at the origin.
        angles: panel angles (phi, theta) (2,) [rad].
        values: values of the UAV's inputs: squared rotor speeds [rad^2/s^2], two actuator forces [N] (m,).
        speeds: rotor speeds (k,) [rad/s], zero for a negative square. A speed of zero has no derivative:
            it is NaN.
        residuals: residual accelerations and conditions (e,), in `residual_units`.
        conditioning: smallest over largest singular value of the Jacobian, in units of a
            radian, the weight, and the weight times a metre; near zero, other trims lie near.
        reason: code of `TrimReason`.
        steps: number of steps of Newton's method.
    """

    point: TreePoint
    angles: Float[Array, "2"]
    values: Float[Array, " m"]
    speeds: Float[Array, " k"]
    residuals: Float[Array, " e"]
    conditioning: Float[Array, ""]
    reason: Int[Array, ""]
    steps: Int[Array, ""]
    residual_units: tuple[str, ...] = eqx.field(static=True)

    @property
    def residual(self) -> Float[Array, "*n"]:
        """Largest of the residuals, each in its unit."""
        return jnp.max(jnp.abs(self.residuals), axis=-1)

    @property
    def speed_squared(self) -> Float[Array, "*n k"]:
        """Squared rotor speeds (k,) [rad^2/s^2]."""
        return self.values[..., :-2]

    @property
    def forces(self) -> Float[Array, "*n 2"]:
        """Forces of the two actuators (2,) [N]."""
        return self.values[..., -2:]

    @property
    def null_space_dimension(self) -> int:
        """Dimension of the allocation's null space: rotors less thrust and moments."""
        return self.speeds.shape[-1] - 4

    @property
    def vector(self) -> Float[Array, " n"]:
        """Values of the trim: rotation vector of the attitude [degrees], speeds, forces (n,)."""
        return _trim_vector(self.point.p, self.speeds, self.forces)

    @property
    def names(self) -> list[tuple[str, str]]:
        """Names and units of `vector`."""
        turns = [(f"turn_{k}", "degrees") for k in "xyz"]
        speeds = [(f"speed_{k + 1}", "rad/s") for k in range(self.speeds.shape[-1])]
        return [*turns, *speeds, ("force_2", "N"), ("force_3", "N")]


@kept_jit
def _trim_vector(p: Array, speeds: Array, forces: Array) -> Array:
    return jnp.concatenate([jnp.degrees(to_rotation_vector(p)), speeds, forces])


def trim_flight(
    uav: Uav, condition: FlightCondition, limits: TrimLimits | None = None, *, throw: bool = True
) -> FlightTrim:
    """Attitude, rotor speeds and actuator forces of a steady flight.

    The function is pure: it may be jitted, vmapped and differentiated in all arguments.

    Args:
        condition: flight condition, see `hover`, `climb`, `cruise` and `steady_turn`.
        limits: limits of rotors, actuators and the tracker; by default those of the motors, if
            there are any, and of the UAV's workspace.
        throw: raise where there is no trim, if values are known.

    Raises:
        StateError: there is no trim; the message gives the reason, with the quantity and its limit.
        ModelError: impossible limits, or limits within which the rotors cannot carry the weight;
            an argument of another kind.
    """
    limits = TrimLimits() if limits is None else limits
    _check_kinds(uav, condition, limits)
    propulsion = uav.propulsion
    if limits.rotors is None and isinstance(propulsion, MotorRotors):
        limits = limits._replace(rotors=propulsion.limits)
    if limits.workspace is None:
        # all that the rods reach and the sliders hold
        reach = Limits(home=(0.0, 0.0), tilt=np.pi, margin=0.0)
        limits = limits._replace(workspace=uav.limits or reach)
    if limits.rotors is not None:
        limits.rotors.squared(uav.rotors.spin.shape[0])
        if throw:
            check_lift(uav.rotors, limits.rotors, mechanism_weight(uav.system))
    # limits are arrays, so that other values do not need another compilation
    bounds: Any = jax.tree.map(as_floats, limits)
    trim = _trim_flight(uav.with_steady_motors(), condition, bounds)
    if throw and has_values(trim.reason) and int(trim.reason) != TrimReason.VALID:
        _raise_reason(TrimReason(int(trim.reason)), trim, uav, limits)
    if not has_values(trim.reason) or int(trim.reason) not in _BALANCED:
        is_balanced = jnp.isin(trim.reason, jnp.array(_BALANCED, trim.reason.dtype))
        keep = lambda x: jnp.where(is_balanced, x, jnp.nan)
        parts = lambda t: (t.point, t.angles, t.values, t.speeds)
        trim = eqx.tree_at(parts, trim, jax.tree.map(keep, parts(trim)))
    if not uav.has_lag:
        return trim
    return eqx.tree_at(lambda t: t.point.internal, trim, trim.speeds)


@kept_jit
def _trim_flight(uav: Uav, condition: FlightCondition, limits: TrimLimits) -> FlightTrim:
    """General trim, converged or not, with the reason code."""
    count, sun, angles = uav.rotors.spin.shape[0], condition.sun, condition.angles
    if angles is None:
        assert sun is not None
        # The attitude is not known yet; level flight is close enough for a start of Newton's method.
        angles = panel_angles(rotation_matrix(turn_about(condition.yaw, 2)).T @ sun)
    state = uav.state(angles)
    weight = mechanism_weight(uav.system)
    # about the centre of mass, thrust and moments are decoupled
    hovering = uav.rotors.hover(jnp.sum(uav.system.bodies.mass), gravity_of(uav.system))
    B = wrench_map(uav.rotors, uav.system.com(state), hovering)
    columns = jax.vmap(minimum_norm, in_axes=(None, 0), out_axes=1)(B, jnp.eye(4))
    directions = weight * jax.scipy.linalg.block_diag(columns, jnp.eye(2))
    # Thrusts are redundant with more than four rotors: the search is along four wrenches and two forces,
    # of minimum norm.
    trim = trim_condition(
        uav.space, condition._replace(angles=None), at=uav.space.from_state(state),
        free=() if sun is None else PANEL_COORDINATES, inputs=uav.inputs, values=directions[:, 0],
        directions=directions, pointing=None if sun is None else _PANEL, throw=False,
    )  # fmt: skip
    if sun is not None:
        angles = jnp.where(trim.converged, uav.panel_angles(trim.point), angles)
    # Squared speeds are the unknowns, as the wrench is linear in them; negative ones are found below.
    values, squared = trim.values, trim.values[:count]
    lower, upper = (0.0, jnp.inf) if limits.rotors is None else limits.rotors.squared(count)
    assert limits.workspace is not None
    strokes, margins, _ = measure(uav.geometry, limits.workspace, turn_by_angles(angles))
    # the posture exists if the rods reach and the sliders hold the panel
    is_held = margins.parallel + limits.workspace.margin > 0
    outside = reasons(margins)
    reason = first_reason(
        (~(jnp.isfinite(jnp.sum(strokes)) & is_held), TrimReason.POSTURE),
        (~(trim.residual <= TOLERANCE), TrimReason.NOT_CONVERGED),
        (jnp.min(squared) < 0, TrimReason.ROTOR_STOPPED),
        (jnp.any((squared < lower) | (squared > upper)), TrimReason.ROTOR_LIMIT),
        (jnp.max(jnp.abs(values[count:])) > limits.actuator, TrimReason.ACTUATOR_LIMIT),
        *((outside == workspace_reason, code) for code, workspace_reason in _OUTSIDE.items()),
    )
    return FlightTrim(
        trim.point, angles, values, sharp_sqrt(squared), trim.residuals, trim.conditioning, reason, trim.steps,
        trim.residual_units,
    )  # fmt: skip


def trim_slopes(
    build: Callable[[dict[str, Array]], Uav],
    values: Mapping[str, Float[Array, "..."]],
    condition: FlightCondition,
    limits: TrimLimits | None = None,
) -> tuple[FlightTrim, dict[str, Float[Array, "..."]]]:
    """Trim of a UAV, and the derivatives of `FlightTrim.vector` with respect to values of its construction.

    Args:
        build: function from values by name, traced by JAX, to the UAV.
        values: values at which the derivatives are taken.

    Returns:
        the trim, whose `reason` says whether there is one, and the derivatives by name: the
        vector's axis first, then those of the value, in the units of both.
    """

    def solve_point(values: dict[str, Array]) -> tuple[Float[Array, " n"], FlightTrim]:
        trim = trim_flight(build(values), condition, limits, throw=False)
        return trim.vector, trim

    # Forward mode: values are few, and results many.
    slopes, trim = quick_jit(jax.jacfwd(solve_point, has_aux=True))(dict(values))
    return trim, slopes


def _check_kinds(uav: Any, condition: Any, limits: Any) -> None:
    for value, kind, role, description in (
        (uav, Uav, "The machine", "a Uav, such as make_uav() returns"),
        (condition, FlightCondition, "The flight", "a steady flight, such as hover() makes"),
        (limits, TrimLimits, "The limits", "a TrimLimits"),
    ):
        if not isinstance(value, kind):
            value_text = repr(value) if isinstance(value, str | int | float) else None
            raise ModelError(
                f"{role} must be {description}, not {value_text or f'a {type(value).__name__}'}."
            )
    if condition.angles is None and condition.sun is None:
        raise ModelError(
            "A flight of the UAV needs either the panel's angles or the direction to the sun."
        )
    if np.ndim(limits.actuator) or (has_values(limits.actuator) and not limits.actuator > 0):
        raise ModelError(
            f"The limit of the actuators' forces must be a positive number of newtons, not {limits.actuator}."
        )


def _raise_reason(reason: TrimReason, trim: FlightTrim, uav: Uav, limits: TrimLimits) -> None:
    """Raise the `StateError` of a flight without a trim."""
    phi, theta = np.degrees(np.asarray(trim.angles))
    angles = f"phi = {phi:.4g}, theta = {theta:.4g} degrees"
    if reason in _OUTSIDE:
        assert limits.workspace is not None
        posture = survey(uav.geometry, trim.angles, limits.workspace)
        cause = why_outside(uav.geometry, limits.workspace, posture.margins, _OUTSIDE[reason])
        raise StateError(f"The panel at {angles} is outside the tracker's workspace: {cause}")
    if reason is TrimReason.POSTURE:
        cause = f"the tracker cannot take the panel angles {angles}"
    elif reason is TrimReason.NOT_CONVERGED:
        cause = (
            "Newton's method has stopped with residual accelerations of "
            f"{format_residuals(trim.residuals, trim.residual_units)} left (tolerance {TOLERANCE:.0e})"
        )
    elif reason is TrimReason.ROTOR_STOPPED:
        cause = "a rotor would have to push downwards"
    elif reason is TrimReason.ACTUATOR_LIMIT:
        cause = (
            f"an actuator would have to push with {float(np.max(np.abs(trim.forces))):.4g} N, but the limit "
            f"is {float(limits.actuator):.4g} N"
        )
    else:
        assert limits.rotors is not None
        low, high = float(np.min(limits.rotors.lowest)), float(np.max(limits.rotors.highest))
        slowest, fastest = np.min(np.asarray(trim.speeds)), np.max(np.asarray(trim.speeds))
        cause = (
            f"the rotors would have to turn with {slowest:.4g} to {fastest:.4g} rad/s, but their limits are "
            f"{low:g} to {high:g} rad/s"
        )
    raise StateError(f"No trim was found: {cause}.")
