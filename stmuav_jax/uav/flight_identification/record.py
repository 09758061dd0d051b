"""Record of a multirotor's flight on one grid, its rotors' layout, and what their commands cause.

Axes are forward, left and up (x, y, z). A rotor's thrust follows its command u, from 0 to 1, as

    T = k ((1 - f) s + f s^2),   s'(t) = (u(t - delay) - s(t)) / tau,

with the thrust model factor f of PX4. Where the battery's voltage V is logged, u stands for u (V / mean V)^p: a motor
without regulation of its speed feels the command times the voltage, p = 1, and one with it p = 0.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.constants import g as GRAVITY
from scipy.signal import bilinear, butter, lfilter

from ...checks.errors import SettingError
from ...checks.shapes import Numbers

# Natural frequency [rad/s] and damping of the observer of velocity, and time in which it forgets that along z [s].
_OBSERVER, _DAMPING, _CLIMB = 0.4, 0.7, 12.0
# Shortest record that is identified [s].
SHORTEST_RECORD = 10.0
# Rotors closer than this to an axis have no side of it, as a share of the largest arm.
_ON_AXIS = 0.05


class RotorLayout(NamedTuple):
    """Rotors of a multirotor.

    Attributes:
        positions: of the rotors in forward-left-up axes (n, 3) [m]; their origin is that of the centre
            of mass which is identified.
        spin: +1 for a rotor that turns anticlockwise seen from above, else -1 (n,).
        mass: mass of the vehicle [kg], None if unknown.
        thrust_model_factor: f of the thrust f s^2 + (1 - f) s.
        inertia: moments of inertia about x, y and z (3,) [kg m^2], for a model of what no flight determines.
        torque_ratio: drag torque of a rotor over its thrust [m]. highest_speed: at the command 1 [rad/s].
        centre_height: centre of mass above the layout's origin [m]. Each is None if unknown.
    """

    positions: Float[np.ndarray, "n 3"]
    spin: Float[np.ndarray, " n"]
    mass: float | None = None
    thrust_model_factor: float = 1.0
    inertia: Float[np.ndarray, "3"] | None = None
    torque_ratio: float | None = None
    highest_speed: float | None = None
    centre_height: float | None = None

    @property
    def arms(self) -> Float[np.ndarray, " 2"]:
        """Mean distances of the rotors from the x and the y axis [m]."""
        return np.mean(np.abs(self.positions[:, [1, 0]] - self.centre[[1, 0]]), axis=0)

    @property
    def centre(self) -> Float[np.ndarray, " 3"]:
        """Centre of the rotors [m]."""
        return np.mean(self.positions, axis=0)


def make_layout(
    positions: Numbers,
    spin: Numbers,
    mass: float | int | None = None,
    thrust_model_factor: float | int = 1.0,
    *,
    inertia: Numbers | None = None,
    torque_ratio: float | int | None = None,
    highest_speed: float | int | None = None,
    centre_height: float | int | None = None,
) -> RotorLayout:
    """Layout of rotors from numbers, checked; see `RotorLayout`.

    Raises:
        SettingError: fewer than three rotors, numbers that are not finite, another number of spins, all
            rotors on one line, a mass, inertia, ratio or speed that is not positive.
    """
    places = np.asarray(positions, float)
    turns = np.asarray(spin, float)
    if places.ndim == 2 and places.shape[1] == 2:
        places = np.column_stack([places, np.zeros(len(places))])
    if places.ndim != 2 or places.shape[1] != 3 or len(places) < 3:
        raise SettingError(
            f"The rotors' positions have the shape {places.shape}; (n, 2) or (n, 3) of three rotors or more "
            "would be valid."
        )
    if turns.shape != (len(places),) or not np.all(np.abs(turns) == 1):
        raise SettingError(
            f"The rotors' spin must be +1 or -1 for each of {len(places)} rotors, but it is {turns.tolist()}."
        )
    if not np.all(np.isfinite(places)):
        raise SettingError("The rotors' positions must be finite numbers [m].")
    if np.min(np.ptp(places[:, :2], axis=0)) < _ON_AXIS * np.max(np.ptp(places, axis=0)):
        raise SettingError(
            "All rotors are on one line; rotors on two sides of x and y would be valid."
        )
    for quantity, value, unit in (
        ("mass", mass, "kg"), ("torque ratio", torque_ratio, "m"), ("highest speed", highest_speed, "rad/s"),
    ):  # fmt: skip
        if value is not None and not 0 < value < np.inf:
            raise SettingError(f"The {quantity} must be positive, but it is {value:g} {unit}.")
    if centre_height is not None and not np.isfinite(centre_height):
        raise SettingError(f"The centre's height must be finite, but it is {centre_height:g} m.")
    moments = None if inertia is None else np.asarray(inertia, float)
    if moments is not None and (
        moments.shape != (3,) or not np.all((moments > 0) & (moments < np.inf))
    ):
        raise SettingError(
            f"The inertia must be three positive moments about x, y and z, but it is {moments.tolist()} kg m^2."
        )
    if not 0 <= thrust_model_factor <= 1:
        raise SettingError(
            f"The thrust model factor must be between 0 and 1, but it is {thrust_model_factor:g}."
        )
    return RotorLayout(
        places, turns, mass, float(thrust_model_factor), moments, torque_ratio, highest_speed, centre_height
    )  # fmt: skip


class FlightRecord(NamedTuple):
    """Flight of a multirotor on one grid of times.

    Attributes:
        ts: times (k,) [s], equally spaced. commands: of the rotors (k, n), 0 to 1.
        gyroscope: (k, 3) [rad/s]. accelerometer: specific force (k, 3) [m/s^2].
        voltage: of the battery (k,) [V], None if it is not known.
        cutoffs: of the two-pole low-pass filters of gyroscope and accelerometer [Hz]; infinite for none.
        resolution: standard deviation of the times at which commands changed [s].
        filter_rate: of the clock of the low-pass filters [Hz], None if unknown.
    """

    ts: Float[np.ndarray, " k"]
    commands: Float[np.ndarray, "k n"]
    gyroscope: Float[np.ndarray, "k 3"]
    accelerometer: Float[np.ndarray, "k 3"]
    voltage: Float[np.ndarray, " k"] | None = None
    cutoffs: tuple[float, float] = (np.inf, np.inf)
    resolution: float = 0.0
    filter_rate: float | None = None

    @property
    def filter_step(self) -> float:
        """Step of the clock of the low-pass filters [s]; if unknown, half of the grid's, which is no faster."""
        return 0.5 * self.dt if self.filter_rate is None else 1 / self.filter_rate

    @property
    def dt(self) -> float:
        """Step of the grid [s]."""
        return float(self.ts[-1] - self.ts[0]) / (len(self.ts) - 1)

    def correct_voltage(self, exponent: float) -> "FlightRecord":
        """Record whose commands are u (V / mean V)^exponent, without the voltage; itself without a voltage."""
        if self.voltage is None:
            return self
        ratio = (self.voltage / np.mean(self.voltage))[:, None]
        return self._replace(commands=self.commands * ratio**exponent, voltage=None)

    def between(self, t0: float, t1: float) -> "FlightRecord":
        """Record from t0 to t1 [s]."""
        inside = (self.ts >= t0) & (self.ts <= t1)
        voltage = None if self.voltage is None else self.voltage[inside]
        return FlightRecord(
            self.ts[inside], self.commands[inside], self.gyroscope[inside], self.accelerometer[inside],
            voltage, self.cutoffs, self.resolution, self.filter_rate,
        )  # fmt: skip


