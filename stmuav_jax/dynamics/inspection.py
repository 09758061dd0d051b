"""Inspection of a mechanism and its posture before a run: what is wrong, and what it will demand."""

import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..checks.errors import ModelError, SettingError, StateError
from ..checks.physical import check_inertia, check_mass
from ..mechanics.forces.applied import Gravity
from ..mechanics.internal import internal_states
from ..mechanics.state import State
from ..mechanics.system import System
from .assembly.initial import Rank, rank_of
from .assembly.singular import weakest_rows
from .certify import allow_dependent, branches_at, check_determined
from .checks import (
    POSITION_TOLERANCE,
    VELOCITY_TOLERANCE,
    check_consistent,
    check_loads,
    check_start,
)
from .evaluation import RowsAt, Saved, rows_at
from .formulations.augmented import Augmented, AugmentedModel, displace
from .scene import Scene
from .stiffness import EXPLICIT_LIMIT, spectrum
from .tree.formulation import Tree
from .tree.topology import spanning_tree

Severity = Literal["fault", "warning", "note"]
SEVERITIES: tuple[Severity, ...] = ("fault", "warning", "note")

# Excess over the triangle inequality that a rounded, printed table may have.
_ROUNDED = 0.1
# Densities of the solid ellipsoid and of the sphere that stand for a body [kg/m^3]: a tenth of
# air's, and well above osmium's. A unit that is wrong by 1000 in a length changes them by 1e9.
_LIGHT, _DENSE = 0.1, 3e4
# Magnitudes of gravity on the Moon and on Jupiter [m/s^2], with a margin.
_WEAK, _STRONG = 1.5, 26.0
# Range of sizes of a mechanism [m].
_SMALL, _LARGE = 1e-3, 1e4
# Ratio of masses and condition numbers beyond which few digits are left.
_RATIO, _CONDITION = 1e8, 1e10
# Distance to a singular posture [m or rad] that gets a warning, and the step that finds it.
_NEAR, _STEP = 0.05, 1e-3
# Newton's steps that put the posture beside it on the constraints.
_CORRECTIONS = 6
# Singular value, as a fraction of the largest, that a dependent row gains beside a singular posture.
_GAINED = 1e-6
# Part of the largest eigenvalue below which another one is round-off of zero.
_ZERO = 1e-6


class Finding(NamedTuple):
    """Finding of an inspection.

    Attributes:
        severity: "fault" if the mechanism cannot be simulated so, "warning" if it probably is not
            what is meant or is near its limits, "note" for what is good to know.
        what: quantity or thing. value: its value with its unit, or what was found, in words.
        valid: what would be valid, or advice; may be empty.
    """

    severity: Severity
    what: str
    value: str
    valid: str = ""


class Inspection(NamedTuple):
    """Findings of `check`, those of the highest severity first."""

    findings: tuple[Finding, ...]

    @property
    def worst(self) -> Severity:
        """Highest severity that occurs; "note" if there are no findings."""
        return self.findings[0].severity if self.findings else "note"

    def __str__(self) -> str:
        rows = (f"{f.severity}: {f.what}: {f.value} {f.valid}".strip() for f in self.findings)
        return "\n".join(rows)


def check(what: Scene | System, state: State | None = None, t: float | None = None) -> Inspection:
    """Inspect a mechanism in one posture: everything that can be said before a run.

    These are looked at: masses, inertia tensors, sizes and gravity, which show wrong units; residuals
    of the posture and its velocities; degrees of freedom, dependent and contradictory constraints by
    the names of their joints; conditions of the mass matrix and of the constraint Jacobian; the
    distance to a singular posture; the eigenvalues of the linearised motion, and which formulation
    and solver suit them.

    Args:
        what: scene, or system. state: state of a system; by default its reference posture, at rest.
        t: time [s]; by default the scene's t0, or zero.

    Raises:
        SettingError: neither a scene nor a system is given, or a scene together with a state.
    """
    between: tuple[str, ...] = ()
    if isinstance(what, Scene) and state is None:
        between = what.links_between
        system, state, t = what.system, what.state0, what.t0 if t is None else t
    elif isinstance(what, System):
        system, state, t = what, what.reference if state is None else state, t or 0.0
    else:
        raise SettingError("check takes a Scene, or a System with or without a State.")
    found = [*_bodies(system), *_magnitudes(system, state, between)]
    found += list(_faults("initial state", lambda: check_start(system, state)))
    if not any(each.severity == "fault" for each in found):
        found += _posture(system, state, t)
    return Inspection(tuple(sorted(found, key=lambda each: SEVERITIES.index(each.severity))))


