"""Independence of constraint rows: one scaling, one threshold, and rows that are dependent in every posture.

The rows J of a constraint Jacobian have units of a length or none, and its columns belong to velocities
[m/s] or angular velocities [rad/s]. With the longest arm L of the joints, rows that are lengths divided
by L and columns of velocities multiplied by L make a matrix without units: its singular values do not
depend on the unit of length, time or mass, nor on the size of the mechanism.

A row that repeats others in every posture, as three rows of a planar loop of four hinges do, is found at
several consistent postures and left out of the equations for good. For such rows to stay the same ones,
those of coincident points are taken in the axes of body i, in which the plane of a loop stands still.
"""

import dataclasses
import threading
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.errors import ModelError, has_values
from ...checks.numbers import array_module, as_jax, as_numpy, stack_arrays
from ...math.compiler import compute_untraced, kept_jit, remember_results
from ...math.native.program import native
from ...mechanics.body import GROUND
from ...mechanics.constraint import ROWS
from ...mechanics.state import State, compute_kinematics
from ...mechanics.system import System
from .constraints import Constraints, group_constraints

# Singular values of the matrix without units below this fraction of the largest count as zero, and so
# does a row's distance from the span of others.
DEPENDENT = 1e-9
# Rows are as good as lost to double precision if their distance from the span of the others is below
# this in every posture: the equations square it.
WEAK = 1e-6

# Displacement to the postures at which the rows are compared, as an angle [rad] or a part of the longest
# arm, in turn if the loops do not close from there; and steps of Newton's method to close them.
_APART, _STEPS = (0.3, 0.1, 0.03), 40
# Loops are closed if their rows without units are below this, and round-off of far positions.
_CLOSED = 1e-12
# Number of postures beside the reference posture, in directions without any pattern.
_BESIDE = 3
# Mechanisms whose rows are remembered.
_MOST_REMEMBERED = 64
# Kinds whose points and lengths say how large a mechanism is.
_SIZED = ("point", "n2", "p2", "distance", "displacement", "screw")
_ROUND_OFF = 1e-14


def longest_arm(system: System, rows: Constraints) -> Float[Array | np.ndarray, ""]:
    """Longest arm L [m] from a centre of mass to a joint's point on that body, or longest rod.

    Where all of them are zero it is the largest radius of gyration.
    """
    bodies, groups = as_numpy((system.bodies, rows.groups))
    xp = array_module(groups, system.reference)
    arms = [xp.zeros(1)]
    for group in groups:
        if group.kind in _SIZED:
            data = group.data
            ends = (data.point_i, data.point_j)
            arms += [xp.sqrt(xp.sum(xp.asarray(x) ** 2, axis=0)).reshape(-1) for x in ends]
        if group.kind == "distance":
            arms.append(xp.abs(xp.asarray(group.data.length)).reshape(-1))
    arm = xp.max(xp.concatenate(arms))
    # Arms of the size of round-off of the positions are no arms: a mechanism of points would else be
    # scaled by noise.
    smallest = 100 * _ROUND_OFF * xp.max(xp.abs(xp.asarray(system.reference.r)))
    if xp is np and arm > smallest:
        return np.asarray(arm)  # masses may be traced
    xp = array_module(bodies, arm, smallest)
    moments = xp.max(xp.abs(xp.asarray(bodies.inertia)), axis=(1, 2))
    # a body without mass or inertia has no radius of gyration
    heavy = xp.where(bodies.mass > 0, bodies.mass, 1.0)
    radius = xp.max(xp.sqrt(moments / heavy))
    radius = xp.where(radius > 0, radius, 1.0)
    return xp.where(arm > smallest, arm, radius)


def row_scales(rows: Constraints, arm: Any) -> Float[Array | np.ndarray, " m"]:
    """Factors (m,) that take the units from rows: those that are lengths are divided by the arm."""
    # within a trace JAX's operations on known numbers give traced ones
    scales, angular = rows.scales(), rows.angular
    xp = array_module(scales, angular, arm)
    return xp.asarray(scales) * xp.where(xp.asarray(angular), 1.0, 1.0 / arm)


