"""Hover trims of the UAV over panel orientations: how many in a second, and how many are trims.

Beside them SciPy's `root` (Powell's hybrid method, differences) on compiled accelerations, one trim
at a time. One core:

    OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 taskset -c 1 python benchmarks/trims.py
"""

import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import root
from shared.clock import measure
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.uav.allocation import minimum_norm, wrench_map

# Panel angles are drawn up to this [rad] either way; some are out of the tracker's reach.
REACH = 0.75


@dataclass(frozen=True)
class Size:
    """How much is run: orientations, those of SciPy, in groups of, repeats."""

    orientations: int = 10_000
    peer: int = 50
    group: int = 64
    repeats: int = 5


QUICK = Size(orientations=6, peer=1, group=2, repeats=1)


def trim_all(uav: stm.uav.Uav, angles: Any, group: int) -> tuple[Any, ...]:
    """Reason, residual, number of steps and inputs of the trims at all angles, `group` at a time."""

    def trim_at(a: Any) -> tuple[Any, ...]:
        trim = stm.uav.trim_flight(uav, stm.analysis.hover(a), throw=False)
        return trim.reason, trim.residual, trim.steps, trim.values

    return jax.lax.map(trim_at, angles, batch_size=group)


def ours(size: Size, uav: stm.uav.Uav, angles: Any) -> dict[str, Any]:
    """All trims in one compiled call."""
    many = stm.math.outer_jit(lambda a: trim_all(uav, a, size.group))
    started = time.perf_counter()
    found = jax.block_until_ready(many(angles))
    first = time.perf_counter() - started
    timing, found = measure(lambda: many(angles), repeats=size.repeats)
    reason, residual, steps, _ = map(np.asarray, found)
    fine = reason == stm.uav.TrimReason.VALID
    counts = Counter(stm.uav.TrimReason(int(k)).name for k in np.sort(reason))
    return {
        "seconds": timing.to_dict(), "first_call_seconds": first,
        "per_second": size.orientations / timing.median, "reasons": dict(counts),
        "largest_residual": float(np.max(residual[fine])),
        "largest_steps": int(np.max(steps[fine])),
    }  # fmt: skip


def with_scipy(size: Size, uav: stm.uav.Uav, angles: Any) -> dict[str, Any]:
    """The same trims by SciPy, compilation left out."""
    space, rotors = uav.space, uav.rotors

    def accelerations(z: Any, angles: Any) -> Any:
        """Of the eight coordinates; unknowns roll, pitch, thrust, moments and two forces."""
        B = wrench_map(rotors, jnp.zeros(3))
        x = space.retract(uav.point(angles), jnp.zeros(16).at[3:5].set(z[:2]))
        values = jnp.concatenate([minimum_norm(B, z[2:6]), z[6:]])
        return space.rates(x, 0.0, uav.inputs.applied(uav.system, values))[8:]

    of = jax.jit(accelerations)
    start = np.zeros(8)
    start[2] = 9.81 * float(jnp.sum(uav.system.bodies.mass))
    of(start, angles[0]).block_until_ready()
    began = time.perf_counter()
    solve = lambda a: root(lambda z: np.asarray(of(z, a)), start, tol=1e-12)
    found = [solve(a) for a in angles[: size.peer]]
    seconds = time.perf_counter() - began
    left = [float(np.max(np.abs(r.fun))) for r in found]
    return {"per_second": size.peer / seconds, "median_residual": float(np.median(left))}


def record(size: Size) -> Iterator[dict[str, Any]]:
    """Our trims and SciPy's."""
    uav = stm.uav.make_uav()
    rng = np.random.default_rng(1)
    angles = jnp.asarray(rng.uniform(-REACH, REACH, (size.orientations, 2)))
    content: dict[str, Any] = {"ours": ours(size, uav, angles)}
    print(content["ours"], flush=True)
    content["scipy"] = with_scipy(size, uav, angles)
    content["times_scipy"] = content["ours"]["per_second"] / content["scipy"]["per_second"]
    print(content["scipy"], content["times_scipy"], flush=True)
    yield content


if __name__ == "__main__":
    benchmark("trims", __doc__, record, (Size(), QUICK))
