"""A multirotor's numbers follow from its flight, with deviations that hold, and refusals in words."""

import json
import re
import tomllib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from problems.multirotor_flights import (
    ARM,
    LAYOUT,
    POSITIONS,
    SPIN,
    TRUTH,
    VALUES,
    simulate_flights,
)
from scipy.constants import g
from scipy.integrate import solve_ivp
from scipy.signal import butter, group_delay, lfilter
from scipy.spatial.transform import Rotation

from stmuav_jax import missions
from stmuav_jax.analysis.fit_statistics import compare_estimates
from stmuav_jax.checks.errors import SettingError
from stmuav_jax.cli.main import main
from stmuav_jax.figures import FLIGHT_LOG_FIGURES, IdentifiedFlight
from stmuav_jax.io import (
    load_model,
    read_flight_log,
    read_rotor_layout,
    save_flight_record,
    write_identified_model,
)
from stmuav_jax.uav import (
    filter_centre,
    filter_hover_centre,
    identify_flight,
    identify_hover_centre,
    make_layout,
)
from stmuav_jax.uav.flight_identification.prediction_error import (
    Regression,
    fit_prediction_error,
)
from stmuav_jax.uav.flight_identification.record import (
    FlightRecord,
    apply_filter,
    compute_rotor_states,
    filter_delay,
    low_pass,
    observe_motion,
    refilter_rates,
)
from stmuav_jax.uav.flight_identification.stages import _allow_for_sag, _check_size

FLIGHTS = Path(__file__).parents[2].parent / "shared" / "flights"
real = pytest.mark.skipif(
    not FLIGHTS.is_dir(), reason="the real flights are not beside the checkout"
)


@pytest.fixture(scope="module")
def record():
    """Flight of 24 s in closed loop, with gusts, noise, biases and filters."""
    return simulate_flights([0], 24.0)[0]


# What a model needs beside the flight.
AIRFRAME = make_layout(
    POSITIONS, SPIN, LAYOUT.mass, inertia=[1e-5, 1e-5, 3e-5], highest_speed=2600.0
)


@pytest.fixture(scope="module")
def result(record):
    """The multirotor of that flight."""
    return identify_flight(record, AIRFRAME)


@pytest.fixture(scope="module")
def calm():
    """Hover of 12 s without manoeuvres."""
    return simulate_flights([2], 12.0, TRUTH._replace(manoeuvres=(0.0, 0.0, 0.0, 0.0)))[0]


@pytest.mark.slow
def test_a_flight_in_closed_loop_gives_the_true_numbers(result):
    assert result.verdict.status == "consistent"
    assert set(VALUES) <= set(result.estimates)
    for name, value in VALUES.items():
        e = result.estimates[name]
        assert abs(e.value - value) < 4 * e.deviation, name
        assert e.deviation == pytest.approx(np.linalg.norm([e.blocks, e.windows, e.variants]))
    for axis, value in zip(("roll", "pitch"), TRUTH.B, strict=False):
        assert result.estimates[axis].deviation < 0.04 * value
    # the rotors' angular momentum turns with the body, and drag below the centre of mass follows the rates
    for fit, places, values in (
        (result.rotation, [5, 11], TRUTH.gyroscopic),
        (result.translation, [10, 11], TRUTH.rate_force),
    ):
        spread = np.sqrt(np.diag(fit.compute_covariance(1.0)))[places]
        assert np.all(np.abs(fit.values[places] - values) < 3.5 * spread)
        assert np.all(spread < np.abs(values))
    table = result.describe()
    assert all(e.name in table for e in result.estimates.values())


@pytest.mark.slow
def test_a_record_that_starts_in_a_manoeuvre_gives_the_true_numbers(record):
    """At 10.4 s it is tilted by 48 degrees and moves at 2.5 m/s; as if level, drag would be 15 deviations off."""
    result = identify_flight(record.between(10.4, 24.0), LAYOUT)
    assert result.verdict.status == "consistent"
    for name, value in VALUES.items():
        e = result.estimates[name]
        assert abs(e.value - value) < 4 * e.deviation, name
    for x in "xy":
        assert result.estimates[f"drag_{x}"].deviation < 0.1 * VALUES[f"drag_{x}"]


@pytest.mark.slow
def test_effectiveness_is_unbiased_and_intervals_cover_over_many_flights():
    """Statistical: the mean of 8 flights within 2 %, and 95 % intervals that cover 91 % or more of 230."""
    results = [identify_flight(r, LAYOUT) for r in simulate_flights(range(20, 28), 24.0)]
    for name in ("roll", "pitch"):
        mean = np.mean([r.estimates[name].value for r in results])
        assert mean == pytest.approx(VALUES[name], rel=0.02)
    inside = [
        abs(r.estimates[name].value - value) < 1.96 * r.estimates[name].deviation
        for r in results
        for name, value in VALUES.items()
        if name in r.estimates
    ]
    assert len(inside) > 220
    assert np.mean(inside) > 0.91


@pytest.mark.slow
@pytest.mark.parametrize(
    ("test", "change", "words"),
    [("lag", {"second_lag": 0.01}, "second lag"), ("sag", {"sag": 0.3}, "battery sags")],
)
def test_a_second_lag_and_a_battery_that_sags_are_said(test, change, words):
    """Of a flight that the benchmark does not have."""
    (record,) = simulate_flights([40], 40.0, TRUTH._replace(**change))
    verdict = identify_flight(record, LAYOUT).verdict
    assert verdict.p_values[test] < 0.01
    assert words in verdict.explanation


