"""The two linear solves that constrained dynamics needs, on top of lineax."""

import equinox as eqx
import jax.numpy as jnp
import lineax as lx

from .shapes import Matrix, Vector


class Factor(eqx.Module):
    """A symmetric matrix S factorised once, to be solved with many right-hand sides.

    A regular S is scaled to a unit diagonal first, which the mixed units of constraint rows
    (m and rad) need. A singular one is not, since scaling would change which solution is the one of minimum norm.
    """

    scaled: lx.AbstractLinearOperator
    scale: Vector
    solver: lx.AbstractLinearSolver
    state: object

    def solve(self, b: Vector) -> Vector:
        """x with S x = b, shape (m,); the x of minimum norm where S is singular."""
        solution = lx.linear_solve(
            self.scaled, b * self.scale, self.solver, state=self.state, throw=False
        )
        return self.scale * solution.value


def factorise(S: Matrix, *, redundant: bool, rcond: float) -> Factor:
    """Factorise a symmetric positive (semi-)definite matrix, shape (m, m).

    `redundant=False`: Cholesky; a singular S then gives NaN, never a wrong number.
    `redundant=True`: singular value decomposition, values below `rcond` times the largest
    counted as zero.
    """
    diagonal = jnp.diagonal(S)
    if redundant:
        scale = jnp.ones_like(diagonal)
        operator = lx.MatrixLinearOperator(S)
        solver = lx.SVD(rcond=rcond)
    else:
        scale = 1 / jnp.sqrt(jnp.where(diagonal > 0, diagonal, 1.0))
        scaled = scale[:, None] * S * scale[None, :]
        operator = lx.MatrixLinearOperator(scaled, lx.positive_semidefinite_tag)
        solver = lx.Cholesky()
    return Factor(operator, scale, solver, solver.init(operator, {}))


def solve_general(K: Matrix, b: Vector, *, redundant: bool, rcond: float) -> Vector:
    """x with K x = b for a general square K, shape (k,): LU, or minimum norm if `redundant`."""
    operator = lx.MatrixLinearOperator(K)
    solver = lx.SVD(rcond=rcond) if redundant else lx.LU()
    return lx.linear_solve(operator, b, solver, throw=False).value
