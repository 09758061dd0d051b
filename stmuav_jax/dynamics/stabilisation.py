"""What keeps a differentiated constraint from drifting: nothing, feedback, or projection."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.shapes import Numbers
from ..mechanics.errors import SettingError, concrete


class AbstractStabilisation(eqx.Module):
    """How the constraints are held at position and velocity level."""


class Unstabilised(AbstractStabilisation):
    """Index-1 equations as they are; positions drift quadratically in time."""


class Baumgarte(AbstractStabilisation):
    """Feedback of the residuals: gamma - 2 alpha (J qdot - target) - beta^2 Phi.

    Args:
        alpha, beta: [1/s]; alpha = beta is critical damping. Errors then decay as
            exp(-alpha t), and steps are limited to a few 1/alpha.
        norm: [1/s], the same for Euler parameters: pdot gets norm (1 - p . p) p.

    Source: J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16.
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]
    norm: Float[Array, ""]

    def __init__(self, alpha: Numbers = 10.0, beta: Numbers = 10.0, norm: Numbers = 10.0) -> None:
        gains = {"alpha": alpha, "beta": beta, "norm": norm}
        for name, value in gains.items():
            if concrete(value) and not (np.isfinite(value) and value >= 0):  # pyright: ignore
                raise SettingError(
                    f"The Baumgarte gain {name} must be finite and not negative, but it is {value} 1/s."
                )
        self.alpha, self.beta, self.norm = (jnp.asarray(g, dtype=float) for g in gains.values())


class Projection(AbstractStabilisation):
    """After each step: nearest positions, norms and velocities that satisfy the constraints.

    Nearest in the mass metric, by simplified Newton iterations with one factorisation.

    Args:
        iterations: of the positions; each multiplies the residual by about the size of the
            step's own error, so three serve tolerances down to 1e-3.

    Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996),
    section VII.2; C. Lubich et al., MEXX (1992).
    """

    iterations: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.iterations < 1:
            raise SettingError(f"Projection needs at least 1 iteration, not {self.iterations}.")
