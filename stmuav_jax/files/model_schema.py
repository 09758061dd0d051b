"""Schema of a model's file, format 1: names, types and units of all its entries.

A kind of joint or of force element is one line of `JOINTS` or `FORCES`; its entries are the arguments
of the function that makes it. docs/models.md lists them.
"""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, NamedTuple

import pydantic
from pydantic import AfterValidator, Field

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, Entries, Finite, Positive, Tuples, checked, named, shown
from ..mechanics import joint as joints
from ..mechanics.body import Body
from ..mechanics.forces import applied
from ..mechanics.forces.effort import JointEffort
from ..mechanics.forces.joint import EndStop, JointFriction, JointServo
from ..mechanics.load import SineMotion
from ..montecarlo.schema import Name
from ..rotorcraft.rotor import Rotors

MODEL_FORMAT = 1

Vector = Annotated[tuple[Finite, Finite, Finite], Tuples]
Rows = Annotated[tuple[Vector, Vector, Vector], Tuples]
Quaternion = Annotated[tuple[Finite, Finite, Finite, Finite], Tuples]
Pair = Annotated[tuple[str, str], Tuples]
Several = Annotated[tuple[Finite, ...], Tuples]
Vectors = Annotated[tuple[Vector, ...], Tuples]


def _inertia(value: Any) -> Any:
    shape = pydantic.TypeAdapter(Vector | Rows)
    try:
        return shape.validate_python(value)
    except pydantic.ValidationError:
        raise ValueError(
            f"must be three moments or three rows of three numbers, but it is {shown(value)}."
        ) from None


def _value(value: Any) -> Any:
    shape = pydantic.TypeAdapter(Finite | Several | Vectors)
    try:
        return shape.validate_python(value)
    except pydantic.ValidationError:
        raise ValueError(f"must be finite numbers, but it is {shown(value)}.") from None


def _format(value: int) -> int:
    if value != MODEL_FORMAT:
        raise ValueError(f"is {shown(value)}, but this version reads format {MODEL_FORMAT} alone.")
    return value


Inertia = Annotated[Any, AfterValidator(_inertia)]


class Slot(NamedTuple):
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
    slots: Mapping[str, Slot]


def _maybe(slot: Slot) -> Slot:
    return slot._replace(needed=False)


def _driver(coordinate: Any) -> Callable[..., joints.Joint]:
    def make(name: str, joint: joints.Joint, **numbers: Any) -> joints.Joint:
        return joints.drive(name, joint, SineMotion(**numbers), coordinate=coordinate)

    return make


_POINT, _AXIS = Slot(Vector, "m"), Slot(Vector, "1")
_LENGTH = Slot(Finite, "m", needed=False)
_WHICH = Slot(Literal["angle", "displacement"], needed=False)
_FRAME = Slot(Literal["world", "body"], needed=False)
_ALONG = {"point": _maybe(_POINT), "axis": _AXIS}
_ENDS = {"point_i": _POINT, "point_j": _POINT, "length": _LENGTH}
_SWING = Slot(Finite, "m or rad", needed=False)
_MOTION = {
    "start": _SWING,
    "rate": Slot(Finite, "m/s or rad/s", needed=False),
    "amplitude": _SWING,
    "angular_frequency": Slot(Finite, "rad/s", needed=False),
    "phase": Slot(Finite, "rad", needed=False),
}

JOINTS: dict[str, Kind] = {
    "weld": Kind(joints.weld, "bodies", {"point": _maybe(_POINT)}),
    "spherical": Kind(joints.spherical, "bodies", {"point": _POINT}),
    "universal": Kind(
        joints.universal, "bodies", {"point": _POINT, "axis_i": _AXIS, "axis_j": _AXIS}
    ),
    "revolute": Kind(joints.revolute, "bodies", {"point": _POINT, "axis": _AXIS}),
    "translational": Kind(joints.translational, "bodies", _ALONG),
    "cylindrical": Kind(joints.cylindrical, "bodies", _ALONG),
    "screw": Kind(
        joints.screw, "bodies", {"point": _POINT, "axis": _AXIS, "pitch": Slot(Finite, "m/rad")}
    ),
    "distance": Kind(joints.distance, "bodies", _ENDS),
    "revolute_spherical": Kind(joints.revolute_spherical, "bodies", {"axis": _AXIS, **_ENDS}),
    "drive_angle": Kind(_driver("angle"), "joint", _MOTION),
    "drive_displacement": Kind(_driver("displacement"), "joint", _MOTION),
}

# Geometry of a joint in the reference frames of its bodies, by which saved models give it.
IN_BODIES: dict[str, Slot] = {
    "point_i": _POINT, "point_j": _POINT,
    "frame_i": Slot(Rows, "1"), "frame_j": Slot(Rows, "1"),
    "length": Slot(Finite, "m or m/rad"),
}  # fmt: skip

_STIFFNESS, _DAMPING = Slot(Finite, "N/m or N m/rad"), Slot(Finite, "N s/m or N m s/rad")
_COORDINATE, _EFFORT = Slot(Finite, "m or rad"), Slot(Finite, "N or N m")

