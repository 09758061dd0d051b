"""Identification of a multirotor from the record of a flight, in stages that refuse what is not excited.

About the centre of mass c, with lagged commands s and thrust shapes T_i(s_i) (see `record`), rotors at
(x_i, y_i) with spin e_i, rates (p, q, r), arms l and velocity v,

    p' =  B_x sum (y_i - c_y) T_i / l_x + d_x p + h_x q r + m_x v_y - G_x q sum e_i s_i + moments that nobody knows,
    q' = -B_y sum (x_i - c_x) T_i / l_y + d_y q + h_y p r + m_y v_x + G_y p sum e_i s_i + ...,
    r' = -B_z sum e_i T_i - S sum e_i s_i' + d_z r + h_z p q + ...,

where the shapes T_i are those of the layout plus an offset, so that the thrust with the slope that manoeuvres show
carries the vehicle; the angular momentum of the rotors makes S and, as it turns with the body, G; an accelerometer at
b from the centre of mass reads

    a = f + w' x b + w x (w x b) + bias,   f = (0, 0, sum T_i k/m) - D v + E (q, -p, 0) + unknown forces,

where drag that acts above or below the centre of mass makes E. The velocity v is not logged. By v' = f + g - w x v,
with gravity g in body axes by the gyroscope,

    f_x' - r f_y = -D_x (f_x + g_x - q v_z) + (D_y - D_x) r v_y + E_x q' + E_y r p,
    f_y' + r f_x = -D_y (f_y + g_y + p v_z) + (D_y - D_x) r v_x - E_y p' + E_x r q,
    f_z' = sum T_i' k/m - D_z (f_z + g_z + q v_x - p v_y)

where the drag tells v once D is roughly known. Both fits are by prediction errors, so the unknown moments
and forces may be coloured and fed back.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy import optimize, stats
from scipy.constants import g as GRAVITY

from ...analysis.fit_statistics import compare_estimates, compute_autocorrelation
from ...checks.errors import SettingError
from .combinations import describe_combinations
from .prediction_error import PredictionErrorFit, Regression, fit_prediction_error, solve_columns
from .record import (
    SHORTEST_RECORD,
    FlightRecord,
    RotorLayout,
    apply_filter,
    compute_rotor_states,
    compute_thrust_shape,
    filter_columns,
    filter_delay,
    low_pass,
    observe_motion,
    refilter_rates,
)

AXES = ("roll", "pitch", "yaw")
# Rate of the regressions for specific force, for screening and for variants [Hz]. That of the angular motion is
# the grid's: the commands follow every sample, and errors of averages would not be independent of them.
_FORCE_RATE = 100.0
# Memories of the coloured forces and moments, block of scores, and stretch after the start that is left out [s].
_MEMORY, _MOMENT_MEMORY, _BLOCK, _SETTLING = 0.25, 0.15, 1.0, 0.3
# Block of the scores of the forces, in which the drag follows errors of the observed velocity that last as long [s].
_FORCE_BLOCK = 2.0
# Bounds of lag and delay, and their starts [s].
_BOUNDS, _START = ((0.0005, 0.5), (0.0, 0.05)), (0.05, 0.004)
# Shortest window, and most of them.
_WINDOW, _WINDOWS = 6.0, 5
# Effect of the commands over the prediction errors from which an axis is excited.
_EXCITED = 2.0
# Relative deviation up to which an effectiveness is determined.
_DETERMINED = 0.1
# That of a combination of the motors' responses about an axis that is not excited, of which little is known.
_COMBINED = 0.04
# Deviations from which a response about yaw has a clear sign.
_CLEAR = 5.0
# Deviations up to which the IMU's position [m] and the drag over mass [1/s] are determined. A bound as a share of the
# drag that was found would keep those that came out too large.
_IMU_DETERMINED, _DRAG_DETERMINED = 0.005, 0.2
# Deviation of the voltage's exponent up to which it is determined, and range of the voltage from which it is sought.
_EXPONENT_DETERMINED, _STEADY = 0.25, 0.01
# Deviation of the curve's quadratic part up to which it is determined, as a share of the slope.
_CURVE_DETERMINED = 0.15
# Step of the polygon for what is not known of the velocity along z [s].
_CLIMB = 3.0
# Time in which the integral of the forces' relations forgets [s].
_LEAK = 1.0
# Columns of the forces' regression before those of the thrust: lever, drag, turning constants, rates.
_FORCE = 12
# Columns of the moments' regression about roll or pitch after those of the rotors.
_MOMENT = 4
# Time of a battery's sag, and lag whose change of the response stands for a second one [s].
_SLOW, _SECOND_LAG = 3.0, 0.005
# Pace of the observer of a variant.
_OTHER_PACE = 2.0
# Drag over mass with which the observer starts [1/s], and most passes until its drag is that of the fit.
_DRAG, _PASSES = 0.4, 6
# Share of the thrust that carries the vehicle below which it does not fly.
_CARRYING = 0.3
# Radii of gyration of multirotors over their mean arms: possible and usual ones.
_GYRATION, _USUAL = (0.1, 5.0), (0.3, 1.3)
# Mean specific force along the vertical in flight [m/s^2], change of the speed along it, and largest speed [m/s].
_VERTICAL, _SPEED_CHANGE, _FASTEST = (9.4, 10.2), 2.0, 300.0
# Equal parts of the flight whose median counts beside the mean.
_PARTS = 8
# Trend and linear part of the thrust that are no fault of a model: a calm flight shows smaller ones, which come from
# the observed velocity.
_NEGLIGIBLE = 0.005
# Level of the verdict and of variants that the record rejects.
_LEVEL = 0.01
# Lowest rate of commands [Hz], and smallest change of a channel: means over a grid's steps have errors of rounding.
_SLOWEST, _SMALLEST = 50.0, 1e-9


class ParameterEstimate(NamedTuple):
    """Estimate of one quantity, with what its deviation is made of.

    Attributes:
        name: of the quantity. unit: of the value and the deviations. value: estimate.
        deviation: standard deviation, the root of the squares of blocks, windows and variants.
        white: deviation for white prediction errors. blocks: by sums of scores over blocks.
        windows: scatter between windows beyond their deviations; zero where they agree.
        variants: difference of variants of the model beyond what chance explains.
        window_values: estimate in each window (w,). window_deviations: their deviations (w,).
        window_p_value: p-value of their agreement.
    """

    name: str
    unit: str
    value: float
    deviation: float
    white: float
    blocks: float
    windows: float
    variants: float
    window_values: Float[np.ndarray, " w"]
    window_deviations: Float[np.ndarray, " w"]
    window_p_value: float


def combine_parts(
    name: str, unit: str, value: float, white: float, blocks: float, variants: float,
    window_values: Float[np.ndarray, " w"], window_deviations: Float[np.ndarray, " w"],
) -> ParameterEstimate:  # fmt: skip
    """Estimate with the scatter between its windows, from the other parts of its deviation."""
    scatter, p_value = 0.0, 1.0
    # a lag at its bound has no deviation
    if np.all(window_deviations > 0):
        scatter, p_value = compare_estimates(window_values, np.diag(window_deviations**2), _LEVEL)
    deviation = float(np.sqrt(blocks**2 + scatter**2 + variants**2))
    return ParameterEstimate(
        name, unit, float(value), deviation, float(white), float(blocks), scatter, float(variants),
        window_values, window_deviations, p_value,
    )  # fmt: skip


class FlightVerdict(NamedTuple):
    """Verdict on an identification.

    Attributes:
        status: "consistent"; "inconsistent": a test rejects the model; "undecided": nothing was
            identified.
        p_values: p-value of every test by its name.
        explanation: sentences on the findings.
    """

    status: Literal["consistent", "inconsistent", "undecided"]
    p_values: dict[str, float]
    explanation: str


class FlightIdentification(NamedTuple):
    """Multirotor that a flight identifies.

    Attributes:
        estimates: by their names; those that the flight does not determine are not among them.
        refusals: sentence of each stage that was refused, by the stage's name.
        verdict: on the model and the deviations.
        layout: rotors that were assumed.
        rotation: fit behind the effectiveness, None if no axis is determined. translation: that behind the rest.
        hover: mean command of the rotors.
    """

    estimates: dict[str, ParameterEstimate]
    refusals: dict[str, str]
    verdict: FlightVerdict
    layout: RotorLayout
    rotation: PredictionErrorFit | None
    translation: PredictionErrorFit
    hover: float

    def correct_voltage(self, record: FlightRecord) -> FlightRecord:
        """The identified record with commands corrected for the voltage, if its exponent is determined."""
        exponent = self.estimates.get("voltage_exponent")
        return record.correct_voltage(0.0 if exponent is None else exponent.value)

    def describe(self) -> str:
        """Table of the estimates, the refusals and the verdict."""
        parts = ("deviation", "blocks", "windows", "variants", "white")
        rows: list[tuple[str, ...]] = [("quantity", "value", *parts, "unit")]
        for e in self.estimates.values():
            numbers = (f"{getattr(e, part):.2g}" for part in parts)
            rows.append((e.name, f"{e.value:.4g}", *numbers, e.unit))
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
        return "\n".join([*lines, "", *self.refusals.values(), self.verdict.explanation])


class _Signals(NamedTuple):
    """Record with what all regressions need: force at the centre of mass, velocity and gravity in body axes.

    The slope is that of a rotor's thrust over mass by the command at the mean command, None if it is not determined.
    """

    record: FlightRecord
    layout: RotorLayout
    force: np.ndarray
    velocity: np.ndarray
    gravity: np.ndarray
    slope: float | None = None

    @property
    def hover(self) -> float:
        """Mean command of the rotors."""
        return float(np.mean(self.record.commands))

    def compute_thrusts(
        self, states: Float[np.ndarray, "k n"], factor: float
    ) -> Float[np.ndarray, "k n"]:
        """Thrusts over their coefficient that follow the layout's shape about the mean, and on average carry."""
        shape = compute_thrust_shape(states, factor)
        if self.slope is None:
            return shape
        coefficient = self.slope / _shape_slope(factor, self.hover)
        # The moment of the centre of mass takes the whole thrust, of which a shape through zero has another
        # share by its slope than a curve with an offset or with an idle speed.
        level = float(np.mean(self.record.accelerometer[:, 2])) / states.shape[1]
        return shape + level / coefficient - np.mean(shape)


