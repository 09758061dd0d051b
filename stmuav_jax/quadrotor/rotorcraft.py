"""Rigid-body model of a multicopter with any number of rotors, for its centre of mass.

    J Omega' = sum_k [k_f (a_k - c) x e_z - k_tau s_k e_z] u_k - Omega x J Omega,   c = (offset, c_z)

The u_k are squared rotor speeds. The sensors are at the frame's origin: a gyroscope, and an
accelerometer that reads

    k_f sum u_k e_z / m + Omega' x (-c) + Omega x (Omega x (-c)).

J and c_z are those of one posture. If parts of the machine move in a known way (`MovingPartInputs`), the model
includes the terms that the report neglects, with J(t) and the parts' angular momentum h(t) relative
to the frame:

    J Omega' = tau - Omega x (J Omega + h) - J' Omega - h'

`stm.sensing.system_model` estimates the same from all bodies and their joints, with 17 and more states
on the seven-body UAV. This model stays for a filter that runs beside a flight: it has five states and
takes what moves within the machine as inputs.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..algebra import lapack
from ..algebra.rotation import cross
from ..algebra.small import inverse
from ..algebra.stacked import apply
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.propagate import rk4
from ..rotorcraft.rotor import Rotors
from .model import NAMES, OBSERVABLE, body_rates, matrix, specific_force


class MovingPartInputs(NamedTuple):
    """Inputs of a machine with moving parts, as mean values over a step, components first.

    Attributes:
        speed_squared: squared rotor speeds (k,) [rad^2/s^2].
        J, J_rate: inertia about the centre of mass [kg m^2], its rate [kg m^2/s], row by row (9,).
        h, h_rate: angular momentum of the parts relative to the frame, about the centre of mass
            (3,) [N m s], and its rate [N m].
        height: z coordinate c_z of the centre of mass (1,) [m].
    """

    speed_squared: Array
    J: Array
    J_rate: Array
    h: Array
    h_rate: Array
    height: Array


def moving_part_inputs(
    speed_squared: Array, J: Array, h: Array, height: Array, dt: Any
) -> MovingPartInputs:
    """Inputs over T steps from values at their T + 1 ends.

    Args:
        speed_squared: squared rotor speeds over the steps (T, k).
        J, h, height: as in `MovingPartInputs`, (T + 1, 3, 3), (T + 1, 3) and (T + 1,).
        dt: length of the steps [s].
    """
    J, height = J.reshape(len(J), 9), height[:, None]
    middle = lambda a: (a[1:] + a[:-1]) / 2
    rate = lambda a: jnp.diff(a, axis=0) / dt
    return MovingPartInputs(speed_squared, middle(J), rate(J), middle(h), rate(h), middle(height))


def rotorcraft_model(
    rotors: Rotors, J: Any, mass: Any, *, height: Any = 0.0, Q: Any, R: Any
) -> StateSpaceModel:
    """Model of body rates and centre of mass (x, y), with squared rotor speeds or `MovingPartInputs` as input.

    Args:
        J, mass: inertia of the whole about its centre of mass (3, 3) [kg m^2], and mass [kg].
        height: z coordinate c_z of the centre of mass [m].
        Q: covariance of the process noise (5,) or (5, 5), per step.
        R: covariance of the measurements' noise: (3,) for a gyroscope alone [rad^2/s^2], or (6,)
            with the accelerometer [m^2/s^4].
    """
    J = jnp.asarray(J)
    J_inverse = lapack.inverse(J)
    noise = matrix(R)
    accelerometer = np.shape(noise)[0] == 6

    def turning(x: Array, u: Any) -> tuple[Array, Array]:
        """Angular acceleration Omega' and centre of mass c (3, *s)."""
        lanes = (1,) * (x.ndim - 1)
        wide = lambda a: a.reshape(-1, *lanes)
        is_moved = isinstance(u, MovingPartInputs)
        z = u.height if is_moved else jnp.asarray(height)
        c = jnp.concatenate([x[3:5], jnp.broadcast_to(z, x[:1].shape)])
        squared = u.speed_squared if is_moved else u
        thrust = rotors.k_f * squared
        total = jnp.sum(thrust, axis=0)
        about_x = jnp.sum(wide(rotors.arms[:, 1]) * thrust, axis=0) - c[1] * total
        about_y = -jnp.sum(wide(rotors.arms[:, 0]) * thrust, axis=0) + c[0] * total
        drag = -jnp.sum(wide(rotors.k_tau * rotors.spin) * squared, axis=0)
        moment = jnp.stack([about_x, about_y, jnp.broadcast_to(drag, about_x.shape)])
        if not is_moved:
            return body_rates(x[:3], moment, J, J_inverse), c
        square = lambda a: a.reshape(3, 3, *a.shape[1:])
        now, omega = square(u.J), x[:3]
        moment = moment - cross(omega, apply(now, omega) + u.h)
        moment = moment - apply(square(u.J_rate), omega) - u.h_rate
        return apply(inverse(now), moment), c

    def rates(x: Array, u: Any) -> Array:
        return jnp.concatenate([turning(x, u)[0], jnp.zeros_like(x[3:])])

    def seen(x: Array, u: Any) -> Array:
        if not accelerometer:
            return x[:3]
        slope, c = turning(x, u)
        squared = u.speed_squared if isinstance(u, MovingPartInputs) else u
        lift = jnp.sum(rotors.k_f * squared, axis=0) / mass
        return jnp.concatenate([x[:3], specific_force(x[:3], slope, c, lift)])

    names = tuple(f"gyroscope {axis}" for axis in "xyz")
    if accelerometer:
        names += tuple(f"accelerometer {axis}" for axis in "xyz")
    sensor = Sensor(seen, noise, names=names, stacked=True)
    return StateSpaceModel(rk4(rates), matrix(Q), sensor, names=NAMES[OBSERVABLE], stacked=True)
