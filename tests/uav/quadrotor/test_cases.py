"""The eight cases: truth by another integrator, the notes' figures, consistency."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from stmuav_jax.checks.errors import ModelError, SettingError
from stmuav_jax.estimation.filter import filter_bank
from stmuav_jax.math.rotation import rotation_matrix
from stmuav_jax.uav.quadrotor.assessment import (
    Estimates,
    consistent_tuning,
    estimate_case,
    report_tuning,
    study_case,
    summarise,
)
from stmuav_jax.uav.quadrotor.cases import CASES, CaseRecord, World, simulate_case
from stmuav_jax.uav.quadrotor.model import PART_III, report_model, report_prior, swinging_model

J = np.array(PART_III.value("inertia"))
QUIET = PART_III.replaced({"true.Q": [0.0] * 8, "true.R": [0.0] * 3})


def thrust_by_hand(case, t):
    """As the notes choose them."""
    s, c = np.sin(2 * np.pi * t), np.cos(2 * np.pi * t)
    return {
        4: [10 + 2 * s, 10 + 2 * c, 10 - 2 * s, 10 - 2 * c],
        6: [7, 9, 11, 13],
    }[case]


@pytest.mark.slow
def test_single_precision_runs_without_warnings():
    """Warnings are errors here: JAX has one for every number that it must shorten."""
    with jax.enable_x64(False):
        record = simulate_case(4, seeds=2, t1=0.01)
    assert record.y.dtype == np.float32
    assert np.all(np.isfinite(record.y))


@pytest.mark.slow
@pytest.mark.parametrize("case", [4, 6])
def test_truth_by_scipy(case):
    """Rates and attitude (rotation matrix here) after 0.2 s by DOP853, thrusts held."""
    record = simulate_case(case, seeds=1, t1=0.2, parameters=QUIET)

    def slope(t, x, F):
        w, R = x[:3], x[3:].reshape(3, 3)
        dx, dy = 0.05, 0.1
        if case > 4:
            dx, dy = 0.05 + 0.05 * np.sin(np.pi * t), 0.1 + 0.05 * (np.cos(np.pi * t) - 1)
        tau = [-dy * sum(F) + 0.5 * (F[1] - F[3]), dx * sum(F) + 0.5 * (F[2] - F[0]), 0.0]
        W = np.array([[0, -w[2], w[1]], [w[2], 0, -w[0]], [-w[1], w[0], 0]])
        return [*np.linalg.solve(J, tau - np.cross(w, J @ w)), *(R @ W).ravel()]

    x = np.array([0.1, 0.2, 0.3, *np.eye(3).ravel()])
    for k in range(200):
        F = thrust_by_hand(case, 1e-3 * k)
        span = (1e-3 * k, 1e-3 * (k + 1))
        x = solve_ivp(slope, span, x, "DOP853", args=(F,), rtol=1e-12, atol=1e-13).y[:, -1]
    # RK4 at h = 0.25 ms; the thrust is known to rounding, the moving offset to h^2
    np.testing.assert_allclose(record.omega[-1, :, 0], x[:3], rtol=0, atol=1e-9)
    R = rotation_matrix(record.p[-1, :, 0])
    np.testing.assert_allclose(R, x[3:].reshape(3, 3), rtol=0, atol=1e-9)
    np.testing.assert_array_equal(record.y[..., 0], record.omega[1:, :, 0])


def test_substeps_are_one_loop():
    """Written out they take six times as long, because the compiler computes them again and again."""

    def lines(substeps: int) -> int:
        world = World(substeps=substeps)
        run = lambda u: simulate_case(1, seeds=2, t1=0.002, world=world).omega + u
        return len(str(jax.make_jaxpr(run)(0.0)).splitlines())

    assert lines(1) > 50
    assert lines(8) <= lines(2)


@pytest.mark.slow
def test_noise_is_as_the_table_says():
    """Per-step variances of wandering offset and measured rates (statistical, 5 sigma)."""
    record = simulate_case(1, seeds=20, t1=0.5)
    steps = np.diff(np.asarray(record.offset), axis=0)
    noise = np.asarray(record.y) - np.asarray(record.omega)[1:]
    count = steps.shape[0] * 20
    for values, expected in ((steps, [1e-8, 1e-8]), (noise, PART_III.value("true.R"))):
        found = np.var(values, axis=(0, 2))
        np.testing.assert_allclose(found, expected, rtol=5 * np.sqrt(2 / count))
    # a run does not depend on how many others there are
    one = simulate_case(1, seeds=1, t1=0.5, seed=7)
    np.testing.assert_allclose(one.y[..., 0], record.y[..., 7], rtol=0, atol=1e-12)


@pytest.fixture(scope="module")
def studies(optimised):
    """All cases, 50 seeds, 2 s, both tunings: what `stmuav estimate` prints."""
    report = report_tuning()
    fixed, moving = consistent_tuning(1), consistent_tuning(5)
    return {case: study_case(case, [report, moving if case > 4 else fixed]) for case in CASES}


# medians to 2 cm [s] of an independent reproduction in NumPy, other seeds
NOTES = {1: 0.258, 2: 0.366, 3: 0.187, 4: 0.106, 5: 0.131, 6: 0.338, 7: 0.110, 8: 0.070}


# notebook 14 asserts the same of 20 seeds by default
@pytest.mark.slow
def test_the_target_table(studies):
    """Report's tuning 0.07 to 0.4 s to 2 cm; consistent 10 times faster, NEES and NIS in place."""
    for case in CASES:
        report, consistent = (studies[case].summaries[name] for name in ("report", "consistent"))
        # all seeds; ends of the range as printed, half of the last digit
        assert 0.0695 <= report.to_2cm <= report.to_2cm_worst <= 0.4005
        # medians of 50, of seeds that are not the same: 3 steps, 8 for case 3, whose spread is 40
        assert abs(report.to_2cm - NOTES[case]) <= (0.008 if case == 3 else 0.0035)
        assert consistent.to_2cm_worst <= report.to_2cm / 10
        assert not report.failed
        assert not consistent.failed
        for value, window in (
            (consistent.nees_offset, consistent.nees_offset_window),
            (consistent.nees, consistent.nees_window),
            (consistent.nis, consistent.nis_window),
        ):
            assert window[0] <= value <= window[1]
        assert consistent.outside <= 1
        # the report's is not consistent, and is seen not to be, from the innovations alone
        assert report.verdict.status == "inconsistent"
        assert report.verdict.flagged == 50
        assert consistent.verdict.status == "consistent"
        assert not report.nis_window[0] <= report.nis <= report.nis_window[1]


