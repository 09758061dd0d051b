"""What a study says, for the terminal: a table of its quantities and a few sentences."""

import math

from rich.table import Table
from rich.text import Text

from ..montecarlo.statistics import Estimate
from .study_analysis import Analysis
from .study_data import label

# Rows of the table; the report has all.
_MOST = 24


def summary_table(analysis: Analysis) -> Table:
    """Mean and quantiles of every quantity over the completed samples."""
    columns = ("quantity", "mean", "5 %", "median", "95 %")
    table = Table()
    for k, name in enumerate(columns):
        table.add_column(Text(name), justify="right" if k else "left")
    for one in analysis.findings[:_MOST]:
        summary = one.summary
        quantiles = [summary.quantiles.get(share) for share in (0.05, 0.5, 0.95)]
        cells = [_cell(number) for number in (summary.mean, *quantiles)]
        # text and no markup, since units stand in brackets
        table.add_row(*map(Text, (label(one.quantity.words, one.quantity.unit), *cells)))
    return table


def _cell(number: Estimate | float | None) -> str:
    value = number.value if isinstance(number, Estimate) else number
    if value is None or math.isnan(value):
        return ""
    return f"{value:.4g}" if math.isfinite(value) else ("never" if value > 0 else "-infinite")


def summary_lines(analysis: Analysis) -> list[str]:
    """How the samples ended, and the probability of the declared failure."""
    o = analysis.outcomes
    lines = [
        f"{o.fine:,} samples completed, {o.failed:,} did not complete, {o.missing:,} not computed."
    ]
    lines += [
        f"  did not complete: {o.codes.get(code, 0):,}, {words}"
        for code, (words, _) in o.reasons.items()
        if o.codes.get(code, 0)
    ]
    if analysis.failure:
        event, found, samples = analysis.failure
        ends = "" if found.low is None or found.high is None else (
            f" ({100 * found.low:.3g} to {100 * found.high:.3g} % with {100 * analysis.level:g} %)"
        )  # fmt: skip
        lines.append(
            f"Probability of failure ({event}): {100 * found.value:.3g} %{ends}, among {samples:,} "
            "completed."
        )
    if len(analysis.findings) > _MOST:
        lines.append(f"{_MOST} of {len(analysis.findings)} quantities; the report has all.")
    return lines
