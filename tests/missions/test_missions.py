"""Missions on a hexacopter: flown, interrupted and resumed, saved, and refused before the flight."""

import copy
import importlib.util
import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
import scipy.integrate
import xarray as xr
from helpers import check_same_types
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.algebra import compiler
from stmuav_jax.cli import main
from stmuav_jax.commands.fly import NOT_KEPT, UNFINISHED
from stmuav_jax.figures import loop_report
from stmuav_jax.files.netcdf import load_checkpoint, save_checkpoint, save_sealed
from stmuav_jax.missions.flight import _chunk
from stmuav_jax.missions.keep import load_reached, save_reached
from stmuav_jax.missions.outcome import labelled_flight

missions = stm.missions
ROOT = Path(__file__).parents[2]

TEXT = """
format = 1
name = "square"
t1 = 2.2

[machine]
scene = "hexacopter"
options = { drag = {} }

[rates]
control = 200.0

[path]
waypoints = [
    { t = 0.2, position = [0.0, 0.0, 0.0] },
    { t = 1.2, position = [0.3, 0.0, 0.1], heading = 10.0 },
    { t = 2.1, position = [0.3, 0.3, 0.1] },
]

[wind]
steady = [1.0, 0.0, 0.0]
gusts = { seed = 3 }
change = { to = [2.0, 1.0, 0.0], at = 1.0 }

[battery]
state_of_charge = 0.9

[tolerances]
position = 0.1
tilt = 15.0
"""


def plain(**changes):
    """Mission with some entries replaced, by names with double underscores; None removes."""
    content = copy.deepcopy(tomllib.loads(TEXT))
    for name, value in changes.items():
        *tables, last = name.split("__")
        at = content
        for table in tables:
            at = at.setdefault(table, {})
        if value is None:
            at.pop(last)
        else:
            at[last] = value
    return content


def chunks():
    """Keys of the programs that fly a chunk."""
    keys: list[Any] = list(compiler._programs)
    return {key for key in keys if key[0] is _chunk}


@pytest.fixture(scope="module")
def flight():
    there = chunks()
    found = missions.fly(missions.make_mission(plain()))
    # one program flies the first second and the others
    assert len(chunks() - there) <= 1 < len(found.run.ts) / 200
    return found


@pytest.fixture(scope="module")
def data(flight):
    return missions.to_data(flight)


def test_a_hexacopter_flies_along_its_waypoints(flight, data):
    assert flight.ending == ""
    assert data.sizes["time"] == 441
    place = data.position.sel(time=[1.2, 2.1], method="nearest").values[:, 0]
    np.testing.assert_allclose(place, [[0.3, 0.0, 0.1], [0.3, 0.3, 0.1]], atol=0.1)
    kept, words = missions.verdict(data)
    assert kept
    assert "t = 2.2 s of 2.2 s" in words
    # tolerances that hold from later on were not checked
    content = json.loads(data.attrs["mission"])
    content["tolerances"] |= {"after": 5.0, "position": 1e-9}
    later = data.assign_attrs(mission=json.dumps(content))
    kept, words = missions.verdict(later)
    assert kept
    assert "tolerances hold from 5 s on" in words
    # by hand: the error, and the thrust that the weight needs on the average
    off = np.linalg.norm(data.position.values[:, 0] - data.wanted_position.values, axis=1)
    assert missions.measures(data)[0].value == pytest.approx(np.max(off), rel=1e-12)
    assert np.max(off) > 1e-4
    squared = data.rotor_speed.values**2
    lift = stm.PART_II.value("rotor.k_f") * np.sum(squared, axis=1)
    assert np.mean(lift) == pytest.approx(9.81 * stm.PART_II.value("bare.mass"), rel=0.1)


