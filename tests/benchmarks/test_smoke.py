"""Benchmark scripts at their smallest size: each leaves a complete record, of which figures and pages are made."""

import itertools
import json
from types import SimpleNamespace

import numpy as np
import pytest
import report
from problems.multirotor_flights import VALUES
from sections.figures import draw_figures
from shared.record import RESULTS

pytestmark = pytest.mark.slow


def test_waiting(run_script):
    record = run_script("waiting")
    for kind in ("cold", "warm"):
        command = record["commands"]["list"][kind]
        assert command["wall"] > 0
        assert command["memory"] > 10


def test_compile_times(run_script):
    record = run_script("compile_times")
    (row,) = record["rows"]
    assert min(row[f"{k}_seconds"] for k in ("trace", "lower", "compile")) > 0
    # the program holds the integrator's loops and the equations of motion
    assert row["equations"] > 500


def test_structures(run_script):
    (row,) = run_script("structures")["rows"]
    assert row["structures"] == 2
    assert min(row["megabytes"], row["cpu_seconds"]) > 1


def test_batch_sizes(run_script):
    (row,) = run_script("batch_sizes")["rows"]
    assert row["size"] == 8
    assert min(row["flights_per_second"], row["filter_step_us"]) > 0
    assert (row["flights_failed"], row["filters_failed"]) == (0, 0)


def test_machine_code(run_script, tmp_path):
    record = run_script("machine_code")
    for operations in record["operations"].values():
        assert 0 < operations["left"] < 0.7 * operations["traced"]
    for row in (*record["rows"], *record["flights"]):
        assert row["difference"] <= 1e-9
    assert len(record["rows"]) == 4
    (figure,) = draw_figures(tmp_path, tmp_path)
    assert figure.stat().st_size > 5000


def test_errors(run_script):
    record = run_script("errors")
    assert record["rows"][0]["true"] > 0
    assert record["factors"]["0.1"]["within"] == 1


def test_failure(run_script):
    record = run_script("failure")
    assert record["measured"]["deciding"]["commit"] == record["environment"]["commit"]
    assert all(row["steps"] > 0 for row in record["deciding"])
    corrected = record["deciding"][0]
    assert (corrected["name"], corrected["failure"]) == ("corrected", "")
    assert corrected["violation"] < 1e-4
    # what was measured once is kept
    assert record["trials"] == json.loads((RESULTS / "failure.json").read_text())["trials"]


def test_long_horizon(run_script, tmp_path):
    (problem,) = run_script("long_horizon")["problems"]
    assert len(problem["runs"]) == 2
    for row in problem["runs"]:
        assert row["completed"]
        assert row["residual"] <= 1e-8
        assert row["seconds"] > 0
    coarse, fine = problem["runs"]
    assert fine["largest"] < coarse["largest"]
    assert fine["evaluations"] > coarse["evaluations"]
    assert len(draw_figures(tmp_path, tmp_path)) == 3


def test_stiff(run_script, tmp_path):
    record = run_script("stiff")
    soft, hard = record["scenes"]
    # one sliding body of m = 1 kg: |eigenvalue| = sqrt(k / m) where the damping is light
    assert soft["eigenvalue"]["start"] == pytest.approx(np.sqrt(soft["stiffness"]), rel=1e-3)
    assert hard["eigenvalue"]["start"] > soft["eigenvalue"]["start"]
    for scene in (soft, hard):
        assert max(scene["reference"]["kvaerno5_apart"]) <= 1e-10
        assert all(row["completed"] and row["error"] <= 1e-6 for row in scene["runs"])
        assert scene["cheapest"]["1e-06"]["explicit_over_implicit"] > 0
    assert len(draw_figures(tmp_path, tmp_path)) == 2


# Section of the suite -> keys of its record, and keys of its first row. The others time programs that
# other tests compile: curves those of `published`, gradients those of tests/laws/test_gradients.py.
SECTIONS = {
    "scaling": ({"rows", "exponents"}, {"loops", "acceleration_seconds", "run_seconds"}),
    "vector_steps": ({"rows", "horizon"}, {"machine", "per_second", "position_error_many"}),
    "published": ({"curves"}, {"problem", "rows", "references", "cheapest", "failure"}),
}


def test_suite(run_script, tmp_path):
    """Every record is complete, nothing failed, and the page shows what there is."""
    arguments = ("--size", "one", "--no-peers", "--only", *SECTIONS)
    run_script("suite", *arguments, record="suite_scaling")
    for name, (keys, first) in SECTIONS.items():
        record = json.loads((tmp_path / f"suite_{name}.json").read_text())
        assert {"section", "size", "took_seconds", "machine", "peers", "skipped"} <= set(record)
        assert keys <= set(record)
        rows = record["curves" if "curves" in keys else "rows"]
        assert first <= set(rows[0])
        for row in [*rows, *(point for curve in rows for point in curve.get("rows", []))]:
            assert row["failure"] == ""
    text = report.build(tmp_path, tmp_path / "benchmarks.md").read_text()
    # the provenance stands at the end
    assert text.count("\n## ") == len(SECTIONS) + 1
    assert all(f"suite_{name}.json" in text for name in SECTIONS)
    assert "smallest size" in text


def test_flight_logs(run_script, monkeypatch):
    """Of made-up answers, alternately two deviations above the truth and at it; tests/uav identifies flights."""
    answers = itertools.cycle([2.0, 0.0])

    def identify(record, layout):
        off = next(answers)
        estimates = {
            name: SimpleNamespace(value=value + off * 0.1, deviation=0.1, white=0.05)
            for name, value in VALUES.items()
        }
        p_values = {"lag": 1e-3 if off else 0.5, "sag": 0.5}
        verdict = SimpleNamespace(p_values=p_values, status="consistent")
        return SimpleNamespace(estimates=estimates, verdict=verdict)

    monkeypatch.setattr("stmuav_jax.uav.identify_flight", identify)
    record = run_script("flight_logs")
    assert {row["quantity"] for row in record["estimates"]} == set(VALUES)
    row = record["estimates"][0]
    assert (row["flights"], row["cover_95"], row["over_white"]) == (2, 0.5, 2.0)
    assert row["mean_in_deviations"] == pytest.approx(1.0)
    found = [(row["flights"], row["share"]) for row in record["said"]]
    assert found == [(2, 0.5), (2, 0.0), (1, 1.0), (1, 0.0)]
