"""Schema of a model's file, formats 1 and 2: names, types and units of all its entries.

A kind of force element is one line of `FORCES`; the kinds of joints are those of the catalogue. The
entries of either are the arguments of the function that makes it. docs/models.md lists them.
"""

import inspect
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple

import pydantic
from pydantic import AfterValidator, Field

from ..checks.errors import SettingError, concrete, nearest_names
from ..checks.schema import SHOWN, Entries, Finite, Positive, Tuples, checked, named, shown
from ..control.instruments import Instrument
from ..mechanics import joint as joints
from ..mechanics.body import Body
from ..mechanics.forces import applied
from ..mechanics.forces.contact import GroundContact
from ..mechanics.forces.effort import JointEffort
from ..mechanics.forces.joint import EndStop, JointFriction, JointServo
from ..mechanics.load import SineMotion
from ..montecarlo.schema import Name
from ..parameters.table import Parameter
from ..rotorcraft.rotor import Rotors
from ..sensing.sensors import SENSORS

# Formats that are read; the second has sensors.
MODEL_FORMATS = (1, 2)

Triple = Annotated[tuple[Finite, Finite, Finite], Tuples]
Rows = Annotated[tuple[Triple, Triple, Triple], Tuples]
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], Tuples]
Pair = Annotated[tuple[str, str], Tuples]
Several = Annotated[tuple[Finite, ...], Tuples]
Triples = Annotated[tuple[Triple, ...], Tuples]


def _shaped(kinds: Any, words: str) -> AfterValidator:
    """Check that a value is of one of some shapes; a message says what it must be."""
    shape = pydantic.TypeAdapter(kinds)

    def check(value: Any) -> Any:
        try:
            return shape.validate_python(value)
        except pydantic.ValidationError:
            raise ValueError(f"must be {words}, but it is {shown(value)}.") from None

    return AfterValidator(check)


_INERTIA = _shaped(Triple | Rows, "three moments or three rows of three numbers")
_VALUE = _shaped(Finite | Several | Triples, "finite numbers")
# One number, or one for each component.
Size = Annotated[Any, _shaped(Finite | Several, "a number or a list of numbers")]


def _format(value: int) -> int:
    if value not in MODEL_FORMATS:
        known = " and ".join(map(str, MODEL_FORMATS))
        raise ValueError(f"is {shown(value)}, but this version reads the formats {known}.")
    return value


Inertia = Annotated[Any, _INERTIA]


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
    """

    make: Callable[..., Any]
    owner: str
    slots: Mapping[str, Entry]


def _maybe(slot: Entry) -> Entry:
    return slot._replace(needed=False)


def _driver(coordinate: Any) -> Callable[..., joints.Joint]:
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


def _joint(kind: str) -> Kind:
    """Table of a kind of joint, from the signature of its function."""
    own = _keywords(kind)
    slots = {name: _ARGUMENTS[name]._replace(needed=own[name]) for name in own}
    return Kind(getattr(joints, kind), "bodies", slots)


def _keywords(kind: str) -> dict[str, bool]:
    """Keyword arguments of a joint's function, and for each whether it is needed."""
    own = inspect.signature(getattr(joints, kind)).parameters.values()
    return {p.name: p.default is p.empty for p in own if p.kind is p.KEYWORD_ONLY}


def _named() -> list[str]:
    """Kinds of joints whose functions take what a file can hold; those of a user are not among them."""
    own = [kind for kind in joints.CATALOGUE if hasattr(joints, kind)]
    return [kind for kind in own if _keywords(kind).keys() <= _ARGUMENTS.keys()]


JOINTS: dict[str, Kind] = {
    **{kind: _joint(kind) for kind in _named()},
    "drive_angle": Kind(_driver("angle"), "joint", _MOTION),
    "drive_displacement": Kind(_driver("displacement"), "joint", _MOTION),
}

# Geometry of a joint in the reference frames of its bodies, by which saved models give it.
IN_BODIES: dict[str, Entry] = {
    "point_i": _POINT, "point_j": _POINT,
    "frame_i": Entry(Rows, "1"), "frame_j": Entry(Rows, "1"),
    "length": Entry(Finite, "m or m/rad"),
}  # fmt: skip