class _Results(NamedTuple):
    """Estimates and refusals of the stages so far."""

    estimates: dict[str, ParameterEstimate]
    refusals: dict[str, str]


class _Variant(NamedTuple):
    """Settings of a fit."""

    rate: float = np.inf
    memory: float = _MEMORY
    factor: float | None = None


def _sample_step(record: FlightRecord, rate: float) -> int:
    return max(round(1 / (record.dt * rate)), 1)


def _other_factor(layout: RotorLayout) -> float:
    """Thrust model factor of a variant: that of another shape than the layout's."""
    return 0.5 if layout.thrust_model_factor > 0.75 else 1.0


def _shape_slope(factor: float, command: float) -> float:
    """Slope of the thrust's shape at a command."""
    return 1 - factor + 2 * factor * command


def _rotation_regression(
    signals: _Signals, axes: Sequence[int], variant: _Variant, *, free: bool = False
) -> Callable[[np.ndarray], Regression]:
    """Regression of angular accelerations as a function of (lag, delay).

    The output is the change of the gyroscope's reading over a step of the grid. Regressors go through
    its filter; those that were measured themselves enter from before the step.
    """
    record, layout = signals.record, signals.layout
    dt, n = record.dt, _sample_step(record, variant.rate)
    # Filters of the record start at zero: rows before they have settled would be fitted to a
    # transient that the vehicle did not make.
    first = round(_SETTLING / dt)
    box = np.ones(n) / n
    boxes = np.convolve(box, box)
    # The angular acceleration is never formed by a derivative, which would amplify noise: the
    # regression is of the rate's change over a step, with all else integrated over the same step.
    change = np.zeros(n + 1)
    change[[0, -1]] = 1, -1
    w = record.gyroscope
    y = filter_columns(np.convolve(box, change) / (n * dt), [1.0], w)[first::n]
    b, a = low_pass(record.cutoffs[0], dt, record.filter_step)
    # integrals over a step by the trapezoidal rule, and of a derivative exactly
    trapezoids = np.convolve(boxes, [0.5, 0.5])
    integral, derivative = (
        np.convolve(b, x) for x in (trapezoids, np.convolve(boxes, [1 / dt, -1 / dt]))
    )
    through = lambda numerator, x: apply_filter(numerator, a, x)[first::n]
    measured = []
    for axis in axes:
        # Regressors that were measured have noise of their own. From before the step it is not
        # correlated with that of the output, which would bias their coefficients.
        i, j = [k for k in range(3) if k != axis]
        product = filter_columns(trapezoids, [1.0], w[:, i] * w[:, j])
        columns = [w[:, axis]] + ([signals.velocity[:, 1 - axis]] if axis < 2 else [])
        # the newest sample is that before the step of the output
        older = filter_columns(np.append(np.zeros(n), boxes), [1.0], np.stack(columns, axis=1))
        # the velocity in the middle of the step, by a straight line through those before it
        older[n:, 1:] += (n - 0.5) / n * (older[n:, 1:] - older[:-n, 1:])
        measured.append(np.column_stack([older[:, 0], product, older[:, 1:]])[first::n])
    factor = layout.thrust_model_factor if variant.factor is None else variant.factor
    levers = layout.positions - layout.centre

    def build(lags: np.ndarray) -> Regression:
        s = compute_rotor_states(record.commands, dt, *lags)
        T = signals.compute_thrusts(s, factor)
        momentum = apply_filter(b, a, s @ layout.spin)[:, None] * w[:, :2]
        gyroscopic = filter_columns(trapezoids, [1.0], momentum)[first::n]
        parts = []
        for axis, columns in zip(axes, measured, strict=True):
            sign = 1 if axis == 0 else -1
            if axis == 2:
                spins = np.eye(len(levers)) if free else -layout.spin[:, None]
                rotors = np.hstack([through(integral, T @ spins), through(derivative, s @ spins)])
            # Motors that differ have a coefficient each; equal ones share one, and the centre of
            # mass is then the only other unknown of the moment.
            elif free:
                rotors = through(integral, T)
            else:
                moment = T @ levers[:, 1 - axis] / layout.arms[axis]
                rotors = sign * through(integral, np.stack([moment, -np.sum(T, axis=1)], axis=1))
            coupling = [] if axis == 2 else [sign * -gyroscopic[:, [1 - axis]]]
            parts.append(np.hstack([rotors, columns, *coupling]))
        ends = np.cumsum([0, *(part.shape[1] for part in parts)])
        X = np.zeros((len(y), len(axes), ends[-1]))
        for c, part in enumerate(parts):
            X[:, c, ends[c] : ends[c + 1]] = part
        return Regression(y[:, list(axes)], X, n * dt)

    return build


def _lever_columns(record: FlightRecord) -> np.ndarray:
    """Accelerations (k, 3, 3) at unit distances from the centre of mass, as the accelerometer reads them."""
    w = record.gyroscope
    # The accelerometer is off the centre of mass by an unknown lever: angular accelerations and
    # squares of rates appear in its reading, in proportion to it.
    dw = np.gradient(refilter_rates(record, w), record.dt, axis=0)
    S = refilter_rates(record, np.einsum("ki,kj->kij", w, w).reshape(-1, 9)).reshape(-1, 3, 3)
    S -= np.eye(3) * np.trace(S, axis1=1, axis2=2)[:, None, None]
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        S[:, j, i] += dw[:, k]
        S[:, i, j] -= dw[:, k]
    return S


def _integrate_relation(record: FlightRecord, n: int, values: np.ndarray) -> np.ndarray:
    """Leaky integral of a relation of the forces, at every nth sample by means over the steps.

    The noise of a derivative has no constant part, which A(z) cannot describe; that of this integral has one.
    """
    # The integral forgets, since a bias that turns with the body would otherwise grow without
    # bound in it.
    pole, share = np.exp(-record.dt / _LEAK), record.dt / n
    integral = filter_columns(np.full(n, share), [1.0, -pole], values)
    return integral[round(_SETTLING / record.dt) :: n]


def _thrust_columns(record: FlightRecord, n: int, thrust: np.ndarray) -> np.ndarray:
    """Terms that thrusts (k, m) over mass add to the relation of the forces along z, as the accelerometer reads it."""
    b, a = low_pass(record.cutoffs[1], record.dt, record.filter_step)
    difference = np.array([1.0, -1.0]) / record.dt
    return _integrate_relation(record, n, apply_filter(np.convolve(b, difference), a, thrust))


