"""Schema of a model's file, formats 1 and 2: names, types and units of all its entries.

A kind of force element is one line of `FORCES`; the kinds of joints are those of the catalogue. The
entries of either are the arguments of the function that makes it. docs/models.md lists them.
"""

import functools
import inspect
import operator
from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Any, Literal, NamedTuple

import equinox as eqx
import numpy as np
import pydantic
from pydantic import AfterValidator, Field

from ..analysis.sensors import SENSORS
from ..checks.errors import SettingError, has_values, nearest_names
from ..checks.numbers import as_floats
from ..checks.schema import (
    SHOWN,
    Count,
    Entries,
    Finite,
    Name,
    Positive,
    Triple,
    Tuples,
    format_value,
    quote_name,
    validate_model,
)
from ..control.instruments import Instrument
from ..mechanics import forces, joint as joints
from ..mechanics.body import Body
from ..mechanics.joint_forces import EndStop, JointEffort, JointFriction, JointServo
from ..mechanics.load import SineMotion
from ..mechanics.parameters import Parameter
from ..uav.allocation import RotorLimits
from ..uav.drag import AirframeDrag
from ..uav.motor import MotorRotors
from ..uav.rotor import Rotors, fit_rotor_curves, rotor_layout
from .air_entries import BatteryEntry, WindEntry

# Formats that are read; the second has what `SECOND` names.
MODEL_FORMATS = (1, 2)

SECOND = ("sensors", "links_between", "wind", "battery")

Rows = Annotated[tuple[Triple, Triple, Triple], Tuples]
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], Tuples]
Pair = Annotated[tuple[str, str], Tuples]
Several = Annotated[tuple[Finite, ...], Tuples]
Triples = Annotated[tuple[Triple, ...], Tuples]


def _shape_check(kinds: Any, requirement: str) -> AfterValidator:
    """Check that a value is of one of some shapes; a message says what it must be."""
    # The error of a union lists why each of its shapes does not fit; one sentence on what would fit
    # is what the user needs.
    shape = pydantic.TypeAdapter(kinds)

    def check_shapes(value: Any) -> Any:
        try:
            return shape.validate_python(value)
        except pydantic.ValidationError:
            raise ValueError(f"must be {requirement}, but it is {format_value(value)}.") from None

    return AfterValidator(check_shapes)


def _shape_schema(kinds: Any) -> pydantic.WithJsonSchema:
    """Schema for editors of values of one of some shapes."""
    return pydantic.WithJsonSchema(pydantic.TypeAdapter(kinds).json_schema())


_INERTIA, _VALUE, _SIZE = Triple | Rows, Finite | Several | Triples, Finite | Several
Inertia = Annotated[
    Any,
    _shape_check(_INERTIA, "three moments or three rows of three numbers"),
    _shape_schema(_INERTIA),
]
Value = Annotated[Any, _shape_check(_VALUE, "finite numbers"), _shape_schema(_VALUE)]
# One number, or one for each component.
Size = Annotated[Any, _shape_check(_SIZE, "a number or a list of numbers"), _shape_schema(_SIZE)]


def _check_format(value: int) -> int:
    if value not in MODEL_FORMATS:
        supported_formats = " and ".join(map(str, MODEL_FORMATS))
        raise ValueError(
            f"is {format_value(value)}, but this version reads the formats {supported_formats}."
        )
    return value


class Entry(NamedTuple):
    """One entry of a table of the file.

    Attributes:
        type: type of its value. unit: unit of its numbers, or two joined by " or "; None if it
            holds no numbers, so that text in it names no parameter.
        needed: False if it may be left out.
    """

    type: Any
    unit: str | None = None
    needed: bool = True


class Kind(NamedTuple):
    """Table of the file: the function that makes its object, and its entries.

    Attributes:
        make: function of the names in `owner` and of the entries by name.
        owner: entry that names the bodies or the joint; "" for none.
        type: class of the object, where `make` is not the class itself.
        read: function of an object and the name of an entry that returns its value, or None.
    """

    make: Callable[..., Any]
    owner: str
    slots: Mapping[str, Entry]
    type: Any = None
    read: Callable[[Any, str], Any] = getattr

    @property
    def makes(self) -> Any:
        """Class of the object."""
        return self.make if self.type is None else self.type


def _optional_entry(slot: Entry) -> Entry:
    return slot._replace(needed=False)


def _driver_maker(coordinate: Any) -> Callable[..., joints.Joint]:
    def make(name: str, joint: joints.Joint, **numbers: Any) -> joints.Joint:
        return joints.drive(name, joint, SineMotion(**numbers), coordinate=coordinate)

    return make


