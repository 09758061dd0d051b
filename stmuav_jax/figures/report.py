"""Report page of a result in one self-contained HTML file: verdict, tables of numbers and settings, figures.

A result is the dataset of a run, a closed loop, filters with known truth or a study, or a `FilterRecord`. The
template `report.html` next to this module serves all results.
"""

import base64
import itertools
import json
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jinja2
import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..io.netcdf import FORMAT, LOOP_FORMAT, FileError, flatten_tables, write_atomically
from ..studies.statistics import IntervalEstimate
from . import filter_record
from .filter_record import FilterRecord, error_figure, record_of_dataset
from .plot import draw_histories, figure_content
from .run import FIGURES, draw_loads, saved_loads
from .study import study_figures
from .study_data import Analysis, analyse, label_unit, study_data, summary_lines

_MEDIA_TYPES = {"png": "image/png", "svg": "image/svg+xml"}
# Curves in a panel of inputs, and states of a filter in a figure.
_CURVES, _STATES = 4, 6

Verdict = tuple[str, bool | None]
Captioned = tuple[str, Figure]


class ReportTable(NamedTuple):
    """Table of a report: title, heads of the columns or none, and rows of cells."""

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[Any]]


class _Content(NamedTuple):
    title: str
    verdicts: list[Verdict]
    tables: Sequence[ReportTable]
    figures: Iterable[Captioned]


def write_report(
    result: xr.Dataset | FilterRecord,
    path: str | os.PathLike[str],
    format: Literal["png", "svg"] = "png",
    *,
    dpi: int = 160,
    verdict: Verdict | None = None,
    tables: Sequence[ReportTable] = (),
    figures: Iterable[Captioned] = (),
    analysis: Analysis | None = None,
) -> Path:
    """Write a self-contained page about a result, atomically; return its path.

    Args:
        result: dataset of a run, a closed loop, an estimation or a study, as `stm.load` and
            `stm.studies.open_store` read them, or record of filters.
        path: path of the page.
        format: format of the embedded figures. dpi: their resolution [dots per inch].
        verdict: sentence on the result and whether it is good, in place of its own.
        tables: tables before those of the result. figures: captions and figures before its own.
        analysis: analysis of a study, if it is known already.

    Raises:
        FileError: the dataset is no result of this package.
    """
    kind = "" if isinstance(result, FilterRecord) else result.attrs.get("format", "")
    if isinstance(result, FilterRecord):
        page = _of_filters(result)
    elif "sample" in result.dims:
        page = _of_study(result, analysis)
    elif kind in (FORMAT, LOOP_FORMAT):
        page = _of_motion(result)
    elif kind == filter_record.FORMAT:
        page = _of_filters(record_of_dataset(result))
    else:
        raise FileError(
            "A report needs a run, a closed loop, a filter record or a study, but the dataset has the "
            f"format '{kind}'."
        )
    embedded_figures = []
    for caption, figure in itertools.chain(figures, page.figures):
        # Pictures within the page: one file that can be sent and kept.
        code = base64.b64encode(figure_content(figure, format, dpi)).decode()
        embedded_figures.append((caption, f"data:{_MEDIA_TYPES[format]};base64,{code}"))
    source = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    # Names come from users' files; escaped, they cannot become elements of the page.
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(source)
    text = template.render(
        title=page.title, verdicts=page.verdicts if verdict is None else [verdict],
        tables=[*tables, *page.tables], figures=embedded_figures,
    )  # fmt: skip
    return write_atomically(path, text.encode())


def _of_motion(data: xr.Dataset) -> _Content:
    """Content of a run or of a closed loop."""
    certificate, failure = json.loads(data.attrs["certificate"]), data.attrs.get("failure", "")
    ending = f"It ended at t = {certificate['t_end']:g} s: {certificate['result']}."
    verdict_text = failure or ending
    if certificate.get("position_error") is not None:
        verdict_text += (
            f" Its distance from the exact motion is estimated as at most {certificate['position_error']:.2g} m "
            f"and {certificate['angle_error']:.2g} rad."
        )
    is_good = certificate["result"] in ("successful", "event occurred") and not failure
    entries = {k.replace("_", " "): v for k, v in certificate.items() if v is not None}
    accuracy = [(name, _shorten_data(value)) for name, value in entries.items()]
    title = str(data.attrs.get("title") or data.attrs.get("scene") or "Run")
    captioned_figures = [(name.capitalize(), draw(data)) for name, draw in FIGURES.items()]
    figures = [(caption, figure) for caption, figure in captioned_figures if figure is not None]
    loads = saved_loads(data)
    if loads is not None:
        figures.append(("Reaction loads at the saved times", draw_loads(title, loads)))
    if data.sizes.get("input", 0):
        names, units = (data[name].values.astype(str) for name in ("input", "input_unit"))
        panels = []
        # Inputs of one unit share an axis, a few curves in each panel.
        for unit in dict.fromkeys(units):
            group = np.flatnonzero(units == unit)
            for places in (group[k : k + _CURVES] for k in range(0, len(group), _CURVES)):
                labels = tuple(f"{names[k]} {k + 1}" for k in places)
                panels.append((f"input [{unit}]", labels, data["command"].values[:, places]))
        histories = draw_histories(title, data["time"].values, panels)
        figures.append(("Inputs from the controller", histories))
    notes = [(f"Note: {note}", None) for note in json.loads(data.attrs.get("notes", "[]"))]
    tables = [ReportTable("Accuracy", (), accuracy), *_settings_tables(data)]
    return _Content(title, [(verdict_text, is_good), *notes], tables, figures)


