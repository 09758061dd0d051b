"""Figures of docs/failure.md, from the record of the failure benchmark alone; takes some seconds.

    python docs/make_failure.py

Writes docs/figures/failure/*.png.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from stmuav_jax.figures import grid, look, save_figures

ROOT = Path(__file__).parents[1]
RECORD = ROOT / "benchmarks" / "results" / "failure.json"
FOLDER = ROOT / "docs" / "figures" / "failure"
DEFAULT, TIGHT = "ode45 1e-03/1e-06", "ode45 1e-06/1e-09"
# Difference from the corrected equations, and scheme -> name of the curve.
VIOLATIONS = {
    ("corrected", DEFAULT): "corrected, default tolerances",
    ("corrected", TIGHT): "corrected",
    ("printed p", TIGHT): "Euler parameters as printed",
    ("gamma: lost dots", TIGHT): "lost dots",
    ("d~^T in the Jacobian", TIGHT): "transposed Jacobian",
    ("all four", TIGHT): "all four misprints",
}
BOUND = {"color": "k", "linestyle": (0, (6, 3)), "linewidth": 1}


def finish(figure: Figure, axes: list[Any], columns: int) -> Figure:
    """The figure with the time of the reported stop in each panel and one legend below."""
    labels: dict[str, Any] = {}
    for ax in axes:
        ax.axvspan(0.45, 0.5, color="0.8", zorder=0, label="the report's simulation stops")
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True):
            labels.setdefault(label, line)
        for text in (ax.title, ax.xaxis.label, ax.yaxis.label):
            text.set_fontsize(9)
    figure.legend(
        labels.values(), labels.keys(), ncols=columns, fontsize=8, loc="outside lower center",
        handlelength=3.5,
    )  # fmt: skip
    return figure


def violation(record: dict[str, Any]) -> Figure:
    """Constraint violation over time of one run of each kind, case 2."""
    figure, axes = grid(1, 1, 4.2)
    ax = axes[0, 0]
    runs = {(r["name"], r["scheme"]): r for r in record["trials"] if r["case"] == 2}
    for k, (key, label) in enumerate(VIOLATIONS.items()):
        times, values = (np.array(runs[key]["series"][name]) for name in ("t", "violation"))
        style = look(k)
        # The start has no violation, which a logarithm cannot show.
        ax.semilogy(times[1:], values[1:], **style, markevery=(5 + k, 20), label=label)
        if runs[key]["failure"]:
            end = {"color": style["color"], "marker": "x", "markersize": 9, "markeredgewidth": 2}
            ax.plot(runs[key]["reached"], values[-1], **end)
    ax.plot([], [], "kx", markersize=8, markeredgewidth=2, label="the run stops")
    ax.set(xlabel="time [s]", ylabel="largest violation [m; direction cosines: 1]")
    ax.set_title(f"Case 2: runs stop with misprints only ({TIGHT} unless named)")
    return finish(figure, [ax], 2)


def collapse(record: dict[str, Any]) -> Figure:
    """When runs with the printed table stop, by case and tolerances, in ten geometries."""
    figure, axes = grid(1, 1, 3.4)
    ax = axes[0, 0]
    rows = [(row["name"], row["case"]) for row in record["collapses"]]
    kinds = list(dict.fromkeys(rows))
    for row, key in zip(record["collapses"], rows, strict=True):
        is_tight = row["scheme"] == TIGHT
        style = look(int(is_tight)) | {"linestyle": "", "markersize": 6}
        ends = [time for time, _ in row["ends"]]
        height = kinds.index(key) + (0.17 if is_tight else -0.17)
        ax.plot(ends, [height] * len(ends), **style, fillstyle="none", label=row["scheme"])
        ax.plot(ends[0], height, **style)
    words = {"gamma: lost dots": "lost dots", "all four": "all four misprints"}
    ax.set_yticks(range(len(kinds)), [f"{words[name]}, case {case}" for name, case in kinds])
    ax.invert_yaxis()
    ax.set_xlabel("time at which the run stops [s]")
    ax.set_title(
        "All four misprints stop runs around the reported time, lost dots alone later\n"
        "(Table 4.1 of Part II as printed; filled: the adopted geometry)"
    )
    return finish(figure, [ax], 3)


def stiffness(record: dict[str, Any]) -> Figure:
    """Largest eigenvalues along the path and steps times them: to the reported stop, and all."""
    figure, axes = grid(2, 2, 5.0, sharex="col")
    largest = ("fastest", "largest |eigenvalue| [1/s]", 100)
    step = ("step_times_fastest", "step x |eigenvalue| [1]", 3.6)
    for pair, (key, words, top) in zip(axes, (largest, step), strict=True):
        for k, run in enumerate(record["stiffness"]):
            for ax, every in zip(pair, (1, 5), strict=True):
                style = look(k) | {"label": f"case {run['case'][-1]}", "markevery": every}
                ax.plot(run["t"], run["dense"][key], **style)
        pair[0].set(ylabel=words, xlim=(0, 0.52), ylim=(0, top))
        pair[1].set_yscale("log")
    for ax in axes[1]:
        ax.axhline(3.3, **BOUND, label="limit of stability on the real axis, 3.3")
        ax.set_xlabel("time [s]")
    axes[1, 1].set_ylim(0.1, 10)
    axes[0, 0].set_title("to the reported stop")
    axes[0, 1].set_title("the whole run")
    title = "Corrected equations, steps of ode45 at 1e-3/1e-6: not stiff up to the reported stop"
    figure.suptitle(title, fontsize=10)
    return finish(figure, [*axes.flat], 3)


def alignment(record: dict[str, Any]) -> Figure:
    """When and how closely rod 5 meets the first axis of its universal joint, by geometry."""
    figure, axes = grid(2, 1, 5.0, sharex=True, height_ratios=(3, 1))
    top, bottom = axes[:, 0]
    for row in record["alignment"]["rows"]:
        if row["scene"] != "uav_tracker":
            continue
        ax, case = (bottom if row["swapped"] else top), row["case"]
        times, angles, _ = np.array(row["closest"]).T
        style = look(case - 1) | {"linestyle": ""}
        ax.plot(times, angles, **style, fillstyle="none", label=f"case {case}")
        large = {"markersize": 9, "markeredgecolor": "k", "zorder": 4}
        ax.plot(times[0], angles[0], **style | large)
    top.axhline(5.0, **BOUND, label="5 degrees")
    top.set_yscale("log")
    top.set_title(
        "Rod 5 may align with its joint's axis, mostly after 0.5 s (filled: the adopted geometry)"
    )
    bottom.set(xlim=(0, 1.02), ylim=(70, 90), xlabel="time of the closest approach [s]")
    bottom.set_title("With the joint's axes in the other order it never does")
    figure.supylabel("closest angle within 1 s [degrees]", fontsize=9)
    return finish(figure, [top, bottom], 5)


def main() -> None:
    record = json.loads(RECORD.read_text())
    figures = {make.__name__: make(record) for make in (violation, collapse, stiffness, alignment)}
    save_figures(figures, FOLDER, dpi=160)


if __name__ == "__main__":
    main()
