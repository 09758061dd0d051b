"""Limits of the actuators' forces: references beyond them, what they give, and the verdict."""

import inspect
import json
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import xarray as xr

import stmuav_jax as stm
from stmuav_jax.checks.schema import validate_model
from stmuav_jax.missions import ensemble
from stmuav_jax.missions.controller import References
from stmuav_jax.missions.machine import machine_of
from stmuav_jax.missions.mission import (
    LIBRARY,
    _make_moves,
    _make_path,
    check_forces,
    needed_forces,
    times_of,
)
from stmuav_jax.missions.schema import MissionFile

control, missions, tracker = stm.control, stm.missions, stm.uav

DEGREE = np.pi / 180
GOAL, BEGIN, DURATION = np.array([14.3, 11.5]), 0.1, 0.3
CLIMB = np.array([0.5, -0.4, 1.0])
PUSH, OMEGA, LIMIT = -1.2, 4 * np.pi, 8.5
PLAIN = {
    "format": 1, "name": "forces", "t1": 0.6, "machine": {"scene": "uav_tracker"},
    "path": {"acceleration": CLIMB.tolist()},
    "panel": [{"angles": GOAL.tolist(), "at": BEGIN, "duration": DURATION}],
}  # fmt: skip


@pytest.fixture(scope="module")
def asked():
    """Entries, machine and references of the mission, times, and the forces then."""
    given = validate_model(MissionFile, PLAIN, "A mission")
    machine = machine_of(given, LIBRARY)
    references = References(_make_path(given.path, machine), _make_moves(given, machine))
    ts, gravity = times_of(given), jnp.array([0.0, 0.0, -9.81])
    needed = np.asarray(needed_forces(machine.bodies, references, gravity, jnp.asarray(ts)))
    return given, machine, references, ts, needed


@pytest.mark.slow
def test_forces_along_a_reference_by_hand(asked):
    """The quintic and its derivatives, on a base that leans as its climb needs."""
    _, machine, _, ts, needed = asked
    home = np.asarray(tracker.initial_angles(stm.PART_II))
    s, way = np.clip((ts - BEGIN) / DURATION, 0.0, 1.0)[:, None], GOAL * DEGREE - home
    motion = tracker.PairMotion(
        jnp.asarray(home + way * (10 * s**3 - 15 * s**4 + 6 * s**5)),
        jnp.asarray(way * (30 * s**2 - 60 * s**3 + 30 * s**4) / DURATION),
        jnp.asarray(way * (60 * s - 180 * s**2 + 120 * s**3) / DURATION**2),
    )
    felt = np.array([0.0, 0.0, -9.81]) - CLIMB
    z = -felt / np.linalg.norm(felt)
    y = np.cross(z, [1.0, 0.0, 0.0])
    y = y / np.linalg.norm(y)
    felt_b = jnp.asarray(np.stack([np.cross(y, z), y, z]) @ felt)
    forces = lambda x: stm.uav.inverse_dynamics(machine.bodies, x, felt_b, jnp.zeros(3)).forces
    np.testing.assert_allclose(needed, jax.jit(jax.vmap(forces))(motion), rtol=1e-9)


def test_a_reference_beyond_the_actuators_is_refused(asked):
    """Just below the largest force, but not just above it."""
    given, machine, references, _, needed = asked
    most, slider = np.max(np.abs(needed)), int(np.argmax(np.max(np.abs(needed), axis=0))) + 2
    assert most > 1.2 * np.max(np.abs(needed[0]))
    check_forces(given, machine, references)
    check_forces(given, machine._replace(force=1.001 * most), references)
    words = (
        rf"slider {slider} needs a force of -?[0-9.]+ N.* at most [0-9.]+ N .*'controller.force'"
    )
    with pytest.raises(stm.SettingError, match=words):
        check_forces(given, machine._replace(force=0.99 * most), references)
    # the weight alone, at the start
    with pytest.raises(stm.SettingError, match="at t = 0 s slider"):
        check_forces(given, machine._replace(force=1.0), references)


