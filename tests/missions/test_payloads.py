"""Payloads that are picked up and dropped, and sensors that fail, against Newton's second law and counts."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.control import Instrument, SensorFault
from stmuav_jax.control.instruments import Bench
from stmuav_jax.missions.outcome import list_unreached

missions = stm.missions
PLAIN = {"format": 1, "name": "carrier", "t1": 3.0, "machine": {"scene": "hexacopter"}}
MASS = 0.4


@pytest.fixture(scope="module")
def flight():
    """Hexacopter that picks a payload up under its base at 0.5 s and drops it at 2.5 s."""
    payload = {
        "body": "hexacopter",
        "mass": MASS,
        "position": [0.0, 0.0, -0.1],
        "at": 0.5,
        "until": 2.5,
    }
    return missions.fly(missions.make_mission(PLAIN | {"payloads": [payload]}))


@pytest.mark.slow
def test_a_payload_weighs_from_its_pick_up_to_its_drop(flight):
    """Thrust of the weight alone: a jump of -g m / (M + m) and +g m / M; sag of g m / (k M) between them."""
    run, system = flight.run, flight.mission.machine.scene.system
    M, g, k = float(np.sum(np.asarray(system.bodies.mass))), 9.81, 9.0
    assert "payload_1" in run.plant.system.names
    rate = flight.mission.plant.rate
    speed = np.asarray(run.states.v)[:, 0, 2]
    height = np.asarray(run.states.r)[:, 0, 2]
    up, down = round(0.5 * rate), round(2.5 * rate)
    np.testing.assert_allclose(speed[: up + 1], 0.0, atol=1e-9)
    assert speed[up + 1] * rate == pytest.approx(-g * MASS / (M + MASS), rel=1e-6)
    # the mean of a damped fall, nearly at rest before the drop
    assert height[down] == pytest.approx(-g * MASS / (k * M), rel=0.05)
    jump = (speed[down + 1] - speed[down]) * rate
    assert jump == pytest.approx(g * MASS / M, rel=0.05)
    # the payload is where the base carries it, until and after
    place = np.asarray(run.states.r)[:, 1] - np.asarray(run.states.r)[:, 0]
    np.testing.assert_allclose(place, np.broadcast_to([0.0, 0.0, -0.1], place.shape), atol=1e-9)


def test_payloads_that_cannot_be_are_refused():
    for change, words in (
        ({"body": "body"}, "on the body 'body', which the machine does not have"),
        ({"body": "hexacopter", "at": 2.0, "until": 1.0}, "dropped after it is picked up"),
    ):
        with pytest.raises(stm.SettingError, match=words):
            missions.make_mission(PLAIN | {"payloads": [{"mass": 0.1} | change]})
    entries = {"payloads": [{"body": "frame", "at": 0.0, "until": 4.0}]}
    assert list_unreached(entries, 3.0) == ["the drop of the payload of frame at t = 4 s"]


def test_an_instrument_loses_readings_and_gains_a_bias_in_their_times(flight):
    system = flight.mission.machine.scene.system
    gyroscope = Instrument(
        stm.analysis.SENSORS["gyroscope"]("hexacopter"),
        bias=0.1,
        faults=(SensorFault(0.1, 0.2), SensorFault(0.15, bias=[1.0, 2.0, 3.0])),
    )
    bench = Bench((gyroscope,), system, 100.0)
    zero = jnp.zeros_like(system.reference.v)
    seen = stm.analysis.SensedMotion(
        system.kinematics(system.reference), system.reference.p, zero, zero, jnp.zeros(3)
    )
    queues = bench.fill_queues(seen, system, jax.random.key(0))
    readings = []
    for k in range(1, 30):
        queues = bench.advance_queues(queues, seen, system, jnp.asarray(k), jax.random.key(0))
        readings.append(np.asarray(bench.oldest_readings(queues)[gyroscope.name].value))
    readings = np.array(readings)
    np.testing.assert_allclose(readings[:9], 0.1)
    assert np.all(np.isnan(readings[9:19]))
    np.testing.assert_allclose(readings[19:], np.tile([1.1, 2.1, 3.1], (10, 1)))


def test_noise_of_an_instrument_does_not_depend_on_the_others(flight):
    system = flight.mission.machine.scene.system
    make = lambda name, **errors: Instrument(stm.analysis.SENSORS[name]("hexacopter"), **errors)
    gyroscope, position = make("gyroscope", noise=0.1), make("position", noise=[0.1, 0.2, 0.3])
    others = (make("attitude", noise=0.01), make("accelerometer", bias=0.1))
    zero = jnp.zeros_like(system.reference.v)
    motion = stm.analysis.SensedMotion(
        system.kinematics(system.reference), system.reference.p, zero, zero, jnp.zeros(3)
    )
    readings = []
    for entries in ((gyroscope, position), (gyroscope, position, *others)):
        bench = Bench(entries, system, 100.0)
        queues = bench.fill_queues(motion, system, jax.random.key(3))
        queues = bench.advance_queues(queues, motion, system, jnp.asarray(5), jax.random.key(3))
        oldest = bench.oldest_readings(queues)
        readings.append([oldest[i.name].value for i in (gyroscope, position)])
    for alone, beside in zip(*readings, strict=True):
        np.testing.assert_array_equal(alone, beside)


def test_faults_of_sensors_that_cannot_be_are_refused():
    position = {"sensor": "position", "at": 1.0}
    for changes, words in (
        ({"faults": [position]}, r"needs a mission with \[sensors\]"),
        ({"faults": [position | {"rotor": 1}]}, "one of a rotor, a slider and a sensor"),
        ({"sensors": {}, "faults": [position | {"until": 0.5}]}, "must end after it begins"),
        ({"sensors": {}, "faults": [position | {"known": True}]}, "for faults of rotors"),
        ({"sensors": {}, "faults": [position | {"sensor": "encoders"}]}, "a machine with joints"),
        ({"faults": [{"rotor": 1, "at": 1.0, "until": 2.0}]}, "are for faults of sensors"),
    ):
        with pytest.raises(stm.SettingError, match=words):
            missions.make_mission(PLAIN | changes)


@pytest.mark.slow
def test_a_flight_without_position_fixes_drifts_and_comes_back():
    """Of 50 readings a second one second is missing; a bias step of 3 cm moves the machine by that."""
    faults = [
        {"sensor": "position", "at": 0.5, "until": 1.5},
        {"sensor": "position", "at": 2.0, "bias": [0.03, 0.0, 0.0]},
    ]
    mission = missions.make_mission(
        PLAIN | {"t1": 16.0, "sensors": {"standing": 1.0}, "faults": faults}
    )
    flight = missions.fly(mission)
    assert flight.ending == ""
    end = flight.run.rollout.end.estimate
    estimator: Any = mission.plant.estimator
    k = next(k for k, name in enumerate(estimator.names) if "position" in name)
    assert int(end.missing[k]) == 50
    place = np.asarray(flight.run.states.r)[:, 0]
    assert np.max(np.abs(place[: round(1.5 * mission.plant.rate), 0])) < 0.1
    # the reading is 3 cm too far forward, so the machine holds 3 cm behind
    assert np.mean(place[-400:, 0]) == pytest.approx(-0.03, abs=5e-3)
