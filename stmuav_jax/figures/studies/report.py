"""Report of a study: figures, a self-contained page, and a summary for programs."""

import json
import os
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from ...files.layout import flattened
from ...files.netcdf import write_atomically
from ...montecarlo.sensitivity import IndexIntervals
from ...montecarlo.statistics import LEVEL, IntervalEstimate, SampleSummary
from ...montecarlo.work import column_name
from ..page import (
    Picture,
    check_format,
    drawn,
    framed,
    html_table,
    number_text,
    short,
    text,
)
from . import plot, region
from .analysis import Analysis, QuantityAnalysis, analyse, number, plain
from .data import StudyData, label, study_data
from .plot import strength

FORMAT, FORMAT_VERSION = "stmuav_jax study summary", 1

# Functions and captions of the figures, by name.
FIGURES: Mapping[str, tuple[Callable[[StudyData, Analysis], Figure | None], str]] = {
    "quantities": (plot.quantities, "How the quantities are distributed"),
    "fans": (plot.fans, "Curves: quantiles at each place, and some single samples"),
    "failures": (region.failures, "Where runs did not complete"),
    "sensitivities": (region.sensitivities, "Which inputs decide"),
    "scatter": (plot.scatter, "Quantities against the inputs that decide most"),
    "settling": (region.settling, "How estimates settle with the number of samples"),
    "inputs": (plot.inputs, "What was drawn"),
}
EVENTS = 4  # largest number of events with a figure of their own

_DESIGNS = {
    "random": "independent random draws",
    "latin": "Latin hypercubes of {stratum} samples each",
    "sobol": "a scrambled Sobol sequence",
    "saltelli": "base points of a scrambled Sobol sequence, for Sobol indices",
    "table": "the rows of a given table",
}


def write_report(
    dataset: xr.Dataset,
    folder: str | os.PathLike[str],
    format: str = "png",
    *,
    level: float = LEVEL,
    dpi: int = 160,
    analysis: Analysis | None = None,
) -> list[Path]:
    """Write `report.html`, `summary.json` and the figures in `figures/`; return their paths.

    Columns are read one by one, so memory is bounded by a few of them. The page contains its
    figures (png, svg), or refers to them (pdf). Each file is written atomically.

    Args:
        dataset: dataset of a study, as described in `study_data`.
        folder: folder of the files.
        format: format of the figures: "png", "svg" or "pdf".
        level: confidence level of all intervals.
        dpi: resolution of the figures [dots per inch].
        analysis: analysis of the dataset, if it is known already.

    Raises:
        FileError: the dataset is not a study.
        SettingError: another format or an impossible level.
    """
    check_format(format)
    data = study_data(dataset)
    analysis = analyse(data, level) if analysis is None else analysis
    place = Path(folder)
    paths, shown = drawn(_figures(data, analysis), place, format, dpi)
    page = _page(data, analysis, shown)
    summary = json.dumps(_summary_file(data, analysis), indent=1, allow_nan=False) + "\n"
    return [
        write_atomically(place / "report.html", page.encode()),
        write_atomically(place / "summary.json", summary.encode()),
        *paths,
    ]


def _figures(data: StudyData, analysis: Analysis) -> Iterator[Picture]:
    """Figures with their names and captions, one at a time."""
    for name, (draw, words) in FIGURES.items():
        figure = draw(data, analysis)
        if figure is not None:
            yield Picture(name, words, figure)
    events = [one.quantity for one in analysis.findings if one.event][:EVENTS]
    for k, one in enumerate(events):
        figure = region.event(data, analysis, one)
        if figure is not None:
            yield Picture(f"event_{k + 1}", f"Where it is so: {one.words}", figure)


def _summary_file(data: StudyData, analysis: Analysis) -> dict[str, Any]:
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "title": data.title}
    return head | plain(analysis) | {"identity": _finite(data.identity)}


