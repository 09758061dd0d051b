"""The slew of 30 degrees in one second with a payload: what feedforward and adaptation are worth together.

Instruments are noisy, and their noise alone turns the base by some 0.4 degrees. What the slew does is
the rotation against the same flight, with the same noise, in which the panel stands still.
"""

import tomllib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import stmuav_jax as stm
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.math.rotation import conjugate, product, to_rotation_vector
from stmuav_jax.missions.controller import PanelMoves, References
from stmuav_jax.missions.mission import LIBRARY

control, missions = stm.control, stm.missions

PLAIN = tomllib.loads((LIBRARY / "slew-30.toml").read_text(encoding="utf-8"))
CONTROLLERS = {
    "neither": {"payload": "unknown", "feedforward": False},
    "adapted": {"payload": "estimated"},
}
# beginning of the slew, time before it for the mean attitude, end of what is looked at, and time from
# which the position counts [s]
SLEW, BEFORE, END, SETTLED = 3.0, 0.5, 5.0, 2.0


@quick_jit
def rolled(plant, pilot, wanted, moves):
    """Closed loop until two seconds after the beginning of the slew, `moves` times of which is made."""
    start = wanted.panel.start
    (goal,) = wanted.panel.targets
    panel = PanelMoves(
        start, (start + moves * (goal - start),), wanted.panel.ats, wanted.panel.durations, False
    )
    references = References(wanted.path, panel)
    signals = {
        "memory": lambda s: s.memory.flight,
        "centre": lambda s: stm.uav.mass_properties(plant.system, s.state).centre,
    }
    return control.rollout(
        plant, pilot, round(END * plant.rate) + 1, reference=references, memory=pilot.start(),
        signals=signals, start=plant.reset(jax.random.key(0)),
    )  # fmt: skip


def apart(p, q):
    """Angle between two attitudes, or rows of them [degrees]."""
    v = jax.vmap(lambda p, q: to_rotation_vector(product(conjugate(p), q)))(p, q)
    return np.degrees(np.linalg.norm(v, axis=1))


@pytest.fixture(scope="module")
def flights():
    """Flights with each controller, and by its name three numbers.

    These are the largest rotation from the flight with a panel that stands still, that from the mean
    attitude before the slew [degrees], and the largest position error [m].
    """
    found, largest = {}, {}
    for name, controller in CONTROLLERS.items():
        plain = PLAIN | {"name": name, "t1": END, "controller": controller}
        mission = missions.make_mission(plain)
        own = mission.plant, mission.controller, mission.references
        found[name], still = (rolled(*own, jnp.asarray(x)) for x in (1.0, 0.0))
        assert not np.any(found[name].reason)
        assert not np.any(still.reason)
        ts, p = np.asarray(found[name].ts), found[name].states.p[:, 0]
        mean = jnp.mean(p[(ts >= SLEW - BEFORE) & (ts < SLEW)], axis=0)
        mean = mean / jnp.linalg.norm(mean)
        late = ts >= SLEW
        largest[name] = (
            np.max(apart(still.states.p[late, 0], p[late])),
            np.max(apart(jnp.broadcast_to(mean, p[late].shape), p[late])),
            np.max(np.linalg.norm(found[name].states.r[ts >= SETTLED, 0], axis=1)),
        )
        turned, whole, off = largest[name]
        print(f"| {name} | {turned:.2f} deg | {whole:.2f} deg | {100 * off:.1f} cm |")
    return found, largest


@pytest.mark.slow
def test_adaptation_halves_what_a_slew_does_to_the_attitude(flights):
    largest = {name: numbers[0] for name, numbers in flights[1].items()}
    assert largest["adapted"] <= 0.5 * largest["neither"]


@pytest.mark.slow
def test_adaptation_carries_the_payload(flights):
    """A payload that is not known lets the machine sink by 0.3 / 7.4 of 9.81 / 9 m, and lean."""
    largest = {name: numbers[2] for name, numbers in flights[1].items()}
    assert largest["neither"] > 0.04
    assert largest["adapted"] < 0.02


@pytest.mark.slow
def test_the_payload_is_found_before_the_slew_and_during_it(flights):
    """Mass and moment within three deviations, the centre of mass within 0.5 mm across the thrust."""
    found = flights[0]["adapted"]
    payload = found.signals["memory"].payload
    truth = PLAIN["payload"]["mass"] * np.array([1.0, *PLAIN["payload"]["position"]])
    for at in (SLEW, END):
        k = round(at * 400)
        error = np.asarray(payload.mean[k, 3:7]) - truth
        deviation = np.sqrt(np.diag(payload.covariance[k])[3:7])
        assert np.all(np.abs(error) < 3 * deviation)
        off = found.signals["memory"].centre[k] - found.signals["centre"][k]
        assert np.max(np.abs(off[:2])) < 5e-4
    # a third of what they were before the flight
    assert np.all(deviation < np.array([0.3, 0.02, 0.02, 0.02]) / 3)