def column_scales(n_bodies: int, arm: Any) -> Float[np.ndarray, " k"]:
    """Factors (6 n,) that take the units from columns in (v, omega')."""
    # A displacement of one arm counts as much as a turn of one radian, which is what makes singular
    # values of rows and columns of mixed units comparable.
    return np.tile(np.repeat([float(arm), 1.0], 3), n_bodies)


def scale_matrix(
    system: System, rows: Constraints, matrix: Float[np.ndarray, "*s m k"]
) -> Float[np.ndarray, "*s m k"]:
    """Constraint Jacobian in (v, omega') without units, see the module."""
    arm = float(longest_arm(system, rows))
    scale = np.asarray(row_scales(rows, arm))[:, None]
    return np.asarray(matrix) * scale * column_scales(system.n_bodies, arm)


def count_independent(values: Float[np.ndarray, "*s k"]) -> Any:
    """Rank from the singular values of matrices without units, the largest first."""
    values = np.asarray(values)
    # One threshold for rank, checks and formulations: two of them would disagree on mechanisms that lie
    # between.
    return np.sum(values > DEPENDENT * values[..., :1], axis=-1)


def turn_rows(
    rows: Constraints,
    R: Float[Array, "3 3 N *s"],
    values: Float[Array, "m ..."],
    *,
    back: bool = False,
) -> Float[Array, "m ..."]:
    """Rows with those of coincident points in the axes of body i, or from these if `back`.

    Args:
        R: axes of all bodies and ground, in those of the rows.
        values: rows, whose last axes are those of R's batch.
    """
    batch = R.ndim - 3
    parts, start = [], 0
    for group in rows.groups:
        count = ROWS[group.kind] * len(group.i)
        part = values[start : start + count]
        start += count
        if group.kind == "point":
            # In the axes of body i the plane of a planar loop stands still, so that the same row of a coincident
            # point is the dependent one in every posture.
            axes = R[:, :, np.array(group.i)]
            axes = axes if back else jnp.swapaxes(axes, 0, 1)
            part = part.reshape(len(group.i), 3, *part.shape[1:])
            inner = part.ndim - 2 - batch
            axes = axes.reshape(*axes.shape[:3], *(1,) * inner, *axes.shape[3:])
            part = jnp.sum(axes * jnp.moveaxis(part, 1, 0)[None], axis=1)
            part = jnp.moveaxis(part, 0, 1).reshape(count, *part.shape[2:])
        parts.append(part)
    return jnp.concatenate(parts)


def open_limit(tolerance: Any, *, projected: bool) -> Any:
    """Residual of constraints without units above which a run's joints have come open.

    A projection closes loops to round-off, unless rows hold that it leaves out. Without one they drift
    by more than the tolerance.

    Args:
        tolerance: larger one of the tolerances of a step.
    """
    return (10.0 if projected else 1e4) * tolerance + 2e-8


class Independence(NamedTuple):
    """Rows that are independent in nearly every posture.

    Attributes:
        rows: mask (m,) of a set of rows on which all others depend; None if all are independent.
        rank: rank of the rows of all joints.
        weakest: smallest singular value that does not count as zero, at the posture where it is largest,
            relative to the largest one.
        shares: squares of the components of the combination of rows that belongs to it, of all joints.
    """

    rows: Bool[np.ndarray, " m"] | None
    rank: int
    weakest: float = 1.0
    shares: Float[np.ndarray, " r"] | None = None


class _Postures(NamedTuple):
    """Jacobians (p, m, 6 n) without units at p consistent postures, rows of points in body axes."""

    matrices: Float[np.ndarray, "p m k"]
    owner: tuple[int, ...]


