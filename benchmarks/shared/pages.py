"""Markdown tables and figures of the benchmarks' pages, which hold only what JSON records say."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from stmuav_jax.files.netcdf import write_atomically

Lines = list[str]
Row = dict[str, Any]
# A column: the key that is also its head; or head and key; or head, key and format. A format with
# no key is given the whole row.
Column = str | tuple[Any, ...]
# What the names of methods end with that run in the process with native loops.
NATIVE = ", native loops"


def table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> Lines:
    """A Markdown table."""
    cell = lambda x: str(x).replace("|", "/").replace("\n", " ")
    line = lambda cells: "| " + " | ".join(cell(x) for x in cells) + " |"
    return [line(head), line(["---"] * len(head)), *(line(row) for row in rows)]


def listed(rows: Sequence[Row], *columns: Column) -> Lines:
    """A Markdown table of records, column by column."""

    def cell(row: Row, column: Column) -> Any:
        if isinstance(column, str):
            return row[column]
        _, key, *form = column
        if not form:
            return row[key]
        return form[0](row if key is None else row.get(key))

    head = [column if isinstance(column, str) else column[0] for column in columns]
    return table(head, [[cell(row, column) for column in columns] for row in rows])


def titled(title: str, rows: Sequence[Row], *columns: Column) -> str:
    """A table of records under its title, as text."""
    return "\n".join([title, "", *listed(rows, *columns)])


def shown(parts: Sequence[str], figures: Sequence[Path]) -> str:
    """Texts with a blank line between them, and the figures' places."""
    return "\n".join(["\n\n".join(parts), *map(str, figures)])


def number(value: float | None, unit: float = 1.0, digits: int = 3) -> str:
    """Some digits, or a dash."""
    return "-" if value is None else f"{unit * value:.{digits}g}"


def micro(value: float | None) -> str:
    """Three digits of a millionth, or a dash."""
    return number(value, 1e6)


def power(value: float | None, behind: int = 1) -> str:
    """One digit, some behind the point and a power of ten, or a dash."""
    return "-" if value is None else f"{value:.{behind}e}"


def whole(value: int | None) -> str:
    """A count, or a dash."""
    return "-" if value is None else str(value)


def milliseconds(timing: Row | None) -> str:
    """Median and, in brackets, spread; a single run is marked."""
    if timing is None:
        return "-"
    if timing["repeats"] == 1:
        return f"{1e3 * timing['median']:.3g} (once)"
    return f"{1e3 * timing['median']:.3g} ({1e3 * timing['spread']:.1g})"


def setting(row: Row) -> str:
    """Tolerance or step of a run."""
    if row.get("tolerance") is not None:
        return f"tol {row['tolerance']:.0e}"
    return f"h = {row['step']:g} s" if row.get("step") is not None else "-"


def ours(rows: Sequence[Row]) -> list[Row]:
    """The rows of this package."""
    return [row for row in rows if row["method"].startswith("stmuav-jax")]


def panels(
    rows: int, columns: int, width: float, height: float, **shared: Any
) -> tuple[Figure, list[Any]]:
    """A figure of so many panels, row by row; sizes in inches."""
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    return figure, list(figure.subplots(rows, columns, squeeze=False, **shared).ravel())


def legend_of(axes: Sequence[Any]) -> dict[str, Any]:
    """Label -> line over all panels, for one legend."""
    lines: dict[str, Any] = {}
    for ax in axes:
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True):
            lines.setdefault(label, line)
    return lines


def save(figures: dict[str, Figure], folder: Path, dpi: float | None = None) -> list[Path]:
    """Write figures as PNG under their names; returns their paths."""
    paths = []
    for name, figure in figures.items():
        FigureCanvasAgg(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=dpi or "figure")
        paths.append(write_atomically(folder / f"{name}.png", buffer.getvalue()))
    return paths
