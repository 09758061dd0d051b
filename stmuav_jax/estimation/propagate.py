"""From rates to steps: Euler's and the classical Runge-Kutta method, for vector states."""

from collections.abc import Callable
from typing import Any

from jaxtyping import Array, Float

from ..mechanics.errors import SettingError

Rates = Callable[[Float[Array, "n *s"], Any], Float[Array, "n *s"]]
Step = Callable[[Float[Array, "n *s"], Any, Any], Float[Array, "n *s"]]


def euler(rates: Rates) -> Step:
    """x + dt rates(x, u)."""
    return lambda x, u, dt: x + dt * rates(x, u)


def rk4(rates: Rates, substeps: int = 1) -> Step:
    """The classical fourth-order method, inputs held over the step.

    Raises:
        SettingError: fewer than one substep.
    """
    if substeps < 1:
        raise SettingError(f"rk4 needs at least one substep, not {substeps}.")

    def step(x: Array, u: Any, dt: Any) -> Array:
        h = dt / substeps
        for _ in range(substeps):
            k1 = rates(x, u)
            k2 = rates(x + h / 2 * k1, u)
            k3 = rates(x + h / 2 * k2, u)
            k4 = rates(x + h * k3, u)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return step
