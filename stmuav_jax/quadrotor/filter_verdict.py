"""Verdict on a record: a test of the consistency of a filter's stated errors.

A consistent filter has scaled innovations z_k = S_k^-1/2 nu_k that are independent and of unit
covariance. Eight tests look for deviations from this in the settled part of the record and,
separately, at its start:

    start       NIS of the start, two-sided: fit of the prior
    size        NIS of the settled part, two-sided
    sliding     NIS of windows that overlap by half, two-sided: sizes that change
    memory      correlation at six lags, within and between components (Box and Pierce's sum)
    drift       squares of means over blocks of 5 steps: slow correlation
    slow drift  squares of means over windows: slower correlation
    bias        squares of the components' means
    outliers    largest innovation relative to the size of the others

The last five compare innovations with their own root mean square, so that a wrong R alone does not
trigger them. The p-values are combined by Bonferroni's inequality: the verdict is "inconsistent"
if the smallest of them times their number is below `level`. A consistent filter is therefore
called inconsistent in at most about `level` of its records.

The transient of a wrong prior does not count as settled. Unless a time is given, the settled part
begins with the first window whose NIS is within its 99.9 % interval or beyond it on the other side
(a filter with a wrong start and too large an R may cross the interval within a window). The start,
which is the part before it or otherwise the first window, has its own test.

Errors that no innovation shows are not detected: an error that the states absorb, such as a
constant bias of a gyroscope below its noise, passes every test and can double the errors.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, Estimation with applications to tracking and
navigation (2001), ch. 5.4; G. E. P. Box, D. A. Pierce, JASA 65 (1970).
"""

from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from ..checks.errors import SettingError
from ..estimation.consistency import chi2_p_values
from ..estimation.filter import Filtered
from .verdict_words import meaning

Status = Literal["consistent", "inconsistent", "undecided", "failed"]

LAGS = (1, 2, 3, 5, 8, 13)
# Number of steps of a short block; a long block is a window.
SHORT = 5
# Number of measured components in the settled part below which the verdict is "undecided".
FEWEST = 30
# Two-sided p-value above which a window counts as settled.
WITHIN = 1e-3
TESTS = ("start", "size", "sliding", "memory", "drift", "slow drift", "bias", "outliers")


class Verdict(NamedTuple):
    """Verdict of the tests on the innovations of one record.

    Attributes:
        status: "consistent", "inconsistent", "undecided" (too few measurements), or "failed".
        level: probability with which a consistent filter is called inconsistent.
        p_value: smallest p-value of the tests, times their number.
        p_values: p-value of every test by its name.
        settled: time from which the record counts as settled [s].
        inconsistent_since: end of the first window outside of its interval [s], NaN without one.
        fraction_high, fraction_low: fractions of windows whose NIS is too large or too small.
        initial_nis: mean NIS per measured component at the start, with an expected value of one.
        settled_nis: mean NIS per measured component in the settled part, with the same expected value.
        autocorrelation: mean correlation with the next innovation, with an expected value of zero.
        missing: fraction of measurements that are missing.
        words: sentences on the findings and their usual causes.
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
    words: str

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
        words: sentences on all runs and on a typical one.
    """

    status: Status
    runs: int
    flagged: int
    failed: int
    significant_tests: tuple[str, ...]
    words: str

    @property
    def short(self) -> str:
        """Summary of the verdict in one line."""
        if self.failed:
            return f"{self.status}: {self.failed} of {self.runs} runs lost their covariance"
        tests = f" ({', '.join(self.significant_tests)})" if self.flagged else ""
        return f"{self.status}: {self.flagged} of {self.runs} runs flagged{tests}"


