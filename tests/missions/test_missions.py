"""Missions on a hexacopter: flown, interrupted, saved, and refused before the flight."""

import copy
import importlib.util
import inspect
import json
import re
import tomllib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest
import scipy.integrate
import xarray as xr
from helpers import check_same_types
from html_pages import read

import stmuav_jax as stm
from stmuav_jax.cli.fly import NOT_KEPT
from stmuav_jax.cli.main import main
from stmuav_jax.io.netcdf import save_sealed
from stmuav_jax.math import compiler
from stmuav_jax.missions import mission as mission_module
from stmuav_jax.missions.flight import _fly_chunk, describe_failure
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
    return {key for key in keys if key[0] is _fly_chunk}


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


@pytest.mark.slow
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
    off = np.linalg.norm(data.position.values[:, 0] - data.reference_position.values, axis=1)
    assert missions.measures(data)[0].value == pytest.approx(np.max(off), rel=1e-12)
    assert np.max(off) > 1e-4
    squared = data.rotor_speed.values**2
    lift = stm.PART_II.value("rotor.k_f") * np.sum(squared, axis=1)
    assert np.mean(lift) == pytest.approx(9.81 * stm.PART_II.value("bare.mass"), rel=0.1)


@pytest.mark.slow
def test_report_of_a_flight(flight, data, tmp_path):
    """Its verdict, what it is judged by and the mission's entries; an early end stands out."""
    save_sealed(labelled_flight(flight), tmp_path / "flight.nc")
    target = tmp_path / "report.html"
    assert main(["view", str(tmp_path), "--report", str(target)]) == 0
    page, text = read(target)
    # the mechanism; errors, margins, rotors, power; pose; inputs
    assert len(page.sources) == 7
    assert missions.verdict(data)[1] in text
    for one in missions.measures(data):
        assert f"{one.name} {one.value:.4g}" in text
    assert re.search(r"Largest position error [\d.]+ m 0.1 met", text)
    assert "mission: wind.change.at 1" in text
    # a loop without a mission has what all loops have, and says that it failed
    attributes = {k: v for k, v in data.attrs.items() if k != "mission"}
    attributes["failure"] = "The state is not finite at t = 1 s."
    loop = data.drop_attrs().assign_attrs(attributes)
    page, text = read(stm.figures.write_report(loop, tmp_path / "loop.html", dpi=40))
    assert len(page.sources) == 2
    assert "not finite at t = 1 s." in text


