"""Quadrotor models of the report's Part III, which find the centre of mass from body rates.

State q = (phi, theta, psi, Omega_x, Omega_y, Omega_z, offset_x, offset_y) [rad, rad/s, m]:

    (phi, theta, psi)' = H^-1 Omega,    J Omega' = -Omega x J Omega + tau,    offset' = 0
    tau = (-offset_y F + l (F2 - F4),  offset_x F + l (F3 - F1),  M1 - M2 + M3 - M4),  F = sum F_i

with R = R_Z(psi) R_X(phi) R_Y(theta). The report prints H in place of H^-1 (Eq. 2.3.1 to 2.3.3);
`report_model` has both. The angles enter no equation of the other states and are not measured, so
they are unobservable: `observable_model` leaves them out, `attitude_model` has Euler parameters in
their place, whose step is the fourth-order Magnus expansion

    p <- p * exp(v),   v = h/6 (w0 + 4 w1 + w2) + h^2/12 w0 x w2

`swinging_model` adds a load that swings, c = centre + s, s' = w q, q' = -w s. The report holds J constant, which is
right only for a load without mass.

`stm.analysis.system_model` is the model for any mechanism; these have the states that gyroscope and
accelerometer see, and no position.

Source: AFRL-AFOSR-JP-TR-2019-0058, Part III, Eq. 2.2.4 to 2.4.1, Tables 2.4.1, 2.4.2, 3.1.1, 3.1.2;
Magnus expansion: A. Iserles et al., Lie-group methods, Acta Numerica 9 (2000), section 5.
"""

import math
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import ModelError, SettingError
from ...estimation.gaussians import Gaussian, gaussian
from ...estimation.model import Sensor, StateSpaceModel, euler, rk4, rk4_step
from ...math import lapack
from ...math.rotation import cross, from_rotation_vector, product, relative_acceleration
from ...math.space import Composite, Rotation, Vector
from ...math.stacked import apply_matrix
from ...mechanics.parameters import Parameter, Parameters

_T1 = "report Part III, Table 2.4.1"
_T2 = "report Part III, Table 2.4.2"

# fmt: off
PART_III = Parameters("PART_III", {
    "arm": Parameter(0.5, "m", _T1 + ": l"),
    "drag": Parameter((4.0, 4.0, 4.0, 4.0), "N m", _T1 + ": M_i"),
    "inertia": Parameter((
        (57253259e-9, 492519.58e-9, -201867.25e-9),
        (492519.58e-9, 58818844.45e-9, 5649.67e-9),
        (-201867.25e-9, 5649.67e-9, 86609602.22e-9)), "kg m^2", _T1),
    "step": Parameter(1e-3, "s", _T1),
    "mass": Parameter(
        40 / 9.81, "kg", "chosen: 10 N of each rotor is hover (the report prints no mass)"),
    "true.start": Parameter(
        (0.0, 0.0, 0.0, 0.1, 0.2, 0.3, 0.05, 0.1), "rad, rad/s, m", _T1 + ": q_0|0"),
    "true.Q": Parameter(
        (1e-8, 2e-8, 1e-8, 1e-8, 2e-8, 4e-8, 1e-8, 1e-8), "squares of the state's, per step", _T1),
    "true.R": Parameter((1e-4, 2e-4, 1e-4), "rad^2/s^2", _T1),
    "filter.start": Parameter(
        (1.0, 5.0, 0.2, 4.0, 5.0, 6.0, 0.5, -0.5), "rad, rad/s, m", _T2 + ": q_0|0"),
    "filter.P0": Parameter(
        (5e-7, 7e-7, 2e-7, 9e-7, 5e-7, 2e-7, 7.6e-7, 7e-7), "squares of the state's", _T2),
    "filter.Q": Parameter(
        (7e-8, 5e-8, 1e-8, 2e-8, 6e-8, 4e-8, 2e-8, 2e-8), "squares of the state's, per step", _T2),
    "filter.R": Parameter((3e-4, 5e-4, 7e-4), "rad^2/s^2", _T2),
    "filter.alpha": Parameter(0.1, "1", _T2),
    "filter.beta": Parameter(2.0, "1", _T2),
    "filter.kappa": Parameter(0.1, "1", _T2 + ": k"),
})
# fmt: on

_ANGLES = ("phi (roll angle)", "theta (pitch angle)", "psi (yaw angle)")
_OBSERVABLE = (
    "Omega_x (roll rate)", "Omega_y (pitch rate)", "Omega_z (yaw rate)",
    "offset_x (centre of mass, x)", "offset_y (centre of mass, y)",
)  # fmt: skip
_SWING = ("swing_x [m]", "swing_y [m]", "swing rate_x [m]", "swing rate_y [m]")

