"""Inspection of a mechanism and its posture before a run: what is wrong, and what it will demand."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..checks.errors import ModelError, SettingError, StateError
from ..checks.numbers import check_inertia, check_mass
from ..mechanics.forces import Gravity
from ..mechanics.inputs import Inputs, inputs_of, present_values
from ..mechanics.size import mechanism_size
from ..mechanics.state import State
from ..mechanics.system import System
from .actuation import (
    WEAK,
    Actuation,
    actuation_along,
    force_units,
    input_labels,
    joints_in_motion,
    names_of_largest,
)
from .assembly.rank import Rank, rank_of
from .assembly.singular import weakest_rows
from .diagnostics import (
    POSITION_TOLERANCE,
    branches_at,
    check_compatible,
    check_consistent,
    check_determined,
    check_loads,
    check_rounded,
    check_start,
    consistent_limits,
)
from .evaluation import RowsAt, rows_of
from .formulations.augmented import AugmentedModel, prepare_rows
from .formulations.base import count_left_out
from .formulations.independence import displace_postures, longest_arm
from .method import EXPLICIT_LIMIT, spectrum
from .simulation import Scene, output_times
from .statespace.tree import TreeSpace
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
# Extrapolated distance beyond which there is none to speak of [m or rad].
_FAR = 100.0
# Directions beside a posture that mix its independent coordinates.
_MIXTURES = 4
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
            what is meant or is near its limits, "note" for information.
        quantity: quantity or object. value: its value with its unit, or a description.
        valid: what would be valid, or advice; may be empty.
    """

    severity: Severity
    quantity: str
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
        rows = (f"{f.severity}: {f.quantity}: {f.value} {f.valid}".strip() for f in self.findings)
        return "\n".join(rows)


def check(
    mechanism: Scene | System,
    state: State | None = None,
    t: float | None = None,
    *,
    inputs: Inputs | None = None,
) -> Inspection:
    """Inspect a mechanism in one posture before a run.

    The inspection covers masses, inertia tensors, sizes and gravity, which reveal wrong units; residuals
    of the posture and its velocities; degrees of freedom, dependent and contradictory constraints by
    the names of their joints; conditions of the mass matrix and of the constraint Jacobian; the
    distance to a singular posture of the constraints and of the inputs; the eigenvalues of the linearised
    motion, and which formulation and solver suit them.

    Args:
        mechanism: scene, or system. state: state of a system; by default its reference posture, at rest.
        t: time [s]; by default the scene's t0, or zero.
        inputs: inputs of the actuators, see `inputs_of`; by default all of the system.

    Raises:
        SettingError: neither a scene nor a system is given, or a scene together with a state.
    """
    between: tuple[str, ...] = ()
    lost: tuple[str, ...] = ()
    findings: list[Finding] = []
    if isinstance(mechanism, Scene) and state is None:
        between, lost = mechanism.links_between, mechanism.warnings
        scene = mechanism
        findings += _catch_fault("time span", lambda: output_times(scene, None, None, None))
        system, state, t = mechanism.system, mechanism.state0, mechanism.t0 if t is None else t
    elif isinstance(mechanism, System):
        system, state, t = mechanism, mechanism.reference if state is None else state, t or 0.0
    else:
        raise SettingError("check takes a Scene, or a System with or without a State.")
    findings += [Finding("warning", "import", sentence) for sentence in lost]
    findings += [*_check_bodies(system), *_check_magnitudes(system, state, between)]
    findings += list(_catch_fault("initial state", lambda: check_start(system, state)))
    if not any(finding.severity == "fault" for finding in findings):
        findings += _check_posture(
            system, state, t, inputs_of(system) if inputs is None else inputs
        )
    return Inspection(
        tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity)))
    )


def _catch_fault(subject: str, look: Callable[[], Any]) -> Iterator[Finding]:
    """Error of a check as a finding."""
    try:
        look()
    except (ModelError, SettingError, StateError) as error:
        yield Finding("fault", subject, str(error))


# --- bodies and magnitudes


