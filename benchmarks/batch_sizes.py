"""Throughput by batch size on JAX's default device, a GPU where there is one: flights, and filters of a bank.

    python benchmarks/batch_sizes.py              on a CPU: one core (taskset -c 1)

Flights are those of montecarlo.py, filters those of estimation.py (cubature, square root, 8 states).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import montecarlo
import numpy as np
from estimation import programs, record_of_case
from shared.clock import measure
from shared.record import benchmark

from stmuav_jax.estimation.filter import DEFAULT

# Largest batches: on a CPU the time of a larger one is in proportion.
MOST = {"cpu": 1024}
MOST_ELSEWHERE = 65536


@dataclass(frozen=True)
class Sweep:
    """sizes: batches; steps: of each filter; flights: which ones; tolerance; repeats."""

    sizes: tuple[int, ...] = (16, 64, 256, 1024, 4096, 16384, 65536)
    steps: int = 200
    flights: montecarlo.Size = montecarlo.FULL
    tolerance: float = 1e-9
    repeats: int = 3


QUICK = Sweep((8,), 3, montecarlo.ONE, 1e-6, 1)


def flights(sweep: Sweep, size: int) -> dict[str, Any]:
    """Flights per second of one batch in which all go on together."""
    bare = montecarlo.Bare(replace(sweep.flights, flights=size), sweep.tolerance, size)
    timing, flown = measure(lambda: bare.fly(size), repeats=sweep.repeats)
    failed = int(np.sum(np.asarray(flown.ending) != 1))
    return {"flights_per_second": size / timing.median, "flights_failed": failed}


def filters(sweep: Sweep, size: int) -> dict[str, Any]:
    """Microseconds of a filter's step in a bank of this size."""
    u, y = record_of_case(2, sweep.steps)
    spread = 0.01 * np.random.default_rng(1).normal(size=(sweep.steps, 3, size))
    given = jnp.asarray(y[:, :, None] + spread), jnp.asarray(u)
    _, bank = programs(DEFAULT)
    timing, found = measure(lambda: bank(*given), repeats=sweep.repeats)
    lost = int(np.sum(~np.asarray(found[2])))
    return {"filter_step_us": 1e6 * timing.median / (sweep.steps * size), "filters_failed": lost}


def record(sweep: Sweep) -> Iterator[dict[str, Any]]:
    """A row for each size, as they come."""
    device, rows = jax.devices()[0], []
    for size in sweep.sizes:
        if size <= MOST.get(device.platform, MOST_ELSEWHERE):
            rows.append({"size": size, **flights(sweep, size), **filters(sweep, size)})
            print(rows[-1], flush=True)
            what = f"throughput by batch size, {device.device_kind}"
            yield {"what": what, "tolerance": sweep.tolerance, "rows": rows}


if __name__ == "__main__":
    benchmark("batch_sizes", __doc__, record, (Sweep(), QUICK))