@pytest.mark.slow
def test_a_logged_voltage_explains_thrust_that_falls_with_it():
    """A battery that empties by 12 % and dips by 15 % of the relative collective; numbers are those at its mean."""
    truth = TRUTH._replace(discharge=0.12, dip=0.15)
    record = simulate_flights([60], 24.0, truth)[0]
    result = identify_flight(record, LAYOUT)
    e = result.estimates["voltage_exponent"]
    assert abs(e.value - 1.0) < 3 * e.deviation < 0.3
    assert result.verdict.status == "consistent"
    assert record.voltage is not None
    scale = (np.mean(record.voltage) / 4.0) ** 2
    for name in ("roll", "pitch", "thrust", "thrust_slope"):
        e = result.estimates[name]
        assert abs(e.value - scale * VALUES[name]) < 3 * e.deviation, name
        assert e.deviation < 0.03 * e.value
    blind = identify_flight(record._replace(voltage=None), LAYOUT)
    assert blind.verdict.status == "inconsistent"
    assert "Thrust falls" in blind.verdict.explanation
    assert blind.estimates["roll"].deviation > 3 * result.estimates["roll"].deviation
    wrong = np.where(record.ts > 20, 0.0, record.voltage)
    with pytest.raises(SettingError, match=r"voltage falls to 0 V where"):
        identify_flight(record._replace(voltage=wrong), LAYOUT)


@pytest.mark.slow
def test_rotors_with_an_idle_speed_have_the_true_centre_of_mass():
    """Speed 0.25 + 0.75 u: by a thrust through zero that has the slope at hover, the centre is 1.3 mm off."""
    truth = TRUTH._replace(centre=(0.003, -0.002))
    record = simulate_flights([70], 16.0, truth)[0]
    record = record._replace(commands=(record.commands - 0.25) / 0.75)
    result = identify_flight(record, LAYOUT)
    for x, value in zip("xy", truth.centre, strict=True):
        for e in (result.estimates[f"centre_{x}"], result.estimates[f"free_centre_{x}"]):
            assert abs(e.value - value) < 3 * e.deviation
        assert result.estimates[f"centre_{x}"].deviation < 0.25e-3


@pytest.mark.slow
def test_voltage_and_commands_that_change_together_are_not_told_apart():
    """A hover, in which the commands rise as the battery empties."""
    truth = TRUTH._replace(discharge=0.12, dip=0.15, manoeuvres=(0.0, 0.0, 0.0, 0.0))
    result = identify_flight(simulate_flights([50], 30.0, truth)[0], LAYOUT)
    assert "voltage_exponent" not in result.estimates
    assert re.search(
        r"deviation of [\d.]+; .* together \(correlation -0\.9", result.refusals["voltage"]
    )


@pytest.mark.slow
def test_commands_with_stamps_that_are_late_are_said(record):
    """By 8 ms, twice the delay."""
    shifted = record._replace(commands=np.roll(record.commands, 4, axis=0))
    result = identify_flight(shifted.between(1.0, 24.0), LAYOUT)
    assert "ends at the bound of 0 ms" in result.refusals["delay"]
    assert "delay" not in result.estimates
    assert result.verdict.status == "inconsistent"
    assert "their time stamps differ" in result.verdict.explanation


@pytest.mark.slow
def test_measured_rotor_speeds_take_the_place_of_commands(record, tmp_path):
    """Speeds that follow the commands with the true lag: effectiveness by shares of the highest one, and no lag."""
    s = compute_rotor_states(record.commands, record.dt, TRUTH.tau, TRUTH.delay)
    names = [
        "t [s]",
        *(f"accelerometer.{x} [m/s^2]" for x in "xyz"),
        *(f"gyroscope.{x} [rad/s]" for x in "xyz"),
    ]
    names += [f"rotor_speeds.{k} [rad/s]" for k in (1, 2, 3, 4)]
    table = np.column_stack([record.ts, record.accelerometer, record.gyroscope, 2600.0 * s])
    np.savetxt(tmp_path / "log.csv", table, delimiter=",", header=",".join(names), comments="")
    flight = read_flight_log(tmp_path / "log.csv").to_record()._replace(cutoffs=record.cutoffs)
    result = identify_flight(flight, LAYOUT)
    for name in ("roll", "pitch", "thrust"):
        e = result.estimates[name]
        assert abs(e.value - VALUES[name] * np.max(s) ** 2) < 3 * e.deviation, name
    assert "rotor speeds that were measured have none" in result.refusals["lag"]
    assert "lag" not in result.estimates


@pytest.mark.slow
def test_thrust_that_fades_is_said_and_widens_the_deviation():
    record = simulate_flights([3], 24.0, TRUTH._replace(fade=0.15))[0]
    result = identify_flight(record, make_layout(LAYOUT.positions, LAYOUT.spin))
    assert result.verdict.status == "inconsistent"
    assert {"windows", "trend"} & {k for k, p in result.verdict.p_values.items() if p < 0.01 / 6}
    roll = result.estimates["roll"]
    assert roll.windows > roll.blocks
    assert "force" not in result.estimates
    assert "give the mass" in result.describe()


