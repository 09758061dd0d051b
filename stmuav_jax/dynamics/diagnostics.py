"""Checks of a run before it starts, its error estimate, and its certificate.

The global error of a method with local extrapolation is proportional to its tolerance: a run at a
tenth of the tolerances has about a tenth of the error e of the first run, and the two differ by
0.9 e. If a saved time, not the tolerance, ends a step, the second run takes that interval in two
steps instead. Both runs use one compiled program.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4 (global error
proportional to the tolerance).
"""

import dataclasses
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from ..checks.errors import ModelError, SettingError, StateError, has_values
from ..checks.numbers import as_floats, as_numpy, check_unit
from ..math.rotation import from_rotation_vector, product
from ..mechanics.body import check_bodies
from ..mechanics.constraint import ROWS
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .assembly.rank import Rank, rank_of
from .assembly.singular import (
    RESTING,
    Branching,
    branches_meet,
    find_branches,
    name_owners,
    singular_start,
)
from .evaluation import (
    Balances,
    RowsAt,
    Saved,
    balances,
    evaluate_accelerations,
    rows_at,
    rows_of,
    singular_values,
)
from .formulations.augmented import Augmented, AugmentedModel, prepare_rows
from .formulations.base import AbstractFormulation, count_left_out
from .formulations.constraints import Constraints
from .formulations.independence import (
    DEPENDENT,
    WEAK,
    check_condition,
    find_independent_rows,
    longest_arm,
    open_limit,
    scale_matrix,
)
from .integration.advance import March, Trajectory, same_result
from .integration.problem import Problem
from .tree.formulation import Tree


@dataclass(frozen=True)
class Seconds:
    """Times [s] of compilation, the run, the second run of the error estimate, and the analysis."""

    compile: float
    run: float
    estimate: float
    analysis: float = 0.0


@dataclass(frozen=True)
class Certificate:
    """Quality of a run: its estimated error, constraint violations, balances and effort.

    The estimated errors alone tell how accurate the motion is. Constraints and balances can hold to
    round-off in a run that is wrong by a centimetre. None stands for a value that was not computed.

    Attributes:
        result: "successful", or the reason for the stop, or "constraints violated". t_end: last time reached [s].
        position_error, angle_error, velocity_error, angular_velocity_error: estimated distance from
            the exact motion, the largest over all bodies and saved times [m], [rad], [m/s],
            [rad/s]; see `ErrorEstimate`.
        position_error_end, angle_error_end: the largest over all bodies at the last saved time.
        error_e_folding_time, predictability_horizon: those of `ErrorEstimate` [s]. error_words: both as text,
            with a sentence if the motion has left a singular posture.
        position_violation, angle_violation: largest residual of constraints that are lengths [m],
            and of those that are cosines or angles [rad], over all accepted steps.
        velocity_violation, angular_velocity_violation: those of their rates [m/s], [rad/s].
        norm_violation: largest | |p|^2 - 1 |.
        energy_error, relative_energy_error: largest |T + V - work - initial| [J], and its ratio to
            the largest energy.
        momentum_error, angular_momentum_error: largest change not explained by forces,
            relative to the largest momentum or impulse; None where a joint names ground.
        smallest_singular_value: that of the constraint Jacobian along the saved path, at most
            `SEEN` of its states unless the certificate is "full"; None without joints.
        rank, rows: those at the start. redundant: joints that own a dependent row.
        formulation_difference: largest difference between the accelerations by the formulation in
            use and by another, `Augmented` or `Tree`, at any saved time, relative to the largest
            acceleration; None unless the certificate is "full".
        accepted_steps, rejected_steps: numbers over the whole run. steps_at_growth_limit: steps
            accepted with an error so far below the tolerance that the next step could grow as
            much as any may.
        compile_seconds, run_seconds: times of the integration. estimate_seconds: that of the second
            run. analysis_seconds: that of checks and balances, compilation included.
    """

    result: str
    t_end: float
    position_error: float
    position_error_end: float
    angle_error: float
    angle_error_end: float
    velocity_error: float
    angular_velocity_error: float
    error_e_folding_time: float | None
    predictability_horizon: float | None
    error_words: str
    position_violation: float
    angle_violation: float
    velocity_violation: float
    angular_velocity_violation: float
    norm_violation: float
    energy_error: float
    relative_energy_error: float
    momentum_error: float | None
    angular_momentum_error: float | None
    smallest_singular_value: float | None
    rows: int
    rank: int
    redundant: tuple[str, ...]
    formulation_difference: float | None
    accepted_steps: int
    rejected_steps: int
    steps_at_growth_limit: int
    compile_seconds: float
    run_seconds: float
    estimate_seconds: float
    analysis_seconds: float

    def to_dict(self) -> dict[str, Any]:
        """Certificate as plain numbers and strings, for JSON; NaN becomes None."""
        return {k: None if v != v else v for k, v in asdict(self).items()}


