"""Stability of sampled loops with delay: closed forms, and axes by hand, and the sampled motion."""

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.missions.machine import input_names
from stmuav_jax.uav.motor import only_rotors
from stmuav_jax.uav.panel_servo import StrokeServo
from stmuav_jax.uav.stability import SampledLoop, make_hover, scale_frequency, scale_pilot

missions = stm.missions


def servo_loop(frequency, delay, rate=400.0):
    """Double integrator under proportional and derivative control, critically damped."""
    A, B = np.array([[0.0, 1.0], [0.0, 0.0]]), np.array([[0.0], [1.0]])
    K = np.array([[frequency**2, 2 * frequency]])
    return SampledLoop(A, B, K, rate, delay, np.array([True, True]))


def test_a_double_integrator_without_delay_has_the_roots_of_its_quadratic():
    """z^2 - (2 - a - b) z + 1 - b + a = 0, a = (w T)^2 / 2, b = 2 w T."""
    for frequency in (40.0, 120.0, 300.0):
        a, b = (frequency / 400) ** 2 / 2, 2 * frequency / 400
        roots = np.roots([1.0, -(2 - a - b), 1 - b + a])
        radius = servo_loop(frequency, 0).compute_spectral_radius()
        assert radius == pytest.approx(np.max(np.abs(roots)), rel=1e-12)


def test_a_servo_of_120_rad_s_stands_one_period_of_delay_and_not_two():
    """The map written out by hand: x, v, and the commands on their way."""
    T, w = 1 / 400, 120.0
    for delay, published in ((1, 0.823), (2, 1.051)):
        by_hand = np.zeros((2 + delay, 2 + delay))
        by_hand[:2, :3] = [[1.0, T, T**2 / 2], [0.0, 1.0, T]]
        by_hand[2:-1, 3:] = np.eye(delay - 1)
        by_hand[-1, :2] = [-(w**2), -2 * w]
        radius = servo_loop(w, delay).compute_spectral_radius()
        assert radius == pytest.approx(np.max(np.abs(np.linalg.eigvals(by_hand))), rel=1e-12)
        # three digits of a calculation outside of the package
        assert radius == pytest.approx(published, abs=5e-4)


def test_long_delays_are_sampled_more_coarsely():
    """The growth in a second near the edge of stability, of the continuous delay to some per cent."""
    edge = [
        max(w for w in np.arange(4.0, 8.0, 0.02) if servo_loop(w, d).compute_spectral_radius() < 1)
        for d in (40, 44)
    ]
    # w times the delay is constant for delays that are long against a period
    assert edge[1] * 44.5 == pytest.approx(edge[0] * 40.5, rel=0.03)


def test_gains_are_scaled_by_their_powers_of_the_frequency():
    gains = scale_frequency(stm.uav.FlightGains(integral=2.0), 0.5)
    assert [float(x) for x in (gains.position, gains.velocity, gains.integral)] == [2.25, 2.5, 0.25]
    assert [float(gains.attitude), float(gains.rate)] == [50.0, 12.5]


@pytest.fixture(scope="module")
def hexacopter():
    """Hexacopter with motors and an integral of the position."""
    plain = {
        "format": 1, "name": "a", "t1": 1.0,
        "machine": {"scene": "hexacopter", "options": {"motor": {}}},
        "controller": {"gains": {"integral": 3.0}},
    }  # fmt: skip
    return missions.make_mission(plain)


def by_axes(gains, T, reaction, g=9.81):
    """Loops of a vertical, a horizontal and the yaw axis of a stiff machine whose wrench lags by T.

    The yaw moment has the rotors' acceleration besides: M + reaction dM/dt.
    """
    k_x, k_v, k_i = (float(x) for x in (gains.position, gains.velocity, gains.integral))
    k_R, k_W = float(gains.attitude), float(gains.rate)
    pull = lambda r, v, q: -k_x * r - k_v * v - k_i * q
    # z, v, force, integral
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    A[0, 1] = A[1, 2] = A[3, 0] = 1.0
    A[2, 2], B[2] = -1 / T, 1 / T
    r, v, _, q = np.eye(4)
    vertical = A, B, -pull(r, v, q)[None]
    # x, v, angle, rate, moment, integral
    A, B = np.zeros((6, 6)), np.zeros((6, 1))
    A[0, 1] = A[2, 3] = A[3, 4] = A[5, 0] = 1.0
    A[1, 2], A[4, 4], B[4] = g, -1 / T, 1 / T
    r, v, angle, rate, _, q = np.eye(6)
    goal, turning = pull(r, v, q) / g, pull(v, g * angle, r) / g
    turning_rate = pull(g * angle, g * rate, v) / g
    moment = -k_R * (angle - goal) - k_W * (rate - turning) + turning_rate
    horizontal = A, B, -moment[None]
    # heading, rate, moment
    A = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0 - reaction / T], [0.0, 0.0, -1 / T]])
    B = np.array([[0.0], [reaction / T], [1 / T]])
    return vertical, horizontal, (A, B, np.array([[k_R, k_W, 0.0]]))


