"""The process of a command: `stmuav`, or `python -m stmuav_jax`."""

import gc
import os
import signal
import sys
import threading
from typing import Any

# Thresholds of Python's garbage collector.
_GARBAGE = (50_000, 20, 20)
# Time after which Ctrl-C comes again [s].
_LATER = 0.02


def _repeat_interrupt(unraisable: Any) -> None:
    """Let Ctrl-C come again where Python would print and forget it, as in callbacks of weak references."""
    if issubclass(unraisable.exc_type, KeyboardInterrupt):
        threading.Timer(_LATER, signal.raise_signal, [signal.SIGINT]).start()
    else:
        sys.__unraisablehook__(unraisable)


def run_process() -> int:
    """Entry point of a process that is one command and nothing else; the exit code as of `cli.main.main`.

    Only such a process keeps its programs: in others a part of the package may have been replaced.
    """
    # Until everything is imported, Ctrl-C ends the process at once, without Python's traceback.
    at_interrupt = signal.getsignal(signal.SIGINT)
    if at_interrupt is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from .cli.main import main
    from .cli.output import INTERRUPTED

    # tracing makes millions of objects, through which Python would look for cycles after every 700
    gc.set_threshold(*_GARBAGE)
    sys.unraisablehook = _repeat_interrupt
    signal.signal(signal.SIGINT, at_interrupt)
    code = main(keep_programs=True)
    if code == INTERRUPTED:
        # XLA's threads may still run the interrupted program, and Python's own end would take from under
        # them what they use.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    return code


if __name__ == "__main__":
    sys.exit(run_process())