def _faults(what: str, look: Callable[[], Any]) -> Iterator[Finding]:
    """Error of a check as a finding."""
    try:
        look()
    except (ModelError, StateError) as error:
        yield Finding("fault", what, str(error))


# --- bodies and magnitudes


def _bodies(system: System) -> Iterator[Finding]:
    """Findings on masses and inertia tensors."""
    for name, mass, inertia in zip(
        system.names, np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia), strict=True
    ):
        yield from _faults(f"mass of {name}", lambda m=mass, n=name: check_mass(m, f"body '{n}'"))
        wrong = list(
            _faults(
                f"inertia of {name}",
                lambda J=inertia, n=name: check_inertia(J, f"body '{n}'", _ROUNDED),
            )
        )
        yield from wrong
        if wrong or not mass > 0:
            continue
        moments = np.linalg.eigvalsh(inertia)
        excess = moments[2] / (moments[0] + moments[1]) - 1
        if excess > 1e-12:
            yield Finding(
                "warning", f"inertia of {name}", f"largest moment {100 * excess:.3g} % too large",
                "at most the sum of the other two; admitted by triangle_tolerance",
            )  # fmt: skip
        # squared semi-axes of the solid ellipsoid with these moments
        square = 2.5 / mass * np.maximum(np.sum(moments) - 2 * moments, 0.0)
        ball, solid = max(square) ** 1.5, np.sqrt(np.prod(square))
        for volume, off, words in (
            (ball, mass > _DENSE * 4 / 3 * np.pi * ball, "as dense as a sphere of"),
            (solid, mass < _LIGHT * 4 / 3 * np.pi * solid, "as dense as an ellipsoid of"),
        ):
            if off:
                density = mass / (4 / 3 * np.pi * volume)
                yield Finding(
                    "warning", f"mass and inertia of {name}", f"{words} {density:.2g} kg/m^3",
                    f"{_LIGHT:g} to {_DENSE:g} kg/m^3; are they in kg and kg m^2?",
                )  # fmt: skip


def _magnitudes(system: System, state: State, between: Sequence[str]) -> Iterator[Finding]:
    """Findings on the ratio of masses, the size of the mechanism and gravity.

    Args:
        between: names of the links that an import put between joints, whose masses are not meant.
    """
    if between:
        largest = max(float(system.bodies.mass[system.index(name)]) for name in between)
        yield Finding(
            "note", "links between several joints of a body",
            f"{len(between)}, of at most {largest:.2g} kg",
            "the import made them; the tree's coordinates carry them (formulation Tree)",
        )  # fmt: skip
    own = [k for k, name in enumerate(system.names) if name not in between]
    mass = np.asarray(system.bodies.mass)[own]
    if max(mass) > _RATIO * min(mass):
        light, heavy = (system.names[own[k]] for k in (np.argmin(mass), np.argmax(mass)))
        yield Finding(
            "warning", "ratio of masses", f"{max(mass) / min(mass):.2g} ({heavy} to {light})",
            f"below {_RATIO:g}; a light body between heavy ones is best carried by the tree's "
            "coordinates (formulation Tree)",
        )  # fmt: skip
    kin = system.kinematics(state)
    ends = [(j.body_i, j.point_i) for j in system.joints]
    ends += [(j.body_j, j.point_j) for j in system.joints]
    points = np.array([*np.asarray(state.r), *(np.asarray(kin.point(*end)[0]) for end in ends)])
    size = float(np.max(np.ptp(points, axis=0)))
    if 0 < size < _SMALL or size > _LARGE:
        yield Finding(
            "warning", "size of the mechanism", f"{size:.3g} m",
            f"{_SMALL:g} to {_LARGE:g} m; are lengths in m?",
        )  # fmt: skip
    pulls = [np.linalg.norm(f.acceleration) for f in system.forces if isinstance(f, Gravity)]
    if not any(pulls):
        yield Finding("note", "gravity", "none")
    elif not _WEAK <= sum(pulls) <= _STRONG:
        yield Finding(
            "warning", "gravity", f"{sum(pulls):.4g} m/s^2",
            f"{_WEAK:g} to {_STRONG:g} m/s^2 on a planet's surface; is it given once, in m/s^2?",
        )  # fmt: skip


# --- the posture


