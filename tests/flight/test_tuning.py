"""Inputs and parameters found by gradients through the flight."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import stmuav_jax as stm
from stmuav_jax.algebra.least_squares import search
from stmuav_jax.flight.flight_trim import hover, trim_flight
from stmuav_jax.flight.flyer import RotorsAndForces, rotors_and_forces
from stmuav_jax.flight.identification import (
    IdentifiabilityError,
    Unknown,
    check_identifiable,
    from_table,
    identify,
)
from stmuav_jax.flight.multiple_shooting import growth, shooting, transition
from stmuav_jax.flight.segments import fly
from stmuav_jax.flight.synthetic import experiment
from stmuav_jax.flight.uav_tuning import SlewLimits, at_rest, hold, holding_time, peaks, slew
from stmuav_jax.rotorcraft.rotor import hover_speed_squared
from stmuav_jax.scenes.flight_options import Motor
from stmuav_jax.scenes.uav_tracker import uav_flyer
from stmuav_jax.tracker.tracker_options import Friction
from stmuav_jax.tracker.workspace import tracker_limits

# searches fly many times: they compute for longer than they compile
pytestmark = pytest.mark.usefixtures("optimised")

START = stm.tracker.initial_angles(stm.PART_II)
LM = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-8)


@pytest.fixture(scope="module")
def flyer():
    return uav_flyer()


@pytest.fixture(scope="module")
def untuned(flyer):
    """The report's case 1: equal speeds that carry the weight, actuators idle."""
    mass = float(np.sum(flyer.system.bodies.mass))
    equal = hover_speed_squared(
        mass, stm.PART_II.value("gravity"), stm.PART_II.value("rotor.k_f"), 6
    )
    return RotorsAndForces(equal, jnp.zeros(2))


@pytest.fixture(scope="module")
def held(flyer):
    return trim_flight(flyer, hover(START)).inputs


def test_displacement_and_back(flyer):
    rng = np.random.default_rng(3)
    x = jnp.asarray(0.1 * rng.normal(size=16))
    at = flyer.retract(at_rest(START), jnp.asarray(0.1 * rng.normal(size=16)))
    np.testing.assert_allclose(flyer.difference(flyer.retract(at, x), at), x, atol=1e-14)
    back = jax.jit(lambda at: flyer.from_state(flyer.to_state(at)))(at)
    np.testing.assert_allclose(flyer.difference(back, at), 0, atol=1e-13)


@pytest.mark.slow
def test_growth_is_that_of_the_linear_system(flyer, held):
    """At a trim the transition is expm(A t); its growth rate that of the fastest mode."""
    from scipy.linalg import expm

    from stmuav_jax.flight.linear import linearize

    ts, start = np.linspace(0.0, 0.4, 5), at_rest(START)
    system = flyer.with_inputs(held)
    method = stm.Method(rtol=1e-10, atol=1e-12)
    found = np.asarray(transition(flyer, system, start, jnp.asarray(ts), method))
    linear = linearize(flyer, start, values=jnp.concatenate(held))
    for t, Phi in zip(ts, found, strict=True):
        exact = expm(linear.A * t)
        np.testing.assert_allclose(Phi, exact, atol=2e-5 * np.max(np.abs(exact)))
    seen = growth(flyer, system, start, ts, method)
    assert seen.rate == pytest.approx(linear.modes()[0].eigenvalue.real, rel=0.25)
    assert seen.useful_until == 0.4
    loose = growth(flyer, system, start, ts, stm.Method(rtol=1e-3, atol=1e-3))
    assert loose.useful_until < 0.4
    with pytest.raises(stm.SettingError, match="three times or more"):
        growth(flyer, system, start, ts[:2])


@pytest.mark.slow
def test_hold(flyer, untuned, held):
    """From the untuned case to the trim, by the gradients of the flight alone."""
    start = at_rest(START)
    before = holding_time(flyer, untuned, start)
    tuning = hold(flyer, START, untuned, horizon=0.4)
    found = search(tuning.residuals, tuning.start, LM, steps=60)
    inputs = rotors_and_forces(tuning.inputs(found.values))
    np.testing.assert_allclose(
        np.sqrt(inputs.speed_squared), np.sqrt(held.speed_squared), rtol=1e-7
    )
    np.testing.assert_allclose(inputs.forces, held.forces, rtol=1e-6)
    after = holding_time(flyer, inputs, start)
    assert before < 0.3
    assert after > 5 * before


