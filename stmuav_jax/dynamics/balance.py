"""Accelerations of a tree solved by its branches, with derivatives from the balance of forces.

Accelerations x and multipliers y leave nothing unbalanced: M x + h - J^T y = 0, gamma - J x = 0.
What is unbalanced at given x and y costs one pass over the tree, without a mass matrix; by the
implicit function theorem the derivatives of x and y are those of this pass, solved with the
blocks that are there already. Differentiating the elimination itself costs twice as much.

Source: J. Carpentier, N. Mansard, Analytical derivatives of rigid body dynamics algorithms,
Robotics: Science and Systems (2018).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.derivative import directional
from ..algebra.stacked import summed
from .branches import Eliminated, eliminate, first_solution, further_solution
from .chain import Chain
from .cut import Rows, ends
from .differential import Constraints
from .frames import columns, inwards, outwards, pick
from .motion import Motion, bias, inertia, needed_wrenches
from .pose import by_frame

Solution = tuple[Float[Array, "l *s"], Float[Array, "m *s"]]


@eqx.filter_custom_jvp
def balanced(
    chain: Chain,
    constraints: Constraints,
    moving: Motion,
    load: Float[Array, "6 F *s"],
    rows: Rows | None,
) -> Solution:
    """Accelerations (l,), in the order of `mass_matrix`, and multipliers (m,).

    Args:
        load: on the frames, see `wrenches_by_frame`. rows: of the cut joints.
    """
    return first_solution(chain.tree, _eliminated(chain, moving, load, rows))


@balanced.def_jvp
def _balanced_jvp(primals: Any, tangents: Any) -> tuple[Solution, Solution]:
    chain, _, moving, load, rows = primals
    found = _eliminated(chain, moving, load, rows)
    x, y = first_solution(chain.tree, found)
    left = lambda *setting: unbalanced(*setting, x, y)  # pyright: ignore[reportCallIssue]
    _, off = directional(left, primals, tangents)
    return (x, y), further_solution(chain.tree, found, *off)


def _eliminated(
    chain: Chain, moving: Motion, load: Float[Array, "6 F *s"], rows: Rows | None
) -> Eliminated:
    tree = chain.tree
    total = inertia(chain, moving, load)
    h = bias(tree, moving.S, total)
    J = jnp.zeros((0, *moving.S.shape[1:]), h.dtype) if rows is None else rows.J
    return eliminate(tree, moving.S, total, J, h[:0] if rows is None else rows.gamma, h)


def unbalanced(
    chain: Chain,
    constraints: Constraints,
    moving: Motion,
    load: Float[Array, "6 F *s"],
    rows: Rows | None,
    x: Float[Array, "l *s"],
    y: Float[Array, "m *s"],
) -> Solution:
    """M x + h - J^T y (l,) and gamma - J x (m,), from the frames' accelerations."""
    tree = chain.tree
    base = 6 * tree.floating
    root = jnp.zeros((6, 1, *x.shape[1:]), x.dtype)
    own = outwards(tree, root, by_frame(tree, moving.S * x[base:]))
    A = moving.A + own
    if base:
        A = A + x[:6, None]
    wrench = needed_wrenches(chain, moving, A) - load
    # rows do not know the base: on it the two sides of a joint cancel, closed or not
    on_base = jnp.sum(wrench, axis=1)
    off = y
    if rows is not None:
        off = rows.gamma
        for frame, W in zip(ends(tree, constraints), rows.wrenches, strict=True):
            holds = np.eye(wrench.shape[1])[frame]
            wrench = wrench - summed(W * y, holds)
            off = off - jnp.sum(W * pick(own, frame, 1), axis=0)
    own = jnp.sum(moving.S * pick(inwards(tree, wrench), columns(tree)[0], 1), axis=0)
    return (jnp.concatenate([on_base, own]) if base else own), off
