"""The ready missions: their files, and flights of those that need more than a hexacopter in the air."""

import re
import tomllib
from pathlib import Path

import equinox as eqx
import jax
import numpy as np
import pytest
import xarray as xr
from helpers import check_same_types

import stmuav_jax as stm
from stmuav_jax.checks.schema import validate_model
from stmuav_jax.cli.fly import Fly
from stmuav_jax.cli.main import main
from stmuav_jax.missions.flight import _Chunk, _fly_chunk
from stmuav_jax.missions.mission import LIBRARY
from stmuav_jax.missions.outcome import _largest_error, _of_gear
from stmuav_jax.missions.schema import MissionFile, TolerancesEntry

missions = stm.missions
ROOT = Path(__file__).parents[2]


def test_the_ready_missions_and_the_pages_example_fit_the_schema():
    page = (ROOT / "docs" / "control_and_missions.md").read_text(encoding="utf-8")
    texts = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    assert len(texts) == 1
    names = missions.mission_names()
    assert {"hover", "case-1", "case-2", "case-3", "sun-slew", "waypoints", "gusts"} <= set(names)
    texts += [(LIBRARY / f"{name}.toml").read_text(encoding="utf-8") for name in names]
    for text in texts:
        validate_model(MissionFile, {"name": "a"} | tomllib.loads(text), "A mission")
    assert set(names) <= set(
        re.findall(r"`([a-z0-9-]+)`", page.split("\n## Missions\n")[1].split("## In Python")[0])
    )
    listed = str(Fly.__doc__).replace("case-1 to case-3", "case-1 case-2 case-3")
    assert all(name in listed for name in names)


def test_a_touchdown_follows_a_time_in_flight_and_rebounds_do_not():
    """Of a made-up record: stands, flies, touches down, rebounds, stands."""
    ts = np.arange(100) * 0.02
    load = np.where((ts < 0.5) | (ts > 1.01), 30.0, 0.0)
    load[55:58] = 0.0
    v = np.zeros((100, 1, 3))
    v[:, 0, 2] = -0.01 * np.arange(100)
    time = {"time": ts}
    data = xr.Dataset(
        {"gear_load": ("time", load), "gear_depth": ("time", load / 1e4 - 1e-3),
         "velocity": (("time", "body", "axis"), v)}, time,
    )  # fmt: skip
    wanted = TolerancesEntry(touchdown=0.4, sink=0.1)
    speed, sink, carried = _of_gear(data, wanted)
    assert (speed.value, speed.allowed, speed.is_met) == (pytest.approx(0.5), 0.4, False)
    assert (sink.value, sink.is_met) == (pytest.approx(2e-3), True)
    assert carried.value == 30.0
    late = _largest_error(data, "position", ts, "m", 1.0, 0.2)
    assert late.name == "Largest position error from 0.2 s on in flight"
    assert (late.value, late.is_met) == (ts[load == 0.0][-1], False)
    never = data.assign(gear_load=("time", np.full(100, 30.0)))
    assert _largest_error(never, "position", ts, "m", 1.0, 0.2).value == 0.0
    assert [one.name for one in _of_gear(never, wanted)] == [sink.name, carried.name]
    # shorter than the time in flight that a touchdown takes
    assert len(_of_gear(data.isel(time=slice(0, 3)), TolerancesEntry())) == 2


@pytest.mark.slow
def test_a_flight_on_sensors_goes_on_with_the_program_of_its_first_second():
    mission, key = missions.load_mission("slew-30"), jax.random.key(0)
    plant, controller = mission.plant, mission.controller
    first = jax.eval_shape(lambda: (plant.reset(key), controller.start()))
    run = _Chunk(controller, mission.references, mission.gauges, 2)
    found = eqx.filter_eval_shape(_fly_chunk, run, plant, *first)
    check_same_types(first, (found.end, found.memory))


