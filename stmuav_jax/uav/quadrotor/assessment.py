"""Filters for the eight cases, and their assessment over seeds: convergence, errors, NEES, NIS.

The report's tuning (Table 2.4.2) starts 0.45 m and 0.6 m from the truth with a standard deviation
of 0.9 mm, has three to seven times too much measurement noise, and a random walk of the centre
of mass of 0.14 mm a step. The consistent tuning starts at the same place with suitable standard
deviations (5 rad/s, 0.5 m, not taken from the truth), has the table's true noise, and, if the load
moves, a model of its motion: a swing of known period and unknown centre, amplitudes and phases.

Convergence to 2 cm is the last time at which either component of the centre of mass is more
than 2 cm wrong. NEES is computed for the offset (2) and for rates and offset (5); sums over seeds
are chi-squared at any one time, while values at different times are not independent. Innovations
are white, so that NIS is averaged over times and seeds. All are of the settled part, after
`SETTLED`: the NEES of the report's filter, which starts 0.45 m wrong, needs 1.1 s to settle.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.errors import SettingError
from ...estimation.consistency import RunsVerdict, judge_innovations, mean_interval, nees, over_runs
from ...estimation.filter import DEFAULT, AbstractFilter, Filtered, GaussianFilter, filter_bank
from ...estimation.gaussians import Gaussian, gaussian, triangularise_rows
from ...estimation.model import StateSpaceModel
from ...estimation.sigma import Unscented
from ...estimation.smoother import Smoothed, smooth
from ...math.compiler import quick_jit
from ...math.rotation import product, turn_about
from ...math.space import Vector
from ...mechanics.parameters import Parameters
from .cases import CaseRecord, simulate_case
from .model import (
    OBSERVABLE,
    PART_III,
    attitude_model,
    observable_model,
    report_model,
    swinging_model,
)

Kind = Literal["observable", "report", "printed", "attitude"]

KINDS = get_args(Kind)

# Period of the chosen motion of cases 5 to 8 [s].
PERIOD = 2.0

# Standard deviations of the consistent prior: angles [rad], rates [rad/s], offsets [m], swing [m].
WIDE = {"angle": 1.0, "rate": 5.0, "offset": 0.5, "swing": 0.1}

# Variance per step of a random walk of the offset that follows cases 5 to 8 [m^2], found by
# maximum likelihood (docs/estimation.md), for the models without a swing.
FOLLOWING = 3e-7


class FilterTuning(eqx.Module):
    """Tuning: a filter ready to run.

    Attributes:
        name: name for tables.
        model, prior, method: arguments of `kalman_filter`.
        output_matrix: matrix (5, n) that maps the state's error to that of (Omega, offset).
    """

    name: str = eqx.field(static=True)
    model: StateSpaceModel
    prior: Gaussian
    method: AbstractFilter
    output_matrix: Float[np.ndarray, "5 n"]

    def point(self, mean: Any) -> Float[Array, "5 *s"]:
        """Values of Omega and of the offset in a state."""
        if isinstance(mean, dict):
            return jnp.concatenate([mean["omega"], mean["offset"]])
        return jnp.tensordot(jnp.asarray(self.output_matrix), mean, axes=1)


def report_tuning(kind: Kind = "report", *, parameters: Parameters = PART_III) -> FilterTuning:
    """Tuning of Table 2.4.2: prior, Q, R and the rule's alpha, beta, kappa.

    Args:
        kind: "report" for the 8 states with corrected kinematics; "printed" for them as printed;
            "observable" for the 5 observable ones; "attitude" for 8 with the attitude on SO(3),
            whose prior and noise are those of the Euler angles taken as a rotation vector.
    """
    value = parameters.value
    rule = Unscented(value("filter.alpha"), value("filter.beta"), value("filter.kappa"))
    model, state_map = _make_model(kind, value("filter.Q"), value("filter.R"), parameters)
    prior = _make_prior(kind, value("filter.start"), value("filter.P0"))
    return FilterTuning("report", model, prior, GaussianFilter(rule), state_map)


def consistent_tuning(
    case: int, kind: Kind = "observable", *, parameters: Parameters = PART_III
) -> FilterTuning:
    """Tuning whose covariances are consistent with the errors; see the module.

    With kind="observable" the model contains the swing of cases 5 to 8; models of other kinds
    follow it by a random walk (`FOLLOWING`), which can lag.
    """
    value = parameters.value
    Q, start = np.array(value("true.Q"), dtype=float), np.array(value("filter.start"))
    rates, wide = [WIDE["rate"]] * 3, [WIDE["offset"]] * 2
    if kind == "observable" and case > 4:
        model = swinging_model(PERIOD, parameters=parameters)
        mean = np.concatenate([start[OBSERVABLE], np.zeros(4)])
        prior = gaussian(mean, np.diag([*rates, *wide, *[WIDE["swing"]] * 4]) ** 2)
        state_map = np.eye(5, 9)
        state_map[3, 5] = state_map[4, 6] = 1.0
        return FilterTuning("consistent", model, prior, DEFAULT, state_map)
    if case > 4:
        Q[6:] = FOLLOWING
    model, state_map = _make_model(kind, Q, value("true.R"), parameters)
    # The prior covers the report's start, which lies up to 6 rad/s from the truth; its own P_0 allows
    # errors of 0.001 rad/s.
    deviations = np.array([*[WIDE["angle"]] * 3, *rates, *wide])
    prior = _make_prior(kind, start, deviations**2)
    return FilterTuning("consistent", model, prior, DEFAULT, state_map)


def _make_model(
    kind: Kind, Q: Any, R: Any, parameters: Parameters
) -> tuple[StateSpaceModel, np.ndarray]:
    """Model with a constant centre of mass, and the matrix from its errors to (Omega, offset)."""
    if kind not in KINDS:
        raise SettingError(f"The model must be one of {', '.join(KINDS)}, not '{kind}'.")
    Q = np.asarray(Q)
    if kind == "observable":
        return observable_model(Q=Q[OBSERVABLE], R=R, parameters=parameters), np.eye(5)
    if kind == "attitude":
        model = attitude_model(Q, R, parameters=parameters)
    elif kind == "printed":
        model = report_model("printed", "euler", Q=Q, R=R, parameters=parameters)
    else:
        model = report_model(Q=Q, R=R, parameters=parameters)
    return model, np.eye(5, 8, k=3)


def _make_prior(kind: Kind, mean: Any, variances: Any) -> Gaussian:
    """Prior from those of 8 states, for "attitude" with Euler parameters for the angles (R_Z R_X R_Y)."""
    states = OBSERVABLE if kind == "observable" else slice(8)
    prior = gaussian(np.asarray(mean)[states], np.diag(np.asarray(variances)[states]))
    if kind != "attitude":
        return prior
    phi, theta, psi = (prior.mean[i] for i in range(3))
    p = product(turn_about(psi, 2), product(turn_about(phi, 0), turn_about(theta, 1)))
    return Gaussian({"p": p, "omega": prior.mean[3:6], "offset": prior.mean[6:]}, prior.factor)


# --- assessment

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
        predicted: predicted readings (T, m, s) [rad/s], None if they are not known.
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
    predicted: Float[Array, "T m s"] | None = None

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
    return _estimate_record(y, record.u, record.step, truth, tuning, smoothed)


@quick_jit
def _estimate_record(
    y: Array, u: Array, dt: Array, truth: Array, tuning: FilterTuning, smoothed: bool
) -> Estimates:
    filtered = filter_bank(tuning.model, tuning.prior, y, u=u, dt=dt, method=tuning.method)
    path: Filtered | Smoothed = smooth(tuning.model, filtered) if smoothed else filtered
    state_map = jnp.asarray(tuning.output_matrix)

    def compare_offset(mean: Any, factor: Array, true: Array) -> tuple[Array, Array, Array, Array]:
        x = tuning.point(mean)
        rows = jnp.sum(factor[:, :, None] * state_map.T[:, None, :, None], axis=0)
        root = triangularise_rows(rows)
        deviation = jnp.sqrt(jnp.sum(rows**2, axis=0))
        of_offset = nees(x, root, true, Vector(5), only=slice(3, 5))
        return x, deviation, of_offset, nees(x, root, true, Vector(5))

    mean, deviation, of_offset, of_all = jax.vmap(compare_offset)(path.mean, path.factor, truth)
    return Estimates(
        mean, deviation, truth, of_offset, of_all, filtered.nis, filtered.ok,
        *(getattr(filtered.innovations, name) for name in ("normalised", "measured", "predicted")),
    )  # fmt: skip


def last_beyond(error: Float[Array, "T k s"], t: Any, within: float) -> Float[Array, " s"]:
    """Last of the times t[1:] at which an error is larger than `within` (s,) [s].

    The time is zero if there is none, and NaN if the error is so at the end.
    """
    outside_mask = ~(jnp.max(jnp.abs(error), axis=1) <= within)
    last_index = len(outside_mask) - 1 - jnp.argmax(outside_mask[::-1], axis=0)
    when = jnp.where(outside_mask.any(axis=0), jnp.asarray(t)[last_index + 1], 0.0)
    return jnp.where(outside_mask[-1], jnp.nan, when)


def settled_from(t1: float) -> float:
    """Time at which the settled part of a run of t1 [s] begins: `SETTLED`, at most 0.6 t1 [s]."""
    return float(min(SETTLED, 0.6 * t1))


def summarise(estimates: Estimates, record: CaseRecord, tuning: str) -> CaseSummary:
    """Summary of one case; failed runs count in `failed` and are otherwise left out."""
    t = np.asarray(record.t)
    running = np.asarray(estimates.ok)[-1]
    good = jax.tree.map(lambda a: jnp.asarray(np.asarray(a)[..., running]), estimates)
    count = int(running.sum())
    from_time = settled_from(t[-1])
    # Convergence is judged by itself; averages with the start in them would say little about the settled
    # filter.
    after_start = t[1:] > from_time
    runs = judge_innovations(
        estimates.normalised, estimates.measured, estimates.ok, np.diff(t), inputs=record.u,
        predicted=estimates.predicted, names=tuple(f"gyroscope {axis}" for axis in "xyz"),
    )  # fmt: skip
    judged = (from_time, over_runs(runs))
    if not count:
        nan = float("nan")
        none = (nan, nan)
        return CaseSummary(record.case, tuning, record.seeds, record.seeds, nan, nan, nan, none, nan,
                       nan, nan, none, none, none, 0, *judged)  # fmt: skip
    close, times_to_5mm = (last_beyond(good.error[:, 3:], t, within) for within in (0.02, 0.005))
    error = np.asarray(good.error)[after_start, 3:]
    window = mean_interval(5, count)
    # Errors of neighbouring steps are correlated; a count at 50 spread times can be compared with the
    # interval's level.
    checked_steps = np.linspace(np.argmax(after_start), len(t) - 2, 50).astype(int)
    means = np.mean(good.nees, axis=1)[checked_steps]
    rmse = np.sqrt(np.mean(error**2, axis=(0, 2)))
    return CaseSummary(
        record.case, tuning, record.seeds, record.seeds - count,
        float(np.median(close)), float(np.max(close)), float(np.median(times_to_5mm)),
        (float(rmse[0]), float(rmse[1])),
        float(np.mean(good.nees_offset[after_start])), float(np.mean(good.nees[after_start])),
        float(np.mean(good.nis[after_start])),
        mean_interval(2, count), window, mean_interval(3, count * int(after_start.sum())),
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
