"""Figures of a mission's flight, from its dataset."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..figures.plot import STYLES, curves, grid
from .outcome import margin_history

_DEGREE = np.pi / 180


def _labelled(ax: Axes, words: str, *, legend: bool = True) -> None:
    ax.set_ylabel(words, fontsize=9)
    if legend:
        ax.legend(fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.22))


def _titled(figure: Figure, data: xr.Dataset) -> Figure:
    figure.suptitle(data.attrs.get("title", ""), fontsize=11)
    return figure


def flight_errors(data: xr.Dataset) -> Figure:
    """Figure of the position error along the world's axes, and of the tilt error."""
    figure, axes = grid(2, 1, 5.0)
    ts = data.time.values
    curves(axes[0, 0], ts, data.position_error.values, ("x", "y", "z"))
    _labelled(axes[0, 0], "position error [m]")
    tilt = data.tilt_error.values[:, None] / _DEGREE
    curves(axes[1, 0], ts, tilt, ("tilt error",))
    _labelled(axes[1, 0], "tilt error [degrees]", legend=False)
    return _titled(figure, data)


def flight_panel(data: xr.Dataset) -> Figure:
    """Figure of the panel angles against their reference, and of the angle between both normals."""
    figure, axes = grid(2, 1, 5.0)
    both = np.concatenate([data.panel_angles.values, data.wanted_panel_angles.values], axis=1)
    labels = ("phi", "theta", "phi wanted", "theta wanted")
    curves(axes[0, 0], data.time.values, both / _DEGREE, labels)
    _labelled(axes[0, 0], "panel angles [degrees]")
    curves(axes[1, 0], data.time.values, data.panel_error.values[:, None] / _DEGREE, ("error",))
    _labelled(axes[1, 0], "panel error [degrees]", legend=False)
    return _titled(figure, data)


def _many(ax: Axes, data: xr.Dataset, name: str, limit: str, dim: str) -> None:
    """Plot all histories of a signal, and its limits as thin lines."""
    values = data[name].values
    for k, label in enumerate(data[dim].values):
        color, dash = STYLES[k % len(STYLES)]
        width = 1.4 if k < len(STYLES) else 0.7
        ax.plot(
            data.time.values, values[:, k], label=f"{dim} {label}", linewidth=width, color=color,
            linestyle=dash,
        )  # fmt: skip
    for end in ("lowest", "highest"):
        if f"{end}_{limit}" in data:
            for value in np.unique(data[f"{end}_{limit}"].values):
                ax.axhline(value, color="0.3", linewidth=0.6)
    ax.set_xlabel("time [s]", fontsize=9)


def flight_rotors(data: xr.Dataset) -> Figure:
    """Figure of the rotor speeds with their limits."""
    figure, axes = grid(1, 1, 3.4)
    _many(axes[0, 0], data, "rotor_speed", "speed", "rotor")
    _labelled(axes[0, 0], "rotor speed [rad/s]")
    return _titled(figure, data)


def flight_strokes(data: xr.Dataset) -> Figure:
    """Figure of the sliders' displacements with their limits."""
    figure, axes = grid(1, 1, 3.4)
    _many(axes[0, 0], data, "displacement", "displacement", "slider")
    _labelled(axes[0, 0], "displacement [m]")
    return _titled(figure, data)


def flight_forces(data: xr.Dataset) -> Figure:
    """Figure of the forces that the servo asks of the tracker's actuators, with their limits."""
    figure, axes = grid(1, 1, 3.4)
    _many(axes[0, 0], data, "wanted_force", "force", "slider")
    _labelled(axes[0, 0], "force wanted [N]")
    return _titled(figure, data)


def flight_power(data: xr.Dataset) -> Figure:
    """Figure of the powers, and of the battery's charge if there is one."""
    charge = "state_of_charge" in data
    figure, axes = grid(2 if charge else 1, 1, 5.0 if charge else 3.0)
    both = np.stack([data.electric_power.values, data.rotor_power.values], axis=1)
    curves(axes[0, 0], data.time.values, both, ("electrical", "of the rotors, mechanical"))
    _labelled(axes[0, 0], "power [W]")
    if charge:
        left = 100 * data.state_of_charge.values[:, None]
        curves(axes[1, 0], data.time.values, left, ("charge",))
        _labelled(axes[1, 0], "charge left [%]", legend=False)
    return _titled(figure, data)


def flight_margins(data: xr.Dataset) -> Figure:
    """Figure of the smallest margins of rotor speeds, strokes and forces, as shares of their ranges."""
    shown = {
        label: 100 * np.nanmin(margin_history(data, name, limit), axis=1, initial=0.5)
        for name, limit, label in (
            ("rotor_speed", "speed", "rotor speeds"), ("displacement", "displacement", "strokes"),
            ("wanted_force", "force", "actuators' forces"),
        )
        if f"lowest_{limit}" in data
    }  # fmt: skip
    figure, axes = grid(1, 1, 3.0)
    if shown:
        curves(axes[0, 0], data.time.values, np.stack(list(shown.values()), axis=1), tuple(shown))
        axes[0, 0].axhline(0.0, color="0.3", linewidth=0.6)
    else:
        axes[0, 0].text(
            0.5, 0.5, "no limits", transform=axes[0, 0].transAxes, ha="center", fontsize=9
        )
    _labelled(axes[0, 0], "smallest margin\n[% of the range]", legend=bool(shown))
    return _titled(figure, data)


FLIGHT_FIGURES = {
    "errors": flight_errors, "margins": flight_margins, "rotors": flight_rotors, "power": flight_power,
    "panel": flight_panel, "strokes": flight_strokes, "forces": flight_forces,
}  # fmt: skip


# Variables without which a figure is left out: those of the panel are a tracker's.
_NEEDED = {"panel": "panel_error", "strokes": "displacement", "forces": "wanted_force"}


def flight_figures(data: xr.Dataset) -> dict[str, Figure]:
    """Figures of a mission's flight by name; those of the panel only for a machine with a tracker."""
    names = [name for name in FLIGHT_FIGURES if _NEEDED.get(name, "time") in data.variables]
    return {name: FLIGHT_FIGURES[name](data) for name in names}
