"""Velocities, velocity-product accelerations, composite inertias and the mass matrix of a tree.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6.3 (branch-induced sparsity).
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...math.rotation import cross, rotation_matrix
from ...math.stacked import apply_matrix, apply_transposed, multiply_matrices
from .coordinates import TreeCoordinates
from .parameters import Pose, TreeParameters, by_frame, place, root_pose, spatial_axes
from .topology import (
    SpanningTree,
    align_axes,
    backward_pass,
    find_supported,
    forward_pass,
    motion_columns,
    pick_entries,
    sum_entries,
)


class TreeMotion(NamedTuple):
    """Motion of a tree with f frames and n bodies, in the axes and about the origin of frame 0.

    Attributes:
        pose: poses of all frames.
        S: spatial axes (angular, linear) of the velocities u (6, m, *s).
        V: spatial velocities of the frames (6, f + 1, *s).
        A: spatial accelerations of the frames at du/dt = 0 (6, f + 1, *s).
        R, c: axes (3, 3, n + 1, *s) and centres of mass (3, n + 1, *s) [m] of the bodies.
        w: angular velocities of the bodies (3, n + 1, *s) [rad/s].
        v: velocities of the centres of mass relative to the base's (3, n + 1, *s) [m/s].
    """

    pose: Pose
    S: Float[Array, "6 m *s"]
    V: Float[Array, "6 f *s"]
    A: Float[Array, "6 f *s"]
    R: Float[Array, "3 3 N *s"]
    c: Float[Array, "3 N *s"]
    w: Float[Array, "3 N *s"]
    v: Float[Array, "3 N *s"]


def compute_motion(parameters: TreeParameters, at: TreeCoordinates) -> TreeMotion:
    """Motion of a tree at the given positions and velocities."""
    tree = parameters.tree
    # A single free body has no relative coordinates. The passes over an empty tree would still compile,
    # into kernels that compute nothing.
    if not tree.steps:
        return _of_base(parameters, at)
    pose = place(parameters, at.q)
    S = spatial_axes(parameters, pose)
    dV = by_frame(tree, S * at.u[None])
    root = jnp.zeros((6, 1, *at.u.shape[1:]), at.u.dtype)
    if tree.floating:
        # Frame 0 moves with the base, and its own linear velocity drops out of all relative motions: set to
        # zero, it cannot lose digits on a fast flight.
        root = jnp.concatenate([at.omega, jnp.zeros_like(at.omega)])
    V = forward_pass(tree, root, dV)
    # Accelerations at du/dt = 0 come from the same pass over the tree as velocities: the bias force then
    # needs no derivative of the mass matrix.
    A = forward_pass(tree, jnp.zeros_like(root), _spatial_cross(V[:, 1:], dV))
    frame = np.array(tree.frame)
    E, o = pick_entries(pose.E, frame, 2), pick_entries(pose.o, frame, 1)
    c = o + apply_matrix(E, parameters.com)
    body_twists = pick_entries(V, frame, 1)
    return TreeMotion(
        pose,
        S,
        V,
        A,
        multiply_matrices(E, parameters.B),
        c,
        body_twists[:3],
        body_twists[3:] + cross(body_twists[:3], c),
    )


def _of_base(parameters: TreeParameters, at: TreeCoordinates) -> TreeMotion:
    """Motion of a tree without steps, whose bodies are all fixed to frame 0."""
    pose = root_pose(at.u.shape[1:], at.u.dtype)
    root = jnp.zeros((6, 1, *at.u.shape[1:]), at.u.dtype)
    V = jnp.concatenate([at.omega, root[:3]]) if parameters.tree.floating else root
    w = jnp.broadcast_to(V[:3], (3, *parameters.com.shape[1:2], *at.u.shape[1:]))
    none = jnp.zeros((6, 0, *at.u.shape[1:]), at.u.dtype)
    return TreeMotion(
        pose, none, V, root, parameters.B, parameters.com, w, cross(w, parameters.com)
    )


def _spatial_cross(V: Float[Array, "6 f *s"], S: Float[Array, "6 f *s"]) -> Float[Array, "6 f *s"]:
    """Spatial cross product V x S: the rate of a vector S fixed in a frame that moves with V."""
    return jnp.concatenate([cross(V[:3], S[:3]), cross(V[:3], S[3:]) + cross(V[3:], S[:3])])


class Inertia(NamedTuple):
    """Composite inertias of all bodies that each frame supports, about the origin of frame 0.

    Attributes:
        mass: masses (f + 1, *s) [kg].
        moment: masses times centres of mass (3, f + 1, *s) [kg m].
        tensor: inertia tensors (3, 3, f + 1, *s) [kg m^2].
        wrench: moment and force for the motion at du/dt = 0, less the loads (6, f + 1, *s).
    """

    mass: Float[Array, "f *s"]
    moment: Float[Array, "3 f *s"]
    tensor: Float[Array, "3 3 f *s"]
    wrench: Float[Array, "6 f *s"]


# Rows and columns of the entries of a symmetric matrix that are computed, and their places in the matrix.
_UPPER = np.triu_indices(3)
_PLACES = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])


def _fill_symmetric(entries: Float[Array, "6 *s"]) -> Float[Array, "3 3 *s"]:
    """Symmetric matrices from the entries on and above the diagonal."""
    return pick_entries(entries, _PLACES, 0).reshape(3, 3, *entries.shape[1:])


def composite_inertia(
    parameters: TreeParameters, moving: TreeMotion, load: Float[Array, "6 F *s"]
) -> Inertia:
    """Composite inertias, and bias wrenches under loads on the frames (`wrenches_by_frame`)."""
    tree, E = parameters.tree, moving.pose.E
    c = moving.pose.o + apply_matrix(E, parameters.centre)
    row, column = _UPPER
    rotated_rows = pick_entries(multiply_matrices(E, parameters.inertia), row, 0)
    tensor = jnp.sum(rotated_rows * pick_entries(E, column, 0), axis=1)
    turning, f = _bias_of_frames(parameters, moving, c, _fill_symmetric(tensor))
    # First moments and tensors about the common origin simply add along the tree, so that composite
    # inertias are one backward sum without transformations between frames (R. Featherstone 2008, ch.
    # 6.2).
    mc = parameters.mass[None] * c
    x, y, z = mc * c
    square = align_axes(1.0 * (row == column), 1 + x.ndim) * (x + y + z)[None]
    about = tensor + square - pick_entries(mc, row, 0) * pick_entries(c, column, 0)
    # All quantities that are summed towards the root go through one pass: the depth of the tree is paid
    # once.
    total = backward_pass(tree, jnp.concatenate([mc, about, turning - load[:3], f - load[3:]]))
    return Inertia(parameters.subtree_mass, total[:3], _fill_symmetric(total[3:9]), total[9:])


def wrenches_by_frame(
    tree: SpanningTree,
    moving: TreeMotion,
    force: Float[Array, "3 n *s"],
    moment: Float[Array, "3 n *s"],
) -> Float[Array, "6 F *s"]:
    """Wrench (moment about the origin, force) of the loads on the bodies of each frame.

    Args:
        force: forces at the bodies' centres of mass [N].
        moment: moments about the bodies' centres of mass [N m].
    """
    n = len(tree.frame) - 1
    rows = jnp.concatenate([moment + cross(moving.c[:, :n], force), force])
    # Bodies that are welded to one frame are gathered by a constant index: no scatter, which is slow on
    # accelerators and not deterministic there.
    bodies: list[list[int]] = [[] for _ in range(len(tree.steps) + 1)]
    for body in range(n):
        bodies[tree.frame[body]].append(body)
    return sum_entries(rows, bodies)


def _bias_of_frames(
    parameters: TreeParameters,
    moving: TreeMotion,
    c: Float[Array, "3 F *s"],
    tensor: Float[Array, "3 3 F *s"],
) -> tuple[Float[Array, "3 F *s"], Float[Array, "3 F *s"]]:
    """Moment about the origin and force that the bodies of each frame need at du/dt = 0."""
    w, A = moving.V[:3], moving.A
    v = moving.V[3:] + cross(w, c)
    f = parameters.mass[None] * (A[3:] + cross(A[:3], c) + cross(w, v))
    return apply_matrix(tensor, A[:3]) + cross(w, apply_matrix(tensor, w)) + cross(c, f), f


def needed_wrenches(
    parameters: TreeParameters, moving: TreeMotion, A: Float[Array, "6 F *s"]
) -> Float[Array, "6 F *s"]:
    """Wrenches (moment about the origin, force) that frames with spatial accelerations A need."""
    E, w = moving.pose.E, moving.V[:3]
    c = moving.pose.o + apply_matrix(E, parameters.centre)
    apply_inertia = lambda x: apply_matrix(
        E, apply_matrix(parameters.inertia, apply_transposed(E, x))
    )
    v = moving.V[3:] + cross(w, c)
    f = parameters.mass[None] * (A[3:] + cross(A[:3], c) + cross(w, v))
    return jnp.concatenate([apply_inertia(A[:3]) + cross(w, apply_inertia(w)) + cross(c, f), f])


def spatial_momenta(
    frame: np.ndarray, S: Float[Array, "6 m *s"], at: Inertia
) -> Float[Array, "6 m *s"]:
    """Spatial momenta (angular about the origin, linear) per unit of the frames' velocities."""
    h, tensor = pick_entries(at.moment, frame, 1), pick_entries(at.tensor, frame, 2)
    # The momentum of a composite body per unit of an axis needs the ten inertia parameters only and never
    # a 6 x 6 matrix.
    linear = pick_entries(at.mass, frame, 0)[None] * S[3:] - cross(h, S[:3])
    return jnp.concatenate([apply_matrix(tensor, S[:3]) + cross(h, S[3:]), linear])


