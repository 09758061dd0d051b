"""Linear solvers of constrained dynamics, for small full matrices, symmetric or general."""

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..checks.shapes import Matrix, Vector
from ..math import lapack
from .stacked import gather_entries

# Weight w of the proximal term relative to rows of unit size, and number of iterations. The error
# that remains along a singular value s is (w / (w + s))^steps. In a singular posture of a mechanism
# s goes through zero, and accelerations are wrong while s < w: a smaller w shortens that time. It
# only has to exceed the round-off of the matrix, as rows that are always dependent are left out.
_PROXIMAL_WEIGHT = 1e-15
_PROXIMAL_STEPS = 4


class Factor(eqx.Module):
    """Cholesky factorisation of a symmetric positive definite matrix S, for many right-hand sides.

    A singular S gives NaN, never a wrong number. Rows of mixed units (m and rad) do no harm: the relative
    round-off of Cholesky's method does not depend on a scaling of rows and columns.
    """

    lower: Matrix

    def solve(self, b: Float[Array, "m *r"]) -> Float[Array, "m *r"]:
        """Solution x of S x = b, shape (m,) or (m, r)."""
        y = solve_lower(self.lower, b[:, None] if b.ndim == 1 else b)
        x = solve_lower(self.lower, y, transpose=True)
        return x[:, 0] if b.ndim == 1 else x


class MinimumNorm(eqx.Module):
    """Pseudoinverse of a symmetric positive semi-definite matrix S scaled to a unit diagonal.

    Units then do not matter, and if S is singular, the solution has minimum norm in the scaled unknowns.
    """

    inverse: Matrix
    scale: Vector

    def solve(self, b: Float[Array, "m *r"]) -> Float[Array, "m *r"]:
        """Solution x of S x = b, shape (m,) or (m, r)."""
        scale = self.scale.reshape(-1, *(1,) * (b.ndim - 1))
        return scale * (self.inverse @ (scale * b))


class Proximal(eqx.Module):
    """Proximal solver of a positive semi-definite matrix S: x <- x + (S + w I)^-1 (b - S x).

    The iteration starts from x = 0 and is much cheaper than a singular value decomposition. For b
    in the range of S, S x equals b; x is determined up to the null space of S only, in which it
    carries round-off divided by w.

    Source: J. Carpentier, R. Budhiraja, N. Mansard, Proximal and sparse resolution of
    constrained dynamic equations, Robotics: Science and Systems (2021).
    """

    matrix: Matrix
    lower: Matrix
    scale: Vector

    def solve(self, b: Float[Array, "m *r"]) -> Float[Array, "m *r"]:
        """Solution x of S x = b, shape (m,) or (m, r)."""
        scale = self.scale[:, None]
        B = scale * (b[:, None] if b.ndim == 1 else b)
        x = jnp.zeros_like(B)
        for _ in range(_PROXIMAL_STEPS):
            y = solve_lower(self.lower, B - self.matrix @ x)
            x = x + solve_lower(self.lower, y, transpose=True)
        x = scale * x
        return x[:, 0] if b.ndim == 1 else x


@jax.custom_jvp
def factor_cholesky(S: Matrix) -> Matrix:
    """Lower Cholesky factor of a symmetric positive definite matrix; NaN for any other."""
    return lapack.factor_cholesky(S)


@factor_cholesky.defjvp
def _cholesky_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    """Derivative L' = L F, with F the lower half of L^-1 S' L^-T and half its diagonal."""
    L = factor_cholesky(*primals)
    middle = solve_lower(L, solve_lower(L, tangents[0]).T)
    return L, L @ (jnp.tril(middle) - 0.5 * jnp.diag(jnp.diagonal(middle)))


def solve_lower(L: Matrix, B: Matrix, *, transpose: bool = False) -> Matrix:
    """Solution L^-1 B, or L^-T B, for a lower triangular matrix L."""
    options: dict[str, bool] = {"left_side": True, "lower": True, "transpose_a": transpose}
    return jax.lax.linalg.triangular_solve(L, B, **options)


