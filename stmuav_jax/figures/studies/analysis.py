"""Analysis of a study: outcomes, statistics of every quantity, and sensitivities to inputs."""

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from ...checks.errors import SettingError
from ...montecarlo.sensitivity import (
    IndexIntervals,
    SobolIndices,
    binned,
    separation,
    sobol,
    spearman,
)
from ...montecarlo.statistics import (
    LEVEL,
    SHARES,
    IntervalEstimate,
    Outcomes,
    SampleSummary,
    outcomes,
    probability,
    summarise,
    value_ranks,
)
from .data import StudyData, StudyQuantity

# Largest number of samples for first-order indices and rank correlations; more would change little.
ROWS = 100_000

# Numbers that the bootstrap of Sobol indices may sample per quantity, and fewest resamples.
DRAWS, RESAMPLES = 2**27, 199


class Influence(NamedTuple):
    """Sensitivity of one quantity to the inputs.

    Attributes:
        names: keys of the d inputs.
        indices: Sobol indices of a Saltelli study; None in others.
        first: first-order indices (d,), from `indices` or from bins.
        noise_bound: bound of an index from bins without influence; None for Sobol indices.
        ranks: Spearman's rank correlations; None where they are not defined.
        samples: number of samples behind the results.
        note: remark on the results, or the reason why there are none.
    """

    names: tuple[str, ...]
    indices: SobolIndices | None
    first: np.ndarray | None
    noise_bound: float | None
    ranks: IndexIntervals | None
    samples: int
    note: str


class QuantityAnalysis(NamedTuple):
    """Results for one quantity: statistics, its probability if it is an event, sensitivities."""

    quantity: StudyQuantity
    summary: SampleSummary
    event: IntervalEstimate | None
    influence: Influence


class Failing(NamedTuple):
    """Event that the study declares a failure.

    Attributes:
        words: description of the event.
        probability: probability among the completed samples.
        samples: number of completed samples.
    """

    words: str
    probability: IntervalEstimate
    samples: int


class Analysis(NamedTuple):
    """Analysis of a study.

    Attributes:
        total: number of samples of the study.
        outcomes: outcomes of the independent samples.
        level: confidence level of all intervals.
        inputs: statistics of the sampled inputs, by key.
        varying: inputs that vary.
        findings: results for the quantities, in their order.
        failing: Kolmogorov-Smirnov distance of each varying input between failed samples and the
            others (d,), or None.
        notes: remarks on all numbers.
        failure: event that the study declares a failure, or None.
    """

    total: int
    outcomes: Outcomes
    level: float
    inputs: dict[str, SampleSummary]
    varying: tuple[StudyQuantity, ...]
    findings: tuple[QuantityAnalysis, ...]
    failing: np.ndarray | None
    notes: tuple[str, ...]
    failure: Failing | None = None


def analyse(data: StudyData, level: float = LEVEL) -> Analysis:
    """Analyse a study, one column at a time.

    Raises:
        SettingError: a level outside (0, 1).
    """
    found = outcomes(data.status[data.chosen], data.reasons, level)
    inputs = {one.key: summarise(data.values(one, "computed"), level=level) for one in data.inputs}
    varying = tuple(one for one in data.inputs if _varies(inputs[one.key]))
    picked = [data.inputs.index(one) for one in varying]
    table = data.table(limit=ROWS)[:, picked]
    names = data.factors if data.design == "saltelli" else tuple(one.key for one in varying)
    findings = tuple(_finding(data, one, names, table, level) for one in data.quantities)
    failing, notes = _failing(data, picked), _notes(data)
    failure = _failure(data, level)
    return Analysis(
        len(data.status), found, level, inputs, varying, findings, failing, notes, failure
    )


def _failure(data: StudyData, level: float) -> Failing | None:
    """Declared failure among the completed samples; a NaN value does not count as a failure."""
    given = data.identity.get("failure")
    found = {one.key: one for one in data.quantities}
    if not isinstance(given, Mapping) or given.get("quantity") not in found:
        return None
    one = found[given["quantity"]]
    values, limits = data.values(one), {k: given[k] for k in ("above", "below") if k in given}
    # the time of a crossing that never happens is infinite
    happened = np.zeros(len(values), bool) if limits else np.isfinite(values)
    unit = "" if one.unit in ("", "1") else f" {one.unit}"
    said = []
    if "above" in limits:
        happened |= values > limits["above"]
        said.append(f"above {limits['above']:g}{unit}")
    if "below" in limits:
        happened |= values < limits["below"]
        said.append(f"below {limits['below']:g}{unit}")
    if said:
        words = f"{one.words} {' or '.join(said)}"
    else:
        words = one.words.removeprefix("time at which ")
    if not len(values):
        return None
    return Failing(words, probability(int(np.sum(happened)), len(values), level), len(values))


def is_event(one: StudyQuantity, values: np.ndarray) -> bool:
    """Test whether a quantity is a yes-or-no event: whole numbers 0 and 1 only."""
    return one.whole and len(values) > 0 and bool(np.all((values == 0) | (values == 1)))


def _finding(
    data: StudyData, one: StudyQuantity, names: tuple[str, ...], table: np.ndarray, level: float
) -> QuantityAnalysis:
    values = data.values(one)
    event = probability(int(np.sum(values)), len(values), level) if is_event(one, values) else None
    if data.design == "saltelli":
        influence = _sobol(data, one, names, level)
    else:
        influence = _from_samples(names, table, values[:ROWS], level)
    return QuantityAnalysis(one, summarise(values, SHARES, level), event, influence)