def saved_states(trajectory: Trajectory) -> Saved:
    """Saved times, states and actuator states of a trajectory."""
    return Saved(np.asarray(trajectory.ts), trajectory.states, np.asarray(trajectory.internal))


def relative_error(error: ArrayLike, *scales: ArrayLike) -> float:
    """Largest |error| over the largest of |scales|, or the error itself if all scales are zero."""
    size = max((float(np.max(np.abs(np.asarray(s)))) for s in scales), default=0.0)
    worst = float(np.max(np.abs(np.asarray(error))))
    return worst / size if size > 0 else worst


# Larger initial residuals are refused: they are not round-off, and are never repaired silently. They
# are parts of the longest arm of a joint and of the fastest rate of the mechanism; rates below the last
# number [1/s] count as rest.
POSITION_TOLERANCE = 1e-8
VELOCITY_TOLERANCE = 1e-7
_REST = 1e-16


def check_start(system: System, state: State) -> None:
    """Raise an error unless the state fits the system, is finite and has unit Euler parameters."""
    if not has_values(system, state):
        raise SettingError(
            "simulate needs known values and cannot be differentiated, batched or compiled by JAX: "
            "its scene holds traced numbers. Use stmuav_jax.integrate(system, state, ts, method)."
        )
    check_state(system, state)
    check_bodies(system.bodies)
    units = (
        ("r", "position", "m"),
        ("v", "velocity", "m/s"),
        ("omega", "angular velocity", "rad/s"),
    )
    state = as_numpy(state)
    for k, name in enumerate(system.names):
        check_unit(state.p[k], f"body '{name}' in the initial state", StateError)
        for field, quantity, unit in units:
            value = np.asarray(getattr(state, field)[k])
            if not np.all(np.isfinite(value)):
                raise StateError(
                    f"The initial {quantity} of body '{name}' must be finite, but it is {value.tolist()} {unit}."
                )


def check_loads(system: System, finite: np.ndarray, t: float) -> None:
    """Raise `ModelError` unless the load of every force element is finite."""
    for force, is_finite in zip(system.forces, finite, strict=True):
        if not is_finite:
            raise ModelError(
                f"The load of {type(force).__name__} on {force.acts_on()} is not finite at t = {t:.9g} s."
            )


def consistent_limits(
    system: System, model: AugmentedModel, state: State, rows: RowsAt
) -> tuple[np.ndarray, np.ndarray]:
    """Largest residuals and rates (m,) of rows that count as closed, of the size of the mechanism.

    Args:
        rows: rows and loads at the state, without an axis of several states.
    """
    arm = float(longest_arm(system, model.constraints))
    size = np.where(model.constraints.angular, 1.0, arm)
    bodies = as_numpy(system.bodies)
    heavy = np.where(bodies.mass > 0, bodies.mass, np.inf)[:, None]
    moments = np.trace(bodies.inertia, axis1=1, axis2=2)
    stout = np.where(moments > 0, moments, np.inf)[:, None]
    wrenches = np.abs(np.asarray(rows.wrenches))
    # the rate at which loads would set free bodies moving
    pushed = np.sqrt(max(np.max(wrenches[:, :3] / heavy) / arm, np.max(wrenches[:, 3:] / stout)))
    moving = (np.max(np.abs(np.asarray(state.v))) / arm, np.max(np.abs(np.asarray(state.omega))))
    rate = np.nanmax([pushed, *moving])
    return POSITION_TOLERANCE * size, (VELOCITY_TOLERANCE * rate + _REST) * size


def check_consistent(
    system: System,
    model: AugmentedModel,
    residuals: np.ndarray,
    rates: np.ndarray,
    limits: tuple[np.ndarray, np.ndarray],
) -> None:
    """Raise `StateError` unless positions and velocities satisfy the joints.

    Args:
        residuals, rates: residuals and rates of every row (m,), scaled as those of `Snapshot`.
        limits: largest of both, see `consistent_limits`.
    """
    owner = model.constraints.owner
    checks: tuple[tuple[Any, np.ndarray, str, Callable[..., str]], ...] = (
        (residuals, limits[0], "positions", _format_residual),
        (rates, limits[1], "velocities", _off_rate),
    )
    for values, most, quantity, deviation_text in checks:
        # NaN is not within the tolerance either
        if np.all(np.abs(values) <= most):
            continue
        k = int(np.argmax(np.where(np.isnan(values), np.inf, np.abs(values) / most)))
        raise StateError(
            f"The initial {quantity} do not fit the joints: joint '{system.joints[owner[k]].name}' is off "
            f"by {deviation_text(model, k, values[k])} (tolerance {most[k]:.0e}). Find the nearest consistent "
            "state with stmuav_jax.assemble(system, state)."
        )