@pytest.mark.slow
def test_a_motion_in_parts_keeps_the_speeds_of_its_motors(untuned):
    """With motors that lag, the rotors' speeds go on from one call of the program to the next, to 1e-8."""
    lagging = uav_flyer(motor=Motor(time_constant=0.05))
    tuning = hold(lagging, START, untuned, horizon=0.1, segments=2)
    values = jax.tree.map(lambda x: 1.05 * x, tuning.start)
    motion = tuning.motion(values, 12)
    problem, ts = tuning.residuals, jnp.linspace(0.0, 0.1, 12)
    system = problem.system(values["values"])
    whole = jax.jit(lambda at: fly(lagging, system, at, ts, problem.method))(problem.start)
    off = np.asarray(jax.vmap(lagging.difference)(motion.points, whole))
    scale = np.where(np.arange(off.shape[1]) < 16, 1.0, 1e3)
    assert np.max(np.abs(off) / scale) < 1e-8
    assert np.ptp(np.asarray(whole.internal)[:, 0]) > 10.0


@pytest.mark.slow
def test_segments_where_one_flight_is_too_long(flyer, untuned, held):
    """Over 1.2 s differences grow by e^13: in one piece the search is stuck, in 24 it arrives."""
    ends = {}
    for segments in (1, 24):
        tuning = hold(flyer, START, untuned, horizon=1.2, segments=segments)
        found = search(tuning.residuals, tuning.start, LM, steps=60)
        ends[segments] = rotors_and_forces(tuning.inputs(found.values))
    off = {k: float(np.max(np.abs(end.forces - held.forces))) for k, end in ends.items()}
    assert off[1] > 1.0
    assert off[24] < 1e-8


@pytest.mark.slow
def test_slew(flyer):
    """The panel turns within limits, and the UAV is disturbed a hundred times less."""
    after = np.asarray(START) + np.array([0.4, 0.3])
    stops = tracker_limits(stm.PART_II)
    limits = SlewLimits(6.2, stops.home, stops.lower, stops.upper, 30.0)
    tuning = slew(flyer, START, after, 1.0, limits, segments=5, outputs_per_segment=6)
    found = tuning.search(steps=60)
    assert found.reason == stm.algebra.SearchReason.CONVERGED
    before, now = peaks(tuning, tuning.start), peaks(tuning, found.values)
    assert float(now.error) < 1e-4 < 0.1 < float(before.error)
    assert float(now.tilt) < 0.01 * float(before.tilt)
    assert float(now.drift) < 0.02 * float(before.drift)
    assert float(now.force) < 6.2
    assert now.reaction is not None
    assert float(now.reaction) < 30.0
    assert np.all((now.lower > stops.lower) & (now.upper < stops.upper))


def test_slew_refused(flyer):
    after = np.asarray(START) + np.array([0.4, 0.3])
    with pytest.raises(
        stm.ModelError, match=r"before the turn needs an actuator force of 5\.958 N"
    ):
        slew(flyer, START, after, 1.0, SlewLimits(force=5.0))
    with pytest.raises(
        stm.ModelError, match=r"displacement of slider_2 before the turn is 22\.06 mm"
    ):
        slew(flyer, START, after, 1.0, SlewLimits(upper=(0.001, 0.1)))
    with pytest.raises(stm.StateError, match="cannot take the panel angles"):
        slew(flyer, START, [0.2, -1.5], 1.0)
    with pytest.raises(stm.SettingError, match="must be positive, not -1 s"):
        slew(flyer, START, after, -1.0)
    with pytest.raises(stm.SettingError, match="four knots or more"):
        slew(flyer, START, after, 1.0, knots=3)
    with pytest.raises(stm.SettingError, match="two or more increasing times"):
        shooting(flyer, lambda v: v, lambda *a: a, lambda t: at_rest(START), np.array([0.0, 0.0]))


@pytest.fixture(scope="module")
def case():
    return experiment(lambda table: uav_flyer(table, friction=Friction()), stm.PART_II, seed=1)


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


@pytest.mark.slow
def test_ten_records(case):
    """Of ten noise seeds and starts, 9 or more leave all ten parameters within 3 sigma."""
    records, starts = [], []
    for seed in range(10):
        rng = np.random.default_rng(seed)
        records.append(case.clean + case.sigma * rng.normal(size=case.clean.shape))
        starts.append(case.truth + 0.5 * case.sizes * rng.uniform(-1.0, 1.0, len(case.truth)))
    found = list(
        stm.flight.identify_many(
            case.predict, jnp.asarray(records), case.sigma, jnp.asarray(starts), case.sizes,
            labels=case.labels, min_singular_value=0.5,
        )
    )  # fmt: skip
    assert sum(one.within(case.truth) for one in found) >= 9
    # deviations are honest both ways: normal errors are within one of them in 68 % of 100
    inside = np.mean([np.abs(one.values - case.truth) < one.standard_deviations for one in found])
    assert 0.53 < inside < 0.83
    assert 0.93 < np.mean([one.reduced_chi_square for one in found]) < 1.07


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
        from_table(uav_flyer, stm.PART_II, [Unknown("mass.panel_7", 0.1, ((0,),))])
