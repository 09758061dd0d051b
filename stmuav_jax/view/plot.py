"""Figures of a run, in the report's manner and readable in black and white."""

import io
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..dynamics.run import Run
from .io import write_atomically

# Okabe and Ito's colours, each with its own dash, so that neither is needed alone.
STYLES = (
    ("#0072B2", "-"),
    ("#D55E00", "--"),
    ("#009E73", "-."),
    ("#000000", ":"),
)
WIDTH = 7.0  # [inch], a page's text width


def grid(rows: int, columns: int, height: float) -> tuple[Figure, np.ndarray]:
    """A figure of the text's width with axes (rows, columns); height [inch]."""
    figure = Figure(figsize=(WIDTH, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(rows, columns, squeeze=False)
    for ax in axes.flat:
        ax.grid(True, color="0.85", linewidth=0.6)
        ax.tick_params(labelsize=9)
    return figure, axes


def curves(ax: Axes, ts: np.ndarray, values: np.ndarray, labels: tuple[str, ...]) -> None:
    """Histories (k, labels) over times (k,) [s], each in its own style."""
    for k, label in enumerate(labels):
        color, dash = STYLES[k]
        ax.plot(ts, values[:, k], label=label, linewidth=1.4, color=color, linestyle=dash)
    ax.set_xlabel("time [s]", fontsize=9)


def positions(run: Run) -> Figure:
    """Positions of the watched bodies' centres of mass, one panel a body.

    Source: in the manner of report Part II, Fig. 5.3 to 5.5.
    """
    names = run.scene.watch or run.scene.system.names
    columns = 1 if len(names) == 1 else 2
    rows = -(-len(names) // columns)
    figure, axes = grid(rows, columns, 0.6 + 2.4 * rows)
    for ax, name in zip(axes.flat, names, strict=False):
        curves(ax, run.ts, np.asarray(run.body(name).r), ("x", "y", "z"))
        ax.set_title(name.replace("_", " "), fontsize=10)
        ax.set_ylabel("position [m]", fontsize=9)
    for ax in axes.flat[len(names) :]:
        ax.set_axis_off()
    axes.flat[0].legend(fontsize=9)
    figure.suptitle(run.scene.title, fontsize=11)
    return figure


def euler_parameters(run: Run) -> Figure:
    """Euler parameters of the last watched body (the panel).

    Source: in the manner of report Part I, Fig. 5.1 to 5.3.
    """
    name = (run.scene.watch or run.scene.system.names)[-1]
    figure, axes = grid(1, 1, 3.2)
    ax = axes[0, 0]
    curves(ax, run.ts, np.asarray(run.body(name).p), ("$e_0$", "$e_1$", "$e_2$", "$e_3$"))
    ax.set_ylim(-1.05, 1.05)
    ax.set_ylabel("Euler parameters [1]", fontsize=9)
    ax.legend(fontsize=9, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.18))
    ax.set_title(f"{run.scene.title}: {name.replace('_', ' ')}", fontsize=10)
    return figure


def balances(run: Run) -> Figure:
    """Energies, how well energy and constraints are kept, and the estimated error."""
    figure, axes = grid(1, 2, 3.3)
    view, trajectory = run.snapshot, run.trajectory
    energies = np.stack([view.kinetic, view.potential - view.potential[0], trajectory.work], axis=1)
    curves(axes[0, 0], run.ts, energies, ("kinetic", "potential", "work done"))
    axes[0, 0].set_ylabel("energy [J]", fontsize=9)
    total = view.kinetic + view.potential
    drift = np.maximum.accumulate(np.abs(total - total[0] - trajectory.work))
    position = np.max(run.errors.position, axis=1)
    worst = trajectory.worst
    errors = np.stack([position, drift, worst.position, worst.velocity], axis=1)
    labels = (
        "estimated position error [m]",
        "energy drift so far [J]",
        "violation of lengths so far [m]",
        "of their rates so far [m/s]",
    )
    curves(axes[0, 1], run.ts, np.maximum(errors, 1e-18), labels)
    axes[0, 1].set_yscale("log")
    axes[0, 1].set_ylabel("error, violation", fontsize=9)
    for ax in axes.flat:
        ax.legend(fontsize=8, ncols=2, loc="upper center", bbox_to_anchor=(0.5, -0.2))
    figure.suptitle(run.scene.title, fontsize=11)
    return figure


FIGURES = {"positions": positions, "euler_parameters": euler_parameters, "balances": balances}


def save_figures(
    run: Run, folder: str | os.PathLike[str], suffix: str = "png", dpi: int = 200
) -> list[Path]:
    """Draw every figure of a run into `folder` (png, pdf or svg); their paths."""
    return save_all(FIGURES, run, folder, suffix, dpi)


def save_all(
    figures: Mapping[str, Callable[[Any], Figure]],
    subject: Any,
    folder: str | os.PathLike[str],
    suffix: str = "png",
    dpi: int = 200,
) -> list[Path]:
    """Draw figures of one subject, by their names, into `folder` (png, pdf or svg); their paths."""
    paths = []
    for name, draw in figures.items():
        buffer = io.BytesIO()
        draw(subject).savefig(buffer, format=suffix, dpi=dpi)
        paths.append(write_atomically(Path(folder) / f"{name}.{suffix}", buffer.getvalue()))
    return paths
