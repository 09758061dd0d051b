"""Projection of a tree's coordinates onto its loop closures, nearest in the mass metric."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...algebra.linalg import right_inverse
from ...mechanics.system import System
from ..formulations.base import AbstractModel, Residuals, residuals_of
from ..formulations.constraints import Constraints
from .closures import Rows, closure_rows
from .coordinates import TreeCoordinates, moved, unit_vectors
from .elimination import right_inverse_branches
from .motion import TreeMotion, inertia, mass_matrix, motion
from .parameters import TreeParameters
from .topology import SpanningTree


class TreeModel(AbstractModel):
    """System prepared for the formulation in relative coordinates.

    Attributes:
        constraints: constraints of the loop closures.
        inverse: inverse mass matrix where it is constant, for a floating base alone; else None.
        kept: mask of the independent rows, which are kept through a step, see `at_step`.
    """

    system: System
    parameters: TreeParameters
    constraints: Constraints
    inverse: Float[Array, "6 6"] | None
    kept: Bool[Array, " m"] | None = None


def closed(
    model: TreeModel,
    t: Float[Array, ""],
    at: TreeCoordinates,
    iterations: int,
    small: Callable[[TreeModel], bool],
) -> tuple[TreeCoordinates, Rows]:
    """Nearest coordinates that satisfy the loop closures, and the rows at their positions.

    Args:
        small: predicate, true if the equations are solved branch by branch.
    """
    tree = model.parameters.tree

    def rows_of(moving: TreeMotion) -> Rows:
        return closure_rows(model.parameters, model.constraints, t, moving)

    # The derivative of a converged iteration is that of its last step at constant G: the
    # neglected terms are of the size of the residual before that step.
    near = jax.lax.stop_gradient(at)
    moving = motion(model.parameters, near)
    rows = jax.lax.stop_gradient(rows_of(moving))
    G = jax.lax.stop_gradient(_closing(model, moving, rows.J, small(model)))
    by_rows = lambda b: jnp.sum(G * b[None], axis=1)

    def closer(_: Any, now: TreeCoordinates) -> TreeCoordinates:
        rows = jax.lax.stop_gradient(rows_of(motion(model.parameters, now)))
        return moved(tree, now, -by_rows(rows.value))

    near = moved(tree, near, -by_rows(rows.value))
    near = jax.lax.fori_loop(1, iterations, closer, near)
    at = _carried(at, near)
    rows = rows_of(motion(model.parameters, at))
    at = _carried(moved(tree, at, -by_rows(rows.value)), near)
    for _ in range(max(iterations, 2)):
        off = jnp.sum(rows.J * at.u, axis=1) - rows.target
        at = at._replace(u=at.u - by_rows(off))
    return at, rows


def _closing(
    model: TreeModel, moving: TreeMotion, J: Float[Array, "m k *s"], small: bool
) -> Float[Array, "k m *s"]:
    """Right inverse G of J: u = G b solves J u = b with minimum norm in the mass metric."""
    tree = model.parameters.tree
    total = inertia(model.parameters, moving, jnp.zeros_like(moving.V))
    if small:
        return right_inverse_branches(tree, moving.S, total, J)
    M, J = mass_matrix(tree, moving.S, total), all_columns(tree, J)
    G = right_inverse(M, J, redundant=model.kept is not None, kept=model.kept)
    return G[6 * tree.floating :]


def rows_after(
    model: TreeModel, t: Float[Array, ""], at: TreeCoordinates, by: Float[Array, "k"]
) -> Float[Array, "m k"]:
    """Rows J of the loop closures after a displacement `by` along the velocities."""
    moving = motion(model.parameters, moved(model.parameters.tree, at, by))
    return closure_rows(model.parameters, model.constraints, t, moving).J


def all_columns(tree: SpanningTree, J: Float[Array, "m k"]) -> Float[Array, "m l"]:
    """Rows in all velocities, with zeros for the base, whose motion violates no loop closure."""
    if not tree.floating:
        return J
    return jnp.concatenate([jnp.zeros((J.shape[0], 6, *J.shape[2:]), J.dtype), J], axis=1)


def _carried(at: TreeCoordinates, to: TreeCoordinates) -> TreeCoordinates:
    """Coordinates with the values of `to` and the derivatives of `at`."""
    stop = jax.lax.stop_gradient
    return jax.tree.map(lambda x, y: stop(y) + (x - stop(x)), at, to)


def left(model: TreeModel, at: TreeCoordinates, rows: Rows | None) -> Residuals:
    """Residuals of the loop closures, of their rates, and of the norms of unit vectors."""
    squares = [jnp.sum(p**2, axis=0) for p in unit_vectors(model.parameters.tree, at)]
    norm = jnp.max(jnp.abs(jnp.concatenate(squares) - 1), axis=0, initial=0.0)
    if rows is None:
        return residuals_of(model.constraints, norm[None], norm[None], norm)
    off = jnp.sum(rows.J * at.u, axis=1) - rows.target
    return residuals_of(model.constraints, rows.value, off, norm)
