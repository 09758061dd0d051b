"""Flights through lanes: against flights one by one, whatever the block, lane and device."""

import itertools
import json
import pickle
from dataclasses import replace
from pathlib import Path

import diffrax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import Augmented, Baumgarte, Method, SettingError, integrate
from stmuav_jax.dynamics.formulations.stabilisation import AbstractStabilisation
from stmuav_jax.dynamics.loads import joint_loads
from stmuav_jax.io import read_model
from stmuav_jax.math.compiler import quick_jit
from stmuav_jax.math.rotation import rotation_matrix
from stmuav_jax.studies import FINE, make_flight_study, make_study
from stmuav_jax.studies.study import _split_ranges
from stmuav_jax.uav import panel_angles

NORMAL = {"distribution": "normal", "mean": 0.0, "standard_deviation": 0.3}


def column(values, **more):
    return {"distribution": "empirical", "values": [float(x) for x in values]} | more


RNG = np.random.default_rng(4)
COUNT = 32
# the last samples: masses and a moment that no body has, a spin that takes too many steps
NEGATIVE, HEAVY, UNLIKE, FAST = range(COUNT - 4, COUNT)
TURNING = {
    "name": "turning",
    "scene": "hexacopter",
    "t1": 0.4,
    "every": 0.1,
    "rtol": 1e-10,
    "atol": 1e-10,
    "max_steps": 300,
    "seed": 4,
    "design": "table",
    "factors": {
        "start.p": column([*RNG.normal(0.0, 0.3, COUNT - 1), 0.0]),
        "start.q": column([*RNG.normal(0.0, 3.0, COUNT - 1), 0.0]),
        "start.r": column([0.0] * (COUNT - 1) + [1e4]),
        "bare.mass": column(
            [*RNG.normal(1.0, 0.1, COUNT - 4), -1.0, 1e300, 1.0, 1.0], relative=True
        ),
        "bare.inertia[0, 0]": column([*[1.0] * (COUNT - 2), 5.0, 1.0], relative=True),
    },
    "quantities": {
        "tilt": {"signal": "tilt", "take": "largest"},
        "over": {"signal": "tilt", "take": "when_above", "level": 0.5},
        "low": {"signal": "z", "take": "smallest"},
        "path": {"signal": "z", "take": "path"},
        "end_x": {"signal": "x", "take": "final"},
        "fallen": {"signal": "tilt", "take": "when_above", "level": 1.0, "stop": True},
    },
}


@pytest.fixture(scope="module")
def turning():
    study = make_study(TURNING, block=COUNT, lanes=8)
    return study, study.compute(0, COUNT)


def one_by_one(study, k, ts, **options):
    """Sample k by `integrate` alone."""
    drawn = jnp.asarray(study.sampling.draw(k, 1)[0])
    sample = dict(zip(study.sampling.names, drawn, strict=True))
    system, state = study.evaluate.flights.build(sample)
    method = Method(adjoint=diffrax.ForwardMode(), **options)
    return system, integrate(system, state, jnp.asarray(ts), method)


@pytest.mark.slow
def test_as_flights_one_by_one(turning):
    study, found = turning
    ts = np.linspace(0.0, 0.4, 401)
    upright = np.flatnonzero(np.isinf(found["fallen"]) & (found["status"] == FINE))
    crossing = np.flatnonzero(np.isfinite(found["over"]) & np.isinf(found["fallen"]))
    for k in map(int, (upright[0], upright[-1], crossing[0])):
        _, run = one_by_one(study, k, ts, rtol=1e-12, atol=1e-12)
        z = np.asarray(run.states.r[:, 0, 2])
        assert found["path"][k] == pytest.approx(z[::100], abs=1e-9)
        assert found["end_x"][k] == pytest.approx(float(run.states.r[-1, 0, 0]), abs=1e-9)
        up = np.stack([np.asarray(rotation_matrix(p))[:, 2] for p in run.states.p[:, 0]])
        tilt = np.arctan2(np.hypot(up[:, 0], up[:, 1]), up[:, 2])
        assert found["tilt"][k] == pytest.approx(tilt.max(), abs=1e-7)
        assert found["low"][k] == pytest.approx(z.min(), abs=1e-8)
        above = np.flatnonzero(tilt > 0.5)
        if len(above):
            first = above[0]
            between = np.interp(0.5, tilt[first - 1 : first + 1], ts[first - 1 : first + 1])
            assert found["over"][k] == pytest.approx(between, abs=1e-6)
        else:
            assert np.isinf(found["over"][k])
    assert 0 < np.isinf(found["over"]).sum() < COUNT


