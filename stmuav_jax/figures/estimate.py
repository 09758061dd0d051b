"""Tables, figures and datasets of the eight cases of estimation and of the hover."""

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ..estimation.consistency import mean_interval
from ..files.labelled import Labelled
from ..files.netcdf import labelled
from ..quadrotor.assess import CaseStudy, CaseSummary, Estimates, last_beyond, settled_from
from ..quadrotor.filter_verdict import RunsVerdict
from ..quadrotor.hover import Hover
from .filter_record import FORMAT, FORMAT_VERSION, normalised_innovations
from .plot import STYLES, grid, look

COMPONENTS = ("Omega_x", "Omega_y", "Omega_z", "offset_x", "offset_y")
_LOOKS = {"truth": ("0.6", "-"), "report": STYLES[1], "consistent": STYLES[0]}


# --- tables


def summary_table(summaries: Iterable[CaseSummary]) -> Table:
    """Table of convergence, errors, consistency and verdict, with a row per case and tuning."""
    rows = list(summaries)
    title = f"Centre of mass: convergence, errors, consistency ({rows[0].seeds} seeds)"
    table = Table(title=title, title_justify="left", padding=(0, 0, 0, 1))
    # in a narrow terminal numbers are broken over two lines, and no word is cut
    for name in ("case", "tuning"):
        table.add_column(name, no_wrap=True)
    for name in ("to 2 cm\n[s]", "to 5 mm\n[s]", "RMSE x, y\n[mm]", "NEES\n(2)", "NEES\n(5)",
                 "NIS\n(3)", "flag-\nged"):  # fmt: skip
        table.add_column(Text(name), justify="right")
    for row in rows:
        table.add_row(
            str(row.case), row.tuning, _seconds(row.to_2cm), _seconds(row.to_5mm),
            f"{1e3 * row.rmse[0]:.2f}, {1e3 * row.rmse[1]:.2f}",
            _mean(row.nees_offset, row.nees_offset_window), _mean(row.nees, row.nees_window),
            _mean(row.nis, row.nis_window), str(row.verdict.flagged),
        )  # fmt: skip
    table.caption = (
        "Medians of the times from which on the error is below 2 cm and 5 mm. After "
        f"{rows[0].settling_time:g} s: RMSE, and the means of NEES of the offset (2 is right), of rates and "
        "offset (5), and of NIS (3); high and low: outside the interval of 99.9 % of a consistent "
        "filter. Flagged: runs whose innovations contradict their filter."
    )
    return table


def verdict_lines(found: dict[str, RunsVerdict]) -> list[str]:
    """Line with the verdict for each title; up to two are given in full."""
    lines = [f"{title}: {one.short}." for title, one in found.items()]
    return lines if len(found) > 2 else [f"{title}: {one.words}" for title, one in found.items()]


def _seconds(value: float) -> str:
    return "never" if math.isnan(value) else f"{value:.3f}"


def _mean(value: float, window: tuple[float, float]) -> str:
    if not math.isfinite(value):
        return "-"
    side = " low" if value < window[0] else " high" if value > window[1] else ""
    return f"{value:.3g}{side}"


