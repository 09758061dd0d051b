"""Runs as labelled datasets and NetCDF files; parameter tables from TOML."""

import datetime
import hashlib
import importlib.metadata
import io
import json
import os
import platform
import tempfile
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ..checks.errors import ModelError, SettingError
from ..checks.schema import checked, shown
from .labelled import Labelled

if TYPE_CHECKING:
    import xarray as xr

    from ..dynamics.run import Run
    from ..parameters.table import Parameters

# Largest size of a TOML file in bytes.
MOST_TOML = 4_000_000

FORMAT = "stmuav_jax run"
FORMAT_VERSION = 2
LOOP_FORMAT, LOOP_VERSION = "stmuav_jax closed loop", 1
# Version of each format that this package reads.
_READ = {FORMAT: FORMAT_VERSION, LOOP_FORMAT: LOOP_VERSION}

_PACKAGES = ("stmuav-jax", "jax", "jaxlib", "diffrax", "equinox", "lineax", "numpy", "xarray")


class FileError(ValueError):
    """Error for a file that is missing, damaged or of another kind; the message names it."""


def versions() -> dict[str, str]:
    """Versions of the package, its libraries, Python and the device."""
    import jax  # slow to import, and pages of what was computed are made without it

    found = {name: importlib.metadata.version(name) for name in _PACKAGES}
    device = jax.devices()[0]
    return found | {"python": platform.python_version(), "device": device.device_kind}


def now() -> str:
    """Date and time of day in UTC, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def labelled(
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
        name: (dims, values, {"units": unit, "description": words})
        for name, (dims, values, unit, words) in table.items()
    }
    about = attributes | {"versions": versions()}
    texts = {k: v if isinstance(v, str | int) else json.dumps(v) for k, v in about.items()}
    texts["date"] = now()
    places = {k: v if isinstance(v, tuple) else ((k,), v, {}) for k, v in coordinates.items()}
    return Labelled(data, places, texts)


def save_labelled(arrays: Labelled, path: str | os.PathLike[str]) -> Path:
    """Save labelled arrays as NetCDF (HDF5), atomically; return the path."""
    return write_atomically(path, arrays.netcdf())


def to_dataset(run: "Run") -> "xr.Dataset":
    """Labelled dataset of a run.

    Dimensions: time, body, axis (x, y, z), component (e0 to e3), joint, rotor. Every variable has
    `units` and `description`; attributes hold scene, parameters, settings, versions, date
    and certificate (the mappings as JSON). Estimated errors are NaN where there are none.
    """
    return _labelled_run(run).dataset()


def _labelled_run(run: "Run") -> Labelled:
    """Content of a saved run; see `to_dataset`."""
    # commands without a run read and write files too, and need not wait for its modules
    from ..dynamics.run import saved
    from ..mechanics.internal import internal_names
    from .machine import machine_coordinates, machine_table, rotor_table

    states, system, errors = run.states, run.scene.system, run.errors
    vector = ("time", "body", "axis")
    of_body = ("time", "body")
    exact = "estimated distance from the exact"
    table: dict[str, tuple[tuple[str, ...], Any, str, str]] = {
        "position": (vector, states.r, "m", "centre of mass, world axes"),
        "euler_parameters": (("time", "body", "component"), states.p, "1", "body to world"),
        "velocity": (vector, states.v, "m/s", "of the centre of mass, world axes"),
        "angular_velocity": (vector, states.omega, "rad/s", "body axes"),
        "position_error": (of_body, errors.position, "m", f"{exact} position"),
        "angle_error": (of_body, errors.angle, "rad", f"{exact} orientation"),
        "velocity_error": (of_body, errors.velocity, "m/s", f"{exact} velocity"),
        "angular_velocity_error": (
            of_body, errors.angular_velocity, "rad/s", f"{exact} angular velocity",
        ),
    }  # fmt: skip
    table |= machine_table(system) | rotor_table(system, saved(run.trajectory))
    if run.model is not None:
        table |= _analysed(run)
    names = internal_names(system)
    if names:
        table["internal"] = (
            ("time", "internal_state"), run.trajectory.internal, "see internal_state",
            "states of forces, units in their names",
        )  # fmt: skip
    coordinates = {
        "time": (("time",), run.ts, {"units": "s", "description": "saved times"}),
        "component": ["e0", "e1", "e2", "e3"],
        **machine_coordinates(system),
    } | ({"internal_state": list(names)} if names else {})
    return labelled(
        table, coordinates, format=FORMAT, format_version=FORMAT_VERSION, scene=run.scene.name,
        title=run.scene.title, notes=run.scene.notes, parameters=run.scene.parameters,
        settings=run.settings, certificate=run.certificate.to_dict(), watch=list(run.scene.watch),
    )  # fmt: skip


def _analysed(run: "Run") -> dict[str, tuple[tuple[str, ...], Any, str, str]]:
    """Dimensions, values, unit and description of the analysis's results."""
    view, worst = run.snapshot, run.trajectory.worst
    vector, wrench = ("time", "body", "axis"), ("time", "joint", "axis")
    return {
        "acceleration": (vector, view.accelerations.v_rate, "m/s^2", "of the centre of mass"),
        "angular_acceleration": (vector, view.accelerations.omega_rate, "rad/s^2", "body axes"),
        "reaction_force": (wrench, view.reactions.force, "N", "of body i on body j, world axes"),
        "reaction_moment": (
            wrench, view.reactions.moment, "N m",
            "of body i on body j about the joint's point on body j, world axes",
        ),
        "kinetic_energy": (("time",), view.kinetic, "J", "of all bodies"),
        "potential_energy": (("time",), view.potential, "J", "of gravity and springs"),
        "work": (("time",), run.trajectory.work, "J", "done by forces without potential"),
        "position_violation": (("time",), worst.position, "m", "of lengths, the largest so far"),
        "velocity_violation": (("time",), worst.velocity, "m/s", "of their rates, the largest so far"),
    }  # fmt: skip


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
                os.fsync(file.fileno())
            os.chmod(name, 0o644)
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


