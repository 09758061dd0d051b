"""The certificate as a table for people."""

from rich.table import Table

from ..dynamics.run import Run


def _number(value: float | None, unit: str) -> str:
    return "not applicable" if value is None else f"{value:.2e} {unit}".rstrip()


def certificate_rows(run: Run) -> list[tuple[str, str]]:
    """What a run's certificate says, as (quantity, value) in words."""
    c = run.certificate
    rank = f"{c.rank} of {c.rows} rows" if c.rows else "no joints"
    if c.redundant:
        rank += f"; dependent rows in {', '.join(c.redundant)}"
    rows = [
        ("Result", f"{c.result} at t = {c.t_end:g} s"),
        ("Largest position residual", _number(c.position_residual, "m")),
        ("Largest velocity residual", _number(c.velocity_residual, "m/s")),
        ("Largest Euler-parameter norm error", _number(c.norm_error, "")),
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
    return [
        *rows,
        ("Steps accepted, rejected", f"{c.accepted_steps}, {c.rejected_steps}"),
        ("Time to compile the integration", f"{c.compile_seconds:.2f} s"),
        ("Time to run it", f"{c.run_seconds:.2f} s"),
        ("Time for checks and balances", f"{c.analysis_seconds:.2f} s"),
    ]


def certificate_table(run: Run) -> Table:
    """The certificate as a table for the terminal."""
    table = Table(title=run.scene.title, show_header=False, title_justify="left")
    table.add_column(style="bold")
    table.add_column()
    for row in certificate_rows(run):
        table.add_row(*row)
    return table