def compute_rotor_states(
    commands: Float[np.ndarray, "k n"], dt: float, tau: float, delay: float
) -> Float[np.ndarray, "k n"]:
    """Commands after delay and lag, exact for commands that hold over each step; in balance at the start."""
    steps = int(delay / dt)
    share = delay / dt - steps
    # Before the record the first commands count as held: zeros would be a start of the motors.
    padded = np.concatenate([np.repeat(commands[:1], steps + 1, axis=0), commands])
    now, before = padded[1 : 1 + len(commands)], padded[: len(commands)]
    # over a step the older command acts for a share of it, then the newer one
    decay, late = np.exp(-dt / tau), np.exp(-(1 - share) * dt / tau)
    pushed = (late - decay) * before + (1 - late) * now
    states, _ = lfilter([0.0, 1.0], [1.0, -decay], pushed, axis=0, zi=commands[:1])
    return states


def compute_thrust_shape(
    states: Float[np.ndarray, "k n"], factor: float
) -> Float[np.ndarray, "k n"]:
    """Thrusts over their coefficient, (1 - f) s + f s^2."""
    return states * (1 - factor + factor * states)


def filter_columns(
    b: Sequence[float] | np.ndarray,
    a: Sequence[float] | np.ndarray,
    values: Float[np.ndarray, "k *n"],
) -> Float[np.ndarray, "k *n"]:
    """Values through a digital filter b / a in time, from rest."""
    return np.asarray(lfilter(b, a, values, axis=0))


