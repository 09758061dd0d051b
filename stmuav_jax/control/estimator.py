"""Estimator of a flying machine's motion from its sensors, for closed loops.

Gyroscope and accelerometer drive the kinematics of the base, so that no forces need to be known:

    p <- p exp(h (w_m - b_w)),   v <- v + h (R (f_m - b_f) + g),   r <- r + h v + h^2 / 2 (...),

with the biases b_w and b_f as further states. Position and attitude fixes correct it, at their own
rates and late by their delays, over which acceleration and angular velocity are taken as constant.
The error of the attitude is a rotation vector in the base's axes. The panel angles are estimated
beside it from the encoders of the strokes, their accelerations taken as white noise.

The filters of `stm.estimation` give the same numbers for any model; this one has its derivatives in
closed form and takes one component of a fix after the other, which needs no factorisations: these
would take longer than the rest of the loop.

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
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import conjugate, product, rotation_matrix, to_rotation_vector
from ..algebra.space import Composite, Point, Rotation, Vector
from ..checks.errors import ModelError, SettingError, concrete
from ..checks.numbers import array_module, as_numpy, floats, numbers, stacked
from ..checks.shapes import Numbers
from ..flight.flyer import FlyerPoint, whole_state
from ..flight.linear import Linear
from ..mechanics.state import State
from ..mechanics.system import System
from ..sensing.sensors import SENSORS, gravity_of
from ..tracker.drive import SLIDER_JOINTS
from ..tracker.kinematics import stroke_jacobian, strokes
from .inertial import ERRORS, fix_rows, one_by_one, panel_step, strapdown, walks
from .instruments import Instrument, Reading
from .panel import PanelBodies, panel_motion
from .quadratic import check_observable

_BASE = Composite(
    p=Rotation(), r=Vector(3), v=Vector(3), gyroscope_bias=Vector(3), accelerometer_bias=Vector(3)
)


class Belief(NamedTuple):
    """Mean of an estimate, and the covariance of its errors.

    Attributes:
        mean: of a base, "p", "r", "v", "gyroscope_bias" [rad/s] and "accelerometer_bias" [m/s^2]; of a
            panel, its angles [rad] and their rates (4,).
        covariance: of a base's errors (15, 15) in this order, that of p in its own axes [rad]; of a
            panel's (4, 4).
    """

    mean: Any
    covariance: Float[Array, "n n"]


class MotionEstimate(NamedTuple):
    """Estimate of a machine's motion, which the controllers of `stm.control` take for its `State`.

    Attributes:
        state: estimated state of base and tracker; without a tracker that of the base alone.
        base: mean and covariance of the base and of the biases.
        panel: those of the panel angles and their rates; None without a tracker.
        nis: normalised innovation squared of the fixes that arrived now.
        components: number of their components, zero where none arrived.
        force: accelerometer's reading less its bias, base axes (3,) [m/s^2].
    """

    state: State
    base: Belief
    panel: Belief | None
    nis: Float[Array, ""]
    components: Float[Array, ""]
    force: Float[Array, "3"]


class EstimatorMemory(NamedTuple):
    """Memory of a `MotionEstimator`.

    Attributes:
        base, panel: means and covariances as in `MotionEstimate`.
        turning: last reading of the gyroscope, base axes (3,) [rad/s].
        begun: false before the first sample.
    """

    base: Belief
    panel: Belief | None
    turning: Float[Array, "3"]
    begun: Bool[Array, ""]


class MotionEstimator(eqx.Module):
    """Estimator of pose, velocity and the biases of its sensors, and of the tracker's panel angles.

    It is a function (readings, inputs, memory) -> (`MotionEstimate`, memory) for a `Plant` with the
    same instruments. Their noise, rates and delays are those that the estimator believes; their
    biases it does not know. A fix's own bias cannot be told from the motion, and stays in it.

    Args:
        system: machine, whose first body is the base.
        rate: control rate [Hz].
        instruments: gyroscope, accelerometer at the centre of mass, position and attitude fix of
            the base; with a tracker also the encoders of its two slider joints. Gyroscope and
            accelerometer read at every period, without delay.
        tracker: bodies of the tracker, see `panel_bodies`.
        gyroscope_drift: random walk of the gyroscope's bias [rad/s/sqrt(s)].
        accelerometer_drift: that of the accelerometer's bias [m/s^2/sqrt(s)].
        panel_noise: density of the panel angles' accelerations [rad/s^2/sqrt(Hz)].

    Raises:
        SettingError: an instrument that is missing or has no noise, a gyroscope or accelerometer that is
            slow or late, an accelerometer off the centre of mass; fixes and encoders that do not see a
            mode of the errors at rest (the message names the states in it).
    """

    tracker: PanelBodies | None
    axes: Float[Array, "2 3 3"]
    gravity: Float[Array, "3"]
    arm: Float[Array, "3"]
    late: Float[Array, " f"]
    variance: Float[Array, " c"]
    walk: Float[Array, "15 15"]
    panel_walk: Float[Array, "4 4"]
    home: Float[Array, "2"]
    period: Float[Array, ""]
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        system: System,
        rate: float,
        instruments: Sequence[Instrument],
        *,
        tracker: PanelBodies | None = None,
        gyroscope_drift: Numbers = 1e-5,
        accelerometer_drift: Numbers = 1e-4,
        panel_noise: Numbers = 5.0,
    ) -> None:
        name = system.names[0]
        kinds = ("gyroscope", "accelerometer", "position", "attitude")
        wanted = [SENSORS[kind](name) for kind in kinds]
        wanted += [] if tracker is None else [SENSORS["encoder"](joint) for joint in SLIDER_JOINTS]
        _check_observed(system, rate, instruments, wanted, tracker)
        found = [_of_name(instruments, one.name) for one in wanted]
        for one in found[:2]:
            if one.periods(rate) != 1 or one.delay != 0:
                raise SettingError(
                    f"The estimator needs a reading of '{one.name}' at every control period and without "
                    f"delay, but it reads at {one.rate or rate:g} Hz, late by {one.delay:g} s."
                )
        if getattr(found[1].sensor, "point", None) is not None:
            raise SettingError(
                f"The estimator needs '{found[1].name}' at the centre of mass: give it no point."
            )
        self.names = tuple(one.name for one in found)
        self.axes = stacked([getattr(one.sensor, "axes") for one in found[:2]])  # noqa: B009
        self.tracker, self.period = tracker, floats(1.0 / rate)
        self.late = floats([one.delay for one in found[2:]])
        noise = [_noise(one, system) for one in found]
        self.variance = _square(*noise[2:])
        self.arm = _arm(found[2], system)
        self.gravity = gravity_of(system)
        drift = [
            numbers(value, (), f"The drift of the {what}'s bias", unit)
            for value, what, unit in (
                (gyroscope_drift, "gyroscope", "rad/s/sqrt(s)"),
                (accelerometer_drift, "accelerometer", "m/s^2/sqrt(s)"),
            )
        ]
        q = numbers(panel_noise, (), "The noise of the panel", "rad/s^2/sqrt(Hz)")
        self.walk, self.panel_walk = walks(self.period, *noise[:2], *drift, q)
        self.home = floats(np.zeros(2)) if tracker is None else _home(tracker, system.reference)

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
        """First memory, from a supposed state and its standard deviations.

        Args:
            attitude: [rad]. position: [m]. velocity: [m/s]. gyroscope_bias: [rad/s], about zero.
            accelerometer_bias: [m/s^2], about zero. panel: panel angles [rad].
            panel_rate: their rates [rad/s].
        """
        zero = floats(np.zeros(3))
        mean = {
            "p": state.p[0], "r": state.r[0], "v": state.v[0],
            "gyroscope_bias": zero, "accelerometer_bias": zero,
        }  # fmt: skip
        each = (attitude, position, velocity, gyroscope_bias, accelerometer_bias)
        base = Belief(mean, _spread(each, 3))
        angles = None
        if self.tracker is not None:
            now = panel_motion(state)
            spread = _spread((panel, panel_rate), 2)
            angles = Belief(jnp.concatenate([now.value, now.rate]), spread)
        return EstimatorMemory(base, angles, zero, jnp.zeros((), bool))

    def __call__(
        self, readings: dict[str, Reading], inputs: Float[Array, " m"], memory: EstimatorMemory
    ) -> tuple[MotionEstimate, EstimatorMemory]:
        """Estimate at a sample, and the memory."""
        del inputs
        gyroscope, felt, position, attitude, *encoders = (readings[name] for name in self.names)
        turning, force = (
            axes.T @ x.value for axes, x in zip(self.axes, (gyroscope, felt), strict=True)
        )
        h = jnp.where(memory.begun, self.period, 0.0)
        before = jnp.where(memory.begun, memory.turning, turning)
        (x, P), mean_rate = memory.base, (before + turning) / 2
        x, errors = strapdown(x, mean_rate, force, self.gravity, h)
        P = errors @ P @ errors.T + self.walk
        fresh = jnp.stack([position.fresh, attitude.fresh])
        base, nis = jax.lax.cond(
            jnp.any(fresh),
            lambda x, P: self._fixed(x, P, turning, force, position, attitude),
            lambda x, P: (Belief(x, P), jnp.zeros(())),
            x,
            0.5 * (P + P.T),
        )
        panel = None if memory.panel is None else self._panel(memory.panel, h, encoders)
        state = self._state(base.mean, turning - base.mean["gyroscope_bias"], panel)
        felt = force - base.mean["accelerometer_bias"]
        # of a type of its own, as at every sample: a flight's program is compiled for one type
        components = 3 * jnp.sum(fresh, dtype=nis.dtype)
        found = MotionEstimate(state, base, panel, nis, components, felt)
        return found, EstimatorMemory(base, panel, turning, jnp.ones((), bool))

    def _fixed(
        self,
        x: Point,
        P: Float[Array, "15 15"],
        turning: Float[Array, "3"],
        force: Float[Array, "3"],
        position: Reading,
        attitude: Reading,
    ) -> tuple[Belief, Float[Array, ""]]:
        """Belief after position and attitude fix, and their NIS."""
        late = self.late
        then, _ = strapdown(x, turning, force, self.gravity, -late[0])
        facing, _ = strapdown(x, turning, force, self.gravity, -late[1])
        R = rotation_matrix(then["p"])
        off = position.value - then["r"] - R @ self.arm
        turned = to_rotation_vector(product(conjugate(facing["p"]), attitude.value))
        omega = turning - x["gyroscope_bias"]
        H = fix_rows(R, self.arm, omega, late[:2])
        fresh = jnp.repeat(jnp.stack([position.fresh, attitude.fresh]), 3)
        error = jnp.concatenate([off, turned])
        move, P, nis = one_by_one(P, H, self.variance[:6], error, fresh)
        return Belief(_BASE.retract(x, move), P), nis

    def _panel(self, before: Belief, h: Float[Array, ""], encoders: list[Reading]) -> Belief:
        """Belief about the panel a step h [s] later, after its encoders."""
        assert self.tracker is not None
        geometry = self.tracker.geometry
        F = panel_step(h)
        x = F @ before.mean
        P = F @ before.covariance @ F.T + self.panel_walk
        J, now = stroke_jacobian(geometry, x[:2]), strokes(geometry, x[:2]) - self.home
        late = self.late[2:, None] * J
        error = jnp.concatenate([one.value for one in encoders]) - now + late @ x[2:]
        fresh = jnp.stack([one.fresh for one in encoders])
        H = jnp.concatenate([J, -late], axis=1)
        move, P, _ = one_by_one(0.5 * (P + P.T), H, self.variance[6:], error, fresh)
        return Belief(x + move, P)

    def _state(self, x: Point, omega: Float[Array, "3"], panel: Belief | None) -> State:
        if panel is None or self.tracker is None:
            return State(x["r"][None], x["p"][None], x["v"][None], omega[None])
        angles, rates = panel.mean[:2], panel.mean[2:]
        at = FlyerPoint(x["r"], x["p"], angles, x["v"], omega, rates)
        return whole_state(self.tracker.geometry, self.tracker.shift, at)


@quick_jit
def _home(tracker: PanelBodies, state: State) -> Float[Array, "2"]:
    """Strokes (2,) [m] at a state."""
    return strokes(tracker.geometry, panel_motion(state).value)


def _square(*deviations: Float[Array, "..."]) -> Float[Array, " n"]:
    own = as_numpy(deviations)
    return floats(array_module(*own).concatenate(own) ** 2)


def _arm(fix: Instrument, system: System) -> Float[Array, "3"]:
    """Point of a position fix from the base's centre of mass, base axes (3,) [m]."""
    point = getattr(fix.sensor, "point", None)
    if point is None:
        return floats(np.zeros(3))
    point, com = as_numpy((point, system.bodies.com))
    return floats(point - com[0])


