"""Identification on records of a known truth: turns, an uncertain start, missing data, deviations, verdicts."""

from itertools import pairwise
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter

import stmuav_jax as stm
from stmuav_jax.analysis.identification import physical_faults
from stmuav_jax.math.rotation import from_rotation_vector, to_rotation_vector
from stmuav_jax.math.sampled import Sampled
from stmuav_jax.math.space import Rotation, RotationVector

G, MASS, ARM, INERTIA = 9.81, 1.2, 0.3, 0.02
ABOUT_PIN = INERTIA + MASS * ARM**2
FRICTION, NOISE = 0.12, 0.01
SIZES = [0.1]


def pendulum(friction: Any, mass: Any = MASS):
    """A body on a hinge, which a torque turns against gravity and friction."""
    body = stm.Body("rod", mass, jnp.eye(3) * INERTIA, com=-ARM * jnp.eye(3)[2])
    pin = stm.revolute("pin", "ground", "rod", point=[0.0, 0.0, 0.0], axis=[0.0, 1.0, 0.0])
    forces = [
        stm.Gravity([0.0, 0.0, -G]), stm.JointEffort("pin", 0.0),
        stm.mechanics.JointDamping("pin", turning=friction),
    ]  # fmt: skip
    return stm.System([body], [pin], forces)


def swing(ts, angle, rate, torque, lag=0.0, mass=MASS, friction=FRICTION):
    """Angles (k, n) of n pendulums by Runge and Kutta's method in NumPy, the torque behind a lag [s]."""
    about = INERTIA + mass * ARM**2
    x = np.stack([angle, rate, np.full_like(angle, torque(ts[0]))])

    def slope(t, x):
        felt = x[2] if lag else torque(t)
        turn = (felt - friction * x[1] - mass * G * ARM * np.sin(x[0])) / about
        return np.stack([x[1], turn, (torque(t) - x[2]) / lag if lag else 0 * x[2]])

    found, parts = [x[0]], 10
    for t0, t1 in pairwise(ts):
        h = (t1 - t0) / parts
        for j in range(parts):
            t = t0 + j * h
            a = slope(t, x)
            b = slope(t + h / 2, x + h / 2 * a)
            c = slope(t + h / 2, x + h / 2 * b)
            d = slope(t + h, x + h * c)
            x = x + h / 6 * (a + 2 * b + 2 * c + d)
        found.append(x[0])
    return np.stack(found)


SYSTEM = pendulum(FRICTION)
SPACE = stm.TreeSpace(SYSTEM)
REST = SPACE.from_state(SYSTEM.reference)
# 2.6 turns and on: released near the top with a push
TURNING = np.linspace(0.0, 3.0, 151)
SPUN = SPACE.retract(REST, jnp.array([1.0, 20.0]))


def made(q):
    return pendulum(q[0])


@pytest.fixture(scope="module")
def spun():
    """A record of more than two turns, as it is, with noise."""
    truth = swing(TURNING, np.array([1.0]), np.array([20.0]), lambda t: 0.0)
    assert np.ptp(truth) > 2.2 * 2 * np.pi
    return truth + NOISE * np.random.default_rng(3).normal(size=truth.shape)


def wrapped(angle):
    return np.arctan2(np.sin(angle), np.cos(angle))


@pytest.fixture(scope="module")
def by_encoder():
    return stm.analysis.motion_model(
        made, SPUN, TURNING, [stm.analysis.Encoder("pin")], space=SPACE,
        start_deviations={"pin.angle": 0.02, "pin.angle_rate": 0.1},
    )  # fmt: skip


@pytest.mark.slow
def test_turns_of_an_angle_may_be_recorded_or_not(spun, by_encoder):
    """From a start 40 % off, wrapped and unwrapped."""
    found = {
        name: stm.analysis.identify(by_encoder, record, [NOISE], {"friction": 0.17}, SIZES)
        for name, record in {"encoder": wrapped(spun), "unwrapped": spun}.items()
    }
    for name, each in found.items():
        assert each.within([FRICTION], 2.0), name
        assert each.standard_deviations[0] < 0.003
        assert each.verdict.status == "consistent", each.verdict.explanation
        # one record has one minimum, to the search's tolerance
        assert each.values[0] == pytest.approx(found["encoder"].values[0], abs=1e-5)
        assert each.start is not None
        assert float(each.start.mean.u[0]) == pytest.approx(20.0, abs=0.1)