FORCES: dict[str, Kind] = {
    "gravity": Kind(applied.Gravity, "", {"acceleration": Slot(Vector, "m/s^2", needed=False)}),
    "spring": Kind(applied.LinearSpringDamper, "bodies", {
        "point_i": _maybe(_POINT), "point_j": _maybe(_POINT), "stiffness": Slot(Finite, "N/m"),
        "damping": Slot(Finite, "N s/m", needed=False), "length": _LENGTH,
    }),
    "torsional_spring": Kind(applied.TorsionalSpringDamper, "joint", {
        "stiffness": Slot(Finite, "N m/rad"), "damping": Slot(Finite, "N m s/rad", needed=False),
        "angle": Slot(Finite, "rad", needed=False),
    }),
    "damping": Kind(applied.JointDamping, "joint", {
        "turning": Slot(Finite, "N m s/rad", needed=False),
        "sliding": Slot(Finite, "N s/m", needed=False),
    }),
    "servo": Kind(JointServo, "joint", {
        "stiffness": _STIFFNESS, "damping": _DAMPING, "target": _COORDINATE, "coordinate": _WHICH,
    }),
    "end_stop": Kind(EndStop, "joint", {
        "lower": _maybe(_COORDINATE), "upper": _maybe(_COORDINATE), "stiffness": _STIFFNESS,
        "damping": _DAMPING, "width": _COORDINATE, "coordinate": _WHICH,
    }),
    "friction": Kind(JointFriction, "joint", {
        "coulomb": _EFFORT, "viscous": _maybe(_DAMPING), "speed": Slot(Finite, "m/s or rad/s"),
        "coordinate": _WHICH,
    }),
    "effort": Kind(JointEffort, "joint", {"effort": _EFFORT, "coordinate": _WHICH}),
    "force": Kind(applied.AppliedForce, "body", {
        "force": Slot(Vector, "N"), "frame": _FRAME, "point": _maybe(_POINT),
    }),
    "moment": Kind(applied.AppliedMoment, "body", {"moment": Slot(Vector, "N m"), "frame": _FRAME}),
    "rotors": Kind(Rotors, "body", {
        "arms": Slot(Vectors, "m"), "spin": Slot(Several, "1"), "k_f": Slot(Finite, "N s^2/rad^2"),
        "k_tau": Slot(Finite, "N m s^2/rad^2"), "speed_squared": Slot(Several, "rad^2/s^2"),
    }),
}  # fmt: skip

BODY = Kind(Body, "", {
    "mass": Slot(Finite, "kg"), "inertia": Slot(Inertia, "kg m^2"), "com": _maybe(_POINT),
    "position": _maybe(_POINT), "com_position": _maybe(_POINT),
    "orientation": Slot(Quaternion, "1", needed=False), "free": Slot(bool, needed=False),
    "triangle_tolerance": Slot(Finite, "1", needed=False),
})  # fmt: skip

START_BODY: dict[str, Slot] = {
    "com_position": _maybe(_POINT), "orientation": Slot(Quaternion, "1", needed=False),
    "velocity": Slot(Vector, "m/s", needed=False),
    "angular_velocity": Slot(Vector, "rad/s", needed=False),
}  # fmt: skip


class ModelParameter(Entries):
    """Entry of a parameter, to which the entries of bodies, joints and forces may refer."""

    value: Annotated[Any, AfterValidator(_value)]
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
    parameters: dict[str, ModelParameter] = Field(default_factory=dict)
    bodies: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, Any]] = Field(default_factory=dict)
    forces: dict[str, dict[str, Any]] = Field(default_factory=dict)
    start: StartEntry = StartEntry()


_OWNERS = {"bodies": Slot(Pair), "body": Slot(str), "joint": Slot(str), "": None}


def kind_of(given: Mapping[str, Any], kinds: Mapping[str, Kind], what: str) -> Kind:
    """Kind that a table names; raises `SettingError` if it names none of them."""
    kind = given.get("kind")
    if not isinstance(kind, str) or kind not in kinds:
        wrong = "needs 'kind'." if kind is None else f"has the kind {shown(kind)}."
        raise SettingError(f"{what} {wrong}{nearest_names(str(kind)[:SHOWN], kinds)}")
    return kinds[kind]


def entries(
    given: Mapping[str, Any],
    slots: Mapping[str, Slot],
    parameters: Mapping[str, ModelParameter],
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
    every = {**({"kind": Slot(str)} if kind else {}), **({owner: own} if own else {}), **slots}
    filled = {
        key: value if (slot := every.get(key)) is None or slot.unit is None
        else with_parameters(value, parameters, key, slot.unit)
        for key, value in given.items()
    }  # fmt: skip
    fields: Any = {key: (s.type, ... if s.needed else None) for key, s in every.items()}
    model = pydantic.create_model("Table", __base__=Entries, **fields)
    found = checked(model, filled, what)
    return {key: getattr(found, key) for key in every if key in found.model_fields_set}


def with_parameters(
    value: Any, parameters: Mapping[str, ModelParameter], key: str, unit: str = ""
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
