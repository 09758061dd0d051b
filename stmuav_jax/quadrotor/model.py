"""Quadrotor models of the report's Part III, which find the centre of mass from body rates.

State q = (phi, theta, psi, Omega_x, Omega_y, Omega_z, offset_x, offset_y) [rad, rad/s, m]:

    (phi, theta, psi)' = H^-1 Omega,    J Omega' = -Omega x J Omega + tau,    offset' = 0
    tau = (-offset_y F + l (F2 - F4),  offset_x F + l (F3 - F1),  M1 - M2 + M3 - M4),  F = sum F_i

with R = R_Z(psi) R_X(phi) R_Y(theta). The report prints H in place of H^-1 (Eq. 2.3.1 to 2.3.3);
the module has both. The angles enter no equation of the other states and are not measured, so
they are unobservable. `observable_model` leaves them out and keeps the 5 observable states.

The report holds J constant: its equations are correct only for a load that adds no inertia.

The printed model is kept as the report has it, Euler angles and Euler's steps included, so that its
figures can be made again; `stm.sensing.system_model` is the one for any mechanism.

Source: AFRL-AFOSR-JP-TR-2019-0058, Part III, Eq. 2.2.5 to 2.4.1, Tables 2.4.1, 2.4.2, 3.1.1, 3.1.2.
"""

from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra import lapack
from ..algebra.rotation import cross, relative_acceleration
from ..algebra.stacked import apply
from ..checks.errors import ModelError, SettingError
from ..estimation.gaussians import Gaussian, gaussian
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.propagate import Rates, euler, rk4
from ..parameters.table import Parameter, Parameters
from .trigonometry import sine_cosine

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

NAMES = (
    "phi (roll angle)",
    "theta (pitch angle)",
    "psi (yaw angle)",
    "Omega_x (roll rate)",
    "Omega_y (pitch rate)",
    "Omega_z (yaw rate)",
    "offset_x (centre of mass, x)",
    "offset_y (centre of mass, y)",
)
# the observable components of q
OBSERVABLE = slice(3, 8)

Kinematics = Literal["corrected", "printed"]
Propagation = Literal["rk4", "euler"]


def euler_angle_rates(
    angles: Float[Array, "3 *s"], omega: Float[Array, "3 *s"], kinematics: Kinematics = "corrected"
) -> Float[Array, "3 *s"]:
    """Rates of (phi, theta, psi) [rad/s]: H^-1 Omega, or H Omega as the report prints.

    H^-1 is singular at phi = 90 deg; sigma points beyond this angle are on another branch.

    Source: report Part III, Eq. 2.2.5, 2.2.6; as printed: Eq. 2.3.1.
    """
    x, y, z = omega[0], omega[1], omega[2]
    (sp, st), (cp, ct) = sine_cosine(angles[:2])
    if kinematics == "printed":
        return jnp.stack([ct * x - st * cp * z, y + sp * z, st * x + ct * cp * z])
    # the part of Omega about the yaw axis, over cos(phi)
    yaw = (ct * z - st * x) / cp
    return jnp.stack([ct * x + st * z, y - sp * yaw, yaw])