def low_pass(cutoff: float, dt: float, step: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Numerator and denominator of a two-pole low-pass filter; 1 and 1 without a cutoff.

    A filter of a digital clock's step meets its cutoff exactly, which shortens its delay; zero is continuous time.
    """
    if not np.isfinite(cutoff):
        return np.ones(1), np.ones(1)
    poles = butter(2, np.sqrt(2) / filter_delay(cutoff, step), analog=True, output="ba")
    numerator, denominator = bilinear(*poles, fs=1 / dt)  # pyright: ignore
    return np.asarray(numerator), np.asarray(denominator)


def filter_delay(cutoff: float, step: float) -> float:
    """Delay [s] of slow signals by a two-pole low-pass filter of a digital clock's step, or of continuous time, 0."""
    # Butterworth's design by the bilinear transform moves the poles up so that the cutoff is met; a filter that is
    # close to half its clock's rate, which no firmware has, moves them no further.
    half = min(np.pi * cutoff * step, np.pi / 4)
    return float(np.sqrt(2) / (2 * np.pi * cutoff) * (half / np.tan(half) if half else 1.0))


def apply_filter(
    b: np.ndarray, a: np.ndarray, values: Float[np.ndarray, "k *n"]
) -> Float[np.ndarray, "k *n"]:
    """Values through a filter that is in balance with the first of them."""
    # The sensor ran before the record begins: from rest the filter would answer to a step that
    # never was.
    gain = np.sum(b) / np.sum(a)
    return filter_columns(b, a, values - values[:1]) + gain * values[:1]


def refilter_rates(
    record: FlightRecord, values: Float[np.ndarray, "k n"]
) -> Float[np.ndarray, "k n"]:
    """Readings of the gyroscope, or values made of them, through the accelerometer's filter instead of its own."""
    (bg, ag), (bf, af) = (
        low_pass(cutoff, record.dt, record.filter_step) for cutoff in record.cutoffs
    )
    # The numerators of two-pole filters have the same zeros, so their quotient is a number. Zeros
    # of a gyroscope's filter alone cannot be divided by; its gain is.
    b = ag * (bf[0] / bg[0]) if len(bg) == len(bf) else np.convolve(bf, ag) / np.sum(bg)
    return apply_filter(b, af, values)


def observe_motion(
    record: FlightRecord,
    force: Float[np.ndarray, "k 3"],
    drag: Float[np.ndarray, " 2"],
    pace: float = 1.0,
) -> tuple[Float[np.ndarray, "k 3"], Float[np.ndarray, "k 3"]]:
    """Velocity [m/s] and gravity [m/s^2] in body axes by an observer, as they are before each sample.

    It integrates v' = f + g - w x v and g' = -w x g with the specific force f at the centre of mass.
    The drag tells the horizontal velocity, -f / D, which draws both within seconds; along z the velocity
    forgets slowly, as nothing tells it but that on average the vertical force carries. The state at the start is
    that of a pass backwards in time.

    Args:
        force: f. drag: D along x and y [1/s]. pace: factor of the usual speed at which it is drawn.

    Source: P. Martin, E. Salaün, The true role of accelerometer feedback in quadrotor control, ICRA 2010.
    """
    dt = record.dt
    mean = np.mean(force, axis=0)
    # on average the vehicle is level and stands still, up to the biases
    push = force - mean * [1, 1, 0]
    target = -(force - mean)[:, :2] / drag
    frequency = pace * _OBSERVER
    quick, slow = 2 * _DAMPING * frequency, frequency**2
    forget = pace / _CLIMB
    state, velocity, gravity = (0.0,) * 5 + (-GRAVITY,), np.zeros_like(force), np.zeros_like(force)
    share = np.linspace(0, 1, len(force))
    # A record may start tilted and in motion, which nothing measures: in reversed time, where rates and
    # velocity change their signs, a pass comes to the start as settled as the pass before it to the end.
    for sign in (1, -1, 1):
        rows = np.concatenate([sign * record.gyroscope, push, sign * target], axis=1)[::sign]
        now, before = state, None
        # plain numbers: a loop over arrays of three would take twenty times as long
        for k, (p, q, r, fx, fy, fz, tx, ty) in enumerate(rows.tolist()):
            vx, vy, vz, gx, gy, gz = now
            # The length of gravity is known; all three components turn, so that a flip does not fold them.
            scale = GRAVITY / math.hypot(gx, gy, gz)
            gx, gy, gz = scale * gx, scale * gy, scale * gz
            velocity[k], gravity[k] = (vx, vy, vz), (gx, gy, gz)
            ex, ey = tx - vx, ty - vy
            slope = (
                fx + gx - q * vz + r * vy + quick * ex,
                fy + gy - r * vx + p * vz + quick * ey,
                fz + gz - p * vy + q * vx - forget * vz,
                slow * ex - q * gz + r * gy,
                slow * ey - r * gx + p * gz,
                q * gx - p * gy,
            )
            # The method of Adams and Bashforth of second order: a step by Euler's would turn gravity by
            # an angle that lags by half a step.
            now = tuple(
                x + dt * (1.5 * c - 0.5 * o)
                for x, c, o in zip((vx, vy, vz, gx, gy, gz), slope, before or slope, strict=True)
            )
            before = slope
        state = (*(-velocity[-1]).tolist(), *gravity[-1].tolist())
        # A bias along z, or what is missing of a climb that is forgotten, makes a velocity that turns with the body
        # and that the drag along z would follow. With these weights the mean is the slope of a straight line through
        # the speed along the vertical.
        vertical = -np.sum(push[::sign] * gravity, axis=1) / GRAVITY
        push[:, 2] -= np.average(vertical, weights=share * (1 - share)) - GRAVITY
    return velocity, gravity
