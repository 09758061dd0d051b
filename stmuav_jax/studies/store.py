"""Store of a study's results: a Zarr group on disk, written chunk by chunk, so that a run can be resumed.

xarray reads the folder: `xarray.open_zarr(path, consolidated=False)`. Missing samples are NaN, and 0
in the column "status". Zarr writes each chunk of a column as one file, atomically and with a CRC-32C;
the status is written last, so that where it is set the other columns are complete. The content
depends neither on time nor on the order or the process in which chunks were computed.
"""

import contextlib
import errno
import functools
import itertools
import json
import os
import platform
import shutil
import uuid
from collections.abc import Iterator, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr
from zarr.codecs import Crc32cCodec

from ..checks.errors import SettingError
from ..checks.schema import format_value
from ..checks.sources import source_digest
from ..io.netcdf import FileError, flatten_tables, list_versions as package_versions
from ..math.native.program import describe_code
from .columns import FINE, MISSING, Column
from .schema import check_count

FORMAT, FORMAT_VERSION = "stmuav_jax study", 2
SAMPLE = "sample"
# Longest text of a value in a message.
_SHOWN_TEXT = 60


def computing_versions() -> dict[str, str]:
    """Versions and sources on which numbers may depend: the package, its libraries, the processor.

    Raises:
        SettingError: the package's sources were changed after this process imported them.
    """
    libraries = ("jax", "jaxlib", "diffrax", "equinox", "lineax", "optimistix", "numpy", "scipy")
    return {
        **{name: package_versions()[name] for name in ("stmuav-jax", "device")},
        **{name: version(name) for name in libraries},
        "processor": describe_processor(), "sources": source_digest(), "equations": describe_code(),
    }  # fmt: skip


@functools.cache
def describe_processor() -> str:
    """Architecture of the processor and its vector instructions, on which the last digits depend."""
    flags: set[str] = set()
    # Only Linux has this file; elsewhere the architecture alone stands for the processor.
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.partition(":")[0].strip() in ("flags", "Features"):
                flags = set(line.partition(":")[2].split())
                break
    # Vector instructions decide the order of sums and with it the last digits; the model of the processor
    # does not.
    vector = ("avx", "avx2", "fma", "avx512f", "avx512dq", "avx512vl", "asimd", "sve", "sve2")
    return " ".join([platform.machine() or "unknown", *(x for x in vector if x in flags)])


