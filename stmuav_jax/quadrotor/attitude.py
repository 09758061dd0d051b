"""Quadrotor model with the attitude on SO(3), without Euler angles, and the observable states.

The state has p, Euler parameters from body to world axes; omega [rad/s] in body axes; offset
(x, y) of the centre of mass [m]. Its errors (8) are a rotation vector in body axes [rad], omega
and offset. A step integrates omega by RK4 and the attitude by the fourth-order Magnus expansion,
so that p keeps its unit norm:

    p <- p * exp(v),   v = h/6 (w0 + 4 w1 + w2) + h^2/12 w0 x w2

The sensors are a gyroscope (omega) and an accelerometer at the frame's epicentre, which reads the
specific force R_wb^T (a - g) by the rotors and by its own motion about the centre of mass.

`stm.sensing.system_model` of one free body moves in the same way, but has the body's position and
velocity among its states, which these sensors never see. This model stays for its eight errors and
for the closed form of its step.

Source: A. Iserles et al., Lie-group methods, Acta Numerica 9 (2000), section 5.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra import lapack
from ..algebra.rotation import cross, from_rotation_vector, product
from ..algebra.space import Composite, Rotation, Vector
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.propagate import rk4_step
from ..parameters.table import Parameters
from .model import PART_III, body_rates, matrix, specific_force, torque

State = dict[str, Array]

ATTITUDE_NAMES = (
    "rotation about body x",
    "rotation about body y",
    "rotation about body z",
    "Omega_x (roll rate)",
    "Omega_y (pitch rate)",
    "Omega_z (yaw rate)",
    "offset_x (centre of mass, x)",
    "offset_y (centre of mass, y)",
)


def attitude_space() -> Composite:
    """Space of points {p, omega, offset}, whose errors have 8 components."""
    return Composite(p=Rotation(), omega=Vector(3), offset=Vector(2))


def turned(
    p: Array, w: Array, end: Array, rate: Array, end_rate: Array, h: Any
) -> Float[Array, "4 *s"]:
    """Attitude after h [s] in which omega changes from w to `end`, with its rates at both ends."""
    # omega in the middle from the cubic through both ends and their rates
    middle = (w + end) / 2 + h / 8 * (rate - end_rate)
    v = h / 6 * (w + 4 * middle + end) + h**2 / 12 * cross(w, end)
    return product(p, from_rotation_vector(v))


def attitude_model(
    Q: Any,
    R: Any,
    *,
    mass: float | None = None,
    parameters: Parameters = PART_III,
) -> StateSpaceModel:
    """State-space model with the attitude on SO(3), whose inputs are the four thrusts [N].

    Args:
        Q: covariance of the process noise (8,) or (8, 8), per step.
        R: covariance of the measurements' noise: (3,) for the gyroscope [rad^2/s^2]; with a mass
            (6,), with the accelerometer's [m^2/s^4] last.
        mass: mass [kg], needed for the accelerometer; None for a gyroscope alone.
    """
    J = jnp.asarray(parameters.value("inertia"))
    J_inverse = lapack.inverse(J)
    arm, drag = parameters.value("arm"), parameters.value("drag")

    def turning(omega: Array, offset: Array, u: Array) -> Array:
        return body_rates(omega, torque(offset, u, arm, drag), J, J_inverse)

    def step(x: State, u: Array, h: Any) -> State:
        w, offset = x["omega"], x["offset"]
        rate = lambda w: turning(w, offset, u)
        end = rk4_step(lambda w, _: rate(w), w, h)
        p = turned(x["p"], w, end, rate(w), rate(end), h)
        return {"p": p, "omega": end, "offset": offset}

    def seen(x: State, u: Array) -> Float[Array, "m *s"]:
        omega, offset = x["omega"], x["offset"]
        if mass is None:
            return omega
        c = jnp.concatenate([offset, jnp.zeros_like(offset[:1])])
        lift = jnp.sum(u, axis=0) / mass
        return jnp.concatenate([omega, specific_force(omega, turning(omega, offset, u), c, lift)])

    names = ("gyroscope x", "gyroscope y", "gyroscope z")
    if mass is not None:
        names += ("accelerometer x", "accelerometer y", "accelerometer z")
    sensor = Sensor(seen, matrix(R), names=names, stacked=True)
    return StateSpaceModel(
        step, matrix(Q), sensor, space=attitude_space(), names=ATTITUDE_NAMES, stacked=True
    )
