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

from ..checks.errors import ModelError, SettingError, SimulationError, StateError
from ..figures.terminal import print_line

# Exit code after Ctrl-C.
INTERRUPTED = 130

# Largest length of a message, which may quote the user's input of any length; longer ones are cut.
_LONGEST = 2000


def results_folder(folder: Path | None, name: str) -> Path:
    """Folder for the results: the given one, else runs/NAME."""
    return Path("runs") / name if folder is None else folder


def print_paths(out: Console, paths: Iterable[Path]) -> None:
    """Print the paths of the written files."""
    print_line(out, "Written:")
    for path in paths:
        out.print(Text(f"  {path}"), soft_wrap=True, highlight=False)


@contextlib.contextmanager
def show_activity(message: str) -> Iterator[None]:
    """Show the present activity on stderr, if that is a terminal, until the context ends."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield
        return
    with console.status(Text(message)):
        yield


@contextlib.contextmanager
def show_progress(message: str) -> Iterator[Callable[..., None]]:
    """Show a progress bar on stderr, if that is a terminal; the context gives a function that moves it.

    The function takes the share that is done, from 0 to 1, and optionally another message.
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
        TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    console = Console(stderr=True)
    with Progress(
        *columns, console=console, transient=True, disable=not console.is_terminal
    ) as bar:
        task = bar.add_task(message, total=1.0)
        yield lambda share, text=message: bar.update(task, completed=share, description=text)


# --- errors


def explain_error(error: BaseException, debug: bool) -> int:
    """Print one paragraph about an error on stderr; return the exit code.

    The code is 2 for bad input, 1 for a failed run or a fault of the program, 130 for Ctrl-C.
    """
    out = Console(stderr=True)
    code, message = _code_and_words(error)
    if code is None:
        code, message = 1, f"{message} {_save_traceback(error, debug)}"
    _print_message(out, message)
    if debug:
        _print_message(out, "".join(traceback.format_exception(error)), cut=False)
    return code


def _code_and_words(error: BaseException) -> tuple[int | None, str]:
    from ..estimation import EstimationError
    from ..io.netcdf import FileError

    if isinstance(error, KeyboardInterrupt):
        return INTERRUPTED, "interrupted before anything was reached."
    if isinstance(error, SimulationError | EstimationError):
        return 1, str(error)
    if isinstance(error, ModelError | StateError | SettingError | FileError):
        return 2, str(error)
    if isinstance(error, OSError):
        message = error.strerror or str(error)
        return 2, message if error.filename is None else f"{message}: {error.filename}"
    if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
        return 1, "there is not enough memory for this. Ask for less: fewer samples, times or runs."
    kind = type(error).__name__
    return None, f"a fault of the program, not of what you gave it: {kind}: {error}."


def _save_traceback(error: BaseException, debug: bool) -> str:
    """Save the traceback, and return a sentence that says where it is."""
    if debug:
        return "Please report it with the traceback below."
    with contextlib.suppress(OSError):
        handle, path = tempfile.mkstemp(prefix="stmuav-fault-", suffix=".log")
        with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as log:
            log.write(" ".join(sys.argv) + "\n" + "".join(traceback.format_exception(error)))
        return f"Please report it; the traceback is in {path}."
    return "Please report it with the traceback that --debug prints."


def _print_message(out: Console, message: str, *, cut: bool = True) -> None:
    message = "".join(c if c.isprintable() or c == "\n" else "?" for c in message)
    if cut:
        message = " ".join(message.split())
    if cut and len(message) > _LONGEST:
        message = f"{message[: _LONGEST // 2]} ... {message[-_LONGEST // 2 :]}"
    # in one line, which the terminal breaks: a message can be searched for
    text = Text(f"stmuav: {message}" if cut else message, style="red")
    out.print(text, highlight=False, soft_wrap=True)
