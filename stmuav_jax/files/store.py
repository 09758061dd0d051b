"""Store of a study's results on disk, chunk by chunk, so that a run can be interrupted and resumed.

The folder is a Zarr group (format 3) that xarray reads:
`xarray.open_zarr(path, consolidated=False)`. Missing samples are NaN, and 0 in the column "status".
The content does not depend on time, or on the order or the process in which chunks were computed.
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
from typing import Any

import numpy as np
import xarray as xr

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import shown
from ..montecarlo.schema import check_count
from ..montecarlo.work import AbstractWork
from .chunks import (
    ChunkRecord,
    chunk_file,
    clean,
    flush,
    read_records,
    read_samples,
    size,
    verify,
    write_record,
)
from .layout import SAMPLE, Layout, differences, layout_of, lengthen, read_layout, write_layout
from .netcdf import FileError

# Seconds without a change after which an unfinished store counts as left by a killed run.
_STALE = 3600.0


class Store:
    """Store of a study; made by `create`, `resume_store` (to write) or `open_store` (to read).

    Attributes:
        path: folder of the store.
        layout: samples, identity, versions, columns, axes and reasons.
    """

    def __init__(self, path: Path, layout: Layout, lock: int | None = None) -> None:
        self.path, self.layout = path, layout
        self._lock = lock
        # samples of each chunk; checksums stay on disk, else memory would grow with the study
        self._stored = {chunk: record.samples for chunk, record in read_records(path, layout)}
        self._finished = sum(self._stored.values())
        self._arrays: dict[str, Any] = {}

    def __enter__(self) -> "Store":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release the lock, so that another run may write the store."""
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    @property
    def total(self) -> int:
        """Number of samples of the study."""
        return self.layout.total

    @property
    def finished(self) -> int:
        """Number of stored samples."""
        return self._finished

    @property
    def pending(self) -> tuple[int, ...]:
        """Chunks with missing samples; `waiting` gives them one by one."""
        return tuple(self.waiting())

    def waiting(self) -> Iterator[int]:
        """Chunks with missing samples, one by one, since a study may have very many."""
        return (chunk for chunk in range(self.layout.chunks) if self.todo(chunk)[1])

    def todo(self, chunk: int) -> tuple[int, int]:
        """Number of the first missing sample of a chunk, and the count of missing ones."""
        if not 0 <= chunk < self.layout.chunks:
            raise SettingError(f"There is no chunk {chunk} among {self.layout.chunks}.")
        done = self._stored.get(chunk, 0)
        return chunk * self.layout.chunk + done, size(self.layout, chunk) - done

    def write(self, chunk: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Store the samples of `todo(chunk)`: either all or none.

        Args:
            arrays: columns (count, ...) by name.

        Raises:
            SettingError: columns of other names, shapes or types, or a chunk that is complete.
            FileError: the disk is full or fails; chunks written before are kept.
        """
        first, count = self.todo(chunk)
        done = first - chunk * self.layout.chunk
        values = self._fitting(arrays, first, count)
        try:
            sums = {}
            # the status is written last: where it is set, the other columns are complete
            for name in sorted(values, key="status".__eq__):
                digest = hashlib.sha256()
                if done:
                    digest.update(read_samples(self.path, self.layout, name, chunk, done))
                else:
                    # a file of an interrupted write; zarr would read it to fill up a last chunk
                    chunk_file(self.path, self.layout, name, chunk).unlink(missing_ok=True)
                self._array(name)[first : first + count] = values[name]
                digest.update(values[name].astype(values[name].dtype.newbyteorder("<")).tobytes())
                sums[name] = digest.hexdigest()
            flush(chunk_file(self.path, self.layout, name, chunk) for name in values)
            write_record(self.path, chunk, ChunkRecord(done + count, sums))
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
            # else a chunk of fill values only would have no file
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
        """Extend the store to more samples; those stored stay as they are.

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
            # the total is written first, so that a resumed run completes the extension
            zarr.open_group(str(self.path), mode="r+").attrs["total"] = total
            for name in self.layout.columns:
                lengthen(self.path / name, total)
            self._arrays.clear()
        except OSError as error:
            raise self._failed(error) from error
        self.layout = self.layout._replace(total=total)

    def verify(self, columns: Iterable[str] | None = None) -> None:
        """Compare the stored columns with the checksums taken when they were written.

        Raises:
            FileError: a file is missing, truncated or altered; the message names it.
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
        """Dataset of the finished samples, read lazily, with their numbers as coordinate "sample".

        Attributes `total` and `finished` are the numbers of samples of the study and of finished
        ones. `dataset(...).load()` reads all of them; `load` verifies them too.

        Args:
            columns: names of the wanted columns; default all.
        """
        chosen = self._known(columns)
        others = [name for name in self.layout.columns if name not in chosen]
        # columns are in the study's order, not in that of the folder
        order = [name for name in self.layout.columns if name in chosen]
        how: Any = {"consolidated": False, "chunks": None, "decode_cf": False}
        try:
            whole = xr.open_zarr(self.path, drop_variables=others, **how)[order]
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            why = shown(str(error))
            raise FileError(f"A description in {self.path} is damaged: {why}.") from error
        begins = [self.layout.chunk * chunk for chunk in sorted(self._stored)]
        spans = [np.arange(k, k + self._stored[k // self.layout.chunk]) for k in begins]
        numbers = np.concatenate([np.zeros(0, np.int64), *spans])
        gapless = not numbers.size or numbers[-1] + 1 == numbers.size
        # a slice reads whole chunks, and is equivalent while no sample is missing in between
        kept = whole.isel({SAMPLE: slice(0, numbers.size) if gapless else numbers})
        words = {"long_name": "number of the sample", "units": "1"}
        return kept.assign_coords({SAMPLE: (SAMPLE, numbers, words)}).assign_attrs(
            total=self.total, finished=int(numbers.size)
        )

    def load(self, columns: Iterable[str] | None = None) -> xr.Dataset:
        """Dataset of the finished samples in memory, after `verify` of the chosen columns."""
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
    """Create the empty store of a study and open it to write.

    Args:
        path: folder of the store.
        work: work of the study.
        total: number of samples.
        chunk: number of samples written together, which cannot be changed later.
        versions: versions that compute the numbers; default `computing_versions` of this process.

    Raises:
        SettingError: numbers below 1, or columns that cannot be stored.
        FileError: there is something at `path` already, or it cannot be written.
    """
    target = Path(path)
    layout = layout_of(work, total, chunk, versions)
    if target.exists() and not (target.is_dir() and not any(target.iterdir())):
        raise FileError(f"{target} exists; go on with it (resume), or give another name.")
    # a unique name: of processes that create the same store at once, one renames its own
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
    """Give a new store its name, unless another one has that name by now."""
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
    """Remove old remains of runs that were killed while they created the store."""
    for left in target.parent.glob(f".{glob.escape(target.name)}.*.partial"):
        with contextlib.suppress(OSError):
            if time.time() - left.stat().st_mtime > _STALE:
                shutil.rmtree(left, ignore_errors=True)


def open_store(path: str | os.PathLike[str]) -> Store:
    """Open a store of any study to read it, even while another run writes it.

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
    """Open the store of a work to continue writing it; its content is verified.

    Raises:
        FileError: no store; a store of another study, format or version (the message says what
            differs); one that another run is writing; or files missing, truncated or altered.
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
    """Handle that keeps other runs from writing until it is closed or the process ends."""
    handle = os.open(path, os.O_RDONLY)
    try:
        import fcntl

        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise FileError(f"{path} is being written by another run.") from None
    except (ImportError, OSError):
        # some file systems have no locks; two runs would then do the same work twice
        pass
    return handle
