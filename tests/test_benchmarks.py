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
def test_first_result(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "first_result.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "first_result.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    for kind in ("cold", "warm"):
        figures = record[kind]["median"]
        assert figures["total"] > figures["rest"] > 0


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
