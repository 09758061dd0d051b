"""Scenes written as models' TOML files, from which they come back to the last bit."""

import dataclasses
import json
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np

from ..checks.errors import SettingError
from ..dynamics.scene import Scene
from ..mechanics.body import GROUND
from ..mechanics.joint import Joint
from ..mechanics.load import SineMotion
from ..mechanics.system import System
from ..sensing.sensors import SENSORS
from .model_schema import DATASHEET, FORCES, IN_BODIES, INSTRUMENTS, JOINTS, MODEL_FORMATS
from .netcdf import write_atomically


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
        "format": MODEL_FORMATS[1 if scene.sensors or scene.links_between else 0],
        "name": scene.name, "title": scene.title,
        "t0": scene.t0, "t1": scene.t1, "save_every": scene.save_every,
        "notes": list(scene.notes), "watch": list(scene.watch),
    }  # fmt: skip
    if scene.links_between:
        head["links_between"] = list(scene.links_between)
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
    for name, instrument in scene.sensors.items():
        tables["sensors", name] = _sensor_table(instrument)
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
    if joint.kind not in JOINTS:
        raise SettingError(
            f"A model's file cannot hold joint '{joint.name}': {joint.kind} is no kind of the package."
        )
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


def _sensor_table(instrument: Any) -> dict[str, Any]:
    sensor = instrument.sensor
    kinds = {make: name for name, make in SENSORS.items()}
    if type(sensor) not in kinds:
        raise SettingError(
            f"A model's file cannot hold a {type(sensor).__name__}, only these sensors: "
            f"{', '.join(INSTRUMENTS)}."
        )
    kind = INSTRUMENTS[kinds[type(sensor)]]
    table = {"kind": kinds[type(sensor)], kind.owner: getattr(sensor, kind.owner)}
    for key in kind.slots:
        value = getattr(instrument if key in DATASHEET else sensor, key)
        usual = value is None or (key == "delay" and value == 0)
        usual = usual or (key == "axes" and np.array_equal(np.asarray(value), np.eye(3)))
        if not usual:
            table[key] = value
    return table
