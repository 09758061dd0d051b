"""How good a filter is over the seeds of a case: convergence, errors, NEES, NIS.

Convergence to 2 cm is the last time at which either component of the centre of mass is more
than 2 cm wrong. NEES is that of the offset (2) and of rates and offset (5); their means over
seeds are chi-squared at any one time, while those of different times are not independent. Innovations
are white, so that NIS counts with times and seeds. All are of the settled part, from `SETTLED` on: the
report's filter, which starts 0.45 m wrong, needs 1.1 s until its NEES has come to rest.
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
from ..vehicle.parameters import Parameters
from .bank import filter_bank
from .cases import Record, simulate_case
from .consistency import mean_interval, nees
from .factor import triangularise
from .filter import Filtered
from .quadrotor import PART_III
from .smoother import Smoothed, smooth
from .space import Vector
from .tuning import Tuning
from .verdict import RunsVerdict, judge, over_runs

# From here on a run counts as settled [s].
SETTLED = 1.2


class Estimates(eqx.Module):
    """What a bank of filters says about (Omega, offset), T times, s seeds.

    Attributes:
        mean, deviation: (T, 5, s) [rad/s, m]. truth: (T, 5, s).
        nees_offset: of the offset (T, s). nees: of all five (T, s).
        nis: of the innovations (T, s), infinite from a failure on. ok: whether it runs (T, s).
        scaled, there: scaled innovations, and which were measured (T, m, s).
    """

    mean: Float[Array, "T 5 s"]
    deviation: Float[Array, "T 5 s"]
    truth: Float[Array, "T 5 s"]
    nees_offset: Float[Array, "T s"]
    nees: Float[Array, "T s"]
    nis: Float[Array, "T s"]
    ok: Bool[Array, "T s"]
    scaled: Float[Array, "T m s"]
    there: Bool[Array, "T m s"]

    @property
    def error(self) -> Float[Array, "T 5 s"]:
        """Estimate less truth."""
        return self.mean - self.truth


class Summary(NamedTuple):
    """A case's row of the table; times [s], lengths [m].

    Attributes:
        case, tuning, seeds, failed: which, how many runs, and how many lost their covariance.
        to_2cm, to_2cm_worst, to_5mm: convergence, median and largest over seeds; median. NaN
            where a run does not converge.
        rmse: of the offset (x, y) after `SETTLED`.
        nees_offset, nees, nis: means over seeds and times after `SETTLED`.
        nees_offset_window, nees_window, nis_window: where they lie with 99.9 %, counting for NEES
            the seeds alone.
        outside: of 50 times after `SETTLED`, how many means of `nees` lie outside.
        settled: where the settled part begins [s].
        verdict: over all runs, from their innovations.
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
    settled: float
    verdict: RunsVerdict

    def plain(self) -> dict[str, Any]:
        """Everything as plain data, for files."""
        return self._asdict() | {"verdict": self.verdict._asdict()}


def estimate_case(record: Record, tuning: Tuning, *, smoothed: bool = False) -> Estimates:
    """Run a bank of filters, one per seed; `smoothed` goes back through them afterwards."""
    truth = jnp.concatenate([record.omega, record.offset], axis=1)[1:]
    y = record.y[:, : tuning.model.sensor.space.size]
    return _compiled()(y, record.u, record.step, truth, tuning, smoothed)


@cache
def _compiled() -> Any:
    return outer_jit(_estimated)


def _estimated(
    y: Array, u: Array, dt: Array, truth: Array, tuning: Tuning, smoothed: bool
) -> Estimates:
    found = filter_bank(
        tuning.model,
        tuning.prior,
        y,
        u=u,
        dt=dt,
        rule=tuning.rule,
        form=tuning.form,
    )
    path: Filtered | Smoothed = found
    if smoothed:
        path = smooth(tuning.model, found, rule=tuning.rule)
    seen = jnp.asarray(tuning.seen)

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
        found.innovations.scaled, found.innovations.there,
    )  # fmt: skip


def convergence(estimates: Estimates, t: Any, within: float) -> np.ndarray:
    """The last time at which the offset is further than `within` from the truth (s,) [s].

    Zero if it never is; NaN if it still is at the end.
    """
    return last_beyond(np.asarray(estimates.error)[:, 3:], t, within)


def last_beyond(error: np.ndarray, t: Any, within: float) -> np.ndarray:
    """As `convergence`, of errors (T, k, s) at the times t[1:]."""
    far = ~(np.max(np.abs(error), axis=1) <= within)
    last = len(far) - 1 - np.argmax(far[::-1], axis=0)
    when = np.where(far.any(axis=0), np.asarray(t)[last + 1], 0.0)
    return np.where(far[-1], np.nan, when)


def settled_from(t1: float) -> float:
    """Where the settled part of a run of t1 [s] begins [s]: `SETTLED`, at most 60 % of the run."""
    return float(min(SETTLED, 0.6 * t1))


def summarise(estimates: Estimates, record: Record, tuning: str) -> Summary:
    """The figures of one case.

    Failed runs count in `failed` and are left out of the others.
    """
    t = np.asarray(record.t)
    fine = np.asarray(estimates.ok)[-1]
    kept = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[..., fine]), estimates)
    count = int(fine.sum())
    from_time = settled_from(t[-1])
    settled = t[1:] > from_time
    names = tuple(f"gyroscope {axis}" for axis in "xyz")
    found = over_runs(
        judge(estimates.scaled, estimates.there, estimates.ok, np.diff(t), names=names)
    )
    judged = (from_time, found)
    if not count:
        nan = float("nan")
        none = (nan, nan)
        return Summary(record.case, tuning, record.seeds, record.seeds, nan, nan, nan, none, nan,
                       nan, nan, none, none, none, 0, *judged)  # fmt: skip
    close, near = (convergence(kept, t, within) for within in (0.02, 0.005))
    error = np.asarray(kept.error)[settled, 3:]
    m = 3
    window = mean_interval(5, count)
    looked = np.linspace(np.argmax(settled), len(t) - 2, 50).astype(int)
    means = np.mean(kept.nees, axis=1)[looked]
    rmse = np.sqrt(np.mean(error**2, axis=(0, 2)))
    return Summary(
        record.case, tuning, record.seeds, record.seeds - count,
        float(np.median(close)), float(np.max(close)), float(np.median(near)),
        (float(rmse[0]), float(rmse[1])),
        float(np.mean(kept.nees_offset[settled])), float(np.mean(kept.nees[settled])),
        float(np.mean(kept.nis[settled])),
        mean_interval(2, count), window, mean_interval(m, count * int(settled.sum())),
        int(np.sum((means < window[0]) | (means > window[1]))), *judged,
    )  # fmt: skip


class CaseStudy(NamedTuple):
    """One case with one filter or several.

    Attributes:
        record: what happened. estimates, summaries: by the tuning's name.
    """

    record: Record
    estimates: dict[str, Estimates]
    summaries: dict[str, Summary]


def study_case(
    case: int,
    tunings: Sequence[Tuning],
    *,
    seeds: int = 50,
    t1: float = 2.0,
    seed: int = 0,
    parameters: Parameters = PART_III,
) -> CaseStudy:
    """Simulate a case and estimate it with each tuning, on the same measurements.

    Raises:
        SettingError: as `simulate_case`.
    """
    record = simulate_case(case, seeds=seeds, t1=t1, seed=seed, parameters=parameters)
    estimates = {tuning.name: estimate_case(record, tuning) for tuning in tunings}
    summaries = {name: summarise(e, record, name) for name, e in estimates.items()}
    return CaseStudy(record, estimates, summaries)