def save(run: "Run", path: str | os.PathLike[str]) -> Path:
    """Save a run as NetCDF (HDF5), atomically; return the path.

    Numbers have Fletcher's checksum, which any reader of HDF5 verifies; a SHA-256 at the end of the
    file covers all content, and `load` verifies it.
    """
    return save_sealed(_labelled_run(run), path)


def save_sealed(arrays: Labelled, path: str | os.PathLike[str]) -> Path:
    """Save labelled arrays as by `save`, with checksums that `load` verifies."""
    content = arrays.netcdf(checksums=True)
    return write_atomically(path, content + _seal(content))


def _seal(content: bytes) -> bytes:
    return _SEAL + hashlib.sha256(content).hexdigest().encode() + b"\n"


def is_sealed(path: str | os.PathLike[str]) -> bool:
    """True if a file ends with a seal, as those of `save` do; `load` verifies it."""
    with open(path, "rb") as file:
        file.seek(0, os.SEEK_END)
        file.seek(max(file.tell() - _SEAL_LENGTH, 0))
        return file.read().startswith(_SEAL)


def _verified(source: Path, kind: str = "a run") -> bytes:
    """Content of a file without its seal, verified, as HDF5 and zip are not safe on damaged files."""
    whole = source.read_bytes()
    content, seal = whole[:-_SEAL_LENGTH], whole[-_SEAL_LENGTH:]
    if not seal.startswith(_SEAL):
        raise FileError(
            f"{source} cannot be read: it is truncated, damaged or was changed since it was saved, or is "
            f"not {kind} saved by stmuav_jax."
        )
    if seal != _seal(content):
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
    return write_atomically(path, content.getvalue() + _seal(content.getvalue()))


def load_checkpoint(
    path: str | os.PathLike[str], kind: str
) -> tuple[dict[str, Any], list[np.ndarray]]:
    """Plain data and arrays of a file of `save_checkpoint`.

    Args:
        kind: what the file should be, such as "a search", for the errors.

    Raises:
        FileError: the file is missing, damaged, or of another kind.
    """
    source = Path(path)
    if not source.is_file():
        raise FileError(f"There is no file {source} to go on from.")
    content = _verified(source, kind)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as found:
            head = json.loads(str(found["head"]))
            arrays = [found[f"{k}"] for k in range(len(found.files) - 1)]
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

    source = Path(path)
    if not source.is_file():
        raise FileError(f"There is no file {source}.")
    content = _verified(source)
    try:
        with xr.open_dataset(io.BytesIO(content), engine="h5netcdf") as dataset:
            found = dataset.load()
    except Exception as error:
        raise FileError(
            f"{source} cannot be read as a saved run: it is truncated, damaged or of another kind "
            f"({type(error).__name__})."
        ) from error
    known = _READ.get(found.attrs.get("format", ""))
    if known is None:
        raise FileError(f"{source} is a NetCDF file, but not a run saved by stmuav_jax.")
    version = int(found.attrs.get("format_version", 0))
    if version != known:
        raise FileError(
            f"{source} has format version {version}; this package reads version {known}."
        )
    return found


def save_certificate(run: "Run", path: str | os.PathLike[str]) -> Path:
    """Save the certificate, settings and versions as JSON, atomically; return the path."""
    content = {
        "scene": run.scene.name,
        "settings": run.settings,
        "certificate": run.certificate.to_dict(),
        "versions": versions(),
    }
    return write_atomically(path, (json.dumps(content, indent=2) + "\n").encode())


def read_toml(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Content of a TOML file.

    Raises:
        FileError: the file is missing, a folder or a pipe, longer than 4 MB, nested too deeply, or
            not valid TOML.
    """
    source = Path(path)
    try:
        if source.exists() and not source.is_file():
            raise FileError(f"{shown(str(source))} is no file but a folder or a pipe.")
        if source.stat().st_size > MOST_TOML:
            raise FileError(
                f"{source} is larger than {MOST_TOML / 1e6:g} MB; long lists of numbers belong in a "
                "CSV file, which a factor can name."
            )
        return tomllib.loads(source.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise FileError(f"There is no file {shown(str(source))}.") from None
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
        return base.replaced(_flat(content, base), source=f"given in {source.name}")
    except ModelError as error:
        raise ModelError(f"{source}: {error}") from None


def _flat(content: Mapping[str, Any], base: "Parameters", prefix: str = "") -> dict[str, Any]:
    from ..parameters.table import ParameterEntry

    found: dict[str, Any] = {}
    for key, value in content.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and "value" in value:
            unit = base[name].unit
            try:
                given = checked(ParameterEntry, value, f"'{name}'")
            except SettingError as error:
                raise ModelError(str(error)) from None
            if given.unit not in (None, unit):
                raise ModelError(f"'{name}' must be given in {unit}, not in {shown(given.unit)}.")
            found[name] = given.value
        elif isinstance(value, Mapping):
            found |= _flat(value, base, f"{name}.")
        else:
            found[name] = value
    return found