@pytest.mark.slow
def test_missing_readings_are_left_out(spun, by_encoder):
    """NaN and a mask say the same: 30 % of single readings and a gap of 0.3 s."""
    holes = np.random.default_rng(5).random(spun.shape) < 0.3
    holes[60:75] = True
    blank = np.where(holes, np.nan, wrapped(spun))
    masked = np.ma.array(np.where(holes, -999.0, wrapped(spun)), mask=holes)
    found = [
        stm.analysis.identify(by_encoder, record, [NOISE], {"friction": 0.15}, SIZES)
        for record in (blank, masked)
    ]
    assert found[0].values[0] == found[1].values[0]
    assert found[0].within([FRICTION], 2.0)
    assert np.all(np.isnan(found[0].residuals) == holes)
    assert "missing and was left out" in found[0].verdict.explanation
    bad = spun.copy()
    bad[3] = np.inf
    with pytest.raises(stm.ModelError, match=r"infinite at \[3, 0\]"):
        stm.analysis.identify(by_encoder, bad, [NOISE], {"friction": 0.15}, SIZES)


@pytest.mark.slow
def test_an_exact_start_that_is_none_is_said(spun):
    """A start one hundredth of a radian off, taken as exact: the verdict speaks, and names the way out."""
    exact = stm.analysis.motion_model(
        made, SPACE.retract(SPUN, jnp.array([0.02, 0.1])), TURNING, [stm.analysis.Encoder("pin")],
        space=SPACE,
    )  # fmt: skip
    found = stm.analysis.identify(exact, spun, [NOISE], {"friction": 0.15}, SIZES)
    assert found.verdict.status == "inconsistent"
    assert "start_deviations" in found.verdict.explanation
    assert found.deviations.blocks is not None
    assert found.standard_deviations[0] > 1.5 * found.deviations.white[0]


# --- deviations of many records

DRIVEN = np.linspace(0.0, 2.0, 101)
KNOTS = np.linspace(0.0, 2.0, 9)
TORQUE = Sampled(KNOTS, 1.5 * np.random.default_rng(8).normal(size=9), 3)


@pytest.fixture(scope="module")
def driven():
    """Model of a driven pendulum whose start is known to 0.05 rad and 0.2 rad/s: friction and mass."""
    return stm.analysis.motion_model(
        lambda q: pendulum(q[0], q[1]), REST, DRIVEN, [stm.analysis.Encoder("pin")], space=SPACE,
        inputs={"effort": TORQUE},
        start_deviations={"pin.angle": 0.05, "pin.angle_rate": 0.2},
        # errors of 1e-6 rad are far below the noise
        method=stm.Method(rtol=1e-6, atol=1e-7, adjoint=diffrax.ForwardMode()),
    )  # fmt: skip


def many(driven, lag, count):
    """Fits of records with starts from the prior, and a torque that lags."""
    rng = np.random.default_rng(11)
    angle, rate = 0.05 * rng.normal(size=count), 0.2 * rng.normal(size=count)
    # the twin's method takes half steps of a tenth of the sampling time
    every = np.linspace(DRIVEN[0], DRIVEN[-1], 20 * (len(DRIVEN) - 1) + 1)
    table = np.asarray(jax.vmap(TORQUE)(jnp.asarray(every)))
    torque = lambda t: table[round(t / every[1])]
    records = swing(DRIVEN, angle, rate, torque, lag).T[..., None]
    records = records + 0.01 * rng.normal(size=records.shape)
    start = {"friction": 0.14, "mass": 1.1}
    return [stm.analysis.identify(driven, record, [0.01], start, [0.1, 0.2]) for record in records]


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_intervals_hold_the_truth_with_an_uncertain_start(driven):
    """95 % intervals of 100 records; 92 to 98 % is about three deviations of the count of 200."""
    found = many(driven, 0.0, 100)
    z = np.array([(one.values - [FRICTION, MASS]) / one.standard_deviations for one in found])
    inside = np.mean(np.abs(z) < 1.96)
    assert 0.92 <= inside <= 0.98
    assert sum(one.verdict.status == "consistent" for one in found) >= 96
    # deviations of white residuals, of the whole: none had to be enlarged in nearly all
    assert sum(one.deviations.blocks is None for one in found) >= 96


@pytest.mark.slow
@pytest.mark.usefixtures("optimised")
def test_a_lag_left_out_of_the_model_is_said(driven):
    """30 ms of the drive's lag are not in the model: all of 20 verdicts say that something is."""
    for one in many(driven, 0.03, 20):
        assert one.verdict.status == "inconsistent"
        assert "the model leaves something out (a lag" in one.verdict.explanation


# --- regressions, whose deviations have closed forms or many cheap records

