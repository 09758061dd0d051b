"""Inputs and parameters found by gradients through the flight."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from shared.uav_record import simulate_record

import stmuav_jax as stm
from stmuav_jax.analysis import (
    IdentifiabilityError,
    Limit,
    Unknown,
    check_identifiable,
    departures,
    from_table,
    hover,
    identify,
    joint_forces,
    make_shooting,
    roughness,
    tune_inputs,
    tune_slew,
)
from stmuav_jax.analysis.multiple_shooting import integrate_points
from stmuav_jax.analysis.sensors import joint_output
from stmuav_jax.uav import trim_flight
from stmuav_jax.uav.rotor import hover_speed_squared
from stmuav_jax.uav.scenes.flight_options import Motor
from stmuav_jax.uav.scenes.uav_tracker import make_uav
from stmuav_jax.uav.tracker.workspace import tracker_limits

# searches fly many times: they compute for longer than they compile
pytestmark = pytest.mark.usefixtures("optimised")

START = stm.uav.initial_angles(stm.PART_II)
LM = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8)


@pytest.fixture(scope="module")
def uav():
    return make_uav()


@pytest.mark.slow
def test_a_motion_in_parts_keeps_the_speeds_of_its_motors():
    """With motors that lag, the rotors' speeds go on from one call of the program to the next, to 1e-8."""
    lagging = make_uav(motor=Motor(time_constant=0.05))
    motors: Any = lagging.propulsion
    mass = float(np.sum(lagging.system.bodies.mass))
    gravity, k_f = stm.PART_II.value("gravity"), stm.PART_II.value("rotor.k_f")
    equal = hover_speed_squared(mass, gravity, k_f, 6)
    start = lagging.point(START)._replace(internal=motors.speeds_of(equal))
    tuning = tune_inputs(
        lagging.space, [departures(lagging.space, start)], start=start, duration=0.1,
        inputs=lagging.inputs, values=jnp.concatenate([equal, jnp.zeros(2)]),
        sizes=[float(equal[0])] * 6 + [5.0, 5.0], segments=2,
    )  # fmt: skip
    values = jax.tree.map(lambda x: 1.05 * x, tuning.start)
    motion = tuning.motion(values, 12)
    problem, ts = tuning.residuals, jnp.linspace(0.0, 0.1, 12)
    system = problem.system(values["values"])
    whole = jax.jit(lambda at: integrate_points(lagging.space, system, at, ts, problem.method))(
        problem.start
    )
    off = np.asarray(jax.vmap(lagging.space.difference)(motion.points, whole))
    scale = np.where(np.arange(off.shape[1]) < 16, 1.0, 1e3)
    assert np.max(np.abs(off) / scale) < 1e-8
    assert np.ptp(np.asarray(whole.internal)[:, 0]) > 10.0


@pytest.mark.slow
def test_slew(uav):
    """The panel turns within limits, and the UAV is disturbed a hundred times less."""
    after, space = np.asarray(START) + np.array([0.4, 0.3]), uav.space
    stops, (highest, reaction) = tracker_limits(stm.PART_II), (6.2, 30.0)
    ends = [trim_flight(uav, hover(angles)) for angles in (START, after)]
    start, target = ends[0].point, uav.point(after)
    sliders = [joint_output(uav.system, f"{joint}.displacement") for joint in ("T12", "T13")]

    def displacements(path):
        of = lambda now: [one.of(uav.system, space.to_state(now)) for one in sliders]
        return jax.vmap(lambda now: jnp.stack(of(now)))(path)

    def excess(motion):
        moved = displacements(motion.points)
        forces = jnp.abs(motion.extremes[:, -2:]) / highest - 1
        over = [(moved - stops.upper) / 0.01, (stops.lower - moved) / 0.01]
        return [forces, *over, joint_forces(motion) / reaction - 1]

    force = max(float(np.max(np.abs(end.forces))) for end in ends)
    disturbance = {"r": 0.05, "theta": 0.05, "v": 0.2, "omega": 0.2}
    tuning = tune_slew(
        space, start, target, 1.0, [roughness, Limit(excess)], inputs=uav.inputs,
        values=ends[0].values, end_values=ends[1].values,
        sizes=[*ends[0].speed_squared, force, force],
        path_sizes={f"{name}_{k}": size for name, size in disturbance.items() for k in "xyz"},
        end_sizes={"U47.angle_1": 1e-3, "U47.angle_2": 1e-3, "U47.angle_1_rate": 1e-2,
                   "U47.angle_2_rate": 1e-2},
        segments=5, outputs_per_segment=6,
    )  # fmt: skip
    found = tuning.search(steps=60)
    assert found.reason == stm.math.SearchReason.CONVERGED
    motions = [tuning.motion(values, 200) for values in (tuning.start, found.values)]
    errors = [
        np.asarray(jax.vmap(lambda now: space.difference(now, target))(motion.points))
        for motion in motions
    ]
    missed = [np.max(np.abs(x[-1, 6:8])) for x in errors]
    tilt, drift = (
        [np.max(np.linalg.norm(x[:, part] - x[0, part], axis=1)) for x in errors]
        for part in (slice(3, 6), slice(0, 3))
    )
    assert missed[1] < 1e-4 < 0.1 < missed[0]
    assert tilt[1] < 0.01 * tilt[0]
    assert drift[1] < 0.02 * drift[0]
    assert np.max(np.abs(motions[1].extremes[:, -2:])) < highest
    assert np.max(jax.jit(joint_forces)(motions[1])) < reaction
    moved = np.asarray(displacements(motions[1].points))
    assert np.all((moved > stops.lower) & (moved < stops.upper))


