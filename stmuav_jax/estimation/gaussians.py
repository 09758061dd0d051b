"""Gaussians, and the lower triangular square roots L of their covariances P = L L^T.

Arrays have their components first and the axes of a stack (the filters of a bank) last. Roots are
formed without squaring by `triangularise_rows`, the QR decomposition of rows whose Gram matrix is P. A
rank-one change of a root has Carlson's closed form: with d_j = d_0 - a_1^2 - ... - a_j^2 the lower
Cholesky factor T of I - a a^T / d_0 is

    T_jj = sqrt(d_j / d_(j-1)),    T_ij = -a_i a_j / sqrt(d_j d_(j-1)),  i > j.

The result for a matrix that is not positive definite is NaN, which callers test for.

Source: N. A. Carlson, Fast triangular formulation of the square root filter, AIAA Journal 11
(1973); Gram-Schmidt's R is as accurate as Householder's: N. J. Higham, Accuracy and Stability
of Numerical Algorithms (2002), theorem 19.13.
"""

from collections.abc import Callable
from functools import wraps
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.errors import ModelError, check_finite, has_values
from ..checks.shapes import Numbers
from ..math import lapack, linalg
from ..math.native.program import is_on, native
from ..math.space import Point, Vector
from ..math.stacked import multiply_matrices

Root = Float[Array, "k k *s"]

# Round-off in a pivot of a covariance, and of its root, that should be zero, in units of epsilon.
_ROUND_OFF, _ROUND_OFF_OF_ROOT = 100, 20

# Columns up to which written-out code is faster than LAPACK for a single matrix, compiled by XLA; products
# of rows and squared columns up to which it is machine code of its own.
_FEW, _FEW_PRODUCTS = 3, 20_000


def in_lanes(function: Callable[..., Any]) -> Callable[..., Any]:
    """Function of arrays of one filter or of a bank, of which the first is a matrix for each filter.

    Machine code takes the filters of a bank one by one, in the lanes of the processor's vectors; compiled by
    XLA, each operation is one over all of them.
    """
    compiled: Any = native(function)

    @wraps(function)
    def call(*args: Array) -> Any:
        if args[0].ndim == 2:
            return compiled(*args)
        if args[0].ndim > 3 or not compiled.has_code(*(a[..., 0] for a in args)):
            return function(*args)
        return jax.vmap(compiled, in_axes=-1, out_axes=-1)(*args)

    return call


def triangularise_rows(rows: Float[Array, "r k *s"]) -> Root:
    """Lower triangular L with diagonal >= 0 and L L^T = rows^T rows.

    The rows are never squared, so parts of L that are small compared with others keep their digits.
    """
    r, k = rows.shape[:2]
    if is_on() and r * k * k <= _FEW_PRODUCTS:
        return _orthogonalise_in_lanes(rows)
    if rows.ndim > 2 or k <= _FEW:
        return _orthogonalise_columns(rows)
    if r < k:
        rows = jnp.concatenate([rows, jnp.zeros((k - r, k), rows.dtype)])
    # Householder's QR factorisation does not square the condition of the rows, as the Cholesky factor of
    # rows^T rows would.
    R = lapack.upper_factor(rows)
    return (jnp.where(jnp.diagonal(R) < 0, -1.0, 1.0)[:, None].astype(R.dtype) * R).T


def _orthogonalise_columns(rows: Float[Array, "r k *s"]) -> Root:
    # Modified Gram-Schmidt, written out: for a bank each operation is one kernel over all its filters,
    # while LAPACK would be called once for each. Every pair of columns is one pass over numbers that stay
    # in registers, which takes half the time of updating all later columns at once.
    remaining, columns = [rows[:, j] for j in range(rows.shape[1])], []
    while remaining:
        first, *remaining = remaining
        square = jnp.sum(first * first, axis=0)
        # a direction without variance: its column of L is zero
        positive = square > 0
        inverse = jnp.where(positive, 1 / jnp.sqrt(jnp.where(positive, square, 1.0)), 0.0)
        inverse = jnp.where(jnp.isnan(square), jnp.nan, inverse)
        unit = first * inverse[None]
        projections = [jnp.sum(other * unit, axis=0) for other in remaining]
        pairs = zip(remaining, projections, strict=True)
        remaining = [other - c[None] * unit for other, c in pairs]
        columns.append(jnp.stack([square * inverse, *projections]))
    return _assemble_triangle(columns)