def test_powers_and_the_battery_by_hand(data):
    """Power by the drag torque; the charge by SciPy's integration of dQ/dt = -I."""
    speeds = data.rotor_speed.values
    power = stm.PART_II.value("rotor.k_tau") * np.sum(speeds**3, axis=1)
    np.testing.assert_allclose(data.rotor_power, power, rtol=1e-12)
    np.testing.assert_allclose(data.electric_power, power / 0.8 + 10.0, rtol=1e-12)
    table = {name: stm.uav.ENERGY.value(f"battery.{name}") for name in (
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
    mission, rows = flight.mission, flight.run.rollout
    key = jax.random.key(0)
    first = jax.eval_shape(lambda: (mission.plant.reset(key), mission.controller.start()))
    later = jax.eval_shape(lambda: (rows.end, rows.memory))
    check_same_types(first, later)


def test_an_interrupted_flight_keeps_what_was_flown(data):
    mission = missions.make_mission(plain())

    def stop(done):
        if done > 0.3:
            raise KeyboardInterrupt

    part = missions.fly(mission, progress=stop)
    assert part.ending == "interrupted"
    flown = missions.to_data(part)
    kept, words = missions.verdict(flown)
    assert not kept
    assert "interrupted" in words
    np.testing.assert_array_equal(flown.command.values, data.command.values[:200])


def test_an_empty_battery_ends_the_flight_with_its_results():
    mission = missions.make_mission(plain(battery__state_of_charge=0.2004))
    found = missions.fly(mission)
    assert found.ending == "battery empty"
    data = missions.to_data(found)
    charge = data.state_of_charge.values
    assert 10 < len(charge) < 400
    assert charge[-1] <= 0.2 < charge[-2]
    assert np.all(np.isfinite(data.position))


@pytest.mark.slow
def test_a_rotor_that_fails_is_not_known_to_the_controller(data):
    # the second fault, listed first, leaves a share of the whole thrust too
    faults = [{"rotor": 2, "share": 0.3, "at": 1.5}, {"rotor": 2, "share": 0.5, "at": 1.0}]
    mission = missions.make_mission(plain(faults=faults))
    flown = missions.fly(mission)
    found = missions.to_data(flown)
    before = data.time.values < 1.0 - 1e-9
    np.testing.assert_array_equal(found.command.values[before], data.command.values[before])
    k = int(np.sum(before))
    np.testing.assert_allclose(found.command[k, 1], 0.5 * data.command[k, 1], rtol=1e-12)
    # the pilot, at the states that were flown, asks for what the rotor gives a share of
    pilot: Any = mission.controller.pilot
    asked_at = jax.jit(lambda t, x: pilot(x, mission.references(t).waypoint, pilot.start())[0][1])
    for t, share in ((0.5, 1.0), (1.25, 0.5), (1.75, 0.3)):
        k = round(200 * t)
        state = jax.tree.map(lambda x, k=k: jax.numpy.asarray(x[k]), flown.run.states)
        asked = asked_at(jax.numpy.asarray(t), state)
        np.testing.assert_allclose(found.command[k, 1], share * asked, rtol=1e-9)
    kept, words = missions.verdict(found)
    assert not kept
    assert "largest position error" in words


@pytest.mark.slow
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
    path = stm.io.save_loop(flight.run, tmp_path / "loop.nc")
    loaded = stm.io.load(path)
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
    assert isinstance(stm.io.load(folder / "flight.nc"), xr.Dataset)
    (tmp_path / "mine.toml").write_text(TEXT.replace("tilt = 15.0", "tilt = 0.1"))
    assert main(["fly", "mine.toml", "--figures", "none"]) == NOT_KEPT
    assert main(["fly", "hoover"]) == 2
    assert "Did you mean 'hover'?" in " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"speed": 3.0}, "A mission has no entry 'speed'"),
        ({"format": 2}, "reads format 1 alone"),
        ({"t1": 0.0}, "'t1' must be greater than 0"),
        ({"t1": 2.2013}, "whole number of control periods"),
        ({"machine__scene": "tracker"}, "must be 'hexacopter' or 'uav_tracker'"),
        ({"machine__model": "x.toml"}, "a scene or a model's file, and not both"),
        ({"machine__options": {}}, "options.drag"),
        ({"path__position": [0.0, 0.0, 0.0]}, "either waypoints or a position, heading"),
        ({"path__waypoints": [{"t": 0.0, "position": [0.0] * 3}]}, "two or more, with times"),
        (
            {"path__waypoints": [
                {"t": 0.0, "position": [0.0] * 3}, {"t": 0.3, "position": [3.0, 0.0, 0.0]}
            ]},
            "The path needs a thrust of",
        ),
        ({"controller__highest": 800.0}, "cannot carry the weight"),
        ({"controller__servo": {"frequency": 9.0}}, "needs the tracker"),
        ({"faults": [{"rotor": 7, "at": 1.0}]}, "no rotor 7"),
        ({"faults": [{"at": 1.0}]}, "one of a rotor, a slider and a sensor"),
        ({"faults": [{"rotor": 2, "share": 0.5, "at": 1.0, "known": True}]}, "must be the loss of a"),
        (
            {"faults": [{"rotor": 1, "at": 1.0, "known": True}], "controller__highest": 1300.0},
            "cannot be held without rotor 1",
        ),
        ({"wind__steady": [0.0, 0.0, 0.0]}, "must not be zero"),
        ({"tolerances__sink": 0.01}, "'tolerances.sink' needs a landing gear"),
        ({"sensors": {"position": {"rate": 33.0}}}, "does not divide"),
        ({"payload": {"mass": 0.1, "position": [0.0, 0.0, 0.0]}}, r"\[payload\] needs the tracker"),
        ({"controller__payload": "known"}, r"known, but the mission has no \[payload\]"),
        ({"controller__payload": "estimated"}, "from gyroscope and accelerometer"),
        ({"battery__state_of_charge": 0.2, "battery__reserve": 0.3}, "above its reserve of 0.3"),
        # the reserve of the table, which is used where none is given
        ({"battery__state_of_charge": 0.1}, "above its reserve of 0.2, but it is 0.1"),
        ({"controller__highest": 2500.0, "machine__options__motor": {}},
         "'controller.highest' is 2500 rad/s, but the motors turn no faster than 1900 rad/s"),
        ({"controller__lowest": 50.0, "machine__options__motor": {}},
         "'controller.lowest' is 50 rad/s, but the motors turn no more slowly than 200 rad/s"),
        ({"faults": [{"rotor": 1, "at": 1.0, "share": 0.5}, {"rotor": 1, "at": 1.0}]},
         "Rotor 1 has two faults at t = 1 s"),
        ({"faults": [{"rotor": 1, "at": 1.0, "known": True}, {"rotor": 1, "at": 1.5, "share": 0.5}]},
         "Rotor 1 is lost from t = 1 s on, so that its fault at t = 1.5 s has no effect"),
        ({"faults": [{"slider": 2, "at": 1.5}, {"slider": 2, "at": 1.0}]},
         "Slider 2 is jammed from t = 1 s on"),
        ({"path": {"acceleration": [0.0, 0.0, -12.0]}}, "thrust that points downwards at t = 0 s"),
        ({"path": {"position": [5.0, 0.0, 0.0]}}, "begins with a step of 5 m: the path begins at"),
        ({"path": {"heading": 170.0}}, "begins with a step of 170 degrees"),
        ({"path": {}, "machine__options__start": {"vx": 2.0}}, "begins with a step of 2 m/s"),
        ({"path": {}, "machine__options__start": {"r": 0.3}}, "begins with a step of 0.3 rad/s"),
        ({"sensors": {"gyroscope": {"rate": 100.0}}},
         "'sensors.gyroscope' must read at every control period, at 200 Hz, and without delay"),
        ({"sensors": {"attitude": {"delay": 0.012}}}, "'sensors.attitude.delay' must be a whole number"),
        ({"sensors": {"gyroscope": {"noise": -1e-3}}}, "noise' must not be negative, but it is -0.001"),
        ({"rates__delay": 0.1}, "closed loop of the position and attitude is unstable"),
    ],
    ids=lambda x: "" if isinstance(x, str) else None,
)  # fmt: skip
def test_missions_that_cannot_be_flown_are_refused(changes, words):
    with pytest.raises((stm.SettingError, stm.ModelError), match=words):
        missions.make_mission(plain(**changes))


