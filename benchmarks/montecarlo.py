"""Many flights: throughput by lanes, on one core and all, against peers; what store and study cost.

    OPENBLAS_NUM_THREADS=1 python benchmarks/montecarlo.py

Flights of uav_tracker case 2, 1 s, from starts that differ in the base's velocities (normal, 0.1 m/s
and 0.1 rad/s). Errors are those of any body's position at the end, over the first flights, against
runs at a tighter tolerance.
"""

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from sections.ours import peers
from sections.speed import errors, throughput
from shared.clock import compiled, measure
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.lanes import integrate_batch

# Largest error that counts [m]; peers get finer settings until they reach it.
WANTED = 1e-6


@dataclass(frozen=True)
class Size:
    """flights: of a throughput; lanes: tried; checked: with an error; t1 [s]; repeats."""

    flights: int = 512
    lanes: tuple[int, ...] = (8, 16, 32, 64)
    checked: int = 64
    t1: float = 1.0
    tolerances: tuple[float, ...] = (1e-8, 3e-9, 1e-9)
    tight: float = 1e-12
    repeats: int = 3
    scene: str = "uav_tracker"
    case: int | None = 2


FULL = Size()
ONE = Size(flights=4, lanes=(2,), checked=2, t1=0.02, tolerances=(1e-6,), tight=1e-9, repeats=1,
           scene="hexacopter", case=None)  # fmt: skip


def make_study(size: Size, tolerance: float, **settings: Any) -> stm.Study:
    """The flights, with what a study of them would keep."""
    normal = {"distribution": "normal", "mean": 0.0, "standard_deviation": 0.1}
    names = ("vx", "vy", "vz", "p", "q", "r")
    return stm.studies.make_study(
        {
            "name": "throughput", "scene": size.scene, "case": size.case, "t1": size.t1, "seed": 1,
            "rtol": tolerance, "atol": tolerance,
            "factors": {f"start.{name}": normal for name in names},
            "quantities": {name: {"signal": name, "take": "final"} for name in "xyz"},
        },
        **settings,
    )  # fmt: skip


class Bare:
    """Flights through lanes alone, without a study's columns."""

    def __init__(self, size: Size, tolerance: float, lanes: int) -> None:
        study = make_study(size, tolerance)
        plan = self.plan = study.evaluate.plan
        drawn = study.sampling.draw(0, size.flights).T
        samples = dict(zip(study.sampling.names, map(jnp.asarray, drawn), strict=True))
        self.queue = samples, jnp.zeros((size.flights, 2), jnp.uint32)
        run = lambda queue, count: integrate_batch(plan, queue, count, lanes)
        self.program, self.compile_seconds = compiled(run, self.queue, jnp.asarray(1))

    def fly(self, count: int) -> Any:
        """The first flights."""
        return jax.block_until_ready(self.program(self.queue, jnp.asarray(count)))

    def ends(self, count: int) -> np.ndarray:
        """Positions of all bodies at the end (count, n, 3) [m]."""
        last = self.fly(count).last[:count]

        def positions(drawn: Any, y: Any) -> Any:
            problem, _ = self.plan.make(drawn)
            method = problem.method
            return method.formulation.to_state(problem.model, y[: problem.n_state]).r

        first = jax.tree.map(lambda x: x[:count], self.queue)
        return np.asarray(jax.jit(jax.vmap(positions))(first, last))

    def starts(self, count: int) -> stm.State:
        """Consistent starts (count, n, .)."""
        first = jax.tree.map(lambda x: x[:count], self.queue)
        return jax.jit(jax.vmap(lambda drawn: self.plan.make(drawn)[1]))(first)


def tolerance_for(size: Size, exact: np.ndarray) -> tuple[float, list[dict[str, Any]]]:
    """The loosest tolerance whose largest error is small enough; and what was tried."""
    tried = []
    for tolerance in size.tolerances:
        ends = Bare(size, tolerance, 16).ends(len(exact))
        tried.append({"tolerance": tolerance, **errors(ends, exact)})
        print(f"  tolerance {tolerance:g}: {tried[-1]}", flush=True)
        worst = tried[-1]["largest_error"]
        if worst is not None and worst <= WANTED:
            break
    return tried[-1]["tolerance"], tried


