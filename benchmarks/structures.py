"""Memory of one process that simulates many mechanisms, each of another structure.

The mechanisms are chains of three bodies with every choice of six kinds of joints. One core:

    taskset -c 1 python benchmarks/structures.py
"""

import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from shared.record import benchmark

import stmuav_jax as stm

Z = (0.0, 0.0, 1.0)
# Kind of joint -> what else it takes beside its name, bodies and point.
KINDS: dict[str, dict[str, Any]] = {
    "spherical": {}, "universal": {"axis_i": Z, "axis_j": (1.0, 0.0, 0.0)}, "revolute": {"axis": (0.0, 1.0, 0.0)},
    "translational": {"axis": Z}, "cylindrical": {"axis": Z}, "screw": {"axis": Z, "pitch": 0.1},
}  # fmt: skip
BODIES, EVERY = 3, 10


def chain(kinds: tuple[str, ...]) -> stm.System:
    """Rods that hang one on the other by joints of the given kinds, from the ground outwards."""
    names = ["ground", *(f"rod {k}" for k in range(len(kinds)))]
    bodies = [
        stm.Body(name, mass=1.0 + 0.1 * k, inertia=np.diag([0.02, 0.1, 0.1]), position=(k + 0.5, 0.0, 0.0))
        for k, name in enumerate(names[1:])
    ]  # fmt: skip
    joints = [
        getattr(stm.mechanics, kind)(f"joint {k}", *names[k : k + 2], point=(k, 0.0, 0.0), **KINDS[kind])
        for k, kind in enumerate(kinds)
    ]  # fmt: skip
    return stm.System(bodies, joints, [stm.Gravity()])


def read_memory() -> float:
    """Memory of this process [MB], without what is swapped out."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def record(number: int) -> Iterator[dict[str, Any]]:
    """Memory and seconds of processor time after every ten structures."""
    rows = []
    choices = itertools.product(KINDS, repeat=BODIES)
    for count, kinds in enumerate(itertools.islice(choices, number), start=1):
        system = chain(kinds)
        stm.simulate(system, system.reference, t1=0.02)
        if count % EVERY == 0 or count == number:
            spent = time.process_time()
            rows.append({"structures": count, "megabytes": read_memory(), "cpu_seconds": spent})
            print(rows[-1], flush=True)
    yield {"what": "memory of one process after simulations of so many structures", "rows": rows}


if __name__ == "__main__":
    benchmark("structures", __doc__, record, (len(KINDS) ** BODIES, 2))
