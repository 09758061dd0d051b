"""Layout of a store: identity, versions, columns and axes of its study, and lengths of its arrays.

A store is a Zarr folder (format 3). The layout is read from the attributes of the root and of each
array. A chunk of an array consists of plain numbers in little-endian order and a CRC-32C behind
them, without compression and Python objects; arrays stored in any other way are refused unread.
"""

import contextlib
import functools
import importlib.metadata
import json
import platform
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..checks.errors import SettingError
from ..checks.schema import named, shown
from ..montecarlo.schema import MOST, check_count
from ..montecarlo.work import FINE, MISSING, AbstractWork, Axis, Column
from .netcdf import FileError, versions as _versions, write_atomically

FORMAT = "stmuav_jax study"
FORMAT_VERSION = 1
SAMPLE = "sample"
RECORDS = "records"

# Largest size of a zarr.json in bytes; that of the root may contain a table of 10^5 numbers.
_LONGEST_NODE = 100_000_000

_TYPES = {f"{kind}{bits}" for kind in ("int", "uint") for bits in (8, 16, 32, 64)}
_TYPES |= {"float32", "float64", "complex64", "complex128", "bool"}


class Layout(NamedTuple):
    """Description of a study in its store.

    Attributes:
        total: number of samples.
        chunk: number of samples that are written together.
        identity: plain data of everything on which the numbers depend.
        versions: versions of the software and processor that compute them.
        columns, axes, reasons: as in `AbstractWork`.
    """

    total: int
    chunk: int
    identity: Mapping[str, Any]
    versions: Mapping[str, str]
    columns: Mapping[str, Column]
    axes: Mapping[str, Axis]
    reasons: Mapping[int, str]

    @property
    def chunks(self) -> int:
        """Number of chunks of the study."""
        return -(-self.total // self.chunk)

    def row(self, name: str) -> tuple[int, ...]:
        """Shape of a column in one sample."""
        return tuple(len(self.axes[dim].values) for dim in self.columns[name].dims)

    @property
    def sample_bytes(self) -> int:
        """Bytes of all columns in one sample."""
        return sum(
            np.dtype(column.dtype).itemsize * int(np.prod(self.row(name), dtype=int))
            for name, column in self.columns.items()
        )


def computing_versions() -> dict[str, str]:
    """Versions on which numbers may depend: the package, its numerical libraries, the device."""
    found = _versions() | {"scipy": importlib.metadata.version("scipy")}
    found["processor"] = processor()
    return {name: version for name, version in found.items() if name not in ("python", "xarray")}


@functools.cache
def processor() -> str:
    """Architecture of the processor and its vector instructions.

    Compilers choose instructions by them, and the last digits of results depend on the choice.
    """
    flags: set[str] = set()
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.partition(":")[0].strip() in ("flags", "Features"):
                flags = set(line.partition(":")[2].split())
                break
    vector = ("avx", "avx2", "fma", "avx512f", "avx512dq", "avx512vl", "asimd", "sve", "sve2")
    return " ".join([platform.machine() or "unknown", *(x for x in vector if x in flags)])


def layout_of(
    work: AbstractWork, total: int, chunk: int, versions: Mapping[str, str] | None = None
) -> Layout:
    """Layout of the store of a work.

    Raises:
        SettingError: numbers of samples below 1, or columns that a store cannot hold.
    """
    for what, count in (("A study's samples", total), ("A chunk's samples", chunk)):
        check_count(count, what)
    _check_columns(work.columns, work.axes)
    try:
        identity = json.loads(json.dumps(dict(work.identity)))
    except (TypeError, ValueError) as error:
        raise SettingError(f"A study's identity must be plain data for JSON: {error}.") from None
    return Layout(
        total, chunk, identity, dict(computing_versions() if versions is None else versions),
        dict(work.columns), dict(work.axes), dict(work.reasons),
    )  # fmt: skip


def _check_columns(columns: Mapping[str, Column], axes: Mapping[str, Axis]) -> None:
    status = columns.get("status")
    if status is None or status[0] != "int8" or status.role != "status" or status.dims:
        raise SettingError("A study needs a column 'status' of type int8, that role and no axes.")
    for name in (*columns, *axes):
        if (
            not name.isidentifier()
            or name in (SAMPLE, RECORDS)
            or (name in columns) & (name in axes)
        ):
            raise SettingError(
                f"'{name}' cannot name a column or an axis: letters, digits and _ can, "
                f"except '{SAMPLE}' and '{RECORDS}', and each once."
            )
    for name, column in columns.items():
        if column.dtype not in _TYPES:
            raise SettingError(f"Column '{name}' has type {column.dtype}; numbers can be stored.")
        unknown = [dim for dim in column.dims if dim not in axes]
        if unknown:
            raise SettingError(f"Column '{name}' has axes that are not given: {unknown}.")
    for name, axis in axes.items():
        values = np.asarray(axis.values)
        if values.ndim != 1 or not values.size or values.dtype.name not in _TYPES:
            raise SettingError(
                f"Axis '{name}' needs numbers (k,), not {values.dtype} {values.shape}."
            )


def _missing(column: Column) -> Any:
    """Fill value of a column where a sample is missing."""
    kind = np.dtype(column.dtype).kind
    if column.role == "status":
        return MISSING
    if kind in "fc":
        return np.nan
    if kind == "b":
        return False
    limits = np.iinfo(column.dtype)
    return limits.min if kind == "i" else limits.max


def write_layout(folder: Path, layout: Layout) -> None:
    """Create the store's root and its empty arrays in a folder that does not exist yet."""
    import zarr
    from zarr.codecs import Crc32cCodec

    attributes = {
        "format": FORMAT,
        "format_version": FORMAT_VERSION,
        "total": layout.total,
        "chunk": layout.chunk,
        "columns": list(layout.columns),
        "axes": list(layout.axes),
        "identity": json.dumps(layout.identity),
        "versions": json.dumps(layout.versions),
        "reasons": json.dumps({str(code): words for code, words in layout.reasons.items()}),
    }
    group = zarr.create_group(str(folder), zarr_format=3, attributes=attributes)
    group.create_group(RECORDS, attributes={"long_name": "what has been written whole, by chunk"})
    plain: dict[str, Any] = {"filters": None, "compressors": [Crc32cCodec()]}
    for name, column in layout.columns.items():
        row = layout.row(name)
        about: dict[str, Any] = {
            "units": column.unit,
            "long_name": column.words,
            "role": column.role,
        }
        if column.role == "status":
            codes = {MISSING: "missing", FINE: "fine"} | dict(layout.reasons)
            about["meanings"] = json.dumps({str(code): words for code, words in codes.items()})
        group.create_array(
            name, shape=(layout.total, *row), chunks=(layout.chunk, *row), dtype=column.dtype,
            fill_value=_missing(column), dimension_names=[SAMPLE, *column.dims],
            attributes=about, **plain,
        )  # fmt: skip
    for name, axis in layout.axes.items():
        values = np.asarray(axis.values)
        about: dict[str, Any] = {"units": axis.unit, "long_name": name}
        array = group.create_array(
            name, shape=values.shape, chunks=values.shape, dtype=values.dtype.name,
            dimension_names=[name], attributes=about, config={"write_empty_chunks": True}, **plain,
        )  # fmt: skip
        array[:] = values


def read_node(folder: Path) -> dict[str, Any]:
    """Content of a folder's zarr.json.

    Raises:
        FileError: the file is missing or damaged.
    """
    file = folder / "zarr.json"
    try:
        if file.exists() and not file.is_file():
            raise FileError(f"{file} is no file; the store was altered.")
        if file.stat().st_size > _LONGEST_NODE:
            raise FileError(f"{file} is longer than the description of any study.")
        found = json.loads(file.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileError(f"There is no file {file}.") from None
    except FileError:
        raise
    except RecursionError:
        raise FileError(f"{file} is nested too deeply; it was altered.") from None
    except (OSError, ValueError) as error:
        raise FileError(f"{file} is truncated, damaged or of another kind: {error}.") from None
    fine = isinstance(found, dict) and isinstance(found.get("attributes"), dict)
    kind = (found.get("zarr_format"), found.get("node_type")) if fine else None
    if kind not in ((3, "group"), (3, "array")):
        raise FileError(f"{file} is not the description of a Zarr array or group.")
    return found


def read_layout(path: Path) -> tuple[Layout, dict[str, int]]:
    """Layout of the store in a folder, and the length of each column's array.

    Raises:
        FileError: no store of a study, one of another format, or damaged descriptions.
    """
    if not (path / "zarr.json").is_file():
        what = "holds no store of a study" if path.is_dir() else (
            "is no folder, as a study's store is" if path.exists() else "does not exist"
        )  # fmt: skip
        raise FileError(f"{path} {what}.")
    head = read_node(path)["attributes"]
    if head.get("format") != FORMAT:
        raise FileError(f"{path} is a Zarr folder, but not a study's store.")
    if head.get("format_version") != FORMAT_VERSION:
        raise FileError(
            f"{path} has format version {head.get('format_version')}; this package reads version "
            f"{FORMAT_VERSION}."
        )
    check_inside(path, path / RECORDS)
    read_node(path / RECORDS)
    try:
        total, chunk = (_whole(path, head, name) for name in ("total", "chunk"))
        texts = {key: json.loads(head[key]) for key in ("identity", "versions", "reasons")}
        reasons = {int(code): str(words) for code, words in texts["reasons"].items()}
        # all descriptions are checked before a number is read
        nodes = {str(n): _plain_array(path, str(n)) for n in (*head["axes"], *head["columns"])}
        axes = {name: _read_axis(path, name, nodes[name]) for name in head["axes"]}
        found = {n: _read_column(path, n, nodes[n], chunk, axes) for n in head["columns"]}
    except (
        KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError, RecursionError
    ) as error:  # fmt: skip
        if isinstance(error, FileError):
            raise
        why = shown(repr(error))
        raise FileError(f"{path / 'zarr.json'} is damaged: {why}.") from None
    columns = {name: column for name, (column, _) in found.items()}
    layout = Layout(total, chunk, texts["identity"], texts["versions"], columns, axes, reasons)
    return layout, {name: length for name, (_, length) in found.items()}


def _whole(path: Path, head: Mapping[str, Any], name: str) -> int:
    """Number of samples from the root's attributes, checked."""
    value = head[name]
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MOST:
        raise FileError(
            f"{path / 'zarr.json'} is damaged: '{name}' must be a whole number from 1 to {MOST:,}, but "
            f"it is {shown(value)}."
        )
    return value


def check_inside(path: Path, folder: Path) -> None:
    """Refuse a link within a store, through which files outside of it would be read and written.

    Raises:
        FileError: the folder is a link.
    """
    if folder.is_symlink():
        raise FileError(f"{folder} is a link; all of a store lies within {path}. It was altered.")


def lengthen(folder: Path, total: int) -> None:
    """Increase the number of samples in an array's description; chunks are not touched."""
    node = read_node(folder)
    if node["shape"][0] >= total:
        return
    node["shape"][0] = total
    write_atomically(folder / "zarr.json", json.dumps(node, indent=2).encode())


def _plain_array(path: Path, name: str) -> dict[str, Any]:
    """Description of an array whose chunks are plain numbers; others are refused."""
    if not name.isidentifier():
        raise FileError(
            f"{path / 'zarr.json'} is damaged: {named(name)} names no array of a study."
        )
    check_inside(path, path / name)
    check_inside(path, path / name / "c")
    node = read_node(path / name)
    codecs = node.get("codecs")
    simple = (
        node["node_type"] == "array"
        and "fill_value" in node
        and isinstance(codecs, list)
        and [codec.get("name") for codec in codecs] == ["bytes", "crc32c"]
        and codecs[0].get("configuration", {}).get("endian", "little") == "little"
        and isinstance(node.get("shape"), list)
        and all(type(n) is int and 0 <= n <= MOST for n in node["shape"])
    )
    if str(node.get("data_type")) not in _TYPES or not simple:
        raise FileError(
            f"{path / name / 'zarr.json'} describes {shown(node.get('data_type'))} of shape "
            f"{shown(node.get('shape'))} stored by {shown(codecs)}, "
            "which no store of a study holds; it was altered, and nothing of it was read."
        )
    return node


def _read_column(
    path: Path, name: str, node: Mapping[str, Any], chunk: int, axes: Mapping[str, Axis]
) -> tuple[Column, int]:
    about, dims = node["attributes"], tuple(node["dimension_names"][1:])
    column = Column(node["data_type"], about["units"], about["long_name"], about["role"], dims)
    row = [len(axes[dim].values) for dim in dims]
    fine = node["shape"][1:] == row and node["dimension_names"][0] == SAMPLE
    if not fine or node["chunk_grid"]["configuration"]["chunk_shape"] != [chunk, *row]:
        raise FileError(f"{path / name / 'zarr.json'} does not fit {path / 'zarr.json'}.")
    return column, int(node["shape"][0])


def _read_axis(path: Path, name: str, node: Mapping[str, Any]) -> Axis:
    import zarr

    file, shape = path / name / "c" / "0", node["shape"]
    if not file.is_file():
        # zarr would take the missing file for a chunk of fill values
        raise FileError(f"There is no file {file}; the store was altered.")
    item = np.dtype(node["data_type"]).itemsize
    # one chunk holds the whole axis, so that an altered shape is detected before anything is read
    chunks, dims = node["chunk_grid"]["configuration"]["chunk_shape"], node["dimension_names"]
    one = (len(shape), chunks, dims) == (1, shape, [name])
    if not one or file.stat().st_size != shape[0] * item + 4:
        raise FileError(f"{path / name / 'zarr.json'} does not fit {file}; the store was altered.")
    try:
        values = np.asarray(zarr.open_array(str(path / name), mode="r")[:])
    except (OSError, ValueError) as error:
        raise FileError(f"{file} is truncated or altered: {error}.") from None
    return Axis(values, node["attributes"]["units"])


def flattened(value: Any, name: str = "", left_out: Any = None) -> Iterator[tuple[str, Any]]:
    """Entries of nested tables, but of the one left out, by dotted names; {} is an entry."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items() if value is not left_out else ():
            yield from flattened(inner, f"{name}.{key}" if name else str(key), left_out)
    else:
        yield name, value


def _deciding(layout: Layout) -> dict[str, Any]:
    """Entries that must agree between two parts of one study, by dotted names."""
    columns = {
        name: {"dtype": c.dtype, "unit": c.unit, "role": c.role, "axes": list(c.dims)}
        for name, c in layout.columns.items()
    }
    axes = {
        name: {"values": np.asarray(axis.values).tolist(), "unit": axis.unit}
        for name, axis in layout.axes.items()
    }
    more = {"column": columns, "axis": axes, "reason": layout.reasons, "version": layout.versions}
    return dict(flattened(layout.identity)) | dict(flattened(more))


def differences(there: Layout, here: Layout) -> list[str]:
    """Differences between a store and a study, such as 'seed is 1 there and 2 here'."""
    one, two = _deciding(there), _deciding(here)
    show = lambda side, key: _short(side[key]) if key in side else "not given"
    return [
        f"{key} is {show(one, key)} there and {show(two, key)} here"
        for key in dict.fromkeys([*one, *two])
        # compared as text, since NaN does not equal itself
        if json.dumps(one.get(key)) != json.dumps(two.get(key)) or (key in one) != (key in two)
    ]


def _short(value: Any) -> str:
    words = json.dumps(value)
    return words if len(words) <= 60 else f"{words[:57]}..."
