"""The scenes by name, for the command line, for studies and for those who loop over them.

A scene is one file with a function, and one line here. Cases, parameters and options are those of
the function's signature (`signature.py`). JAX is imported when a scene is built.
"""

import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from ..checks.errors import SettingError, nearest_names
from ..checks.quantity import option_from_plain
from .signature import SceneOption, Signature, signature_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from ..dynamics.scene import Scene
    from ..parameters.table import Parameters


@dataclass(frozen=True)
class RegisteredScene:
    """Entry of the registry for one scene.

    Attributes:
        module: dotted name of the module whose function of the same last name builds the scene.
        summary: one line. source: in the report. t1: end of the scene [s].
    """

    module: str
    summary: str
    source: str
    t1: float

    @property
    def function(self) -> str:
        """Name of the function that builds the scene."""
        return self.module.rpartition(".")[2]

    @property
    def signature(self) -> Signature:
        """Cases, parameters and options, read without JAX."""
        return signature_of(self.module, self.function)

    @property
    def cases(self) -> tuple[int, ...]:
        """Cases of the report, empty where there is one only."""
        return self.signature.cases

    @property
    def default_case(self) -> int | None:
        """The case that is run if none is named."""
        return self.signature.default_case

    @property
    def options(self) -> Mapping[str, SceneOption]:
        """Options that text can give, by name."""
        return self.signature.options

    @property
    def build(self) -> "Callable[..., Scene]":
        """The function that builds the scene."""
        return getattr(import_module(self.module), self.function)

    @property
    def parameters(self) -> "Parameters":
        """The table that the scene is built from."""
        module, name = self.signature.table
        return getattr(import_module(module), name)


_HERE = __package__

SCENES: dict[str, RegisteredScene] = {
    "spin": RegisteredScene(
        f"{_HERE}.spin", "a body on a ball joint, with a closed form", "Part I, 4.3", 5.0
    ),
    "tracker": RegisteredScene(
        f"{_HERE}.tracker", "the tracker on fixed ground", "Part I, ch. 5", 2.0
    ),
    "hexacopter": RegisteredScene(
        f"{_HERE}.hexacopter", "one free body, six rotors", "Part II, 5.1", 2.0
    ),
    "uav_tracker": RegisteredScene(
        f"{_HERE}.uav_tracker", "hexacopter with tracker", "Part II, 5.2", 2.0
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
    have = ", ".join(entry_of(scene).options) or "none"
    return SettingError(f"Scene {scene} has no {option}; its options: {have}.")


def options_from_plain(name: str, plain: Mapping[str, Any]) -> dict[str, Any]:
    """Options of a scene from plain data, such as {"drag": {}, "motor": {"time_constant": 0.04}}.

    Raises:
        SettingError: an unknown scene, option or field, or a value of another type.
    """
    known, found = entry_of(name).options, {}
    for option, value in plain.items():
        if option not in known:
            raise unknown_option(name, option)
        own = known[option]
        if own.is_group:
            found[option] = option_from_plain(own.kind, value, option)
            continue
        if own.choices and value not in own.choices:
            words = ", ".join(map(str, own.choices))
            raise SettingError(f"Option '{option}' must be one of {words}, not {value!r}.")
        if not own.choices and not isinstance(
            value, (int, float) if own.kind is float else own.kind
        ):
            raise SettingError(f"Option '{option}' must be a {own.kind.__name__}, not {value!r}.")
        found[option] = value
    return found


def make_scene(
    name: str, case: int | None = None, parameters: "Parameters | None" = None, **options: Any
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
        if option not in inspect.signature(entry.build).parameters:
            raise unknown_option(name, option)
    if case is not None and case not in entry.cases:
        have = ", ".join(map(str, entry.cases)) or "none"
        raise SettingError(f"Scene '{name}' has no case {case}; its cases: {have}.")
    if entry.cases:
        options["case"] = case if case is not None else entry.default_case
    return entry.build(
        parameters=parameters if parameters is not None else entry.parameters, **options
    )
