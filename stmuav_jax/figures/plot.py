"""Figures of a run in the report's style, readable in black and white."""

import io
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from .numbers import balances_of, euler_parameters_of, positions_of

if TYPE_CHECKING:
    from ..dynamics.run import Run

# Okabe and Ito's colours, each with its own dash, so that either alone tells curves apart.
STYLES = (
    ("#0072B2", "-"),
    ("#D55E00", "--"),
    ("#009E73", "-."),
    ("#000000", ":"),
)
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


def curves(ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...]) -> None:
    """Plot histories (k, labels) over times (k,) [s], each in its own style."""
    for k, label in enumerate(labels):
        color, dash = STYLES[k]
        ax.plot(ts, values[:, k], label=label, linewidth=1.4, color=color, linestyle=dash)
    ax.set_xlabel("time [s]", fontsize=9)


def positions(run: "Run") -> Figure:
    """Figure of positions of the watched bodies' centres of mass, one panel per body.

    Source: in the style of report Part II, Fig. 5.3 to 5.5.
    """
    return _positions(*positions_of(run))


def _positions(
    title: str, names: Sequence[str], ts: np.ndarray, positions: Sequence[np.ndarray]
) -> Figure:
    columns = 1 if len(names) == 1 else 2
    rows = -(-len(names) // columns)
    figure, axes = grid(rows, columns, 0.6 + 2.4 * rows)
    for ax, name, r in zip(axes.flat, names, positions, strict=False):
        curves(ax, ts, r, ("x", "y", "z"))
        ax.set_title(name.replace("_", " "), fontsize=10)
        ax.set_ylabel("position [m]", fontsize=9)
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    axes.flat[0].legend(fontsize=9)
    figure.suptitle(title, fontsize=11)
    return figure


def euler_parameters(run: "Run") -> Figure:
    """Figure of the Euler parameters of the last watched body (the panel).

    Source: in the style of report Part I, Fig. 5.1 to 5.3.
    """
    return _euler_parameters(*euler_parameters_of(run))


def _euler_parameters(title: str, name: str, ts: np.ndarray, p: np.ndarray) -> Figure:
    figure, axes = grid(1, 1, 3.2)
    ax = axes[0, 0]
    curves(ax, ts, p, ("$e_0$", "$e_1$", "$e_2$", "$e_3$"))
    ax.set_ylim(-1.05, 1.05)
    ax.set_ylabel("Euler parameters [1]", fontsize=9)
    ax.legend(fontsize=9, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    ax.set_title(f"{title}: {name.replace('_', ' ')}", fontsize=10)
    return figure


def balances(run: "Run") -> Figure:
    """Figure of energies, energy drift, constraint violations, and the estimated error."""
    return _balances(*balances_of(run))


def _balances(title: str, ts: np.ndarray, energies: np.ndarray, errors: np.ndarray) -> Figure:
    figure, axes = grid(1, 2, 3.3)
    curves(axes[0, 0], ts, energies, ("kinetic", "potential", "work done"))
    axes[0, 0].set_ylabel("energy [J]", fontsize=9)
    labels = (
        "estimated position error [m]",
        "energy drift so far [J]",
        "violation of lengths so far [m]",
        "of their rates so far [m/s]",
    )
    curves(axes[0, 1], ts, np.maximum(errors, 1e-18), labels)
    axes[0, 1].set_yscale("log")
    axes[0, 1].set_ylabel("error, violation", fontsize=9)
    for ax in axes.flat:
        ax.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    figure.suptitle(title, fontsize=11)
    return figure


FIGURES = {"positions": positions, "euler_parameters": euler_parameters, "balances": balances}


# The same by the numbers that `numbers_of` takes from a run.
DRAWN = {"positions": _positions, "euler_parameters": _euler_parameters, "balances": _balances}


def content(figure: Figure, suffix: str, dpi: int = 200) -> bytes:
    """Content of a figure's file (png, pdf or svg)."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format=suffix, dpi=dpi)
    return buffer.getvalue()


def save_figures(
    figures: Mapping[str, Figure | Callable[..., Figure]],
    folder: str | os.PathLike[str],
    suffix: str = "png",
    *subject: Any,
    dpi: int = 200,
) -> list[Path]:
    """Write figures (png, pdf or svg) into `folder`, atomically; return their paths.

    Args:
        figures: figures by file name, or functions of the subject that draw them.
        folder: folder of the files.
        suffix: "png", "pdf" or "svg".
        subject: arguments of the functions, such as a run.
        dpi: resolution [dots per inch].
    """
    from ..files.netcdf import write_atomically

    paths = []
    for name, drawn in figures.items():
        figure = drawn if isinstance(drawn, Figure) else drawn(*subject)
        path = Path(folder) / f"{name}.{suffix}"
        paths.append(write_atomically(path, content(figure, suffix, dpi)))
    return paths
