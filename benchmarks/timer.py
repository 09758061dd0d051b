"""The one timer of the benchmarks: waits on what a call returns, reports median and spread."""

import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import jax


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

    def to_dict(self) -> dict[str, float]:
        """As plain numbers, for JSON."""
        return asdict(self)


def summary(seconds: list[float]) -> Timing:
    """Median, best and spread of measured seconds."""
    ordered = sorted(seconds)
    if len(ordered) < 2:
        return Timing(ordered[0], ordered[0], 0.0, 1)
    low, _, high = statistics.quantiles(ordered, n=4, method="inclusive")
    return Timing(statistics.median(ordered), ordered[0], high - low, len(ordered))


def measure(
    call: Callable[[], Any], *, repeats: int = 5, warm_up: int = 1, budget: float = 20.0
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
        start = time.perf_counter()
        output = jax.block_until_ready(call())
        seconds.append(time.perf_counter() - start)
    return summary(seconds), output