# the observable components of q
OBSERVABLE = slice(3, 8)

Kinematics = Literal["corrected", "printed"]
Propagation = Literal["rk4", "euler"]


# --- equations of motion


def euler_angle_rates(
    angles: Float[Array, "3 *s"], omega: Float[Array, "3 *s"], kinematics: Kinematics = "corrected"
) -> Float[Array, "3 *s"]:
    """Rates of (phi, theta, psi) [rad/s]: H^-1 Omega, or H Omega as the report prints.

    H^-1 is singular at phi = 90 deg; sigma points beyond this angle are on another branch.

    Source: report Part III, Eq. 2.2.5, 2.2.6; as printed: Eq. 2.3.1.
    """
    x, y, z = omega[0], omega[1], omega[2]
    (sp, st), (cp, ct) = jnp.sin(angles[:2]), jnp.cos(angles[:2])
    if kinematics == "printed":
        return jnp.stack([ct * x - st * cp * z, y + sp * z, st * x + ct * cp * z])
    # the part of Omega about the yaw axis, over cos(phi)
    # The order of rotations is singular at a roll of 90 degrees, at which H has no inverse.
    yaw = (ct * z - st * x) / cp
    return jnp.stack([ct * x + st * z, y - sp * yaw, yaw])


def thrust_moment(
    offset: Float[Array, "2 *s"], thrust: Float[Array, "rotors *#s"], arm: Any, drag: Any
) -> Float[Array, "3 *s"]:
    """Moment tau (3,) [N m] about the centre of mass at `offset` [m], of thrusts (4,) [N].

    Raises:
        ModelError: the number of thrusts is not four.

    Source: report Part III, Eq. 2.2.9.
    """
    if thrust.shape[0] != 4:
        raise ModelError(f"The inputs are four thrusts, but there are {thrust.shape[0]}.")
    total = jnp.sum(thrust, axis=0)
    # Thrusts act at the rotors' places; about the displaced centre of mass their sum has a moment as
    # well.
    x = -offset[1] * total + arm * (thrust[1] - thrust[3])
    y = offset[0] * total + arm * (thrust[2] - thrust[0])
    return jnp.stack([x, y, jnp.broadcast_to(drag[0] - drag[1] + drag[2] - drag[3], x.shape)])


class Quadrotor(eqx.Module):
    """Equations of motion of the chosen states; called with states and thrusts they are the rates.

    Attributes:
        J, J_inverse: inertia (3, 3) [kg m^2] and its inverse.
        arm, moments: arm [m] and drag moments (4,) [N m] of the rotors.
        mass: total mass [kg].
        frequency: angular frequency w of a swinging load [rad/s], or None.
        kinematics: equations of the angles; None if they are no states.
    """

    J: Float[Array, "3 3"]
    J_inverse: Float[Array, "3 3"]
    arm: Any
    moments: Any
    mass: Any
    frequency: Any = None
    kinematics: Kinematics | None = eqx.field(static=True, default=None)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states, in their order."""
        angles, swing = self.kinematics is not None, self.frequency is not None
        return _ANGLES * angles + _OBSERVABLE + _SWING * swing

    def split(self, x: Float[Array, "n *s"]) -> tuple[Array, Array]:
        """Angles, if they are states, and the others."""
        first = 0 if self.kinematics is None else 3
        return x[:first], x[first:]

    def centre(self, x: Float[Array, "n *s"]) -> Float[Array, "2 *s"]:
        """Centre of mass relative to the epicentre [m], of the states without the angles."""
        return x[3:5] if self.frequency is None else x[3:5] + x[5:7]

    def spin(self, omega: Float[Array, "3 *s"], moment: Array) -> Float[Array, "3 *s"]:
        """Angular acceleration [rad/s^2] under a moment [N m]."""
        lanes = (1,) * (omega.ndim - 1)
        J, back = (matrix.reshape(3, 3, *lanes) for matrix in (self.J, self.J_inverse))
        return apply_matrix(back, moment - cross(omega, apply_matrix(J, omega)))

    def turning(self, x: Float[Array, "n *s"], u: Array) -> Float[Array, "3 *s"]:
        """Angular acceleration [rad/s^2] under thrusts u (4, ...) [N], of the states without the angles."""
        return self.spin(x[:3], thrust_moment(self.centre(x), u, self.arm, self.moments))

    def __call__(self, x: Float[Array, "n *s"], u: Array) -> Float[Array, "n *s"]:
        """Rates of all states under thrusts u (4, ...) [N]."""
        angles, rest = self.split(x)
        # The centre of mass is constant; process noise lets its estimate follow changes.
        parts = [self.turning(rest, u), jnp.zeros_like(rest[3:5])]
        if self.frequency is not None:
            # The swing is an oscillator in units of length: its rate is divided by the frequency, so that both
            # states are of one size.
            parts.append(self.frequency * jnp.concatenate([rest[7:9], -rest[5:7]]))
        if self.kinematics is not None:
            parts.insert(0, euler_angle_rates(angles, rest[:3], self.kinematics))
        return jnp.concatenate(parts)

    def specific_force(
        self, omega: Array, omega_rate: Array, u: Array, offset: Float[Array, "2 *s"]
    ) -> Float[Array, "3 *s"]:
        """Reading R_wb^T (a - g) of an accelerometer at the epicentre in body axes [m/s^2].

        F / m e_z - Omega' x c - Omega x (Omega x c), c the constant centre of mass
        """
        c = jnp.concatenate([offset, jnp.zeros_like(offset[:1])])
        force = -relative_acceleration(omega, omega_rate, c)
        return force.at[2].add(jnp.sum(u, axis=0) / self.mass)


def state_rates(
    parameters: Parameters = PART_III, kinematics: Kinematics | None = "corrected", **options: Any
) -> Quadrotor:
    """Function q'(q, u) of the 8 states, or the last 5 if kinematics=None, and thrusts (4,) [N]."""
    J = jnp.asarray(parameters.value("inertia"))
    # plain numbers leave single precision as it is
    arm, moments, mass = (parameters.value(name) for name in ("arm", "drag", "mass"))
    return Quadrotor(J, lapack.inverse(J), arm, moments, mass, kinematics=kinematics, **options)


