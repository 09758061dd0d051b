"""Forward dynamics of a tree by branch elimination, with derivatives from the inverse dynamics.

Accelerations x and multipliers y leave no residual: M x + h - J^T y = 0, gamma - J x = 0. The
residual at given x and y (inverse dynamics) costs one pass over the tree, without a mass matrix;
by the implicit function theorem the derivatives of x and y follow from those of this pass by a
solution with the blocks at hand. Differentiation of the elimination itself costs twice as much.

Source: J. Carpentier, N. Mansard, Analytical derivatives of rigid body dynamics algorithms,
Robotics: Science and Systems (2018).
"""

from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.derivative import directional
from ...algebra.stacked import summed
from ..formulations.constraints import Constraints
from .closures import Rows, ends
from .elimination import BranchElimination, eliminate_branches, first_solution, further_solution
from .frames import backward_pass, columns, forward_pass, pick
from .motion import TreeMotion, bias, inertia, needed_wrenches
from .parameters import TreeParameters
from .poses import by_frame

Solution = tuple[Float[Array, "l *s"], Float[Array, "m *s"]]


@eqx.filter_custom_jvp
def forward_dynamics(
    parameters: TreeParameters,
    constraints: Constraints,
    moving: TreeMotion,
    load: Float[Array, "6 F *s"],
    rows: Rows | None,
) -> Solution:
    """Accelerations (l,), in the order of `mass_matrix`, and multipliers (m,).

    Args:
        load: wrenches on the frames, see `wrenches_by_frame`.
        rows: constraint rows of the loop closures; None without any.
    """
    return first_solution(parameters.tree, _eliminated(parameters, moving, load, rows))


@forward_dynamics.def_jvp
def _forward_dynamics_jvp(primals: Any, tangents: Any) -> tuple[Solution, Solution]:
    parameters, _, moving, load, rows = primals
    found = _eliminated(parameters, moving, load, rows)
    x, y = first_solution(parameters.tree, found)
    left = lambda *setting: inverse_dynamics_residual(*setting, x, y)  # pyright: ignore[reportCallIssue]
    _, off = directional(left, primals, tangents)
    return (x, y), further_solution(parameters.tree, found, *off)


def _eliminated(
    parameters: TreeParameters, moving: TreeMotion, load: Float[Array, "6 F *s"], rows: Rows | None
) -> BranchElimination:
    tree = parameters.tree
    total = inertia(parameters, moving, load)
    h = bias(tree, moving.S, total)
    J = jnp.zeros((0, *moving.S.shape[1:]), h.dtype) if rows is None else rows.J
    return eliminate_branches(tree, moving.S, total, J, h[:0] if rows is None else rows.gamma, h)


def inverse_dynamics_residual(
    parameters: TreeParameters,
    constraints: Constraints,
    moving: TreeMotion,
    load: Float[Array, "6 F *s"],
    rows: Rows | None,
    x: Float[Array, "l *s"],
    y: Float[Array, "m *s"],
) -> Solution:
    """Residuals M x + h - J^T y (l,) and gamma - J x (m,), from the frames' accelerations."""
    tree = parameters.tree
    base = 6 * tree.floating
    root = jnp.zeros((6, 1, *x.shape[1:]), x.dtype)
    own = forward_pass(tree, root, by_frame(tree, moving.S * x[base:]))
    A = moving.A + own
    if base:
        A = A + x[:6, None]
    wrench = needed_wrenches(parameters, moving, A) - load
    # on the base the wrenches of a joint on its two bodies cancel, whether it is closed or not
    on_base = jnp.sum(wrench, axis=1)
    off = y
    if rows is not None:
        off = rows.gamma
        for frame, W in zip(ends(tree, constraints), rows.wrenches, strict=True):
            holds = np.eye(wrench.shape[1])[frame]
            wrench = wrench - summed(W * y, holds)
            off = off - jnp.sum(W * pick(own, frame, 1), axis=0)
    own = jnp.sum(moving.S * pick(backward_pass(tree, wrench), columns(tree).frame, 1), axis=0)
    return (jnp.concatenate([on_base, own]) if base else own), off
