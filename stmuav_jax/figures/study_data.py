"""Results of a study, read column by column, their statistics and sensitivities, and a summary.

A study is a dataset over `sample` with one variable per column; attributes of a variable are
`units`, `long_name` and `role` ("input", "quantity", "status"); those of the dataset are JSON texts
`identity` and `reasons` (words by code of the status).
"""

import dataclasses
import functools
import itertools
import json
import math
import os
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import xarray as xr
from rich.table import Table

from ..checks.errors import SettingError
from ..io.netcdf import FileError, write_atomically
from ..studies.columns import FINE, MISSING, column_name
from ..studies.sensitivity import (
    SobolIndices,
    separation,
    sobol,
    spearman,
    spline_shares,
)
from ..studies.statistics import (
    LEVEL,
    SHARES,
    IntervalEstimate,
    Intervals,
    Outcomes,
    SampleSummary,
    outcomes,
    probability,
    summarise,
)
from .terminal import add_row, make_table

# Largest number of components of one column, such as joints; the rest is left out with a note.
COMPONENTS = 12

# Largest number of doubles of a curve that are read at once, 32 MiB.
BLOCK = 2**22


class StudyQuantity(NamedTuple):
    """Quantity with a number, or a curve of numbers, for each sample: a column, or one component of it.

    Attributes:
        key: name, such as "peak_force[joint=hinge_1]".
        column, place: column, and indices by dimension of the component in it.
        label, unit: description and unit for labels; "1" is no unit.
        whole: true if its numbers are integers or truth values.
        axis: dimension of a curve's axis, "" for a number. axis_words, axis_unit: for the axis' label.
    """

    key: str
    column: str
    place: dict[str, int]
    label: str
    unit: str
    whole: bool = False
    axis: str = ""
    axis_words: str = ""
    axis_unit: str = "1"


