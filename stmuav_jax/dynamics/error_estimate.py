"""Estimate of a run's global error by a second, more accurate run beside it.

The global error of a method with local extrapolation is proportional to its tolerance: a run at a
tenth of the tolerances has about a tenth of the error e of the first run, and the two differ by
0.9 e. If a saved time, not the tolerance, ends a step, the second run takes that interval in two
steps instead. Both runs use one compiled program.

Source: Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4 (global error
proportional to the tolerance).
"""

import dataclasses
from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ..algebra.rotation import from_rotation_vector, product
from ..checks.numbers import floats
from ..mechanics.state import State
from .integration.advance import Trajectory
from .integration.march import March, same_result
from .integration.problem import Problem

# Below the first tolerance round-off leaves no room for a tenth of it, below the second for any
# less.
_SHARP, _SHARPEST = 1e-12, 3e-14

# Factor on tolerances of the size of round-off. Round-off makes the two runs differ by some 1.4
# errors, proportionality by 2; a difference of 1.5 errors is assumed.
ROUND_OFF = 3.0

# Factor on the tolerances of the second run if smaller tolerances cannot be met.
LOOSER = 10.0

# No tolerance is reduced below this number; one that is smaller already stays unchanged.
_SMALLEST = 1e-14

# Relative error of the distance travelled, or error of an angle [rad], beyond which a motion is
# undetermined.
LOST = 0.01

# Logarithm of the error growth over the later half of a run from which the growth counts as
# exponential: e^3 is 20, while an error that grows as t^4 gives 16.
_EXPONENTIAL = 3.0


@dataclass(frozen=True)
class ErrorEstimate:
    """Estimated distance of every body's computed motion from the exact one, at the saved times.

    Entries without an estimate are NaN. Errors of the model or its parameters are not included.

    Attributes:
        position: error of the centres of mass (k, n) [m].
        angle: angle between computed and exact orientation (k, n) [rad].
        velocity: error (k, n) [m/s]. angular_velocity: error (k, n) [rad/s].
        e_folding_time: time in which errors grow by the factor e [s], if they grow exponentially over
            the later half of the determined motion; else None.
        predictability_horizon: first saved time at which a position is known to no better than 1 %
            of the largest distance travelled, or an orientation to 0.01 rad [s]; else None.
        note: reason why estimates are missing at some times; empty if none is missing.
    """

    position: Float[np.ndarray, "k n"]
    angle: Float[np.ndarray, "k n"]
    velocity: Float[np.ndarray, "k n"]
    angular_velocity: Float[np.ndarray, "k n"]
    e_folding_time: float | None = None
    predictability_horizon: float | None = None
    note: str = ""

    @property
    def reached(self) -> int:
        """Number of saved times with an estimate, counted from the first."""
        return int(np.sum(np.isfinite(self.position[:, 0])))

    def words(self, ts: Float[np.ndarray, " k"]) -> str:
        """Notable facts about the errors besides their size, as text; empty if there are none."""
        found = []
        if self.e_folding_time is not None:
            found.append(f"Errors grow e-fold every {self.e_folding_time:.2g} s.")
        if self.predictability_horizon is not None:
            k = int(np.searchsorted(ts, self.predictability_horizon))
            position, angle = (np.max(x[k]) for x in (self.position, self.angle))
            found.append(
                f"From t = {self.predictability_horizon:.4g} s on the positions are known to no better than "
                f"{position:.1g} m and the orientations to no better than {angle:.1g} rad."
            )
        return " ".join([*found, *([self.note] if self.note else [])])


class SecondRun:
    """Second run, at other tolerances beside the first run.

    Args:
        problem: problem of the first run. t0: initial time [s]. state0: state at t0.
        factor: factor on the tolerances; by default that of `usual`. A factor above one serves
            problems that cannot meet smaller tolerances: the estimate is cheaper, but rarely
            within a factor of three (benchmarks/errors.py).
    """

    def __init__(
        self, problem: Problem, t0: float, state0: State, *, factor: float | None = None
    ) -> None:
        self.first = problem
        factor = usual(problem) if factor is None else factor
        self.difference = 1.5 if factor == ROUND_OFF else abs(1 - factor)
        smaller = lambda x: floats(max(float(x) * factor, min(float(x), _SMALLEST)))
        method = problem.method
        changes: dict[str, Any] = {"rtol": smaller(method.rtol), "atol": smaller(method.atol)}
        # a run with a bounded step length becomes more accurate by halving the bound
        longest: Any = getattr(method, "max_step", None)
        if eqx.is_array(longest):
            changes["max_step"] = floats(float(longest) / 2)
        method = dataclasses.replace(method, **changes)
        self.march = March(dataclasses.replace(problem, method=method), t0, state0)
        self.last = (t0, 0)
        self.saved: list[np.ndarray] = []

    def follow(self, part: Trajectory) -> None:
        """Continue to the times of the first run, by way of the middles of its single steps."""
        before, steps = self.last
        ts, taken = np.asarray(part.ts), np.asarray(part.counts.accepted)
        fresh = np.append(not self.saved or ts[0] > before, np.diff(ts) > 0)
        if not np.any(fresh) or not self.march.going:
            return
        times, counts = ts[fresh], taken[fresh]
        starts = np.append(before, times[:-1])
        single = (np.diff(counts, prepend=steps) <= 1) & (times > starts)
        middles = 0.5 * (starts + times)[single]
        order = np.argsort(np.append(times, middles), kind="stable")
        self.march.to(np.append(times, middles)[order])
        self.last = (float(times[-1]), int(counts[-1]))
        self.saved.append(order < len(times))

    def at_saved(self) -> tuple[np.ndarray, State]:
        """Saved times that the second run reached (m,), and its states there (m, n, .)."""
        pick = [saved[: len(p.ts)] for saved, p in zip(self.saved, self.march.parts, strict=False)]
        parts = [
            jax.tree.map(lambda x, s=s: np.asarray(x)[s], (p.ts, p.states))
            for s, p in zip(pick, self.march.parts, strict=False)
        ]
        return jax.tree.map(lambda *x: np.concatenate(x), *parts)


