"""Figures of the suite's page, from its JSON files alone."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from shared.pages import NATIVE, Row, legend_of, ours, panels, save

MARKS = "osD^vP*X<>h8p"
# Thirteen colours that stay apart for the colour-blind, those of Okabe and Ito first.
COLORS = (
    "#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000", "#E69F00",
    "#56B4E9", "#882255", "#999933", "#666666", "#44AA99", "#332288",
    "#DDCC77",
)  # fmt: skip


def draw(results: dict[str, Row], folder: Path) -> dict[str, list[Path]]:
    """Write all figures as PNG; returns their paths by section."""
    makers = {"batch": batch, "scaling": scaling, "acceleration": acceleration}
    made: dict[str, list[Path]] = {}
    for name, result in results.items():
        figures: dict[str, Figure] = {}
        if "curves" in result:
            for curve in result["curves"]:
                if curve["rows"]:
                    figures[f"{name}_{curve['problem']}"] = work_precision(curve)
        elif name in makers:
            figures[name] = makers[name](result)
        made[name] = save(figures, folder)
    return made


def _short(row: Row) -> str:
    """A point's tolerance or step."""
    if row["tolerance"] is not None:
        return f"{row['tolerance']:.0e}".replace("e-0", "e-")
    return f"{row['step']:g} s"


def work_precision(curve: Row) -> Figure:
    """Run time against error of every method; ends of each line labelled by its setting."""
    ends = curve["horizons"]
    figure, sides = panels(1, len(ends), 1.5 + 4.6 * len(ends), 5.4, sharey=True)
    methods = list(dict.fromkeys((row["method"], row["solver"]) for row in curve["rows"]))
    # a method with native loops is dotted, in the colour of the same without them
    alike = [(name.removesuffix(NATIVE), solver) for name, solver in methods]
    order = list(dict.fromkeys(alike))
    shown = [row for row in curve["rows"] if drawn(row)]
    for axes, end in zip(sides, ends, strict=True):
        for (method, solver), like in zip(methods, alike, strict=True):
            k, which = order.index(like), (method, solver, end)
            rows = [r for r in shown if (r["method"], r["solver"], r["horizon"]) == which]
            if not rows:
                continue
            x = [row["error"] for row in rows]
            y = [1e3 * row["seconds"]["median"] for row in rows]
            mine = method.startswith("stmuav-jax")
            style = {"lw": 2.0, "ls": "-"} if mine else {"lw": 1.0, "ls": "--"}
            style |= {"ls": ":"} if method.endswith(NATIVE) else {}
            name = method if solver in method else f"{method}, {solver}"
            color = COLORS[k % len(COLORS)]
            axes.loglog(x, y, marker=MARKS[k % len(MARKS)], ms=5, color=color, label=name, **style)
            for row, a, b in list(zip(rows, x, y, strict=True))[:: max(1, len(rows) - 1)]:
                axes.annotate(
                    _short(row), (a, b), xytext=(3, 4), textcoords="offset points",
                    fontsize=6, color=color,
                )  # fmt: skip
        axes.set(xlabel="position error [m]", title=f"to {end:g} s")
        axes.grid(alpha=0.3)
        axes.invert_xaxis()
    sides[0].set_ylabel("run time [ms]")
    lines = legend_of(sides)
    figure.legend(
        lines.values(), lines.keys(), loc="outside lower center", fontsize=7.5,
        ncols=3 if len(ends) > 1 else 2, title_fontsize=6.5,
        title=missing(not_drawn(curve), 70 * len(ends) + 40),
    )  # fmt: skip
    figure.suptitle(curve["title"], fontsize=10)
    return figure


def drawn(row: Row) -> bool:
    """Whether a run has a point; that of a failed run would be of the part before its end."""
    return bool(row["error"] and row["seconds"] and not row["failure"])


def not_drawn(curve: Row) -> list[tuple[str, str]]:
    """Methods without a point in the figure, each with the reason."""
    absent = [(x["method"], f"not in our adapter: {x['reason']}") for x in curve["unsupported"]]
    there = {row["method"] for row in curve["rows"] if drawn(row)}
    for row in curve["rows"]:
        name = row["method"]
        if name not in there and name not in dict(absent):
            absent.append((name, row["failure"] or "the error could not be measured"))
    return absent