def _check_bodies(system: System) -> Iterator[Finding]:
    """Findings on masses and inertia tensors."""
    for name, mass, inertia in zip(
        system.names, np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia), strict=True
    ):
        yield from _catch_fault(
            f"mass of {name}", lambda m=mass, n=name: check_mass(m, f"body '{n}'")
        )
        wrong = list(
            _catch_fault(
                f"inertia of {name}",
                lambda J=inertia, n=name: check_inertia(J, f"body '{n}'", _ROUNDED),
            )
        )
        yield from wrong
        if wrong or not mass > 0:
            continue
        # The principal moments of a body in millimetres or grams imply an impossible density, which is how
        # wrong units are found.
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
        for volume, is_implausible, comparison in (
            (ball, mass > _DENSE * 4 / 3 * np.pi * ball, "as dense as a sphere of"),
            (solid, mass < _LIGHT * 4 / 3 * np.pi * solid, "as dense as an ellipsoid of"),
        ):
            if is_implausible:
                density = mass / (4 / 3 * np.pi * volume)
                yield Finding(
                    "warning", f"mass and inertia of {name}", f"{comparison} {density:.2g} kg/m^3",
                    f"{_LIGHT:g} to {_DENSE:g} kg/m^3; are they in kg and kg m^2?",
                )  # fmt: skip


def _check_magnitudes(system: System, state: State, between: Sequence[str]) -> Iterator[Finding]:
    """Findings on the ratio of masses, the size of the mechanism and gravity.

    Args:
        between: names of the links that an import put between joints, whose masses are not meant.
    """
    if between:
        largest = max(float(system.bodies.mass[system.index(name)]) for name in between)
        yield Finding(
            "note", "links between several joints of a body",
            f"{len(between)}, of at most {largest:.2g} kg",
            "made by the import; use the formulation Tree",
        )  # fmt: skip
    body_indices = [k for k, name in enumerate(system.names) if name not in between]
    mass = np.asarray(system.bodies.mass)[body_indices]
    if max(mass) > _RATIO * min(mass):
        light, heavy = (system.names[body_indices[k]] for k in (np.argmin(mass), np.argmax(mass)))
        yield Finding(
            "warning", "ratio of masses", f"{max(mass) / min(mass):.2g} ({heavy} to {light})",
            f"below {_RATIO:g}; use the formulation Tree for a light body between heavy ones",
        )  # fmt: skip
    # Lengths in millimetres make a mechanism of 100 m, which no check of single numbers would notice.
    size = float(mechanism_size(system, state))
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


def _check_posture(system: System, state: State, t: float, inputs: Inputs) -> list[Finding]:
    """Findings on loads, residuals, rank, conditions and the linearised motion at a state."""
    model = prepare_rows(system)
    posture_rows = RowsAt(
        *(x[0] for x in rows_of(model, jax.tree.map(lambda x: x[None], state), t))
    )
    residuals, rates, matrix, gamma, loads, wrenches = posture_rows
    findings = list(_catch_fault("loads", lambda: check_loads(system, loads, t)))
    most = consistent_limits(system, model, state, posture_rows)
    posture_faults = list(
        _catch_fault("posture", lambda: check_consistent(system, model, residuals, rates, most))
    )
    if not posture_faults and system.joints:
        angular = np.asarray(model.constraints.angular)
        value = f"{_largest_by_unit(residuals, angular)}; rates {_largest_by_unit(rates, angular, '/s')}"
        limits = f"at most {np.min(most[0]):.1g} and {np.min(most[1]):.1g}"
        findings.append(Finding("note", "largest residual of the constraints", value, limits))
    rank = rank_of(system, model, state, t, matrix)
    free = _free_motions(matrix, rank, 6 * system.n_bodies)
    findings += [
        *posture_faults,
        *_describe_freedom(system, rank),
        *_check_conditions(system, rank, matrix, free),
    ]
    findings += _catch_fault("rounded numbers", lambda: check_rounded(system, model))
    if rank.redundant:
        wrong = list(_catch_fault("constraints", lambda: check_compatible(rank, matrix, gamma)))
        if not (wrong or posture_faults):
            branching = branches_at(model, state, t, matrix)
            start = lambda: check_determined(system, state, branching, gamma, wrenches)
            wrong += _catch_fault("singular posture at rest", start)
        findings += wrong
    if rank.rank and not posture_faults:
        findings += _check_nearness(system, model, state, t, rank, free)
    if len(inputs) and rank.dof and not posture_faults:
        findings += _check_actuation(system, state, t, inputs)
    if rank.dof and not any(finding.severity == "fault" for finding in findings):
        findings += _check_motion(system, state, t, rank)
    return findings


def _free_motions(matrix: np.ndarray, rank: Rank, columns: int) -> Float[np.ndarray, "k dof"]:
    """Orthonormal velocities (v, omega') that the constraints allow."""
    if not rank.rank:
        return np.eye(columns)
    return np.linalg.svd(matrix)[2][rank.rank :].T


def _describe_freedom(system: System, rank: Rank) -> Iterator[Finding]:
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


