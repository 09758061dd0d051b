"""Reverse mode by recorded steps: against diffrax's own, forward mode, and differences."""

from dataclasses import replace

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import pendulum, swung

import stmuav_jax as stm

KEEPING = stm.Method(rtol=1e-10, atol=1e-10)
AHEAD = replace(KEEPING, adjoint=diffrax.ForwardMode())
# mass, length, first angle, first rate, start and length of the flight
Q = jnp.array([2.0, 0.5, 1.1, -0.3, 0.2, 1.5])


def push(t):
    """A moment that depends on time [N m]."""
    return 0.8 * jnp.sin(3.0 * t)


def swing(q, method, times=None):
    """Of a driven pendulum: heights at three times, weighted, and the last rate."""
    mass, length, angle, rate = q[:4]
    t0, span = q[4:] if times is None else times
    system = pendulum(length=length, mass=mass, forces=(stm.JointEffort("hinge", push),))
    start = swung(system, angle, rate, length)
    ts = t0 + span * jnp.array([0.0, 0.35, 0.5, 1.0])
    states = stm.integrate(system, start, ts, method).states
    return states.r[1:, 0, 2] @ jnp.array([1.0, -0.5, 2.0]) + 0.1 * states.omega[-1, 0, 1]


of_kept = jax.jit(jax.value_and_grad(lambda q: swing(q, KEEPING)))


def forward_and_differences(f, q):
    """Gradient in forward mode and by differences of fourth order, from one program."""
    run = jax.jit(jax.vmap(lambda x, d: jax.jvp(f, (x,), (d,))))
    at = lambda k: run(q + k * 1e-3 * jnp.eye(len(q)), jnp.eye(len(q)))
    values = {k: np.asarray(at(k)[0]) for k in (-2, -1, 1, 2)}
    return at(0)[1], (8 * (values[1] - values[-1]) - (values[2] - values[-2])) / 12e-3


@pytest.mark.slow
def test_three_routes():
    """By numbers of the model and of the start, and by times, which the flow's equations give."""
    gradient = of_kept(Q)[1]
    forward, differences = forward_and_differences(lambda q: swing(q, AHEAD), Q)
    np.testing.assert_allclose(gradient[:4], forward[:4], rtol=1e-9)
    np.testing.assert_allclose(gradient, differences, rtol=1e-7)


@pytest.mark.slow
def test_three_routes_through_an_implicit_solver():
    """Its stages are solved to its tolerance, which both modes feel apart."""
    tight = replace(KEEPING, solver=stm.dynamics.kvaerno5())
    ahead = replace(tight, adjoint=diffrax.ForwardMode())
    reverse = jax.jit(jax.grad(lambda x: swing(x, tight, Q[4:])))(Q[:4])
    forward, differences = forward_and_differences(lambda q: swing(q, ahead, Q[4:]), Q[:4])
    np.testing.assert_allclose(reverse, forward, rtol=1e-8)
    np.testing.assert_allclose(reverse, differences, rtol=1e-5)


