"""Consistency of a filter's stated errors: NEES, NIS, their intervals, and a verdict on a record.

    NEES = e^T P^-1 e, e the error of the state;    NIS = nu^T S^-1 nu, nu the innovation

Over N independent runs, N times the mean NEES is chi-squared with N n degrees of freedom. A
consistent filter has scaled innovations z_k = S_k^-1/2 nu_k that are independent and of unit
covariance. Eleven tests look for deviations from this in the settled part of a record and,
separately, at its start:

    start       first innovation of each component, the next seven steps, and the rest of the start:
                fit of the prior
    size        NIS of the settled part, two-sided
    sliding     NIS of windows that overlap by half, two-sided: sizes that change
    memory      correlation at six lags, within and between components (Box and Pierce's sum)
    drift       squares of means over blocks of 5 steps: slow correlation
    slow drift  squares of means over windows: slower correlation
    trend       squares of the four slowest cosines over the settled part
    bias        squares of the components' means
    inputs      correlation with the inputs u: a wrong gain of the model
    prediction  correlation with the predicted readings: a wrong rate or scale of the model
    outliers    largest innovation relative to the size of the others

All but the start and the sizes compare innovations with their own root mean square, so that a wrong R
alone does not trigger them. Inputs and predictions count from the mean of their earlier values, since
later ones depend on the innovations (Dickey and Fuller's effect). The p-values are combined by
Bonferroni's inequality. Unless a time is given, the settled part begins with the first window whose NIS
is within its 99.9 % interval or beyond it on the other side, but after the first innovation of each
component. Errors that no innovation shows, as a small constant bias of a gyroscope, are not detected.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with applications to tracking and
navigation (2001), ch. 5.4; G. E. P. Box, D. A. Pierce, JASA 65 (1970); D. A. Dickey, W. A. Fuller,
JASA 74 (1979); B. S. So, D. W. Shin, Statistics and Probability Letters 43 (1999).
"""

from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import SettingError
from ..math.space import AbstractSpace, Point
from .filter import Filtered
from .gaussians import divide_lower, has_contradiction, triangularise_rows

Status = Literal["consistent", "inconsistent", "undecided", "failed"]

TESTS = (
    "start", "size", "sliding", "memory", "drift", "slow drift", "trend", "bias", "inputs",
    "prediction", "outliers",
)  # fmt: skip
_LAGS = (1, 2, 3, 5, 8, 13)
# Steps of a short block (a long one is a window), steps after which the start's second part ends, and
# the number of cosines.
_SHORT, _EARLY, _COSINES = 5, 8, 4
# Measured numbers of the settled part below which the verdict is "undecided", and those that a
# regression needs for each of its columns.
_FEWEST, _PER_COLUMN = 30, 10
# Two-sided p-value above which a window counts as settled, and kurtosis above which only a few
# innovations are large (3 for Gaussian numbers).
_WITHIN, _HEAVY = 1e-3, 8.0


# --- NEES, NIS and their intervals


def nees(
    mean: Point, factor: Float[Array, "n n *s"], truth: Point, space: AbstractSpace, *,
    only: slice | None = None,
) -> Float[Array, "*s"]:  # fmt: skip
    """Normalised estimation error squared, chi-squared with n degrees if the filter is consistent.

    A component that is known exactly contributes zero if it is correct, and infinity otherwise.

    Args:
        only: consecutive components of the error, with their marginal covariance; None for all.
    """
    error = space.difference(truth, mean)
    if only is not None:
        error = error[only]
        factor = triangularise_rows(jnp.swapaxes(factor[only], 0, 1))
    scaled = divide_lower(factor, error[:, None])[:, 0]
    leaves = [leaf for leaf in jax.tree.leaves((mean, truth)) if leaf.shape[0]]
    size = jnp.max(jnp.stack([jnp.max(jnp.abs(leaf), axis=0) for leaf in leaves]), axis=0)
    wrong = has_contradiction(factor, error, scaled, size)
    return jnp.where(wrong, jnp.inf, jnp.sum(scaled**2, axis=0))


