"""Models of mechanisms as TOML files: read as scenes, and written so that they round-trip exactly."""

import contextlib
import dataclasses
import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import numpy as np
import tomli_w
from jaxtyping import Array

from ..analysis.sensors import SENSORS
from ..checks.errors import ModelError, SettingError, StateError, nearest_names
from ..checks.numbers import array_module, as_floats, as_numpy, check_unit, stack_arrays
from ..checks.schema import SHOWN, validate_model
from ..control.instruments import Instrument
from ..dynamics.assembly.joint_start import state_from_joints
from ..dynamics.simulation import Scene
from ..math.rotation import rotation_matrix_in
from ..mechanics.body import GROUND, Body
from ..mechanics.forces import Gravity
from ..mechanics.internal import counted_hinges, internal_states, with_start_angles
from ..mechanics.joint import Joint, free_coordinates
from ..mechanics.joint_states import coordinates_of
from ..mechanics.load import SineMotion
from ..mechanics.parameters import Parameter, Parameters
from ..mechanics.state import State
from ..mechanics.system import System
from ..uav.drag import AirframeDrag, with_wind
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors
from .air_entries import make_wind
from .model_schema import (
    BODY,
    DATASHEET,
    FORCES,
    IN_BODIES,
    INSTRUMENTS,
    JOINTS,
    MODEL_FORMATS,
    ROTORS,
    SECOND,
    START_BODY,
    Entry,
    ModelFile,
    kind_of,
    read_entries,
    with_parameters,
)
from .netcdf import FileError, read_toml, write_atomically

Table = Mapping[str, Parameter]

# Seconds by which gusts are longer than a model's own time span.
BEYOND = 60.0
# Largest admitted difference of a frame's axes from orthogonal unit vectors.
_ORTHOGONAL = 1e-9


@dataclass(frozen=True)
class ParametricModel:
    """Model's file that was read and checked, from whose parameters systems can be made.

    Attributes:
        place: path of the file, for messages. file: its entries.
        scene: its scene, with the parameters' own values.
        table: its parameters.
    """

    place: str
    file: ModelFile
    scene: Scene
    table: Parameters

    def system(self, table: Parameters) -> System:
        """System with the values of a table, which JAX may trace."""
        return _build_system(self.place, self.file, table)

    def start(self, system: System, table: Parameters) -> State:
        """State of the start with the values of a table, which JAX may trace, in its system."""
        return _read_start(system, self.file, table)

    @property
    def digest(self) -> str:
        """Text that identifies the entries of the model."""
        text = json.dumps(self.file.model_dump(mode="json"), sort_keys=True)
        return hashlib.sha256(text.encode()).hexdigest()[:16]

    def used_parameters(self) -> frozenset[str]:
        """Names of the parameters to which the entries refer."""
        texts = _nested_texts(self.file.model_dump(exclude={"parameters"}))
        return frozenset(texts) & frozenset(self.table)

    def of_start(self) -> frozenset[str]:
        """Names of the parameters to which the entries of the start refer."""
        return frozenset(_nested_texts(self.file.start.model_dump())) & frozenset(self.table)


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
        """Text that identifies systems and starts by their numbers."""
        digest = hashlib.sha256(repr(self.scene.system.names).encode())
        for leaf in jax.tree.leaves((self.scene.system, self.scene.state0)):
            digest.update(np.asarray(leaf).tobytes())
        return digest.hexdigest()[:16]

    def system(self, table: Parameters) -> System:
        """The system."""
        del table
        return self.scene.system

    def used_parameters(self) -> frozenset[str]:
        """No names."""
        return frozenset()

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
    source = Path(path)
    if source.suffix in (".xml", ".mjcf", ".urdf"):
        raise FileError(
            f"{source} is the file of a robot, where a model's TOML file is needed: write one by "
            f'save_model(load_robot("{source.name}"), "{source.stem}.toml").'
        )
    content = read_toml(source)
    with _locate_errors(f"{source}"):
        model_data = validate_model(ModelFile, content, "A model")
    entries_of = model_data.parameters.items()
    table = Parameters(
        f"{source}", {name: Parameter(p.value, p.unit, p.source) for name, p in entries_of}
    )
    system = _build_system(f"{source}", model_data, table)
    with _locate_errors(f"{source}"):
        for name in (*model_data.watch, *model_data.links_between):
            system.index(name)
    sensors = {}
    # An older version of the package refuses the format's number with a sentence; a section that
    # it does not know, it would call an error of the user.
    for section in SECOND:
        if getattr(model_data, section) and model_data.format < 2:
            raise FileError(
                f"{source}: '{section}' needs format = 2, but the file has {model_data.format}."
            )
    for name, entry in model_data.sensors.items():
        with _locate_errors(f"{source}, [sensors.{name}]"):
            sensors[name] = _read_instrument(name, entry, table, system)
    with _locate_errors(f"{source}, [start]"):
        state0 = _read_start(system, model_data, table)
    same = ("title", "t0", "t1", "save_every", "notes", "watch", "links_between")
    scene = Scene(
        name=model_data.name or source.stem, system=system, state0=state0, sensors=sensors,
        parameters={name: p.model_dump(mode="json") for name, p in entries_of},
        **{name: getattr(model_data, name) for name in same},
    )  # fmt: skip
    return ParametricModel(f"{source}", model_data, scene, table)