def test_page_of_a_flight(flight, data, tmp_path, capsys, monkeypatch):
    """Its verdict, what it is judged by and the mission's entries; an early end stands out."""
    save_sealed(labelled_flight(flight), tmp_path / "flight.nc")
    assert main(["report", str(tmp_path)]) == 0
    assert "Flight: " in capsys.readouterr().out
    page, text = read(tmp_path / "report.html")
    # the mechanism; errors, margins, rotors, power; pose; inputs
    assert len(page.sources) == 7
    assert missions.verdict(data)[1] in text
    for one in missions.measures(data):
        assert f"{one.name} {one.value:.4g}".replace("-", "\u2212") in text
    assert re.search(r"Largest position error [\d.]+ m 0.1 kept", text)
    assert "Mission: wind.change.at 1" in text
    assert "Mission: tolerances.tilt 15" in text
    # a loop without a mission has what all loops have
    loop = data.drop_attrs().assign_attrs({k: v for k, v in data.attrs.items() if k != "mission"})
    stm.figures.write_loop_report(loop, tmp_path / "loop.html", dpi=40)
    page, text = read(tmp_path / "loop.html")
    assert len(page.sources) == 3
    assert "ran to its end at t = 2.2 s" in text
    monkeypatch.setattr(loop_report, "_pictures", lambda *_: iter(()))
    failed = data.assign_attrs(failure="The state is not finite at t = 1 s.", ending="failed")
    content = json.loads(data.attrs["mission"])
    content["tolerances"]["position"] = 1e-9
    missions.write_flight_report(
        failed.assign_attrs(mission=json.dumps(content)), tmp_path / "failed.html"
    )
    text = read(tmp_path / "failed.html")[1]
    assert "The state is not finite at t = 1 s." in text
    assert "Not kept: largest position error" in text


def test_powers_and_the_battery_by_hand(data):
    """Power by the drag torque; the charge by SciPy's integration of dQ/dt = -I."""
    speeds = data.rotor_speed.values
    power = stm.PART_II.value("rotor.k_tau") * np.sum(speeds**3, axis=1)
    np.testing.assert_allclose(data.rotor_power, power, rtol=1e-12)
    np.testing.assert_allclose(data.electric_power, power / 0.8 + 10.0, rtol=1e-12)
    table = {name: stm.parameters.ENERGY.value(f"battery.{name}") for name in (
        "capacity", "resistance", "state_of_charge", "open_circuit_voltage")}  # fmt: skip
    ts = data.time.values

    def rate(t, soc):
        U = np.interp(soc[0], table["state_of_charge"], table["open_circuit_voltage"])
        P = data.electric_power.values[min(int(t * 200 + 1e-9), len(ts) - 1)]
        R = table["resistance"]
        return [-(U - np.sqrt(U**2 - 4 * R * P)) / (2 * R) / table["capacity"]]

    found = scipy.integrate.solve_ivp(rate, (0.0, ts[-1]), [0.9], max_step=0.0025, rtol=1e-10)
    used = 0.9 - found.y[0, -1]
    assert 0.9 - data.state_of_charge.values[-1] == pytest.approx(used, rel=1e-4)


def test_a_flight_goes_on_with_the_program_of_its_first_second(flight):
    """Where it stands after a second has the shapes and types that it had at the start."""
    mission, rows = flight.mission, flight.reached.rows
    key = jax.random.key(0)
    first = jax.eval_shape(lambda: (mission.plant.reset(key), mission.controller.start()))
    later = jax.eval_shape(lambda: (rows.end, rows.memory))
    check_same_types(first, later)


def test_an_interrupted_flight_goes_on_to_the_last_bit(flight, data, tmp_path):
    mission = missions.make_mission(plain())

    def stop(done):
        if done > 0.3:
            raise KeyboardInterrupt

    part = missions.fly(mission, progress=stop)
    assert part.ending == "interrupted"
    assert part.reached.samples == 200
    data_so_far = missions.to_data(part)
    kept, words = missions.verdict(data_so_far)
    assert not kept
    assert "interrupted" in words
    path = save_reached(mission, part.reached, tmp_path / "part.npz")
    again = missions.to_data(missions.fly(mission, reached=load_reached(mission, path)))
    assert again.drop_attrs().identical(data.drop_attrs())
    other = missions.make_mission(plain(wind__gusts__seed=4))
    with pytest.raises(stm.files.FileError, match="of another mission"):
        load_reached(other, path)
    head, arrays = load_checkpoint(path, "a flight")
    save_checkpoint(path, head, arrays[:-1])
    with pytest.raises(stm.files.FileError, match="has not the arrays of a flight"):
        load_reached(mission, path)
    save_checkpoint(path, {**head, "signals": 3}, arrays)
    with pytest.raises(stm.files.FileError, match="'signals' must be a list"):
        load_reached(mission, path)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(stm.files.FileError, match="damaged"):
        load_reached(mission, path)


