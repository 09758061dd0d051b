"""Figures of the failure benchmark, from its JSON record alone."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from shared.pages import Row, panels, save

REPORTED = (0.45, 0.5)


def draw(result: Row, folder: Path) -> list[Path]:
    """Write all figures as PNG; returns their paths."""
    makers = {
        "violation": violation, "stiffness": stiffness, "alignment": alignment,
        "collapse": collapse,
    }  # fmt: skip
    return save({name: make(result) for name, make in makers.items()}, folder)


def _reported(axes: Any) -> None:
    axes.axvspan(*REPORTED, color="0.85", zorder=0, label="report's simulation stops")


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
    axes.grid(alpha=0.3)
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
        a.grid(alpha=0.3)
    axes[1].set_ylim(0.03, None)
    axes[1].legend(fontsize=8, ncols=2, loc="lower center")
    return figure


def alignment(result: Row) -> Figure:
    """When and how closely rod 5 meets the first axis of its universal joint, by geometry."""
    rows = [row for row in result["alignment"]["rows"] if row["scene"] == "uav_tracker"]
    figure, axes = panels(2, 1, 8, 6.2)
    for k, a in enumerate(axes):
        _reported(a)
        for row in rows:
            if row["swapped"] != bool(k):
                continue
            points = np.array(row["closest"])
            dots = a.scatter(points[:, 0], points[:, 1], s=12, label=f"case {row['case']}")
            a.plot(*points[0, :2], "*", ms=13, mec="k", color=dots.get_facecolor()[0])
        span = max((max(p[0] for p in row["closest"]) for row in rows), default=1.0)
        a.set(ylabel="closest angle [deg]", xlim=(0, 1.02 * span), ylim=(0, 60 if not k else 90))
        a.grid(alpha=0.3)
    title = (
        "Closest approach of rod 5 to the joint's first axis within 1 s, by geometry\n"
        "(star: adopted geometry); above: axes as adopted, below: swapped"
    )
    axes[0].set_title(title, fontsize=10)
    axes[0].legend(fontsize=8)
    axes[1].set_xlabel("t of the closest approach [s]")
    return figure


def collapse(result: Row) -> Figure:
    """When runs with the printed table stop, over geometries."""
    figure, (axes,) = panels(1, 1, 8, 4.2)
    _reported(axes)
    labels = []
    for k, row in enumerate(result["collapses"]):
        ends = np.array([end[0] for end in row["ends"]])
        stopped = np.array([bool(end[1]) for end in row["ends"]])
        height = np.full(len(ends), float(k))
        axes.plot(ends[stopped], height[stopped], "|", ms=13, color="C3")
        axes.plot(ends[~stopped], height[~stopped], "o", ms=5, color="C0")
        labels.append(f"{row['name']}, case {row['case']}, {row['scheme'].split()[1]}")
    axes.set_yticks(range(len(labels)), labels, fontsize=8)
    axes.invert_yaxis()
    axes.set_xlabel("t where the run stopped (bar) or ended (dot) [s]")
    axes.set_title("Table 4.1 of Part II as printed, ode45, geometries varied", fontsize=10)
    axes.legend(fontsize=8, loc="lower right")
    axes.grid(alpha=0.3, axis="x")
    return figure
