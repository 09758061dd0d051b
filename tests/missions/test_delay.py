"""Missions whose commands act late: the default servo follows the delay, and unstable loops are refused."""

import jax
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.cli.main import main
from stmuav_jax.missions import mission as mission_module
from stmuav_jax.missions.machine import default_servo_frequency
from stmuav_jax.missions.schema import RatesEntry
from stmuav_jax.uav.panel_servo import panel_motion
from stmuav_jax.uav.stability import Hover
from stmuav_jax.uav.tracker.kinematics import stroke_motion

missions = stm.missions

# noisy sensors, gusts, a payload that the controller does not know, and commands 5 ms late
LATE = {
    "format": 1, "name": "late", "t1": 1.5,
    "machine": {"scene": "uav_tracker", "options": {"drag": {}}},
    "rates": {"delay": 0.005},
    "sensors": {},
    "payload": {"mass": 0.35, "position": [0.02, 0.01, 0.03]},
    "panel": [{"angles": [10.0, 5.0], "at": 0.3, "duration": 0.8}],
    "wind": {"steady": [3.0, 0.0, 0.0], "gusts": {"seed": 4}},
    "battery": {},
}  # fmt: skip


def test_the_default_servo_follows_delay_and_hold():
    assert default_servo_frequency(RatesEntry()) == 120.0
    assert default_servo_frequency(RatesEntry(delay=0.005)) == pytest.approx(0.3 / 0.00625)
    assert default_servo_frequency(RatesEntry(control=100.0)) == pytest.approx(60.0)


@pytest.mark.slow
def test_a_servo_too_fast_for_its_delay_is_refused_with_the_fastest_that_is_stable():
    plain = LATE | {"sensors": None, "wind": None, "payload": None, "battery": None}
    plain = {name: value for name, value in plain.items() if value is not None}
    fast = plain | {"controller": {"servo": {"frequency": 120.0}}}
    words = (
        r"closed loop of the panel's servo is unstable.*inputs late by 5 ms \(2 periods\).*grow by a "
        r"factor of 1\.\d+ in a period.*servo = \{ frequency = (\d+\.?\d*), damping = 1 \}.*a delay of "
        r"2\.5 ms is stable"
    )
    with pytest.raises(stm.SettingError, match=words) as refused:
        missions.make_mission(fast)
    fastest = float(str(refused.value).split("frequency = ")[1].split(",")[0])
    assert 60.0 < fastest < 110.0
    missions.make_mission(plain | {"controller": {"servo": {"frequency": fastest}}})
    with pytest.raises(stm.SettingError, match="unstable"):
        missions.make_mission(plain | {"controller": {"servo": {"frequency": 1.1 * fastest}}})
    # stiffness and damping of the strokes, which know no masses
    with pytest.raises(stm.SettingError, match=r'servo = \{ kind = "strokes", stiffness = '):
        missions.make_mission(plain | {"controller": {"servo": {"kind": "strokes"}}})
    # position and attitude, of a machine without a panel
    bare = {"machine": {"scene": "hexacopter"}, "rates": {"delay": 0.1}, "panel": []}
    with pytest.raises(stm.SettingError, match=r"position and attitude.*gains = \{ position = "):
        missions.make_mission(plain | bare)


@pytest.mark.slow
def test_a_controller_that_is_told_of_a_lost_rotor_is_checked_before_the_flight(monkeypatch):
    """Position and tilt keep the poles of all six rotors; yaw, which is given up, has none."""
    entries = {
        "format": 1, "name": "told", "t1": 1.0, "machine": {"scene": "hexacopter"},
        "rates": {"delay": 0.01}, "faults": [{"rotor": 1, "at": 0.5, "known": True}],
    }  # fmt: skip
    loops, close = [], Hover.close

    def close_hover(*args):
        loops.append(close(*args))
        return loops[-1]

    monkeypatch.setattr(Hover, "close", close_hover)
    mission = missions.make_mission(entries)
    assert mission.growth == 1.0
    poles = [np.linalg.eigvals(loop.make_period_map()) for loop in loops]
    whole, left = ([x for x in p if abs(x) > 1e-3] for p in poles)
    assert len(whole) > len(left) > 10
    # a pole of all three axes is known to the cube root of round-off
    for pole in left:
        assert np.min(np.abs(np.array(whole) - pole)) < 1e-4
    wild = entries | {
        "rates": {"delay": 0.0},
        "controller": {"gains": {"attitude": 4e5, "rate": 1e3}},
    }
    whole_machine = mission_module._check_pilot
    monkeypatch.setattr(
        mission_module, "_check_pilot",
        lambda mission, pilot: 1.0 if pilot.working is None else whole_machine(mission, pilot),
    )  # fmt: skip
    with pytest.raises(stm.SettingError, match="position and attitude without rotor 1 is unstable"):
        missions.make_mission(wild)