_POINT, _AXIS = Entry(Triple, "m"), Entry(Triple, "1")
_LENGTH = Entry(Finite, "m", needed=False)
_WHICH = Entry(Literal["angle", "displacement"], needed=False)
_FRAME = Entry(Literal["world", "body"], needed=False)
_SWING = Entry(Finite, "m or rad", needed=False)
_MOTION = {
    "start": _SWING,
    "rate": Entry(Finite, "m/s or rad/s", needed=False),
    "amplitude": _SWING,
    "angular_frequency": Entry(Finite, "rad/s", needed=False),
    "phase": Entry(Finite, "rad", needed=False),
}

# Arguments of the functions that make joints: one that is not here keeps its joint out of files.
_ARGUMENTS = {
    **dict.fromkeys(("point", "point_i", "point_j"), _POINT),
    **dict.fromkeys(("axis", "axis_i", "axis_j"), _AXIS),
    "length": _LENGTH,
    "pitch": Entry(Finite, "m/rad"),
}


def _joint_kinds() -> Iterator[tuple[str, Kind]]:
    """Tables of the kinds of joints whose functions take what a file can hold, so none of a user.

    The signature is the only list of a joint's arguments, so that files cannot deviate from it.
    """
    for kind in joints.CATALOGUE:
        if make := getattr(joints, kind, None):
            arguments = inspect.signature(make).parameters.values()
            needs = {p.name: p.default is p.empty for p in arguments if p.kind is p.KEYWORD_ONLY}
            if needs.keys() <= _ARGUMENTS.keys():
                slots = {k: _ARGUMENTS[k]._replace(needed=needed) for k, needed in needs.items()}
                yield kind, Kind(make, "bodies", slots)


JOINTS: dict[str, Kind] = {
    **dict(_joint_kinds()),
    "drive_angle": Kind(_driver_maker("angle"), "joint", _MOTION),
    "drive_displacement": Kind(_driver_maker("displacement"), "joint", _MOTION),
    "mimic": Kind(joints.mimic, "joint", {
        "mate": Entry(str),
        "ratio": Entry(Finite, "1 or m/rad"),
        "offset": _SWING,
        "coordinate": _WHICH,
        "mate_coordinate": _WHICH,
    }),
}  # fmt: skip

# Geometry of a joint in the reference frames of its bodies, by which saved models give it.
IN_BODIES: dict[str, Entry] = {
    "point_i": _POINT, "point_j": _POINT,
    "frame_i": Entry(Rows, "1"), "frame_j": Entry(Rows, "1"),
    "length": Entry(Finite, "m or m/rad"),
}  # fmt: skip

_STIFFNESS, _DAMPING = Entry(Finite, "N/m or N m/rad"), Entry(Finite, "N s/m or N m s/rad")
_COORDINATE, _EFFORT = Entry(Finite, "m or rad"), Entry(Finite, "N or N m")


def _make_rotors(
    body: str,
    *,
    arms: Any = None,
    spin: Any = None,
    number: int | None = None,
    radius: Any = None,
    layout: Any = "x",
    coaxial: Any = None,
    height: Any = 0.0,
    k_f: Any = None,
    k_tau: Any = None,
    points: Any = None,
    speed_squared: Any = None,
    carried: Any = None,
    **curves: Any,
) -> Rotors:
    """Rotors at places of their own, or of a layout; without speeds they hover with mass and gravity `carried`."""
    if (arms is None) != (spin is None) or (arms is None) == (number is None):
        raise SettingError(
            "Rotors need 'arms' and 'spin', or a layout by 'number' and 'radius', and not both."
        )
    if number is not None:
        if radius is None:
            raise SettingError("A layout of rotors needs 'radius', the length of its arms.")
        arms, spin = rotor_layout(number, radius, layout=layout, coaxial=coaxial, height=height)
    coefficients = {"k_f": k_f, "k_tau": k_tau, **curves}
    if points is not None:
        if any(value is not None for value in coefficients.values()):
            raise SettingError(
                "Rotors have either 'points' of a test stand or coefficients such as 'k_f', and not both."
            )
        coefficients = fit_rotor_curves(points)
    elif k_f is None or k_tau is None:
        raise SettingError("Rotors need 'k_f' and 'k_tau', or 'points' of a test stand.")
    rotors = Rotors(body, arms=arms, spin=spin, **coefficients, speed_squared=np.zeros(len(spin)))
    if speed_squared is None:
        speed_squared = rotors.hover(*carried)
    return eqx.tree_at(lambda r: r.speed_squared, rotors, as_floats(speed_squared))


