"""The benchmark of singular postures runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
def test_singular_postures(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "singular.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "singular.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    rows = [*record["chains"], *record["couplers"], *record["misses"]]
    assert len(rows) == 3
    assert all(row["passed"] for row in rows)
