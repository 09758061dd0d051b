"""Style of all figures, readable in black and white, and their files."""

import contextlib
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Okabe and Ito's colours, each with its own dash, so that either alone tells curves apart.
STYLES = (("#0072B2", "-"), ("#D55E00", "--"), ("#009E73", "-."), ("#000000", ":"))
# More of them for figures of many curves. With the markers, whose number is no multiple of that of the
# colours, 104 curves stay apart.
_COLORS = (*(color for color, _ in STYLES), "#CC79A7", "#E69F00", "#56B4E9", "#666666")
_LONGER_DASHES = ((0, (5, 1)), (0, (3, 1, 1, 1, 1, 1)), (0, (1, 1)), (0, (9, 2)))
_DASHES = (*(dash for _, dash in STYLES), *_LONGER_DASHES)
_MARKS = "os^DvP*X<>hp8"
WIDTH = 7.0  # text width of a page [inch]


def grid(rows: int, columns: int, height: float, **more: Any) -> tuple[Figure, np.ndarray]:
    """Create a figure of the text's width with axes (rows, columns).

    Args:
        rows, columns: numbers of rows and columns.
        height: height of the figure [inch].
        more: keyword arguments of `subplots`.
    """
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False, **more)
    for ax in axes.flat:
        ax.grid(True, color="0.85", linewidth=0.6)
        ax.tick_params(labelsize=9)
    return figure, axes


def look(k: int) -> dict[str, Any]:
    """Colour, dash and marker of the k-th of many curves, as keyword arguments of `plot`.

    The colours are Okabe and Ito's; dash or marker alone distinguishes the curves in grey print.

    Args:
        k: number of the curve, from zero.
    """
    color, dash = (style_cycle[k % len(style_cycle)] for style_cycle in (_COLORS, _DASHES))
    mark = _MARKS[k % len(_MARKS)]
    return {"color": color, "linestyle": dash, "marker": mark, "markersize": 4, "linewidth": 1.2}


def plot_histories(ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...]) -> None:
    """Plot histories (k, labels) over times (k,) [s], each in its own style."""
    for k, label in enumerate(labels):
        color, dash = (cycle[k % len(cycle)] for cycle in (_COLORS, _DASHES))
        ax.plot(ts, values[:, k], label=label, linewidth=1.4, color=color, linestyle=dash)
    ax.set_xlabel("time [s]", fontsize=9)


def draw_histories(
    title: str,
    ts: np.ndarray,
    panels: Sequence[tuple[str, tuple[str, ...], np.ndarray]],
    height: float | None = None,
) -> Figure:
    """Figure of panels over time, each with the words of its axis, labels and curves (k, labels)."""
    figure, axes = grid(len(panels), 1, height or 0.9 + 2.1 * len(panels), sharex=True)
    for ax, (axis_label, labels, values) in zip(axes[:, 0], panels, strict=True):
        plot_histories(ax, ts, values, labels)
        ax.set_ylabel(axis_label, fontsize=9, parse_math=False)
        if len(labels) > 1:
            draw_legend_beside(ax)
    for ax in axes[:-1, 0]:
        ax.set_xlabel("")
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def draw_legend_beside(ax: Axes) -> None:
    """Legend to the right of the axes."""
    ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def figure_content(figure: Figure, suffix: str, dpi: int = 200) -> bytes:
    """Content of a figure's file (png, pdf or svg)."""
    buffer = io.BytesIO()
    with _place_axes(figure, dpi) if suffix == "png" else contextlib.nullcontext():
        figure.savefig(buffer, format=suffix, dpi=dpi)
    return buffer.getvalue()


@contextlib.contextmanager
def _place_axes(figure: Figure, dpi: int) -> Iterator[None]:
    """Place a figure's axes at a resolution, so that saving it draws it once.

    Matplotlib draws a figure that has a layout engine twice, the first time only to place its axes.
    """
    engine, before = figure.get_layout_engine(), figure.dpi
    if engine is None or type(figure.canvas) is not FigureCanvasAgg:
        yield
        return
    figure.set_dpi(dpi)
    try:
        engine.execute(figure)
        figure.set_layout_engine(None)
        yield
    finally:
        figure.set_dpi(before)
        figure.set_layout_engine(engine)


def save_figures(
    figures: Mapping[str, Figure | Callable[..., Figure | None]],
    folder: str | os.PathLike[str],
    suffix: str = "png",
    *subject: Any,
    dpi: int = 200,
) -> list[Path]:
    """Write figures (png, pdf or svg) into `folder`, atomically; return their paths.

    Args:
        figures: figures by file name, or functions of the subject that draw them; those that return None
            leave a file out.
        folder: folder of the files.
        suffix: "png", "pdf" or "svg".
        subject: arguments of the functions, such as a run.
        dpi: resolution [dots per inch].
    """
    from ..io.netcdf import write_atomically

    paths = []
    for name, figure_source in figures.items():
        figure = figure_source if isinstance(figure_source, Figure) else figure_source(*subject)
        if figure is None:
            continue
        path = Path(folder) / f"{name}.{suffix}"
        paths.append(write_atomically(path, figure_content(figure, suffix, dpi)))
    return paths