def _check_conditions(
    system: System, rank: Rank, matrix: np.ndarray, free: np.ndarray
) -> Iterator[Finding]:
    """Findings on the condition numbers of the mass matrix and of the constraint Jacobian."""
    condition_numbers: list[tuple[str, float]] = []
    if rank.dof:
        n = system.n_bodies
        M = np.zeros((n, 6, n, 6))
        for k in range(n):
            M[k, :3, k, :3] = np.asarray(system.bodies.mass)[k] * np.eye(3)
            M[k, 3:, k, 3:] = np.asarray(system.bodies.inertia)[k]
        # Only the motions that the joints allow count: a light body between heavy ones need not be ill-
        # conditioned.
        values = np.linalg.eigvalsh(free.T @ M.reshape(6 * n, 6 * n) @ free)
        condition = values[-1] / values[0] if values[0] > 0 else np.inf
        condition_numbers.append(
            ("condition of the mass matrix in the free motions", float(condition))
        )
    if rank.rank:
        largest = np.linalg.svd(matrix, compute_uv=False)[0]
        condition = float(largest / rank.smallest_singular_value)
        condition_numbers.append(("condition of the constraint Jacobian", condition))
    for subject, condition in condition_numbers:
        bad = not condition < _CONDITION
        yield Finding(
            "warning" if bad else "note", subject, f"{condition:.2g}",
            f"below {_CONDITION:g}; results lose as many digits as this number has" if bad else "",
        )  # fmt: skip


def _largest_by_unit(rows: np.ndarray, angular: np.ndarray, per: str = "") -> str:
    """Largest of the rows that are lengths, and of those that are angles."""
    parts = {"m": rows[~angular], "rad": rows[angular]}
    return ", ".join(
        f"{np.max(np.abs(part)):.2g} {unit}{per}" for unit, part in parts.items() if part.size
    )


def _unit_of(motion: np.ndarray) -> str:
    """Unit of the largest component of a motion of all bodies, v and omega (6 n,)."""
    return "m" if np.argmax(np.abs(motion)) % 6 < 3 else "rad"