class Store:
    """Store of a study; made by `create_store`, `resume_store` (to write) or `open_store` (to read).

    Attributes:
        path: folder of the store.
        chunk: number of samples that are written together.
        columns: names of the columns, in the study's order.
        versions: versions of the software and the processor that compute the numbers.
    """

    def __init__(self, path: Path, lock: int | None = None) -> None:
        self.path, self._lock = path, lock
        try:
            # a chunk of fill values only would otherwise have no file, as a missing one
            with zarr.config.set({"array.write_empty_chunks": True}):
                self._group = zarr.open_group(str(path), mode="r" if lock is None else "r+")
                attributes: Any = self._group.attrs
                if attributes.get("format") != FORMAT:
                    raise FileError(f"{path} is a Zarr folder, but not a study's store.")
                if attributes["format_version"] != FORMAT_VERSION:
                    raise FileError(
                        f"{path} has format version {attributes['format_version']}; this package "
                        f"reads version {FORMAT_VERSION}."
                    )
                self.chunk = check_count(attributes["chunk"], "A chunk's samples")
                self.columns = tuple(str(name) for name in attributes["columns"])
                self.versions: dict[str, str] = json.loads(attributes["versions"])
                axes = json.loads(attributes["layout"])["axis"]
                self._axes: dict[str, Any] = {name: self._group[name] for name in axes}
                self._arrays: dict[str, Any] = {name: self._group[name] for name in self.columns}
            self.total = check_count(attributes["total"], "A study's samples")
            # A reader cannot complete an extension, and columns of several lengths make no dataset;
            # a writer completes it in `resume_store`.
            lengths = {array.shape[0] for array in self._arrays.values()}
            if lock is None and lengths != {self.total}:
                raise FileError(
                    f"{path} is being extended to {self.total} samples, or that was broken off: "
                    "resume the study first."
                )
            # The status of a sample is written last: what it marks as stored is complete.
            status = np.zeros(self.total, np.int8)
            stored = np.asarray(self._arrays["status"][:])
            status[: len(stored)] = stored[: self.total]
        except (FileNotFoundError, NotADirectoryError):
            kind = "holds no store of a study" if path.is_dir() else (
                "is no folder, as a study's store is" if path.exists() else "does not exist"
            )  # fmt: skip
            raise FileError(f"{path} {kind}.") from None
        except FileError:
            raise
        except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
            raise FileError(f"{path} is damaged: {format_value(str(error))}.") from None
        self._is_stored = status != MISSING

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
    def finished(self) -> int:
        """Number of stored samples."""
        return int(np.count_nonzero(self._is_stored))

    def pending(self) -> Iterator[tuple[int, int]]:
        """First missing sample and number of missing samples of each unfinished chunk, in order."""
        for start in range(0, self.total, self.chunk):
            stop = min(start + self.chunk, self.total)
            first = start + int(np.count_nonzero(self._is_stored[start:stop]))
            if first < stop:
                yield first, stop - first

    def write(self, first: int, arrays: Mapping[str, np.ndarray]) -> None:
        """Store the missing samples of a chunk: either all or none.

        Args:
            first: number of the first of them, as in `pending`.
            arrays: columns (count, ...) by name.

        Raises:
            SettingError: columns of other names, shapes or types than the study declares.
            FileError: the disk is full or fails, or the folder is gone; chunks written before are kept.
        """
        if self._lock is None:
            raise SettingError(f"{self.path} is open for reading only.")
        if set(arrays) != set(self.columns):
            raise SettingError(
                f"A chunk has the columns {sorted(arrays)}, but the study declares {sorted(self.columns)}."
            )
        last = first + len(arrays["status"])
        for name, values in arrays.items():
            # Zarr casts an array of another type without a word, and the column would then hold
            # other numbers than were computed.
            stated = self._arrays[name]
            shape = (last - first, *stated.shape[1:])
            if (values.dtype, values.shape) != (stated.dtype, shape):
                raise SettingError(
                    f"Samples {first} to {last - 1}: column '{name}' is {values.dtype} {values.shape}, "
                    f"but the study declares {stated.dtype} {shape}."
                )
        self.check_folder()
        try:
            # The status comes after all other columns, so that an interruption leaves a chunk without status and
            # never one with half of its numbers.
            for name in sorted(self.columns, key="status".__eq__):
                self._arrays[name][first:last] = arrays[name]
        except OSError as error:
            self.check_folder()
            raise self._describe_disk(error) from error
        self._is_stored[first:last] = True

    def check_folder(self) -> None:
        """Raise an error if the folder is no longer the one that was opened.

        Zarr would create missing folders again, for chunks that belong to no study.

        Raises:
            FileError: the folder was removed, renamed or replaced, or samples in it were.
        """
        try:
            same = self._lock is None or os.path.samestat(os.stat(self.path), os.fstat(self._lock))
        except FileNotFoundError:
            same = False
        if not same:
            raise FileError(
                f"{self.path} was removed, renamed or replaced while the study ran, when it had "
                f"{self.finished} of {self.total} samples: the run ends. If it was renamed, its "
                "samples are complete there, and the study is resumed under that name."
            )

    def _describe_disk(self, error: OSError) -> FileError:
        advice = "check the disk"
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            advice = "free space on the disk"
        elif error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            advice = "make the folder writable"
        return FileError(
            f"{self.path} cannot be written ({error.strerror or error}); it keeps {self.finished} of "
            f"{self.total} samples. To resume the study, {advice} first."
        )

    def extend(self, total: int) -> None:
        """Extend the store to more samples; those stored stay as they are.

        Raises:
            SettingError: fewer samples than now.
            FileError: the disk is full or fails.
        """
        check_count(total, "A study's samples")
        if total < self.total:
            raise SettingError(
                f"{self.path} has {self.total} samples; a study can grow, not shrink to {total}."
            )
        try:
            # the total is written first, so that a resumed run completes the extension
            self._group.attrs["total"] = total
            for array in self._arrays.values():
                if array.shape[0] < total:
                    array.resize((total, *array.shape[1:]))
        except OSError as error:
            raise self._describe_disk(error) from error
        self._is_stored = np.append(self._is_stored, np.zeros(total - self.total, bool))
        self.total = total

    def verify(self) -> None:
        """Read all axes and all stored chunks of the columns, and check their sums.

        Raises:
            FileError: a file is missing, truncated or altered; the message names it.
        """
        for name, axis in self._axes.items():
            self._check_chunk(name, axis, 0, "The store is damaged.")
        for index, start in enumerate(range(0, self.total, self.chunk)):
            status = self.path / "status" / "c" / str(index)
            advice = f"Delete it and {status} and resume the study to have it computed again."
            if np.any(self._is_stored[start : start + self.chunk]):
                for name in self.columns:
                    self._check_chunk(name, self._arrays[name], index, advice)

    def _check_chunk(self, name: str, array: Any, index: int, advice: str) -> None:
        """Raise `FileError` where a chunk's file is missing, or Zarr finds another sum than it has."""
        key = array.metadata.encode_chunk_key((index, *[0] * (array.ndim - 1)))
        file = self.path / name / key
        # Zarr reads a missing chunk as fill values, so that a lost file would look like missing
        # samples.
        if not file.is_file():
            raise FileError(f"There is no file {file}, though its chunk is complete. {advice}")
        length = array.chunks[0]
        try:
            # Reading is the check: the codec compares the CRC-32C, and the numbers are not needed.
            array[index * length : (index + 1) * length]
        except (OSError, ValueError) as error:
            raise FileError(
                f"{file} was truncated or altered: {format_value(str(error))}. {advice}"
            ) from None

    def dataset(self) -> xr.Dataset:
        """Dataset of the finished samples, read lazily, with their numbers as coordinate "sample".

        Attributes `total` and `finished` are the numbers of samples of the study and of finished
        ones. `dataset().load()` reads all of them; `load` verifies them too.
        """
        settings: Any = {"consolidated": False, "chunks": None, "decode_cf": False}
        try:
            whole = xr.open_zarr(self.path, **settings)[list(self.columns)]
        except (ValueError, TypeError, LookupError, AttributeError, ArithmeticError) as error:
            reason = format_value(str(error))
            raise FileError(f"A description in {self.path} is damaged: {reason}.") from error
        numbers = np.flatnonzero(self._is_stored)
        is_gapless = not numbers.size or numbers[-1] + 1 == numbers.size
        # a slice reads whole chunks, and is equivalent while no sample is missing in between
        stored_samples = whole.isel({SAMPLE: slice(0, numbers.size) if is_gapless else numbers})
        attributes = {"long_name": "number of the sample", "units": "1"}
        return stored_samples.assign_coords({SAMPLE: (SAMPLE, numbers, attributes)}).assign_attrs(
            total=self.total, finished=int(numbers.size)
        )

    def load(self) -> xr.Dataset:
        """Dataset of the finished samples in memory, after `verify`."""
        self.verify()
        return self.dataset().load()