def _make_motors(
    body: str,
    *,
    time_constant: Any = None,
    inertia: Any = None,
    lowest: Any = 0.0,
    highest: Any = None,
    start: Any = None,
    **rotors: Any,
) -> MotorRotors:
    """Motors with the rotors of the other entries."""
    limits = None if highest is None else RotorLimits(lowest, highest)
    return MotorRotors(
        _make_rotors(body, **rotors), time_constant=time_constant, inertia=inertia, limits=limits, start=start
    )  # fmt: skip


def _read_motors(motors: MotorRotors, name: str) -> Any:
    if name in ("lowest", "highest"):
        return getattr(motors.limits, name, None)
    is_of_motors = name in ("time_constant", "inertia", "start")
    return getattr(motors if is_of_motors else motors.rotors, name, None)


_ROTORS = {
    "arms": Entry(Triples, "m", needed=False), "spin": Entry(Several, "1", needed=False),
    "number": Entry(Count, needed=False), "radius": _LENGTH,
    "layout": Entry(Literal["x", "plus"], needed=False), "coaxial": _LENGTH, "height": _LENGTH,
    "k_f": Entry(Finite, "N s^2/rad^2", needed=False), "k_tau": Entry(Finite, "N m s^2/rad^2", needed=False),
    "thrust_linear": Entry(Finite, "N s/rad", needed=False), "thrust_offset": Entry(Finite, "N", needed=False),
    "torque_linear": Entry(Finite, "N m s/rad", needed=False), "torque_offset": Entry(Finite, "N m", needed=False),
    "points": Entry(Triples, needed=False),
    "speed_squared": Entry(Several, "rad^2/s^2", needed=False),
}  # fmt: skip
# Kinds of sets of rotors.
ROTORS = ("rotors", "motors")
_SPEED = Entry(Size, "rad/s", needed=False)
_LIMIT = _optional_entry(_EFFORT)

FORCES: dict[str, Kind] = {
    "gravity": Kind(forces.Gravity, "", {"acceleration": Entry(Triple, "m/s^2", needed=False)}),
    "spring": Kind(forces.LinearSpringDamper, "bodies", {
        "point_i": _optional_entry(_POINT), "point_j": _optional_entry(_POINT), "stiffness": Entry(Finite, "N/m"),
        "damping": Entry(Finite, "N s/m", needed=False), "length": _LENGTH,
    }),
    "torsional_spring": Kind(forces.TorsionalSpringDamper, "joint", {
        "stiffness": Entry(Finite, "N m/rad"), "damping": Entry(Finite, "N m s/rad", needed=False),
        "angle": Entry(Finite, "rad", needed=False),
    }),
    "damping": Kind(forces.JointDamping, "joint", {
        "turning": Entry(Finite, "N m s/rad", needed=False),
        "sliding": Entry(Finite, "N s/m", needed=False),
    }),
    "servo": Kind(JointServo, "joint", {
        "stiffness": _STIFFNESS, "damping": _DAMPING, "target": _COORDINATE, "coordinate": _WHICH,
        "limit": _LIMIT,
    }),
    "end_stop": Kind(EndStop, "joint", {
        "lower": _optional_entry(_COORDINATE), "upper": _optional_entry(_COORDINATE), "stiffness": _STIFFNESS,
        "damping": _DAMPING, "width": _COORDINATE, "coordinate": _WHICH,
    }),
    "friction": Kind(JointFriction, "joint", {
        "coulomb": _EFFORT, "viscous": _optional_entry(_DAMPING), "speed": Entry(Finite, "m/s or rad/s"),
        "coordinate": _WHICH,
    }),
    "effort": Kind(JointEffort, "joint", {
        "effort": _EFFORT, "coordinate": _WHICH, "limit": _LIMIT,
    }),
    "ground_contact": Kind(forces.GroundContact, "body", {
        "feet": Entry(Triples, "m"), "height": _LENGTH, "stiffness": Entry(Finite, "N/m"),
        "damping": Entry(Finite, "N s/m"), "width": Entry(Finite, "m"), "friction": Entry(Finite, "1"),
        "slip_speed": Entry(Finite, "m/s"),
    }),
    "force": Kind(forces.AppliedForce, "body", {
        "force": Entry(Triple, "N"), "frame": _FRAME, "point": _optional_entry(_POINT),
    }),
    "moment": Kind(forces.AppliedMoment, "body", {"moment": Entry(Triple, "N m"), "frame": _FRAME}),
    "rotors": Kind(_make_rotors, "body", _ROTORS, Rotors, lambda rotors, name: getattr(rotors, name, None)),
    "motors": Kind(_make_motors, "body", {
        **_ROTORS, "time_constant": Entry(Size, "s", needed=False), "inertia": Entry(Size, "kg m^2", needed=False),
        "lowest": _SPEED, "highest": _SPEED, "start": _SPEED,
    }, MotorRotors, _read_motors),
    "drag": Kind(AirframeDrag, "body", {
        "linear": Entry(Triple, "N s/m", needed=False), "quadratic": Entry(Triple, "N s^2/m^2", needed=False),
        "point": _optional_entry(_POINT),
    }),
}  # fmt: skip


