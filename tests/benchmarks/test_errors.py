"""The benchmark of the error estimate runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
def test_errors(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "errors.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "errors.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    (row,) = record["rows"]
    assert row["true"] > 0
    assert record["factors"]["0.1"]["within"] == 1
