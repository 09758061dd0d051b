"""Numbers, tables and figures of the benchmarks' pages, which hold only what JSON records say."""

from collections.abc import Iterable, Sequence
from typing import Any

from matplotlib.figure import Figure

from stmuav_jax.figures import grid

Row = dict[str, Any]


def table(head: Iterable[str], rows: Iterable[Iterable[Any]]) -> str:
    """A Markdown table."""
    cell = lambda x: str(x).replace("|", "/").replace("\n", " ")
    line = lambda cells: "| " + " | ".join(cell(x) for x in cells) + " |"
    head = list(head)
    return "\n".join([line(head), line(["---"] * len(head)), *map(line, rows)])


def number(value: float | None, unit: float = 1.0, digits: int = 3) -> str:
    """Some digits, or a dash."""
    return "-" if value is None else f"{unit * value:.{digits}g}"


def plain(value: float | None) -> str:
    """Two digits without a power of ten, or a dash."""
    return "-" if value is None else f"{float(f'{value:.2g}'):,g}"


def power(value: float | None, behind: int = 1) -> str:
    """One digit, some behind the point and a power of ten, or a dash."""
    return "-" if value is None else f"{value:.{behind}e}"


def duration(seconds: float | None) -> str:
    """Three digits, in ms below a second."""
    if seconds is None:
        return "not reached"
    return f"{1e3 * seconds:.3g} ms" if seconds < 1 else f"{seconds:.3g} s"


def holds(row: Row) -> bool:
    """True if a hard case reached its end with the error that is demanded."""
    return row["result"] == "successful" and bool(row["reached"] <= row["demanded"])


def describe_scene(scene: Row) -> str:
    """A stiff scene in words, with the stiffness and the damping of its servos."""
    if scene["stiffness"]:
        return f"servo {scene['stiffness']:.0e} N/m, {scene['damping']:,g} N s/m"
    return "no force on the sliders" if scene["name"] == "free" else scene["name"]


def comparable(content: Row) -> list[Row]:
    """Each program's fastest setting whose largest error is at most twice ours."""
    most, best = 2 * content["tried"][-1]["largest_error"], {}
    for row in content["peers"]:
        error, name = row.get("largest_error"), row["method"]
        if error is None or not error <= most:
            continue
        if name not in best or row["per_second"] > best[name]["per_second"]:
            best[name] = row
    return list(best.values())


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
