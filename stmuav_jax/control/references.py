"""References of controllers: waypoints of a flying machine, and moves from rest to rest.

With s the share of the time and c_k free coefficients, the share of the way of a move is

    rise(s) = 10 s^3 - 15 s^4 + 6 s^5 + (4 s (1 - s))^3 (c_0 + c_1 z + c_2 z^2 + ...),    z = 2 s - 1,

with zero speed and acceleration at both ends for any coefficients; zeros make the quintic.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.numbers import check_numbers, check_positive
from ..checks.shapes import Numbers
from ..math.derivative import motion_along


class Waypoint(NamedTuple):
    """Target motion of a flying machine at one time.

    Attributes:
        r, v, a: position, velocity, acceleration of the base, world (3,) [m], [m/s], [m/s^2].
        jerk, snap: first and second rate of the acceleration (3,) [m/s^3], [m/s^4].
        heading: yaw of the base's x axis [rad]. turning, turning_rate: its first and second rate
            [rad/s], [rad/s^2].
    """

    r: Float[Array, "3"]
    v: Float[Array, "3"]
    a: Float[Array, "3"]
    jerk: Float[Array, "3"]
    snap: Float[Array, "3"]
    heading: Float[Array, ""]
    turning: Float[Array, ""]
    turning_rate: Float[Array, ""]


def at_point(r: Numbers, heading: Numbers = 0.0) -> Waypoint:
    """Waypoint at rest at a position (3,) [m] with a yaw [rad]."""
    place = check_numbers(r, (3,), "The position of a waypoint", "m")
    yaw = check_numbers(heading, (), "The heading of a waypoint", "rad")
    zero = jnp.zeros(3)
    return Waypoint(place, zero, zero, zero, zero, yaw, jnp.zeros(()), jnp.zeros(()))


def follow_path(path: Callable[[Array], Any], heading: Callable[[Array], Any] | None = None) -> Any:
    """Reference function t -> `Waypoint` from a smooth path t [s] -> (3,) [m], by derivatives.

    Args:
        heading: function of t to the yaw [rad]; by default zero.
    """

    def derivatives(function: Callable[[Array], Any], count: int) -> list[Callable[[Array], Any]]:
        """The function and its derivatives by t up to an order."""
        result = [function]
        for _ in range(count):
            result.append(lambda t, f=result[-1]: jax.jvp(f, (t,), (jnp.ones_like(t),))[1])
        return result

    functions = [
        *derivatives(lambda t: jnp.asarray(path(t)), 4),
        *derivatives(jnp.zeros_like if heading is None else heading, 2),
    ]
    return lambda t: Waypoint(*(function(jnp.asarray(t, dtype=float)) for function in functions))


def quintic_share(s: Float[Array, ""], coefficients: Float[Array, " k"]) -> Float[Array, ""]:
    """Share of the way at a share s of the time, from 0 to 1."""
    quintic = s**3 * (10 - 15 * s + 6 * s**2)
    if not coefficients.size:
        return quintic
    return quintic + (4 * s * (1 - s)) ** 3 * jnp.polyval(coefficients[::-1], 2 * s - 1)


class Slew(eqx.Module):
    """Move of n values from rest to rest, as a function of t [s] to them, their rates and accelerations.

    Args:
        start, goal: values before and after the move (n,).
        duration: time that it takes [s].
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
        self.start = check_numbers(start, (count or (1,))[:1], "The start of a slew", "")
        self.goal = check_numbers(goal, self.start.shape, "The goal of a slew", "")
        self.duration = check_positive(duration, "The duration of a slew", "s")
        shape = (jnp.shape(jnp.asarray(coefficients)) or (1,))[:1]
        self.coefficients = check_numbers(coefficients, shape, "The coefficients of a slew", "1")
        self.at = check_numbers(at, (), "The beginning of a slew", "s")

    def value(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """Values (n,) at a time [s]."""
        s = jnp.clip((t - self.at) / self.duration, 0.0, 1.0)
        return self.start + quintic_share(s, self.coefficients) * (self.goal - self.start)

    def __call__(
        self, t: Float[Array, ""]
    ) -> tuple[Float[Array, " n"], Float[Array, " n"], Float[Array, " n"]]:
        """Values, rates and accelerations, each (n,); `PairMotion(*slew(t))` is for a panel."""
        return motion_along(self.value, jnp.asarray(t, dtype=float))