def create_store(
    path: str | os.PathLike[str],
    study: Any,
    total: int,
    chunk: int,
    versions: Mapping[str, str] | None = None,
) -> Store:
    """Create the empty store of a study and open it to write.

    Args:
        study: a `Study`, of which columns, axes, reasons and identity are kept.
        chunk: number of samples written together, which cannot be changed later.
        versions: versions that compute the numbers; default `computing_versions` of this process.

    Raises:
        SettingError: numbers below 1, or columns that cannot be stored.
        FileError: there is something at `path` already, or it cannot be written.
    """
    target = Path(path)
    for subject, count in (("A study's samples", total), ("A chunk's samples", chunk)):
        check_count(count, subject)
    versions = dict(computing_versions() if versions is None else versions)
    description = _describe_study(study, versions)
    check_absent(target)
    # a name of its own: of processes that create one store at once, one renames its own
    partial = target.parent / f".{target.name}.{uuid.uuid4().hex}.partial"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        attributes = {"total": total, "chunk": chunk, **description}
        group = zarr.create_group(str(partial), zarr_format=3, attributes=attributes)
        _write_arrays(group, study, total, chunk)
        # The store appears under its name by one rename when all its arrays exist, so that no other
        # process opens one that is half made.
        os.rename(partial, target)
    except BaseException as error:
        shutil.rmtree(partial, ignore_errors=True)
        if isinstance(error, OSError):
            check_absent(target)
            raise FileError(f"{target} cannot be made: {error}.") from error
        raise
    return resume_store(target, study, versions)


