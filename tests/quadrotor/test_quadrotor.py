"""The report's quadrotor: equations, observability, consistency, and other programs (oracles)."""

from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from linear import random_linear

from stmuav_jax.algebra.rotation import skew
from stmuav_jax.algebra.space import Vector
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.estimation.bank import filter_bank
from stmuav_jax.estimation.consistency import (
    autocorrelation,
    chi2_interval,
    inconsistent,
    mean_interval,
    path_nees,
)
from stmuav_jax.estimation.filter import kalman_filter
from stmuav_jax.estimation.gaussians import gaussian
from stmuav_jax.estimation.model import Sensor, StateSpaceModel
from stmuav_jax.estimation.observable import observability
from stmuav_jax.estimation.propagate import euler, rk4
from stmuav_jax.estimation.sigma import Unscented
from stmuav_jax.estimation.smoother import smooth
from stmuav_jax.estimation.update import GaussianFilter
from stmuav_jax.quadrotor.model import (
    PART_III,
    euler_angle_rates,
    observable_model,
    offsets,
    rates,
    report_model,
    report_prior,
    thrusts,
)

RULE = Unscented(0.1, 2.0, 0.1)
DT = 1e-3


@cache
def case_2(count=200):
    from estimation import record_of_case

    return record_of_case(2, count)


def rotation(q):
    p, t, s = q
    Z = jnp.array([[jnp.cos(s), -jnp.sin(s), 0], [jnp.sin(s), jnp.cos(s), 0], [0, 0, 1]])
    X = jnp.array([[1, 0, 0], [0, jnp.cos(p), -jnp.sin(p)], [0, jnp.sin(p), jnp.cos(p)]])
    Y = jnp.array([[jnp.cos(t), 0, jnp.sin(t)], [0, 1, 0], [-jnp.sin(t), 0, jnp.cos(t)]])
    return Z @ X @ Y


def test_kinematics():
    """R' = R Omega~ along the rates; what the report prints does not satisfy it."""
    q, w = jnp.array([0.4, -0.7, 1.1]), jnp.array([0.3, -0.5, 0.8])
    for rate, right in (
        (euler_angle_rates(q, w), True),
        (euler_angle_rates(q, w, "printed"), False),
    ):
        _, R_rate = jax.jvp(rotation, (q,), (rate,))
        error = float(jnp.max(jnp.abs(R_rate - rotation(q) @ skew(w))))
        assert (error < 1e-14) if right else (error > 0.1)


def test_rates_of_the_body():
    """Against the vector formula with cross products of arms and forces (Eq. 2.2.8)."""
    q = np.array([0.1, 0.2, 0.3, 0.5, -0.4, 0.7, 0.05, 0.1])
    F, arm = np.array([7.0, 9.0, 11.0, 13.0]), 0.5
    arms = np.array([[arm, 0, 0], [0, arm, 0], [-arm, 0, 0], [0, -arm, 0]])
    offset = np.array([q[6], q[7], 0.0])
    tau = sum(np.cross(a - offset, [0, 0, f]) for a, f in zip(arms, F, strict=True))
    J = np.array(PART_III.value("inertia"))
    expected = np.linalg.solve(J, tau - np.cross(q[3:6], J @ q[3:6]))
    found = rates()(jnp.asarray(q), jnp.asarray(F))
    np.testing.assert_allclose(found[3:6], expected, rtol=1e-13)
    five = rates(kinematics=None)(jnp.asarray(q[3:]), jnp.asarray(F))
    np.testing.assert_array_equal(five, found[3:])


def test_orders_of_the_steps():
    rate = lambda x, u: -x * x
    for step, order in ((euler, 1), (rk4, 4)):
        errors = []
        for n in (8, 16):
            x = jnp.array([1.0])
            for _ in range(n):
                x = step(rate)(x, None, 1.0 / n)
            errors.append(abs(float(x[0]) - 0.5))
        assert abs(np.log2(errors[0] / errors[1]) - order) < 0.3
    with pytest.raises(SettingError):
        rk4(rate, 0)


