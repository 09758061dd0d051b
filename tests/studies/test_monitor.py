"""Extremes and crossings between steps, against functions whose own are known."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax.dynamics.integration.lanes import (
    Span,
    cubic_peak,
    follow_parts,
    follow_step,
    hermite_cubic,
    highest_value,
    start_monitor,
)

RNG = np.random.default_rng(5)


def watched(f, ts):
    """The monitor after steps to each of ts, of signals f with exact rates."""
    rate = jax.jacfwd(f)
    ts = jnp.asarray(ts)
    step = jax.jit(lambda monitor, t0, t1: follow_step(monitor, t0, t1, f(t1), rate(t1)))
    monitor = start_monitor(ts[0], f(ts[0]), rate(ts[0]))
    for t0, t1 in itertools.pairwise(ts):
        monitor = step(monitor, t0, t1)
    return monitor


def test_a_cubic_is_met_exactly():
    coefficients = RNG.normal(size=(50, 4))
    f = lambda t: jnp.asarray(coefficients) @ jnp.stack([t**0, t, t**2, t**3])
    rate = jax.jacfwd(f)
    t0, t1 = jnp.asarray(-0.3), jnp.asarray(0.9)
    span = Span(t0, t1, f(t0), f(t1), rate(t0), rate(t1))
    fine = np.linspace(-0.3, 0.9, 20_001)
    values = np.polynomial.polynomial.polyval(fine, coefficients.T)
    top = np.asarray(highest_value(span))
    assert np.all(top >= values.max(axis=1) - 1e-12)
    assert np.max(top - values.max(axis=1)) < 1e-6
    inside = values.argmax(axis=1)
    s = np.asarray(cubic_peak(hermite_cubic(span)))
    interior = (inside > 0) & (inside < 20_000)
    assert interior.sum() > 10
    assert np.max(np.abs(-0.3 + 1.2 * s - fine[inside])[interior]) < 1e-3


def test_peaks_and_crossings_of_sines():
    """Of fourth order in the step."""
    count, phases = 20, jnp.asarray([0.3, 1.0, 2.6])
    f = lambda t: jnp.sin(t + phases) - 0.7
    monitor = watched(f, np.linspace(0.0, 6.0, count + 1))
    bound = (6.0 / count) ** 4 / 384
    assert np.max(np.abs(np.asarray(monitor.extreme) - 0.3)) < 1.2 * bound
    exact = (np.arcsin(0.7) - np.asarray(phases)) % (2 * np.pi)
    exact[1] = 0.0  # above from the start on
    assert np.sin(1.0) > 0.7 > np.sin(0.3)
    slope = np.cos(np.arcsin(0.7))
    assert np.max(np.abs(np.asarray(monitor.crossings.times()) - exact)) < 1.5 * bound / slope


def test_a_crossing_within_a_step_is_seen():
    """Up and down again between two steps that both lie below."""
    f = lambda t: jnp.stack([0.2 - (t - 0.5) ** 2])
    monitor = watched(f, [0.0, 1.0])
    assert monitor.crossings.times()[0] == pytest.approx(0.5 - np.sqrt(0.2), abs=1e-12)
    assert monitor.extreme[0] == pytest.approx(0.2, abs=1e-12)


def test_the_largest_value_can_be_differentiated_with_and_without_a_peak():
    """Reverse mode too, where the cubic has no extreme at all and its formula no root."""
    one = jnp.ones(1)
    top = lambda x: highest_value(Span(jnp.zeros(()), jnp.ones(()), *(v * one for v in x)))[0]
    top_of, gradient_of = jax.jit(top), jax.jit(jax.grad(top))
    for x in ([0.0, 1.0, 1.0, 1.0], [0.0, 1.0, 3.0, 0.5], [0.0, 0.2, 1.0, -1.0], [0.0] * 3 + [1.0]):
        x = jnp.asarray(x)
        gradient = gradient_of(x)
        expected = [(top_of(x + h) - top_of(x - h)) / 2e-6 for h in 1e-6 * jnp.eye(4)]
        if float(x[1]) == 0:  # level: no derivative by differences, but finite
            assert np.all(np.isfinite(gradient))
        else:
            np.testing.assert_allclose(gradient, expected, atol=1e-8)


def test_signals_without_rates_are_watched_within_steps():
    """States of an oscillator, a signal of them: as close as the cubic of the states, h^4 / 384."""
    state = lambda t: jnp.stack([jnp.sin(t), jnp.cos(t)])
    slope = lambda t: jnp.stack([jnp.cos(t), -jnp.sin(t)])
    phases = jnp.asarray([0.3, 1.0, 2.6])
    signals = lambda t, y: y[0] * jnp.cos(phases) + y[1] * jnp.sin(phases) - 0.7
    count = 10
    ts = jnp.linspace(0.0, 6.0, count + 1)
    first = signals(ts[0], state(ts[0]))
    monitor = start_monitor(ts[0], first, jnp.zeros(3))
    span = lambda t0, t1: Span(t0, t1, state(t0), state(t1), slope(t0), slope(t1))
    step = jax.jit(lambda monitor, t0, t1: follow_parts(monitor, span(t0, t1), signals))
    for t0, t1 in itertools.pairwise(ts):
        monitor = step(monitor, t0, t1)
    bound = 2 * (6.0 / count) ** 4 / 384
    assert np.max(np.abs(np.asarray(monitor.extreme) - 0.3)) < bound
    exact = (np.arcsin(0.7) - np.asarray(phases)) % (2 * np.pi)
    exact[1] = 0.0
    slope_there = np.cos(np.arcsin(0.7))
    assert np.max(np.abs(np.asarray(monitor.crossings.times()) - exact)) < bound / slope_there
    assert np.array_equal(monitor.g, signals(ts[-1], state(ts[-1])))
    # a step that was not taken changes nothing
    again = step(monitor, ts[-1], ts[-1])
    assert np.array_equal(again.extreme, monitor.extreme)
    assert np.array_equal(again.crossings.times(), monitor.crossings.times())
