"""Figures of a mission's flight, from its dataset."""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ..figures.plot import STYLES, grid, plot_histories
from .outcome import MARGINS, margin_history

_DEGREE = np.pi / 180


def _label_axes(ax: Axes, label: str, *, legend: bool = True) -> None:
    ax.set_ylabel(label, fontsize=9)
    if legend:
        ax.legend(fontsize=8, ncols=4, loc="upper center", bbox_to_anchor=(0.5, -0.22))


def _add_title(figure: Figure, data: xr.Dataset) -> Figure:
    figure.suptitle(data.attrs.get("title", ""), fontsize=11)
    return figure


def flight_errors(data: xr.Dataset) -> Figure:
    """Figure of the position error along the world's axes, and of the tilt error."""
    figure, axes = grid(2, 1, 5.0)
    ts = data.time.values
    plot_histories(axes[0, 0], ts, data.position_error.values, ("x", "y", "z"))
    _label_axes(axes[0, 0], "position error [m]")
    tilt = data.tilt_error.values[:, None] / _DEGREE
    plot_histories(axes[1, 0], ts, tilt, ("tilt error",))
    _label_axes(axes[1, 0], "tilt error [degrees]", legend=False)
    return _add_title(figure, data)


def flight_panel(data: xr.Dataset) -> Figure:
    """Figure of the panel angles against their reference, and of the angle between both normals."""
    figure, axes = grid(2, 1, 5.0)
    both = np.concatenate([data.panel_angles.values, data.reference_panel_angles.values], axis=1)
    labels = ("phi", "theta", "phi reference", "theta reference")
    plot_histories(axes[0, 0], data.time.values, both / _DEGREE, labels)
    _label_axes(axes[0, 0], "panel angles [degrees]")
    plot_histories(
        axes[1, 0], data.time.values, data.panel_error.values[:, None] / _DEGREE, ("error",)
    )
    _label_axes(axes[1, 0], "panel error [degrees]", legend=False)
    return _add_title(figure, data)


def _plot_many(ax: Axes, data: xr.Dataset, name: str, limit: str, dim: str) -> None:
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
    _plot_many(axes[0, 0], data, "rotor_speed", "speed", "rotor")
    _label_axes(axes[0, 0], "rotor speed [rad/s]")
    return _add_title(figure, data)


def flight_strokes(data: xr.Dataset) -> Figure:
    """Figure of the sliders' displacements with their limits."""
    figure, axes = grid(1, 1, 3.4)
    _plot_many(axes[0, 0], data, "displacement", "displacement", "slider")
    _label_axes(axes[0, 0], "displacement [m]")
    return _add_title(figure, data)


def flight_forces(data: xr.Dataset) -> Figure:
    """Figure of the forces that the servo asks of the tracker's actuators, with their limits."""
    figure, axes = grid(1, 1, 3.4)
    _plot_many(axes[0, 0], data, "commanded_force", "force", "slider")
    _label_axes(axes[0, 0], "commanded force [N]")
    return _add_title(figure, data)


def flight_joints(data: xr.Dataset) -> Figure:
    """Figure of the driven joints against their references, and of their errors; hinges and slides apart."""
    units = data.driven_joint_unit.values
    scales = [x for x in (("rad", "degrees", _DEGREE), ("m", "m", 1.0)) if x[0] in units]
    figure, axes = grid(2 * len(scales), 1, 5.0 * len(scales))
    for row, (unit, unit_text, scale) in enumerate(scales):
        places = np.flatnonzero(units == unit)
        names = [str(name) for name in data.driven_joint.values[places]]
        position, reference, error = (
            data[signal].values[:, places] / scale
            for signal in ("joint_position", "reference_joint_position", "joint_error")
        )
        labels = (*names, *(f"{name} reference" for name in names))
        both = np.concatenate([position, reference], axis=1)
        plot_histories(axes[2 * row, 0], data.time.values, both, labels)
        _label_axes(axes[2 * row, 0], f"joints [{unit_text}]")
        plot_histories(axes[2 * row + 1, 0], data.time.values, error, tuple(names))
        _label_axes(axes[2 * row + 1, 0], f"error [{unit_text}]")
    return _add_title(figure, data)


def flight_power(data: xr.Dataset) -> Figure:
    """Figure of the powers, and of the battery's charge if there is one."""
    charge = "state_of_charge" in data
    figure, axes = grid(2 if charge else 1, 1, 5.0 if charge else 3.0)
    both = np.stack([data.electric_power.values, data.rotor_power.values], axis=1)
    plot_histories(axes[0, 0], data.time.values, both, ("electrical", "of the rotors, mechanical"))
    _label_axes(axes[0, 0], "power [W]")
    if charge:
        remaining_charge = 100 * data.state_of_charge.values[:, None]
        plot_histories(axes[1, 0], data.time.values, remaining_charge, ("charge",))
        _label_axes(axes[1, 0], "charge left [%]", legend=False)
    return _add_title(figure, data)


def flight_margins(data: xr.Dataset) -> Figure | None:
    """Figure of the smallest margins of rotor speeds, strokes and forces, as shares of their ranges.

    None for a machine without limits.
    """
    margins_by_label = {
        label: 100 * np.nanmin(margin_history(data, name, limit), axis=1, initial=0.5)
        for name, label, limit in MARGINS
        if f"lowest_{limit}" in data
    }
    if not margins_by_label:
        return None
    figure, axes = grid(1, 1, 3.0)
    plot_histories(
        axes[0, 0],
        data.time.values,
        np.stack(list(margins_by_label.values()), axis=1),
        tuple(margins_by_label),
    )
    axes[0, 0].axhline(0.0, color="0.3", linewidth=0.6)
    _label_axes(axes[0, 0], "smallest margin\n[% of the range]")
    return _add_title(figure, data)


FLIGHT_FIGURES = {
    "errors": flight_errors, "margins": flight_margins, "rotors": flight_rotors, "power": flight_power,
    "panel": flight_panel, "strokes": flight_strokes, "forces": flight_forces, "joints": flight_joints,
}  # fmt: skip


# Variables without which a figure is left out.
_NEEDED = {
    "joints": "joint_error",
    "panel": "panel_error",
    "strokes": "displacement",
    "forces": "commanded_force",
}


def flight_figures(data: xr.Dataset) -> dict[str, Figure]:
    """Figures of a mission's flight by name; those of the panel only for a machine with a tracker."""
    names = [name for name in FLIGHT_FIGURES if _NEEDED.get(name, "time") in data.variables]
    figures = {name: FLIGHT_FIGURES[name](data) for name in names}
    return {name: figure for name, figure in figures.items() if figure is not None}