def _check_nearness(
    system: System, model: AugmentedModel, state: State, t: float, rank: Rank, free: np.ndarray
) -> Iterator[Finding]:
    """Findings on dependent rows and singular postures, from neighbouring postures."""
    names, at, change = ", ".join(rank.redundant), rank.smallest_singular_value, 0.0
    unit = ""
    if rank.dof:
        nearby_rows = _evaluate_neighbours(model, state, t, free)
        # a motion that is not along a branch of the mechanism finds no posture beside it
        arm = float(longest_arm(system, model.constraints))
        size = np.where(model.constraints.angular, 1.0, arm)
        closed_mask = np.max(np.abs(nearby_rows.residuals) / size, axis=1) <= POSITION_TOLERANCE
        values = np.linalg.svd(nearby_rows.matrix[closed_mask], compute_uv=False)
        if np.any(values[:, rank.rank :][:, :1] > _GAINED * values[:, :1]):
            yield Finding(
                "warning", "singular posture", f"rank {rank.rank} here, higher nearby",
                f"start in a nearby posture; here the rows of {names} depend on others",
            )  # fmt: skip
            return
        # one-sided differences, since a singular value has a kink where it is zero
        changes = np.abs(values[:, rank.rank - 1] - at)
        change = float(np.max(changes, initial=0.0))
        if changes.size:
            place = int(np.flatnonzero(closed_mask)[np.argmax(changes)])
            unit = _unit_of(free[:, place // 2])
    if rank.redundant:
        yield Finding(
            "note", "dependent constraints", f"{rank.rows - rank.rank} rows, among those of {names}",
            "the motion does not depend on them, but reactions are not unique; a joint with fewer "
            "constraints, such as a spherical one, would avoid them",
        )  # fmt: skip
    if not rank.dof:
        return
    # The smallest singular value goes to zero linearly at a singular posture: its rate of change gives
    # the distance to the zero.
    distance = at * _STEP / change if change > 0 else np.inf
    if distance < _NEAR:
        _, joints = weakest_rows(system, model, state, t, rank.rank)
        yield Finding(
            "warning", "distance to a singular posture",
            _format_distance(distance, unit),
            f"above {_NEAR:g} {unit}; plan the motion around it. Its rows are those of {', '.join(joints)}",
        )  # fmt: skip
    else:
        yield Finding(
            "note",
            "distance to a singular posture",
            _format_distance(distance, unit),
            f"above {_NEAR:g}",
        )


def _format_distance(distance: float, unit: str) -> str:
    """Words for a distance that is extrapolated from the posture's neighbours, by the largest part of their motion."""
    if distance > _FAR:
        return "none near: no singular value changes"
    return f"a movement of about {distance:.2g} {unit}"


def _check_actuation(system: System, state: State, t: float, inputs: Inputs) -> Iterator[Finding]:
    """Findings on singular postures of the inputs: direct (type 2) and inverse (type 1) ones.

    Ranks are those of the postures one step to either side along each independent coordinate, where the
    largest movement of a body is `_STEP` [m or rad]. Distances are extrapolated from there.
    """
    try:
        space = TreeSpace(system, state, t=t)
    except ModelError:
        return  # a singular posture of the constraints has its own finding
    x, dof, time = space.from_state(state), space.dof, jnp.asarray(t, float)
    values = jnp.stack([
        jnp.zeros(()) if callable(v) else jnp.asarray(v, float) for v in present_values(system, inputs)
    ])  # fmt: skip
    # besides the coordinates one by one, mixtures: a singular value may stay at zero along each of them
    directions = np.vstack([np.eye(dof), np.random.default_rng(0).normal(size=(_MIXTURES, dof))])
    steps = np.zeros((1 + 2 * len(directions), space.size))
    evaluate = lambda: jax.tree.map(
        np.asarray, actuation_along(space, x, jnp.asarray(steps), inputs, values, time)
    )
    start = evaluate()
    reach = np.max(np.abs(start.velocities[0] @ directions.T), axis=0)
    steps[1::2, :dof] = _STEP * directions / reach[:, None]
    steps[2::2, :dof] = -steps[1::2, :dof]
    neighbours = evaluate()
    motions = start.velocities[0] @ directions.T
    units = [_unit_of(motion) for motion in np.repeat(motions.T, 2, axis=0)]
    yield from _check_direct(system, state, inputs, neighbours, units)
    yield from _check_inverse(system, state, inputs, neighbours, units)


def _scaled_forces(
    system: System, inputs: Inputs, neighbours: Actuation
) -> tuple[np.ndarray, bool]:
    """Effects of the inputs on the unit motions (k, dof, m), and whether all are in weights.

    Inputs of other units, such as targets of servos, are scaled to their largest effect.
    """
    in_weights = np.array([bool(unit) for unit in force_units(system, inputs)])
    effect = np.nanmax(np.linalg.norm(neighbours.forces, axis=1), axis=0)
    scaled = np.asarray(neighbours.forces) / np.where(in_weights | (effect == 0), 1.0, effect)
    return scaled, bool(np.all(in_weights))


def _check_direct(
    system: System, state: State, inputs: Inputs, neighbours: Actuation, units: list[str]
) -> Iterator[Finding]:
    """Findings on motions that the inputs do not hold."""
    scaled, in_weights = _scaled_forces(system, inputs, neighbours)
    nearness = _extrapolate_rank(scaled, units)
    if nearness is None:
        return
    rank, sigma, distance, unit = nearness
    if not (distance < _NEAR or (sigma < WEAK and in_weights)):
        yield Finding(
            "note", "distance to an actuation singularity", _format_distance(distance, unit),
            f"above {_NEAR:g}; smallest singular value {sigma:.2g}",
        )  # fmt: skip
        return
    row_vectors, values, column_vectors = np.linalg.svd(scaled[0], full_matrices=False)
    round_off = _GAINED * np.nanmax(np.linalg.norm(scaled, axis=(1, 2)))
    weak = (np.arange(len(values)) < rank) & (values <= max(2 * sigma, round_off))
    lost = np.asarray(neighbours.motions[0]) @ row_vectors[:, weak]
    moving = joints_in_motion(system, state, lost, float(neighbours.size[0]))
    acting = names_of_largest(input_labels(system, inputs), column_vectors[weak].T)
    yield Finding(
        "warning", "actuation singularity",
        f"{_format_distance(distance, unit)}; smallest singular value {sigma:.2g}",
        f"above {_NEAR:g} {unit} and {WEAK:g}; direct singularity (type 2): the inputs "
        f"{', '.join(acting)} hardly hold the motion of the joints {', '.join(moving)}"
        + ("" if in_weights else "; inputs that are no forces are scaled to their largest effect"),
    )  # fmt: skip


def _check_inverse(
    system: System, state: State, inputs: Inputs, neighbours: Actuation, units: list[str]
) -> Iterator[Finding]:
    """Findings on bodies of the most freedom, such as a platform, that lose a direction of motion."""
    size = float(neighbours.size[0])
    # angular velocities in units of the size, as in the metric of the motions
    metric = np.repeat([1.0, size], 3)[:, None]
    rows = np.split(np.asarray(neighbours.motions), len(system.names), axis=1)
    nearness = {
        name: _extrapolate_rank(V * metric, units)
        for name, V in zip(system.names, rows, strict=True)
    }
    freedom = max((measure[0] for measure in nearness.values() if measure), default=0)
    resting = {
        name: measure
        for name, measure in nearness.items()
        if measure and measure[0] == freedom and measure[2] < _NEAR
    }
    if not resting:
        return
    first = min(resting, key=lambda name: resting[name][2])
    V = rows[system.names.index(first)][0] * metric
    direction = np.linalg.svd(V)[2][resting[first][0] - 1]
    scaled, _ = _scaled_forces(system, inputs, neighbours)
    rates = scaled[0].T @ direction
    if not np.max(np.abs(rates), initial=0.0) > WEAK:
        return  # a motion that the inputs do not see is a direct singularity
    acting = names_of_largest(input_labels(system, inputs), rates)
    moving = joints_in_motion(
        system, state, np.asarray(neighbours.motions[0]) @ direction[:, None], size
    )
    yield Finding(
        "note", "dead centre",
        f"{_format_distance(*resting[first][2:])}, of {', '.join(resting)}",
        "inverse singularity (type 1): a direction of motion is lost, while the inputs "
        f"{', '.join(acting)} and the joints {', '.join(moving)} move",
    )  # fmt: skip


def _extrapolate_rank(
    matrices: np.ndarray, units: list[str]
) -> tuple[int, float, float, str] | None:
    """Rank beside the first of some matrices, its singular value of that place, the distance to zero and its unit.

    None where all vanish. Matrices that are not finite, of loops that do not close, are left out.

    Args:
        units: units of the steps to the others.
    """
    is_finite = np.isfinite(matrices).all(axis=(1, 2))
    values = np.linalg.svd(matrices[is_finite], compute_uv=False)
    rank = int(np.max(np.sum(values > _GAINED * np.max(values, initial=0.0), axis=1), initial=0))
    if not rank:
        return None
    sigma = float(values[0, rank - 1])
    changes = np.abs(values[1:, rank - 1] - sigma)
    change = float(np.max(changes, initial=0.0))
    if not change > 0:
        return rank, sigma, np.inf, ""
    places = np.flatnonzero(is_finite)[1:] - 1
    unit = units[int(places[np.argmax(changes)])]
    return rank, sigma, sigma * _STEP / change, unit


def _evaluate_neighbours(model: AugmentedModel, state: State, t: float, free: np.ndarray) -> RowsAt:
    """Rows at postures one step to either side along each free motion, put on the constraints.

    The largest movement of a body is `_STEP` [m or rad].
    """
    scales = np.asarray(model.constraints.scales())
    units = free / np.max(np.abs(free), axis=0)
    steps = [sign * _STEP * column for column in units.T for sign in (-1.0, 1.0)]
    states = displace_postures(state, np.array(steps))
    rows = rows_of(model, states, t)
    for _ in range(_CORRECTIONS):
        pairs = zip(rows.matrix, rows.residuals, strict=True)
        back = [-np.linalg.lstsq(J, phi / scales, rcond=1e-9)[0] for J, phi in pairs]
        states = displace_postures(states, np.array(back))
        rows = rows_of(model, states, t)
    return rows


def _check_motion(system: System, state: State, t: float, rank: Rank) -> list[Finding]:
    """Findings on the eigenvalues of the linearised motion, and the solver that they ask for."""
    more = rank.rows - rank.rank > count_left_out(Tree().prepare(system))
    formulation = Tree(redundant=more)
    try:
        values = spectrum(system, state, t, formulation=formulation)
    except StateError as error:
        return [Finding("warning", "linearised motion", str(error))]
    sizes = np.abs(values)
    sizes = sizes[sizes > _ZERO * max(sizes[0], 1e-3)]
    if not sizes.size:
        return [Finding("note", "solver", "all eigenvalues are zero", "Dopri8")]
    findings = [
        Finding("note", "rates of the linearised motion",
                f"{sizes[-1]:.3g} to {sizes[0]:.3g} 1/s, ratio {sizes[0] / sizes[-1]:.2g}"),
        Finding("note", "solver", f"fastest rate {sizes[0]:.3g} 1/s",
                f"Dopri8, since the fastest rate is below {EXPLICIT_LIMIT:g} 1/s"
                if sizes[0] <= EXPLICIT_LIMIT else
                f"kvaerno5, or solver=\"auto\": above {EXPLICIT_LIMIT:g} 1/s explicit steps are short"),
    ]  # fmt: skip
    growth = float(np.max(np.real(values)))
    if growth > 1e-3 * sizes[0]:
        value = f"e-fold in {1 / growth:.3g} s"
        findings.append(
            Finding("note", "growth of small deviations", value, "unstable at this point")
        )
    return findings
