"""Models of mechanisms as TOML files: loaded as scenes, and saved again to the last bit."""

import contextlib
import dataclasses
import json
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from ..algebra.rotation import rotation_matrix_in
from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import floats
from ..checks.physical import check_unit
from ..checks.schema import SHOWN, checked
from ..dynamics.assembly.joint_start import state_from_joints
from ..dynamics.scene import Scene
from ..mechanics.body import GROUND, Body
from ..mechanics.joint import Joint
from ..mechanics.load import SineMotion
from ..mechanics.state import State
from ..mechanics.system import System
from .model_schema import (
    BODY,
    FORCES,
    IN_BODIES,
    JOINTS,
    MODEL_FORMAT,
    START_BODY,
    ModelFile,
    ModelParameter,
    entries,
    kind_of,
    with_parameters,
)
from .netcdf import FileError, read_toml, write_atomically

Table = Mapping[str, ModelParameter]

# Largest admitted difference of a frame's axes from orthogonal unit vectors.
_ORTHOGONAL = 1e-9


def load_model(path: str | os.PathLike[str]) -> Scene:
    """Scene of a model's TOML file; a model without a name is named after the file.

    docs/models.md describes the format.

    Raises:
        FileError: the file is missing or not valid TOML; an entry is unknown, missing, of another
            type or unit, or out of range; names refer to nothing; the mechanism is not connected;
            or it has no state with the coordinates and rates of the start. The message names the
            file and the table.
    """
    source, content = Path(path), read_toml(path)
    with _within(f"{source}"):
        given = checked(ModelFile, content, "A model")
        parameters = given.parameters
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
        for name in given.watch:
            system.index(name)
    system = _placed(system, [place for _, place in bodies])
    with _within(f"{source}, [start]"):
        state0 = _start(system, given, parameters)
    return Scene(
        name=given.name or source.stem,
        title=given.title,
        system=system,
        state0=state0,
        t0=given.t0,
        t1=given.t1,
        save_every=given.save_every,
        parameters={name: each.model_dump(mode="json") for name, each in parameters.items()},
        notes=given.notes,
        watch=given.watch,
    )


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
    com = np.asarray(found.get("com", np.zeros(3)))
    p = np.asarray(found.get("orientation", (1.0, 0.0, 0.0, 0.0)), dtype=float)
    return Body(name, position=place - rotation_matrix_in(np, p) @ com, **found), place


def _placed(system: System, places: list[Any]) -> System:
    """System with the given centres of mass themselves, where positions only come near them."""
    r = np.array(system.reference.r)
    for row, place in enumerate(places):
        if place is not None:
            r[row] = place
    return eqx.tree_at(lambda s: s.reference.r, system, floats(r))


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


