"""A figure of the tracker's workspace: by panel angles, and by the direction that is faced."""

import jax
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure

from ..vehicle.geometry import TrackerGeometry
from ..vehicle.kinematics import Reason, panel_angles
from ..vehicle.workspace import Limits, Survey, direction_grid, survey

_LEVELS = (1.0, 1.5, 2.0, 3.0, 5.0, 10.0, 50.0)
_NORM = BoundaryNorm(_LEVELS, 256)
# What ends the workspace, with the letter that stands in the figure.
_LETTERS = {
    Reason.TILT: "T",
    Reason.POST_ROOT: "P",
    Reason.ROD_2_ROOT: "R2",
    Reason.ROD_3_ROOT: "R3",
    Reason.SINGULAR: "S",
    Reason.STROKE_2: "2",
    Reason.STROKE_3: "3",
}
_WORDS = "T tilt limit, S singularity, 2 and 3 stroke of that slider, R2, R3, P out of reach"
_look = jax.jit(survey)


def _draw(ax: Axes, x: np.ndarray, y: np.ndarray, found: Survey, every: int) -> object:
    """Condition numbers inside, letters outside on each `every`-th point."""
    reason = np.asarray(found.reason)
    inside = np.where(reason == Reason.VALID, np.asarray(found.condition), np.nan)
    filled = ax.contourf(x, y, inside, levels=_LEVELS, cmap="viridis_r", norm=_NORM)
    ax.contour(x, y, (reason == Reason.VALID).astype(float), levels=[0.5], colors="k", linewidths=1)
    for i in range(every // 2, reason.shape[0], every):
        for j in range(every // 2, reason.shape[1], every):
            letter = _LETTERS.get(Reason(int(reason[i, j])))
            if letter:
                where = x[i, j], y[i, j]
                ax.annotate(letter, where, fontsize=6, color="0.4", ha="center", va="center")
    return filled


def workspace(geometry: TrackerGeometry, limits: Limits, *, points: int = 121) -> Figure:
    """The workspace over (phi, theta), and over the horizontal part of the direction faced.

    Colours show the condition number of d strokes / d angles, letters the first limit that is
    broken. Directions are in the base's axes.

    Args:
        points: along each axis of the grids.
    """
    figure = Figure(figsize=(7.0, 3.4), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    reach = float(np.degrees(limits.tilt)) + 10.0
    side = np.radians(np.linspace(-reach, reach, points))
    phi, theta = np.meshgrid(side, side, indexing="ij")
    found = _look(geometry, np.stack([phi, theta]), limits)
    every = max(points // 15, 1)
    filled = _draw(left, np.degrees(phi), np.degrees(theta), found, every)
    left.set_xlabel("phi [degrees]", fontsize=9)
    left.set_ylabel("theta [degrees]", fontsize=9)
    azimuths = np.linspace(0.0, 2 * np.pi, 2 * points - 1)
    tilts = np.radians(np.linspace(0.0, min(reach, 180.0), points))
    found = _look(geometry, panel_angles(direction_grid(azimuths, tilts)), limits)
    azimuth, tilt = np.meshgrid(azimuths, np.degrees(tilts), indexing="ij")
    _draw(right, tilt * np.cos(azimuth), tilt * np.sin(azimuth), found, every)
    right.set_xlabel("tilt towards x [degrees]", fontsize=9)
    right.set_ylabel("tilt towards y [degrees]", fontsize=9)
    for ax in (left, right):
        ax.set_aspect("equal")
        ax.tick_params(labelsize=8)
    bar = figure.colorbar(filled, ax=[left, right], shrink=0.7)  # pyright: ignore[reportArgumentType]
    bar.set_label("condition number", fontsize=9)
    figure.suptitle(f"Workspace. {_WORDS}", fontsize=8)
    return figure
