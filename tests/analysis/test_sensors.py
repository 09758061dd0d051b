"""Sensors, and the simulator as a filter's process model: against closed forms and statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from helpers import np_rotation
from mechanisms import pendulum

import stmuav_jax as stm
from stmuav_jax.analysis.sensors import (
    Accelerometer,
    AttitudeFix,
    Encoder,
    Gyroscope,
    PositionFix,
    readings,
    sensed_motion_at,
)

G = 9.81


@pytest.fixture(scope="module")
def copter():
    system = stm.make_scene("hexacopter").system
    space = stm.TreeSpace(system)
    x = space.from_state(system.reference)
    v = np.array([0.1, -0.2, 0.3, 0.3, -0.2, 0.5, 1.0, -0.5, 0.2, 0.8, -1.1, 0.6])
    return space, space.retract(x, jnp.asarray(v))


def test_sensors_of_a_turning_body(copter):
    """Readings at a point off the centre of mass, by hand; a body at rest feels g upwards."""
    space, x = copter
    system = space.system
    body, com = system.names[0], np.asarray(system.bodies.com[0])
    arm = np.array([0.1, -0.05, 0.2])
    seen = jax.jit(lambda x: sensed_motion_at(space, x))(x)
    state = space.to_state(x)
    R = np_rotation(np.asarray(state.p[0]))
    w, w_rate = np.asarray(state.omega[0]), np.asarray(seen.omega_rate[0])
    felt = R.T @ (np.asarray(seen.v_rate[0]) + np.array([0.0, 0.0, G]))
    felt = felt + np.cross(w_rate, arm - com) + np.cross(w, np.cross(w, arm - com))
    np.testing.assert_allclose(Accelerometer(body, arm).read(seen), felt, atol=1e-12)
    turned = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(Gyroscope(body, turned).read(seen), turned @ w, atol=1e-15)
    np.testing.assert_allclose(AttitudeFix(body).read(seen), state.p[0])
    at = np.asarray(state.r[0]) + R @ (arm - com)
    np.testing.assert_allclose(PositionFix(body, arm).read(seen), at, atol=1e-15)
    rates = space.rates(x)
    np.testing.assert_allclose(seen.v_rate[0], rates[6:9], atol=1e-12)
    np.testing.assert_allclose(seen.omega_rate[0], rates[9:], atol=1e-12)


@pytest.mark.slow
def test_readings_along_a_run():
    """The same sensors on a simulated pendulum: the encoder is the joint's own angle."""
    system = pendulum()
    space = stm.TreeSpace(system)
    start = space.retract(space.from_state(system.reference), jnp.array([0.5, 0.0]))
    run = stm.simulate(system, space.to_state(start), t1=0.1)
    found = readings((Encoder("hinge"), Gyroscope("rod")), run)
    np.testing.assert_allclose(found["encoder hinge"][:, 0], run.joint("hinge").angle, atol=1e-12)
    np.testing.assert_allclose(found["gyroscope rod"], run.body("rod").omega)
    with pytest.raises(stm.SettingError, match="Two sensors have the name encoder hinge"):
        readings((Encoder("hinge"), Encoder("hinge")), run)