@pytest.mark.slow
@pytest.mark.parametrize("is_curved", [False, True])
def test_the_identified_model_has_the_true_numbers(result, tmp_path, is_curved):
    """A curve that differs from the layout's shape by more than its deviation is the model's."""
    if is_curved:
        curve = {f"thrust_{x}": result.estimates[f"thrust_{x}"] for x in ("linear", "quadratic")}
        curve["thrust_quadratic"] = curve["thrust_quadratic"]._replace(deviation=1e-3)
        result = result._replace(estimates=result.estimates | curve)
    files = write_identified_model(result, tmp_path / "own.toml", source="a flight")
    scene = load_model(files.model)
    body = scene.system.bodies
    forces: Any = scene.system.forces
    _, motors, air = forces
    e = result.estimates
    np.testing.assert_allclose(
        np.diag(body.inertia[0]), [e["inertia_x"].value, e["inertia_y"].value, 3e-5]
    )
    np.testing.assert_allclose(body.com[0], [e["centre_x"].value, e["centre_y"].value, 0.0])
    np.testing.assert_allclose(air.linear, [0.027 * e[f"drag_{x}"].value for x in "xyz"])
    # the thrust's slope by the command at the mean one, and the torque of spinning up
    span = float(motors.limits.highest[0] - motors.limits.lowest[0])
    speed = float(motors.limits.lowest[0]) + span * result.hover
    thrust = lambda speed: motors.rotors.thrusts(speed**2)
    slope = float(jax.grad(thrust)(speed)) * span
    assert (motors.rotors.thrust_linear is not None) == is_curved
    if is_curved:
        parts = [e[f"thrust_{x}"].value for x in ("offset", "linear", "quadratic")]
        level = 0.027 * np.polynomial.polynomial.polyval(result.hover, parts)
        assert float(thrust(speed)) == pytest.approx(level, rel=1e-9)
        ratios = [float(motors.rotors.torques(w**2) / thrust(w)) for w in (900.0, 2000.0)]
        assert ratios[0] == pytest.approx(ratios[1], rel=1e-9)
        # every factor of the study has an effect on the mission, whose loop is stable
        written = missions.load_mission_study(tomllib.loads(files.study.read_text()), tmp_path)
        assert written.evaluate.mission.growth <= 1.0
    assert slope == pytest.approx(2 * result.hover * e["force"].value, rel=1e-9)
    assert float(motors.inertia[0]) * span / 3e-5 == pytest.approx(e["spin_up"].value)
    # drag below the centre of mass makes both moments of horizontal speed
    assert float(air.point[2]) == pytest.approx(-6.0 * 1.8e-5 / 0.027 / 0.5, rel=0.4)
    study = tomllib.loads(files.study.read_text())
    assert study["factors"]["inertia_x"]["standard_deviation"] == pytest.approx(
        e["inertia_x"].deviation
    )
    assert "no flight determines it" in " ".join(files.notes)


def test_a_model_without_its_numbers_is_refused_by_their_names(result, tmp_path):
    bare = result._replace(layout=make_layout(POSITIONS, SPIN))
    with pytest.raises(SettingError, match=r"needs 'mass', 'highest_speed'.*'inertia' \(Jz\)"):
        write_identified_model(bare, tmp_path / "own.toml")
    estimates = {k: e for k, e in result.estimates.items() if not k.startswith("yaw")}
    with pytest.raises(SettingError, match="'torque_ratio'"):
        write_identified_model(result._replace(estimates=estimates), tmp_path / "own.toml")
    with pytest.raises(SettingError, match=r"ends in \.toml"):
        write_identified_model(result, tmp_path / "own.nc")


@pytest.mark.slow
def test_figures_show_what_the_flight_determines(record, result, tmp_path):
    log = read_flight_log(save_flight_record(record, tmp_path / "flight.csv"))
    subject = IdentifiedFlight(log, record, result)
    figures: dict[str, Any] = {name: draw(subject) for name, draw in FLIGHT_LOG_FIGURES.items()}
    # the fit passes through the measured gains where they are coherent
    measured, fit = figures["response"].axes[0].lines
    gains = np.interp(measured.get_xdata(), fit.get_xdata(), fit.get_ydata())
    middle = (measured.get_xdata() > 2) & (measured.get_xdata() < 8)
    np.testing.assert_allclose(measured.get_ydata()[middle], gains[middle], rtol=0.25)
    assert np.sum(middle) > 6
    for ax in figures["accelerations"].axes:
        measured, predicted = (line.get_ydata() for line in ax.lines)
        assert np.std(measured - predicted) < 0.7 * np.std(measured)
    ellipses = [patch for patch in figures["centre"].axes[1].patches]
    e = result.estimates["free_centre_x"]
    assert ellipses[1].height == pytest.approx(2e3 * 2.4477 * e.deviation, rel=1e-3)


