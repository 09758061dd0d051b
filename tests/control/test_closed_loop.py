"""Closed loops against closed forms: held inputs, delays, rates, gradients, failures."""

import sys
from pathlib import Path
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit

sys.path.insert(0, str(Path(__file__).parents[1] / "analysis"))
from mechanisms import cart_pole  # pyright: ignore[reportMissingImports]

control, sensing = stm.control, stm.analysis

MASS, STIFFNESS, DAMPING, RATE = 2.0, 50.0, 1.5, 200.0
GAIN = np.array([30.0, 6.0])
START = np.array([0.1, -0.2])
# steps of order 4 in a period of 5 ms at 5 rad/s: (5 rad/s 5 ms)^5 / 120 = 8e-11 a step
HELD = 1e-9


def spring_mass(damping=DAMPING):
    """A mass on a rail along x with a spring, a damper [N s/m] and a driving force."""
    mass = stm.Body("mass", MASS, np.eye(3) * 0.1)
    rail = stm.translational("rail", "ground", "mass", point=[0.0] * 3, axis=[1.0, 0.0, 0.0])
    spring = stm.mechanics.JointServo("rail", target=0.0, stiffness=STIFFNESS, damping=damping)
    system = stm.System([mass], [rail], [spring, stm.JointEffort("rail", 0.0)])
    return system, stm.state_from_joints(system, {"rail": START[0]}, {"rail": START[1]})


def position_feedback(estimate, reference, memory):
    """A state feedback of the mass about a reference."""
    x = jnp.stack([estimate.r[0, 0], estimate.v[0, 0]])
    return -jnp.asarray(GAIN) @ (x - reference)[:, None], memory


def by_hand(samples, late, reference, damping=DAMPING, rate=RATE):
    """Positions, rates and commands of the exact sampled system, late by whole samples."""
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -damping / MASS]])
    A_d, B_d = control.held_matrices(A, np.array([[0.0], [1 / MASS]]), 1 / rate)
    x, queue, rows = START.copy(), [0.0] * late, []
    for k in range(samples):
        u = float(-GAIN @ (x - reference(k / rate)))
        rows.append([*x, u])
        queue.append(u)
        x = A_d @ x + B_d[:, 0] * queue.pop(0)
    return np.array(rows)


def wanted(t):
    return jnp.stack([0.05 * jnp.sin(3.0 * t), 0.15 * jnp.cos(3.0 * t)])


@pytest.mark.slow
@pytest.mark.parametrize("steps", [1, None])
def test_a_loop_is_the_exact_sampled_system(steps):
    """A spring's mass under a delayed feedback, by the matrix exponential."""
    (system, start), late = spring_mass(), 3
    plant = control.Plant(
        system, start, rate=RATE, inputs=["effort"], delay=late / RATE, steps=steps
    )
    run = control.close_loop(plant, position_feedback, 0.5, reference=wanted)
    exact = by_hand(101, late, lambda t: np.asarray(wanted(t)))
    tolerance = HELD if steps else 1e-7
    np.testing.assert_allclose(run.states.r[:, 0, 0], exact[:, 0], atol=tolerance)
    np.testing.assert_allclose(run.states.v[:, 0, 0], exact[:, 1], atol=20 * tolerance)
    np.testing.assert_allclose(run.input("effort"), exact[:, 2], atol=200 * tolerance)
    assert run.successful
    assert run.certificate.energy_error < 1e-6
    np.testing.assert_allclose(run.ts, np.arange(101) / RATE, atol=1e-14)


def stiff_loop(method=None, steps=None):
    """Of a damper of 1e5 N s/m: its mode decays in 20 us, a thousandth of a period."""
    plant = control.Plant(
        *spring_mass(1e5), rate=50.0, inputs=["effort"], method=method, steps=steps
    )
    return control.close_loop(
        plant, position_feedback, 0.6, reference=lambda t: jnp.zeros(2), balances=False, throw=False
    )


TIGHT = {"rtol": HELD, "atol": HELD, "steps": "state"}


@pytest.mark.slow
def test_an_implicit_loop_is_the_exact_sampled_system():
    run = stiff_loop(stm.Method(solver=stm.dynamics.kvaerno5(), **TIGHT))
    exact = by_hand(31, 0, lambda t: np.zeros(2), 1e5, 50.0)
    assert run.successful
    np.testing.assert_allclose(run.states.r[:, 0, 0], exact[:, 0], atol=HELD)
    np.testing.assert_allclose(run.states.v[1:, 0, 0], exact[1:, 1], atol=HELD)


def test_fixed_steps_of_the_default_method_are_too_long_for_a_stiff_loop():
    """Four steps of order 4 in a period of 20 ms: the loop says that its motion is no longer finite."""
    run = stiff_loop(steps=4)
    assert not run.successful
    assert "its steps are too long" in run.failure


