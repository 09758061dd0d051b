"""The lengths from the printed tables: what the fit finds, how sure it is, what it decides."""

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from stmuav_jax import PART_I, SettingError
from stmuav_jax.uav import initial_angles, tracker_geometry
from stmuav_jax.uav.airframe import PRINTED_CENTRES, PRINTED_ORIENTATIONS
from stmuav_jax.uav.tracker.bodies import place

sys.path.append(str(Path(__file__).parents[3] / "notebooks"))

from reconstruction import (
    ALTERNATIVES,
    UNKNOWNS,
    Reading,
    fit,
    mechanism,
    predicted,
    rms,
)

PRINTED = np.array(list(PRINTED_CENTRES.values()))


@pytest.fixture(scope="module")
def fits():
    return {name: fit(reading) for name, reading in ALTERNATIVES.items()}


@pytest.fixture(scope="module")
def best(fits):
    return fits["adopted reading"]


def test_adopted_lengths_reproduce_the_printed_centres():
    """0.64 mm rms over seven bodies, 1.08 mm at worst: docs/report_machine.md."""
    r, _ = predicted(tracker_geometry(PART_I), initial_angles(PART_I))
    errors = np.asarray(r) - PRINTED
    assert 1e3 * rms(errors) == pytest.approx(0.638, abs=5e-4)
    assert 1e3 * rms(errors, base=False) == pytest.approx(0.689, abs=5e-4)
    assert 1e3 * np.linalg.norm(errors, axis=1).max() == pytest.approx(1.08, abs=5e-3)


@pytest.mark.slow
def test_the_fit_reaches_its_figure(best):
    assert best.converged
    assert best.rms() <= 0.65e-3
    assert 1e3 * best.rms() == pytest.approx(0.428, abs=2e-3)
    assert 1e3 * best.worst() == pytest.approx(0.742, abs=2e-3)
    # as good as its weights say
    assert 0.4 < best.chi_square / best.freedom < 1.6


def test_the_fitted_mechanism_closes(best):
    """Errors are those of a mechanism, placed by hand from the printed numbers."""
    at = place(best.geometry, jnp.asarray(best.angles))
    assert np.max(np.abs(np.asarray(at.r) - PRINTED - best.position_errors)) < 1e-15
    rod = np.linalg.norm(at.points["S57"] - at.points["U35"])
    assert rod == pytest.approx(best.values["rod"] + best.values["rod_more"], abs=1e-15)
    p5 = np.array(PRINTED_ORIENTATIONS["rod_5"])
    assert np.asarray(at.p[3]) - p5 == pytest.approx(best.euler_errors[1], abs=1e-15)


def test_it_is_a_minimum(best):
    """By another route: SciPy, on misfits written in NumPy."""
    from scipy.optimize import least_squares

    names = list(best.values)
    sizes = np.array([UNKNOWNS[name][1] for name in names])
    everything = {name: start for name, (start, _) in UNKNOWNS.items()}
    spread = np.array([0.002, 0.004, 0.002, 0.004])[:, None]
    read = Reading().orientations()

    @jax.jit
    def bodies(values):
        return predicted(*mechanism(values))

    def misfits(x):
        u = everything | dict(zip(names, x * sizes, strict=True))
        r, p = bodies(np.array(list(u.values())))
        middles = np.array([u["middle_6"], u["middle_5"]]) - 0.5
        parts = (np.asarray(r) - PRINTED) / 5e-4, (np.asarray(p) - read) / spread, middles / 0.02
        return np.concatenate([part.ravel() for part in parts])

    x0 = np.array([everything[name] for name in names]) / sizes
    other = least_squares(misfits, x0, x_scale="jac", xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert 2 * other.cost == pytest.approx(best.chi_square, rel=1e-8)
    spreads = np.sqrt(np.diag(np.linalg.inv(other.jac.T @ other.jac))) * sizes
    assert list(best.standard_deviations.values()) == pytest.approx(spreads, rel=1e-3)


def test_other_starts_find_the_same(best):
    rng = np.random.default_rng(40)
    for _ in range(3):
        start = {name: at + 5 * size * rng.normal() for name, (at, size) in UNKNOWNS.items()}
        other = fit(start=start)
        assert other.converged
        assert other.chi_square == pytest.approx(best.chi_square, rel=1e-9)


def test_what_the_tables_do_not_decide(fits, best):
    """Joint 3-5's order weakly, equal rods not at all; legs apart fit a little better."""
    assert 1 < fits["joint 3-5 with x in the slider"].chi_square - best.chi_square < 4
    assert abs(fits["both rods of one length"].chi_square - best.chi_square) < 1
    assert best.standard_deviations["rod"] > 5e-3
    assert best.standard_deviations["rod_more"] < 1.5e-3
    gain = best.chi_square - fits["panel arms apart"].chi_square
    assert 6 < gain < 10
    assert fits["all of these apart"].freedom == best.freedom - 3


def test_bad_input():
    with pytest.raises(SettingError, match="no unknown arms"):
        fit(start={"arms": 0.1})
    with jax.enable_x64(False), pytest.raises(SettingError, match="double precision"):
        fit()
