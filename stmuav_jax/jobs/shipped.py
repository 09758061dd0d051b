"""Work of a study on the workers of a cluster; imported only where `distributed` is installed."""

import functools
import hashlib
import logging
import signal
import threading
from collections.abc import Mapping

import cloudpickle
import jax
from distributed import Worker, get_worker
from distributed.comm.core import CommClosedError
from distributed.diagnostics.plugin import WorkerPlugin

from ..checks.errors import SettingError
from ..files.layout import computing_versions
from ..montecarlo.work import AbstractWork
from .compute import Piece, Pieces

# The last work of this process, so that an extended study is not compiled again.
_made: dict[str, "_Made"] = {}
_making = threading.Lock()


def _worth_telling(record: logging.LogRecord) -> bool:
    """False for a message about a closed connection.

    The process that has started scheduler and workers ends both at any moment, and Dask reports a
    heartbeat that was on its way with a traceback. A connection that was really lost is reported
    by that process.
    """
    return record.exc_info is None or not isinstance(record.exc_info[1], CommClosedError)


class _Made:
    """Work unpickled in a worker's process, with the lock of its compilation."""

    def __init__(self, work: AbstractWork) -> None:
        self.pieces = Pieces(work)
        self.lock = threading.Lock()
        self.compiled = False

    def __call__(self, first: int, count: int) -> Piece:
        if self.compiled:
            return self.pieces(first, count)
        # threads of one process wait for the first, so that the program is compiled once
        with self.lock:
            piece = self.pieces(first, count)
            self.compiled = True
        return piece


class Shipped(WorkerPlugin):
    """Work of a study as a plugin, sent once to each present worker and to each later one.

    Attributes:
        x64: true if JAX computes in double precision.
        ours: true if this package has started the workers.
    """

    def __init__(self, work: AbstractWork, *, x64: bool, ours: bool) -> None:
        self.content = cloudpickle.dumps(work)
        self.key = hashlib.sha256(self.content).hexdigest()
        self.x64, self.ours = x64, ours

    def setup(self, worker: Worker) -> None:
        """Prepare a worker when it receives the plugin."""
        if self.ours and threading.current_thread() is threading.main_thread():
            # Ctrl-C reaches all processes of a terminal; the one that owns the workers ends them
            signal.signal(signal.SIGINT, signal.SIG_IGN)
            for handler in logging.getLogger("distributed").handlers:
                handler.addFilter(_worth_telling)

    def made(self) -> _Made:
        """Work in this process, unpickled when it is first needed."""
        with _making:
            if self.key not in _made:
                _made.clear()
                _made[self.key] = _Made(cloudpickle.loads(self.content))
            return _made[self.key]


_versions = functools.cache(computing_versions)


def _held(name: str) -> Shipped:
    return get_worker().plugins[name]  # pyright: ignore[reportReturnType]


def surveyed(name: str, total: int | None) -> tuple[float, dict[str, str]]:
    """Measure the seconds per sample on a worker if `total` is given; also return its versions."""
    held = _held(name)
    # the client's precision holds for this thread only, and leaves other tasks of the worker alone
    with jax.enable_x64(held.x64):
        made = held.made()
        if total is None:
            return 0.0, _versions()
        with made.lock:
            return made.pieces.seconds(total), _versions()


def computed(name: str, first: int, count: int, versions: Mapping[str, str]) -> Piece:
    """Compute the samples first, first + 1, ... on a worker.

    Raises:
        SettingError: the versions of this worker differ from the store's.
    """
    mine = _versions()
    if mine != versions:
        unlike = [
            f"{key} {mine.get(key)} (the store has {versions.get(key)})"
            for key in dict.fromkeys([*mine, *versions])
            if mine.get(key) != versions.get(key)
        ]
        raise SettingError(f"Worker {get_worker().address} computes with {', '.join(unlike)}.")
    held = _held(name)
    with jax.enable_x64(held.x64):
        return held.made()(first, count)