def hover_table(flights: dict[str, Hover]) -> Table:
    """Table of hovers by tuning: largest tilt and distance, errors, final consistency."""
    table = Table(title="Hover by a controller that sees the estimate", title_justify="left")
    table.add_column("tuning", no_wrap=True)
    for name in ("largest tilt\n[degrees]", "furthest\n[m]", "to 2 cm\n[s]", "RMSE x, y\n[mm]",
                 "NEES\n(2)", "NEES\n(14)", "failed"):  # fmt: skip
        table.add_column(Text(name), justify="right")
    end = float(max(flight.t[-1] for flight in flights.values()))
    for name, flight in flights.items():
        t = np.asarray(flight.t)
        error = np.asarray(flight.mean - flight.truth)[:, 3:]
        seeds = error.shape[2]
        settled = t[1:] > settled_from(t[-1])
        rmse = 1e3 * np.sqrt(np.mean(error[settled] ** 2, axis=(0, 2)))
        table.add_row(
            name, f"{np.degrees(np.max(np.asarray(flight.tilt))):.1f}",
            f"{np.max(np.linalg.norm(np.asarray(flight.r), axis=1)):.3f}",
            _seconds(float(np.median(last_beyond(error, t, 0.02)))),
            f"{rmse[0]:.2f}, {rmse[1]:.2f}",
            _mean(float(np.mean(flight.nees_offset[-1])), mean_interval(2, seeds)),
            _mean(float(np.mean(flight.nees[-1])), mean_interval(14, seeds)),
            f"{int(np.sum(~np.asarray(flight.ok)[-1]))} of {seeds}",
        )  # fmt: skip
    table.caption = (
        f"RMSE after {settled_from(end):g} s; NEES at the end; high and low: outside the interval of "
        "99.9 % of a consistent filter's means."
    )
    return table


# --- figures


def _line(ax: Axes, t: Any, values: Any, name: str, **more: Any) -> None:
    color, dash = _LOOKS[name]
    width = 3.0 if name == "truth" else 1.3
    more = {"linewidth": width, "color": color, "linestyle": dash, "label": name} | more
    ax.plot(t, values, **more)


def _title(study: CaseStudy) -> str:
    return f"Report Part III, case {study.record.case}"


