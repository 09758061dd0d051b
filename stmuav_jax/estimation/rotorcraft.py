"""Where is the centre of mass of a multicopter with any number of rotors: one rigid body.

    J Omega' = sum_k [k_f (a_k - c) x e_z - k_tau s_k e_z] u_k - Omega x J Omega,   c = (offset, c_z)

u_k are squared rotor speeds. Sensors at the frame's origin: a gyroscope, and an accelerometer

    k_f sum u_k e_z / m + Omega' x (-c) + Omega x (Omega x (-c)).

J and c_z are those of one posture. Where parts of the machine move in a known way (`Moved`), the
terms that the report neglects are there too, with J(t) and the parts' angular momentum h(t)
relative to the frame:

    J Omega' = tau - Omega x (J Omega + h) - J' Omega - h'
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..algebra.rotation import cross
from ..algebra.small import inverse
from ..algebra.stacked import apply
from ..vehicle.rotor import Rotors
from .model import Sensor, StateSpaceModel
from .propagate import rk4
from .quadrotor import NAMES, OBSERVABLE, body_rates, matrix


class Moved(NamedTuple):
    """Inputs of a machine whose parts move; mean values over a step, components first.

    Attributes:
        squared: rotor speeds (k,) [rad^2/s^2].
        J, J_rate: about the centre of mass, row by row (9,) [kg m^2], [kg m^2/s].
        h, h_rate: angular momentum of the parts relative to the frame, about the centre of mass
            (3,) [N m s], [N m].
        height: c_z (1,) [m].
    """

    squared: Array
    J: Array
    J_rate: Array
    h: Array
    h_rate: Array
    height: Array


def moved(squared: Array, J: Array, h: Array, height: Array, dt: Any) -> Moved:
    """Inputs over T steps from values at their T + 1 ends.

    Args:
        squared: (T, k). J: (T + 1, 3, 3). h: (T + 1, 3). height: (T + 1,). dt: the step [s].
    """
    J, height = J.reshape(len(J), 9), height[:, None]
    middle = lambda a: (a[1:] + a[:-1]) / 2
    rate = lambda a: jnp.diff(a, axis=0) / dt
    return Moved(squared, middle(J), rate(J), middle(h), rate(h), middle(height))


def rotorcraft_model(
    rotors: Rotors, J: Any, mass: Any, *, height: Any = 0.0, Q: Any, R: Any
) -> StateSpaceModel:
    """Body rates and centre of mass (x, y); inputs the squared speeds of the rotors, or `Moved`.

    Args:
        J: of the whole about its centre of mass (3, 3) [kg m^2]. mass: of the whole [kg].
        height: c_z [m]. Q: (5,) or (5, 5), per step. R: (3,) for a gyroscope alone [rad^2/s^2],
            or (6,) with the accelerometer [m^2/s^4].
    """
    J = jnp.asarray(J)
    J_inverse = jnp.linalg.inv(J)
    noise = matrix(R)
    accelerometer = np.shape(noise)[0] == 6

    def turning(x: Array, u: Any) -> tuple[Array, Array]:
        """Omega', and c (3, *s)."""
        lanes = (1,) * (x.ndim - 1)
        wide = lambda a: a.reshape(-1, *lanes)
        is_moved = isinstance(u, Moved)
        z = u.height if is_moved else jnp.asarray(height)
        c = jnp.concatenate([x[3:5], jnp.broadcast_to(z, x[:1].shape)])
        squared = u.squared if is_moved else u
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
        squared = u.squared if isinstance(u, Moved) else u
        lift = jnp.sum(rotors.k_f * squared, axis=0) / mass
        out = cross(slope, c) + cross(x[:3], cross(x[:3], c))
        up = jnp.broadcast_to(lift, x.shape[1:])[None] - out[2:]
        return jnp.concatenate([x[:3], -out[:2], up])

    names = tuple(f"gyroscope {axis}" for axis in "xyz")
    if accelerometer:
        names += tuple(f"accelerometer {axis}" for axis in "xyz")
    sensor = Sensor(seen, noise, names=names, stacked=True)
    return StateSpaceModel(rk4(rates), matrix(Q), sensor, names=NAMES[OBSERVABLE], stacked=True)
