"""Options of the scenes on the command line, generated from the scenes' own.

An option that is a group of numbers, such as drag, becomes `--drag`, which switches it on with the
table's numbers, and `--drag.linear X Y Z` for each number, which switch it on too.
"""

import dataclasses
import difflib
from collections.abc import Sequence
from typing import Annotated, Any

import tyro

from ..checks.errors import SettingError
from ..checks.quantity import OptionField, quantities
from ..scenes.registry import SCENES
from ..scenes.signature import SceneOption

# Ends of the names of files that hold a model: TOML, MJCF, URDF.
MODEL_FILES = (".toml", ".xml", ".mjcf", ".urdf")

_METAVARS = {float: "FLOAT", int: "INT"}


def options_class(scene: str) -> type:
    """Dataclass of a scene's options for tyro: one flat field for each word that may be given."""
    fields = [field for option in SCENES[scene].options.values() for field in _fields(option)]
    return dataclasses.make_dataclass("SceneOptions", fields)


def plain_of(scene: str, given: Any) -> dict[str, Any]:
    """Plain data, for `options_from_plain`, of an instance of `options_class(scene)`."""
    plain: dict[str, Any] = {}
    for option in SCENES[scene].options.values():
        own = getattr(given, option.name)
        if not option.is_group:
            if own is not None:
                plain[option.name] = own
            continue
        values = {k: getattr(given, f"{option.name}__{k}") for k in quantities(option.kind)}
        switches = [k for k, number in quantities(option.kind).items() if number.kind is bool]
        numbers = {
            k: v for k, v in values.items() if v is not None and not (k in switches and v is False)
        }
        if own or numbers:
            plain[option.name] = numbers
    return plain


def _word(*names: str) -> str:
    return ".".join(name.replace("_", "-") for name in names)


def _field(
    name: str, kind: Any, default: Any, word: str, words: str, hint: str, **more: Any
) -> Any:
    notes = tyro.conf.arg(name=word, help=words, help_behavior_hint=hint, **more)
    return name, Annotated[kind, notes], dataclasses.field(default=default)


def _switch(name: str, word: str, words: str) -> Any:
    name, kind, default = _field(name, bool, False, word, words, "")
    return name, Annotated[kind, tyro.conf.FlagCreatePairsOff], default


def _fields(option: SceneOption) -> list[Any]:
    name, word = option.name, _word(option.name)
    if not option.is_group:
        hint = f"(default: {option.default})"
        return [_field(name, option.kind | None, None, word, option.words, hint)]
    about = (option.kind.__doc__ or option.words).partition("\n")[0]
    found = [_switch(name, word, about)]
    usual = {field.name: field.default for field in dataclasses.fields(option.kind)}
    for each, number in quantities(option.kind).items():
        found.append(_number(f"{name}__{each}", _word(name, each), number, usual[each]))
    return found


def _number(name: str, word: str, number: OptionField, usual: Any) -> Any:
    unit = f" [{number.unit}]" if number.unit else ""
    words = f"{number.what[0].upper()}{number.what[1:]}{unit}."
    if number.kind is bool:
        return _switch(name, word, words)
    hint = "(default: the scene's)" if usual is None else f"(default: {_shown(usual)})"
    one = _METAVARS[number.kind]
    if number.counts == (1,):
        return _field(name, number.kind | None, None, word, words, hint, metavar=one)
    if len(number.counts) == 1:
        kind = tuple[(number.kind,) * number.counts[0]]  # pyright: ignore[reportInvalidTypeArguments]
        metavar = " ".join([one] * number.counts[0])
    else:
        kind, metavar = tuple[number.kind, ...], f"{one} [{one} ...]"
    return _field(name, kind | None, None, word, words, hint, metavar=metavar)


def _shown(usual: Any) -> str:
    return " ".join(f"{x:g}" for x in usual) if isinstance(usual, tuple) else f"{usual:g}"


def scene_among(words: Sequence[str], flags: Sequence[str]) -> str | None:
    """The scene or the model's file that the words after a command name, if they name one.

    A value of an option is neither.

    Args:
        flags: options that no value follows.
    """
    before = ""
    for word in words:
        named = word in SCENES or (word.endswith(MODEL_FILES) and not word.startswith("--"))
        if named and not (before.startswith("--") and before not in flags):
            return word
        before = word
    return None


def check_known(scene: str, words: Sequence[str], own: Sequence[str]) -> None:
    """Raise SettingError for an option that belongs to another scene, or to none.

    Args:
        own: options that every scene has.
    """
    fields = dataclasses.fields(options_class(scene))
    mine = {*own, *("--" + field.name.replace("__", ".").replace("_", "-") for field in fields)}
    for word in words:
        option = word.partition("=")[0].replace("_", "-")
        if not option.startswith("--") or option == "--" or option in mine:
            continue
        stem = option[2:].partition(".")[0]
        have = ", ".join(f"--{_word(name)}" for name in SCENES[scene].options) or "none"
        if stem in (_word(name) for name in SCENES[scene].options):
            inner = ", ".join(sorted(name for name in mine if name.startswith(f"--{stem}.")))
            raise SettingError(f"There is no {option}; {scene} has {inner or have}.")
        close = difflib.get_close_matches(option[:80], sorted(mine), n=1)
        near = f" Did you mean {close[0]}?" if close else ""
        raise SettingError(
            f"Option {option[:80]} is not for this scene: {scene} has no {stem[:80]}.{near} Options "
            f"of its own: {have}. `stmuav simulate {scene} --help` describes all."
        )
