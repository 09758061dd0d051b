"""Process that draws figures: it imports matplotlib while this one computes; nothing here does."""

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from .numbers import Numbers

_PROGRAM = "from stmuav_jax.figures.drawing import answer; answer()"


class Drawer:
    """Process that draws figures; where it fails, this process draws them.

    Attributes:
        process: the other process; None if there is none. asked: what it was asked for.
    """

    def __init__(self, process: Any) -> None:
        self.process = process
        self.asked: tuple[Numbers, str] = ({}, "png")

    def ask(self, numbers: Numbers, suffix: str) -> None:
        """Ask for the figures (png, pdf or svg) of these numbers."""
        self.asked = numbers, suffix
        if self.process is not None:
            try:
                pickle.dump(self.asked, self.process.stdin)
                self.process.stdin.close()
            except OSError:
                self.process = None

    def files(self) -> dict[str, bytes]:
        """Content of the figures' files by name, when they are drawn."""
        if self.process is not None:
            # whatever has happened to the other process: the figures are drawn here
            with contextlib.suppress(Exception):
                return pickle.load(self.process.stdout)
        return _drawn(*self.asked)


@contextlib.contextmanager
def drawing(wanted: bool) -> Iterator[Drawer]:
    """Context with a `Drawer`, whose process ends with it.

    A process is started only if it is wanted, there is a processor for it, and matplotlib has not
    been imported here.
    """
    process = _started() if wanted and _processors() > 1 else None
    if process is None:
        yield Drawer(None)
        return
    with process:
        try:
            yield Drawer(process)
        finally:
            process.kill()


def _started() -> subprocess.Popen[bytes] | None:
    if "matplotlib" in sys.modules:
        return None
    pipe = subprocess.PIPE
    try:
        # its own session, so that Ctrl-C ends the run and not the drawing of what was reached
        return subprocess.Popen(
            [sys.executable, "-c", _PROGRAM],
            stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True,
        )  # fmt: skip
    except OSError:
        return None


def _processors() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _drawn(numbers: Numbers, suffix: str) -> dict[str, bytes]:
    from .plot import DRAWN, content

    return {name: content(DRAWN[name](*each), suffix) for name, each in numbers.items()}


def answer() -> None:
    """Draw what standard input asks for; write the files' content to standard output."""
    from . import plot

    del plot  # imported before there is anything to draw
    with contextlib.suppress(EOFError):
        # the process that started this one is the only one that writes to its input
        found = _drawn(*pickle.load(sys.stdin.buffer))
        pickle.dump(found, sys.stdout.buffer)
        sys.stdout.flush()