def save_model(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Write a scene as a model's TOML file, see `model_to_text`; the path."""
    return write_atomically(path, model_to_text(scene).encode())


def model_to_text(scene: Scene) -> str:
    """TOML text of a scene, from which `load_model` makes the same system and state to the last bit.

    Numbers are written out in the bodies' reference frames: nothing refers to the parameters, which
    are kept as a record.

    Raises:
        SettingError: the file cannot hold the system: a load or a driver's motion that is
            another function of time, a force element of another class, or single precision.
    """
    system = scene.system
    if system.allow_float32:
        raise SettingError("Models are saved in double precision alone; this system admits others.")
    head: dict[str, Any] = {
        "format": MODEL_FORMAT, "name": scene.name, "title": scene.title,
        "t0": scene.t0, "t1": scene.t1, "save_every": scene.save_every,
        "notes": list(scene.notes), "watch": list(scene.watch),
    }  # fmt: skip
    tables: dict[tuple[str, ...], dict[str, Any]] = {
        ("parameters", name): dict(each) for name, each in scene.parameters.items()
    }
    floating = _floating(system)
    for k, name in enumerate(system.names):
        tables["bodies", name] = _body_table(system, k) | ({"free": True} if k in floating else {})
    for k, joint in enumerate(system.joints):
        tables["joints", joint.name] = _joint_table(joint, system.joints[:k])
    for k, force in enumerate(system.forces, start=1):
        kind, table = _force_table(force)
        tables["forces", f"{kind}_{k}"] = table
    for k, name in enumerate(system.names):
        state = scene.state0
        tables["start", "bodies", name] = {
            "com_position": state.r[k], "orientation": state.p[k],
            "velocity": state.v[k], "angular_velocity": state.omega[k],
        }  # fmt: skip
    parts = ["\n".join(f"{key} = {_toml(value)}" for key, value in head.items())]
    for place, table in tables.items():
        last = place[-1] if re.fullmatch("[A-Za-z0-9_-]+", place[-1]) else _toml(place[-1])
        title = ".".join((*place[:-1], last))
        parts.append("\n".join([f"[{title}]", *(f"{k} = {_toml(v)}" for k, v in table.items())]))
    return "\n\n".join(parts) + "\n"


def _toml(value: Any) -> str:
    """TOML form of a text, a truth value, numbers, or a table within a line."""
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + "}"
    plain = np.asarray(value).tolist() if not isinstance(value, list | tuple) else value
    if isinstance(plain, list | tuple):
        return "[" + ", ".join(_toml(each) for each in plain) + "]"
    return repr(plain)


def _floating(system: System) -> set[int]:
    """Rows of the bodies that no chain of joints connects to ground."""
    reached, grown = {GROUND}, True
    while grown:
        ends = [{joint.body_i, joint.body_j} for joint in system.joints]
        new = set().union(*(pair for pair in ends if pair & reached)) - reached
        reached, grown = reached | new, bool(new)
    return {k for k, name in enumerate(system.names) if name not in reached}


def _body_table(system: System, k: int) -> dict[str, Any]:
    bodies, start = system.bodies, system.reference
    table = {
        "mass": bodies.mass[k], "inertia": bodies.inertia[k], "com": bodies.com[k],
        "com_position": start.r[k], "orientation": start.p[k],
    }  # fmt: skip
    moments = np.linalg.eigvalsh(np.asarray(bodies.inertia[k]))
    excess = moments[2] / (moments[0] + moments[1]) - 1
    # a rounded, printed tensor was admitted: it has to be again
    return table | ({"triangle_tolerance": 1.01 * excess} if excess > 0 else {})


def _joint_table(joint: Joint, before: tuple[Joint, ...]) -> dict[str, Any]:
    if JOINTS[joint.kind].owner == "joint":
        return _driver_table(joint, before)
    geometry = {key: getattr(joint, key) for key in IN_BODIES}
    ends = [joint.body_i, joint.body_j]
    return {"kind": joint.kind, "bodies": ends, "in_bodies": geometry}


def _driver_table(driver: Joint, before: tuple[Joint, ...]) -> dict[str, Any]:
    if not isinstance(driver.motion, SineMotion):
        raise SettingError(
            f"A model's file cannot hold the motion of the driver '{driver.name}', only a "
            "stmuav_jax.mechanics.SineMotion."
        )
    for joint in before:
        other = dataclasses.replace(joint, name=driver.name, kind=driver.kind, motion=driver.motion)
        if joint.motion is None and eqx.tree_equal(other, driver):
            return {
                "kind": driver.kind,
                "joint": joint.name,
                **{key: getattr(driver.motion, key) for key in JOINTS[driver.kind].slots},
            }
    raise SettingError(f"No joint before the driver '{driver.name}' is the one that it drives.")


def _force_table(force: Any) -> tuple[str, dict[str, Any]]:
    kinds = {each.make: (name, each) for name, each in FORCES.items()}
    if type(force) not in kinds:
        known = ", ".join(each.__name__ for each in kinds)
        raise SettingError(
            f"A model's file cannot hold a {type(force).__name__}, only these force elements: {known}."
        )
    name, kind = kinds[type(force)]
    owner = [force.body_i, force.body_j] if kind.owner == "bodies" else None
    table: dict[str, Any] = {"kind": name}
    if kind.owner:
        table[kind.owner] = owner or getattr(force, kind.owner)
    for key in kind.slots:
        value = getattr(force, key)
        if callable(value):
            raise SettingError(
                f"A model's file cannot hold functions of time, such as '{key}' of the "
                f"{type(force).__name__} on {force.acts_on()}; set it to a number by "
                "stmuav_jax.mechanics.with_inputs."
            )
        if value is not None:
            table[key] = value
    return name, table