def test_an_empty_battery_ends_the_flight_with_its_results():
    mission = missions.make_mission(plain(battery__state_of_charge=0.2004))
    found = missions.fly(mission)
    assert found.ending == "battery empty"
    data = missions.to_data(found)
    charge = data.state_of_charge.values
    assert 10 < len(charge) < 400
    assert charge[-1] <= 0.2 < charge[-2]
    assert np.all(np.isfinite(data.position))


def test_a_rotor_that_fails_is_not_known_to_the_controller(data):
    faults = [{"rotor": 2, "share": 0.5, "at": 1.0}]
    found = missions.to_data(missions.fly(missions.make_mission(plain(faults=faults))))
    before = data.time.values < 1.0 - 1e-9
    np.testing.assert_array_equal(found.command.values[before], data.command.values[before])
    k = int(np.sum(before))
    np.testing.assert_allclose(found.command[k, 1], 0.5 * data.command[k, 1], rtol=1e-12)
    kept, words = missions.verdict(found)
    assert not kept
    assert "largest position error" in words


def test_a_rotor_that_is_known_to_be_lost_is_flown_without(data):
    """The same path in the same gusts, with yaw given up from the fault on."""
    faults = [{"rotor": 2, "at": 1.0, "known": True}]
    found = missions.to_data(missions.fly(missions.make_mission(plain(faults=faults))))
    before = data.time.values < 1.0 - 1e-9
    # another program: round-off, and what a second of flight makes of it
    np.testing.assert_allclose(found.command.values[before], data.command.values[before], rtol=1e-9)
    assert np.all(found.rotor_speed.values[~before, 1] == 0.0)
    kept, words = missions.verdict(found)
    assert kept, words


def test_a_flight_is_saved_and_loaded_with_equality(flight, data, tmp_path):
    path = stm.files.save_loop(flight.run, tmp_path / "loop.nc")
    loaded = stm.files.load(path)
    np.testing.assert_array_equal(loaded.position, flight.run.states.r)
    np.testing.assert_array_equal(loaded.command, flight.run.rollout.inputs)
    assert list(loaded.input_unit.values) == ["rad^2/s^2"] * 6
    np.testing.assert_array_equal(loaded.tilt_error, data.tilt_error)
    assert loaded.tilt_error.units == "see description"
    assert data.tilt_error.units == "rad"
    # thrusts are found from the rotors of the plant, speeds by the signals of the mission
    k_f = float(flight.mission.machine.rotors.k_f)
    np.testing.assert_allclose(data.rotor_thrust, k_f * data.rotor_speed**2, rtol=1e-12)
    shown = re.findall(r'"title":"([^"]*)"', stm.view(data).html)
    assert {"thrust of rotors [N]", "tilt error [rad]", "position error [m]"} <= set(shown)


