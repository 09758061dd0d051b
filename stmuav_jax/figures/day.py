"""Tables, figures, dataset and files of a day of pointing at the sun."""

import math
import os
from collections.abc import Callable
from datetime import datetime
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from ..io.csv_table import read_csv_table
from ..io.netcdf import FileError, Labelled, label_table
from ..math.compiler import quick_jit
from ..uav.environment.sun import attitude
from ..uav.tracker.day import PANELS, Day
from ..uav.tracker.geometry import TrackerGeometry
from ..uav.tracker.kinematics import Reason, panel_angles
from ..uav.tracker.workspace import Limits, direction_grid, survey
from .plot import STYLES, grid
from .terminal import add_row, make_pairs, make_table

FORMAT = "stmuav_jax day"
FORMAT_VERSION = 1

PANEL_NAMES = {
    "tracker": "tracker on the UAV",
    "two_axis": "two axes, unlimited",
    "single_axis": "single axis, on the ground",
    "airframe": "fixed on the UAV",
    "flat": "level",
}


def clock_time(day: Day, hours: float) -> str:
    """Time that a clock of the place shows some hours after the start of a day, such as '07:30'."""
    minutes = round(60 * hours)
    # A clock shows the end of the day as 00:00, the same as its start.
    if minutes >= round(60 * day.hours[-1]):
        return "24:00"
    # by way of UTC, because clocks may have changed since the start
    when = datetime.fromtimestamp(day.start.timestamp() + 60.0 * minutes, day.start.tzinfo)
    return f"{when:%H:%M}"


def day_title(day: Day) -> str:
    """Title with place and date."""
    lat, lon = math.degrees(float(day.place.latitude)), math.degrees(float(day.place.longitude))
    where = (
        f"{abs(lat):.4g}° {'N' if lat >= 0 else 'S'}, {abs(lon):.5g}° {'E' if lon >= 0 else 'W'}"
    )
    return f"Pointing at the sun, {where}, {day.start:%Y-%m-%d} (UTC{day.start.isoformat()[19:]})"


def _format_span(values: np.ndarray, unit: str) -> str:
    return f"{np.nanmin(values):.1f} to {np.nanmax(values):.1f} {unit}"


def day_rows(day: Day) -> list[tuple[str, str]]:
    """Main results of the day as rows (quantity, value) of text."""
    lit = day.lit
    error = np.degrees(lit.pointing_error)
    up = ", ".join(f"{clock_time(day, a)} to {clock_time(day, b)}" for a, b in day.daylight)
    height = math.degrees(np.max(np.asarray(lit.sun.elevation)))
    angles, q = np.degrees(lit.angles), 1e3 * lit.strokes
    codes = np.unique(lit.reason[lit.is_up & ~lit.facing])
    hours = [(lit.hours_of(lit.reason == code), int(code)) for code in codes]
    hours = sorted(hours, key=lambda entry: -entry[0])
    reasons = [f"{Reason(code).label} {hour:.1f} h" for hour, code in hours]
    rows = [
        ("Sun above the horizon", f"{up} ({sum(b - a for a, b in day.daylight):.1f} h)"),
        ("Highest", f"{height:.1f}° at {clock_time(day, day.culmination)}"),
        ("Within the tracker's reach", f"{lit.hours_of(lit.facing):.1f} h"),
        ("Out of reach because of", ", ".join(reasons) or "-"),
        ("Panel angles phi, theta", ", ".join(_format_span(angle, "°") for angle in angles)),
        ("Strokes q2, q3", ", ".join(_format_span(stroke, "mm") for stroke in q)),
    ]
    # On a day on which the sun is never within reach there is no largest error.
    if np.any(lit.facing):
        worst = np.max(error[lit.facing])
        rows.append(("Pointing error within reach, largest", f"{worst:.2g}°"))
    mean = lambda values: float(np.average(values, weights=lit.weights))
    cosine = lit.incidence_cosine
    return [
        *rows,
        ("Pointing error in daylight, mean, largest",
         f"{mean(error):.1f}°, {np.max(error):.1f}°"),
        ("Incidence cosine, mean, smallest", f"{mean(cosine):.3f}, {np.min(cosine):.3f}"),
        ("Lost by the tracker's reach and errors", f"{-100 * day.gain('tracker', 'two_axis'):.2f} %"),
    ]  # fmt: skip


