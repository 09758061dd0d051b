"""One compilation for many runs, and what a run costs where the machine is shared.

Costs are seconds of processor time of this process: run it on one core (`taskset -c 1`, with
OMP_NUM_THREADS=1), and they are what the clock shows on an idle core, whatever else runs. The
clock's own figures are kept beside them.
"""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from timer import Timing, measure, summary

import stmuav_jax as sj

# No call is repeated once this much is spent on it [s of the clock].
BUDGET = 1.0


class Cost(NamedTuple):
    """Seconds of the processor and of the clock."""

    processor: Timing
    clock: Timing

    def to_dict(self) -> dict[str, Any]:
        """As plain numbers, for JSON."""
        return {"processor": self.processor.to_dict(), "clock": self.clock.to_dict()}


def compiled(function: Callable[..., Any], *arguments: Any) -> tuple[Callable[..., Any], float]:
    """The function compiled for arguments of these shapes, and the processor seconds it took."""
    start = time.process_time()
    call: Any = sj.outer_jit(function)
    done = call.lower(*arguments).compile()
    return done, time.process_time() - start


def timed(call: Callable[..., Any], *arguments: Any, repeats: int = 3) -> tuple[Cost, Any]:
    """Cost and output of a compiled call; slow calls are made once."""
    seconds: list[float] = []

    def once() -> Any:
        start = time.process_time()
        output = jax.block_until_ready(call(*arguments))
        seconds.append(time.process_time() - start)
        return output

    clock, output = measure(once, repeats=repeats, warm_up=0, budget=BUDGET)
    return Cost(summary(seconds), clock), output


def rounded(value: Any, digits: int = 4) -> Any:
    """Significant digits of an array as a list, for JSON; what is not finite as None."""
    flat = [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.ravel(value)]
    return flat if np.ndim(value) else flat[0]


def ready(tree: Any) -> Any:
    """All arrays as NumPy arrays."""
    return jax.tree.map(lambda x: np.asarray(x) if eqx.is_array(x) else x, tree)
