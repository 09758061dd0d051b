"""Output of every command: the files written, its activity, an error in one paragraph."""

import contextlib
import os
import sys
import tempfile
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from rich.console import Console
from rich.text import Text

from ..figures.terminal import line

# Largest length of a message, which may quote the user's input of any length; longer ones are cut.
_LONGEST = 2000


def results_folder(given: Path | None, name: str) -> Path:
    """Folder for the results: the given one, else runs/NAME."""
    return Path("runs") / name if given is None else given


def written(out: Console, paths: Iterable[Path]) -> None:
    """Print the paths of the written files."""
    line(out, "Written:")
    for path in paths:
        out.print(Text(f"  {path}"), soft_wrap=True, highlight=False)


@contextlib.contextmanager
def working(words: str) -> Iterator[None]:
    """Show the present activity on stderr, if that is a terminal, until the context ends."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(Text(words)):
        yield


@contextlib.contextmanager
def progressing(words: str) -> Iterator[Callable[[float], None]]:
    """Show a progress bar on stderr, if that is a terminal; the context gives a function that moves it.

    The function takes the share that is done, from 0 to 1.
    """
    # slow to import, and most commands show no bar
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(words, total=1.0)
        yield lambda done: bar.update(task, completed=done)


# --- errors


def explain(error: BaseException, debug: bool) -> int:
    """Print one paragraph about an error on stderr; return the exit code.

    The code is 2 for bad input, 1 for a failed run or a fault of the program, 130 for Ctrl-C.
    """
    out = Console(stderr=True)
    code, words = _code_and_words(error)
    if code is None:
        code, words = 1, f"{words} {_kept(error, debug)}"
    _say(out, words)
    if debug:
        _say(out, "".join(traceback.format_exception(error)), cut=False)
    return code


def _code_and_words(error: BaseException) -> tuple[int | None, str]:
    from ..checks.errors import ModelError, SettingError, SimulationError, StateError

    if isinstance(error, KeyboardInterrupt):
        return 130, "interrupted before anything was reached."
    if isinstance(error, SimulationError) or _is(error, "filter", "EstimationError"):
        return 1, str(error)
    if isinstance(error, ModelError | StateError | SettingError) or _is(
        error, "netcdf", "FileError"
    ):
        return 2, str(error)
    if isinstance(error, OSError):
        return 2, _file_words(error)
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return 1, "there is not enough memory for this. Ask for less: fewer samples, times or runs."
    kind = type(error).__name__
    return None, f"a fault of the program, not of what you gave it: {kind}: {error}."


def _is(error: BaseException, module: str, name: str) -> bool:
    """Test whether an error is of a class whose module may never have been imported."""
    return any(
        kind.__name__ == name and kind.__module__.endswith(f".{module}")
        for kind in type(error).__mro__
    )


def _file_words(error: OSError) -> str:
    """Message of the operating system, with the file concerned."""
    words = error.strerror or str(error)
    return f"{words}: {error.filename}" if error.filename is not None else words


def _kept(error: BaseException, debug: bool) -> str:
    """Save the traceback, and return a sentence that says where it is."""
    if debug:
        return "Please report it with the traceback below."
    with contextlib.suppress(OSError):
        handle, path = tempfile.mkstemp(prefix="stmuav-fault-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as log:
            log.write(" ".join(sys.argv) + "\n" + "".join(traceback.format_exception(error)))
        return f"Please report it; the traceback is in {path}."
    return "Please report it with the traceback that --debug prints."


def _say(out: Console, words: str, *, cut: bool = True) -> None:
    words = "".join(c if c.isprintable() or c == "\n" else "?" for c in words)
    if cut:
        words = " ".join(words.split())
    if cut and len(words) > _LONGEST:
        words = f"{words[: _LONGEST // 2]} ... {words[-_LONGEST // 2 :]}"
    out.print(Text(f"stmuav: {words}" if cut else words, style="red"), highlight=False)