def test_a_verdict_counts_the_forces_that_the_servo_asks_for():
    """Of a made-up record: 8 N are asked of slider 3, of which the actuators give 6."""
    ts = np.arange(0.0, 2.0, 0.5)
    one = lambda x: (("time",), np.broadcast_to(x, ts.shape).astype(float))
    forces = np.array([[3.0, 1.0], [-4.5, 8.0], [3.0, -2.0], [2.0, 2.0]])
    content = {"t1": 1.5, "tolerances": {}, "faults": []}
    data = xr.Dataset(
        {
            "position_error": (("time", "axis"), np.zeros((4, 3))), "tilt_error": one(0.0),
            "panel_error": one(0.0), "rotor_power": one(1.0), "electric_power": one(1.0),
            "commanded_force": (("time", "slider"), forces),
        },
        {"time": ts}, {"mission": json.dumps(content), "ending": ""},
    )  # fmt: skip
    limits = lambda x: {"lowest_force": ("slider", [-x] * 2), "highest_force": ("slider", [x] * 2)}
    margin = lambda d: [m for m in missions.measures(d) if "actuators' forces" in m.name]
    assert margin(data) == []
    (kept,) = margin(data.assign(limits(10.0)))
    assert (kept.value, kept.is_met) == (pytest.approx(10.0), True)
    (broken,) = margin(data.assign(limits(6.0)))
    assert (broken.value, broken.is_met) == (pytest.approx(-100 / 6), False)
    fine, words = missions.verdict(data.assign(limits(6.0)))
    assert not fine
    assert "smallest margin of the actuators' forces" in words
    # the servo of a jammed slider asks in vain
    content["faults"] = [{"rotor": None, "slider": 3, "at": 0.5}]
    (jammed,) = margin(data.assign(limits(6.0)).assign_attrs(mission=json.dumps(content)))
    assert (jammed.value, jammed.is_met) == (pytest.approx(12.5), True)


def test_a_study_counts_the_same_forces():
    """Of the same record, in which what is asked after the end and of a jammed slider does not count."""
    ts = jnp.array([0.0, 0.5, 1.0, 1.5, 2.0])
    forces = jnp.array([[3.0, 1.0], [-4.5, 8.0], [3.0, -2.0], [2.0, 2.0], [9.0, 9.0]])
    none = jnp.zeros(5)
    own = {
        "position_error": jnp.zeros((5, 3)), "tilt_error": none, "electric_power": none,
        "commanded_force": forces,
    }  # fmt: skip
    found: Any = SimpleNamespace(ts=ts, signals={"gauges": own}, reason=jnp.zeros(5, jnp.int8))
    given = validate_model(MissionFile, PLAIN | {"t1": 1.5}, "A mission")
    mission: Any = SimpleNamespace(
        file=given, samples=4, plant=SimpleNamespace(rate=2.0), machine=SimpleNamespace(force=6.0)
    )
    zero, one = jnp.zeros(()), jnp.ones(())
    none_yet, reason = jnp.zeros(0), jnp.zeros((), jnp.int8)
    begun = ensemble.Worst(
        zero,
        zero,
        zero,
        none_yet,
        one,
        one,
        one,
        one,
        zero,
        one,
        one,
        jnp.array(False),
        reason,
        zero,
    )
    joined = inspect.unwrap(ensemble._join_worst)
    for at, margin in ((jnp.inf, -1 / 6), (0.5, 0.125)):
        jam = SimpleNamespace(at=jnp.array([jnp.inf, at]))
        truth = SimpleNamespace(battery=None, speeds=None)
        of: Any = SimpleNamespace(
            truth=truth, limits=None, controller=SimpleNamespace(force=jnp.full(2, 6.0), jam=jam)
        )
        worst = joined(mission, of, begun, found)
        assert float(worst.forces) == pytest.approx(margin)
        assert float(worst.rotors) == float(worst.strokes) == 1.0


@pytest.mark.slow
def test_actuators_give_no_more_than_their_limit(asked):
    """A push that no reference foretells: the servo asks for more, and the verdict says so."""
    _, _, _, times, _ = asked
    push = {"force": PUSH, "angular_frequency": OMEGA}
    # straight up, so that the base stands from the start as its path needs
    own = {"push": push, "controller": {"force": LIMIT}, "path": {"acceleration": [0.0, 0.0, 1.0]}}
    mission = missions.make_mission(PLAIN | own)
    data = missions.to_data(missions.fly(mission))
    wanted, given = data.commanded_force.values, data.command.values[:, 6:]
    np.testing.assert_array_equal(given, np.clip(wanted, -LIMIT, LIMIT))
    assert np.max(np.abs(wanted)) > LIMIT
    kept, words = missions.verdict(data)
    assert not kept
    assert words.endswith("Not met: smallest margin of the actuators' forces.")
    # until the limit is met, the servo asks for what the reference needs less what pushes
    ts = data.time.values
    met = int(np.argmax(np.any(np.abs(wanted) > LIMIT, axis=1)))
    gravity, bodies = jnp.array([0.0, 0.0, -9.81]), mission.machine.bodies
    needed = needed_forces(bodies, mission.references, gravity, jnp.asarray(times))
    foreseen = np.stack([np.interp(ts, times, needed[:, k]) for k in (0, 1)], axis=1)
    foreseen -= PUSH * np.sin(OMEGA * ts)[:, None]
    # the base gives way to what moves on it
    assert met > 20
    np.testing.assert_allclose(wanted[1:met], foreseen[1:met], atol=0.15)
    assert set(missions.flight_figures(data)) >= {"forces", "strokes"}
