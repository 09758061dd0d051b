"""Markdown tables and figures of the benchmarks' pages, which hold only what JSON records say."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from stmuav_jax.figures import grid, save_figures

Lines = list[str]
Row = dict[str, Any]
# A column: the key that is also its head; or head and key; or head, key and format. A format with
# no key is given the whole row.
Column = str | tuple[Any, ...]


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


def number(value: float | None, unit: float = 1.0, digits: int = 3) -> str:
    """Some digits, or a dash."""
    return "-" if value is None else f"{unit * value:.{digits}g}"


def plain(value: float | None) -> str:
    """Two digits without a power of ten, or a dash."""
    return "-" if value is None else f"{float(f'{value:.2g}'):,g}"


def power(value: float | None, behind: int = 1) -> str:
    """One digit, some behind the point and a power of ten, or a dash."""
    return "-" if value is None else f"{value:.{behind}e}"


def panels(rows: int, columns: int, height: float, **shared: Any) -> tuple[Figure, list[Any]]:
    """A figure of the library's style with so many panels, row by row; its height in inches."""
    figure, axes = grid(rows, columns, height, **shared)
    return figure, list(axes.flat)


def legend(figure: Figure, axes: Sequence[Any], columns: int, size: float = 8, **how: Any) -> None:
    """Add one legend of all panels' labels, below them where nothing else is said."""
    lines: dict[str, Any] = {}
    for ax in axes:
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True):
            lines.setdefault(label, line)
    how = {"loc": "outside lower center", "handlelength": 3, "title_fontsize": size} | how
    figure.legend(lines.values(), lines.keys(), ncols=columns, fontsize=size, **how)


def save(figures: dict[str, Figure], folder: Path) -> list[Path]:
    """Write figures as PNG under their names, for print; returns their paths."""
    for ax in (ax for figure in figures.values() for ax in figure.axes):
        for text in (ax.title, ax.xaxis.label, ax.yaxis.label):
            text.set_fontsize(9)
    return save_figures(figures, folder, dpi=160)
