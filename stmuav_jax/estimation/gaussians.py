"""Gaussians on a space, each with its mean and a square root of its covariance."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.space import Point, Vector
from ..checks.errors import ModelError, check_finite, concrete
from ..checks.shapes import Numbers
from .factor import outer_square, semidefinite

# Negative eigenvalues up to this fraction of the largest, in units of epsilon, are round-off.
_ROUND_OFF = 100


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
    factor = root(covariance, name)
    check_finite(mean, f"The mean that belongs to {name}", "")
    if not isinstance(mean, dict) and not hasattr(mean, "_fields"):
        mean = jnp.asarray(mean, dtype=factor.dtype)
        Vector(factor.shape[0]).check(mean, f"The mean that belongs to {name}")
    return Gaussian(mean, factor)


def root(covariance: Numbers, name: str) -> Float[Array, "n n *s"]:
    """Lower triangular L with L L^T = covariance, which may be singular.

    Inside `jax.jit` or `grad` the values cannot be checked, and the result for a matrix that is no
    covariance is NaN. Derivatives exist with respect to all nonzero variances; a variance of zero
    is treated as a constant (`factor.semidefinite`).

    Raises:
        ModelError: the covariance is refused as in `gaussian`.
    """
    if not concrete(covariance):
        return semidefinite(jnp.asarray(covariance))
    given = np.asarray(covariance)
    P = given.astype(float)
    check_covariance(P, name, epsilon=_epsilon(given))
    # eigenvectors, not Cholesky: zero variances are allowed (states without process noise)
    values, vectors = np.linalg.eigh(np.moveaxis(P, (0, 1), (-2, -1)))
    rows = np.sqrt(np.maximum(values, 0.0))[..., :, None] * np.swapaxes(vectors, -1, -2)
    R = np.linalg.qr(rows, mode="r")
    signs = np.where(np.diagonal(R, axis1=-2, axis2=-1) < 0, -1.0, 1.0)
    L = np.moveaxis(np.swapaxes(signs[..., :, None] * R, -1, -2), (-2, -1), (0, 1))
    return jnp.asarray(np.ascontiguousarray(L), dtype=_kind(given))


def _kind(given: np.ndarray) -> np.dtype:
    """Precision of the given numbers; integers count as double."""
    return given.dtype if np.issubdtype(given.dtype, np.floating) else np.dtype(float)


def _epsilon(given: np.ndarray) -> float:
    """Relative precision of the given numbers."""
    return float(np.finfo(_kind(given).type).eps)


def check_covariance(P: np.ndarray, name: str, *, epsilon: float = 2.3e-16) -> None:
    """Raise `ModelError` unless P (n, n, *s) is a covariance, apart from round-off.

    Raises:
        ModelError: not square, not finite, not symmetric, or with a negative eigenvalue.
    """
    if P.ndim < 2 or P.shape[0] != P.shape[1]:
        raise ModelError(f"{name} must be a square matrix, but its shape is {P.shape}.")
    if not np.all(np.isfinite(P)):
        raise ModelError(f"{name} must be finite, but it is {P.tolist()}.")
    P = np.moveaxis(P, (0, 1), (-2, -1))
    scale = max(float(np.max(np.abs(P))), np.finfo(float).tiny)
    apart = np.abs(P - np.swapaxes(P, -1, -2))
    if np.max(apart) > _ROUND_OFF * epsilon * scale:
        i, j = np.unravel_index(
            int(np.argmax(apart.reshape(-1, *P.shape[-2:]).max(0))), P.shape[-2:]
        )
        raise ModelError(
            f"{name} must be symmetric, but entries ({i}, {j}) and ({j}, {i}) differ by "
            f"{np.max(apart):.3g}."
        )
    least = np.linalg.eigvalsh((P + np.swapaxes(P, -1, -2)) / 2)
    if np.min(least) < -_ROUND_OFF * epsilon * scale:
        raise ModelError(
            f"{name} must be positive semi-definite, but its smallest eigenvalue is "
            f"{np.min(least):.4g} (largest {np.max(least):.4g})."
        )