def _settings_tables(data: xr.Dataset) -> list[ReportTable]:
    """Tables of the settings, of the parameters that were changed, and of the versions."""
    read = lambda name: json.loads(data.attrs.get(name, "{}"))
    ts, mission = data["time"].values, read("mission")
    rows = [
        ("scene", data.attrs.get("scene", "")), ("date", data.attrs.get("date", "")),
        ("saved times", f"{len(ts):,}, from {ts[0]:g} s to {ts[-1]:g} s"),
        *((name.replace("_", " "), _shorten_data(value)) for name, value in flatten_tables(read("settings"))),
        *(
            (f"mission: {name}", _shorten_data(value)) for name, value in flatten_tables(mission)
            if value not in (None, {}, [], "")
        ),
    ]  # fmt: skip
    changed = [
        (name, _shorten_data(entry["value"]), entry.get("unit", ""), entry["source"])
        for name, entry in read("parameters").items()
        # A table of all parameters is long; what a reader must know is what differs.
        if str(entry.get("source", "")).startswith("given")
    ]
    return [
        ReportTable("Settings", (), rows),
        ReportTable("Parameters that were changed", ("", "value", "unit", "source"), changed),
        ReportTable("Versions", (), list(read("versions").items())),
    ]


def _of_filters(record: FilterRecord) -> _Content:
    rows = []
    for tuning_index, tuning in enumerate(record.tunings):
        ends = (record.error[tuning_index, -1], record.deviation[tuning_index, -1])
        rms = [np.sqrt(np.mean(end**2, axis=-1)) for end in ends]
        rows += [
            (f"{state}, {tuning}", *(f"{x:.4g}" for x in numbers))
            for state, *numbers in zip(record.states, *rms, strict=True)
        ]
    head = ("state", "RMS error at the end", "standard deviation by the filter")
    about = [(name, _shorten_data(x)) for name, x in flatten_tables(record.about) if x != ""]
    tables = [ReportTable("Errors", head, rows), ReportTable("Settings", (), about)]
    caption = "Errors of up to 20 runs, and the filters' 3-sigma bands"
    count = len(record.states)
    parts = (range(k, min(k + _STATES, count)) for k in range(0, count, _STATES))
    figures = ((caption, error_figure(record, part)) for part in parts)
    return _Content(record.title, list(record.verdicts), tables, figures)


def _of_study(dataset: xr.Dataset, analysis: Analysis | None) -> _Content:
    data = study_data(dataset)
    analysis = analyse(data) if analysis is None else analysis
    rows = []
    for finding in analysis.findings:
        summary = finding.summary
        shares = [summary.quantiles.get(share) for share in (0.05, 0.5, 0.95)]
        numbers = (finding.event or summary.mean, summary.standard_deviation, *shares)
        name = label_unit(finding.quantity.label, finding.quantity.unit)
        rows.append((name, f"{summary.values:,}", *map(_format_interval, numbers)))
    head = ("", "values", "mean or probability", "standard deviation", "5 %", "median", "95 %")
    about = [(name, _shorten_data(value)) for name, value in flatten_tables(data.identity)]
    tables = [
        ReportTable("Quantities, over the completed samples", head, rows),
        ReportTable("Settings", (), about),
    ]
    level = f"Intervals hold with {100 * analysis.level:g} %, each by itself."
    sentences = (*summary_lines(analysis), *analysis.notes, level)
    verdicts: list[Verdict] = [(text, None) for text in sentences]
    figures = ((text, figure) for _, text, figure in study_figures(data, analysis))
    return _Content(data.title, verdicts, tables, figures)


def _format_interval(estimate: IntervalEstimate | None) -> str:
    """Number with its interval in brackets."""
    if estimate is None or math.isnan(estimate.value):
        return ""
    if estimate.low is None or estimate.high is None:
        return f"{estimate.value:.4g}"
    return f"{estimate.value:.4g} ({estimate.low:.4g} to {estimate.high:.4g})"


def _shorten_data(value: Any) -> str:
    """Text of plain data; long lists and long texts are cut."""
    if isinstance(value, list | tuple):
        text = ", ".join(_shorten_data(x) for x in value[:8])
        return text if len(value) <= 8 else f"{text}, ... ({len(value):,} in all)"
    text = f"{value:.6g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 300 else f"{text[:300]} ..."