@pytest.fixture(scope="module")
def flights():
    """Flight of the mission above, and of one whose servo is too fast for the delay."""
    calm = missions.fly(missions.make_mission(LATE))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mission_module, "_check_stability", lambda mission: 1.0)
        fast = missions.make_mission(LATE | {"controller": {"servo": {"frequency": 120.0}}})
        wild = missions.fly(fast)
    return calm, wild


@pytest.mark.slow
def test_a_late_mission_flies_with_the_default_servo(flights):
    calm, _ = flights
    assert calm.ending == ""
    data = missions.to_data(calm)
    # a payload of 0.35 kg that is not known lets the machine sink by g m / (k M) = 5 cm
    assert float(np.max(np.linalg.norm(data.position_error, axis=1))) < 0.2
    assert float(data.panel_error.values[-1]) < np.radians(1.0)
    kept, words = missions.verdict(data)
    assert kept, words


@pytest.mark.slow
def test_each_actuator_takes_its_own_power(flights):
    """What one slider brakes does not drive the other: sum of max(f v, 0) over the sliders.

    The forces are those of two periods before, which act now.
    """
    mission, data = flights[0].mission, missions.to_data(flights[0])
    states = jax.tree.map(jax.numpy.asarray, flights[0].run.states)
    geometry = mission.gauges.bodies.geometry
    rates = jax.vmap(lambda state: stroke_motion(geometry, panel_motion(state)).rate)(states)
    late = mission.plant.late
    assert late == 2
    forces = np.concatenate(
        [np.tile(mission.plant.before[6:], (late, 1)), data.command.values[:-late, 6:]]
    )
    powers = forces * np.asarray(rates)
    np.testing.assert_allclose(data.actuator_power, np.sum(powers, axis=1), atol=1e-9)
    np.testing.assert_allclose(data.rotor_speed[late:] ** 2, data.command[:-late, :6], rtol=1e-12)
    apart = np.any(powers > 1e-3, axis=1) & np.any(powers < -1e-3, axis=1)
    assert np.any(apart)
    taken = data.electric_power - data.rotor_power / 0.8 - 10.0
    np.testing.assert_allclose(taken, np.sum(np.maximum(powers, 0.0), axis=1), atol=1e-9)


@pytest.mark.slow
def test_a_failed_flight_has_its_numbers_until_the_failure(flights, tmp_path, capsys, monkeypatch):
    _, wild = flights
    assert wild.ending == "failed"
    assert "left its stroke" in wild.run.failure
    assert "its motion had diverged" in wild.run.failure
    assert "estimate" not in wild.run.failure
    data = missions.to_data(wild)
    assert 0.05 < float(data.time.values[-1]) < 1.0
    for name in data.data_vars:
        if data[name].dtype.kind == "f" and "time" in data[name].dims:
            assert np.all(np.isfinite(data[name])), name
    table = {one.name: one for one in missions.measures(data)}
    assert all(np.isfinite(one.value) for one in table.values())
    assert not table["Smallest margin of the strokes"].is_met
    kept, words = missions.verdict(data)
    assert not kept
    assert "ended there: failed" in words
    assert "Not met: smallest margin of the strokes" in words
    # the command prints the verdict before the reason
    monkeypatch.setattr("stmuav_jax.missions.flight.fly", lambda *args, **named: wild)
    (tmp_path / "late.toml").write_text(
        'format = 1\nt1 = 0.1\nmachine = { scene = "hexacopter" }\n'
    )
    folder = str(tmp_path / "out")
    file = str(tmp_path / "late.toml")
    assert main(["fly", file, "--figures", "none", "--out", folder]) == 1
    shown = capsys.readouterr()
    assert "ended there: failed" in " ".join(shown.out.split())
    assert "left its stroke" in " ".join(shown.err.split())