def find_independent_rows(system: System, joints: Sequence[int] | None = None) -> Independence:
    """Rows of all joints, or of those with given indices, that do not depend on other rows.

    The rows of the joints that are not given come before them: they all stay. Among those that are left
    the set is taken whose rows are farthest from each other in the metric of the inverse masses, which
    keeps the equations' condition. The result is remembered for the numbers of the mechanism.

    Args:
        joints: indices of joints that close loops, see `group_constraints`; by default of all joints.
    """
    if not _has_loops(system) or (joints is not None and not joints):
        return Independence(None, sum(joint.n_rows for joint in system.joints))
    geometry = [
        getattr(joint, field.name)
        for joint in system.joints
        for field in dataclasses.fields(joint)
        if field.name != "motion"
    ]
    if not has_values(geometry, system.reference, system.bodies.com):
        return Independence(None, sum(joint.n_rows for joint in system.joints))
    # Within a trace JAX's operations on known numbers give traced ones, so that the rows, too, are
    # computed outside it.
    return compute_untraced(_find_independent, system, joints)


@remember_results
def _find_independent(system: System, joints: Sequence[int] | None) -> Independence:
    rows = group_constraints(system)
    undriven_rows = _remove_motions(rows)
    if not has_values(system.bodies.mass, system.bodies.inertia):
        # Rows depend on each other by their geometry; unknown inertias count as those of equal spheres
        # of the mechanism's size.
        system = _with_spheres(system, float(longest_arm(_with_spheres(system, 1.0), rows)))
    none = Independence(None, rows.n_rows)
    postures = _cached_postures(system, rows, undriven_rows)
    if not len(postures.matrices):
        return none
    closing = np.isin(rows.owner, list(range(len(system.joints)) if joints is None else joints))
    left_vectors, values, _ = np.linalg.svd(postures.matrices, full_matrices=False)
    # Dependence in one posture may be a singular one; rows are left out only if they are dependent in the
    # posture where the rank is largest.
    counts = count_independent(values)
    # a mechanism that can only shake closes to a square: its neighbours are known to the root of that
    counts[1:] = np.sum(values[1:] > 10 * WEAK * values[1:, :1], axis=1)
    rank = int(np.max(counts))
    where = np.where(counts == rank, values[:, rank - 1] / values[:, 0], 0.0)
    clearest = int(np.argmax(where))
    shares = left_vectors[clearest, :, rank - 1] ** 2
    independence = Independence(None, rank, float(where[clearest]), shares)
    if rank == rows.n_rows:
        return independence
    number = rank - int(np.sum(~closing))
    # Among all sets of the right size the one with the best condition is taken, since a valid set of
    # nearly parallel rows would lose digits in every step.
    mask = _select_farthest(system, postures.matrices[counts == rank], closing, number)
    return independence._replace(rows=mask)


def _with_spheres(system: System, radius: float) -> System:
    """The system with bodies of 1 kg and of a given radius of gyration [m]."""
    unit = (np.ones(system.n_bodies), np.stack([radius**2 * np.eye(3)] * system.n_bodies))
    return eqx.tree_at(lambda s: (s.bodies.mass, s.bodies.inertia), system, unit)


def compute_condition(
    system: System, row_mask: Bool[np.ndarray, " m"] | None, state: State
) -> tuple[float, float]:
    """Condition number of the equations for the multipliers of all joints, and that of their geometry.

    The equations are scaled to a unit diagonal. As many digits of the accelerations as the first number
    has are lost to round-off; the second is that for bodies of equal inertias.

    Args:
        row_mask: mask of the rows that the equations hold; None if they hold all.
    """
    rows = group_constraints(system)
    if not rows.n_rows:
        return 1.0, 1.0
    at = jax.tree.map(lambda x: stack_arrays([x] * (_BESIDE + 1)), state)
    matrix = np.asarray(_rows_at(system.names, system.bodies.com, _remove_motions(rows), at)[1])[0]
    matrix = scale_matrix(system, rows, matrix)
    matrix = matrix if row_mask is None else matrix[row_mask]

    def gram_condition(weighed: Float[np.ndarray, "m k"]) -> float:
        # The equations for the multipliers have the condition of J M^-1 J^T, and the geometry's own condition
        # shows whether masses or posture cause it.
        S = weighed @ weighed.T
        scale = 1 / np.sqrt(np.diag(S))
        values = np.linalg.eigvalsh(scale[:, None] * S * scale)
        return float(values[-1] / values[0]) if values[0] > 0 else float("inf")

    return gram_condition(matrix @ _inverse_root_of_masses(system)), gram_condition(matrix)


