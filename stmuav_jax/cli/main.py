"""The command line, `stmuav`: its arguments, its commands, and its error messages.

The modules of a command are imported when it runs.
"""

import contextlib
import dataclasses
import hashlib
import os
import stat
import sys
import tomllib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union

import jax
import tyro
from rich.console import Console

from .. import __version__
from ..figures.terminal import print_line
from ..uav.scenes.registry import SCENES
from .check import List, check_class, run_check, run_list
from .estimate import estimate_options, run_estimate
from .fly import Fly, run_fly
from .identify import identify_options, run_identify
from .montecarlo import Montecarlo, run_montecarlo
from .options import check_options, check_words
from .output import explain_error, show_activity
from .simulate import run_simulate, simulate_class
from .sun import SunDay, run_sun
from .trim import run_trim, trim_options
from .tune import run_tune, tune_options
from .view import run_view, view_options

ABOUT = """Simulate, trim, tune and estimate a UAV that carries a parallel-mechanism solar tracker,
from the command line. Results go to files in runs/; `stmuav COMMAND --help` describes a command.

Examples: stmuav simulate uav_tracker --case 2; stmuav sun --lat 11.55 --lon 104.92 --date 2024-03-21;
stmuav trim --phi 10 --theta -5; stmuav view runs/uav_tracker_2 --gif flight.gif.
Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
`--version` prints the version; `--debug` with a command prints the traceback of an error.
"""


class Command(NamedTuple):
    """A command by its name.

    Attributes:
        options: dataclass that tyro reads, or a function that makes one of the words after the
            command's name. run: takes an instance and returns the exit code.
        doing: what is said on stderr meanwhile; "" for commands that show their own progress.
    """

    options: Any
    run: Callable[[Any], int]
    doing: str = ""


# Columns of a terminal below which tables hold one letter a line; shells say 0 for a width unknown.
_NARROWEST = 60

COMMANDS = {
    "list": Command(List, run_list),
    "simulate": Command(simulate_class, run_simulate),
    "fly": Command(Fly, run_fly),
    "check": Command(check_class, run_check, "Compiling and inspecting"),
    "view": Command(view_options, run_view),
    "sun": Command(SunDay, run_sun, "Following the sun through the day"),
    "trim": Command(trim_options, run_trim, "Compiling and solving the trim"),
    "tune": Command(tune_options, run_tune),
    "identify": Command(identify_options, run_identify),
    "estimate": Command(estimate_options, run_estimate, "Compiling and running the filters"),
    "montecarlo": Command(Montecarlo, run_montecarlo),
}


def cache_folder() -> Path | None:
    """Folder of compiled code: $XDG_CACHE_HOME/stmuav_jax, else ~/.cache/stmuav_jax; None without a home.

    A relative path in $XDG_CACHE_HOME does not count, as the XDG specification requires: whoever
    made the current folder would choose the code that runs.
    """
    base = os.environ.get("XDG_CACHE_HOME", "")
    if os.path.isabs(base):
        return Path(base) / "stmuav_jax"
    with contextlib.suppress(RuntimeError):
        return Path.home() / ".cache" / "stmuav_jax"
    return None


def private_folder(path: Path) -> Path | None:
    """The real path of a folder, made if it is missing, that no other user can replace; else None.

    JAX reads code from there that becomes part of the process. So the folder is the user's own, its
    parents are the user's or root's, and others may write to none of them; where they may, as in
    /tmp, the sticky bit keeps them from renaming what is not theirs.
    """
    try:
        path.mkdir(mode=0o700, parents=True, exist_ok=True)
        real = path.resolve(strict=True)
        if not hasattr(os, "getuid"):
            return real
        folder_status, *parents = [folder.stat() for folder in (real, *real.parents)]
    except (OSError, RuntimeError):
        return None
    open_to_others = stat.S_IWGRP | stat.S_IWOTH
    if folder_status.st_uid != os.getuid() or folder_status.st_mode & open_to_others:
        return None
    for parent in parents:
        if parent.st_uid not in (0, os.getuid()):
            return None
        if parent.st_mode & open_to_others and not parent.st_mode & stat.S_ISVTX:
            return None
    return real


def _configure_cache(use_cache: bool) -> Path | None:
    """Set JAX's cache to a folder, if one may be used; the folder."""
    folder = cache_folder() if use_cache else None
    folder = None if folder is None else private_folder(folder)
    if folder is not None:
        jax.config.update("jax_compilation_cache_dir", str(folder))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


# Options that no program depends on.
_FREE = ("out", "figures", "cache")


