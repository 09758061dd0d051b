"""`integrate`: under jit, vmap and differentiation, and its events; on a pendulum."""

import re
from typing import Any

import diffrax
import equinox as eqx
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


# what the flights of the batch need is some 20 step attempts for an output time
FEW: dict[str, Any] = {"max_steps": 60}


@pytest.fixture(scope="module")
def of_batch():
    """Values and gradients of a batch, compiled."""
    return jax.jit(jax.vmap(jax.value_and_grad(lambda x: loss_of(run(x, **FEW)))))


@pytest.fixture(scope="module")
def batched(of_batch):
    """Values and gradients of the batch."""
    return of_batch(BATCH)


@pytest.fixture(scope="module")
def forward():
    """Value, derivative along a direction, and the trajectory, compiled."""

    def along(x):
        found = run(x, adjoint=diffrax.ForwardMode(), **FEW)
        return loss_of(found), found

    return jax.jit(lambda x, d: jax.jvp(along, (x,), (d,), has_aux=True))


def minimal(parameters, t, event=None):
    """The pendulum in its angle, by SciPy; moment of inertia m l^2 + 0.02."""
    rate, mass, gravity = parameters
    f = lambda t, x: [x[1], -mass * gravity * LENGTH * np.sin(x[0]) / (mass * LENGTH**2 + 0.02)]
    return solve_ivp(f, (0, t), [0.7, rate], method="DOP853", rtol=1e-13, atol=1e-14, events=event)


@pytest.mark.slow
def test_values_under_jit_and_vmap(batched):
    """The minimal-coordinate pendulum says the same."""
    for parameters, value in zip(BATCH, batched[0], strict=True):
        ends = [np.array([0.7, 0.0]), *(minimal(parameters, float(t)).y[:, -1] for t in TS[1:])]
        expected = sum(-LENGTH * (np.sin(a) + 2 * np.cos(a)) for a, _ in ends) + ends[-1][1] ** 2
        assert float(value) == pytest.approx(expected, abs=1e-8)


@pytest.mark.slow
def test_a_batch_in_reverse_is_its_members_in_forward_mode(batched, forward):
    """Values to 10 times the tolerance."""
    for parameters, value, gradient in zip(BATCH, *batched, strict=True):
        for k, direction in enumerate(jnp.eye(3)):
            same, rate, _ = forward(parameters, direction)
            assert float(value) == pytest.approx(float(same), rel=10 * RTOL)
            assert float(rate) == pytest.approx(float(gradient[k]), rel=1e-9)


@pytest.mark.slow
def test_gradients_equal_finite_differences(batched, forward):
    for k, direction in enumerate(jnp.eye(3)):
        value = lambda h, d=direction: forward(BATCH[0] + h * d, d)[0]
        expected = central(value, 1e-3)
        assert abs(expected) > 1e-4
        assert float(batched[1][0, k]) == pytest.approx(float(expected), rel=1e-6)


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


@pytest.mark.slow
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


def test_states_of_another_size_are_refused():
    system = pendulum()
    two = jax.tree.map(lambda x: jnp.concatenate([x, x]), system.reference)
    with pytest.raises(stm.SettingError, match=r"State.r must have shape"):
        stm.integrate(system, two, TS)


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()], ids=str)
def test_masses_that_are_none_are_flagged_and_leave_the_others_alone(formulation):
    """A batch over a mass with 0, -1 kg and NaN: no motion there, and the others to the last bit."""
    method = stm.Method(formulation=formulation, adjoint=diffrax.ForwardMode())
    at = lambda mass: run((1.0, mass, 9.81), formulation=formulation, adjoint=method.adjoint)
    batch = jax.jit(jax.vmap(at))
    good, bad = (
        batch(jnp.asarray([2.0, *middle, 3.0]))
        for middle in ([0.5, 0.6, 0.7], [0.0, -1.0, float("nan")])
    )
    for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
        np.testing.assert_array_equal(a[jnp.array([0, 4])], b[jnp.array([0, 4])])
    assert np.all(good.result == diffrax.RESULTS.successful)
    for k, mass in ((1, 0.0), (2, -1.0)):
        member = jax.tree.map(lambda x, k=k: x[k], bad)
        assert member.result != diffrax.RESULTS.successful
        assert np.all(np.isnan(member.states.r[1:]))
        assert np.all(member.ts == TS[0])
        system = eqx.tree_at(lambda s: s.bodies.mass, pendulum(), jnp.asarray([mass]))
        words = stm.dynamics.describe_result(system, member)
        assert re.search(r"mass of body '\w+' must be finite and positive, but it is", words)
        with pytest.raises(stm.ModelError, match="must be finite and positive"):
            stm.simulate(system, swung(system, 0.7), t1=0.1)


@pytest.mark.slow
def test_output_times_may_go_back():
    """To 0.5 s and back to 0.2 s and the start, as a run that goes straight there."""
    through = jax.jit(lambda ts: run((1.0, 2.0, 9.81), ts, adjoint=diffrax.ForwardMode()))
    back, on = (through(jnp.asarray(ts)) for ts in ([0.0, 0.5, 0.2, 0.0], [0.0, 0.2, 0.4, 0.5]))
    assert back.result == diffrax.RESULTS.successful
    # both within a few tolerances
    np.testing.assert_allclose(back.states.r[1:3], on.states.r[np.array([3, 1])], atol=100 * RTOL)
    np.testing.assert_allclose(back.states.r[3], back.states.r[0], atol=100 * RTOL)
    with pytest.raises(
        stm.SettingError, match="times must increase with a method that has an event"
    ):
        run((1.0, 2.0, 9.81), jnp.asarray([0.0, 0.5, 0.2]), event=lambda t, state: state.r[0, 2])