def _build_system(source: str, model_data: ModelFile, parameters: Table) -> System:
    bodies = []
    for name, table in model_data.bodies.items():
        with _locate_errors(f"{source}, [bodies.{name}]"):
            bodies.append(_read_body(name, table, parameters))
    joints: list[Joint] = []
    for name, table in model_data.joints.items():
        with _locate_errors(f"{source}, [joints.{name}]"):
            joints.append(_read_joint(name, table, parameters, joints))
    forces = {}
    # rotors whose speeds are left out hover: the others come first
    hovering = lambda table: table.get("kind") in ROTORS and "speed_squared" not in table
    # The sort is stable: apart from hovering rotors, forces keep the order of the file.
    for name, table in sorted(model_data.forces.items(), key=lambda entry: hovering(entry[1])):
        with _locate_errors(f"{source}, [forces.{name}]"):
            carried = {}
            if hovering(table):
                carried["carried"] = _carried_weight([b for b, _ in bodies], forces.values())
            forces[name] = _read_force(table, parameters, joints, **carried)
    with _locate_errors(f"{source}"):
        # Inputs are numbered in the order of the file, whatever was read first.
        ordered_forces = [forces[name] for name in model_data.forces]
        system = System([body for body, _ in bodies], joints, ordered_forces)
    if model_data.wind is not None:
        with _locate_errors(f"{source}, [wind]"):
            system = with_wind(system, make_wind(model_data.wind, model_data.t1 + BEYOND))
    with _locate_errors(f"{source}, [start]"):
        # Springs that count turns need the start's angles before the state exists, which has angles up to
        # whole turns only.
        system = _count_turns(system, model_data, parameters)
    # The given centres of mass themselves, where positions only come near them.
    places, reference_positions = [place for _, place in bodies], system.reference.r
    if all(place is None for place in places):
        return system
    rows = [reference_positions[k] if place is None else place for k, place in enumerate(places)]
    return eqx.tree_at(lambda s: s.reference.r, system, stack_arrays(rows))


def _count_turns(system: System, model: ModelFile, parameters: Table) -> System:
    """System whose forces count the turns of hinges from the angles of the file's start."""
    coordinates = model.start.coordinates
    angles = {}
    for name in sorted({hinge for hinge in counted_hinges(system) if hinge in coordinates}):
        value = _fill_numbers(coordinates[name], parameters, f"coordinates.{name}")
        kind = system.joints[system.joint_index(name)].kind
        labels = [label for label, _ in coordinates_of(kind)]
        values = value if isinstance(value, list) else [value]
        # another number of coordinates is refused where the start is made
        if len(values) == len(labels):
            angles[name] = values[labels.index("angle")]
    for name, value in model.start.angles.items():
        angles[name] = _fill_numbers(value, parameters, f"angles.{name}", ("rad",))
    return with_start_angles(system, angles)


def _nested_texts(value: Any) -> set[str]:
    """Texts among nested values, without the names of entries."""
    if isinstance(value, str):
        return {value}
    inner = value.values() if isinstance(value, Mapping) else value
    parts = [_nested_texts(element) for element in inner] if isinstance(inner, Iterable) else []
    return set().union(*parts)


