"""Levenberg-Marquardt steps with second-order corrections, for nonlinear least squares.

A step solves min |r + J d|^2 + damping |d|^2. Where some residuals have large weights, such as the
defects of multiple shooting, their curvature spoils every step but the shortest, and the search creeps
along a curved valley. A correction takes the remainder of the linear model at the end of the step,

    q = r(x + s) - (r + J d),    s <- s - (J^T J + damping 1)^-1 J^T q,

which costs one more value of the residuals and no Jacobian. Corrections go on as long as they help:
values of a motion cost much less than its Jacobian.

Source: J. Fan, The modified Levenberg-Marquardt method for nonlinear equations with cubic convergence,
Mathematics of Computation 81 (2012); J. Nocedal, S. J. Wright, Numerical Optimization (2006), ch. 10.3
(damping by the ratio of actual and predicted reduction) and ch. 15.5 (second-order corrections).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy.linalg
from jaxtyping import Float

from ..checks.numbers import as_jax

# Smallest ratio of actual and predicted reduction with which a step is taken.
_TAKEN = 1e-2
# Ratios from which on the damping falls, and its factors; a step that is not taken takes back the largest
# fall. Where corrections follow the curvature a step can be long: with factors of 0.25 and 4 the slew of
# the UAV took 11 steps instead of 8, and holding it in segments of 0.05 s 9 instead of 6.
_FALLS, _MORE = ((0.95, 0.05), (0.75, 0.25)), 20.0
# A step that reaches this share of the predicted reduction needs no correction, and corrections end with
# one that adds less than this share of the reduction so far.
_ENOUGH, _LITTLE = 0.9, 0.01


class Attempt(NamedTuple):
    """Result of one step.

    Attributes:
        values: values after the step, or those before it if it is not taken. loss: half the sum of squares
            there. damping: that of the next step. taken: the step is taken. done: it has converged.
    """

    values: Any
    loss: float
    damping: float
    taken: bool
    done: bool


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
    corrections: int = eqx.field(static=True, default=10)

    def attempt(
        self, residuals: Callable[[Any], Any], values: Any, seen: Any, damping: float
    ) -> Attempt:
        """One step from values whose residuals and Jacobian have been seen.

        Everything but the residuals is computed by NumPy and LAPACK, for which nothing is compiled.

        Args:
            residuals: values -> residuals, any pytree. seen: residuals and columns of their Jacobian at
                the values, as `value_and_columns` gives them.
        """
        x, r, J = _vector(values), _vector(seen[0]), _rows(seen[1])
        m, n = J.shape
        Q, R = np.linalg.qr(np.concatenate([J, np.sqrt(damping) * np.eye(n)]))
        towards = lambda q: scipy.linalg.solve_triangular(R, -(Q[:m].T @ q))
        step, before = towards(r), float(r @ r)
        linear = r + J @ step
        predicted = before - float(linear @ linear)
        best, squares = np.zeros(n), np.inf
        for k in range(1 + self.corrections):
            found = _vector(residuals(_like(values, x + step)))
            now, last = float(found @ found), squares
            if not now < last:
                break
            best, squares = step, now
            enough = before - now >= _ENOUGH * predicted
            if enough if k == 0 else last - now <= _LITTLE * (before - now):
                break
            step = step + towards(found - linear)
        ratio = (before - squares) / predicted if predicted > 0 else -np.inf
        taken = bool(ratio > _TAKEN)
        loss, after = 0.5 * before, 0.5 * squares
        still = bool(np.all(np.abs(best) <= self.atol + self.rtol * np.abs(x)))
        still &= loss - after <= self.atol**2 + self.rtol * loss
        # nothing is left to gain beyond round-off
        flat = predicted <= 4 * np.finfo(float).eps * before
        return Attempt(
            values=_like(values, x + best) if taken else values,
            loss=after if taken else loss,
            damping=damping * (_fall(ratio) if taken else _MORE),
            taken=taken,
            done=(taken and still) or flat,
        )


def _fall(ratio: float) -> float:
    """Factor of the damping after a step with this ratio of actual and predicted reduction."""
    return next((factor for least, factor in _FALLS if ratio > least), 1.0)


def _vector(tree: Any) -> Float[np.ndarray, " n"]:
    """All numbers of a pytree."""
    return np.concatenate([np.zeros(0), *(np.ravel(leaf) for leaf in jax.tree.leaves(tree))])


def _rows(columns: Any) -> Float[np.ndarray, "m n"]:
    """Jacobian from a pytree of its columns, which are the leaves' last axes."""
    leaves = [np.asarray(leaf) for leaf in jax.tree.leaves(columns)]
    return np.concatenate([leaf.reshape(-1, leaf.shape[-1]) for leaf in leaves])


def _like(tree: Any, x: Float[np.ndarray, " n"]) -> Any:
    """Pytree of the same form with other numbers."""
    leaves, structure = jax.tree.flatten(tree)
    parts = np.split(x, np.cumsum([np.size(leaf) for leaf in leaves])[:-1])
    pairs = zip(parts, leaves, strict=True)
    return jax.tree.unflatten(structure, [as_jax(x.reshape(np.shape(leaf))) for x, leaf in pairs])
