"""The joint catalogue: one entry per kind of joint, made of constraint primitives.

A joint has a frame on each of its two bodies. The frames coincide at the joint's zero; z is the
axis of motion, if there is one. An entry of `CATALOGUE` lists the primitives between the frames'
axes, the primitives of the report's own rows (cross products with two of three rows kept), and
the relative motions that the joint leaves free. A new joint is one entry, one function and one row
of tests; a new relative motion is one class, see `stmuav_jax.mechanics.motions.base`.

Source: report Part I, section 3.4 (Eq. 3.11 to 3.14).
"""

import dataclasses
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import rotation_matrix_in
from ..checks.errors import ModelError, concrete
from ..checks.numbers import array_module, as_numpy, floats, scalar, vector
from ..checks.shapes import Numbers
from .body import Body
from .constraint import ROWS, Data
from .joint_kind import Freedom, JointKind, Term, Which, X, Y, Z
from .motions.axial import PRISMATIC, REVOLUTE, SCREW
from .motions.spherical import SPHERICAL

Motion = Callable[[Float[Array, ""]], Float[Array, ""]]

_PARALLEL = (Term("n1", X, Z), Term("n1", Y, Z))
_ON_AXIS = (Term("n2", X), Term("n2", Y))
_POINT = Term("point")
_REVOLUTE, _PRISMATIC = Freedom(REVOLUTE), Freedom(PRISMATIC)

CATALOGUE: dict[str, JointKind] = {
    "weld": JointKind((_POINT, Term("n1", X, Y), Term("n1", Y, Z), Term("n1", Z, X)), ()),
    "spherical": JointKind((_POINT,), (Freedom(SPHERICAL),)),
    "universal": JointKind(
        (_POINT, Term("n1", X, Y)),
        (Freedom(REVOLUTE, X, " about axis_i"), Freedom(REVOLUTE, Y, " about axis_j")),
    ),
    "revolute": JointKind((_POINT, *_PARALLEL), (_REVOLUTE,), (_POINT, Term("p1"))),
    "translational": JointKind(
        (*_PARALLEL, *_ON_AXIS, Term("n1", X, Y)),
        (_PRISMATIC,),
        (Term("p1"), Term("p2"), Term("n1", X, Y)),
    ),
    "cylindrical": JointKind(
        (*_PARALLEL, *_ON_AXIS), (_PRISMATIC, _REVOLUTE), (Term("p1"), Term("p2"))
    ),
    "screw": JointKind(
        (*_PARALLEL, *_ON_AXIS, Term("screw", Z, X, X)),
        (Freedom(SCREW),),
        (Term("p1"), Term("p2"), Term("screw", Z, X, X)),
    ),
    "distance": JointKind((Term("distance"),)),
    "revolute_spherical": JointKind((Term("n2", Z), Term("distance"))),
    "drive_angle": JointKind((Term("angle", X, X, Y),)),
    "drive_displacement": JointKind((Term("displacement", Z),)),
}


def kinds_that_leave(which: Which) -> str:
    """Kinds of joints that leave a coordinate free, for messages."""
    return ", ".join(kind for kind, entry in CATALOGUE.items() if which in entry.leaves_free)


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
    point_i: Float[Array, "3"]
    point_j: Float[Array, "3"]
    frame_i: Float[Array, "3 3"]
    frame_j: Float[Array, "3 3"]
    length: Float[Array, ""]
    motion: Motion | None = None

    def terms(self, rows: Literal["body", "report"]) -> tuple[Term, ...]:
        """Primitives of this joint, in the chosen rows."""
        entry = CATALOGUE[self.kind]
        return entry.report if rows == "report" and entry.report is not None else entry.terms

    @property
    def n_rows(self) -> int:
        """Number of the joint's constraint rows."""
        return sum(ROWS[term.kind] for term in self.terms("body"))

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
            point_i=self.point_i - com_i,
            point_j=self.point_j - com_j,
            axis_i=self.frame_i[:, term.axis_i],
            axis_j=self.frame_j[:, term.axis_j],
            side_i=self.frame_i[:, term.side_i],
            length=self.length,
        )


def resolve(joint: Joint, i: Body | None, j: Body | None) -> Joint:
    """Joint with points and frames in its bodies' reference frames (None stands for ground)."""
    if not joint.in_world:
        return joint

    def fix(body: Body | None, point: Array, frame: Array) -> tuple[Array, Array]:
        if body is None:
            return point, frame
        point, frame, p, position = as_numpy((point, frame, body.orientation, body.position))
        R_bw = rotation_matrix_in(array_module(p, point, frame, position), p).T
        return floats(R_bw @ (point - position)), floats(R_bw @ frame)

    point_i, frame_i = fix(i, joint.point_i, joint.frame_i)
    point_j, frame_j = fix(j, joint.point_j, joint.frame_j)
    return dataclasses.replace(
        joint, in_world=False, point_i=point_i, point_j=point_j, frame_i=frame_i, frame_j=frame_j
    )


