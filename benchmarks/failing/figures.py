"""Figures of the failure benchmark, from its JSON record alone."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from shared.pages import Row, panels, save

REPORTED = (0.45, 0.5)


def draw(result: Row, folder: Path) -> list[Path]:
    """Write both figures as PNG; returns their paths."""
    return save({"violation": violation(result), "stiffness": stiffness(result)}, folder)


def _reported(axes: Any) -> None:
    axes.axvspan(*REPORTED, color="0.85", zorder=0, label="report's simulation stops")
    axes.grid(alpha=0.3)


def violation(result: Row) -> Figure:
    """Constraint violation against time of one run of each kind, case 2."""
    figure, (axes,) = panels(1, 1, 8, 4.2)
    kinds = ("corrected", "printed p", "gamma: lost dots", "d~^T in the Jacobian", "all four")
    tight = "ode45 1e-06/1e-09"
    _reported(axes)
    for name, scheme in (("corrected", "ode45 1e-03/1e-06"), *((kind, tight) for kind in kinds)):
        for row in result["trials"]:
            if (row["name"], row["scheme"], row["case"]) != (name, scheme, 2):
                continue
            series = row["series"]
            values = np.array(series["violation"], dtype=float)
            (line,) = axes.semilogy(series["t"][1:], values[1:], label=f"{name}, {scheme}")
            if row["failure"]:
                axes.plot(row["reached"], values[-1], "x", color=line.get_color(), ms=9, mew=2)
    axes.set(xlabel="t [s]", ylabel="largest constraint violation [m or 1]")
    axes.set_title("Case 2: constraint violation; a cross marks where a run stopped", fontsize=10)
    axes.legend(fontsize=8, loc="lower right")
    return figure


def stiffness(result: Row) -> Figure:
    """Eigenvalues along the path, and steps times the fastest of them."""
    figure, axes = panels(2, 1, 8, 6.2)
    for row in result["stiffness"]:
        label = f"case {row['case'][-1]}"
        axes[0].semilogy(row["t"], row["dense"]["fastest"], label=label)
        axes[1].semilogy(row["t"], row["dense"]["step_times_fastest"], label=label)
    axes[0].set(ylabel="fastest eigenvalue, |lambda| [1/s]")
    axes[1].set(ylabel="step h |lambda| [1]", xlabel="t [s]")
    axes[1].axhline(3.3, color="k", ls="--", lw=1, label="stability limit on the real axis, 3.3")
    title = "Linearised corrected equations, and the steps of ode45 at 1e-3/1e-6"
    axes[0].set_title(title, fontsize=10)
    for a in axes:
        _reported(a)
    axes[1].set_ylim(0.03, None)
    axes[1].legend(fontsize=8, ncols=2, loc="lower center")
    return figure