def base_inertia(at: Inertia) -> Float[Array, "6 6 *s"]:
    """Composite spatial inertia of the floating system about the base's centre of mass."""
    x, y, z = at.moment[:, 0]
    zero = jnp.zeros_like(x)
    lever = jnp.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3, *x.shape)
    mass = align_axes(np.eye(3), 2 + x.ndim) * (at.mass[0] + zero)[None, None]
    upper = jnp.concatenate([at.tensor[:, :, 0], lever], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([-lever, mass], axis=1)])


def mass_matrix(
    tree: SpanningTree, S: Float[Array, "6 m *s"], at: Inertia
) -> Float[Array, "k k *s"]:
    """Mass matrix in the velocities (omega and v of a floating base in its axes, u)."""
    if tree.floating and not tree.steps:
        return base_inertia(at)
    frame = motion_columns(tree).frame
    F = spatial_momenta(frame, S, at)
    # Entries of two axes on different branches are zero (branch-induced sparsity). The mask is a constant
    # of the tree, and the symmetric half is the transpose of the computed one.
    above = find_supported(tree)[np.ix_(frame, frame)]
    product = jnp.sum(S[:, :, None] * F[:, None], axis=0)
    batch = product.ndim
    flipped = jnp.swapaxes(product, 0, 1)
    M = jnp.where(
        align_axes(above, batch), product, jnp.where(align_axes(above.T, batch), flipped, 0.0)
    )
    if not tree.floating:
        return M
    upper = jnp.concatenate([base_inertia(at), F], axis=1)
    return jnp.concatenate([upper, jnp.concatenate([jnp.swapaxes(F, 0, 1), M], axis=1)])


