"""What controllers do at the limits of rotors, and what the servos of the panel know."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit

control, tracker = stm.control, stm.uav


def test_the_integral_stands_still_while_the_rotors_cannot_give_the_wrench():
    """Far below its reference the machine asks for more than its rotors have; nearby it does not."""
    scene = stm.make_scene("hexacopter")
    gains = stm.uav.FlightGains(integral=5.0)
    limits = stm.uav.RotorLimits(200.0, 1400.0)
    pilot = stm.uav.FlightController(scene.system, 400.0, gains=gains, limits=limits)
    begun = stm.uav.FlightMemory(jnp.array([0.01, -0.02, 0.03]))
    for height, stands in ((0.05, False), (50.0, True)):
        above = control.at_point(jnp.array([0.0, 0.0, height]), jnp.zeros(()))
        squared, after = pilot(scene.state0, above, begun)
        assert np.all(squared <= 1400.0**2 * (1 + 1e-12))
        grown = np.asarray(after.integral - begun.integral)
        wanted = 0.0 if stands else -height / 400.0
        np.testing.assert_allclose(grown, [0.0, 0.0, wanted], atol=1e-15)
    # without limits it grows with any error
    free = stm.uav.FlightController(scene.system, 400.0, gains=gains)
    above = control.at_point(jnp.array([0.0, 0.0, 50.0]), jnp.zeros(()))
    _, after = free(scene.state0, above, begun)
    assert float(after.integral[2] - begun.integral[2]) == pytest.approx(-50.0 / 400.0)


@pytest.mark.slow
def test_the_servo_of_strokes_is_a_spring_and_a_damper_of_each_slider():
    """Forces against differences of the strokes themselves, from two postures apart by angles."""
    table = stm.PART_II
    geometry = tracker.tracker_geometry(table)
    scene = stm.make_scene("uav_tracker", 2)
    bodies = stm.uav.panel_bodies(scene.system, geometry, table.value("mount.shift"))
    servo = stm.uav.StrokeServo(bodies, stiffness=3000.0, damping=40.0)
    now, goal = jnp.array([-0.2, -0.1]), jnp.array([0.1, 0.15])
    rate, none = jnp.array([0.3, -0.4]), jnp.zeros(2)
    at = tracker.PairMotion(now, rate, none)
    found = servo.command(at, tracker.PairMotion(goal, none, none), jnp.zeros(3), jnp.zeros(3))
    strokes = lambda x: np.asarray(tracker.strokes(geometry, x))
    h = 1e-6
    moving = (strokes(now + h * rate) - strokes(now - h * rate)) / (2 * h)
    wanted = 3000.0 * (strokes(goal) - strokes(now)) - 40.0 * moving
    np.testing.assert_allclose(found.forces, wanted, rtol=1e-7)
    np.testing.assert_array_equal(found.moment, np.zeros(3))
    for name in ("stiffness", "damping"):
        with pytest.raises(stm.ModelError, match=rf"The {name} of the strokes' servo"):
            stm.uav.StrokeServo(bodies, **{name: -1.0})


@pytest.mark.slow
def test_the_servo_knows_the_trackers_equations():
    """Its forces, on a base of 1e9 kg that is held, give the accelerations they were found for."""
    heavy = {"mass.hexacopter_1": 1e9, "inertia.hexacopter_1": 1e9 * np.eye(3)}
    uav = stm.uav.make_uav(stm.PART_II.replaced(heavy))
    bodies = stm.uav.panel_bodies(
        uav.system, tracker.tracker_geometry(stm.PART_II), stm.PART_II.value("mount.shift")
    )
    angles, rates = jnp.array([0.1, -0.2]), jnp.array([0.7, -0.4])
    wanted = jnp.array([3.0, -5.0])
    motion = tracker.PairMotion(angles, rates, wanted)
    found = stm.uav.inverse_dynamics(bodies, motion, jnp.array([0.0, 0.0, -9.81]), jnp.zeros(3))
    at = uav.point(angles, rates)
    held = stm.AppliedForce("hexacopter_1", jnp.array([0.0, 0.0, 9.81e9]))
    idle = uav.inputs.applied(uav.system, jnp.concatenate([jnp.zeros(6), found.forces]))
    system = eqx.tree_at(lambda s: s.forces, idle, (*idle.forces, held))
    rate = quick_jit(lambda x, s: uav.space.rates(x, 0.0, s))(at, system)

    def turned(t):
        """Panel angles at a time: the coordinates are those of the joint at the post."""
        moved = t * rate[:8] + t**2 / 2 * rate[8:]
        return uav.panel_angles(uav.space.retract(at, jnp.zeros(16).at[:8].set(moved)))

    # the base gives way by some 20 N / 1e9 kg
    turning = quick_jit(jax.jacfwd(jax.jacfwd(turned)))(0.0)
    np.testing.assert_allclose(turning, wanted, rtol=1e-6)
    assert np.max(np.abs(rate[8:14])) < 1e-6
