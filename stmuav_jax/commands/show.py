"""Command `stmuav show`: a labelled sketch of a mechanism and the graph of its joints."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console

from .check import CheckSettings
from .options import default
from .output import written
from .simulate import chosen_scene, scene_command


@dataclasses.dataclass
class ShowSettings(CheckSettings):
    """Options of a sketch, which all scenes share."""

    out: Annotated[Path | None, default("runs/NAME")] = None
    """Folder for the picture."""
    figures: Literal["png", "pdf", "svg"] = "png"
    """Format of the picture."""


ABOUT = """Draw a scene or a model's file: bodies, joints, frames, and the graph of the joints.

Example: stmuav show uav_tracker; stmuav show docs/models/four_bar.toml --out runs/four_bar
"""


def show_class(words: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Show", ShowSettings, ABOUT, words)


def run_show(command: Any) -> int:
    """Draw the mechanism, write the picture; return the exit code."""
    from ..figures.plot import save_figures
    from ..viewer.sketch import draw

    scene, settings = chosen_scene(command), command.settings
    folder = settings.out if settings.out is not None else Path("runs") / scene.name
    written(Console(), save_figures({"mechanism": draw(scene)}, folder, settings.figures))
    return 0
