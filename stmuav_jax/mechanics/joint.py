"""The joint catalogue: one entry per kind of joint, made of constraint primitives.

A joint has a frame on each of its two bodies. The frames coincide at the joint's zero; z is the
axis of motion, if there is one. An entry of `CATALOGUE` lists the primitives between the frames'
axes and the relative motions that the joint leaves free. A new joint is one entry, one function and
one row of tests; a new relative motion is one class, see `stmuav_jax.mechanics.motions`.

Source: report Part I, section 3.4 (Eq. 3.11 to 3.14).
"""

import dataclasses
from collections.abc import Callable, Mapping
from fractions import Fraction
from typing import Literal, NamedTuple, get_args

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, has_values
from ..checks.numbers import array_module, as_floats, as_numpy, check_scalar, check_vector
from ..checks.shapes import Numbers, Scalar, Vec3
from ..math.native.structure import has_structure
from ..math.rotation import rotation_matrix_in
from .body import Body
from .constraint import COUPLINGS, ROWS, Data
from .motions import PRISMATIC, REVOLUTE, SCREW, SPHERICAL, AbstractRelativeMotion, MotionColumn

# Name of a coordinate that a joint may leave free.
Which = Literal["angle", "displacement"]

X, Y, Z = 0, 1, 2


class Term(NamedTuple):
    """One primitive of a joint: the columns of frame i and frame j that are its axes and side."""

    kind: str
    axis_i: int = Z
    axis_j: int = Z
    side_i: int = Y


class Freedom(NamedTuple):
    """One relative motion that a joint leaves free.

    Attributes:
        motion: kind of relative motion. axis: axis of the joint's frame that is its z axis.
        place: words that distinguish its coordinates from those of the joint's other motions.
    """

    motion: AbstractRelativeMotion
    axis: int = Z
    place: str = ""


class JointKind(NamedTuple):
    """Constraints of a kind of joint, and the relative motion that it leaves free.

    Attributes:
        terms: primitives of the joint.
        motion: relative motions that lead from frame i to frame j, in sequence; None for a
            joint without such coordinates, which can only close a loop.
    """

    terms: tuple[Term, ...]
    motion: tuple[Freedom, ...] | None = None

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        """Columns of the motion subspaces about or along the joint's z axis."""
        z_freedoms = (f for f in self.motion or () if f.axis == Z and len(f.motion.columns) == 1)
        return tuple(column for freedom in z_freedoms for column in freedom.motion.columns)

    @property
    def leaves_free(self) -> tuple[Which, ...]:
        """Coordinates that are free about or along the joint's z axis."""
        # A screw has both in one column: its angle and its displacement are each a coordinate that
        # a force or a sensor may name.
        free = {(c.angular != 0, c.linear != 0) for c in self.columns}
        return tuple(
            coordinate for k, coordinate in enumerate(get_args(Which)) if any(f[k] for f in free)
        )

    @property
    def pitched(self) -> bool:
        """True if the `length` of such a joint is a pitch [m/rad]."""
        return any(column.linear is None for column in self.columns)


Motion = Callable[[Scalar], Scalar]

# Kinds of joints are data, and primitives are the only code: a new kind is one more entry, and
# both formulations, the assembly and the sensors read it from there.
_PARALLEL = (Term("n1", X, Z), Term("n1", Y, Z))
_ON_AXIS = (Term("n2", X), Term("n2", Y))
_POINT = Term("point")
# Terms that read a joint's coordinate.
READING: dict[str, Term] = {
    "angle": Term("angle", X, X, Y),
    "displacement": Term("displacement", Z),
}
_REVOLUTE, _PRISMATIC = Freedom(REVOLUTE), Freedom(PRISMATIC)

