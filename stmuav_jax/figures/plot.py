"""Figures of a run in the report's style, readable in black and white."""

import contextlib
import io
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .numbers import NOTHING, SavedLoads, balances_of, joints_of, motion_of, pose_of

if TYPE_CHECKING:
    from ..dynamics.run import Run

# Okabe and Ito's colours, each with its own dash, so that either alone tells curves apart.
STYLES = (
    ("#0072B2", "-"),
    ("#D55E00", "--"),
    ("#009E73", "-."),
    ("#000000", ":"),
)
# More of them for figures of many curves. With the markers, whose number is no multiple of that of the
# colours, 104 curves stay apart.
_COLORS = (*(color for color, _ in STYLES), "#CC79A7", "#E69F00", "#56B4E9", "#666666")
_DASHES = (
    *(dash for _, dash in STYLES),
    (0, (5, 1)),
    (0, (3, 1, 1, 1, 1, 1)),
    (0, (1, 1)),
    (0, (9, 2)),
)
_MARKS = "os^DvP*X<>hp8"
# Peaks of more than so many usual loads are drawn on a logarithmic axis.
_SPIKE = 5.0
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

    The colours are Okabe and Ito's; dash or marker alone tells the curves apart in grey print.

    Args:
        k: number of the curve, from zero.
    """
    color, dash = (each[k % len(each)] for each in (_COLORS, _DASHES))
    mark = _MARKS[k % len(_MARKS)]
    return {"color": color, "linestyle": dash, "marker": mark, "markersize": 4, "linewidth": 1.2}


def curves(ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...]) -> None:
    """Plot histories (k, labels) over times (k,) [s], each in its own style."""
    for k, label in enumerate(labels):
        color, dash = STYLES[k]
        ax.plot(ts, values[:, k], label=label, linewidth=1.4, color=color, linestyle=dash)
    ax.set_xlabel("time [s]", fontsize=9)


def pose(run: "Run") -> Figure:
    """Figure of the base's position, tilt and angular velocity.

    The base is the body with rotors, or else the last watched body; tilt is the angle of its z axis
    from the vertical.
    """
    return _pose(*pose_of(motion_of(run)))


def _pose(
    title: str, name: str, ts: np.ndarray, r: np.ndarray, tilt: np.ndarray, omega: np.ndarray
) -> Figure:
    figure, axes = grid(3, 1, 5.6, sharex=True)
    _panel(axes[0, 0], ts, r, ("x", "y", "z"), "position [m]")
    _panel(axes[1, 0], ts, tilt[:, None], ("tilt",), "tilt [degrees]")
    axes[1, 0].set_ylim(bottom=0.0)
    _panel(axes[2, 0], ts, omega, ("x", "y", "z"), "angular velocity,\nbody axes [rad/s]")
    for ax in axes[:-1, 0]:
        ax.set_xlabel("")
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(f"{title}\n{name.replace('_', ' ')}", fontsize=10, parse_math=False)
    return figure


def joints(run: "Run") -> Figure | None:
    """Figure of strokes and panel angles, or else of the angles of joints that turn.

    None for a run without such joints.
    """
    found = joints_of(motion_of(run))
    return _joints(*found) if found[-1] else None


def _joints(
    title: str, ts: np.ndarray, panels: Sequence[tuple[str, tuple[str, ...], np.ndarray]]
) -> Figure:
    figure, axes = grid(len(panels), 1, 0.9 + 2.1 * len(panels), sharex=True)
    for ax, (words, labels, values) in zip(axes[:, 0], panels, strict=True):
        _panel(ax, ts, values, labels, words)
    for ax in axes[:-1, 0]:
        ax.set_xlabel("")
    figure.align_ylabels(axes[:, 0])
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def _panel(
    ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...], words: str
) -> None:
    """Plot curves with a legend beside them."""
    curves(ax, ts, values, labels)
    ax.set_ylabel(words, fontsize=9)
    if len(labels) > 1:
        ax.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def balances(run: "Run") -> Figure:
    """Figure of energies, and of the estimated error, energy drift and violations, a unit an axis."""
    return _balances(*balances_of(run))


def _balances(title: str, ts: np.ndarray, energies: np.ndarray, errors: np.ndarray) -> Figure:
    figure, axes = grid(2, 2, 5.2, sharex=True)
    position, drift, lengths, rates = errors.T
    curves(axes[0, 0], ts, energies, ("kinetic", "potential", "work done"))
    axes[0, 0].set_ylabel("energy [J]", fontsize=9)
    both = np.stack([position, lengths], axis=1)
    labels = ("estimated error of positions", "violation of lengths so far")
    _logarithmic(axes[0, 1], ts, both, labels, "length [m]")
    _logarithmic(axes[1, 0], ts, drift[:, None], ("energy drift so far",), "energy [J]")
    words = ("violation of the lengths' rates so far",)
    _logarithmic(axes[1, 1], ts, rates[:, None], words, "speed [m/s]")
    for ax in axes.flat:
        ax.legend(fontsize=8, ncols=1, loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False)
    for ax in axes[0]:
        ax.set_xlabel("")
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def _logarithmic(
    ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...], words: str
) -> None:
    """Plot the positive values on a logarithmic axis; zeros have no place on it."""
    positive = np.where(values > 0, values, np.nan)
    curves(ax, ts, positive, labels)
    ax.set_ylabel(words, fontsize=9)
    if np.any(values > 0):
        ax.set_yscale("log")
    else:
        ax.set_yticks([])
        words = "zero throughout" if np.any(np.isfinite(values)) else "not known"
        ax.text(0.5, 0.5, words, transform=ax.transAxes, ha="center", fontsize=9)


def loads(title: str, found: SavedLoads) -> Figure:
    """Figure of force and moment over time in joint axes, with a row of panels per joint."""
    rows = max(len(found.joints), 1)
    figure, axes = grid(rows, 2, 0.9 + 1.35 * rows)
    for k, name in enumerate(found.joints):
        _history(found, k, axes[k])
        axes[k, 0].set_ylabel(name, fontsize=9, fontweight="bold", parse_math=False)
        for ax in axes[k]:
            if k < len(found.joints) - 1:
                ax.set_xlabel("")
                ax.tick_params(labelbottom=False)
    figure.align_ylabels(axes[:, 0])
    axes[0, 0].set_title("force [N]", fontsize=10)
    axes[0, 1].set_title("moment [N m]", fontsize=10)
    if found.joints:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
    else:
        for ax in axes.flat:
            ax.set_axis_off()
    words = "reactions in joint axes, body i on body j; beyond the thin lines logarithmic"
    figure.suptitle(f"{title}\n{words}", fontsize=10, parse_math=False)
    return figure


def _history(found: SavedLoads, k: int, axes: np.ndarray) -> None:
    values = found.components[:, k]
    for ax, part in zip(axes, (slice(0, 4), slice(4, 8)), strict=True):
        curves(ax, found.ts, values[:, part], ("x", "y", "z", "magnitude"))
        if not np.any(np.abs(values[:, part]) > NOTHING):
            ax.set_ylim(-1.0, 1.0)
            ax.set_yticks([])
            ax.text(0.5, 0.6, "none", transform=ax.transAxes, ha="center", fontsize=9)
        else:
            _room_for_spikes(ax, values[:, part][:, -1])


def _room_for_spikes(ax: Axes, magnitude: np.ndarray) -> None:
    """Make an axis logarithmic beyond the usual loads, where short peaks are far above them."""
    sizes = magnitude[np.isfinite(magnitude)]
    usual = float(np.quantile(sizes, 0.9))
    if usual <= NOTHING or np.max(sizes) < _SPIKE * usual:
        return
    decade = 10 ** np.floor(np.log10(usual))
    linear = float(decade * max(k for k in (1, 2, 5) if k * decade <= usual))
    ax.set_yscale("symlog", linthresh=linear, linscale=1.5)
    largest = 10 ** np.ceil(np.log10(np.max(sizes)))
    ax.set_yticks([-largest, -linear, 0.0, linear, largest])
    ax.minorticks_off()
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for side in (-linear, linear):
        ax.axhline(side, color="0.55", linewidth=0.5)


FIGURES = {"pose": pose, "joints": joints, "balances": balances}


# The same by the numbers that `numbers_of` takes from a run, and its reaction loads.
DRAWN = {"pose": _pose, "joints": _joints, "balances": _balances, "loads": loads}


def content(figure: Figure, suffix: str, dpi: int = 200) -> bytes:
    """Content of a figure's file (png, pdf or svg)."""
    buffer = io.BytesIO()
    with _placed(figure, dpi) if suffix == "png" else contextlib.nullcontext():
        figure.savefig(buffer, format=suffix, dpi=dpi)
    return buffer.getvalue()


@contextlib.contextmanager
def _placed(figure: Figure, dpi: int) -> Iterator[None]:
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
    from ..files.netcdf import write_atomically

    paths = []
    for name, drawn in figures.items():
        figure = drawn if isinstance(drawn, Figure) else drawn(*subject)
        if figure is None:
            continue
        path = Path(folder) / f"{name}.{suffix}"
        paths.append(write_atomically(path, content(figure, suffix, dpi)))
    return paths
