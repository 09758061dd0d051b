"""Estimator of a flying machine's motion from its sensors, for closed loops.

Gyroscope and accelerometer drive the kinematics of the base, so that no forces need to be known, and
position and attitude fixes correct it, at their own rates and late by their delays
(`stm.estimation.inertial`). The panel angles are estimated separately from the encoders of the strokes, or the
coordinates of any other chain of joints from theirs, with accelerations taken as white noise.

Source: J. Sola, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508 (2017),
ch. 5 and 6; J. L. Crassidis, J. L. Junkins, Optimal Estimation of Dynamic Systems (2011), ch. 7.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag
from jaxtyping import Array, Bool, Float, Int

from ..analysis.linear import Linear
from ..analysis.sensors import SENSORS, gravity_of
from ..checks.errors import ModelError, SettingError, has_values
from ..checks.numbers import (
    array_module,
    as_floats,
    as_numpy,
    check_nonnegative,
    check_numbers,
    stack_arrays,
)
from ..checks.shapes import Numbers
from ..control.instruments import Instrument, Reading
from ..control.quadratic import check_observable
from ..estimation.inertial import (
    BASE,
    ERRORS,
    Belief,
    Gated,
    fix_rows,
    gap_noise,
    gate_limits,
    keep_covariance,
    predict_base,
    step_noise,
    strapdown,
    update_by_fixes,
    update_with_gate,
)
from ..math.compiler import quick_jit
from ..math.rotation import rotation_matrix
from ..mechanics.state import State
from ..mechanics.system import System
from .inner_motion import BasePose, JointChain, TrackerMotion
from .panel_servo import PanelBodies


class MotionEstimate(NamedTuple):
    """Estimate of a machine's motion, which flight controllers accept in place of a `State`.

    Attributes:
        state: estimated state of base and tracker; without a tracker that of the base alone.
        base: mean and covariance of the base and of the biases.
        panel: those of the panel angles, or of the coordinates of the joints, and of their rates; None without.
        nis: normalised innovation squared of the fixes that arrived now and were accepted.
        components: number of their components, zero where none was.
        force: accelerometer's reading less its bias, base axes (3,) [m/s^2].
        missing: readings that were NaN, until now, of each instrument in the order of the estimator's names.
        gated: readings that the gate has rejected, until now, in the same order.
    """

    state: State
    base: Belief
    panel: Belief | None
    nis: Float[Array, ""]
    components: Float[Array, ""]
    force: Float[Array, "3"]
    missing: Int[Array, " f"] | None = None
    gated: Int[Array, " f"] | None = None


class EstimatorMemory(NamedTuple):
    """Memory of a `MotionEstimator`.

    Attributes:
        base, panel: means and covariances as in `MotionEstimate`.
        turning, force: last readings of gyroscope [rad/s] and accelerometer [m/s^2], base axes (3,).
        has_started: false before the first sample.
        gaps: periods since the last reading of gyroscope and accelerometer (2,).
        streak: readings of each fix and encoder beyond the gate, one after the other, until now.
        missing, gated: as in `MotionEstimate`.
    """

    base: Belief
    panel: Belief | None
    turning: Float[Array, "3"]
    force: Float[Array, "3"]
    has_started: Bool[Array, ""]
    gaps: Int[Array, "2"]
    streak: Int[Array, " c"]
    missing: Int[Array, " f"]
    gated: Int[Array, " f"]


class MotionEstimator(eqx.Module):
    """Estimator of pose, velocity and the biases of its sensors, and of the tracker's panel angles.

    It is a function (readings, inputs, memory) -> (`MotionEstimate`, memory) for a `Plant` with the
    same instruments. The estimator uses their noise, rates and delays, and estimates the biases of gyroscope
    and accelerometer. It cannot distinguish the bias of a fix from motion.

    A reading of NaN is missing, and counted: a fix or encoder is left out, gyroscope and accelerometer keep
    their last reading, whose error grows by `turning_change` and `force_change`. A gate on the Mahalanobis
    distance rejects, and counts, fixes too far from their prediction. If the start is worse than its
    deviations, the gate may reject the first ten fixes; after that fixes are accepted.

    Args:
        system: machine, whose first body is the base.
        rate: control rate [Hz].
        instruments: gyroscope, accelerometer at the centre of mass, position and attitude fix of
            the base; with a tracker also the encoders of its two slider joints. Gyroscope and
            accelerometer read at every period, without delay.
        tracker: bodies of the tracker, see `panel_bodies`.
        joints: chain of joints of any other machine, each of which then has an encoder.
        gyroscope_drift: random walk of the gyroscope's bias [rad/s/sqrt(s)].
        accelerometer_drift: that of the accelerometer's bias [m/s^2/sqrt(s)].
        panel_noise: density of the accelerations of panel angles or joints [rad/s^2/sqrt(Hz)], [m/s^2/sqrt(Hz)].
        gate: probability with which the gate rejects a correct reading; 0 for no gate.
        turning_change, force_change: how fast angular velocity [rad/s^2] and force [m/s^3] may change while a
            reading of them is missing.

    Raises:
        SettingError: an instrument that is missing or has no noise, a gyroscope or accelerometer that is
            slow or late, an accelerometer off the centre of mass; a mode of the errors at rest that is
            unobservable by fixes and encoders (the message names its states).
    """

    inner: TrackerMotion | JointChain | None
    axes: Float[Array, "2 3 3"]
    gravity: Float[Array, "3"]
    arm: Float[Array, "3"]
    late: Float[Array, " f"]
    variance: Float[Array, " c"]
    walk: Float[Array, "15 15"]
    panel_walk: Float[Array, "m m"]
    period: Float[Array, ""]
    limits: Float[Array, "2"]
    changes: Float[Array, "2"]
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        instruments: Sequence[Instrument],
        *,
        tracker: PanelBodies | None = None,
        joints: JointChain | None = None,
        gyroscope_drift: Numbers = 1e-5,
        accelerometer_drift: Numbers = 1e-4,
        panel_noise: Numbers = 5.0,
        gate: float = 1e-6,
        turning_change: Numbers = 10.0,
        force_change: Numbers = 50.0,
    ) -> None:
        kinds = ("gyroscope", "accelerometer", "position", "attitude")
        # Instruments are matched by the names that sensors of these kinds have: a list in any
        # order, with others in between, serves the same estimator.
        sensors = [SENSORS[kind](system.names[0]) for kind in kinds]
        self.inner = joints if tracker is None else TrackerMotion(tracker, system.reference)
        encoders = () if self.inner is None else self.inner.encoders
        sensors += [SENSORS["encoder"](joint) for joint in encoders]
        _check_observed(system, rate, instruments, sensors, self.inner)
        selected = [_of_name(instruments, sensor.name) for sensor in sensors]
        for instrument in selected[:2]:
            if instrument.periods(rate) != 1 or instrument.delay != 0:
                raise SettingError(
                    f"The estimator needs a reading of '{instrument.name}' at every control period and without "
                    f"delay, but it reads at {instrument.rate or rate:g} Hz, late by {instrument.delay:g} s."
                )
        if getattr(selected[1].sensor, "point", None) is not None:
            raise SettingError(
                f"The estimator needs '{selected[1].name}' at the centre of mass: give it no point."
            )
        self.names = tuple(instrument.name for instrument in selected)
        vector_sensors: list[Any] = [instrument.sensor for instrument in selected[:2]]
        self.axes = stack_arrays([sensor.axes for sensor in vector_sensors])
        self.period = as_floats(1.0 / rate)
        self.late = as_floats([instrument.delay for instrument in selected[2:]])
        # Noise is that of the instruments as simulated, so that the covariance is consistent by construction
        # and not by tuning.
        noise = [_instrument_noise(instrument, system) for instrument in selected]
        deviations = as_numpy(noise[2:])
        self.variance = as_floats(array_module(*deviations).concatenate(deviations) ** 2)
        self.arm = _fix_arm(selected[2], system)
        self.gravity = gravity_of(system)
        subject, unit = "The drift of the {}'s bias", "/sqrt(s)"
        drift = (
            check_numbers(gyroscope_drift, (), subject.format("gyroscope"), "rad/s" + unit),
            check_numbers(accelerometer_drift, (), subject.format("accelerometer"), "m/s^2" + unit),
        )
        q = check_numbers(panel_noise, (), "The noise of the panel", "rad/s^2/sqrt(Hz)")
        # Gyroscope and accelerometer drive the prediction, so that their noise is process noise;
        # it is the same in every period and is made once.
        self.walk = step_noise(self.period, *noise[:2], *drift)
        self.panel_walk = _panel_noise(self.period, q, len(encoders))
        self.limits = gate_limits(gate)
        turning_change = check_nonnegative(
            turning_change, "The change of the angular velocity", "rad/s^2"
        )
        force_change = check_nonnegative(force_change, "The change of the force", "m/s^3")
        self.changes = stack_arrays([turning_change, force_change])

    def start(
        self,
        state: State,
        *,
        attitude: Numbers = 0.02,
        position: Numbers = 0.05,
        velocity: Numbers = 0.05,
        gyroscope_bias: Numbers = 0.02,
        accelerometer_bias: Numbers = 0.1,
        panel: Numbers = 0.01,
        panel_rate: Numbers = 0.1,
    ) -> EstimatorMemory:
        """First memory, from an assumed state and its standard deviations.

        Args:
            attitude: [rad]. position: [m]. velocity: [m/s]. gyroscope_bias: [rad/s], about zero.
            accelerometer_bias: [m/s^2], about zero. panel: panel angles [rad].
            panel_rate: their rates [rad/s].
        """
        # Biases start at zero with a deviation: a datasheet gives the size of a bias, not its
        # value.
        zero = as_floats(np.zeros(3))
        mean = {
            "p": state.p[0], "r": state.r[0], "v": state.v[0],
            "gyroscope_bias": zero, "accelerometer_bias": zero,
        }  # fmt: skip
        deviations = (attitude, position, velocity, gyroscope_bias, accelerometer_bias)
        base = Belief(mean, _spread_deviations(deviations, 3))
        angles = None
        if self.inner is not None:
            coordinates, rates = self.inner.read(state)
            spread = _spread_deviations((panel, panel_rate), len(self.inner.names))
            angles = Belief(jnp.concatenate([coordinates, rates]), spread)
        none = jnp.zeros(len(self.names), int)
        has_begun, gaps = jnp.zeros((), bool), jnp.zeros(2, int)
        # until its first reading the accelerometer is taken to be at rest
        force = -rotation_matrix(state.p[0]).T @ self.gravity
        return EstimatorMemory(base, angles, zero, force, has_begun, gaps, none[2:], none, none)

    def __call__(
        self, readings: dict[str, Reading], inputs: Float[Array, " m"], memory: EstimatorMemory
    ) -> tuple[MotionEstimate, EstimatorMemory]:
        """Estimate at a sample, and the memory."""
        del inputs
        selected = [readings[name] for name in self.names]
        is_finite = jnp.stack([jnp.all(jnp.isfinite(reading.value)) for reading in selected])
        # A sensor slower than the control rate holds its last value between its readings, which must not be
        # used twice.
        new = jnp.stack([reading.fresh for reading in selected])
        missing, fresh = memory.missing + (new & ~is_finite), new & is_finite
        position, attitude, *encoders = selected[2:]
        turning, force = (
            jnp.where(is_finite[k], self.axes[k].T @ selected[k].value, last)
            for k, last in enumerate((memory.turning, memory.force))
        )
        # The first call has no period before it and only takes readings.
        h = jnp.where(memory.has_started, self.period, 0.0)
        previous_turning = jnp.where(memory.has_started, memory.turning, turning)
        previous_force = jnp.where(memory.has_started, memory.force, force)
        gaps = jnp.where(is_finite[:2], 0, memory.gaps + 1)
        # Gyroscope and accelerometer are inputs of the prediction and not measurements: a missing one is
        # replaced by the last, with the error that it may have grown.
        noise = self.walk + gap_noise(self.changes, self.period, gaps)
        rates, forces = (previous_turning, turning), (previous_force, force)
        predicted = predict_base(memory.base, rates, forces, self.gravity, h, noise)
        # Positions and attitudes arrive at a fraction of the control rate; their update costs more than the
        # prediction and is skipped in between.
        base, fixes = jax.lax.cond(
            jnp.any(fresh[2:4]),
            lambda belief: update_by_fixes(
                belief, turning, force, self.gravity, self.arm, self.late[:2], self.variance[:6],
                self.limits[1], position.value, attitude.value, fresh[2:4], memory.streak[:2],
            ),
            lambda belief: (belief, keep_covariance(belief.covariance, memory.streak[:2])),
            predicted,
        )  # fmt: skip
        updates, panel = [fixes], None
        # The angular velocity is the gyroscope's less its bias: a state of its own would only delay it.
        x, omega = base.mean, turning - base.mean["gyroscope_bias"]
        if memory.panel is None or self.inner is None:
            state = State(x["r"][None], x["p"][None], x["v"][None], omega[None])
        else:
            panel, update = self._update_panel(
                memory.panel, h, encoders, fresh[4:], memory.streak[2:]
            )
            updates.append(update)
            pose = BasePose(x["r"], x["p"], x["v"], omega)
            state = self.inner.place(pose, *jnp.split(panel.mean, 2))
        rejected = jnp.concatenate([jnp.zeros(2, bool), *(update.gated for update in updates)])
        gated, streak = memory.gated + rejected, jnp.concatenate([u.streak for u in updates])
        specific_force = force - x["accelerometer_bias"]
        estimate = MotionEstimate(
            state, base, panel, fixes.nis, fixes.components, specific_force, missing, gated
        )
        has_started = jnp.ones((), bool)
        return estimate, EstimatorMemory(
            base, panel, turning, force, has_started, gaps, streak, missing, gated
        )

    def _update_panel(
        self,
        before: Belief,
        h: Float[Array, ""],
        encoders: list[Reading],
        fresh: Bool[Array, " c"],
        streak: Int[Array, " c"],
    ) -> tuple[Belief, Gated]:
        """Belief about the panel a step h [s] later, after its encoders, and what the gate did."""
        assert self.inner is not None
        n = len(self.inner.names)
        F = _panel_step(h, n)
        # The tracker has a filter of its own beside the base's: its encoders tell nothing of the
        # base, and two small covariances cost less than one large one.
        x = F @ before.mean
        P = F @ before.covariance @ F.T + self.panel_walk
        J = self.inner.jacobian(x[:n])
        # A late encoder reads where the joint was: rate times delay behind, which is linear in the
        # states and needs no stored past.
        delay_jacobian = self.late[2:, None] * J
        readings = jnp.concatenate([encoder.value for encoder in encoders])
        error = self.inner.innovation(readings, x[:n]) + delay_jacobian @ x[n:]
        H, count = jnp.concatenate([J, -delay_jacobian], axis=1), len(encoders)
        rows = [slice(k, k + 1) for k in range(count)]
        gated_update = update_with_gate(
            # Encoders are taken one by one: the gate judges each by itself, and a scalar update
            # needs no inverse.
            0.5 * (P + P.T), [H[k] for k in rows], [self.variance[6:][k] for k in rows],
            [error[k] for k in rows], fresh, [self.limits[0]] * count, streak,
        )  # fmt: skip
        return Belief(x + gated_update.move, gated_update.covariance), gated_update


def _panel_noise(h: Float[Array, ""], density: Float[Array, ""], n: int) -> Float[Array, "m m"]:
    """Covariance that accelerations of n coordinates add to them and their rates over a period h [s]."""
    h, density = as_numpy((h, density))
    xp = array_module(h, density)
    # White accelerations integrated over a period, exactly: the noise of value and rate is
    # correlated.
    axis_covariance = density**2 * xp.stack(
        [xp.stack([h**3 / 3, h**2 / 2]), xp.stack([h**2 / 2, h + 0.0])]
    )
    return as_floats(xp.kron(axis_covariance, np.eye(n)))


def _panel_step(h: Float[Array, ""], n: int) -> Float[Array, "m m"]:
    """Matrix of n coordinates and their rates over a step h [s]."""
    return jnp.eye(2 * n).at[:n, n:].add(h * jnp.eye(n))


def _fix_arm(fix: Instrument, system: System) -> Float[Array, "3"]:
    """Point of a position fix from the base's centre of mass, base axes (3,) [m]."""
    point = getattr(fix.sensor, "point", None)
    if point is None:
        return as_floats(np.zeros(3))
    point, com = as_numpy((point, system.bodies.com))
    return as_floats(point - com[0])