@pytest.mark.slow
def test_adaptive_steps_are_safe_for_derivatives_unless_told_otherwise():
    """At rest, where the state has no error: by the held input, as the matrix exponential has it."""
    system, _ = spring_mass()

    def plant(number, **how):
        method = stm.Method(**how) if how else None
        return control.Plant(system, rate=0.5, inputs=["effort"], method=method, steps=number)

    ahead = plant(None, adjoint=diffrax.ForwardMode())

    def moved(u):
        step = lambda now, _: (ahead.step(now, u), None)
        return jax.lax.scan(step, ahead.reset(), None, 2)[0].state.r[0, 0]

    _, slope = jax.jit(lambda u: jax.jvp(moved, (u,), (jnp.ones(1),)))(jnp.zeros(1))
    A = np.array([[0.0, 1.0], [-STIFFNESS / MASS, -DAMPING / MASS]])
    _, exact = control.held_matrices(A, np.array([[0.0], [1 / MASS]]), 4.0)
    np.testing.assert_allclose(slope, exact[0, 0], rtol=1e-6)
    chosen = lambda of: of.motion.problem.method.steps
    assert [chosen(ahead), chosen(plant(None))] == ["sensitivities"] * 2
    assert chosen(plant(None, steps="state")) == "state"
    # nothing could bound steps of a fixed length
    assert chosen(plant(2)) == "state"


@pytest.fixture(scope="module")
def cart():
    """A cart-pole's space, its upright posture, its regulator and a start off it."""
    system = cart_pole()
    space = stm.TreeSpace(system)
    x = space.from_state(system.reference)
    inputs = stm.inputs_of(system)
    linear = stm.linearize(space, x, inputs, [0.0])
    found = control.regulator(linear, [10.0, 10.0, 1.0, 1.0], [0.1], rate=100.0)
    feedback = control.StateFeedback(space, x, [0.0], found)
    start = stm.state_from_joints(system, {"rail": 0.3, "hinge": 0.15}, {})
    return system, space, linear, feedback, start


@pytest.mark.slow
def test_a_regulator_balances_a_cart_pole(cart):
    """Two solutions of the Riccati equation agree, and the nonlinear pole comes to rest."""
    system, _, _, feedback, start = cart
    plant = control.Plant(system, start, rate=100.0, steps=2)
    run = control.close_loop(plant, feedback, 8.0)
    end = run.states.r[-1]
    assert np.max(np.abs(end[:, 0])) < 2e-3
    assert run.certificate.relative_energy_error < 1e-6
    assert run.certificate.position_violation < 1e-9
    assert run.certificate.steps == 1600


def cost(plant, feedback, samples=101):
    """Mean square of the cart-pole's height lost and of its force, over 1 s."""
    found = control.rollout(plant, feedback, samples)
    return jnp.mean(found.states.r[:, 0, 0] ** 2) + 1e-4 * jnp.mean(found.inputs**2)


@pytest.mark.slow
def test_gradients_of_a_closed_loop(cart):
    """By gains and by a mass, through 1 s: against converged differences, 1e-5 relative."""
    _, space, _, feedback, start = cart

    def of(bob, K):
        plant = control.Plant(cart_pole(bob=bob), start, rate=100.0)
        loop = control.StateFeedback(space, feedback.point, [0.0], K)
        return cost(plant, loop)

    K = feedback.K
    at = quick_jit(of)
    by_bob, by_K = quick_jit(jax.grad(of, argnums=(0, 1)))(jnp.asarray(0.5), K)
    side = jax.random.normal(jax.random.key(2), K.shape) * K

    def difference(f, h):
        return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)

    bob = difference(lambda h: at(jnp.asarray(0.5 + h), K), 1e-3)
    gains = difference(lambda h: at(jnp.asarray(0.5), K + h * side), 1e-3)
    assert float(by_bob) == pytest.approx(float(bob), rel=1e-5)
    assert float(jnp.sum(by_K * side)) == pytest.approx(float(gains), rel=1e-5)


@pytest.mark.slow
def test_a_batch_is_its_single_loops(cart):
    """`rollout`, vmapped over starts, against `reset` and `step` of one after the other."""
    system, _, _, feedback, _ = cart
    plant = control.Plant(system, rate=100.0)
    angles = [0.05, -0.1]
    starts = [stm.state_from_joints(system, {"hinge": a}, {}) for a in angles]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *starts)

    def flown(state):
        return control.rollout(plant, feedback, 50, start=plant.reset(state0=state)).states.r

    def stepped(state):
        now = plant.reset(state0=state)
        for _ in range(2):
            now = plant.step(now, feedback(now.estimate, None, None)[0])
        return now.state.r

    one, many = quick_jit(stepped), quick_jit(jax.vmap(flown))(stacked)
    for k, state in enumerate(starts):
        np.testing.assert_allclose(many[k, 2], one(state), atol=1e-13)