def _finite(value: Any) -> Any:
    """Plain data in which infinite numbers are replaced by words, for JSON."""
    if isinstance(value, Mapping):
        return {name: _finite(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_finite(inner) for inner in value]
    return number(value) if isinstance(value, float) else value


# --- the page


def _page(data: StudyData, analysis: Analysis, figures: list[str]) -> str:
    parts = [
        f"<h1>{text(data.title)}</h1>",
        f"<p>{_lead(analysis)}</p>",
        "".join(f"<p>{text(note)}</p>" for note in analysis.notes),
        "<h2>How the samples ended</h2>", _outcomes(analysis),
        _quantities(analysis), _events(analysis), _decide(data, analysis),
        "<h2>Figures</h2>", *(figures or ["<p>There is nothing to draw.</p>"]),
        "<h2>What was drawn</h2>", _sampling(data, analysis),
        "<h2>The study</h2>", _identity(data),
    ]  # fmt: skip
    return framed(data.title, parts)


def _lead(analysis: Analysis) -> str:
    o = analysis.outcomes
    used = o.successful + o.failed + o.missing
    words = "1 sample" if analysis.total == 1 else f"{analysis.total:,} samples"
    if used < analysis.total:
        words += f", of which {used:,} are independent of each other"
    words += f": {o.successful:,} completed, {o.failed:,} did not complete, "
    words += f"{o.missing:,} not computed. "
    if o.failure and o.failed:
        words += f"Share of runs that did not complete: {_percent(o.failure)}. "
    if analysis.failure:
        event, probability = text(analysis.failure.words), _percent(analysis.failure.probability)
        words += f"Probability of failure among those completed ({event}): {probability}. "
    return words + f"All intervals hold with {100 * analysis.level:g} %, each by itself."


def _outcomes(analysis: Analysis) -> str:
    o = analysis.outcomes
    rows = [["completed", f"{o.successful:,}", "", ""]]
    for code, (words, share) in o.reasons.items():
        rows.append(
            [f"did not complete: {words}", f"{o.codes.get(code, 0):,}", _percent(share), f"{code}"]
        )
    rows.append(["not computed", f"{o.missing:,}", "", ""])
    head = ["", "samples", "probability among the computed", "code"]
    return html_table(head, [[text(row[0]), *row[1:]] for row in rows])


def _quantities(analysis: Analysis) -> str:
    found = [one for one in analysis.findings if one.event is None]
    if not found:
        return ""
    rows = []
    for one in found:
        words = text(label(one.quantity.words, one.quantity.unit))
        rows.append([words + _remarks(one.summary), *_statistics(one.summary)])
    head = ["", "values", "mean", "std. dev.", "5 %", "median", "95 %", "minimum", "maximum"]
    return "<h2>Quantities, over the completed samples</h2>" + html_table(head, rows)


def _statistics(one: SampleSummary) -> list[str]:
    quantiles = [_estimate(one.quantiles.get(share)) for share in (0.05, 0.5, 0.95)]
    spread = [_estimate(one.mean), _estimate(one.standard_deviation)]
    return [
        f"{one.values:,}",
        *spread,
        *quantiles,
        number_text(one.minimum),
        number_text(one.maximum),
    ]


def _remarks(one: SampleSummary) -> str:
    found = []
    if one.infinite_probability:
        found.append(f"infinite, so without a mean: {_percent(one.infinite_probability)}")
    if one.undefined:
        found.append(f"undefined in {one.undefined:,} samples")
    return "".join(f"<br><small>{text}</small>" for text in found)


def _events(analysis: Analysis) -> str:
    rows = [
        [text(one.quantity.words), f"{one.summary.values:,}", _percent(one.event)]
        for one in analysis.findings
        if one.event
    ]
    if not rows:
        return ""
    head = ["", "completed samples", "probability"]
    return "<h2>Events, among the completed samples</h2>" + html_table(head, rows)


def _decide(data: StudyData, analysis: Analysis) -> str:
    """Table of the inputs for each quantity, the most influential first."""
    if not analysis.findings or not analysis.varying:
        return ""
    words = {one.key: one.words for one in data.inputs}
    if data.design == "saltelli":
        said = "Sobol indices: shares of the variance that an input decides alone, and with interactions."
    else:
        said = (
            "Share: of the variance that an input alone decides, estimated from bins of the samples; "
            "correlation: Spearman's, of ranks."
        )
    tables = [_influences(one, words) for one in analysis.findings]
    return f'<h2>Which inputs decide</h2><p>{said}</p><div class="side">{"".join(tables)}</div>'


def _influences(one: QuantityAnalysis, words: Mapping[str, str]) -> str:
    found = one.influence
    title = text(one.quantity.words)
    remark = f"<p><small>{text(found.note)}</small></p>" if found.note else ""
    if found.first is None and found.ranks is None:
        return f"<div><p><strong>{title}</strong></p>{remark}</div>"
    order = (-strength(one)).argsort(kind="stable")
    if found.indices:
        head = ["", "alone", "with interactions"]
        columns = [_interval(part) for part in (found.indices.first, found.indices.total)]
    else:
        head, columns = ["", "share", "correlation"], []
        shares = found.first if found.first is not None else []
        columns.append([_small(x) for x in shares] or ["" for _ in found.names])
        columns.append(_interval(found.ranks) if found.ranks else ["" for _ in found.names])
        if found.noise_bound is not None:
            bound = _small(found.noise_bound)
            remark += f"<p><small>by chance shares stay below {bound}</small></p>"
    rows = [
        [text(words.get(found.names[k], found.names[k])), *(c[k] for c in columns)] for k in order
    ]
    return f"<div>{html_table(head, rows, title)}{remark}</div>"


def _sampling(data: StudyData, analysis: Analysis) -> str:
    given = data.sampling
    rows = []
    plans = given.get("factors", [])
    if isinstance(plans, Mapping):
        plans = [{"name": name} | dict(one) for name, one in plans.items()]
    laws = {column_name(str(one["name"])): _law(one) for one in plans}
    for one in data.inputs:
        summary = analysis.inputs[one.key]
        known = [_estimate(summary.mean), _estimate(summary.standard_deviation)]
        ends = [number_text(summary.minimum), number_text(summary.maximum)]
        rows.append([text(label(one.words, one.unit)), text(laws.get(one.key, "")), *known, *ends])
    head = ["", "distribution", "mean drawn", "standard deviation drawn", "minimum", "maximum"]
    words = ""
    if given:
        design = _DESIGNS.get(data.design, data.design).format(stratum=given.get("stratum"))
        words = f"<p>Drawn by {text(design)}, seed {text(given['seed'])}.</p>"
        for a, b, rho in given.get("correlation", []):
            words += f"<p>Correlation of {text(a)} and {text(b)} (normal copula): {rho:g}.</p>"
    return words + (html_table(head, rows, left=(1,)) if rows else "<p>No inputs.</p>")


def _law(one: Mapping[str, Any]) -> str:
    rest = [f"{k} {short(v)}" for k, v in one.items() if k not in ("name", "distribution")]
    return ", ".join([str(one.get("distribution", "")).replace("_", " "), *rest])


def _identity(data: StudyData) -> str:
    entries = flattened(data.identity, left_out=data.sampling)
    rows = [[text(name), text(short(value))] for name, value in entries if value != {}]
    rows += [
        [text(name), text(short(value))]
        for name, value in data.dataset.attrs.items()
        if name not in ("identity", "reasons", "title")
    ]
    return html_table(["", ""], rows, left=(1,)) if rows else "<p>Nothing is known of it.</p>"


# --- small pieces of text


def _small(value: float) -> str:
    return f"{round(float(value), 3) + 0.0:.3f}".replace("-", "\N{MINUS SIGN}")


def _estimate(one: IntervalEstimate | None) -> str:
    """Text of a number with its interval below it."""
    if one is None:
        return ""
    if one.low is None and one.high is None:
        return number_text(one.value)
    low, high = (number_text(end) or "open" for end in (one.low, one.high))
    if low == high:
        return number_text(one.value)
    return f"{number_text(one.value)}<br><small>{low} to {high}</small>"


def _percent(one: IntervalEstimate | None) -> str:
    if one is None:
        return ""
    ends = "" if one.low is None or one.high is None else (
        f" <small>({100 * one.low:.3g} to {100 * one.high:.3g} %)</small>"
    )  # fmt: skip
    return f"{100 * one.value:.3g} %{ends}"


def _interval(one: IndexIntervals) -> list[str]:
    rows = zip(one.value, one.low, one.high, strict=True)
    return [f"{_small(v)} <small>{_small(a)} to {_small(b)}</small>" for v, a, b in rows]