def find_extreme_bodies(system: System) -> tuple[str, str, float]:
    """Names of the bodies that resist motion least and most, and the ratio of their inertias.

    A body's inertias are its mass and its moments of inertia over the square of the longest arm.
    """
    arm = float(longest_arm(system, group_constraints(system)))
    moments = np.linalg.eigvalsh(np.asarray(system.bodies.inertia)) / arm**2
    # Moments over the squared arm are masses, so that both resistances to motion are compared in one
    # unit.
    inertias = np.column_stack([np.asarray(system.bodies.mass), moments])
    light, heavy = np.min(inertias, axis=1), np.max(inertias, axis=1)
    least, most = int(np.argmin(light)), int(np.argmax(heavy))
    ratio = float(heavy[most] / light[least]) if light[least] > 0 else float("inf")
    return system.names[least], system.names[most], ratio


# Condition of the equations of `Augmented` at which accelerations lose all but four digits.
_MOST_CONDITION = 3e11
# Inertias that differ by less leave its equations enough digits in any but a nearly singular posture.
_APART_ENOUGH = 1e6


def check_condition(system: System, state: State) -> None:
    """Raise `ModelError` if round-off leaves too little of the accelerations by `Augmented`."""
    row_mask = find_independent_rows(system).rows
    condition, geometric = compute_condition(system, row_mask, state)
    # a posture near a singular one is not the masses' fault
    if condition <= _MOST_CONDITION or condition <= 1e3 * geometric:
        return
    light, heavy, ratio = find_extreme_bodies(system)
    raise ModelError(
        f"The masses and moments of inertia of the bodies '{light}' and '{heavy}' are too far apart for "
        f"Augmented: they differ by {ratio:.1g} (moments over the squared longest arm), and round-off "
        f"of its equations, of condition {condition:.1g}, would dominate the accelerations. Use Tree(), "
        "or give the bodies inertias nearer to each other."
    )


def check_inertias(system: System, state: State) -> None:
    """Check the condition of `Augmented` where values are known and inertias are far apart."""
    if has_values((system, state)) and find_extreme_bodies(system)[2] > _APART_ENOUGH:
        check_condition(system, state)


def compare_clearance(
    system: System,
    row_mask: Bool[np.ndarray, " c"],
    states: State,
    joints: Sequence[int] | None = None,
) -> float:
    """Smallest singular value of the rows that equations hold, at the last state over that at the first.

    Args:
        row_mask: mask of the closing rows that are held. states: two or more states (k, n, .).
        joints: indices of the joints that close loops; by default all, see `find_independent_rows`.
    """
    rows = group_constraints(system)
    pick = np.r_[np.zeros(_BESIDE, int), -1]
    at = jax.tree.map(lambda x: as_jax(np.asarray(x)[pick]), states)
    matrix = np.asarray(_rows_at(system.names, system.bodies.com, _remove_motions(rows), at)[1])
    closing = np.isin(rows.owner, list(range(len(system.joints)) if joints is None else joints))
    held_mask = ~closing
    held_mask[closing] = row_mask
    values = np.linalg.svd(
        scale_matrix(system, rows, matrix)[[0, -1]][:, held_mask], compute_uv=False
    )
    return float(values[1, -1] / values[0, -1])


def _remove_motions(rows: Constraints) -> Constraints:
    """Rows without their prescribed motions, which move none of the Jacobian."""
    groups = tuple(dataclasses.replace(group, motions=()) for group in rows.groups)
    return Constraints(groups, rows.owner, rows.n_bodies)


def _has_loops(system: System) -> bool:
    """True if the joints close a loop of bodies."""
    names = (*system.names, GROUND)
    incidence = np.zeros((len(system.joints), len(names)))
    for row, joint in zip(incidence, system.joints, strict=True):
        row[names.index(joint.body_i)] += 1.0
        row[names.index(joint.body_j)] -= 1.0
    # the edges of a forest are independent
    return bool(np.linalg.matrix_rank(incidence) < len(incidence)) if len(incidence) else False


