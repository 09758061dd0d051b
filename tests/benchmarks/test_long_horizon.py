"""The long-horizon benchmark: its measures, what it keeps of symmetric methods, its smoke test."""

import json
from types import SimpleNamespace

import long_horizon
import numpy as np
import pytest
from problems import conservative
from shared import record

import stmuav_jax as stm


def path_of(total):
    return SimpleNamespace(total=np.array(total), good=np.isfinite(np.array(total)))


def test_energy_error_of_a_straight_line():
    """Exact class: 1 J lost a second with a scale of 2 J."""
    ts = np.linspace(0.0, 4.0, 9)
    found = long_horizon.energy_error(ts, path_of(3.0 - ts), 2.0)
    assert found["largest"] == 2.0
    assert found["drift"] == pytest.approx(-0.5)
    assert found["about_line"] == pytest.approx(0.0, abs=1e-12)
    failed = long_horizon.energy_error(ts, path_of([*(3.0 - ts[:-1]), np.nan]), 2.0)
    assert set(failed.values()) == {None}


@pytest.mark.slow
def test_symmetric_methods_are_kept():
    """The former record's runs and comparison stand beside new runs, which they do not touch."""
    former = json.loads((record.RESULTS / "long_horizon.json").read_text())["problems"][0]
    quick = long_horizon.QUICK
    runner = long_horizon.Runner(np.linspace(0.0, 0.1, 3), 1)
    found = long_horizon.run_problem(conservative.simple_pendulum(), quick, runner, former)
    kept = [row for row in former["runs"] if row["solver"] in long_horizon.SYMMETRIC]
    assert len(kept) == 18
    assert found["runs"][-18:] == kept
    assert found["answers"] == former["answers"]
    assert len(found["runs"]) == 20


@pytest.mark.parametrize("make", [conservative.heavy_top, conservative.four_bar])
def test_problems_start_consistent(make):
    """Exact class: velocities that the joints allow; the others start at rest or assembled."""
    problem = make()
    found = stm.assemble(problem.system, problem.state)
    np.testing.assert_allclose(found.state.v, problem.state.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.state.omega, problem.state.omega, rtol=0, atol=1e-10)
