"""Contradictions between the channels of a flight log, each in one sentence.

An attitude turns as the gyroscope measures, a position moves as the velocity says, a velocity changes as the specific
force that the attitude turns into the world, and the IMU feels the commands. Each pair is compared by its changes over
half a second, in which delays of filters and estimators are short and drift is small. Where they are alike but for a
factor, an order or signs, a unit or axes are wrong; where they are alike at another time, a clock is.
"""

from collections.abc import Iterator, Mapping
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.signal import correlate
from scipy.spatial.transform import Rotation

from .log_formats import UNITS, XYZ

# Step of the comparison's grid, changes that are compared, and shortest flight that is [s]; slowest channel [Hz].
_STEP, _CHANGE, _SHORTEST, _SLOWEST = 0.02, 0.5, 10.0, 5.0
# Correlations from which changes are alike, and below which they are not; gain of another order or signs, per axis.
_ALIKE, _UNLIKE, _BETTER = 0.8, 0.7, 0.4
# Factors between two channels that count as one, and how close a factor is to the ratio of two units.
_FACTORS, _CLOSE = (0.75, 1.33), 0.15
# Longest shift of a clock that is sought [s]. Commands lead the IMU by the lag of motors, and follow it by that of a
# controller: these shifts are none.
_LONGEST_SHIFT, _NO_SHIFT = 30.0, (-0.3, 0.5)
# Share of an IMU's channel that commands at another time explain, and how much more than those at their own.
_EXPLAINED, _MORE = 0.25, 3.0
# Commands and IMU are compared less their means over this time [s].
_SLOW = 1.0


class _Pair(NamedTuple):
    """Two channels that say the same as curves (k, 3), the least change that is compared, and what a fault means."""

    first: str
    second: str
    curves: tuple[np.ndarray, np.ndarray]
    least: float
    unit: str
    is_refused: bool


def find_contradictions(
    channels: Mapping[str, Any], flights: Float[np.ndarray, "n 2"]
) -> Iterator[tuple[str, bool]]:
    """Sentence on each contradiction in the longest flight, and whether it makes an identification invalid.

    Args:
        channels: by their names, with `ts`, `values` and `rate`. flights: starts and ends [s].
    """
    lengths = flights[:, 1] - flights[:, 0]
    if not len(flights) or np.max(lengths) < _SHORTEST:
        return
    begin, end = flights[np.argmax(lengths)]
    grid = np.arange(begin, end, _STEP)
    covers = lambda ts: ts[0] <= begin + 1 and ts[-1] >= end - 1
    available = {k: x for k, x in channels.items() if x.rate > _SLOWEST and covers(x.ts)}
    for pair in _list_pairs(available, grid):
        sentence = _compare_curves(pair)
        if sentence:
            yield sentence, pair.is_refused
    sentence = _compare_commands(available, grid)
    if sentence:
        yield sentence, True


