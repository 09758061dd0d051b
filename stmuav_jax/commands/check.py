"""`stmuav check`: inspection of a scene or of a model's file before a run."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from ..figures.terminal import line, row, table
from .options import Cache, default, shared
from .simulate import chosen_scene, scene_command

EXIT_CODES = {"note": 0, "warning": 1, "fault": 2}


@dataclasses.dataclass
class CheckSettings:
    """Options of an inspection, which all scenes share."""

    case: Annotated[int | None, shared("case"), default("the scene's first choice")] = None
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    cache: Cache = True


ABOUT = """Inspect a scene, or a model's file, at its start: what is wrong, and what a run will demand.

Example: stmuav check model.toml; stmuav check uav_tracker --case 2. Units and magnitudes, inertia,
degrees of freedom, dependent and contradictory constraints, residuals, conditions, singular postures,
stiffness, formulation and solver. Exit codes: 0 notes at most, 1 warnings, 2 faults or bad input.
"""


def check_class(words: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Check", CheckSettings, ABOUT, words)


def run_check(command: Any) -> int:
    """Inspect the scene and print the findings; the exit code by the worst of them."""
    from ..dynamics.inspection import check

    scene = chosen_scene(command)
    found = check(scene)
    shown = table("", "what", "value", "valid, or advice", title=scene.title)
    for each in found.findings:
        row(shown, *each)
    out = Console()
    out.print(shown)
    for note in scene.notes:
        line(out, f"Note: {note}")
    return EXIT_CODES[found.worst]
