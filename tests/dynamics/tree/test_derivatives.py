"""Derivatives of accelerations by the balance of forces, against other routes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central, forked

import stmuav_jax as stm


@pytest.fixture(scope="module")
def case():
    """x' as a function of x and of masses, inertias and points of joints; a direction of each.

    A floating mechanism with a ball and a closed loop, off its constraints.
    """
    rod = stm.distance("rod", "b", "c", point_i=[0.1, 0.2, 0.2], point_j=[0.1, -0.2, 0.35])
    system, how = forked(True, rod), stm.Baumgarte(5.0, 7.0)
    rng = np.random.default_rng(11)
    numbers = lambda s: (s.bodies.mass, s.bodies.inertia, *(j.point_j for j in s.joints))
    start = jax.tree.map(jnp.asarray, numbers(system))
    x = stm.Tree().to_vector(stm.Tree().prepare(system), system.reference)
    x = x + 0.05 * rng.normal(size=x.shape)

    def rate(x, values):
        changed = eqx.tree_at(numbers, system, values)
        model = stm.Tree().prepare(changed)
        return stm.Tree().derivative(model, jnp.asarray(0.3), x, how)[0]

    tensor = lambda a: a + np.swapaxes(a, 1, 2) if a.ndim == 3 else a
    step = lambda a: jnp.asarray(tensor(0.1 * np.mean(np.abs(a)) * rng.normal(size=a.shape)))
    dx = jnp.asarray(rng.normal(size=x.shape))
    return rate, x, start, dx, jax.tree.map(step, start), rng.normal(size=x.shape)


@pytest.mark.slow
def test_forward_reverse_differences(case):
    rate, x, start, dx, dv, weight = case
    moved = lambda h: rate(x + h * dx, jax.tree.map(lambda a, b: a + h * b, start, dv))
    run = jax.jit(moved)
    forward = jax.jit(lambda: jax.jvp(rate, (x, start), (dx, dv))[1])()
    expected = central(run, 1e-3)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(forward, expected, rtol=1e-8, atol=1e-8 * size)

    grads = jax.jit(lambda: jax.vjp(rate, x, start)[1](jnp.asarray(weight)))()
    back = sum(
        jnp.vdot(a, b) for a, b in zip(*map(jax.tree.leaves, (grads, (dx, dv))), strict=True)
    )
    assert float(back) == pytest.approx(float(weight @ forward), rel=1e-9, abs=1e-10 * size)


@pytest.mark.slow
def test_second_derivative(case):
    rate, x, start, dx, _, weight = case
    gradient = jax.grad(lambda x: weight @ rate(x, start))
    second = jax.jit(lambda: jax.jvp(gradient, (x,), (dx,))[1])()
    run = jax.jit(lambda h: gradient(x + h * dx))
    expected = central(run, 1e-3)
    size = np.max(np.abs(expected))
    np.testing.assert_allclose(second, expected, rtol=1e-7, atol=1e-7 * size)