def check_absent(path: Path) -> None:
    """Raise `FileError` where there is anything at a path but an empty folder."""
    if path.exists() and not (path.is_dir() and not any(path.iterdir())):
        raise FileError(f"{path} exists: resume it, or give another name.")


def open_store(path: str | os.PathLike[str]) -> Store:
    """Open a store of any study to read it, even while another run writes it.

    Raises:
        FileError: no store of a study, one of another format, or a damaged one.
    """
    return Store(Path(path))


def resume_store(
    path: str | os.PathLike[str], study: Any, versions: Mapping[str, str] | None = None
) -> Store:
    """Open the store of a study to continue writing it; its content is verified.

    Args:
        versions: versions that compute the numbers; default `computing_versions` of this process.

    Raises:
        FileError: no store; a store of another study, format or version (the message says what
            differs); one that another run is writing; or files missing, truncated or altered.
    """
    source = Path(path)
    with contextlib.ExitStack() as stack:
        # The lock comes before anything is read: another run could otherwise change the store between
        # its verification and the first write.
        lock = _lock_folder(source)
        stack.callback(os.close, lock)
        store = Store(source, lock)
        stored: Any = dict(store._group.attrs)
        present = _describe_study(study, computing_versions() if versions is None else versions)
        if unlike := _list_differences(stored, present):
            more = f"; and {len(unlike) - 8} more" if len(unlike) > 8 else ""
            differences = f"{'; '.join(unlike[:8])}{more}."
            if all(entry.startswith("versions.") for entry in unlike):
                raise FileError(
                    f"{source} was computed by other code, whose samples cannot be mixed with this "
                    f"code's: {differences} Resume it by that code, or give another name."
                )
            raise FileError(f"{source} belongs to another study: {differences}")
        # chunks of a killed process
        for file in source.rglob("*.partial"):
            file.unlink()
        # A run that was broken off while it extended the store has written the new total, but not
        # the length of every array.
        store.extend(store.total)
        store.verify()
        stack.pop_all()
    return store