@pytest.mark.slow
def test_the_page_on_missions_runs(capsys):
    page = (ROOT / "docs" / "control_and_missions.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page.split("\n## Missions\n")[1], re.DOTALL)
    names: dict = {}
    exec(code, names)
    assert float(names["data"].position[-1, 0, 2]) == pytest.approx(0.5, abs=0.01)


@pytest.mark.slow
def test_case_1_is_flown_by_the_command(tmp_path, capsys):
    """On sensors, within what its file asks for; and references out of the tracker's reach are refused."""
    assert main(["fly", "case-1", "--t1", "8", "--out", str(tmp_path)]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert "Largest panel error" in shown
    assert "All tolerances and limits were met." in shown
    assert (tmp_path / "panel.png").exists()
    page = tmp_path / "report.html"
    assert main(["view", str(tmp_path), "--report", str(page)]) == 0
    assert "<figcaption>Forces</figcaption>" in page.read_text()
    uav = {"format": 1, "name": "a", "t1": 3.0, "machine": {"scene": "uav_tracker"}}
    sun = {"lat": 11.55, "lon": 104.92, "date": "2024-03-21", "hour": 22.0}
    berlin = sun | {"hour": 2.5, "timezone": "Europe/Berlin"}
    apia = sun | {"date": "2011-12-30", "timezone": "Pacific/Apia"}
    for panel, words in (
        ([{"angles": [70.0, 0.0]}], "slider 3 would have to stand at"),
        ([{"direction": [1.0, 0.0, 0.2]}], "The panel cannot follow its reference"),
        ([{"sun": sun}], "degrees below the horizon"),
        ([{"sun": sun | {"timezone": "Asia/Phnom_Pen"}}], "Did you mean 'Asia/Phnom_Penh'"),
        (
            [{"sun": berlin | {"date": "2024-03-31"}}],
            "no time 2024-03-31 02:30:00 in Europe/Berlin",
        ),
        ([{"sun": berlin | {"date": "2024-10-27"}}], "happens twice in Europe/Berlin"),
        ([{"sun": apia}], "There was no 2011-12-30 in Pacific/Apia"),
        ([{"angles": [0.0, 0.0]}, {"direction": [0.0, 0.0, 1.0]}], "must all be to angles"),
        ([{"at": 1.0}], "one of angles, direction and sun"),
    ):
        with pytest.raises(stm.SettingError, match=words):
            missions.make_mission(uav | {"panel": panel})


@pytest.mark.slow
def test_a_flight_starts_and_ends_on_the_ground(tmp_path, capsys):
    """The ready mission: it stands, takes off, lands slowly, and stands where it stood."""
    assert main(["fly", "takeoff-and-land", "--figures", "none", "--out", str(tmp_path)]) == 0
    words = capsys.readouterr().out
    assert "Largest touchdown speed" in words
    data = stm.io.load(tmp_path / "flight.nc")
    z, load, ts = data.position.values[:, 0, 2], data.gear_load.values, data.time.values
    weight = 9.81 * stm.PART_II.value("bare.mass")
    thrust = stm.PART_II.value("rotor.k_f") * np.sum(data.rotor_speed.values**2, axis=1)
    for at in ((ts > 0.5) & (ts < 1.0), ts > 21.5):
        # it stands: thrust and gear carry the weight, at the depth of what the gear carries
        np.testing.assert_allclose((thrust + load)[at], weight, rtol=1e-3)
        np.testing.assert_allclose(z[at], -load[at] / (4 * 2e4) - 0.5e-3, atol=2e-6)
        np.testing.assert_allclose(thrust[at] / weight, 1 - 9 * 0.8 / 9.81, atol=2e-3)
    aloft = (ts > 8.0) & (ts < 14.0)
    assert not np.any(load[aloft])
    assert np.max(z) == pytest.approx(1.0, abs=0.01)
    # touchdowns by hand: no load for a tenth of a second before; the first is the fastest
    down, *_ = [k for k in range(40, len(ts)) if load[k] and not np.any(load[k - 40 : k])]
    (speed,) = [one for one in missions.measures(data) if one.name == "Largest touchdown speed"]
    assert speed.value == pytest.approx(-data.velocity.values[down - 1, 0, 2], rel=1e-12)
    assert 0.1 < speed.value < 0.5
    # a mass on springs: the energy of the touchdown bounds the sink
    deepest = np.max(data.gear_depth.values)
    assert deepest < 0.5e-3 + load[-1] / 8e4 + speed.value * np.sqrt(
        stm.PART_II.value("bare.mass") / 8e4
    )
    assert float(data.tilt_error.max()) < np.radians(1.0)
