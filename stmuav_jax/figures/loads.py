"""Table (CSV) of reaction loads for a mechanical designer, and their figure."""

import csv
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from ..dynamics.loads import COMPONENTS, UNITS, Envelope, JointLoads, envelope
from ..dynamics.scene import Scene
from ..files.netcdf import write_atomically
from ..mechanics.system import System
from .numbers import joint_side, saved_motion
from .plot import curves, grid
from .terminal import row as add_row, table

if TYPE_CHECKING:
    import xarray as xr

HEADER = (
    "joint", "type", "body_i", "body_j", "component", "unit", "min", "t_min_s", "max", "t_max_s",
)  # fmt: skip

# Loads below this are round-off of joints without such a load; tables show them as 0 [N, N m].
NOTHING = 1e-9
# Peaks of more than so many usual loads are drawn on a logarithmic axis.
_SPIKE = 5.0


def rows(system: System, found: Envelope) -> list[tuple[str | float, ...]]:
    """Rows of the table, one per joint and component, with columns as in `HEADER`."""
    values = [
        np.asarray(x) for x in (found.minimum, found.t_minimum, found.maximum, found.t_maximum)
    ]
    table: list[tuple[str | float, ...]] = []
    for k, joint in enumerate(system.joints):
        for c, (name, unit) in enumerate(zip(COMPONENTS, UNITS, strict=True)):
            numbers = (float(x[k, c]) for x in values)
            table.append((joint.name, joint.kind, joint.body_i, joint.body_j, name, unit, *numbers))
    return table


def save_loads(scene: Scene, loads: JointLoads, path: str | os.PathLike[str]) -> Path:
    """Save the envelope of reaction loads as CSV, atomically; return the path.

    Loads act from body i on body j, about the joint's point on body j, in the axes of the
    joint's frame on body i.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(HEADER)
    for row in rows(scene.system, envelope(loads)):
        writer.writerow([f"{x:.6g}" if isinstance(x, float) else x for x in row])
    return write_atomically(path, text.getvalue().encode())


def loads_table(scene: Scene, loads: JointLoads) -> Table:
    """Table for the terminal: peaks of force and moment at every joint."""
    found = envelope(loads)
    heads = ("joint", "type", "peak force [N]", "at [s]", "peak moment [N m]", "at [s]")
    shown = table(*heads, title=f"{scene.title}: peaks of the joint reactions")
    force, moment = COMPONENTS.index("|F|"), COMPONENTS.index("|M|")
    for k, joint in enumerate(scene.system.joints):
        cells: list[str] = []
        for c in (force, moment):
            value, time = float(found.maximum[k, c]), float(found.t_maximum[k, c])
            cells += ["0", ""] if value < NOTHING else [f"{value:.4g}", f"{time:.4f}"]
        add_row(shown, joint.name, joint.kind, *cells)
    return shown


def loads_figure(scene: Scene, found: JointLoads) -> Figure:
    """Figure of force and moment over time in joint axes, with a row of panels per joint."""
    ts, force, moment = (np.asarray(x) for x in (found.ts, found.force, found.moment))
    names = tuple(joint.name for joint in scene.system.joints)
    return histories(scene.title, SavedLoads(ts, force, moment, names))


class SavedLoads(NamedTuple):
    """Reaction loads in NumPy arrays, as in `JointLoads`: times (k,), force and moment (k, joints, 3)."""

    ts: np.ndarray
    force: np.ndarray
    moment: np.ndarray
    joints: tuple[str, ...]

    @property
    def components(self) -> np.ndarray:
        """Force and its magnitude [N], moment and its magnitude [N m] (k, joints, 8)."""
        parts = [
            part
            for vector in (self.force, self.moment)
            for part in (vector, np.linalg.norm(vector, axis=-1)[..., None])
        ]
        return np.concatenate(parts, axis=-1)


def saved_loads(data: "xr.Dataset") -> SavedLoads | None:
    """Reaction loads at the saved times of a saved run; None where its file has none."""
    if "reaction_force" not in data or not data.sizes["joint"]:
        return None
    motion = saved_motion(data)
    frames = np.stack([joint_side(motion, joint, "i")[1] for joint in motion.joints], axis=1)
    # components along the columns of each frame
    own = lambda name: np.einsum("kjab,kja->kjb", frames, data[name].values)
    names = tuple(joint.name for joint in motion.joints)
    return SavedLoads(motion.ts, own("reaction_force"), own("reaction_moment"), names)


def histories(title: str, found: SavedLoads) -> Figure:
    """Figure of `loads_figure` with a title of its own."""
    rows = max(len(found.joints), 1)
    figure, axes = grid(rows, 2, 0.9 + 1.35 * rows)
    for k, name in enumerate(found.joints):
        _history(found, k, axes[k])
        axes[k, 0].set_ylabel(name, fontsize=9, fontweight="bold", parse_math=False)
        for ax in axes[k]:
            if k < len(found.joints) - 1:
                ax.set_xlabel("")
                ax.tick_params(labelbottom=False)
    figure.align_ylabels(axes[:, 0])
    axes[0, 0].set_title("force [N]", fontsize=10)
    axes[0, 1].set_title("moment [N m]", fontsize=10)
    if found.joints:
        figure.legend(*axes[0, 0].get_legend_handles_labels(), ncols=4, loc="outside lower center")
    else:
        for ax in axes.flat:
            ax.set_axis_off()
    words = "reactions in joint axes, body i on body j; beyond the thin lines logarithmic"
    figure.suptitle(f"{title}\n{words}", fontsize=10, parse_math=False)
    return figure


def _history(found: SavedLoads, k: int, axes: np.ndarray) -> None:
    values = found.components[:, k]
    for ax, part in zip(axes, (slice(0, 4), slice(4, 8)), strict=True):
        curves(ax, found.ts, values[:, part], ("x", "y", "z", "magnitude"))
        if not np.any(np.abs(values[:, part]) > NOTHING):
            ax.set_ylim(-1.0, 1.0)
            ax.set_yticks([])
            ax.text(0.5, 0.6, "none", transform=ax.transAxes, ha="center", fontsize=9)
        else:
            _room_for_spikes(ax, values[:, part][:, -1])


def _room_for_spikes(ax: Axes, magnitude: np.ndarray) -> None:
    """Make an axis logarithmic beyond the usual loads, where short peaks are far above them."""
    sizes = magnitude[np.isfinite(magnitude)]
    usual = float(np.quantile(sizes, 0.9))
    if usual <= NOTHING or np.max(sizes) < _SPIKE * usual:
        return
    decade = 10 ** np.floor(np.log10(usual))
    linear = float(decade * max(k for k in (1, 2, 5) if k * decade <= usual))
    ax.set_yscale("symlog", linthresh=linear, linscale=1.5)
    largest = 10 ** np.ceil(np.log10(np.max(sizes)))
    ax.set_yticks([-largest, -linear, 0.0, linear, largest])
    ax.minorticks_off()
    ax.yaxis.set_major_formatter(lambda value, _: f"{value:g}")
    for side in (-linear, linear):
        ax.axhline(side, color="0.55", linewidth=0.5)
