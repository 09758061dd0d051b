"""Files of results, as labelled arrays in NetCDF (HDF5) that are sealed by a checksum; TOML files.

Arrays are written by h5netcdf alone: xarray, which takes a third of a second to import, reads them.
"""

import datetime
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import tempfile
import tomllib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks.errors import ModelError, SettingError
from ..checks.schema import format_value, validate_model

if TYPE_CHECKING:
    import xarray as xr

    from ..mechanics.parameters import Parameters

# Largest size of a TOML file in bytes.
MOST_TOML = 4_000_000

FORMAT = "stmuav_jax run"
FORMAT_VERSION = 2
LOOP_FORMAT, LOOP_VERSION = "stmuav_jax closed loop", 1
# Version of each format that this package reads.
_READ = {FORMAT: FORMAT_VERSION, LOOP_FORMAT: LOOP_VERSION}
# Signals of missions by their names in files of version 0.3.0 and before, which have the same content.
_FORMER_NAMES = {
    **{f"wanted_{name}": f"commanded_{name}" for name in ("force", "effort")},
    **{
        f"wanted_{name}": f"reference_{name}"
        for name in ("position", "heading", "panel_angles", "joint_position")
    },
    "believed_centre_of_mass": "estimated_centre_of_mass",
}

_PACKAGES = ("stmuav-jax", "jax", "jaxlib", "diffrax", "equinox", "lineax", "numpy", "xarray")


# Dimensions, values and attributes of an array.
Parts = tuple[tuple[str, ...], Any, dict[str, str]]


@dataclass(frozen=True)
class Labelled:
    """Arrays with names, dimensions, coordinates and attributes, as in an `xarray.Dataset`.

    Attributes:
        variables: dimensions, values and attributes by name.
        coordinates: the same of coordinates; those with the name of a dimension are its labels.
        attributes: texts and integers.
    """

    variables: Mapping[str, Parts]
    coordinates: Mapping[str, Parts]
    attributes: Mapping[str, str | int]

    def dataset(self) -> "xr.Dataset":
        """Dataset of xarray with the same content."""
        import xarray as xr

        return xr.Dataset(dict(self.variables), dict(self.coordinates), dict(self.attributes))

    def netcdf(self, *, checksums: bool = False) -> bytes:
        """Content of a NetCDF file (HDF5), from which xarray reads `dataset()`.

        Args:
            checksums: add Fletcher's checksum to the numbers, which any reader of HDF5 verifies.
        """
        import h5netcdf
        import h5py

        buffer = io.BytesIO()
        with h5netcdf.File(buffer, "w") as file:
            arrays = {**self.coordinates, **self.variables}
            for dims, values, _ in arrays.values():
                for name, size in zip(dims, np.shape(values), strict=True):
                    if name not in file.dimensions:
                        file.dimensions[name] = size
            for name, (dims, values, attributes) in arrays.items():
                values, about, more = np.asarray(values), dict(attributes), {}
                if values.dtype.kind == "b":
                    # NetCDF has no truth values; xarray's mark for them
                    values, about["dtype"] = values.astype(np.int8), "bool"
                # HDF5 has no checksums of scalars
                if checksums and values.dtype.kind == "f" and values.ndim and values.size:
                    more["fletcher32"] = True
                kind = h5py.string_dtype() if values.dtype.kind in "UO" else values.dtype
                values = values.astype(object) if values.dtype.kind == "U" else values
                variable = file.create_variable(name, dims, kind, data=values, **more)
                for key, value in about.items():
                    variable.attrs[key] = value
            # Coordinates that are not named as their dimension have to be listed, or xarray reads them as
            # variables.
            others = [k for k, (dims, *_) in self.coordinates.items() if (k,) != dims]
            named = {"coordinates": " ".join(others)} if others else {}
            for key, value in {**self.attributes, **named}.items():
                file.attrs[key] = value
        return buffer.getvalue()


class FileError(ValueError):
    """Error for a file that is missing, damaged or of another kind; the message names it."""


def regular_file(path: str | os.PathLike[str]) -> Path:
    """Path of a file that can be read to its end.

    Raises:
        FileError: there is no such file, or it is a folder, a pipe or a device, which may never end.
    """
    source = Path(path)
    try:
        exists, is_file = source.exists(), source.is_file()
    # a forbidden folder, or a name that the system cannot have
    except OSError as error:
        raise FileError(f"{source} cannot be read: {error.strerror}.") from None
    except ValueError as error:
        raise FileError(f"{format_value(str(source))} names no file: {error}.") from None
    if not exists:
        raise FileError(f"There is no file {format_value(str(source))}.")
    if not is_file:
        raise FileError(f"{source} is no file but a folder, a pipe or a device.")
    return source


