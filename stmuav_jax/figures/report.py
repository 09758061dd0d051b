"""Table of a run's certificate for the terminal."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

from rich.table import Table
from rich.text import Text

from ..dynamics.run import Certificate, Run
from ..files.netcdf import FileError
from .terminal import row

# Error estimates below this are differences of round-off, for motions of some metres.
_ROUND_OFF = 1e-14


def _number(value: float | None, unit: str) -> str:
    if value is None or math.isnan(value):
        return "not applicable" if value is None else "not found"
    return f"{value:.2e} {unit}".rstrip()


def _estimate(largest: float, end: float, unit: str) -> str:
    if math.isnan(largest):
        return "none"
    words = f"{largest:.1e} {unit}"
    words += "" if math.isnan(end) else f", at the end {end:.1e} {unit}"
    return f"{words} (round-off)" if largest < _ROUND_OFF else words


def certificate_rows(run: Run) -> list[tuple[str, str]]:
    """Entries of a run's certificate as rows (quantity, value) in words."""
    return rows_of(run.certificate)


def certificate_from(plain: Mapping[str, Any]) -> Certificate:
    """Certificate of a saved run from the plain data of `Certificate.to_dict`.

    Raises:
        FileError: entries are missing, as in a file of another version.
    """
    fields = [field.name for field in dataclasses.fields(Certificate)]
    missing = [name for name in fields if name not in plain]
    if missing:
        raise FileError(f"The certificate of the run lacks {', '.join(missing)}.")
    # None stands for NaN where a number may be undefined
    numbers = {name for name in fields if Certificate.__annotations__[name] in (float, "float")}
    given: dict[str, Any] = {
        k: math.nan if k in numbers and plain[k] is None else plain[k] for k in fields
    }
    given["redundant"] = tuple(plain["redundant"])
    return Certificate(**given)


def rows_of(c: Certificate) -> list[tuple[str, str]]:
    """Entries of a certificate as rows (quantity, value) in words."""
    rank = f"{c.rank} of {c.rows} rows" if c.rows else "no joints"
    if c.redundant:
        rank += f"; dependent rows in {', '.join(c.redundant)}"
    rows = [
        ("Result", f"{c.result} at t = {c.t_end:g} s"),
        ("Estimated position error", _estimate(c.position_error, c.position_error_end, "m")),
        ("Estimated orientation error", _estimate(c.angle_error, c.angle_error_end, "rad")),
    ]
    if c.error_words:
        rows.append(("About these errors", c.error_words))
    rows += [
        ("Constraint violation, lengths", _number(c.position_violation, "m")),
        ("Constraint violation, angles", _number(c.angle_violation, "rad")),
        ("Violation of the lengths' rates", _number(c.velocity_violation, "m/s")),
        ("Violation of the angles' rates", _number(c.angular_velocity_violation, "rad/s")),
        ("Violation of the Euler parameters' norm", _number(c.norm_violation, "")),
        ("Energy balance, of the largest energy", _number(c.relative_energy_error, "")),
    ]
    if c.momentum_error is not None:
        rows += [
            ("Momentum balance, relative", _number(c.momentum_error, "")),
            ("Angular momentum balance, relative", _number(c.angular_momentum_error, "")),
        ]
    rows.append(("Rank of the constraint Jacobian", rank))
    if c.smallest_singular_value is not None:
        rows.append(("Smallest singular value on the way", _number(c.smallest_singular_value, "")))
    difference = c.formulation_difference
    words = "not computed" if difference is None else _number(difference, "")
    rows.append(("Accelerations by another formulation, difference", words))
    rows.append(("Steps accepted, rejected", f"{c.accepted_steps}, {c.rejected_steps}"))
    if 2 * c.steps_at_growth_limit > c.accepted_steps:
        rows.append(
            (
                "Steps that grew at their limit",
                f"{c.steps_at_growth_limit}: not the error but the saved times, or nothing, chose most lengths",
            )
        )
    return [
        *rows,
        ("Time to compile the integration", f"{c.compile_seconds:.2f} s"),
        ("Time to run it", f"{c.run_seconds:.2f} s"),
        ("Time for the second run, for the errors", f"{c.estimate_seconds:.2f} s"),
        ("Time for checks and balances", f"{c.analysis_seconds:.2f} s"),
    ]


def certificate_table(run: Run) -> Table:
    """Table of a run's certificate for the terminal."""
    # names of bodies and joints are printed literally: brackets in them are no markup
    table = Table(title=Text(run.scene.title), show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for cells in certificate_rows(run):
        row(table, *cells)
    return table
