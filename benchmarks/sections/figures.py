"""Figures of the suite's page, from its JSON files alone."""

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import NullLocator
from shared.pages import NATIVE, Row, legend, ours, panels, save

from stmuav_jax.figures import look


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
    """Run time against error of every method, whose label says its coarsest and finest setting."""
    ends = curve["horizons"]
    shown = [row for row in curve["rows"] if drawn(row)]
    methods = list(dict.fromkeys((row["method"], row["solver"]) for row in shown))
    # a method with native loops is dotted, like the same without them in all else
    alike = [(name.removesuffix(NATIVE), solver) for name, solver in methods]
    order = list(dict.fromkeys(alike))
    figure, sides = panels(1, len(ends), 3.6 + 0.12 * len(methods), sharey=True)
    for (method, solver), like in zip(methods, alike, strict=True):
        mine = [row for row in shown if (row["method"], row["solver"]) == (method, solver)]
        name = method if solver in method else f"{method}, {solver}"
        name += f" ({' to '.join(dict.fromkeys(_short(mine[k]) for k in (0, -1)))})"
        line = ":" if method.endswith(NATIVE) else "-" if ours(mine) else "--"
        style = look(order.index(like)) | {"linestyle": line, "label": name}
        for axes, end in zip(sides, ends, strict=True):
            rows = [row for row in mine if row["horizon"] == end]
            y = [1e3 * row["seconds"]["median"] for row in rows]
            axes.loglog([row["error"] for row in rows], y, **style)
    for axes, end in zip(sides, ends, strict=True):
        axes.set(xlabel="position error [m]", title=f"to {end:g} s")
    sides[0].set_ylabel("run time [ms]")
    legend(figure, sides, 2, 6.5, title=missing(not_drawn(curve), 130))
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
    figure, (axes,) = panels(1, 1, 3.6)
    rows = [row for row in ours(result["rows"]) if row["per_second"] is not None]
    for k, count in enumerate(dict.fromkeys(row["trajectories"] for row in rows)):
        some = sorted((r for r in rows if r["trajectories"] == count), key=lambda r: r["block"])
        x, y = [r["block"] for r in some], [r["per_second"] for r in some]
        # points that lie on top of each other stay visible
        own = look(k) | {"markersize": 4 + 3 * k, "fillstyle": "none" if k else "full"}
        axes.semilogx(x, y, **own, label=f"stmuav-jax, {count} trajectories", base=2)
    level = {"color": "0.4", "linestyle": ":", "label": "stmuav-jax, one after the other"}
    axes.axhline(result["single"]["per_second"], **level)
    wanted = result["error_wanted"]
    fine = lambda row: (row.get("largest_error") or np.inf) <= wanted and row["per_second"]
    for k, row in enumerate([r for r in result["rows"] if r not in rows and fine(r)], 4):
        axes.axhline(row["per_second"], **look(k) | {"marker": ""}, label=row["method"])
    axes.set(xlabel="trajectories advanced together", ylabel="trajectories per second [1/s]")
    blocks = sorted({row["block"] for row in rows})
    axes.set_xticks(blocks, [str(b) for b in blocks])
    axes.minorticks_off()
    axes.set_ylim(bottom=0)
    axes.set_title(f"Each {result['horizon']:g} s, errors up to {wanted:g} m")
    axes.legend(fontsize=8)
    return figure


def scaling(result: Row) -> Figure:
    """Times against the number of loops, a panel each, with the slope between the last two points."""
    rows = [row for row in result["rows"] if "bodies" in row and not row["failure"]]
    runs = [row for row in rows if row["run_seconds"]]
    series = {
        "one acceleration": (rows, [row["acceleration_seconds"] for row in rows]),
        "run of 1 s of motion": (runs, [row["run_seconds"]["median"] for row in runs]),
        "compilation of that run": (runs, [row["run_compile_seconds"] for row in runs]),
    }
    figure, sides = panels(1, len(series), 2.8, sharex=True)
    for axes, (name, (some, y)) in zip(sides, series.items(), strict=True):
        n = [row["loops"] for row in some]
        axes.loglog(n, y, **look(0))
        if len(n) > 1:
            slope = np.log(y[-1] / y[-2]) / np.log(n[-1] / n[-2])
            name += f",\nslope {slope:.1f} from N = {n[-2]} to {n[-1]}"
        axes.set(xlabel="closed loops N", title=name)
    many = [row["loops"] for row in rows]
    sides[0].set_xticks(many, [str(x) for x in many])
    sides[0].xaxis.set_minor_locator(NullLocator())
    sides[0].set_ylabel("time [s]")
    return figure


def _program(row: Row) -> str:
    """A method without the integrator, which has no part in one acceleration."""
    method = row["method"]
    return method if method.startswith(("stmuav-jax", "NumPy")) else method.split(",")[0]


def acceleration(result: Row) -> Figure:
    """One acceleration, as points: on an axis of powers of ten, lengths of bars mean nothing."""
    rows = [row for row in result["rows"] if row["seconds"] is not None]
    figure, (axes,) = panels(1, 1, 1.2 + 0.26 * len(rows))
    values = [1e6 * row["seconds"] for row in rows]
    names = [
        _program(row) + (f", {row['batch']} at once" if row["batch"] > 1 else "") for row in rows
    ]
    for k, (row, value) in enumerate(zip(rows, values, strict=True)):
        own = {**look(0)} if row in ours(rows) else {**look(3), "fillstyle": "none"}
        axes.plot(value, k, **own | {"linestyle": "", "marker": "o"})
    for k, value in enumerate(values):
        axes.annotate(
            f"{value:.3g}", (value, k), xytext=(6, 0), textcoords="offset points",
            va="center", fontsize=8,
        )  # fmt: skip
    axes.set_yticks(range(len(rows)), names, fontsize=8)
    axes.invert_yaxis()
    axes.set_xscale("log")
    axes.margins(x=0.15)
    axes.set_xlabel("time per acceleration and state [us]; filled: this package")
    absent = [(r["method"], r["failure"]) for r in result["rows"] if r["seconds"] is None]
    if note := missing(absent, 100):
        figure.supxlabel(note, fontsize=6.5)
    return figure
