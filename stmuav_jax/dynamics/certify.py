"""Certificate of a finished run, from its trajectory and analysis."""

from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from ..checks.errors import ModelError, StateError
from ..mechanics.internal import internal_states
from ..mechanics.state import State
from ..mechanics.system import System
from .assembly.branching import RESTING, Branching, branching
from .assembly.initial import Rank, rank_of
from .assembly.singular import branches_meet, singular_start
from .checks import check_consistent, check_loads
from .error_estimate import ErrorEstimate
from .evaluation import Balances, RowsAt, Saved, accelerations, balances, rows_at, singular_values
from .formulations.augmented import Augmented, AugmentedModel
from .formulations.base import AbstractFormulation
from .formulations.constraints import Constraints
from .integration.advance import Trajectory
from .integration.problem import Problem
from .run import Certificate, Seconds, relative, saved
from .tree.formulation import Tree


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
    system: System, state: State, t: float, formulation: AbstractFormulation
) -> tuple[AbstractFormulation, AugmentedModel, Start]:
    """Check an initial state and its loads, determine the rank, and allow for dependent rows.

    Returns:
        formulation, or one that allows for dependent rows if there are any; system prepared for
        maximal coordinates, with the rows of all joints; and what was found.

    Raises:
        StateError: the state is not consistent with the joints, or it is a singular posture at rest
            from which loads set the system in motion. ModelError: a load is not finite, the
            constraints contradict each other, or the formulation allows for no dependent rows.
    """
    rows = Augmented().prepare(system)
    row = lambda x: np.asarray(x)[None]
    here = Saved(np.array([t]), *jax.tree.map(row, (state, internal_states(system))))
    seen = rows_at(rows, here)
    residuals, rates, matrix, gamma, finite_loads, wrenches = (np.asarray(x)[0] for x in seen)
    check_loads(system, finite_loads, t)
    check_consistent(system, rows, residuals, rates)
    rank = rank_of(system, rows, state, t, matrix)
    off_unit = np.max(np.abs(np.sum(np.asarray(state.p) ** 2, axis=-1) - 1))
    start = Start(seen, rank, float(off_unit))
    if rank.rank < rank.rows:
        formulation = allow_dependent(formulation, rank, matrix, gamma)
        beside = branches_at(rows, state, t, matrix)
        check_determined(system, state, beside, gamma, wrenches)
        text = branches_meet(system, state, beside.names) if beside.undetermined else ""
        followed = beside.gained > 0 and not beside.undetermined
        start = start._replace(branches=text, followed=followed)
    return formulation, rows, start


def branches_at(rows: AugmentedModel, state: State, t: float, matrix: np.ndarray) -> Branching:
    """`Branching` of a posture with dependent rows.

    Args:
        rows: system prepared for maximal coordinates, with the rows of all joints.
        matrix: constraint Jacobian in (v, omega').
    """
    internal = np.asarray(internal_states(rows.system))

    def look(states: State) -> np.ndarray:
        count = len(states.r)
        beside = Saved(np.full(count, t), states, np.tile(internal, (count, 1)))
        return np.asarray(rows_at(rows, jax.tree.map(np.asarray, beside)).matrix)

    return branching(rows, state, matrix, look)


# Generalised forces below this part of their terms, and accelerations of drivers below this [m/s^2],
# [rad/s^2], count as zero.
_BALANCED = 1e-9


def check_determined(
    system: System, state: State, beside: Branching, gamma: np.ndarray, wrenches: np.ndarray
) -> None:
    """Raise `StateError` if a motion begins at rest in a singular posture.

    Args:
        gamma: right-hand sides of the constraint rows for accelerations (m,). wrenches: loads on the
            bodies (n, 6), as in `RowsAt`.
    """
    if not (beside.undetermined and beside.resting):
        return
    terms = beside.free * wrenches.reshape(-1, 1)
    pushed = np.any(np.abs(terms.sum(axis=0)) > _BALANCED * np.abs(terms).sum(axis=0))
    if pushed or np.max(np.abs(gamma)) > _BALANCED:
        text = branches_meet(system, state, beside.names)
        raise StateError(
            f"T{text[1:]}. Here it is at rest, as which velocities up to {RESTING:g} rad/s count, and "
            "its loads or drivers set it in motion."
        )