def _check_observed(
    system: System,
    rate: float,
    instruments: Sequence[Any],
    wanted: Sequence[Any],
    tracker: PanelBodies | None,
) -> None:
    """Raise `SettingError` for fixes and encoders that do not see all errors of the estimator.

    The test is that of `check_observable`, about rest at the reference, on the estimator's own matrices F
    over a period h and H at the fixes, as the rate (F - 1) / h, whose modes have the same states.
    """
    known = {one.name: one for one in instruments if isinstance(one, Instrument)}
    fixes, gravity, h = [known.get(one.name) for one in wanted[2:]], gravity_of(system), 1 / rate
    delays = floats([0.0 if one is None else one.delay for one in fixes])
    arm = floats(np.zeros(3)) if fixes[0] is None else _arm(fixes[0], system)
    F, H = _at_rest(tracker, system.reference, gravity, arm, delays, floats(h))
    seen = np.repeat([one is not None for one in fixes], [3, 3] + [1] * len(fixes[2:]))
    names = list(ERRORS)
    if tracker is not None:
        names += ["phi", "theta", "rate of phi", "rate of theta"]
    if not concrete(F, H):
        return
    A, C = (np.asarray(F) - np.eye(len(names))) / h, np.asarray(H)[seen]
    states = tuple((name, "") for name in names)
    none = np.zeros((len(names), 0))
    try:
        check_observable(Linear(A, none, C, none[: len(C)], states, (), ()))
    except ModelError as error:
        lacking = [one.name for one, fix in zip(wanted[2:], fixes, strict=True) if fix is None]
        words = f": there is no {', no '.join(repr(name) for name in lacking)}" if lacking else ""
        raise SettingError(f"The estimator's instruments do not suffice{words}. {error}") from error