def test_slew_refused(uav):
    start, target = (uav.point(np.asarray(START) + turn) for turn in (0.0, 0.3))
    slew = lambda *arguments, **options: tune_slew(
        uav.space, start, target, *arguments, inputs=uav.inputs, values=np.ones(8), **options
    )
    with pytest.raises(stm.SettingError, match="must be positive, not -1 s"):
        slew(-1.0)
    with pytest.raises(stm.SettingError, match="four knots or more"):
        slew(1.0, knots=3)
    with pytest.raises(stm.SettingError, match="two or more increasing times"):
        make_shooting(uav.space, lambda v: v, lambda *a: a, lambda t: start, np.array([0.0, 0.0]))


@pytest.fixture(scope="module")
def case():
    return simulate_record(seed=1)


@pytest.mark.slow
def test_identification(case):
    """Ten parameters from one record, with deviations that say how far off they are."""
    found = identify(
        case.predict, case.record, case.sigma, case.start, case.sizes, labels=case.labels,
        min_singular_value=0.5,
    )  # fmt: skip
    assert np.all(np.abs(found.values - case.truth) < 4 * found.standard_deviations)
    assert np.max(found.standard_deviations / case.sizes) < 0.15
    assert 0.8 < found.reduced_chi_square < 1.2
    # what is left is the record's noise
    assert 30 * found.search.loss < found.search.history[0]


def test_what_cannot_be_told_is_named():
    J = np.array([[1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 5.0]])
    with pytest.raises(IdentifiabilityError, match=r"[+-]0\.71 (a|b), [+-]0\.71 (a|b) \(singular"):
        check_identifiable(J, ["a", "b", "c"])
    assert check_identifiable(J[:, 1:], ["b", "c"])[0] == pytest.approx(5.0)
    line = lambda q: (q[0] + q[1]) * jnp.linspace(0, 1, 5)[:, None]
    with pytest.raises(IdentifiabilityError, match="leave one of the parameters out"):
        identify(line, np.ones((5, 1)), [0.1], [0.0, 0.0], [1.0, 1.0])


def test_a_straight_line():
    """Values, deviations and misfit as those of linear regression."""
    ts = np.linspace(0, 1, 30)
    rng = np.random.default_rng(4)
    record = (1.5 - 2.0 * ts + 0.1 * rng.normal(size=30))[:, None]
    line = lambda q: (q[0] + q[1] * jnp.asarray(ts))[:, None]
    found = identify(line, record, [0.1], {"offset": 0.0, "slope": 0.0}, [1.0, 1.0])
    X = np.stack([np.ones(30), ts], axis=1)
    exact = np.linalg.lstsq(X, record[:, 0], rcond=None)[0]
    np.testing.assert_allclose(found.values, exact, atol=1e-8)
    np.testing.assert_allclose(found.covariance, 0.01 * np.linalg.inv(X.T @ X), rtol=1e-8)
    assert found.labels == ("offset", "slope")
    left = record[:, 0] - X @ exact
    assert found.reduced_chi_square == pytest.approx(left @ left / 0.01 / 28)


def test_records_refused():
    line = lambda q: q[0] * jnp.ones((5, 1))
    with pytest.raises(stm.ModelError, match=r"record has shape \(4, 1\), but predictions"):
        identify(line, np.ones((4, 1)), [0.1], [0.0], [1.0])
    with pytest.raises(stm.ModelError, match="record"):
        identify(line, np.full((5, 1), np.nan), [0.1], [0.0], [1.0])
    with pytest.raises(stm.SettingError, match="1 positive deviations"):
        identify(line, np.ones((5, 1)), [0.0], [0.0], [1.0])
    with pytest.raises(stm.SettingError, match="1 positive sizes"):
        identify(line, np.ones((5, 1)), [0.1], [0.0], [-1.0])
    # not as parameters that the record leaves open
    heavy = lambda q: jnp.sqrt(q[0]) * jnp.ones((5, 1)) + q[1] * jnp.linspace(0, 1, 5)[:, None]
    with pytest.raises(stm.SettingError, match=r"predictions at the start .* mass = -1, slope = 0"):
        identify(heavy, np.ones((5, 1)), [0.1], {"mass": -1.0, "slope": 0.0}, [1.0, 1.0])
    with pytest.raises(stm.SettingError, match="derivatives of the predictions at the start"):
        identify(heavy, np.ones((5, 1)), [0.1], {"mass": 0.0, "slope": 0.0}, [1.0, 1.0])
    with pytest.raises(stm.ModelError, match="has no entry"):
        from_table(
            lambda table: make_uav(table).space,
            stm.PART_II,
            [Unknown("mass.panel_7", 0.1, ((0,),))],
        )
