"""The scenes by name, for the command line and for those who loop over them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ..dynamics.scene import Scene
from ..mechanics.errors import SettingError, nearest_names
from ..vehicle.airframe import PART_I, PART_II
from ..vehicle.parameters import Parameters
from . import hexacopter, spin, tracker, uav_tracker


@dataclass(frozen=True)
class Entry:
    """One scene of the registry.

    Attributes:
        build: makes the scene. cases: of the report, empty where there is one only.
        default_case: the one that is run if none is named.
        parameters: the table it is built from. summary: one line. source: in the report.
    """

    build: Callable[..., Scene]
    cases: tuple[int, ...]
    default_case: int | None
    parameters: Parameters
    summary: str
    source: str


SCENES: dict[str, Entry] = {
    "spin": Entry(
        spin.spin, (), None, PART_I, "a body on a ball joint, with a closed form", "Part I, 4.3"
    ),
    "tracker": Entry(
        tracker.tracker, (1, 2, 3), 1, PART_I, "the tracker on fixed ground", "Part I, ch. 5"
    ),
    "hexacopter": Entry(
        hexacopter.hexacopter, (), None, PART_II, "one free body, six rotors", "Part II, 5.1"
    ),
    "uav_tracker": Entry(
        uav_tracker.uav_tracker, (1, 2, 3), 2, PART_II, "hexacopter with tracker", "Part II, 5.2"
    ),
}


def make_scene(
    name: str, case: int | None = None, parameters: Parameters | None = None, **options: Any
) -> Scene:
    """Build a scene by name.

    Args:
        case: of the report; default the entry's.
        parameters: default the scene's table.
        options: passed on, e.g. actuators="printed" for uav_tracker.

    Raises:
        SettingError: an unknown name, or a case that the scene does not have.
    """
    if name not in SCENES:
        raise SettingError(f"There is no scene '{name}'.{nearest_names(name, SCENES)}")
    entry = SCENES[name]
    if case is not None and case not in entry.cases:
        have = ", ".join(map(str, entry.cases)) or "none"
        raise SettingError(f"Scene '{name}' has no case {case}; its cases: {have}.")
    if entry.cases:
        options["case"] = case if case is not None else entry.default_case
    return entry.build(
        parameters=parameters if parameters is not None else entry.parameters, **options
    )