def test_a_filter_of_the_centre_ends_where_the_whole_record_does(record, result):
    """The same answer with like deviations; the innovations have the size that the filter expects."""
    filtered = filter_centre(record, result)
    assert filtered.centre.shape == (len(filtered.ts), 2)
    for axis, x in enumerate("xy"):
        e = result.estimates[f"centre_{x}"]
        assert abs(filtered.centre[-1, axis] - e.value) < 1.5 * e.deviation
        assert filtered.deviation[-1, axis] == pytest.approx(e.deviation, rel=0.4)
        assert filtered.deviation[0, axis] > 5 * filtered.deviation[-1, axis]
    assert filtered.verdict.settled_nis == pytest.approx(1.0, abs=0.1)
    with pytest.raises(SettingError, match="drift must be zero or positive"):
        filter_centre(record, result, drift=-1.0)
    with pytest.raises(SettingError, match=r"identifies roll and pitch: Roll is not excited"):
        filter_centre(
            record, result._replace(estimates={}, refusals={"roll": "Roll is not excited."})
        )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("order", "spin", "words"),
    [
        ([1, 0, 3, 2], [-1, 1, -1, 1], "motors 1 to 4 respond as rotors 2 1 4 3 of the layout"),
        ([0, 1, 2, 3], [-1, 1, -1, 1], "of the spin [1, -1, 1, -1], but the layout has [-1, 1, -1, 1]"),
    ],
    ids=["order", "spin"],
)  # fmt: skip
def test_motors_in_another_order_or_with_another_spin_are_named(record, order, spin, words):
    with pytest.raises(SettingError, match=re.escape(words)):
        identify_flight(record, make_layout(LAYOUT.positions[order], spin))


@pytest.mark.slow
def test_a_hover_that_excites_nothing_is_refused_by_axis(calm):
    """Nor does a voltage that hardly changes tell anything."""
    voltage = np.linspace(4.0, 3.98, len(calm.ts))
    result = identify_flight(calm._replace(voltage=voltage), LAYOUT)
    assert result.rotation is None
    assert "it changes by 0.02 V; 1 % of it or more" in result.refusals["voltage"]
    assert "voltage_exponent" not in result.estimates
    for axis in ("roll", "pitch", "thrust"):
        assert "is not excited" in result.refusals[axis]
    # its gusts tell the IMU's position and the drag, but neither an axis, nor lag, thrust or mass
    assert "yaw" in result.refusals
    assert all(name.startswith(("imu_", "drag_")) for name in result.estimates)


@pytest.mark.slow
def test_a_vehicle_that_is_held_while_its_motors_run_is_refused(record):
    rng = np.random.default_rng(0)
    force, rates = (size * rng.normal(size=(len(record.ts), 3)) for size in (0.3, 0.01))
    held = record._replace(gyroscope=rates, accelerometer=force + np.array([0, 0, g]))
    with pytest.raises(
        SettingError, match=r"not follow its motors: .*where 5\.\d m/s\^2 would carry"
    ):
        identify_flight(held, LAYOUT)


@pytest.mark.slow
def test_positions_in_millimetres_are_refused(record):
    large = make_layout(1000 * POSITIONS, SPIN)
    with pytest.raises(
        SettingError, match=r"would be 0\.0[23]\d* of the mean arm of 28.3 m; .* positions in m"
    ):
        identify_flight(record, large)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("manoeuvres", "known", "signs"),
    [
        ((1.0, 0.0, 0.0, 0.0), {"roll", "lag", "centre_y", "thrust"}, {"pitch": "++++ ++--"}),
        ((0.0, 0.0, 0.0, 1.5), {"thrust", "thrust_slope"}, {"roll": "++++", "pitch": "++++"}),
    ],
    ids=["roll", "climbs"],
)
def test_what_a_flight_tells_of_other_axes_is_named(manoeuvres, known, signs):
    """The balance of any flight tells the sum of the responses; commands about roll, their effect about pitch too."""
    record = simulate_flights([2], 16.0, TRUTH._replace(manoeuvres=manoeuvres))[0]
    result = identify_flight(record, LAYOUT)
    assert known <= set(result.estimates)
    for axis, pattern in signs.items():
        assert axis not in result.estimates
        words = result.refusals[axis].partition("Of the motors' responses only")[2]
        sums = [re.findall(r"(-?)\+? ?(?:[\d.]+ )?motor (\d)", part) for part in words.split(";")]
        same = [["-+"[sign == terms[0][0]] for sign, _ in terms] for terms in sums]
        assert " ".join(map("".join, same)) == pattern
        assert all([number for _, number in terms] == list("1234") for terms in sums)
    if "curve" in result.refusals and "thrust" in result.estimates:
        # the slope by the square of the command at hover
        linear, value = map(
            float,
            re.findall(r"Only ([\d.]+) the linear .* = ([\d.]+)", result.refusals["curve"])[0],
        )
        assert linear == pytest.approx(1 / (2 * result.hover), rel=0.1)
        assert value == pytest.approx(TRUTH.thrust, rel=0.05)