def test_cases():
    for case in range(1, 9):
        assert thrusts(case, np.zeros(3)).shape == (4, 3)
        np.testing.assert_allclose(offsets(case, 0.0), [0.05, 0.1])
    with pytest.raises(SettingError, match="cases 1 to 8"):
        thrusts(9, 0.0)


def test_what_can_be_observed():
    start = np.array(PART_III.value("true.start"))
    u = np.asarray(thrusts(2, np.arange(20) * DT)).T
    model = report_model("printed", "euler")
    seen = observability(model, jnp.asarray(start), u=u, dt=DT, count=20)
    assert seen.rank == 5
    assert seen.words() == (
        "5 of 8 directions are observable. Not observable at all: phi (roll angle), "
        "theta (pitch angle), psi (yaw angle)."
    )
    five = observable_model()
    seen = observability(five, jnp.asarray(start[3:]), u=u, dt=DT, count=20)
    assert seen.words() == "All 5 states are observable."
    # without thrust nothing depends on where the centre of mass is
    seen = observability(five, jnp.asarray(start[3:]), u=0 * u, dt=DT, count=20)
    assert seen.rank == 3
    assert "offset_x (centre of mass, x), offset_y" in seen.words()


def test_sums_that_cannot_be_observed():
    step = lambda x, u, dt: x
    sensor = Sensor(lambda x, u: jnp.stack([x[0] + 2 * x[1]]), [[1.0]], stacked=True)
    model = StateSpaceModel(step, np.eye(2), sensor, names=("a", "b"), stacked=True)
    seen = observability(model, jnp.zeros(2), dt=1.0, count=3)
    assert seen.words().endswith("Not observable together: a - 0.5 b.")


def test_report_converges_as_in_the_notes():
    """Case 2, report's tuning: 2 cm after 0.366 s (median, reproduction); 5 states the same."""
    u, y = case_2(500)
    kind: Any = {"u": u, "dt": DT, "method": GaussianFilter(RULE, "covariance")}
    out = kalman_filter(report_model(propagation="euler"), report_prior(), y, **kind)
    five = kalman_filter(observable_model("euler"), report_prior(states=5), y, **kind)
    np.testing.assert_allclose(out.mean[:, 3:], five.mean, rtol=0, atol=1e-9)
    error = np.max(np.abs(np.asarray(out.mean)[:, 6:] - [0.05, 0.1]), axis=1)
    converged = DT * (1 + np.max(np.nonzero(error > 0.02)))
    assert 0.33 < converged < 0.40
    # the start is 0.45 m wrong with a deviation of 0.9 mm: seen from the measurements alone
    flags = inconsistent(out, window=50)
    assert flags[:100].all()
    assert np.all(np.isfinite(out.nis))


def test_consistency():
    """D6 for a linear system: NEES and NIS in their intervals, white; wrong Q or R is seen."""
    case, runs, count = random_linear(seed=4, n=2, m=1, count=1), 100, 50
    rng = np.random.default_rng(7)
    x = rng.multivariate_normal(case.m0, case.P0, size=runs)
    xs, ys = [], []
    for _ in range(count):
        x = x @ case.F.T + rng.multivariate_normal(np.zeros(2), case.Q, size=runs)
        xs.append(x.T)
        ys.append(case.H @ x.T + np.sqrt(case.R[0, 0]) * rng.normal(size=(1, runs)))
    truth, y = jnp.asarray(np.array(xs)), jnp.asarray(np.array(ys))

    def run(wrong):
        out = filter_bank(
            case._replace(R=wrong * case.R).model(), case.prior(), y, dt=1.0, group=runs
        )
        nees = path_nees(out, truth, Vector(2))
        return np.asarray(nees), np.asarray(out.nis), np.asarray(out.innovations.normalised)

    nees, nis, scaled = run(1.0)
    for values, degrees in ((nees, 2), (nis, 1)):
        low, high = mean_interval(degrees, runs)
        outside = np.sum((values.mean(axis=1) < low) | (values.mean(axis=1) > high))
        assert outside <= 1
    low, high = chi2_interval(count * runs)
    assert low < nis.sum() < high
    for lag in range(1, 6):
        every = np.mean(autocorrelation(jnp.asarray(scaled), lag))
        assert abs(every) < 3.3 / np.sqrt(count * runs)
    _, nis, _ = run(4.0)
    assert nis.sum() < low