def interpolate(grid: np.ndarray, ts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (k, m) at the times of a grid, linear between their own times."""
    return np.stack([np.interp(grid, ts, column) for column in values.T], axis=1)


def _integrate(grid: np.ndarray, ts: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Integral of values (k, m) from the first of them to the times of a grid."""
    areas = 0.5 * np.diff(ts)[:, None] * (values[1:] + values[:-1])
    return interpolate(grid, ts, np.cumsum(np.insert(areas, 0, 0.0, axis=0), axis=0))


def _list_pairs(channels: Mapping[str, Any], grid: np.ndarray) -> Iterator[_Pair]:
    """Pairs of channels; an identification uses the gyroscope, but neither attitude, position nor velocity."""
    curves = lambda name: interpolate(grid, channels[name].ts, channels[name].values)
    integral = lambda name: _integrate(grid, channels[name].ts, channels[name].values)
    attitude = channels.get("attitude")
    # quaternions without a length, which the log's check refuses, are no rotations
    turns = None
    if attitude is not None and np.all(np.any(attitude.values != 0, axis=1)):
        turns = Rotation.from_quat(attitude.values, scalar_first=True)
    if attitude is not None and turns is not None and "gyroscope" in channels:
        # The sum of small turns in body axes is the integral of the rates: a wrong factor stays one, however large.
        steps = np.zeros((len(attitude.ts), 3))
        steps[1:] = (turns[:-1].inv() * turns[1:]).as_rotvec()
        angles = interpolate(grid, attitude.ts, np.cumsum(steps, axis=0))
        yield _Pair("attitude", "gyroscope", (angles, integral("gyroscope")), 0.05, "rad/s", True)
    if "position" in channels and "velocity" in channels:
        pair = (curves("position"), integral("velocity"))
        yield _Pair("position", "velocity", pair, 0.1, "m", False)
    if attitude is not None and turns is not None and "accelerometer" in channels:
        force = channels["accelerometer"]
        nearest = np.clip(np.searchsorted(attitude.ts, force.ts), 0, len(attitude.ts) - 1)
        # changes are compared less their median, to which gravity adds
        speed = _integrate(grid, force.ts, turns[nearest].apply(force.values))
        if "velocity" in channels:
            pair = (curves("velocity"), speed)
            yield _Pair("velocity", "accelerometer", pair, 0.3, "m/s^2", False)
        elif "position" in channels:
            # Mean speeds over a stretch: the noise of a position would hide those between two samples.
            n, place = round(_CHANGE / _STEP), curves("position")
            sums = np.cumsum(speed, axis=0)
            pair = ((place[n:] - place[:-n]) / _CHANGE, (sums[n:] - sums[:-n]) / n)
            yield _Pair("position", "accelerometer", pair, 1.0, "m", False)


def _compare_curves(pair: _Pair) -> str:
    """Sentence on how changes of two curves contradict each other; empty where they do not."""
    n = round(_CHANGE / _STEP)
    y, x = (curve[n:] - curve[:-n] for curve in pair.curves)
    y, x = y - np.median(y, axis=0), x - np.median(x, axis=0)
    # Resets of an estimator are rare and large. Their rows become zeros, which keeps the times of the others.
    inner = np.all(np.abs(y) <= np.percentile(np.abs(y), 99, axis=0), axis=1)[:, None]
    y, x = y * inner, x * inner
    sizes = np.sqrt([np.mean(y**2, axis=0), np.mean(x**2, axis=0)])
    active = np.flatnonzero((sizes[0] > pair.least) & (sizes[1] > pair.least / 100))
    active = active if len(active) else np.flatnonzero(np.max(sizes, axis=0) > pair.least)
    if not len(active) or np.any(sizes == 0):
        return ""
    alike = (y.T @ x) / len(y) / np.outer(*sizes)
    diagonal = np.diag(alike)[active]
    names = ", ".join(XYZ[k] for k in active)
    change = {"attitude": "turns", "position": "moves", "velocity": "changes"}[pair.first]
    side = "about" if pair.first == "attitude" else "along"
    fault = lambda sentence: f"The {pair.first} {change} {side} {names} {sentence}"
    if np.any(diagonal < _ALIKE):
        order, best = max(
            ((order, np.abs(alike[active, np.array(order)[active]])) for order in permutations(range(3))),
            key=lambda match: np.sum(match[1]),
        )  # fmt: skip
        if np.sum(best) - np.sum(diagonal) > _BETTER * len(active) and np.min(best) > _ALIKE:
            sign = lambda k: "-" if alike[k, order[k]] < 0 else ""
            signed = ", ".join(f"{sign(k)}{XYZ[order[k]]}" for k in active)
            return fault(
                f"as the {pair.second} measures {signed}: the order or the signs of one's columns, or their axes, "
                "are others."
            )
    # Heading and height are the worst of an estimator's: where both others agree, they are right.
    clear = (active < 2) & (np.min(sizes, axis=0)[active] > pair.least)
    if np.any(diagonal[clear] < _UNLIKE):
        shift = _find_shift(y[:, active], x[:, active])
        if shift is not None:
            return fault(
                f"{abs(shift):.1f} s {'after' if shift > 0 else 'before'} the {pair.second} measures it: one clock "
                "for both would be valid."
            )
        return fault(
            f"not as the {pair.second} measures (correlation {np.min(diagonal[clear]):.2f}; {_ALIKE:g} would be "
            "valid): unit, order or signs of one's columns are wrong."
        )
    factor = np.mean(y[:, active] * x[:, active], axis=0) / np.mean(x[:, active] ** 2, axis=0)
    wrong = (diagonal > _ALIKE) & ((factor < _FACTORS[0]) | (factor > _FACTORS[1]))
    if not np.any(wrong):
        return ""
    names = ", ".join(XYZ[k] for k in active[wrong])
    typical = float(np.median(factor[wrong]))
    fits = lambda size: min(abs(typical / size - 1), abs(typical * size - 1)) < _CLOSE
    hints = [name for name, size in UNITS[pair.unit].items() if size != 1 and fits(size)]
    hint = f", as if one were in {hints[0]}" if hints else ""
    return fault(
        f"{typical:.3g} times as much as the {pair.second} measures{hint}; {_FACTORS[0]:g} to {_FACTORS[1]:g} would be "
        "valid: the unit or the scale of one of the two is wrong."
    )


def _find_shift(y: np.ndarray, x: np.ndarray) -> float | None:
    """Time [s] by which y follows x where they are alike only then."""
    limit = min(round(_LONGEST_SHIFT / _STEP), len(y) // 2)
    both = np.zeros(2 * limit + 1)
    centre = len(y) - 1
    for a, b in zip(y.T, x.T, strict=True):
        whole = correlate(a, b, method="fft") / np.sqrt((a @ a) * (b @ b))
        # a shifted record overlaps by less than its length
        both += whole[centre - limit : centre + limit + 1] / y.shape[1]
    lags = np.arange(-limit, limit + 1)
    both *= len(y) / (len(y) - np.abs(lags))
    k = int(np.argmax(both))
    return float(lags[k] * _STEP) if both[k] > _ALIKE else None


def _compare_commands(channels: Mapping[str, Any], grid: np.ndarray) -> str:
    """Sentence on commands that the IMU feels at another time; empty where it feels them at theirs, or hardly."""
    motors = next((name for name in ("motor_commands", "rotor_speeds") if name in channels), None)
    if motors is None or not {"accelerometer", "gyroscope"} <= set(channels):
        return ""
    steps = lambda name: np.diff(
        _integrate(grid, channels[name].ts, channels[name].values), axis=0
    ) / _STEP  # fmt: skip
    u, force, rates = steps(motors), steps("accelerometer"), steps("gyroscope")
    y = np.column_stack([force[:, 2], np.gradient(rates, axis=0)])
    n = round(_SLOW / _STEP)
    slow = lambda x: np.stack([np.convolve(c, np.ones(n) / n, mode="same") for c in x.T], axis=1)
    u, y = ((x - slow(x))[n:-n] for x in (u, y))
    limit = min(round(_LONGEST_SHIFT / _STEP), len(u) // 2)
    if not len(u) or np.any(np.std(u, axis=0) == 0) or np.any(np.std(y, axis=0) == 0):
        return ""
    lags, centre = np.arange(-limit, limit + 1), len(u) - 1
    overlap = len(u) / (len(u) - np.abs(lags))
    inverse = np.linalg.pinv(u.T @ u / len(u), rcond=1e-6, hermitian=True)
    explained = []
    for column in (y / np.std(y, axis=0)).T:
        c = np.array([correlate(column, x, method="fft")[centre + lags] for x in u.T]) / len(u)
        explained.append(np.einsum("il,ij,jl->l", c, inverse, c) * overlap**2)
    share = np.max(explained, axis=0)
    times = lags * _STEP
    in_time = (times >= _NO_SHIFT[0]) & (times <= _NO_SHIFT[1])
    k = int(np.argmax(np.where(in_time, 0.0, share)))
    if not share[k] > max(_EXPLAINED, _MORE * np.max(share[in_time])):
        return ""
    return (
        f"The IMU feels {motors} {abs(times[k]):.1f} s {'after' if times[k] > 0 else 'before'} their time stamps; "
        f"within {_NO_SHIFT[1]:g} s after them would be valid: are their clocks others?"
    )
