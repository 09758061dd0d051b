"""Figures of a multirotor that was identified from its flight log: the flight, the fit, and the estimates."""

from collections.abc import Callable, Mapping
from textwrap import fill
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse
from scipy import signal, stats
from scipy.constants import g as GRAVITY

from ..io.flight_log import FlightLog
from ..uav.flight_identification.centre import FilteredCentre
from ..uav.flight_identification.record import (
    FlightRecord,
    apply_filter,
    compute_rotor_states,
    compute_thrust_shape,
    low_pass,
)
from ..uav.flight_identification.stages import AXES, FlightIdentification, ParameterEstimate
from .plot import STYLES, draw_legend_beside, grid, look, plot_histories

# Length of a segment for the frequency response, and of the interval that is drawn of accelerations [s].
_SEGMENT, _SHOWN = 2.0, 3.0
# Highest frequency of the response that is drawn [Hz], and coherence from which it is.
_HIGHEST, _COHERENT = 25.0, 0.6
# Estimates whose windows are drawn, most points of a history, and level of the ellipses.
_BY_WINDOWS = ("lag", "roll", "pitch", "yaw", "thrust", "centre_x", "centre_y", "drag_x", "drag_y")
_MOST, _ELLIPSE = 4000, 0.95
_BAND = "0.88"


class IdentifiedFlight(NamedTuple):
    """Log, the segment of it that was identified, and the result."""

    log: FlightLog
    record: FlightRecord
    result: FlightIdentification


def _axes_of(result: FlightIdentification) -> list[int]:
    """Axes of rotation whose effectiveness is determined."""
    return [k for k, name in enumerate(AXES) if name in result.estimates]


