"""Missions and studies of a machine of one's own, from its file."""

import json
import pickle
from typing import Any

import numpy as np
import pytest

import stmuav_jax as stm

missions = stm.missions

MODEL = """
format = 2

[parameters]
camera = {value = 0.4, unit = "kg", source = "weighed"}
k_f = {value = 1e-5, unit = "N s^2/rad^2", source = "test stand"}
label = {value = 1.0, unit = "1", source = "unused"}

[bodies]
frame = {mass = 2.0, inertia = [0.03, 0.03, 0.05], free = true}
yoke = {mass = 0.1, inertia = [2e-4, 2e-4, 1e-4], position = [0, 0, -0.06]}
camera = {mass = "camera", inertia = [5e-4, 5e-4, 5e-4], position = [0, 0, -0.1], com = [0.01, 0, -0.01]}

[joints]
roll = {kind = "revolute", bodies = ["frame", "yoke"], point = [0, 0, -0.06], axis = [1, 0, 0]}
pitch = {kind = "revolute", bodies = ["yoke", "camera"], point = [0, 0, -0.1], axis = [0, 1, 0]}

[forces]
weight = {kind = "gravity"}
roll_servo = {kind = "servo", joint = "roll", stiffness = 8.0, damping = 0.2, target = 0.0}
pitch_motor = {kind = "effort", joint = "pitch", effort = 0.0, limit = 2.0}
air = {kind = "drag", body = "frame", linear = [0.2, 0.2, 0.3]}

[forces.motors]
kind = "motors"
body = "frame"
number = 6
radius = 0.3
k_f = "k_f"
k_tau = 1.5e-7
time_constant = 0.02
highest = 1300.0

[wind]
steady = [2.0, 0.0, 0.0]

[battery]
capacity = 9000.0
reserve = 0.3
"""
MISSION = {
    "format": 1, "name": "own", "t1": 1.5,
    "machine": {"model": "own.toml"},
    "rates": {"control": 200.0},
    "controller": {"gains": {"integral": 4.0}},
    "path": {"waypoints": [{"t": 0.1, "position": [0.0, 0.0, 0.0]}, {"t": 1.3, "position": [0.2, 0.0, 0.1]}]},
    "joints": [
        {"joint": "pitch", "to": -30.0, "at": 0.2, "duration": 0.8}, {"joint": "roll", "to": 10.0, "at": 0.2},
    ],
    "wind": {"steady": [3.0, 0.0, 0.0], "gusts": {"seed": 2}},
    "battery": {"state_of_charge": 0.9},
    "tolerances": {"after": 0.5, "position": 0.3, "joints": {"pitch": 0.5, "roll": 5.0}},
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("own")
    (path / "own.toml").write_text(MODEL)
    return path


@pytest.fixture(scope="module")
def flight(folder):
    return missions.fly(missions.make_mission(MISSION, folder))


@pytest.fixture(scope="module")
def data(flight):
    return missions.to_data(flight)


def changed(**changes):
    return {key: value for key, value in (MISSION | changes).items() if value is not None}


@pytest.mark.slow
def test_an_own_machine_flies_in_gusts_and_moves_its_gimbal(flight, data):
    kept, words = missions.verdict(data)
    assert kept, words
    assert list(data.driven_joint.values) == ["roll", "pitch"]
    assert (data.joint_error.units, data.highest_effort.units) == ("rad", "N m")
    start, end = data.joint_position.values[[0, -1]]
    assert start == pytest.approx([0.0, 0.0], abs=1e-12)
    # the mechanical servo gives way to the weight of the camera, computed torque does not
    assert np.degrees(end[1]) == pytest.approx(-30.0, abs=0.1)
    assert 1e-3 < abs(np.degrees(end[0]) - 10.0) < 5.0
    assert missions.Measure("Largest tilt error", 2e-15, "degrees").text == "0 degrees"
    measures = {one.name: one for one in missions.measures(data)}
    pitch = measures["Largest pitch error from 0.5 s on"]
    late = data.time.values >= 0.5
    assert pitch.value == pytest.approx(
        np.degrees(np.max(np.abs(data.joint_error.values[late, 1])))
    )
    assert (pitch.unit, pitch.allowed) == ("degrees", 0.5)
    effort = data.commanded_effort.values
    margin = measures["Smallest margin of the joint efforts"].value
    assert margin == pytest.approx(100 * np.min((2.0 - np.abs(effort[:, 1])) / 4.0))
    # the servo's law, and that the gusts are the mission's and the battery the model's
    lag = (data.joint_position - data.reference_joint_position).values[:, 0]
    rate = data.joint_position.differentiate("time").values[:, 0]
    np.testing.assert_allclose(effort[5:-5, 0], (-8.0 * lag - 0.2 * rate)[5:-5], atol=0.01)
    assert np.std(np.diff(flight.mission.plant.system.forces[3].wind.values, axis=0)) > 0
    assert flight.mission.battery is not None
    assert float(flight.mission.battery.capacity) == 9000.0
    assert float(flight.mission.battery.reserve) == 0.3
    assert float(data.state_of_charge[-1]) < 0.9
    drawn = missions.flight_figures(data)
    assert {"joints", "margins", "power"} <= set(drawn)


@pytest.mark.slow
def test_hinges_and_slides_have_their_units_and_any_number_of_joints_is_drawn(tmp_path):
    parts = [(MODEL.split("[joints]")[0], "", "")]
    for k in range(2):
        body = f"bodies = ['frame', 'ballast_{k}']"
        parts.append((
            f"ballast_{k} = {{mass = 0.1, inertia = [2e-4, 2e-4, 2e-4], position = [0, 0, {0.1 * k}]}}",
            f"rail_{k} = {{kind = 'translational', {body}, axis = [0, {k % 2}, {(k + 1) % 2}]}}",
            f"rail_motor_{k} = {{kind = 'effort', joint = 'rail_{k}', effort = 0.0, limit = 9.0}}",
        ))  # fmt: skip
    bodies, joints, forces = ("\n".join(lines) for lines in zip(*parts, strict=True))
    text = MODEL.replace(parts[0][0], f"{bodies}\n")
    text = text.replace("[joints]", f"[joints]{joints}").replace("[forces]", f"[forces]{forces}", 1)
    (tmp_path / "own.toml").write_text(text)
    moves = [{"joint": "rail_1", "to": 0.05, "at": 0.0}]
    flight = missions.fly(missions.make_mission(changed(t1=0.1, joints=moves), tmp_path))
    data = missions.to_data(flight)
    order = ["m", "m", "rad", "rad"]
    assert list(data.driven_joint_unit.values) == order
    efforts = [{"m": "N", "rad": "N m"}[unit] for unit in order]
    assert list(data.driven_joint_effort_unit.values) == efforts
    assert data.joint_error.units == "see driven_joint_unit"
    assert (
        data.commanded_effort.units == data.highest_effort.units == "see driven_joint_effort_unit"
    )
    curve = missions.flight_figures(data)["joints"].axes[2].lines[1]
    np.testing.assert_array_equal(curve.get_ydata(), data.joint_position.values[:, 1])


@pytest.mark.slow
def test_the_gimbal_is_estimated_by_its_encoders_with_the_sensors_of_the_model(folder, data):
    sensors = """
[sensors]
gyro = {kind = "gyroscope", body = "frame", noise = 0.003}
gps = {kind = "position", body = "frame", noise = 0.005, rate = 100.0, point = [0.0, 0.0, 0.1]}
resolver = {kind = "encoder", joint = "pitch", noise = 1e-3}
"""
    (folder / "sensed.toml").write_text(MODEL + sensors)
    plain = changed(
        machine={"model": "sensed.toml"}, sensors={"standing": 0.5, "gyroscope": {"noise": 0.004}}
    )
    mission = missions.make_mission(plain, folder)
    by_name: dict[str, Any] = {
        instrument.name: instrument for instrument in mission.plant.bench.instruments
    }
    assert np.max(by_name["gyroscope frame"].noise) == 0.004
    assert by_name["position frame"].rate == 100.0
    np.testing.assert_array_equal(by_name["position frame"].sensor.point, [0.0, 0.0, 0.1])
    assert [np.max(by_name[f"encoder {name}"].noise) for name in ("roll", "pitch")] == [1e-5, 1e-3]
    flown = missions.to_data(missions.fly(mission))
    kept, words = missions.verdict(flown)
    assert kept, words
    error = np.degrees(np.abs((flown.joint_position - data.joint_position).values))
    # the noise of the resolver, 0.06 degrees, is in the torque, and the gimbal follows all the same
    assert 1e-3 < np.max(error[:, 1]) < 0.5


@pytest.mark.slow
def test_a_tighter_tolerance_and_an_early_end_are_not_kept(data):
    content = json.loads(data.attrs["mission"])
    content["tolerances"]["joints"]["roll"] = 1e-3
    kept, words = missions.verdict(data.assign_attrs(mission=json.dumps(content)))
    assert not kept
    assert "largest roll error from 0.5 s on" in words
    content = json.loads(data.attrs["mission"])
    content["joints"][0]["at"] = 1.0
    kept, words = missions.verdict(data.assign_attrs(mission=json.dumps(content)))
    assert not kept
    assert "before the end of a move of joint pitch at t = 1.8 s" in words


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"joints": [{"joint": "pich", "to": 1.0}]}, r"\[\[joints\]\] names 'pich'.*Did you mean 'pitch'"),
        ({"tolerances": {"joints": {"yaw": 1.0}}}, "'tolerances.joints' names 'yaw'"),
        ({"controller": {"joints": {"roll": {"frequency": 9.0}}}}, "no joint 'roll' with an effort"),
        ({"controller": {"joints": {"pitch": {"kind": "pd"}}}}, "of the kind pd needs 'stiffness'"),
        ({"controller": {"joints": {"pitch": {"stiffness": 3.0}}}}, "has 'frequency' and 'damping', and no st"),
        ({"joints": [{"joint": "pitch", "to": 1.0}, {"joint": "pitch", "to": 2.0, "at": 0.5}]},
         "The moves of joint 'pitch' must follow one another"),
        ({"controller": {"highest": 1500.0}}, "the motors turn no faster than 1300 rad/s"),
        ({"machine": {"model": "own.toml", "parameters": {"camra": 1.0}}}, "no parameter 'camra'"),
        ({"machine": {"model": "own.toml", "options": {"drag": {}}}}, "'machine.options' is for built-in scenes"),
        ({"battery": {"state_of_charge": 0.3}}, "must be above its reserve of 0.3"),
        ({"controller": {"payload": "estimated"}, "sensors": {}}, "cannot be estimated by a machine with driven"),
        ({"panel": [{"angles": [1.0, 1.0]}]}, "needs the tracker of the scene uav_tracker"),
        ({"machine": {"scene": "hexacopter"}, "wind": None, "tolerances": {}},
         r"\[\[joints\]\] names 'pitch', but no effort or servo"),
    ],
)  # fmt: skip
def test_entries_that_the_machine_cannot_fly_are_refused(changes, words, folder):
    with pytest.raises((stm.SettingError, stm.ModelError), match=words):
        missions.make_mission(changed(**changes), folder)