def _posture(system: System, state: State, t: float) -> list[Finding]:
    """Findings on loads, residuals, rank, conditions and the linearised motion at a state."""
    model = Augmented().prepare(system)
    seen = _rows(system, model, [state], t)
    residuals, rates, matrix, gamma, loads, wrenches = (np.asarray(x)[0] for x in seen)
    found = list(_faults("loads", lambda: check_loads(system, loads, t)))
    off = list(_faults("posture", lambda: check_consistent(system, model, residuals, rates)))
    if not off and system.joints:
        value = f"{np.max(np.abs(residuals)):.2g} m or rad, "
        value += f"rates {np.max(np.abs(rates)):.2g} m/s or rad/s"
        limits = f"at most {POSITION_TOLERANCE:g} and {VELOCITY_TOLERANCE:g}"
        found.append(Finding("note", "largest residual of the constraints", value, limits))
    rank = rank_of(system, model, state, t, matrix)
    free = _free_motions(matrix, rank, 6 * system.n_bodies)
    found += [*off, *_freedom(system, rank), *_conditions(system, rank, matrix, free)]
    if rank.redundant:
        wrong = list(_faults("constraints", lambda: allow_dependent(Tree(), rank, matrix, gamma)))
        if not (wrong or off):
            beside = branches_at(model, state, t, matrix)
            start = lambda: check_determined(system, state, beside, gamma, wrenches)
            wrong += _faults("singular posture at rest", start)
        found += wrong
    if rank.rank and not off:
        found += _nearness(system, model, state, t, rank, free)
    if rank.dof and not any(each.severity == "fault" for each in found):
        found += _motion(system, state, t, rank)
    return found


def _rows(system: System, model: AugmentedModel, states: list[State], t: float) -> RowsAt:
    """Constraint rows and loads at several states, stacked along the first axis."""
    stack: Any = jax.tree.map(lambda *x: np.stack([np.asarray(y) for y in x]), *states)
    internal = np.stack([np.asarray(internal_states(system))] * len(states))
    return jax.tree.map(np.asarray, rows_at(model, Saved(np.full(len(states), t), stack, internal)))


def _free_motions(matrix: np.ndarray, rank: Rank, columns: int) -> Float[np.ndarray, "k dof"]:
    """Orthonormal velocities (v, omega') that the constraints allow."""
    if not rank.rank:
        return np.eye(columns)
    return np.linalg.svd(matrix)[2][rank.rank :].T


def _freedom(system: System, rank: Rank) -> Iterator[Finding]:
    bodies, joints = system.n_bodies, len(system.joints)
    counted = f"(bodies {bodies}, joints {joints}, rows {rank.rows} of rank {rank.rank})"
    valid = "" if rank.dof else "none is left: a structure, or a motion that drivers prescribe"
    yield Finding("note", "degrees of freedom", f"{rank.dof} {counted}", valid)
    tree = spanning_tree(system)
    cut = [system.joints[k] for k in tree.cut]
    closing = ", ".join(joint.name for joint in cut)
    value = f"Tree: coordinates {tree.n_velocities}, rows {sum(j.n_rows for j in cut)}"
    value += f"; Augmented: {6 * bodies} and {rank.rows}"
    valid = f"loops are closed by {closing}" if cut else "no loops: nothing can drift in a tree"
    if tree.n_velocities == 6 * bodies:
        valid = "no joint has relative coordinates: both are the same size"
    yield Finding("note", "formulation", value, valid)


def _conditions(
    system: System, rank: Rank, matrix: np.ndarray, free: np.ndarray
) -> Iterator[Finding]:
    """Findings on the condition numbers of the mass matrix and of the constraint Jacobian."""
    found: list[tuple[str, float]] = []
    if rank.dof:
        n = system.n_bodies
        M = np.zeros((n, 6, n, 6))
        for k in range(n):
            M[k, :3, k, :3] = np.asarray(system.bodies.mass)[k] * np.eye(3)
            M[k, 3:, k, 3:] = np.asarray(system.bodies.inertia)[k]
        values = np.linalg.eigvalsh(free.T @ M.reshape(6 * n, 6 * n) @ free)
        condition = values[-1] / values[0] if values[0] > 0 else np.inf
        found.append(("condition of the mass matrix in the free motions", float(condition)))
    if rank.rank:
        largest = np.linalg.svd(matrix, compute_uv=False)[0]
        condition = float(largest / rank.smallest_singular_value)
        found.append(("condition of the constraint Jacobian", condition))
    for what, condition in found:
        bad = not condition < _CONDITION
        yield Finding(
            "warning" if bad else "note", what, f"{condition:.2g}",
            f"below {_CONDITION:g}; as many digits as this number has are lost" if bad else "",
        )  # fmt: skip


