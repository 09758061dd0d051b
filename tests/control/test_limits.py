"""What controllers do at the limits of rotors, and the servo of strokes that knows no masses."""

import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm

control, tracker = stm.control, stm.tracker


@pytest.mark.slow
def test_the_integral_stands_still_while_the_rotors_cannot_give_the_wrench():
    """Far below its reference the machine asks for more than its rotors have; nearby it does not."""
    scene = stm.make_scene("hexacopter")
    gains = control.FlightGains(integral=5.0)
    limits = stm.rotorcraft.RotorLimits(200.0, 1400.0)
    pilot = control.FlightController(scene.system, 400.0, gains=gains, limits=limits)
    begun = control.FlightMemory(jnp.array([0.01, -0.02, 0.03]))
    for height, stands in ((0.05, False), (50.0, True)):
        above = control.at_point(jnp.array([0.0, 0.0, height]), jnp.zeros(()))
        squared, after = pilot(scene.state0, above, begun)
        assert np.all(squared <= 1400.0**2 * (1 + 1e-12))
        grown = np.asarray(after.integral - begun.integral)
        wanted = 0.0 if stands else -height / 400.0
        np.testing.assert_allclose(grown, [0.0, 0.0, wanted], atol=1e-15)
    # without limits it grows with any error
    free = control.FlightController(scene.system, 400.0, gains=gains)
    above = control.at_point(jnp.array([0.0, 0.0, 50.0]), jnp.zeros(()))
    _, after = free(scene.state0, above, begun)
    assert float(after.integral[2] - begun.integral[2]) == pytest.approx(-50.0 / 400.0)


@pytest.mark.slow
def test_the_servo_of_strokes_is_a_spring_and_a_damper_of_each_slider():
    """Forces against differences of the strokes themselves, from two postures apart by angles."""
    table = stm.PART_II
    geometry = tracker.tracker_geometry(table)
    scene = stm.make_scene("uav_tracker", 2)
    bodies = control.panel_bodies(scene.system, geometry, table.value("mount.shift"))
    servo = control.StrokeServo(bodies, stiffness=3000.0, damping=40.0)
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
            control.StrokeServo(bodies, **{name: -1.0})
