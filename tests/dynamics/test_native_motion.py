"""Motions by machine code of the equations against those by XLA."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import four_bar, four_bar_state
from parallel_robots import slider_crank

import stmuav_jax as stm
from stmuav_jax.math.native import llvm
from stmuav_jax.math.native.program import evaluate, targets_in

pytestmark = pytest.mark.skipif(not llvm.available(), reason="llvmlite is not installed")


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=["tree", "augmented"])
def test_a_slider_crank_and_its_derivatives_are_those_by_xla(formulation, machine_code):
    system = slider_crank(0.8, "O")
    method = stm.Method(formulation=formulation, rtol=1e-10, atol=1e-10)
    ts = jnp.linspace(0.0, 0.3, 4)

    def height(state):
        states = stm.integrate(system, state, ts, method=method).states
        return jnp.sum(states.r[-1]), states

    results = []
    for on in (False, True):
        machine_code(on)
        results.append(jax.value_and_grad(height, has_aux=True)(system.reference))
    for mine, others in zip(*(jax.tree.leaves(r) for r in results), strict=True):
        np.testing.assert_allclose(mine, others, rtol=0, atol=1e-9)


@pytest.mark.slow
def test_equations_are_machine_code_beside_the_choice_of_rows_and_as_by_xla(machine_code):
    """Derivative with rows that are selected in every step, and its gradient."""
    system, formulation = four_bar(), stm.Tree(redundant=True)
    model = formulation.prepare(system)
    x = formulation.to_vector(model, four_bar_state(system, 3.0))

    def rates(x):
        return formulation.derivative(model, jnp.zeros(()), x, stm.Projection())[0]

    def rates_and_gradient(x):
        value, transpose = jax.vjp(rates, x)
        return value, *transpose(jnp.ones_like(value))

    results = []
    for on in (False, True):
        machine_code(on)
        traced = jax.jit(lambda x: rates_and_gradient(x)).trace(x)
        assert bool(targets_in(traced.jaxpr.jaxpr)) == on
        results.append(traced.lower().compile()(x))
    for mine, others in zip(*results, strict=True):
        np.testing.assert_allclose(mine, others, rtol=0, atol=1e-11 * np.max(np.abs(others)))


@pytest.mark.slow
def test_a_number_of_the_state_that_is_not_finite_is_seen_wherever_xla_sees_it(machine_code):
    system, formulation = slider_crank(0.8, "O"), stm.Tree()
    model = formulation.prepare(system)
    x = formulation.to_vector(model, system.reference)
    places = jnp.eye(len(x), dtype=bool)
    states = jnp.concatenate([jnp.where(places, bad, x) for bad in (jnp.nan, jnp.inf, -jnp.inf)])

    def rates(x):
        return evaluate(formulation.derivative, model, jnp.zeros(()), x, stm.Unstabilised())[0]

    found = {}
    for on in (False, True):
        machine_code(on)
        found[on] = np.isfinite(jax.jit(jax.vmap(lambda x: rates(x)))(states))
    assert not found[True].all(axis=1).any()
    assert not (found[True] & ~found[False]).any()


@pytest.mark.slow
def test_a_run_says_what_compiled_its_equations(machine_code):
    for on, name in ((False, "XLA"), (True, "LLVM")):
        machine_code(on)
        run = stm.simulate(stm.make_scene("spin"), t1=0.01, analysis=False, error_estimate=False)
        assert run.settings["equations_compiled_by"].split()[0] == name
