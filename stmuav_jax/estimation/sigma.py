"""Transformation of a Gaussian by a function: sigma-point rules, and linearisation.

Every sigma-point rule has a central point and pairs at m + s_j and m - s_j, s_j = L d_j, of weight
w_j each. With the values relative to the central one, o_j = (f+ - f-) / 2 and e_j = (f+ + f-) / 2:

    mean = f0 + delta,   delta = sum 2 w_j e_j,   W = sum 2 w_j,   ebar = delta / W
    P = sum 2 w_j [o_j o_j^T + (e_j - ebar)(e_j - ebar)^T] + (g - 1 + 1 / W) delta delta^T

with g the central weight of the covariance less that of the mean. This is the usual weighted
sum, rearranged. For the scaled unscented transform the last factor is beta + alpha^2 kappa / n:
even a central weight of -95 (the report's) needs no subtraction, and P is a sum of squares
unless kappa or beta is negative; then its square root needs a downdate.

On a space with angles, points beyond half a turn would come back on the other side. Where the farthest
of them is more than a quarter turn away, in the state or (by the function's values close to the mean)
after a step, all distances are reduced by one factor c and the weights w_j divided by c^2, as Julier's
scaling does: W grows likewise, and the last term's factor stays, so that P is a sum of squares as before.

Source: S. J. Julier, The scaled unscented transformation, ACC (2002); I. Arasaratnam, S. Haykin,
Cubature Kalman filters, IEEE TAC 54 (2009); fifth degree: B. Jia, M. Xin, Y. Cheng, High-degree
cubature Kalman filter, Automatica 49 (2013).
"""

import itertools
import math
from abc import abstractmethod
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..math.space import AbstractSpace, Point, expand_axis, half_turns
from .gaussians import Gaussian

Function = Callable[[Point], Point]

# Relative error of a mean up to which a rule may be used in a given precision.
_LOST = 2e-5

# Largest angle between a point and the central one, in half turns: the other half is for what is not linear.
_FARTHEST = 0.5

# Distance, in that of the points, at which their images are taken to grow in proportion.
_NEAR = 1e-3


class Transformed(NamedTuple):
    """Transformed Gaussian, with the covariance rows^T rows - less less^T.

    Attributes:
        mean: mean, a point of the target space.
        rows: rows of deviations (r, m, *s).
        less: vector of the subtracted square (m, *s), or None.
        inputs: deviations of the input along the first q rows (q, n, *s), so that the cross
            covariance is inputs^T rows[:q].
        triangular: True if `inputs` is the transposed root of the input's covariance (q = n).
    """

    mean: Point
    rows: Float[Array, "r m *s"]
    less: Float[Array, "m *s"] | None
    inputs: Float[Array, "q n *s"]
    triangular: bool


class Points(NamedTuple):
    """Directions d_j for unit covariance (q, n), weights w_j of their points (q,), and g."""

    directions: np.ndarray
    weights: np.ndarray
    extra: float


class AbstractRule(eqx.Module):
    """Rule for the transformation of a Gaussian by a function."""

    @abstractmethod
    def transform(
        self, function: Function, prior: Gaussian, source: AbstractSpace, target: AbstractSpace
    ) -> Transformed:
        """Gaussian of function(x) for x from `prior`; the function takes stacks of points."""

    def check(self, n: int, dtype: jnp.dtype) -> None:
        """Raise `SettingError` if the rule cannot be used in n dimensions and this precision; most can."""


class AbstractPointRule(AbstractRule):
    """Rule that evaluates the function at a central point and at pairs of others.

    Attributes:
        means: number of iterations for the mean on a manifold; vectors need none.
    """

    means: int = eqx.field(static=True, default=3, kw_only=True)

    @abstractmethod
    def points(self, n: int) -> Points:
        """Directions and weights for n dimensions."""

    def transform(
        self, function: Function, prior: Gaussian, source: AbstractSpace, target: AbstractSpace
    ) -> Transformed:
        L = prior.factor
        points = self.points(L.shape[0])
        directions, weights, _ = points
        n, q = L.shape[0], len(weights)
        # Points along the columns of L need no product with a matrix of directions.
        axial = q == n
        if axial:
            steps = L * float(directions[0, 0])
        else:
            D = jnp.asarray(directions.T, L.dtype).reshape(1, n, q, *(1,) * (L.ndim - 2))
            steps = jnp.sum(L[:, :, None] * D, axis=1)
        scale = _reduction_factor(function, prior, steps, source, target)
        reduced = steps if scale is None else steps * scale
        # All points go through the function in one call: a simulator compiles once for the stack.
        moves = jnp.concatenate([jnp.zeros_like(L[:, :1]), reduced, -reduced], axis=1)
        images = function(source.retract(expand_axis(prior.mean), moves))
        mean, rows, less = _image_moments(images, points, target, self.means, scale)
        inputs = L if axial else steps * _align_weights(np.sqrt(2 * weights), steps)
        return Transformed(mean, rows, less, jnp.swapaxes(inputs, 0, 1), axial)