@pytest.mark.slow
def test_many_at_once():
    """Flights of different lengths: vmap of grad is a loop of grads."""
    several = Q + jnp.linspace(0.0, 0.4, 3)[:, None]
    values, gradients = jax.jit(jax.vmap(jax.value_and_grad(lambda q: swing(q, KEEPING))))(several)
    for q, value, gradient in zip(several, values, gradients, strict=True):
        alone, expected = of_kept(q)
        # round-off decides on steps, and those on the error
        assert value == pytest.approx(float(alone), rel=1e-9)
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize("jump", [0.4, 0.5])
def test_by_the_time_of_a_jump(jump):
    """A force that sets in on a slide, also at an output time: s = f (t - a)^2 / (2 m) from a on."""
    body = stm.Body("cart", 2.0, (0.1, 0.1, 0.1))
    slide = stm.translational("slide", "ground", "cart", point=(0, 0, 0), axis=(1, 0, 0))

    def positions(a, times, force):
        effort = stm.JointEffort("slide", lambda t: jnp.where(t < a, 0.0, force))
        system = stm.System([body], [slide], [effort])
        method = replace(KEEPING, jump_ts=jnp.stack([a]))
        return stm.integrate(system, system.reference, times, method).states.r[:, 0, 0]

    times, force = jnp.array([0.0, 0.5, 1.0]), 3.0
    rows = jax.jit(jax.jacrev(positions, argnums=(0, 1, 2)))(jump, times, force)
    since = np.maximum(np.asarray(times) - jump, 0.0)
    np.testing.assert_allclose(rows[0], -force / 2 * since, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rows[1], np.diag(force / 2 * since), rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(rows[2], since**2 / 4, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
def test_windows_of_two_attempts():
    """Flights of a batch, with different numbers of windows: the same derivatives as by long ones."""
    few = replace(KEEPING, adjoint=stm.dynamics.DiscreteAdjoint(recorded_steps=2), max_steps=200)
    several = Q + jnp.linspace(0.0, 0.4, 2)[:, None]
    found = jax.jit(jax.vmap(jax.value_and_grad(lambda q: swing(q, few))))
    for q, value, gradient in zip(several, *found(several), strict=True):
        alone, expected = of_kept(q)
        assert value == pytest.approx(float(alone), rel=1e-9)
        np.testing.assert_allclose(gradient, expected, rtol=0, atol=1e-9 * np.abs(expected).max())


@pytest.mark.slow
def test_more_steps_than_are_recorded():
    """Forward mode allows `max_steps` to each output time, the record holds as many in all: it says so."""
    ts = jnp.linspace(0.0, 3.0, 7)

    def end(rate, most):
        method = replace(KEEPING, max_steps=most, adjoint=stm.dynamics.DiscreteAdjoint(2))
        system = pendulum()
        found = stm.integrate(system, swung(system, 0.7, rate), ts, method)
        return found.states.r[-1, 0, 0], found

    found = end(1.0, 15)[1]
    total = int(found.counts.accepted[-1] + found.counts.rejected[-1])
    assert found.result == diffrax.RESULTS.successful
    assert total > 2 * (15 // 2 + 1 + 6)  # the record's windows of two attempts
    gradient, recorded = jax.grad(end, has_aux=True)(1.0, 15)
    assert recorded.result == diffrax.RESULTS.max_steps_reached
    assert np.isnan(gradient)
    gradient, recorded = jax.grad(end, has_aux=True)(1.0, total)
    assert recorded.result == diffrax.RESULTS.successful
    assert np.isfinite(gradient)


@pytest.mark.slow
def test_a_long_span_beside_many_short_ones():
    """64 output times, and thousands of step attempts before the last: forward mode."""
    ts = jnp.concatenate([jnp.linspace(0.0, 0.064, 64), jnp.array([10.0])])
    method = stm.Method(solver=diffrax.Heun(), rtol=1e-6, atol=1e-6, steps="state")

    def end(rate, how):
        system = pendulum()
        found = stm.integrate(system, swung(system, 0.7, rate), ts, how)
        return found.states.r[-1, 0, 0], found

    gradient, found = jax.jit(jax.grad(lambda rate: end(rate, method), has_aux=True))(1.0)
    attempts = np.diff(found.counts.accepted + found.counts.rejected)
    assert found.result == diffrax.RESULTS.successful
    assert 16_384 < attempts[-1] < 100_000
    ahead = replace(method, adjoint=diffrax.ForwardMode())
    _, expected = jax.jit(lambda x: jax.jvp(lambda x: end(x, ahead)[0], (x,), (1.0,)))(1.0)
    assert gradient == pytest.approx(float(expected), rel=1e-9)


@pytest.mark.slow
def test_in_diffrax_itself():
    """Elsewhere it is an adjoint like any other, with as many checkpoints."""
    term = diffrax.ODETerm(lambda t, y, k: -k * y)

    def end(k, adjoint):
        solution = diffrax.diffeqsolve(
            term, diffrax.Tsit5(), 0.0, 1.0, 0.1, jnp.ones(2), k, adjoint=adjoint, max_steps=64
        )
        return jnp.sum(jnp.asarray(solution.ys))

    found = jax.grad(end)(0.7, stm.dynamics.DiscreteAdjoint(recorded_steps=8))
    same = jax.grad(end)(0.7, diffrax.RecursiveCheckpointAdjoint(checkpoints=8))
    assert found == same
    with pytest.raises(stm.SettingError, match="at least one step attempt, not 0"):
        stm.dynamics.DiscreteAdjoint(recorded_steps=0)