def allow_dependent(
    formulation: AbstractFormulation, rank: Rank, matrix: np.ndarray, gamma: np.ndarray
) -> AbstractFormulation:
    """Formulation that allows for the dependent rows.

    Raises:
        ModelError: the rows contradict each other, or the formulation allows for no dependent ones.
    """
    allowing = formulation.allowing_dependent_rows()
    if allowing is None:
        raise ModelError(
            f"Dependent constraint rows in {', '.join(rank.redundant)}, for which "
            f"{type(formulation).__name__} does not allow."
        )
    nearest = np.linalg.lstsq(matrix, gamma, rcond=1e-9)[0]
    misfit = np.max(np.abs(matrix @ nearest - gamma))
    if not misfit <= 1e-6 * (1 + np.max(np.abs(nearest))):
        raise ModelError(
            "The constraints contradict each other: no accelerations satisfy all of them "
            f"(misfit {misfit:.3g}). Among the dependent rows are those of "
            f"{', '.join(rank.redundant)}. Where only this posture makes them dependent, it is "
            "the velocities that fit no motion through it."
        )
    return allowing


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
    at, system = saved(first), rows.system
    pick = np.arange(len(at.ts))
    if not full and len(pick) > SEEN:
        pick = np.linspace(0, len(pick) - 1, SEEN).round().astype(int)
    there = rows_at(rows, jax.tree.map(lambda x: np.asarray(x)[pick], at))
    smallest, difference, branches = None, None, ""
    worst = violations(rows.constraints, first, there if full else start.rows, start.norm)
    if start.rank.rank:
        values = singular_values(there)
        smallest = float(np.min(values[:, start.rank.rank - 1]))
        drifted = max(worst["position_violation"], worst["angle_violation"])
        later = _independent_later(values, start.rank.rank, drifted)
        if later is not None and not start.followed:
            one = lambda k: jax.tree.map(lambda x: np.asarray(x)[k], at.states)
            k = pick[later]
            time = float(at.ts[k])
            branches = singular_start(system, rows, one(0), one(k), time, start.rank.rank)
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
    own = problem.method.formulation
    other, model = Augmented(), rows
    if isinstance(own, Augmented):
        other = Tree()
        model = other.prepare(rows.system)
    other = other.allowing_dependent_rows() if dependent else other
    found = [accelerations(how, m, at) for how, m in ((own, problem.model), (other, model))]
    pairs = [[x.v_rate, x.omega_rate] for x in found]
    return max(relative(a - b, a, b) for a, b in zip(*pairs, strict=True))


def certify(
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
        rank: rank at the start. result: outcome of the run in words.
    """
    drift, relative_drift, momentum = _balances(system, trajectory, checked.balances)
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
        error_words=_with(errors.words(np.asarray(trajectory.ts)), checked.branches),
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


def _with(words: str, branches: str) -> str:
    """Words about the errors, with those on a singular start as a sentence of their own."""
    if not branches:
        return words
    also = f"T{branches[1:]}. The errors are those of the branch that this run follows."
    return f"{words.rstrip('.')}. {also}" if words else also


def _balances(
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
            relative(change[:, part], view.momentum[:, part], trajectory.impulse[:, part])
            for part in (slice(0, 3), slice(3, 6))
        )  # pyright: ignore[reportAssignmentType]
    ratio = relative(drift, view.kinetic, view.potential, trajectory.work)
    return float(np.max(np.abs(drift))), ratio, momentum


def violations(
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


def _over_all(errors: np.ndarray) -> float:
    """Largest of the error estimates; NaN if there is none."""
    return float(np.nanmax(errors)) if np.any(np.isfinite(errors)) else float("nan")
