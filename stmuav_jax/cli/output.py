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

# Exit codes: after Ctrl-C, and of a completed run whose result cannot be trusted.
INTERRUPTED, UNTRUSTED = 130, 3

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
    from ..estimation import EstimationError
    from ..io.netcdf import FileError

    trace = "".join(traceback.format_exception(error))
    match error:
        case KeyboardInterrupt():
            code, message = INTERRUPTED, "interrupted before anything was reached."
        case SimulationError() | EstimationError():
            code, message = 1, str(error)
        case ModelError() | StateError() | SettingError() | FileError():
            code, message = 2, str(error)
        case OSError():
            code, message = 2, error.strerror or str(error)
            message += "" if error.filename is None else f": {error.filename}"
        case _ if isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error):
            code, message = (
                1, "there is not enough memory for this. Ask for less: fewer samples, times or runs.",
            )  # fmt: skip
        case _:
            report = "Please report it with the traceback "
            report += "below." if debug else "that --debug prints."
            with contextlib.suppress(OSError):
                if not debug:
                    handle, path = tempfile.mkstemp(prefix="stmuav-fault-", suffix=".log")
                    with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as log:
                        log.write(" ".join(sys.argv) + "\n" + trace)
                    report = f"Please report it; the traceback is in {path}."
            kind = type(error).__name__
            code, message = (
                1, f"a fault of the program, not of what you gave it: {kind}: {error}. {report}",
            )  # fmt: skip
    printable = lambda text: "".join(c if c.isprintable() or c == "\n" else "?" for c in text)
    message = " ".join(printable(message).split())
    if len(message) > _LONGEST:
        message = f"{message[: _LONGEST // 2]} ... {message[-_LONGEST // 2 :]}"
    # in one line, which the terminal breaks: a message can be searched for
    for text in (f"stmuav: {message}", *[printable(trace)] * debug):
        Console(stderr=True).print(Text(text, style="red"), highlight=False, soft_wrap=True)
    return code
