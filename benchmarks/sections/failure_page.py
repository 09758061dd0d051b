"""Figures of docs/failure.md, from the record of the failure benchmark alone."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure
from shared.pages import Row, legend, panels

from stmuav_jax.figures import look

DEFAULT, TIGHT = "ode45 1e-03/1e-06", "ode45 1e-06/1e-09"
# What is done differently, and the scheme -> what its curve is called.
VIOLATIONS = {
    ("corrected", DEFAULT): "corrected, default tolerances",
    ("corrected", TIGHT): "corrected",
    ("printed p", TIGHT): "Euler parameters as printed",
    ("gamma: lost dots", TIGHT): "lost dots",
    ("d~^T in the Jacobian", TIGHT): "transposed Jacobian",
    ("all four", TIGHT): "all four misprints",
}


def figures(record: Row) -> dict[str, Figure]:
    """All figures by name."""
    makers = (violation, collapse, stiffness, alignment)
    return {make.__name__: make(record) for make in makers}


def finished(figure: Figure, axes: list[Any], columns: int) -> Figure:
    """The figure with the time of the reported stop in each panel and one legend below."""
    for ax in axes:
        ax.axvspan(0.45, 0.5, color="0.8", zorder=0, label="the report's simulation stops")
    legend(figure, axes, columns, handlelength=3.5)
    return figure


def violation(record: Row) -> Figure:
    """Constraint violation over time of one run of each kind, case 2."""
    figure, (ax,) = panels(1, 1, 4.2)
    runs = {(r["name"], r["scheme"]): r for r in record["trials"] if r["case"] == 2}
    for k, (key, label) in enumerate(VIOLATIONS.items()):
        times, values = (np.array(runs[key]["series"][name]) for name in ("t", "violation"))
        own = look(k)
        # the start has no violation, which a logarithm cannot show
        ax.semilogy(times[1:], values[1:], **own, markevery=(5 + k, 20), label=label)
        if runs[key]["failure"]:
            end = {"color": own["color"], "marker": "x", "markersize": 9, "markeredgewidth": 2}
            ax.plot(runs[key]["reached"], values[-1], **end)
    ax.plot([], [], "kx", markersize=8, markeredgewidth=2, label="the run stops")
    ax.set(xlabel="time [s]", ylabel="largest violation [m; direction cosines: 1]")
    ax.set_title(f"Case 2, {TIGHT} where no other tolerances are named")
    return finished(figure, [ax], 2)


def collapse(record: Row) -> Figure:
    """When runs with the printed table stop, by case and tolerances, in ten geometries."""
    figure, (ax,) = panels(1, 1, 3.4)
    rows = [(row["name"], row["case"]) for row in record["collapses"]]
    kinds = list(dict.fromkeys(rows))
    for row, key in zip(record["collapses"], rows, strict=True):
        tight = row["scheme"] == TIGHT
        own = look(int(tight)) | {"linestyle": "", "markersize": 6}
        ends = [time for time, _ in row["ends"]]
        height = kinds.index(key) + (0.17 if tight else -0.17)
        ax.plot(ends, [height] * len(ends), **own, fillstyle="none", label=row["scheme"])
        ax.plot(ends[0], height, **own)
    words = {"gamma: lost dots": "lost dots", "all four": "all four misprints"}
    ax.set_yticks(range(len(kinds)), [f"{words[name]}, case {case}" for name, case in kinds])
    ax.invert_yaxis()
    ax.set_xlabel("time at which the run stops [s]")
    ax.set_title("Table 4.1 of Part II as printed; filled: the adopted geometry")
    return finished(figure, [ax], 3)


def stiffness(record: Row) -> Figure:
    """Largest eigenvalues along the path and steps times them: to the reported stop, and all."""
    figure, axes = panels(2, 2, 5.0, sharex="col")
    largest = ("fastest", "largest |eigenvalue| [1/s]", 100)
    step = ("step_times_fastest", "step x |eigenvalue| [1]", 3.6)
    for pair, (key, words, top) in ((axes[:2], largest), (axes[2:], step)):
        for k, run in enumerate(record["stiffness"]):
            for ax in pair:
                own = look(k) | {"label": f"case {run['case'][-1]}"}
                ax.plot(run["t"], run["dense"][key], **own, markevery=5 if ax is pair[1] else 1)
        pair[0].set(ylabel=words, xlim=(0, 0.52), ylim=(0, top))
        pair[1].set_yscale("log")
    limit = {"color": "k", "linestyle": (0, (6, 3)), "linewidth": 1}
    for ax in axes[2:]:
        ax.axhline(3.3, **limit, label="limit of stability on the real axis, 3.3")
        ax.set_xlabel("time [s]")
    axes[3].set_ylim(0.1, 10)
    axes[0].set_title("to the reported stop")
    axes[1].set_title("the whole run")
    title = "Corrected equations, linearised, and the steps of ode45 at 1e-3/1e-6"
    figure.suptitle(title, fontsize=10)
    return finished(figure, axes, 3)


def alignment(record: Row) -> Figure:
    """When and how closely rod 5 meets the first axis of its universal joint, by geometry."""
    figure, axes = panels(2, 1, 5.0, sharex=True, height_ratios=(3, 1))
    rows = [row for row in record["alignment"]["rows"] if row["scene"] == "uav_tracker"]
    for row in rows:
        ax, case = axes[row["swapped"]], row["case"]
        times, angles, _ = np.array(row["closest"]).T
        own = look(case - 1) | {"linestyle": ""}
        ax.plot(times, angles, **own, fillstyle="none", label=f"case {case}")
        ax.plot(times[0], angles[0], **own | {"markersize": 9, "markeredgecolor": "k", "zorder": 4})
    axes[0].axhline(5.0, color="k", linestyle=(0, (6, 3)), linewidth=1, label="5 degrees")
    axes[0].set(yscale="log", title="axes of the joint as adopted; filled: the adopted geometry")
    axes[1].set(xlim=(0, 1.02), ylim=(70, 90), title="axes swapped")
    axes[1].set_xlabel("time of the closest approach [s]")
    figure.supylabel("closest angle within 1 s [degrees]", fontsize=9)
    return finished(figure, axes, 5)
