"""The benchmark of trims runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
def test_trims(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "trims.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "trims.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    assert sum(record["ours"]["reasons"].values()) == 6
    assert record["ours"]["largest_residual"] < 1e-10
    assert record["scipy"]["median_residual"] < 1e-8