def day_tables(day: Day) -> tuple[Table, Table]:
    """Tables for the terminal: main results, and the energies of the panels."""
    figures = make_pairs(day_title(day), day_rows(day))
    heads = ("panel", "kWh/m² a day", "more than level", "more than single axis")
    energies = make_table(*heads, title="Under a clear sky", right=1)
    for panel in PANELS:
        gains = (
            f"{100 * gain:+.1f} %" for gain in (day.gain(panel), day.gain(panel, "single_axis"))
        )
        add_row(energies, PANEL_NAMES[panel], f"{day.energy[panel] / 3.6e6:.3f}", *gains)
    return figures, energies


# --- files


def labelled_day(day: Day) -> Labelled:
    """Content of a saved day, with times in seconds since local midnight.

    Dimensions: time, axis (x, y, z; the world is east, north, up), axis_b (of the UAV), angle,
    leg, panel. Every variable has `units` and `description`; attributes hold place, date and
    settings.
    """
    s = "time"
    table = {
        "unix_time": ((s,), day.unix, "s", "UTC since 1970-01-01, without leap seconds"),
        "sun_direction": (("axis", s), day.sun.s_w, "1", "seen through air; east, north, up"),
        "sun_elevation": ((s,), day.sun.elevation, "rad", "seen through air"),
        "sun_azimuth": ((s,), day.sun.azimuth, "rad", "clockwise from north"),
        "sun_in_body": (("axis_b", s), day.s_b, "1", "direction to the sun in the UAV's axes"),
        "R_wb": (("axis", "axis_b", s), day.R_wb, "1", "UAV to world"),
        "panel_angles": (("angle", s), day.angles, "rad", "R_x(phi) R_y(theta); NaN at night"),
        "strokes": (("leg", s), day.strokes, "m", "heights of the rods' lower joints"),
        "displacements": (("leg", s), day.displacements, "m", "strokes from the initial posture's"),
        "panel_normal": (("axis", s), day.normals_w, "1", "in the world"),
        "reason": ((s,), day.reason, "1", "why the sun is not faced: attribute reasons"),
        "pointing_error": ((s,), day.pointing_error, "rad", "panel's normal from the sun"),
        "incidence_cosine": ((s,), day.incidence_cosine, "1", "of the panel on the UAV"),
        "beam": ((s,), day.sky.beam, "W/m^2", "clear sky, on a plane that faces the sun"),
        "diffuse": ((s,), day.sky.diffuse, "W/m^2", "clear sky, on a level plane"),
        "irradiance": (("panel", s), np.stack([day.irradiance[k] for k in PANELS]), "W/m^2", ""),
        "energy": (("panel",), np.array([day.energy[k] for k in PANELS]), "J/m^2", "of the day"),
    }  # fmt: skip
    time_attributes = {"units": "s", "description": "since local midnight"}
    coordinates = {
        "time": ((s,), day.unix - day.unix[0], time_attributes), "axis": ["x", "y", "z"],
        "axis_b": ["x", "y", "z"], "angle": ["phi", "theta"], "leg": [2, 3], "panel": list(PANELS),
    }  # fmt: skip
    place = {k: float(getattr(day.place, k)) for k in ("latitude", "longitude", "altitude")}
    return label_table(
        table, coordinates, format=FORMAT, format_version=FORMAT_VERSION, title=day_title(day),
        place=place, start=day.start.isoformat(), settings=day.settings,
        reasons={int(reason): reason.label for reason in Reason},
        parameters=day.parameters.to_dict(),
    )  # fmt: skip


# Largest angle of an attitude history [degrees]; beyond, a double no longer tells directions.
_MOST_TURNED = 1e9


def load_attitude(path: str | os.PathLike[str]) -> Callable[[Array], Float[Array, "3 3"]]:
    """Attitude history from a CSV file with columns t, roll, pitch, yaw.

    Times t are increasing seconds since local midnight. Angles are in degrees
    (`environment.sun.attitude`), linear between rows and constant outside of them.

    Returns:
        attitude R_wb (3, 3) as a function of time [s].

    Raises:
        FileError: the file is missing, or has other columns, values or order.
    """
    table, names = read_csv_table(path), ["t", "roll", "pitch", "yaw"]
    source = table.source
    if list(table.heads) != names:
        first = ",".join(table.heads)[:80]
        raise FileError(
            f"{source} must begin with the line t,roll,pitch,yaw, but it begins with '{first}'."
        )
    t, *degrees = (table.read_numbers(name) for name in names)
    if np.any(t[1:] <= t[:-1]):
        raise FileError(f"{source} must have times that increase from line to line.")
    if np.max(np.abs(degrees)) > _MOST_TURNED:
        raise FileError(f"{source} has angles beyond {_MOST_TURNED:g} degrees.")
    # Interpolation between 359 and 1 degrees must go by zero.
    angles = np.unwrap(np.radians(degrees), axis=1)

    def attitude_at(time: Array) -> Float[Array, "3 3"]:
        return attitude(*(jnp.interp(time, t, angle) for angle in angles))

    return attitude_at


