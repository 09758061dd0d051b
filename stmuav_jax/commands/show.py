"""Command `stmuav show`: a labelled sketch of a mechanism and the graph of its joints."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console
from rich.table import Table

from ..figures.terminal import row, table
from .check import CheckSettings
from .options import default, shared
from .output import results_folder, written
from .simulate import chosen_scene, scene_command

if TYPE_CHECKING:
    from ..dynamics.scene import Scene


@dataclasses.dataclass
class ShowSettings(CheckSettings):
    """Options of a sketch, which all scenes share."""

    out: Annotated[Path | None, shared("out"), default("runs/NAME")] = None
    figures: Annotated[Literal["png", "pdf", "svg"], shared("figures")] = "png"


ABOUT = """Draw a scene or a model's file: bodies, joints, frames, and the graph of the joints.

Example: stmuav show uav_tracker; stmuav show docs/models/four_bar.toml --out runs/four_bar. The table lists the joints,
and says which of them close loops of the mechanism.
"""


def show_class(words: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Show", ShowSettings, ABOUT, words)


def run_show(command: Any) -> int:
    """Draw the mechanism, print its joints and write the picture; return the exit code."""
    from ..figures.plot import save_figures
    from ..viewer.sketch import draw

    scene, settings = chosen_scene(command), command.settings
    folder = results_folder(settings.out, scene.name)
    paths = save_figures({"mechanism": draw(scene)}, folder, settings.figures)
    out = Console()
    out.print(_joints_table(scene))
    written(out, paths)
    return 0


def _joints_table(scene: "Scene") -> Table:
    """Table of the joints, with the two bodies of each and its place in the graph."""
    from ..dynamics.tree.topology import spanning_tree

    system = scene.system
    closing = set(spanning_tree(system).cut)
    shown = table("joint", "kind", "from", "to", "graph", title=scene.title or scene.name)
    for k, joint in enumerate(system.joints):
        place = "closes a loop" if k in closing else "spanning tree"
        row(shown, joint.name, joint.kind.replace("_", " "), joint.body_i, joint.body_j, place)
    return shown
