"""Explicit Runge-Kutta steps without the stages that only serve an interpolant."""

from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.shapes import StateVector


class RecordedStep(diffrax.LocalLinearInterpolation):
    """Linear interpolant of a step, with the slopes of its stages (s, k) as a record."""

    slopes: Array


class RungeKutta4(diffrax.AbstractERK):
    """Classical Runge-Kutta method of order 4, for steps of fixed length: it estimates no error.

    It takes steps with everything that a `Method` adds to a solver of diffrax, such as the projection
    onto the constraints; the filters' `rk4_step` takes plain steps of a vector.

    Source: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993),
    section II.1.
    """

    scan_kind: None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(  # pyright: ignore[reportIncompatibleVariableOverride]
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        del terms
        return 4


class AbstractNonDense(diffrax.AbstractAdaptiveSolver):
    """Base of methods that take a method's coefficients from diffrax, without its dense output.

    The interpolation within steps is linear, so steps must end at the output times.

    Attributes:
        method: Runge-Kutta method of diffrax, which has the orders.
    """

    method: eqx.AbstractVar[Any]

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return RecordedStep

    def order(self, terms: Any) -> int | None:
        return self.method.order(terms)

    def strong_order(self, terms: Any) -> Any:
        return self.method.strong_order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.method.error_order(terms)

    def func(self, terms: Any, t0: Any, y0: StateVector, args: Any) -> Any:
        return terms.vf(t0, y0, args)


class NonDenseRungeKutta(AbstractNonDense):
    """Explicit Runge-Kutta method of diffrax without its dense output.

    The tableau and, up to round-off, the steps are those of the method: one loop over the
    stages, their slopes in one array, without the stages that only serve interpolation. The
    interpolation within steps is linear, so steps must end at the output times.

    Args:
        method: explicit Runge-Kutta method of diffrax, such as `diffrax.Dopri8()`.
    """

    method: diffrax.AbstractERK

    def init(self, terms: Any, t0: Any, t1: Any, y0: StateVector, args: Any) -> None:
        return None

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: StateVector,
        args: Any,
        solver_state: None,
        made_jump: Any,
    ) -> tuple[StateVector, StateVector, Any, None, diffrax.RESULTS]:
        del solver_state, made_jump
        A, b, b_error, c = coefficients(self.method)
        h = terms.contr(t0, t1)

        def stage(slopes: Float[Array, "s k"], at: tuple[Any, Any, Any]) -> tuple[Any, None]:
            row, weight, number = at
            y = y0 + h * jnp.sum(row[:, None] * slopes, axis=0)
            slope = terms.vf(t0 + weight * h, y, args)
            return jax.lax.dynamic_update_index_in_dim(slopes, slope, number, 0), None

        stages = len(c)
        start = jnp.zeros((stages, y0.shape[0]), y0.dtype)
        table = (jnp.asarray(A), jnp.asarray(c), jnp.arange(stages))
        slopes, _ = jax.lax.scan(stage, start, table)
        y1 = y0 + h * jnp.sum(b[:, None] * slopes, axis=0)
        error = h * jnp.sum(b_error[:, None] * slopes, axis=0)
        dense_info = {"y0": y0, "y1": y1, "slopes": slopes}
        return y1, error, dense_info, None, diffrax.RESULTS.successful


def coefficients(
    method: diffrax.AbstractERK,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Butcher coefficients A (s, s), b, those of the error, and c (s,).

    Final stages that neither the step nor its error needs are left out.
    """
    tableau: Any = method.tableau
    count = len(tableau.b_sol)
    A = np.zeros((count, count))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    c = np.concatenate([[0.0], tableau.c])
    b, b_error = np.asarray(tableau.b_sol), np.asarray(tableau.b_error)
    used = np.flatnonzero((b != 0) | (b_error != 0))
    last = int(used[-1]) + 1
    return A[:last, :last], b[:last], b_error[:last], c[:last]
