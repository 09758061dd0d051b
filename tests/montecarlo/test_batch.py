"""Flights through lanes: against flights one by one, whatever the block, lane and device."""

import itertools
import json
import pickle
from dataclasses import replace
from pathlib import Path

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import Augmented, Baumgarte, Method, SettingError, integrate
from stmuav_jax.algebra import compiler, kept
from stmuav_jax.algebra.compiler import quick_jit
from stmuav_jax.algebra.rotation import rotation_matrix
from stmuav_jax.dynamics.formulations.stabilisation import AbstractStabilisation
from stmuav_jax.dynamics.loads import joint_loads
from stmuav_jax.files import read_model
from stmuav_jax.montecarlo.batch import FlightWork, _parts
from stmuav_jax.montecarlo.disturbed_flights import Drawn
from stmuav_jax.montecarlo.study import study_from_plain
from stmuav_jax.montecarlo.work import FINE

NORMAL = {"distribution": "normal", "mean": 0.0, "standard_deviation": 0.3}
TURNING = {
    "name": "turning",
    "scene": "hexacopter",
    "t1": 0.4,
    "every": 0.1,
    "rtol": 1e-10,
    "atol": 1e-10,
    "seed": 4,
    "factors": {
        "start.p": NORMAL,
        "start.q": NORMAL | {"standard_deviation": 3.0},
        "bare.mass": {
            "distribution": "normal",
            "mean": 1.0,
            "standard_deviation": 0.1,
            "relative": True,
        },
    },
    "quantities": {
        "tilt": {"signal": "tilt", "take": "largest"},
        "over": {"signal": "tilt", "take": "when_above", "level": 0.5},
        "low": {"signal": "z", "take": "smallest"},
        "path": {"signal": "z", "take": "path"},
        "end_x": {"signal": "x", "take": "final"},
    },
}


@pytest.fixture(scope="module")
def turning():
    work = FlightWork(study_from_plain(TURNING), block=32, lanes=8)
    return work, work.run(0, 32)


def one_by_one(work, k, ts, **options):
    """Sample k by `integrate` alone."""
    study = work.study
    drawn = study.sampling.draw(k, 1)[0]
    system, state = study.flights.build(
        study.sampling.names, Drawn(jnp.asarray(drawn), jnp.zeros((), jnp.uint32))
    )
    method = Method(adjoint=diffrax.ForwardMode(), **options)
    return system, integrate(system, state, jnp.asarray(ts), method)


def test_as_flights_one_by_one(turning):
    work, found = turning
    assert np.all(found["status"] == FINE)
    ts = np.linspace(0.0, 0.4, 401)
    for k in (0, 5, 31):
        _, run = one_by_one(work, k, ts, rtol=1e-12, atol=1e-12)
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
    assert 0 < np.isinf(found["over"]).sum() < 32


def test_any_range_gives_the_same_numbers(turning):
    work, whole = turning
    for first, count in ((0, 1), (7, 13), (30, 20)):
        part = work.run(first, count)
        upto = min(32 - first, count)
        for name, values in whole.items():
            same = part[name][:upto] == values[first : first + upto]
            both = np.isnan(part[name][:upto]) & np.isnan(values[first : first + upto])
            assert np.all(same | both), name


# functions with executed annotations have no text, and only the slow tests run without
@pytest.mark.slow
def test_programs_kept_in_files_are_found_whatever_is_drawn(tmp_path, monkeypatch):
    names, compiled = [], compiler._compiled

    def named(function, args, quick, key):
        # the small programs that make the start are quick ones
        if quick:
            return compiled(function, args, quick, key)
        names.append(key)
        return function

    monkeypatch.setattr(compiler, "_compiled", named)
    turned = TURNING["factors"] | {"start.p": NORMAL | {"standard_deviation": 0.1}}
    changes = ({}, {"seed": 5}, {"factors": turned}, {"t1": 0.5}, {"rtol": 1e-9})
    kept.keep_programs(tmp_path / "programs")
    try:
        for change in changes:
            FlightWork(study_from_plain(TURNING | change), lanes=8)._program(jax.devices()[0])
    finally:
        kept.keep_programs(None)
    first, *others = names
    assert first is not None
    assert [name == first for name in others] == [True, True, False, False]


