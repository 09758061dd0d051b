"""Certificate of a finished run, from its trajectory and analysis."""

import numpy as np

from ..mechanics.system import System
from .assembly.initial import Rank
from .error_estimate import ErrorEstimate
from .evaluation import Snapshot, StartCheck
from .formulations.constraints import Constraints
from .integration.advance import Trajectory
from .run import Certificate, Seconds, relative


def certify(
    system: System,
    trajectory: Trajectory,
    view: Snapshot | None,
    errors: ErrorEstimate,
    rank: Rank,
    worst: dict[str, float],
    result: str,
    seconds: Seconds,
) -> Certificate:
    """Assemble the certificate of a finished run.

    Args:
        view: `Snapshot`s of the saved states, if they were analysed. rank: rank at the start.
        worst: result of `violations`. result: outcome of the run in words.
    """
    drift, relative_drift, momentum = _balances(system, trajectory, view)
    position, angle, velocity, angular_velocity = (
        _over_all(x)
        for x in (errors.position, errors.angle, errors.velocity, errors.angular_velocity)
    )
    smallest = None
    if view is not None and rank.rank:
        smallest = float(np.min(view.singular_values[:, rank.rank - 1]))
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
        error_words=errors.words(np.asarray(trajectory.ts)),
        **worst,
        energy_error=drift,
        relative_energy_error=relative_drift,
        momentum_error=momentum[0],
        angular_momentum_error=momentum[1],
        smallest_singular_value=smallest,
        rows=rank.rows,
        rank=rank.rank,
        redundant=rank.redundant,
        accepted_steps=int(trajectory.counts.accepted[-1]),
        rejected_steps=int(trajectory.counts.rejected[-1]),
        steps_at_growth_limit=int(trajectory.counts.at_growth_limit[-1]),
        compile_seconds=seconds.compile,
        run_seconds=seconds.run,
        estimate_seconds=seconds.estimate,
        analysis_seconds=seconds.analysis,
    )


def _balances(
    system: System, trajectory: Trajectory, view: Snapshot | None
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
    constraints: Constraints, trajectory: Trajectory, start: StartCheck
) -> dict[str, float]:
    """Largest residuals at the start and over the accepted steps, by name in a certificate."""
    angular, worst = constraints.angular, trajectory.worst
    over = lambda way, x: max(float(way[-1]), float(np.max(np.abs(x), initial=0.0)))
    return {
        "position_violation": over(worst.position, start.residuals[~angular]),
        "angle_violation": over(worst.angle, start.residuals[angular]),
        "velocity_violation": over(worst.velocity, start.rates[~angular]),
        "angular_velocity_violation": over(worst.angular_velocity, start.rates[angular]),
        "norm_violation": max(float(worst.norm[-1]), start.norm),
    }


def _over_all(errors: np.ndarray) -> float:
    """Largest of the error estimates; NaN if there is none."""
    return float(np.nanmax(errors)) if np.any(np.isfinite(errors)) else float("nan")