@pytest.mark.slow
def test_a_crossing_can_stop_a_flight(turning):
    _, found = turning
    fine = found["status"] == FINE
    fallen = fine & np.isfinite(found["fallen"])
    assert np.all(found["end"][fine & ~fallen] == 0.4)
    assert np.all(found["end"][fallen] >= found["fallen"][fallen])
    assert np.any(found["end"][fallen] < 0.35)


def test_a_flight_that_fails_is_data_and_costs_nothing(turning):
    """Masses and tensors by the checks that a body alone would get; a reason for each in words."""
    study, found = turning
    assert found["status"].tolist() == [FINE] * (COUNT - 4) + [5, 6, 5, 3]
    assert "not positive" in study.reasons[5]
    assert "not finite" in study.reasons[6]
    # no more steps are tried than it takes to see it
    assert np.all(found["rejected"][[NEGATIVE, HEAVY, UNLIKE]] < 30)
    for name in ("tilt", "low", "end_x"):
        assert np.all(np.isnan(found[name][NEGATIVE:])), name


def test_any_range_gives_the_same_numbers(turning):
    study, whole = turning
    for first, count in ((0, 1), (7, 13), (30, 2)):
        part = study.compute(first, count)
        for name, values in whole.items():
            assert np.array_equal(part[name], values[first : first + count], equal_nan=True), name


def test_any_number_of_devices_gives_the_same_numbers(turning):
    """Threads share one program: it is that of one device, and not compiled again."""
    study, whole = turning
    shared = make_study(TURNING, block=COUNT, lanes=8, devices=3)
    vars(shared)["_compiled"] = study._compiled
    assert len(shared._places) == 3
    found = shared.compute(0, COUNT)
    for name, values in whole.items():
        assert np.array_equal(found[name], values, equal_nan=True), name
    assert shared.identity == study.identity
    assert len(study._compiled) == 1


SHORT = {
    "name": "turning", "scene": "hexacopter", "t1": 0.04, "every": 0.02, "rtol": 1e-10, "seed": 4,
    "solver": "tsit5", "factors": {"start.p": NORMAL},
    "quantities": {name: TURNING["quantities"][name] for name in ("tilt", "path")},
}  # fmt: skip


def test_the_method_is_part_of_the_identity_as_far_as_runs_use_it():
    """The identity is the same whether the method comes from a file or from Python."""
    usual = make_study(SHORT).evaluate
    method = Method(solver=diffrax.Tsit5(), rtol=1e-10, max_steps=20_000)
    for each in (method, replace(method, adjoint=diffrax.DirectAdjoint(), steps="state")):
        assert replace(usual, method=each).plain() == usual.plain()
    other_parts = replace(
        usual.method, first_step=1e-3, max_step=0.01, formulation=Augmented(redundant=True),
        stabilisation=Baumgarte(5.0, 6.0, 7.0),
    )  # fmt: skip
    found = replace(usual, method=other_parts).plain()
    assert {k: v for k, v in found.items() if k not in usual.plain()} == {
        "first_step": 1e-3,
        "max_step": 0.01,
        "formulation": {
            "kind": "Augmented", "redundant": True,
            "rcond": 1e-11,
        },
        "stabilisation": {"kind": "Baumgarte", "alpha": 5.0, "beta": 6.0, "norm": 7.0},
    }  # fmt: skip
    assert json.loads(json.dumps(found)) == found


