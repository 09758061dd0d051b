"""Attitude on SO(3) with the observable states: a quadrotor's rotation without Euler angles.

State: p, Euler parameters body to world; omega [rad/s] in body axes; offset (x, y) of the centre
of mass [m]. Errors (8): rotation vector in body axes [rad], omega, offset. A step takes omega by
RK4 and the attitude by the fourth-order Magnus expansion, so that p stays of unit norm:

    p <- p * exp(v),   v = h/6 (w0 + 4 w1 + w2) + h^2/12 w0 x w2

Sensors: a gyroscope (omega), and an accelerometer at the frame's epicentre that reads the specific
force of the rotors and of its own motion about the centre of mass, R_wb^T (a - g).

Source: A. Iserles et al., Lie-group methods, Acta Numerica 9 (2000), section 5.
"""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import cross, from_rotation_vector, product
from ..vehicle.parameters import Parameters
from .model import Sensor, StateSpaceModel
from .quadrotor import PART_III, body_rates, matrix, torque
from .space import Composite, Rotation, Vector

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
    """Points {p, omega, offset}, errors of 8 components."""
    return Composite(p=Rotation(), omega=Vector(3), offset=Vector(2))


def turned(
    p: Array, w: Array, end: Array, rate: Array, end_rate: Array, h: Any
) -> Float[Array, "4 *s"]:
    """The attitude after h [s] in which omega went from w to `end`, with these rates of it."""
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
    """The quadrotor with its attitude on SO(3), inputs the four thrusts [N].

    Args:
        Q: (8,) or (8, 8), per step. R: (3,) for the gyroscope [rad^2/s^2]; with a mass (6,), the
            accelerometer's [m^2/s^4] after it.
        mass: [kg], needed for the accelerometer; None leaves it out.
    """
    J = jnp.asarray(parameters.value("inertia"))
    J_inverse = jnp.linalg.inv(J)
    arm, drag = parameters.value("arm"), parameters.value("drag")

    def turning(omega: Array, offset: Array, u: Array) -> Array:
        return body_rates(omega, torque(offset, u, arm, drag), J, J_inverse)

    def step(x: State, u: Array, h: Any) -> State:
        w, offset = x["omega"], x["offset"]
        k1 = turning(w, offset, u)
        k2 = turning(w + h / 2 * k1, offset, u)
        k3 = turning(w + h / 2 * k2, offset, u)
        k4 = turning(w + h * k3, offset, u)
        end = w + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        p = turned(x["p"], w, end, k1, turning(end, offset, u), h)
        return {"p": p, "omega": end, "offset": offset}

    def seen(x: State, u: Array) -> Float[Array, "m *s"]:
        omega, offset = x["omega"], x["offset"]
        if mass is None:
            return omega
        total = jnp.sum(u, axis=0)
        to_epicentre = -jnp.concatenate([offset, jnp.zeros_like(offset[:1])])
        wheel = cross(turning(omega, offset, u), to_epicentre)
        wheel = wheel + cross(omega, cross(omega, to_epicentre))
        lift = jnp.broadcast_to(total / mass, wheel.shape[1:])[None]
        return jnp.concatenate(
            [omega, wheel + jnp.pad(lift, ((2, 0), *((0, 0),) * (lift.ndim - 1)))]
        )

    names = ("gyroscope x", "gyroscope y", "gyroscope z")
    if mass is not None:
        names += ("accelerometer x", "accelerometer y", "accelerometer z")
    sensor = Sensor(seen, matrix(R), names=names, stacked=True)
    return StateSpaceModel(
        step, matrix(Q), sensor, space=attitude_space(), names=ATTITUDE_NAMES, stacked=True
    )
