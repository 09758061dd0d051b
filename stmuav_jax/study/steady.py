"""Steady flights that a trim is wanted for: hover, climb, cruise, steady turn."""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..mechanics.errors import ModelError, concrete
from ..mechanics.numbers import numbers

_UP = np.array([0.0, 0.0, 1.0])


class Wanted(NamedTuple):
    """A steady flight; see `hover`, `climb`, `cruise` and `steady_turn`.

    Attributes:
        angles: of the panel (2,) [rad], or None where it points at the sun.
        sun: direction to it, world (3,), or None.
        yaw: heading [rad]. v: velocity of the base, world (3,) [m/s].
        rate: of turn about the vertical [rad/s].
        acceleration: of the base beside that of the turn, world (3,) [m/s^2].
    """

    angles: Float[Array, "2"] | None
    sun: Float[Array, "3"] | None
    yaw: Float[Array, ""]
    v: Float[Array, "3"]
    rate: Float[Array, ""]
    acceleration: Float[Array, "3"]


def hover(angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> Wanted:
    """Standing still with the panel at angles (2,) [rad], or at the sun (3,), world.

    Raises:
        ModelError: an argument that is not finite numbers of its shape (here and below).
    """
    return _flight(angles, sun, yaw, jnp.zeros(3), 0.0)


def climb(speed: Any, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> Wanted:
    """Straight up at a speed [m/s]; negative for a descent."""
    speed = numbers(speed, (), "The speed of the climb", "m/s")
    return _flight(angles, sun, yaw, speed * _UP, 0.0)


def cruise(
    speed: Any, course: Any = 0.0, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None
) -> Wanted:
    """Level flight at a speed [m/s] towards a course from x to y [rad]."""
    speed = numbers(speed, (), "The level speed", "m/s")
    course = numbers(course, (), "The course", "rad")
    along = jnp.stack([jnp.cos(course), jnp.sin(course), jnp.zeros_like(course)])
    return _flight(angles, sun, yaw, speed * along, 0.0)


def steady_turn(speed: Any, rate: Any, angles: Any, course: Any = 0.0, yaw: Any = 0.0) -> Wanted:
    """A level turn at a speed [m/s] and a rate [rad/s], positive from x to y; at its start."""
    straight = cruise(speed, course, angles, yaw)
    return straight._replace(rate=numbers(rate, (), "The rate of turn", "rad/s"))


def _flight(angles: Any, sun: Any, yaw: Any, v: Array, rate: Any) -> Wanted:
    if (angles is None) == (sun is None):
        raise ModelError(
            "A flight needs either the panel's angles or the direction to the sun, and not both."
        )
    if angles is not None:
        angles = numbers(angles, (2,), "The pair of the panel's angles", "rad")
    if sun is not None:
        sun = numbers(sun, (3,), "The direction to the sun", "")
        if concrete(sun) and not float(jnp.linalg.norm(sun)) > 0:
            raise ModelError("The direction to the sun must not be zero.")
    yaw = numbers(yaw, (), "The heading", "rad")
    return Wanted(angles, sun, yaw, v, jnp.asarray(rate, dtype=float), jnp.zeros(3))
