"""The long-horizon benchmark: its symmetric comparator, its measures, its smoke test."""

import json
import runpy
import sys
from types import SimpleNamespace

import diffrax
import jax
import jax.numpy as jnp
import long_horizon
import numpy as np
import pytest
from problems import conservative
from shared.gauss import Gauss

import stmuav_jax as stm


def march(stages, y0, h, count):
    """y after so many steps of the plane pendulum y = (angle, rate), and whether all converged."""
    terms = diffrax.ODETerm(lambda t, y, args: jnp.stack([y[1], -jnp.sin(y[0])]))
    solver, zero = Gauss(stages), jnp.zeros(())

    def step(now, _):
        y, state, good = now
        y, _, _, state, result = solver.step(terms, zero, zero + h, y, None, state, False)
        return (y, state, good & (result == diffrax.RESULTS.successful)), None

    start = (y0, solver.init(terms, zero, zero + h, y0, None), jnp.asarray(True))
    (y, _, good), _ = jax.lax.scan(step, start, length=count)
    return np.asarray(y), bool(good)


START = jnp.array([2.0, 0.3])


@pytest.mark.parametrize("stages", [1, 2])
def test_order(stages):
    """Statistical class: 2 and 4 within 0.1, against ten times as many steps of order 4."""
    exact, _ = march(2, START, 3.0 / 640, 640)
    counts = (16, 32, 64)
    errors = [np.linalg.norm(march(stages, START, 3.0 / n, n)[0] - exact) for n in counts]
    assert -np.polyfit(np.log(counts), np.log(errors), 1)[0] == pytest.approx(2 * stages, abs=0.1)


@pytest.mark.parametrize("stages", [1, 2])
def test_symmetric(stages):
    """Exact class: as many steps back lead to the start."""
    there, good = march(stages, START, 0.1, 50)
    back, too = march(stages, jnp.asarray(there), -0.1, 50)
    assert good
    assert too
    np.testing.assert_allclose(back, START, rtol=0, atol=1e-12)


def test_steps_too_long_fail():
    """Fixed-point iterations diverge: a result code, not a number that looks fine."""
    assert not march(2, START, 20.0, 3)[1]


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


def test_equal_cost():
    """The best explicit run that costs no more, and none where all cost more."""

    def row(family, largest, seconds, step=None):
        hold = family.split(", ")[1]
        return {"family": family, "hold": hold, "largest": largest, "drift": largest,
                "seconds": seconds, "step": step, "tolerance": 1e-6}  # fmt: skip

    runs = [
        row("dopri8, projection", 1e-4, 1.0),
        row("tsit5, projection", 1e-6, 2.0),
        row("dopri8, none", 1e-9, 0.1),
        row("gauss, none", 1e-5, 0.5, 0.1),
        row("gauss, none", 1e-5, 1.5, 0.1),
        row("gauss, none", 1e-5, 2.5, 0.1),
    ]
    found = long_horizon.answer(runs, "seconds")
    assert [pair["ratio"] for pair in found["pairs"]] == [None, pytest.approx(0.1), 10.0]
    assert (found["compared"], found["explicit_better"]) == (2, 1)


@pytest.mark.parametrize("make", [conservative.heavy_top, conservative.four_bar])
def test_problems_start_consistent(make):
    """Exact class: velocities that the joints allow; the others start at rest or assembled."""
    problem = make()
    found = stm.assemble(problem.system, problem.state)
    np.testing.assert_allclose(found.state.v, problem.state.v, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.state.omega, problem.state.omega, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_smoke(tmp_path, monkeypatch):
    """The script at its smallest size: a complete record and its figures."""
    arguments = ["--quick", "--results", str(tmp_path), "--figures", str(tmp_path)]
    monkeypatch.setattr(sys, "argv", ["long_horizon.py", *arguments])
    runpy.run_path(long_horizon.__file__, run_name="__main__")
    record = json.loads((tmp_path / "long_horizon.json").read_text())
    assert {"commit", "dirty", "versions", "cores", "date"} <= set(record["environment"])
    (problem,) = record["problems"]
    assert len(problem["runs"]) == 4
    for row in problem["runs"]:
        assert row["completed"]
        assert row["residual"] <= 1e-8
        assert row["seconds"] > 0
    coarse, fine = (row for row in problem["runs"] if row["solver"] == "dopri8")
    assert fine["largest"] < coarse["largest"]
    assert fine["evaluations"] > coarse["evaluations"]
    assert len(list(tmp_path.glob("*.png"))) == 3
