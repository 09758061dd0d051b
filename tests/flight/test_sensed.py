"""The estimator on the seven-body UAV: sensors of the full dynamics, centre of mass online."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.estimation.consistency import mean_interval
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.online import OnlineFilter
from stmuav_jax.flight.sensed import centre_of_mass, inertia_about_centre, sensed_flight
from stmuav_jax.quadrotor.rotorcraft import moving_part_inputs, rotorcraft_model

GYROSCOPE, ACCELEROMETER = 1e-3, 0.05  # standard deviations [rad/s], [m/s^2]


def scene(strokes):
    return stm.make_scene("uav_tracker", 1, strokes=strokes)


def machine(made, flight, **more):
    """The model, with inertia and height of the first posture."""
    rotors = next(f for f in made.system.forces if isinstance(f, stm.rotorcraft.Rotors))
    return rotorcraft_model(
        rotors,
        inertia_about_centre(made.system, made.state0),
        jnp.sum(made.system.bodies.mass),
        height=flight.centre_of_mass[0, 2],
        **more,
    )


NOISE = {"Q": [1e-8] * 3 + [4e-9] * 2, "R": [GYROSCOPE**2] * 3 + [ACCELEROMETER**2] * 3}


@pytest.fixture(scope="module")
def held():
    """0.2 s with the tracker held still, thrown a little at the start."""
    still = lambda t: 0.0 * t
    made = scene((still, still))
    start = made.state0
    omega = jnp.array([0.2, -0.3, 0.1])
    start = stm.State(
        start.r, start.p, start.v + jnp.cross(omega, start.r - start.r[0]),
        start.omega + jnp.einsum("nji,j->ni", jax.vmap(stm.rotation.rotation_matrix)(start.p), omega),
    )  # fmt: skip
    return made, sensed_flight(made.system, start, t1=0.2)


@pytest.mark.slow
def test_held_tracker_is_one_rigid_body(held):
    """Rates and specific force of seven bodies in loops against one body with the same centre of
    mass and inertia."""
    made, flight = held
    model = machine(made, flight, **NOISE)
    c = flight.centre_of_mass[0, :2]
    assert np.ptp(np.asarray(flight.centre_of_mass), axis=0).max() < 1e-12
    before = jnp.concatenate([flight.omega[:-1].T, jnp.broadcast_to(c[:, None], (2, 40))])
    after = jax.jit(lambda x, u: model(x, u, 5e-3))(before, flight.speed_squared.T)
    # RK4's error of a step of 5 ms at 0.4 rad/s
    np.testing.assert_allclose(after[:3].T, flight.omega[1:], rtol=0, atol=1e-8)
    now = jnp.concatenate([flight.omega[1:].T, jnp.broadcast_to(c[:, None], (2, 40))])
    seen = model.sensor(now, flight.speed_squared.T)
    np.testing.assert_allclose(seen[3:].T, flight.force, rtol=0, atol=1e-8)
    assert np.max(np.abs(flight.omega[0])) > 0.2
    assert flight.residual < 1e-12


@pytest.fixture(scope="module")
def moving():
    """1.2 s; strokes of 60 and 80 mm there and back."""
    made = scene((
        lambda t: 0.03 * (1 - jnp.cos(jnp.pi * t)),
        lambda t: 0.04 * (1 - jnp.cos(1.5 * jnp.pi * t)),
    ))  # fmt: skip
    return made, sensed_flight(made.system, made.state0, t1=1.2)


@pytest.mark.slow
def test_it_flies(moving):
    made, flight = moving
    assert flight.residual < 1e-12
    assert np.max(np.abs(flight.omega)) < 0.3
    tilt = 2 * np.arcsin(np.linalg.norm(np.asarray(flight.p)[:, 1:3], axis=1))
    assert np.degrees(tilt.max()) < 5
    # what there is to find: the centre of mass moves by millimetres
    assert np.ptp(np.asarray(flight.centre_of_mass)[:, 1]) > 2e-3
    np.testing.assert_allclose(
        flight.centre_of_mass[0], centre_of_mass(made.system, made.state0), rtol=0, atol=1e-15
    )


def online(made, flight, inputs, sensors=6):
    """Errors of the centre of mass (T, 2) [m] and NIS, one sample at a time, from 5 cm wrong."""
    rng = np.random.default_rng(0)
    count = len(flight.speed_squared)
    noise = rng.normal(size=(count, 6)) * np.sqrt(NOISE["R"])
    y = np.concatenate([flight.omega[1:], flight.force], axis=1) + noise
    prior = gaussian([0.0, 0.0, 0.0, 0.05, -0.05], np.diag([0.1, 0.1, 0.1, 0.05, 0.05]) ** 2)
    # the accelerometer's equation has no terms for parts that move
    R = NOISE["R"][:sensors]
    now = OnlineFilter(machine(made, flight, Q=NOISE["Q"], R=R), prior)
    at = lambda k: jax.tree.map(lambda a: np.asarray(a[k]), inputs)
    now.warm_up(at(0))
    found = []
    for k in range(count):
        found.append(
            np.asarray(now.step(y[k, :sensors], float(flight.t[k + 1]), at(k)).state.mean[3:])
        )
    return np.array(found) - np.asarray(flight.centre_of_mass)[1:, :2], np.array(now.nis)


@pytest.mark.slow
def test_what_the_moving_parts_do_is_felt(moving):
    """One rigid body in the filter: the panel's reaction, up to 0.2 N m, passes for offset."""
    made, flight = moving
    error, nis = online(made, flight, flight.speed_squared)
    assert 1e-3 < np.max(np.abs(error[20:])) < 4e-3
    assert np.mean(nis[20:]) > 12  # 6 expected: the filter's own measurements show it


@pytest.mark.slow
def test_centre_of_mass_online(moving):
    """With the known motion of the parts: within 0.4 mm from 0.1 s on, and NIS as it must be."""
    made, flight = moving
    inputs = moving_part_inputs(
        flight.speed_squared, flight.J, flight.h, flight.centre_of_mass[:, 2], 5e-3
    )
    error, nis = online(made, flight, inputs, sensors=3)
    assert np.max(np.abs(error[20:])) < 0.4e-3
    low, high = mean_interval(3, 220)
    assert low < np.mean(nis[20:]) < high


def test_refused():
    made = stm.make_scene("tracker", 1)
    with pytest.raises(stm.ModelError, match="one set of rotors"):
        sensed_flight(made.system, made.state0)
    made = stm.make_scene("hexacopter")
    pair = [stm.Body(name, 1.0, np.eye(3), free=True) for name in ("load", "hexacopter")]
    other = stm.System(pair, (), made.system.forces)
    with pytest.raises(stm.ModelError, match=r"rotors are on body 'hexacopter', .* body, 'load'"):
        sensed_flight(other, made.state0)
    with pytest.raises(stm.SettingError, match=r"one step of 0.005 s"):
        sensed_flight(made.system, made.state0, t1=0.001)
