"""Assessment of a filter over the seeds of a case: convergence, errors, NEES, NIS.

Convergence to 2 cm is the last time at which either component of the centre of mass is more
than 2 cm wrong. NEES is computed for the offset (2) and for rates and offset (5); sums over seeds
are chi-squared at any one time, while values at different times are not independent. Innovations
are white, so that NIS is averaged over times and seeds. All are of the settled part, after
`SETTLED`: the NEES of the report's filter, which starts 0.45 m wrong, needs 1.1 s to settle.
"""

from collections.abc import Sequence
from functools import cache
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..algebra.compiler import outer_jit
from ..algebra.space import Vector
from ..estimation.bank import filter_bank
from ..estimation.consistency import mean_interval, nees
from ..estimation.factor import triangularise
from ..estimation.filter import Filtered
from ..estimation.smoother import Smoothed, smooth
from ..parameters.table import Parameters
from .cases import CaseRecord, simulate_case
from .filter_verdict import RunsVerdict, judge, over_runs
from .model import PART_III
from .tuning import FilterTuning

# Time from which a run counts as settled [s].
SETTLED = 1.2


class Estimates(eqx.Module):
    """Estimates of (Omega, offset) by a bank of filters, at T times for s seeds.

    Attributes:
        mean, standard_deviation: means and standard deviations (T, 5, s) [rad/s, m].
        truth: true values (T, 5, s) [rad/s, m].
        nees_offset: NEES of the offset (T, s).
        nees: NEES of all five components (T, s).
        nis: NIS of the innovations (T, s), infinite from a failure on.
        ok: False from the step at which a filter failed (T, s).
        normalised, measured: normalised innovations, and True for those not missing (T, m, s).
    """

    mean: Float[Array, "T 5 s"]
    standard_deviation: Float[Array, "T 5 s"]
    truth: Float[Array, "T 5 s"]
    nees_offset: Float[Array, "T s"]
    nees: Float[Array, "T s"]
    nis: Float[Array, "T s"]
    ok: Bool[Array, "T s"]
    normalised: Float[Array, "T m s"]
    measured: Bool[Array, "T m s"]

    @property
    def error(self) -> Float[Array, "T 5 s"]:
        """Errors, estimates less the truth."""
        return self.mean - self.truth


class CaseSummary(NamedTuple):
    """Row of the table for a case and a tuning; times [s], lengths [m].

    Attributes:
        case, tuning: number of the case and name of the tuning.
        seeds, failed: numbers of all runs and of those that lost their covariance.
        to_2cm, to_2cm_worst: median and largest time of convergence to 2 cm over the seeds.
        to_5mm: median time of convergence to 5 mm. All three are NaN if a run does not converge.
        rmse: root-mean-square error of the offset (x, y) after `settling_time`.
        nees_offset, nees, nis: means over seeds and times after `settling_time`.
        nees_offset_window, nees_window, nis_window: intervals of these means with a probability
            of 99.9 %; those of NEES are for the mean over seeds at one time.
        outside: number of 50 times after `settling_time` at which the mean of `nees` is out of its
            interval.
        settling_time: time at which the settled part begins.
        verdict: verdict over all runs, from their innovations.
    """

    case: int
    tuning: str
    seeds: int
    failed: int
    to_2cm: float
    to_2cm_worst: float
    to_5mm: float
    rmse: tuple[float, float]
    nees_offset: float
    nees: float
    nis: float
    nees_offset_window: tuple[float, float]
    nees_window: tuple[float, float]
    nis_window: tuple[float, float]
    outside: int
    settling_time: float
    verdict: RunsVerdict

    def plain(self) -> dict[str, Any]:
        """All fields as plain data, for files."""
        return self._asdict() | {"verdict": self.verdict._asdict()}


def estimate_case(record: CaseRecord, tuning: FilterTuning, *, smoothed: bool = False) -> Estimates:
    """Run a bank of filters, one per seed, and with `smoothed` a smoother afterwards."""
    truth = jnp.concatenate([record.omega, record.offset], axis=1)[1:]
    y = record.y[:, : tuning.model.sensor.space.size]
    return _compiled()(y, record.u, record.step, truth, tuning, smoothed)


@cache
def _compiled() -> Any:
    return outer_jit(_estimated)