# --- models of the filters


class BodyRates(eqx.Module):
    """Readings of a gyroscope."""

    equations: Quadrotor

    def __call__(self, x: Float[Array, "n *s"], u: Any) -> Float[Array, "3 *s"]:
        return self.equations.split(x)[1][:3]


class AttitudeStep(eqx.Module):
    """Step of {p, omega, offset}, by RK4 and the Magnus expansion."""

    equations: Quadrotor

    def __call__(self, x: dict[str, Array], u: Array, h: Any) -> dict[str, Array]:
        w, offset = x["omega"], x["offset"]
        rate = lambda w: self.equations.turning(jnp.concatenate([w, offset]), u)
        end = rk4_step(lambda w, _: rate(w), w, h)
        p = turn_attitude(x["p"], w, end, rate(w), rate(end), h)
        return {"p": p, "omega": end, "offset": offset}


class AttitudeReadings(eqx.Module):
    """Readings of {p, omega, offset}: of a gyroscope, and with an accelerometer at the epicentre its force."""

    equations: Quadrotor
    accelerometer: bool = eqx.field(static=True)

    def __call__(self, x: dict[str, Array], u: Array) -> Float[Array, "m *s"]:
        omega, offset = x["omega"], x["offset"]
        if not self.accelerometer:
            return omega
        omega_rate = self.equations.turning(jnp.concatenate([omega, offset]), u)
        return jnp.concatenate([omega, self.equations.specific_force(omega, omega_rate, u, offset)])


def turn_attitude(
    p: Array, w: Array, end: Array, rate: Array, end_rate: Array, h: Any
) -> Float[Array, "4 *s"]:
    """Attitude after h [s] in which omega changes from w to `end`, with its rates at both ends."""
    # omega in the middle from the cubic through both ends and their rates
    middle = (w + end) / 2 + h / 8 * (rate - end_rate)
    v = h / 6 * (w + 4 * middle + end) + h**2 / 12 * cross(w, end)
    return product(p, from_rotation_vector(v))


def report_model(
    kinematics: Kinematics = "corrected",
    propagation: Propagation = "rk4",
    *,
    Q: Any = None,
    R: Any = None,
    parameters: Parameters = PART_III,
) -> StateSpaceModel:
    """Report's 8-state model, with the body rates as measurements.

    The model as printed has kinematics="printed" and propagation="euler".

    Args:
        Q: covariance of the process noise (8,) or (8, 8), per step; by default that of Table 2.4.2.
        R: covariance of the measurements' noise (3,) or (3, 3) [rad^2/s^2]; by default likewise.
    """
    Q = parameters.value("filter.Q") if Q is None else Q
    return _make_model(state_rates(parameters, kinematics), propagation, Q, R, parameters)


