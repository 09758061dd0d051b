"""A tree brought onto the rows of its cut joints, the nearest way."""

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..algebra.linalg import right_inverse
from ..algebra.rotation import from_rotation_vector, product
from ..mechanics.system import System
from .branches import right_inverse_branches
from .chain import Chain
from .coordinates import Coordinates
from .cut import Rows, cut_rows
from .differential import Constraints
from .formulation import Residuals, residuals_of
from .motion import Motion, inertia, mass_matrix, motion
from .pose import kinds
from .topology import SpanningTree


class TreeModel(eqx.Module):
    """A system prepared for relative coordinates; `constraints` are those of the cut joints.

    `inverse` is that of the mass matrix where it is constant: nothing but a base. `kept` are
    the rows that count through a step, of those that depend on each other, see `at_step`.
    """

    system: System
    chain: Chain
    constraints: Constraints
    inverse: Float[Array, "6 6"] | None
    kept: Bool[Array, " m"] | None = None


def closed(
    model: TreeModel,
    t: Float[Array, ""],
    at: Coordinates,
    iterations: int,
    small: Callable[[TreeModel], bool],
) -> tuple[Coordinates, Rows]:
    """The nearest coordinates that satisfy the rows, and the rows where positions do.

    Args:
        small: whether the equations are solved branch by branch.
    """
    tree = model.chain.tree

    def rows_of(moving: Motion) -> Rows:
        return cut_rows(model.chain, model.constraints, t, moving)

    # The derivative of a converged iteration is that of its last step with G held: what
    # this leaves out is of the size of the residual that the step before has left.
    near = jax.lax.stop_gradient(at)
    moving = motion(model.chain, near)
    rows = jax.lax.stop_gradient(rows_of(moving))
    G = jax.lax.stop_gradient(_closing(model, moving, rows.J, small(model)))
    by_rows = lambda b: jnp.sum(G * b[None], axis=1)

    def closer(_: Any, now: Coordinates) -> Coordinates:
        rows = jax.lax.stop_gradient(rows_of(motion(model.chain, now)))
        return moved(tree, now, -by_rows(rows.value))

    near = moved(tree, near, -by_rows(rows.value))
    near = jax.lax.fori_loop(1, iterations, closer, near)
    at = _carried(at, near)
    rows = rows_of(motion(model.chain, at))
    at = _carried(moved(tree, at, -by_rows(rows.value)), near)
    for _ in range(max(iterations, 2)):
        off = jnp.sum(rows.J * at.u, axis=1) - rows.target
        at = at._replace(u=at.u - by_rows(off))
    return at, rows


def _closing(
    model: TreeModel, moving: Motion, J: Float[Array, "m k *s"], small: bool
) -> Float[Array, "k m *s"]:
    """G: of all velocities u with J u = b, G b is the smallest in the mass metric."""
    tree = model.chain.tree
    total = inertia(model.chain, moving, jnp.zeros_like(moving.V))
    if small:
        return right_inverse_branches(tree, moving.S, total, J)
    M, J = mass_matrix(tree, moving.S, total), all_columns(tree, J)
    G = right_inverse(M, J, redundant=model.kept is not None, kept=model.kept)
    return G[6 * tree.floating :]


def rows_after(
    model: TreeModel, t: Float[Array, ""], at: Coordinates, by: Float[Array, "k"]
) -> Float[Array, "m k"]:
    """The rows after a displacement."""
    moving = motion(model.chain, moved(model.chain.tree, at, by))
    return cut_rows(model.chain, model.constraints, t, moving).J


def all_columns(tree: SpanningTree, J: Float[Array, "m k"]) -> Float[Array, "m l"]:
    """Rows in all velocities: those of the base move no row that joins two bodies on it."""
    if not tree.floating:
        return J
    return jnp.concatenate([jnp.zeros((J.shape[0], 6, *J.shape[2:]), J.dtype), J], axis=1)


def _carried(at: Coordinates, to: Coordinates) -> Coordinates:
    """The values of `to`, with the derivatives of `at`."""
    stop = jax.lax.stop_gradient
    return jax.tree.map(lambda x, y: stop(y) + (x - stop(x)), at, to)


def moved(tree: SpanningTree, at: Coordinates, step: Float[Array, "k"]) -> Coordinates:
    """The tree's coordinates after a small motion along its velocities."""
    q1, shift, balls = kinds(tree, step)
    turned = product(at.balls, from_rotation_vector(balls)) if balls.shape[1] else at.balls
    return at._replace(q1=at.q1 + q1, shift=at.shift + shift, balls=turned)


def left(model: TreeModel, at: Coordinates, rows: Rows | None) -> Residuals:
    """What is left of the rows, of their rates, and of the norms."""
    p = jnp.concatenate([at.p, at.balls], axis=1)
    norm = jnp.max(jnp.abs(jnp.sum(p**2, axis=0) - 1), axis=0, initial=0.0)
    if rows is None:
        return residuals_of(model.constraints, norm[None], norm[None], norm)
    off = jnp.sum(rows.J * at.u, axis=1) - rows.target
    return residuals_of(model.constraints, rows.value, off, norm)
