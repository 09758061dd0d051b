"""Adapter between the suite and a program that it measures: ours and every peer alike.

A peer is one module in `benchmarks/peers/` with one class derived from `Peer`. It gets the
same `Scene` as we do and builds its own model from it, so that all solve the same problem.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from importlib import metadata
from importlib.util import find_spec
from typing import Any

import numpy as np

from stmuav_jax import Scene, State


@dataclass(frozen=True)
class Setting:
    """One point of a work-precision curve: a tolerance of adaptive steps, or a fixed step [s]."""

    solver: str
    tolerance: float | None = None
    step: float | None = None
    options: dict[str, Any] = field(default_factory=dict)


def tolerances(solver: str, powers: Iterable[int] = range(4, 13)) -> list[Setting]:
    """Tolerances of 10^-k."""
    return [Setting(solver, tolerance=10.0**-k) for k in powers]


def steps(solver: str, *lengths: float) -> list[Setting]:
    """Fixed steps [s]."""
    return [Setting(solver, step=length) for length in lengths]


@dataclass(frozen=True)
class Outcome:
    """What one run gives.

    Attributes:
        positions: centres of mass at the wanted times, world (k, n, 3) [m]; not finite from
            where the run failed.
        evaluations: of accelerations; None where the program does not count.
        accepted, rejected: steps. residual: largest constraint violation [m].
        seconds: timed by the program itself (a program of its own cannot be timed from
            here without its start); None: the suite's timer counts.
        failure: in words; empty if it reached the end.
    """

    positions: np.ndarray
    evaluations: int | None = None
    accepted: int | None = None
    rejected: int | None = None
    residual: float | None = None
    seconds: list[float] | None = None
    failure: str = ""

    def figures(self) -> dict[str, Any]:
        """What a row says of a run beside its cost and error."""
        names = ("evaluations", "accepted", "rejected", "residual", "failure")
        return {name: getattr(self, name) for name in names}


def looked_at(
    states: Iterable[Any],
    look: Callable[[Any], tuple[np.ndarray, float]],
    n: int,
    counts: tuple[int, int, int],
    failure: str = "",
) -> Outcome:
    """The outcome of a run whose states at the wanted times are given.

    Args:
        look: positions (n, 3) and residual of a state. counts: evaluations, accepted and rejected
            steps. failure: what the integrator said.
    """
    states = list(states)
    positions, worst = np.full((len(states), n, 3), np.nan), 0.0
    for k, state in enumerate(states):
        if np.all(np.isfinite(state)):
            positions[k], gap = look(state)
            worst = max(worst, gap)
    if not failure and not np.all(np.isfinite(positions)):
        failure = "The state is not finite."
    return Outcome(positions, *counts, worst, failure=failure)


@dataclass(frozen=True)
class Prepared:
    """A run that is ready to be timed: `run()` does the whole integration and waits for it."""

    run: Callable[[], Outcome]
    compile_seconds: float = 0.0


class Peer(ABC):
    """A program to compare with.

    Attributes:
        name: in tables and figures. packages: what it imports, and what pip installs for that.
        how: its settings that are not in the tables, for those who know the program.
        caveats: what it, or our adapter, leaves out or does differently, one sentence each.
    """

    name: str
    packages: tuple[tuple[str, str], ...] = ()
    how: str = ""
    caveats: tuple[str, ...] = ()

    def missing(self) -> str:
        """Why it cannot run here (not installed, no compiler); empty if it can."""
        for module, package in self.packages:
            # a module of a package that is not there is an error
            if not (find_spec(module.partition(".")[0]) and find_spec(module)):
                return f"The package {package} is not installed."
        return ""

    def version(self) -> str:
        """Version of the measured program, and those of the packages beside it."""
        (_, first), *beside = self.packages
        others = (f", {name} {metadata.version(name)}" for _, name in beside)
        return metadata.version(first) + "".join(others)

    def unsupported(self, scene: Scene) -> str:
        """What our adapter lacks for this scene; empty if it can be run."""
        return ""

    @abstractmethod
    def settings(self, scene: Scene | None = None) -> list[Setting]:
        """From coarse to fine; those for a scene, where that makes a difference."""

    @abstractmethod
    def prepare(self, scene: Scene, times: np.ndarray, setting: Setting) -> Prepared:
        """Build the model and, where there is something to compile, compile it."""

    def throughput(
        self, scene: Scene, states: State, t1: float, setting: Setting
    ) -> tuple[float, np.ndarray] | None:
        """Trajectories per second on one thread, and where they end; None without such a mode.

        Args:
            states: consistent starts, arrays (k, n, .). t1: end [s].

        Returns:
            The median rate [1/s]; centres of mass at t1 (k, n, 3) [m].
        """
        return None