_orthogonalise_in_lanes = in_lanes(_orthogonalise_columns)


def _assemble_triangle(columns: list[Float[Array, "_ *s"]]) -> Root:
    """Lower triangular matrix from its columns, each from the diagonal down."""
    k = len(columns)
    above = lambda c: jnp.zeros((k - len(c), *c.shape[1:]), c.dtype)
    padded = [c if len(c) == k else jnp.concatenate([above(c), c]) for c in columns]
    return jnp.stack(padded, axis=1) if k else jnp.zeros((0, 0))


def factor_semidefinite(P: Root, scale: Float[Array, "k *s"] | None = None) -> Root:
    """Lower Cholesky factor of positive semi-definite matrices; NaN for any other.

    A pivot of zero, within rounding of `scale`, makes a column of zeros. The factor is
    differentiable as long as the null directions stay: a variance of zero is treated as a
    constant, since its root has no derivative.

    Args:
        scale: sizes of the numbers whose rounding P has; by default its diagonal.
    """
    if scale is None:
        scale = jnp.stack([P[i, i] for i in range(P.shape[0])])
    # The threshold of round-off decides which pivots are zero and has no derivative.
    scale = jax.lax.stop_gradient(scale)
    noise = _ROUND_OFF * jnp.finfo(P.dtype).eps * scale
    columns = []
    for k in range(P.shape[0]):
        pivot, below, allowed = P[0, 0], P[1:, 0], noise[0]
        some = pivot > allowed
        # |P_ij| <= sqrt(P_ii P_jj): the entries beside a pivot of zero are zero
        none = (pivot >= -allowed) & jnp.all(below**2 <= allowed * scale[k + 1 :], axis=0)
        safe = jnp.where(some, pivot, 1.0)
        inverse = jnp.where(some | none, jnp.where(some, 1 / jnp.sqrt(safe), 0.0), jnp.nan)
        column = P[:, 0] * inverse
        columns.append(column)
        P = P[1:, 1:] - column[1:, None] * column[None, 1:]
        # what is subtracted brings the rounding of a small pivot into the others
        shares = jnp.abs(jax.lax.stop_gradient(jnp.where(some, below / safe, 0.0)))
        noise = (jnp.sqrt(noise[1:]) + shares * jnp.sqrt(allowed)) ** 2
    return _assemble_triangle(columns)


def outer_square(L: Root) -> Root:
    """Product L L^T, exactly symmetric."""
    return multiply_matrices(L, jnp.swapaxes(L, 0, 1))


def divide_lower(L: Root, B: Float[Array, "k r *s"]) -> Float[Array, "k r *s"]:
    """Solution L^-1 B for lower triangular L; zero in rows whose pivot is zero within rounding.

    Such a row belongs to a component that the earlier ones determine. Whether B agrees with that is
    left to the caller (`has_contradiction`).
    """
    k = L.shape[0]
    # A pivot at round-off belongs to a direction without variance. Dividing by infinity gives zero there,
    # without a branch and with a zero derivative.
    pivots = jnp.stack([L[i, i] for i in range(k)])
    negligible = _ROUND_OFF_OF_ROOT * jnp.finfo(L.dtype).eps * jnp.max(jnp.abs(L), axis=1)
    # a NaN stays one
    pivots = jnp.where(jnp.abs(pivots) <= negligible, jnp.inf, pivots)
    if L.ndim == 2 and B.ndim == 2 and k > _FEW:
        return linalg.solve_lower(jnp.where(jnp.eye(k, dtype=bool), pivots[:, None], L), B)
    quotients: list[Array] = []
    for i in range(k):
        row = B[0] / (pivots[i][None] if pivots[i].ndim else pivots[i])
        quotients.append(row)
        B = B[1:] - L[1:, 0][:, None] * row[None]
        L = L[1:, 1:]
    return jnp.stack(quotients)


