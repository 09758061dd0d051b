"""Chains of four-bars through their singular postures: errors and steps at every tolerance.

N loops for 20 s from N = 1 to 40, against the closed form; a heavy and a light coupler; linkages
that miss the singular posture, by their energy. Large matrices are slower by an order of magnitude
with threads that wait for each other, so give OpenBLAS one:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/singular.py
"""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from problems import four_bar
from problems.four_bar import LONG, TOLERANCES
from shared.record import benchmark

import stmuav_jax as stm


@dataclass(frozen=True)
class Size:
    """How much is run: numbers of loops, couplers [kg], misses [m], tolerances."""

    loops: tuple[int, ...] = (1, 2, 5, 20, 40)
    couplers: tuple[float, ...] = (1e-4, 1e6)
    misses: tuple[float, ...] = (1e-3, 1e-4, 1e-5, 1e-7)
    tolerances: tuple[float, ...] = TOLERANCES


QUICK = Size((1,), (1e-4,), (1e-3,), TOLERANCES[:1])


def course_of(system: stm.System, state: stm.State, rtol: float) -> tuple[dict[str, Any], Any]:
    """How one run went, and its trajectory."""
    began = time.process_time()
    path = jax.block_until_ready(four_bar.course(system, state, jnp.asarray(rtol)))
    reached = int(np.sum(np.isfinite(np.asarray(path.states.r[:, 0, 0]))))
    counts = path.counts
    how = {
        "tolerance": rtol,
        "passed": bool(path.result == diffrax.RESULTS.successful),
        "reached": float(LONG[reached - 1]),
        "accepted": int(counts.accepted[-1]),
        "rejected": int(counts.rejected[-1]),
        "cpu_seconds": time.process_time() - began,
        "largest_rate": float(np.nanmax(np.abs(np.asarray(path.states.omega)))),
    }
    return how, path


def chain(loops: int, rtol: float, coupler: float = 1.0) -> dict[str, Any]:
    """One tolerance, against the closed form."""
    system = four_bar.four_bar(loops, coupler=coupler)
    how, path = course_of(system, four_bar.start(system), rtol)
    off = (
        2 * np.asarray(path.states.r[:, 0, :2]) - four_bar.closed_form(loops, LONG, coupler)[:, :2]
    )
    return {"loops": loops, "coupler": coupler, **how, "error": float(np.nanmax(np.abs(off)))}


def miss(by: float, rtol: float) -> dict[str, Any]:
    """One tolerance, by the energy."""
    system, state = four_bar.missing(by)
    how, path = course_of(system, state, rtol)
    energy = four_bar.kinetic_and_potential(system, path.states)
    return {"missed_by": by, **how, "energy": float(np.nanmax(np.abs(energy - energy[0])))}


def record(size: Size) -> Iterator[dict[str, Any]]:
    """All chains, couplers and misses."""
    content: dict[str, Any] = {"chains": [], "couplers": [], "misses": []}

    def add(to: str, row: dict[str, Any]) -> None:
        content[to].append(row)
        print(row, flush=True)

    for rtol in size.tolerances:
        for coupler in size.couplers:
            add("couplers", chain(1, rtol, coupler))
        for by in size.misses:
            add("misses", miss(by, rtol))
    for loops in size.loops:
        # the first run compiles
        chain(loops, 1e-6)
        for rtol in size.tolerances:
            add("chains", chain(loops, rtol))
    yield content


if __name__ == "__main__":
    benchmark("singular", __doc__, record, (Size(), QUICK))
