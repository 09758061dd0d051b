"""Gauss-Legendre collocation with fixed steps: the symmetric comparator for long horizons.

    Y_i = y0 + h sum_j a_ij f(t0 + c_j h, Y_j),     y1 = y0 + h sum_i b_i f(t0 + c_i h, Y_i)

With one stage it is the implicit midpoint rule (order 2), with two it has order 4. Both are
symmetric, keep quadratic invariants exactly, and are symplectic where y is canonical.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), sections
II.1.3 (coefficients), IV.2 (quadratic invariants) and VIII.6 (iterations to round-off).
"""

from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

Vector = Float[Array, " k"]

# Iterations end where the stages move by less than this, relative to 1 + |y|; or where round-off
# keeps them from moving less, if that is below the second figure. Otherwise the step has failed.
_DONE, _STALLED = 1e-15, 1e-10
_MOST = 100


def coefficients(stages: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, b and c; and the slopes' polynomial continued to the next step, as a first guess there."""
    x, weights = np.polynomial.legendre.leggauss(stages)
    c, k = (1 + x[:, None]) / 2, np.arange(stages)
    values = np.linalg.inv(c**k)
    return c ** (k + 1) / (k + 1) @ values, weights / 2, c[:, 0], (1 + c) ** k @ values


class GaussState(NamedTuple):
    """The last step's slopes, and how many evaluations of f all steps took so far."""

    slopes: Float[Array, "s k"]
    evaluations: Int[Array, ""]


class Gauss(diffrax.AbstractSolver):
    """Gauss-Legendre stages by fixed-point iterations to round-off.

    It has no error estimate: steps are fixed. A step whose iterations do not converge fails
    with `nonlinear_divergence`. Between steps it interpolates linearly.
    """

    term_structure: ClassVar = diffrax.ODETerm
    interpolation_cls: ClassVar = diffrax.LocalLinearInterpolation
    stages: int = eqx.field(static=True, default=2)

    def order(self, terms: Any) -> int:
        return 2 * self.stages

    def init(self, terms: Any, t0: Any, t1: Any, y0: Vector, args: Any) -> GaussState:
        slope = terms.vf(t0, y0, args)
        return GaussState(jnp.tile(slope, (self.stages, 1)), jnp.ones((), int))

    def func(self, terms: Any, t0: Any, y0: Vector, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self, terms: Any, t0: Any, t1: Any, y0: Any, args: Any, solver_state: Any, made_jump: Any
    ) -> tuple[Vector, None, Any, GaussState, diffrax.RESULTS]:
        # the remembered slopes are a first guess only, so a jump does no harm
        del made_jump
        h = t1 - t0
        A, b, c, guess = (jnp.asarray(part, y0.dtype) for part in coefficients(self.stages))
        field = jax.vmap(lambda t, y: terms.vf(t, y, args))

        def going(now: Any) -> Array:
            _, moved, before, count = now
            stalled = (moved >= before) & (moved <= _STALLED)
            return (moved > _DONE) & ~stalled & jnp.isfinite(moved) & (count < _MOST)

        def iterate(now: Any) -> Any:
            slopes, moved, _, count = now
            after = field(t0 + c * h, y0 + h * A @ slopes)
            change = jnp.max(jnp.abs((after - slopes) * h / (1 + jnp.abs(y0))))
            return after, change, moved, count + 1

        first = (guess @ solver_state.slopes, jnp.asarray(jnp.inf), None, jnp.zeros((), int))
        slopes, moved, _, count = jax.lax.while_loop(going, iterate, iterate(first))
        y1 = y0 + h * b @ slopes
        state = GaussState(slopes, solver_state.evaluations + self.stages * count)
        results: Any = diffrax.RESULTS
        good, bad = results.successful, results.nonlinear_divergence
        result = results.where(moved <= _STALLED, good, bad)
        return y1, None, {"y0": y0, "y1": y1}, state, result