CATALOGUE: dict[str, JointKind] = {
    "weld": JointKind((_POINT, Term("n1", X, Y), Term("n1", Y, Z), Term("n1", Z, X)), ()),
    "spherical": JointKind((_POINT,), (Freedom(SPHERICAL),)),
    "universal": JointKind(
        (_POINT, Term("n1", X, Y)),
        (Freedom(REVOLUTE, X, " about axis_i"), Freedom(REVOLUTE, Y, " about axis_j")),
    ),
    "revolute": JointKind((_POINT, *_PARALLEL), (_REVOLUTE,)),
    "translational": JointKind((*_PARALLEL, *_ON_AXIS, Term("n1", X, Y)), (_PRISMATIC,)),
    "cylindrical": JointKind((*_PARALLEL, *_ON_AXIS), (_PRISMATIC, _REVOLUTE)),
    "screw": JointKind((*_PARALLEL, *_ON_AXIS, Term("screw", Z, X, X)), (Freedom(SCREW),)),
    # Massless links have constraints but no coordinates that a tree could use: they always close a
    # loop.
    "distance": JointKind((Term("distance"),)),
    "revolute_spherical": JointKind((Term("n2", Z), Term("distance"))),
    **{f"drive_{coordinate}": JointKind((term,)) for coordinate, term in READING.items()},
    **{
        f"mimic_{kind}": JointKind((READING[dependent]._replace(kind=kind),))
        for kind, (dependent, _) in COUPLINGS.items()
    },
}


def kinds_that_leave(coordinate: Which) -> str:
    """Kinds of joints that leave a coordinate free, for messages."""
    return ", ".join(kind for kind, entry in CATALOGUE.items() if coordinate in entry.leaves_free)


class Mate(eqx.Module):
    """Joint whose coordinate x_a another one follows, x_b = ratio x_a + offset.

    Attributes:
        dependent: name of the joint of x_b. joint: that of x_a. ratio: per unit of x_a. offset: in the unit of x_b.
        period: value up to which whole turns leave x_b - ratio x_a; infinite for none.
        coordinates: which ones x_b and x_a are.
    """

    dependent: str = eqx.field(static=True)
    coordinates: tuple[Which, Which] = eqx.field(static=True)
    joint: "Joint"
    ratio: Scalar
    offset: Scalar
    period: Scalar


@has_structure(zero=("point_i", "point_j"), unit=("frame_i", "frame_j"))
class Joint(eqx.Module):
    """Joint between two named bodies, either of which may be "ground".

    The functions below make joints. In a `System` points and frames are in the bodies' reference
    frames: `point_i`, `point_j` (3,) [m], `frame_i`, `frame_j` (3, 3) with the joint's x, y, z
    axes as columns; before, in the world at the reference posture. `length`: of a rod [m], or the
    pitch of a screw [m/rad].
    """

    name: str = eqx.field(static=True)
    kind: str = eqx.field(static=True)
    body_i: str = eqx.field(static=True)
    body_j: str = eqx.field(static=True)
    in_world: bool = eqx.field(static=True)
    point_i: Vec3
    point_j: Vec3
    frame_i: Float[Array, "3 3"]
    frame_j: Float[Array, "3 3"]
    length: Scalar
    motion: Motion | None = None
    mate: Mate | None = None

    @property
    def n_rows(self) -> int:
        """Number of the joint's constraint rows."""
        return sum(ROWS[term.kind] for term in CATALOGUE[self.kind].terms)

    @property
    def pitched(self) -> bool:
        """True if the joint's `length` is the pitch of a screw [m/rad]."""
        return CATALOGUE[self.kind].pitched

    def data(
        self,
        term: Term,
        com_i: Float[Array | np.ndarray, "3"],
        com_j: Float[Array | np.ndarray, "3"],
    ) -> Data:
        """Body-fixed parameters of one primitive, with points relative to the centres of mass."""
        return Data(
            self.point_i - com_i, self.point_j - com_j, self.frame_i[:, term.axis_i],
            self.frame_j[:, term.axis_j], self.frame_i[:, term.side_i], self.length,
        )  # fmt: skip


def free_coordinates(joint: Joint) -> list[Which]:
    """Coordinates that a joint leaves free: "angle" about its z axis, "displacement" along it."""
    return list(CATALOGUE[joint.kind].leaves_free)


