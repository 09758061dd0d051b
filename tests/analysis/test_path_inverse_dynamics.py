"""Inverse dynamics along a path, against drivers and virtual power; clearances of joints, against hand kinematics."""

import jax.numpy as jnp
import numpy as np
import pytest
from parallel_robots import CRANK, ROD, slider_crank
from test_posture_survey import five_bar

import stmuav_jax as stm
from stmuav_jax.analysis import compare_clearances, inverse_dynamics

ANGLE = 0.7


def slope(angle):
    """Slope dx/dtheta of the slider-crank, and the tangent of its rod's angle."""
    s, c = CRANK * np.sin(angle), CRANK * np.cos(angle)
    root = np.sqrt(ROD**2 - s**2)
    return -s - s * c / root, s / root


@pytest.mark.slow
def test_efforts_of_a_parallel_robot_are_those_of_drivers():
    system, joints = five_bar(), ("A", "B")
    ts = np.linspace(0.0, 0.5, 6)
    motions = {
        joint: lambda t, k=k: 0.2 * jnp.sin(4 * t + k) - 0.2 * np.sin(k)
        for k, joint in enumerate(joints)
    }
    result = inverse_dynamics(system, motions, ts)
    driven = stm.dynamics.add_drivers(system, motions)
    efforts = stm.dynamics.driver_efforts(driven, result.states, jnp.asarray(ts))
    expected = np.stack([np.asarray(efforts[f"drive {joint}"]) for joint in joints], axis=1)
    assert np.ptp(expected) > 1.0
    np.testing.assert_allclose(result.values, expected, rtol=1e-8)
    assert np.max(result.unbalanced) < 1e-10
    assert [unit for _, unit in result.inputs] == ["N m"] * 2


@pytest.mark.slow
def test_a_path_of_a_passive_joint_has_the_efforts_of_the_actuator():
    """The crank turns evenly, the slider is pushed: both have the same power as one degree of freedom has."""
    system = slider_crank(ANGLE, "slide")
    ts = np.linspace(0.0, 0.2, 5)
    turning = inverse_dynamics(system, {"O": lambda t: 2.0 * t}, ts)
    power = np.asarray(
        stm.dynamics.driver_efforts(
            stm.dynamics.add_drivers(slider_crank(ANGLE, "O"), {"O": lambda t: 2.0 * t}),
            turning.states, jnp.asarray(ts),
        )["drive O"]
    ) * 2.0  # fmt: skip
    speed = np.asarray(turning.states.v)[:, 2, 0]
    np.testing.assert_allclose(turning.values[:, 0] * speed, power, rtol=1e-8)


@pytest.mark.slow
def test_a_path_that_is_not_determined_is_refused():
    with pytest.raises(stm.ModelError, match="degree"):
        inverse_dynamics(five_bar(), {"A": lambda t: 0.0 * t}, [0.0, 0.1])


def test_clearances_move_a_slider_as_its_kinematics_say():
    """A gap at the ball moves it by 1 / cos of the rod's angle, an error of the crank by dx/dtheta."""
    found = {c.joint: c for c in compare_clearances(slider_crank(ANGLE, "O"), ["O"], "slider")}
    dx, tangent = slope(ANGLE)
    assert found["drive O"].translation[1] == pytest.approx(abs(dx), rel=1e-9)
    assert found["B"].translation[0] == pytest.approx(np.hypot(1.0, tangent), rel=1e-9)
    assert found["drive O"].rotation[1] == pytest.approx(0.0, abs=1e-9)
    with pytest.raises(stm.SettingError, match="keeps 1 degrees of freedom"):
        compare_clearances(slider_crank(ANGLE, "O"), [], "slider")