def _force_regression(
    signals: _Signals, variant: _Variant, *, curve: bool, voltage: np.ndarray | None = None
) -> Callable[[np.ndarray], Regression]:
    """Regression of the specific force as a function of (lag, delay) of the thrust.

    Outputs are the two relations of the horizontal forces, then the force along z. Logarithms of the voltage (k,)
    add a column for its exponent after those of the curve.
    """
    record, layout = signals.record, signals.layout
    dt, n = record.dt, _sample_step(record, variant.rate)
    rates = refilter_rates(record, record.gyroscope)

    def relate(f: np.ndarray) -> np.ndarray:
        # Horizontal forces turn with the vehicle's heading, which no sensor here measures: their
        # rates in turning axes need the yaw rate alone.
        rate = rates[:, 2].reshape(-1, *(1,) * (f.ndim - 2))
        change = np.concatenate([np.zeros_like(f[:1]), np.diff(f, axis=0)]) / dt
        change[:, 0] -= rate * f[:, 1]
        change[:, 1] += rate * f[:, 0]
        return change

    sampled = lambda x: _integrate_relation(record, n, x)
    y = sampled(relate(record.accelerometer))
    nodes = max(round((record.ts[-1] - record.ts[0]) / _CLIMB), 2)
    columns = np.zeros((len(record.ts), 3, _FORCE + nodes))
    columns[:, :, :3] = relate(_lever_columns(record))
    (p, q, r), v = record.gyroscope.T, signals.velocity
    coupling = np.stack([q * v[:, 2], -p * v[:, 2], p * v[:, 1] - q * v[:, 0]], axis=1)
    # the force within a step of the output follows from those before it, whose noise is not that of the output
    force = filter_columns(np.r_[np.zeros(n), 2.0, np.zeros(n - 1), -1.0], [1.0], signals.force)
    acceleration = force + refilter_rates(record, signals.gravity - coupling)
    acceleration -= np.mean(acceleration[2 * n :], axis=0)
    for axis in range(3):
        columns[:, axis, 3 + axis] = -acceleration[:, axis]
    # drag that differs along x and y does not turn with the heading
    turning_speed = refilter_rates(record, r[:, None] * v[:, [1, 0]])
    columns[:, :2, 3] -= turning_speed
    columns[:, :2, 4] += turning_speed
    # biases of the accelerometer and the mean velocity, which nothing tells, turn with the body
    for column, (axis, rate) in enumerate(((0, 2), (1, 2), (2, 0), (2, 1))):
        columns[:, axis, 6 + column] = rates[:, rate]
    # force that follows the rates, as the speed of a place above or below the centre of mass does
    follow = np.zeros((len(rates), 3, 2))
    follow[:, 0, 0], follow[:, 1, 1] = rates[:, 1], -rates[:, 0]
    columns[:, :, 10:_FORCE] = relate(follow)
    # so does the velocity along z, which nothing tells either: a polygon over the flight
    places = np.linspace(record.ts[0], record.ts[-1], nodes)
    for j, node in enumerate(np.eye(nodes)):
        share = np.interp(record.ts, places, node)[:, None]
        columns[:, :2, _FORCE + j] = share * rates[:, [1, 0]] * [1, -1]
    # integrals over a step by the trapezoidal rule, as those of the derivatives are exact
    mean = [3, 4, 5, 6, 7, 8, 9, *range(_FORCE, _FORCE + nodes)]
    columns[1:, :, mean] = 0.5 * (columns[1:, :, mean] + columns[:-1, :, mean])
    measured = sampled(columns.reshape(len(record.ts), -1)).reshape(-1, 3, _FORCE + nodes)
    factor = layout.thrust_model_factor if variant.factor is None else variant.factor

    def build(lags: np.ndarray) -> Regression:
        s = compute_rotor_states(record.commands, dt, *lags)
        if curve:
            parts = [s, s**2]
            if voltage is not None:
                change = compute_rotor_states(record.commands * voltage[:, None], dt, *lags)
                parts.append((1 - factor + 2 * factor * s) * change)
            thrust = np.stack([np.sum(part, axis=1) for part in parts], axis=1)
        else:
            thrust = np.sum(compute_thrust_shape(s, factor), axis=1)[:, None]
        m = thrust.shape[1]
        X = np.zeros((len(y), 3, _FORCE + m + nodes))
        X[:, :, :_FORCE], X[:, :, _FORCE + m :] = measured[:, :, :_FORCE], measured[:, :, _FORCE:]
        X[:, 2, _FORCE : _FORCE + m] = _thrust_columns(record, n, thrust)
        return Regression(y, X, n * dt)

    return build


def _identify_voltage(
    record: FlightRecord, layout: RotorLayout, results: _Results
) -> tuple[FlightRecord, FlightRecord | None]:
    """Record with commands as the motors feel them, and that for an exponent larger by its deviation.

    The second is None where the voltage is not known, or its exponent not determined.
    """
    voltage = record.voltage
    if voltage is None:
        return record, None
    bare = record._replace(voltage=None)
    if not np.min(voltage) > 0.5 * np.median(voltage):
        raise SettingError(
            f"The battery's voltage falls to {np.min(voltage):.3g} V where {np.median(voltage):.3g} V is usual; "
            "positive voltages throughout, or none, would be valid."
        )
    if np.ptp(voltage) < _STEADY * np.mean(voltage):
        results.refusals["voltage"] = (
            f"The voltage's part in the thrust is not determined: it changes by {np.ptp(voltage):.2g} V; "
            f"{100 * _STEADY:g} % of it or more would be valid."
        )
        return bare, None
    logarithm = np.log(voltage / np.mean(voltage))
    signals, *_ = _observe_signals(bare, layout)
    exponent, e = 0.0, None
    for _ in range(_PASSES):
        felt, base = signals._replace(record=record.correct_voltage(exponent)), exponent
        hover, k = felt.hover, _shape_slope(layout.thrust_model_factor, felt.hover)
        build = _force_regression(felt, _Variant(_FORCE_RATE), curve=True, voltage=logarithm)
        fit, other = (
            fit_prediction_error(build, np.array(_START), _BOUNDS, memory)
            for memory in (_MEMORY, 2 * _MEMORY)
        )
        e = _Evaluation(fit, [other], _window_count(record)).estimate(
            "exponent of the voltage", "1",
            lambda z, b=base, h=hover, k=k: b + z[_FORCE + 2] * k / (z[_FORCE] + 2 * h * z[_FORCE + 1]),
        )  # fmt: skip
        exponent = e.value
        if not e.deviation <= _EXPONENT_DETERMINED or abs(exponent - base) < 0.1 * e.deviation:
            break
    assert e is not None
    if not e.deviation <= _EXPONENT_DETERMINED:
        level = np.log(np.maximum(np.mean(record.commands, axis=1), 1e-3))
        level = filter_columns([1.0], [1.0, -0.99], level - np.mean(level))
        alike = float(np.corrcoef(level, logarithm)[0, 1])
        results.refusals["voltage"] = (
            f"The voltage's part in the thrust is not determined: its exponent has a deviation of {e.deviation:.2g}; "
            f"{_EXPONENT_DETERMINED:g} or less would be valid. Commands and voltage change together (correlation "
            f"{alike:.2f}); quick manoeuvres in thrust at several voltages would separate them."
        )
        return bare, None
    results.estimates["voltage_exponent"] = e
    return record.correct_voltage(e.value), record.correct_voltage(e.value + e.deviation)


def _observe(
    record: FlightRecord, layout: RotorLayout, levers: np.ndarray, imu: np.ndarray, drag: np.ndarray,
    pace: float = 1.0,
) -> _Signals:  # fmt: skip
    force = record.accelerometer - levers @ imu
    signals = _Signals(record, layout, force, *observe_motion(record, force, drag, pace))
    if not np.all(np.abs(signals.velocity) < _FASTEST):
        raise SettingError(
            f"By gyroscope and accelerometer the vehicle would exceed {_FASTEST:g} m/s: are their units rad/s and "
            "m/s^2?"
        )
    return signals


def _observe_signals(
    record: FlightRecord, layout: RotorLayout
) -> tuple[_Signals, _Signals, _Signals]:
    """Signals by an observer whose drag and lever are those of a fit with its result, and by two others.

    One is faster, the other has a drag that is larger by its standard deviation.
    """
    drag = np.full(2, _DRAG)
    observe = partial(_observe, record, layout, _lever_columns(record))
    # Drag and lever are found from the velocity, which is observed with drag and lever: a few
    # passes agree, since either depends little on the other.
    imu, fit = np.zeros(3), None
    for _ in range(_PASSES):
        build = _force_regression(observe(imu, drag), _Variant(_FORCE_RATE), curve=False)
        fit = fit_prediction_error(build, np.array(_START), _BOUNDS, _MEMORY)
        previous, drag = drag, np.maximum(fit.values[3:5], 0.1 * _DRAG)
        imu = fit.values[:3]
        if np.all(np.abs(drag - previous) < 0.02 * drag):
            break
    assert fit is not None
    signals = observe(imu, drag)
    spread = np.sqrt(np.diag(fit.compute_covariance(_FORCE_BLOCK))[3:5])
    return signals, observe(imu, drag, _OTHER_PACE), observe(imu, drag + spread)


def _check_gravity(signals: _Signals) -> float:
    """Refuse a specific force that on average is not gravity along the vertical which the gyroscope carries on.

    Returns:
        Its difference from gravity, of the mean or the median of parts the smaller one [m/s^2].
    """
    record = signals.record
    vertical_force = np.sum(signals.force * -signals.gravity, axis=1) / GRAVITY
    # In a wild manoeuvre the observer may lose the vertical for seconds, which the median of parts of
    # the flight does not see. A part alone says little in a short flight, where the mean says more.
    # So both must be wrong.
    parts = np.array([np.mean(part) for part in np.array_split(vertical_force, _PARTS)])
    vertical, median = float(np.mean(vertical_force)), float(np.median(parts))
    # The observer counts the mean horizontal force as a bias. It may be a tilt in wind instead.
    horizontal = float(np.linalg.norm(np.mean(signals.force[:, :2], axis=0)))
    change = _SPEED_CHANGE / float(record.ts[-1] - record.ts[0])
    low, high = _VERTICAL[0] - change, _VERTICAL[1] + change
    if not any(
        np.hypot(value, horizontal) >= low and value <= high for value in (vertical, median)
    ):
        raise SettingError(
            f"The accelerometer measures {vertical:.3g} m/s^2 on average along the vertical propagated by the "
            f"gyroscope; {low:.3g} to {high:.3g} m/s^2 would be valid: check unit, scale and axes of both sensors."
        )
    return min(abs(vertical - GRAVITY), abs(median - GRAVITY))


