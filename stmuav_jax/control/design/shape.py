"""Shapes of references that are tuned beside the gains: moves from rest to rest.

With s the share of the time and c_k free coefficients, the share of the way is

    rise(s) = 10 s^3 - 15 s^4 + 6 s^5 + (4 s (1 - s))^3 (c_0 + c_1 z + c_2 z^2 + ...),    z = 2 s - 1

so that each shape begins and ends with zero speed and acceleration. Zeros make the quintic; c_0 is the
share of the way by which the shape is ahead of it at half the time.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.derivative import motion_along
from ...checks.errors import SettingError, concrete
from ...checks.numbers import numbers, positive
from ...checks.shapes import Numbers


def rise(s: Float[Array, ""], coefficients: Float[Array, " k"]) -> Float[Array, ""]:
    """Share of the way at a share s of the time, from 0 to 1."""
    quintic = s**3 * (10 - 15 * s + 6 * s**2)
    if not coefficients.size:
        return quintic
    return quintic + (4 * s * (1 - s)) ** 3 * jnp.polyval(coefficients[::-1], 2 * s - 1)


class Slew(eqx.Module):
    """Move of n values from rest to rest, as a function of t [s] to them, their rates and accelerations.

    Args:
        start, goal: values before and after the move (n,).
        duration: time that it takes [s]; see `within` for one that is tuned.
        coefficients: c_k of the shape (k,), one or more [1].
        at: beginning of the move [s].

    Raises:
        ModelError: values, coefficients or times of another shape, or not finite; a duration that is
            not positive.
    """

    start: Float[Array, " n"]
    goal: Float[Array, " n"]
    duration: Float[Array, ""]
    coefficients: Float[Array, " k"]
    at: Float[Array, ""]

    def __init__(
        self,
        start: Numbers,
        goal: Numbers,
        duration: Numbers,
        coefficients: Numbers = (0.0,),
        at: Numbers = 0.0,
    ) -> None:
        count = jnp.shape(jnp.asarray(start))
        self.start = numbers(start, (count or (1,))[:1], "The start of a slew", "")
        self.goal = numbers(goal, self.start.shape, "The goal of a slew", "")
        self.duration = positive(duration, "The duration of a slew", "s")
        shape = (jnp.shape(jnp.asarray(coefficients)) or (1,))[:1]
        self.coefficients = numbers(coefficients, shape, "The coefficients of a slew", "1")
        self.at = numbers(at, (), "The beginning of a slew", "s")

    def value(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """Values (n,) at a time [s]."""
        s = jnp.clip((t - self.at) / self.duration, 0.0, 1.0)
        return self.start + rise(s, self.coefficients) * (self.goal - self.start)

    def __call__(
        self, t: Float[Array, ""]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Values, rates and accelerations, each (n,); `PairMotion(*slew(t))` is for a panel."""
        return motion_along(self.value, jnp.asarray(t, dtype=float))


def within(x: Numbers, lowest: Numbers, highest: Numbers) -> Float[Array, "..."]:
    """Numbers strictly between two bounds from any x: lowest + (highest - lowest) / (1 + e^-x).

    A search over x keeps a duration, or a gain, within its bounds; x = 0 is half-way between them.

    Raises:
        SettingError: a lowest bound that is not below the highest.
    """
    if concrete(lowest, highest) and not np.all(np.asarray(lowest) < np.asarray(highest)):
        raise SettingError(
            f"The lowest bound must be below the highest, but they are {lowest} and {highest}."
        )
    low, high = jnp.asarray(lowest, dtype=float), jnp.asarray(highest, dtype=float)
    return low + (high - low) * jax.nn.sigmoid(jnp.asarray(x, dtype=float))
