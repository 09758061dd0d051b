"""Timers of the benchmarks, on the clock and on the processor, and compilation apart from runs.

Seconds of processor time are what the clock shows on an idle core, whatever else runs: for them
run on one core (`taskset -c 1`, with OMP_NUM_THREADS=1).
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from typing import Any

import jax
import numpy as np

import stmuav_jax as stm


@dataclass(frozen=True)
class Timing:
    """Seconds of repeated calls, the first (warm-up) calls left out.

    Attributes:
        median, best: [s]. spread: from the first to the third quartile [s].
        repeats: how many calls were timed.
    """

    median: float
    best: float
    spread: float
    repeats: int

    to_dict = asdict


def summary(seconds: list[float]) -> Timing:
    """Median, best and spread of measured seconds."""
    ordered = sorted(seconds)
    if len(ordered) < 2:
        return Timing(ordered[0], ordered[0], 0.0, 1)
    low, _, high = statistics.quantiles(ordered, n=4, method="inclusive")
    return Timing(statistics.median(ordered), ordered[0], high - low, len(ordered))


def measure(
    call: Callable[[], Any],
    *,
    repeats: int = 5,
    warm_up: int = 1,
    budget: float = 20.0,
    clock: Callable[[], float] = time.perf_counter,
) -> tuple[Timing, Any]:
    """Time `call`, and return its last output.

    The clock stops when every array of the output is there (`jax.block_until_ready`, which
    passes NumPy arrays and plain objects). No more calls are made once `budget` [s] is spent.
    """
    output = None
    for _ in range(warm_up):
        output = jax.block_until_ready(call())
    seconds: list[float] = []
    while len(seconds) < repeats and (not seconds or sum(seconds) < budget):
        start = clock()
        output = jax.block_until_ready(call())
        seconds.append(clock() - start)
    return summary(seconds), output


# Of a compiled call, on the processor; slow calls are made once.
measure_processor = partial(measure, repeats=3, warm_up=0, budget=1.0, clock=time.process_time)


def compiled(
    function: Callable[..., Any],
    *arguments: Any,
    clock: Callable[[], float] = time.perf_counter,
    jit: Callable[..., Any] = stm.math.outer_jit,
) -> tuple[Any, float]:
    """The function compiled for arguments of these shapes, and the seconds for trace and all.

    What JAX remembers of traces is dropped first: another function's would shorten this one's.
    """
    jax.clear_caches()
    start = clock()
    call: Any = jit(function)
    done = call.lower(*arguments).compile()
    return done, clock() - start


def compile_and_measure(
    function: Callable[..., Any], *arguments: Any, **how: Any
) -> tuple[Timing, Any, float]:
    """Timing and output of a function compiled for these arguments, and the seconds for that."""
    program, seconds = compiled(function, *arguments)
    timing, output = measure(lambda: program(*arguments), **how)
    return timing, output, seconds


def rounded(value: Any, digits: int = 4) -> Any:
    """Significant digits of an array as a list, for JSON; what is not finite as None."""
    flat = [float(f"{v:.{digits}g}") if np.isfinite(v) else None for v in np.ravel(value)]
    return flat if np.ndim(value) else flat[0]