def _compute_slope(
    layout: RotorLayout, hover: float, estimates: dict[str, ParameterEstimate]
) -> float | None:
    """Slope of a rotor's thrust over mass by the command at the mean one; None if it is not determined."""
    if "thrust_slope" in estimates:
        return 2 * hover * estimates["thrust_slope"].value
    if "thrust" in estimates:
        return _shape_slope(layout.thrust_model_factor, hover) * estimates["thrust"].value
    return None


def _double_noise(record: FlightRecord) -> FlightRecord:
    """Record with as much noise again in the gyroscope as it has.

    Noise of the regressors that are made of it draws their coefficients towards zero; what more noise changes is by how
    much. Source: J. R. Cook, L. A. Stefanski, Journal of the American Statistical Association 89 (1994) 1314-1328.
    """
    cutoff, count = record.cutoffs[0], len(record.ts)
    # White noise is all that is left above the vehicle's motions and where the filter has not yet taken it away.
    # Medians do not see the lines of vibrations.
    highest = min(0.45 / record.dt, 1.5 * cutoff)
    frequencies = np.fft.rfftfreq(count, record.dt)
    band = (frequencies > highest / 1.5) & (frequencies < highest)
    rates = record.gyroscope * np.hanning(count)[:, None]
    power = np.abs(np.fft.rfft(rates, axis=0))[band] ** 2 * (8 / 3) / count
    power *= 1 + (frequencies[band, None] / cutoff) ** 4
    size = np.sqrt(np.median(power, axis=0) / np.log(2))
    noise = np.random.default_rng(0).normal(size=(count, 3)) * size
    b, a = low_pass(cutoff, record.dt, record.filter_step)
    return record._replace(gyroscope=record.gyroscope + filter_columns(b, a, noise))


