"""From what a run left behind to its certificate."""

from typing import Any

import numpy as np

from ..mechanics.system import System
from .analysis import Snapshot
from .initial import Rank
from .integrate import Trajectory
from .run import Certificate, relative


def certify(
    system: System,
    trajectory: Trajectory,
    view: Snapshot,
    rank: Rank,
    result: str,
    seconds: tuple[float, float, float],
) -> Certificate:
    """The certificate of a finished run.

    Args:
        view: `Snapshot`s of the saved states. rank: at the start. result: in words.
        seconds: spent on compiling, running, and looking.
    """
    total = view.kinetic + view.potential
    drift = total - total[0] - trajectory.work
    momentum: tuple[float | None, float | None] = (None, None)
    if system.floating:
        change = view.momentum - view.momentum[0] - trajectory.impulse
        momentum = tuple(
            relative(change[:, part], view.momentum[:, part], trajectory.impulse[:, part])
            for part in (slice(0, 3), slice(3, 6))
        )  # pyright: ignore[reportAssignmentType]
    values = view.singular_values
    return Certificate(
        result=result,
        t_end=float(trajectory.ts[-1]),
        position_residual=_largest(trajectory.worst.position[-1], view.residuals[0]),
        velocity_residual=_largest(trajectory.worst.velocity[-1], view.rates[0]),
        norm_error=_largest(trajectory.worst.norm[-1], np.sum(trajectory.states.p[0] ** 2, -1) - 1),
        energy_error=float(np.max(np.abs(drift))),
        relative_energy_error=relative(drift, view.kinetic, view.potential, trajectory.work),
        momentum_error=momentum[0],
        angular_momentum_error=momentum[1],
        smallest_singular_value=float(np.min(values[:, rank.rank - 1])) if rank.rank else None,
        rows=rank.rows,
        rank=rank.rank,
        redundant=rank.redundant,
        accepted_steps=int(trajectory.counts.accepted[-1]),
        rejected_steps=int(trajectory.counts.rejected[-1]),
        compile_seconds=seconds[0],
        run_seconds=seconds[1],
        analysis_seconds=seconds[2],
    )


def _largest(on_the_way: Any, at_the_start: Any) -> float:
    """The largest absolute value over the accepted steps and the start."""
    return float(max(on_the_way, np.max(np.abs(at_the_start), initial=0.0)))