def draw_log(subject: IdentifiedFlight) -> Figure:
    """Commands, rates, forces and voltage of the whole log, with flight segments and windows."""
    log, record, result = subject
    names = ("motor_commands", "gyroscope", "accelerometer", "battery_voltage")
    names = [name for name in names if name in log]
    figure, axes = grid(len(names), 1, 0.9 + 1.5 * len(names), sharex=True)
    count = len(next(iter(result.estimates.values())).window_values) if result.estimates else 1
    for ax, name in zip(axes[:, 0], names, strict=True):
        channel = log[name]
        # Points beyond the width of the figure show nothing and make vector files large.
        every = max(len(channel.ts) // _MOST, 1)
        for k, column in enumerate(channel.columns):
            style = look(k) | {"marker": "", "linewidth": 0.8}
            ax.plot(channel.ts[::every], channel.values[::every, k], label=column, **style)
        for start, end in log.flights:
            ax.axvspan(start, end, color=_BAND, zorder=0)
        for t in np.linspace(record.ts[0], record.ts[-1], count + 1):
            ax.axvline(t, color="0.3", linewidth=0.8, linestyle=":")
        ax.set_ylabel(f"{name.replace('_', ' ')} [{channel.unit}]", fontsize=8)
        draw_legend_beside(ax)
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    figure.align_ylabels(axes[:, 0])
    title = f"{log.name}: flight (grey) and windows (dotted)"
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def draw_accelerations(subject: IdentifiedFlight) -> Figure:
    """Measured and predicted accelerations over the seconds in which the commands are strongest."""
    _, record, result = subject
    axes_of = _axes_of(result)
    figure, axes = grid(len(axes_of) + 1, 1, 1.2 + 1.5 * (len(axes_of) + 1), sharex=True)
    ts, rows = record.ts, round(_SHOWN / record.dt)
    # A wrong model shows most where the commands change most.
    changes = np.sum(np.diff(record.commands, axis=0) ** 2, axis=1)
    spread = np.convolve(changes, np.ones(rows), "same")
    middle = float(ts[np.argmax(spread)])
    b, a = low_pass(20.0, record.dt)
    for c, axis in enumerate(axes_of):
        assert result.rotation is not None
        noise = result.rotation.noise[:, c]
        # The measurement less its unexplained part is what the fit predicts: nothing is simulated
        # anew.
        measured = (np.diff(record.gyroscope[:, axis]) / record.dt)[-len(noise) :]
        pair = apply_filter(b, a, np.stack([measured, measured - noise], axis=1))
        plot_histories(axes[c, 0], ts[-len(noise) :], pair, ("measured", "predicted"))
        axes[c, 0].set_ylabel(f"{AXES[axis]} [rad/s$^2$]", fontsize=9)
    force = np.stack([record.accelerometer[:, 2], _predict_force(record, result)], axis=1)
    plot_histories(axes[-1, 0], ts, apply_filter(b, a, force), ("measured", "predicted"))
    axes[-1, 0].set_ylabel("force along z [m/s$^2$]", fontsize=9)
    for ax in axes[:, 0]:
        ax.set_xlim(middle - _SHOWN / 2, middle + _SHOWN / 2)
        ax.set_xlabel("")
        # Matplotlib scales an axis by the whole curve, also by what lies outside of the drawn
        # seconds.
        x, y = np.concatenate([np.asarray(line.get_xydata()) for line in ax.lines]).T
        inside = y[np.abs(x - middle) < _SHOWN / 2]
        if len(inside):
            low, high = float(np.min(inside)), float(np.max(inside))
            ax.set_ylim(low - 0.08 * (high - low), high + 0.08 * (high - low))
    axes[-1, 0].set_xlabel("time [s]", fontsize=9)
    above = (1.0, 1.0)
    axes[0, 0].legend(fontsize=8, ncols=2, loc="lower right", bbox_to_anchor=above, frameon=False)
    figure.align_ylabels(axes[:, 0])
    figure.suptitle("Accelerations by commands, both below 20 Hz", fontsize=10)
    return figure


def _predict_force(record: FlightRecord, result: FlightIdentification) -> np.ndarray:
    """Specific force along z that the commands cause, as the accelerometer reads it (k,) [m/s^2]."""
    e, layout = result.estimates, result.layout
    lags = result.translation.lags if "thrust" in e else _lags(result)
    record = result.correct_voltage(record)
    s = compute_rotor_states(record.commands, record.dt, *lags)
    if "thrust_quadratic" in e:
        force = e["thrust_linear"].value * s + e["thrust_quadratic"].value * s**2
    else:
        shape = compute_thrust_shape(s, layout.thrust_model_factor)
        weight = GRAVITY / float(np.mean(np.sum(shape, axis=1)))
        force = (e["thrust"].value if "thrust" in e else weight) * shape
    total = np.sum(force, axis=1)
    b, a = low_pass(record.cutoffs[1], record.dt, record.filter_step)
    # the level holds the offset of the curve and the accelerometer's bias
    return apply_filter(b, a, total - np.mean(total) + np.mean(record.accelerometer[:, 2]))


def _lags(result: FlightIdentification) -> np.ndarray:
    """Lag and delay of the motors [s]."""
    fit = result.translation if result.rotation is None else result.rotation
    return fit.lags


def draw_response(subject: IdentifiedFlight) -> Figure | None:
    """Frequency responses of angular accelerations to commands, with coherence and fit; None without any."""
    _, record, result = subject
    axes_of, layout = _axes_of(result), result.layout
    if not axes_of:
        return None
    levers = layout.positions - layout.centre
    sides = (levers[:, 1] / layout.arms[0], -levers[:, 0] / layout.arms[1], -layout.spin)
    figure, axes = grid(3, len(axes_of), 5.6, sharex=True, sharey="row")
    tau, delay = _lags(result)
    record = result.correct_voltage(record)
    shape = compute_thrust_shape(record.commands, layout.thrust_model_factor)
    size = min(round(_SEGMENT / record.dt), len(record.ts))
    settings = {"fs": 1 / record.dt, "nperseg": size}
    b, a = low_pass(record.cutoffs[0], record.dt, record.filter_step)
    for column, axis in enumerate(axes_of):
        u, y = shape @ sides[axis], np.gradient(record.gyroscope[:, axis], record.dt)
        # Spectra averaged over segments suppress the noise of the gyroscope, which a quotient of
        # two transforms would keep.
        f, Puy = signal.csd(u, y, **settings)
        _, Puu = signal.welch(u, **settings)
        _, coherence = signal.coherence(u, y, **settings)
        band = (f >= 1 / _SEGMENT) & (f < _HIGHEST)
        f, H, coherence = f[band], (Puy / Puu)[band], coherence[band]
        good, s = coherence > _COHERENT, 2j * np.pi * f
        # The filter of the gyroscope is part of what was measured, so the fit goes through it too.
        z = np.exp(-s * record.dt)
        filtered = np.polyval(b[::-1], z) / np.polyval(a[::-1], z)
        fit = result.estimates[AXES[axis]].value * np.exp(-s * delay) / (1 + s * tau) * filtered
        # A rotor that changes its speed turns the vehicle by its inertia, which yaw alone shows.
        if axis == 2:
            spin_up = result.estimates["spin_up"].value
            fit += spin_up * s / (1 + s * tau) * np.exp(-s * delay) * filtered
        for row, of in enumerate((np.abs, lambda x: np.degrees(np.unwrap(np.angle(x))))):
            ax: Axes = axes[row, column]
            ax.plot(f[good], of(H)[good], "o", color=STYLES[0][0], markersize=3, label="measured")
            ax.plot(f, of(fit), color=STYLES[1][0], linestyle=STYLES[1][1], label="lag and delay")
        axes[0, column].set_yscale("log")
        axes[0, column].set_title(AXES[axis], fontsize=9)
        axes[2, column].plot(f, coherence, color=STYLES[0][0], linewidth=1.2)
        axes[2, column].axhline(_COHERENT, color="0.3", linewidth=0.8, linestyle=":")
        axes[2, column].set_xscale("log")
        axes[2, column].set_xlabel("frequency [Hz]", fontsize=9)
    for row, label in enumerate(("gain [rad/s$^2$]", "phase [degrees]", "coherence [1]")):
        axes[row, 0].set_ylabel(label, fontsize=9)
    axes[0, 0].legend(fontsize=8, frameon=False)
    title = f"Response to commands; points with a coherence above {_COHERENT:g}"
    figure.suptitle(title, fontsize=10)
    return figure


def draw_windows(subject: IdentifiedFlight) -> Figure | None:
    """Estimates in windows of the flight with their deviations, and of the whole flight; None without any."""
    _, record, result = subject
    names = [name for name in _BY_WINDOWS if name in result.estimates]
    if not names:
        return None
    columns = min(3, len(names))
    rows = -(-len(names) // columns)
    figure, axes = grid(rows, columns, 0.8 + 1.6 * rows, sharex=True)
    for ax in axes.flat[len(names) :]:
        ax.set_visible(False)
    for ax, name in zip(axes.flat, names, strict=False):
        e = result.estimates[name]
        scale, unit = (1e3, "mm") if e.unit == "m" else (1.0, e.unit)
        value, deviation = scale * e.value, scale * e.deviation
        edges = np.linspace(record.ts[0], record.ts[-1], len(e.window_values) + 1)
        ax.axhspan(value - deviation, value + deviation, color=_BAND)
        ax.axhline(value, color=STYLES[1][0], linestyle=STYLES[1][1], linewidth=1.2)
        ax.errorbar(
            (edges[1:] + edges[:-1]) / 2, scale * np.asarray(e.window_values), scale * np.asarray(e.window_deviations),
            fmt="o", color=STYLES[0][0], markersize=4, capsize=3, linewidth=1.2,
        )  # fmt: skip
        ax.set_title(f"{e.name} [{unit}]", fontsize=8, parse_math=False)
        ax.ticklabel_format(axis="y", scilimits=(-3, 4))
        ax.yaxis.get_offset_text().set_fontsize(7)
    # below the last panel of each column, also where the last row is not full
    for ax in axes.flat[max(len(names) - columns, 0) : len(names)]:
        ax.set_xlabel("time [s]", fontsize=9)
        ax.tick_params(labelbottom=True)
    figure.suptitle("Windows with bars of one deviation; the whole flight as a band", fontsize=10)
    return figure


def draw_centre(subject: IdentifiedFlight) -> Figure | None:
    """Centre of mass with ellipses of 95 % on the plan of the rotors; None where it is not determined."""
    e, layout = subject.result.estimates, subject.result.layout
    if not {"centre_x", "centre_y"} <= set(e):
        return None
    figure, axes = grid(1, 2, 3.6)
    radius = float(np.sqrt(stats.chi2.ppf(_ELLIPSE, 2)))
    for ax in axes[0]:
        ax.plot(0.0, 0.0, "+", color="0.3", markersize=10, label="origin")
        kinds = (("centre", "motors equal"), ("free_centre", "motors free"))
        for k, (prefix, label) in enumerate(kinds):
            if f"{prefix}_x" not in e:
                continue
            x, y = e[f"{prefix}_x"], e[f"{prefix}_y"]
            color, dash = STYLES[k]
            # forward is up, and left is to the left
            place = (-1e3 * y.value, 1e3 * x.value)
            size = 2e3 * radius * np.array([y.deviation, x.deviation])
            style = {"fill": False, "color": color, "linestyle": dash, "linewidth": 1.4}
            ax.add_patch(Ellipse(place, *size, **style))
            ax.plot(*place, "o^"[k], color=color, markersize=5, label=label)
        ax.set_aspect("equal")
        ax.set_xlabel("to the right [mm]", fontsize=9)
    for k, (place, spin) in enumerate(zip(layout.positions, layout.spin, strict=True)):
        x, y = -1e3 * place[1], 1e3 * place[0]
        axes[0, 0].plot(x, y, "o", color="0.6", markersize=16, markerfacecolor="none")
        axes[0, 0].annotate(f"{k + 1}", (x, y), ha="center", va="center", fontsize=8)
        axes[0, 0].annotate(
            "left" if spin > 0 else "right", (x, y), (0, -16), textcoords="offset points", ha="center", fontsize=7
        )  # fmt: skip
    axes[0, 0].margins(0.25)
    axes[0, 0].set_ylabel("forward [mm]", fontsize=9)
    axes[0, 1].legend(fontsize=8, frameon=False, loc="upper right")
    # Deviations are much smaller than the arms: the second panel enlarges the centre of the first.
    sizes = [x.deviation + abs(x.value) for name, x in e.items() if "centre" in name]
    reach = 1e3 * radius * max(sizes)
    axes[0, 1].set_xlim(-1.1 * reach, 1.1 * reach)
    axes[0, 1].set_ylim(-1.1 * reach, 1.1 * reach)
    figure.suptitle("Centre of mass, 95 %, on the plan of the rotors", fontsize=10)
    return figure


def draw_thrust(subject: IdentifiedFlight) -> Figure | None:
    """Thrust of a rotor over its command, with one deviation, where the flight went; None if not determined."""
    _, record, result = subject
    e, layout = result.estimates, result.layout
    if "thrust" not in e:
        return None
    scale, unit = (1.0, "m/s$^2$, over mass") if layout.mass is None else (layout.mass, "N")
    low, high = np.quantile(result.correct_voltage(record).commands, [0.01, 0.99])
    u = np.linspace(0.0, 1.0, 101)
    figure, axes = grid(1, 1, 3.4)
    ax = axes[0, 0]
    ax.axvspan(low, high, color=_BAND, label="commands of the flight, 98 %")
    weight = GRAVITY / len(layout.spin)
    if "thrust_quadratic" in e:
        parts = [e[f"thrust_{part}"] for part in ("offset", "linear", "quadratic")]
        thrust = sum(part.value * u**k for k, part in enumerate(parts))
        slope = e["thrust_slope"]
        # The weight fixes the thrust at the mean command; the slope is uncertain, and its effect
        # grows with the distance from there.
        spread = slope.deviation * np.abs(u**2 - result.hover**2)
        label = "curve"
    else:
        shape = lambda x: compute_thrust_shape(np.array([x]), layout.thrust_model_factor)[0]
        change = shape(u) - shape(np.array([result.hover]))
        thrust, spread = weight + e["thrust"].value * change, e["thrust"].deviation * np.abs(change)
        label = "assumed shape through the weight"
    color, dash = STYLES[0]
    ax.plot(u, scale * thrust, color=color, linestyle=dash, linewidth=1.4, label=label)
    low, high = scale * (thrust - spread), scale * (thrust + spread)
    ax.fill_between(u, low, high, color=color, alpha=0.25)
    label = "weight at the mean command"
    ax.plot(result.hover, scale * weight, "^", color=STYLES[1][0], label=label)
    ax.set_xlim(0.0, 1.0)
    ax.set_ylim(min(0.0, float(np.min(scale * thrust))), None)
    ax.set_xlabel("command [1]", fontsize=9)
    ax.set_ylabel(f"thrust of a rotor [{unit}]", fontsize=9)
    ax.legend(fontsize=8, frameon=False)
    figure.suptitle("Thrust curve; dependable within the commands of the flight", fontsize=10)
    return figure


def draw_table(subject: IdentifiedFlight) -> Figure:
    """Table of what is determined with its deviation, and the sentences on what is not."""
    result = subject.result
    estimates = result.estimates.values()
    rows = [[e.name, f"{e.value:.4g}", f"{e.deviation:.2g}", e.unit] for e in estimates]
    texts = (*result.refusals.values(), result.verdict.explanation)
    sentences = [fill(text, 110) for text in texts]
    lines = sum(text.count("\n") + 1 for text in sentences)
    heights = [0.19 * (len(rows) + 1) + 0.1, 0.16 * lines + 0.1]
    figure, axes = grid(2, 1, 0.7 + sum(heights), height_ratios=heights)
    for ax in axes[:, 0]:
        ax.axis("off")
    if rows:
        table = axes[0, 0].table(
            rows, colLabels=["determined", "value", "deviation", "unit"], loc="upper center",
            colWidths=[0.55, 0.15, 0.15, 0.15], cellLoc="left", bbox=[0, 0, 1, 1],
        )  # fmt: skip
        table.auto_set_font_size(False)
        table.set_fontsize(7.5)
        for cell in table.get_celld().values():
            cell.set_linewidth(0.4)
            cell.get_text().set_parse_math(False)
    style = {"fontsize": 7.5, "va": "top", "transform": axes[1, 0].transAxes}
    axes[1, 0].text(0.0, 1.0, "\n".join(sentences), parse_math=False, **style)
    figure.suptitle("What the flight determines, and what it does not", fontsize=10)
    return figure


def draw_filtered_centre(
    filtered: FilteredCentre, estimates: Mapping[str, ParameterEstimate] | None = None
) -> Figure:
    """Centre of mass over a flight with bands of two deviations, and the estimates of the whole record."""
    figure, axes = grid(2, 1, 4.2, sharex=True)
    for axis, name in enumerate("xy"):
        ax = axes[axis, 0]
        value, spread = 1e3 * filtered.centre[:, axis], 2e3 * filtered.deviation[:, axis]
        color, dash = STYLES[0]
        ax.plot(filtered.ts, value, color=color, linestyle=dash, linewidth=1.4, label="filter")
        ax.fill_between(filtered.ts, value - spread, value + spread, color=color, alpha=0.25)
        # The start of the filter from its wide prior would set the scale of the axis.
        low, high = value[len(value) // 20 :].min(), value[len(value) // 20 :].max()
        if estimates is not None and f"centre_{name}" in estimates:
            e = estimates[f"centre_{name}"]
            color, dash = STYLES[1]
            whole, band = 1e3 * e.value, 2e3 * e.deviation
            ax.axhline(whole, color=color, linestyle=dash, label="whole record")
            ax.axhspan(whole - band, whole + band, color=_BAND, zorder=0)
            low, high = min(low, whole), max(high, whole)
        margin = 0.5 * (high - low) + 2e3 * filtered.deviation[-1, axis]
        ax.set_ylim(low - margin, high + margin)
        ax.set_ylabel(f"centre of mass {name} [mm]", fontsize=9)
    axes[0, 0].legend(fontsize=8, frameon=False, ncols=2)
    axes[1, 0].set_xlabel("time [s]", fontsize=9)
    figure.suptitle("Centre of mass by a filter; bands of two deviations", fontsize=10)
    return figure


FLIGHT_LOG_FIGURES: Mapping[str, Callable[[IdentifiedFlight], Figure | None]] = {
    "log": draw_log, "accelerations": draw_accelerations, "response": draw_response, "windows": draw_windows,
    "centre": draw_centre, "thrust": draw_thrust, "table": draw_table,
}  # fmt: skip