@pytest.mark.slow
def test_records_that_cannot_be_identified_are_refused(record):
    held = record.commands[np.arange(len(record.ts)) // 50 * 50]
    with pytest.raises(SettingError, match=r"commands change 9\.96 times a second"):
        identify_flight(record._replace(commands=held), LAYOUT)
    with pytest.raises(SettingError, match=r"3 s long; 10 s or more"):
        identify_flight(record.between(5.0, 8.0), LAYOUT)
    with pytest.raises(SettingError, match="commands of 3 rotors, but the layout has 4"):
        identify_flight(record._replace(commands=record.commands[:, :3]), LAYOUT)
    with pytest.raises(SettingError, match="gyroscope of the record must be finite"):
        identify_flight(record._replace(gyroscope=record.gyroscope * np.nan), LAYOUT)
    with pytest.raises(SettingError, match=r"command of motor 4 is 0\.5 throughout the flight"):
        identify_flight(
            record._replace(commands=record.commands * [1, 1, 1, 0] + [0, 0, 0, 0.5]), LAYOUT
        )
    with pytest.raises(SettingError, match="gyroscope's axis y is 0 throughout"):
        identify_flight(record._replace(gyroscope=np.abs(record.gyroscope) * [1, 0, 1]), LAYOUT)
    # as constant as the means over a grid's steps are
    still = record._replace(commands=0.5 + 1e-13 * record.commands)
    with pytest.raises(SettingError, match=r"command of motor 1 is 0\.5 throughout the flight"):
        identify_flight(still, LAYOUT)
    for name, factor in (("gyroscope", 3.0), ("gyroscope", 57.3), ("accelerometer", 0.93)):
        scaled = {name: factor * getattr(record, name)}
        with pytest.raises(SettingError, match=r"along the vertical|unit"):
            identify_flight(record._replace(**scaled), LAYOUT)
    with pytest.raises(SettingError, match="one line"):
        make_layout([[0, 1], [0, 2], [0, 3]], [1, 1, -1])
    with pytest.raises(SettingError, match="spin must be"):
        make_layout(LAYOUT.positions, [1, -1, 1])


def test_prediction_errors_remove_the_bias_of_feedback():
    """A gain of 2 behind a feedback that follows a coloured disturbance; least squares is 20 deviations off."""
    rng = np.random.default_rng(0)
    n, gain = 20_000, 2.0
    v = lfilter([1.0], [1.0, -0.95], rng.normal(size=n))
    u, y = np.zeros(n), np.zeros(n)
    drive = rng.normal(size=n)
    for k in range(1, n):
        u[k] = drive[k] - 0.3 * y[k - 1]
        y[k] = gain * u[k] + v[k]
    regression = Regression(y[:, None], u[:, None, None], 1.0)
    fit = fit_prediction_error(lambda lags: regression, np.zeros(0), (), 5.0)
    deviation = np.sqrt(fit.compute_covariance(50.0)[0, 0])
    assert abs(fit.values[0] - gain) < 4 * deviation
    assert deviation == pytest.approx(np.sqrt(fit.white_covariance[0, 0]), rel=0.3)
    assert abs((u @ y) / (u @ u) - gain) > 20 * deviation
    late = np.append(0.0, u[:-1])
    _, _, p_value = fit.test_columns(late[:, None, None], 50.0)
    assert p_value > 1e-4
    wrong = regression._replace(y=y[:, None] + 0.5 * late[:, None])
    fit = fit_prediction_error(lambda lags: wrong, np.zeros(0), (), 5.0)
    coefficient, _, p_value = fit.test_columns(late[:, None, None], 50.0)
    assert p_value < 1e-8
    assert coefficient[0] == pytest.approx(0.5, abs=0.05)


def test_the_lag_is_exact_for_commands_that_hold():
    """A step of the command at 0.2 s, delayed by 2.6 steps of the grid."""
    dt, tau, delay = 0.002, 0.05, 0.0052
    ts = np.arange(400) * dt
    u = np.where(ts >= 0.2, 1.0, 0.3)[:, None]
    s = compute_rotor_states(u, dt, tau, delay)[:, 0]
    after = np.maximum(ts - 0.2 - delay, 0.0)
    np.testing.assert_allclose(s, 0.3 + 0.7 * (1 - np.exp(-after / tau)), atol=1e-12)


@pytest.mark.parametrize(
    ("rise", "start", "climb", "flip", "bounds"),
    # gravity by Euler's method would be off by 0.018 m/s^2; a start that counts as level and at rest, by 2 m/s^2;
    # climbs that are forgotten within 3 s make errors of 0.08 m/s; a flip loses a vertical whose sign is assumed
    [
        (4.0, 0.0, 0.0, 0.0, (0.01, 0.004)),
        (1e-9, 0.5, 0.0, 0.0, (0.1, 0.03)),
        (4.0, 0.0, 0.4, 0.0, (0.04, 0.004)),
        (4.0, 0.0, 0.0, 1.0, (0.1, 0.05)),
    ],
    ids=["level", "moving", "climbing", "flip"],
)
def test_velocity_and_gravity_of_a_quick_motion_are_observed(rise, start, climb, flip, bounds):
    """Tilts of 20 degrees within a quarter of a second, from the first sample on or rising from a hover."""
    ts = np.arange(0, 20, 0.002)
    angles = lambda t: np.array([1.2 * np.sin(1.5 * t), 0.35 * np.sin(7 * t), 0.35 * np.cos(6 * t)])
    turns = lambda t: np.array([0.0, 0.0, np.pi * flip])[:, None] * (1 + np.tanh((t - 8) / 0.15))
    tilt = lambda t: Rotation.from_euler(
        "ZYX", (np.tanh((t + 1e-4) / rise) * angles(t) + np.squeeze(turns(t))).T
    )
    turn = tilt(ts)
    rates = (tilt(ts - 1e-5).inv() * tilt(ts + 1e-5)).as_rotvec() / 2e-5
    drag, up = np.array([0.45, 0.5, 0.4]), np.array([0.0, 0.0, 1.0])

    def push(t, v):
        """Specific force in body axes of a vehicle that holds its height, or climbs and sinks again."""
        R = tilt(t)
        lift = (g - 3 * (v[..., 2] - climb * np.sin(0.7 * t))) / np.maximum(
            R.as_matrix()[..., 2, 2], 0.5
        )
        return lift[..., None] * up - drag * R.inv().apply(v)

    slope = lambda t, v: tilt(t).apply(push(t, v)) - g * up
    v = solve_ivp(slope, (0, 20), start * np.array([1, -1, 0.5]), t_eval=ts, rtol=1e-8).y.T
    force, v = push(ts, v), turn.inv().apply(v)
    record = FlightRecord(ts, np.zeros((len(ts), 4)), rates, force)
    velocity, gravity = observe_motion(record, force, drag[:2])
    for part in (ts > 10, ts < 5):
        assert np.all(np.std((velocity - v)[part], axis=0) < bounds[0])
        assert np.all(np.std((gravity - turn.inv().apply(-g * up))[part], axis=0) < bounds[1])
    # a bias along z makes little velocity; by a mean over three seconds it would be 0.57 m/s
    biased, _ = observe_motion(record, force + 0.2 * up, drag[:2])
    assert np.max(np.abs(biased - velocity)) < 0.15


def test_commands_hold_over_the_steps_of_a_record(tmp_path):
    """At 500 Hz as they are; sampled at 1 kHz while they change at 440 Hz, by their means over the steps."""
    rng = np.random.default_rng(0)
    for rate, every in ((500, 1), (1000, 2.3)):
        ts = np.arange(14 * rate) / rate
        changes = rng.normal(size=len(ts) + 1)
        u = np.clip(0.5 + 0.05 * changes[np.floor(np.arange(len(ts)) / every).astype(int)], 0, 1)
        noise = rng.normal(size=(len(ts), 3))
        record = FlightRecord(
            ts, u[:, None] + np.zeros(4), 0.1 * noise, 9.81 * np.eye(3)[2] + noise
        )
        part = read_flight_log(save_flight_record(record, tmp_path / "log.csv")).to_record()
        # a change came by half a sample before the row that shows it
        late = 0.0 if rate == 500 else 0.5e-3
        integral = np.append(0.0, np.cumsum(u)) / rate
        edges = np.append(part.ts, part.ts[-1] + part.dt)
        means = (
            np.diff(np.interp(edges + late, np.append(ts, ts[-1] + 1 / rate), integral)) / part.dt
        )
        np.testing.assert_allclose(part.commands[:, 0], means, atol=1e-6)
        assert part.resolution == pytest.approx(late / 3**0.5)


def test_filters_of_firmware_have_the_delay_of_a_digital_clock():
    for cutoff in (30.0, 80.0):
        _, delay = group_delay(butter(2, cutoff, fs=1000.0), np.array([1e-3]))  # pyright: ignore[reportArgumentType]
        assert filter_delay(cutoff, 1e-3) == pytest.approx(delay[0] / 1000, rel=1e-4)
        assert filter_delay(cutoff, 0.0) == pytest.approx(2**0.5 / (2 * np.pi * cutoff))


def test_a_radius_of_gyration_that_is_not_usual_is_said(result):
    assert _check_size(LAYOUT, result.estimates) == ""
    half = LAYOUT._replace(positions=LAYOUT.positions / 2.5)
    sentence = _check_size(half, result.estimates)
    assert re.search(
        r"about roll is 1\.4 of the mean arm of 0\.0113 m, where 0\.3 to 1\.3 is", sentence
    )


def test_an_unlogged_sag_widens_what_takes_the_slope_of_collective_commands(result):
    """A scatter of windows of 5 %, a change of 17 % through the flight, is 0.17 of the centre's place and inertias."""
    roll = result.estimates["roll"]
    estimates = result.estimates | {"roll": roll._replace(windows=0.05 * roll.value)}
    _allow_for_sag(LAYOUT, estimates)
    for name, e in estimates.items():
        before = result.estimates[name]
        if name in ("centre_x", "centre_y", "inertia_x", "inertia_y"):
            part = 0.1732 * e.value
            assert e.variants == pytest.approx(np.hypot(before.variants, part), rel=1e-3)
            assert e.deviation == pytest.approx(np.linalg.norm([e.blocks, e.windows, e.variants]))
        else:
            assert e.deviation == before.deviation


@pytest.mark.parametrize(
    "cutoffs", [(80.0, 30.0), (80.0, np.inf), (np.inf, 30.0), (np.inf, np.inf)]
)
def test_rates_pass_through_the_filter_of_the_forces(cutoffs):
    """A ramp, late as a force would be; the zeros of a gyroscope's filter alone are a step of delay that stays."""
    ts = np.arange(500) * 0.002
    record = FlightRecord(
        ts, np.zeros((500, 4)), np.zeros((500, 3)), np.zeros((500, 3)), None, cutoffs
    )
    by_gyroscope, by_force = (
        apply_filter(*low_pass(f, 0.002, record.filter_step), ts[:, None] + 1.0) for f in cutoffs
    )
    late = by_force[-1, 0] - refilter_rates(record, by_gyroscope)[-1, 0]
    assert late == pytest.approx(0.002 if cutoffs == (80, np.inf) else 0.0, abs=1e-9)


def layout_file(folder, text=""):
    """Layout of the Crazyflie in the order of its motors, forward and left."""
    path = folder / "crazyflie.toml"
    path.write_text(
        "mass = 0.027\npositions = [[0.0283, -0.0283], [-0.0283, -0.0283], [-0.0283, 0.0283], [0.0283, 0.0283]]\n"
        f"spin = [1, -1, 1, -1]\n{text}"
    )
    return path


def test_layouts_are_read_and_checked(tmp_path):
    layout = read_rotor_layout(layout_file(tmp_path))
    np.testing.assert_allclose(layout.positions, LAYOUT.positions)
    assert layout.mass == 0.027
    with pytest.raises(SettingError, match="unknown entry 'masses'"):
        read_rotor_layout(layout_file(tmp_path, "masses = 3"))
    with pytest.raises(SettingError, match="thrust model factor must be between 0 and 1"):
        read_rotor_layout(layout_file(tmp_path, "thrust_model_factor = 2"))


@pytest.mark.slow
@real
def test_roll_and_pitch_manoeuvres_of_a_real_flight_agree_with_independent_answers(tmp_path):
    answers = json.loads((FLIGHTS / "answers.json").read_text())
    log = read_flight_log(FLIGHTS / "crazyflie" / "log15")
    result = identify_flight(log.to_record(), read_rotor_layout(layout_file(tmp_path)))
    e = result.estimates
    for axis in ("roll", "pitch"):
        answer = answers["effectiveness_B_rad_s2_per_duty2"][axis]["value"]
        assert e[axis].value == pytest.approx(answer, rel=0.1)
        assert 0.02 < e[axis].deviation / e[axis].value < 0.1
        # windows agree within the stated deviations
        values, spread = e[axis].window_values, np.hypot(e[axis].window_deviations, e[axis].windows)
        assert compare_estimates(values, np.diag(spread**2))[1] > 0.01
        over_lag = answers["B_over_tau_high_frequency"][f"{axis}_rad_s3"]
        assert e[f"{axis}_over_lag"].value == pytest.approx(over_lag, abs=400)
    assert e["inertia_ratio"].value == pytest.approx(1.055, abs=0.08)
    assert e["lag"].value == pytest.approx(0.06, abs=0.01)
    assert e["delay"].value == pytest.approx(0.004, abs=0.003)
    imu = np.array([e[f"imu_{x}"].value for x in "xyz"])
    assert np.all(
        np.abs(imu - answers["imu_from_centre_of_mass_m"]["value"]) < [1e-3, 1e-3, 0.4e-3]
    )
    for x, value in (("x", -0.9e-3), ("y", -0.2e-3)):
        assert e[f"centre_{x}"].value == pytest.approx(value, abs=1e-3)
        assert e[f"drag_{x}"].value == pytest.approx(0.48, abs=0.1)
        # motors that differ in strength, lag and more cost most of what is known
        assert 2e-3 < e[f"free_centre_{x}"].deviation < 8e-3
        # the battery's unlogged sag, of which the effectiveness tells, is a part of the deviation
        assert e[f"centre_{x}"].variants > 0.12 * abs(e[f"centre_{x}"].value)
    # nor is the thrust that accelerates the inertia that of collective commands
    assert abs(e["inertia_x"].value - 1.51e-5) < 2 * e["inertia_x"].deviation
    assert e["inertia_x"].value == pytest.approx(1.51e-5, rel=0.25)
    assert "Yaw is not excited" in result.refusals["yaw"]
    # a real battery sags, and the verdict says so
    assert result.verdict.status == "inconsistent"
    assert "windows" in result.verdict.explanation.split(":")[1]


@pytest.mark.slow
@real
def test_thrust_manoeuvres_of_a_real_flight_give_the_curve_and_no_roll(tmp_path):
    log = read_flight_log(FLIGHTS / "crazyflie" / "log10")
    result = identify_flight(log.to_record(), read_rotor_layout(layout_file(tmp_path)))
    assert "Roll is not excited" in result.refusals["roll"]
    assert result.estimates["force"].value == pytest.approx(0.117, rel=0.1)
    assert result.estimates["imu_z"].value == pytest.approx(-2.2e-3, abs=0.4e-3)
    curve = [result.estimates[f"thrust_{x}"].value for x in ("offset", "linear", "quadratic")]
    duty = np.linspace(0.4, 0.8, 5)
    thrust = 0.027 * np.polyval(curve[::-1], duty)
    np.testing.assert_allclose(thrust, np.polyval([0.1229, -0.0074, 0.0221], duty), rtol=0.06)


@pytest.mark.slow
def test_a_hover_balances_about_the_centre_of_mass(calm):
    estimates = identify_hover_centre(calm.ts, calm.commands, LAYOUT)
    for e, value in zip(estimates, TRUTH.centre, strict=True):
        assert abs(e.value - value) < 4 * e.deviation
        assert e.white < e.deviation < 0.5e-3
    part = calm.between(2.0, 5.0)
    with pytest.raises(SettingError, match=r"hover is 3 s long; 4 s or more"):
        identify_hover_centre(part.ts, part.commands, LAYOUT)


@pytest.mark.slow
def test_the_command_reads_a_log_lists_it_and_identifies(calm, tmp_path, capsys, monkeypatch):
    """A CSV file, which knows no rotors: they are given by an option."""
    monkeypatch.setenv("COLUMNS", "140")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    names = ["t [s]", *(f"accelerometer.{x} [m/s^2]" for x in "xyz")]
    names += [
        *(f"gyroscope.{x} [rad/s]" for x in "xyz"),
        *(f"motor_commands.{k}" for k in (1, 2, 3, 4)),
    ]
    table = np.column_stack([calm.ts, calm.accelerometer, calm.gyroscope, calm.commands])
    log = tmp_path / "flight.csv"
    np.savetxt(log, table, delimiter=",", header=",".join(names), comments="")
    assert main(["identify", str(log), "--list"]) == 0
    assert "in flight: 0.0 to 12.0 s" in capsys.readouterr().out
    assert main(["identify", str(log)]) == 2
    assert "no positions of the rotors" in capsys.readouterr().err
    words = ["identify", str(log), "--airframe", str(layout_file(tmp_path)), "--mass", "0.03"]
    for option, value, sentence in (
        ("-o", "own.nc", "ends in .toml"),
        ("--out", str(log), "must be a folder"),
        ("--mass", "-1", "must be positive"),
        ("--flight", "3", "but not number 3"),
    ):
        assert main([*words, option, value]) == 2
        assert sentence in " ".join(capsys.readouterr().err.split())
    assert main([*words, "--out", str(tmp_path / "figures")]) == 0
    # no axis is excited, so there is neither a response nor an ellipse
    names = {path.stem for path in (tmp_path / "figures").glob("*.png")}
    assert {"log", "accelerations", "windows", "table"} <= names
    assert not {"response", "centre"} & names
    said = " ".join(capsys.readouterr().out.split())
    assert "Identifying 1.0 to 11.5 s of flight.csv" in said
    assert "drag x" in said
    assert "Roll is not excited" in said
    assert "Undecided" in said


@real
def test_a_weight_at_motor_3_moves_the_centre_of_mass_towards_it():
    """Mean over the hovers of three plain flights and of two with the weight, at arms of 32.5 mm."""
    layout = make_layout(LAYOUT.positions / ARM * 0.0325, LAYOUT.spin)
    centres = {}
    for folder, names in (
        ("normal_flight", ("E9_log00", "E9_log01", "E9_log02")),
        ("add_weight_W3_near_M3", ("E9_log00", "E9_log02")),
    ):
        logs = [read_flight_log(FLIGHTS / "crazypad" / folder / name) for name in names]
        hovers = [
            log.window(t0 + 1, t1 - 1)["motor_commands"] for log in logs for t0, t1 in log.flights
        ]
        pairs = [identify_hover_centre(h.ts, h.values, layout) for h in hovers]
        centres[folder] = np.mean([[e.value for e in pair] for pair in pairs], axis=0)
    shift = centres["add_weight_W3_near_M3"] - centres["normal_flight"]
    assert np.degrees(np.arctan2(shift[1], shift[0])) == pytest.approx(135, abs=10)
    assert np.linalg.norm(shift) == pytest.approx(3.3e-3, abs=0.5e-3)


@real
def test_a_weight_appears_as_a_step_of_the_filtered_centre():
    """The longest hovers without and with the weight, one after the other; towards motor 3 within two seconds."""
    layout = make_layout(LAYOUT.positions / ARM * 0.0325, LAYOUT.spin)
    hovers = []
    for folder in ("normal_flight", "add_weight_W3_near_M3"):
        log = read_flight_log(FLIGHTS / "crazypad" / folder / "E9_log00")
        parts = [log.window(t0 + 1, t1 - 1)["motor_commands"] for t0, t1 in log.flights]
        hovers.append(max(parts, key=lambda c: len(c.ts)))
    before, after = hovers
    end = before.ts[-1] - before.ts[0]
    ts = np.append(before.ts - before.ts[0], after.ts - after.ts[0] + end + 0.01)
    filtered = filter_hover_centre(ts, np.concatenate([before.values, after.values]), layout)
    settled = lambda a, b: np.mean(filtered.centre[(filtered.ts > a) & (filtered.ts < b)], axis=0)
    shift = settled(end + 2, ts[-1]) - settled(end - 4, end)
    assert np.degrees(np.arctan2(shift[1], shift[0])) == pytest.approx(135, abs=15)
    assert np.linalg.norm(shift) == pytest.approx(3.3e-3, abs=0.8e-3)
    assert np.all(np.abs(shift) > 3 * filtered.deviation[-1])


@real
def test_logs_that_are_no_flight_or_too_slow_are_refused(tmp_path):
    with pytest.raises(SettingError, match="is disarmed throughout"):
        read_flight_log(FLIGHTS / "ulog" / "sample_appended_multiple.ulg").to_record()
    with pytest.raises(SettingError, match="slower than the lag of motors"):
        read_flight_log(FLIGHTS / "ulog" / "sample_px4_events.ulg").to_record()
    with pytest.raises(SettingError, match="no gyroscope"):
        read_flight_log(FLIGHTS / "crazypad" / "normal_flight" / "E9_log00").to_record()
