"""Figures of a mission's flight, from its dataset."""

from typing import Any

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from ..figures.plot import draw_histories
from .outcome import MARGINS, margin_history

_DEGREE = np.pi / 180


def flight_figures(data: xr.Dataset) -> dict[str, Figure]:
    """Figures of a mission's flight by name: errors, margins of the limits, rotor speeds, power.

    A machine with a tracker has those of panel, strokes and forces, one with driven joints those of its
    joints, hinges apart from slides.
    """
    values = lambda name: data[name].values
    labels_of = lambda dim: tuple(f"{dim} {x}" for x in values(dim))
    panels: dict[str, list[Any]] = {
        "errors": [
            ("position error [m]", ("x", "y", "z"), values("position_error")),
            ("tilt error [degrees]", ("tilt error",), values("tilt_error")[:, None] / _DEGREE),
        ],
    }
    margins = {
        label: 100 * np.nanmin(margin_history(data, name, limit), axis=1, initial=0.5)
        for name, label, limit in MARGINS
        if f"lowest_{limit}" in data
    }
    if margins:
        # a single curve has no legend
        of = f" of the\n{next(iter(margins))}" if len(margins) == 1 else "\n"
        label = f"smallest margin{of} [% of the range]"
        panels["margins"] = [(label, tuple(margins), np.stack([*margins.values()], axis=1))]
    panels["rotors"] = [("rotor speed [rad/s]", labels_of("rotor"), values("rotor_speed"))]
    powers = np.stack([values("electric_power"), values("rotor_power")], axis=1)
    panels["power"] = [("power [W]", ("electrical", "of the rotors, mechanical"), powers)]
    if "state_of_charge" in data:
        charge = 100 * values("state_of_charge")[:, None]
        panels["power"].append(("charge left [%]", ("charge",), charge))
    if "panel_error" in data:
        names = ("phi", "theta", "phi reference", "theta reference")
        angles = np.hstack([values("panel_angles"), values("reference_panel_angles")]) / _DEGREE
        error = values("panel_error")[:, None] / _DEGREE
        panels["panel"] = [("panel angles [degrees]", names, angles)]
        panels["panel"].append(("panel error [degrees]", ("error",), error))
    if "displacement" in data:
        panels["strokes"] = [("displacement [m]", labels_of("slider"), values("displacement"))]
    if "commanded_force" in data:
        # the forces that the servo asks of the tracker's actuators
        panels["forces"] = [("commanded force [N]", labels_of("slider"), values("commanded_force"))]
    for unit, unit_text, scale in (("rad", "degrees", _DEGREE), ("m", "m", 1.0)):
        if "joint_error" in data and unit in values("driven_joint_unit"):
            places = np.flatnonzero(values("driven_joint_unit") == unit)
            names = tuple(map(str, values("driven_joint")[places]))
            position, reference, error = (
                values(signal)[:, places] / scale
                for signal in ("joint_position", "reference_joint_position", "joint_error")
            )
            labels = (*names, *(f"{name} reference" for name in names))
            panels.setdefault("joints", []).extend([
                (f"joints [{unit_text}]", labels, np.hstack([position, reference])),
                (f"error [{unit_text}]", names, error),
            ])  # fmt: skip
    title = data.attrs.get("title", "")
    figures = {name: draw_histories(title, values("time"), of) for name, of in panels.items()}
    lines = {"margins": [0.0]}
    for name, limit in (("rotors", "speed"), ("strokes", "displacement"), ("forces", "force")):
        lines[name] = [values(x) for x in (f"lowest_{limit}", f"highest_{limit}") if x in data]
    for name in lines.keys() & figures.keys():
        for value in np.unique(lines[name]):
            figures[name].axes[0].axhline(value, color="0.3", linewidth=0.6)
    return figures
