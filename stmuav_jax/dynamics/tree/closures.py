"""Kinematics of a tree in the world, for force elements, and the rows of its loop closures."""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.rotation import cross, rotation_matrix
from ...algebra.stacked import apply, apply_transposed, multiply
from ...mechanics.body import GROUND
from ...mechanics.constraint import ROWS, side_world
from ...mechanics.state import Kinematics
from ...mechanics.system import System
from ..formulations.constraints import Constraints
from .coordinates import TreeCoordinates
from .frames import aligned, columns, pick, support
from .motion import TreeMotion
from .parameters import TreeParameters
from .topology import SpanningTree


class Placed(NamedTuple):
    """Kinematics of bodies and ground in the world, components first; see `Kinematics`."""

    r: Float[Array, "3 N *s"]
    v: Float[Array, "3 N *s"]
    omega: Float[Array, "3 N *s"]
    R_wb: Float[Array, "3 3 N *s"]
    omega_w: Float[Array, "3 N *s"]


def in_world(parameters: TreeParameters, at: TreeCoordinates, moving: TreeMotion) -> Placed:
    """Positions and velocities of all bodies and of ground in the world."""
    tree = parameters.tree
    R, r, v, w = moving.R, moving.c, moving.v, moving.w
    omega = apply_transposed(R, w)
    if not tree.floating:
        return Placed(r - r[:, -1:], v, omega, R, w)
    R_w0 = rotation_matrix(at.p)
    moves = aligned(np.arange(r.shape[1]) < r.shape[1] - 1, r.ndim - 1)
    R = jnp.where(moves, multiply(R_w0, R), aligned(np.eye(3), R.ndim))
    r = jnp.where(moves, at.r + apply(R_w0, r), 0.0)
    v = jnp.where(moves, at.v + apply(R_w0, v), 0.0)
    omega = jnp.where(moves, omega, 0.0)
    return Placed(r, v, omega, R, apply(R, omega))


def kinematics(system: System, placed: Placed) -> Kinematics:
    """Kinematics of one state in the form that force elements take."""
    # XLA makes no kernels of these transposes: docs/dynamics.md, "Array layout"
    R = jnp.moveaxis(placed.R_wb, -1, 0)
    return Kinematics(
        r=placed.r.T,
        v=placed.v.T,
        omega=placed.omega.T,
        R_wb=R,
        omega_w=placed.omega_w.T,
        mass=jnp.concatenate([system.bodies.mass, jnp.zeros(1)]),
        com=jnp.concatenate([system.bodies.com, jnp.zeros((1, 3))]),
        names=(*system.names, GROUND),
        joints=system.joints,
    )


class Rows(NamedTuple):
    """Constraint rows of the loop closures, m of them.

    Attributes:
        value: constraint values Phi (m, *s).
        target: right-hand side of the velocity constraints J u = target (m, *s).
        gamma: right-hand side of the acceleration constraints J du/dt = gamma (m, *s).
        J: constraint Jacobian in the velocities of the tree's steps (m, k, *s); its columns for
            a floating base would be zero.
        wrenches: wrenches on bodies i and on bodies j per unit multiplier, moment about the
            origin of frame 0 and force, two of (6, m, *s).
    """

    value: Float[Array, "m *s"]
    target: Float[Array, "m *s"]
    gamma: Float[Array, "m *s"]
    J: Float[Array, "m k *s"]
    wrenches: tuple[Float[Array, "6 m *s"], Float[Array, "6 m *s"]]


def ends(tree: SpanningTree, constraints: Constraints) -> tuple[np.ndarray, np.ndarray]:
    """Frames of the bodies i and of the bodies j of all rows, (m,) each."""
    bodies = (
        np.concatenate([np.repeat(getattr(g, end), ROWS[g.kind]) for g in constraints.groups])
        for end in ("i", "j")
    )
    i, j = (np.array(tree.frame)[body] for body in bodies)
    return i, j


def closure_rows(
    parameters: TreeParameters, constraints: Constraints, t: Float[Array, "*s"], moving: TreeMotion
) -> Rows:
    """Constraint rows of the loop-closing joints, from their primitives and the spatial axes."""
    tree = parameters.tree
    sides = side_world(moving.c, moving.v, moving.R, moving.w)
    found = [group.rows(sides, t, "world") for group in constraints.groups]
    batch = moving.c.shape[2:]

    def flat(name: str) -> Array:
        """Rows in the groups' order, those of one primitive together."""
        parts = [jnp.swapaxes(getattr(rows, name), 0, 1) for rows in found]
        return jnp.concatenate([part.reshape(-1, *batch) for part in parts])

    gamma = flat("gamma")
    J = jnp.zeros(())
    wrenches = []
    for ends, name in (("i", "J_i"), ("j", "J_j")):
        body = np.concatenate(
            [np.repeat(getattr(group, ends), ROWS[group.kind]) for group in constraints.groups]
        )
        J_body = jnp.concatenate(
            [jnp.moveaxis(getattr(rows, name), 0, 2).reshape(6, -1, *batch) for rows in found],
            axis=1,
        )
        c, w, v = (pick(x, body, 1) for x in (moving.c, moving.w, moving.v))
        force = J_body[:3]
        W = jnp.concatenate([J_body[3:] + cross(c, force), force])
        frame = np.array(tree.frame)[body]
        A = pick(moving.A, frame, 1)
        twist = cross(w, v)
        gamma = gamma - jnp.sum(W * A, axis=0) - jnp.sum(force * twist, axis=0)
        moved = support(tree)[np.ix_(columns(tree).frame, frame)].T.astype(float)
        product = sum(W[i][:, None] * moving.S[i][None] for i in range(6))
        J = J + aligned(moved, 2 + len(batch)) * product
        wrenches.append(W)
    return Rows(flat("value"), flat("target"), gamma, J, (wrenches[0], wrenches[1]))