def _window_count(record: FlightRecord) -> int:
    return int(np.clip((record.ts[-1] - record.ts[0]) // _WINDOW, 2, _WINDOWS))


class _Evaluation:
    """Fit with its covariance, its windows and its variants, for estimates of functions of its values.

    Further fits may have one of their assumptions shifted by a standard deviation each.
    """

    def __init__(
        self,
        fit: PredictionErrorFit,
        variants: Sequence[PredictionErrorFit],
        windows: int,
        shifted: Sequence[PredictionErrorFit] = (),
        block: float = _FORCE_BLOCK,
    ) -> None:
        self.fit, self.shifted = fit, shifted
        # Scores are summed over blocks longer than the disturbances' correlation: their scatter
        # needs no model of it.
        self.covariance = fit.compute_covariance(block)
        self.white = fit.white_covariance
        # effectiveness may drift, as a battery sags, but not the lag of motors
        self.windows = fit.fit_windows(windows, self.covariance, common_lags=True)
        self.lag_windows = fit.fit_windows(windows, self.covariance)
        self.variants = [(v, v.compute_covariance(block)) for v in variants]

    def estimate(
        self, name: str, unit: str, quantity: Callable[..., float], *others: float
    ) -> ParameterEstimate:
        """Estimate of quantity(values), or of quantity(values, other) with other settings of variants."""
        of = lambda z: quantity(z, *others[:1])
        G = _difference_gradient(of, self.fit.values, self.white)
        value = float(of(self.fit.values))
        variance = lambda V: float(max(G @ V @ G, 0.0))
        blocks = variance(self.covariance)
        is_of_lags = np.any(G[len(G) - self.fit.lag_count :] != 0)
        # Each window has its own estimate. Scatter beyond the windows' own deviations is what the
        # model leaves out, such as a sagging battery.
        changes, covariances = self.lag_windows if is_of_lags else self.windows
        spread = np.sqrt([variance(V) for V in covariances])
        excess = []
        for k, (fit, V) in enumerate(self.variants):
            of_variant = lambda z, k=k: quantity(z, *others[k + 1 : k + 2])
            H = _difference_gradient(of_variant, fit.values, fit.white_covariance)
            excess.append((float(of_variant(fit.values)) - value, float(H @ V @ H)))
        variants = _exceed_chance(excess, blocks)
        # What another pace of the observer, whose errors are then about twice as large, and an error of
        # its drag or of the voltage's exponent, of one deviation, change.
        variants += sum((float(of(fit.values)) - value) ** 2 for fit in self.shifted)
        parts = np.sqrt([variance(self.white), blocks, variants])
        windows = {"window_values": value + changes @ G, "window_deviations": spread}
        return combine_parts(name, unit, value, *parts, **windows)


def _exceed_chance(differences: Sequence[tuple[float, float]], variance: float) -> float:
    """Mean square of differences of variants beyond chance, by pairs of a difference and the variant's variance."""
    # Of two estimates from one record the less efficient one has the larger variance, and their
    # difference has the excess (Hausman): only a larger difference speaks against the model.
    excess = [max(d**2 - abs(other - variance), 0.0) for d, other in differences]
    return float(np.mean(excess)) if excess else 0.0


def _difference_gradient(
    function: Callable[[np.ndarray], float], x: np.ndarray, V: np.ndarray
) -> np.ndarray:
    """Gradient by central differences of a hundredth of a deviation."""
    G = np.zeros(len(x))
    for k, h in enumerate(0.01 * np.sqrt(np.diag(V))):
        if h > 0:
            e = np.where(np.arange(len(x)) == k, h, 0.0)
            G[k] = (function(x + e) - function(x - e)) / (2 * h)
    return G


def identify_flight(
    record: FlightRecord, layout: RotorLayout, *, progress: Callable[[float], object] | None = None
) -> FlightIdentification:
    """Identify lag, thrust, effectiveness, IMU position, drag and centre of mass from a flight.

    Deviations have three independent parts: sums of scores over blocks of a second or two, scatter between
    windows, and variants of the model. Without a mass only ratios are determined.

    Args:
        record: flight of 10 s or more, at 100 Hz or more.
        layout: rotors in the order of the commands; the centre of mass counts from their origin.
        progress: function that is called with the completed fraction after each stage.

    Raises:
        SettingError: the record is too short or too slow, has another number of rotors, the vehicle does not
            follow its motors, or these respond in another order or with another spin than the layout says.

    Source: the module's equations; L. Ljung, System Identification (1999), ch. 7 and 13.4.
    """
    report = progress or (lambda share: None)
    _check_record(record, layout)
    results = _Results({}, {})
    estimates, refusals = results
    record, further = _identify_voltage(record, layout, results)
    report(0.1)
    # Forces come first: they give the lever of the IMU and the drag, without which the moments'
    # regression lacks the velocity.
    signals, faster, shifted = _observe_signals(record, layout)
    bias = _check_gravity(signals)
    other = [] if further is None else [signals._replace(record=further)]
    report(0.2)
    noisy = signals._replace(record=_double_noise(record))
    translation = _identify_translation(signals, [faster, shifted, noisy, *other], results)
    report(0.35)
    slope = _compute_slope(layout, signals.hover, estimates)
    signals, *shifted = (x._replace(slope=slope) for x in (signals, faster, *other))
    if slope is not None:
        # The accelerometer's bias along z is an error of the thrust that carries, as the slope's is.
        relative = np.hypot(
            estimates["thrust"].deviation / estimates["thrust"].value, bias / GRAVITY
        )
        shifted.append(signals._replace(slope=slope * (1 + float(relative))))
    axes = _screen_axes(signals, refusals)
    report(0.4)
    rotation = _identify_rotation(signals, shifted, axes, results)
    _name_combinations(signals, axes, results)
    report(0.8)
    if {"roll", "pitch"} <= set(estimates):
        _identify_free_centre(signals, estimates)
    report(1.0)
    size = _check_size(layout, estimates)
    _scale_by_mass(layout, results)
    if further is None:
        _allow_for_sag(layout, estimates)
    verdict = _judge_estimates(signals, rotation, translation.fit, estimates)
    verdict = verdict._replace(explanation=verdict.explanation + size)
    fits = (rotation.fit if rotation else None, translation.fit)
    return FlightIdentification(estimates, refusals, verdict, layout, *fits, signals.hover)


def explain_rotation(
    record: FlightRecord, result: FlightIdentification
) -> tuple[
    Float[np.ndarray, " k"], Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"], Float[np.ndarray, "k 2"]
]:  # fmt: skip
    """Rotation about roll and pitch at 100 Hz, with what a result explains of it except for the centre of mass.

    Args:
        record: the record that was identified. result: identifies roll and pitch.

    Returns:
        Times [s], rates [rad/s], explained angular accelerations over the steps before [rad/s^2], and their
        changes by c_y and c_x, which count from the rotors' centre [rad/(s^2 m)].
    """
    assert result.rotation is not None
    record = result.correct_voltage(record)
    layout, theta = result.layout, result.rotation.values
    imu, drag = np.split(result.translation.values[:5], [3])
    drag = np.maximum(drag, 0.1 * _DRAG)
    signals = _observe(record, layout, _lever_columns(record), imu, drag)
    signals = signals._replace(slope=_compute_slope(layout, result.hover, result.estimates))
    n, first = _sample_step(record, _FORCE_RATE), round(_SETTLING / record.dt)
    build = _rotation_regression(signals, [0, 1], _Variant(_FORCE_RATE))
    X = build(result.rotation.lags).X
    m = 2 + _MOMENT
    weights = theta[: 2 * m].copy()
    weights[[1, m + 1]] = 0.0
    slopes = [X[:, c, m * c + 1] * theta[m * c] / layout.arms[c] for c in range(2)]
    rates = filter_columns(np.full(n, 1 / n), [1.0], record.gyroscope[:, :2])[first::n]
    return record.ts[first::n], rates, X @ weights, np.stack(slopes, axis=1)


def _check_record(record: FlightRecord, layout: RotorLayout) -> None:
    count = record.commands.shape[1]
    if count != len(layout.positions):
        raise SettingError(
            f"The record has commands of {count} rotors, but the layout has {len(layout.positions)}."
        )
    length, rate = float(record.ts[-1] - record.ts[0]), 1 / record.dt
    if length < SHORTEST_RECORD:
        raise SettingError(
            f"The flight is {length:.3g} s long; {SHORTEST_RECORD:g} s or more would be valid."
        )
    if rate < 0.99 * _FORCE_RATE:
        raise SettingError(
            f"The record has {rate:.3g} samples a second; {_FORCE_RATE:g} or more would be valid."
        )
    for field, name, labels in (
        ("commands", "command of motor", range(1, count + 1)),
        ("gyroscope", "gyroscope's axis", "xyz"),
        ("accelerometer", "accelerometer's axis", "xyz"),
    ):
        columns = getattr(record, field)
        if not np.all(np.isfinite(columns)):
            raise SettingError(f"The {field} of the record must be finite numbers throughout.")
        constant = np.flatnonzero(np.ptp(columns, axis=0) < _SMALLEST)
        if len(constant):
            raise SettingError(
                f"The {name} {labels[constant[0]]} is {columns[0, constant[0]]:g} throughout the flight; values that "
                "change would be valid."
            )
    changes = np.sum(np.abs(np.diff(record.commands, axis=0)).max(axis=1) > _SMALLEST) / length
    if changes < _SLOWEST:
        raise SettingError(
            f"The commands change {changes:.3g} times a second, which is slower than the lag of motors; "
            f"{_SLOWEST:g} or more would be valid (a high-rate logging profile)."
        )


def _channel_effect(fit: PredictionErrorFit, channel: int, columns: slice) -> float:
    """Standard deviation of what columns contribute to a channel, in those of the errors."""
    return float(np.std(fit.slopes[:, channel, columns] @ fit.values[columns]))


def _screen_axes(signals: _Signals, refusals: dict[str, str]) -> list[int]:
    """Axes that the commands excite, with the order of the motors checked."""
    layout, count = signals.layout, len(signals.layout.positions)
    axes, responses = [], {}

    def fit_axis(axis: int, *, free: bool) -> PredictionErrorFit:
        build = _rotation_regression(signals, [axis], _Variant(_FORCE_RATE), free=free)
        return fit_prediction_error(build, np.array(_START), _BOUNDS, _MEMORY)

    for axis, name in enumerate(AXES):
        is_free = axis < 2
        # Each motor is free here, so that an order of the motors other than the layout's shows in
        # the signs of their responses instead of in a poor fit.
        fit = fit_axis(axis, free=is_free)
        effect = _channel_effect(fit, 0, slice(0, count if is_free else 2))
        if effect < _EXCITED:
            refusals[name] = (
                f"{name.capitalize()} is not excited: the commands cause {effect:.2g} times what nobody "
                f"commands; {_EXCITED:g} times or more would be valid (a manoeuvre about this axis, and one clock for "
                "commands and gyroscope)."
            )
            continue
        axes.append(axis)
        if is_free:
            response = fit.values[:count] * (1 if axis == 0 else -1)
            responses[axis] = (response - np.mean(response)) / np.std(response)
    _check_order(layout, responses)
    # With a wrong spin yaw seems not to be excited, so this needs free motors too.
    _check_spin(layout, fit_axis(2, free=True))
    return axes


def _name_combinations(signals: _Signals, excited: list[int], results: _Results) -> None:
    """Add which combinations of the motors' responses about roll and pitch an axis that is not excited still tells.

    They have no values: without excitation little noise suffices to bias the fit.
    """
    layout, count = signals.layout, len(signals.layout.positions)
    lag = results.estimates.get("lag", results.estimates.get("thrust_lag"))
    lags = np.array([_START[0] if lag is None else lag.value, _START[1]])
    shape = compute_thrust_shape(signals.record.commands, layout.thrust_model_factor)
    for axis in {0, 1} - set(excited):
        # Where the controller alone moves the vehicle, errors of averages over a coarser grid, which depend on the
        # commands, would make its own gain of the responses.
        regression = _rotation_regression(signals, [axis], _Variant(), free=True)(lags)
        fit = fit_prediction_error(lambda _, same=regression: same, np.zeros(0), (), _MEMORY)
        # a vehicle whose radius of gyration is its arm has this effectiveness
        usual = GRAVITY / (count * float(np.mean(shape)) * layout.arms[axis])
        sentence = describe_combinations(
            [f"motor {k + 1}" for k in range(count)], "", fit.values[:count],
            fit.compute_covariance(_BLOCK)[:count, :count], np.full(count, _COMBINED * usual),
        )  # fmt: skip
        results.refusals[AXES[axis]] += sentence.replace("Only", "Of the motors' responses only")


def _check_order(layout: RotorLayout, responses: dict[int, np.ndarray]) -> None:
    """Refuse motors whose responses about roll and pitch are those of other places."""
    levers, count = layout.positions - layout.centre, len(layout.positions)
    # what motor i does at the place of rotor j
    match = np.zeros((count, count))
    for axis, response in responses.items():
        match += np.outer(response, levers[:, 1 - axis] / np.std(levers[:, 1 - axis]))
    # All orders are compared at once by the assignment problem; the layout's own order is refused
    # only if another is clearly better.
    best = optimize.linear_sum_assignment(-match)[1]
    score, best_score = np.trace(match), np.sum(match[np.arange(count), best])
    most = count * len(responses)
    if not responses or score > 0.7 * most or score > best_score - 0.2 * most:
        return
    names = " and ".join(AXES[axis] for axis in responses)
    if len(responses) < 2 or best_score < 0.7 * most:
        hint = "are the order of the motors or the axes of the gyroscope others?"
    else:
        hint = (
            f"motors 1 to {count} respond as rotors {' '.join(str(k + 1) for k in best)} of the layout "
            "would; that order would be valid, or other axes of the gyroscope."
        )
    raise SettingError(
        f"The motors' responses about {names} are not those of the rotors' positions: {hint}"
    )


def _check_spin(layout: RotorLayout, fit: PredictionErrorFit) -> None:
    """Refuse motors whose responses about yaw are those of another spin; the fit has free motors."""
    count = len(layout.spin)
    responses = fit.values[:count]
    spread = np.sqrt(np.diag(fit.compute_covariance(_BLOCK))[:count])
    spin = -np.sign(responses).astype(int)
    effect = _channel_effect(fit, 0, slice(0, 2 * count))
    is_clear = effect >= _EXCITED and np.all(np.abs(responses) > _CLEAR * spread)
    if is_clear and np.any(spin != layout.spin):
        raise SettingError(
            f"The motors' responses about yaw are those of the spin {spin.tolist()}, but the layout has "
            f"{layout.spin.astype(int).tolist()}; use the first, or change the sign of the gyroscope's z."
        )


def _fit_rotation(
    signals: _Signals, axes: list[int], variant: _Variant, start: np.ndarray
) -> PredictionErrorFit:
    build = _rotation_regression(signals, axes, variant)
    return fit_prediction_error(build, start, _BOUNDS, variant.memory)


def _identify_rotation(
    signals: _Signals, shifted: Sequence[_Signals], axes: list[int], results: _Results
) -> _Evaluation | None:
    """Estimates of the angular motion about the axes that are excited and determined."""
    layout, refusals = signals.layout, results.refusals
    factor, other_factor = layout.thrust_model_factor, _other_factor(layout)
    # An axis that is not determined is left out and the others are fitted again: its noise would
    # spoil the lag that all of them share.
    while axes:
        # In calm air sensor noise and slow errors of the velocity are left, which need a longer A(z)
        # than gusts do.
        for memory in (_MOMENT_MEMORY, 2 * _MOMENT_MEMORY):
            fit = _fit_rotation(signals, axes, _Variant(memory=memory), np.array(_START))
            if _test_whiteness(fit, 0.0) >= _LEVEL:
                break
        variants = [
            _fit_rotation(signals, axes, variant, fit.lags)
            for variant in (_Variant(_FORCE_RATE), _Variant(memory=2 * memory))
        ]
        result = _fit_rotation(
            signals, axes, _Variant(memory=memory, factor=other_factor), fit.lags
        )
        # A variant that the record itself rejects, on the same grid, says nothing about the uncertainty
        # of the one that fits.
        difference = len(fit.errors) * 2 * float(np.sum(np.log(result.sigma / fit.sigma)))
        if not difference > stats.chi2.isf(_LEVEL, 1) * fit.errors.shape[1]:
            variants.append(result)
        further = [
            _fit_rotation(other, axes, _Variant(memory=memory), fit.lags) for other in shifted
        ]
        evaluation = _Evaluation(fit, variants, _window_count(signals.record), further, _BLOCK)
        # Effectiveness of two thrust shapes is compared at the hover, where the record is: its
        # number at the command 1 differs by the shape alone.
        hover = signals.hover
        relative_slope = _shape_slope(other_factor, hover) / _shape_slope(factor, hover)
        slopes = [1.0, 1.0, 1.0, relative_slope][: 1 + len(variants)]
        quantities: list[tuple[Any, ...]] = [
            ("lag", "lag", "s", lambda z: z[-2]), ("delay", "delay", "s", lambda z: z[-1]),
        ]  # fmt: skip
        for place, axis in enumerate(axes):
            k, name, letter = (2 + _MOMENT) * place, AXES[axis], "yx"[axis % 2]
            over_lag, arm = f"{name} effectiveness over lag", layout.arms[axis % 2]
            centre = lambda z, k=k, arm=arm, origin=layout.centre[1 - axis]: (
                origin + z[k + 1] / z[k] * arm
            )
            quantities += [
                (name, f"{name} effectiveness", "rad/s^2", lambda z, f, k=k: z[k] * f, *slopes),
                (
                    f"{name}_over_lag",
                    over_lag,
                    "rad/s^3",
                    lambda z, f, k=k: z[k] * f / z[-2],
                    *slopes,
                ),
            ]
            if axis == 2:
                quantities.append(("spin_up", "yaw by spin-up", "rad/s", lambda z, k=k: z[k + 1]))
            else:
                quantities += [
                    (f"{name}_speed", f"{name} by horizontal speed", "rad/(m s)", lambda z, k=k: z[k + 4]),
                    (f"centre_{letter}", f"centre of mass {letter}, equal motors", "m", centre),
                ]  # fmt: skip
        if {0, 1} <= set(axes):
            inertia_ratio = lambda z: z[0] / z[2 + _MOMENT] * layout.arms[1] / layout.arms[0]
            quantities.append(("inertia_ratio", "inertia ratio Jy / Jx", "1", inertia_ratio))
        new = {key: evaluation.estimate(*quantity) for key, *quantity in quantities}
        new["delay"] = _add_resolution(new["delay"], signals.record)
        doubtful = {
            axis: abs(new[AXES[axis]].deviation / new[AXES[axis]].value)
            for axis in axes
            if not new[AXES[axis]].deviation <= _DETERMINED * new[AXES[axis]].value
        }
        if not doubtful:
            if not fit.free[-2]:
                new = {name: e for name, e in new.items() if not name.endswith("lag")}
                refusals["lag"] = (
                    f"The lag is not determined: it ends at the bound of {1e3 * fit.values[-2]:g} ms; rotor speeds "
                    "that were measured have none."
                )
            elif not fit.free[-1]:
                del new["delay"]
                refusals["delay"] = (
                    f"The delay ends at the bound of {1e3 * fit.values[-1]:g} ms, which has no deviation. Commands "
                    "without a delay do so; commands whose time stamps are late or early against the gyroscope's do "
                    "so too, and then lag and effectiveness are biased."
                )
            results.estimates.update(new)
            return evaluation
        for axis, relative in doubtful.items():
            refusals[AXES[axis]] = (
                f"{AXES[axis].capitalize()} effectiveness is not determined: its deviation is "
                f"{100 * relative:.0f} % of it; {100 * _DETERMINED:.0f} % or less would be valid."
            )
            ratio = new[f"{AXES[axis]}_over_lag"]
            if ratio.deviation <= _DETERMINED * ratio.value:
                refusals[AXES[axis]] += (
                    f" Only its ratio to the lag is determined: {ratio.value:.4g} +- {ratio.deviation:.2g} rad/s^3."
                )
        axes = [axis for axis in axes if axis not in doubtful]
    return None


def _add_resolution(delay: ParameterEstimate, record: FlightRecord) -> ParameterEstimate:
    """Estimate whose deviation allows for the times at which commands changed and for the clock of on-board filters."""
    cutoff, clock = record.cutoffs[0], 0.0
    if np.isfinite(cutoff) and record.filter_rate is None:
        # The filter runs at the grid's rate or a higher one, up to continuous time.
        clock = filter_delay(cutoff, 0.0) - filter_delay(cutoff, 0.5 * record.dt)
    parts = (
        np.linalg.norm([x, record.resolution, clock]) for x in (delay.deviation, delay.variants)
    )
    return delay._replace(**dict(zip(("deviation", "variants"), map(float, parts), strict=True)))


def _identify_translation(
    signals: _Signals, shifted: Sequence[_Signals], results: _Results
) -> _Evaluation:
    """Estimates of thrust, drag and the IMU's position from the specific force."""
    estimates, refusals = results
    start = np.array(_START)

    def evaluate(*, curve: bool) -> _Evaluation:
        nonlocal start
        fits = []
        for k, setting in enumerate((signals, signals, *shifted)):
            variant = _Variant(_FORCE_RATE, memory=2 * _MEMORY if k == 1 else _MEMORY)
            build = _force_regression(setting, variant, curve=curve)
            fits.append(fit_prediction_error(build, start, _BOUNDS, variant.memory))
            start = fits[-1].lags
        return _Evaluation(fits[0], fits[1:2], _window_count(signals.record), fits[2:])

    evaluation = evaluate(curve=False)
    main = evaluation.fit
    thrust = evaluation.estimate("thrust of a rotor over mass", "m/s^2", lambda z: z[_FORCE])
    effect = _channel_effect(main, 2, slice(_FORCE, _FORCE + 1))
    record, factor = signals.record, signals.layout.thrust_model_factor
    shapes = np.sum(compute_thrust_shape(record.commands, factor), axis=1)
    usual = float(np.mean(record.accelerometer[:, 2]) / np.mean(shapes))
    if thrust.value + 3 * thrust.deviation < _CARRYING * usual:
        raise SettingError(
            "The vehicle does not follow its motors: by the collective commands a rotor's thrust over mass at the "
            f"command 1 is {thrust.value:.2g} +- {thrust.deviation:.2g} m/s^2, where {usual:.2g} m/s^2 would carry the "
            "vehicle. Was it held, or on the ground, or do commands and IMU have different clocks?"
        )
    if effect >= _EXCITED / 4 and thrust.deviation <= _DETERMINED * thrust.value:
        estimates["thrust"] = thrust
        if main.free[-2]:
            estimates["thrust_lag"] = evaluation.estimate("lag of thrust", "s", lambda z: z[-2])
        _identify_curve(signals, evaluate(curve=True), results)
    else:
        refusals["thrust"] = (
            f"The thrust curve is not excited: collective commands cause {effect:.2g} times what nobody "
            f"commands, and the slope's deviation is {100 * thrust.deviation / abs(thrust.value):.0f} % of it; "
            f"{_EXCITED / 4:g} times or more and {100 * _DETERMINED:.0f} % or less would be valid."
        )
    for k, x in enumerate("xyz"):
        e = evaluation.estimate(f"IMU from centre of mass, {x}", "m", lambda z, k=k: z[k])
        estimates[f"imu_{x}"] = e
        if e.deviation > _IMU_DETERMINED:
            del estimates[f"imu_{x}"]
            refusals[f"imu_{x}"] = (
                f"The IMU's position along {x} is not determined: its deviation is "
                f"{1e3 * e.deviation:.2g} mm; {1e3 * _IMU_DETERMINED:g} mm or less would be valid."
            )
    for k, x in enumerate("xyz"):
        e = evaluation.estimate(f"drag over mass, {x}", "1/s", lambda z, k=k: z[3 + k])
        estimates[f"drag_{x}"] = e
        if not e.deviation <= _DRAG_DETERMINED or e.value < -2 * e.deviation:
            del estimates[f"drag_{x}"]
            refusals[f"drag_{x}"] = (
                f"The drag along {x} is not determined: it is {e.value:.2g} 1/s with a deviation of "
                f"{e.deviation:.2g} 1/s; one that is not negative, with {_DRAG_DETERMINED:g} 1/s or less, would be "
                "valid."
            )
    return evaluation


def _identify_curve(signals: _Signals, evaluation: _Evaluation, results: _Results) -> None:
    """Estimates of the curve T/m = c0 + c1 s + c2 s^2 of one rotor.

    The offset, which follows from the mean specific force, contains the accelerometer's bias along z.
    """
    record, hover, slope = signals.record, signals.hover, results.estimates["thrust"].value
    s = compute_rotor_states(record.commands, record.dt, *evaluation.fit.lags)
    # The integral relation has no constant part: the offset of the curve follows from the mean
    # force, once its slope is known.
    level = float(np.mean(record.accelerometer[:, 2])) / s.shape[1]
    first, second = float(np.mean(s)), float(np.mean(s**2))
    curve = {
        f"thrust_{name}": evaluation.estimate(f"thrust over mass{text}", "m/s^2", quantity)
        for name, text, quantity in (
            ("offset", ", offset", lambda z: level - z[_FORCE] * first - z[_FORCE + 1] * second),
            ("linear", ", linear", lambda z: z[_FORCE]),
            ("quadratic", ", quadratic", lambda z: z[_FORCE + 1]),
            ("slope", " by the square of the command at hover", lambda z: z[_FORCE + 1] + z[_FORCE] / (2 * hover)),
        )
    }  # fmt: skip
    deviation = curve["thrust_quadratic"].deviation
    if deviation > _CURVE_DETERMINED * slope:
        place = slice(_FORCE, _FORCE + 2)
        sentence = describe_combinations(
            ["the linear part", "the quadratic part"], "m/s^2", evaluation.fit.values[place],
            evaluation.covariance[place, place], _CURVE_DETERMINED * slope * np.array([2 * hover, 1.0]),
        )  # fmt: skip
        results.refusals["curve"] = (
            f"The curvature of the thrust is not determined: its deviation is {deviation:.2g} m/s^2 "
            f"at a slope of {slope:.2g} m/s^2 by the square of the command.{sentence}"
        )
        return
    results.estimates.update(curve)


def _fit_free_motors(
    signals: _Signals, variant: _Variant, lags: np.ndarray | None = None
) -> PredictionErrorFit:
    """Fit in which each motor has a strength of its own about each axis; with `lags`, about which each has its own.

    The columns of the strengths come first about each axis; those of the changes of the lag are the last.
    """
    build = _rotation_regression(signals, [0, 1], variant, free=True)
    if lags is None:
        return fit_prediction_error(build, np.array(_START), _BOUNDS, variant.memory)
    # To first order a lag of its own adds the derivative of the response by the lag: one more
    # linear column for each motor instead of a nonlinear unknown.
    step = np.array([0.02 * lags[0], 0.0])
    regression = build(lags)
    change = (build(lags + step).X - build(lags - step).X)[:, :, _strengths(signals.layout)]
    X = np.concatenate([regression.X, change / (2 * step[0])], axis=2)
    return fit_prediction_error(lambda _: regression._replace(X=X), np.zeros(0), (), variant.memory)


def _strengths(layout: RotorLayout) -> np.ndarray:
    """Columns of the motors' strengths about roll, then pitch."""
    n = len(layout.positions)
    return np.r_[0:n, n + _MOMENT : 2 * n + _MOMENT]


def _identify_free_centre(signals: _Signals, estimates: dict[str, ParameterEstimate]) -> None:
    """Centre of mass with a strength and a lag of its own for each motor.

    The responses of motor i are k_i (y_i - c_y) about roll and -k_i (x_i - c_x) rho about pitch; their
    ratios do not contain k_i. Where the 2 n responses contradict these n + 3 unknowns, motors differ in yet
    another way, and the misfit widens the deviations. Windows give the scatter.
    """
    layout = signals.layout
    n, places = len(layout.positions), _strengths(layout)
    variant = _Variant(memory=_MOMENT_MEMORY)
    common = _fit_free_motors(signals, variant)
    fit, *variants = [
        _fit_free_motors(signals, setting, common.lags)
        for setting in (
            variant, _Variant(_FORCE_RATE), variant._replace(factor=_other_factor(layout))
        )
    ]  # fmt: skip
    evaluation = _Evaluation(fit, [common, *variants], _window_count(signals.record), block=_BLOCK)
    levers = layout.positions - layout.centre
    mean = np.mean(np.abs(fit.values[:n])) / layout.arms[0]

    def model(u: np.ndarray) -> np.ndarray:
        strength, rho, c = u[:n], u[n], u[n + 1 :]
        return np.append(strength * (levers[:, 1] - c[1]), -strength * rho * (levers[:, 0] - c[0]))

    def solve(responses: np.ndarray, V: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
        # Responses are correlated, and weighted by their covariance: the fit is then the maximum
        # of likelihood, and its cost is a chi-squared.
        L = np.linalg.cholesky(np.linalg.inv(V)).T
        sizes = np.append(np.full(n, mean), [1.0, *layout.arms[::-1]])
        result = optimize.least_squares(
            lambda u: L @ (model(u) - responses), sizes * np.r_[np.ones(n + 1), 0, 0], x_scale=sizes
        )
        C = np.linalg.inv(result.jac.T @ result.jac)
        return result.x[n + 1 :], C[n + 1 :, n + 1 :], 2 * float(result.cost)

    responses = fit.values[places]
    block = np.ix_(places, places)
    c, V, Q = solve(responses, evaluation.covariance[block])
    if n > 3 and stats.chi2.sf(Q, n - 3) < _LEVEL:
        V = V * Q / (n - 3)
    _, V_white, _ = solve(responses, evaluation.white[block])
    parts = [
        solve(responses + change[places], V_w[block])
        for change, V_w in zip(*evaluation.windows, strict=True)
    ]
    others = [solve(z.values[places], V_z[block]) for z, V_z in evaluation.variants]
    for k, letter in enumerate("xy"):
        differences = [(x[k] - c[k], W[k, k]) for x, W, _ in others]
        variances = [V_white[k, k], V[k, k], _exceed_chance(differences, V[k, k])]
        window_values = layout.centre[k] + np.array([part[0][k] for part in parts])
        estimates[f"free_centre_{letter}"] = combine_parts(
            f"centre of mass {letter}, motors free", "m", layout.centre[k] + c[k], *np.sqrt(variances),
            window_values=window_values, window_deviations=np.sqrt([part[1][k, k] for part in parts]),
        )  # fmt: skip


def _check_size(layout: RotorLayout, estimates: dict[str, ParameterEstimate]) -> str:
    """Sentence after a blank on arms that no usual radius of gyration fits, J / m = (T / m) l / B.

    Raises:
        SettingError: none that is possible does.
    """
    sentence = ""
    for axis, arm in enumerate(layout.arms):
        if "thrust" in estimates and AXES[axis] in estimates:
            ratio = estimates["thrust"].value * arm / estimates[AXES[axis]].value
            share = float(np.sqrt(ratio)) / arm
            if not _GYRATION[0] < share < _GYRATION[1]:
                raise SettingError(
                    f"The radius of gyration about {AXES[axis]} would be {share:.2g} of the mean arm of {arm:.3g} m; "
                    f"{_GYRATION[0]:g} to {_GYRATION[1]:g} of it would be valid: are the positions in m?"
                )
            if not _USUAL[0] < share < _USUAL[1]:
                sentence += (
                    f" The radius of gyration about {AXES[axis]} is {share:.2g} of the mean arm of {arm:.3g} m, where "
                    f"{_USUAL[0]:g} to {_USUAL[1]:g} is usual: are the gyroscope's scale and the positions right?"
                )
    return sentence


def _scale_by_mass(layout: RotorLayout, results: _Results) -> None:
    """Thrust and moments of inertia in SI units, which scale with the mass and the arms."""
    estimates, refusals = results
    if layout.mass is None:
        refusals["mass"] = (
            "Masses, forces and inertias: the log determines ratios only; give the mass for SI values."
        )
        return
    # the slope of the curve where that is determined, else that of the layout's shape
    thrust = estimates.get("thrust_slope", estimates.get("thrust"))
    parts = ("deviation", "white", "blocks", "windows", "variants")
    if thrust is not None:
        scaled = ("value", *parts, "window_values", "window_deviations")
        numbers = {part: getattr(thrust, part) * layout.mass for part in scaled}
        estimates["force"] = thrust._replace(name="thrust of a rotor", unit="N", **numbers)
    for axis, arm in zip("xy", layout.arms, strict=True):
        B, force = estimates.get(AXES["xy".index(axis)]), estimates.get("force")
        if B is None:
            continue
        if force is None:
            refusals[f"inertia_{axis}"] = (
                f"J{axis} and the thrust of a rotor at the command 1 are not determined; only their ratio is: "
                f"thrust / J{axis} = {B.value / arm:.4g} +- {B.deviation / arm:.2g} N/(kg m^2)."
            )
            continue
        value = force.value * arm / B.value
        relative = lambda part, B=B, force=force: np.hypot(
            getattr(B, part) / B.value, getattr(force, part) / force.value
        )
        estimates[f"inertia_{axis}"] = B._replace(
            name=f"moment of inertia J{axis}", unit="kg m^2", value=value,
            window_values=value * B.value / B.window_values,
            window_deviations=value * B.window_deviations / B.value,
            **{part: float(relative(part) * value) for part in parts},
        )  # fmt: skip


def _allow_for_sag(layout: RotorLayout, estimates: dict[str, ParameterEstimate]) -> None:
    """Widen the deviations of what needs the thrust of differential commands and has that of collective ones.

    Collective commands pull an unlogged voltage down, differential ones do not, and no log tells by how much the slopes
    differ. A battery that changes the effectiveness through the flight may change it as much so.
    """
    # a straight line changes by the root of twelve times its standard deviation
    change = max(
        (np.sqrt(12) * estimates[name].windows / estimates[name].value for name in AXES if name in estimates),
        default=0.0,
    )  # fmt: skip
    origins = {
        "centre_x": layout.centre[0],
        "centre_y": layout.centre[1],
        "inertia_x": 0,
        "inertia_y": 0,
    }
    for name in estimates.keys() & origins.keys():
        e = estimates[name]
        part = float(change * (e.value - origins[name]))
        estimates[name] = e._replace(
            deviation=float(np.hypot(e.deviation, part)), variants=float(np.hypot(e.variants, part))
        )


def _judge_estimates(
    signals: _Signals,
    rotation: _Evaluation | None,
    translation: PredictionErrorFit,
    estimates: dict[str, ParameterEstimate],
) -> FlightVerdict:
    """Verdict by windows, further terms of the model, whiteness, and windows that are left out."""
    p_values: dict[str, float] = {}
    sentences: list[str] = []
    if rotation is not None:
        keys = [name for name in ("lag", *AXES, "centre_x", "centre_y") if name in estimates]
        least = min(keys, key=lambda name: estimates[name].window_p_value)
        # The smallest of several p-values is small by chance: Bonferroni's factor allows for their
        # number.
        p_values["windows"] = min(1.0, len(keys) * estimates[least].window_p_value)
        if p_values["windows"] < _LEVEL:
            sentences.append(
                f"Windows disagree most about the {estimates[least].name}; its deviation contains the scatter."
            )
        tests = _test_terms(signals, rotation.fit, translation, estimates)
        if rotation.fit.free[-2] and not rotation.fit.free[-1]:
            # The score of the delay, less what the free values can take on.
            fit = rotation.fit
            J = fit.slopes.reshape(-1, len(fit.values))
            column = J[:, -1] - J[:, fit.free] @ solve_columns(J[:, fit.free], J[:, -1])
            score = abs(column @ fit.errors.ravel()) / np.linalg.norm(column)
            tests["delay"] = (
                float(stats.norm.sf(score)),
                "The gyroscope follows the commands best with a delay beyond its bound: their time stamps differ.",
            )
        p_values |= {name: p_value for name, (p_value, _) in tests.items()}
        sentences += [sentence for p_value, sentence in tests.values() if p_value < _LEVEL]
        p_values["whiteness"] = _test_whiteness(rotation.fit)
        if p_values["whiteness"] < _LEVEL / 6:
            sentences.append("Prediction errors are correlated in time; blocks allow for it.")
        growth = _predict_left_out(rotation)
        sentences.append(
            f"A window that is left out is predicted with errors at most {100 * growth:.2g} % larger than in "
            "the fit."
        )
    significant = [name for name, p in p_values.items() if p < _LEVEL / 6]
    if rotation is not None and not rotation.fit.is_converged:
        significant.append("search")
        sentences.append("The search for lag and effectiveness did not converge.")
    status, summary = "consistent", f"none of {len(p_values)} tests rejects the model."
    if significant:
        names = ", ".join(significant)
        status, summary = "inconsistent", f"{names} (family-wise level {_LEVEL:g})."
    if not p_values:
        status = "undecided"
        summary = "no axis of the angular motion is identified, so no test is made."
    sentences.insert(0, f"{status.capitalize()}: {summary}")
    return FlightVerdict(status, p_values, " ".join(sentences))


def _test_terms(
    signals: _Signals,
    rotation: PredictionErrorFit,
    translation: PredictionErrorFit,
    estimates: dict[str, ParameterEstimate],
) -> dict[str, tuple[float, str]]:
    """P-values of further terms of the thrust, each with the sentence that it stands for.

    A second lag and a battery's sag have a known sign, and the thrust tells them as well as the moments do.
    """
    record, layout = signals.record, signals.layout
    axes = [axis for axis, name in enumerate(AXES) if name in estimates]
    dt, factor = record.dt, layout.thrust_model_factor
    levers = layout.positions - layout.centre
    sides = np.column_stack(
        [levers[:, 1] / layout.arms[0], -levers[:, 0] / layout.arms[1], -layout.spin]
    )
    b, a = low_pass(record.cutoffs[0], dt, record.filter_step)
    b = np.convolve(b, [0.5, 0.5])
    effectiveness = np.array([estimates[AXES[axis]].value for axis in axes])
    time = ((record.ts - record.ts[0]) / (record.ts[-1] - record.ts[0]) - 0.5)[:, None]
    keep = np.exp(-dt / _SLOW)

    def change(name: str, lags: np.ndarray) -> np.ndarray:
        """Change of the thrusts' shapes by a term."""
        s = compute_rotor_states(record.commands, dt, *lags)
        T = compute_thrust_shape(s, factor)
        if name == "curve":
            return s
        if name == "trend":
            return T * time
        if name == "lag":
            # A term of the size of its first-order effect is tested, not fitted: a score test
            # needs the main fit only.
            lagged = compute_rotor_states(s, dt, _SECOND_LAG, 0.0)
            return compute_thrust_shape(lagged, factor) - T
        total = np.sum(T, axis=1, keepdims=True)
        return -T * filter_columns([1 - keep], [1.0, -keep], total / np.mean(total) - 1)

    results = {}
    for name, sentence in (
        ("trend", "Effectiveness changes by {:.0f} % through the flight."),
        ("curve", "Thrust has a linear part of {:.0f} % of the slope beside the assumed curve."),
        ("lag", "Thrust responds to commands as if by a second lag behind the first."),
        (
            "sag",
            "Thrust falls by {:.2g} % with 1 % of collective within seconds, as a battery sags.",
        ),
    ):
        # Share of the term by the moments: what is wrong is wrong about all axes alike.
        terms = apply_filter(b, a, change(name, rotation.lags) @ (sides[:, axes] * effectiveness))
        by_moments, V, _ = rotation.test_columns(terms[round(_SETTLING / dt) :, :, None], _BLOCK)
        share, variance = float(by_moments[0]), float(V[0, 0])
        if name in ("trend", "curve"):
            excess = max(abs(share) - _NEGLIGIBLE, 0.0)
            p = min(1.0, 2 * float(stats.norm.sf(excess / np.sqrt(variance))))
            results[name] = (p, sentence.format(100 * share))
            continue
        thrust = translation.values[_FORCE] * np.sum(change(name, translation.lags), axis=1)
        column = np.zeros((len(translation.noise), 3, 1))
        column[:, 2] = _thrust_columns(record, _sample_step(record, _FORCE_RATE), thrust[:, None])
        by_force, V, _ = translation.test_columns(column, _BLOCK)
        # Forces and moments estimate the same quantity independently: weighted together they
        # detect a smaller one than either does.
        weights = np.array([1 / V[0, 0], 1 / variance])
        share = float(weights @ [by_force[0], share] / np.sum(weights))
        p = float(stats.norm.sf(share * np.sqrt(np.sum(weights))))
        results[name] = (p, sentence.format(share))
    return results


def _test_whiteness(fit: PredictionErrorFit, share: float = 1.0) -> float:
    """P-value of Ljung and Box's test of the prediction errors, of the channel that is least white.

    Correlations of a share of the inverse of A(z)'s order are allowed.
    """
    measured = np.ones(fit.errors.shape, bool)
    order = fit.denominators.shape[1] - 1
    Q = np.sum(compute_autocorrelation(fit.errors, measured, order + 20) ** 2, axis=0)
    # The noise of a derivative, which is all that calm air leaves, needs an A(z) without end. One of
    # finite order leaves correlations of its inverse, which change no deviation by much.
    rest = 20 * len(fit.errors) * (share / order) ** 2
    return float(min(1.0, np.min(stats.ncx2.sf(Q, 20, rest)) * fit.errors.shape[1]))


def _predict_left_out(evaluation: _Evaluation) -> float:
    """Largest relative growth of the errors in a window that the fit does not use."""
    fit = evaluation.fit
    k = len(fit.errors)
    windows = np.array_split(np.arange(k), len(evaluation.windows[0]))
    J, e = fit.slopes[:, :, fit.free], fit.errors
    information = [np.einsum("kci,kcj->ij", J[rows], J[rows]) for rows in windows]
    scores = [np.einsum("kci,kc->i", J[rows], e[rows]) for rows in windows]
    growth = []
    for rows, M, g in zip(windows, information, scores, strict=True):
        # The fit without a window is one linear step from the whole one, whose slopes are at hand:
        # no window needs a fit of its own.
        rest = np.linalg.lstsq(sum(information) - M, sum(scores) - g, rcond=None)[0]
        outside = e[rows] - J[rows] @ rest
        growth.append(np.sqrt(np.sum(outside**2) / np.sum(e[rows] ** 2)) - 1)
    return float(max(growth))