def torque(
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
    x = -offset[1] * total + arm * (thrust[1] - thrust[3])
    y = offset[0] * total + arm * (thrust[2] - thrust[0])
    return jnp.stack([x, y, jnp.broadcast_to(drag[0] - drag[1] + drag[2] - drag[3], x.shape)])


def body_rates(
    omega: Float[Array, "3 *s"], moment: Float[Array, "3 *s"], J: Array, J_inverse: Array
) -> Float[Array, "3 *s"]:
    """Angular acceleration Omega' = J^-1 (tau - Omega x J Omega) [rad/s^2]."""
    lanes = (1,) * (omega.ndim - 1)
    J, J_inverse = J.reshape(3, 3, *lanes), J_inverse.reshape(3, 3, *lanes)
    return apply(J_inverse, moment - cross(omega, apply(J, omega)))


def specific_force(
    omega: Float[Array, "3 *s"],
    omega_rate: Float[Array, "3 *s"],
    c: Float[Array, "3 *s"],
    lift: Any,
    moving: tuple[Array, Array] | None = None,
) -> Float[Array, "3 *s"]:
    """Reading R_wb^T (a - g) of an accelerometer at the epicentre in body axes [m/s^2].

    With c the vector from the epicentre to the centre of mass, the reading is

        F / m e_z - Omega' x c - Omega x (Omega x c) - 2 Omega x c' - c''

    Args:
        c: vector from the epicentre to the centre of mass [m].
        lift: specific thrust F / m [m/s^2].
        moving: c' [m/s] and c'' [m/s^2] in body axes for a moving load; None if c is fixed.
    """
    out = relative_acceleration(omega, omega_rate, c)
    if moving is not None:
        out = out + 2 * cross(omega, moving[0]) + moving[1]
    return jnp.stack([-out[0], -out[1], jnp.broadcast_to(lift, out[2].shape) - out[2]])


class RigidBodyRates(eqx.Module):
    """Rates q'(q, u) of the 8 states, or of the last 5, under thrusts u (4,) [N]; see `rates`.

    Attributes:
        J, J_inverse: inertia [kg m^2] and its inverse.
        arm, drag: arm [m] and drag moments (4,) [N m] of the rotors.
        kinematics: equations of the angles; None if they are no states.
    """

    J: Float[Array, "3 3"]
    J_inverse: Float[Array, "3 3"]
    arm: Any
    drag: Any
    kinematics: Kinematics | None = eqx.field(static=True)

    def __call__(self, q: Array, u: Array) -> Array:
        start = 0 if self.kinematics is None else 3
        omega, offset = q[start : start + 3], q[start + 3 :]
        moment = torque(offset, u, self.arm, self.drag)
        turning = body_rates(omega, moment, self.J, self.J_inverse)
        parts = [turning, jnp.zeros_like(offset)]
        if self.kinematics is not None:
            parts.insert(0, euler_angle_rates(q[:3], omega, self.kinematics))
        return jnp.concatenate(parts)


class BodyRates(eqx.Module):
    """Measurement of the body rates, which begin at a place among the states."""

    first: int = eqx.field(static=True)

    def __call__(self, x: Float[Array, "n *s"], u: Any) -> Float[Array, "3 *s"]:
        return x[self.first : self.first + 3]


def rates(parameters: Parameters = PART_III, kinematics: Kinematics | None = "corrected") -> Rates:
    """Function q'(q, u) of the 8 states, or the last 5 if kinematics=None, and thrusts (4,) [N]."""
    J = jnp.asarray(parameters.value("inertia"))
    # plain numbers leave single precision as it is
    arm, drag = parameters.value("arm"), parameters.value("drag")
    return RigidBodyRates(J, lapack.inverse(J), arm, drag, kinematics)


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
    step = _stepper(rates(parameters, kinematics), propagation)
    return _model(step, Q, R, parameters, NAMES, slice(0, 8), 3)


def observable_model(
    propagation: Propagation = "rk4",
    *,
    Q: Any = None,
    R: Any = None,
    parameters: Parameters = PART_III,
) -> StateSpaceModel:
    """Model of the 5 states that body rates make observable: Omega and the centre of mass.

    The equations are those of `report_model` without the angles, and so are the estimates.

    Args:
        Q: covariance of the process noise (5,) or (5, 5), per step; default as in `report_model`.
        R: covariance of the measurements' noise (3,) or (3, 3); default as in `report_model`.
    """
    step = _stepper(rates(parameters, None), propagation)
    return _model(step, Q, R, parameters, NAMES[OBSERVABLE], OBSERVABLE, 0)


def _stepper(rate: Rates, propagation: Propagation) -> Any:
    if propagation not in ("rk4", "euler"):
        raise SettingError(f"propagation is 'rk4' or 'euler', not '{propagation}'.")
    return rk4(rate) if propagation == "rk4" else euler(rate)


def _model(
    step: Any,
    Q: Any,
    R: Any,
    parameters: Parameters,
    names: tuple[str, ...],
    states: slice,
    first: int,
) -> StateSpaceModel:
    Q = np.asarray(parameters.value("filter.Q"))[states] if Q is None else Q
    R = parameters.value("filter.R") if R is None else R
    seen = ("gyroscope x", "gyroscope y", "gyroscope z")
    sensor = Sensor(BodyRates(first), matrix(R), names=seen, stacked=True)
    return StateSpaceModel(step, matrix(Q), sensor, names=names, stacked=True)


def matrix(values: Any) -> Any:
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
        raise SettingError(f"There are models of 8 and of 5 states, not of {states}.")
    which = slice(0, 8) if states == 8 else OBSERVABLE
    mean = np.asarray(parameters.value("filter.start"))[which]
    return gaussian(mean, np.diag(np.asarray(parameters.value("filter.P0"))[which]))


def thrusts(case: int, t: Any) -> Float[Array, "4 *s"]:
    """Thrusts F_1 to F_4 [N] of cases 1 to 8 at times t [s].

    The histories of cases 3, 4, 7, 8 were in figures that are lost. Histories chosen instead are
    10 + 5 sin(2 pi t), all equal (3, 7), and 10 +- 2 sin(2 pi t), 10 +- 2 cos(2 pi t) (4, 8).

    Source: report Part III, Tables 3.1.1 and 3.1.2.
    """
    _check_case(case)
    t = jnp.asarray(t)
    one, turn = jnp.ones_like(t), 2 * jnp.pi * t
    kind = (case - 1) % 4
    if kind == 0:
        return jnp.stack([10.0 * one] * 4)
    if kind == 1:
        return jnp.stack([7.0 * one, 9.0 * one, 11.0 * one, 13.0 * one])
    if kind == 2:
        return jnp.stack([10 + 5 * jnp.sin(turn)] * 4)
    s, c = 2 * jnp.sin(turn), 2 * jnp.cos(turn)
    return jnp.stack([10 + s, 10 + c, 10 - s, 10 - c])


def offsets(case: int, t: Any) -> Float[Array, "2 *s"]:
    """Centre of mass (x, y) [m] of cases 1 to 8 at times t [s], without noise.

    It is (0.05, 0.1) in cases 1 to 4. Its motion in cases 5 to 8 is lost; the one chosen instead
    is 0.05 + 0.05 sin(pi t) and 0.1 + 0.05 (cos(pi t) - 1).
    """
    _check_case(case)
    t = jnp.asarray(t)
    if case <= 4:
        return jnp.stack([0.05 * jnp.ones_like(t), 0.1 * jnp.ones_like(t)])
    half = jnp.pi * t
    return jnp.stack([0.05 + 0.05 * jnp.sin(half), 0.1 + 0.05 * (jnp.cos(half) - 1)])


def _check_case(case: int) -> None:
    if case not in range(1, 9):
        raise SettingError(f"The report has cases 1 to 8, not {case}.")
