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


def rk4_step(rate: Callable[[Array, Any], Array], x: Array, h: Any) -> Array:
    """State after h [s] by the classical fourth-order method.

    Args:
        rate: function of the state and of the time since the beginning of the step [s].
    """
    k1 = rate(x, 0.0)
    k2 = rate(x + h / 2 * k1, h / 2)
    k3 = rate(x + h / 2 * k2, h / 2)
    k4 = rate(x + h * k3, h)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)


def rk4_step_in_loop(rate: Callable[[Array, Any], Array], x: Array, h: Any) -> Array:
    """`rk4_step` with its four stages as a loop, for rates that take long to compile: once here."""

    def stage(carry: Any, now: Array) -> Any:
        k, total = carry
        node, weight = now
        k = rate(x + h * node * k, h * node)
        return (k, total + weight * k), None

    nodes = jnp.array([[0.0, 1 / 6], [0.5, 1 / 3], [0.5, 1 / 3], [1.0, 1 / 6]], x.dtype)
    (_, total), _ = jax.lax.scan(stage, (0.0 * x, 0.0 * x), nodes)
    return x + h * total


def rk4(rates: Rates, substeps: int = 1) -> Step:
    """Step of the classical fourth-order Runge-Kutta method, with inputs held over the step.

    Raises:
        SettingError: `substeps` is less than one.
    """
    if substeps < 1:
        raise SettingError(f"rk4 needs at least one substep, not {substeps}.")
    return RungeKuttaStep(rates, substeps)