@pytest.mark.parametrize(
    "changes",
    [
        {"sensors": {"gyroscope": {"rate": 100.0}}}, {"sensors": {"encoders": {"rate": 33.0}}},
        {"battery__state_of_charge": 0.1}, {"faults": [{"at": 1.0}]}, {"t1": 2.2013},
        {"rates__delay": 0.0013}, {"machine__scene": "uav_tracker", "panel": [{"at": 1.0}]},
    ],
)  # fmt: skip
def test_what_the_entries_tell_alone_is_refused_before_a_machine_is_made(changes, monkeypatch):
    monkeypatch.setattr(mission_module, "machine_of", lambda *_: pytest.fail("a machine was made"))
    with pytest.raises(stm.SettingError):
        missions.make_mission(plain(**changes))


@pytest.mark.parametrize(
    ("moves", "words"),
    [
        ([{"angles": [0.0, 0.0], "at": 3.0}, {"angles": [5.0, 0.0], "at": 1.0}],
         "move 2 begins at t = 1 s, before the end of move 1 at 4 s"),
        ([{"angles": [0.0, 0.0], "at": 0.5, "duration": 2.0}, {"angles": [5.0, 0.0], "at": 1.0}],
         "move 2 begins at t = 1 s, before the end of move 1 at 2.5 s"),
    ],
)  # fmt: skip
def test_moves_of_the_panel_follow_one_another(moves, words):
    uav = {"format": 1, "name": "a", "t1": 5.0, "machine": {"scene": "uav_tracker"}}
    with pytest.raises(stm.SettingError, match=words):
        missions.make_mission(uav | {"panel": moves})


def test_a_path_may_begin_elsewhere_where_a_step_is_wanted():
    step = {"position": [1.0, 0.0, 0.0], "heading": 90.0, "step": True}
    path: Any = missions.make_mission(plain(path=step)).references.path
    np.testing.assert_allclose(path.r, [1.0, 0.0, 0.0])
    # held where it starts, the machine keeps its heading
    turned = missions.make_mission(plain(path={}, machine__options__start={"yaw": 0.7}))
    path = turned.references.path
    assert float(path.heading) == pytest.approx(0.7, rel=1e-12)