def has_contradiction(
    L: Root, v: Float[Array, "k *s"], x: Float[Array, "k *s"], size: Float[Array, "*s"]
) -> Bool[Array, "*s"]:
    """True where L x is not v, for x from `divide_lower`, beyond the rounding of numbers of a size."""
    residual = v - jnp.sum(jnp.swapaxes(L * x[None], 0, 1), axis=0)
    largest = jnp.maximum(size, jnp.max(jnp.abs(v - residual), axis=0))
    return jnp.max(jnp.abs(residual), axis=0) > jnp.sqrt(jnp.finfo(L.dtype).eps) * largest


def reduce_root(
    M: Float[Array, "i k *s"], a: Float[Array, "k *s"], last: Float[Array, "*#s"]
) -> Float[Array, "i k *s"]:
    """Product M T, T the lower Cholesky factor of I - a a^T / (last + a^T a); see the module.

    With last >= 0 all sums have positive terms, so that nothing cancels.
    """
    # The sums run backwards from the noise: each d_j is the variance of the reading that the states from
    # j on explain, so that all terms are positive.
    d = [jnp.broadcast_to(last, a.shape[1:])]
    for value in a[::-1]:
        d.append(d[-1] + value * value)
    return _scaled_columns(M, a, jnp.stack(d[::-1]))


def _scaled_columns(
    M: Float[Array, "i k *s"], a: Float[Array, "k *s"], d: Float[Array, "_ *s"]
) -> Float[Array, "i k *s"]:
    """Product M T for T with the given d_0, ..., d_k."""
    # no variance before: a has nothing there; none after: all of it is taken
    some, rest = d[:-1] != 0, d[1:] != 0
    # roots before products, which could underflow
    before = jnp.sqrt(jnp.where(some, d[:-1], 1.0))
    after = jnp.sqrt(jnp.where(rest, d[1:], 1.0))
    coupling = jnp.where(some & rest, a / before / after, 0.0)
    diagonal_share = jnp.where(some, jnp.where(rest, after / before, 0.0), 1.0)
    # sums over later columns, in reverse order
    later, columns = jnp.zeros_like(M[:, 0]), []
    for j in reversed(range(a.shape[0])):
        columns.append(M[:, j] * diagonal_share[None, j] - coupling[None, j] * later)
        later = later + M[:, j] * a[None, j]
    return jnp.stack(columns[::-1], axis=1)


def downdate_factor(L: Root, v: Float[Array, "k *s"]) -> Root:
    """Lower Cholesky factor of L L^T - v v^T; NaN where that is not positive definite."""
    # L L^T - v v^T = L (I - a a^T) L^T: the downdate of the identity has a closed form, whose d_j fall
    # below zero exactly where the result is not positive definite.
    a = divide_lower(L, v[:, None])[:, 0]
    k = a.shape[0]
    upto = jnp.asarray([[float(i < j) for i in range(k)] for j in range(k + 1)], a.dtype)
    upto = upto.reshape(k + 1, k, *(1,) * (a.ndim - 1))
    d = 1 - jnp.sum(jnp.swapaxes(upto, 0, 1) * (a * a)[:, None], axis=0)
    return _scaled_columns(L, a, jnp.where(d > 0, d, jnp.nan))


