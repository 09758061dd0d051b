"""Machine code of random mechanisms against XLA's: values and derivatives."""

import itertools
import os
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings, strategies as st
from test_random_mechanisms import Structure, built, structures

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


def differences(structure: Structure, seed: int) -> tuple[float, float, float]:
    """Of the accelerations of one mechanism, their jvp and their vjp."""
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
    moves = rng.normal(size=x.shape), rng.normal(size=mass.shape)
    # a pull-back is the transpose of all columns, which the push-forward gives in one batch
    unit = np.eye(len(x) + len(mass))
    axes = (None, None, 0, 0)
    (columns,) = run(forward, axes, x, mass, unit[:, : len(x)], unit[:, len(x) :])
    seed_vector = rng.normal(size=columns.shape[1])
    pulled = np.concatenate(run(back, None, x, mass, seed_vector))
    return (
        apart(run(program, None, x, mass), by_xla(program, x, mass)),
        apart(run(forward, None, x, mass, *moves), by_xla(forward, x, mass, *moves)),
        apart([pulled], [columns @ seed_vector]),
    )  # fmt: skip


# The suite takes a few; the variable asks for more, which are others than those of the suite.
EXAMPLES = int(os.environ.get("STMUAV_RANDOM_MECHANISMS", "8"))
tried = itertools.count(1)


@settings(
    max_examples=EXAMPLES, derandomize=True, deadline=None, database=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large], phases=[Phase.generate],
)  # fmt: skip
@given(structures(), st.integers(0, 99))
def test_random_mechanisms(structure: Structure, seed: int):
    value, forward, back = differences(structure, seed)
    assert value <= 1e-12
    assert max(forward, back) <= 1e-11
    if next(tried) % 12 == 0:
        # hundreds of mechanisms in one test would fill the memory
        jax.clear_caches()