@contextlib.contextmanager
def _locate_errors(place: str) -> Iterator[None]:
    """Context in which errors of a user's numbers name the place in the file."""
    try:
        yield
    except (ModelError, SettingError, StateError) as error:
        raise FileError(f"{place}: {error}") from error


def _read_body(name: str, table: Mapping[str, Any], parameters: Table) -> tuple[Body, Any]:
    """Body, and the given place of its centre of mass (3,) [m] or None."""
    entry_values = read_entries(table, BODY.slots, parameters, "A body")
    # A saved model gives centres of mass: computed from a reference point they would differ in the last
    # bit.
    place = entry_values.pop("com_position", None)
    if place is None:
        return Body(name, **entry_values), None
    if "position" in entry_values:
        raise SettingError("A body has a position or a com_position, not both.")
    com = entry_values.get("com", np.zeros(3))
    p = entry_values.get("orientation", (1.0, 0.0, 0.0, 0.0))
    com, p, place = (as_floats(x) for x in (com, p, place))
    # Numbers of a file stay in NumPy, without a compilation; parameters that JAX traces need its
    # functions.
    module = array_module(com, p, place)
    com, p, place = (module.asarray(x) for x in (com, p, place))
    return Body(name, position=place - rotation_matrix_in(module, p) @ com, **entry_values), place


def _read_joint(
    name: str, table: Mapping[str, Any], parameters: Table, before: list[Joint]
) -> Joint:
    """Joint of a table; a driver or a coupling is of joints before it."""
    kind = kind_of(table, JOINTS, "A joint")
    subject = f"A joint of kind {table['kind']}"
    if "in_bodies" not in table or kind.owner == "joint":
        entry_values = read_entries(
            table, _choose_units(kind.slots, table, before), parameters, subject, owner=kind.owner, kind=True
        )  # fmt: skip
        del entry_values["kind"]
        if kind.owner == "bodies":
            return kind.make(name, *entry_values.pop("bodies"), **entry_values)
        joints_by_name = {joint.name: joint for joint in before}
        for entry in {"joint", "mate"} & entry_values.keys():
            used = entry_values[entry]
            if used not in joints_by_name:
                raise SettingError(
                    f"'{entry}' must be a joint of a table before this one, but it is '{used[:SHOWN]}'."
                    f"{nearest_names(used[:SHOWN], joints_by_name)}"
                )
            entry_values[entry] = joints_by_name[used]
        return kind.make(name, **entry_values)
    return _in_bodies(name, table, parameters, subject)


def _in_bodies(name: str, table: Mapping[str, Any], parameters: Table, subject: str) -> Joint:
    """Joint with its geometry in its bodies' reference frames."""
    rest = {key: value for key, value in table.items() if key != "in_bodies"}
    # Saved joints keep their frames in both bodies, since the axes in the world exist at the reference
    # posture only.
    (i, j) = read_entries(
        rest, {}, parameters, f"{subject} with 'in_bodies'", owner="bodies", kind=True
    )["bodies"]
    if not isinstance(table["in_bodies"], Mapping):
        raise SettingError("'in_bodies' must be a table.")
    entry_values = read_entries(table["in_bodies"], IN_BODIES, parameters, "'in_bodies'")
    for key in ("frame_i", "frame_j"):
        # A printed matrix is rounded: it is kept as it is, since projecting it would change its
        # last bits.
        frame = np.array(entry_values[key])
        if np.abs(frame.T @ frame - np.eye(3)).max() > _ORTHOGONAL or np.linalg.det(frame) < 0:
            raise SettingError(
                f"'{key}' must be a rotation matrix, with the joint's x, y, z axes as columns, but "
                f"it is {frame.tolist()}."
            )
    if i == j:
        raise ModelError(f"Joint '{name}' joins body '{i}' to itself: name two different bodies.")
    if entry_values["length"] < 0 and table["kind"] != "screw":
        raise SettingError(f"'length' must not be negative, but it is {entry_values['length']} m.")
    geometry: Any = {key: as_floats(value) for key, value in entry_values.items()}
    return Joint(name=name, kind=table["kind"], body_i=i, body_j=j, in_world=False, **geometry)