def _sobol(data: StudyData, one: StudyQuantity, names: tuple[str, ...], level: float) -> Influence:
    resamples = min(499, max(RESAMPLES, DRAWS // max(len(data.status), 1)))
    values = data.whole_column(one)
    try:
        found = sobol(values, data.status, len(names), level=level, resamples=resamples)
    except SettingError as error:
        return Influence(names, None, None, None, None, 0, str(error))
    note = f"{found.used} base points" + (f", {found.lost} lost to failures" * (found.lost > 0))
    samples = found.used * (len(names) + 2)
    return Influence(names, found, found.first.value, None, None, samples, note)


def _from_samples(
    names: tuple[str, ...], table: np.ndarray, values: np.ndarray, level: float
) -> Influence:
    if not names:
        return Influence(names, None, None, None, None, 0, "No input varies.")
    known = ~np.isnan(values)
    table, values = table[known], values[known]
    first, ranks, chance, note = None, None, None, ""
    try:
        ranks = spearman(table, values, level)
        if np.any(np.isinf(values)):
            values, note = value_ranks(values), "shares are of the ranks, since values are infinite"
        found = binned(table, values, level=level)
        first, chance = found.value, found.noise_bound
    except SettingError as error:
        note = str(error)
    return Influence(names, None, first, chance, ranks, len(values), note)


def _failing(data: StudyData, picked: list[int]) -> np.ndarray | None:
    numbers = data.computed[:ROWS]
    failed = ~np.isin(numbers, data.fine)
    if not picked or not np.any(failed) or np.all(failed):
        return None
    return separation(data.table("computed", ROWS)[:, picked], failed)


def _varies(summary: SampleSummary) -> bool:
    least, most = summary.minimum, summary.maximum
    return least is not None and most is not None and least < most


def _notes(data: StudyData) -> tuple[str, ...]:
    notes = list(data.notes)
    if data.design == "saltelli":
        notes.append(
            "Statistics are of the samples A and B of each base point; the rest repeat their numbers. "
            "Sobol indices are of all samples."
        )
    if data.design in ("latin", "sobol", "saltelli"):
        notes.append(
            "Intervals are those of independent samples; this design is more even, so that those of "
            "means and probabilities are rather too wide than too narrow."
        )
    if len(data.computed) > ROWS and data.design != "saltelli":
        notes.append(f"Shares and rank correlations are from the first {ROWS:,} samples.")
    return tuple(notes)


# --- as plain data


def plain(analysis: Analysis) -> dict[str, Any]:
    """Plain data of the analysis for JSON; infinite numbers are the words "inf" and "-inf"."""
    o = analysis.outcomes
    return {
        "level": analysis.level,
        "samples": {
            "total": analysis.total, "not_computed": o.missing, "completed": o.successful,
            "not_completed": o.failed, "share_not_completed": _estimate(o.failure),
            "reasons": {
                str(code): {
                    "words": words, "count": o.codes.get(code, 0), "probability": _estimate(share)
                }
                for code, (words, share) in o.reasons.items()
            },
        },
        "failure": None if analysis.failure is None else {
            "words": analysis.failure.words, "samples": analysis.failure.samples,
            "probability": _estimate(analysis.failure.probability),
        },
        "inputs": {key: _summary(one) for key, one in analysis.inputs.items()},
        "quantities": {
            one.quantity.key: {
                "words": one.quantity.words, "unit": one.quantity.unit, **_summary(one.summary),
                "probability": _estimate(one.event),
                "influence": _influence(one.influence),
            }
            for one in analysis.findings
        },
        "failures_differ_in": _named(tuple(one.key for one in analysis.varying), analysis.failing),
        "notes": list(analysis.notes),
    }  # fmt: skip


def number(value: float | None) -> float | int | str | None:
    """Value for JSON: a finite number, "inf", "-inf", or None for NaN."""
    if value is None or math.isnan(value):
        return None
    return str(float(value)) if math.isinf(value) else value


def _estimate(one: IntervalEstimate | None) -> dict[str, Any] | None:
    if one is None:
        return None
    return {name: number(value) for name, value in one._asdict().items()}


def _summary(one: SampleSummary) -> dict[str, Any]:
    return {
        "values": one.values, "undefined": one.undefined,
        "infinite": {
            "above": one.positive_infinite, "below": one.negative_infinite,
            "share": _estimate(one.infinite_probability),
        },
        "minimum": number(one.minimum), "maximum": number(one.maximum),
        "mean": _estimate(one.mean), "standard_deviation": _estimate(one.standard_deviation),
        "quantiles": {f"{share:g}": _estimate(x) for share, x in one.quantiles.items()},
    }  # fmt: skip


def _named(names: tuple[str, ...], values: np.ndarray | None) -> dict[str, Any] | None:
    if values is None:
        return None
    return {name: number(float(value)) for name, value in zip(names, values, strict=True)}


def _shares(names: tuple[str, ...], one: IndexIntervals | None) -> dict[str, Any] | None:
    if one is None:
        return None
    rows = zip(names, one.value, one.low, one.high, strict=True)
    return {
        name: _estimate(IntervalEstimate(float(v), float(low), float(high)))
        for name, v, low, high in rows
    }


def _influence(one: Influence) -> dict[str, Any]:
    return {
        "sobol_first": _shares(one.names, one.indices.first if one.indices else None),
        "sobol_total": _shares(one.names, one.indices.total if one.indices else None),
        "share": None if one.indices else _named(one.names, one.first),
        "share_by_chance": number(one.noise_bound),
        "rank_correlation": _shares(one.names, one.ranks),
        "samples": one.samples,
        "note": one.note,
    }