class Doubled(AbstractStabilisation):
    """A stabilisation that plain data cannot describe: one of its fields is a stabilisation."""

    inner: AbstractStabilisation = Baumgarte()

    def add_row_feedback(self, gamma, value, rate):
        return self.inner.add_row_feedback(gamma, 2 * value, 2 * rate)

    def add_norm_feedback(self, rate, p):
        return self.inner.add_norm_feedback(rate, p)

    def iterations_after_step(self):
        return 0


@pytest.mark.parametrize(
    ("method", "words"),
    [
        (Method(solver=diffrax.Kvaerno5()), r"Dopri8\(\) or Tsit5\(\), not Kvaerno5"),
        (Method(event=lambda t, state: t - 1.0), "cannot have 'event'"),
        (Method(rtol=2.0), "'rtol' must be at most 1"),
        (Method(max_steps=2**40), "'max_steps' must be at most"),
        (Method(stabilisation=Doubled()), "numbers and texts, but Doubled has 'inner'"),
    ],
)
def test_methods_that_a_study_cannot_have(method, words):
    evaluation = make_study(SHORT).evaluate
    with pytest.raises(SettingError, match=words):
        replace(evaluation, method=method)


@pytest.mark.slow
def test_another_formulation_gives_the_same_flights(turning):
    study, found = turning
    names = ("path", "tilt")
    evaluation = replace(
        study.evaluate, quantities={name: study.evaluate.quantities[name] for name in names},
        method=replace(study.evaluate.method, formulation=Augmented(), stabilisation=Baumgarte()),
    )  # fmt: skip
    other = make_flight_study(
        evaluation, study.sampling.factors, seed=4, design="table", block=COUNT, lanes=8
    )
    upright = np.flatnonzero(np.isinf(found["fallen"]) & (found["status"] == FINE))
    numbers = other.compute(0, COUNT)
    for name in names:
        np.testing.assert_allclose(numbers[name][upright], found[name][upright], atol=1e-8)


def test_parts_keep_devices_busy_and_lanes_full():
    for count, block, lanes, devices in itertools.product(
        (1, 15, 16, 400, 5000), (16, 512), (8, 16), (1, 3)
    ):
        parts = list(_split_ranges(count, block, lanes, devices))
        assert [start for start, _ in parts] == [0, *(stop for _, stop in parts[:-1])]
        assert parts[-1][1] == count
        assert all(1 <= stop - start <= block for start, stop in parts)
    assert len(list(_split_ranges(400, 512, 16, 2))) == 2
    assert len(list(_split_ranges(16, 512, 16, 2))) == 1


def test_lanes_are_part_of_the_study_and_devices_are_not():
    make = lambda **settings: make_study(TURNING, **settings)
    studies = [make(lanes=16, devices=k) for k in (None, 1, 2)]
    assert all(study.identity == studies[0].identity for study in studies)
    assert make().identity == studies[0].identity
    assert make(lanes=8).identity["lanes"] == 8
    with pytest.raises(SettingError, match="multiple of 8, but it is 7"):
        make(lanes=7)
    with pytest.raises(SettingError, match="There are 1024 devices"):
        make(devices=10**9)
    for name in ("lanes", "block", "devices"):
        with pytest.raises(SettingError, match=f"{name} must be at least 1, but it is 0"):
            make(**{name: 0})


def test_a_pickle_is_small_and_gives_the_same(turning):
    study, whole = turning
    content = pickle.dumps(study)
    assert len(content) < 30_000
    again = pickle.loads(content)
    assert again.identity == study.identity
    vars(again)["_compiled"] = study._compiled
    assert np.array_equal(again.compute(3, 2)["tilt"], whole["tilt"][3:5])
    signals = again.evaluate.signals
    assert {name: signal.unit for name, signal in signals.items()} == {
        name: signal.unit for name, signal in study.evaluate.signals.items()
    }