def choose_coordinate(joint: Joint, coordinate: Which | None, subject: str) -> Which:
    """Select a free coordinate of a joint: the named one, or else the only one.

    Args:
        subject: subject of the error's sentence.

    Raises:
        ModelError: the joint does not leave it free, or leaves both free and none is named.
    """
    free = free_coordinates(joint)
    if coordinate in free:
        return coordinate
    if coordinate is None and len(free) == 1:
        return free[0]
    if coordinate is None and free:
        raise ModelError(
            f"{subject}: a {joint.kind} joint leaves both an angle and a displacement free; say which by "
            "coordinate='angle' or coordinate='displacement'."
        )
    names: tuple[Which, ...] = ("angle", "displacement") if coordinate is None else (coordinate,)
    needed = "; ".join(f"{name} needs one of: {kinds_that_leave(name)}" for name in names)
    coordinate_text = "an angle or a displacement" if coordinate is None else f"the {coordinate}"
    raise ModelError(
        f"{subject} acts on {coordinate_text}, but a {joint.kind} joint does not leave that free about or "
        f"along one axis ({needed})."
    )


def resolve_joint(joint: Joint, bodies: Mapping[str, Body]) -> Joint:
    """Joint with points and frames in its bodies' reference frames; ground is not among the bodies."""
    if joint.mate is not None:
        # A coupling has a copy of the other joint, whose frames are resolved like its own: its row
        # can be evaluated without a look at the other joints.
        mate = dataclasses.replace(joint.mate, joint=resolve_joint(joint.mate.joint, bodies))
        joint = dataclasses.replace(joint, mate=mate)
    if not joint.in_world:
        return joint
    i, j = bodies.get(joint.body_i), bodies.get(joint.body_j)

    def fix_frame(body: Body | None, point: Array, frame: Array) -> tuple[Array, Array]:
        if body is None:
            return point, frame
        point, frame, p, position = as_numpy((point, frame, body.orientation, body.position))
        # In NumPy where numbers are known, so that building a model compiles nothing; in JAX where
        # lengths are differentiated.
        R_bw = rotation_matrix_in(array_module(p, point, frame, position), p).T
        return as_floats(R_bw @ (point - position)), as_floats(R_bw @ frame)

    point_i, frame_i = fix_frame(i, joint.point_i, joint.frame_i)
    point_j, frame_j = fix_frame(j, joint.point_j, joint.frame_j)
    return dataclasses.replace(
        joint, in_world=False, point_i=point_i, point_j=point_j, frame_i=frame_i, frame_j=frame_j
    )


def _unit_axis(axis: Numbers, subject: str) -> Vec3:
    axis_vector = as_numpy(check_vector(axis, subject, ""))
    length = array_module(axis_vector).sqrt(axis_vector @ axis_vector)
    if has_values(axis_vector) and float(length) == 0:
        raise ModelError(f"{subject} has zero length; give any non-zero vector along it.")
    return as_floats(axis_vector / length)


def _frame_about(z: Vec3) -> Float[Array, "3 3"]:
    """Right-handed frame with the given third column, its x axis near the least aligned axis."""
    z, module = as_numpy(z), array_module(z)
    # Any x axis would do for a hinge. The least aligned one keeps the division away from zero for
    # every direction of the axis.
    other = module.eye(3, dtype=z.dtype)[module.argmin(module.abs(z))]
    x = other - (other @ z) * z
    x = x / module.sqrt(x @ x)
    return as_floats(module.stack([x, module.cross(z, x), z], axis=1))


def _make_joint(
    kind: str,
    name: str,
    body_i: str,
    body_j: str,
    point_i: Numbers,
    point_j: Numbers,
    frame: Float[Array, "3 3"],
    length: Numbers = 0.0,
) -> Joint:
    subject = f"A point of joint '{name}'"
    # Points and axes are given in the world at the reference posture, the only frame that all bodies
    # share.
    points = check_vector(point_i, subject, "m"), check_vector(point_j, subject, "m")
    if body_i == body_j:
        raise ModelError(
            f"Joint '{name}' joins body '{body_i}' to itself: name two different bodies."
        )
    return Joint(name, kind, body_i, body_j, True, *points, frame, frame, as_floats(length))


_ORIGIN = (0.0, 0.0, 0.0)


def weld(name: str, body_i: str, body_j: str, *, point: Numbers = _ORIGIN) -> Joint:
    """Rigid connection of two bodies; 6 rows. `point` (3,) [m]: point of the reaction."""
    return _make_joint("weld", name, body_i, body_j, point, point, as_floats(np.eye(3)))


