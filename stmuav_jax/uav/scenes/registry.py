"""The scenes by name, for the command line, for studies and for those who loop over them.

A scene is one file with a function, and one line here. Its parameters and options are those of the function's
signature; the line repeats the cases, so that a list of the scenes imports none of them. An option is a
keyword-only argument whose annotation begins with what text can give: a Literal, float, int, bool, str, or a
dataclass whose fields are made by `quantity`. So

    def swing(parameters=PART_I, *, length: float = 1.0, drag: Drag | None = None) -> Scene

has the options length and drag. Others, such as functions of time, are for Python alone.
"""

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    NamedTuple,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from ...checks.errors import SettingError, closest_name, nearest_names
from ...checks.schema import option_from_plain, quantity_fields
from ...mechanics.parameters import Parameters

if TYPE_CHECKING:
    # takes half of the time in which the command line starts, and is not needed to name the scenes
    from ...dynamics.simulation import Scene


class SceneOption(NamedTuple):
    """One option of a scene.

    Attributes:
        name: of the argument. kind: a Literal, float, int, bool, str, or a dataclass of quantities.
        default: the argument's. description: from the docstring of the function.
    """

    name: str
    kind: Any
    default: Any
    description: str

    @property
    def is_group(self) -> bool:
        """True for an option with fields of its own."""
        return bool(quantity_fields(self.kind))

    @property
    def choices(self) -> tuple[Any, ...]:
        """Values of a Literal; none of another kind."""
        return get_args(self.kind) if get_origin(self.kind) is Literal else ()


@cache
def _options_of(build: Callable[..., "Scene"]) -> dict[str, SceneOption]:
    """Options of the function that builds a scene, by name."""
    # Options of the command line follow from the builder's signature and docstring: nothing is written
    # twice.
    hints = get_type_hints(build)
    arguments = inspect.signature(build).parameters.values()
    keywords = [argument for argument in arguments if argument.kind is argument.KEYWORD_ONLY]
    section = inspect.cleandoc(build.__doc__ or "").partition("Args:")[2].partition("\n\n")[0]
    names = "|".join(argument.name for argument in keywords)
    parts = re.split(rf"\b({names}): ", " ".join(section.split())) if names else [""]
    descriptions = dict(zip(parts[1::2], map(str.strip, parts[2::2]), strict=True))
    options = {}
    for argument in keywords:
        kind = hints[argument.name]
        kind = get_args(kind)[0] if get_origin(kind) in (Union, UnionType) else kind
        if kind in (float, int, bool, str) or get_origin(kind) is Literal or quantity_fields(kind):
            name = argument.name
            options[name] = SceneOption(name, kind, argument.default, descriptions.get(name, ""))
    return options


@dataclass(frozen=True)
class RegisteredScene:
    """Entry of the registry for one scene; its module is imported when the scene is needed.

    Attributes:
        module: dotted name of the module whose function of the same last name builds the scene.
        summary: one line. source: in the report. t1: end of the scene [s].
        cases: cases of the report, as in the function's signature; empty where there is one only.
    """

    module: str
    summary: str
    source: str
    t1: float
    cases: tuple[int, ...] = ()

    @property
    def build(self) -> Callable[..., "Scene"]:
        """The function that builds the scene."""
        return getattr(import_module(self.module), self.module.rpartition(".")[2])

    @property
    def default_case(self) -> int | None:
        """The case that is run if none is named."""
        return inspect.signature(self.build).parameters["case"].default if self.cases else None

    @property
    def options(self) -> Mapping[str, SceneOption]:
        """Options that text can give, by name."""
        return _options_of(self.build)

    @property
    def parameters(self) -> Parameters:
        """The table that the scene is built from."""
        return inspect.signature(self.build).parameters["parameters"].default


_HERE = __package__

SCENES: dict[str, RegisteredScene] = {
    "spin": RegisteredScene(
        f"{_HERE}.spin", "a body on a ball joint, with a closed form", "Part I, 4.3", 5.0
    ),
    "tracker": RegisteredScene(
        f"{_HERE}.tracker", "the tracker on fixed ground", "Part I, ch. 5", 2.0, (1, 2, 3)
    ),
    "hexacopter": RegisteredScene(
        f"{_HERE}.hexacopter", "one free body, six rotors", "Part II, 5.1", 2.0
    ),
    "uav_tracker": RegisteredScene(
        f"{_HERE}.uav_tracker", "hexacopter with tracker", "Part II, 5.2", 2.0, (1, 2, 3)
    ),
}


def entry_of(name: str) -> RegisteredScene:
    """The line of a scene.

    Raises:
        SettingError: an unknown name.
    """
    if name not in SCENES:
        raise SettingError(f"There is no scene '{name}'.{nearest_names(name, SCENES)}")
    return SCENES[name]


def unknown_option(scene: str, option: str) -> SettingError:
    """The error about an option that a scene does not have."""
    names_text = ", ".join(entry_of(scene).options) or "none"
    hint = closest_name(option, entry_of(scene).options)
    return SettingError(f"Scene {scene} has no {option}; its options: {names_text}.{hint}")


def options_from_plain(name: str, plain: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a scene from plain data, such as {"drag": {}, "motor": {"time_constant": 0.04}}.

    Raises:
        SettingError: an unknown scene, option or field, or a value of another type.
    """
    scene_options, option_values = entry_of(name).options, {}
    for option, value in plain.items():
        if option not in scene_options:
            raise unknown_option(name, option)
        scene_option = scene_options[option]
        if scene_option.is_group:
            option_values[option] = option_from_plain(scene_option.kind, value, option)
            continue
        if scene_option.choices and value not in scene_option.choices:
            choice_list = ", ".join(map(str, scene_option.choices))
            hint = closest_name(str(value), map(str, scene_option.choices))
            raise SettingError(
                f"Option '{option}' must be one of {choice_list}, not {value!r}.{hint}"
            )
        if not scene_option.choices and not isinstance(
            value, (int, float) if scene_option.kind is float else scene_option.kind
        ):
            raise SettingError(
                f"Option '{option}' must be a {scene_option.kind.__name__}, not {value!r}."
            )
        option_values[option] = value
    return option_values


def make_scene(
    name: str, case: int | None = None, parameters: Parameters | None = None, **options: Any
) -> "Scene":
    """Build a scene by name.

    Args:
        case: case of the report; by default that of the entry.
        parameters: parameter table; by default that of the entry.
        options: options of the scene, such as actuators="printed" for uav_tracker.

    Raises:
        SettingError: an unknown name or option, or a case that the scene does not have.
    """
    entry = entry_of(name)
    for option in options:
        # A misspelt option would otherwise be an error of Python about arguments.
        if option not in inspect.signature(entry.build).parameters:
            raise unknown_option(name, option)
    if case is not None and case not in entry.cases:
        cases_text = ", ".join(map(str, entry.cases)) or "none"
        raise SettingError(f"Scene '{name}' has no case {case}; its cases: {cases_text}.")
    if entry.cases:
        options["case"] = case if case is not None else entry.default_case
    return entry.build(
        parameters=parameters if parameters is not None else entry.parameters, **options
    )
