"""Monte Carlo studies of a mission: flights side by side, resumed, and refused before they begin."""

import pickle

import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra import compiler, kept
from stmuav_jax.cli import main
from stmuav_jax.missions.ensemble import LANES, NOT_PHYSICAL

missions = stm.missions
MISSION = {
    "format": 1, "name": "held", "t1": 2.0,
    "machine": {"scene": "hexacopter", "options": {"drag": {}, "motor": {}}},
    "rates": {"control": 200.0},
    "sensors": {"standing": 0.5},
    "wind": {"steady": [3.0, 0.0, 0.0], "gusts": {}},
    "tolerances": {"position": 0.08, "tilt": 15.0},
}  # fmt: skip
# the machine itself, one that is a tenth heavier, and one that cannot be; the rest are in between
SHARES = [1.0, 1.1, -1.0, *np.linspace(0.9, 1.05, 21)]
FACTORS = {
    "bare.mass": {"distribution": "empirical", "values": SHARES},
    "rotor.k_tau": {"distribution": "constant", "value": 1.0},
}  # fmt: skip
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


def study(factors=None, relative=frozenset(FACTORS), design="table", **changes):
    """Work of a study of the mission above."""
    sampling = stm.montecarlo.Sampling(FACTORS if factors is None else factors, 5, design)
    mission = missions.make_mission(MISSION | changes)
    return missions.MissionWork(mission, sampling, relative=relative, name="held")


@pytest.fixture(scope="module")
def work():
    return study()


@pytest.fixture(scope="module")
def columns(work):
    return work.run(0, 24)


# functions with executed annotations have no text, and only the slow tests run without
@pytest.mark.slow
def test_programs_kept_in_files_are_found_whatever_is_drawn(tmp_path, monkeypatch):
    names = []

    noted = lambda function, args, quick, key: names.append(key) or function
    other = FACTORS | {"bare.mass": {"distribution": "empirical", "values": [1.0, 1.1]}}
    kept.keep_programs(tmp_path / "programs")
    try:
        works = study(), study(other), study(sensors={"standing": 0.4})
        monkeypatch.setattr(compiler, "_compiled", noted)
        assert all(work._program for work in works)
    finally:
        kept.keep_programs(None)
    first, same, longer = names
    assert first is not None
    assert first == same != longer


@pytest.mark.slow
def test_a_flight_of_the_study_is_that_of_the_mission_alone(work, columns):
    """The undisturbed machine in the same gusts and noise, flown by `fly` and judged by `measures`."""
    gusts, noise = np.random.SeedSequence((5, 0)).generate_state(2).astype(np.uint32)
    alone = MISSION | {"sensors": MISSION["sensors"] | {"seed": int(noise)}}
    alone["wind"] = MISSION["wind"] | {"gusts": {"seed": int(gusts)}}
    data = missions.to_data(missions.fly(missions.make_mission(alone)))
    found = {one.name: one.value for one in missions.measures(data)}
    assert columns["status"][0] == 1
    assert columns["end"][0] == pytest.approx(2.0)
    for name, value in (
        ("Largest position error", columns["position_error"][0]),
        ("Largest tilt error", np.degrees(columns["tilt_error"][0])),
        ("Smallest margin of the rotor speeds", 100 * columns["rotor_margin"][0]),
        ("Energy used, electrical", columns["energy"][0] / 3600),
    ):
        assert value == pytest.approx(found[name], rel=1e-6), name


@pytest.mark.slow
def test_the_truth_is_drawn_and_the_controllers_belief_is_not(columns):
    """A machine a tenth heavier than believed sags by g / 10 k, k = 9 1/s^2 being the gain; so it is lost.

    The wind adds some 3 cm across: 0.11 m in all.
    """
    sag = 9.81 * 0.1 / 9.0
    assert columns["position_error"][1] == pytest.approx(np.hypot(sag, 0.03), rel=0.15)
    assert columns["kept"][1] == 0
    fine = columns["position_error"] <= 0.08
    assert np.all(columns["tilt_error"][3:] < np.radians(15.0))
    np.testing.assert_array_equal(columns["kept"], fine)
    assert 0 < np.sum(fine) < 24
    # no body has such a mass
    assert columns["status"][2] == NOT_PHYSICAL
    assert np.isnan(columns["position_error"][2])
    assert columns["kept"][2] == 0
    assert np.all(columns["status"][3:] == 1)
    assert len(set(columns["tilt_error"][3:])) == 21


@pytest.mark.slow
def test_a_sample_does_not_depend_on_others_and_a_study_is_resumed(work, columns, tmp_path):
    part = work.run(5, 14)
    for name, values in part.items():
        np.testing.assert_array_equal(values, columns[name][5:19])
    store = tmp_path / "study.zarr"
    stm.jobs.run_study(work, store, LANES)
    stm.jobs.run_study(work, store, 24, resume=True)
    with stm.files.open_store(store) as opened:
        data = opened.dataset()
    for name, values in columns.items():
        np.testing.assert_array_equal(data[name].values[:24], values)
    again = pickle.loads(pickle.dumps(work))
    assert again.identity == work.identity
    assert again.columns == work.columns


@pytest.mark.slow
def test_the_command_flies_a_study_and_reports_it(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "held.toml").write_text(HELD)
    (tmp_path / "study.toml").write_text(TEXT)
    assert main(["montecarlo", "study.toml", "--figures", "svg"]) == 0
    out = capsys.readouterr().out
    assert "16" in out
    assert "kept" in out
    assert (tmp_path / "runs" / "study" / "study.zarr").is_dir()
    assert main(["montecarlo", "study.toml", "--resume", "--figures", "none", "--lanes", "8"]) == 2
    assert "has no --lanes" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("factor", "relative", "words"),
    [
        ("bare.mas", True, "no parameter of hexacopter"),
        ("geometry.rods", True, "can be no factor of a mission's study"),
        ("mass.panel_7", True, "has no effect on this mission"),
        ("bare.inertia", False, "name one entry"),
        ("gust.height", True, "has no effect on this mission"),
    ],
)
def test_factors_that_cannot_be_drawn_are_refused(factor, relative, words):
    names = frozenset({factor}) if relative else frozenset()
    with pytest.raises(stm.SettingError, match=words):
        study({factor: 1.0}, names, "random")


def test_studies_that_cannot_be_flown_are_refused(tmp_path):
    (tmp_path / "held.toml").write_text(HELD)
    plain = {"kind": "missions", "mission": "held.toml", "factors": {"bare.mass": 1.0}}
    assert missions.mission_work(plain, tmp_path).mission.file.name == "held"
    for change, words in (
        ({"mission_": "hover"}, "Did you mean 'mission'"),
        ({"mission": "hoover"}, "Did you mean 'hover'"),
        ({"mission": "none.toml"}, "There is no file"),
        ({"samples": 0}, "samples"),
        ({"factors": {}}, "factors"),
        ({"t1": -1.0}, "t1"),
    ):
        with pytest.raises((stm.SettingError, stm.files.FileError), match=words):
            missions.mission_work(plain | change, tmp_path)
    with pytest.raises(stm.SettingError, match="has no battery"):
        study(battery={})