ROWS = np.linspace(0.0, 1.0, 2000)
REGRESSORS = np.stack([np.ones(2000), np.sin(6 * np.pi * ROWS)], axis=1)


def line(q):
    return (jnp.asarray(REGRESSORS) @ q)[:, None]


def coloured(rho, rng, count, rows):
    """Noise (count, rows) of unit deviation with a correlation rho from row to row."""
    white = rng.normal(size=(count, rows + 500))
    filtered: Any = lfilter([np.sqrt(1 - rho**2)], [1.0, -rho], white)
    return filtered[:, 500:]


@pytest.mark.slow
def test_correlated_residuals_have_deviations_by_blocks():
    """95 % intervals of 100 records: as of white residuals they would hold the truth in a third of them."""
    noise = coloured(0.95, np.random.default_rng(2), 100, 2000)
    records = (REGRESSORS @ [1.0, 2.0] + 0.1 * noise)[:, :, None]
    start = {"a": 0.5, "b": 1.0}
    found = [stm.analysis.identify(line, record, [0.1], start, [1.0, 1.0]) for record in records]
    off = np.array([one.values - [1.0, 2.0] for one in found])
    inside = np.mean(np.abs(off) < 1.96 * np.array([one.standard_deviations for one in found]))
    white = np.mean(np.abs(off) < 1.96 * np.array([one.deviations.white for one in found]))
    # 200 numbers, of which few blocks tell the deviations: 95 % within three deviations of a count and 2 %
    assert 0.88 < inside < 0.99
    assert white < 0.6
    # the integral of the correlation is (1 + rho) / (1 - rho): the root is 6.2
    ratio = np.mean([one.deviations.blocks[0] / one.deviations.white[0] for one in found])  # pyright: ignore[reportOptionalSubscript]
    assert ratio == pytest.approx(np.sqrt(1.95 / 0.05), rel=0.1)
    words = found[0].verdict.explanation
    assert "by blocks of" in words
    assert "Residuals are correlated in time" in words


def test_white_residuals_keep_their_deviations():
    """Those of linear regression; a noise twice as large as given enlarges them by two, and is said."""
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(2000, 1))
    exact = np.sqrt(np.diag(np.linalg.inv(REGRESSORS.T @ REGRESSORS)))
    for size in (0.1, 0.2):
        found = stm.analysis.identify(
            line, line(jnp.array([1.0, 2.0])) + size * noise, [0.1], [0.5, 1.0], [1.0, 1.0]
        )
        record = REGRESSORS @ [1.0, 2.0] + size * noise[:, 0]
        np.testing.assert_allclose(found.values, np.linalg.lstsq(REGRESSORS, record)[0], atol=1e-8)
        np.testing.assert_allclose(found.deviations.white, 0.1 * exact, rtol=1e-8)
        scale = 1.0 if size == 0.1 else np.sqrt(found.reduced_chi_square)
        np.testing.assert_allclose(found.standard_deviations, scale * 0.1 * exact, rtol=1e-8)
        assert found.verdict.status == ("consistent" if size == 0.1 else "inconsistent")
    assert "larger than the record's deviations say" in found.verdict.explanation


def test_windows_that_disagree_are_added_to_the_deviations():
    """A gain that is another one in each fifth of the record: its scatter, not the noise, is its deviation."""
    rng = np.random.default_rng(4)
    gains = 2.0 + 0.3 * np.array([1.0, -1.0, 0.5, -1.2, 0.7])
    gain = np.repeat(gains, 400)
    record = 1.0 + gain * REGRESSORS[:, 1] + 0.1 * rng.normal(size=2000)
    found = stm.analysis.identify(
        line, record[:, None], [0.1], {"offset": 0.5, "gain": 1.0}, [1.0, 1.0]
    )
    assert "Windows of the record disagree" in found.verdict.explanation
    assert (
        "The scatter between windows is added to the deviations of gain."
        in found.verdict.explanation
    )
    # five windows tell a scatter to about a third
    assert found.standard_deviations[1] == pytest.approx(np.std(gains, ddof=1), rel=0.35)
    np.testing.assert_allclose(found.deviations.window_values[:, 1], gains, atol=0.05)  # pyright: ignore[reportOptionalSubscript]
    assert found.deviations.windows[0] == 0.0


