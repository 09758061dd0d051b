"""Tables and lines of the terminal, printed literally: brackets are units and paths, not markup."""

import math
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.table import Table
from rich.text import Text

if TYPE_CHECKING:
    from ..dynamics.loads import JointLoads
    from ..dynamics.simulation import Run, Scene

# Loads below this are round-off of joints without such a load; tables show them as 0 [N, N m].
NOTHING = 1e-9
# Error estimates below this are differences of round-off, for motions of some metres.
_ROUND_OFF = 1e-14


def print_line(out: Console, text: object) -> None:
    """Print words literally: brackets are units and paths, not markup."""
    out.print(Text(str(text)), highlight=False)


def make_table(*heads: str, title: str | None = None, right: int = 0) -> Table:
    """Table whose title and heads are printed literally; rows are added by `add_row`.

    Args:
        heads: heads of the columns.
        title: title of the table.
        right: index of the first right-aligned column, 0 for none.
    """
    empty_table = Table(title=None if title is None else Text(title), title_justify="left")
    for k, head in enumerate(heads):
        empty_table.add_column(Text(head), justify="right" if right and k >= right else "left")
    return empty_table


def add_row(rich_table: Table, *cells: object) -> None:
    """Add a row of cells that are printed literally."""
    rich_table.add_row(*(Text(str(cell)) for cell in cells))


def make_pairs(title: str, rows: Iterable[Sequence[str]]) -> Table:
    """Table of quantities and their values, without heads."""
    pairs = Table(title=Text(title), show_header=False, title_justify="left")
    pairs.add_column(style="bold")
    pairs.add_column()
    for cells in rows:
        add_row(pairs, *cells)
    return pairs


def _format_number(value: float, unit: str) -> str:
    if math.isnan(value):
        return "not found"
    return f"{value:.2e} {unit}".rstrip() if value else f"0 {unit}".rstrip()


def _format_estimate(largest: float, end: float, unit: str) -> str:
    if math.isnan(largest):
        return "none"
    estimate_text = f"{largest:.1e} {unit}"
    estimate_text += "" if math.isnan(end) else f", at the end {end:.1e} {unit}"
    return f"{estimate_text} (round-off)" if largest < _ROUND_OFF else estimate_text


def summary_rows(c: Any) -> list[tuple[str, str]]:
    """The six entries of an accuracy report that decide, as rows (quantity, value).

    Remarks on the error estimates and dependent constraint rows are added where a run has them.
    """
    lengths = _format_number(c.position_violation, "m")
    angles = _format_number(c.angle_violation, "rad")
    seconds = c.compile_seconds + c.run_seconds + c.estimate_seconds + c.analysis_seconds
    rows = [
        *_error_rows(c),
        ("Largest constraint violations", f"{lengths}, {angles}"),
        ("Relative energy error", _format_number(c.relative_energy_error, "")),
        ("Accepted steps, run time", f"{c.accepted_steps}, {c.run_seconds:.2f} s of {seconds:.2f} s"),
        ("Dependent constraint rows", ", ".join(c.redundant)),
    ]  # fmt: skip
    return [(quantity, value) for quantity, value in rows if value]


def _error_rows(c: Any) -> list[tuple[str, str]]:
    """Result and estimated errors, with the remarks on them, which may be empty."""
    return [
        ("Result", f"{c.result} at t = {c.t_end:g} s"),
        ("Estimated position error", _format_estimate(c.position_error, c.position_error_end, "m")),
        ("Estimated orientation error", _format_estimate(c.angle_error, c.angle_error_end, "rad")),
        ("Remarks on the errors", c.error_words),
    ]


def certificate_rows(c: Any) -> list[tuple[str, str]]:
    """All entries of an accuracy report as rows (quantity, value)."""
    rank = f"{c.rank} of {c.rows} rows" if c.rows else "no joints"
    if c.redundant:
        rank += f"; dependent rows in {', '.join(c.redundant)}"
    numbers = [
        ("Constraint violation, lengths", c.position_violation, "m"),
        ("Constraint violation, angles", c.angle_violation, "rad"),
        ("Constraint violation, rates of lengths", c.velocity_violation, "m/s"),
        ("Constraint violation, rates of angles", c.angular_velocity_violation, "rad/s"),
        ("Largest | |p|^2 - 1 | of the Euler parameters", c.norm_violation, ""),
        ("Relative energy error", c.relative_energy_error, ""),
        # None where they do not exist, or were not asked for
        ("Relative error of momentum", c.momentum_error, ""),
        ("Relative error of angular momentum", c.angular_momentum_error, ""),
        ("Smallest singular value of the constraint Jacobian", c.smallest_singular_value, ""),
        ("Relative difference of accelerations, two formulations", c.formulation_difference, ""),
    ]
    limited = 2 * c.steps_at_growth_limit > c.accepted_steps
    at_limit = f"{c.steps_at_growth_limit}: the saved times limit most step lengths, not the error"
    rows = [
        *_error_rows(c),
        *((quantity, _format_number(x, unit)) for quantity, x, unit in numbers if x is not None),
        ("Rank of the constraint Jacobian", rank),
        ("Steps accepted, rejected", f"{c.accepted_steps}, {c.rejected_steps}"),
        ("Steps that grew at their limit", at_limit if limited else ""),
        ("Compilation time", f"{c.compile_seconds:.2f} s"),
        ("Run time", f"{c.run_seconds:.2f} s"),
        ("Time of the second run for the error estimate", f"{c.estimate_seconds:.2f} s"),
        ("Time of checks and balances", f"{c.analysis_seconds:.2f} s"),
    ]
    return [(quantity, value) for quantity, value in rows if value]


def certificate_table(run: "Run", *, verbose: bool = False) -> Table:
    """Table of a run's accuracy report for the terminal.

    Args:
        run: run.
        verbose: True for all entries, False for the six main ones.
    """
    rows = (certificate_rows if verbose else summary_rows)(run.certificate)
    return make_pairs(run.scene.title, rows)


def loads_table(scene: "Scene", loads: "JointLoads") -> Table:
    """Table for the terminal: peaks of force and moment at every joint."""
    from ..dynamics.loads import COMPONENTS, envelope

    load_envelope = envelope(loads)
    heads = ("joint", "type", "peak force [N]", "at [s]", "peak moment [N m]", "at [s]")
    peak_table = make_table(*heads, title=f"{scene.title}: peaks of the joint reactions")
    force, moment = COMPONENTS.index("|F|"), COMPONENTS.index("|M|")
    for k, joint in enumerate(scene.system.joints):
        cells: list[str] = []
        for c in (force, moment):
            value, time = float(load_envelope.maximum[k, c]), float(load_envelope.t_maximum[k, c])
            cells += ["0", ""] if value < NOTHING else [f"{value:.4g}", f"{time:.4f}"]
        add_row(peak_table, joint.name, joint.kind, *cells)
    return peak_table
