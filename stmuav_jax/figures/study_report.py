"""Report of a study: figures, a self-contained page, and a summary for programs."""

import base64
import html
import io
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import xarray as xr
from matplotlib.figure import Figure

from ..checks.errors import SettingError, nearest_names
from ..files.layout import flattened
from ..files.netcdf import write_atomically
from ..montecarlo.sensitivity import IndexIntervals
from ..montecarlo.statistics import LEVEL, IntervalEstimate, SampleSummary
from ..montecarlo.study import column_name
from . import study_plot, study_region
from .study_analysis import Analysis, QuantityAnalysis, analyse, number, plain
from .study_data import StudyData, label, study_data
from .study_plot import strength

FORMAT, FORMAT_VERSION = "stmuav_jax study summary", 1

# Functions and captions of the figures, by name.
FIGURES: Mapping[str, tuple[Callable[[StudyData, Analysis], Figure | None], str]] = {
    "quantities": (study_plot.quantities, "How the quantities are distributed"),
    "fans": (study_plot.fans, "Curves: quantiles at each place, and some single samples"),
    "failures": (study_region.failures, "Where runs did not complete"),
    "sensitivities": (study_region.sensitivities, "Which inputs decide"),
    "scatter": (study_plot.scatter, "Quantities against the inputs that decide most"),
    "settling": (study_region.settling, "How estimates settle with the number of samples"),
    "inputs": (study_plot.inputs, "What was drawn"),
}
EVENTS = 4  # largest number of events with a figure of their own

# Media types of figures embedded in the page; a figure without one is a file beside it.
_TYPES = {"png": "image/png", "svg": "image/svg+xml", "pdf": ""}

_DESIGNS = {
    "random": "independent random draws",
    "latin": "Latin hypercubes of {stratum} samples each",
    "sobol": "a scrambled Sobol sequence",
    "saltelli": "base points of a scrambled Sobol sequence, for Sobol indices",
    "table": "the rows of a given table",
}

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; color: #222; max-width: 70rem; margin: 2rem auto;
       padding: 0 1rem; }
h1 { font-size: 1.6rem; } h2 { font-size: 1.2rem; margin-top: 2.2rem; }
table { border-collapse: collapse; margin: 0.8rem 0; font-size: 0.86rem; }
th, td { padding: 0.25rem 0.6rem; text-align: right; border-bottom: 1px solid #ddd;
         vertical-align: top; font-variant-numeric: tabular-nums; }
