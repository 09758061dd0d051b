"""The command line, `stmuav`: what its words mean, which command runs, and how errors are said.

Options are read without JAX; the modules of a command are imported when it runs.
"""

import gc
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union

import tyro
from rich.console import Console

from .commands.check import check_class, run_check
from .commands.estimate import estimate_options, run_estimate
from .commands.flight import linear_options, run_linearize, run_trim, trim_options
from .commands.fly import Fly, run_fly
from .commands.listing import List, run_list
from .commands.montecarlo import Montecarlo, run_montecarlo
from .commands.options import arguments_of, check_options, check_words
from .commands.output import explain, working
from .commands.report import Report, run_report
from .commands.show import run_show, show_class
from .commands.simulate import run_simulate, simulate_class
from .commands.sun import SunDay, run_sun
from .commands.tune import run_tune, tune_options
from .commands.view import View, run_view
from .figures.terminal import line

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


# Thresholds of Python's garbage collector.
_GARBAGE = (50_000, 20, 20)

COMMANDS = {
    "list": Command(List, run_list),
    "show": Command(show_class, run_show, "Building and drawing the mechanism"),
    "simulate": Command(simulate_class, run_simulate),
    "fly": Command(Fly, run_fly),
    "check": Command(check_class, run_check, "Compiling and inspecting"),
    "view": Command(View, run_view),
    "sun": Command(SunDay, run_sun, "Following the sun through the day"),
    "trim": Command(trim_options, run_trim, "Compiling and solving the trim"),
    "linearize": Command(
        linear_options, run_linearize, "Compiling and solving trim and linear equations"
    ),
    "tune": Command(tune_options, run_tune),
    "estimate": Command(estimate_options, run_estimate, "Compiling and running the filters"),
    "montecarlo": Command(Montecarlo, run_montecarlo),
    "report": Command(Report, run_report, "Reading the results and drawing"),
}


def cache_folder() -> Path:
    """Folder of compiled code: $XDG_CACHE_HOME/stmuav_jax, else ~/.cache/stmuav_jax."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "stmuav_jax"


def _configure(use_cache: bool) -> None:
    import jax

    from .algebra.kept import keep_programs, own_folder

    jax.config.update("jax_enable_x64", True)
    # what JAX reads there becomes part of the process, so nobody else may write to it
    if use_cache and own_folder(cache_folder()):
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
        keep_programs(cache_folder() / "programs")


def _read(words: Sequence[str]) -> tuple[str, Any]:
    """The command's name and its options."""
    kinds: dict[str, Any] = {}
    for name, command in COMMANDS.items():
        made = isinstance(command.options, type)
        after = words[1:] if words[:1] == [name] else ()
        kinds[name] = command.options if made else command.options(after)
    named = [Annotated[kind, tyro.conf.subcommand(name=name)] for name, kind in kinds.items()]
    every: Any = Union[tuple(named)]  # noqa: UP007
    given = tyro.cli(every, args=list(words), prog="stmuav", description=ABOUT)
    check_options(given, words)
    return next(name for name, kind in kinds.items() if type(given) is kind), given


def _run(name: str, given: Any) -> int:
    """Run one command; its exit code."""
    command = COMMANDS[name]
    if hasattr(given, "cache"):
        _configure(given.cache)
    if not command.doing:
        return command.run(given)
    with working(command.doing):
        return command.run(given)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code: 0, 1 for a failed run, 2 for bad input, 130 for Ctrl-C."""
    if arguments is None:
        # a process of its own: tracing makes millions of objects, through which Python would look for
        # cycles after every 700 new ones
        gc.set_threshold(*_GARBAGE)
    words = arguments_of(arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if words == ["--version"]:
        # the package is loaded by now; it cannot be imported here, since it is above all floors
        line(Console(), f"stmuav_jax {sys.modules['stmuav_jax'].__version__}")
        return 0
    try:
        check_words(words)
        return _run(*_read(words))
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except (Exception, KeyboardInterrupt) as error:
        return explain(error, debug)


if __name__ == "__main__":
    sys.exit(main())