@pytest.mark.slow
def test_start_of_the_report_is_far_outside(studies):
    """NEES of the offset 50 ms after the start: 3.5e4 to 5.1e4 in the notes, expected 2."""
    for case in (1, 8):
        start = np.mean(np.asarray(studies[case].estimates["report"].nees_offset)[49])
        assert 3e4 < start < 6e4


@pytest.mark.slow
def test_smoother(studies):
    """RMSE at most 60 % of the filter's, after 0.1 s; and its covariance is right."""
    study, tuning = studies[8], consistent_tuning(8)
    smoothed = estimate_case(study.record, tuning, smoothed=True)
    settled = slice(100, 900)
    rmse = lambda e: np.sqrt(np.mean(np.asarray(e.error)[settled, 3:] ** 2, axis=(0, 2)))
    assert np.all(rmse(smoothed) <= 0.6 * rmse(study.estimates["consistent"]))
    low, high = 5 * 0.7, 5 * 1.35  # 50 seeds at each of 9 times, 99.9 % is 3.66 to 6.60
    means = np.mean(np.asarray(smoothed.nees), axis=1)[100:1000:100]
    assert np.all((means > low) & (means < high))


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_no_covariance_is_lost_in_single_precision():
    """8 cases x 50 seeds x 3 s, through the singular roll angle, report's tuning, 8 states."""
    records = [simulate_case(case, seeds=50, t1=3.0) for case in CASES]
    y = jnp.concatenate([r.y for r in records], axis=-1)
    u = jnp.concatenate(
        [jnp.broadcast_to(r.u[..., None], (*r.u.shape, 50)) for r in records], axis=-1
    )
    single = lambda a: np.asarray(a, np.float32)
    model = report_model(
        Q=np.diag(single(PART_III.value("filter.Q"))),
        R=np.diag(single(PART_III.value("filter.R"))),
        parameters=PART_III.replaced({"inertia": single(J)}),
    )
    prior = jax.tree.map(lambda a: a.astype(np.float32), report_prior())
    out = filter_bank(model, prior, single(y), u=single(u), dt=np.float32(1e-3))
    assert out.mean.dtype == out.factor.dtype == np.float32
    assert np.all(np.isfinite(out.mean[-1]))
    assert int(np.sum(out.ok[-1])) == 400


# --- bad input


def test_refused():
    with pytest.raises(SettingError, match="cases 1 to 8, not 9"):
        simulate_case(9)
    with pytest.raises(SettingError, match="At least one seed"):
        simulate_case(1, seeds=0)
    with pytest.raises(SettingError, match="first seed must lie"):
        simulate_case(1, seed=-1)
    with pytest.raises(SettingError, match="too many to keep at once"):
        simulate_case(1, seeds=10**10)
    with pytest.raises(SettingError, match=r"between one step of 0.001 s"):
        simulate_case(1, t1=-1.0)
    with pytest.raises(SettingError, match="period of the load must be positive"):
        swinging_model(0.0)
    with pytest.raises(ModelError, match="must agree"):
        swinging_model(2.0, Q=np.ones(5))


def test_a_bank_that_fails_is_counted():
    """All runs lost: no figures, but their number."""
    none = jnp.zeros((3, 2))
    path = jnp.zeros((3, 5, 2))
    seen = jnp.zeros((3, 3, 2))
    lost = Estimates(
        path, path, path, none, none, none, jnp.zeros((3, 2), bool), seen, jnp.ones_like(seen, bool)
    )
    t = jnp.arange(4) * 1e-3
    record = CaseRecord(t, jnp.zeros((3, 4)), jnp.zeros((4, 4, 2)), jnp.zeros((4, 3, 2)),
                    jnp.zeros((4, 2, 2)), jnp.zeros((3, 3, 2)), 1)  # fmt: skip
    row = summarise(lost, record, "consistent")
    assert row.failed == 2
    assert row.verdict.status == "failed"
    assert row.verdict.short == "failed: 2 of 2 runs lost their covariance"
    assert np.isnan(row.to_2cm)
