"""A study's results on disk, chunk by chunk, so that a run can be broken off and gone on with.

The folder is a Zarr group (format 3) that xarray reads:
`xarray.open_zarr(path, consolidated=False)`. Samples that are not there yet show as NaN, and as 0
in the column "status". Nothing in it depends on time, or on the order or the process in which
chunks were computed.
"""

import contextlib
import errno
import glob
import hashlib
import os
import shutil
import time
import uuid
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import xarray as xr

from ..mechanics.errors import SettingError, nearest_names
from ..montecarlo.schema import check_count
from ..montecarlo.work import AbstractWork
from .chunks import (
    Record,
    chunk_file,
    clean,
    flush,
    read_records,
    read_samples,
    size,
    verify,
    write_record,
)
from .io import FileError
from .layout import (
    SAMPLE,
    Layout,
    differences,
    layout_of,
    lengthen,
    read_layout,
    write_layout,
)

# Seconds after which an unfinished store that nobody touches was left by a run that was killed.
_STALE = 3600.0


class Store:
    """The store of a study; made by `create`, `resume_store` (to write) or `open_store` (to read).

    Attributes:
        path: the folder.
        layout: samples, identity, versions, columns, axes and reasons.
    """

    def __init__(self, path: Path, layout: Layout, lock: int | None = None) -> None:
        self.path, self.layout = path, layout
        self._lock = lock
        # samples of each chunk; the sums are on disk, else memory would grow with the study
        self._stored = {chunk: record.samples for chunk, record in read_records(path, layout)}
        self._finished = sum(self._stored.values())
        self._arrays: dict[str, Any] = {}

    def __enter__(self) -> "Store":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Let another run write the store."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def total(self) -> int:
        """Samples of the study."""
        return self.layout.total

    @property
    def finished(self) -> int:
        """Samples that are stored."""
        return self._finished

    @property
    def pending(self) -> tuple[int, ...]:
        """Chunks of which samples are missing; `waiting` gives them one by one."""
        return tuple(self.waiting())

    def waiting(self) -> Iterator[int]:
        """Chunks of which samples are missing, one by one: a study may have very many."""
        return (chunk for chunk in range(self.layout.chunks) if self.todo(chunk)[1])

    def todo(self, chunk: int) -> tuple[int, int]:
        """The first of a chunk's samples that are missing, and how many they are."""
        if not 0 <= chunk < self.layout.chunks:
            raise SettingError(f"There is no chunk {chunk} among {self.layout.chunks}.")
        done = self._stored.get(chunk, 0)
        return chunk * self.layout.chunk + done, size(self.layout, chunk) - done

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Store the samples of `todo(chunk)`; all of them are there afterwards, or none.

        Args:
            arrays: columns (count, ...).

        Raises:
            SettingError: columns of other names, shapes or types, or a chunk that is complete.
            FileError: the disk is full or fails; chunks written before are kept.
        """
        first, count = self.todo(chunk)
        done = first - chunk * self.layout.chunk
        values = self._fitting(arrays, first, count)
        try:
            sums = {}
            # the status comes last: where it is there, what it speaks of is there too
            for name in sorted(values, key="status".__eq__):
                digest = hashlib.sha256()
                if done:
                    digest.update(read_samples(self.path, self.layout, name, chunk, done))
                else:
                    # of a write that was broken off; zarr would read it to fill up a last chunk
                    chunk_file(self.path, self.layout, name, chunk).unlink(missing_ok=True)
                self._array(name)[first : first + count] = values[name]
                digest.update(values[name].astype(values[name].dtype.newbyteorder("<")).tobytes())
                sums[name] = digest.hexdigest()
            flush(chunk_file(self.path, self.layout, name, chunk) for name in values)
            write_record(self.path, chunk, Record(done + count, sums))
        except OSError as error:
            raise self._failed(error) from error
        self._stored[chunk] = done + count
        self._finished += count

    def _fitting(
        self, arrays: Mapping[str, np.ndarray], first: int, count: int
    ) -> dict[str, np.ndarray]:
        if self._lock is None:
            raise SettingError(f"{self.path} was opened to read, not to write.")
        if not count:
            raise SettingError(f"The chunk that ends before sample {first} is complete.")
        columns = self.layout.columns
        if set(arrays) != set(columns):
            raise SettingError(
                f"A study gave columns {sorted(arrays)} where it says {sorted(columns)}."
            )
        for name, column in columns.items():
            have = arrays[name].dtype.name, arrays[name].shape
            want = column.dtype, (count, *self.layout.row(name))
            if have != want:
                raise SettingError(
                    f"Samples {first} to {first + count - 1}: column '{name}' is {have[0]} "
                    f"{have[1]} where the study says {want[0]} {want[1]}."
                )
        return {name: arrays[name] for name in columns}

    def _array(self, name: str) -> Any:
        import zarr

        if name not in self._arrays:
            # else a chunk in which all is missing would have no file
            with zarr.config.set({"array.write_empty_chunks": True}):
                self._arrays[name] = zarr.open_array(str(self.path / name), mode="r+")
        return self._arrays[name]

    def _failed(self, error: OSError) -> FileError:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            why, what = "The disk is full", "Make room"
        elif error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            why, what = f"The store may not be written ({error})", "Have it made writable"
        else:
            why, what = f"The disk fails ({error})", "Repair it"
        return FileError(
            f"{why}: {self.path} keeps {self.finished} of {self.total} samples. "
            f"{what} and go on with the study where it stands."
        )

    def extend(self, total: int) -> None:
        """Make room for more samples; those stored stay as they are.

        Raises:
            SettingError: fewer samples than now.
            FileError: the disk is full or fails.
        """
        import zarr

        check_count(total, "A study's samples")
        if total < self.total:
            raise SettingError(
                f"{self.path} has {self.total} samples; a study can grow, not shrink to {total}."
            )
        if self._lock is None:
            raise SettingError(f"{self.path} was opened to read, not to write.")
        try:
            # first what is meant, so that a run that goes on with this one completes it
            zarr.open_group(str(self.path), mode="r+").attrs["total"] = total
            for name in self.layout.columns:
                lengthen(self.path / name, total)
            self._arrays.clear()
        except OSError as error:
            raise self._failed(error) from error
        self.layout = self.layout._replace(total=total)

    def verify(self, columns: Iterable[str] | None = None) -> None:
        """Compare what is stored with the sums taken when it was written.

        Raises:
            FileError: names a file that is missing, truncated or altered.
        """
        verify(self.path, self.layout, self._known(columns))

    def _known(self, columns: Iterable[str] | None) -> tuple[str, ...]:
        known = tuple(self.layout.columns)
        chosen = known if columns is None else tuple(columns)
        for name in chosen:
            if name not in known:
                near = nearest_names(name, known)
                raise SettingError(f"{self.path} has no column '{name}'.{near}")
        return chosen

    def dataset(self, columns: Iterable[str] | None = None) -> xr.Dataset:
        """The finished samples, lazily, with their numbers as the coordinate "sample".

        Attributes `total` and `finished` say how many there are to be and are. Nothing is read
        before it is asked for; `dataset(...).load()` reads all, `load` verifies it too.

        Args:
            columns: the names of those wanted; default all.
        """
        chosen = self._known(columns)
        others = [name for name in self.layout.columns if name not in chosen]
        whole = xr.open_zarr(
            self.path, consolidated=False, chunks=None, decode_cf=False, drop_variables=others
        )
        begins = [self.layout.chunk * chunk for chunk in sorted(self._stored)]
        spans = [np.arange(k, k + self._stored[k // self.layout.chunk]) for k in begins]
        numbers = np.concatenate([np.zeros(0, np.int64), *spans])
        gapless = not numbers.size or numbers[-1] + 1 == numbers.size
        # a slice reads whole chunks; so long as all from the first are there it says the same
        kept = whole.isel({SAMPLE: slice(0, numbers.size) if gapless else numbers})
        # in the study's order, not in that of the folder
        kept = kept[[name for name in self.layout.columns if name in chosen]]
        words = {"long_name": "number of the sample", "units": "1"}
        return kept.assign_coords({SAMPLE: (SAMPLE, numbers, words)}).assign_attrs(
            total=self.total, finished=int(numbers.size)
        )

    def load(self, columns: Iterable[str] | None = None) -> xr.Dataset:
        """The finished samples in memory, after `verify` of the columns chosen."""
        chosen = self._known(columns)
        self.verify(chosen)
        return self.dataset(chosen).load()


def create(
    path: str | os.PathLike[str],
    work: AbstractWork,
    total: int,
    chunk: int,
    versions: Mapping[str, str] | None = None,
) -> Store:
    """Make the empty store of a study, to write.

    Args:
        total: samples. chunk: samples written together, which stays as it is.
        versions: of what computes the numbers; default this process's `computing_versions`.

    Raises:
        SettingError: numbers below 1, or columns that cannot be stored.
        FileError: there is something at `path` already, or it cannot be written.
    """
    target = Path(path)
    layout = layout_of(work, total, chunk, versions)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise FileError(f"{target} exists; go on with it (resume), or give another name.")
    # a name of its own: of processes that make one store at the same time, one puts its in place
    partial = target.parent / f".{target.name}.{uuid.uuid4().hex}.partial"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        _sweep(target)
        write_layout(partial, layout)
        _put(partial, target)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            raise FileError(f"{target} cannot be made: {error}.") from error
        raise
    return resume_store(target, work, versions)


def _put(partial: Path, target: Path) -> None:
    """Give a new store its name, unless there is one of that name by now."""
    try:
        os.rename(partial, target)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
        raise FileError(
            f"{target} exists: another run has made it just now; go on with it (resume) when that has "
            "ended, or give another name."
        ) from None


def _sweep(target: Path) -> None:
    """Remove what runs that were killed as they made the store have left, long ago."""
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _STALE:
                shutil.rmtree(left, ignore_errors=True)


def open_store(path: str | os.PathLike[str]) -> Store:
    """Open a store to read it, whatever study it is of; its samples may still be coming.

    Raises:
        FileError: no store of a study, one of another format, or damaged descriptions.
    """
    source = Path(path)
    layout, lengths = read_layout(source)
    if set(lengths.values()) != {layout.total}:
        raise FileError(
            f"{source} is being extended to {layout.total} samples, or that was broken off; go on "
            "with the study first."
        )
    return Store(source, layout)


def resume_store(
    path: str | os.PathLike[str], work: AbstractWork, versions: Mapping[str, str] | None = None
) -> Store:
    """Open the store of a work to go on writing it; all that is there is verified.

    Raises:
        FileError: no store, one of another study, format or version (it says what differs), one
            that another run is writing, or files that are missing, truncated or altered.
    """
    source = Path(path)
    read_layout(source)
    lock = _locked(source)
    try:
        layout, lengths = read_layout(source)
        unlike = differences(layout, layout_of(work, layout.total, layout.chunk, versions))
        if unlike:
            more = f"; and {len(unlike) - 8} more" if len(unlike) > 8 else ""
            raise FileError(f"{source} is of another study: {'; '.join(unlike[:8])}{more}.")
        clean(source)
        store = Store(source, layout, lock)
        for name, length in lengths.items():
            if length > layout.total:
                raise FileError(
                    f"{source / name / 'zarr.json'} was altered: it has {length} samples."
                )
        if min(lengths.values()) < layout.total:
            store.extend(layout.total)
        store.verify()
    except BaseException:
        with contextlib.suppress(OSError):
            os.close(lock)
        raise
    return store


def _locked(path: Path) -> int:
    """A handle that keeps other runs from writing until it is closed or the process ends."""
    handle = os.open(path, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise FileError(f"{path} is being written by another run.") from None
    except (ImportError, OSError):
        # there are file systems without locks; two runs would do the same work, no more
        pass
    return handle