class Gaussian(eqx.Module):
    """Gaussian N(mean, L L^T); axes *s are those of a bank of filters.

    Attributes:
        mean: point of the model's space, for vectors an array (n, *s).
        factor: lower triangular root L (n, n, *s) of the covariance of the error from the mean.
    """

    mean: Point
    factor: Float[Array, "n n *s"]

    @property
    def covariance(self) -> Float[Array, "n n *s"]:
        """Covariance P = L L^T, exactly symmetric."""
        return outer_square(self.factor)

    @property
    def standard_deviation(self) -> Float[Array, "n *s"]:
        """Standard deviations, the square roots of P's diagonal."""
        return jnp.sqrt(jnp.sum(jnp.swapaxes(self.factor, 0, 1) ** 2, axis=0))


def gaussian(mean: Point, covariance: Numbers, *, name: str = "P0") -> Gaussian:
    """Gaussian from its mean and covariance (n, n, *s).

    Raises:
        ModelError: the covariance is not symmetric, not finite or not positive semi-definite
            (the message has the matrix's name and the eigenvalue), or not of the mean's size; or
            the mean is not finite.
    """
    factor = covariance_root(covariance, name)
    check_finite(mean, f"The mean that belongs to {name}", "")
    if not isinstance(mean, dict) and not hasattr(mean, "_fields"):
        mean = jnp.asarray(mean, dtype=factor.dtype)
        Vector(factor.shape[0]).check(mean, f"The mean that belongs to {name}")
    return Gaussian(mean, factor)


def covariance_root(covariance: Numbers, name: str) -> Float[Array, "n n *s"]:
    """Lower triangular L with L L^T = covariance, which may be singular.

    Inside `jax.jit` or `grad` the values cannot be checked, and the result for a matrix that is no
    covariance is NaN. Derivatives exist with respect to all nonzero variances; a variance of zero
    is treated as a constant (`factor.semidefinite`).

    Raises:
        ModelError: the covariance is refused as in `gaussian`.
    """
    if not has_values(covariance):
        return factor_semidefinite(jnp.asarray(covariance))
    entries = np.asarray(covariance)
    P = entries.astype(float)
    # integers count as double
    is_float = np.issubdtype(entries.dtype, np.floating)
    dtype = entries.dtype if is_float else np.dtype(float)
    if P.ndim < 2 or P.shape[0] != P.shape[1]:
        raise ModelError(f"{name} must be a square matrix, but its shape is {P.shape}.")
    if not np.all(np.isfinite(P)):
        raise ModelError(f"{name} must be finite, but it is {P.tolist()}.")
    P = np.moveaxis(P, (0, 1), (-2, -1))
    scale = max(float(np.max(np.abs(P))), np.finfo(float).tiny)
    round_off = _ROUND_OFF * float(np.finfo(dtype.type).eps) * scale
    asymmetry = np.abs(P - np.swapaxes(P, -1, -2))
    if np.max(asymmetry) > round_off:
        largest = asymmetry.reshape(-1, *P.shape[-2:]).max(0)
        i, j = np.unravel_index(int(np.argmax(largest)), P.shape[-2:])
        raise ModelError(
            f"{name} must be symmetric, but entries ({i}, {j}) and ({j}, {i}) differ by "
            f"{np.max(asymmetry):.3g}."
        )
    least = np.linalg.eigvalsh((P + np.swapaxes(P, -1, -2)) / 2)
    if np.min(least) < -round_off:
        raise ModelError(
            f"{name} must be positive semi-definite, but its smallest eigenvalue is "
            f"{np.min(least):.4g} (largest {np.max(least):.4g})."
        )
    # eigenvectors, not Cholesky: zero variances are allowed (states without process noise)
    values, vectors = np.linalg.eigh(P)
    rows = np.sqrt(np.maximum(values, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2)
    R = np.linalg.qr(rows, mode="r")
    signs = np.where(np.diagonal(R, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    L = np.moveaxis(np.swapaxes(signs[..., :, None] * R, -1, -2), (-2, -1), (0, 1))
    return jnp.asarray(np.ascontiguousarray(L), dtype=dtype)