def list_versions() -> dict[str, str]:
    """Versions of the package, its libraries, Python and the device."""
    import jax  # slow to import, and pages of what was computed are made without it

    package_versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    device = jax.devices()[0]
    return package_versions | {"python": platform.python_version(), "device": device.device_kind}


def utc_now() -> str:
    """Date and time of day in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def label_table(
    table: Mapping[str, tuple[tuple[str, ...], Any, str, str]],
    coordinates: Mapping[str, Any],
    **attributes: Any,
) -> Labelled:
    """Arrays with `units` and `description`, and attributes with versions and date.

    Args:
        table: dimensions, values, unit and description by name.
        coordinates: labels of the dimension of that name; or dimensions, values and attributes.
        attributes: texts and integers; others are kept as JSON.
    """
    data = {
        name: (dims, values, {"units": unit, "description": description})
        for name, (dims, values, unit, description) in table.items()
    }
    about = attributes | {"versions": list_versions()}
    texts = {k: v if isinstance(v, str | int) else json.dumps(v) for k, v in about.items()}
    texts["date"] = utc_now()
    places = {k: v if isinstance(v, tuple) else ((k,), v, {}) for k, v in coordinates.items()}
    return Labelled(data, places, texts)


def save_labelled(arrays: Labelled, path: str | os.PathLike[str]) -> Path:
    """Save labelled arrays as NetCDF (HDF5), atomically; return the path."""
    return write_atomically(path, arrays.netcdf())


def write_atomically(path: str | os.PathLike[str], content: bytes) -> Path:
    """Write a file so that a reader sees the old content or the new, never a part."""
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(dir=target.parent, prefix=f".{target.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content)
                file.flush()
                # Renamed without a flush, the name may survive a power failure and the content not.
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
            # A rename within one folder is atomic: readers see the old file or the new one.
            os.replace(name, target)
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        if error.errno is None:
            raise
        # the error of a full disk does not name the file
        raise OSError(error.errno, error.strerror, str(target)) from error
    return target


# Seal at the end of a file: HDF5 reads no further than the end that its own header names.
_SEAL = b"\nstmuav_jax sha256 "
_SEAL_LENGTH = len(_SEAL) + 64 + 1


def save_sealed(arrays: Labelled, path: str | os.PathLike[str]) -> Path:
    """Save labelled arrays as by `save`, with checksums that `load` verifies."""
    content = arrays.netcdf(checksums=True)
    return write_atomically(path, content + _make_seal(content))


def _make_seal(content: bytes) -> bytes:
    return _SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n"


def is_sealed(path: str | os.PathLike[str]) -> bool:
    """True if a file ends with a seal, as those of `save` do; `load` verifies it."""
    with open(path, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(file.tell() - _SEAL_LENGTH, 0))
        return file.read().startswith(_SEAL)


def _verify_content(source: Path, kind: str = "a run") -> bytes:
    """Content of a file without its seal, verified, as HDF5 and zip are not safe on damaged files."""
    whole = source.read_bytes()
    content, seal = whole[:-_SEAL_LENGTH], whole[-_SEAL_LENGTH:]
    if not seal.startswith(_SEAL):
        raise FileError(
            f"{source} cannot be read: it is truncated, damaged or was changed since it was saved, or is "
            f"not {kind} saved by stmuav_jax."
        )
    if seal != _make_seal(content):
        raise FileError(
            f"{source} cannot be read as {kind}: it is damaged, its SHA-256 is not the one that it "
            "was saved with."
        )
    return content


def save_checkpoint(
    path: str | os.PathLike[str], head: Mapping[str, Any], arrays: Iterable[Any]
) -> Path:
    """Save plain data and arrays as a sealed npz file, atomically; return the path."""
    content = io.BytesIO()
    numbered: dict[str, Any] = {f"{k}": np.asarray(array) for k, array in enumerate(arrays)}
    np.savez(content, allow_pickle=False, head=np.array(json.dumps(dict(head))), **numbered)
    return write_atomically(path, content.getvalue() + _make_seal(content.getvalue()))


def load_checkpoint(
    path: str | os.PathLike[str], kind: str
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Plain data and arrays of a file of `save_checkpoint`.

    Args:
        kind: what the file should be, such as "a search", for the errors.

    Raises:
        FileError: the file is missing, damaged, or of another kind.
    """
    source = regular_file(path)
    content = _verify_content(source, kind)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            head = json.loads(str(archive["head"]))
            arrays = [archive[f"{k}"] for k in range(len(archive.files) - 1)]
        return dict(head), arrays
    # a sealed file of another program may hold anything
    except Exception as error:
        raise FileError(f"{source} is not {kind} ({type(error).__name__}).") from error


