"""`stmuav list`: the scenes. `stmuav check`: inspection of a scene or of a model's file before a run."""

import dataclasses
import json
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from rich.console import Console

from ..figures.terminal import add_row, make_table, print_line
from ..uav.scenes.registry import SCENES
from .options import Cache, Params, default_text, shared_option
from .scene_options import chosen_scene, scene_command

EXIT_CODES = {"note": 0, "warning": 1, "fault": 2}


@dataclasses.dataclass
class CheckSettings:
    """Options of an inspection, which all scenes share."""

    case: Annotated[int | None, shared_option("case", "the scene's first choice")] = None
    params: Params = None
    floating: bool = False
    """Let the root link of a URDF float; without it the root is fixed to ground."""
    cache: Cache = True


ABOUT = """Inspect a scene, or a model's file, at its start: faults, and requirements of a run.

Example: stmuav check model.toml; stmuav check uav_tracker --case 2. Units and magnitudes, inertia,
degrees of freedom, dependent and contradictory constraints, residuals, condition numbers, singular
postures, stiffness, formulation and solver. Exit codes: 0 notes at most, 1 warnings, 2 faults or bad input.
"""


def check_class(arguments: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Check", CheckSettings, ABOUT, arguments)


def run_check(command: Any) -> int:
    """Inspect the scene and print the findings; the exit code by the worst of them."""
    from ..dynamics.inspection import check

    scene = chosen_scene(command)
    result = check(scene)
    findings_table = make_table("", "what", "value", "valid, or advice", title=scene.title)
    for finding in result.findings:
        add_row(findings_table, *finding)
    out = Console()
    out.print(findings_table)
    for note in scene.notes:
        print_line(out, f"Note: {note}")
    return EXIT_CODES[result.worst]


@dataclasses.dataclass
class List:
    """List the scenes, their cases and where the report describes them; or print the schema of a file.

    Example: stmuav list; stmuav list --schema model
    """

    schema: Annotated[Literal["model", "mission", "study"] | None, default_text("none")] = None
    """Print the JSON schema of this kind of TOML file, by which editors complete and check entries."""


def run_list(command: List) -> int:
    """Print the scenes, or a schema; the exit code."""
    if command.schema is not None:
        # not by the console, which would break lines
        if command.schema == "model":
            from ..io.model_schema import model_json_schema as make_schema
        elif command.schema == "mission":
            from ..missions.schema import MissionFile

            make_schema = MissionFile.model_json_schema
        else:
            from ..studies.schema import study_json_schema as make_schema
        print(json.dumps(make_schema(), indent=1))
        return 0
    scene_table = make_table("scene", "cases", "what it is", "report", "end [s]")
    for name, entry in SCENES.items():
        cases = ", ".join(map(str, entry.cases)) or "-"
        add_row(scene_table, name, cases, entry.summary, entry.source, f"{entry.t1:g}")
    Console().print(scene_table)
    return 0
