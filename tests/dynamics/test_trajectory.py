"""`integrate`: under jit, vmap and differentiation, and its events; on a pendulum."""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import central, pendulum, relative_error, swung
from scipy.integrate import solve_ivp

import stmuav_jax as stm

LENGTH, RTOL = 0.5, 1e-11
TS = jnp.asarray([0.0, 0.2, 0.5])
BATCH = jnp.asarray([[1.0, 2.0, 9.81], [-0.5, 1.5, 3.7], [4.0, 3.0, 9.0]])


def run(parameters, ts=TS, **more):
    """The pendulum from 0.7 rad by (initial rate, mass, gravity)."""
    rate, mass, gravity = parameters
    system = pendulum(length=LENGTH, mass=mass, gravity=gravity)
    method = stm.Method(rtol=RTOL, atol=RTOL, **more)
    return stm.integrate(system, swung(system, 0.7, rate), ts, method)


def loss_of(found):
    weights = jnp.asarray([1.0, 0.0, 2.0])
    return jnp.sum(found.states.r @ weights) + jnp.sum(found.states.omega[-1] ** 2)


def loss(parameters, **more):
    return loss_of(run(parameters, **more))


@pytest.fixture(scope="module")
def graded():
    """Value and gradient, compiled."""
    return jax.jit(jax.value_and_grad(loss))


# what the flights of the batch need is some 20 step attempts for an output time
FEW: dict[str, Any] = {"max_steps": 60}


@pytest.fixture(scope="module")
def of_batch():
    """Values and gradients of a batch, compiled."""
    return jax.jit(jax.vmap(jax.value_and_grad(lambda x: loss(x, **FEW))))


@pytest.fixture(scope="module")
def batched(of_batch):
    """Values and gradients of the batch."""
    return of_batch(BATCH)


def minimal(parameters, t, event=None):
    """The pendulum in its angle, by SciPy; moment of inertia m l^2 + 0.02."""
    rate, mass, gravity = parameters
    f = lambda t, x: [x[1], -mass * gravity * LENGTH * np.sin(x[0]) / (mass * LENGTH**2 + 0.02)]
    return solve_ivp(f, (0, t), [0.7, rate], method="DOP853", rtol=1e-13, atol=1e-14, events=event)


def test_values_under_jit_and_vmap(graded, batched):
    """10 times the tolerance; and the minimal-coordinate pendulum says the same."""
    for parameters, value in zip(BATCH, batched[0], strict=True):
        single = float(graded(parameters)[0])
        assert float(value) == pytest.approx(single, rel=10 * RTOL)
        ends = [np.array([0.7, 0.0]), *(minimal(parameters, float(t)).y[:, -1] for t in TS[1:])]
        expected = sum(-LENGTH * (np.sin(a) + 2 * np.cos(a)) for a, _ in ends) + ends[-1][1] ** 2
        assert single == pytest.approx(expected, abs=1e-8)


def test_gradients_of_a_batch_are_those_of_its_members(graded, batched):
    for parameters, gradient in zip(BATCH, batched[1], strict=True):
        assert relative_error(gradient, graded(parameters)[1]) < 1e-10


def test_a_failed_flight_is_not_a_number(of_batch, batched):
    """Nor is its gradient, so that a sum shows it; the others are as without it."""
    values, gradients = of_batch(BATCH.at[1, 1].set(jnp.nan))
    assert np.isnan(values[1])
    assert np.all(np.isnan(gradients[1]))
    for k in (0, 2):
        assert float(values[k]) == pytest.approx(float(batched[0][k]), rel=1e-12)
        assert relative_error(gradients[k], batched[1][k]) < 1e-10


def test_gradients_equal_finite_differences(graded):
    gradient = np.asarray(graded(BATCH[0])[1])
    for k, direction in enumerate(np.eye(3)):
        expected = central(lambda h, d=direction: graded(BATCH[0] + h * d)[0], 1e-3)
        assert abs(expected) > 1e-4
        assert gradient[k] == pytest.approx(float(expected), rel=1e-6)


@pytest.fixture(scope="module")
def forward():
    """Value, derivative along a direction, and the trajectory, compiled."""

    def along(x):
        found = run(x, adjoint=diffrax.ForwardMode(), **FEW)
        return loss_of(found), found

    return jax.jit(lambda x, d: jax.jvp(along, (x,), (d,), has_aux=True))


def test_forward_and_reverse_mode_agree(graded, forward):
    value, gradient = graded(BATCH[0])
    for k, direction in enumerate(np.eye(3)):
        same, rate, _ = forward(BATCH[0], jnp.asarray(direction))
        assert float(same) == pytest.approx(float(value), rel=1e-12)
        assert float(rate) == pytest.approx(float(gradient[k]), rel=1e-9)


def test_a_flight_that_stops_on_the_way_is_not_a_number(of_batch, batched, forward):
    """In both modes; what it has reached is kept, and the other flights are as without it."""
    fast = BATCH.at[1, 0].set(250.0)
    value, rate, found = forward(fast[1], jnp.eye(3)[0])
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert float(TS[1]) < float(found.ts[-1]) < float(TS[2])
    assert np.all(np.isfinite(found.states.r[:2]))
    assert np.all(np.isnan(found.states.r[2]))
    assert np.isnan(value)
    assert np.isnan(rate)
    values, gradients = of_batch(fast)
    assert np.isnan(values[1])
    assert np.all(np.isnan(gradients[1]))
    for k in (0, 2):
        assert float(values[k]) == pytest.approx(float(batched[0][k]), rel=1e-12)
        assert relative_error(gradients[k], batched[1][k]) < 1e-10


def test_an_event_stops_at_its_time_on_the_constraint():
    """The pendulum passes through x = 0 (from x < 0, at 0.7 rad) on its way down."""
    ts = jnp.asarray([0.0, 0.05, 1.0, 2.0])
    at_bottom = lambda t, state: state.r[0, 0]
    found = jax.jit(lambda x: run(x, ts, adjoint=diffrax.ForwardMode(), event=at_bottom))(BATCH[1])

    def bottom(t, x):
        return x[0]

    bottom.terminal = True  # pyright: ignore[reportFunctionMemberAccess]
    expected = minimal(np.asarray(BATCH[1]), 2.0, bottom)
    time = float(expected.t_events[0][0])
    assert found.result == diffrax.RESULTS.event_occurred
    np.testing.assert_allclose(found.ts, [0, 0.05, time, time], rtol=0, atol=1e-9)
    r, p = np.asarray(found.states.r[-1, 0]), np.asarray(found.states.p[-1, 0])
    np.testing.assert_allclose(r, [0, 0, -LENGTH], atol=1e-8)
    assert abs(np.linalg.norm(r) - LENGTH) < 1e-14
    assert abs(p @ p - 1) < 1e-15
    rate = expected.y_events[0][0][1]
    assert float(found.states.omega[-1, 0, 1]) == pytest.approx(rate, abs=1e-8)
    assert float(found.worst.position[-1]) < 1e-14


@pytest.mark.slow
def test_too_few_steps_are_a_result_not_an_error():
    found = jax.jit(lambda x: run(x, max_steps=3, adjoint=diffrax.ForwardMode()))(BATCH[0])
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert float(found.ts[-1]) < float(TS[1])
    assert int(found.counts.accepted[-1] + found.counts.rejected[-1]) <= 3


def test_states_of_another_size_are_refused():
    system = pendulum()
    two = jax.tree.map(lambda x: jnp.concatenate([x, x]), system.reference)
    with pytest.raises(stm.SettingError, match=r"State.r must have shape"):
        stm.integrate(system, two, TS)
