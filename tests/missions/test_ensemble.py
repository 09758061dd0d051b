"""Monte Carlo studies of a mission: flights side by side, resumed, and refused before they begin."""

import pickle
import re
from typing import Any

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.missions.ensemble import LANES, NOT_PHYSICAL
from stmuav_jax.missions.truth import narrow_limits

missions = stm.missions
MISSION = {
    "format": 1, "name": "held", "t1": 2.0,
    "machine": {"scene": "hexacopter", "options": {"drag": {}, "motor": {}}},
    "rates": {"control": 200.0},
    "sensors": {"standing": 0.5},
    "faults": [{"sensor": "position", "at": 0.6, "until": 0.8}],
    "payloads": [{"body": "hexacopter", "mass": 0.02, "position": [0.02, 0.0, -0.05], "until": 1.0}],
    "wind": {"steady": [3.0, 0.0, 0.0], "gusts": {}},
    "tolerances": {"position": 0.08, "tilt": 15.0},
}  # fmt: skip
# the machine itself, one that is a tenth heavier, and one that cannot be; the rest are in between
SHARES = [1.0, 1.1, -1.0, *np.linspace(0.9, 1.05, 21), 1.0]
# and the machine itself with a payload that is five times as heavy
LOADS = [1.0] * 24 + [5.0]
FACTORS = {
    "bare.mass": {"distribution": "empirical", "values": SHARES},
    "payload_1.mass": {"distribution": "empirical", "values": LOADS},
    "rotor.k_tau": {"distribution": "constant", "value": 1.0},
}  # fmt: skip
HELD_STILL = {"scene": "hexacopter", "options": {"drag": {}}}
WITH_GEAR = {"scene": "hexacopter", "options": {"drag": {}, "gear": {}}}
TEXT = """
kind = "missions"
mission = "held.toml"
samples = 16

[factors]
"bare.mass" = {distribution = "normal", mean = 1.0, standard_deviation = 0.05, relative = true}
"""
HELD = """
format = 1
t1 = 0.5
machine = { scene = "hexacopter" }
"""


def make_study(mission):
    return missions.make_mission_study(
        mission, FACTORS, relative=frozenset(FACTORS), name="held", seed=5, design="table"
    )


@pytest.fixture(scope="module")
def mission():
    return missions.make_mission(MISSION)


@pytest.fixture(scope="module")
def study(mission):
    return make_study(mission)


@pytest.fixture(scope="module")
def columns(study):
    return study.compute(0, 24)


@pytest.mark.slow
@pytest.mark.parametrize("sample", [0, 24])
def test_a_flight_of_the_study_is_that_of_the_mission_alone(study, sample):
    """The undisturbed machine in the same gusts and noise, flown by `fly` and judged by `measures`."""
    columns = {name: values[0] for name, values in study.compute(sample, 1).items()}
    gusts, noise = np.random.SeedSequence((5, sample)).generate_state(2).astype(np.uint32)
    alone = MISSION | {"sensors": MISSION["sensors"] | {"seed": int(noise)}}
    alone["wind"] = MISSION["wind"] | {"gusts": {"seed": int(gusts)}}
    payload = dict(MISSION["payloads"][0])
    alone["payloads"] = [payload | {"mass": payload["mass"] * LOADS[sample]}]
    data = missions.to_data(missions.fly(missions.make_mission(alone)))
    found = {one.name: one.value for one in missions.measures(data)}
    assert columns["status"] == 1
    assert columns["end"] == pytest.approx(2.0)
    for name, value in (
        ("Largest position error", columns["position_error"]),
        ("Largest tilt error", np.degrees(columns["tilt_error"])),
        ("Smallest margin of the rotor speeds", 100 * columns["rotor_margin"]),
        ("Energy used, electrical", columns["energy"] / 3600),
    ):
        assert value == pytest.approx(found[name], rel=1e-6), name


