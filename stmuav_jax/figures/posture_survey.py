"""Figures of a mechanism in many postures: inputs along a path, and the map of a survey."""

import numpy as np
from matplotlib.colors import BoundaryNorm
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ..analysis.path_inverse_dynamics import PathEfforts
from ..analysis.posture_survey import Survey
from .plot import STYLES, draw_histories, grid

# Levels of the smallest singular value, from without hold on.
_LEVELS = (0.0, 0.001, 0.01, 0.03, 0.1, 0.3, 1.0, 10.0)
# Share of the largest sizes of inputs that a scale leaves out: they go to infinity at a singular posture.
_MOST = 95.0


def survey_map(survey: Survey, title: str = "") -> Figure:
    """Figure of a survey: hold of the inputs, and the largest input that holds a posture, in its unit.

    Postures where the loops do not close stay white.

    Args:
        survey: result of `stm.analysis.survey`. title: title of the figure.
    """
    figure, axes = grid(1, 2, 3.4, sharey=True)
    (name_x, unit_x), (name_y, unit_y) = survey.coordinates
    largest = np.max(np.abs(survey.values), axis=2, initial=0.0)
    units = ", ".join(dict.fromkeys(unit for _, unit in survey.inputs.names))
    limit = np.nanpercentile(largest, _MOST) if np.any(survey.reachable) else 1.0
    ticks = MaxNLocator(8).tick_values(0.0, limit or 1.0)
    panels = (
        (axes[0, 0], survey.hold, "smallest singular value of the inputs' hold", list(_LEVELS)),
        (axes[0, 1], largest, f"largest input at rest [{units}]", ticks),
    )
    for ax, values, label, levels in panels:
        filled = ax.contourf(
            survey.first, survey.second, np.ma.masked_invalid(values).T,
            levels=np.asarray(levels), extend="max",
            # Each level has its own colour: by their values, levels near zero would look alike.
            cmap="cividis", norm=BoundaryNorm(levels, 256, extend="max"),
        )  # fmt: skip
        bar = figure.colorbar(filled, ax=ax, orientation="horizontal", format="{x:.3g}")
        bar.set_label(label, fontsize=8)
        bar.ax.tick_params(labelsize=7)
        ax.set_xlabel(f"{name_x} [{unit_x}]", fontsize=9, parse_math=False)
    axes[0, 0].set_ylabel(f"{name_y} [{unit_y}]", fontsize=9, parse_math=False)
    figure.suptitle(title, fontsize=10, parse_math=False)
    return figure


def effort_histories(efforts: PathEfforts, title: str = "") -> Figure:
    """Figure of the inputs along a path, with a panel for each unit.

    Args:
        efforts: result of `stm.analysis.inverse_dynamics`. title: title of the figure.
    """
    panels = []
    for unit in dict.fromkeys(unit for _, unit in efforts.inputs):
        places = [k for k, (_, own_unit) in enumerate(efforts.inputs) if own_unit == unit]
        for first in range(0, len(places), len(STYLES)):
            some = places[first : first + len(STYLES)]
            labels = tuple(efforts.inputs[k][0] for k in some)
            panels.append((f"input [{unit}]", labels, efforts.values[:, some]))
    return draw_histories(title, efforts.ts, panels)