@pytest.mark.parametrize("devices", [2, 5])
def test_any_number_of_devices_gives_the_same_numbers(turning, devices):
    """Threads share one program: it is that of one device, and not compiled again."""
    work, whole = turning
    shared = FlightWork(work.study, block=work._block, lanes=work.lanes, devices=devices)
    vars(shared)["_compiled"] = work._compiled  # pyright: ignore[reportIndexIssue]
    assert len(shared._places) == devices
    found = shared.run(0, 32)
    for name, values in whole.items():
        assert np.array_equal(found[name], values, equal_nan=True), name
    assert shared.identity == work.identity
    assert len(work._compiled) == 1


# Identity of the study below, but its parameters' digest, in a store that commit c3864ae made.
MADE_BEFORE = (
    '{"scene": "hexacopter", "case": null, "inputs": "case", "drag": false, "gusts": false, '
    '"name": "turning", "t1": 0.04, "rtol": 1e-10, "atol": 1e-08, "solver": "tsit5", '
    '"max_steps": 20000, "kind": "flights", "relative": [], "sampling": {"design": "random", '
    '"seed": 4, "factors": [{"name": "start.p", "distribution": "normal", "mean": 0.0, '
    '"standard_deviation": 0.3}]}, "quantities": {"tilt": {"signal": "tilt", "take": "largest"}, '
    '"path": {"signal": "z", "take": "path"}}, "times": [0.0, 0.02, 0.04], "direction": null, '
    '"lanes": 8}'
)
SHORT = {
    "name": "turning", "scene": "hexacopter", "t1": 0.04, "every": 0.02, "rtol": 1e-10, "seed": 4,
    "solver": "tsit5", "factors": {"start.p": NORMAL},
    "quantities": {name: TURNING["quantities"][name] for name in ("tilt", "path")},
}  # fmt: skip


def test_a_study_goes_on_with_stores_made_before():
    """Its identity is the same text, whether the method comes from a file or from Python."""
    study = study_from_plain(SHORT)
    method = Method(solver=diffrax.Tsit5(), rtol=1e-10, max_steps=20_000)
    for one in (study, replace(study, method=method)):
        found = dict(FlightWork(one, lanes=8).identity)
        assert len(found.pop("parameters")) == 16
        assert json.dumps(found) == MADE_BEFORE
    unused = replace(method, adjoint=diffrax.DirectAdjoint(), steps="state")
    assert replace(study, method=unused).plain() == study.plain()


def test_other_parts_of_a_method_are_of_the_identity_too():
    usual = study_from_plain(SHORT)
    method = replace(
        usual.method, first_step=1e-3, max_step=0.01, formulation=Augmented(redundant=True),
        stabilisation=Baumgarte(5.0, 6.0, 7.0),
    )  # fmt: skip
    found = replace(usual, method=method).plain()
    assert {k: v for k, v in found.items() if k not in usual.plain()} == {
        "first_step": 1e-3,
        "max_step": 0.01,
        "formulation": {
            "kind": "Augmented", "solve": "structured", "rows": "body", "redundant": True,
            "rcond": 1e-11,
        },
        "stabilisation": {"kind": "Baumgarte", "alpha": 5.0, "beta": 6.0, "norm": 7.0},
    }  # fmt: skip
    assert json.loads(json.dumps(found)) == found


class Doubled(AbstractStabilisation):
    """A stabilisation that plain data cannot describe: one of its fields is a stabilisation."""

    inner: AbstractStabilisation = Baumgarte()

    def held_rows(self, gamma, value, rate):
        return self.inner.held_rows(gamma, 2 * value, 2 * rate)

    def held_norms(self, rate, p):
        return self.inner.held_norms(rate, p)

    def iterations_after_step(self):
        return 0


@pytest.mark.parametrize(
    ("method", "words"),
    [
        (Method(solver=diffrax.Kvaerno5()), r"Dopri8\(\) or Tsit5\(\), not Kvaerno5"),
        (Method(solver="auto"), r"Dopri8\(\) or Tsit5\(\), not auto"),
        (Method(event=lambda t, state: t - 1.0), "cannot have 'event'"),
        (Method(jump_ts=[0.1]), "cannot have 'jump_ts'"),
        (Method(balances=True), "cannot have 'balances'"),
        (Method(rtol=2.0), "'rtol' must be at most 1"),
        (Method(max_steps=2**40), "'max_steps' must be at most"),
        (Method(stabilisation=Doubled()), "numbers and texts, but Doubled has 'inner'"),
    ],
)
def test_methods_that_a_study_cannot_have(method, words):
    study = study_from_plain(SHORT)
    with pytest.raises(SettingError, match=words):
        replace(study, method=method)


