"""Machine code of the equations against XLA's: operations, times by lanes, compilation, differences.

    taskset -c 1 python benchmarks/machine_code.py

uav_tracker case 2 by spanning-tree coordinates: right-hand side, projection, and flights of one second
at 1e-9 by lanes. Both kinds of code are measured in one process, in seconds of the processor; states are
of a motion near the start, flights agree to their tolerance. For comparison, the time of as many
fused multiplications and additions in short chains. On a processor with AVX-512 right-hand sides and flights
are measured by code for AVX2 too. The figure stands in docs/theory.md.
"""

import math
import multiprocessing
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import montecarlo
import numpy as np
from jax.extend import core
from shared.clock import compiled, measure_processor
from shared.record import benchmark

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import (
    _get_derivative,
    _get_projection,
    prepare_problem,
)
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.graph import MOVES, make_graph
from stmuav_jax.math.native.program import native
from stmuav_jax.math.native.structure import find_structure, read_structure


@dataclass(frozen=True)
class Size:
    """lanes: states at once; passes: evaluations in a row, of batches a tenth; flights, their lanes, settings."""

    lanes: tuple[int, ...] = (1, 4, 16, 64, 1024)
    passes: int = 1000
    flights: montecarlo.Size = montecarlo.FULL
    flying: tuple[int, ...] = (1, 64)
    tolerance: float = 1e-9
    repeats: int = 3


QUICK = Size((1, 3), 3, montecarlo.ONE, (1,), 1e-6, 1)


def functions(scene: stm.Scene) -> tuple[dict[str, Callable[..., Any]], Any, jax.Array]:
    """Functions of the prepared model and a vector of the state; the model and the start."""
    method = stm.Method()
    problem = prepare_problem(scene.system, method)
    formulation, steady = method.formulation, method.stabilisation
    time_zero, iterations = jnp.zeros(()), steady.iterations_after_step()
    rate = lambda model, x: _get_derivative(formulation, model, time_zero, x, steady)[0]
    project = lambda model, x: _get_projection(formulation, model, time_zero, x, iterations)[0]
    start = formulation.to_vector(problem.model, scene.state0)
    return {"right-hand side": rate, "projection": project}, problem.model, start


def count_traced(jaxpr: Any) -> int:
    """Operations on single numbers of a traced function, without moves of numbers."""
    total = 0
    for equation in jaxpr.eqns:
        name, shapes = equation.primitive.name, [math.prod(v.aval.shape) for v in equation.outvars]
        inner = list(core.jaxprs_in_params(equation.params))
        if inner:
            total += equation.params.get("length", 1) * sum(map(count_traced, inner))
        elif name == "dot_general":
            (axes, _), _ = equation.params["dimension_numbers"]
            terms = math.prod(equation.invars[0].aval.shape[k] for k in axes)
            total += (2 * terms - 1) * shapes[0]
        elif name.startswith("reduce_"):
            total += math.prod(equation.invars[0].aval.shape) - shapes[0]
        elif name not in MOVES and name not in ("gather", "scatter", "split", "pad", "iota"):
            total += sum(shapes)
    return total


def count_operations(function: Callable[..., Any], model: Any, x: jax.Array) -> dict[str, int]:
    """Operations on single numbers as traced, and those of the scalar program."""
    arrays, rest = eqx.partition(model, eqx.is_array)
    leaves, tree = jax.tree.flatten(arrays)
    flat = lambda x, *numbers: function(eqx.combine(jax.tree.unflatten(tree, numbers), rest), x)
    stm.math.use_native_code(False)
    traced = jax.make_jaxpr(flat)(x, *leaves)
    stm.math.use_native_code(True)
    known = read_structure(find_structure((x, model)), (x, model))
    graph, outputs = make_graph(traced, llvm.MOST_NODES, known)
    graph, _ = llvm.fuse(graph, [n for out in outputs for n in out.ravel().tolist()])
    kept = sum(op not in ("input", "constant") for op in graph.ops)
    return {"traced": count_traced(traced.jaxpr), "left": kept}


