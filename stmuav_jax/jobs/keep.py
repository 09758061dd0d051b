"""Keeps what is computed: one chunk is written while the next is computed, and progress is told."""

import os
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

from ..mechanics.errors import SettingError
from ..montecarlo.work import AbstractWork
from ..view.io import FileError
from ..view.layout import read_layout
from ..view.store import Store, create, resume_store
from .compute import Piece
from .progress import Meter, Outcome, Standing

Report = Callable[[Standing], object]


class New(NamedTuple):
    """What a new store needs: samples in a chunk, and the versions of what computes."""

    chunk: int
    versions: Mapping[str, str]


def there(path: str | os.PathLike[str], *, resume: bool) -> bool:
    """Whether there is a store, or something else.

    Raises:
        FileError: there is, and `resume` is not set.
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
    """The store to write: a new one, or with `resume` the one that is there, extended if need be.

    Args:
        chunk: asked for. new: called if there is no store yet.
        elsewhere: another process computes, so that this one's versions do not matter.

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
    """Writes chunks in a thread of its own, one at a time, and reports as they are stored."""

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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        # a chunk that is being written is written whole
        self._thread.shutdown(wait=True)

    def tell(self, note: str = "") -> None:
        """Report where the study stands, with something to say."""
        if note:
            self._notes.append(note)
        standing = self._meter(self.store.finished, note)
        if self._report is not None:
            self._report(standing)

    def keep(self, chunk: int, piece: Piece) -> None:
        """Have a chunk written, once the one before is.

        Raises:
            FileError: the chunk before could not be written.
        """
        self.settle()
        self._writing = self._thread.submit(self.store.write, chunk, piece.arrays)
        if piece.note:
            self.tell(piece.note)

    def settle(self) -> None:
        """Wait until what was given is written; raise what that raised."""
        if self._writing is None:
            return
        # what is interrupted here is still being written, and can be waited for again
        wait([self._writing])
        writing, self._writing = self._writing, None
        writing.result()
        self.tell()

    def outcome(self, *, interrupted: bool) -> Outcome:
        """What the run came to; nothing can be kept after it."""
        # Ctrl-C may have come before a chunk that was handed over could be noted as such
        self._thread.shutdown(wait=True)
        done = self.store.finished
        return Outcome(
            self.store.path, done, self.store.total, done - self._before,
            time.monotonic() - self._start, interrupted, tuple(self._notes),
        )  # fmt: skip