def offset(study: CaseStudy) -> Figure:
    """Figure of the centre of mass, estimate and truth, over the whole time and at the start.

    Source: in the style of report Part III, Fig. 3.1.3 to 3.1.18.
    """
    figure, axes = grid(2, 2, 4.6)
    t = np.asarray(study.record.t)
    truth = np.asarray(study.record.offset)[..., 0]
    for row, axis in enumerate("xy"):
        for ax, count in zip(axes[row], (len(t) - 1, min(30, len(t) - 1)), strict=True):
            _line(ax, t[: count + 1], truth[: count + 1, row], "truth")
            for name, found in study.estimates.items():
                values = np.asarray(found.mean)[:count, 3 + row, 0]
                _line(ax, t[1 : count + 1], values, name)
            ax.set_xlabel("time [s]", fontsize=9)
        axes[row, 0].set_ylabel(f"centre of mass, {axis} [m]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].set_title("the first 30 steps", fontsize=9)
    figure.suptitle(f"{_title(study)}: where is the centre of mass", fontsize=11)
    return figure


def rates(study: CaseStudy) -> Figure:
    """Figure of the body rates over the first half second, estimate and truth."""
    figure, axes = grid(3, 1, 5.4)
    t = np.asarray(study.record.t)
    count = int(np.searchsorted(t, 0.5))
    count = min(count, len(t) - 1)
    truth = np.asarray(study.record.omega)[..., 0]
    for row, axis in enumerate("xyz"):
        ax = axes[row, 0]
        _line(ax, t[: count + 1], truth[: count + 1, row], "truth")
        for name, found in study.estimates.items():
            _line(ax, t[1 : count + 1], np.asarray(found.mean)[:count, row, 0], name)
        ax.set_ylabel(rf"$\Omega_{axis}$ [rad/s]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{_title(study)}: body rates", fontsize=11)
    return figure


def errors(study: CaseStudy) -> Figure:
    """Figure of errors of the centre of mass of up to 20 seeds, with the filter's 3-sigma band."""
    names = list(study.estimates)
    figure, axes = grid(2, len(names), 4.6)
    t = np.asarray(study.record.t)[1:]
    for column, name in enumerate(names):
        found: Estimates = study.estimates[name]
        error, deviation = np.asarray(found.error), np.asarray(found.standard_deviation)
        for row, axis in enumerate("xy"):
            ax = axes[row, column]
            ax.plot(t, 1e3 * error[:, 3 + row, :20], color="0.65", linewidth=0.4)
            band = 3e3 * deviation[:, 3 + row, 0]
            for sign in (1, -1):
                ax.plot(t, sign * band, color=_LOOKS[name][0], linewidth=1.3)
            ax.set_ylim(-8, 8)
            ax.set_ylabel(f"error, {axis} [mm]", fontsize=9)
        axes[0, column].set_title(f"{name} tuning, band: 3 sigma", fontsize=9)
        axes[1, column].set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{_title(study)}: errors of up to 20 seeds", fontsize=11)
    return figure


def consistency(study: CaseStudy) -> Figure:
    """Figure of NEES and NIS, means over the seeds, with their 99.9 % intervals."""
    figure, axes = grid(2, 1, 4.8)
    t = np.asarray(study.record.t)[1:]
    seeds = study.record.seeds
    for row, (words, degrees) in enumerate((("NEES (5)", 5), ("NIS (3)", 3))):
        ax = axes[row, 0]
        ax.axhspan(*mean_interval(degrees, seeds), color="0.8", label="consistent: 99.9 %")
        for k, (name, found) in enumerate(study.estimates.items()):
            values = np.asarray(found.nees if degrees == 5 else found.nis)
            # marks, since dashes drown in the noise
            where = (len(t) // 20 * k, max(1, len(t) // 10))
            own = {"marker": look(k)["marker"], "markeredgecolor": "white", "markevery": where}
            _line(ax, t, np.mean(values, axis=1), name, linewidth=0.8, linestyle="-", **own)
        ax.set_yscale("log")
        ax.axvline(settled_from(t[-1]), color="0.4", linewidth=0.8, linestyle=":", label="settled")
        ax.set_ylabel(f"mean {words} [1]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    axes[1, 0].set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{_title(study)}: {seeds} seeds", fontsize=11)
    return figure


CASE_FIGURES = {"offset": offset, "rates": rates, "errors": errors, "consistency": consistency}


def hover(flights: dict[str, Hover]) -> Figure:
    """Figure of tilt, height and estimated centre of mass of hovers, by tuning; first seed."""
    figure, axes = grid(2, 2, 4.8)
    flight = next(iter(flights.values()))
    for column, axis in enumerate("xy"):
        ax, t = axes[1, column], np.asarray(flight.t)[1:]
        _line(ax, t, np.asarray(flight.truth)[:, 3 + column, 0], "truth")
        ax.set_ylabel(f"centre of mass, {axis} [m]", fontsize=9)
        ax.set_xlabel("time [s]", fontsize=9)
    for name, flight in flights.items():
        t = np.asarray(flight.t)[1:]
        _line(axes[0, 0], t, np.degrees(np.asarray(flight.tilt))[:, 0], name)
        _line(axes[0, 1], t, np.asarray(flight.r)[:, 2, 0], name)
        for column in range(2):
            _line(axes[1, column], t, np.asarray(flight.mean)[:, 3 + column, 0], name)
    axes[0, 0].set_ylabel("tilt [degrees]", fontsize=9)
    axes[0, 1].set_ylabel("height [m]", fontsize=9)
    axes[1, 0].legend(fontsize=8)
    figure.suptitle("Hover by a controller that sees the estimate", fontsize=11)
    return figure


# --- files


def labelled_case(study: CaseStudy) -> Labelled:
    """Content of a saved case, with dimensions time, seed, tuning, component, rotor, axis.

    Times are the ends of the steps, over which the thrusts are constant.
    """
    record, found = study.record, study.estimates
    together = lambda pick: np.stack([np.asarray(pick(e)) for e in found.values()])
    path = ("time", "component", "seed")
    each = ("tuning", *path)
    scalar = ("tuning", "time", "seed")
    first = next(iter(found.values()))
    table = {
        "thrust": (("time", "rotor"), record.u, "N", "of each rotor, held over the step"),
        "truth": (path, first.truth, "rad/s, m", "body rates and centre of mass"),
        "euler_parameters": (("time", "e", "seed"), record.p[1:], "1", "true, body to world"),
        "measured": (("time", "axis", "seed"), record.y[:, :3], "rad/s", "by the gyroscope"),
        "estimate": (each, together(lambda e: e.mean), "rad/s, m", "means"),
        "standard_deviation": (
            each,
            together(lambda e: e.standard_deviation),
            "rad/s, m",
            "the filter's own",
        ),
        "innovation": _innovations(found.values()),
        "nees": (scalar, together(lambda e: e.nees), "1", "of rates and offset, 5 degrees"),
        "nees_offset": (scalar, together(lambda e: e.nees_offset), "1", "2 degrees of freedom"),
        "nis": (scalar, together(lambda e: e.nis), "1", "of the innovations, 3 degrees"),
        "ok": (scalar, together(lambda e: e.ok), "1", "whether the filter still runs"),
    }
    return _dataset(
        table,
        {"time": _times(record.t), "tuning": list(found)},
        _title(study),
        {name: summary.plain() for name, summary in study.summaries.items()},
    )


def labelled_hover(flights: dict[str, Hover]) -> Labelled:
    """Content of saved hovers, with dimensions as in `labelled_case`."""
    together = lambda pick: np.stack([np.asarray(pick(h)) for h in flights.values()])
    each = ("tuning", "time", "component", "seed")
    scalar = ("tuning", "time", "seed")
    table = {
        "thrust": (("tuning", "time", "rotor", "seed"), together(lambda h: h.thrust), "N", ""),
        "position": (
            ("tuning", "time", "axis", "seed"), together(lambda h: h.r), "m",
            "true, of the epicentre, world",
        ),
        "truth": (each, together(lambda h: h.truth), "rad/s, m", "body rates and centre of mass"),
        "estimate": (each, together(lambda h: h.mean), "rad/s, m", "means"),
        "standard_deviation": (each, together(lambda h: h.standard_deviation), "rad/s, m", "the filter's own"),
        "tilt": (scalar, together(lambda h: h.tilt), "rad", "true, of the rotors' axis"),
        "innovation": _innovations(flights.values()),
        "nees": (scalar, together(lambda h: h.nees), "1", "of all 14 error states"),
        "nees_offset": (scalar, together(lambda h: h.nees_offset), "1", "2 degrees of freedom"),
        "nis": (scalar, together(lambda h: h.nis), "1", "6 degrees of freedom"),
        "ok": (scalar, together(lambda h: h.ok), "1", "whether the filter still runs"),
    }  # fmt: skip
    first = next(iter(flights.values()))
    coordinates = {"time": _times(first.t), "tuning": list(flights)}
    found = {name: {"verdict": flight.verdict()._asdict()} for name, flight in flights.items()}
    return _dataset(table, coordinates, "Hover by a controller that sees the estimate", found)


def _innovations(found: Iterable[Estimates | Hover]) -> tuple[tuple[str, ...], Any, str, str]:
    """Normalised innovations of all tunings; those that are missing, or that only another has, are NaN."""
    every = [normalised_innovations(e) for e in found]
    most = max(each.shape[1] for each in every)
    wide = [
        np.pad(e, ((0, 0), (0, most - e.shape[1]), (0, 0)), constant_values=np.nan) for e in every
    ]
    dims = ("tuning", "time", "reading", "seed")
    return dims, np.stack(wide), "1", "normalised, of unit covariance if the filter is consistent"


def _times(t: Any) -> tuple[tuple[str], np.ndarray, dict[str, str]]:
    words = {"units": "s", "description": "ends of the steps"}
    return ("time",), np.asarray(t)[1:], words


def _dataset(table: dict, coordinates: dict, title: str, summaries: dict) -> Labelled:
    used = {dim for dims, *_ in table.values() for dim in dims}
    named = {"component": list(COMPONENTS), "axis": ["x", "y", "z"]}
    return labelled(
        table, coordinates | {k: v for k, v in named.items() if k in used}, format=FORMAT,
        format_version=FORMAT_VERSION, title=title, summaries=summaries,
    )  # fmt: skip