def bias_force(tree: SpanningTree, S: Float[Array, "6 m *s"], at: Inertia) -> Float[Array, "k *s"]:
    """Bias force h of M du/dt + h = J^T lambda, in the order of `mass_matrix`."""
    if tree.floating and not tree.steps:
        return at.wrench[:, 0]
    wrench = pick_entries(at.wrench, motion_columns(tree).frame, 1)
    joint_bias = jnp.sum(S * wrench, axis=0)
    return jnp.concatenate([at.wrench[:, 0], joint_bias]) if tree.floating else joint_bias


def body_accelerations(
    parameters: TreeParameters,
    at: TreeCoordinates,
    moving: TreeMotion,
    u_rate: Float[Array, "k *s"],
) -> tuple[Float[Array, "3 n *s"], Float[Array, "3 n *s"]]:
    """Accelerations in the world [m/s^2] and angular ones in body axes [rad/s^2] of all bodies."""
    tree = parameters.tree
    base = 6 * tree.floating
    joint_accelerations = by_frame(tree, moving.S * u_rate[None, base:])
    root = (
        u_rate[:6, None]
        if tree.floating
        else jnp.zeros((6, 1, *joint_accelerations.shape[2:]), joint_accelerations.dtype)
    )
    n = len(tree.frame) - 1
    A = pick_entries(
        moving.A + forward_pass(tree, root, joint_accelerations), np.array(tree.frame[:n]), 1
    )
    c, w, v = moving.c[:, :n], moving.w[:, :n], moving.v[:, :n]
    a = A[3:] + cross(A[:3], c) + cross(w, v)
    if tree.floating:
        a = apply_matrix(rotation_matrix(at.p), a)
    return a, apply_transposed(moving.R[:, :, :n], A[:3])