def load(path: str | os.PathLike[str]) -> "xr.Dataset":
    """Read a saved run, of a scene or of a closed loop, into memory.

    Raises:
        FileError: the file is missing, truncated, damaged, or not a run of this package.

    Other programs read the file as NetCDF; `xarray.open_dataset(path, engine="h5netcdf")` does.
    """
    import xarray as xr

    source = regular_file(path)
    content = _verify_content(source)
    try:
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as dataset:
            run_data = dataset.load()
    except Exception as error:
        raise FileError(
            f"{source} cannot be read as a saved run: it is truncated, damaged or of another kind "
            f"({type(error).__name__})."
        ) from error
    supported_version = _READ.get(run_data.attrs.get("format", ""))
    if supported_version is None:
        raise FileError(f"{source} is a NetCDF file, but not a run saved by stmuav_jax.")
    version = int(run_data.attrs.get("format_version", 0))
    if version != supported_version:
        raise FileError(
            f"{source} has format version {version}; this package reads version {supported_version}."
        )
    return run_data.rename({old: new for old, new in _FORMER_NAMES.items() if old in run_data})


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Content of a TOML file.

    Raises:
        FileError: the file is missing, a folder or a pipe, longer than 4 MB, nested too deeply, or
            not valid TOML.
    """
    source = regular_file(path)
    try:
        if source.stat().st_size > MOST_TOML:
            raise FileError(
                f"{source} is larger than {MOST_TOML / 1e6:g} MB; long lists of numbers belong in a "
                "CSV file, which a factor can name."
            )
        # some editors begin a file with a byte-order mark
        return tomllib.loads(source.read_text(encoding="utf-8-sig"))
    except RecursionError:
        raise FileError(f"{source} is nested too deeply.") from None
    except FileError:
        raise
    # an integer with more digits than Python reads is a ValueError
    except (OSError, ValueError) as error:
        raise FileError(f"{source} is not a readable TOML file: {error}.") from error


def load_parameters(path: str | os.PathLike[str] | None, base: "Parameters") -> "Parameters":
    """Parameter table with values of `base` replaced by those of a TOML file, if there is one.

    The file's tables and dotted keys are the parameters' names; a value is a number or an
    array, or a table {value = ..., unit = "..."} whose unit must be the parameter's:

        [mass]
        panel_7 = 0.95
        [rotor]
        k_f = {value = 6.6e-6, unit = "N s^2/rad^2"}

    Raises:
        FileError: the file is missing or not valid TOML.
        ModelError: unknown names, wrong shapes or units.
    """
    if path is None:
        return base
    source, content = Path(path), read_toml(path)
    try:
        return base.replaced(_flatten_values(content, base), source=f"given in {source.name}")
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from None


def _flatten_values(
    content: Mapping[str, Any], base: "Parameters", prefix: str = ""
) -> dict[str, Any]:
    from ..mechanics.parameters import ParameterEntry

    values_by_name: dict[str, Any] = {}
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and "value" in value:
            unit = base[name].unit
            try:
                entry = validate_model(ParameterEntry, value, f"'{name}'")
            except SettingError as error:
                raise ModelError(str(error)) from None
            if entry.unit not in (None, unit):
                raise ModelError(
                    f"'{name}' must be given in {unit}, not in {format_value(entry.unit)}."
                )
            values_by_name[name] = entry.value
        elif isinstance(value, Mapping):
            values_by_name |= _flatten_values(value, base, f"{name}.")
        else:
            values_by_name[name] = value
    return values_by_name


def flatten_tables(value: Any, name: str = "") -> Iterator[tuple[str, Any]]:
    """Entries of nested tables by dotted names; an empty table is an entry."""
    if isinstance(value, Mapping) and value:
        for key, inner in value.items():
            yield from flatten_tables(inner, f"{name}.{key}" if name else str(key))
    else:
        yield name, value
