"""Linear solvers of constrained dynamics, for small full matrices, symmetric or general."""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..checks.shapes import Matrix, Vector
from . import lapack, loops
from .native import native_loops
from .stacked import transposed_multiply

# Weight w of the proximal term relative to rows of unit size, and number of iterations. The error
# that remains along a singular value s is (w / (w + s))^steps. In a singular posture of a mechanism
# s goes through zero, and accelerations are wrong while s < w: a smaller w shortens that time. It
# only has to exceed the round-off of the matrix, as rows that are always dependent are left out.
_PROXIMAL_WEIGHT = 1e-15
_PROXIMAL_STEPS = 4


# Number of multiplications above which a matrix product is left to a library.
_LARGE = 10_000


class Factor(eqx.Module):
    """Cholesky factorisation of a symmetric positive definite matrix S, for many right-hand sides.

    Rows of mixed units (m and rad) do no harm: the relative round-off of Cholesky's method does not
    depend on a scaling of rows and columns.
    """

    lower: Matrix

    def solve(self, b: Float[Array, "m *r"]) -> Float[Array, "m *r"]:
        """Solution x of S x = b, shape (m,) or (m, r)."""
        y = solve_lower(self.lower, b[:, None] if b.ndim == 1 else b)
        x = solve_lower(self.lower, y, transpose=True)
        return x[:, 0] if b.ndim == 1 else x


class MinimumNorm(eqx.Module):
    """Pseudoinverse of a symmetric matrix S, singular or not.

    S is not scaled: that would change which solution has minimum norm.
    """

    inverse: Matrix

    def solve(self, b: Vector) -> Vector:
        """Minimum-norm solution x of S x = b, shape (m,)."""
        return self.inverse @ b


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


def _in_loops(A: Matrix) -> bool:
    """True if the factorisation of a matrix is a loop of its own, and not a call of LAPACK."""
    return native_loops() and A.ndim == 2 and 0 < A.shape[0] <= loops.LARGEST


@jax.custom_jvp
def cholesky(S: Matrix) -> Matrix:
    """Lower Cholesky factor of a symmetric positive definite matrix; NaN for any other."""
    return loops.cholesky(S) if _in_loops(S) else lapack.cholesky(S)


@cholesky.defjvp
def _cholesky_jvp(primals: tuple[Matrix], tangents: tuple[Matrix]) -> tuple[Matrix, Matrix]:
    """Derivative L' = L F, with F the lower half of L^-1 S' L^-T and half its diagonal."""
    L = cholesky(*primals)
    middle = solve_lower(L, solve_lower(L, tangents[0]).T)
    return L, L @ (jnp.tril(middle) - 0.5 * jnp.diag(jnp.diagonal(middle)))


def solve_lower(L: Matrix, B: Matrix, *, transpose: bool = False) -> Matrix:
    """Solution L^-1 B, or L^-T B, for a lower triangular matrix L."""
    if not _in_loops(L):
        how: dict[str, bool] = {"left_side": True, "lower": True, "transpose_a": transpose}
        return jax.lax.linalg.triangular_solve(L, B, **how)
    columns = jax.lax.stop_gradient(L)
    down = lambda _, b: loops.solve_columns(columns.T, b, upper=False)
    up = lambda _, b: loops.solve_columns(columns, b, upper=True)
    A = jnp.tril(L).T if transpose else jnp.tril(L)
    ways = (up, down) if transpose else (down, up)
    return jax.lax.custom_linear_solve(lambda x: A @ x, B, *ways)


def product_transposed(A: Float[Array, "m k"], B: Float[Array, "n k"]) -> Float[Array, "m n"]:
    """Product A B^T."""
    return loops.multiply_rows(A, B) if _in_loops(A) else A @ B.T


class Inverse(eqx.Module):
    """Inverse of a general square matrix A, for many solutions x of A x = b.

    Products with it call no library, so that the loop in which they are can be native (`native`). It is
    a constant for differentiation; derivatives of a solution follow from A x = b.
    """

    matrix: Matrix
    inverse: Matrix

    def solve(self, b: Vector) -> Vector:
        """Solution x of A x = b, shape (k,); not finite if A is singular."""
        multiply = lambda x: self.matrix @ x
        ahead, back = lambda _, b: self.inverse @ b, lambda _, b: self.inverse.T @ b
        return jax.lax.custom_linear_solve(multiply, b, ahead, back)


def inverted(A: Matrix) -> Inverse:
    """Invert a general square matrix, shape (k, k), by LU factorisation with partial pivoting."""
    return Inverse(A, lapack.inverse(jax.lax.stop_gradient(A)))


def _scaled(S: Matrix) -> tuple[Matrix, Vector]:
    """Matrix S scaled to a unit diagonal, and its scale factors."""
    diagonal = jnp.diagonal(S)
    scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
    return scale[:, None] * S * scale[None, :], scale