class Unscented(AbstractPointRule):
    """Scaled unscented transform, c^2 = alpha^2 (n + kappa), points m +- c L e_j.

    The report's parameters (Table 2.4.2) are alpha = 0.1, beta = 2, kappa = 0.1.
    """

    alpha: float = eqx.field(static=True, default=1.0)
    beta: float = eqx.field(static=True, default=2.0)
    kappa: float = eqx.field(static=True, default=0.0)

    def points(self, n: int) -> Points:
        square = self.alpha**2 * (n + self.kappa)
        weights = np.full(n, 0.5 / square)
        return Points(math.sqrt(square) * np.eye(n), weights, 1 - self.alpha**2 + self.beta)

    def check(self, n: int, dtype: jnp.dtype) -> None:
        square = self.alpha**2 * (n + self.kappa)
        if not (self.alpha > 0 and square > 0):
            raise SettingError(
                f"The unscented rule needs alpha > 0 and n + kappa > 0, but alpha = {self.alpha}, "
                f"n = {n}, kappa = {self.kappa}."
            )
        lost = float(jnp.finfo(dtype).eps) / square
        if lost > _LOST:
            raise SettingError(
                f"alpha = {self.alpha:g} is too small for {jnp.dtype(dtype).name}: sigma points so "
                f"close lose 1 / (alpha^2 (n + kappa)) = {1 / square:.3g} times the precision, a "
                f"relative error of {lost:.1g} of every mean. Use alpha >= 0.1, the Cubature rule, "
                "or double precision (jax_enable_x64)."
            )


class Cubature(AbstractPointRule):
    """Spherical cubature rule of third degree: points m +- sqrt(n) L e_j, equal weights."""

    def points(self, n: int) -> Points:
        return Points(math.sqrt(n) * np.eye(n), np.full(n, 0.5 / n), 0.0)


class Cubature5(AbstractPointRule):
    """Symmetric cubature rule of fifth degree, with 2 n^2 + 1 points.

    The rule is exact for polynomials up to the fifth degree. It is refused from n = 5 on, where
    its axial weights are negative and the covariance need not be positive definite.
    """

    def points(self, n: int) -> Points:
        # Points on the axes and on the diagonals of all coordinate planes match all moments up to the fifth
        # (McNamee and Stenger 1967).
        axes = math.sqrt(n + 2) * np.eye(n)
        pairs = [
            math.sqrt((n + 2) / 2) * (np.eye(n)[i] + sign * np.eye(n)[j])
            for i, j in itertools.combinations(range(n), 2)
            for sign in (1, -1)
        ]
        weights = [(4 - n) / (2 * (n + 2) ** 2)] * n + [1 / (n + 2) ** 2] * len(pairs)
        return Points(np.concatenate([axes, *[p[None] for p in pairs]]), np.array(weights), 0.0)

    def check(self, n: int, dtype: jnp.dtype) -> None:
        if n > 4:
            raise SettingError(
                f"Cubature5 has negative weights for n = {n} > 4 dimensions, so that its "
                "covariances need not be positive definite. Use Cubature or Unscented."
            )


class Linearised(AbstractRule):
    """First-order rule of the extended Kalman filter: the function's derivative along L."""

    def transform(
        self, function: Function, prior: Gaussian, source: AbstractSpace, target: AbstractSpace
    ) -> Transformed:
        # The extended filter is the limit of the point rules for points at no distance: derivatives along the
        # columns of L take the place of differences.
        centre = function(prior.mean)

        def image_error(v: Array) -> Array:
            return target.difference(function(source.retract(prior.mean, v)), centre)

        zero = jnp.zeros(prior.factor.shape[:1] + prior.factor.shape[2:], prior.factor.dtype)
        derivative = lambda v: jax.jvp(image_error, (zero,), (v,))[1]
        # Forward derivatives along n columns cost as much as n points; a full Jacobian times L would cost a
        # product more.
        rows = jax.vmap(derivative, in_axes=1)(prior.factor)
        return Transformed(centre, rows, None, jnp.swapaxes(prior.factor, 0, 1), True)


