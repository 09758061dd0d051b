"""Every benchmark script runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from sections.tables import compile_times

FOLDER = Path(__file__).parents[1] / "benchmarks"


def test_waiting(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "waiting.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "waiting.json").read_text())
    for kind in ("cold", "warm"):
        own = record["commands"]["list"][kind]
        assert own["runs"][0]["exit"] == 0
        assert own["wall"] > 0
        assert own["memory"] > 10


@pytest.mark.slow
def test_batch_sizes(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "batch_sizes.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    (row,) = json.loads((tmp_path / "batch_sizes.json").read_text())["rows"]
    assert row["size"] == 8
    assert min(row["flights_per_second"], row["filter_step_us"]) > 0
    assert (row["flights_failed"], row["filters_failed"]) == (0, 0)


def test_compile_times(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "compile_times.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    found = json.loads((tmp_path / "compile_times.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(found["environment"])
    (row,) = found["rows"]
    assert min(row[f"{k}_seconds"] for k in ("trace", "lower", "compile")) > 0
    # the program holds the integrator's loops and the equations of motion
    assert row["equations"] > 500
    assert f"| {row['program']} |" in "\n".join(compile_times(found))