@pytest.mark.slow
def test_the_truth_is_drawn_and_the_controllers_belief_is_not(columns):
    """A machine a tenth heavier than believed sags by g / 10 k, k = 9 1/s^2 being the gain; so it is lost.

    The wind adds some 3 cm across: 0.11 m in all.
    """
    sag = 9.81 * 0.1 / 9.0
    assert columns["position_error"][1] == pytest.approx(np.hypot(sag, 0.03), rel=0.15)
    assert columns["met"][1] == 0
    fine = columns["position_error"] <= 0.08
    assert np.all(columns["tilt_error"][3:] < np.radians(15.0))
    np.testing.assert_array_equal(columns["met"], fine)
    assert 0 < np.sum(fine) < 24
    # no body has such a mass
    assert columns["status"][2] == NOT_PHYSICAL
    assert np.isnan(columns["position_error"][2])
    assert columns["met"][2] == 0
    assert np.all(columns["status"][3:] == 1)
    assert len(set(columns["tilt_error"][3:])) == 21


@pytest.mark.slow
def test_a_sample_does_not_depend_on_others_and_a_study_is_resumed(study, columns, tmp_path):
    part = study.compute(5, 14)
    for name, values in part.items():
        np.testing.assert_array_equal(values, columns[name][5:19])
    store = tmp_path / "study.zarr"
    study.run(store, LANES)
    study.run(store, 24, resume=True)
    with stm.studies.open_store(store) as opened:
        data = opened.dataset()
    for name, values in columns.items():
        np.testing.assert_array_equal(data[name].values[:24], values)
    again = pickle.loads(pickle.dumps(study))
    assert again.identity == study.identity
    assert again.columns == study.columns


@pytest.mark.slow
@pytest.mark.parametrize(
    ("factor", "relative", "words"),
    [
        ("bare.mas", True, "no parameter of hexacopter"),
        ("geometry.rods", True, "cannot be a factor of a mission's study"),
        ("mass.panel_7", True, "has no effect on this mission"),
        ("bare.inertia", False, "name one entry"),
        ("gust.height", True, "has no effect on this mission"),
        ("payload_2.mass", True, "mean 'payload_1.mass'"),
    ],
)
def test_factors_that_cannot_be_drawn_are_refused(mission, factor, relative, words):
    names = frozenset({factor}) if relative else frozenset()
    with pytest.raises(stm.SettingError, match=words):
        missions.make_mission_study(mission, {factor: 1.0}, relative=names)


@pytest.mark.slow
def test_studies_that_cannot_be_flown_are_refused(tmp_path):
    (tmp_path / "held.toml").write_text(HELD)
    plain = {"kind": "missions", "mission": "held.toml", "factors": {"bare.mass": 1.0}}
    assert missions.load_mission_study(plain, tmp_path).evaluate.mission.file.name == "held"
    for change, words in (
        ({"mission_": "hover"}, "Did you mean 'mission'"),
        ({"mission": "hoover"}, "Did you mean 'hover'"),
        ({"mission": "none.toml"}, "There is no file"),
        ({"samples": 0}, "samples"),
        ({"factors": {}}, "factors"),
        ({"t1": -1.0}, "t1"),
    ):
        with pytest.raises((stm.SettingError, stm.io.FileError), match=words):
            missions.load_mission_study(plain | change, tmp_path)
    # what the flights of a study do not come to, and what it does not judge
    late = r"end at t = 2 s, before "
    for change, words in (
        ({"faults": [{"rotor": 1, "at": 9.0, "share": 0.9}], "machine": HELD_STILL},
         late + "the fault of rotor 1 at t = 9 s: give the study a later 't1'"),
        ({"tolerances": {"position": 0.1, "after": 5.0}},
         late + "the tolerances of position and tilt, which hold from t = 5 s on"),
        ({"path": {"waypoints": [{"t": t, "position": [0.0, 0.0, t / 10]} for t in (0.0, 3.0)]}},
         late + "waypoint 2 at t = 3 s"),
        ({"tolerances": {"sink": 0.1}, "machine": WITH_GEAR}, "does not support 'tolerances.sink'"),
    ):  # fmt: skip
        with pytest.raises(stm.SettingError, match=words):
            make_study(missions.make_mission(MISSION | change))