def _nearness(
    system: System, model: AugmentedModel, state: State, t: float, rank: Rank, free: np.ndarray
) -> Iterator[Finding]:
    """Findings on dependent rows and singular postures, from postures beside this one."""
    names, at, change = ", ".join(rank.redundant), rank.smallest_singular_value, 0.0
    if rank.dof:
        beside = _beside(system, model, state, t, free)
        # a motion that is not along a branch of the mechanism finds no posture beside it
        held = np.max(np.abs(beside.residuals), axis=1) <= POSITION_TOLERANCE
        values = np.linalg.svd(beside.matrix[held], compute_uv=False)
        if np.any(values[:, rank.rank :][:, :1] > _GAINED * values[:, :1]):
            yield Finding(
                "warning", "singular posture", f"rank {rank.rank} here, more beside it",
                f"start beside it; here the rows of {names} depend on others",
            )  # fmt: skip
            return
        # one-sided differences, since a singular value has a kink where it is zero
        change = float(np.max(np.abs(values[:, rank.rank - 1] - at), initial=0.0))
    if rank.redundant:
        yield Finding(
            "note", "dependent constraints", f"{rank.rows - rank.rank} rows, among those of {names}",
            "the motion is as without them, but how reactions are shared is not determined; a "
            "joint that holds less, such as a spherical one, would not repeat them",
        )  # fmt: skip
    if change > 0 and at * _STEP / change < _NEAR:
        _, joints = weakest_rows(system, model, state, t, rank.rank)
        yield Finding(
            "warning", "distance to a singular posture",
            f"a movement of about {at * _STEP / change:.2g} m or rad",
            f"above {_NEAR:g}; lead the motion around it. Its rows are those of {', '.join(joints)}",
        )  # fmt: skip


def _beside(
    system: System, model: AugmentedModel, state: State, t: float, free: np.ndarray
) -> RowsAt:
    """Rows at postures one step to either side along each free motion, put on the constraints.

    The largest movement of a body is `_STEP` [m or rad].
    """
    scales = np.asarray(model.constraints.scales())
    units = free / np.max(np.abs(free), axis=0)
    steps = [sign * _STEP * column for column in units.T for sign in (-1.0, 1.0)]
    states = [_moved(state, step) for step in steps]
    rows = _rows(system, model, states, t)
    for _ in range(_CORRECTIONS):
        back = [
            -np.linalg.lstsq(J, phi / scales, rcond=1e-9)[0]
            for J, phi in zip(rows.matrix, rows.residuals, strict=True)
        ]
        states = list(itertools.starmap(_moved, zip(states, back, strict=True)))
        rows = _rows(system, model, states, t)
    return rows


def _moved(state: State, step: np.ndarray) -> State:
    r, p = displace(state.r, state.p, jnp.asarray(step.reshape(-1, 6)))
    return State(r, p, state.v, state.omega)


def _motion(system: System, state: State, t: float, rank: Rank) -> list[Finding]:
    """Findings on the eigenvalues of the linearised motion, and the solver that they ask for."""
    formulation = Tree().allowing_dependent_rows() if rank.redundant else Tree()
    try:
        values = spectrum(system, state, t, formulation=formulation)
    except StateError as error:
        return [Finding("warning", "linearised motion", str(error))]
    sizes = np.abs(values)
    sizes = sizes[sizes > _ZERO * max(sizes[0], 1e-3)]
    if not sizes.size:
        return [Finding("note", "solver", "no eigenvalue but zero", "Dopri8")]
    found = [
        Finding("note", "rates of the linearised motion",
                f"{sizes[-1]:.3g} to {sizes[0]:.3g} 1/s, ratio {sizes[0] / sizes[-1]:.2g}"),
        Finding("note", "solver", f"fastest rate {sizes[0]:.3g} 1/s",
                f"Dopri8, since the fastest rate is below {EXPLICIT_LIMIT:g} 1/s"
                if sizes[0] <= EXPLICIT_LIMIT else
                f"Rodas5P, or solver=\"auto\": above {EXPLICIT_LIMIT:g} 1/s explicit steps are short"),
    ]  # fmt: skip
    growth = float(np.max(np.real(values)))
    if growth > 1e-3 * sizes[0]:
        value = f"e-fold in {1 / growth:.3g} s"
        found.append(Finding("note", "growth of small deviations", value, "unstable at this point"))
    return found