@pytest.mark.slow
def test_another_formulation_gives_the_same_flights(turning):
    work, found = turning
    method = replace(work.study.method, formulation=Augmented(), stabilisation=Baumgarte())
    other = FlightWork(replace(work.study, method=method), block=32, lanes=8).run(0, 32)
    for name in ("path", "end_x", "tilt"):
        np.testing.assert_allclose(other[name], found[name], atol=1e-8)


def test_parts_keep_devices_busy_and_lanes_full():
    for count, block, lanes, devices in itertools.product(
        (1, 15, 16, 400, 5000), (16, 512), (8, 16), (1, 3)
    ):
        parts = list(_parts(count, block, lanes, devices))
        assert [start for start, _ in parts] == [0, *(stop for _, stop in parts[:-1])]
        assert parts[-1][1] == count
        assert all(1 <= stop - start <= block for start, stop in parts)
    assert len(list(_parts(400, 512, 16, 2))) == 2
    assert len(list(_parts(16, 512, 16, 2))) == 1


def test_lanes_are_part_of_the_study_and_devices_are_not():
    study = study_from_plain(TURNING)
    works = [FlightWork(study, lanes=16, devices=k) for k in (None, 1, 2)]
    assert all(work.identity == works[0].identity for work in works)
    assert FlightWork(study).identity == works[0].identity
    assert FlightWork(study, lanes=8).identity["lanes"] == 8
    with pytest.raises(SettingError, match="multiple of 8, but it is 7"):
        FlightWork(study, lanes=7)
    with pytest.raises(SettingError, match="There are 1024 devices"):
        FlightWork(study, devices=10**9)
    for name in ("lanes", "block", "devices"):
        with pytest.raises(SettingError, match=f"{name} must be at least 1, but it is 0"):
            FlightWork(study, **{name: 0})


def test_bodies_that_cannot_be_are_named_and_cost_nothing():
    """Masses and tensors of samples, by the checks that a body alone would get."""
    shares = {"distribution": "choice", "values": [-1.0, 0.0, 1.0, 1e300], "relative": True}
    tensor = {"distribution": "choice", "values": [-1.0, 1.0, 5.0], "relative": True}
    factors = {"bare.mass": shares, "bare.inertia[0, 0]": tensor}
    work = FlightWork(study_from_plain(TURNING | {"factors": factors}), block=32, lanes=8)
    found = work.run(0, 32)
    mass, moment = found["bare_mass"], found["bare_inertia_0_0"]
    wrong = (mass <= 0) | (moment != 1)
    assert np.all((found["status"] == 5) == wrong)
    assert np.all(found["status"][~wrong & (mass == 1)] == FINE)
    heavy = ~wrong & (mass == 1e300)
    assert heavy.any()
    assert np.all(found["status"][heavy] == 6)
    assert "not positive" in work.reasons[5]
    assert "not finite" in work.reasons[6]
    # no more steps are tried than it takes to see it
    assert np.all(found["rejected"][wrong | heavy] < 30)
    assert np.all(np.isnan(found["tilt"][wrong | heavy]))


def test_a_pickle_is_small_and_gives_the_same(turning):
    work, whole = turning
    content = pickle.dumps(work)
    assert len(content) < 30_000
    again = pickle.loads(content)
    assert again.identity == work.identity
    assert np.array_equal(again.run(3, 2)["tilt"], whole["tilt"][3:5])


def test_a_study_of_a_model_can_be_sent_to_another_process():
    model = Path(__file__).parents[2] / "docs" / "models" / "pendulum.toml"
    plain = {
        "model": read_model(model), "t1": 0.1, "factors": {"start.pin.angle": 0.1},
        "quantities": {"angle": {"signal": "pin.angle", "take": "final"}},
    }  # fmt: skip
    work = FlightWork(study_from_plain(plain), block=16, lanes=8)
    flights = work.study.flights
    again = pickle.loads(pickle.dumps(work))
    assert again.identity == work.identity
    assert again.study.flights.gusts is flights.gusts is False
    assert again.study.flights.own == flights.own


