"""File from which an interrupted flight goes on, with the numbers to the last bit."""

import dataclasses
import hashlib
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..algebra.native import native_loops
from ..checks.errors import SettingError
from ..checks.schema import Entries, Tuples, checked
from ..control.rolling import Rollout
from ..files.netcdf import FileError, load_checkpoint, save_checkpoint, versions
from .flight import MissionFlight, Reached
from .mission import Mission

_FORMAT = "stmuav_jax unfinished flight 2"


class _About(Entries):
    """Everything of an unfinished flight but its arrays."""

    format: Literal["stmuav_jax unfinished flight 2"]
    mission: str
    versions: dict[str, str]
    soc: float
    seconds: Annotated[tuple[float, float], Tuples]
    signals: Annotated[tuple[str, ...], Tuples]


def save_reached(mission: Mission, reached: Reached, path: str | os.PathLike[str]) -> Path:
    """Save a flight as far as it has come, atomically; return the path."""
    assert reached.rows is not None
    about: dict[str, Any] = {
        "format": _FORMAT, "mission": _identity(mission), "versions": _computing(),
        "soc": reached.soc, "seconds": reached.seconds, "signals": list(reached.rows.signals),
    }  # fmt: skip
    names = [field.name for field in dataclasses.fields(Rollout)]
    leaves = jax.tree.leaves({name: getattr(reached.rows, name) for name in names})
    arrays = [jax.random.key_data(leaf) if _is_key(leaf) else leaf for leaf in leaves]
    return save_checkpoint(path, about, arrays)


def load_reached(mission: Mission, path: str | os.PathLike[str]) -> Reached:
    """Flight as far as it had come, of this mission with this end or an earlier one.

    Raises:
        FileError: the file is missing or damaged, of another mission or other versions, or beyond
            the end.
    """
    source = Path(path)
    about, arrays = _content(source)
    if about.mission != _identity(mission):
        raise FileError(
            f"{source} is of another mission than this one, or of its file before a change."
        )
    if about.versions != _computing():
        raise FileError(
            f"{source} was flown by other versions of the package or its libraries, or with or without "
            "native loops: begin anew, or go on as it was begun."
        )
    try:
        rows = _like(mission, about.signals, arrays)
    except (TypeError, ValueError):
        raise FileError(f"{source} has not the arrays of a flight of this mission.") from None
    if len(rows.ts) > mission.samples:
        raise FileError(
            f"{source} has come to t = {rows.ts[-1]:g} s already, beyond the end at {mission.file.t1:g} s."
        )
    return Reached(rows, about.soc, about.seconds)


def _content(source: Path) -> tuple[_About, list[np.ndarray]]:
    """Head and arrays of a file of `save_reached`; `FileError` for any other."""
    given, arrays = load_checkpoint(source, "an unfinished flight")
    try:
        return checked(_About, given, "An unfinished flight"), arrays
    except SettingError as error:
        raise FileError(f"{source} is not an unfinished flight: {error}") from None


def _identity(mission: Mission) -> str:
    """Digest of all entries of a mission but its end and title, and of the numbers of a model's file."""
    entries = mission.file.model_dump_json(exclude={"t1", "title"})
    of_file = mission.plant.system if mission.file.machine.model is not None else ()
    numbers = b"".join(np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(of_file))
    return hashlib.sha256(entries.encode() + numbers).hexdigest()


def _computing() -> dict[str, str]:
    """Versions, and the option of the compiler, on which the last bits depend."""
    return versions() | {"native loops": str(native_loops())}


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(getattr(leaf, "dtype", float), jax.dtypes.prng_key)


def _like(mission: Mission, signals: Iterable[str], arrays: list[np.ndarray]) -> Rollout:
    """Rollout of a mission with the arrays of a file."""
    key = jax.random.key(0)
    start: Any = eqx.filter_eval_shape(mission.plant.reset, key)
    own = {
        "states": start.state, "counts": start.motion.counts, "worst": start.motion.worst,
        "signals": dict.fromkeys(signals, 0), "end": start, "memory": mission.controller.start(),
    }  # fmt: skip
    names = [field.name for field in dataclasses.fields(Rollout)]
    leaves, structure = jax.tree.flatten({name: own.get(name, 0) for name in names})
    found = [
        jax.random.wrap_key_data(array) if _is_key(leaf) else array
        for leaf, array in zip(leaves, map(jnp.asarray, arrays), strict=True)
    ]
    return Rollout(**jax.tree.unflatten(structure, found))


class Keeping:
    """Saving of an unfinished flight from time to time, and at its interruption.

    Args:
        mission: the mission. path: file. every: time between two savings [s].
    """

    def __init__(self, mission: Mission, path: Path, every: float) -> None:
        self.mission, self.path, self.every = mission, path, every
        self._saved = time.monotonic()

    def keep(self, reached: Reached) -> None:
        """Save the flight, if the last saving was long ago."""
        if time.monotonic() - self._saved > self.every:
            save_reached(self.mission, reached, self.path)
            self._saved = time.monotonic()

    def end(self, flight: MissionFlight) -> None:
        """Save an interrupted flight, and remove the file of one that has ended."""
        if flight.ending == "interrupted":
            save_reached(self.mission, flight.reached, self.path)
        else:
            self.path.unlink(missing_ok=True)