def missing(absent: list[tuple[str, str]], width: int) -> str:
    """Who is missing from a figure, and why; programs with one reason together."""
    together: dict[str, list[str]] = {}
    for name, reason in absent:
        together.setdefault(reason.rstrip("."), []).append(name)
    if not together:
        return ""
    text = "; ".join(f"{' / '.join(names)} ({why})" for why, names in together.items())
    return "\n".join(textwrap.wrap(f"Not shown: {text}.", width))


def batch(result: Row) -> Figure:
    """Throughput against block size; one trajectory and peers as lines."""
    figure, (axes,) = panels(1, 1, 7, 4.4)
    rows = [row for row in ours(result["rows"]) if row["per_second"] is not None]
    for k, count in enumerate(dict.fromkeys(row["trajectories"] for row in rows)):
        some = sorted((r for r in rows if r["trajectories"] == count), key=lambda r: r["block"])
        x, y = [r["block"] for r in some], [r["per_second"] for r in some]
        axes.semilogx(x, y, marker=MARKS[k], label=f"stmuav-jax, {count} trajectories", base=2)
    axes.axhline(
        result["single"]["per_second"], color="k", lw=1, ls=":", label="one after the other"
    )
    wanted = result["error_wanted"]
    for k, row in enumerate(result["rows"]):
        error = row.get("largest_error")
        fine = error is not None and error <= wanted
        if fine and row not in rows and row["per_second"] is not None:
            color, method = f"C{5 + k % 5}", row["method"]
            axes.axhline(row["per_second"], color=color, lw=1, ls="--", label=method)
    axes.set(xlabel="trajectories advanced together", ylabel="trajectories per second")
    blocks = sorted({row["block"] for row in rows})
    axes.set_xticks(blocks, [str(b) for b in blocks])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_title(f"Each {result['horizon']:g} s, errors up to {wanted:g} m", fontsize=10)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def scaling(result: Row) -> Figure:
    """Cost against the number of loops."""
    figure, (axes,) = panels(1, 1, 7, 4.4)
    rows = [row for row in result["rows"] if "bodies" in row and not row["failure"]]
    runs = [row for row in rows if row["run_seconds"]]
    many = lambda rows: np.array([row["loops"] for row in rows], float)
    series = {
        "one acceleration": (rows, [row["acceleration_seconds"] for row in rows]),
        "run of one simulated second": (runs, [row["run_seconds"]["median"] for row in runs]),
        "compilation of that run": (runs, [row["run_compile_seconds"] for row in runs]),
    }
    for k, (name, (some, y)) in enumerate(series.items()):
        axes.loglog(many(some), y, marker=MARKS[k], label=name, base=10)
    n = many(rows)
    if len(n) > 1:
        last = series["one acceleration"][1][-1]
        for power, style in ((1, ":"), (3, "-.")):
            line = last * (n / n[-1]) ** power
            axes.loglog(n, line, color="0.6", lw=1, ls=style, label=f"slope {power}")
    axes.set_xticks(n, [f"{x:g}" for x in n])
    axes.minorticks_off()
    axes.set(xlabel="closed loops N", ylabel="seconds")
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    return figure


def _program(row: Row) -> str:
    """A method without the integrator, which has no part in one acceleration."""
    method = row["method"]
    return method if method.startswith(("stmuav-jax", "NumPy")) else method.split(",")[0]


def acceleration(result: Row) -> Figure:
    """One acceleration, as points: on an axis of powers of ten, lengths of bars mean nothing."""
    rows = [row for row in result["rows"] if row["seconds"] is not None]
    figure, (axes,) = panels(1, 1, 7.5, 1.2 + 0.32 * len(rows))
    values = [1e6 * row["seconds"] for row in rows]
    names = [
        _program(row) + (f", {row['batch']} at once" if row["batch"] > 1 else "") for row in rows
    ]
    colors = ["C0" if row in ours(rows) else "0.6" for row in rows]
    axes.scatter(values, range(len(rows)), color=colors, s=30, zorder=3)
    axes.grid(alpha=0.3)
    for k, value in enumerate(values):
        axes.annotate(
            f"{value:.3g}", (value, k), xytext=(6, 0), textcoords="offset points",
            va="center", fontsize=8,
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.margins(x=0.15)
    axes.set_xlabel("microseconds per acceleration and state")
    absent = [(r["method"], r["failure"]) for r in result["rows"] if r["seconds"] is None]
    if note := missing(absent, 100):
        figure.supxlabel(note, fontsize=6.5)
    return figure
