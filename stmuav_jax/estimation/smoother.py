"""Unscented Rauch-Tung-Striebel smoother: estimates from all measurements, also later ones.

With the prediction's joint deviations of x_k and x_(k+1), triangularised to [L-, 0; D, T],

    G = D L-^-1,   mean <- mean + G (mean_s(k+1) - mean-),   P <- T T^T + (G L_s)(G L_s)^T

so that each covariance is a sum of squares, without the subtraction of the usual form.

Source: S. Sarkka, Unscented Rauch-Tung-Striebel smoother, IEEE TAC 53 (2008); square roots:
S. Sarkka, L. Svensson, Bayesian filtering and smoothing, 2nd ed. (2023), ch. 12 and 14.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.space import Point
from .check import check_functions, check_prior
from .factor import divide_lower, downdate, outer_square, triangularise
from .filter import Filtered
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .sigma import AbstractRule


class Smoothed(eqx.Module):
    """Smoothed estimates, given all T measurements.

    Attributes:
        mean: T points: an array (T, n, *s) or a pytree of such arrays.
        factor: roots of the covariances (T, n, n, *s).
        start: smoothed estimate at the time of the prior.
    """

    mean: Point
    factor: Float[Array, "T n n *s"]
    start: Gaussian

    @property
    def covariance(self) -> Float[Array, "T n n *s"]:
        """Covariances P at each time."""
        return jax.vmap(outer_square)(self.factor)

    @property
    def standard_deviation(self) -> Float[Array, "T n *s"]:
        """Standard deviations at each time."""
        return jnp.sqrt(jnp.sum(self.factor**2, axis=2))


def smooth(
    model: StateSpaceModel, filtered: Filtered, *, rule: AbstractRule | None = None
) -> Smoothed:
    """Smooth the estimates of `kalman_filter` in a backward pass.

    Args:
        rule: rule for the transformation of Gaussians; by default the filter's.

    Raises:
        ModelError, SettingError: the model does not fit the record, as in `kalman_filter`.
    """
    rule = filtered.method.rule if rule is None else rule
    prior = filtered.prior
    check_prior(model, prior, rule)
    now = jax.tree.map(lambda leaf: jax.ShapeDtypeStruct(leaf.shape[1:], leaf.dtype), filtered.u)
    check_functions(model, prior, now)
    first = jax.tree.map(lambda leaf: leaf[None], (prior.mean, prior.factor))
    found = filtered.mean, filtered.factor
    # the estimates before each step, the prior first
    before = jax.tree.map(lambda a, b: jnp.concatenate([a, b[:-1]]), first, found)
    last = filtered.at(-1)

    def step(later: Gaussian, now: tuple) -> tuple[Gaussian, Gaussian]:
        (mean, factor), u, dt = now
        earlier = _back(model, Gaussian(mean, factor), later, u, dt, rule)
        return earlier, earlier

    start, path = jax.lax.scan(step, last, (before, filtered.u, filtered.dt), reverse=True)
    path = jax.tree.map(lambda a, b: jnp.concatenate([a[1:], b[None]]), path, last)
    return Smoothed(path.mean, path.factor, start)


def _back(
    model: StateSpaceModel,
    estimate: Gaussian,
    later: Gaussian,
    u: Inputs,
    dt: Float[Array, ""],
    rule: AbstractRule,
) -> Gaussian:
    """Smoothed estimate at k from the filter's at k and the smoothed one at k + 1 (`later`)."""
    space, n = model.space, model.space.size
    moved = rule.transform(lambda x: model(x, u, dt), estimate, space, space)
    both = triangularise(_joint(moved.rows, moved.inputs, model.step_noise(dt, moved.rows.ndim)))
    if moved.less is not None:
        both = downdate(both, jnp.concatenate([moved.less, jnp.zeros_like(moved.less)]))
    root, cross, rest = both[:n, :n], both[n:, :n], both[n:, n:]
    apart = space.difference(later.mean, moved.mean)
    right = divide_lower(root, jnp.concatenate([apart[:, None], later.factor], axis=1))
    # transpose first, so that sums run over the leading axis
    turned = jnp.swapaxes(cross, 0, 1)
    move = jnp.sum(turned * right[:, :1], axis=0)
    spread = jnp.sum(turned[:, :, None] * right[:, None, 1:], axis=0)
    rows = jnp.concatenate([jnp.swapaxes(rest, 0, 1), jnp.swapaxes(spread, 0, 1)])
    return Gaussian(space.retract(estimate.mean, move), triangularise(rows))


def _joint(rows: Array, inputs: Array, noise: Array) -> Array:
    """Rows whose Gram matrix is the joint covariance of (x_(k+1), x_k)."""
    r, n = rows.shape[:2]
    lanes = rows.shape[2:]
    none = jnp.zeros((r - inputs.shape[0], n, *lanes), rows.dtype)
    turned = jnp.broadcast_to(jnp.swapaxes(noise, 0, 1), (n, n, *lanes))
    return jnp.concatenate(
        [
            jnp.concatenate([rows, jnp.concatenate([inputs, none])], axis=1),
            jnp.concatenate([turned, jnp.zeros_like(turned)], axis=1),
        ]
    )