def _lock_folder(path: Path) -> int:
    """Handle that keeps other runs from writing until it is closed or the process ends."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except OSError as error:
        raise FileError(f"{path} cannot be opened: {error.strerror}.") from None
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


def _describe_study(study: Any, versions: Mapping[str, str]) -> dict[str, Any]:
    """Attributes of a store that identify its study; checks that its columns can be stored.

    Raises:
        SettingError: an identity that is no plain data, or columns that a store cannot hold.
    """
    columns, axes = dict(study.columns), dict(study.axes)
    status = columns.get("status")
    if status is None or (status.dtype, status.role, status.dims) != ("int8", "status", ()):
        raise SettingError("A study needs a column 'status' of type int8, that role and no axes.")
    for name in (*columns, *axes):
        if not name.isidentifier() or name == SAMPLE or (name in columns and name in axes):
            raise SettingError(
                f"'{name}' cannot name a column or an axis: letters, digits and _ can, "
                f"except '{SAMPLE}', and each once."
            )
    for name, column in columns.items():
        if np.dtype(column.dtype).kind not in "fciub":
            raise SettingError(f"Column '{name}' has type {column.dtype}; numbers can be stored.")
        if unknown := [dim for dim in column.dims if dim not in axes]:
            raise SettingError(f"Column '{name}' has axes that are not given: {unknown}.")
    axes = {name: (np.asarray(axis.values), axis.unit) for name, axis in axes.items()}
    for name, (values, _) in axes.items():
        if values.ndim != 1 or not values.size or values.dtype.kind not in "fiu":
            raise SettingError(
                f"Axis '{name}' needs numbers (k,), not {values.dtype} {values.shape}."
            )
    try:
        identity = json.dumps(dict(study.identity))
    except (TypeError, ValueError) as error:
        raise SettingError(f"A study's identity must be plain data for JSON: {error}.") from None
    layout = {
        "column": {n: [c.dtype, c.unit, c.role, list(c.dims)] for n, c in columns.items()},
        "axis": {name: [values.tolist(), unit] for name, (values, unit) in axes.items()},
    }
    return {
        "format": FORMAT, "format_version": FORMAT_VERSION, "columns": list(columns),
        "identity": identity, "versions": json.dumps(dict(versions)), "layout": json.dumps(layout),
        "reasons": json.dumps({str(code): reason for code, reason in study.reasons.items()}),
    }  # fmt: skip


def _write_arrays(group: Any, study: Any, total: int, chunk: int) -> None:
    """Create the empty arrays of the columns, and the axes."""
    plain: dict[str, Any] = {"filters": None, "compressors": [Crc32cCodec()]}
    for name, column in study.columns.items():
        row = row_shape(study, column)
        attributes = {"units": column.unit, "long_name": column.label, "role": column.role}
        # Fill value where a sample is missing. Whole numbers have no NaN, so the end of their range marks a
        # gap: the smallest number, but of unsigned ones, whose smallest is an ordinary 0, the largest.
        kind, fill = np.dtype(column.dtype).kind, {"b": False, "f": np.nan, "c": np.nan}
        if kind in "iu":
            limits = np.iinfo(column.dtype)
            fill = {"i": limits.min, "u": limits.max}
        if column.role == "status":
            fill = {kind: MISSING}
            codes = {MISSING: "missing", FINE: "fine"} | dict(study.reasons)
            attributes["meanings"] = json.dumps({str(code): text for code, text in codes.items()})
        group.create_array(
            name, shape=(total, *row), chunks=(chunk, *row), dtype=column.dtype, fill_value=fill[kind],
            dimension_names=[SAMPLE, *column.dims], attributes=attributes, **plain,
        )  # fmt: skip
    for name, axis in study.axes.items():
        values = np.asarray(axis.values)
        group.create_array(
            name, data=values, chunks=values.shape, dimension_names=[name],
            attributes={"units": axis.unit, "long_name": name}, **plain,
        )  # fmt: skip


def row_shape(study: Any, column: Column) -> tuple[int, ...]:
    """Shape of a column's value for one sample."""
    return tuple(len(study.axes[dim].values) for dim in column.dims)


def _list_differences(stored: Mapping[str, Any], present: Mapping[str, Any]) -> list[str]:
    """Differences between a store and a study, such as 'seed is 1 there and 2 here'."""

    def flatten_attributes(attributes: Mapping[str, Any]) -> dict[str, str]:
        parts = {key: json.loads(attributes[key]) for key in ("layout", "reasons", "versions")}
        entries = json.loads(attributes["identity"]) | parts["layout"] | parts
        # as text, since NaN does not equal itself
        return {key: json.dumps(value) for key, value in dict(flatten_tables(entries)).items()}

    def shorten(text: str, other: str) -> str:
        """Text, of a long one the part around its first difference from another."""
        if len(text) <= _SHOWN_TEXT:
            return text
        same = (a == b for a, b in zip(text, other, strict=False))
        first = max(sum(itertools.takewhile(bool, same)) - _SHOWN_TEXT // 2, 0)
        last = first + _SHOWN_TEXT - 6
        return "..." * (first > 0) + text[first:last] + "..." * (last < len(text))

    stored_entries, present_entries = flatten_attributes(stored), flatten_attributes(present)
    differences = []
    for key in dict.fromkeys([*stored_entries, *present_entries]):
        old = stored_entries.get(key, "not given")
        new = present_entries.get(key, "not given")
        if not key.startswith("layout") and old != new:
            differences.append(f"{key} is {shorten(old, new)} there and {shorten(new, old)} here")
    return differences