def test_the_command_flies_a_file(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(TEXT)
    assert main(["fly", "mine.toml", "--figures", "svg"]) == 0
    out = capsys.readouterr().out
    assert "Largest position error" in out
    folder = tmp_path / "runs" / "square"
    assert {path.name for path in folder.iterdir()} == {
        "flight.nc", "errors.svg", "margins.svg", "rotors.svg", "power.svg"
    }  # fmt: skip
    assert isinstance(stm.files.load(folder / "flight.nc"), xr.Dataset)
    (tmp_path / "mine.toml").write_text(TEXT.replace("tilt = 15.0", "tilt = 0.1"))
    assert main(["fly", "mine.toml", "--figures", "none"]) == NOT_KEPT
    (folder / UNFINISHED).write_bytes(b"")
    assert main(["fly", "mine.toml"]) == 2
    assert "--resume" in capsys.readouterr().err
    assert main(["fly", "mine.toml", "--resume"]) == 2
    assert "damaged" in capsys.readouterr().err
    assert main(["fly", "hoover"]) == 2
    assert "Did you mean 'hover'?" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"speed": 3.0}, "A mission has no entry 'speed'"),
        ({"rates__contrl": 3.0}, "Did you mean 'control'"),
        ({"format": 2}, "reads format 1 alone"),
        ({"t1": 0.0}, "'t1' must be finite and positive"),
        ({"t1": 2.2013}, "whole number of control periods"),
        ({"machine__scene": "tracker"}, "must be hexacopter or uav_tracker"),
        ({"machine__model": "x.toml"}, "a scene or a model's file, and not both"),
        ({"machine__options": {}}, "options.drag"),
        ({"machine__options": {"drga": {}}}, "no drga"),
        ({"path__position": [0.0, 0.0, 0.0]}, "neither position nor heading"),
        ({"path__waypoints": [{"t": 0.0, "position": [0.0] * 3}]}, "two or more, with times"),
        (
            {"path__waypoints": [
                {"t": 0.0, "position": [0.0] * 3}, {"t": 0.3, "position": [3.0, 0.0, 0.0]}
            ]},
            "The path needs a thrust of",
        ),
        ({"controller__highest": 800.0}, "cannot carry the weight"),
        ({"controller__servo": {"frequency": 9.0}}, "needs the tracker"),
        ({"panel": [{"angles": [1.0, 2.0]}]}, "needs the tracker"),
        ({"faults": [{"rotor": 7, "at": 1.0}]}, "no rotor 7"),
        ({"faults": [{"at": 1.0}]}, "needs a rotor or a slider"),
        ({"faults": [{"rotor": 2, "share": 0.5, "at": 1.0, "known": True}]}, "must be the loss of a"),
        (
            {"faults": [{"rotor": 1, "at": 1.0, "known": True}], "controller__highest": 1300.0},
            "cannot be held without rotor 1",
        ),
        ({"wind__steady": [0.0, 0.0, 0.0]}, "must not be zero"),
        ({"tolerances__sink": 0.01}, "'tolerances.sink' needs a landing gear"),
        ({"tolerances__touchdown": 0.0}, "'tolerances.touchdown' must be finite and positive"),
        ({"sensors": {"position": {"rate": 33.0}}}, "not a whole part"),
        ({"payload": {"mass": 0.1, "position": [0.0, 0.0, 0.0]}}, r"\[payload\] needs the tracker"),
        ({"controller__payload": "known"}, r"known, but the mission has no \[payload\]"),
        ({"controller__payload": "estimated"}, "from gyroscope and accelerometer"),
        ({"battery__state_of_charge": 0.2, "battery__reserve": 0.3}, "above its reserve"),
    ],
    ids=lambda x: "" if isinstance(x, str) else None,
)  # fmt: skip
def test_missions_that_cannot_be_flown_are_refused(changes, words):
    with pytest.raises((stm.SettingError, stm.ModelError), match=words):
        missions.make_mission(plain(**changes))


def test_the_table_of_flights_is_that_of_its_script(data):
    """It has a row for each ready mission, in one order; a flight replaces its own row alone."""
    spec = importlib.util.spec_from_file_location("table", ROOT / "docs" / "make_missions.py")
    assert spec is not None
    assert spec.loader is not None
    table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(table)
    page = (ROOT / "docs" / "missions.md").read_text(encoding="utf-8")
    rows = table.rows_of(page)
    assert sorted(rows) == sorted(table.ORDER) == sorted(missions.mission_names())
    assert table.with_rows(page, rows) == page
    own = table.row("gusts", data)
    cells = [cell.strip() for cell in own.strip("|\n").split("|")]
    largest = np.linalg.norm(data.position_error.values, axis=1).max()
    assert cells[:2] == ["`gusts`", "2.2 s"]
    assert cells[2] == f"{100 * largest:.2g} cm"
    assert cells[4::2] == ["", ""]
    assert cells[-1] == "kept"
    changed = table.with_rows(page, rows | {"gusts": own})
    assert table.rows_of(changed) == rows | {"gusts": own}
    fallen = data.assign(position_error=1000.0 * data.position_error)
    assert table.row("gusts", fallen).endswith("| | | | | | it falls |\n")
    off = data.assign(position_error=2.0 * data.position_error / largest * 0.1)
    assert "| 20 cm, not kept |" in table.row("gusts", off)