def over_runs(found: tuple[Verdict, ...]) -> RunsVerdict:
    """Combine the verdicts of independent runs into one."""
    from scipy.special import bdtrc

    flagged = [v for v in found if v.status == "inconsistent"]
    failed = sum(v.status == "failed" for v in found)
    level = found[0].level
    chance = bdtrc(len(flagged) - 1, len(found), level) if flagged else 1.0
    status: Status = "consistent"
    if failed:
        status = "failed"
    elif all(v.status == "undecided" for v in found):
        status = "undecided"
    elif chance <= level * (1 + 1e-9):
        status = "inconsistent"
    spoke = tuple(
        n
        for n in TESTS
        if 2 * sum(n in v.significant_tests for v in flagged) >= max(len(flagged), 1)
    )
    # the run with the median p-value is the typical one of its status
    alike = sorted((v for v in found if v.status == status), key=lambda v: v.p_value)
    typical = alike[len(alike) // 2] if alike else found[0]
    words = (
        f"{len(flagged)} of {len(found)} runs are inconsistent, where chance makes "
        f"{level:.0%}. A typical run: {typical.words}"
    )
    return RunsVerdict(status, len(found), len(flagged), failed, spoke, words)


def verdict(
    filtered: Filtered,
    *,
    settle: float | None = None,
    level: float = 0.01,
    window: int = 50,
    names: tuple[str, ...] = (),
) -> Verdict:
    """Verdict on one record and its filter.

    Args:
        filtered: result of `kalman_filter` for a single filter.
        settle: time from the start after which the record counts as settled [s]; by default found
            from the NIS (see the module).
        level: family-wise probability of a false alarm.
        window: number of steps of the sliding NIS.
        names: names of the measured components, for the words.

    Raises:
        SettingError: `filtered` is a bank (use `verdicts`), or a level, window or time cannot be
            used.
    """
    if np.ndim(filtered.ok) != 1:
        raise SettingError("verdict judges one record; use verdicts for a bank of filters.")
    one = jax.tree.map(lambda a: np.asarray(a)[..., None], (filtered.innovations, filtered.ok))
    innovations, ok = one
    return judge(
        innovations.normalised, innovations.measured, ok, filtered.dt,
        settle=settle, level=level, window=window, names=names,
    )[0]  # fmt: skip


def verdicts(filtered: Filtered, **options: Any) -> tuple[Verdict, ...]:
    """Verdicts on the filters of a bank, with the options of `verdict`."""
    innovations = filtered.innovations
    return judge(innovations.normalised, innovations.measured, filtered.ok, filtered.dt, **options)


def judge(
    scaled: Any,
    there: Any,
    ok: Any,
    dt: Any,
    *,
    settle: float | None = None,
    level: float = 0.01,
    window: int = 50,
    names: tuple[str, ...] = (),
) -> tuple[Verdict, ...]:
    """Verdicts from innovations alone.

    Args:
        normalised, measured: normalised innovations, and True for those not missing (T, m, s).
        ok: False from the step at which a filter failed (T, s).
        dt: lengths of the steps (T,) [s].
        settle, level, window, names: as in `verdict`.

    Raises:
        SettingError: a level, window or time cannot be used.
    """
    if not 0 < level < 1 or window < 2:
        raise SettingError(
            f"A verdict needs a level in (0, 1) and a window of at least 2 steps, not {level} and "
            f"{window}."
        )
    t = np.cumsum(np.broadcast_to(np.asarray(dt, dtype=float), np.shape(scaled)[:1]))
    if settle is not None and not 0 <= settle < t[-1]:
        raise SettingError(
            f"The settling time must lie between 0 and the end at {t[-1]:g} s, not {settle:g} s."
        )
    there = np.asarray(there, dtype=bool)
    z = np.where(there & np.asarray(ok)[:, None], np.asarray(scaled, dtype=float), 0.0)
    # shorter windows in short records, so that there are at least eight
    window = max(2, min(window, len(z) // 8))
    from_step, never = _settled(z, there, window)
    if settle is not None:
        from_step = np.full(z.shape[2], np.sum(t <= settle * (1 + 1e-9)))
        never = np.zeros_like(never)
    steps = np.arange(len(z))[:, None]
    # without a transient the first window is the start
    first = np.maximum(from_step, window if settle is None else 0)
    found = _numbers(z, there & (steps >= from_step)[:, None], window, level)
    start = there & (steps < first)[:, None]
    found |= _sizes("start", np.sum(z**2 * start, (0, 1)), np.sum(start, (0, 1)))
    found["never"] = never
    found["missing"] = 1 - np.mean(there, axis=(0, 1))
    found["settled"] = np.where(from_step > 0, t[np.maximum(from_step, 1) - 1], 0.0)
    at = found["since step"]
    found["since"] = np.where(at >= 0, t[np.minimum(at, len(t) - 1)], np.nan)
    found["fails"] = np.where(np.asarray(ok)[-1], np.nan, t[np.argmin(np.asarray(ok), axis=0)])
    found["first"] = np.where(first > 0, t[np.maximum(first, 1) - 1], 0.0)
    return tuple(_verdict(found, i, level, names) for i in range(z.shape[2]))


def _settled(z: np.ndarray, there: np.ndarray, window: int) -> tuple[np.ndarray, np.ndarray]:
    """Step (s,) at which the first window begins whose NIS is in its interval or beyond it.

    Beyond it means on another side than the first window. The step is zero if there is no such
    window in the first half of the record; the second result is then True.
    """
    count = len(z) // window // 2
    if not count:
        return np.zeros(z.shape[2], dtype=int), np.zeros(z.shape[2], dtype=bool)
    cut = lambda a: a[: count * window].reshape(count, window * z.shape[1], -1)
    below, above, p = chi2_p_values(np.sum(cut(z) ** 2, axis=1), np.sum(cut(there), axis=1))
    side = np.where(p > WITHIN, 0, np.where(above < below, 1, -1))
    over = (side == 0) | (side != side[0])
    some = np.asarray(np.any(over, axis=0))
    return np.where(some, np.argmax(over, axis=0) * window, 0), ~some


def _sizes(name: str, total: np.ndarray, degrees: np.ndarray) -> dict[str, Any]:
    """Two-sided test of a sum of squares, its mean square and degrees of freedom, by name."""
    p = chi2_p_values(total, degrees)[2]
    return {f"p {name}": p, name: total / np.maximum(degrees, 1), f"{name} degrees": degrees}


def _numbers(z: np.ndarray, there: np.ndarray, window: int, level: float) -> dict[str, Any]:
    """Statistics of the settled part by name; `there` is True in this part only."""
    found = _sizes("size", np.sum(z**2 * there, (0, 1)), np.sum(there, (0, 1)))
    found |= _sliding(z, there, window, level)
    count = np.sum(there, axis=0)
    rms = np.sqrt(np.sum(z**2 * there, axis=0) / np.maximum(count, 1))
    r = np.where(there, z / np.where(rms > 0, rms, 1.0), 0.0)
    found |= _memory(r, there)
    for name, length in (("drift", SHORT), ("slow drift", window)):
        total, degrees = _block_means(r, there, length)
        found |= _sizes(name, total, degrees)
    means = np.sum(r, axis=0) / np.sqrt(np.maximum(count, 1))
    found["p bias"] = chi2_p_values(np.sum(means**2, axis=0), np.sum(count > 0, axis=0))[1]
    found["means"] = means
    return found | _outliers(r, there)


def _sliding(z: np.ndarray, there: np.ndarray, window: int, level: float) -> dict[str, Any]:
    """Smallest p-value of the windows times their number, and the windows outside on each side."""
    sums = lambda a: np.concatenate([np.zeros((1, a.shape[2])), np.cumsum(a.sum(axis=1), axis=0)])
    begins = np.arange(0, max(len(z) - window, 0) + 1, max(window // 2, 1))
    ends = np.minimum(begins + window, len(z))
    total, degrees = (s[ends] - s[begins] for s in (sums(z**2 * there), sums(there)))
    below, above, p = chi2_p_values(total, np.round(degrees).astype(int))
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


def _memory(r: np.ndarray, there: np.ndarray) -> dict[str, Any]:
    """Box and Pierce's sum over lags and pairs of components, and the correlation at lag one."""
    m, s = r.shape[1:]
    total, degrees, next_one = np.zeros(s), np.zeros(s, dtype=int), np.zeros(s)
    for lag in LAGS:
        if lag > len(r) // 4:
            break
        for i in range(m):
            for j in range(m):
                pairs = np.sum(there[:-lag, i] & there[lag:, j], axis=0)
                c = np.einsum("ts,ts->s", r[:-lag, i], r[lag:, j]) / np.sqrt(np.maximum(pairs, 1))
                total, degrees = total + c**2, degrees + (pairs > 0)
                if lag == 1 and i == j:
                    next_one += c / np.sqrt(np.maximum(pairs, 1)) / m
    return {"p memory": chi2_p_values(total, degrees)[1], "memory": next_one}


def _block_means(r: np.ndarray, there: np.ndarray, length: int) -> tuple[np.ndarray, np.ndarray]:
    """Sum of the squares of the blocks' means in units of their standard deviations, and count."""
    blocks = len(r) // length
    if blocks < 2:
        return np.zeros(r.shape[2]), np.zeros(r.shape[2], dtype=int)
    cut = lambda a: a[-blocks * length :].reshape(blocks, length, *a.shape[1:]).sum(axis=1)
    count = cut(there.astype(int))
    return (
        np.sum(cut(r) ** 2 / np.maximum(count, 1), axis=(0, 1)),
        np.sum(count > 0, axis=(0, 1)),
    )


def _outliers(r: np.ndarray, there: np.ndarray) -> dict[str, Any]:
    """P-value of the largest of n Gaussian numbers, their kurtosis, and the largest itself."""
    from scipy.special import erfc

    n = np.maximum(np.sum(there, axis=(0, 1)), 1)
    largest = np.max(np.abs(r), axis=(0, 1))
    beyond = erfc(largest / np.sqrt(2))
    return {
        "p outliers": -np.expm1(n * np.log1p(-np.minimum(beyond, 1 - 1e-16))),
        "kurtosis": np.sum(r**4, axis=(0, 1)) / n,
        "largest": largest,
    }


def _verdict(found: dict[str, Any], i: int, level: float, names: tuple[str, ...]) -> Verdict:
    """Verdict on run i."""
    of = {key: value[..., i] for key, value in found.items()}
    p_values = {name: float(of[f"p {name}"]) for name in TESTS}
    least = min(1.0, len(TESTS) * min(p_values.values()))
    status: Status = "inconsistent" if least < level else "consistent"
    if not np.isnan(of["fails"]):
        status = "failed"
    elif of["size degrees"] < FEWEST:
        status = "undecided"
    spoke = {name for name, p in p_values.items() if p < level / len(TESTS)}
    number = lambda key: float(of[key])
    return Verdict(
        status, level, least, p_values,
        settling_time=number("settled"), inconsistent_since=number("since"),
        fraction_high=number("high"), fraction_low=number("low"),
        initial_nis=number("start"), settled_nis=number("size"),
        autocorrelation=number("memory"),
        missing=number("missing"), words=" ".join(_sentences(status, of, spoke, level, names)),
    )  # fmt: skip


def _sentences(
    status: Status, of: dict[str, Any], spoke: set[str], level: float, names: tuple[str, ...]
) -> list[str]:
    """Sentences of a verdict."""
    share = f" {of['missing']:.0%} of the measurements are missing." if of["missing"] > 0 else ""
    if status == "failed":
        return [f"Failed: the filter lost its covariance at {of['fails']:.4g} s.{share}"]
    if status == "undecided":
        return [
            f"Undecided: the settled part has {int(of['size degrees'])} measured numbers, and "
            f"{FEWEST} are needed.{share}"
        ]
    if status == "consistent":
        return [
            f"Consistent: after {of['settled']:.3g} s none of {len(TESTS)} tests at a family-wise level of "
            f"{level:g} speaks against the filter; mean NIS {of['size']:.3g} of 1 per measured "
            f"number.{share} Innovations cannot show an error that the states absorb, such as a "
            "small constant bias."
        ]
    return [
        f"Inconsistent: {', '.join(name for name in TESTS if name in spoke)} "
        f"(family-wise level {level:g}).{share}",
        *meaning(of, spoke, names),
    ]
