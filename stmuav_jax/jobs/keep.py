"""Storing of results: one chunk is written while the next is computed, and progress is reported."""

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import NamedTuple

from ..checks.errors import SettingError
from ..files.layout import read_layout
from ..files.netcdf import FileError
from ..files.store import Store, create, resume_store
from ..montecarlo.work import AbstractWork
from .compute import Piece
from .progress import Meter, Outcome, StudyProgress

Report = Callable[[StudyProgress], object]


class New(NamedTuple):
    """Settings of a new store: samples in a chunk, and the versions that compute them."""

    chunk: int
    versions: Mapping[str, str]


def there(path: str | os.PathLike[str], *, resume: bool) -> bool:
    """Test whether there is a store, or anything else, at a path.

    Raises:
        FileError: there is something, and `resume` is not set.
    """
    target = Path(path)
    found = target.exists() and not (target.is_dir() and not any(target.iterdir()))
    if found and not resume:
        raise FileError(f"{target} exists; go on with it (resume), or give another name.")
    return found


def begin(
    work: AbstractWork,
    path: str | os.PathLike[str],
    total: int,
    *,
    chunk: int | None,
    resume: bool,
    new: Callable[[], New],
    elsewhere: bool = False,
) -> Store:
    """Open the store to write: a new one, or with `resume` an existing one, extended if need be.

    Args:
        chunk: wanted number of samples in a chunk, or None.
        new: function that gives the settings of a new store, called if there is none yet.
        elsewhere: true if another process computes, so that this one's versions do not matter.

    Raises:
        FileError: there is a store and `resume` is not set; or see `resume_store`.
        SettingError: a chunk other than the store's, or fewer samples than it has.
    """
    target = Path(path)
    if not there(target, resume=resume):
        return create(target, work, total, *new())
    versions = read_layout(target)[0].versions if elsewhere else None
    store = resume_store(target, work, versions)
    try:
        if chunk not in (None, store.layout.chunk):
            raise SettingError(
                f"{target} has chunks of {store.layout.chunk} samples, and keeps them; not {chunk}."
            )
        store.extend(total)
    except BaseException:
        store.close()
        raise
    return store


class Keeper:
    """Writer of chunks, one at a time in a thread of its own, with progress after each."""

    def __init__(self, store: Store, report: Report | None) -> None:
        self.store = store
        self._report = report
        self._before, self._start = store.finished, time.monotonic()
        self._meter = Meter(store.finished, store.total)
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="store")
        self._writing: Future[None] | None = None
        self._notes: list[str] = []

    def __enter__(self) -> "Keeper":
        self.tell()
        return self

    def __exit__(self, *_: object) -> None:
        # wait until the present chunk is written
        self._thread.shutdown(wait=True)

    def tell(self, note: str = "") -> None:
        """Call the progress function, with a note if there is one."""
        if note:
            self._notes.append(note)
        standing = self._meter(self.store.finished, note)
        if self._report is not None:
            self._report(standing)

    def keep(self, chunk: int, piece: Piece) -> None:
        """Write a chunk in the background, after the previous one is written.

        Raises:
            FileError: the previous chunk could not be written.
        """
        self.settle()
        self._writing = self._thread.submit(self.store.write, chunk, piece.arrays)
        if piece.note:
            self.tell(piece.note)

    def settle(self) -> None:
        """Wait until the given chunk is written, and raise the error of its writing, if any."""
        if self._writing is None:
            return
        # after an interruption here the chunk is still being written, and can be awaited again
        wait([self._writing])
        writing, self._writing = self._writing, None
        writing.result()
        self.tell()

    def outcome(self, *, interrupted: bool) -> Outcome:
        """Outcome of the run; nothing can be stored after it."""
        # Ctrl-C may have come before a submitted chunk was noted
        self._thread.shutdown(wait=True)
        done = self.store.finished
        return Outcome(
            self.store.path, done, self.store.total, done - self._before,
            time.monotonic() - self._start, interrupted, tuple(self._notes),
        )  # fmt: skip