def path_nees(filtered: Any, truth: Point, space: AbstractSpace) -> Float[Array, "T *s"]:
    """NEES at each time of a `Filtered` or `Smoothed` path or bank; `truth` has T first.

    It is infinite where the filter has failed, as the NIS is.
    """
    # times become one more axis of the stack
    last = lambda leaf: jnp.moveaxis(leaf, 0, -1)
    mean, true = (jax.tree.map(last, a) for a in (filtered.mean, truth))
    nees_values = nees(mean, last(filtered.factor), true, space)
    return jnp.where(filtered.ok, jnp.moveaxis(nees_values, -1, 0), jnp.inf)


def mean_interval(
    degrees: int | float, count: int = 1, level: float = 0.999
) -> tuple[float, float]:
    """Two-sided interval in which the mean of independent chi-squared variables lies with probability `level`.

    Args:
        degrees: degrees of freedom of each variable: n for NEES, m for NIS. count: number of variables.
    """
    from scipy import stats

    if not 0 < level < 1 or degrees * count <= 0:
        raise SettingError(
            f"The level must lie in (0, 1) and the degrees of freedom above 0, but they are {level} and "
            f"{degrees * count}."
        )
    # Sums of independent chi-squared variables are chi-squared with the sum of the degrees, so that the
    # interval of a mean is exact for any number of runs.
    low, high = stats.chi2.interval(level, degrees * count)
    return float(low) / count, float(high) / count


def autocorrelation(scaled: Float[Array, "T m *s"], lag: int) -> Float[Array, "*s"]:
    """Autocorrelation of scaled innovations, the mean of nu_k . nu_(k + lag) / m.

    For white innovations the mean is zero and the standard deviation 1 / sqrt(m T).

    Raises:
        SettingError: `lag` is outside 1 to T - 1.
    """
    if not 0 < lag < scaled.shape[0]:
        raise SettingError(f"The lag must be in 1 to {scaled.shape[0] - 1}, not {lag}.")
    return jnp.mean(scaled[:-lag] * scaled[lag:], axis=(0, 1))


def inconsistent(filtered: Filtered, *, window: int = 50, level: float = 0.999) -> np.ndarray:
    """Flags (T, *s) of times at which the NIS of the last `window` steps is larger than by chance.

    The flag is True also from a failure on. Each time is tested by itself at a level of
    (1 - `level`) / 2. A filter with too large an R lags without a flag, because its innovations are
    small and correlated; `verdict` tests both sides and the correlation, at a stated level.

    Raises:
        SettingError: a window of less than one step, or a level outside (0, 1).
    """
    from scipy import stats

    if window < 1 or not 0 < level < 1:
        raise SettingError(
            f"The window must be at least 1 step and the level in (0, 1), but they are {window} and {level}."
        )
    nis = np.asarray(filtered.nis)
    count = np.sum(np.asarray(filtered.innovations.measured), axis=1)
    count = np.broadcast_to(count, nis.shape)
    # sums of the last entries: differences of running sums would not outlive an infinite one
    parts = [slice(max(k - window + 1, 0), k + 1) for k in range(len(nis))]
    latest = lambda a: np.stack([np.sum(a[part], axis=0) for part in parts])
    total, degrees = latest(nis), latest(count)
    limit = stats.chi2.ppf((1 + level) / 2, np.maximum(degrees, 1))
    return (degrees > 0) & ~(total <= limit)


# --- verdicts


class Verdict(NamedTuple):
    """Verdict of the tests on the innovations of one record.

    Attributes:
        status: "consistent", "inconsistent", "undecided" (too few measurements), or "failed".
        level: probability with which a consistent filter is called inconsistent.
        p_value: smallest p-value of the tests, times their number.
        p_values: p-value of every test by its name.
        settling_time: time from which the record counts as settled [s].
        inconsistent_since: end of the first window outside of its interval [s], NaN without one.
        fraction_high, fraction_low: fractions of windows whose NIS is too large or too small.
        initial_nis, settled_nis: mean NIS per measured component of the start and of the settled
            part, with an expected value of one.
        autocorrelation: mean correlation with the next innovation, with an expected value of zero.
        missing: fraction of measurements that are missing.
        explanation: sentences on the findings and their usual causes.
    """

    status: Status
    level: float
    p_value: float
    p_values: dict[str, float]
    settling_time: float
    inconsistent_since: float
    fraction_high: float
    fraction_low: float
    initial_nis: float
    settled_nis: float
    autocorrelation: float
    missing: float
    explanation: str

    @property
    def significant_tests(self) -> tuple[str, ...]:
        """Names of the tests that were significant."""
        limit = self.level / len(TESTS)
        return tuple(name for name, p in self.p_values.items() if p < limit)


