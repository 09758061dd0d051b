"""Reliable handling of Ctrl-C and SIGTERM: a flag, and an exception repeated until acknowledged.

Python raises KeyboardInterrupt wherever the main thread happens to be. If that is a callback of a
library, such as JAX's during garbage collection, the exception is printed and lost, and the program
continues. Here the signal is raised again until it has been acknowledged.
"""

import contextlib
import signal
import threading
from collections.abc import Iterator
from types import FrameType
from typing import Any

# Seconds after which an unacknowledged signal is raised again.
AGAIN = 0.5
# A call of Dask that has just begun cannot be cancelled yet and says so with a traceback; the
# signal is raised there at its repetition.
_BEGINNING = ("sync", "distributed")


class Stop:
    """Request to stop a run, and its acknowledgement.

    Attributes:
        asked: true once a signal has come.
    """

    def __init__(self) -> None:
        self.asked = False
        self._heard = threading.Event()
        self._over = threading.Event()

    def heard(self) -> None:
        """Acknowledge the signal, so that it is not raised again."""
        self._heard.set()

    def _come(self, number: int, frame: FrameType | None) -> None:
        first = not self.asked
        if first:
            self.asked = True
            threading.Thread(target=self._insist, args=(number,), daemon=True).start()
        if not _loses_exceptions(frame, first=first):
            raise KeyboardInterrupt

    def _insist(self, number: int) -> None:
        while not self._over.is_set() and not self._heard.wait(AGAIN):
            if not self._over.is_set() and not self._heard.is_set():
                signal.pthread_kill(threading.main_thread().ident or 0, number)


def _loses_exceptions(frame: FrameType | None, *, first: bool) -> bool:
    """True if an exception raised in a frame is printed and lost, or, the first time, mishandled."""
    while frame is not None:
        name, module = frame.f_code.co_name, str(frame.f_globals.get("__name__", ""))
        if name == "__del__" or (first and (name, module.partition(".")[0]) == _BEGINNING):
            return True
        frame = frame.f_back
    return False


_now: list[Stop] = []


@contextlib.contextmanager
def stoppable() -> Iterator[Stop]:
    """Context in which Ctrl-C and SIGTERM raise KeyboardInterrupt repeatedly until `Stop.heard`.

    A nested context is the outer one; in threads other than the main one it has no effect. A
    signal that was never acknowledged raises KeyboardInterrupt at the end.
    """
    if _now or threading.current_thread() is not threading.main_thread():
        yield _now[0] if _now else Stop()
        return
    stop = Stop()
    before: dict[int, Any] = {}
    _now.append(stop)
    try:
        for number in (signal.SIGINT, signal.SIGTERM):
            before[number] = signal.signal(number, stop._come)
        yield stop
    except KeyboardInterrupt:
        stop.heard()
        raise
    finally:
        stop._over.set()
        _now.clear()
        for number, handler in before.items():
            signal.signal(number, handler)
    if stop.asked and not stop._heard.is_set():
        raise KeyboardInterrupt