def test_sensors_read_at_their_own_rates():
    """Readings come every third and every period, late by their delays, with their noise."""
    system, start = spring_mass()
    encoder = control.Instrument(sensing.Encoder("rail"), rate=RATE / 4, delay=2 / RATE)
    fix = control.Instrument(sensing.PositionFix("mass"), noise=[0.01, 0.0, 0.0], bias=0.5)
    felt = sensing.Accelerometer("mass")
    plant = control.Plant(system, start, rate=RATE, inputs=["effort"], sensors=[encoder, fix, felt])
    seen = {
        "encoder": lambda s: s.readings["encoder rail"].value[0],
        "fresh": lambda s: s.readings["encoder rail"].fresh,
        "fix": lambda s: s.estimate["position mass"],
        "felt": lambda s: s.estimate["accelerometer mass"][0],
    }
    pushing = lambda e, r, m: (jnp.array([2.0]), m)
    run = control.close_loop(plant, pushing, 400 / RATE, signals=seen, key=jax.random.key(3))
    x, v = run.states.r[:, 0, 0], run.states.v[:, 0, 0]
    k = np.arange(401)
    arrived = k >= 2
    np.testing.assert_array_equal(run.signal("fresh"), (k % 4 == 2) & arrived)
    np.testing.assert_allclose(run.signal("encoder")[2:], x[(k[2:] - 2) // 4 * 4], atol=1e-14)
    # held forces, the spring's and the damper's; at the start the force is still zero
    force = (np.where(k > 0, 2.0, 0.0) - STIFFNESS * x - DAMPING * v) / MASS
    np.testing.assert_allclose(run.signal("felt"), force, atol=1e-10)
    error = run.signal("fix") - run.states.r[:, 0] - 0.5
    assert np.all(np.abs(error[:, 1:]) < 1e-14)
    # 401 draws: mean and standard deviation within five of their standard errors
    assert abs(np.mean(error[:, 0])) < 5 * 0.01 / 20
    assert abs(np.std(error[:, 0]) / 0.01 - 1) < 5 / np.sqrt(2 * 400)
    assert len(np.unique(error[:, 0])) == 401


def test_an_estimator_keeps_its_memory():
    """A mean of all readings so far, from the start on."""
    system, start = spring_mass()

    def mean(readings, inputs, memory):
        count, total = memory
        total = total + readings["encoder rail"].value
        return total / (count + 1), (count + 1, total)

    plant = control.Plant(
        system, start, rate=RATE, inputs=["effort"], sensors=[sensing.Encoder("rail")],
        estimator=mean, memory=(0.0, np.zeros(1)),
    )  # fmt: skip
    run = control.close_loop(
        plant, lambda e, r, m: (0.0 * e, m), 0.05, signals={"mean": lambda s: s.estimate[0]}
    )
    x = run.states.r[:, 0, 0]
    np.testing.assert_allclose(run.signal("mean"), np.cumsum(x) / np.arange(1, 12), atol=1e-14)


def test_what_cannot_be_sampled_is_refused():
    system, start = spring_mass()
    with pytest.raises(stm.SettingError, match=r"noise of the sensor .* must not be negative"):
        control.Instrument(sensing.PositionFix("mass"), noise=[0.01, -0.01, 0.0])
    fast = control.Instrument(sensing.Encoder("rail"), rate=150.0)
    with pytest.raises(stm.SettingError, match=r"150 Hz, which does not divide .* 400 Hz"):
        control.Plant(system, start, inputs=["effort"], sensors=[fast])
    with pytest.raises(stm.SettingError, match=r"The delay of the inputs .* 1\.2 periods"):
        control.Plant(system, start, inputs=["effort"], delay=3e-3)
    with pytest.raises(stm.SettingError, match="whole number from 1"):
        control.Plant(system, start, inputs=["effort"], steps=0)
    with pytest.raises(stm.SettingError, match="must be positive and finite"):
        control.Plant(system, start, inputs=["effort"], rate=0.0)
    with pytest.raises(stm.ModelError, match="inputs before the first command"):
        control.Plant(system, start, inputs=["effort"], before=[1.0, 2.0])


def test_controllers_that_fail_say_when_and_where():
    """A wrong shape, a memory that grows, and a number that is not finite from a time on."""
    system, start = spring_mass()
    plant = control.Plant(system, start, rate=RATE, inputs=["effort"])
    with pytest.raises(
        stm.SettingError, match=r"1 inputs.* effort.* shape \(2,\).*Plant\(\.\.\., inputs="
    ):
        control.close_loop(plant, lambda e, r, m: (jnp.zeros(2), m), 0.1)
    with pytest.raises(stm.SettingError, match="must return a pair"):
        control.close_loop(plant, lambda e, r, m: jnp.zeros(1), 0.1)
    grown = lambda e, r, m: (jnp.zeros(1), jnp.concatenate([m, m]))
    with pytest.raises(stm.SettingError, match=r"one of shape \(1,\) became \(2,\)"):
        control.close_loop(plant, grown, 0.1, memory=jnp.zeros(1))

    def breaks(estimate, reference, memory):
        return jnp.where(memory < 7, 1.0, jnp.nan)[None], memory + 1

    with pytest.raises(stm.SimulationError, match=r"nan for the input 'effort' .* t = 0\.035") as e:
        control.close_loop(plant, breaks, 0.1, memory=0)
    run: Any = e.value.run
    assert run.certificate.t_end == pytest.approx(0.03)
    assert run.certificate.result == "inputs not finite"
    assert np.all(np.isfinite(run.states.r[:8]))
    assert np.all(np.isnan(run.states.r[8:]))