def _check_observed(
    system: System,
    rate: float,
    instruments: Sequence[Any],
    required_instruments: Sequence[Any],
    inner: TrackerMotion | JointChain | None,
) -> None:
    """Raise `SettingError` for fixes and encoders that do not see all errors of the estimator.

    The test is that of `check_observable`, about rest at the reference, on the estimator's own matrices F
    over a period h and H at the fixes, as the rate (F - 1) / h, whose modes have the same states.
    """
    by_name = {x.name: x for x in instruments if isinstance(x, Instrument)}
    names_of_fixes = [instrument.name for instrument in required_instruments[2:]]
    fixes, h = [by_name.get(name) for name in names_of_fixes], 1 / rate
    delays = as_floats([0.0 if fix is None else fix.delay for fix in fixes])
    arm = as_floats(np.zeros(3)) if fixes[0] is None else _fix_arm(fixes[0], system)
    # At rest the fewest states are seen: motion only adds to what the sensors determine.
    F, H = _at_rest(inner, system.reference, gravity_of(system), arm, delays, as_floats(h))
    measured_mask = np.repeat([fix is not None for fix in fixes], [3, 3] + [1] * len(fixes[2:]))
    names = list(ERRORS)
    if inner is not None:
        names += [*inner.names, *(f"rate of {name}" for name in inner.names)]
    if not has_values(F, H):
        return
    # The test uses the matrices that the filter itself runs with, so that it cannot pass for a model that
    # the filter does not have.
    A, C = (np.asarray(F) - np.eye(len(names))) / h, np.asarray(H)[measured_mask]
    states = tuple((name, "") for name in names)
    none = np.zeros((len(names), 0))
    try:
        check_observable(Linear(A, none, C, none[: len(C)], states, (), ()))
    except ModelError as error:
        absent = [repr(name) for name in names_of_fixes if name not in by_name]
        shortage = f": there is no {', no '.join(absent)}" if absent else ""
        raise SettingError(
            f"The estimator's instruments do not suffice{shortage}. {error}"
        ) from error