def _is_repeatable(name: str, options: Any) -> bool:
    """True for a command that does the same if it is told the same, so that its programs can be kept.

    Of a folder's content, such as the run of `view` or a search to resume, and of files that a robot's file names,
    its words say nothing.
    """
    is_robot = str(getattr(options, "scene", "")).endswith((".xml", ".mjcf", ".urdf"))
    resumes = getattr(getattr(options, "settings", options), "resume", False)
    return name != "view" and not is_robot and not resumes


def _digest_file(path: Path, readers: tuple[Path, ...] = ()) -> str:
    """Digest of a file and of the files that it names if it is TOML, as a mission names its model.

    Args:
        readers: files that led to this one, which are not read again.
    """
    content = path.read_bytes()
    with contextlib.suppress(OSError, ValueError):
        for text in _texts_in(tomllib.loads(content.decode())):
            for named in (path.parent / text, Path(text)):
                if os.path.isfile(named) and named not in (*readers, path):
                    content += _digest_file(named, (*readers, path)).encode()
    return hashlib.sha256(content).hexdigest()


def _texts_in(plain: Any) -> Iterator[str]:
    """Every text in plain data."""
    if isinstance(plain, str):
        yield plain
    elif isinstance(plain, dict | list):
        for part in plain.values() if isinstance(plain, dict) else plain:
            yield from _texts_in(part)


def _plain_options(value: Any) -> Any:
    """Plain data of options; of a file its name and the digest of its content."""
    if dataclasses.is_dataclass(value):
        fields = [field.name for field in dataclasses.fields(value) if field.name not in _FREE]
        return {field: _plain_options(getattr(value, field)) for field in fields}
    if isinstance(value, Path | str):
        with contextlib.suppress(OSError, ValueError):
            if (path := Path(value)).is_file():
                # a name may be that of a scene too, beside which a file of this name lies
                return f"{value} {_digest_file(path)}"
    return value if isinstance(value, str | int | float | bool | None) else repr(value)


def _parse_arguments(arguments: Sequence[str]) -> tuple[str, Any]:
    """The command's name and its options."""
    kinds: dict[str, Any] = {}
    for name, command in COMMANDS.items():
        is_class = isinstance(command.options, type)
        after = arguments[1:] if arguments[:1] == [name] else ()
        kinds[name] = command.options if is_class else command.options(after)
    named = [Annotated[kind, tyro.conf.subcommand(name=name)] for name, kind in kinds.items()]
    every: Any = Union[tuple(named)]  # noqa: UP007
    try:
        options = tyro.cli(every, args=list(arguments), prog="stmuav", description=ABOUT)
    except SystemExit as stop:
        if stop.code and arguments and arguments[0] in COMMANDS:
            place = " ".join(
                arguments[:2] if arguments[1:2] and arguments[1] in SCENES else arguments[:1]
            )
            print_line(Console(stderr=True), f"`stmuav {place} --help` describes its options.")
        raise
    check_options(options, arguments)
    return next(name for name, kind in kinds.items() if type(options) is kind), options


def _run_command(name: str, options: Any, keep_programs: bool) -> int:
    """Run one command; its exit code."""
    command = COMMANDS[name]
    folder = _configure_cache(options.cache) if hasattr(options, "cache") else None
    if keep_programs and folder is not None and _is_repeatable(name, options):
        data = {"command": name, "options": _plain_options(options)}
        from ..math.compiler import keep_command_programs
        from ..math.exported import Programs

        keep_command_programs(Programs(folder / "programs", data))
    if not command.doing:
        return command.run(options)
    with show_activity(command.doing):
        return command.run(options)


def main(arguments: Sequence[str] | None = None, *, keep_programs: bool = False) -> int:
    """Run a command; the exit code: 0, 1 for a failed run, 2 for bad input, 130 for Ctrl-C.

    Args:
        arguments: words after `stmuav`, by default those of the process.
        keep_programs: keep programs for later processes with the same words, as `__main__.run_process` does.
    """
    columns = os.environ.get("COLUMNS", "")
    if columns.isdecimal() and int(columns) < _NARROWEST:
        os.environ["COLUMNS"] = str(_NARROWEST) if int(columns) else "80"
    command_line = list(sys.argv[1:] if arguments is None else arguments)
    debug = "--debug" in command_line
    command_line = [word for word in command_line if word != "--debug"]
    jax.config.update("jax_enable_x64", True)
    if command_line == ["--version"]:
        print_line(Console(), f"stmuav_jax {__version__}")
        return 0
    try:
        check_words(command_line)
        return _run_command(*_parse_arguments(command_line), keep_programs)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except (Exception, KeyboardInterrupt) as error:
        return explain_error(error, debug)