def _choose_units(
    slots: Mapping[str, Entry], table: Mapping[str, Any], joints: Sequence[Joint]
) -> Mapping[str, Entry]:
    """Entries of a table, those of a joint's coordinate in the units of an angle or of a displacement."""
    joint = next((joint for joint in joints if joint.name == table.get("joint")), None)
    free = free_coordinates(joint) if joint is not None else []
    driven = str(table["kind"]).removeprefix("drive_")
    single = free[0] if len(free) == 1 else ""
    coordinate = driven if driven in free else table.get("coordinate", single)
    if coordinate not in free:
        # a joint or coordinate that does not exist is refused where the object is made
        return slots
    # A moment in N for a hinge is a mistake that no range check would find. Units are listed as those of a
    # displacement or of an angle, but for the ratio of a coupling, which depends on two coordinates.
    choice = ("displacement", "angle").index(coordinate)
    return {
        name: slot
        if name == "ratio" or not slot.unit or " or " not in slot.unit
        else slot._replace(unit=slot.unit.split(" or ")[choice])
        for name, slot in slots.items()
    }


def _read_force(
    table: Mapping[str, Any], parameters: Table, joints: Sequence[Joint], **carried: Any
) -> Any:
    """Force of a table; rotors whose speeds are left out hover with what is `carried`."""
    kind = kind_of(table, FORCES, "A force element")
    subject = f"A force element of kind {table['kind']}"
    slots = _choose_units(kind.slots, table, joints)
    entry_values = read_entries(table, slots, parameters, subject, owner=kind.owner, kind=True)
    del entry_values["kind"]
    owner = entry_values.pop(kind.owner) if kind.owner else ()
    return kind.make(*((owner,) if isinstance(owner, str) else owner), **entry_values, **carried)


def _carried_weight(bodies: Iterable[Body], forces: Iterable[Any]) -> tuple[Array, Array]:
    """Mass of all bodies [kg] and acceleration of gravity (3,) [m/s^2] that the only set of rotors carries."""
    forces = list(forces)
    if any(isinstance(force, Rotors | MotorRotors) for force in forces):
        raise SettingError(
            "One of several sets of rotors needs 'speed_squared': only one set alone hovers without it."
        )
    gravity = sum(
        (f.acceleration for f in forces if isinstance(f, Gravity)), as_floats(np.zeros(3))
    )
    return sum((as_floats(body.mass) for body in bodies), as_floats(0.0)), gravity


def _read_instrument(
    name: str, table: Mapping[str, Any], parameters: Table, system: System
) -> Instrument:
    kind = kind_of(table, INSTRUMENTS, "A sensor")
    subject = f"A sensor of kind {table['kind']}"
    slots = _choose_units(kind.slots, table, system.joints)
    entry_values = read_entries(table, slots, parameters, subject, owner=kind.owner, kind=True)
    owner = entry_values[kind.owner]
    if kind.owner == "body":
        system.index(owner)
    sheet = {key: entry_values[key] for key in DATASHEET if key in entry_values}
    arguments = {k: v for k, v in entry_values.items() if k in kind.slots.keys() - sheet.keys()}
    instrument = kind.make(owner, name=name, own=arguments, **sheet)
    # A list of one number for three components would be broadcast without a word.
    count = len(instrument.sensor.components(system))
    for key in ("noise", "bias"):
        value = np.asarray(sheet.get(key, 0.0))
        if value.ndim and len(value) != count:
            raise SettingError(
                f"'{key}' must have one number, or {count}, but it has {len(value)}."
            )
        if key == "noise" and np.any(value < 0):
            raise SettingError(f"'noise' must not be negative, but it is {value.tolist()}.")
    return instrument