def spherical(name: str, body_i: str, body_j: str, *, point: Numbers) -> Joint:
    """Spherical joint at a point in world coordinates at the reference posture (3,) [m]; 3 rows."""
    return _make_joint("spherical", name, body_i, body_j, point, point, as_floats(np.eye(3)))


def universal(
    name: str, body_i: str, body_j: str, *, point: Numbers, axis_i: Numbers, axis_j: Numbers
) -> Joint:
    """Universal joint: a common point and two perpendicular axes, one fixed in each body; 4 rows.

    Args:
        point: world coordinates at the reference posture (3,) [m].
        axis_i, axis_j: axes fixed in body i and in body j, in the world (3,), of any length.

    Raises:
        ModelError: an axis has zero length, or the axes are not perpendicular.
    """
    x = _unit_axis(axis_i, f"axis_i of joint '{name}'")
    y = _unit_axis(axis_j, f"axis_j of joint '{name}'")
    # Two axes that are not perpendicular would make a joint that cannot be assembled; silently turning
    # one would change the model.
    cosine = float(np.dot(x, y)) if has_values(x, y) else 0.0
    if abs(cosine) > 1e-9:
        degrees = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        raise ModelError(
            f"The axes of universal joint '{name}' must be perpendicular, but they are "
            f"{degrees:.6g} degrees apart."
        )
    module, (x, y) = array_module(x, y), as_numpy((x, y))
    frame = as_floats(module.stack([x, y, module.cross(x, y)], axis=1))
    return _make_joint("universal", name, body_i, body_j, point, point, frame)


def revolute(name: str, body_i: str, body_j: str, *, point: Numbers, axis: Numbers) -> Joint:
    """Revolute joint about an axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit_axis(axis, f"The axis of joint '{name}'"))
    return _make_joint("revolute", name, body_i, body_j, point, point, frame)


def translational(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Prismatic joint along an axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit_axis(axis, f"The axis of joint '{name}'"))
    return _make_joint("translational", name, body_i, body_j, point, point, frame)


def cylindrical(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Cylindrical joint about and along an axis through `point` (3,) [m]; 4 rows."""
    frame = _frame_about(_unit_axis(axis, f"The axis of joint '{name}'"))
    return _make_joint("cylindrical", name, body_i, body_j, point, point, frame)


def screw(
    name: str, body_i: str, body_j: str, *, point: Numbers, axis: Numbers, pitch: Numbers
) -> Joint:
    """Screw joint: rotation about and displacement along an axis by one coordinate; 5 rows.

    Args:
        point, axis: the axis, world at the reference posture (3,) [m] and (3,), of any length.
        pitch: displacement of body j along the axis per angle about it [m/rad], not zero, positive
            for a right-handed thread; the lead of the thread is 2 pi times as much.

    Raises:
        ModelError: the axis has zero length, or the pitch is zero or not finite.
    """
    frame = _frame_about(_unit_axis(axis, f"The axis of joint '{name}'"))
    value = check_scalar(pitch, f"The pitch of joint '{name}'", "m/rad")
    # Only known numbers can be compared: a pitch that is traced is not checked.
    if has_values(value) and float(value) == 0:
        raise ModelError(
            f"The pitch of joint '{name}' must not be zero; a joint without one is revolute."
        )
    return _make_joint("screw", name, body_i, body_j, point, point, frame, value)


def _rod_length(name: str, point_i: Numbers, point_j: Numbers, length: Numbers | None) -> Numbers:
    ends = as_numpy((as_floats(point_i), as_floats(point_j)))
    separation = ends[1] - ends[0]
    value = as_floats(
        array_module(separation).sqrt(separation @ separation) if length is None else length
    )
    if has_values(value) and not (np.isfinite(float(value)) and float(value) > 0):
        raise ModelError(f"The length of joint '{name}' must be positive, but it is {value} m.")
    return value


def distance(
    name: str,
    body_i: str,
    body_j: str,
    *,
    point_i: Numbers,
    point_j: Numbers,
    length: Numbers | None = None,
) -> Joint:
    """Massless rod with a spherical joint at each end; 1 row.

    Args:
        point_i, point_j: its ends on the two bodies, world at reference (3,) [m].
        length: length of the rod [m]; by default the distance of the points.
    """
    value = _rod_length(name, point_i, point_j, length)
    return _make_joint(
        "distance", name, body_i, body_j, point_i, point_j, as_floats(np.eye(3)), value
    )


