"""Machine code of random mechanisms against XLA's: values and derivatives."""

import itertools
import operator
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import mpmath
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from test_random_mechanisms import Link, Structure, built, structures

import stmuav_jax as stm
from stmuav_jax.math.compiler import compiler_options
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.program import Program, native_p

pytestmark = [
    pytest.mark.slow, pytest.mark.skipif(not llvm.available(), reason="llvmlite is not installed"),
]  # fmt: skip


def program_of(function: Any, *args: Any) -> tuple[Program, list[Any]]:
    """Program of a function of pytrees, and its arguments as arrays."""
    leaves, tree = jax.tree.flatten(args)
    flat = lambda *x: jax.tree.leaves(function(*jax.tree.unflatten(tree, x)))
    return Program(jax.make_jaxpr(flat)(*leaves)), [np.asarray(x, float) for x in leaves]


def run(program: Program, axes: Any, *args: Any) -> Any:
    """Results of a program's machine code, over a batch if there are axes."""
    assert program.graph() is not None, program._reason
    call: Any = lambda *x: native_p.bind(*x, program=program, lead=())
    lowered = jax.jit(jax.vmap(call, in_axes=axes) if axes else call).lower(*args)
    assert "stmuav_" in lowered.as_text()
    return lowered.compile()(*args)


def by_xla(program: Program, *args: Any) -> Any:
    return jax.jit(program.evaluate, compiler_options=compiler_options(quick=True))(*args)


def apart(results: Any, expected: Any) -> float:
    """Largest difference, relative to the largest number of an array."""
    pairs = list(zip(results, expected, strict=True))
    for a, b in pairs:
        np.testing.assert_array_equal(np.isfinite(a), np.isfinite(b))
    return max(float(np.max(np.abs(a - b)) / max(np.max(np.abs(b)), 1.0)) for a, b in pairs)


# Operations of the equations of mechanisms, in exact arithmetic.
EXACT: dict[str, Any] = {
    "add": operator.add, "sub": operator.sub, "mul": operator.mul, "div": operator.truediv, "neg": operator.neg,
    "sqrt": mpmath.sqrt, "sin": mpmath.sin, "cos": mpmath.cos, "atan2": mpmath.atan2, "abs": abs, "max": max,
    "min": min, "lt": operator.lt, "le": operator.le, "gt": operator.gt, "ge": operator.ge, "eq": operator.eq,
    "ne": operator.ne, "and": lambda a, b: bool(a) and bool(b), "or": lambda a, b: bool(a) or bool(b),
    "not": operator.not_, "select": lambda condition, on_false, on_true: on_true if condition else on_false,
}  # fmt: skip


def by_exact_arithmetic(program: Program, *args: np.ndarray) -> list[np.ndarray]:
    """Results of a program's operations with 60 digits each, rounded at the end."""
    graph, outputs = program.graph()
    flat, values = [np.ravel(x) for x in args], {}
    with mpmath.workdps(60):
        for node in graph.needed([n for out in outputs for n in out.ravel().tolist()]):
            op, arguments = graph.ops[node], graph.args[node]
            if op == "constant":
                values[node] = mpmath.mpf(arguments[0])
            elif op == "input":
                values[node] = mpmath.mpf(float(flat[arguments[0]][arguments[1]]))
            else:
                values[node] = EXACT[op](*(values[n] for n in arguments))
        return [np.reshape([float(values[n]) for n in out.ravel()], out.shape) for out in outputs]


def check_against_xla(program: Program, bound: float, *args: np.ndarray) -> None:
    results, expected = run(program, None, *args), by_xla(program, *args)
    if apart(results, expected) > bound:
        # Equations with nearly dependent rows lose more digits than that whoever evaluates them: exact
        # arithmetic says how many, and machine code may lose as many as XLA.
        exact = by_exact_arithmetic(program, *args)
        lost = apart(expected, exact)
        assert apart(results, exact) <= 3 * lost
        assert lost <= 1e-10


def check_mechanism(structure: Structure, seed: int) -> None:
    """Accelerations of one mechanism, their jvp and their vjp."""
    system, velocity = built(structure, seed)
    formulation, rest = stm.Tree(), system.reference
    model = formulation.prepare(system)
    v, omega = jnp.split(velocity, 2, axis=1)
    x = formulation.to_vector(model, stm.State(rest.r, rest.p, v, omega))
    rng = np.random.default_rng(seed)
    masses = lambda model: model.system.bodies.mass

    def rates(x: Any, mass: Any) -> Any:
        weighed = eqx.tree_at(masses, model, mass)
        return formulation.derivative(weighed, jnp.zeros(()), x, stm.Unstabilised())[0]

    program, (x, mass) = program_of(rates, x, masses(model))
    forward = program.push_forward((True, True))
    back = forward.pull_back((True, True, False, False), (True,))
    check_against_xla(program, 1e-12, x, mass)
    check_against_xla(
        forward, 1e-11, x, mass, rng.normal(size=x.shape), rng.normal(size=mass.shape)
    )
    # a pull-back is the transpose of all columns, which the push-forward gives in one batch
    unit = np.eye(len(x) + len(mass))
    axes = (None, None, 0, 0)
    (columns,) = run(forward, axes, x, mass, unit[:, : len(x)], unit[:, len(x) :])
    seed_vector = rng.normal(size=columns.shape[1])
    pulled = np.concatenate(run(back, None, x, mass, seed_vector))
    assert apart([pulled], [columns @ seed_vector]) <= 1e-11


# The suite takes a few; the variable asks for more, which are others than those of the suite.
EXAMPLES = int(os.environ.get("STMUAV_RANDOM_MECHANISMS", "8"))
tried = itertools.count(1)


@settings(
    max_examples=EXAMPLES, derandomize=True, deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], phases=[Phase.generate],
)  # fmt: skip
@given(structures(), st.integers(0, 99))
def test_random_mechanisms(structure: Structure, seed: int):
    check_mechanism(structure, seed)
    if next(tried) % 12 == 0:
        # hundreds of mechanisms in one test would fill the memory
        jax.clear_caches()


def test_a_loop_whose_rows_nearly_depend_on_each_other():
    """Machine code and XLA differ by 3e-12 here, and both from exact arithmetic by half of that."""
    links = Link("spherical", -1, 0), Link("screw", -1, 1), Link("spherical", 0, 1)
    check_mechanism(Structure(bodies=2, links=links, floating=False), 1)
