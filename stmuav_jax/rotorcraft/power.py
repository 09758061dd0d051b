"""Power of rotors: by their drag torque, and the least by momentum theory.

Rotors that hover with equal speeds need a power that grows with the mass to the power of 1.5,
whichever way it is computed; the ratio of both, the figure of merit, is a constant of the rotor.

Source: J. G. Leishman, Principles of Helicopter Aerodynamics (2006), ch. 2.2 to 2.8.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.numbers import floats
from ..checks.shapes import Numbers


def drag_power(speed_squared: Numbers, k_tau: Numbers) -> Float[Array, "*s"]:
    """Mechanical power k_tau u^1.5 that the air takes from rotors of u = omega^2 (...) [W].

    Args:
        speed_squared: u (...) [rad^2/s^2]; NaN comes of a square below zero.
        k_tau: drag torque coefficient [N m s^2/rad^2].
    """
    return floats(k_tau) * floats(speed_squared) ** 1.5


def hover_power(
    mass: Numbers, *, gravity: Numbers, k_f: Numbers, k_tau: Numbers, count: int
) -> Float[Array, "*s"]:
    """Mechanical power of `count` equal rotors that carry a mass (...), in all [W].

        P = n k_tau (m g / (n k_f))^1.5,   dP/dm = 1.5 P / m

    Args:
        mass: mass m (...) [kg].
        gravity: acceleration of gravity (3,) [m/s^2].
        k_f: thrust coefficient [N s^2/rad^2].
        k_tau: drag torque coefficient [N m s^2/rad^2].
        count: number n of rotors.
    """
    weight = floats(mass) * jnp.linalg.norm(floats(gravity))
    return count * drag_power(weight / (count * floats(k_f)), k_tau)


def induced_power(thrust: Numbers, *, density: Numbers, radius: Numbers) -> Float[Array, "*s"]:
    """Ideal power T^1.5 / sqrt(2 rho A) of a hovering rotor by momentum theory (...) [W].

    Args:
        thrust: T of one rotor (...) [N].
        density: density rho of the air [kg/m^3].
        radius: radius of the disc of area A [m].

    Source: Leishman (2006), Eq. 2.15.
    """
    disc = jnp.pi * floats(radius) ** 2
    return floats(thrust) ** 1.5 / jnp.sqrt(2.0 * floats(density) * disc)


def figure_of_merit(
    *, k_f: Numbers, k_tau: Numbers, density: Numbers, radius: Numbers
) -> Float[Array, "*s"]:
    """Ratio of a rotor's ideal power to its own in hover [1]; one above 1 is impossible.

        FM = k_f^1.5 / (k_tau sqrt(2 rho A))

    It does not depend on thrust, since both powers grow with the speed to the third.

    Args:
        k_f: thrust coefficient [N s^2/rad^2].
        k_tau: drag torque coefficient [N m s^2/rad^2].
        density: density rho of the air [kg/m^3].
        radius: radius of the disc of area A [m].

    Source: Leishman (2006), Eq. 2.44.
    """
    return induced_power(k_f, density=density, radius=radius) / floats(k_tau)