def _read_start(system: System, model_data: ModelFile, parameters: Table) -> State:
    """State of the file's start; by default the reference posture at rest."""
    state, start = system.reference, model_data.start
    names = {"r": "com_position", "p": "orientation", "v": "velocity", "omega": "angular_velocity"}
    arrays = {field: [*as_numpy(getattr(state, field))] for field in names}
    for name, table in start.bodies.items():
        if name not in system.names:
            raise SettingError(
                f"There is no body '{name[:SHOWN]}'.{nearest_names(name[:SHOWN], system.names)}"
            )
        entry_values = read_entries(table, START_BODY, parameters, f"'bodies.{name}'")
        for field, key in names.items():
            if key in entry_values:
                arrays[field][system.index(name)] = entry_values[key]
        check_unit(arrays["p"][system.index(name)], f"body '{name}'", StateError)
    state = State(**{field: stack_arrays(rows) for field, rows in arrays.items()})
    if not (start.coordinates or start.rates):
        return state
    kinds = {joint.name: coordinates_of(joint.kind) for joint in system.joints}
    filled: dict[str, dict[str, Any]] = {"coordinates": {}, "rates": {}}
    for table_name, per in (("coordinates", ""), ("rates", "/s")):
        for name, value in getattr(start, table_name).items():
            units = [unit + per for _, unit in kinds.get(name, ())]
            numbers = _fill_numbers(value, parameters, f"{table_name}.{name}", units)
            filled[table_name][name] = numbers
    return state_from_joints(system, *filled.values(), start=state, t=model_data.t0)


def _fill_numbers(value: Any, parameters: Table, key: str, units: Sequence[str] = ()) -> Any:
    """Number or list of numbers of an entry, whose parameters must have the units of its components."""
    if isinstance(value, list) and len(value) == len(units):
        filled = [with_parameters(x, parameters, key, u) for x, u in zip(value, units, strict=True)]
    else:
        filled = with_parameters(value, parameters, key, " or ".join(dict.fromkeys(units)))
    every = filled if isinstance(filled, list) else [filled]
    # an array is the value of a parameter, which JAX may trace
    plain = [x for x in every if not eqx.is_array(x)]
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in plain):
        raise SettingError(f"'{key}' must be a number or a list of numbers.")
    return filled


# --- writing


def save_model(scene: Scene, path: str | os.PathLike[str]) -> Path:
    """Write a scene as a model's TOML file, see `model_to_text`; the path."""
    return write_atomically(path, model_to_text(scene).encode())


def model_to_text(scene: Scene) -> str:
    """TOML text of a scene, which `load_model` reads back exactly, bit for bit.

    Numbers are written out in the bodies' reference frames: nothing refers to the parameters, which
    are kept as a record.

    Raises:
        SettingError: the file cannot hold the system: a load or a driver's motion that is
            another function of time, a force element of another class, or single precision.
    """
    system = scene.system
    if system.allow_float32:
        raise SettingError("Models are saved in double precision alone; this system admits others.")
    wind = _wind_table(system)
    head: dict[str, Any] = {
        "format": MODEL_FORMATS[1 if scene.sensors or scene.links_between or wind else 0],
        "name": scene.name, "title": scene.title,
        "t0": scene.t0, "t1": scene.t1, "save_every": scene.save_every,
        "notes": [*scene.warnings, *scene.notes], "watch": list(scene.watch),
    }  # fmt: skip
    if scene.links_between:
        head["links_between"] = list(scene.links_between)
    floating, state = _floating_rows(system), scene.state0
    bodies = {
        name: _body_table(system, k) | ({"free": True} if k in floating else {})
        for k, name in enumerate(system.names)
    }
    forces = [_force_table(force) for force in system.forces]
    start: dict[str, Any] = {"bodies": {
        name: {
            "com_position": state.r[k], "orientation": state.p[k],
            "velocity": state.v[k], "angular_velocity": state.omega[k],
        }
        for k, name in enumerate(system.names)
    }}  # fmt: skip
    # a posture says the angle of a hinge up to whole turns
    counted = zip(counted_hinges(system), np.asarray(internal_states(system)), strict=True)
    angles = {name: angle for name, angle in counted if name is not None and abs(angle) > np.pi}
    if angles:
        start["angles"] = angles
    tables = {
        "parameters": scene.parameters, "bodies": bodies,
        # In the order of the system: a driver names a joint before it.
        "joints": {j.name: _joint_table(j, system.joints[:k]) for k, j in enumerate(system.joints)},
        "forces": {f"{table['kind']}_{k}": table for k, table in enumerate(forces, start=1)},
        "sensors": {name: _sensor_table(instrument) for name, instrument in scene.sensors.items()},
        "wind": wind, "start": start,
    }  # fmt: skip
    return tomli_w.dumps(
        _plain_values(head | {key: table for key, table in tables.items() if table})
    )