_STIFFNESS, _DAMPING = Entry(Finite, "N/m or N m/rad"), Entry(Finite, "N s/m or N m s/rad")
_COORDINATE, _EFFORT = Entry(Finite, "m or rad"), Entry(Finite, "N or N m")

FORCES: dict[str, Kind] = {
    "gravity": Kind(applied.Gravity, "", {"acceleration": Entry(Triple, "m/s^2", needed=False)}),
    "spring": Kind(applied.LinearSpringDamper, "bodies", {
        "point_i": _maybe(_POINT), "point_j": _maybe(_POINT), "stiffness": Entry(Finite, "N/m"),
        "damping": Entry(Finite, "N s/m", needed=False), "length": _LENGTH,
    }),
    "torsional_spring": Kind(applied.TorsionalSpringDamper, "joint", {
        "stiffness": Entry(Finite, "N m/rad"), "damping": Entry(Finite, "N m s/rad", needed=False),
        "angle": Entry(Finite, "rad", needed=False),
    }),
    "damping": Kind(applied.JointDamping, "joint", {
        "turning": Entry(Finite, "N m s/rad", needed=False),
        "sliding": Entry(Finite, "N s/m", needed=False),
    }),
    "servo": Kind(JointServo, "joint", {
        "stiffness": _STIFFNESS, "damping": _DAMPING, "target": _COORDINATE, "coordinate": _WHICH,
    }),
    "end_stop": Kind(EndStop, "joint", {
        "lower": _maybe(_COORDINATE), "upper": _maybe(_COORDINATE), "stiffness": _STIFFNESS,
        "damping": _DAMPING, "width": _COORDINATE, "coordinate": _WHICH,
    }),
    "friction": Kind(JointFriction, "joint", {
        "coulomb": _EFFORT, "viscous": _maybe(_DAMPING), "speed": Entry(Finite, "m/s or rad/s"),
        "coordinate": _WHICH,
    }),
    "effort": Kind(JointEffort, "joint", {"effort": _EFFORT, "coordinate": _WHICH}),
    "ground_contact": Kind(GroundContact, "body", {
        "feet": Entry(Triples, "m"), "height": _LENGTH, "stiffness": Entry(Finite, "N/m"),
        "damping": Entry(Finite, "N s/m"), "width": Entry(Finite, "m"), "friction": Entry(Finite, "1"),
        "slip_speed": Entry(Finite, "m/s"),
    }),
    "force": Kind(applied.AppliedForce, "body", {
        "force": Entry(Triple, "N"), "frame": _FRAME, "point": _maybe(_POINT),
    }),
    "moment": Kind(applied.AppliedMoment, "body", {"moment": Entry(Triple, "N m"), "frame": _FRAME}),
    "rotors": Kind(Rotors, "body", {
        "arms": Entry(Triples, "m"), "spin": Entry(Several, "1"), "k_f": Entry(Finite, "N s^2/rad^2"),
        "k_tau": Entry(Finite, "N m s^2/rad^2"), "speed_squared": Entry(Several, "rad^2/s^2"),
    }),
}  # fmt: skip


def _sensor(name: str, unit: str, **own: Entry) -> Kind:
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
    "gyroscope": _sensor("gyroscope", "rad/s", axes=_AXES),
    "accelerometer": _sensor("accelerometer", "m/s^2", point=_maybe(_POINT), axes=_AXES),
    "encoder": _sensor("encoder", "m or rad", coordinate=_WHICH),
    "position": _sensor("position", "m", point=_maybe(_POINT)),
    "attitude": _sensor("attitude", "rad"),
}

BODY = Kind(Body, "", {
    "mass": Entry(Finite, "kg"), "inertia": Entry(Inertia, "kg m^2"), "com": _maybe(_POINT),
    "position": _maybe(_POINT), "com_position": _maybe(_POINT),
    "orientation": Entry(Quaternion, "1", needed=False), "free": Entry(bool, needed=False),
    "triangle_tolerance": Entry(Finite, "1", needed=False),
})  # fmt: skip