@quick_jit
def _at_rest(
    tracker: PanelBodies | None,
    state: State,
    gravity: Float[Array, "3"],
    arm: Float[Array, "3"],
    delays: Float[Array, " f"],
    h: Float[Array, ""],
) -> tuple[Float[Array, "n n"], Float[Array, "c n"]]:
    """Matrices F over a period h [s] and H at the fixes of an estimator whose machine is at rest."""
    zero, p = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
    point = dict.fromkeys(dict(_BASE.parts), zero) | {"p": p}
    _, F = strapdown(point, zero, -gravity, gravity, h)
    H = fix_rows(jnp.eye(3), arm, zero, delays[:2])
    if tracker is None:
        return F, H
    J = stroke_jacobian(tracker.geometry, panel_motion(state).value)
    own = jnp.concatenate([J, -delays[2:, None] * J], axis=1)
    return block_diag(F, panel_step(h)), block_diag(H, own)


def state_of(estimate: Any) -> Any:
    """State of a `MotionEstimate`; any other estimate as it is."""
    return estimate.state if isinstance(estimate, MotionEstimate) else estimate


def _spread(deviations: Sequence[Numbers], size: int) -> Float[Array, "n n"]:
    own = as_numpy([floats(x) for x in deviations])
    xp = array_module(*own)
    each = [xp.broadcast_to(x, (size,)) for x in own]
    return floats(xp.diag(xp.concatenate(each) ** 2))


def _of_name(instruments: Sequence[Any], name: str) -> Instrument:
    given = [one for one in instruments if isinstance(one, Instrument)]
    found = [one for one in given if one.name == name]
    if len(found) != 1:
        have = ", ".join(f"'{one.name}'" for one in given) or "none"
        raise SettingError(f"The estimator needs one Instrument '{name}', but there are: {have}.")
    return found[0]


def _noise(one: Instrument, system: System) -> Float[Array, " c"]:
    if one.noise is None:
        raise SettingError(
            f"The estimator needs the noise of '{one.name}': an Instrument with `noise`."
        )
    size = len(one.sensor.components(system))
    noise = as_numpy(floats(one.noise))
    return floats(array_module(noise).broadcast_to(noise, (size,)))
