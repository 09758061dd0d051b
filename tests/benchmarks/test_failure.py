"""The failure benchmark: its NumPy model against the package, its integrators, its smoke test."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from dense.steps import Scheme, integrate
from dense.system import Dense
from dense.tables import Variant, g_and_l
from helpers import evaluated

import stmuav_jax as stm

MISPRINTS = [
    Variant(lost_dots=True),
    Variant(transposed_gamma=True),
    Variant(transposed_jacobian=True),
    Variant(shared_index=True),
]


@pytest.fixture(scope="module")
def moving():
    """Case 2 with a consistent state that moves in all coordinates."""
    scene = stm.make_scene("uav_tracker", 2)
    rng = np.random.default_rng(5)
    start = scene.state0
    # sliders off their zero: there d = 0, and half of the misprints would not show
    r = start.r.at[1, 2].add(4e-3).at[2, 2].add(-3e-3)
    v, omega = jnp.asarray(rng.normal(size=(2, 7, 3)))
    shaken = stm.State(r, start.p, v, omega)
    return dataclasses.replace(scene, state0=stm.assemble(scene.system, shaken).state)


def accelerations(scene, variant, t=0.1):
    model = Dense(scene, variant)
    q = model.accelerations(t, model.start(scene))
    L = g_and_l(np.asarray(scene.state0.p))[1]
    return q[:, :3], 2 * (L @ q[:, 3:, None])[..., 0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("variant", "couple"), [(Variant(), "consistent"), (Variant(frozen=True), "printed")]
)
def test_accelerations_are_those_of_the_package(moving, variant, couple):
    system = stm.make_scene("uav_tracker", 2, actuators=couple).system
    scene = dataclasses.replace(moving, system=system)
    want = evaluated(system, scene.state0, jnp.asarray(0.1)).accelerations
    v_rate, omega_rate = accelerations(scene, variant)
    assert np.max(np.abs(v_rate - want.v_rate)) <= 1e-10 * np.max(np.abs(want.v_rate))
    assert np.max(np.abs(omega_rate - want.omega_rate)) <= 1e-10 * np.max(np.abs(want.omega_rate))


@pytest.mark.parametrize("variant", MISPRINTS)
def test_misprints_change_the_accelerations(moving, variant):
    right, wrong = accelerations(moving, Variant())[0], accelerations(moving, variant)[0]
    assert np.max(np.abs(wrong - right)) > 1e-4 * np.max(np.abs(right))


@pytest.mark.parametrize(
    ("scheme", "error"),
    [
        (Scheme("ode45", 1e-8, 1e-10), 1e-6),
        (Scheme("rk4", step=1e-2), 1e-6),
    ],
    ids=lambda x: getattr(x, "method", ""),
)
def test_integrators_follow_an_oscillator(scheme, error):
    field = lambda t, y: np.array([y[1], -y[0], 0.0])
    times = np.linspace(0, 3, 31)
    history = integrate(field, np.array([1.0, 0.0, 0.0]), times, scheme)
    assert not history.failure
    # values between steps come from interpolants of lower order
    assert abs(history.states[-1, 0] - np.cos(3.0)) < error
    assert np.max(np.abs(history.states[:, 0] - np.cos(times))) < 100 * error
    assert abs(np.sum(history.sizes) - 3) < 1e-9


def test_every_run_ends():
    blow_up = lambda t, y: np.array([y[0] ** 2, 0.0])
    times = np.linspace(0, 2, 21)
    for scheme in (Scheme("ode45"), Scheme("rk4", step=0.01)):
        history = integrate(blow_up, np.array([1.0, 0.0]), times, scheme)
        assert history.failure
        assert 0.8 < history.stopped_at < 1.2
    few = integrate(lambda t, y: -y, np.ones(2), times, Scheme("ode45"), 8)
    assert few.failure == "8 evaluations"
