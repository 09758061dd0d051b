"""Every benchmark script runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

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


def test_first_result(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "first_result.py", "--repeats", "1", "--t1", "0.01",
         "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "first_result.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    for kind in ("cold", "warm"):
        figures = record[kind]["median"]
        assert figures["total"] > figures["rest"] > 0