# --- figures


def _set_hours(ax: Axes, day: Day) -> None:
    """Set the x axis to local hours, from a little before sunrise to a little after sunset."""
    first, last = day.daylight[0][0], day.daylight[-1][1]
    ax.set_xlim(max(first - 0.5, 0.0), min(last + 0.5, day.hours[-1]))
    ax.set_xlabel("time since local midnight [h]", fontsize=9)


def tracking(day: Day) -> Figure:
    """Figure of sun, panel angles, strokes and pointing error over the day."""
    figure, axes = grid(2, 2, 5.2)
    curves = {
        (0, 0): ("sun", "elevation [°]", [("elevation", np.degrees(np.asarray(day.sun.elevation)))]),
        (0, 1): ("panel angles", "angle [°]",
                 [("$\\phi$", np.degrees(day.angles[0])), ("$\\theta$", np.degrees(day.angles[1]))]),
        (1, 0): ("strokes", "stroke [mm]",
                 [("$q_2$", 1e3 * day.strokes[0]), ("$q_3$", 1e3 * day.strokes[1])]),
        (1, 1): ("pointing error", "angle to the sun [°]",
                 [("panel", np.degrees(day.pointing_error))]),
    }  # fmt: skip
    for place, (name, label, lines) in curves.items():
        ax = axes[place]
        # the times in which the sun is up but out of reach
        ax.fill_between(
            day.hours, 0, 1, where=(day.is_up & ~day.facing).tolist(),
            transform=ax.get_xaxis_transform(), color="0.9", lw=0, label="out of reach",
        )  # fmt: skip
        for (legend_text, values), (color, dash) in zip(lines, STYLES, strict=False):
            style = {"color": color, "linestyle": dash, "linewidth": 1.4}
            ax.plot(day.hours, values, label=legend_text, **style)
        ax.set_title(name, fontsize=10)
        ax.set_ylabel(label, fontsize=9)
        _set_hours(ax, day)
        if len(lines) > 1:
            # The first entry is the shading, which the legend of the last panel explains for all.
            handles, legend_text = ax.get_legend_handles_labels()
            ax.legend(handles[1:], legend_text[1:], fontsize=8)
    axes[0, 0].set_ylim(bottom=0)
    axes[1, 1].set_ylim(bottom=0)
    axes[1, 1].legend(fontsize=8)
    figure.suptitle(day_title(day), fontsize=11)
    return figure


def sky(day: Day) -> Figure:
    """Figure of the paths of sun and panel in the UAV's axes, and of the tracker's workspace."""
    figure, axes = grid(1, 1, 5.2, subplot_kw={"projection": "polar"})
    ax: Any = axes[0, 0]
    turn, tilt = np.radians(np.arange(0, 361, 1.0)), np.radians(np.arange(0, 90.1, 0.5))
    inside = np.asarray(_smallest_margin(day.geometry, day.limits, turn, tilt)).T
    ax.contourf(turn, np.degrees(tilt), inside, levels=[0.0, np.inf], colors=["#DDEEDD"])
    ax.contour(turn, np.degrees(tilt), inside, levels=[0.0], colors=["#009E73"], linewidths=1.0)
    up = day.is_up
    panel_b = np.einsum("jin,jn->in", day.R_wb, day.normals_w)
    for way, label, (color, dash) in zip(
        (day.s_b, panel_b), ("sun", "panel's normal"), STYLES, strict=False
    ):
        around = np.full(len(up), np.nan)
        # A jump by a turn would draw a line across the picture.
        around[up] = np.unwrap(np.arctan2(way[1, up], way[0, up]))
        down = np.degrees(np.arccos(np.clip(way[2], -1, 1)))
        ax.plot(around, down, color=color, linestyle=dash, label=label)
    azimuth, tilts = (
        np.arctan2(day.s_b[1], day.s_b[0]),
        np.degrees(np.arccos(np.clip(day.s_b[2], -1, 1))),
    )
    for hour in range(math.ceil(day.hours[-1])):
        k = int(np.argmin(np.abs(day.hours - hour)))
        if day.is_up[k] and day.s_b[2, k] > 0:
            at = float(azimuth[k]), float(tilts[k])
            ax.plot(*at, "o", color=STYLES[0][0], markersize=3)
            if hour % 2 == 0:
                ax.annotate(f"{hour} h", at, (4, 4), textcoords="offset points", fontsize=8)
    ax.fill([], [], color="#DDEEDD", ec="#009E73", label="reach of the tracker")
    ax.set_ylim(0, 90)
    # Labels are off the axes, at the azimuth farthest from the sun's path.
    path, choices = azimuth[day.is_up & (day.s_b[2] > 0)], np.radians(np.arange(22.5, 360.0, 45.0))
    distances = np.abs((path[:, None] - choices + np.pi) % (2 * np.pi) - np.pi)
    farthest = np.argmax(np.min(distances, axis=0, initial=np.pi))
    ax.set_rlabel_position(float(np.degrees(choices[farthest])))
    ax.set_xticks(np.radians([0, 90, 180, 270]), ["x", "y", "-x", "-y"])
    ax.set_yticks([15, 30, 45, 60, 75], ["15°", "30°", "45°", "60°", "75°"], fontsize=8)
    ax.legend(fontsize=8, loc="upper left", bbox_to_anchor=(1.05, 1.0))
    ax.set_title(f"{day_title(day)}\nin the UAV's axes, angle from its z axis", fontsize=10)
    return figure