def _reduction_factor(
    function: Function, prior: Gaussian, steps: Array, source: AbstractSpace, target: AbstractSpace
) -> Float[Array, "*s"] | None:
    """Factor of the points' distances that leaves no angle beyond `_FARTHEST`; None if no space has any.

    Args:
        steps: displacements of the points on one side (n, q, *s).
    """
    # which factor is taken changes what is not linear only: it counts as a constant in derivatives
    steps, prior = jax.lax.stop_gradient((steps, prior))
    turns = None if source.is_flat else half_turns(source, steps)
    if turns is None:
        return None
    largest = jnp.max(turns, axis=0)
    if target is source:
        # a step: a rate that is hardly known turns far in a long one. A sensor's images are left
        # alone, since a bearing has at most half a turn however wide the state is
        moves = jnp.concatenate([jnp.zeros_like(steps[:, :1]), _NEAR * steps], axis=1)
        images = function(source.retract(expand_axis(prior.mean), moves))
        centre = jax.tree.map(lambda leaf: leaf[:, :1], images)
        turns = half_turns(target, target.difference(images, centre))
        assert turns is not None
        largest = jnp.maximum(largest, jnp.max(turns, axis=0) / _NEAR)
    largest = jax.lax.stop_gradient(largest)
    return jnp.where(largest > _FARTHEST, _FARTHEST / jnp.maximum(largest, _FARTHEST), 1.0)


def _align_weights(values: np.ndarray, like: Array) -> Array:
    """Weights (q,) shaped for the second axis of an array (n, q, *s)."""
    return jnp.asarray(values, like.dtype).reshape(1, -1, *(1,) * (like.ndim - 2))


def _image_moments(
    images: Point, points: Points, target: AbstractSpace, means: int, scale: Array | None
) -> tuple[Point, Array, Array | None]:
    """Mean, rows and subtracted square of the images (m, 1 + 2 q, *s).

    Args:
        scale: factor of the points' distances; None for one.
    """
    _, weights, extra = points
    inverse = 1.0 if scale is None else 1 / scale
    # Deviations are taken from the image of the centre, so that large values of a state cancel before
    # they are squared and weights of -95 multiply small numbers only.
    reference = jax.tree.map(lambda leaf: leaf[:, 0], images)

    def split(reference: Point) -> tuple[Array, Array, Array, Array]:
        """Odd and even parts o_j, e_j (m, q, *s), delta, and the central error from a reference."""
        q = len(weights)
        a = target.difference(images, expand_axis(reference))
        centre = a[:, :1]
        plus, minus = a[:, 1 : q + 1] - centre, a[:, q + 1 :] - centre
        odd, even = 0.5 * (plus - minus), 0.5 * (plus + minus)
        weighted = even * _align_weights(2 * weights, even) * inverse**2
        delta = jnp.sum(jnp.swapaxes(weighted, 0, 1), axis=0)
        return odd, even, delta, centre[:, 0]

    odd, even, delta, centre = split(reference)
    if target.is_flat:
        # the centre is the reference, and one round is exact
        reference = target.retract(reference, delta)
    else:
        # On a manifold the mean is defined implicitly by deviations that sum to zero; three rounds of this
        # fixed point leave an error of the order of the deviations to the power of seven.
        for _ in range(means):
            reference = target.retract(reference, delta + centre)
            odd, even, delta, centre = split(reference)
    total = float(np.sum(2 * weights))
    weight = _align_weights(np.sqrt(2 * weights), odd) * inverse
    mean_even = delta[:, None] / (total * inverse**2)
    parts = [odd * weight, (even - mean_even) * weight]
    # The sign of this factor decides whether the shift of the mean adds a row or has to be subtracted.
    # Only kappa or beta below zero make it negative.
    factor = extra - 1 + 1 / total
    less: Array | None = None
    if factor > 1e-14:
        parts.append(math.sqrt(factor) * delta[:, None])
    elif factor < -1e-14:
        less = delta * math.sqrt(-factor)
    return reference, jnp.swapaxes(jnp.concatenate(parts, axis=1), 0, 1), less
