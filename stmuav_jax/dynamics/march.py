"""An integration that goes on from output time to output time through one compiled program."""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..algebra.compiler import program
from ..mechanics.state import State
from .integrate import Trajectory, advance, compiled_begin
from .problem import Problem

# Output times reached by one call of the compiled program, between two progress reports.
CHUNK = 16


class March:
    """Integration of one problem, in chunks of output times.

    Args:
        problem: the system and the method, prepared. Problems that differ in numbers only,
            such as tolerances, share their program.
        t0: [s]. state0: at t0.

    Attributes:
        parts: what was reached so far, as NumPy arrays, a part for every call of `to`.
    """

    def __init__(self, problem: Problem, t0: float, state0: State) -> None:
        self.problem = problem
        self.carry: Any = compiled_begin(problem, jnp.asarray(float(t0)), state0)
        chunk = jnp.full(CHUNK, float(t0))
        self.program = program(advance, problem, self.carry, chunk)
        self.parts: list[Trajectory] = []

    def to(self, times: np.ndarray) -> Trajectory:
        """Go on to each of the times (k,) [s], or to an event or failure before; this part."""
        found = []
        for start in range(0, len(times), CHUNK):
            part = times[start : start + CHUNK]
            chunk = np.append(part, np.full(CHUNK - len(part), part[-1]))
            self.carry, trajectory = self.program(self.problem, self.carry, jnp.asarray(chunk))
            found.append(_shortened(trajectory, len(part)))
            if not self.going:
                break
        self.parts.append(_joined(found))
        return self.parts[-1]

    @property
    def going(self) -> bool:
        """Whether neither an event nor a failure has ended it."""
        return bool(self.carry.result == diffrax.RESULTS.successful)

    def trajectory(self) -> Trajectory:
        """All that was reached, without the repeats of the last state after an event or failure."""
        joined = _joined(self.parts)
        fresh = np.append(True, np.diff(joined.ts) > 0)
        count = len(joined.ts) if np.all(fresh) else int(np.argmin(fresh))
        return _shortened(joined, max(count, 1))


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
