"""Branch-induced elimination of the equations of motion of a tree, from its branches to its base.

Velocities on different branches have no common term in the mass matrix, which, apart from the
rows of the base, is therefore block-diagonal with one small block D for each branch. With F the
rows that couple the base to the branches, J those of the loop closures and W_xy = X D^-1 Y^T,

    (A - W_FF) a       =  r - W_FJ y           r = -h_base + W_Fh
    (W_JJ + W_JF (A - W_FF)^-1 W_FJ) y  =  g - W_Jf + W_JF (A - W_FF)^-1 r
    u'                 =  D^-1 (-h - F^T a + J^T y),

where A - W_FF is the articulated inertia of the base. No block has more than six rows, so the
factorisations are written out and no library is called.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6.3 (branch-induced
sparsity) and 7 (articulated inertias).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.small import LARGEST, solve
from ...algebra.stacked import apply, apply_transposed, multiply
from .frames import aligned, columns, pick, support
from .motion import Inertia, base_inertia, momenta
from .topology import SpanningTree


def branch_columns(tree: SpanningTree) -> np.ndarray:
    """Table of the columns of every branch (b, w), padded with the total number of columns."""
    frame = columns(tree).frame
    first: list[int] = [0]
    for f, step in enumerate(tree.steps, start=1):
        first.append(f if step.parent == 0 else first[step.parent])
    groups = [
        [k for k, f in enumerate(frame) if first[f] == root] for root in sorted(set(first[1:]))
    ]
    width = max((len(g) for g in groups), default=0)
    fill = len(frame)
    table = [g + [fill] * (width - len(g)) for g in groups]
    return np.array(table, int).reshape(len(groups), width)


def has_small_blocks(tree: SpanningTree, rows: int) -> bool:
    """True if all blocks of the elimination have at most `LARGEST` rows."""
    return bool(tree.steps) and branch_columns(tree).shape[1] <= LARGEST and rows <= LARGEST


class BranchElimination(NamedTuple):
    """Equations of motion of a tree after elimination of the branches' velocities.

    Attributes:
        D: blocks of the branches (w, w, b, *s).
        A: articulated inertia of the base (6, 6, *s); None where nothing floats.
        Z: columns of D^-1 F^T, D^-1 J^T and, where a bias was given, D^-1 h (l, 6 + m + 1, *s),
            rows in the order of the branches; the first six columns only where the base floats.
        X, x: matrix (6, m, *s) and vector (6, *s) of the base's acceleration a = x - X y.
        S, g: matrix (m, m, *s) and right-hand side (m, *s) of S y = g for the multipliers y.
    """

    D: Float[Array, "w w b *s"]
    A: Float[Array, "6 6 *s"] | None
    Z: Float[Array, "l r *s"]
    X: Float[Array, "6 m *s"]
    x: Float[Array, "6 *s"]
    S: Float[Array, "m m *s"]
    g: Float[Array, "m *s"]


def eliminate_branches(
    tree: SpanningTree,
    S: Float[Array, "6 k *s"],
    at: Inertia,
    J: Float[Array, "m k *s"],
    gamma: Float[Array, "m *s"],
    h: Float[Array, "l *s"] | None = None,
) -> BranchElimination:
    """Articulated-body elimination of the velocities of all branches.

    Args:
        h: bias force in the order of `mass_matrix`; zero if None.
    """
    base, m = 6 * tree.floating, J.shape[0]
    table = branch_columns(tree)
    flat = table.T.ravel()
    frame = np.concatenate([columns(tree).frame, [0]])[flat]
    S = _padded(S, flat)
    F = momenta(frame, S, at)
    own = [F] if base else []
    own += [_padded(J, flat)] if h is None else [_padded(J, flat), _padded(h[base:][None], flat)]
    # columns first: sums over leading axes run along contiguous rows of the summands
    C = jnp.concatenate([jnp.swapaxes(rows, 0, 1) for rows in own], axis=1)
    D = _blocks(tree, table, S, F)
    Z = _blockwise(D, C)
    W = jnp.sum(C[:, : base + m, None] * Z[:, None], axis=0)
    rows, known = W[base:], W[:, base + m] if h is not None else jnp.zeros_like(W[:, 0])
    g = gamma + known[base:]
    if not base:
        none = jnp.zeros((0, *gamma.shape), gamma.dtype)
        x = none[:, 0] if len(gamma) else none.reshape(0)
        return BranchElimination(D, None, Z, none, x, rows[:, :m], g)
    right = known[:6] if h is None else known[:6] - h[:6]
    right = jnp.concatenate([W[:6, 6 : 6 + m], right[:, None]], axis=1)
    A = base_inertia(at) - W[:6, :6]
    X = solve(A, right)
    lift = multiply(rows[:, :6], X)
    return BranchElimination(
        D, A, Z, X[:, :m], X[:, m], rows[:, 6 : 6 + m] + lift[:, :m], g + lift[:, m]
    )


def _blockwise(D: Float[Array, "w w b *s"], C: Float[Array, "l r *s"]) -> Float[Array, "l r *s"]:
    """Product D^-1 C, block by block."""
    blocks = C.reshape(D.shape[0], 1, *D.shape[2:3], *C.shape[1:])
    return solve(D[:, :, :, None], blocks).reshape(C.shape)


def _blocks(
    tree: SpanningTree, table: np.ndarray, S: Float[Array, "6 l *s"], F: Float[Array, "6 l *s"]
) -> Float[Array, "w w b *s"]:
    """Diagonal blocks of the mass matrix, padded with ones where a branch has fewer columns."""
    count, width = table.shape
    frame = np.concatenate([columns(tree).frame, [0]])[table]
    moves_with = support(tree)
    above = np.stack([moves_with[np.ix_(row, row)] & (row[:, None] > 0) for row in frame], axis=-1)
    batch = 3 + S.ndim - 2
    ones = aligned(np.eye(width)[:, :, None] * (frame.T == 0), batch)
    S, F = (x.reshape(6, width, count, *x.shape[2:]) for x in (S, F))
    product = jnp.sum(S[:, :, None] * F[:, None], axis=0)
    flipped = jnp.swapaxes(product, 0, 1)
    below = jnp.where(aligned(np.swapaxes(above, 0, 1), batch), flipped, ones)
    return jnp.where(aligned(above, batch), product, below)


def _padded(rows: Float[Array, "r k *s"], flat: np.ndarray) -> Float[Array, "r l *s"]:
    """Columns of `rows` in the order of the branches, padded with zeros for shorter branches."""
    if flat.max() == rows.shape[1]:
        rows = jnp.concatenate([rows, jnp.zeros_like(rows[:, :1])], axis=1)
    return pick(rows, flat, 1)


def first_solution(
    tree: SpanningTree, found: BranchElimination
) -> tuple[Float[Array, "l *s"], Float[Array, "m *s"]]:
    """Accelerations and multipliers for the h and gamma that `eliminate_branches` was given."""
    y = solve(found.S, found.g[:, None])[:, 0] if len(found.g) else found.g
    a = found.x - apply(found.X, y)
    factors = jnp.concatenate([-a, y, -jnp.ones_like(found.Z[:1, 0])])
    u_rate = jnp.sum(factors * found.Z, axis=1)
    return jnp.concatenate([a, _in_order(tree, u_rate)]), y


def further_solution(
    tree: SpanningTree,
    found: BranchElimination,
    h: Float[Array, "l *s"],
    gamma: Float[Array, "m *s"],
) -> tuple[Float[Array, "l *s"], Float[Array, "m *s"]]:
    """Accelerations and multipliers, linear in h and gamma, for another h and gamma."""
    base, m = 6 * tree.floating, gamma.shape[0]
    Z = found.Z[:, : base + m]
    h_u = _padded(h[base:][None], branch_columns(tree).T.ravel())[0]
    known = apply_transposed(Z, h_u)
    own = _blockwise(found.D, h_u[:, None])[:, 0]
    g, a = gamma + known[base:], h[:0]
    if base:
        assert found.A is not None
        right = known[:6] - h[:6]
        a = solve(found.A, right[:, None])[:, 0]
        g = g + apply_transposed(found.X, right)
    y = solve(found.S, g[:, None])[:, 0] if m else g
    if base:
        a = a - apply(found.X, y)
    u_rate = apply(Z, jnp.concatenate([-a, y])) - own
    return jnp.concatenate([a, _in_order(tree, u_rate)]), y


def right_inverse_branches(
    tree: SpanningTree, S: Float[Array, "6 k *s"], at: Inertia, J: Float[Array, "m k *s"]
) -> Float[Array, "k m *s"]:
    """Right inverse G of J: u = G b solves J u = b with minimum norm in the metric of M.

    The motion of a floating base, which is free, is taken along in this norm.
    """
    found = eliminate_branches(tree, S, at, J, jnp.zeros_like(J[:, 0]))
    base = 6 * tree.floating
    Y = found.Z[:, base:]
    if base:
        Y = Y + multiply(found.Z[:, :6], found.X)
    return _in_order(tree, jnp.swapaxes(solve(found.S, jnp.swapaxes(Y, 0, 1)), 0, 1))


def _in_order(tree: SpanningTree, u: Float[Array, "l *s"]) -> Float[Array, "k *s"]:
    """Rows in the order of the columns, from rows in the order of the branches."""
    return pick(
        u, np.argsort(branch_columns(tree).T.ravel(), kind="stable")[: len(columns(tree).frame)], 0
    )