def _scale_diagonal(S: Matrix) -> tuple[Matrix, Vector]:
    """Matrix S scaled to a unit diagonal, and its scale factors."""
    diagonal = jnp.diagonal(S)
    # A unit diagonal removes the units of the rows (m, rad) and is within a factor m of the best diagonal
    # scaling (van der Sluis 1969). Rows that are left out have a zero diagonal and stay as they are.
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    return scale[:, None] * S * scale[None, :], scale


def factor_minimum_norm(S: Matrix, rcond: float = 1e-11) -> MinimumNorm:
    """Factorise a positive semi-definite matrix by its singular values, shape (m, m).

    Values of the scaled matrix below `rcond` times the largest count as zero.
    """
    scaled, scale = _scale_diagonal(S)
    return MinimumNorm(lapack.pseudoinverse(scaled, rcond), scale)


def share_multipliers(
    S: Matrix, factor: Factor | MinimumNorm | Proximal, multipliers: Vector
) -> Vector:
    """Multipliers y (m,) of all rows, of minimum norm, with the effect of those of a set of rows.

    All rows are J = C J_0 of the set's J_0, and C^T y are the multipliers of the set.

    Args:
        S: products J_0 W J^T (m, m) of the set with all rows, zero in rows outside of the set.
        factor: factorisation of J_0 W J_0^T, with ones on the diagonal for rows outside of the set.
        multipliers: those of the set (m,), zero for rows outside of it.
    """
    return lapack.pseudoinverse(factor.solve(S), 1e-11) @ multipliers


def factor_proximal(S: Matrix) -> Proximal:
    """Factorise a positive semi-definite matrix for `Proximal`, shape (m, m)."""
    scaled, scale = _scale_diagonal(S)
    # The weight makes S positive definite for Cholesky's method; the iterations of `solve` remove its
    # effect in the range of S.
    weight = _PROXIMAL_WEIGHT * jnp.eye(S.shape[0], dtype=S.dtype)
    return Proximal(scaled, factor_cholesky(scaled + weight), scale)


Redundant = Literal[False, "fast", "minimum norm"]


def independent_rows(S: Matrix, tolerance: float | Float[Array, ""]) -> Bool[Array, " m"]:
    """Mask of rows of J that form a basis of its row space, from S = J J^T, shape (m,).

    Cholesky's method with pivoting adds the row that is farthest from the space of the rows before
    it, until the square of this distance is below `tolerance`. The result has no derivative.

    Source: N. J. Higham, Accuracy and Stability of Numerical Algorithms (2002), ch. 10.3.
    """

    def has_pivot(now: tuple[Matrix, Array]) -> Array:
        return jnp.max(jnp.diagonal(now[0])) > tolerance

    def take_row(now: tuple[Matrix, Array]) -> tuple[Matrix, Array]:
        rest, chosen = now
        row = jnp.argmax(jnp.diagonal(rest))
        column = rest[row]
        rest = rest - column[:, None] * (column / column[row])
        chosen = chosen.at[row].set(True)
        # rows already taken have no distance left, apart from round-off
        keep = ~chosen
        return jnp.where(keep[:, None] & keep, rest, 0.0), chosen

    # Which rows are independent is a choice and no function that could be differentiated; the equations
    # that hold them are.
    start = (jax.lax.stop_gradient(S), jnp.zeros(S.shape[0], bool))
    return jax.lax.while_loop(has_pivot, take_row, start)[1]


