"""Seconds of processor time that tracing, lowering and compiling take, by method and derivative.

Each program is made in a process of its own with nothing kept from before, with the options that
the package gives its own programs. The flights are of 0.3 s, saved at the end. One core:

    taskset -c 1 python benchmarks/compile_times.py
"""

import argparse
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from sections.gradient import PARAMETERS, functional
from shared.methods import trajectory
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.math.native.structure import find_structure, rely_on

# A program: a function and its arguments.
Made = tuple[Callable[..., Any], tuple[Any, ...]]
END, STEPS = 0.3, 100_000


def flight(solver: Any, *scene: Any) -> Made:
    """Simulation of a scene, not differentiated."""
    made = stm.make_scene(*scene)
    run = trajectory(stm.Tree(), solver, None, STEPS)
    return run, (made.system, made.state0, jnp.array([0.0, END]), 1e-8)


def derivative(reverse: bool) -> Made:
    """Derivative of the panel's final position by 20 parameters."""
    scene = stm.make_scene("uav_tracker", 2)
    adjoint = stm.dynamics.DiscreteAdjoint() if reverse else diffrax.ForwardMode()
    of = functional(scene, END, 20, adjoint, STEPS)
    height = lambda change, tolerance: of(change, tolerance)[2]
    return jax.grad(height) if reverse else jax.jacfwd(of), (jnp.zeros(20), 1e-8)


def trim() -> Made:
    """Hover trim of a UAV whose panel's mass and rods' lengths are given."""
    given = stm.PART_II
    values = {k: jnp.asarray(given.value(k), float) for k in ("mass.panel_7", "geometry.rods")}
    wanted = stm.analysis.hover(jnp.radians(jnp.array([10.0, -5.0])))

    def of(values: Any) -> Any:
        uav = stm.uav.make_uav(given.replaced(values))
        return stm.uav.trim_flight(uav, wanted, throw=False).vector

    return of, (values,)


# Name -> what makes the program, in the order of the table; the first is the smallest.
ROWS: dict[str, Callable[[], Made]] = {
    "spin, Dopri8": lambda: flight(diffrax.Dopri8(), "spin"),
    "uav_tracker 2, Dopri8": lambda: flight(diffrax.Dopri8(), "uav_tracker", 2),
    "uav_tracker 2, Kvaerno5": lambda: flight(stm.dynamics.kvaerno5(), "uav_tracker", 2),
    "forward (jacfwd), 20 parameters": lambda: derivative(reverse=False),
    "reverse (grad), 20 parameters": lambda: derivative(reverse=True),
    "trim": trim,
}


def equations(jaxpr: Any) -> int:
    """Number of equations of a program, those inside of others in their place."""
    total = 0
    for eqn in jaxpr.eqns:
        values = [x for v in eqn.params.values() for x in (v if isinstance(v, tuple) else (v,))]
        inner = [getattr(x, "jaxpr", x) for x in values]
        total += sum(equations(x) for x in inner if hasattr(x, "eqns")) or 1
    return total


def measured(name: str) -> dict[str, Any]:
    """Seconds of one program, made in this process."""
    options = stm.math.compiler_options(quick=True)
    function, arguments = ROWS[name]()
    numbers, rest = eqx.partition(arguments, eqx.is_array)
    of = lambda numbers: eqx.filter(function(*eqx.combine(numbers, rest)), eqx.is_array)
    of = rely_on(of, find_structure((numbers,)))
    # what preparing the arguments has traced would shorten the times
    jax.clear_caches()
    marks = [time.process_time()]
    traced = jax.jit(of, compiler_options=options).trace(numbers)
    marks.append(time.process_time())
    lowered = traced.lower()
    marks.append(time.process_time())
    lowered.compile()
    marks.append(time.process_time())
    kinds = ("trace_seconds", "lower_seconds", "compile_seconds")
    spent = zip(kinds, (b - a for a, b in pairwise(marks)), strict=True)
    return {"program": name, **dict(spent), "equations": equations(traced.jaxpr.jaxpr)}


def apart(name: str) -> dict[str, Any]:
    """Seconds of one program, made in a process of its own without JAX's cache."""
    environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(
        [sys.executable, str(Path(__file__)), "--row", name],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def record(names: list[str]) -> Iterator[dict[str, Any]]:
    """Rows of all programs, one after another."""
    rows = []
    for name in names:
        rows.append(apart(name))
        print(rows[-1], flush=True)
        what = "processor time to trace, lower and compile"
        yield {"what": what, "parameters": PARAMETERS, "rows": rows}


if __name__ == "__main__":
    inner = argparse.ArgumentParser(add_help=False)
    inner.add_argument("--row")
    one, _ = inner.parse_known_args()
    if one.row is not None:
        print(json.dumps(measured(one.row)))
    else:
        benchmark("compile_times", __doc__, record, (list(ROWS), list(ROWS)[:1]))