def test_a_study_of_a_model_can_be_sent_to_another_process():
    model = Path(__file__).parents[2] / "docs" / "models" / "pendulum.toml"
    plain = {
        "model": read_model(model), "t1": 0.1, "factors": {"start.pin.angle": 0.1},
        "quantities": {"angle": {"signal": "pin.angle", "take": "final"}},
    }  # fmt: skip
    study = make_study(plain, block=16, lanes=8)
    flights = study.evaluate.flights
    again = pickle.loads(pickle.dumps(study))
    assert again.identity == study.identity
    assert again.evaluate.flights.own_factors == flights.own_factors


def largest(study, k, ts):
    """Peak of the load of U47 by another formulation, at times (n,) and then between its neighbours."""
    force = np.zeros(1)
    for _ in range(2):
        system, run = one_by_one(study, k, ts, rtol=1e-12, atol=1e-12)
        loads = quick_jit(joint_loads)(system, run.ts, run.states, Augmented())
        force = np.linalg.norm(loads.force[:, loads.joints.index("U47")], axis=1)
        top = int(np.argmax(force))
        ends = ts[max(top - 1, 1)], ts[min(top + 1, len(ts) - 1)]
        ts = np.append(0.0, np.linspace(*ends, len(ts) - 1))
    return force.max()


@pytest.mark.slow
def test_a_mechanism_with_closed_loops_as_flights_one_by_one():
    """Posture, stroke, pointing and a joint's load of the tracker; starts out of reach are data."""
    plain = {
        "scene": "tracker", "case": 1, "t1": 0.2, "rtol": 1e-9, "atol": 1e-9,
        "factors": {"start.phi": {"distribution": "choice", "values": [-0.2674, -0.2, 2.5]},
                    "start.phi_rate": {"distribution": "choice", "values": [0.0, 2.0]}},
        "quantities": {"phi": {"signal": "phi", "take": "final"},
                       "stroke": {"signal": "stroke_2", "take": "largest"},
                       "fall": {"signal": "pointing", "take": "when_above", "level": 0.1},
                       "load": {"signal": "force.U47", "take": "largest"}},
    }  # fmt: skip
    study = make_study(plain, block=16, lanes=8)
    found = study.compute(0, 16)
    far, fine = found["start_phi"] == 2.5, found["status"] == FINE
    assert np.all((found["status"] == 2) == far)
    assert np.all(fine == ~far)
    assert np.all(np.isnan(found["phi"][far]) & np.isnan(found["stroke"][far]))
    facing = jnp.asarray(study.evaluate.flights.facing())

    def fallen(t, state):
        normal = rotation_matrix(state.p[-1])[:, 2]
        return jnp.arctan2(jnp.linalg.norm(jnp.cross(normal, facing)), normal @ facing) - 0.1

    dense = np.linspace(0.0, 0.2, 1001)
    falling = np.flatnonzero(fine & np.isfinite(found["fall"]) & (found["fall"] > 0))
    k = int(falling[0])
    _, run = one_by_one(study, k, dense, rtol=1e-12, atol=1e-12)
    angles = panel_angles(rotation_matrix(run.states.p[-1, -1])[:, 2])
    assert found["phi"][k] == pytest.approx(float(angles[0]), abs=1e-8)
    # the load between steps is a quartic, and its peak is some 5 ms wide
    assert found["load"][k] == pytest.approx(largest(study, k, dense), rel=2e-4)
    _, run = one_by_one(study, k, [0.0, 0.2], rtol=1e-12, atol=1e-12, event=fallen)
    assert found["fall"][k] == pytest.approx(float(run.ts[-1]), abs=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"quantities": {}}, "has no quantities"),
        ({"quantities": {"a": {"signal": "tilt", "take": "final", "level": 1.0}}}, "no level"),
        ({"quantities": {"a": {"signal": "tilt", "take": "when_above"}}}, "needs a level"),
        ({"quantities": {"steps": {"signal": "tilt", "take": "final"}}}, "names of other columns"),
        ({"direction": [0.0, 0.0, 2.0]}, "unit vector"),
    ],
)
def test_bad_studies(change, words):
    with pytest.raises(SettingError, match=words):
        make_study(TURNING | change)