_memory: OrderedDict[Any, _Postures] = OrderedDict()
_lock = threading.Lock()


def _cached_postures(system: System, rows: Constraints, undriven_rows: Constraints) -> _Postures:
    leaves, structure = jax.tree.flatten((undriven_rows, system.reference, system.bodies.com))
    driven = tuple(bool(group.motions) for group in rows.groups)
    # Studies prepare the same mechanism thousands of times; the key holds the numbers themselves, because
    # a rounded axis changes the answer.
    key = (structure, system.names, driven, *(np.asarray(x).tobytes() for x in leaves))
    with _lock:
        if key in _memory:
            _memory.move_to_end(key)
            return _memory[key]
    postures = _sample_jacobians(system, rows, undriven_rows)
    with _lock:
        _memory[key] = postures
        while len(_memory) > _MOST_REMEMBERED:
            _memory.popitem(last=False)
    return postures


def _sample_jacobians(system: System, rows: Constraints, undriven_rows: Constraints) -> _Postures:
    """Jacobians at the reference posture and near it, where the loops close."""
    n = system.n_bodies
    arm = float(longest_arm(system, rows))
    distance_in_arms = float(np.max(np.abs(np.asarray(system.reference.r)))) / arm
    scale, unit = np.asarray(row_scales(rows, arm)), column_scales(n, arm)
    # a driver's row prescribes where the mechanism is, and not how it can move
    free = np.repeat(
        [not g.motions for g in rows.groups], [ROWS[g.kind] * len(g.i) for g in rows.groups]
    )

    def evaluate_rows(states: State) -> tuple[np.ndarray, np.ndarray]:
        value, matrix = _rows_at(system.names, system.bodies.com, undriven_rows, states)
        return np.asarray(value) * scale, np.asarray(matrix) * scale[:, None] * unit

    def close_states(states: State) -> tuple[State, np.ndarray, np.ndarray]:
        """States with closed loops, their Jacobians, and true where the loops are closed."""
        value, matrix = evaluate_rows(states)
        for _ in range(_STEPS):
            if not np.all(np.isfinite(value)) or np.max(np.abs(value[:, free])) <= 0.1 * _CLOSED:
                break
            inverse = np.linalg.pinv(matrix[:, free], rcond=1e-7)
            step = -np.einsum("pkm,pm->pk", inverse, value[:, free])
            states = displace_postures(states, step * unit)
            value, matrix = evaluate_rows(states)
        size = np.max(np.abs(np.nan_to_num(value[:, free], nan=1.0)), axis=1, initial=0.0)
        return states, matrix, size <= _CLOSED + _ROUND_OFF * distance_in_arms

    start = jax.tree.map(lambda x: stack_arrays([x] * (_BESIDE + 1)), system.reference)
    start, matrix, is_closed = close_states(start)
    if not is_closed[0]:
        return _Postures(matrix[:0], rows.owner)
    _, values, right = np.linalg.svd(matrix[0][free])
    motions = right[int(count_independent(values)) :]
    if not len(motions):
        return _Postures(matrix[:1], rows.owner)
    ways = np.random.default_rng(0).standard_normal((_BESIDE + 1, len(motions))) @ motions
    ways /= np.max(np.abs(ways), axis=1, keepdims=True)
    ways[0] = 0.0
    matrices = [matrix[0]]
    for distance in _APART:
        states, matrix, is_closed = close_states(displace_postures(start, distance * ways * unit))
        # a structure that can only shake comes back to where it was
        displacements = np.max(np.abs(np.asarray(states.p) - np.asarray(start.p)), axis=(1, 2))
        displacements += (
            np.max(np.abs(np.asarray(states.r) - np.asarray(start.r)), axis=(1, 2)) / arm
        )
        is_closed &= displacements > 1e-3
        matrices += list(matrix[1:][is_closed[1:]])
        if len(matrices) > _BESIDE // 2 + 1:
            break
    return _Postures(np.stack(matrices), rows.owner)


