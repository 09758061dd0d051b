"""Stabilisation of the constraints: none, Baumgarte's feedback, or projection after each step.

A stabilisation is defined by three methods. A formulation calls the first two at every evaluation,
so that one stabilisation serves all formulations; the integration calls the third once.
"""

from abc import abstractmethod

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import SettingError, has_values
from ...checks.shapes import Numbers


class AbstractStabilisation(eqx.Module):
    """Method that keeps the constraints satisfied at position and velocity level."""

    @abstractmethod
    def add_row_feedback(
        self, gamma: Float[Array, "m *s"], value: Float[Array, "m *s"], rate: Float[Array, "m *s"]
    ) -> Float[Array, "m *s"]:
        """Right-hand side of the rows J qddot = gamma, with the stabilising feedback.

        Args:
            gamma: right-hand side without feedback (m, *s).
            value: Phi (m, *s). rate: J qdot - target (m, *s).
        """

    @abstractmethod
    def add_norm_feedback(
        self, rate: Float[Array, "4 *s"], p: Float[Array, "4 *s"]
    ) -> Float[Array, "4 *s"]:
        """Rates of Euler parameters [1/s], with the feedback that restores their unit norm.

        Args:
            rate: rates without feedback, components first (4, *s) [1/s].
            p: Euler parameters (4, *s).
        """

    @abstractmethod
    def iterations_after_step(self) -> int:
        """Number of Newton iterations that project the end of a step; zero for no projection."""


class Unstabilised(AbstractStabilisation):
    """Index-1 equations without stabilisation; positions drift quadratically in time."""

    def add_row_feedback(self, gamma: Array, value: Array, rate: Array) -> Array:
        del value, rate
        return gamma

    def add_norm_feedback(self, rate: Array, p: Array) -> Array:
        del p
        return rate

    def iterations_after_step(self) -> int:
        return 0


class Baumgarte(AbstractStabilisation):
    """Feedback of the residuals: gamma - 2 alpha (J qdot - target) - beta^2 Phi.

    Args:
        alpha, beta: gains [1/s]; alpha = beta is critical damping. Errors then decay as
            exp(-alpha t), and steps are limited to a few 1/alpha.
        norm: gain for Euler parameters [1/s]: pdot gets the term norm (1 - p . p) p.

    Source: J. Baumgarte, Comput. Methods Appl. Mech. Eng. 1 (1972) 1-16.
    """

    alpha: Float[Array, ""]
    beta: Float[Array, ""]
    norm: Float[Array, ""]

    def __init__(self, alpha: Numbers = 10.0, beta: Numbers = 10.0, norm: Numbers = 10.0) -> None:
        gains = {"alpha": alpha, "beta": beta, "norm": norm}
        for name, value in gains.items():
            if has_values(value) and not (np.isfinite(value) and value >= 0):  # pyright: ignore
                raise SettingError(
                    f"The Baumgarte gain {name} must be finite and not negative, but it is {value} 1/s."
                )
        self.alpha, self.beta, self.norm = (jnp.asarray(g, dtype=float) for g in gains.values())

    def add_row_feedback(self, gamma: Array, value: Array, rate: Array) -> Array:
        return gamma - (2 * self.alpha * rate + self.beta**2 * value)

    def add_norm_feedback(self, rate: Array, p: Array) -> Array:
        return rate + self.norm * (1 - jnp.sum(p**2, axis=0)) * p

    def iterations_after_step(self) -> int:
        return 0


class Projection(AbstractStabilisation):
    """Projection after each step to the nearest positions, norms and velocities on the constraints.

    The distance is measured in the mass metric; simplified Newton iterations use one factorisation.

    Args:
        iterations: number of iterations for the positions; each multiplies the residual by about
            the size of the step's own error, so that three serve tolerances down to 1e-3.

    Source: E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996),
    section VII.2; C. Lubich et al., MEXX (1992).
    """

    iterations: int = eqx.field(static=True, default=3)

    def __check_init__(self) -> None:
        if self.iterations < 1:
            raise SettingError(f"Projection needs at least 1 iteration, not {self.iterations}.")

    def add_row_feedback(self, gamma: Array, value: Array, rate: Array) -> Array:
        del value, rate
        return gamma

    def add_norm_feedback(self, rate: Array, p: Array) -> Array:
        del p
        return rate

    def iterations_after_step(self) -> int:
        return self.iterations
