"""Integration from output time to output time through one compiled program, in chunks."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import numpy as np

from ...algebra.compiler import program
from ...checks.numbers import floats
from ...mechanics.state import State
from .advance import Trajectory, advance
from .problem import Problem, compiled_begin

# Number of output times for one call of the compiled program, between two signs of progress.
CHUNK = 16


class March:
    """Integration of one problem, in chunks of output times.

    Args:
        problem: prepared model and method. Problems that differ in numbers only, such as
            tolerances, share their program.
        t0: initial time [s].
        state0: initial state.

    Attributes:
        parts: trajectories reached so far, as NumPy arrays, one for every call of `to`.
    """

    def __init__(self, problem: Problem, t0: float, state0: State) -> None:
        self.problem = problem
        self.carry: Any = compiled_begin(problem, floats(t0), state0)
        chunk = floats(np.full(CHUNK, float(t0)))
        self.program = program(advance, problem, self.carry, chunk)
        self.parts: list[Trajectory] = []

    def to(self, times: np.ndarray) -> Trajectory:
        """Continue to each of the times (k,) [s], or to an earlier event or failure.

        Returns this part of the trajectory.
        """
        found = []
        for start in range(0, len(times), CHUNK):
            part = times[start : start + CHUNK]
            chunk = np.append(part, np.full(CHUNK - len(part), part[-1]))
            self.carry, trajectory = self.program(self.problem, self.carry, floats(chunk))
            found.append(_shortened(trajectory, len(part)))
            if not self.going:
                break
        self.parts.append(_joined(found))
        return self.parts[-1]

    @property
    def going(self) -> bool:
        """True if neither an event nor a failure has ended the integration."""
        return same_result(self.carry.result, diffrax.RESULTS.successful)

    def trajectory(self) -> Trajectory:
        """Trajectory of all parts, without repeats of the last state after an event or failure."""
        joined = _joined(self.parts)
        fresh = np.append(True, np.diff(joined.ts) > 0)
        count = len(joined.ts) if np.all(fresh) else int(np.argmin(fresh))
        return _shortened(joined, max(count, 1))


def same_result(a: Any, b: Any) -> bool:
    """Test whether two known results are the same, by their numbers, which compiles nothing."""
    return int(jax.tree.leaves(a)[0]) == int(jax.tree.leaves(b)[0])


def _result(trajectory: Trajectory) -> Any:
    return trajectory.result


def _joined(parts: list[Trajectory]) -> Trajectory:
    bare = [eqx.tree_at(_result, part, None) for part in parts]
    joined = jax.tree.map(lambda *x: np.concatenate(x), *bare)
    return eqx.tree_at(_result, joined, parts[-1].result, is_leaf=lambda x: x is None)


def _shortened(trajectory: Trajectory, count: int) -> Trajectory:
    bare = eqx.tree_at(_result, trajectory, None)
    bare = jax.tree.map(lambda x: np.asarray(x)[:count], bare)
    return eqx.tree_at(_result, bare, trajectory.result, is_leaf=lambda x: x is None)