def test_wind_without_drag_says_what_the_model_needs(tmp_path):
    text = MODEL.replace("air = ", "# ").partition("[wind]")[0]
    (tmp_path / "own.toml").write_text(text)
    with pytest.raises(
        stm.SettingError, match="add a force of the kind 'drag' to the model's file"
    ):
        missions.make_mission(MISSION, tmp_path)


@pytest.fixture(scope="module")
def study(folder):
    # the table of the samples: the machine itself first
    factors = {
        "camera": {"distribution": "empirical", "values": [1.0, 1.2, -1.0, 1.1]},
        "k_f": {"distribution": "constant", "value": 1.0},
    }
    mission = missions.make_mission(changed(battery=None), folder)
    return missions.make_mission_study(
        mission, factors, relative=frozenset(factors), name="own", seed=5, design="table"
    )


@pytest.mark.slow
def test_a_flight_of_the_study_is_that_of_the_mission_alone(study, folder):
    columns = study.compute(0, 4)
    gusts = int(np.random.SeedSequence((5, 0)).generate_state(2).astype(np.uint32)[0])
    alone = changed(battery=None, wind={"steady": [3.0, 0.0, 0.0], "gusts": {"seed": gusts}})
    data = missions.to_data(missions.fly(missions.make_mission(alone, folder)))
    found = {one.name: one.value for one in missions.measures(data)}
    for name, value in (
        ("Largest position error from 0.5 s on", columns["position_error"][0]),
        ("Largest pitch error from 0.5 s on", np.degrees(columns["pitch_error"][0])),
        ("Largest roll error from 0.5 s on", np.degrees(columns["roll_error"][0])),
        ("Smallest margin of the joint efforts", 100 * columns["effort_margin"][0]),
        ("Energy used, electrical", columns["energy"][0] / 3600),
    ):
        assert value == pytest.approx(found[name], rel=1e-6), name
    # a heavier camera that the controller does not know: the pitch sags, and no body has a negative mass
    assert columns["pitch_error"][1] > 2 * columns["pitch_error"][0]
    assert columns["status"].tolist()[:2] == [1, 1]
    assert columns["status"][2] != 1
    again = pickle.loads(pickle.dumps(study))
    assert again.identity == study.identity


def test_a_study_of_a_model_names_its_parameters(study, folder):
    assert set(study.columns) >= {"pitch_error", "roll_error", "effort_margin", "rotor_margin"}
    assert study.columns["pitch_error"].unit == "rad"
    with pytest.raises(stm.SettingError, match="'label' has no effect on this mission"):
        missions.make_mission_study(study.evaluate.mission, {"label": 1.0})
    with pytest.raises(stm.SettingError, match=r"'camra' is no parameter of own.*'camera'"):
        missions.make_mission_study(study.evaluate.mission, {"camra": 1.0})
