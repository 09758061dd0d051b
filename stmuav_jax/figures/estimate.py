"""Table, figures and dataset of the eight cases of estimation."""

import math
import re
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table
from rich.text import Text

from ..estimation.consistency import RunsVerdict, mean_interval
from ..io.netcdf import Labelled, label_table
from ..uav.quadrotor.assessment import CaseStudy, CaseSummary, Estimates, settled_from
from .filter_record import FORMAT, FORMAT_VERSION, normalised_innovations
from .plot import STYLES, grid

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
                 "NIS\n(3)", "runs\noff"):  # fmt: skip
        table.add_column(Text(name), justify="right")
    for row in rows:
        table.add_row(
            str(row.case), row.tuning, _format_seconds(row.to_2cm), _format_seconds(row.to_5mm),
            f"{1e3 * row.rmse[0]:.2f}, {1e3 * row.rmse[1]:.2f}",
            _format_mean(row.nees_offset, row.nees_offset_window), _format_mean(row.nees, row.nees_window),
            _format_mean(row.nis, row.nis_window), str(row.verdict.flagged),
        )  # fmt: skip
    table.caption = (
        "Medians of the times after which the error stays below 2 cm and 5 mm. After "
        f"{rows[0].settling_time:g} s: RMSE, and means of NEES of the offset (expected 2), of rates and "
        "offset (5), and of NIS (3); high and low: outside the 99.9 % interval of a consistent "
        "filter. Runs off: those whose innovations are inconsistent."
    )
    return table


def verdict_lines(verdicts: dict[str, RunsVerdict]) -> list[str]:
    """Line with the verdict for each title; up to two are followed by their sentences, one a line."""
    # Sentences for one or two filters; a table of sixteen has a line for each.
    if len(verdicts) > 2:
        return [f"{title}: {verdict.short}." for title, verdict in verdicts.items()]
    lines = []
    for title, verdict in verdicts.items():
        sentences = re.split(r"(?<=\.) (?=[A-Z])", verdict.explanation)
        lines += [f"{title}: {verdict.status}.", *(f"  - {sentence}" for sentence in sentences)]
    return lines


def _format_seconds(value: float) -> str:
    return "never" if math.isnan(value) else f"{value:.3f}"


def _format_mean(value: float, window: tuple[float, float]) -> str:
    if not math.isfinite(value):
        return "-"
    side = " low" if value < window[0] else " high" if value > window[1] else ""
    return f"{value:.3g}{side}"


# --- figures


def _plot_line(ax: Axes, t: Any, values: Any, name: str, **more: Any) -> None:
    color, dash = _LOOKS[name]
    width = 3.0 if name == "truth" else 1.3
    more = {"linewidth": width, "color": color, "linestyle": dash, "label": name} | more
    ax.plot(t, values, **more)


def _study_title(study: CaseStudy) -> str:
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
            _plot_line(ax, t[: count + 1], truth[: count + 1, row], "truth")
            for name, estimates in study.estimates.items():
                values = np.asarray(estimates.mean)[:count, 3 + row, 0]
                _plot_line(ax, t[1 : count + 1], values, name)
            ax.set_xlabel("time [s]", fontsize=9)
        axes[row, 0].set_ylabel(f"centre of mass, {axis} [m]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    axes[0, 1].set_title("the first 30 steps", fontsize=9)
    figure.suptitle(f"{_study_title(study)}: estimated centre of mass", fontsize=11)
    return figure


def rates(study: CaseStudy) -> Figure:
    """Figure of the body rates over the first half second, estimate and truth."""
    figure, axes = grid(3, 1, 5.4)
    t = np.asarray(study.record.t)
    count = min(int(np.searchsorted(t, 0.5)), len(t) - 1)
    truth = np.asarray(study.record.omega)[..., 0]
    for row, axis in enumerate("xyz"):
        ax = axes[row, 0]
        _plot_line(ax, t[: count + 1], truth[: count + 1, row], "truth")
        for name, estimates in study.estimates.items():
            _plot_line(ax, t[1 : count + 1], np.asarray(estimates.mean)[:count, row, 0], name)
        ax.set_ylabel(rf"$\Omega_{axis}$ [rad/s]", fontsize=9)
    axes[0, 0].legend(fontsize=8)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{_study_title(study)}: body rates", fontsize=11)
    return figure


def errors(study: CaseStudy) -> Figure:
    """Figure of the range over the seeds of the errors of the centre of mass, with the filter's 3-sigma band."""
    names = list(study.estimates)
    figure, axes = grid(2, len(names), 4.6)
    t = np.asarray(study.record.t)[1:]
    for column, name in enumerate(names):
        estimates: Estimates = study.estimates[name]
        error, deviation = np.asarray(estimates.error), np.asarray(estimates.standard_deviation)
        for row, axis in enumerate("xy"):
            ax = axes[row, column]
            of_seeds = 1e3 * error[:, 3 + row]
            # Fifty curves would hide each other and the band; their range shows whether the band holds them.
            low, high = np.nanmin(of_seeds, axis=1), np.nanmax(of_seeds, axis=1)
            ax.fill_between(t, low, high, color="0.75", linewidth=0, label="range of the seeds")
            band = 3e3 * deviation[:, 3 + row, 0]
            for sign, label in ((1, "3 sigma of the filter"), (-1, None)):
                ax.plot(t, sign * band, color=_LOOKS[name][0], linewidth=1.3, label=label)
            ax.set_ylim(-8, 8)
            ax.set_ylabel(f"error, {axis} [mm]", fontsize=9)
        axes[0, column].set_title(f"{name} tuning", fontsize=9)
        axes[0, column].legend(fontsize=8, loc="upper right")
        axes[1, column].set_xlabel("time [s]", fontsize=9)
    figure.suptitle(f"{_study_title(study)}: errors of {study.record.seeds} seeds", fontsize=11)
    return figure


def consistency(study: CaseStudy) -> Figure:
    """Figure of NEES and NIS, means over the seeds, with their 99.9 % intervals.

    The settled part has a linear axis, on which a factor shows; the start, whose prior may be wrong by
    orders of magnitude, has a logarithmic one.
    """
    figure, axes = grid(2, 2, 4.8, width_ratios=(3, 2))
    t = np.asarray(study.record.t)[1:]
    seeds = study.record.seeds
    settled_mask = t >= settled_from(t[-1])
    for row, (statistic_name, degrees) in enumerate((("NEES (5)", 5), ("NIS (3)", 3))):
        # At the start NEES is larger by orders; on one axis the interval of the settled filter would be a
        # line.
        for ax, part in ((axes[row, 0], settled_mask), (axes[row, 1], ~settled_mask)):
            ax.axhspan(*mean_interval(degrees, seeds), color="0.8", label="consistent: 99.9 %")
            for name, estimates in study.estimates.items():
                statistic = estimates.nees if degrees == 5 else estimates.nis
                values = np.mean(np.asarray(statistic), axis=1)
                _plot_line(ax, t[part], values[part], name, linewidth=0.9)
        axes[row, 0].set_ylim(bottom=0.0)
        axes[row, 1].set_yscale("log")
        axes[row, 0].set_ylabel(f"mean {statistic_name} [1]", fontsize=9)
    axes[0, 0].set_title("settled", fontsize=9)
    axes[0, 1].set_title("before it has settled", fontsize=9)
    for ax in axes[1]:
        ax.set_xlabel("time [s]", fontsize=9)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, ncols=3, fontsize=8, loc="outside lower center")
    figure.suptitle(f"{_study_title(study)}: consistency over {seeds} seeds", fontsize=11)
    return figure