START_BODY: dict[str, Entry] = {
    "com_position": _maybe(_POINT), "orientation": Entry(Quaternion, "1", needed=False),
    "velocity": Entry(Triple, "m/s", needed=False),
    "angular_velocity": Entry(Triple, "rad/s", needed=False),
}  # fmt: skip


class ModelParameter(Entries):
    """Entry of a parameter, to which the entries of bodies, joints and forces may refer."""

    value: Annotated[Any, _VALUE]
    unit: str
    source: str


class StartEntry(Entries):
    """Entry for the state at the start."""

    coordinates: dict[str, Any] = Field(default_factory=dict)
    rates: dict[str, Any] = Field(default_factory=dict)
    bodies: dict[str, dict[str, Any]] = Field(default_factory=dict)


class ModelFile(Entries):
    """Entries of a model; the tables of bodies, joints and forces are checked by `entries`."""

    format: Annotated[int, AfterValidator(_format)]
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
    start: StartEntry = StartEntry()


_OWNERS = {"bodies": Entry(Pair), "body": Entry(str), "joint": Entry(str), "": None}


def kind_of(given: Mapping[str, Any], kinds: Mapping[str, Kind], what: str) -> Kind:
    """Kind that a table names; raises `SettingError` if it names none of them."""
    kind = given.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        wrong = "needs 'kind'." if kind is None else f"has the kind {shown(kind)}."
        raise SettingError(f"{what} {wrong}{nearest_names(str(kind)[:SHOWN], kinds)}")
    return kinds[kind]


def entries(
    given: Mapping[str, Any],
    slots: Mapping[str, Entry],
    parameters: Mapping[str, Parameter],
    what: str,
    *,
    owner: str = "",
    kind: bool = False,
) -> dict[str, Any]:
    """Entries of a table with their parameters' values, all types checked.

    Args:
        what: subject of messages, such as "A revolute joint".
        owner: entry that names bodies or a joint. kind: True if the table names its kind.

    Raises:
        SettingError: an entry is unknown, missing or of another type, or refers to an unknown
            parameter or to one of another unit.
    """
    own = _OWNERS[owner]
    every = {**({"kind": Entry(str)} if kind else {}), **({owner: own} if own else {}), **slots}
    filled = {
        key: value if (slot := every.get(key)) is None or slot.unit is None
        else with_parameters(value, parameters, key, slot.unit)
        for key, value in given.items()
    }  # fmt: skip
    if not concrete(filled):
        # traced numbers have been checked with the values of the file
        return {key: filled[key] for key in every if key in filled}
    fields: Any = {key: (s.type, ... if s.needed else None) for key, s in every.items()}
    model = pydantic.create_model("Table", __base__=Entries, **fields)
    found = checked(model, filled, what)
    return {key: getattr(found, key) for key in every if key in found.model_fields_set}


def with_parameters(
    value: Any, parameters: Mapping[str, Parameter], key: str, unit: str = ""
) -> Any:
    """Value in which each text is replaced by the value of the parameter that it names."""
    if isinstance(value, list):
        # arrays have at most two axes; what is deeper is refused later
        return [
            with_parameters(x, parameters, key, unit) if not isinstance(x, list) or _flat(x) else x
            for x in value
        ]
    if not isinstance(value, str):
        return value
    if value not in parameters:
        raise SettingError(
            f"'{key}' must be numbers or the names of parameters, but there is no parameter "
            f"{named(value)}.{nearest_names(value[:SHOWN], parameters)}"
        )
    found = parameters[value]
    if unit and found.unit not in unit.split(" or "):
        raise SettingError(
            f"'{key}' is a quantity in {unit}, but the parameter '{value}' is in "
            f"{shown(found.unit)}."
        )
    return _lists(found.value)


def _flat(value: list[Any]) -> bool:
    return not any(isinstance(x, list) for x in value)


def _lists(value: Any) -> Any:
    return [_lists(x) for x in value] if isinstance(value, tuple) else value