def test_what_fails_is_data():
    plain = {
        "scene": "tracker", "case": 1, "t1": 0.05, "max_steps": 12,
        "factors": {"start.phi": {"distribution": "choice", "values": [-0.2674, 2.5]},
                    "start.phi_rate": {"distribution": "choice", "values": [0.0, 60.0]}},
        "quantities": {"phi": {"signal": "phi", "take": "final"},
                       "stroke": {"signal": "stroke_2", "take": "largest"}},
    }  # fmt: skip
    found = FlightWork(study_from_plain(plain), block=16, lanes=8).run(0, 16)
    far = found["start_phi"] == 2.5
    assert np.all((found["status"] == 2) == far)
    fast = ~far & (found["start_phi_rate"] == 60.0)
    assert np.all(found["status"][fast] == 3)
    fine = found["status"] == FINE
    assert fine.any()
    assert np.all(np.isnan(found["phi"][~fine]))
    assert np.all(np.isfinite(found["phi"][fine]))
    assert np.all(np.isnan(found["stroke"][~fine]))


def test_a_crossing_can_stop_a_flight():
    quantities = {"over": {"signal": "tilt", "take": "when_above", "level": 0.5, "stop": True}}
    plain = TURNING | {"quantities": TURNING["quantities"] | quantities}
    found = FlightWork(study_from_plain(plain), block=32, lanes=8).run(0, 32)
    crossed = np.isfinite(found["over"])
    assert np.all(found["status"] == FINE)
    assert np.all(found["end"][~crossed] == 0.4)
    assert np.all(found["end"][crossed] >= found["over"][crossed])
    assert np.all(found["end"][crossed] <= 0.4)
    assert np.any(found["end"][crossed] < 0.35)


def largest(work, k, ts):
    """Peak of the load of U47 by another formulation, at times (n,) and then between its neighbours."""
    force = np.zeros(1)
    for _ in range(2):
        system, run = one_by_one(work, k, ts, rtol=1e-12, atol=1e-12)
        loads = quick_jit(joint_loads)(system, run.ts, run.states, Augmented())
        force = np.linalg.norm(loads.force[:, loads.joints.index("U47")], axis=1)
        top = int(np.argmax(force))
        ts = np.append(0.0, np.linspace(ts[top - 1], ts[top + 1], len(ts) - 1))
    return force.max()


@pytest.mark.slow
def test_the_uav_as_flights_one_by_one():
    plain = {
        "scene": "uav_tracker", "case": 2, "t1": 0.5, "rtol": 1e-9, "atol": 1e-9,
        "factors": {"start.p": NORMAL, "start.phi": {
            "distribution": "uniform", "low": -0.35, "high": -0.2}},
        "quantities": {"x": {"signal": "x", "take": "final"},
                       "phi": {"signal": "phi", "take": "final"},
                       "fall": {"signal": "pointing", "take": "when_above", "level": 0.5},
                       "load": {"signal": "force.U47", "take": "largest"}},
    }  # fmt: skip
    work = FlightWork(study_from_plain(plain), block=16)
    found = work.run(0, 16)
    assert np.all(found["status"] == FINE)
    facing = jnp.asarray(work.study.flights.facing())

    def fallen(t, state):
        normal = rotation_matrix(state.p[-1])[:, 2]
        return jnp.arctan2(jnp.linalg.norm(jnp.cross(normal, facing)), normal @ facing) - 0.5

    dense = np.linspace(0.0, 0.5, 2001)
    for k in (0, 9):
        _, run = one_by_one(work, k, dense, rtol=1e-12, atol=1e-12)
        assert found["x"][k] == pytest.approx(float(run.states.r[-1, 0, 0]), abs=1e-8)
        # the load between steps is a quartic, and its peak is some 5 ms wide
        assert found["load"][k] == pytest.approx(largest(work, k, dense), rel=2e-4)
        _, run = one_by_one(work, k, [0.0, 0.5], rtol=1e-12, atol=1e-12, event=fallen)
        assert found["fall"][k] == pytest.approx(float(run.ts[-1]), abs=1e-6)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"scen": "x"}, "Did you mean 'scene'"),
        ({"quantities": {}}, "keeps nothing"),
        ({"quantities": {"a": {"signal": "tlt", "take": "final"}}}, "Did you mean 'tilt'"),
        ({"quantities": {"a": {"signal": "tilt", "take": "final", "level": 1.0}}}, "no level"),
        ({"quantities": {"a": {"signal": "tilt", "take": "when_above"}}}, "needs a level"),
        ({"quantities": {"steps": {"signal": "tilt", "take": "final"}}}, "Other columns"),
        ({"rtol": 0.0}, "at least 1e-15, but it is 0"),
        ({"direction": [0.0, 0.0, 2.0]}, "unit vector"),
        ({"rtol": 1e-16}, "at least 1e-15"),
    ],
)
def test_bad_studies(change, words):
    with pytest.raises(SettingError, match=words):
        _ = FlightWork(study_from_plain(TURNING | change)).columns