@pytest.mark.parametrize(
    ("n", "count", "level", "window"),
    [
        (1, 100, 0.95, (0.7422, 1.2956)),
        (2, 100, 0.999, (1.4066, 2.7242)),
        (3, 500, 0.999, (2.6526, 3.3736)),
        (12, 100, 0.95, (11.0589, 12.9790)),
    ],
)
def test_chi_squared_windows(n, count, level, window):
    """The table of D6 (published: half of the last digit)."""
    np.testing.assert_allclose(mean_interval(n, count, level), window, rtol=0, atol=6e-5)


def test_smoother_of_the_quadrotor():
    """Consistent tuning: the smoothed centre of mass is nearer to the truth."""
    u, y = case_2(400)
    five = observable_model(
        "euler",
        Q=np.array(PART_III.value("true.Q"))[3:],
        R=PART_III.value("true.R"),
    )
    start = np.array(PART_III.value("filter.start"))[3:]
    wrong = np.abs(start - np.array(PART_III.value("true.start"))[3:])
    out = kalman_filter(five, gaussian(start, np.diag(wrong**2)), y, u=u, dt=DT)
    smoothed = smooth(five, out)
    assert np.all(
        np.asarray(smoothed.standard_deviation) <= np.asarray(out.standard_deviation) * (1 + 1e-9)
    )
    inside = slice(20, 380)
    spread = lambda path: np.mean(np.asarray(path.standard_deviation)[inside, 3:])
    assert spread(smoothed) < 0.75 * spread(out)


# --- other programs, where they are installed


def test_filterpy():
    """Case 2, 200 steps, redrawn sigma points, in both forms."""
    pytest.importorskip("filterpy")
    from estimation import Size, with_filterpy

    found = with_filterpy(Size(repeats=1), *case_2())
    assert found["apart"] < 1e-9


@pytest.mark.filterwarnings("ignore")
def test_dynamax():
    """Case 2, 200 steps, its jitter taken out."""
    pytest.importorskip("dynamax")
    from estimation import Size, with_dynamax

    found = with_dynamax(Size(steps=200, filters=0, repeats=1), *case_2())
    assert found["apart"] < 1e-9


def test_square_root_is_the_same_filter():
    u, y = case_2()
    model, prior = report_model(propagation="euler"), report_prior()
    a = kalman_filter(model, prior, y, u=u, dt=DT, method=GaussianFilter(RULE))
    b = kalman_filter(model, prior, y, u=u, dt=DT, method=GaussianFilter(RULE, "covariance"))
    np.testing.assert_allclose(a.mean, b.mean, rtol=0, atol=1e-9)
    np.testing.assert_allclose(a.covariance, b.covariance, rtol=0, atol=1e-12)


def test_single_precision_holds():
    """The default filter in float32, where the covariance form may fail."""
    u, y = case_2()
    single = lambda a: np.asarray(a, np.float32)
    Q, R = np.diag(PART_III.value("filter.Q")), np.diag(PART_III.value("filter.R"))
    parameters = PART_III.replaced({"inertia": single(PART_III.value("inertia"))})
    model = report_model(propagation="euler", Q=single(Q), R=single(R), parameters=parameters)
    start = report_prior()
    prior = jax.tree.map(lambda a: a.astype(jnp.float32), start)
    out = kalman_filter(model, prior, single(y), u=single(u), dt=DT)
    assert out.mean.dtype == jnp.float32
    assert bool(out.ok[-1])
    double = kalman_filter(report_model(propagation="euler"), start, y, u=u, dt=DT)
    np.testing.assert_allclose(out.mean[:, 6:], double.mean[:, 6:], rtol=0, atol=5e-3)