def hover_of(mission):
    plant = mission.plant
    names = input_names(mission.machine)
    return make_hover(plant.system, plant.state0, names, mission.controller.pilot, plant.rate)


def test_the_loop_of_a_hexacopter_is_that_of_its_axes(hexacopter):
    hover, pilot, rate = hover_of(hexacopter), hexacopter.controller.pilot, hexacopter.plant.rate
    motors: Any = only_rotors(hexacopter.plant.system, "A test")
    speed = np.sqrt(hexacopter.plant.before[0])
    reaction = float(motors.inertia[0] / (2 * speed * motors.rotors.k_tau))
    T = float(motors.time_constant[0])
    for delay in (1, 2, 8):
        axes = [
            SampledLoop(*axis, rate, delay, np.zeros(len(axis[0]), bool)).compute_spectral_radius()
            for axis in by_axes(pilot.gains, T, reaction)
        ]
        radius = hover.close(pilot, delay).compute_spectral_radius()
        assert radius == pytest.approx(max(axes), abs=2e-6)
    assert radius == pytest.approx(1.0654, abs=2e-4)


@pytest.mark.slow
def test_a_joint_that_moves_has_the_loop_of_its_servo():
    """Computed torque makes a balanced arm a double integrator, whatever the base does."""
    bodies = [
        stm.Body("frame", 2.0, [0.03, 0.03, 0.05], free=True),
        stm.Body("arm", 0.3, [2e-3, 2e-3, 1e-3], position=[0.0, 0.0, -0.1]),
    ]
    hinge = stm.revolute("J", "frame", "arm", point=[0.0, 0.0, -0.1], axis=[0.0, 1.0, 0.0])
    arms, spin = stm.uav.rotor_layout(4, 0.25)
    rotors = stm.uav.Rotors(
        "frame", arms=arms, spin=spin, k_f=1e-5, k_tau=1e-7, speed_squared=4 * [5.6e5]
    )
    system = stm.System(bodies, [hinge], [stm.Gravity(), rotors, stm.JointEffort("J", 0.0)])
    flight = stm.uav.FlightController(system, 400.0)
    pilot = stm.uav.JointController(system, flight, {"J": stm.uav.JointGains(frequency=120.0)})
    hover = make_hover(system, system.reference, ["speed_squared", "effort"], pilot, 400.0)
    for delay in (1, 2):
        loop = hover.close(pilot, delay)
        values = np.linalg.eigvals(loop.make_period_map())
        for value in np.linalg.eigvals(servo_loop(120.0, delay).make_period_map()):
            assert np.min(np.abs(values - value)) < 1e-6
    assert loop.compute_spectral_radius() == pytest.approx(1.051, abs=5e-4)
    assert loop.compute_joint_share() > 0.9
    slower = hover.close(scale_pilot(pilot, 0.5, of_joints=True), 2)
    assert slower.compute_spectral_radius() <= 1 + 1e-6


@pytest.mark.slow
def test_the_loop_of_the_uav_is_that_of_its_sampled_motion():
    """Its period map is that of the plant's own steps, by central differences."""
    plain = {"format": 1, "name": "a", "t1": 1.0, "machine": {"scene": "uav_tracker"}}
    mission = missions.make_mission(plain)
    plant, pilot = mission.plant, mission.controller.pilot
    hover = hover_of(mission)
    space, x = hover.space, hover.point

    @quick_jit
    def step(plant, pilot, space, x, reference, v):
        now = plant.reset(state0=space.to_state(space.retract(x, v)))
        inputs, _ = pilot(now.state, reference, pilot.start())
        after = plant.step(now, inputs)
        return space.difference(space.from_state(after.state), x)

    run = lambda v: np.asarray(step(plant, pilot, space, x, hover.reference, jnp.asarray(v)))
    h = 1e-5
    columns = [(run(h * e) - run(-h * e)) / (2 * h) for e in np.eye(space.size)]
    n = space.size
    whole = hover.close(pilot, 0).make_period_map()[:n, :n]
    np.testing.assert_allclose(whole, np.stack(columns, axis=1), rtol=2e-3, atol=2e-5)
    # the loops of the masses about hover, with the panel's weight left out
    for delay, radius in ((2, 1.0864), (4, 1.1691)):
        loop = hover.close(pilot, delay)
        assert loop.compute_spectral_radius() == pytest.approx(radius, abs=5e-4)
        assert loop.compute_joint_share() > 0.5
    bodies: Any = mission.machine.bodies
    assert isinstance(scale_frequency(StrokeServo(bodies), 0.5), StrokeServo)