@kept_jit
def _rows_at(
    names: tuple[str, ...], com: Float[Array, "n 3"], rows: Constraints, states: State
) -> tuple[Float[Array, "p m"], Float[Array, "p m k"]]:
    """Values and Jacobians of the rows at p postures, those of points in the axes of body i."""

    return jax.vmap(lambda state: _rows_of_state(names, com, rows, state))(states)


@native
def _rows_of_state(
    names: tuple[str, ...], com: Float[Array, "n 3"], rows: Constraints, state: State
) -> tuple[Float[Array, " m"], Float[Array, "m k"]]:
    kin = compute_kinematics(state, mass=jnp.ones(len(names)), com=com, names=names, joints=())
    eq = rows.equations(jnp.zeros(()), kin)
    R = jnp.moveaxis(kin.R_wb, 0, -1)
    return turn_rows(rows, R, eq.value), turn_rows(rows, R, eq.matrix)


def displace_postures(states: State, steps: Float[np.ndarray, "p k"]) -> State:
    """Postures (p, n, .) after small steps in world translations [m] and body rotation vectors [rad].

    An error of third order in the angle is left.

    Args:
        states: one posture (n, .), or one for every step (p, n, .).
    """
    shift, turn = np.split(steps.reshape(len(steps), -1, 6), 2, axis=2)
    r, p, v, omega = (np.asarray(x) for x in (states.r, states.p, states.v, states.omega))
    # p times the quaternion (1, turn / 2)
    scalar = -np.sum(p[..., 1:] * turn, axis=-1, keepdims=True)
    vector = p[..., :1] * turn + np.cross(p[..., 1:], turn)
    orientations = p + 0.5 * np.concatenate([scalar, vector], axis=2)
    orientations /= np.linalg.norm(orientations, axis=2, keepdims=True)
    velocities = [np.broadcast_to(x, shift.shape) for x in (v, omega)]
    return State(*(as_jax(np.array(x)) for x in (r + shift, orientations, *velocities)))


def _select_farthest(
    system: System,
    matrices: Float[np.ndarray, "p m k"],
    closing: Bool[np.ndarray, " m"],
    number: int,
) -> Bool[np.ndarray, " c"]:
    """Mask, of the closing rows (c,), of those that stay farthest from each other at all postures."""
    weights = _inverse_root_of_masses(system)
    rows = matrices @ weights
    rows = rows / np.linalg.norm(rows, axis=2, keepdims=True)
    others = rows[:, ~closing]
    rest = rows[:, closing]
    if others.shape[1]:
        _, _, right = np.linalg.svd(others)
        free = right[:, others.shape[1] :]
        rest = np.einsum("pmk,pfk->pmf", rest, free)
    mask = np.zeros(rest.shape[1], bool)
    for _ in range(number):
        distance = np.min(np.linalg.norm(rest, axis=2), axis=0)
        pick = int(np.argmax(np.where(mask, -1.0, distance)))
        mask[pick] = True
        way = rest[:, pick] / np.linalg.norm(rest[:, pick], axis=1, keepdims=True)
        for _ in range(2):
            rest = rest - np.einsum("pm,pk->pmk", np.einsum("pmk,pk->pm", rest, way), way)
    return mask


def _inverse_root_of_masses(system: System) -> Float[np.ndarray, "k k"]:
    """Matrix whose product with its transpose is the inverse mass matrix without units."""
    n = system.n_bodies
    arm = float(longest_arm(system, group_constraints(system)))
    mass, inertia = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    root = np.zeros((n, 6, n, 6))
    for k in range(n):
        moments, axes = np.linalg.eigh(inertia[k])
        if mass[k] <= 0 or moments[0] <= 0:
            return np.eye(6 * n)
        root[k, :3, k, :3] = np.eye(3) / np.sqrt(mass[k]) / arm
        root[k, 3:, k, 3:] = axes / np.sqrt(moments)
    return root.reshape(6 * n, 6 * n)