class Saddle(eqx.Module):
    """Factorisation of the equations M x - J^T y = f, J x = g, with M symmetric positive definite.

    Attributes:
        lower: Cholesky factor L of M with its unknowns in this order.
        Y: columns L^-1 J^T (k, m), zero for rows left out.
        factor: factorisation of Y^T Y = J M^-1 J^T.
        order: unknowns in the order in which they are eliminated.
    """

    lower: Matrix
    Y: Matrix
    factor: Factor | MinimumNorm | Proximal
    order: tuple[int, ...] = eqx.field(static=True)

    def solve(self, f: Vector, g: Vector) -> tuple[Vector, Vector]:
        """Solution x (k,) and y (m,); g has to be zero for rows left out, whose y then is zero."""
        rest = solve_lower(self.lower, _reorder(f, self.order)[:, None])[:, 0]
        if len(g):
            g = self.factor.solve(g - jnp.sum(self.Y * rest[:, None], axis=0))
            rest = rest + jnp.sum(self.Y * g[None], axis=1)
        x = solve_lower(self.lower, rest[:, None], transpose=True)[:, 0]
        return _reorder(x, np.argsort(self.order)), g

    def share_multipliers(self, J: Matrix, y: Vector) -> Vector:
        """Multipliers of minimum norm in all rows J with the effect of those y of the rows held."""
        Y = solve_lower(self.lower, _reorder(J.T, self.order))
        return share_multipliers(self.Y.T @ Y, self.factor, y)

    def right_inverse(self) -> Matrix:
        """Right inverse G = M^-1 J^T (J M^-1 J^T)^-1 (k, m): x = G b solves J x = b with minimum x^T M x."""
        columns = solve_lower(self.lower, self.factor.solve(self.Y.T).T, transpose=True)
        return _reorder(columns, np.argsort(self.order))


def _reorder(x: Float[Array, "k *n"], order: Sequence[int] | np.ndarray) -> Float[Array, "k *n"]:
    """Rows of an array in another order."""
    if list(order) == list(range(len(order)))[::-1]:
        return x[::-1]
    return gather_entries(x, order)


def count_products(
    couples: Bool[np.ndarray, "k k"], touches: Bool[np.ndarray, "k m"], order: Sequence[int]
) -> int:
    """Number of products in which `factor_saddle` eliminates the unknowns in this order.

    Args:
        couples: entries of M that are not zero. touches: those of J^T.
    """
    M, Y = couples[np.ix_(order, order)], touches[list(order)]
    total = 0
    for k in range(len(order)):
        below, across = M[k + 1 :, k].copy(), int(Y[k].sum())
        count = int(below.sum())
        # the row of the factor, what it changes below, its share of Y^T Y, and of two solutions
        total += count + count * (count + 1) // 2 + count * across
        total += across * (across + 1) // 2 + 2 * (count + across)
        M[k + 1 :, k + 1 :] |= np.outer(below, below)
        Y[k + 1 :] |= np.outer(below, Y[k])
    return total


def factor_saddle(
    M: Matrix, J: Matrix, *, redundant: Redundant, row_mask: Bool[Array, " m"] | None = None,
    order: Sequence[int] | None = None,
) -> Saddle:  # fmt: skip
    """Factorise the equations of a `Saddle`, without the rows of J that `row_mask` leaves out.

    If rows of J are dependent, `redundant` determines the choice of y; x does not depend on it.

    Args:
        order: unknowns in the order in which they are eliminated; by default from the last to the first.
    """
    order = tuple(range(len(M)))[::-1] if order is None else tuple(order)
    L = factor_cholesky(_reorder(_reorder(M, order).T, order))
    if not J.shape[0]:
        return Saddle(L, J.T, Factor(jnp.zeros((0, 0), L.dtype)), order)
    Y = solve_lower(L, _reorder(J.T, order))
    Y = Y if row_mask is None else jnp.where(row_mask[None], Y, 0.0)
    S = Y.T @ Y
    if row_mask is not None:
        S = S + jnp.diag(1.0 - row_mask)
    if redundant == "fast":
        return Saddle(L, Y, factor_proximal(S), order)
    factor = factor_minimum_norm(S) if redundant else Factor(factor_cholesky(S))
    return Saddle(L, Y, factor, order)
