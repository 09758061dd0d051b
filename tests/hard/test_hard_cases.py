"""Hard cases: each reaches its end, with the error demanded, and knows how large its error is.

The cases and what they are compared with are those of `benchmarks/problems/hard.py`.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hard import holds, row_of, sweep
from problems.hard import CASES, TOLERANCES, Hard

import stmuav_jax as stm

FOLDER = Path(__file__).parents[2] / "benchmarks"
# Motions that are known to fewer digits than the run has, or whose error is not that of a length,
# an angle or a rate, tell nothing about the estimate.
NOT_KNOWN_WELL = ("stiffness 1e9", "mass ratio 1e9", "ten minutes")
ROUND_OFF = 1e-12


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_hard_case(case: Hard):
    row = row_of(case)
    assert holds(row), row
    if not case.name.startswith(NOT_KNOWN_WELL):
        assert row["reached"] <= 5 * row["estimated"] + ROUND_OFF


@pytest.mark.slow
def test_every_tolerance():
    """From 1e-2 to 1e-13: the error is at most 1,000 tolerances."""
    rows = list(sweep(TOLERANCES))
    assert len(rows) == 12
    for row in rows:
        assert holds(row), row


def folded_four_bar() -> stm.System:
    """A four-bar whose third rod lies back on the others, heavy beyond its foot: branches meet there."""
    small, z = (1e-2, 1e-2, 1e-2), (0.0, 0.0, 1.0)
    bodies = [
        stm.Body(f"rod{k}", 1.0, small, position=(k + 0.5 - 2 * (k == 2), 0.0, 0.0))
        for k in range(3)
    ]
    places, names = ((0.0,), (1.0,), (2.0,), (1.0,)), ("ground", "rod0", "rod1", "rod2", "ground")
    joints = [
        stm.revolute(f"R{k}", names[k], names[k + 1], point=(*places[k], 0.0, 0.0), axis=z)
        for k in range(4)
    ]
    return stm.System(bodies, joints, [stm.Gravity((0.0, -9.81, 0.0))])


@pytest.mark.slow
def test_a_start_in_a_singular_posture_is_named():
    """Nothing says which branch the motion follows: it stops at once, and the posture is named."""
    system = folded_four_bar()
    with pytest.raises(stm.SimulationError, match=r"the start is a singular posture of .*R\d"):
        stm.simulate(system, system.reference, t1=0.1)


@pytest.mark.parametrize("what", [{"mass": 0.0}, {"inertia": (1.0, 1.0, 2.5)}])
def test_bodies_that_cannot_exist_are_refused(what):
    given = {"mass": 1.0, "inertia": (1.0, 1.0, 1.0), **what}
    with pytest.raises(stm.ModelError, match=r"must|No body has"):
        stm.Body("link", given["mass"], given["inertia"])


@pytest.mark.slow
def test_the_page_is_made_of_the_record(tmp_path):
    subprocess.run(
        [sys.executable, FOLDER / "hard.py", "--quick", "--results", tmp_path, "--figures", tmp_path],
        check=True, capture_output=True, timeout=600,
    )  # fmt: skip
    content = json.loads((tmp_path / "hard.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(content["environment"])
    rows = [*content["cases"], *content["tolerances"]]
    assert len(rows) == 5
    assert all(np.isfinite(row["reached"]) and row["result"] == "successful" for row in rows)
    text = (tmp_path / "hard.md").read_text()
    assert "All are reached." in text
    assert all(row["name"] in text for row in content["cases"])
