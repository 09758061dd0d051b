"""What the workers of a cluster hold of a study. Imported only where `distributed` is installed."""

import functools
import hashlib
import signal
import threading
from collections.abc import Mapping

import cloudpickle
import jax
from distributed import Worker, get_worker
from distributed.diagnostics.plugin import WorkerPlugin

from ..mechanics.errors import SettingError
from ..montecarlo.work import AbstractWork
from ..view.layout import computing_versions
from .compute import Piece, Pieces

# The last work of this process: a study that is extended compiles nothing again.
_made: dict[str, "_Made"] = {}
_making = threading.Lock()


class _Made:
    """A work in a worker's process."""

    def __init__(self, work: AbstractWork) -> None:
        self.pieces = Pieces(work)
        self.lock = threading.Lock()
        self.compiled = False

    def __call__(self, first: int, count: int) -> Piece:
        if self.compiled:
            return self.pieces(first, count)
        # threads of one process wait for the first, and do not compile the same once more
        with self.lock:
            piece = self.pieces(first, count)
            self.compiled = True
        return piece


class Shipped(WorkerPlugin):
    """A study's work, sent once to each worker there is, and to each that joins later.

    Attributes:
        x64: whether JAX computes in double precision. ours: whether we have started the workers.
    """

    def __init__(self, work: AbstractWork, *, x64: bool, ours: bool) -> None:
        self.content = cloudpickle.dumps(work)
        self.key = hashlib.sha256(self.content).hexdigest()
        self.x64, self.ours = x64, ours

    def setup(self, worker: Worker) -> None:
        """On a worker, as it is told of the study."""
        if self.ours and threading.current_thread() is threading.main_thread():
            # Ctrl-C reaches all processes of a terminal; the one that owns the workers ends them
            signal.signal(signal.SIGINT, signal.SIG_IGN)

    def made(self) -> _Made:
        """The work in this process, made when it is first asked for."""
        with _making:
            if self.key not in _made:
                _made.clear()
                _made[self.key] = _Made(cloudpickle.loads(self.content))
            return _made[self.key]


_versions = functools.cache(computing_versions)


def _held(name: str) -> Shipped:
    return get_worker().plugins[name]  # pyright: ignore[reportReturnType]


def surveyed(name: str, total: int | None) -> tuple[float, dict[str, str]]:
    """On a worker: seconds for a sample, measured if `total` is given, and versions."""
    held = _held(name)
    # precision is the client's, for this thread alone: what else the worker does is its own
    with jax.enable_x64(held.x64):
        made = held.made()
        if total is None:
            return 0.0, _versions()
        with made.lock:
            return made.pieces.seconds(total), _versions()


def computed(name: str, first: int, count: int, versions: Mapping[str, str]) -> Piece:
    """On a worker: samples first, first + 1, ...

    Raises:
        SettingError: this worker's versions are not the store's.
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