def _format_residual(model: AugmentedModel, k: int, value: float) -> str:
    """Text of the residual of row k: a length, a cosine or an angle."""
    kinds = [g.kind for g in model.constraints.groups for _ in range(len(g.i) * ROWS[g.kind])]
    if kinds[k] == "distance":
        # the row is (d^2 - l^2) / (2 l), which equals d - l for small residuals only
        length = 0.5 / float(np.asarray(model.constraints.scales())[k])
        return f"{abs(np.sqrt(max(length**2 + 2 * length * value, 0.0)) - length):.3g} m"
    if kinds[k] == "angle":
        return f"{abs(value):.3g} rad"
    if model.constraints.angular[k]:
        return f"{abs(value):.3g} (a cosine, zero where its axes are as they should be)"
    return f"{abs(value):.3g} m"


def _off_rate(model: AugmentedModel, k: int, value: float) -> str:
    unit = "rad/s" if model.constraints.angular[k] else "m/s"
    return f"{abs(value):.3g} {unit}"


# Below the first tolerance round-off leaves no room for a tenth of it, below the second for any
# less.
_SHARP, _SHARPEST = 1e-12, 3e-14

# Factor on tolerances of the size of round-off. Round-off makes the two runs differ by some 1.4
# errors, proportionality by 2; a difference of 1.5 errors is assumed.
ROUND_OFF = 3.0

# Factor on the tolerances of the second run if smaller tolerances cannot be met.
LOOSER = 10.0

# No tolerance is reduced below this number; one that is smaller already stays unchanged.
_SMALLEST = 1e-14

# Relative error of the distance travelled, or error of an angle [rad], beyond which a motion is
# undetermined.
LOST = 0.01

