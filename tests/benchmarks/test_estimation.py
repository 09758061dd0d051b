"""The benchmark of the filters runs at its smallest size and leaves a complete record."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.mark.slow
def test_estimation(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "estimation.py", "--quick", "--results", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    record = json.loads((tmp_path / "estimation.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    for kind in record["ours"].values():
        for how in ("single", "bank"):
            assert kind[how]["median_us"] > 0
    assert set(record["online"]) == {"default", "without_async_dispatch", "native_loops"}
    assert all(how["median_us"] > 0 for how in record["online"].values())
    # a peer has figures, or the reason why not
    for peer in ("filterpy", "dynamax"):
        assert "apart" in record[peer] or record[peer]["skipped"]
