"""Commands on a scene or a model's file: their options, generated from the scene's own, and the scene.

An option that is a group of numbers, such as drag, becomes `--drag`, which switches it on with the
table's numbers, and `--drag.linear X Y Z` for each number, which switch it on too.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro

from ..checks.errors import SettingError
from ..checks.schema import quantity_fields
from ..uav.scenes.registry import SCENES, SceneOption, make_scene, options_from_plain

if TYPE_CHECKING:
    from ..dynamics.simulation import Scene

# Ends of the names of files that hold a model: TOML, MJCF, URDF.
MODEL_FILES = (".toml", ".xml", ".mjcf", ".urdf")


def scene_command(
    name: str, settings: type, about: str, arguments: Sequence[str], before: Sequence[Any] = ()
) -> type:
    """Command on a scene for tyro, with the options of the scene that the words after it name.

    Its fields are scene, settings and, if the scene is known, options.

    Args:
        settings: dataclass of the options that all scenes share. about: the command's help.
        before: fields of positional arguments in front of the scene.
    """
    scene = named_scene(settings, arguments)
    scene_argument = tyro.conf.arg(
        help="Name of a scene (see `stmuav list`), or a model's file: .toml, .xml, .urdf."
    )
    model = () if scene is None or scene in SCENES else (scene,)
    fields: list[Any] = [
        *before,
        ("scene", Annotated[tyro.conf.Positional[Literal[(*SCENES, *model)]], scene_argument]),  # pyright: ignore[reportInvalidTypeForm]
        ("settings", Annotated[settings, tyro.conf.arg(name="")]),
    ]
    if scene in SCENES:
        options = SCENES[scene].options.values()
        flat = [field for option in options for field in _option_fields(option)]
        options_class = dataclasses.make_dataclass("SceneOptions", flat)
        titled = tyro.conf.arg(name=scene)
        fields.append(("options", Annotated[options_class, titled, tyro.conf.OmitArgPrefixes]))
    cache = property(lambda command: command.settings.cache)
    return dataclasses.make_dataclass(name, fields, namespace={"__doc__": about, "cache": cache})


def command_or_scene(
    command: type, name: str, settings: type, about: str
) -> Callable[[Sequence[str]], type]:
    """Function of the words after a command: its own class, or a `scene_command` if they name a scene.

    Args:
        command: dataclass of the command without a scene or model's file; the others as in `scene_command`.
    """

    def make_options(arguments: Sequence[str]) -> type:
        if named_scene(settings, arguments) is None:
            return command
        return scene_command(name, settings, about, arguments)

    return make_options


def named_scene(settings: type, arguments: Sequence[str]) -> str | None:
    """Scene or model's file that the words after a command name, if they name one.

    A value of an option is neither; no value follows a switch of the settings.
    """
    switches = [name for name, kind in get_type_hints(settings).items() if kind is bool]
    flags = [f"--{no}{name}".replace("_", "-") for name in switches for no in ("", "no-")]
    before = ""
    for word in arguments:
        named = word in SCENES or (word.endswith(MODEL_FILES) and not word.startswith("--"))
        if named and not (before.startswith("--") and before not in flags):
            return word
        before = word
    return None


def _option_fields(option: SceneOption) -> list[Any]:
    """Fields of a scene's option for tyro: one for each word that may be given."""

    def make_field(name: str, kind: Any, default: Any, text: str, hint: str, **more: Any) -> Any:
        word = name.replace("__", ".").replace("_", "-")
        notes = tyro.conf.arg(name=word, help=text, help_behavior_hint=hint, **more)
        return name, Annotated[kind, notes], dataclasses.field(default=default)

    if not option.is_group:
        hint = f"(default: {option.default})"
        return [make_field(option.name, option.kind | None, None, option.description, hint)]
    switch = tyro.conf.FlagCreatePairsOff[bool]
    about = (option.kind.__doc__ or option.description).partition("\n")[0]
    fields = [make_field(option.name, switch, False, about, "")]
    defaults = {field.name: field.default for field in dataclasses.fields(option.kind)}
    for key, number in quantity_fields(option.kind).items():
        name, default, kind = f"{option.name}__{key}", defaults[key], number.kind
        unit = f" [{number.unit}]" if number.unit else ""
        text = f"{number.description[0].upper()}{number.description[1:]}{unit}."
        if kind is bool:
            fields.append(make_field(name, switch, False, text, ""))
            continue
        values = default if isinstance(default, tuple) else (default,)
        default_text = "the scene's" if default is None else " ".join(f"{x:g}" for x in values)
        metavar = kind.__name__.upper()
        if len(number.counts) > 1:
            kind, metavar = tuple[kind, ...], f"{metavar} [{metavar} ...]"
        elif number.counts != (1,):
            count = max(number.counts)
            kind = tuple.__class_getitem__((kind,) * count)
            metavar = " ".join([metavar] * count)
        hint = f"(default: {default_text})"
        fields.append(make_field(name, kind | None, None, text, hint, metavar=metavar))
    return fields


def _plain_options(scene: str, options: Any) -> dict[str, Any]:
    """Plain data, for `options_from_plain`, of the options of a `scene_command`."""
    plain: dict[str, Any] = {}
    for name, option in SCENES[scene].options.items():
        option_value = getattr(options, name)
        if not option.is_group:
            plain |= {} if option_value is None else {name: option_value}
            continue
        values = {k: getattr(options, f"{name}__{k}") for k in quantity_fields(option.kind)}
        # a switch that is not given is false
        values = {k: v for k, v in values.items() if v is not None and v is not False}
        if option_value or values:
            plain[name] = values
    return plain


def chosen_scene(command: Any) -> "Scene":
    """Scene of a `scene_command`, with its case, parameters and options, or of a model's file."""
    name, settings = command.scene, command.settings
    floating = getattr(settings, "floating", False)
    if floating and (name in SCENES or name.endswith(".toml")):
        raise SettingError(f"--floating is for a robot's URDF, which {name} is not.")
    if name in SCENES:
        from ..io.netcdf import load_parameters

        table = load_parameters(settings.params, SCENES[name].parameters)
        options = options_from_plain(name, _plain_options(name, command.options))
        return make_scene(name, settings.case, table, **options)
    for option in ("case", "params"):
        if getattr(settings, option) is not None:
            raise SettingError(
                f"--{option} is for the report's scenes; a model's file has its own parameters."
            )
    if name.endswith(".toml"):
        from ..io.model_file import load_model

        return load_model(name)
    from ..io.mujoco_import import load_robot

    # without the option the root of a URDF stays on ground, and a note says so
    return load_robot(name, floating=floating or None)