def test_the_verdict_names_what_a_flight_did_not_come_to(data):
    """Of a flight of 2.2 s: waypoints, faults, moves of the panel and a change of the wind after it."""
    content = json.loads(data.attrs["mission"])
    content["path"]["waypoints"][2]["t"] = 6.0
    content["faults"] = [
        {"rotor": 1, "slider": None, "at": 50.0},
        {"rotor": 2, "slider": None, "at": 2.2},
        {"rotor": None, "slider": None, "sensor": "position", "at": 0.5, "until": 3.0},
    ]
    content["wind"]["change"] = {"to": [2.0, 0.0, 0.0], "at": 2.1, "rise": 0.2}
    content["panel"] = [{"at": 1.0, "duration": 1.2}, {"at": 30.0, "duration": 1.0}]
    kept, words = missions.verdict(data.assign_attrs(mission=json.dumps(content)))
    assert not kept
    assert words == (
        "It flew to t = 2.2 s of 2.2 s. It ended before waypoint 3 at t = 6 s, the end of move 2 of the "
        "panel at t = 31 s, the fault of rotor 1 at t = 50 s, the fault of rotor 2 at t = 2.2 s, the end of "
        "the fault of sensor position at t = 3 s, the end of the wind's change at t = 2.3 s. Until then, "
        "tolerances and limits were met."
    )


def test_the_verdict_says_that_a_loop_is_unstable_that_was_flown(data):
    assert float(data.attrs["growth"]) == 1.0
    kept, words = missions.verdict(data.assign_attrs(growth=2.5))
    assert kept
    assert "closed loop is unstable: small motions about hover grow 2.5-fold in a second." in words


def test_a_failed_flight_names_the_first_limit_that_it_left():
    """Of a made-up record: slider 3 leaves its stroke, then the base falls over, then numbers end."""
    limits = SimpleNamespace(lower=np.full(2, -0.02), upper=np.full(2, 0.03))
    machine = SimpleNamespace(limits=limits, force=9.0)
    ts = np.arange(6) * 0.01
    strokes = np.zeros((6, 2))
    strokes[3:, 1] = -0.025
    signals = {
        "displacement": strokes, "commanded_force": np.zeros((6, 2)),
        "tilt_error": np.where(ts > 0.035, 2.0, 0.1),
    }  # fmt: skip
    mission: Any = SimpleNamespace(machine=machine)
    rows: Any = SimpleNamespace(ts=ts, signals=signals)
    certificate = SimpleNamespace(t_end=0.05)
    failure = "Number 3 of the estimate was not finite."
    run: Any = SimpleNamespace(failure=failure, ts=ts, certificate=certificate)
    describe = inspect.unwrap(describe_failure)
    assert describe(mission, rows, run) == (
        "The flight got out of control: at t = 0.03 s slider 3 left its stroke of -0.02 to 0.03 m, and "
        "after t = 0.05 s its motion had diverged: its numbers were no longer finite."
    )
    signals["commanded_force"][1, 0] = -9.5
    assert "at t = 0.01 s the servo commanded slider 2 more than 9 N" in describe(
        mission, rows, run
    )
    calm: Any = SimpleNamespace(ts=ts[:3], signals={name: x[:1] for name, x in signals.items()})
    # rows that end before the numbers do: the battery could not give the fourth
    assert "at t = 0.03 s its power demand exceeded that of the battery" in describe(
        mission, calm, run
    )
    certificate.t_end = 0.02
    assert describe(mission, calm, run) == run.failure


def test_the_table_of_flights_is_that_of_its_script(data):
    """It has a row for each ready mission, in one order; a flight replaces its own row alone."""
    spec = importlib.util.spec_from_file_location("table", ROOT / "docs" / "make_missions.py")
    assert spec is not None
    assert spec.loader is not None
    table = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(table)
    page = (ROOT / "docs" / "control_and_missions.md").read_text(encoding="utf-8")
    rows = table.rows_of(page)
    assert sorted(rows) == sorted(table.ORDER) == sorted(missions.mission_names())
    assert table.with_rows(page, rows) == page
    own = table.row("gusts", data)
    cells = [cell.strip() for cell in own.strip("|\n").split("|")]
    largest = np.linalg.norm(data.position_error.values, axis=1).max()
    assert cells[:2] == ["`gusts`", "2.2 s"]
    assert cells[2] == f"{100 * largest:.2g} cm"
    assert cells[4::2] == ["-", "-"]
    assert cells[-1] == "met"
    changed = table.with_rows(page, rows | {"gusts": own})
    assert table.rows_of(changed) == rows | {"gusts": own}
    fallen = data.assign(position_error=1000.0 * data.position_error)
    assert table.row("gusts", fallen).endswith("| | | | | | it falls |\n")
    off = data.assign(position_error=2.0 * data.position_error / largest * 0.1)
    assert "| 20 cm, not met |" in table.row("gusts", off)