def by_lanes(size: Size, tolerance: float) -> list[dict[str, Any]]:
    """Flights per second for numbers of lanes."""
    rows = []
    for lanes in size.lanes:
        bare = Bare(size, tolerance, lanes)
        timing, flown = measure(lambda b=bare: b.fly(size.flights), repeats=size.repeats, warm_up=1)
        attempts = int(np.sum(flown.accepted) + np.sum(flown.rejected))
        rows.append({
            "lanes": lanes, "per_second": size.flights / timing.median,
            "seconds": timing.to_dict(), "compile_seconds": bare.compile_seconds,
            "microseconds_per_step": 1e6 * timing.median / attempts,
            "failed": int(np.sum(np.asarray(flown.ending) != 1)),
        })  # fmt: skip
        print(f"  {lanes} lanes: {rows[-1]['per_second']:.1f} per second", flush=True)
    return rows


def rate_one_by_one(size: Size, tolerance: float) -> float:
    """Flights per second in a single lane, of as few flights as it takes."""
    few, bare = min(64, size.flights), Bare(size, tolerance, 1)
    return few / measure(lambda: bare.fly(few), repeats=size.repeats)[0].median


def on_devices(size: Size, tolerance: float, devices: int) -> dict[str, Any]:
    """A study's flights per second on so many cores, bare and with the store, in a new process."""
    words = json.dumps([devices, tolerance, size == FULL])
    given = [sys.executable, __file__, "--devices", words]
    done = subprocess.run(given, capture_output=True, text=True, check=True)
    row = json.loads(done.stdout.splitlines()[-1])
    print(f"  {devices} cores: {row}", flush=True)
    return row


def child(size: Size, tolerance: float, devices: int) -> dict[str, Any]:
    """What `on_devices` runs: the same flights by bare calls, and as a study with its store."""
    count = size.flights * devices
    study = make_study(size, tolerance, block=size.flights, devices=devices)
    study.compute(0, 2)
    seconds = []
    for _ in range(size.repeats):
        with tempfile.TemporaryDirectory() as folder:
            started = time.perf_counter()
            study.compute(0, count)
            between = time.perf_counter()
            study.run(Path(folder) / "study.zarr", count, chunk=count)
            seconds.append((between - started, time.perf_counter() - between))
    bare, stored = np.array(seconds).T
    return {
        "devices": devices, "flights": count, "per_second": count / float(np.median(bare)),
        "per_second_stored": count / float(np.median(stored)),
        "overhead": float(np.median(stored / bare)) - 1,
    }  # fmt: skip


def record(size: Size) -> Iterator[dict[str, Any]]:
    """Everything."""
    tight = Bare(size, size.tight, 16)
    exact = tight.ends(size.checked)
    tolerance, tried = tolerance_for(size, exact)
    rows = by_lanes(size, tolerance)
    cores = sorted({1, os.cpu_count() or 1}) if size == FULL else [1]
    label = size.scene if size.case is None else f"{size.scene} case {size.case}"
    given = (stm.make_scene(size.scene, size.case), tight.starts(size.checked), size.t1)
    yield {
        "what": f"flights per second, {label}", "t1": size.t1, "flights": size.flights,
        "wanted_error": WANTED, "tolerance": tolerance, "tried": tried, "rows": rows,
        "one_lane_per_second": rate_one_by_one(size, tolerance),
        "peers": [row for peer in peers()[0] for row in throughput(peer, given, exact, WANTED, 30.0)],
        "cores": [on_devices(size, tolerance, count) for count in cores],
    }  # fmt: skip


if __name__ == "__main__":
    if sys.argv[1:2] == ["--devices"]:
        devices, tolerance, is_full = json.loads(sys.argv[2])
        print(json.dumps(child(FULL if is_full else ONE, tolerance, devices)))
    else:
        benchmark("montecarlo", __doc__, record, (FULL, ONE))
