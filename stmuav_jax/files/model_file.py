"""Models of mechanisms as TOML files, loaded as scenes; `model_text` writes them."""

import contextlib
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np

from ..algebra.rotation import rotation_matrix_in
from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import array_module, floats, stacked
from ..checks.physical import check_unit
from ..checks.schema import SHOWN, checked
from ..control.instruments import Instrument
from ..dynamics.assembly.joint_start import state_from_joints
from ..dynamics.scene import Scene
from ..mechanics.body import Body
from ..mechanics.joint import Joint
from ..mechanics.state import State
from ..mechanics.system import System
from ..parameters.table import Parameter, Parameters
from .model_schema import (
    BODY,
    DATASHEET,
    FORCES,
    IN_BODIES,
    INSTRUMENTS,
    JOINTS,
    START_BODY,
    ModelFile,
    entries,
    kind_of,
    with_parameters,
)
from .netcdf import FileError, read_toml

Table = Mapping[str, Parameter]

# Largest admitted difference of a frame's axes from orthogonal unit vectors.
_ORTHOGONAL = 1e-9


@dataclass(frozen=True)
class ParametricModel:
    """Model's file that was read and checked, from whose parameters systems can be made.

    Attributes:
        place: path of the file, for messages. given: its entries.
        scene: its scene, with the parameters' own values.
        table: its parameters.
    """

    place: str
    given: ModelFile
    scene: Scene
    table: Parameters

    def system(self, table: Parameters) -> System:
        """System with the values of a table, which JAX may trace."""
        return _system(self.place, self.given, table)

    @property
    def digest(self) -> str:
        """Text that tells models with other entries apart."""
        text = json.dumps(self.given.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def of_start(self) -> frozenset[str]:
        """Names of the parameters to which the entries of the start refer."""
        return frozenset(_texts(self.given.start.model_dump())) & frozenset(self.table)


@dataclass(frozen=True)
class Robot:
    """Model of a scene without parameters, such as a robot's; see `ParametricModel`."""

    scene: Scene

    @property
    def table(self) -> Parameters:
        """Table without parameters."""
        return Parameters(self.scene.name, {})

    @property
    def digest(self) -> str:
        """Text that tells systems and starts with other numbers apart."""
        found = hashlib.sha256(repr(self.scene.system.names).encode())
        for leaf in jax.tree.leaves((self.scene.system, self.scene.state0)):
            found.update(np.asarray(leaf).tobytes())
        return found.hexdigest()[:16]

    def system(self, table: Parameters) -> System:
        """The system."""
        del table
        return self.scene.system

    def of_start(self) -> frozenset[str]:
        """No names."""
        return frozenset()


def load_model(path: str | os.PathLike[str]) -> Scene:
    """Scene of a model's TOML file; a model without a name is named after the file.

    docs/models.md describes the format.

    Raises:
        FileError: the file is missing or not valid TOML; an entry is unknown, missing, of another
            type or unit, or out of range; names refer to nothing; the mechanism is not connected;
            or it has no state with the coordinates and rates of the start. The message names the
            file and the table.
    """
    return read_model(path).scene


def read_model(path: str | os.PathLike[str]) -> ParametricModel:
    """Model of a TOML file, see `load_model`, from whose parameters systems can be made."""
    source, content = Path(path), read_toml(path)
    with _within(f"{source}"):
        given = checked(ModelFile, content, "A model")
    entries_of = given.parameters.items()
    table = Parameters(
        f"{source}", {name: Parameter(p.value, p.unit, p.source) for name, p in entries_of}
    )
    system = _system(f"{source}", given, table)
    with _within(f"{source}"):
        for name in (*given.watch, *given.links_between):
            system.index(name)
    sensors = {}
    for what in ("sensors", "links_between"):
        if getattr(given, what) and given.format < 2:
            raise FileError(
                f"{source}: '{what}' needs format = 2, but the file has {given.format}."
            )
    for name, entry in given.sensors.items():
        with _within(f"{source}, [sensors.{name}]"):
            sensors[name] = _instrument(name, entry, table, system)
    with _within(f"{source}, [start]"):
        state0 = _start(system, given, table)
    scene = Scene(
        name=given.name or source.stem,
        title=given.title,
        system=system,
        state0=state0,
        t0=given.t0,
        t1=given.t1,
        save_every=given.save_every,
        parameters={name: each.model_dump(mode="json") for name, each in given.parameters.items()},
        notes=given.notes,
        watch=given.watch,
        links_between=given.links_between,
        sensors=sensors,
    )
    return ParametricModel(f"{source}", given, scene, table)


def _system(source: str, given: ModelFile, parameters: Table) -> System:
    bodies = []
    for name, table in given.bodies.items():
        with _within(f"{source}, [bodies.{name}]"):
            bodies.append(_body(name, table, parameters))
    joints: list[Joint] = []
    for name, table in given.joints.items():
        with _within(f"{source}, [joints.{name}]"):
            joints.append(_joint(name, table, parameters, joints))
    forces = []
    for name, table in given.forces.items():
        with _within(f"{source}, [forces.{name}]"):
            forces.append(_force(table, parameters))
    with _within(f"{source}"):
        system = System([body for body, _ in bodies], joints, forces)
    return _placed(system, [place for _, place in bodies])


def _texts(value: Any) -> set[str]:
    """Texts among nested values, without the names of entries."""
    if isinstance(value, str):
        return {value}
    inner = value.values() if isinstance(value, Mapping) else value
    parts = [_texts(each) for each in inner] if isinstance(inner, Iterable) else []
    return set().union(*parts)


@contextlib.contextmanager
def _within(place: str) -> Iterator[None]:
    """Context in which errors of a user's numbers name the place in the file."""
    try:
        yield
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{place}: {error}") from error


def _body(name: str, table: Mapping[str, Any], parameters: Table) -> tuple[Body, Any]:
    """Body, and the given place of its centre of mass (3,) [m] or None."""
    found = entries(table, BODY.slots, parameters, "A body")
    place = found.pop("com_position", None)
    if place is None:
        return Body(name, **found), None
    if "position" in found:
        raise SettingError("A body has a position or a com_position, not both.")
    com, p, place = (
        floats(x)
        for x in (
            found.get("com", np.zeros(3)),
            found.get("orientation", (1.0, 0.0, 0.0, 0.0)),
            place,
        )
    )
    module = array_module(com, p, place)
    com, p, place = (module.asarray(x) for x in (com, p, place))
    return Body(name, position=place - rotation_matrix_in(module, p) @ com, **found), place


def _placed(system: System, places: list[Any]) -> System:
    """System with the given centres of mass themselves, where positions only come near them."""
    if all(place is None for place in places):
        return system
    own = system.reference.r
    rows = [own[k] if place is None else place for k, place in enumerate(places)]
    return eqx.tree_at(lambda s: s.reference.r, system, stacked(rows))


def _joint(name: str, table: Mapping[str, Any], parameters: Table, before: list[Joint]) -> Joint:
    """Joint of a table; a driver is one of the joints before it with a prescribed coordinate."""
    kind = kind_of(table, JOINTS, "A joint")
    what = f"A joint of kind {table['kind']}"
    if "in_bodies" not in table or kind.owner == "joint":
        found = entries(table, kind.slots, parameters, what, owner=kind.owner, kind=True)
        del found["kind"]
        if kind.owner == "bodies":
            return kind.make(name, *found.pop("bodies"), **found)
        driven, known = found.pop("joint"), {joint.name: joint for joint in before}
        if driven not in known:
            raise SettingError(
                f"'joint' must be a joint of a table before this one, but it is '{driven[:SHOWN]}'."
                f"{nearest_names(driven[:SHOWN], known)}"
            )
        return kind.make(name, known[driven], **found)
    return _in_bodies(name, table, parameters, what)


def _in_bodies(name: str, table: Mapping[str, Any], parameters: Table, what: str) -> Joint:
    """Joint with its geometry in its bodies' reference frames."""
    rest = {key: value for key, value in table.items() if key != "in_bodies"}
    (i, j) = entries(rest, {}, parameters, f"{what} with 'in_bodies'", owner="bodies", kind=True)[
        "bodies"
    ]
    if not isinstance(table["in_bodies"], Mapping):
        raise SettingError("'in_bodies' must be a table.")
    found = entries(table["in_bodies"], IN_BODIES, parameters, "'in_bodies'")
    for key in ("frame_i", "frame_j"):
        frame = np.array(found[key])
        if np.abs(frame.T @ frame - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(frame) < 0:
            raise SettingError(
                f"'{key}' must be a rotation matrix, with the joint's x, y, z axes as columns, but "
                f"it is {frame.tolist()}."
            )
    if i == j:
        raise ModelError(f"Joint '{name}' joins body '{i}' to itself.")
    if found["length"] < 0 and table["kind"] != "screw":
        raise SettingError(f"'length' must not be negative, but it is {found['length']} m.")
    geometry: Any = {key: floats(value) for key, value in found.items()}
    return Joint(name=name, kind=table["kind"], body_i=i, body_j=j, in_world=False, **geometry)


def _force(table: Mapping[str, Any], parameters: Table) -> Any:
    kind = kind_of(table, FORCES, "A force element")
    what = f"A force element of kind {table['kind']}"
    found = entries(table, kind.slots, parameters, what, owner=kind.owner, kind=True)
    del found["kind"]
    owner = found.pop(kind.owner) if kind.owner else ()
    return kind.make(*((owner,) if isinstance(owner, str) else owner), **found)


def _instrument(
    name: str, table: Mapping[str, Any], parameters: Table, system: System
) -> Instrument:
    kind = kind_of(table, INSTRUMENTS, "A sensor")
    what = f"A sensor of kind {table['kind']}"
    found = entries(table, kind.slots, parameters, what, owner=kind.owner, kind=True)
    owner, own = found[kind.owner], {k: v for k, v in found.items() if k in kind.slots}
    if kind.owner == "body":
        system.index(owner)
    sheet = {key: own.pop(key) for key in DATASHEET if key in own}
    made = kind.make(owner, name=name, own=own, **sheet)
    count = len(made.sensor.components(system))
    for key in ("noise", "bias"):
        value = np.asarray(sheet.get(key, 0.0))
        if value.ndim and len(value) != count:
            raise SettingError(
                f"'{key}' must have one number, or {count}, but it has {len(value)}."
            )
        if key == "noise" and np.any(value < 0):
            raise SettingError(f"'noise' must not be negative, but it is {value.tolist()}.")
    return made


def _start(system: System, given: ModelFile, parameters: Table) -> State:
    """State of the file's start; at the reference posture, at rest, if it says nothing."""
    state, start = system.reference, given.start
    names = {"r": "com_position", "p": "orientation", "v": "velocity", "omega": "angular_velocity"}
    arrays = {field: np.array(getattr(state, field)) for field in names}
    for name, table in start.bodies.items():
        if name not in system.names:
            raise SettingError(
                f"There is no body '{name[:SHOWN]}'.{nearest_names(name[:SHOWN], system.names)}"
            )
        found = entries(table, START_BODY, parameters, f"'bodies.{name}'")
        for field, key in names.items():
            if key in found:
                arrays[field][system.index(name)] = found[key]
        check_unit(arrays["p"][system.index(name)], f"body '{name}'", StateError)
    state = State(**{field: floats(value) for field, value in arrays.items()})
    if not (start.coordinates or start.rates):
        return state
    coordinates, rates = (
        {name: _numbers(value, parameters, f"{what}.{name}") for name, value in table.items()}
        for what, table in (("coordinates", start.coordinates), ("rates", start.rates))
    )
    return state_from_joints(system, coordinates, rates, start=state, t=given.t0)


def _numbers(value: Any, parameters: Table, key: str) -> Any:
    filled = with_parameters(value, parameters, key)
    every = filled if isinstance(filled, list) else [filled]
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in every):
        raise SettingError(f"'{key}' must be a number or a list of numbers.")
    return filled
