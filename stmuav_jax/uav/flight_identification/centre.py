"""Centre of mass of a multirotor: from the commands of a hover alone, and as states of a filter over a flight.

On average a hovering vehicle does not turn, so its centre of mass is that of the thrusts,

    c = sum_k sum_i T_i(u_ik) a_i / sum_k sum_i T_i(u_ik),

if the motors are equal. A battery's voltage that scales all thrusts alike cancels. If the relative slope
of the thrust at hover differs from that of the layout's shape, c is wrong by the ratio of the two.

The filter stands beside the estimate of the whole record. About roll and pitch, with what the identified
numbers explain of the angular acceleration, a_k, its change g_k by the centre of mass c, and unknown moments m,

    w_k = w_(k-1) + dt (a_k + g_k c_k + m_k),   m_k = rho m_(k-1) + noise,   c_k = c_(k-1) + drift,

and the gyroscope reads w with white noise. In a hover whose rates are not logged the balance of the thrusts
reads c_k + m_k. The numbers of m and of the noise follow from the autocovariances of the record itself.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...checks.errors import SettingError
from ...estimation.consistency import Verdict, verdict
from ...estimation.filter import GaussianFilter, kalman_filter
from ...estimation.gaussians import gaussian
from ...estimation.model import Sensor, StateSpaceModel
from ...estimation.sigma import Unscented
from .record import FlightRecord, RotorLayout, compute_thrust_shape
from .stages import FlightIdentification, ParameterEstimate, combine_parts, explain_rotation

# Rate of the filter on hovers [Hz], deviation of the centre of mass before the flight [m], and lags at which the
# decay of the unknown moments is read [steps].
_HOVER_RATE, _PRIOR, _LAGS = 20.0, 0.02, (2, 6)
# Block of correlated values and shortest hover [s], and number of windows of an estimate from a hover.
_HOVER_BLOCK, _SHORTEST_HOVER, _WINDOWS = 1.0, 4.0, 4


class FilteredCentre(NamedTuple):
    """Centre of mass over a flight.

    Attributes:
        ts: times (k,) [s]. centre, deviation: along x and y from the layout's origin (k, 2) [m].
        verdict: on the filter, by its innovations.
    """

    ts: Float[np.ndarray, " k"]
    centre: Float[np.ndarray, "k 2"]
    deviation: Float[np.ndarray, "k 2"]
    verdict: Verdict


def filter_centre(
    record: FlightRecord, result: FlightIdentification, *, drift: float = 0.0
) -> FilteredCentre:
    """Filter the centre of mass from a flight that identifies roll and pitch.

    Args:
        record: the record that was identified. result: its identification.
        drift: random walk of the centre of mass [m/sqrt(s)]; none by default.

    Raises:
        SettingError: roll or pitch is not identified, or a drift below zero.
    """
    if not {"roll", "pitch"} <= set(result.estimates):
        raise SettingError(
            "A filter of the centre of mass needs a flight that identifies roll and pitch: "
            f"{' '.join(result.refusals.get(name, '') for name in ('roll', 'pitch')).strip()}"
        )
    ts, rates, explained, slopes = explain_rotation(record, result)
    dt = float(ts[1] - ts[0])
    change = np.diff(rates, axis=0, prepend=rates[:1]) / dt
    origin = result.layout.centre[:2]
    rest = change - explained
    rest -= slopes * [result.estimates[f"centre_{x}"].value - origin["xy".index(x)] for x in "yx"]
    rest = rest[1:]
    rho, moment, noise = np.array([_split_noise(v, dt) for v in rest.T]).T

    def step(x: Array, u: Any, dt: Array) -> Array:
        w, m, c = x[:2], x[2:4], x[4:]
        m = jnp.asarray(rho) * m
        return jnp.concatenate([w + dt * (u[0] + u[1] * c[::-1] + m), m, c])

    # a new part of the moments acts within the step that it appears in
    spread = moment * np.sqrt(1 - rho**2)
    entry = np.zeros((6, 4))
    entry[[0, 1], [0, 1]], entry[[2, 3], [0, 1]] = dt * spread, spread
    entry[[4, 5], [2, 3]] = _check_drift(drift) * np.sqrt(dt)
    prior = gaussian(
        np.r_[rates[0], np.zeros(4)],
        np.diag(np.r_[noise**2 + 1e-12, moment**2, np.full(2, _PRIOR**2)]),
    )
    inputs = (explained[1:], slopes[1:])
    return _run(ts, rates[1:], inputs, step, entry, prior, noise, slice(4, 6), origin)


def identify_hover_centre(
    ts: Float[np.ndarray, " k"], commands: Float[np.ndarray, "k n"], layout: RotorLayout
) -> tuple[ParameterEstimate, ParameterEstimate]:
    """Centre of mass along x and y from a hover, from the layout's origin [m].

    The deviation has those of blocks of one second, and the scatter of four windows beyond theirs. What
    is common to flights of one machine, such as motors that differ, is not in it: the difference of two
    flights shows a payload.

    Args:
        ts: times [s]. commands: of the rotors, 0 to 1. layout: rotors in the order of the commands.

    Raises:
        SettingError: the hover is shorter than 4 s, or has another number of rotors.
    """
    T = _hover_thrusts(commands, layout)
    if not ts[-1] - ts[0] >= _SHORTEST_HOVER:
        raise SettingError(
            f"The hover is {ts[-1] - ts[0]:.3g} s long; {_SHORTEST_HOVER:g} s or more would be valid."
        )
    # The incomplete second at the end joins the block before it: a block of a few samples would
    # scatter more than the others.
    block = np.minimum((ts - ts[0]) // _HOVER_BLOCK, (ts[-1] - ts[0]) // _HOVER_BLOCK - 1).astype(
        int
    )
    count = block[-1] + 1
    total = np.bincount(block, np.sum(T, axis=1))
    estimates = []
    for axis, letter in enumerate("xy"):
        moment = np.bincount(block, T @ layout.positions[:, axis])
        value = float(np.sum(moment) / np.sum(total))
        rest = moment - value * total
        # The value was fitted to the blocks, which takes one of their degrees of freedom.
        scale = np.sqrt(count / (count - 1)) / np.sum(total)
        blocks = float(np.sqrt(np.sum(rest**2)) * scale)
        white = T @ layout.positions[:, axis] - value * np.sum(T, axis=1)
        windows = np.array_split(np.arange(count), min(_WINDOWS, count))
        values = np.array([np.sum(moment[w]) / np.sum(total[w]) for w in windows])
        spread = np.array([blocks * np.sqrt(count / len(w)) for w in windows])
        parts = (np.sqrt(np.sum(white**2)) / np.sum(total), blocks, 0.0, values, spread)
        name = f"centre of mass {letter} by hover, equal motors"
        estimates.append(combine_parts(name, "m", value, *parts))
    return estimates[0], estimates[1]


def filter_hover_centre(
    ts: Float[np.ndarray, " k"],
    commands: Float[np.ndarray, "k n"],
    layout: RotorLayout,
    *,
    drift: float = 1e-3,
) -> FilteredCentre:
    """Filter the centre of mass of equal motors from the commands of a hover alone.

    Args:
        ts: times [s]. commands: of the rotors, 0 to 1. layout: rotors in the order of the commands.
        drift: random walk of the centre of mass [m/sqrt(s)], by which a payload may appear.

    Raises:
        SettingError: fewer than 100 means of the hover at 20 Hz, another number of rotors, or a drift below zero.
    """
    T = _hover_thrusts(commands, layout)
    # Round-off of a time at a boundary must not put its sample in the mean before.
    place = np.floor((ts - ts[0]) * _HOVER_RATE + 1e-9).astype(int)
    total = np.bincount(place, np.sum(T, axis=1))
    present = total > 0
    if np.sum(present) < 100:
        raise SettingError(
            f"The hover has {np.sum(present)} means at {_HOVER_RATE:g} Hz; 100 or more would be valid."
        )
    z = np.stack([
        np.bincount(place, T @ layout.positions[:, axis])[present] / total[present] for axis in (0, 1)
    ], axis=1)  # fmt: skip
    times = (np.flatnonzero(present) + 0.5) / _HOVER_RATE + ts[0]
    dt = 1 / _HOVER_RATE
    # steps of a payload are no moments: differences from running means tell these apart
    slow = np.stack(
        [np.convolve(v, np.ones(99) / 99, "same") for v in (z - np.mean(z, axis=0)).T], axis=1
    )
    rest = z - np.mean(z, axis=0) - slow
    size = np.std(rest, axis=0)
    rho = np.array([float(np.clip((v[1:] @ v[:-1]) / (v @ v), 0.0, 0.99)) for v in rest.T])

    def step(x: Array, u: Any, dt: Array) -> Array:
        return jnp.concatenate([jnp.asarray(rho) * x[:2], x[2:]])

    entry = np.diag(
        np.r_[size * np.sqrt(1 - rho**2), np.full(2, _check_drift(drift) * np.sqrt(dt))]
    )
    prior = gaussian(np.zeros(4), np.diag(np.r_[size**2, np.full(2, _PRIOR**2)]))
    read = lambda x, u: x[:2] + x[2:]
    return _run(
        np.r_[times[0] - dt, times], z, None, step, entry, prior, 0.05 * size, slice(2, 4), np.zeros(2), read
    )  # fmt: skip


def _hover_thrusts(commands: np.ndarray, layout: RotorLayout) -> np.ndarray:
    """Thrusts over their coefficient (k, n), of commands for each rotor of the layout."""
    if commands.shape[1] != len(layout.positions):
        raise SettingError(
            f"The hover has commands of {commands.shape[1]} rotors, but the layout has {len(layout.positions)}."
        )
    return compute_thrust_shape(commands, layout.thrust_model_factor)


def _run(
    ts: np.ndarray,
    readings: np.ndarray,
    inputs: Any,
    step: Callable[..., Array],
    entry: np.ndarray,
    prior: Any,
    noise: np.ndarray,
    place: slice,
    origin: np.ndarray,
    read: Callable[..., Array] = lambda x, u: x[:2],
) -> FilteredCentre:
    """Unscented filter whose last states are the centre of mass."""
    names = ("roll", "pitch") if inputs is not None else ("balance x", "balance y")
    sensor = Sensor(read, np.diag(noise**2), names=names)
    model = StateSpaceModel(step, entry @ entry.T, sensor)
    out = kalman_filter(
        model, prior, readings, u=inputs, dt=float(np.median(np.diff(ts))),
        method=GaussianFilter(Unscented()),
    )  # fmt: skip
    centre, spread = np.asarray(out.mean)[:, place], np.asarray(out.standard_deviation)[:, place]
    return FilteredCentre(ts[1:], centre + origin, spread, verdict(out, names=names))


def _check_drift(drift: float) -> float:
    if not 0 <= drift < np.inf:
        raise SettingError(f"The drift must be zero or positive, but it is {drift:g} m/sqrt(s).")
    return drift


def _split_noise(v: np.ndarray, dt: float) -> tuple[float, float, float]:
    """Correlation from step to step and deviation of the moments, and noise of the rates, from their sum's
    autocovariances: v = m + (n_k - n_(k-1)) / dt."""
    gamma = [float(np.mean(v[lag:] * v[: len(v) - lag])) for lag in range(_LAGS[1] + 1)]
    first, last = _LAGS
    # Differences of white noise correlate over one step at most: from lag 2 on the autocovariance
    # is of the moments alone.
    ratio = max(gamma[last], 0.05 * gamma[first]) / max(gamma[first], 1e-12 * gamma[0])
    rho = float(np.clip(ratio ** (1 / (last - first)), 0.1, 0.995))
    variance = min(max(gamma[first] / rho**first, 0.01 * gamma[0]), gamma[0])
    noise = np.sqrt(max(gamma[0] - variance, 1e-3 * gamma[0]) / 2) * dt
    return rho, float(np.sqrt(variance)), float(noise)