# Logarithm of the error growth over the later half of a run from which the growth counts as
# exponential: e^3 is 20, while an error that grows as t^4 gives 16.
_EXPONENTIAL = 3.0


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated distance of every body's computed motion from the exact one, at the saved times.

    Entries without an estimate are NaN. Errors of the model or its parameters are not included.

    Attributes:
        position: error of the centres of mass (k, n) [m].
        angle: angle between computed and exact orientation (k, n) [rad].
        velocity: error (k, n) [m/s]. angular_velocity: error (k, n) [rad/s].
        e_folding_time: time in which errors grow by the factor e [s], if they grow exponentially over
            the later half of the determined motion; else None.
        predictability_horizon: first saved time at which a position is known to no better than 1 %
            of the largest distance travelled, or an orientation to 0.01 rad [s]; else None.
        note: reason why estimates are missing at some times; empty if none is missing.
    """

    position: Float[np.ndarray, "k n"]
    angle: Float[np.ndarray, "k n"]
    velocity: Float[np.ndarray, "k n"]
    angular_velocity: Float[np.ndarray, "k n"]
    e_folding_time: float | None = None
    predictability_horizon: float | None = None
    note: str = ""

    @property
    def estimated_count(self) -> int:
        """Number of saved times with an estimate, counted from the first."""
        return int(np.sum(np.isfinite(self.position[:, 0])))

    def describe(self, ts: Float[np.ndarray, " k"]) -> str:
        """Notable facts about the errors besides their size, as text; empty if there are none."""
        sentences = []
        if self.e_folding_time is not None:
            sentences.append(f"Errors grow e-fold every {self.e_folding_time:.2g} s.")
        if self.predictability_horizon is not None:
            k = int(np.searchsorted(ts, self.predictability_horizon))
            position, angle = (np.max(x[k]) for x in (self.position, self.angle))
            sentences.append(
                f"From t = {self.predictability_horizon:.4g} s on the positions are known to no better than "
                f"{position:.1g} m and the orientations to no better than {angle:.1g} rad."
            )
        return " ".join([*sentences, *([self.note] if self.note else [])])


class SecondRun:
    """Second run, at other tolerances than the first run.

    Args:
        problem: problem of the first run. t0: initial time [s]. state0: state at t0.
        factor: factor on the tolerances; by default that of `tolerance_factor`. A factor above one serves
            problems that cannot meet smaller tolerances: the estimate is cheaper, but rarely
            within a factor of three (benchmarks/errors.py).
    """

    def __init__(
        self, problem: Problem, t0: float, state0: State, *, factor: float | None = None
    ) -> None:
        self.first = problem
        # The second run shares the compiled program: only numbers differ, and the estimate costs run time but
        # no compilation.
        factor = tolerance_factor(problem) if factor is None else factor
        self.difference = 1.5 if factor == ROUND_OFF else abs(1 - factor)
        smaller = lambda x: as_floats(max(float(x) * factor, min(float(x), _SMALLEST)))
        method = problem.method
        changes: dict[str, Any] = {"rtol": smaller(method.rtol), "atol": smaller(method.atol)}
        # a run with a bounded step length becomes more accurate by halving the bound
        longest: Any = getattr(method, "max_step", None)
        if eqx.is_array(longest):
            changes["max_step"] = as_floats(float(longest) / 2)
        method = dataclasses.replace(method, **changes)
        self.march = March(dataclasses.replace(problem, method=method), t0, state0)
        self.last = (t0, 0)
        self.saved: list[np.ndarray] = []

    def follow(self, part: Trajectory) -> None:
        """Continue to the times of the first run, by way of the middles of its single steps."""
        before, steps = self.last
        ts, step_counts = np.asarray(part.ts), np.asarray(part.counts.accepted)
        fresh = np.append(not self.saved or ts[0] > before, np.diff(ts) > 0)
        if not np.any(fresh) or not self.march.going:
            return
        times, counts = ts[fresh], step_counts[fresh]
        # An interval that the first run crossed in one step would be the same step in the second; by way of
        # its middle the second run is forced to another one.
        starts = np.append(before, times[:-1])
        single = (np.diff(counts, prepend=steps) <= 1) & (times > starts)
        middles = 0.5 * (starts + times)[single]
        order = np.argsort(np.append(times, middles), kind="stable")
        self.march.to(np.append(times, middles)[order])
        self.last = (float(times[-1]), int(counts[-1]))
        self.saved.append(order < len(times))

    def at_saved(self) -> tuple[np.ndarray, State]:
        """Saved times that the second run reached (m,), and its states there (m, n, .)."""
        pick = [saved[: len(p.ts)] for saved, p in zip(self.saved, self.march.parts, strict=False)]
        parts = [
            jax.tree.map(lambda x, s=s: np.asarray(x)[s], (p.ts, p.states))
            for s, p in zip(pick, self.march.parts, strict=False)
        ]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def tolerance_factor(problem: Problem) -> float:
    """Factor on the tolerances that these allow, if they can be met."""
    tolerance = max(float(problem.method.rtol), float(problem.method.atol))
    if tolerance >= _SHARP:
        return 0.1
    return 1 / 3 if tolerance >= _SHARPEST else ROUND_OFF


def estimate_error(
    first: Trajectory,
    second: SecondRun,
    rates: tuple[np.ndarray, np.ndarray] | None,
    reason: str = "",
) -> ErrorEstimate:
    """Estimate the first run's error from the second run.

    Args:
        rates: accelerations of the first run's last state, (n, 3) each, if they are known.
        reason: reason why the second run has not reached the end.
    """
    times = np.asarray(first.ts)
    k, n = len(times), first.states.r.shape[1]
    ts, states = second.at_saved() if second.saved else (np.zeros(0), None)
    # Estimates exist as far as both runs went, and no further.
    m = min(len(ts), k)
    same = ts[:m] == times[:m]
    m = m if np.all(same) else int(np.argmin(same))
    parts = np.full((4, k, n), np.nan)
    if m:
        parts[:, :m] = _state_distances(
            _select_rows(first.states, slice(m)), _select_rows(states, slice(m))
        )
    happened = same_result(first.result, diffrax.RESULTS.event_occurred)
    if 0 < m == k - 1 < len(ts) and happened:
        # the second run has found the event at a slightly different time
        later = times[m] - ts[m]
        if abs(later) <= 1e-3 * (times[m] - times[m - 1]):
            shifted_states = _moved_on(_select_rows(states, slice(m, k)), later, rates)
            parts[:, m:] = _state_distances(_select_rows(first.states, slice(m, k)), shifted_states)
            m = k
    # For an error proportional to the tolerance the runs differ by this share of the first run's error.
    parts = parts / second.difference
    note = "" if m == k else _format_note(times, m, reason)
    folding, lost = (
        _estimate_growth(times, np.asarray(first.states.r), parts[0], parts[1])
        if m > 1
        else (None, None)
    )
    return ErrorEstimate(parts[0], parts[1], parts[2], parts[3], folding, lost, note)


def empty_estimate(first: Trajectory, reason: str) -> ErrorEstimate:
    """Estimate without a number at any time, with its reason."""
    none = np.full((4, len(first.ts), first.states.r.shape[1]), np.nan)
    return ErrorEstimate(
        none[0], none[1], none[2], none[3], note=_format_note(np.asarray(first.ts), 0, reason)
    )


def _format_note(ts: np.ndarray, m: int, reason: str) -> str:
    if m == 0:
        return f"There is no error estimate: {reason or 'the second run did not start'}."
    return (
        f"There is no error estimate after t = {ts[m - 1]:.9g} s: "
        f"{reason or 'the second run stopped there'}."
    )


def _select_rows(states: Any, rows: slice) -> State:
    return jax.tree.map(lambda x: np.asarray(x)[rows], states)


def _state_distances(a: State, b: State) -> np.ndarray:
    """Distances of positions, orientations [rad], velocities, angular velocities (4, k, n)."""
    distance = lambda x, y: np.sqrt(np.sum((x - y) ** 2, axis=-1))
    p, q = np.asarray(a.p), np.asarray(b.p)
    vector_part = (
        p[..., :1] * q[..., 1:] - q[..., :1] * p[..., 1:] - np.cross(p[..., 1:], q[..., 1:])
    )
    # arctan2 of vector and scalar part keeps its digits for tiny angles, for which an arc cosine has lost
    # half of them.
    angle = 2 * np.arctan2(np.linalg.norm(vector_part, axis=-1), np.abs(np.sum(p * q, axis=-1)))
    return np.stack([distance(a.r, b.r), angle, distance(a.v, b.v), distance(a.omega, b.omega)])


def _moved_on(states: State, later: float, rates: tuple[np.ndarray, np.ndarray] | None) -> State:
    """States (1, n, .) a short time later; velocities are NaN without accelerations."""
    v_rate, omega_rate = rates if rates is not None else (np.nan, np.nan)
    turn = jax.vmap(jax.vmap(lambda p, w: product(p, from_rotation_vector(w))))
    p = np.asarray(turn(jnp.asarray(states.p), jnp.asarray(states.omega * later)))
    v, omega = states.v + v_rate * later, states.omega + omega_rate * later
    r = states.r + states.v * later
    return State(*(jnp.asarray(x) for x in (r, p, v, omega)))


def _estimate_growth(
    ts: Float[np.ndarray, " k"],
    r: Float[np.ndarray, "k n 3"],
    position: Float[np.ndarray, "k n"],
    angle: Float[np.ndarray, "k n"],
) -> tuple[float | None, float | None]:
    """E-folding time of the errors, and the time from which the motion is not determined."""
    travelled = np.nanmax(np.linalg.norm(r - r[:1], axis=-1))
    floor = 1e-12 * (1 + np.nanmax(np.abs(r)))
    position = np.where(position > floor, position, 0.0)
    share = position / travelled if travelled > floor else np.zeros_like(position)
    # A motion that returns has small errors again by coincidence; what was lost once stays lost.
    error = np.maximum.accumulate(np.nan_to_num(np.max(np.maximum(share, angle), axis=1)))
    lost = np.flatnonzero(error > LOST)
    end = ts[lost[0]] if lost.size else ts[np.flatnonzero(np.isfinite(angle[:, 0]))[-1]]
    later = (ts >= 0.5 * (ts[0] + end)) & (ts <= end) & (error > 1e-15)
    folding = None
    if np.sum(later) >= 4:
        # Only the later half is fitted: in the first one the transient of the smallest errors would tilt the
        # line.
        slope = np.polyfit(ts[later], np.log(error[later]), 1)[0]
        if slope * np.ptp(ts[later]) >= _EXPONENTIAL:
            folding = float(1 / slope)
    return folding, float(ts[lost[0]]) if lost.size else None


class Start(NamedTuple):
    """Checks of the initial state.

    Attributes:
        rows: its constraint rows. rank: their rank. norm: largest | |p|^2 - 1 |.
        branches: text on a singular posture from which several motions lead; else "".
        followed: true if the posture is singular, and the velocities say along which branch the
            motion goes on.
    """

    rows: RowsAt
    rank: Rank
    norm: float
    branches: str = ""
    followed: bool = False


def inspect_start(
    system: System, state: State, t: float, formulation: AbstractFormulation, left_out: int = 0
) -> tuple[AbstractFormulation, AugmentedModel, Start]:
    """Check an initial state and its loads, determine the rank, and allow for dependent rows.

    Args:
        left_out: number of rows that the formulation's equations leave out already.

    Returns:
        formulation, or one that allows for dependent rows if there are more than those left out; system
        prepared for maximal coordinates, with the rows of all joints; and what was found.

    Raises:
        StateError: the state is not consistent with the joints, or it is a singular posture at rest
            from which loads set the system in motion. ModelError: a load is not finite, the
            constraints contradict each other, or the formulation allows for no dependent rows.
    """
    rows = prepare_rows(system)
    batched_rows = rows_of(rows, jax.tree.map(lambda x: np.asarray(x)[None], state), t)
    start_rows = RowsAt(*(x[0] for x in batched_rows))
    check_loads(system, start_rows.finite_loads, t)
    limits = consistent_limits(system, rows, state, start_rows)
    check_consistent(system, rows, start_rows.residuals, start_rows.rates, limits)
    rank = rank_of(system, rows, state, t, start_rows.matrix)
    off_unit = np.max(np.abs(np.sum(np.asarray(state.p) ** 2, axis=-1) - 1))
    start = Start(batched_rows, rank, float(off_unit))
    check_rounded(system, rows)
    if rank.rows - rank.rank <= left_out and isinstance(formulation, Augmented):
        check_condition(system, state)
    if rank.rank < rank.rows:
        check_compatible(rank, start_rows.matrix, start_rows.gamma)
        if rank.rows - rank.rank > left_out:
            formulation = allow_dependent(formulation, rank)
        start_branching = branches_at(rows, state, t, start_rows.matrix)
        check_determined(system, state, start_branching, start_rows.gamma, start_rows.wrenches)
        text = (
            branches_meet(system, state, start_branching.names)
            if start_branching.undetermined
            else ""
        )
        followed = start_branching.gained > 0 and not start_branching.undetermined
        start = start._replace(branches=text, followed=followed)
    return formulation, rows, start


def branches_at(rows: AugmentedModel, state: State, t: float, matrix: np.ndarray) -> Branching:
    """`Branching` of a posture with dependent rows.

    Args:
        rows: system prepared for maximal coordinates, with the rows of all joints.
        matrix: constraint Jacobian in (v, omega').
    """
    return find_branches(rows, state, matrix, lambda states: rows_of(rows, states, t).matrix)


# Generalised forces below this part of their terms, and accelerations of drivers below this [m/s^2],
# [rad/s^2], count as zero.
_BALANCED = 1e-9


def check_determined(
    system: System, state: State, branch: Branching, gamma: np.ndarray, wrenches: np.ndarray
) -> None:
    """Raise `StateError` if a motion begins at rest in a singular posture.

    Args:
        gamma: right-hand sides of the constraint rows for accelerations (m,). wrenches: loads on the
            bodies (n, 6), as in `RowsAt`.
    """
    if not (branch.undetermined and branch.resting):
        return
    terms = branch.free * wrenches.reshape(-1, 1)
    pushed = np.any(np.abs(terms.sum(axis=0)) > _BALANCED * np.abs(terms).sum(axis=0))
    if pushed or np.max(np.abs(gamma)) > _BALANCED:
        text = branches_meet(system, state, branch.names)
        raise StateError(
            f"T{text[1:]}. The motion starts there at rest (velocities up to {RESTING:g} rad/s), and its loads "
            "or drivers set it in motion: give it a velocity, or start in another posture."
        )


def allow_dependent(formulation: AbstractFormulation, rank: Rank) -> AbstractFormulation:
    """Formulation that allows for dependent rows; `ModelError` if there is none."""
    allowing = formulation.allowing_dependent_rows()
    if allowing is None:
        raise ModelError(
            f"The joints {', '.join(rank.redundant)} have dependent constraint rows, which "
            f"{type(formulation).__name__} does not support: use Tree() or Augmented()."
        )
    return allowing


def check_compatible(rank: Rank, matrix: np.ndarray, gamma: np.ndarray) -> None:
    """Raise `ModelError` if dependent rows contradict each other."""
    nearest = np.linalg.lstsq(matrix, gamma, rcond=1e-9)[0]
    misfit = np.max(np.abs(matrix @ nearest - gamma))
    if not misfit <= 1e-6 * (1 + np.max(np.abs(nearest))):
        raise ModelError(
            "The constraints contradict each other: no accelerations satisfy all of them "
            f"(misfit {misfit:.3g}). Among the dependent rows are those of "
            f"{', '.join(rank.redundant)}. If they are dependent in this posture alone, the initial "
            "velocities are inconsistent with it."
        )


def check_rounded(system: System, rows: AugmentedModel) -> None:
    """Raise `ModelError` if rows differ from others by little more than round-off in every posture."""
    independence = find_independent_rows(system)
    if independence.shares is None or independence.weakest >= WEAK:
        return
    names = ", ".join(name_owners(rows, independence.shares))
    raise ModelError(
        f"The mechanism is nearly overconstrained: the joints {names} repeat constraints of "
        f"others to a relative difference of {independence.weakest:.1g} in every posture, which double "
        f"precision cannot resolve (it needs at least {WEAK:.0e}, or below {DEPENDENT:.0e} for dependent "
        "rows). Give axes and points with all digits, or use a joint with fewer constraints, such as a "
        "spherical one."
    )


# The start was a singular posture if a singular value that is zero there comes to this fraction of the
# largest, and to this multiple of the constraints' residuals.
_RISEN, _DRIFT = 1e-5, 100.0

# Largest number of saved states at which the standard certificate looks at the rank.
SEEN = 256


class Checked(NamedTuple):
    """Checks of the saved states.

    Attributes:
        balances: energies and momenta; None if they were left out.
        smallest: smallest singular value number `rank` of the constraint Jacobian, or None.
        difference: that of two formulations, see `Certificate.formulation_difference`, or None.
        worst: largest constraint residuals by name in a certificate.
        branches: text on a start in a singular posture that the motion has left; else "".
    """

    balances: Balances | None
    smallest: float | None
    difference: float | None
    worst: dict[str, float]
    branches: str = ""


def check_saved(
    problem: Problem, rows: AugmentedModel, start: Start, first: Trajectory, full: bool
) -> Checked:
    """Checks of the saved states of a run, by the rows of all joints and by another formulation.

    Args:
        rows: system prepared for maximal coordinates, with the rows of all joints.
        full: look at the rows of every saved state, and compare accelerations with those by
            another formulation.
    """
    at, system = saved_states(first), rows.system
    pick = np.arange(len(at.ts))
    if not full and len(pick) > SEEN:
        pick = np.linspace(0, len(pick) - 1, SEEN).round().astype(int)
    saved_rows = rows_at(rows, jax.tree.map(lambda x: np.asarray(x)[pick], at))
    smallest, difference, branches = None, None, ""
    worst = largest_violations(
        rows.constraints, first, saved_rows if full else start.rows, start.norm
    )
    if start.rank.rank:
        smallest = float(np.min(singular_values(saved_rows)[:, start.rank.rank - 1]))
        arm = float(longest_arm(system, rows.constraints))
        drifted = max(worst["position_violation"] / arm, worst["angle_violation"])
        scaled = scale_matrix(system, rows.constraints, np.asarray(saved_rows.matrix))
        values = np.linalg.svd(scaled, compute_uv=False)
        later = _independent_later(values, start.rank.rank, drifted)
        if later is not None and not start.followed:
            state_at = lambda k: jax.tree.map(lambda x: np.asarray(x)[k], at.states)
            k = pick[later]
            time = float(at.ts[k])
            branches = singular_start(system, rows, state_at(0), state_at(k), time, start.rank.rank)
    if full:
        difference = _formulation_difference(problem, rows, at, bool(start.rank.redundant))
    return Checked(balances(system, at), smallest, difference, worst, branches)


def _independent_later(values: Float[np.ndarray, "k s"], rank: int, drifted: float) -> int | None:
    """Saved state whose rows are independent where those of the start are not; None if there is none.

    Args:
        values: singular values of the rows. rank: rank at the start.
        drifted: largest residual of the constraints, which makes dependent rows a little different.
    """
    if rank >= values.shape[1]:
        return None
    least = max(_RISEN, _DRIFT * drifted) * values[0, 0]
    later = int(np.argmax(values[:, rank]))
    return later if values[later, rank] > least > values[0, rank] else None


def _formulation_difference(
    problem: Problem, rows: AugmentedModel, at: Saved, dependent: bool
) -> float:
    """Largest relative difference of the accelerations by two formulations."""
    run_formulation = problem.method.formulation
    other = Tree() if isinstance(run_formulation, Augmented) else Augmented()
    model = other.prepare(rows.system)
    dependent = dependent and not count_left_out(model)
    other = other.allowing_dependent_rows() if dependent else other
    acceleration_sets = [
        evaluate_accelerations(formulation, m, at)
        for formulation, m in ((run_formulation, problem.model), (other, model))
    ]
    pairs = [[x.v_rate, x.omega_rate] for x in acceleration_sets]
    return max(relative_error(a - b, a, b) for a, b in zip(*pairs, strict=True))


def make_certificate(
    system: System,
    trajectory: Trajectory,
    checked: Checked,
    errors: ErrorEstimate,
    rank: Rank,
    result: str,
    seconds: Seconds,
) -> Certificate:
    """Assemble the certificate of a finished run.

    Args:
        rank: rank at the start. result: outcome of the run as text.
    """
    drift, relative_drift, momentum = _compute_balances(system, trajectory, checked.balances)
    position, angle, velocity, angular_velocity = (
        _over_all(x)
        for x in (errors.position, errors.angle, errors.velocity, errors.angular_velocity)
    )
    return Certificate(
        result=result,
        t_end=float(trajectory.ts[-1]),
        position_error=position,
        position_error_end=_over_all(errors.position[-1]),
        angle_error=angle,
        angle_error_end=_over_all(errors.angle[-1]),
        velocity_error=velocity,
        angular_velocity_error=angular_velocity,
        error_e_folding_time=errors.e_folding_time,
        predictability_horizon=errors.predictability_horizon,
        error_words=_join_texts(errors.describe(np.asarray(trajectory.ts)), checked.branches),
        **checked.worst,
        energy_error=drift,
        relative_energy_error=relative_drift,
        momentum_error=momentum[0],
        angular_momentum_error=momentum[1],
        smallest_singular_value=checked.smallest,
        rows=rank.rows,
        rank=rank.rank,
        redundant=rank.redundant,
        formulation_difference=checked.difference,
        accepted_steps=int(trajectory.counts.accepted[-1]),
        rejected_steps=int(trajectory.counts.rejected[-1]),
        steps_at_growth_limit=int(trajectory.counts.at_growth_limit[-1]),
        compile_seconds=seconds.compile,
        run_seconds=seconds.run,
        estimate_seconds=seconds.estimate,
        analysis_seconds=seconds.analysis,
    )


def _join_texts(error_text: str, branches: str) -> str:
    """Words about the errors, with those on a singular start as a sentence of their own."""
    if not branches:
        return error_text
    also = f"T{branches[1:]}. The errors are those of the branch that this run follows."
    return f"{error_text.rstrip('.')}. {also}" if error_text else also


def _compute_balances(
    system: System, trajectory: Trajectory, view: Balances | None
) -> tuple[float, float, tuple[float | None, float | None]]:
    """Largest energy error [J], its ratio to the largest energy, relative momentum errors."""
    if view is None:
        return float("nan"), float("nan"), (None, None)
    total = view.kinetic + view.potential
    drift = total - total[0] - trajectory.work
    momentum: tuple[float | None, float | None] = (None, None)
    if system.floating:
        change = view.momentum - view.momentum[0] - trajectory.impulse
        momentum = tuple(
            relative_error(change[:, part], view.momentum[:, part], trajectory.impulse[:, part])
            for part in (slice(0, 3), slice(3, 6))
        )  # pyright: ignore[reportAssignmentType]
    ratio = relative_error(drift, view.kinetic, view.potential, trajectory.work)
    return float(np.max(np.abs(drift))), ratio, momentum


def largest_violations(
    constraints: Constraints, trajectory: Trajectory, rows: RowsAt, norm: float
) -> dict[str, float]:
    """Largest residuals over the accepted steps and in `rows`, by name in a certificate.

    Args:
        norm: largest | |p|^2 - 1 | at the start.
    """
    angular, worst = constraints.angular, trajectory.worst
    over = lambda way, x: max(float(way[-1]), float(np.max(np.abs(x), initial=0.0)))
    return {
        "position_violation": over(worst.position, rows.residuals[:, ~angular]),
        "angle_violation": over(worst.angle, rows.residuals[:, angular]),
        "velocity_violation": over(worst.velocity, rows.rates[:, ~angular]),
        "angular_velocity_violation": over(worst.angular_velocity, rows.rates[:, angular]),
        "norm_violation": max(float(worst.norm[-1]), norm),
    }


def describe_open_joints(
    problem: Problem, rows: AugmentedModel, trajectory: Trajectory, worst: dict[str, float]
) -> str:
    """Text on joints that have come open beyond what tolerances and size allow; "" if none has.

    Args:
        rows: system prepared for maximal coordinates, with the rows of all joints.
        worst: largest residuals, see `largest_violations`.
    """
    system, every = rows.system, rows.constraints
    if not every.n_rows:
        return ""
    projected = problem.method.stabilisation.iterations_after_step() > 0
    tolerance = max(float(problem.method.rtol), float(problem.method.atol))
    share = float(open_limit(tolerance, projected=projected))
    arm = float(longest_arm(system, every))
    for name, unit, size in (("position", "m", arm), ("angle", "rad", 1.0)):
        violation = worst[f"{name}_violation"]
        if violation <= share * size:
            continue
        last = jax.tree.map(lambda x: np.asarray(x)[-1:], saved_states(trajectory))
        deviations = np.abs(np.asarray(rows_at(rows, last).residuals)[0]) / np.where(
            every.angular, 1, arm
        )
        joint = system.joints[
            every.owner[int(np.argmax(np.nan_to_num(deviations, nan=np.inf)))]
        ].name
        return (
            f"joint '{joint}' has come open: constraints are violated by {violation:.2g} {unit}, where the "
            f"tolerances and the size of the mechanism allow {share * size:.2g} {unit}. Either its rows "
            "count as dependent on others and are not, or its masses, inertias or lengths differ "
            "too much for double precision"
        )
    return ""


def _over_all(errors: np.ndarray) -> float:
    """Largest of the error estimates; NaN if there is none."""
    return float(np.nanmax(errors)) if np.any(np.isfinite(errors)) else float("nan")