th { border-bottom: 1px solid #888; } caption { text-align: left; font-weight: 600; }
th:first-child, td:first-child, td.text, th.text { text-align: left; }
td { white-space: nowrap; } td:first-child, td.text { white-space: normal; min-width: 9rem; }
small { color: #666; }
figure { margin: 1.4rem 0; } figcaption { font-weight: 600; } img { max-width: 56rem; width: 100%; }
.wide { overflow-x: auto; } .side { display: grid; gap: 0 2rem; align-items: start;
  grid-template-columns: repeat(auto-fill, minmax(30rem, 1fr)); }
.side p { margin: 0.2rem 0; }
@media print { body { margin: 0; max-width: none; font-size: 9pt; } h2 { break-after: avoid; }
  table { font-size: 7.5pt; } th, td { padding: 0.15rem 0.4rem; }
  figure, tr, .side > div { break-inside: avoid; } .wide { overflow: visible; }
  .side { grid-template-columns: 1fr 1fr; gap: 0 1rem; } }
"""


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
    if format not in _TYPES:
        raise SettingError(f"Figures cannot be '{format}'.{nearest_names(format, _TYPES)}")
    data = study_data(dataset)
    analysis = analyse(data, level) if analysis is None else analysis
    place, paths, shown = Path(folder), [], []
    for name, words, figure in _figures(data, analysis):
        buffer = io.BytesIO()
        figure.savefig(buffer, format=format, dpi=dpi)
        path = write_atomically(place / "figures" / f"{name}.{format}", buffer.getvalue())
        paths.append(path)
        shown.append(_embedded(path, words, buffer.getvalue(), _TYPES[format]))
    page = _page(data, analysis, shown)
    summary = json.dumps(_summary_file(data, analysis), indent=1, allow_nan=False) + "\n"
    return [
        write_atomically(place / "report.html", page.encode()),
        write_atomically(place / "summary.json", summary.encode()),
        *paths,
    ]


def _figures(data: StudyData, analysis: Analysis) -> Iterator[tuple[str, str, Figure]]:
    """Figures with their names and captions, one at a time."""
    for name, (draw, words) in FIGURES.items():
        figure = draw(data, analysis)
        if figure is not None:
            yield name, words, figure
    events = [one.quantity for one in analysis.findings if one.event][:EVENTS]
    for k, one in enumerate(events):
        figure = study_region.event(data, analysis, one)
        if figure is not None:
            yield f"event_{k + 1}", f"Where it is so: {one.words}", figure


def _embedded(path: Path, words: str, content: bytes, kind: str) -> str:
    if not kind:
        return f'<p><a href="figures/{_text(path.name)}">{_text(words)}</a></p>'
    source = f"data:{kind};base64,{base64.b64encode(content).decode()}"
    text = _text(words)
    return f'<figure><figcaption>{text}</figcaption><img alt="{text}" src="{source}"></figure>'


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
        f"<h1>{_text(data.title)}</h1>",
        f"<p>{_lead(analysis)}</p>",
        "".join(f"<p>{_text(note)}</p>" for note in analysis.notes),
        "<h2>How the samples ended</h2>", _outcomes(analysis),
        _quantities(analysis), _events(analysis), _decide(data, analysis),
        "<h2>Figures</h2>", *(figures or ["<p>There is nothing to draw.</p>"]),
        "<h2>What was drawn</h2>", _sampling(data, analysis),
        "<h2>The study</h2>", _identity(data),
    ]  # fmt: skip
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{_text(data.title)}</title>\n<style>{_STYLE}</style></head>\n"
        f"<body>\n{body}\n</body></html>\n"
    )


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
        event, probability = _text(analysis.failure.words), _percent(analysis.failure.probability)
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
    return _table(head, [[_text(row[0]), *row[1:]] for row in rows])


def _quantities(analysis: Analysis) -> str:
    found = [one for one in analysis.findings if one.event is None]
    if not found:
        return ""
    rows = []
    for one in found:
        words = _text(label(one.quantity.words, one.quantity.unit))
        rows.append([words + _remarks(one.summary), *_statistics(one.summary)])
    head = ["", "values", "mean", "std. dev.", "5 %", "median", "95 %", "minimum", "maximum"]
    return "<h2>Quantities, over the completed samples</h2>" + _table(head, rows)


def _statistics(one: SampleSummary) -> list[str]:
    quantiles = [_estimate(one.quantiles.get(share)) for share in (0.05, 0.5, 0.95)]
    spread = [_estimate(one.mean), _estimate(one.standard_deviation)]
    return [f"{one.values:,}", *spread, *quantiles, _number(one.minimum), _number(one.maximum)]


def _remarks(one: SampleSummary) -> str:
    found = []
    if one.infinite_probability:
        found.append(f"infinite, so without a mean: {_percent(one.infinite_probability)}")
    if one.undefined:
        found.append(f"undefined in {one.undefined:,} samples")
    return "".join(f"<br><small>{text}</small>" for text in found)


def _events(analysis: Analysis) -> str:
    rows = [
        [_text(one.quantity.words), f"{one.summary.values:,}", _percent(one.event)]
        for one in analysis.findings
        if one.event
    ]
    if not rows:
        return ""
    head = ["", "completed samples", "probability"]
    return "<h2>Events, among the completed samples</h2>" + _table(head, rows)


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
    title = _text(one.quantity.words)
    remark = f"<p><small>{_text(found.note)}</small></p>" if found.note else ""
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
        [_text(words.get(found.names[k], found.names[k])), *(c[k] for c in columns)] for k in order
    ]
    return f"<div>{_table(head, rows, title)}{remark}</div>"


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
        ends = [_number(summary.minimum), _number(summary.maximum)]
        rows.append(
            [_text(label(one.words, one.unit)), _text(laws.get(one.key, "")), *known, *ends]
        )
    head = ["", "distribution", "mean drawn", "standard deviation drawn", "minimum", "maximum"]
    words = ""
    if given:
        design = _DESIGNS.get(data.design, data.design).format(stratum=given.get("stratum"))
        words = f"<p>Drawn by {_text(design)}, seed {_text(given['seed'])}.</p>"
        for a, b, rho in given.get("correlation", []):
            words += f"<p>Correlation of {_text(a)} and {_text(b)} (normal copula): {rho:g}.</p>"
    return words + (_table(head, rows, text=(1,)) if rows else "<p>No inputs.</p>")


def _law(one: Mapping[str, Any]) -> str:
    rest = [f"{k} {_short(v)}" for k, v in one.items() if k not in ("name", "distribution")]
    return ", ".join([str(one.get("distribution", "")).replace("_", " "), *rest])


def _identity(data: StudyData) -> str:
    entries = flattened(data.identity, left_out=data.sampling)
    rows = [[_text(name), _text(_short(value))] for name, value in entries if value != {}]
    rows += [
        [_text(name), _text(_short(value))]
        for name, value in data.dataset.attrs.items()
        if name not in ("identity", "reasons", "title")
    ]
    return _table(["", ""], rows, text=(1,)) if rows else "<p>Nothing is known of it.</p>"


# --- small pieces of text


def _text(value: Any) -> str:
    return html.escape(str(value))


def _short(value: Any) -> str:
    if isinstance(value, list) and len(value) > 8:
        return f"{', '.join(_short(x) for x in value[:3])}, ... ({len(value):,} in all)"
    if isinstance(value, list):
        return ", ".join(_short(x) for x in value)
    text = f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 300 else f"{text[:300]} ..."


def _number(value: float | None) -> str:
    if value is None or math.isnan(value):
        return ""
    if math.isinf(value):
        return "infinite" if value > 0 else "\N{MINUS SIGN}infinite"
    return f"{value:.4g}".replace("-", "\N{MINUS SIGN}")


def _small(value: float) -> str:
    return f"{round(float(value), 3) + 0.0:.3f}".replace("-", "\N{MINUS SIGN}")


def _estimate(one: IntervalEstimate | None) -> str:
    """Text of a number with its interval below it."""
    if one is None:
        return ""
    if one.low is None and one.high is None:
        return _number(one.value)
    low, high = (_number(end) or "open" for end in (one.low, one.high))
    if low == high:
        return _number(one.value)
    return f"{_number(one.value)}<br><small>{low} to {high}</small>"


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


def _table(
    head: list[str], rows: Iterable[list[str]], title: str = "", text: tuple[int, ...] = ()
) -> str:
    """HTML table of cells that are HTML already; columns in `text` are left-aligned."""
    mark = lambda k: ' class="text"' if k in text else ""
    cells = lambda row, tag: "".join(f"<{tag}{mark(k)}>{x}</{tag}>" for k, x in enumerate(row))
    top = f"<thead><tr>{cells(head, 'th')}</tr></thead>" if any(head) else ""
    body = "".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    name = f"<caption>{title}</caption>" if title else ""
    return f'<div class="wide"><table>{name}{top}<tbody>{body}</tbody></table></div>'
