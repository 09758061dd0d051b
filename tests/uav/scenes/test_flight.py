"""Drag, wind and motors as options of the flying scenes: used, kept, and free where absent."""

import numpy as np
import pytest
from helpers import derivative_size

import stmuav_jax as stm


def test_a_scene_without_options_pays_nothing():
    """Its forces are the report's, its equations those of a system with just these."""
    scene = stm.make_scene("hexacopter")
    assert [type(f) for f in scene.system.forces] == [stm.Gravity, stm.uav.Rotors]
    by_hand = stm.System(
        [stm.Body("hexacopter", 5.0, [0.06, 0.06, 0.09], free=True)],
        forces=[stm.Gravity(), scene.system.forces[1]],
    )
    mine = derivative_size(scene.system)
    assert mine == derivative_size(by_hand)
    dragged = derivative_size(stm.make_scene("hexacopter", drag=stm.uav.Drag()).system)
    windy = derivative_size(
        stm.make_scene("hexacopter", drag=stm.uav.Drag(), wind=stm.uav.Wind()).system
    )
    motored = derivative_size(stm.make_scene("hexacopter", motor=stm.uav.Motor()).system)
    assert mine[0] < dragged[0] < windy[0]
    assert mine[1] == dragged[1] == windy[1] == motored[1] - 6
    types = [type(f) for f in stm.make_scene("uav_tracker", 1).system.forces]
    assert types == [stm.Gravity, stm.uav.Rotors]
    assert not [k for k in scene.parameters if k.startswith(("drag.", "wind.", "motor.", "gust."))]


def test_numbers_given_are_used_and_kept():
    scene = stm.make_scene(
        "uav_tracker",
        2,
        drag=stm.uav.Drag(linear=[0.1, 0.2, 0.3]),
        wind=stm.uav.Wind(mean=[0.0, 4.0, 0.0], gusts=True, seed=3, height=15.0),
        motor=stm.uav.Motor(time_constant=0.03),
    )
    motors, drag = scene.system.forces[1:3]
    assert isinstance(drag, stm.uav.AirframeDrag)
    assert isinstance(motors, stm.uav.MotorRotors)
    np.testing.assert_allclose(drag.linear, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(drag.quadratic, stm.PART_II.value("drag.quadratic"))
    assert isinstance(drag.wind, stm.uav.Gusts)
    np.testing.assert_allclose(drag.wind.mean, [0.0, 4.0, 0.0])
    for value, expected in (
        (motors.time_constant, 0.03), (motors.inertia, stm.PART_II.value("motor.inertia")),
    ):  # fmt: skip
        assert value is not None
        np.testing.assert_allclose(value, expected)
    np.testing.assert_allclose(motors.internal, 1356.3, atol=0.05)
    assert scene.parameters["wind.mean"]["value"] == [0.0, 4.0, 0.0]
    assert scene.parameters["motor.time_constant"]["source"] == "given by the user"
    assert scene.parameters["gust.height"]["value"] == 15.0
    assert "Not in the report: drag, wind, motors." in scene.notes
    plain = stm.make_scene("hexacopter", drag=stm.uav.Drag(), wind=[1.0, 2.0, 3.0])
    air = plain.system.forces[2]
    assert isinstance(air, stm.uav.AirframeDrag)
    np.testing.assert_allclose(np.asarray(air.wind), [1.0, 2.0, 3.0])
    assert "wind.mean" not in plain.parameters


def test_the_gear_of_a_scene_stands_below_its_base():
    scene = stm.make_scene("uav_tracker", 1, gear=stm.uav.Gear(spread=0.3, ground=1.0))
    gear = scene.system.forces[-1]
    assert isinstance(gear, stm.mechanics.GroundContact)
    assert gear.body == "hexacopter_1"
    feet = [[x, y, -0.2] for x, y in ((0.3, 0.3), (-0.3, 0.3), (-0.3, -0.3), (0.3, -0.3))]
    np.testing.assert_allclose(gear.feet, feet)
    numbers = {
        "height": 1.0,
        "stiffness": 2e4,
        "damping": 150,
        "width": 1e-3,
        "friction": 0.6,
        "slip_speed": 0.02,
    }
    for name, value in numbers.items():
        np.testing.assert_allclose(getattr(gear, name), value)
    assert scene.parameters["gear.ground"]["source"] == "given by the user"
    assert "Not in the report: landing gear." in scene.notes
    assert "gear.ground" not in stm.make_scene("uav_tracker", 1).parameters
    assert "gear.depth" in stm.make_scene("hexacopter", gear=stm.uav.Gear()).parameters


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hexacopter", "uav_tracker"])
def test_a_flight_in_gusts_keeps_its_balances(name, tmp_path):
    """All options: certificate, saved speeds, the same again from the same seed."""
    make = lambda: stm.make_scene(
        name, drag=stm.uav.Drag(), wind=stm.uav.Wind(gusts=True), motor=stm.uav.Motor()
    )
    run = stm.simulate(make(), t1=0.1)
    assert run.certificate.relative_energy_error < 1e-7
    assert (run.certificate.angular_momentum_error or 0.0) < 1e-7
    assert run.certificate.position_violation < 1e-14
    assert run.trajectory.internal.shape == (11, 6)
    again = stm.simulate(make(), t1=0.1)
    np.testing.assert_array_equal(run.states.r, again.states.r)
    from stmuav_jax.io import load, save

    data = load(save(run, tmp_path / "run.nc"))
    np.testing.assert_array_equal(data["internal"], run.trajectory.internal)
    assert str(data["internal_state"].values[2]).endswith(": speed of rotor 3 [rad/s]")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"wind": stm.uav.Wind()}, "give drag=Drag"),
        ({"drag": stm.uav.Drag(linear=0.1)}, r"'drag.linear' must have shape \(3,\)"),
        (
            {"drag": stm.uav.Drag(), "wind": stm.uav.Wind(mean=[0.0] * 3, gusts=True)},
            "that is not zero",
        ),
        ({"motor": stm.uav.Motor(highest=1000.0)}, r"72.25 N are required.* 39.28 N"),
    ],
)
def test_senseless_options_are_refused(options, words):
    with pytest.raises(stm.ModelError, match=words):
        stm.make_scene("uav_tracker", 2, **options)
