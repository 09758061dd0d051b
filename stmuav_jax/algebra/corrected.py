"""Levenberg-Marquardt steps with second-order corrections, for nonlinear least squares.

A step solves min |r + J d|^2 + damping |d|^2. Where some residuals have large weights, such as the
defects of multiple shooting, their curvature spoils every step but the shortest, and the search creeps
along a curved valley. A correction takes the remainder of the linear model at the end of the step,

    q = r(x + s) - (r + J d),    s <- s - (J^T J + damping 1)^-1 J^T q,

which costs one more value of the residuals and no Jacobian.

Source: J. Fan, The modified Levenberg-Marquardt method for nonlinear equations with cubic convergence,
Mathematics of Computation 81 (2012); J. Nocedal, S. J. Wright, Numerical Optimization (2006), ch. 10.3
(damping by the ratio of actual and predicted reduction) and ch. 15.5 (second-order corrections).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float

from ..checks.shapes import Matrix, Vector
from . import lapack
from .compiler import quick_jit

# Smallest ratio of actual and predicted reduction with which a step is taken, the ratio from which on
# the damping falls, and its factors after such a step and after one that is not taken.
_TAKEN, _GOOD, _LESS, _MORE = 1e-2, 0.75, 0.25, 4.0
# A step that reaches this share of the predicted reduction needs no correction.
_ENOUGH = 0.9


class Attempt(NamedTuple):
    """Result of one step.

    Attributes:
        values: values after the step, or those before it if it is not taken. loss: half the sum of squares
            there. damping: that of the next step. taken: the step is taken. done: it has converged.
    """

    values: Any
    loss: Float[Array, ""]
    damping: Float[Array, ""]
    taken: Bool[Array, ""]
    done: Bool[Array, ""]


class _Trial(NamedTuple):
    """Steps tried: the next one, the best one so far and its sum of squares, and whether to go on."""

    count: Any
    step: Vector
    best: Vector
    squares: Float[Array, ""]
    open: Bool[Array, ""]


class CorrectedLevenbergMarquardt(eqx.Module):
    """Method of `search`: Levenberg-Marquardt steps with second-order corrections.

    A search has converged when a step changes the values by less than `atol + rtol |values|` and the loss,
    which is a square, by less than `atol^2 + rtol loss`.

    Attributes:
        rtol, atol: relative and absolute tolerances of the values.
        corrections: largest number of corrections of a step.
    """

    rtol: float = 1e-8
    atol: float = 1e-10
    corrections: int = eqx.field(static=True, default=2)

    @quick_jit
    def attempt(
        self, function: Callable[[Any], Any], values: Any, seen: Any, damping: Float[Array, ""]
    ) -> Attempt:
        """One step from values whose residuals and Jacobian have been seen.

        Args:
            function: values -> residuals, any pytree. seen: residuals and columns of their Jacobian at
                the values, as `value_and_columns` gives them.
        """
        x, unravel = ravel_pytree(values)
        r, J = _flat(seen)
        of = lambda step: ravel_pytree(function(unravel(x + step)))[0]
        m, n = J.shape
        Q, R = lapack.qr(jnp.concatenate([J, jnp.sqrt(damping) * jnp.eye(n)]))
        towards = lambda q: jax.lax.linalg.triangular_solve(
            R, -(Q[:m].T @ q)[:, None], left_side=True, lower=False
        )[:, 0]
        step, before = towards(r), jnp.sum(r**2)
        linear = r + J @ step
        predicted = before - jnp.sum(linear**2)

        def tried(now: _Trial) -> _Trial:
            found = of(now.step)
            squares = jnp.sum(found**2)
            better = squares < now.squares
            rest = jnp.where(jnp.isfinite(found), found - linear, 0.0)
            return _Trial(
                count=now.count + 1,
                step=now.step + towards(rest),
                best=jnp.where(better, now.step, now.best),
                squares=jnp.where(better, squares, now.squares),
                open=jnp.isfinite(squares)
                & (better | (now.count == 0))
                & (squares > before - _ENOUGH * predicted),
            )

        start = _Trial(0, step, jnp.zeros(n), jnp.asarray(jnp.inf), jnp.asarray(True))
        going = lambda now: now.open & (now.count <= self.corrections)
        trial = jax.lax.while_loop(going, tried, start)
        ratio = (before - trial.squares) / predicted
        taken = (ratio > _TAKEN) & jnp.isfinite(trial.squares)
        good = jnp.where(ratio > _GOOD, _LESS, 1.0)
        loss, after = 0.5 * before, 0.5 * trial.squares
        still = jnp.all(jnp.abs(trial.best) <= self.atol + self.rtol * jnp.abs(x))
        still &= loss - after <= self.atol**2 + self.rtol * loss
        # nothing is left to gain beyond round-off
        flat = predicted <= 4 * jnp.finfo(x.dtype).eps * before
        return Attempt(
            values=unravel(jnp.where(taken, x + trial.best, x)),
            loss=jnp.where(taken, after, loss),
            damping=damping * jnp.where(taken, good, _MORE),
            taken=taken,
            done=(taken & still) | flat,
        )


def _flat(seen: tuple[Any, Any]) -> tuple[Vector, Matrix]:
    """Residuals (m,) and their Jacobian (m, n)."""
    value, columns = seen
    r = ravel_pytree(value)[0]
    rows = [x.reshape(-1, x.shape[-1]) for x in jax.tree.leaves(columns)]
    return r, jnp.concatenate(rows)
