"""Table (CSV) of reaction loads for a mechanical designer, and their figure."""

import csv
import io
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from rich.table import Table

from ..dynamics.loads import COMPONENTS, UNITS, Envelope, JointLoads, envelope
from ..dynamics.scene import Scene
from ..files.netcdf import write_atomically
from ..mechanics.system import System
from .numbers import NOTHING, SavedLoads
from .terminal import row as add_row, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEADER = (
    "joint", "type", "body_i", "body_j", "component", "unit", "min", "t_min_s", "max", "t_max_s",
)  # fmt: skip


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


def loads_numbers(scene: Scene, found: JointLoads) -> tuple[str, SavedLoads]:
    """Numbers that the figure of reaction loads shows: the scene's title and the loads."""
    ts, force, moment = (np.asarray(x) for x in (found.ts, found.force, found.moment))
    names = tuple(joint.name for joint in scene.system.joints)
    return scene.title, SavedLoads(ts, force, moment, names)


def loads_figure(scene: Scene, found: JointLoads) -> "Figure":
    """Figure of force and moment over time in joint axes, with a row of panels per joint."""
    # matplotlib is slow to import: only where figures are drawn
    from .plot import loads

    return loads(*loads_numbers(scene, found))