def _estimated(
    y: Array, u: Array, dt: Array, truth: Array, tuning: FilterTuning, smoothed: bool
) -> Estimates:
    found = filter_bank(tuning.model, tuning.prior, y, u=u, dt=dt, method=tuning.method)
    path: Filtered | Smoothed = found
    if smoothed:
        path = smooth(tuning.model, found)
    seen = jnp.asarray(tuning.output_matrix)

    def each(mean: Any, factor: Array, true: Array) -> tuple[Array, Array, Array, Array]:
        x = tuning.point(mean)
        rows = jnp.sum(factor[:, :, None] * seen.T[:, None, :, None], axis=0)
        root = triangularise(rows)
        deviation = jnp.sqrt(jnp.sum(rows**2, axis=0))
        of_offset = nees(x, root, true, Vector(5), only=slice(3, 5))
        return x, deviation, of_offset, nees(x, root, true, Vector(5))

    mean, deviation, of_offset, of_all = jax.vmap(each)(path.mean, path.factor, truth)
    return Estimates(
        mean, deviation, truth, of_offset, of_all, found.nis, found.ok,
        found.innovations.normalised, found.innovations.measured,
    )  # fmt: skip


def convergence(estimates: Estimates, t: Any, within: float) -> np.ndarray:
    """Last time at which the offset is further than `within` from the truth (s,) [s].

    The time is zero if there is none, and NaN if the offset is so at the end.
    """
    return last_beyond(np.asarray(estimates.error)[:, 3:], t, within)


def last_beyond(error: np.ndarray, t: Any, within: float) -> np.ndarray:
    """Times as in `convergence` for errors (T, k, s) at the times t[1:]."""
    far = ~(np.max(np.abs(error), axis=1) <= within)
    last = len(far) - 1 - np.argmax(far[::-1], axis=0)
    when = np.where(far.any(axis=0), np.asarray(t)[last + 1], 0.0)
    return np.where(far[-1], np.nan, when)


def settled_from(t1: float) -> float:
    """Time at which the settled part of a run of t1 [s] begins: `SETTLED`, at most 0.6 t1 [s]."""
    return float(min(SETTLED, 0.6 * t1))


def summarise(estimates: Estimates, record: CaseRecord, tuning: str) -> CaseSummary:
    """Summary of one case; failed runs count in `failed` and are otherwise left out."""
    t = np.asarray(record.t)
    fine = np.asarray(estimates.ok)[-1]
    kept = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[..., fine]), estimates)
    count = int(fine.sum())
    from_time = settled_from(t[-1])
    settled = t[1:] > from_time
    names = tuple(f"gyroscope {axis}" for axis in "xyz")
    found = over_runs(
        judge(estimates.normalised, estimates.measured, estimates.ok, np.diff(t), names=names)
    )
    judged = (from_time, found)
    if not count:
        nan = float("nan")
        none = (nan, nan)
        return CaseSummary(record.case, tuning, record.seeds, record.seeds, nan, nan, nan, none, nan,
                       nan, nan, none, none, none, 0, *judged)  # fmt: skip
    close, near = (convergence(kept, t, within) for within in (0.02, 0.005))
    error = np.asarray(kept.error)[settled, 3:]
    m = 3
    window = mean_interval(5, count)
    looked = np.linspace(np.argmax(settled), len(t) - 2, 50).astype(int)
    means = np.mean(kept.nees, axis=1)[looked]
    rmse = np.sqrt(np.mean(error**2, axis=(0, 2)))
    return CaseSummary(
        record.case, tuning, record.seeds, record.seeds - count,
        float(np.median(close)), float(np.max(close)), float(np.median(near)),
        (float(rmse[0]), float(rmse[1])),
        float(np.mean(kept.nees_offset[settled])), float(np.mean(kept.nees[settled])),
        float(np.mean(kept.nis[settled])),
        mean_interval(2, count), window, mean_interval(m, count * int(settled.sum())),
        int(np.sum((means < window[0]) | (means > window[1]))), *judged,
    )  # fmt: skip


class CaseStudy(NamedTuple):
    """Study of one case with one filter or several.

    Attributes:
        record: truth and measurements.
        estimates, summaries: results by the tuning's name.
    """

    record: CaseRecord
    estimates: dict[str, Estimates]
    summaries: dict[str, CaseSummary]


def study_case(
    case: int,
    tunings: Sequence[FilterTuning],
    *,
    seeds: int = 50,
    t1: float = 2.0,
    seed: int = 0,
    parameters: Parameters = PART_III,
) -> CaseStudy:
    """Simulate a case and estimate it with each tuning, on the same measurements.

    Raises:
        SettingError: the case, seeds or end are refused as in `simulate_case`.
    """
    record = simulate_case(case, seeds=seeds, t1=t1, seed=seed, parameters=parameters)
    estimates = {tuning.name: estimate_case(record, tuning) for tuning in tunings}
    summaries = {name: summarise(e, record, name) for name, e in estimates.items()}
    return CaseStudy(record, estimates, summaries)