def evaluated(
    function: Callable[..., Any], model: Any, starts: jax.Array, size: Size
) -> dict[str, Any]:
    """Microseconds per state of evaluations in a row, seconds to compile, and the last values."""
    one = len(starts) == 1
    # a call itself takes time, that of a hundred evaluations of a small mechanism
    passes = max(size.passes // 10, size.passes // len(starts), 1)

    def chain(start: jax.Array) -> Any:
        value = lambda x: function(model, x)
        evaluate = value if one else jax.vmap(value)

        def step(_: Any, now: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            rate = evaluate(now[0])
            # each evaluation needs the one before
            return now[0] + 1e-12 * rate, rate

        return jax.lax.fori_loop(0, passes, step, (start, start))[1]

    argument = starts[0] if one else starts
    program, seconds = compiled(chain, argument, clock=time.process_time)
    timing, last = measure_processor(lambda: program(argument), repeats=size.repeats)
    best = 1e6 * timing.best / (passes * len(starts))
    return {"us_per_state": best, "compile_seconds": seconds, "last": np.asarray(last)}


# Numbers of a state in the program of short chains, and operations in a row, each of which waits for
# the one before. They are so few that a processor, which looks a few hundred operations ahead, finds enough
# that wait for nothing.
_NUMBERS, _PASSES = 16, 4


@native
def multiply_and_add(factor: jax.Array, chains: int, x: jax.Array) -> jax.Array:
    """Sums of chains of operations y * factor + 1 that begin at x + 0, x + 1, and so on."""
    y = x + np.arange(float(chains))[:, None]
    for _ in range(_PASSES):
        y = y * factor + 1.0
    return jnp.sum(y, axis=0)


def measure_chains(operations: int, lanes: int, size: Size) -> float:
    """Microseconds per state of a program of this many operations in short chains."""
    chains = operations // (_NUMBERS * (_PASSES + 2))
    function = lambda factor, x: multiply_and_add(factor, chains, x)
    starts = jnp.ones((lanes, _NUMBERS))
    cost = evaluated(function, jnp.asarray(0.5), starts, size)["us_per_state"]
    return cost * operations / (chains * _NUMBERS * (_PASSES + 2))


def both(measured: Callable[[], dict[str, Any]], key: str) -> dict[str, Any]:
    """A measurement by machine code and by XLA, and the largest difference relative to the largest value."""
    found = {}
    for on in (True, False):
        stm.math.use_native_code(on)
        found[on] = measured()
    stm.math.use_native_code(True)
    ours, theirs = (found[on].pop(key) for on in (True, False))
    apart = float(np.max(np.abs(ours - theirs)) / np.max(np.abs(theirs)))
    return {"machine_code": found[True], "xla": found[False], "difference": apart}


def fly(size: Size, lanes: int) -> dict[str, Any]:
    """Flights per second and seconds to compile, with the positions at the end."""
    count = min(size.flights.flights, 32 if lanes == 1 else 256)
    begun = time.process_time()
    bare = montecarlo.Bare(replace(size.flights, flights=count), size.tolerance, lanes)
    seconds = time.process_time() - begun
    timing, _ = measure_processor(lambda: bare.fly(count), repeats=size.repeats)
    ends = bare.ends(min(count, size.flights.checked))
    return {
        "flights_per_second": count / timing.best, "compile_seconds": seconds, "ends": ends,
    }  # fmt: skip


def measure_rows(size: Size, names: Sequence[str]) -> Iterator[dict[str, Any]]:
    """A row for each function and number of lanes."""
    made, model, start = functions(stm.make_scene(size.flights.scene, size.flights.case))
    rng = np.random.default_rng(1)
    for name in names:
        for lanes in size.lanes:
            starts = start + 1e-2 * rng.normal(size=(lanes, len(start)))
            timed = lambda f=made[name], s=starts: evaluated(f, model, s, size)
            row = {"function": name, "lanes": lanes, **both(timed, "last")}
            print(row, flush=True)
            yield row


def measure_flights(size: Size) -> Iterator[dict[str, Any]]:
    """A row for each number of flights that go side by side."""
    for lanes in size.flying:
        row = {"lanes": lanes, **both(lambda k=lanes: fly(size, k), "ends")}
        print(row, flush=True)
        yield row


def measure_narrow(size: Size) -> dict[str, Any]:
    """Right-hand sides and flights by code for a processor with AVX2, in a process that has compiled nothing."""
    features = llvm._features()
    wide = ("avx512", "avx10")
    narrow = {name: has and not name.startswith(wide) for name, has in features.items()}
    llvm._features = lambda: type(features)(narrow)
    rows = list(measure_rows(size, ["right-hand side"]))
    return {
        "vector_width": llvm.vector_width(),
        "rows": rows,
        "flights": list(measure_flights(size)),
    }


def record(size: Size) -> Iterator[dict[str, Any]]:
    """A row for each function and number of lanes, then flights, then the same with narrower vectors."""
    made, model, start = functions(stm.make_scene(size.flights.scene, size.flights.case))
    rows: list[dict[str, Any]] = []
    content = {
        "what": "machine code of the equations against XLA's", "vector_width": llvm.vector_width(),
        "operations": {k: count_operations(f, model, start) for k, f in made.items()}, "rows": rows,
        "flights": [],
    }  # fmt: skip
    left = content["operations"]["right-hand side"]["left"]
    content["limit"] = [
        {"lanes": lanes, "us_per_state": measure_chains(left, lanes, size)} for lanes in size.lanes
    ]
    rows += measure_rows(size, list(made))
    yield content
    for row in measure_flights(size):
        content["flights"].append(row)
        yield content
    if llvm.vector_width() == 8:
        os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_cpu_max_isa=AVX2"
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            content["narrow"] = pool.apply(measure_narrow, (size,))
        yield content


if __name__ == "__main__":
    benchmark("machine_code", __doc__, record, (Size(), QUICK))
