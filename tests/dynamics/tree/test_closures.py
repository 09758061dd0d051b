"""Functions that close over differentiated numbers, where reverse mode has a rule of its own."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.dynamics.integration.problem import Closure, convert_closures


@eqx.filter_custom_vjp
def applied(function, x):
    return function(x)


@applied.def_fwd
def _forward(perturbed, function, x):
    del perturbed
    return function(x), None


@applied.def_bwd
def _backward(residuals, wanted, perturbed, function, x):
    del residuals, perturbed
    arrays, rest = eqx.partition(function, eqx.is_inexact_array)
    return jax.vjp(lambda f: eqx.combine(f, rest)(x), arrays)[1](wanted)[0]


def of_lambda(a):
    return lambda x: a * x


def of_default(a):
    return lambda x, scale=a: scale * x


def of_keyword(a):
    def function(x, *, scale=a):
        return scale * x

    return function


def of_inner(a):
    inner = lambda x: a * x
    return lambda x: 1.0 * inner(x)


def of_pytree(a):
    numbers = {"a": [a, jnp.ones(2)], "words": "kept"}
    return lambda x: numbers["a"][0] * x


def of_partial(a):
    return functools.partial(lambda scale, x: scale * x, a)


def of_itself(a):
    def function(x, again=True):
        return function(a * x, False) if again else x

    return function


@pytest.mark.parametrize(
    "make", [of_lambda, of_default, of_keyword, of_inner, of_pytree, of_partial, of_itself]
)
def test_differentiated(make):
    value, slope = jax.jit(jax.value_and_grad(lambda a: applied(convert_closures(make(a)), 3.0)))(
        2.0
    )
    assert (float(value), float(slope)) == (6.0, 3.0)


@pytest.mark.slow
def test_a_force_written_as_a_lambda():
    """x(t) of 2 kg on a rail under a sin 3 t, and its derivative by a; as a user writes it."""
    body = stm.Body("m", 2.0, (1e-3,) * 3)
    rail = stm.translational("h", "ground", "m", point=(0, 0, 0), axis=(1, 0, 0))

    def end(a):
        push = stm.AppliedForce("m", lambda t, kin: jnp.stack([a * jnp.sin(3 * t), 0.0, 0.0]))
        system = stm.System([body], [rail], [push])
        ts = jnp.array([0.0, 1.0])
        return stm.integrate(system, system.reference, ts).states.r[-1, 0, 0]

    value, slope = jax.jit(jax.value_and_grad(end))(1.5)
    expected = (1.0 / 3 - np.sin(3.0) / 9) / 2
    assert float(value) == pytest.approx(1.5 * expected, rel=1e-7)
    assert float(slope) == pytest.approx(expected, rel=1e-7)
    with pytest.raises(RuntimeError, match="take forward mode over reverse mode"):
        jax.eval_shape(jax.grad(jax.grad(end)), 1.5)


def test_nothing_to_open_stays_as_it_is():
    function = of_lambda(2.0)
    assert convert_closures(function) is function
    assert convert_closures({"f": function, "x": 1.0}) == {"f": function, "x": 1.0}
    kinds = []
    jax.jit(lambda a: kinds.append(type(convert_closures(of_lambda(a)))))(1.0)
    assert kinds == [Closure]
