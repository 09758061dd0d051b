"""The benchmark of throughput runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
def test_montecarlo(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "montecarlo.py", "--size", "one", "--results", tmp_path,
         "--page", tmp_path / "docs" / "throughput.md"],
        check=True, capture_output=True, timeout=900,
    )  # fmt: skip
    record = json.loads((tmp_path / "montecarlo.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    assert all(row["failed"] == 0 and row["per_second"] > 0 for row in record["rows"])
    assert record["tried"][-1]["largest_error"] < 1e-6
    assert record["cores"][0]["devices"] == 1
    assert record["cores"][0]["per_second_stored"] > 0
    page = (tmp_path / "docs" / "throughput.md").read_text()
    assert "## More cores, and the store" in page
    assert (tmp_path / "docs" / "figures" / "benchmarks" / "lanes.png").stat().st_size > 5000
