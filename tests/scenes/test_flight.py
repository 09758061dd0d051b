"""Drag, wind and motors as options of the flying scenes: used, kept, and free where absent."""

import numpy as np
import pytest
from helpers import derivative_size

import stmuav_jax as sj


def test_a_scene_without_options_pays_nothing():
    """Its forces are the report's, its equations those of a system with just these."""
    scene = sj.make_scene("hexacopter")
    assert [type(f) for f in scene.system.forces] == [sj.Gravity, sj.Rotors]
    by_hand = sj.System(
        [sj.Body("hexacopter", 5.0, [0.06, 0.06, 0.09], free=True)],
        forces=[sj.Gravity(), scene.system.forces[1]],
    )
    mine = derivative_size(scene.system)
    assert mine == derivative_size(by_hand)
    dragged = derivative_size(sj.make_scene("hexacopter", drag=sj.Drag()).system)
    windy = derivative_size(sj.make_scene("hexacopter", drag=sj.Drag(), wind=sj.Wind()).system)
    motored = derivative_size(sj.make_scene("hexacopter", motor=sj.Motor()).system)
    assert mine[0] < dragged[0] < windy[0]
    assert mine[1] == dragged[1] == windy[1] == motored[1] - 6
    types = [type(f) for f in sj.make_scene("uav_tracker", 1).system.forces]
    assert types == [sj.Gravity, sj.Rotors]
    assert not [k for k in scene.parameters if k.startswith(("drag.", "wind.", "motor.", "gust."))]


def test_numbers_given_are_used_and_kept():
    scene = sj.make_scene(
        "uav_tracker",
        2,
        drag=sj.Drag(linear=[0.1, 0.2, 0.3]),
        wind=sj.Wind(mean=[0.0, 4.0, 0.0], gusts=True, seed=3, height=15.0),
        motor=sj.Motor(time_constant=0.03),
    )
    motors, drag = scene.system.forces[1:3]
    assert isinstance(drag, sj.AirframeDrag)
    assert isinstance(motors, sj.MotorRotors)
    np.testing.assert_allclose(drag.linear, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(drag.quadratic, sj.PART_II.value("drag.quadratic"))
    assert isinstance(drag.wind, sj.Gusts)
    np.testing.assert_allclose(drag.wind.mean, [0.0, 4.0, 0.0])
    for value, expected in (
        (motors.time_constant, 0.03), (motors.inertia, sj.PART_II.value("motor.inertia")),
    ):  # fmt: skip
        assert value is not None
        np.testing.assert_allclose(value, expected)
    np.testing.assert_allclose(motors.internal, 1356.3, atol=0.05)
    assert scene.parameters["wind.mean"]["value"] == [0.0, 4.0, 0.0]
    assert scene.parameters["motor.time_constant"]["source"] == "given by the user"
    assert scene.parameters["gust.height"]["value"] == 15.0
    assert "Not in the report: drag, wind, motors." in scene.notes
    plain = sj.make_scene("hexacopter", drag=sj.Drag(), wind=[1.0, 2.0, 3.0])
    air = plain.system.forces[2]
    assert isinstance(air, sj.AirframeDrag)
    np.testing.assert_allclose(np.asarray(air.wind), [1.0, 2.0, 3.0])
    assert "wind.mean" not in plain.parameters


@pytest.mark.parametrize(
    "name", ["hexacopter", pytest.param("uav_tracker", marks=pytest.mark.slow)]
)
def test_a_flight_in_gusts_keeps_its_balances(name, tmp_path):
    """All options: certificate, saved speeds, the same again from the same seed."""
    make = lambda: sj.make_scene(name, drag=sj.Drag(), wind=sj.Wind(gusts=True), motor=sj.Motor())
    run = sj.simulate(make(), t1=0.1)
    assert run.certificate.relative_energy_error < 1e-7
    assert (run.certificate.angular_momentum_error or 0.0) < 1e-7
    assert run.certificate.position_violation < 1e-14
    assert run.trajectory.internal.shape == (11, 6)
    again = sj.simulate(make(), t1=0.1)
    np.testing.assert_array_equal(run.states.r, again.states.r)
    from stmuav_jax.view.io import load, save

    data = load(save(run, tmp_path / "run.nc"))
    np.testing.assert_array_equal(data["internal"], run.trajectory.internal)
    assert str(data["internal_state"].values[2]).endswith(": speed of rotor 3 [rad/s]")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"wind": sj.Wind()}, "give drag=Drag"),
        ({"drag": sj.Drag(linear=[-1.0, 0, 0])}, "must not be negative"),
        ({"drag": sj.Drag(linear=0.1)}, r"'drag.linear' must have shape \(3,\)"),
        ({"drag": sj.Drag(), "wind": sj.Wind(mean=[0.0] * 3, gusts=True)}, "must not be zero"),
        ({"drag": sj.Drag(), "wind": sj.Wind(height=1.0, gusts=True)}, "3.048 to 304.8 m"),
        ({"motor": sj.Motor(time_constant=0.0)}, "must be positive"),
        ({"motor": sj.Motor(highest=1000.0)}, r"72.25 N are required.* 39.28 N"),
        ({"motor": sj.Motor(lowest=2000.0)}, "lowest < highest"),
    ],
)
def test_senseless_options_are_refused(options, words):
    with pytest.raises(sj.ModelError, match=words):
        sj.make_scene("uav_tracker", 2, **options)
