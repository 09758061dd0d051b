"""Chains of four-bars through their singular postures: errors and steps at every tolerance.

N loops for 20 s from N = 1 to 40, against the closed form; a heavy and a light coupler; linkages
that miss the singular posture, by their energy. Large matrices are slower by an order of magnitude
with threads that wait for each other, so give OpenBLAS one:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 python benchmarks/singular.py
"""

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import diffrax
import jax
import numpy as np
from record import add_options, begin, write

jax.config.update("jax_enable_x64", True)
sys.path[:0] = [str(Path(__file__).parents[1] / "tests" / part) for part in ("", "published")]

import jax.numpy as jnp
from test_four_bar import (  # pyright: ignore[reportMissingImports]
    LONG,
    TOLERANCES,
    closed_form,
    course,
    four_bar,
    kinetic_and_potential,
    missing,
    start,
)

import stmuav_jax as sj

LOOPS = (1, 2, 5, 20, 40)
COUPLERS = (1e-4, 1e6)  # kg
MISSES = (1e-3, 1e-4, 1e-5, 1e-7)  # m


def course_of(system: sj.System, state: sj.State, rtol: float) -> tuple[dict[str, Any], Any]:
    """How one run went, and its trajectory."""
    began = time.process_time()
    path = jax.block_until_ready(course(system, state, jnp.asarray(rtol)))
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
    system = four_bar(loops, coupler=coupler)
    how, path = course_of(system, start(system), rtol)
    off = 2 * np.asarray(path.states.r[:, 0, :2]) - closed_form(loops, LONG, coupler)[:, :2]
    return {"loops": loops, "coupler": coupler, **how, "error": float(np.nanmax(np.abs(off)))}


def miss(by: float, rtol: float) -> dict[str, Any]:
    """One tolerance, by the energy."""
    system, state = missing(by)
    how, path = course_of(system, state, rtol)
    energy = kinetic_and_potential(system, path.states)
    return {"missed_by": by, **how, "energy": float(np.nanmax(np.abs(energy - energy[0])))}


def main() -> None:
    """Run and write `singular.json`."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="one loop, one tolerance")
    add_options(parser)
    arguments = parser.parse_args()
    begin(arguments)
    few = arguments.quick
    tolerances = TOLERANCES[:1] if few else TOLERANCES
    content: dict[str, Any] = {"chains": [], "couplers": [], "misses": []}

    def add(to: str, row: dict[str, Any]) -> None:
        content[to].append(row)
        print(row, flush=True)

    for rtol in tolerances:
        for coupler in COUPLERS[:1] if few else COUPLERS:
            add("couplers", chain(1, rtol, coupler))
        for by in MISSES[:1] if few else MISSES:
            add("misses", miss(by, rtol))
    for loops in LOOPS[:1] if few else LOOPS:
        # the first run compiles
        chain(loops, 1e-6)
        for rtol in tolerances:
            add("chains", chain(loops, rtol))
    print(write("singular", content, arguments.results))


if __name__ == "__main__":
    main()