def observable_model(
    propagation: Propagation = "rk4",
    *,
    Q: Any = None,
    R: Any = None,
    parameters: Parameters = PART_III,
) -> StateSpaceModel:
    """Model of the 5 states that body rates make observable: Omega and the centre of mass.

    The equations are those of `report_model` without the angles, and so are the estimates and the
    defaults.

    Args:
        Q: covariance of the process noise (5,) or (5, 5), per step.
        R: covariance of the measurements' noise (3,) or (3, 3).
    """
    Q = np.asarray(parameters.value("filter.Q"))[OBSERVABLE] if Q is None else Q
    return _make_model(state_rates(parameters, None), propagation, Q, R, parameters)


def attitude_model(
    Q: Any, R: Any, *, mass: float | None = None, parameters: Parameters = PART_III
) -> StateSpaceModel:
    """Model with the attitude on SO(3): points {p, omega, offset}, whose errors have 8 components.

    Args:
        Q: covariance of the process noise (8,) or (8, 8), per step.
        R: covariance of the measurements' noise: (3,) for the gyroscope [rad^2/s^2]; with a mass
            (6,), with the accelerometer's [m^2/s^4] last.
        mass: mass [kg], needed for the accelerometer; None for a gyroscope alone.
    """
    equations = state_rates(parameters, None)
    if mass is not None:
        equations = eqx.tree_at(lambda e: e.mass, equations, mass)
    readings = AttitudeReadings(equations, mass is not None)
    names = (*(f"rotation about body {axis}" for axis in "xyz"), *_OBSERVABLE)
    return StateSpaceModel(
        AttitudeStep(equations), noise_matrix(Q), _make_sensor(readings, R, mass is not None),
        space=attitude_space(), names=names, stacked=True,
    )  # fmt: skip


def attitude_space() -> Composite:
    """Space of points {p, omega, offset}."""
    return Composite(p=Rotation(), omega=Vector(3), offset=Vector(2))


def swinging_model(
    period: float, *, Q: Any = None, R: Any = None, parameters: Parameters = PART_III
) -> StateSpaceModel:
    """Model of body rates, centre of mass and a load that swings about it, four states more, with RK4 steps.

    Args:
        period: period of the swing [s].
        Q: covariance of the process noise (9,) or (9, 9), per step; by default the table's true one of
            the 5 observable states, and none of the swing.
        R: covariance of the measurements' noise (3,) or (3, 3) [rad^2/s^2]; by default the table's true one.

    Raises:
        SettingError: a period that is not positive.
    """
    if not period > 0:
        raise SettingError(f"The period of the load must be positive, but it is {period:g} s.")
    equations = state_rates(parameters, None, frequency=2 * math.pi / period)
    if Q is None:
        Q = np.append(np.array(parameters.value("true.Q"))[OBSERVABLE], np.zeros(4))
    R = parameters.value("true.R") if R is None else R
    return _make_model(equations, "rk4", Q, R, parameters)


def _make_model(
    equations: Quadrotor, propagation: Propagation, Q: Any, R: Any, parameters: Parameters
) -> StateSpaceModel:
    if propagation not in ("rk4", "euler"):
        raise SettingError(f"propagation is 'rk4' or 'euler', not '{propagation}'.")
    step = rk4(equations) if propagation == "rk4" else euler(equations)
    R = parameters.value("filter.R") if R is None else R
    sensor = _make_sensor(BodyRates(equations), R, accelerometer=False)
    space, names = Vector(len(equations.names)), equations.names
    return StateSpaceModel(step, noise_matrix(Q), sensor, space=space, names=names, stacked=True)


def _make_sensor(readings: Any, R: Any, accelerometer: bool) -> Sensor:
    kinds = ("gyroscope", "accelerometer") if accelerometer else ("gyroscope",)
    names = tuple(f"{kind} {axis}" for kind in kinds for axis in "xyz")
    return Sensor(readings, noise_matrix(R), names=names, stacked=True)


def noise_matrix(values: Any) -> Any:
    """Matrix (n, n), given as such or as its diagonal (n,)."""
    values = values if isinstance(values, jnp.ndarray) else np.asarray(values)
    if values.ndim != 1:
        return values
    return jnp.diag(values) if isinstance(values, jnp.ndarray) else np.diag(values)


def report_prior(parameters: Parameters = PART_III, *, states: int = 8) -> Gaussian:
    """Prior of the report's filter (Table 2.4.2), for 8 states or the observable 5.

    Its offsets are 0.45 and 0.6 m from the truth, with standard deviations of 0.9 mm.

    Raises:
        SettingError: neither 8 nor 5 states.
    """
    if states not in (8, 5):
        raise SettingError(f"A model of the quadrotor has 8 or 5 states, not {states}.")
    states_slice = slice(0, 8) if states == 8 else OBSERVABLE
    mean = np.asarray(parameters.value("filter.start"))[states_slice]
    return gaussian(mean, np.diag(np.asarray(parameters.value("filter.P0"))[states_slice]))