@pytest.mark.slow
def test_a_study_flies_what_single_flights_with_its_truth_do():
    """Errors, energy and charge of three machines, the last of which empties its battery on the way."""
    plain = {
        **{key: MISSION[key] for key in ("format", "name", "machine", "rates")},
        "t1": 1.5,
        "wind": {"steady": [3.0, 0.0, 0.0]},
        "payloads": MISSION["payloads"],
        "battery": {"state_of_charge": 0.9, "capacity": 5000.0},
        "tolerances": {"position": 0.2},
    }
    truths = [
        {"bare.mass": 5.0, "battery.capacity": 4000.0},
        {"payload_1.mass": 0.06, "bare.inertia[0, 0]": 0.06},
        {"battery.state_of_charge": 0.203, "rotor.k_f": 6.4e-6},
    ]
    mission = missions.make_mission(plain)
    usual = {
        name: mission.table.value(name) for truth in truths for name in truth if "[" not in name
    }
    usual |= {"bare.inertia[0, 0]": mission.table.value("bare.inertia")[0][0]}
    rows = {name: [truth.get(name, usual[name]) for truth in truths] for name in usual}
    factors = {
        name: {"distribution": "empirical", "values": values} for name, values in rows.items()
    }
    study = missions.make_mission_study(mission, factors, samples=3, design="table", lanes=8)
    table = study.compute(0, 3)
    flight: Any = None
    for k, truth in enumerate(truths):
        flight = missions.fly(missions.make_mission(plain | {"truth": truth}))
        signals = flight.run.rollout.signals
        errors = np.linalg.norm(signals["position_error"], axis=1)
        assert table["position_error"][k] == pytest.approx(np.max(errors), rel=1e-9)
        charge, power = signals["state_of_charge"][-1], signals["electric_power"]
        assert table["state_of_charge"][k] == pytest.approx(charge, rel=1e-12)
        assert table["energy"][k] == pytest.approx(np.sum(power[:-1]) / 200.0, rel=1e-9)
        assert table["end"][k] == pytest.approx(flight.run.ts[-1])
        assert (flight.ending == "battery empty") == (k == 2)
        assert bool(table["met"][k]) == (k < 2)
    assert flight.run.ts[-1] < 1.4
    # the controller goes on with the mission's numbers
    pilot: Any = lambda mission: mission.controller.pilot
    assert float(pilot(flight.mission).mass.mass) == pytest.approx(float(pilot(mission).mass.mass))


@pytest.mark.parametrize(
    ("truth", "words"),
    [
        ({"bare.mas": 3.0}, "'bare.mas' is no parameter of hexacopter. Did you mean 'bare.mass'?"),
        ({"bare.inertia[0, 0]": 9.0}, "'bare.inertia' violates the triangle inequality"),
        ({"bare.inertia": 3.0}, "name one entry, such as bare.inertia[0, 0]"),
        ({"mass.panel_7": 3.0}, "'mass.panel_7' has no effect on this mission"),
    ],
)
def test_a_truth_that_no_flight_has_is_refused(truth, words):
    with pytest.raises((stm.SettingError, stm.ModelError), match=re.escape(words)):
        missions.make_mission(MISSION | {"truth": truth})


def test_margins_of_a_study_are_those_of_the_motors_that_are_drawn():
    """The truth's motors give less than the controller believes."""
    motor = {"motor.highest": 1500.0, "motor.lowest": 100.0}
    table = stm.PART_II.replaced(motor)
    scene = stm.make_scene("hexacopter", parameters=table, motor=stm.uav.Motor())
    found = narrow_limits(stm.uav.RotorLimits(200.0, 1900.0), scene)
    assert found is not None
    low, high = found.squared(6)
    np.testing.assert_allclose(low, 200.0**2)
    np.testing.assert_allclose(high, 1500.0**2, rtol=1e-12)