def _sensor_kind(name: str, unit: str, **own: Entry) -> Kind:
    """Table of a kind of sensor with the numbers of its datasheet, noise and bias in a unit."""

    def make(*owner: str, name: str, own: Mapping[str, Any], **datasheet: Any) -> Instrument:
        return Instrument(sensor(*owner, name=name, **own), **datasheet)

    sensor = SENSORS[name]
    error = Entry(Size, unit, needed=False)
    sheet = {"noise": error, "bias": error, "rate": Entry(Finite, "Hz", needed=False)}
    sheet["delay"] = Entry(Finite, "s", needed=False)
    return Kind(make, "joint" if name == "encoder" else "body", {**own, **sheet})


_AXES = Entry(Rows, "1", needed=False)
DATASHEET = ("noise", "bias", "rate", "delay")
INSTRUMENTS: dict[str, Kind] = {
    "gyroscope": _sensor_kind("gyroscope", "rad/s", axes=_AXES),
    "accelerometer": _sensor_kind(
        "accelerometer", "m/s^2", point=_optional_entry(_POINT), axes=_AXES
    ),
    "encoder": _sensor_kind("encoder", "m or rad", coordinate=_WHICH),
    "position": _sensor_kind("position", "m", point=_optional_entry(_POINT)),
    "attitude": _sensor_kind("attitude", "rad"),
}

BODY = Kind(Body, "", {
    "mass": Entry(Finite, "kg"), "inertia": Entry(Inertia, "kg m^2"), "com": _optional_entry(_POINT),
    "position": _optional_entry(_POINT), "com_position": _optional_entry(_POINT),
    "orientation": Entry(Quaternion, "1", needed=False), "free": Entry(bool, needed=False),
    "triangle_tolerance": Entry(Finite, "1", needed=False),
})  # fmt: skip

START_BODY: dict[str, Entry] = {
    "com_position": _optional_entry(_POINT), "orientation": Entry(Quaternion, "1", needed=False),
    "velocity": Entry(Triple, "m/s", needed=False),
    "angular_velocity": Entry(Triple, "rad/s", needed=False),
}  # fmt: skip


class ModelParameter(Entries):
    """Entry of a parameter, to which the entries of bodies, joints and forces may refer."""

    value: Value  # pyright: ignore[reportInvalidTypeForm]
    unit: str
    source: str


class StartEntry(Entries):
    """Entry for the state at the start."""

    coordinates: dict[str, Any] = Field(default_factory=dict)
    rates: dict[str, Any] = Field(default_factory=dict)
    angles: dict[str, Any] = Field(default_factory=dict)
    bodies: dict[str, dict[str, Any]] = Field(default_factory=dict)


class ModelFile(Entries):
    """Entries of a model; the tables of bodies, joints and forces are checked by `read_entries`."""

    format: Annotated[int, AfterValidator(_check_format)]
    name: Name | None = None
    title: str = ""
    t0: Finite = 0.0
    t1: Finite = 2.0
    save_every: Positive = 0.01
    notes: Annotated[tuple[str, ...], Tuples] = ()
    watch: Annotated[tuple[str, ...], Tuples] = ()
    links_between: Annotated[tuple[str, ...], Tuples] = ()
    parameters: dict[str, ModelParameter] = Field(default_factory=dict)
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, Any]] = Field(default_factory=dict)
    forces: dict[str, dict[str, Any]] = Field(default_factory=dict)
    sensors: dict[str, dict[str, Any]] = Field(default_factory=dict)
    wind: WindEntry | None = None
    battery: BatteryEntry | None = None
    start: StartEntry = StartEntry()


_OWNERS = {"bodies": Entry(Pair), "body": Entry(str), "joint": Entry(str), "": None}


def kind_of(table: Mapping[str, Any], kinds: Mapping[str, Kind], subject: str) -> Kind:
    """Kind that a table names; raises `SettingError` if it names none of them."""
    kind = table.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        wrong = "needs 'kind'." if kind is None else f"has the kind {format_value(kind)}."
        raise SettingError(f"{subject} {wrong}{nearest_names(str(kind)[:SHOWN], kinds)}")
    return kinds[kind]


