"""Gauss-Legendre collocation with fixed steps: the symmetric comparator for long horizons.

    Y_i = y0 + h sum_j a_ij f(t0 + c_j h, Y_j),     y1 = y0 + h sum_i b_i f(t0 + c_i h, Y_i)

With one stage it is the implicit midpoint rule (order 2), with two it has order 4. Both are
symmetric, keep quadratic invariants exactly, and are symplectic where y is canonical.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), sections
II.1.3 (coefficients), IV.2 (quadratic invariants) and VIII.6 (iterations to round-off).
"""

from typing import Any, NamedTuple

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

_ROOT = float(np.sqrt(3.0))
_TABLES = {
    1: (np.array([[0.5]]), np.array([1.0]), np.array([0.5])),
    2: (
        np.array([[1 / 4, 1 / 4 - _ROOT / 6], [1 / 4 + _ROOT / 6, 1 / 4]]),
        np.array([0.5, 0.5]),
        np.array([0.5 - _ROOT / 6, 0.5 + _ROOT / 6]),
    ),
}
# The slopes' polynomial through c_1 and c_2, continued to 1 + c_1 and 1 + c_2: the first guess.
_GUESS = {1: np.array([[1.0]]), 2: np.array([[1 - _ROOT, _ROOT], [-_ROOT, 1 + _ROOT]])}


class GaussState(NamedTuple):
    """The last step's slopes, and how many evaluations of f all steps took so far."""

    slopes: Float[Array, "s k"]
    evaluations: Int[Array, ""]


class Gauss(diffrax.AbstractSolver):
    """One or two Gauss-Legendre stages by fixed-point iterations to round-off.

    It has no error estimate: steps are fixed. A step whose iterations do not converge fails
    with `nonlinear_divergence`. Between steps it interpolates linearly.

    Args:
        stages: 1 or 2.
    """

    stages: int = eqx.field(static=True, default=2)

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return diffrax.ODETerm

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        return 2 * self.stages

    def init(self, terms: Any, t0: Any, t1: Any, y0: Vector, args: Any) -> GaussState:
        slope = terms.vf(t0, y0, args)
        return GaussState(jnp.tile(slope, (self.stages, 1)), jnp.ones((), int))

    def func(self, terms: Any, t0: Any, y0: Vector, args: Any) -> Any:
        return terms.vf(t0, y0, args)

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Vector,
        args: Any,
        solver_state: GaussState,
        made_jump: Any,
    ) -> tuple[Vector, None, Any, GaussState, diffrax.RESULTS]:
        # the remembered slopes are a first guess only, so a jump does no harm
        del made_jump
        h = t1 - t0
        A, b, c = (jnp.asarray(part, y0.dtype) for part in _TABLES[self.stages])
        field = jax.vmap(lambda t, y: terms.vf(t, y, args))

        def again(slopes: Float[Array, "s k"]) -> Float[Array, "s k"]:
            return field(t0 + c * h, y0 + h * A @ slopes)

        guess = jnp.asarray(_GUESS[self.stages], y0.dtype) @ solver_state.slopes
        slopes, count, converged = _fixed_point(again, guess, h / (1 + jnp.abs(y0)))
        y1 = y0 + h * b @ slopes
        state = GaussState(slopes, solver_state.evaluations + self.stages * count)
        results: Any = diffrax.RESULTS
        good, bad = results.successful, results.nonlinear_divergence
        result = results.where(converged, good, bad)
        return y1, None, {"y0": y0, "y1": y1}, state, result


def _fixed_point(
    again: Any, guess: Float[Array, "s k"], weight: Vector
) -> tuple[Float[Array, "s k"], Int[Array, ""], Array]:
    """Iterate to round-off: the slopes, the number of iterations, whether they converged."""

    def going(now: Any) -> Array:
        _, moved, before, count = now
        stalled = (moved >= before) & (moved <= _STALLED)
        return (moved > _DONE) & ~stalled & jnp.isfinite(moved) & (count < _MOST)

    def iterate(now: Any) -> Any:
        slopes, moved, _, count = now
        after = again(slopes)
        return after, jnp.max(jnp.abs((after - slopes) * weight)), moved, count + 1

    first = iterate((guess, jnp.asarray(jnp.inf, guess.dtype), None, jnp.zeros((), int)))
    slopes, moved, _, count = jax.lax.while_loop(going, iterate, first)
    return slopes, count, moved <= _STALLED