def _unit(axis: Numbers, what: str) -> Float[Array, "3"]:
    along = as_numpy(vector(axis, what, ""))
    length = array_module(along).sqrt(along @ along)
    if concrete(along) and float(length) == 0:
        raise ModelError(f"{what} has zero length; give any non-zero vector along it.")
    return floats(along / length)


def _frame_about(z: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Right-handed frame with the given third column, its x axis near the least aligned axis."""
    z, module = as_numpy(z), array_module(z)
    other = module.eye(3, dtype=z.dtype)[module.argmin(module.abs(z))]
    x = other - (other @ z) * z
    x = x / module.sqrt(x @ x)
    return floats(module.stack([x, module.cross(z, x), z], axis=1))


def _joint(
    kind: str,
    name: str,
    body_i: str,
    body_j: str,
    point_i: Numbers,
    point_j: Numbers,
    frame: Float[Array, "3 3"],
    length: Numbers = 0.0,
) -> Joint:
    what = f"A point of joint '{name}'"
    points = vector(point_i, what, "m"), vector(point_j, what, "m")
    if body_i == body_j:
        raise ModelError(f"Joint '{name}' joins body '{body_i}' to itself.")
    return Joint(
        name=name,
        kind=kind,
        body_i=body_i,
        body_j=body_j,
        in_world=True,
        point_i=points[0],
        point_j=points[1],
        frame_i=frame,
        frame_j=frame,
        length=floats(length),
    )


_ORIGIN = (0.0, 0.0, 0.0)


def weld(name: str, body_i: str, body_j: str, *, point: Numbers = _ORIGIN) -> Joint:
    """Rigid connection of two bodies; 6 rows. `point` (3,) [m]: point of the reaction."""
    return _joint("weld", name, body_i, body_j, point, point, floats(np.eye(3)))


def spherical(name: str, body_i: str, body_j: str, *, point: Numbers) -> Joint:
    """Spherical joint at a point in world coordinates at the reference posture (3,) [m]; 3 rows."""
    return _joint("spherical", name, body_i, body_j, point, point, floats(np.eye(3)))


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
    x = _unit(axis_i, f"axis_i of joint '{name}'")
    y = _unit(axis_j, f"axis_j of joint '{name}'")
    cosine = float(np.dot(x, y)) if concrete(x, y) else 0.0
    if abs(cosine) > 1e-9:
        degrees = float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))
        raise ModelError(
            f"The axes of universal joint '{name}' must be perpendicular, but they are "
            f"{degrees:.6g} degrees apart."
        )
    module, (x, y) = array_module(x, y), as_numpy((x, y))
    frame = floats(module.stack([x, y, module.cross(x, y)], axis=1))
    return _joint("universal", name, body_i, body_j, point, point, frame)


def revolute(name: str, body_i: str, body_j: str, *, point: Numbers, axis: Numbers) -> Joint:
    """Revolute joint about an axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("revolute", name, body_i, body_j, point, point, frame)


def translational(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Prismatic joint along an axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("translational", name, body_i, body_j, point, point, frame)


def cylindrical(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Cylindrical joint about and along an axis through `point` (3,) [m]; 4 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("cylindrical", name, body_i, body_j, point, point, frame)


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
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    value = scalar(pitch, f"The pitch of joint '{name}'", "m/rad")
    if concrete(value) and float(value) == 0:
        raise ModelError(
            f"The pitch of joint '{name}' must not be zero; a joint without one is revolute."
        )
    return _joint("screw", name, body_i, body_j, point, point, frame, value)


def _length(name: str, point_i: Numbers, point_j: Numbers, length: Numbers | None) -> Numbers:
    ends = as_numpy((floats(point_i), floats(point_j)))
    apart = ends[1] - ends[0]
    value = floats(array_module(apart).sqrt(apart @ apart) if length is None else length)
    if concrete(value) and not (np.isfinite(float(value)) and float(value) > 0):
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
    value = _length(name, point_i, point_j, length)
    return _joint("distance", name, body_i, body_j, point_i, point_j, floats(np.eye(3)), value)


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
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    value = _length(name, point_i, point_j, length)
    return _joint("revolute_spherical", name, body_i, body_j, point_i, point_j, frame, value)


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