@dataclasses.dataclass(frozen=True)
class StudyData:
    """Dataset of a study with the meaning of its columns; made by `study_data`.

    Attributes:
        dataset: dataset as stored; columns are read when they are needed.
        status: status codes of the samples (n,).
        identity, reasons: identity of the study and reasons of failures, parsed from attributes.
        inputs, quantities, curves: inputs, quantities and curves of the study.
        notes: remarks on columns that are left out.
    """

    dataset: xr.Dataset
    status: np.ndarray
    identity: dict[str, Any]
    reasons: dict[int, str]
    inputs: tuple[StudyQuantity, ...]
    quantities: tuple[StudyQuantity, ...]
    curves: tuple[StudyQuantity, ...]
    notes: tuple[str, ...]

    @functools.cached_property
    def sampling(self) -> dict[str, Any]:
        """Plain form of the sampling design, found in the identity; empty if it has none."""
        return next(_read_samplings(self.identity), {})

    @property
    def design(self) -> str:
        """Name of the sampling design; "" if unknown."""
        return str(self.sampling.get("design", ""))

    @property
    def factors(self) -> tuple[str, ...]:
        """Columns of the sampling's factors, in their order."""
        plans = self.sampling.get("factors", ())
        names = plans if isinstance(plans, Mapping) else (plan["name"] for plan in plans)
        return tuple(column_name(str(name)) for name in names)

    @property
    def title(self) -> str:
        """Title of the study."""
        for place in (self.dataset.attrs, self.identity):
            for name in ("title", "name", "study"):
                if isinstance(place.get(name), str):
                    return place[name]
        return "Study"

    @functools.cached_property
    def chosen(self) -> np.ndarray:
        """Mask of the samples that share no factor values with others (n,)."""
        # A base point of Saltelli's design has d + 2 samples: A, B, and A with each column of B.
        row = len(self.factors) + 2 if self.design == "saltelli" else 1
        return np.arange(len(self.status)) % row < 2

    @functools.cached_property
    def computed(self) -> np.ndarray:
        """Increasing numbers of the computed samples among the chosen ones."""
        return np.flatnonzero(self.chosen & (self.status != MISSING))

    @functools.cached_property
    def completed(self) -> np.ndarray:
        """Increasing numbers of the completed samples among the chosen ones."""
        return np.flatnonzero(self.chosen & (self.status == FINE))

    def values(
        self,
        quantity: StudyQuantity,
        of: Literal["fine", "computed"] = "fine",
        limit: int | None = None,
    ) -> np.ndarray:
        """Values of the first `limit` chosen samples that are completed or computed."""
        # Inputs are judged over all computed samples, quantities over those that completed: others have none.
        numbers = (self.completed if of == "fine" else self.computed)[:limit]
        stop = int(numbers[-1]) + 1 if len(numbers) else 0
        # One slice is read, since a selection by numbers would open every chunk once for each.
        part = self.dataset[quantity.column].isel({"sample": slice(0, stop)} | quantity.place)
        return np.asarray(part.values, dtype=float)[numbers]

    def table(
        self, of: Literal["fine", "computed"] = "fine", limit: int | None = None
    ) -> np.ndarray:
        """Values of the inputs (n, d) of the samples as in `values`."""
        columns = [self.values(quantity, of, limit) for quantity in self.inputs]
        count = len((self.completed if of == "fine" else self.computed)[:limit])
        return np.stack(columns, axis=1) if columns else np.empty((count, 0))

    def curve(self, curve: StudyQuantity, limit: int) -> tuple[np.ndarray, np.ndarray]:
        """Axis (k,), and curves (m, k) of the first m <= `limit` completed samples."""
        numbers = self.completed[:limit]
        axis = np.asarray(self.dataset[curve.axis].values, dtype=float)
        part = self.dataset[curve.column].isel(curve.place).transpose("sample", curve.axis)
        size = max(1, BLOCK // max(len(axis), 1))
        parts = [np.empty((0, len(axis)))]
        # read in blocks, because the completed samples may lie far apart
        for start in range(0, int(numbers[-1]) + 1 if len(numbers) else 0, size):
            numbers_inside = numbers[(numbers >= start) & (numbers < start + size)] - start
            if len(numbers_inside):
                block = part.isel(sample=slice(start, start + size)).values
                parts.append(np.asarray(block, dtype=float)[numbers_inside])
        return axis, np.concatenate(parts)


def study_data(dataset: xr.Dataset) -> StudyData:
    """Read the meaning of a study's columns.

    Raises:
        FileError: no dimension "sample", not one status column, or attributes that are not JSON.
    """
    if "sample" not in dataset.dims:
        raise FileError(
            f"A study has the dimension 'sample', but the dataset has {list(dataset.dims)}."
        )
    roles = {str(name): variable.attrs.get("role") for name, variable in dataset.items()}
    status = [name for name, role in roles.items() if role == "status"]
    if len(status) != 1:
        raise FileError(f"A study has one column of the role 'status', but here are {status}.")
    identity = _read_json(dataset, "identity")
    reasons = {int(k): str(text) for k, text in _read_json(dataset, "reasons").items()}
    inputs, quantities, curves = ([] for _ in range(3))
    notes: list[str] = []
    for name, role in roles.items():
        if role not in ("input", "quantity") or "sample" not in dataset[name].dims:
            continue
        for part in _column_parts(dataset, name, notes):
            (curves if part.axis else inputs if role == "input" else quantities).append(part)
    codes = np.asarray(dataset[status[0]].values)
    fields: Any = (tuple(parts) for parts in (inputs, quantities, curves, notes))
    data = StudyData(dataset, codes, identity, reasons, *fields)
    # inputs in the order of the factors, since a folder may have sorted its columns
    place = {name: k for k, name in enumerate(data.factors)}
    inputs.sort(key=lambda part: place.get(part.key, len(place)))
    return dataclasses.replace(data, inputs=tuple(inputs))


def label_unit(text: str, unit: str) -> str:
    """Label with a unit in brackets."""
    return text if unit in ("", "1") else f"{text} [{unit}]"


def _column_parts(dataset: xr.Dataset, name: str, notes: list[str]) -> Iterator[StudyQuantity]:
    """Quantities and curves of a column."""
    variable = dataset[name]
    long_name = str(variable.attrs.get("long_name") or name.replace("_", " "))
    unit = str(variable.attrs.get("units", "1"))
    further = [str(dim) for dim in variable.dims if dim != "sample"]
    axis = _curve_axis(dataset, further)
    others = [dim for dim in further if dim != axis]
    places = list(itertools.product(*(range(dataset.sizes[dim]) for dim in others)))
    if len(places) > COMPONENTS:
        notes.append(
            f"Of the {len(places)} components of '{name}' the first {COMPONENTS} are shown."
        )
    for place in places[:COMPONENTS]:
        where = dict(zip(others, place, strict=True))
        of = lambda dim, k: dataset[dim].values[k] if dim in dataset.coords else k
        marks = {dim: str(of(dim, k)) for dim, k in where.items()}
        key, full_name = name, ", ".join([long_name, *marks.values()])
        if marks:
            key = f"{name}[{', '.join(f'{dim}={mark}' for dim, mark in marks.items())}]"
        if axis:
            attributes = dataset[axis].attrs
            axis_words = str(attributes.get("long_name") or axis.replace("_", " "))
            of_axis = axis, axis_words, str(attributes.get("units", "1"))
            yield StudyQuantity(key, name, where, full_name, unit, False, *of_axis)
        else:
            yield StudyQuantity(key, name, where, full_name, unit, variable.dtype.kind in "biu")


def _curve_axis(dataset: xr.Dataset, dims: list[str]) -> str | None:
    """Dimension of the curves' axis: time, or else the first that has numbers with a unit."""
    if "time" in dims:
        return "time"
    for dim in dims:
        # Numbers without a unit count components, such as joints, over which no curve is drawn.
        numbers = dim in dataset.coords and dataset[dim].dtype.kind in "iuf"
        if numbers and dataset[dim].attrs.get("units", "1") not in ("", "1"):
            return dim
    return None


def _read_json(dataset: xr.Dataset, name: str) -> dict[str, Any]:
    try:
        content = json.loads(dataset.attrs.get(name, "{}"))
    except (TypeError, ValueError) as error:
        raise FileError(f"The study's attribute '{name}' is not JSON: {error}.") from None
    if not isinstance(content, dict):
        raise FileError(f"The study's attribute '{name}' must be a JSON object.")
    return content


def _read_samplings(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, dict):
        if {"design", "seed", "factors"} <= set(value):
            yield value
        for inner in value.values():
            yield from _read_samplings(inner)


# Largest number of samples for first-order indices and rank correlations; more would change little.
ROWS = 100_000

# Numbers that the bootstrap of Sobol indices may sample per quantity, and fewest resamples.
DRAWS, RESAMPLES = 2**27, 199


class Influence(NamedTuple):
    """Sensitivity of one quantity to the inputs.

    Attributes:
        names: keys of the d inputs.
        indices: Sobol indices of a Saltelli study; None in others.
        first: first-order indices, from `indices` or by regression of the samples.
        ranks: Spearman's rank correlations; None where they are not defined.
        samples: number of samples behind the results.
        note: remark on the results, or the reason why there are none.
    """

    names: tuple[str, ...]
    indices: SobolIndices | None
    first: Intervals | None
    ranks: Intervals | None
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
        label: description of the event.
        probability: probability among the completed samples.
        samples: number of completed samples.
    """

    label: str
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
    sample_outcomes = outcomes(data.status[data.chosen], data.reasons, level)
    inputs = {q.key: summarise(data.values(q, "computed"), level=level) for q in data.inputs}
    # An input that does not vary has no influence, and a regression on it has no slope.
    varying = tuple(q for q in data.inputs if inputs[q.key].minimum != inputs[q.key].maximum)
    picked = [data.inputs.index(quantity) for quantity in varying]
    table = data.table(limit=ROWS)[:, picked]
    names = data.factors if data.design == "saltelli" else tuple(q.key for q in varying)
    findings = tuple(
        _analyse_quantity(data, quantity, names, table, level) for quantity in data.quantities
    )
    failing, notes = _failing_distance(data, picked), _study_notes(data)
    failure = _find_failure(data, level)
    return Analysis(
        len(data.status), sample_outcomes, level, inputs, varying, findings, failing, notes, failure
    )


def _find_failure(data: StudyData, level: float) -> Failing | None:
    """Declared failure among the completed samples; a NaN value does not count as a failure."""
    declared = data.identity.get("failure")
    quantities = {quantity.key: quantity for quantity in data.quantities}
    if not isinstance(declared, Mapping) or declared.get("quantity") not in quantities:
        return None
    quantity = quantities[declared["quantity"]]
    values = data.values(quantity)
    if not len(values):
        return None
    # the time of a crossing that never happens is infinite
    happened, description = np.isfinite(values), quantity.label.removeprefix("time at which ")
    limits = {k: declared[k] for k in ("above", "below") if k in declared}
    if limits:
        above, below = limits.get("above", math.inf), limits.get("below", -math.inf)
        happened = (values > above) | (values < below)
        unit = "" if quantity.unit in ("", "1") else f" {quantity.unit}"
        description = " or ".join(f"{side} {limit:g}{unit}" for side, limit in limits.items())
        description = f"{quantity.label} {description}"
    return Failing(description, probability(int(np.sum(happened)), len(values), level), len(values))


def is_event(quantity: StudyQuantity, values: np.ndarray) -> bool:
    """Test whether a quantity is a yes-or-no event: whole numbers 0 and 1 only."""
    return quantity.whole and len(values) > 0 and bool(np.all((values == 0) | (values == 1)))


def _analyse_quantity(
    data: StudyData,
    quantity: StudyQuantity,
    names: tuple[str, ...],
    table: np.ndarray,
    level: float,
) -> QuantityAnalysis:
    values, event = data.values(quantity), None
    if is_event(quantity, values):
        event = probability(int(np.sum(values)), len(values), level)
    if data.design == "saltelli":
        influence = _sobol_influence(data, quantity, names, level)
    else:
        influence = _from_samples(names, table, values[:ROWS], level)
    return QuantityAnalysis(quantity, summarise(values, SHARES, level), event, influence)


def _sobol_influence(
    data: StudyData, quantity: StudyQuantity, names: tuple[str, ...], level: float
) -> Influence:
    # More resamples where they are cheap; 199 give the ends of a 95 % interval well enough.
    resamples = min(499, max(RESAMPLES, DRAWS // max(len(data.status), 1)))
    # Indices need the samples in their places, failed ones included, since a base point counts
    # whole or not at all.
    column = data.dataset[quantity.column].isel(quantity.place)
    values = np.asarray(column.values, dtype=float)
    try:
        indices = sobol(values, data.status, len(names), level=level, resamples=resamples)
    except SettingError as error:
        return Influence(names, None, None, None, 0, str(error))
    note = f"{indices.used} base points"
    note += f", {indices.lost} lost to failures" if indices.lost else ""
    samples = indices.used * (len(names) + 2)
    return Influence(names, indices, indices.first, None, samples, note)


def _from_samples(
    names: tuple[str, ...], table: np.ndarray, values: np.ndarray, level: float
) -> Influence:
    if not names:
        return Influence(names, None, None, None, 0, "No input varies.")
    is_defined = ~np.isnan(values)
    table, values = table[is_defined], values[is_defined]
    first, ranks, note = None, None, ""
    try:
        ranks = spearman(table, values, level)
        if np.any(np.isinf(values)):
            from scipy.stats import rankdata

            # An event that never happens has an infinite time: ranks have a variance, the times have none.
            values, note = rankdata(values), "shares are of the ranks, since values are infinite"
        # Any design gives first-order shares by regression on one input at a time; totals need Saltelli's.
        first = spline_shares(table, values, level)
    except SettingError as error:
        note = str(error)
    return Influence(names, None, first, ranks, len(values), note)


def _failing_distance(data: StudyData, picked: list[int]) -> np.ndarray | None:
    numbers = data.computed[:ROWS]
    failed = ~np.isin(numbers, data.completed)
    # A distance is between two groups: without failed samples, or without others, there is none.
    if not picked or not np.any(failed) or np.all(failed):
        return None
    return separation(data.table("computed", ROWS)[:, picked], failed)


def _study_notes(data: StudyData) -> tuple[str, ...]:
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


def plain_analysis(analysis: Analysis) -> dict[str, Any]:
    """Plain data of the analysis for JSON; infinite numbers are the words "inf" and "-inf"."""
    o = analysis.outcomes
    reasons = {
        code: {"words": description, "count": o.codes.get(code, 0), "probability": share}
        for code, (description, share) in o.reasons.items()
    }
    samples = {
        "total": analysis.total, "not_computed": o.missing, "completed": o.successful,
        "not_completed": o.failed, "share_not_completed": o.failure, "reasons": reasons,
    }  # fmt: skip
    quantities = {
        finding.quantity.key: {
            "words": finding.quantity.label, "unit": finding.quantity.unit,
            **finding.summary._asdict(), "probability": finding.event,
            "influence": _plain_influence(finding.influence),
        }
        for finding in analysis.findings
    }  # fmt: skip
    names = [quantity.key for quantity in analysis.varying]
    failing = analysis.failing
    differences = None if failing is None else dict(zip(names, failing, strict=True))
    return to_json({
        "level": analysis.level, "samples": samples, "failure": analysis.failure,
        "inputs": analysis.inputs, "quantities": quantities, "failures_differ_in": differences,
        "notes": analysis.notes,
    })  # fmt: skip


def to_json(value: Any) -> Any:
    """Plain data for JSON: tuples with names become tables; infinite numbers are words, and NaN is None."""
    if hasattr(value, "_asdict"):
        return to_json(value._asdict())
    if isinstance(value, Mapping):
        return {f"{k:g}" if isinstance(k, float) else str(k): to_json(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [to_json(inner) for inner in value]
    if isinstance(value, float):
        # JSON has neither NaN nor infinity, and strict readers refuse them.
        return None if math.isnan(value) else float(value) if math.isfinite(value) else str(value)
    return value


def _plain_influence(influence: Influence) -> dict[str, Any]:
    def shares(part: Intervals | None) -> dict[str, Any] | None:
        if part is None:
            return None
        rows = zip(part.value.tolist(), part.low.tolist(), part.high.tolist(), strict=True)
        return dict(zip(influence.names, (IntervalEstimate(*row) for row in rows), strict=True))

    indices = influence.indices
    return {
        "sobol_first": shares(indices.first if indices else None),
        "sobol_total": shares(indices.total if indices else None),
        "share": None if indices else shares(influence.first),
        "rank_correlation": shares(influence.ranks),
        "samples": influence.samples,
        "note": influence.note,
    }


# Largest number of rows of the table; the report has all.
_MOST = 24


def summary_table(analysis: Analysis) -> Table:
    """Table of mean and quantiles of every quantity over the completed samples."""
    rich_table = make_table("quantity", "mean", "5 %", "median", "95 %", right=1)
    for finding in analysis.findings[:_MOST]:
        summary = finding.summary
        quantiles = [summary.quantiles.get(share) for share in (0.05, 0.5, 0.95)]
        cells = [_format_cell(number) for number in (summary.mean, *quantiles)]
        add_row(rich_table, label_unit(finding.quantity.label, finding.quantity.unit), *cells)
    if len(analysis.findings) > _MOST:
        rich_table.caption = f"{_MOST} of {len(analysis.findings)} quantities; the report has all."
    return rich_table


def _format_cell(number: IntervalEstimate | float | None) -> str:
    value = number.value if isinstance(number, IntervalEstimate) else number
    if value is None or math.isnan(value):
        return ""
    return f"{value:.4g}" if math.isfinite(value) else ("never" if value > 0 else "-infinite")


def summary_lines(analysis: Analysis) -> list[str]:
    """Lines with the samples' outcomes, and the probability of the declared failure."""
    o = analysis.outcomes
    lines = [
        f"{o.successful:,} samples completed, {o.failed:,} did not complete, {o.missing:,} not computed."
    ]
    lines += [
        f"  did not complete: {o.codes.get(code, 0):,}, {description}"
        for code, (description, _) in o.reasons.items()
        if o.codes.get(code, 0)
    ]
    if analysis.failure:
        event, estimate, samples = analysis.failure
        ends = "" if estimate.low is None or estimate.high is None else (
            f" ({100 * estimate.low:.3g} to {100 * estimate.high:.3g} % with {100 * analysis.level:g} %)"
        )  # fmt: skip
        lines.append(
            f"Probability of failure ({event}): {100 * estimate.value:.3g} %{ends}, among {samples:,} "
            "completed."
        )
    return lines


def save_summary(data: StudyData, analysis: Analysis, path: str | os.PathLike[str]) -> Path:
    """Write the analysis with the study's identity as JSON, atomically; return the path."""
    head = {"format": "stmuav_jax study summary", "format_version": 1, "title": data.title}
    content = head | plain_analysis(analysis) | {"identity": to_json(data.identity)}
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    return write_atomically(path, text.encode())