class RunsVerdict(NamedTuple):
    """Verdict over independent runs with the same filter.

    Attributes:
        status: "inconsistent" if more runs are so than chance allows at the level of one run,
            "failed" if a run lost its covariance, "undecided" if all runs are undecided.
        runs, flagged, failed: numbers of all runs, of inconsistent and of failed ones.
        significant_tests: names of the tests that were significant in at least half of the flagged runs.
        explanation: sentences on all runs and on a typical one.
    """

    status: Status
    runs: int
    flagged: int
    failed: int
    significant_tests: tuple[str, ...]
    explanation: str

    @property
    def short(self) -> str:
        """Summary of the verdict in one line."""
        if self.failed:
            return f"{self.status}: {self.failed} of {self.runs} runs lost their covariance"
        tests = f" ({', '.join(self.significant_tests)})" if self.flagged else ""
        return f"{self.status}: {self.flagged} of {self.runs} runs are inconsistent{tests}"


def over_runs(verdicts: tuple[Verdict, ...]) -> RunsVerdict:
    """Combine the verdicts of independent runs into one."""
    from scipy import stats

    flagged = [v for v in verdicts if v.status == "inconsistent"]
    failed, level = sum(v.status == "failed" for v in verdicts), verdicts[0].level
    status: Status = "consistent"
    if failed:
        status = "failed"
    elif all(v.status == "undecided" for v in verdicts):
        status = "undecided"
    # Some runs of a correct filter are rejected by chance: the number of rejections is compared with its
    # binomial distribution.
    elif stats.binom.sf(len(flagged) - 1, len(verdicts), level) <= level * (1 + 1e-9):
        status = "inconsistent"
    hits = {name: sum(name in v.significant_tests for v in flagged) for name in TESTS}
    significant = tuple(n for n in TESTS if 2 * hits[n] >= max(len(flagged), 1))
    # the run with the median p-value is the typical one of its status
    alike = sorted((v for v in verdicts if v.status == status), key=lambda v: v.p_value)
    typical = alike[len(alike) // 2] if alike else verdicts[0]
    sentences = (
        f"{len(flagged)} of {len(verdicts)} runs are inconsistent, {level:.0%} are expected by "
        f"chance. A typical run: {typical.explanation}"
    )
    return RunsVerdict(status, len(verdicts), len(flagged), failed, significant, sentences)


def verdict(filtered: Filtered, **options: Any) -> Verdict:
    """Verdict on one record and its filter.

    Args:
        filtered: result of `kalman_filter` for a single filter.
        options: `settle`, `level`, `window`, `names` of `judge_innovations`.

    Raises:
        SettingError: `filtered` is a bank (use `verdicts`), or a level, window or time cannot be
            used.
    """
    if np.ndim(filtered.ok) != 1:
        raise SettingError("verdict takes one record; use verdicts for a bank of filters.")
    as_bank = lambda tree: jax.tree.map(lambda a: np.asarray(a)[..., None], tree)
    innovations, ok = as_bank((filtered.innovations, filtered.ok))
    return judge_innovations(
        innovations.normalised, innovations.measured, ok, filtered.dt, inputs=filtered.u,
        predicted=innovations.predicted, **options,
    )[0]  # fmt: skip


def verdicts(filtered: Filtered, **options: Any) -> tuple[Verdict, ...]:
    """Verdicts on the filters of a bank, with the options of `verdict`."""
    innovations = filtered.innovations
    return judge_innovations(
        innovations.normalised, innovations.measured, filtered.ok, filtered.dt, inputs=filtered.u,
        predicted=innovations.predicted, **options,
    )  # fmt: skip


def judge_innovations(
    normalised: Any, measured: Any, ok: Any, dt: Any, *, inputs: Any = None, predicted: Any = None,
    settle: float | None = None, level: float = 0.01, window: int = 50, names: tuple[str, ...] = (),
) -> tuple[Verdict, ...]:  # fmt: skip
    """Verdicts from innovations alone.

    Args:
        normalised, measured: normalised innovations, and True for those not missing (T, m, s).
        ok: False from the step at which a filter failed (T, s).
        dt: lengths of the steps (T,) [s].
        inputs: inputs of the filter, a pytree of arrays (T, k) or (T, k, s); None without any.
        predicted: predicted readings (T, k, s); None leaves their test out.
        settle: time from the start after which the record counts as settled [s]; by default found
            from the NIS (see the module).
        level: family-wise probability of a false alarm.
        window: number of steps of the sliding NIS.
        names: names of the measured components, for the words.

    Raises:
        SettingError: a level, window or time cannot be used.
    """
    if not 0 < level < 1 or window < 2:
        raise SettingError(
            f"A verdict needs a level in (0, 1) and a window of at least 2 steps, not {level} and "
            f"{window}."
        )
    t = np.cumsum(np.broadcast_to(np.asarray(dt, dtype=float), np.shape(normalised)[:1]))
    if settle is not None and not 0 <= settle < t[-1]:
        raise SettingError(
            f"The settling time must lie between 0 and the end at {t[-1]:g} s, not {settle:g} s."
        )
    measured, ok = np.asarray(measured, dtype=bool), np.asarray(ok)
    # Innovations scaled by their covariance are independent standard normal numbers for a correct filter:
    # all tests below are tests of that.
    z = np.where(measured & ok[:, None], np.asarray(normalised, dtype=float), 0.0)
    # shorter windows in short records, so that there are at least eight
    window = max(2, min(window, len(z) // 8))
    begin, never = _find_settled_step(z, measured, window)
    if settle is not None:
        begin = np.full(z.shape[2], np.sum(t <= settle * (1 + 1e-9)))
        never = np.zeros_like(never)
    steps = np.arange(len(z))[:, None]
    # without a transient the first window is the start
    start_end = np.maximum(begin, window if settle is None else 0)
    # The first innovation of each component is the only one that sees the prior alone.
    initial = measured & (np.cumsum(measured, axis=0) == 1)
    settled_mask = measured & ~initial & (steps >= begin)[:, None]
    of = _test_start(z, measured & (steps < start_end)[:, None], initial)
    of |= _test_settled(z, settled_mask, window, level, inputs, predicted)
    k = of["since step"]
    of |= {
        "never": never,
        "missing": 1 - np.mean(measured, axis=(0, 1)),
        "settled": np.where(begin > 0, t[np.maximum(begin, 1) - 1], 0.0),
        "since": np.where(k >= 0, t[np.minimum(k, len(t) - 1)], np.nan),
        "fails": np.where(ok[-1], np.nan, t[np.argmin(ok, axis=0)]),
        "first": np.where(start_end > 0, t[np.maximum(start_end, 1) - 1], 0.0),
    }
    runs = ({key: value[..., i] for key, value in of.items()} for i in range(z.shape[2]))
    return tuple(_decide_verdict(run, level, names) for run in runs)


def _p_values(total: Any, degrees: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lower, upper and two-sided p-values of chi-squared sums; one without degrees of freedom."""
    from scipy import stats

    some, degrees = degrees > 0, np.maximum(degrees, 1)
    below, above = (np.where(some, f(total, degrees), 1.0) for f in (stats.chi2.cdf, stats.chi2.sf))
    return below, above, np.minimum(1.0, 2 * np.minimum(below, above))


def _find_settled_step(
    z: np.ndarray, measured: np.ndarray, window: int
) -> tuple[np.ndarray, np.ndarray]:
    """Step (s,) at which the first window begins whose NIS is in its interval or beyond it.

    Beyond it means on another side than the first window. The step is zero if there is no such
    window in the first half of the record; the second result is then True.
    """
    count = len(z) // window // 2
    if not count:
        return np.zeros(z.shape[2], dtype=int), np.zeros(z.shape[2], dtype=bool)
    cut = lambda a: a[: count * window].reshape(count, window * z.shape[1], -1)
    below, above, p = _p_values(np.sum(cut(z) ** 2, axis=1), np.sum(cut(measured), axis=1))
    # A transient ends where the NIS enters its interval or crosses it; a filter that is wrong for good
    # may cross without ever staying inside.
    side = np.where(p > _WITHIN, 0, np.where(above < below, 1, -1))
    over = (side == 0) | (side != side[0])
    some = np.asarray(np.any(over, axis=0))
    return np.where(some, np.argmax(over, axis=0) * window, 0), ~some


def _size_test(name: str, total: np.ndarray, degrees: np.ndarray) -> dict[str, Any]:
    """Two-sided test of a sum of squares, its mean square and degrees of freedom, by name."""
    p = _p_values(total, degrees)[2]
    return {f"p {name}": p, name: total / np.maximum(degrees, 1), f"{name} degrees": degrees}


def _test_largest(z: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Largest size (s,) of Gaussian numbers (T, m, s), its component, and its p-value."""
    from scipy import stats

    component_maxima = np.max(np.abs(z) * mask, axis=0)
    largest, n = np.max(component_maxima, axis=0), np.maximum(np.sum(mask, axis=(0, 1)), 1)
    # The p-value of a largest of n numbers is 1 - (1 - q)^n; log1p and expm1 keep its digits where q is
    # far below epsilon.
    beyond = np.minimum(2 * stats.norm.sf(largest), 1 - 1e-16)
    return largest, np.argmax(component_maxima, axis=0), -np.expm1(n * np.log1p(-beyond))


def _test_start(z: np.ndarray, start: np.ndarray, initial: np.ndarray) -> dict[str, Any]:
    """Statistics of the start by name; its parts, which are independent, are tested one by one.

    A wrong start shows in the first innovations alone, which a sum over all would drown.
    """
    of = _size_test("start", np.sum(z**2 * start, (0, 1)), np.sum(start, (0, 1)))
    largest, component, p = _test_largest(z, start & initial)
    # A wrong start decays within a few steps, which a sum over the whole first window would dilute.
    early = np.cumsum(np.any(start, axis=1), axis=0) <= _EARLY
    count = np.sum(start & initial, (0, 1))
    parts = [(np.where(count > 0, p, 1.0), count)]
    for mask in (early, ~early):
        part = start & ~initial & mask[:, None]
        degrees = np.sum(part, (0, 1))
        parts.append((_p_values(np.sum(z**2 * part, (0, 1)), degrees)[2], degrees))
    p_values, degrees = (np.stack(x) for x in zip(*parts, strict=True))
    # The parts are independent, so that Sidak's correction of their smallest p-value is exact.
    least = np.min(p_values, axis=0)
    p = -np.expm1(np.sum(degrees > 0, axis=0) * np.log1p(-np.minimum(least, 1 - 1e-16)))
    first = {"first is largest": p_values[0] <= least, "first size": largest}
    return of | first | {"p start": p, "first component": component}


def _test_settled(
    z: np.ndarray, settled_mask: np.ndarray, window: int, level: float, inputs: Any, predicted: Any
) -> dict[str, Any]:
    """Statistics of the settled part by name; `settled` is True for its innovations."""
    squares, count = np.sum(z**2 * settled_mask, axis=0), np.sum(settled_mask, axis=0)
    of = _size_test("size", np.sum(squares, axis=0), np.sum(count, axis=0))
    of |= _test_windows(z, settled_mask, window, level)
    of["sizes"] = squares / np.maximum(count, 1)
    # in units of the root mean square of each component
    rms = np.sqrt(of["sizes"])
    r = np.where(settled_mask, z / np.where(rms > 0, rms, 1.0), 0.0)
    of |= _test_memory(r, settled_mask)
    for name, length in (("drift", _SHORT), ("slow drift", window)):
        blocks = len(r) // length if len(r) >= 2 * length else 0
        cut = lambda a, b=blocks, n=length: (
            a[len(a) - b * n :].reshape(b, n, *a.shape[1:]).sum(axis=1)
        )
        block_counts = cut(settled_mask.astype(int))
        total = np.sum(cut(r) ** 2 / np.maximum(block_counts, 1), axis=(0, 1))
        of |= _size_test(name, total, np.sum(block_counts > 0, axis=(0, 1)))
    # The mean over the whole settled part is the test with the largest power against a constant bias.
    of["means"] = np.sum(r, axis=0) / np.sqrt(np.maximum(count, 1))
    of["p bias"] = _p_values(np.sum(of["means"] ** 2, axis=0), np.sum(count > 0, axis=0))[1]
    # Half-period cosines are orthogonal and span slow changes without a choice of their phase.
    harmonics = np.arange(1, _COSINES + 1)
    phases = lambda rows: np.pi * (np.arange(len(rows)) + 0.5) / max(len(rows), 1)
    cosines = lambda rows, run: np.cos(np.outer(phases(rows), harmonics))
    of["p trend"] = _test_regression(r, settled_mask, cosines)
    for name, tree in (("inputs", inputs), ("prediction", predicted)):
        of[f"p {name}"] = _test_regression(r, settled_mask, _centre_columns(tree))
    of["largest"], _, of["p outliers"] = _test_largest(r, settled_mask)
    n = np.maximum(np.sum(count, axis=0), 1)
    return of | {"kurtosis": np.sum(r**4, axis=(0, 1)) / n}


def _test_windows(
    z: np.ndarray, settled_mask: np.ndarray, window: int, level: float
) -> dict[str, Any]:
    """Smallest p-value of the windows times their number, and the windows outside on each side."""
    sums = lambda a: np.concatenate([np.zeros((1, a.shape[2])), np.cumsum(a.sum(axis=1), axis=0)])
    # Windows overlap by half, so that an event on the boundary of two is whole in a third; the correction
    # by their number is then conservative.
    begins = np.arange(0, max(len(z) - window, 0) + 1, max(window // 2, 1))
    ends = np.minimum(begins + window, len(z))
    total, degrees = (s[ends] - s[begins] for s in (sums(z**2 * settled_mask), sums(settled_mask)))
    below, above, p = _p_values(total, np.round(degrees).astype(int))
    used = degrees > 0
    count = np.maximum(np.sum(used, axis=0), 1)
    limit = level / len(TESTS) / count / 2
    high, low = used & (above < limit), used & (below < limit)
    out = high | low
    return {
        "p sliding": np.minimum(1.0, np.min(np.where(used, p, 1.0), axis=0) * count),
        "high": np.sum(high, axis=0) / count,
        "low": np.sum(low, axis=0) / count,
        "since step": np.where(out.any(axis=0), ends[np.argmax(out, axis=0)] - 1, -1),
    }


def _test_memory(r: np.ndarray, settled_mask: np.ndarray) -> dict[str, Any]:
    """Box and Pierce's sum over lags and pairs of components, and the correlation at lag one."""
    m, s = r.shape[1:]
    total, degrees, correlation = np.zeros(s), np.zeros(s, dtype=int), np.zeros(s)
    over_time = lambda a, lag: np.einsum("tis,tjs->ijs", a[:-lag], a[lag:])
    for lag in (lag for lag in _LAGS if lag <= len(r) // 4):
        pairs = over_time(settled_mask.astype(float), lag)
        # All pairs of components are correlated, not only each with itself: a lag in one state shows in the
        # reading of another.
        c = over_time(r, lag) / np.sqrt(np.maximum(pairs, 1))
        total, degrees = total + np.sum(c**2, (0, 1)), degrees + np.sum(pairs > 0, (0, 1))
        if lag == 1:
            correlation_matrices = c / np.sqrt(np.maximum(pairs, 1))
            correlation = np.einsum("iis->s", correlation_matrices) / m
    return {"p memory": _p_values(total, degrees)[1], "memory": correlation}


def _centre_columns(tree: Any) -> Callable[[np.ndarray, int], np.ndarray]:
    """Columns of known numbers (T, k) or (T, k, s), each from the mean of the earlier ones."""
    leaves = [np.asarray(leaf, float) for leaf in jax.tree.leaves(tree)]

    def centre_segment(rows: np.ndarray, run: int) -> np.ndarray:
        parts = [(c if c.ndim == 2 else c[..., run])[rows] for c in leaves]
        x = np.nan_to_num(np.concatenate([*parts, np.zeros((len(rows), 0))], axis=1))
        # Columns are centred by the mean of earlier rows only: innovations are independent of the past, but
        # not of later readings, and a mean over all rows would make the test reject correct filters.
        k = np.arange(len(x))[:, None]
        # the first from itself
        centred = x - np.where(k > 0, (np.cumsum(x, axis=0) - x) / np.maximum(k, 1), x)
        size, raw = (np.sqrt(np.sum(a**2, axis=0)) for a in (centred, x))
        varies = size > 1e-9 * raw
        return centred[:, varies] / size[varies]

    return centre_segment


def _test_regression(
    r: np.ndarray, settled_mask: np.ndarray, columns: Callable[[np.ndarray, int], np.ndarray]
) -> np.ndarray:
    """P-values (s,) of the sums of squares that columns explain.

    Args:
        columns: function of the numbers of the settled steps and of the run that returns (steps, k).
    """
    sums = []
    for run in range(r.shape[2]):
        rows = np.flatnonzero(np.any(settled_mask[..., run], axis=1))
        x, total, degrees = columns(rows, run), 0.0, 0
        for innovation, mask in zip(r[rows, :, run].T, settled_mask[rows, :, run].T, strict=True):
            if not x.shape[1] or np.sum(mask) < _PER_COLUMN * x.shape[1]:
                continue
            values, vectors = np.linalg.eigh(x[mask].T @ x[mask])
            used = values > 1e-10 * values[-1]
            projections = vectors.T @ (x[mask].T @ innovation[mask])
            total += float(np.sum(projections[used] ** 2 / values[used]))
            degrees += int(np.sum(used))
        sums.append((total, degrees))
    return _p_values(*np.array(sums).reshape(-1, 2).T)[1]


# --- words


def _decide_verdict(of: dict[str, Any], level: float, names: tuple[str, ...]) -> Verdict:
    """Verdict on one run by its statistics."""
    p_values = {name: float(of[f"p {name}"]) for name in TESTS}
    least = min(1.0, len(TESTS) * min(p_values.values()))
    status: Status = "inconsistent" if least < level else "consistent"
    if not np.isnan(of["fails"]):
        status = "failed"
    elif of["size degrees"] < _FEWEST:
        status = "undecided"
    significant = [name for name, p in p_values.items() if p < level / len(TESTS)]
    sentences = {
        "failed": f"Failed: the filter lost its covariance at {of['fails']:.4g} s.",
        "undecided": f"Undecided: the settled part has {int(of['size degrees'])} measured numbers, "
        f"and {_FEWEST} are needed.",
        "consistent": f"Consistent: after {of['settled']:.3g} s none of {len(TESTS)} tests at a "
        f"family-wise level of {level:g} rejects the filter; mean NIS {of['size']:.3g} of 1 "
        "per measured number.",
        "inconsistent": f"Inconsistent: {', '.join(significant)} (family-wise level {level:g}).",
    }[status]
    if of["missing"] > 0:
        sentences += f" {of['missing']:.0%} of the measurements are missing."
    if status == "consistent":
        sentences += " Innovations cannot show an error that the states absorb, such as a small constant bias."
    elif status == "inconsistent":
        name = lambda i: names[i] if i < len(names) else f"component {i}"
        sentences = " ".join([sentences, *_explain_findings(of, set(significant), name)])
    keys = ("settled", "since", "high", "low", "start", "size", "memory", "missing")
    return Verdict(status, level, least, p_values, *(float(of[key]) for key in keys), sentences)  # pyright: ignore[reportCallIssue]


def _explain_findings(
    of: dict[str, Any], significant: set[str], name: Callable[[int], str]
) -> list[str]:
    """Sentences on the findings in an inconsistent record, and on their usual causes."""
    wrong_size = bool(significant & {"size", "sliding"})
    lines = []
    # a start that is like the rest is no sign of a wrong prior
    if "start" in significant and not (wrong_size and 0.5 < of["start"] / of["size"] < 2):
        width, place = ("wide", "nearer to") if of["start"] < 1 else ("narrow", "further from")
        lines.append(
            f"The first innovation of {name(int(of['first component']))} is {of['first size']:.3g} "
            "of its stated deviations: the prior is too narrow, the start is further from the truth "
            "than it says."
            if of["first is largest"]
            else f"In the first {of['first']:.3g} s the NIS is {of['start']:.3g} per measured number where 1 is "
            f"expected: the prior is too {width}, the start is {place} the truth than it says."
        )
    later = significant - {"start"}
    if not later:
        return [*lines, f"From {of['settled']:.3g} s on no test rejects the filter."]
    part = (
        "No window of the first half has the NIS that is expected, so that the whole record is judged"
        if of["never"]
        else f"In the settled part, from {of['settled']:.3g} s on"
    )
    size = f"the NIS is as expected ({of['size']:.3g} of 1 per measured number)"
    if wrong_size:
        size = f"the NIS is {of['size']:.3g} per measured number where 1 is expected"
        if len(of["sizes"]) > 1:
            log_ratios = np.abs(np.log(np.maximum(of["sizes"], 1e-300)))
            i = int(np.argmax(np.where(of["sizes"] > 0, log_ratios, 0.0)))
            size += f" ({name(i)} has {of['sizes'][i]:.3g})"
        if not np.isnan(of["since"]):
            size += (
                f"; {of['high']:.0%} of the windows are too high and {of['low']:.0%} too low, the "
                f"first at {of['since']:.3g} s"
            )
    lines.append(f"{part}: {size}.")
    if "outliers" in later and of["kurtosis"] > _HEAVY:
        return [
            *lines,
            f"The largest innovation is {of['largest']:.3g} times their root mean square: outliers. "
            "Take them out (NaN), or give R the size of what they do.",
        ]
    if later - {*_CORRELATED, "bias"}:
        lines.append(_explain_cause(of, later, wrong_size))
    lines += [sentence for test, sentence in _CORRELATED.items() if test in later]
    if "bias" in later:
        lines.append(
            f"The mean innovation of {name(int(np.argmax(np.abs(of['means']))))} is not zero: a bias "
            "of this sensor or of another, or a constant error of the model; add it as a state."
        )
    return lines


def _explain_cause(of: dict[str, Any], significant: set[str], wrong_size: bool) -> str:
    """Sentence about the cause, by the size and the correlation of the innovations."""
    size, sign = "as large as", 0
    if wrong_size:
        size = "smaller than" if of["size"] < 1 else "larger than"
    # the first of the tests of correlation that is significant, and its expected value
    for test, expected in (("slow drift", 1), ("drift", 1), ("memory", 0)):
        if not sign and test in significant:
            sign = 1 if of[test] > expected else -1
    if size == "as large as" and not sign:
        return "Their sizes change along the record, or the noise is not Gaussian."
    correlation_text = "and white"
    if sign:
        correlation_text = (
            f"and successive ones {'are alike' if sign > 0 else 'cancel'} (correlation "
            f"{of['memory']:+.2f}, means over windows {of['slow drift']:.2g} times as large as chance "
            "makes them)"
        )
    return f"They are {size} the filter expects, {correlation_text}: {_CAUSES[size, sign]}"


_CORRELATED = {
    "inputs": "The innovations follow the inputs: the model's gain of an input, or what the input "
    "acts on, is wrong. States that absorb a part of it are wrong as well.",
    "prediction": "The innovations follow the predicted readings: a rate or a scale of the model, or "
    "of a sensor, is wrong.",
    "trend": "The mean innovation wanders slowly along the record: an error of the model, or of a "
    "sensor, that changes slowly.",
}
_LAGGING = (
    "the filter lags behind, because the model is wrong (parameters, motion or a bias that it does "
    "not have) or Q is too small. Errors can be many of the stated deviations."
)
# Causes by the size of the innovations and the sign of their correlation.
# fmt: off
_CAUSES = {
    ("smaller than", 1): "R is too large, so that the filter follows too slowly and its lag hides below "
    "the noise that it assumes. Errors can be several of the stated deviations.",
    ("smaller than", 0): "R or Q is too large. The filter is too cautious; its errors are likely "
    "smaller than it says.",
    ("smaller than", -1): "Q is too large. The filter follows the noise; its errors are likely "
    "smaller than it says.",
    ("larger than", 1): _LAGGING,
    ("larger than", 0): "R is too small.",
    ("larger than", -1): "R is too small, so that the filter follows the noise. Errors are larger than "
    "the stated deviations.",
    ("as large as", 1): _LAGGING,
    ("as large as", -1): "Q is too large against R. The filter follows the noise; a smaller Q would "
    "make smaller errors.",
}
# fmt: on