@quick_jit
def _smallest_margin(
    geometry: TrackerGeometry, limits: Limits, turn: Float[Array, " n"], tilt: Float[Array, " m"]
) -> Float[Array, "n m"]:
    """Smallest scaled margin: positive in the workspace, zero on its boundary."""
    angles = panel_angles(direction_grid(turn, tilt))
    m = survey(geometry, angles, limits).margins
    # Only the sign of the smallest counts; the scale keeps the contour lines of metres and radians alike.
    parts = jnp.stack([m.tilt, m.parallel, *(m.lower / 0.05), *(m.upper / 0.05)])
    # compiled minima may ignore NaN
    return jnp.min(jnp.where(jnp.isfinite(parts), parts, -1.0), axis=0)


def light(day: Day) -> Figure:
    """Figure of the panels' irradiances over the day, and of their energies."""
    figure, axes = grid(1, 2, 3.4, width_ratios=(3, 2))
    irradiance_axes, energy_axes = axes[0]
    # On a level UAV the fixed panel is the level one, and its curve would cover that one's.
    plotted_panels = [p for p in PANELS if p != "airframe" or abs(day.gain("airframe")) > 1e-6]
    dash_dot_style = ("#CC79A7", (0, (5, 1, 1, 1)))
    looks: Any = (STYLES[0], STYLES[3], STYLES[1], dash_dot_style, STYLES[2])
    styles: dict[str, Any] = dict(zip(PANELS, looks, strict=True))
    for panel in plotted_panels:
        color, dash = styles[panel]
        irradiance_axes.plot(
            day.hours, day.irradiance[panel], color=color, linestyle=dash, linewidth=1.4,
            label=PANEL_NAMES[panel],
        )  # fmt: skip
    irradiance_axes.set_ylabel("irradiance [W/m²]", fontsize=9)
    irradiance_axes.set_ylim(bottom=0)
    _set_hours(irradiance_axes, day)
    irradiance_axes.legend(fontsize=8, loc="lower center")
    energies = [day.energy[panel] / 3.6e6 for panel in plotted_panels]
    names, colours = zip(*((PANEL_NAMES[p], styles[p][0]) for p in plotted_panels), strict=True)
    bars = energy_axes.barh(names, energies, color=colours, height=0.6)
    gains = [f" {100 * day.gain(p):+.1f} %" for p in plotted_panels]
    energy_axes.bar_label(bars, gains, fontsize=8)
    energy_axes.set_xlim(0, 1.4 * max(energies))
    # Matplotlib stacks bars upwards, while the legend beside them reads downwards.
    energy_axes.invert_yaxis()
    energy_axes.set_xlabel("energy [kWh/m² a day]", fontsize=9)
    energy_axes.grid(False, axis="y")
    for ax in (irradiance_axes, energy_axes):
        ax.set_axisbelow(True)
    figure.suptitle(day_title(day), fontsize=11)
    return figure


DAY_FIGURES = {"tracking": tracking, "sky": sky, "light": light}
