"""Discretisation of rates by Euler's and the classical Runge-Kutta method, for vector states."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..checks.errors import SettingError

Rates = Callable[[Float[Array, "n *s"], Any], Float[Array, "n *s"]]
Step = Callable[[Float[Array, "n *s"], Any, Any], Float[Array, "n *s"]]

# Node and six times the weight of each stage of the classical Runge-Kutta method.
_STAGES = ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0))


class EulerStep(eqx.Module):
    """Step x + dt rates(x, u) of Euler's method; see `euler`."""

    rates: Rates

    def __call__(self, x: Array, u: Any, dt: Any) -> Array:
        return x + dt * self.rates(x, u)


class RungeKuttaStep(eqx.Module):
    """Step of the classical fourth-order Runge-Kutta method; see `rk4`."""

    rates: Rates
    substeps: int = eqx.field(static=True)

    def __call__(self, x: Array, u: Any, dt: Any) -> Array:
        h = dt / self.substeps
        for _ in range(self.substeps):
            x = rk4_step(lambda x, _: self.rates(x, u), x, h)
        return x


def euler(rates: Rates) -> Step:
    """Step x + dt rates(x, u) of Euler's method."""
    return EulerStep(rates)


def rk4_step(
    rate: Callable[[Array, Any], Array], x: Array, h: Any, *, in_loop: bool = False
) -> Array:
    """State after h [s] by the classical fourth-order method.

    Args:
        rate: function of the state and of the time since the beginning of the step [s].
        in_loop: take the four stages in a loop, for rates that take long to compile: once there,
            against four times. Short rates run faster one after the other.
    """

    def stage(carry: Any, now: Any) -> tuple[Any, None]:
        k, total = carry
        node, weight = now
        k = rate(x + h * node * k, h * node)
        return (k, total + weight * k), None

    if in_loop:
        zero = 0.0 * x
        (_, total), _ = jax.lax.scan(stage, (zero, zero), jnp.array(_STAGES, x.dtype))
        return x + h / 6 * total
    first = rate(x, 0.0)
    carry = (first, first)
    for now in _STAGES[1:]:
        carry, _ = stage(carry, now)
    return x + h / 6 * carry[1]


def rk4(rates: Rates, substeps: int = 1) -> Step:
    """Step of the classical fourth-order Runge-Kutta method, with inputs held over the step.

    Raises:
        SettingError: `substeps` is less than one.
    """
    if substeps < 1:
        raise SettingError(f"rk4 needs at least one substep, not {substeps}.")
    return RungeKuttaStep(rates, substeps)