def read_entries(
    data: Mapping[str, Any],
    slots: Mapping[str, Entry],
    parameters: Mapping[str, Parameter],
    subject: str,
    *,
    owner: str = "",
    kind: bool = False,
) -> dict[str, Any]:
    """Entries of a table with their parameters' values, all types checked.

    Args:
        subject: subject of messages, such as "A revolute joint".
        owner: entry that names bodies or a joint. kind: True if the table names its kind.

    Raises:
        SettingError: an entry is unknown, missing or of another type, or refers to an unknown
            parameter or to one of another unit.
    """
    owner_entry = _OWNERS[owner]
    every = {
        **({"kind": Entry(str)} if kind else {}),
        **({owner: owner_entry} if owner_entry else {}),
        **slots,
    }
    filled = {
        key: value if (slot := every.get(key)) is None or slot.unit is None
        else with_parameters(value, parameters, key, slot.unit)
        for key, value in data.items()
    }  # fmt: skip
    if not has_values(filled):
        # traced numbers have been checked with the values of the file
        return {key: filled[key] for key in every if key in filled}
    fields: Any = {key: (s.type, ... if s.needed else None) for key, s in every.items()}
    model = pydantic.create_model("Table", __base__=Entries, **fields)
    # The schema is data: messages, documentation and checks follow from one table of entries.
    table = validate_model(model, filled, subject)
    # Entries that the file leaves out are not passed on, so that the defaults of the functions
    # hold.
    return {key: getattr(table, key) for key in every if key in table.model_fields_set}


def with_parameters(
    value: Any, parameters: Mapping[str, Parameter], key: str, unit: str = ""
) -> Any:
    """Value in which each text is replaced by the value of the parameter that it names."""
    if isinstance(value, list):
        # arrays have at most two axes; what is deeper is refused later
        is_deep = lambda x: isinstance(x, list) and any(isinstance(y, list) for y in x)
        return [x if is_deep(x) else with_parameters(x, parameters, key, unit) for x in value]
    if not isinstance(value, str):
        return value
    if value not in parameters:
        raise SettingError(
            f"'{key}' must be numbers or the names of parameters, but there is no parameter "
            f"{quote_name(value)}.{nearest_names(value[:SHOWN], parameters)}"
        )
    parameter = parameters[value]
    # A parameter with another unit is a mistake that no range check would find.
    if unit and parameter.unit not in unit.split(" or "):
        raise SettingError(
            f"'{key}' is a quantity in {unit}, but the parameter '{value}' is in "
            f"{format_value(parameter.unit)}."
        )
    return _as_lists(parameter.value)


def _as_lists(value: Any) -> Any:
    return [_as_lists(x) for x in value] if isinstance(value, tuple) else value


# --- schema for editors


def model_json_schema() -> dict[str, Any]:
    """JSON schema of a model's file, for editors that complete and check entries."""
    geometry = {"in_bodies": Entry(Any, needed=False)}
    joint_kinds = {
        name: kind._replace(
            slots={key: _optional_entry(slot) for key, slot in kind.slots.items()} | geometry
        )
        for name, kind in JOINTS.items()
    }
    # By the discriminator an editor completes the entries of the kind that is named, and its
    # messages are about that kind alone.
    of_kinds = lambda kinds: Annotated[
        functools.reduce(operator.or_, [_table_model(kind, name) for name, kind in kinds.items()]),
        Field(discriminator="kind"),
    ]
    sections: Any = {
        "bodies": _table_model(BODY),
        "joints": of_kinds(joint_kinds),
        "forces": of_kinds(FORCES),
        "sensors": of_kinds(INSTRUMENTS),
    }
    fields: Any = {
        key: (dict[str, table], ... if key == "bodies" else {}) for key, table in sections.items()
    }
    return pydantic.create_model("Model", __base__=ModelFile, **fields).model_json_schema()


def _table_model(kind: Kind, name: str = "") -> Any:
    """Model of a table, whose numbers may be names of parameters."""
    owner = _OWNERS[kind.owner]
    fields: Any = {"kind": (Literal[name], ...)} if name else {}
    fields |= {kind.owner: (owner.type, ...)} if owner else {}
    for key, slot in kind.slots.items():
        valid = slot.type if slot.unit is None else slot.type | str | tuple[Any, ...]
        fields[key] = (
            Annotated[valid, Field(description=slot.unit and f"[{slot.unit}]")],
            ... if slot.needed else None,
        )
    return pydantic.create_model(name or "body", __base__=Entries, **fields)