def revolute_spherical(
    name: str,
    body_i: str,
    body_j: str,
    *,
    point_i: Numbers,
    axis: Numbers,
    point_j: Numbers,
    length: Numbers | None = None,
) -> Joint:
    """Massless link with a revolute joint on body i and a spherical joint on body j; 2 rows.

    Args:
        point_i, axis: the axis in body i, world at reference (3,) [m] and (3,).
        point_j: centre of the spherical joint (3,) [m], in the plane through `point_i`
            perpendicular to the axis.
        length: length of the link [m]; by default the distance of the points.
    """
    frame = _frame_about(_unit_axis(axis, f"The axis of joint '{name}'"))
    value = _rod_length(name, point_i, point_j, length)
    return _make_joint("revolute_spherical", name, body_i, body_j, point_i, point_j, frame, value)


def drive(name: str, joint: Joint, motion: Motion, *, coordinate: Which) -> Joint:
    """Prescribe a relative coordinate of a joint as a function of time; 1 row, rheonomic.

    Args:
        joint: joint whose frames define the coordinate (its z axis).
        motion: function from t [s] to the coordinate: the angle [rad] from body i to body j about
            z, or the displacement [m] of j's point along z from i's, zero at the reference
            posture. JAX must be able to differentiate it twice.

    Raises:
        ModelError: the joint does not leave this coordinate free.
    """
    if coordinate not in CATALOGUE[joint.kind].leaves_free:
        raise ModelError(
            f"Driver '{name}' prescribes the {coordinate} of joint '{joint.name}', but a "
            f"{joint.kind} joint does not leave it free; {coordinate} needs one of: {kinds_that_leave(coordinate)}."
        )
    return dataclasses.replace(joint, name=name, kind=f"drive_{coordinate}", motion=motion)


# Largest number of teeth of a pair of wheels, by which whole turns of a ratio are told.
_MOST_TEETH = 64


def mimic(
    name: str,
    joint: Joint,
    mate: Joint,
    *,
    ratio: Numbers,
    offset: Numbers = 0.0,
    coordinate: Which | None = None,
    mate_coordinate: Which | None = None,
) -> Joint:
    """Couple the coordinates of two joints, x_b = ratio x_a + offset: gears, racks, mimic joints; 1 row.

    Whole turns of both joints count where the ratio of two angles is a fraction with a denominator of at most
    64, or one of the coordinates is a displacement; other ratios hold within half a turn of both joints.
    The load of the coupling is the effort on x_b; that on x_a, -ratio times as much, is part of
    the load of the mate.

    Args:
        joint: the joint of x_b. mate: the joint of x_a. The system must contain both.
        ratio: dx_b / dx_a, between [rad] and [m]. offset: value of x_b where x_a is zero.
        coordinate, mate_coordinate: "angle" or "displacement" where a joint leaves both free.

    Raises:
        ModelError: a joint leaves no such coordinate free, or a number is not finite.
    """
    subject = f"The coupling '{name}'"
    kinds = (
        choose_coordinate(joint, coordinate, subject),
        choose_coordinate(mate, mate_coordinate, subject),
    )
    k, c = (
        check_scalar(x, f"{label} of {name}", "")
        for x, label in ((ratio, "The ratio"), (offset, "The offset"))
    )
    period: Numbers = np.inf
    if kinds == ("angle", "angle") and has_values(k):
        # The row contains ratio times an angle that is known up to whole turns: for a ratio of p /
        # q it repeats after 1 / q of a turn, and all whole turns of both joints give the same
        # residual.
        fraction = Fraction(float(k)).limit_denominator(_MOST_TEETH)
        if abs(float(k) - fraction) <= 1e-12 * max(1.0, abs(float(k))):
            period = 2 * np.pi / fraction.denominator
    elif kinds == ("angle", "displacement"):
        period = 2 * np.pi
    elif kinds == ("displacement", "angle"):
        period = 2 * np.pi * array_module(k).abs(as_numpy(k))
    return dataclasses.replace(
        joint,
        name=name,
        kind=f"mimic_{'_by_'.join(kinds)}",
        mate=Mate(joint.name, kinds, mate, k, c, as_floats(period)),
    )