def _plain_values(value: Any) -> Any:
    """Numbers, texts and truth values of Python in nested tables and lists."""
    if isinstance(value, Mapping):
        return {key: _plain_values(element) for key, element in value.items()}
    if isinstance(value, str | list | tuple):
        return value if isinstance(value, str) else [_plain_values(element) for element in value]
    return np.asarray(value).tolist()


def _floating_rows(system: System) -> set[int]:
    """Rows of the bodies declared free, and of those that no chain of joints connects to them or to ground."""
    # Joints that were taken away may leave bodies that float undeclared: the loader must be told that this
    # is meant.
    attached_names, has_grown = {GROUND, *system.bodies.free}, True
    while has_grown:
        ends = [{joint.body_i, joint.body_j} for joint in system.joints]
        new = set().union(*(pair for pair in ends if pair & attached_names)) - attached_names
        attached_names, has_grown = attached_names | new, bool(new)
    floats = lambda name: name in system.bodies.free or name not in attached_names
    return {k for k, name in enumerate(system.names) if floats(name)}


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
    if joint.mate is not None:
        coordinate, mate_coordinate = joint.mate.coordinates
        return {
            "kind": "mimic", "joint": joint.mate.dependent, "mate": joint.mate.joint.name,
            "ratio": joint.mate.ratio, "offset": joint.mate.offset, "coordinate": coordinate,
            "mate_coordinate": mate_coordinate,
        }  # fmt: skip
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
        # A driver has its joint's geometry but not its name: the joint is the one that differs in
        # nothing else.
        other = dataclasses.replace(joint, name=driver.name, kind=driver.kind, motion=driver.motion)
        if joint.motion is None and eqx.tree_equal(other, driver):
            numbers = {key: getattr(driver.motion, key) for key in JOINTS[driver.kind].slots}
            return {"kind": driver.kind, "joint": joint.name, **numbers}
    raise SettingError(
        f"The driver '{driver.name}' must follow the joint that it drives, but no joint before it is that one."
    )


def _force_table(force: Any) -> dict[str, Any]:
    # The exact class is sought: a subclass may have entries that the file would lose.
    kinds = {entry.makes: (name, entry) for name, entry in FORCES.items()}
    if type(force) not in kinds:
        supported_names = ", ".join(entry.__name__ for entry in kinds)
        raise SettingError(
            f"A model's file cannot hold a {type(force).__name__}, only these force elements: {supported_names}."
        )
    name, kind = kinds[type(force)]
    owner = [force.body_i, force.body_j] if kind.owner == "bodies" else None
    table: dict[str, Any] = {"kind": name}
    if kind.owner:
        table[kind.owner] = owner or kind.read(force, kind.owner)
    for key in kind.slots:
        value = kind.read(force, key)
        if callable(value):
            raise SettingError(
                f"A model's file cannot hold functions of time, such as '{key}' of the "
                f"{type(force).__name__} on {force.acts_on()}; set it to a number by "
                "stmuav_jax.mechanics.with_inputs."
            )
        if value is not None:
            table[key] = value
    return table


def _wind_table(system: System) -> dict[str, Any]:
    """Table of the steady wind of all airframes; none where the air is still."""
    airframes = [force for force in system.forces if isinstance(force, AirframeDrag)]
    winds: list[Any] = [force.wind for force in airframes]
    if all(wind is None for wind in winds):
        return {}
    steady = not any(wind is None or callable(wind) for wind in winds)
    if not steady or np.ptp(np.stack(winds), axis=0).any():
        raise SettingError(
            "A model's file cannot hold gusts or a wind that is a function of time, and only one wind for all "
            "airframes: give the system a steady one by stmuav_jax.uav.with_wind."
        )
    return {"steady": winds[0]}


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
        # Usual values are left out, so that the file stays readable and short.
        usual = usual or (key == "axes" and np.array_equal(np.asarray(value), np.eye(3)))
        if not usual:
            table[key] = value
    return table
