"""Summary of a study for the terminal: a table of its quantities and a few sentences."""

import math

from rich.table import Table

from ...montecarlo.statistics import IntervalEstimate
from ..terminal import row, table
from .analysis import Analysis
from .data import label

# Largest number of rows of the table; the report has all.
_MOST = 24


def summary_table(analysis: Analysis) -> Table:
    """Table of mean and quantiles of every quantity over the completed samples."""
    made = table("quantity", "mean", "5 %", "median", "95 %", right=1)
    for one in analysis.findings[:_MOST]:
        summary = one.summary
        quantiles = [summary.quantiles.get(share) for share in (0.05, 0.5, 0.95)]
        cells = [_cell(number) for number in (summary.mean, *quantiles)]
        row(made, label(one.quantity.words, one.quantity.unit), *cells)
    return made


def _cell(number: IntervalEstimate | float | None) -> str:
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