def test_a_time_that_is_no_number_ends_the_values():
    """A known one is refused; nothing after a traced one is a value."""
    times = jnp.asarray([0.0, 0.2, jnp.nan, 0.5])
    with pytest.raises(stm.SettingError, match="output times ts must be a list of finite numbers"):
        run((1.0, 2.0, 9.81), times)
    found = jax.jit(lambda ts: run((1.0, 2.0, 9.81), ts, adjoint=diffrax.ForwardMode()))(times)
    assert np.all(np.isfinite(found.states.r[:2]))
    assert np.all(np.isnan(found.states.r[2:]))


@pytest.mark.slow
@pytest.mark.parametrize("formulation", [stm.Tree(), stm.Augmented()])
def test_a_welded_body_stays_where_it_is(formulation):
    """No coordinate is left: nothing moves, and steps have no error."""
    block = stm.Body("block", 10.0, [1.0, 1.0, 1.5], position=[0.5, 0.0, 0.0])
    system = stm.System([block], [stm.weld("foot", "ground", "block")], [stm.Gravity()])
    method = stm.Method(formulation=formulation)
    path = stm.integrate(system, system.reference, jnp.asarray([0.0, 1.0]), method)
    result = stm.simulate(system, system.reference, ts=[0.0, 1.0], method=method)
    for states in (path.states, result.states):
        np.testing.assert_allclose(states.r[-1], [[0.5, 0.0, 0.0]], atol=1e-12)
    weight = np.asarray(stm.dynamics.run_loads(result).force)[-1]
    np.testing.assert_allclose(weight, [[0.0, 0.0, 98.1]], atol=1e-9)


def push(t):
    """A moment that depends on time [N m], not evenly."""
    return 0.8 * jnp.sin(3.0 * t) + t


BACK = jnp.array([0.2, 0.5, 1.7])


def there_and_back(rate, solver):
    """States of a pushed pendulum at three times, and those on the way back from the last of them."""
    system = pendulum(length=LENGTH, forces=(stm.JointEffort("hinge", push),))
    method = stm.Method(solver=solver, rtol=1e-9, atol=1e-9)
    ahead = stm.integrate(system, swung(system, 1.1, rate), BACK, method).states
    end = jax.tree.map(lambda x: x[-1], ahead)
    return ahead, stm.integrate(system, end, BACK[::-1], method).states


@pytest.mark.slow
@pytest.mark.parametrize("solver", [diffrax.Dopri8(), stm.dynamics.kvaerno5()])
def test_a_motion_goes_back_in_time(solver):
    """To where it came from, by forces that depend on time; so do derivatives in reverse mode."""

    def last(rate):
        ahead, back = there_and_back(rate, solver)
        return back.omega[-1, 0, 1], (ahead, back)

    slope, (ahead, back) = jax.jit(jax.grad(last, has_aux=True))(-0.3)
    for a, b in zip(jax.tree.leaves(ahead), jax.tree.leaves(back), strict=True):
        np.testing.assert_allclose(b[::-1], a, rtol=0, atol=2e-8)
    assert slope == pytest.approx(1.0, abs=1e-6)


def test_a_motion_that_stops_on_the_way_back_is_not_a_number():
    """Nor is one that stops on the way ahead, see above."""
    system = pendulum(length=LENGTH)
    method = stm.Method(rtol=RTOL, atol=RTOL, max_steps=2)
    found = stm.integrate(system, swung(system, 0.7, 4.0), TS[::-1], method)
    assert found.result == diffrax.RESULTS.max_steps_reached
    assert float(TS[1]) < float(found.ts[-1]) < float(TS[2])
    assert np.all(np.isfinite(found.states.r[0]))
    assert np.all(np.isnan(found.states.r[1:]))


@pytest.mark.slow
def test_a_driver_goes_back_in_time():
    """A joint with a prescribed motion stands where the motion was at that time."""
    angle = lambda t: 0.5 * jnp.sin(3 * t) + 0.2 * t**2
    hinge = pendulum(length=LENGTH).joints[0]
    low = stm.Body("low", 1.0, (0.02, 0.02, 0.01), position=(0, 0, -1.0))
    knee = stm.revolute("knee", "bob", "low", point=(0, 0, -0.8), axis=(0, 1, 0))
    bob = stm.Body("bob", 2.0, (0.02, 0.02, 0.01), position=(0, 0, -LENGTH))
    motor = stm.drive("motor", hinge, angle, coordinate="angle")
    system = stm.System([bob, low], [hinge, knee, motor], [stm.Gravity()])
    method = stm.Method(rtol=1e-9, atol=1e-9)
    start = stm.assemble(system, system.reference).state
    ahead = stm.integrate(system, start, TS, method).states
    back = stm.integrate(system, jax.tree.map(lambda x: x[-1], ahead), TS[::-1], method).states
    np.testing.assert_allclose(
        2 * jnp.atan2(back.p[:, 0, 2], back.p[:, 0, 0]), angle(TS[::-1]), atol=1e-9
    )
    np.testing.assert_allclose(back.r[::-1], ahead.r, atol=1e-8)
