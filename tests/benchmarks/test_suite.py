"""The benchmark suite at its smallest size: every section leaves a record, and a page comes of it."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

FOLDER = Path(__file__).parents[2] / "benchmarks"
# Seconds that all sections may take; they need some two minutes.
PATIENCE = 600

# Section -> keys of its record, and keys of its first row.
WANTED = {
    "acceleration": ({"rows"}, {"method", "batch", "seconds", "operations", "failure"}),
    "hexacopter": ({"rows", "ratios"}, {"method", "tolerance", "seconds", "steps"}),
    "work_precision": ({"curves"}, {"problem", "rows", "references", "cheapest", "failure"}),
    "batch": ({"rows", "single", "tried"}, {"trajectories", "block", "per_second"}),
    "scaling": ({"rows", "exponents"}, {"loops", "acceleration_seconds", "run_seconds"}),
    "gradient": ({"rows", "differences"}, {"mode", "seconds", "cost_in_simulations"}),
    "vector_steps": ({"rows", "closed_loops"}, {"machine", "per_second", "position_error_many"}),
    "scenes": ({"rows"}, {"scene", "seconds", "accepted", "residual"}),
    "published": ({"curves"}, {"problem", "rows", "references", "cheapest", "failure"}),
    "stiff": ({"curves"}, {"problem", "rows", "references", "cheapest", "failure"}),
}


def run(folder: Path, sections: tuple[str, ...], capfd: Any) -> Path:
    """Run sections and build the page in a folder; returns the page."""
    page, said = folder / "docs" / "benchmarks.md", folder / "said.txt"
    arguments = ["--size", "one", "--no-peers", "--results", folder, "--page", page]
    code = None
    for _ in range(2):
        code = ended([FOLDER / "suite.py", *arguments, "--only", *sections], said)
        if code is not None:
            break
        # It hung once in some fifteen runs, and nobody knows where: the log of the tests has to
        # show it, whether or not the second run ends.
        with capfd.disabled():
            print(f"The suite hung:\n{said.read_text()}", file=sys.stderr, flush=True)
    assert code == 0, said.read_text()[-3000:]
    return page


def ended(command: list[Any], said: Path) -> int | None:
    """Exit status of a script, or None if it hung; then `said` has the stacks of all threads."""
    with said.open("w") as out:
        process = subprocess.Popen(
            [sys.executable, "-X", "faulthandler", *map(str, command)],
            stdout=out, stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
    try:
        return process.wait(PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGABRT)
        time.sleep(5)
        return None
    finally:
        # also the process with native loops that the suite has started
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def check(folder: Path, sections: tuple[str, ...], page: Path) -> None:
    """Every record is complete, nothing failed, every figure that the page shows is there."""
    for name in sections:
        record = json.loads((folder / f"suite_{name}.json").read_text())
        assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
        assert {"section", "size", "took_seconds", "machine", "peers", "skipped"} <= set(record)
        keys, first = WANTED[name]
        assert keys <= set(record)
        rows = record["curves" if "curves" in keys else "rows"]
        assert first <= set(rows[0])
        for row in [*rows, *(point for curve in rows for point in curve.get("rows", []))]:
            assert row["failure"] == ""
    text = page.read_text()
    # two more: what was compared with, and the state of the results
    assert text.count("\n## ") == 2 + len(sections)
    assert "smallest size" in text
    shown = [line.split("(")[1].rstrip(")") for line in text.splitlines() if line.startswith("![")]
    assert all((page.parent / place).stat().st_size > 0 for place in shown)


@pytest.mark.slow
def test_all_sections(tmp_path, capfd):
    sections = tuple(WANTED)
    check(tmp_path, sections, run(tmp_path, sections, capfd))
    gradient = json.loads((tmp_path / "suite_gradient.json").read_text())
    errors = [row["error"] for row in gradient["rows"] if row["error"] is not None]
    assert len(errors) == 3
    assert max(errors) < 1e-5