def usual(problem: Problem) -> float:
    """Factor on the tolerances that these allow, if they can be met."""
    tolerance = max(float(problem.method.rtol), float(problem.method.atol))
    if tolerance >= _SHARP:
        return 0.1
    return 1 / 3 if tolerance >= _SHARPEST else ROUND_OFF


def estimated(
    first: Trajectory, second: SecondRun, rates: tuple[np.ndarray, np.ndarray] | None, why: str = ""
) -> ErrorEstimate:
    """Estimate the first run's error from the second run.

    Args:
        rates: accelerations of the first run's last state, (n, 3) each, if they are known.
        why: reason why the second run has not reached the end.
    """
    times = np.asarray(first.ts)
    k, n = len(times), first.states.r.shape[1]
    ts, states = second.at_saved() if second.saved else (np.zeros(0), None)
    m = min(len(ts), k)
    same = ts[:m] == times[:m]
    m = m if np.all(same) else int(np.argmin(same))
    parts = np.full((4, k, n), np.nan)
    if m:
        parts[:, :m] = _apart(_rows(first.states, slice(m)), _rows(states, slice(m)))
    happened = same_result(first.result, diffrax.RESULTS.event_occurred)
    if 0 < m == k - 1 < len(ts) and happened:
        # the second run has found the event at a slightly different time
        later = times[m] - ts[m]
        if abs(later) <= 1e-3 * (times[m] - times[m - 1]):
            moved = _moved_on(_rows(states, slice(m, k)), later, rates)
            parts[:, m:] = _apart(_rows(first.states, slice(m, k)), moved)
            m = k
    parts = parts / second.difference
    note = "" if m == k else _note(times, m, why)
    folding, lost = (
        _growth(times, np.asarray(first.states.r), parts[0], parts[1]) if m > 1 else (None, None)
    )
    return ErrorEstimate(parts[0], parts[1], parts[2], parts[3], folding, lost, note)


def without(first: Trajectory, why: str) -> ErrorEstimate:
    """Estimate without a number at any time, with the reason `why`."""
    none = np.full((4, len(first.ts), first.states.r.shape[1]), np.nan)
    return ErrorEstimate(
        none[0], none[1], none[2], none[3], note=_note(np.asarray(first.ts), 0, why)
    )


def _note(ts: np.ndarray, m: int, why: str) -> str:
    if m == 0:
        return f"There is no error estimate: {why or 'the second run did not start'}."
    return (
        f"There is no error estimate after t = {ts[m - 1]:.9g} s: "
        f"{why or 'the second run stopped there'}."
    )


def _rows(states: Any, rows: slice) -> State:
    return jax.tree.map(lambda x: np.asarray(x)[rows], states)


def _apart(a: State, b: State) -> np.ndarray:
    """Distances of positions, orientations [rad], velocities, angular velocities (4, k, n)."""
    distance = lambda x, y: np.sqrt(np.sum((x - y) ** 2, axis=-1))
    p, q = np.asarray(a.p), np.asarray(b.p)
    turned = p[..., :1] * q[..., 1:] - q[..., :1] * p[..., 1:] - np.cross(p[..., 1:], q[..., 1:])
    angle = 2 * np.arctan2(np.linalg.norm(turned, axis=-1), np.abs(np.sum(p * q, axis=-1)))
    return np.stack([distance(a.r, b.r), angle, distance(a.v, b.v), distance(a.omega, b.omega)])


def _moved_on(states: State, later: float, rates: tuple[np.ndarray, np.ndarray] | None) -> State:
    """States (1, n, .) a short time later; velocities are NaN without accelerations."""
    v_rate, omega_rate = rates if rates is not None else (np.nan, np.nan)
    turn = jax.vmap(jax.vmap(lambda p, w: product(p, from_rotation_vector(w))))
    p = np.asarray(turn(jnp.asarray(states.p), jnp.asarray(states.omega * later)))
    v, omega = states.v + v_rate * later, states.omega + omega_rate * later
    r = states.r + states.v * later
    return State(*(jnp.asarray(x) for x in (r, p, v, omega)))


def _growth(
    ts: Float[np.ndarray, " k"],
    r: Float[np.ndarray, "k n 3"],
    position: Float[np.ndarray, "k n"],
    angle: Float[np.ndarray, "k n"],
) -> tuple[float | None, float | None]:
    """E-folding time of the errors, and the time from which the motion is not determined."""
    travelled = np.nanmax(np.linalg.norm(r - r[:1], axis=-1))
    floor = 1e-12 * (1 + np.nanmax(np.abs(r)))
    position = np.where(position > floor, position, 0.0)
    share = position / travelled if travelled > floor else np.zeros_like(position)
    error = np.maximum.accumulate(np.nan_to_num(np.max(np.maximum(share, angle), axis=1)))
    lost = np.flatnonzero(error > LOST)
    end = ts[lost[0]] if lost.size else ts[np.flatnonzero(np.isfinite(angle[:, 0]))[-1]]
    later = (ts >= 0.5 * (ts[0] + end)) & (ts <= end) & (error > 1e-15)
    folding = None
    if np.sum(later) >= 4:
        slope = np.polyfit(ts[later], np.log(error[later]), 1)[0]
        if slope * np.ptp(ts[later]) >= _EXPONENTIAL:
            folding = float(1 / slope)
    return folding, float(ts[lost[0]]) if lost.size else None
