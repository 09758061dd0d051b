"""Chunks on disk: their files and contents, and the records of the complete ones.

A record is the description of an empty Zarr group, records/<chunk>/zarr.json: the number of the
chunk's samples in its files, and for each column the SHA-256 of these samples' bytes. It is written
atomically after the files, so that a chunk either has its record and is complete, or counts as
missing. The bytes of recorded samples never change, and more may only be appended: a record stays
true while a last chunk is filled up, even if that is interrupted.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

import numpy as np

from .layout import RECORDS, Layout, check_inside, read_node
from .netcdf import FileError, write_atomically

_AGAIN = "To have the chunk computed again, delete {folder} and go on with the study."


class ChunkRecord(NamedTuple):
    """Record of a chunk: number of its complete samples, and the SHA-256 of each column."""

    samples: int
    sums: Mapping[str, str]


def chunk_file(path: Path, layout: Layout, name: str, chunk: int) -> Path:
    """Path of the file with a column's numbers of a chunk."""
    return path.joinpath(name, "c", str(chunk), *("0" for _ in layout.columns[name].dims))


def write_record(path: Path, chunk: int, record: ChunkRecord) -> None:
    """Record a chunk as complete, atomically."""
    node = {
        "attributes": {"samples": record.samples, "sha256": dict(record.sums)},
        "zarr_format": 3,
        "node_type": "group",
    }
    content = (json.dumps(node, indent=2) + "\n").encode()
    write_atomically(path / RECORDS / str(chunk) / "zarr.json", content)


def read_records(path: Path, layout: Layout) -> Iterator[tuple[int, ChunkRecord]]:
    """Numbers and records of the complete chunks, one after another.

    Raises:
        FileError: a record is damaged or does not belong to this store.
    """
    for file in sorted((path / RECORDS).glob("*/zarr.json")):
        check_inside(path, file.parent)
        attributes = read_node(file.parent)["attributes"]
        samples, sums = attributes.get("samples"), attributes.get("sha256")
        name = file.parent.name
        chunk = int(name) if name.isdecimal() and len(name) < 20 else -1
        fits = (
            0 <= chunk < layout.chunks
            and isinstance(samples, int)
            and not isinstance(samples, bool)
            and 1 <= samples <= size(layout, chunk)
            and isinstance(sums, dict)
            and set(sums) == set(layout.columns)
        )
        if not fits:
            again = _AGAIN.format(folder=file.parent)
            raise FileError(f"{file} is damaged or not of this store. {again}")
        yield chunk, ChunkRecord(samples, sums)


def size(layout: Layout, chunk: int) -> int:
    """Number of samples in a chunk; the last chunk may have fewer."""
    return min(layout.chunk, layout.total - chunk * layout.chunk)


def read_samples(path: Path, layout: Layout, name: str, chunk: int, samples: int) -> bytes:
    """Bytes of a chunk's first samples, after a check of the file.

    Raises:
        FileError: the file is missing, truncated or altered.
    """
    import google_crc32c

    file = chunk_file(path, layout, name, chunk)
    again = _AGAIN.format(folder=path / RECORDS / str(chunk))
    item = np.dtype(layout.columns[name].dtype).itemsize * int(np.prod(layout.row(name), dtype=int))
    wanted = layout.chunk * item + 4
    try:
        if not file.is_file():
            what = "is no file" if file.exists() else "is missing"
            raise FileError(
                f"There is no file {file}, though its chunk was complete: it {what}. {again}"
            )
        if file.stat().st_size != wanted:
            raise FileError(f"{file} has {file.stat().st_size} bytes instead of {wanted}. {again}")
        content = file.read_bytes()
    except OSError as error:
        raise FileError(f"{file} cannot be read: {error.strerror}. {again}") from error
    if len(content) != wanted:
        raise FileError(f"{file} has {len(content)} bytes instead of {wanted}. {again}")
    if google_crc32c.value(content[:-4]) != int.from_bytes(content[-4:], "little"):
        raise FileError(f"{file} was altered: its CRC-32C is another. {again}")
    return content[: samples * item]


def verify(path: Path, layout: Layout, names: Iterable[str]) -> None:
    """Compare the files of complete chunks with their records.

    Raises:
        FileError: a file is missing, truncated or altered; the message names the first.
    """
    names = tuple(names)
    for chunk, record in read_records(path, layout):
        for name in names:
            content = read_samples(path, layout, name, chunk, record.samples)
            if hashlib.sha256(content).hexdigest() != record.sums[name]:
                file, folder = chunk_file(path, layout, name, chunk), path / RECORDS / str(chunk)
                again = _AGAIN.format(folder=folder)
                raise FileError(
                    f"{file} or {folder / 'zarr.json'} was altered: the SHA-256 differs. {again}"
                )


def flush(files: Iterable[Path]) -> None:
    """Wait until files are on the disk, so that no record can precede them."""

    def one(file: Path) -> None:
        with open(file, "rb+") as opened:
            os.fsync(opened.fileno())

    # in parallel, since a disk can serve many requests at once
    with ThreadPoolExecutor(8) as pool:
        for _ in pool.map(one, files):
            pass


def clean(path: Path) -> None:
    """Remove the temporary files of interrupted writes."""
    for file in path.rglob("*"):
        if file.name.endswith(".partial") or file.name.startswith(".zarr.json."):
            file.unlink()