def test_bounds_keep_a_parameter_physical():
    """Within its bound an estimate is that of a free search; beyond it, it stays inside, and is said."""
    rng = np.random.default_rng(6)
    noise = 0.1 * rng.normal(size=(2000, 1))
    fit = lambda truth, bounds: stm.analysis.identify(
        line, line(jnp.array([1.0, truth])) + noise, [0.1], {"offset": 0.5, "drag": 0.3}, [1.0, 0.3],
        bounds=bounds,
    )  # fmt: skip
    for bounds in ({"drag": (0.0, np.inf)}, {"drag": (-1.0, 2.0)}, {"drag": (-np.inf, 4.0)}):
        found, free = fit(0.5, bounds), fit(0.5, None)
        np.testing.assert_allclose(found.values, free.values, atol=1e-6)
        np.testing.assert_allclose(found.standard_deviations, free.standard_deviations, rtol=1e-5)
    assert fit(-0.2, None).values[1] < 0
    found = fit(-0.2, {"drag": (0.0, np.inf)})
    assert 0 < found.values[1] < 0.01
    assert "drag ended at its bound" in found.verdict.explanation
    with pytest.raises(
        stm.SettingError, match=r"start of drag must lie between its bounds 1 and inf"
    ):
        fit(0.5, {"drag": (1.0, np.inf)})
    with pytest.raises(stm.SettingError, match="name 'mass', which is no parameter"):
        fit(0.5, {"mass": (1.0, np.inf)})


def test_what_no_mechanism_has_is_named():
    """A negative mass, an inertia tensor that no body has, and a negative friction, by body and joint."""
    parts = lambda s: (s.bodies.mass, s.bodies.inertia, s.forces[2].turning)
    bad = (jnp.array([-0.5]), jnp.diag(jnp.array([1.0, 1.0, 3.0]))[None], jnp.array(-0.1))
    words = " ".join(physical_faults(eqx.tree_at(parts, SYSTEM, bad)))
    assert "mass of body 'rod' must be finite and positive, but it is -0.5 kg" in words
    assert "violates the triangle inequality" in words
    assert "turning of JointDamping of pin must not be negative, but it is -0.1" in words
    assert physical_faults(SYSTEM) == ()


@pytest.mark.slow
def test_rotations_are_compared_as_rotations():
    """A body that turns three times: a rate from unit quaternions of either sign, and from rotation vectors."""
    ts, rate, noise = np.linspace(0.0, 4.0, 80), 5.0, 0.02
    axis = np.array([0.6, 0.0, 0.8])
    turned = lambda q: jax.vmap(from_rotation_vector)(q[0] * jnp.asarray(ts)[:, None] * axis)
    rng = np.random.default_rng(9)
    exact = turned(jnp.array([rate]))
    record = np.asarray(
        jax.vmap(Rotation().retract)(exact, jnp.asarray(noise * rng.normal(size=(80, 3))))
    )
    record = record * rng.choice([-1.0, 1.0], size=(80, 1))
    record[5, 2] = np.nan
    found = stm.analysis.identify(turned, record, [noise] * 3, [4.9], [0.1], readings=Rotation())
    assert found.within([rate], 3.0)
    assert found.verdict.status == "consistent"
    assert np.all(np.isnan(found.residuals[5]))
    # as rotation vectors, which jump where the angle passes half a turn
    vectors = lambda q: jax.vmap(to_rotation_vector)(turned(q))
    record = vectors(jnp.array([rate])) + noise * rng.normal(size=(80, 3))
    found = stm.analysis.identify(
        vectors, record, [noise] * 3, [4.9], [0.1], readings=RotationVector()
    )
    assert found.within([rate], 3.0)
    assert found.verdict.status == "consistent"


def test_a_search_that_has_not_arrived_says_so():
    """One step of many is no estimate, whatever its deviations."""
    curved = lambda q: jnp.exp(q[0] * jnp.asarray(ROWS))[:, None]
    record = curved(jnp.array([3.0]))
    found = stm.analysis.identify(curved, record, [0.1], {"rate": 1.0}, [1.0], steps=1)
    assert found.verdict.status == "failed"
    assert "not at a minimum" in found.verdict.explanation


@pytest.mark.slow
def test_an_estimate_that_no_mechanism_has_is_said(by_encoder):
    """A pendulum whose angle grows where friction would take it down: a negative friction, by name."""
    start = np.array([1.0]), np.array([20.0])
    truth = swing(TURNING, *start, lambda t: 0.0, friction=-0.02)
    record = truth + NOISE * np.random.default_rng(1).normal(size=truth.shape)
    found = stm.analysis.identify(by_encoder, record, [NOISE], {"friction": 0.02}, SIZES)
    assert found.values[0] < -0.01
    assert found.verdict.status == "inconsistent"
    assert "must not be negative, but it is -0." in found.verdict.explanation