def factorise(S: Matrix, *, redundant: bool, rcond: float) -> Factor | MinimumNorm:
    """Factorise a symmetric positive (semi-)definite matrix, shape (m, m).

    `redundant=False` uses Cholesky's method; a singular S gives NaN, never a wrong number.
    `redundant=True` uses a singular value decomposition, in which values below `rcond` times the
    largest count as zero.
    """
    if redundant:
        return MinimumNorm(lapack.pseudoinverse(S, rcond))
    return Factor(cholesky(S))


def proximal(S: Matrix) -> Proximal:
    """Factorise a positive semi-definite matrix for `Proximal`, shape (m, m)."""
    scaled, scale = _scaled(S)
    weight = _PROXIMAL_WEIGHT * jnp.eye(S.shape[0], dtype=S.dtype)
    return Proximal(scaled, cholesky(scaled + weight), scale)


Redundant = Literal[False, "fast", "minimum norm"]


def _schur(S: Matrix, redundant: Redundant) -> Factor | Proximal | MinimumNorm:
    if redundant == "fast":
        return proximal(S)
    return factorise(S, redundant=bool(redundant), rcond=1e-11)


def independent_rows(S: Matrix, tolerance: float | Float[Array, ""]) -> Bool[Array, " m"]:
    """Mask of rows of J that form a basis of its row space, from S = J J^T, shape (m,).

    Cholesky's method with pivoting adds the row that is farthest from the space of the rows before
    it, until the square of this distance is below `tolerance`. The result has no derivative.

    Source: N. J. Higham, Accuracy and Stability of Numerical Algorithms (2002), ch. 10.3.
    """

    def far(now: tuple[Matrix, Array]) -> Array:
        return jnp.max(jnp.diagonal(now[0])) > tolerance

    def take(now: tuple[Matrix, Array]) -> tuple[Matrix, Array]:
        rest, taken = now
        row = jnp.argmax(jnp.diagonal(rest))
        column = rest[row]
        rest = rest - column[:, None] * (column / column[row])
        taken = taken.at[row].set(True)
        # rows already taken have no distance left, apart from round-off
        keep = ~taken
        return jnp.where(keep[:, None] & keep, rest, 0.0), taken

    start = (jax.lax.stop_gradient(S), jnp.zeros(S.shape[0], bool))
    return jax.lax.while_loop(far, take, start)[1]


def _gram(Y: Matrix) -> Matrix:
    """Gram matrix Y^T Y; small ones by sums, which fuse and avoid the cost of a library call."""
    k, m = Y.shape
    return Y.T @ Y if k * m * m > _LARGE else transposed_multiply(Y, Y)


def solve_saddle(
    M: Matrix,
    J: Matrix,
    f: Vector,
    g: Vector,
    *,
    redundant: Redundant,
    kept: Bool[Array, " m"] | None = None,
) -> tuple[Vector, Vector]:
    """Solution x (k,), y (m,) of M x - J^T y = f, J x = g, with M symmetric positive definite.

    If rows of J are dependent, `redundant` determines the choice of y; x does not depend on it.
    With `kept` the other rows are left out, and their y is zero.
    """
    L = cholesky(M)
    if not J.shape[0]:
        y = solve_lower(L, f[:, None])
        return solve_lower(L, y, transpose=True)[:, 0], g
    Y = solve_lower(L, jnp.concatenate([f[:, None], J.T], axis=1))
    y, Y = Y[:, 0], Y[:, 1:]
    if kept is not None:
        Y, g = jnp.where(kept, Y, 0.0), jnp.where(kept, g, 0.0)
    S = _with_ones(_gram(Y), kept)
    multipliers = _schur(S, redundant).solve(g - jnp.sum(Y * y[:, None], axis=0))
    x = y + jnp.sum(Y * multipliers, axis=1)
    return solve_lower(L, x[:, None], transpose=True)[:, 0], multipliers


def _with_ones(S: Matrix, kept: Bool[Array, " m"] | None) -> Matrix:
    """Add ones to the diagonal of S in the rows left out, which are zero otherwise."""
    return S if kept is None else S + jnp.diag(1.0 - kept)


def right_inverse(
    M: Matrix, J: Matrix, *, redundant: bool, kept: Bool[Array, " m"] | None = None
) -> Matrix:
    """Right inverse G = M^-1 J^T (J M^-1 J^T)^-1: x = G b solves J x = b with minimum x^T M x.

    With `kept` it is the inverse for these rows; columns of the others are zero.
    """
    L = cholesky(M)
    Y = solve_lower(L, J.T)
    if kept is not None:
        Y = jnp.where(kept, Y, 0.0)
    S = _with_ones(_gram(Y), kept)
    return solve_lower(L, _schur(S, "fast" if redundant else False).solve(Y.T).T, transpose=True)


def solve_general(K: Matrix, b: Vector, *, redundant: bool, rcond: float) -> Vector:
    """Solution x (k,) of K x = b for a general square K: LU, or minimum norm if `redundant`."""
    return lapack.pseudoinverse(K, rcond) @ b if redundant else lapack.solve(K, b)
