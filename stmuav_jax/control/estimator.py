"""Estimator of a flying machine's motion from its sensors, for closed loops.

Gyroscope and accelerometer drive the kinematics of the base, so that no forces need to be known:

    p <- p exp(h (w_m - b_w)),   v <- v + h (R (f_m - b_f) + g),   r <- r + h v + h^2 / 2 (...),

with the biases b_w and b_f as further states. Position and attitude fixes correct it, at their own
rates and late by their delays, over which acceleration and angular velocity are taken as constant.
The error of the attitude is a rotation vector in the base's axes. The panel angles are estimated
beside it from the encoders of the strokes, their accelerations taken as white noise.

Source: J. Sola, Quaternion kinematics for the error-state Kalman filter, arXiv:1711.02508 (2017),
ch. 5 and 6; J. L. Crassidis, J. L. Junkins, Optimal Estimation of Dynamic Systems (2011), ch. 7.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..algebra.rotation import (
    conjugate,
    from_rotation_vector,
    normalise,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ..algebra.space import Composite, Point, Rotation, Vector
from ..checks.errors import SettingError
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..estimation.gaussians import Gaussian
from ..estimation.model import Sensor, StateSpaceModel
from ..estimation.sigma import Linearised
from ..estimation.update import GaussianFilter
from ..flight.flyer import FlyerPoint, whole_state
from ..mechanics.state import State
from ..mechanics.system import System
from ..sensing.sensors import (
    Accelerometer,
    AttitudeFix,
    Encoder,
    Gyroscope,
    PositionFix,
    gravity_of,
)
from ..tracker.drive import SLIDER_JOINTS
from ..tracker.geometry import TrackerGeometry
from ..tracker.kinematics import strokes
from .instruments import Instrument, Reading
from .panel import PanelBodies, panel_motion

_FILTER = GaussianFilter(Linearised(), "covariance")
_BASE = Composite(
    p=Rotation(), r=Vector(3), v=Vector(3), gyroscope_bias=Vector(3), accelerometer_bias=Vector(3)
)
_NAMES = tuple(
    f"{what} {axis}"
    for what in ("attitude", "position", "velocity", "gyroscope bias", "accelerometer bias")
    for axis in "xyz"
)


class MotionEstimate(NamedTuple):
    """Estimate of a machine's motion, which the controllers of `stm.control` take for its `State`.

    Attributes:
        state: estimated state of base and tracker; without a tracker that of the base alone.
        base: Gaussian of the base: `mean` with "p", "r", "v", "gyroscope_bias" [rad/s] and
            "accelerometer_bias" [m/s^2]; errors (15,) in this order, that of p in its own axes [rad].
        panel: Gaussian of the panel angles and their rates (4,); None without a tracker.
        nis: normalised innovation squared of the fixes that arrived now.
        components: number of their components, zero where none arrived.
    """

    state: State
    base: Gaussian
    panel: Gaussian | None
    nis: Float[Array, ""]
    components: Float[Array, ""]


class EstimatorMemory(NamedTuple):
    """Memory of a `MotionEstimator`.

    Attributes:
        base, panel: Gaussians as in `MotionEstimate`.
        turning: last reading of the gyroscope, base axes (3,) [rad/s].
        begun: false before the first sample.
    """

    base: Gaussian
    panel: Gaussian | None
    turning: Float[Array, "3"]
    begun: Bool[Array, ""]


class _Strapdown(eqx.Module):
    """Motion of the base by the readings u: mean "turning" over the step, and "force" (3,)."""

    gravity: Float[Array, "3"]

    def __call__(self, x: Point, u: Any, h: Any) -> Point:
        half = from_rotation_vector(h / 2 * (u["turning"] - x["gyroscope_bias"]))
        middle = product(x["p"], half)
        a = rotation_matrix(middle) @ (u["force"] - x["accelerometer_bias"]) + self.gravity
        moved = {"p": normalise(product(middle, half)), "v": x["v"] + h * a}
        return {**x, **moved, "r": x["r"] + h * x["v"] + h**2 / 2 * a}


class _Fixes(eqx.Module):
    """Position of a point, and rotation vector from an attitude u["p"], as they were before delays.

    Attributes:
        strapdown: motion of the base. arm: point from the centre of mass, base axes (3,) [m].
        late: delays of position and attitude (2,) [s].
    """

    strapdown: _Strapdown
    arm: Float[Array, "3"]
    late: Float[Array, "2"]

    def __call__(self, x: Point, u: Any) -> Float[Array, "6"]:
        where, attitude = (self.strapdown(x, u, -late) for late in self.late)
        r = where["r"] + rotation_matrix(where["p"]) @ self.arm
        return jnp.concatenate([r, to_rotation_vector(product(conjugate(u["p"]), attitude["p"]))])


def _turn_on(x: Float[Array, "4"], u: Any, h: Any) -> Float[Array, "4"]:
    """Panel angles and rates a time h [s] later."""
    del u
    return x.at[:2].add(h * x[2:])


class _Strokes(eqx.Module):
    """Displacements of the sliders from those at home (2,) [m], as they were before delays [s]."""

    geometry: TrackerGeometry
    home: Float[Array, "2"]
    late: Float[Array, "2"]

    def __call__(self, x: Float[Array, "4"], u: Any) -> Float[Array, "2"]:
        del u
        at = [strokes(self.geometry, x[:2] - late * x[2:])[k] for k, late in enumerate(self.late)]
        return jnp.stack(at) - self.home


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
            slow or late, an accelerometer off the centre of mass.
    """

    base: StateSpaceModel
    panel: StateSpaceModel | None
    axes: Float[Array, "2 3 3"]
    tracker: PanelBodies | None
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
        wanted: list[Any] = [Gyroscope(name), Accelerometer(name), PositionFix(name)]
        wanted += [AttitudeFix(name)]
        wanted += [] if tracker is None else [Encoder(joint) for joint in SLIDER_JOINTS]
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
        self.axes = jnp.stack([getattr(one.sensor, "axes") for one in found[:2]])  # noqa: B009
        self.tracker, self.period = tracker, jnp.asarray(1.0 / rate)
        noise = [_noise(one, system) for one in found]
        point = getattr(found[2].sensor, "point", None)
        com = system.bodies.com[0]
        fixes = _Fixes(
            _Strapdown(gravity_of(system)),
            jnp.zeros(3) if point is None else point - com,
            jnp.array([one.delay for one in found[2:4]]),
        )
        h = self.period
        drift = [
            numbers(value, (), f"The drift of the {what}'s bias", unit) * jnp.sqrt(h) * jnp.ones(3)
            for value, what, unit in (
                (gyroscope_drift, "gyroscope", "rad/s/sqrt(s)"),
                (accelerometer_drift, "accelerometer", "m/s^2/sqrt(s)"),
            )
        ]
        steps = [h * noise[0], h**2 / 2 * noise[1], h * noise[1], *drift]
        Q = jnp.diag(jnp.concatenate(steps) ** 2)
        # both come from one reading of the accelerometer
        shared = jnp.arange(3)
        cross = h**3 / 2 * noise[1] ** 2
        Q = Q.at[3 + shared, 6 + shared].set(cross).at[6 + shared, 3 + shared].set(cross)
        seen = Sensor(fixes, jnp.diag(jnp.concatenate(noise[2:4]) ** 2))
        self.base = StateSpaceModel(fixes.strapdown, Q, seen, space=_BASE, names=_NAMES)
        self.panel = None
        if tracker is not None:
            q = numbers(panel_noise, (), "The noise of the panel", "rad/s^2/sqrt(Hz)") ** 2
            one = q * jnp.array([[h**3 / 3, h**2 / 2], [h**2 / 2, h]])
            home = strokes(tracker.geometry, panel_motion(system.reference).value)
            late = jnp.array([found[k].delay for k in (4, 5)])
            encoders = _Strokes(tracker.geometry, home, late)
            own = Sensor(encoders, jnp.diag(jnp.concatenate(noise[4:]) ** 2))
            self.panel = StateSpaceModel(_turn_on, jnp.kron(one, jnp.eye(2)), own)

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
        zero = jnp.zeros(3)
        mean = {
            "p": state.p[0], "r": state.r[0], "v": state.v[0],
            "gyroscope_bias": zero, "accelerometer_bias": zero,
        }  # fmt: skip
        each = (attitude, position, velocity, gyroscope_bias, accelerometer_bias)
        base = Gaussian(mean, _spread(each, 3))
        angles = None
        if self.panel is not None:
            now = panel_motion(state)
            angles = Gaussian(
                jnp.concatenate([now.value, now.rate]), _spread((panel, panel_rate), 2)
            )
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
        u = {"turning": (before + turning) / 2, "force": force}
        predicted = _FILTER.predict(self.base, memory.base, u, h)
        p = predicted.mean["p"]
        error = to_rotation_vector(product(conjugate(p), attitude.value))
        y = jnp.concatenate([position.value, error])
        fresh = jnp.repeat(jnp.stack([position.fresh, attitude.fresh]), 3)
        base, nis = _updated(self.base, predicted, y, fresh, {**u, "turning": turning, "p": p})
        panel = None
        if self.panel is not None and memory.panel is not None:
            moved = _FILTER.predict(self.panel, memory.panel, None, h)
            y = jnp.concatenate([x.value for x in encoders])
            seen = jnp.stack([x.fresh for x in encoders])
            panel, _ = _updated(self.panel, moved, y, seen, None)
        state = self._state(base.mean, turning - base.mean["gyroscope_bias"], panel)
        count = jnp.sum(fresh).astype(nis.dtype)
        return MotionEstimate(state, base, panel, nis, count), EstimatorMemory(
            base, panel, turning, jnp.ones((), bool)
        )

    def _state(self, x: Point, omega: Float[Array, "3"], panel: Gaussian | None) -> State:
        if panel is None or self.tracker is None:
            return State(x["r"][None], x["p"][None], x["v"][None], omega[None])
        angles, rates = panel.mean[:2], panel.mean[2:]
        at = FlyerPoint(x["r"], x["p"], angles, x["v"], omega, rates)
        return whole_state(self.tracker.geometry, self.tracker.shift, at)


def state_of(estimate: Any) -> Any:
    """State of a `MotionEstimate`; any other estimate as it is."""
    return estimate.state if isinstance(estimate, MotionEstimate) else estimate


def _updated(
    model: StateSpaceModel, predicted: Gaussian, y: Array, fresh: Array, u: Any
) -> tuple[Gaussian, Float[Array, ""]]:
    """Gaussian after those components of y that are fresh, and their NIS."""

    def seen(prior: Gaussian) -> tuple[Gaussian, Array]:
        given = jnp.where(fresh, y, jnp.nan)
        after, innovation = _FILTER.update(prior, given, model.sensor, u, model=model)
        return after, innovation.nis

    return jax.lax.cond(
        jnp.any(fresh), seen, lambda prior: (prior, jnp.zeros((), y.dtype)), predicted
    )


def _spread(deviations: Sequence[Numbers], size: int) -> Float[Array, "n n"]:
    each = [jnp.broadcast_to(jnp.asarray(x, float), (size,)) for x in deviations]
    return jnp.diag(jnp.concatenate(each))


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
    return jnp.broadcast_to(jnp.asarray(one.noise, float), (size,))