@quick_jit
def _at_rest(
    inner: TrackerMotion | JointChain | None,
    state: State,
    gravity: Float[Array, "3"],
    arm: Float[Array, "3"],
    delays: Float[Array, " f"],
    h: Float[Array, ""],
) -> tuple[Float[Array, "n n"], Float[Array, "c n"]]:
    """Matrices F over a period h [s] and H at the fixes of an estimator whose machine is at rest."""
    zero, p = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
    point = dict.fromkeys(dict(BASE.parts), zero) | {"p": p}
    _, F = strapdown(point, zero, -gravity, gravity, h)
    H = fix_rows(jnp.eye(3), arm, zero, delays[:2])
    if inner is None:
        return F, H
    J = inner.jacobian(inner.read(state)[0])
    encoder_rows = jnp.concatenate([J, -delays[2:, None] * J], axis=1)
    return block_diag(F, _panel_step(h, len(inner.names))), block_diag(H, encoder_rows)


def state_of(estimate: Any) -> Any:
    """State of a `MotionEstimate`; any other estimate as it is."""
    return estimate.state if isinstance(estimate, MotionEstimate) else estimate


def _spread_deviations(deviations: Sequence[Numbers], size: int) -> Float[Array, "n n"]:
    deviation_arrays = as_numpy([as_floats(x) for x in deviations])
    xp = array_module(*deviation_arrays)
    axis_deviations = [xp.broadcast_to(x, (size,)) for x in deviation_arrays]
    return as_floats(xp.diag(xp.concatenate(axis_deviations) ** 2))


def _of_name(instruments: Sequence[Any], name: str) -> Instrument:
    candidates = [x for x in instruments if isinstance(x, Instrument)]
    matches = [instrument for instrument in candidates if instrument.name == name]
    if len(matches) != 1:
        names_text = ", ".join(f"'{x.name}'" for x in candidates) or "none"
        raise SettingError(
            f"The estimator needs one Instrument '{name}', but there are: {names_text}."
        )
    return matches[0]


def _instrument_noise(instrument: Instrument, system: System) -> Float[Array, " c"]:
    if instrument.noise is None:
        raise SettingError(
            f"The estimator needs the noise of '{instrument.name}': an Instrument with `noise`."
        )
    size = len(instrument.sensor.components(system))
    noise = as_numpy(as_floats(instrument.noise))
    return as_floats(array_module(noise).broadcast_to(noise, (size,)))