CASE_FIGURES = {"offset": offset, "rates": rates, "errors": errors, "consistency": consistency}


# --- files


def labelled_case(study: CaseStudy) -> Labelled:
    """Content of a saved case, with dimensions time, seed, tuning, component, rotor, axis.

    Times are the ends of the steps, over which the thrusts are constant.
    """
    record, estimates_by_tuning = study.record, study.estimates
    together = lambda pick: np.stack([np.asarray(pick(e)) for e in estimates_by_tuning.values()])
    path = ("time", "component", "seed")
    component_dims = ("tuning", *path)
    scalar = ("tuning", "time", "seed")
    first = next(iter(estimates_by_tuning.values()))
    # Filters of one case may read different sensors: innovations that only another has are NaN.
    innovations = [normalised_innovations(e) for e in estimates_by_tuning.values()]
    most = max(x.shape[1] for x in innovations)
    widen = lambda x: np.pad(x, ((0, 0), (0, most - x.shape[1]), (0, 0)), constant_values=np.nan)
    innovations = [widen(x) for x in innovations]
    table = {
        "thrust": (("time", "rotor"), record.u, "N", "of each rotor, held over the step"),
        "truth": (path, first.truth, "rad/s, m", "body rates and centre of mass"),
        "euler_parameters": (("time", "e", "seed"), record.p[1:], "1", "true, body to world"),
        "measured": (("time", "axis", "seed"), record.y[:, :3], "rad/s", "by the gyroscope"),
        "estimate": (component_dims, together(lambda e: e.mean), "rad/s, m", "means"),
        "standard_deviation": (
            component_dims, together(lambda e: e.standard_deviation), "rad/s, m", "the filter's own",
        ),
        "innovation": (
            ("tuning", "time", "reading", "seed"), np.stack(innovations), "1",
            "normalised, of unit covariance if the filter is consistent",
        ),
        "nees": (scalar, together(lambda e: e.nees), "1", "of rates and offset, 5 degrees"),
        "nees_offset": (scalar, together(lambda e: e.nees_offset), "1", "2 degrees of freedom"),
        "nis": (scalar, together(lambda e: e.nis), "1", "of the innovations, 3 degrees"),
        "ok": (scalar, together(lambda e: e.ok), "1", "whether the filter still runs"),
    }  # fmt: skip
    about = {"units": "s", "description": "ends of the steps"}
    coordinates = {
        "time": (("time",), np.asarray(record.t)[1:], about), "component": list(COMPONENTS),
        "axis": ["x", "y", "z"], "tuning": list(estimates_by_tuning),
    }  # fmt: skip
    return label_table(
        table, coordinates, format=FORMAT, format_version=FORMAT_VERSION,
        title=_study_title(study),
        summaries={name: summary.plain() for name, summary in study.summaries.items()},
    )  # fmt: skip
