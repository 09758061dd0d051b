"""Numbers that the figures of a run show: texts and arrays, without the run's model."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from ..dynamics.run import Run

# Arguments of the functions that draw, by the figures' names.
Numbers = Mapping[str, tuple[Any, ...]]


def positions_of(run: "Run") -> tuple[Any, ...]:
    """Title, names of the watched bodies, times [s] and positions of each (k, 3) [m]."""
    names = run.scene.watch or run.scene.system.names
    return run.scene.title, names, run.ts, [np.asarray(run.body(name).r) for name in names]


def euler_parameters_of(run: "Run") -> tuple[Any, ...]:
    """Title, name of the last watched body, times [s] and its Euler parameters (k, 4)."""
    name = (run.scene.watch or run.scene.system.names)[-1]
    return run.scene.title, name, run.ts, np.asarray(run.body(name).p)


def balances_of(run: "Run") -> tuple[Any, ...]:
    """Title, times [s], energies (k, 3) [J], and errors and violations so far (k, 4)."""
    view, trajectory = run.snapshot, run.trajectory
    energies = np.stack([view.kinetic, view.potential - view.potential[0], trajectory.work], axis=1)
    total = view.kinetic + view.potential
    drift = np.maximum.accumulate(np.abs(total - total[0] - trajectory.work))
    position = np.max(run.errors.position, axis=1)
    worst = trajectory.worst
    errors = np.stack([position, drift, worst.position, worst.velocity], axis=1)
    return run.scene.title, run.ts, energies, errors


def numbers_of(run: "Run") -> Numbers:
    """Numbers of all figures of a run by the figures' names."""
    return {
        "positions": positions_of(run),
        "euler_parameters": euler_parameters_of(run),
        "balances": balances_of(run),
    }
