"""The joint catalogue: one entry per joint, made of primitives.

A joint carries a frame on each of its two bodies. The frames coincide when the joint is at
its zero; z is the axis of motion where there is one. An entry of `CATALOGUE` lists the
primitives between the frames' axes, the same joint in the report's own rows (cross products
with two of three rows kept), and the relative motion that the joint leaves. A new joint is
one entry, one function and one row of tests.

Source: report Part I, section 3.4 (Eq. 3.11 to 3.14).
"""

import dataclasses
from collections.abc import Callable
from typing import Literal, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import cross, rotation_matrix
from ..algebra.shapes import Numbers
from .body import Body
from .constraint import ROWS, Data
from .errors import ModelError, check_finite, check_shape, concrete

Motion = Callable[[Float[Array, ""]], Float[Array, ""]]

X, Y, Z = 0, 1, 2


class Term(NamedTuple):
    """One primitive of a joint: columns of frame i, of frame j, and the side column."""

    kind: str
    axis_i: int = Z
    axis_j: int = Z
    side_i: int = Y


_PARALLEL = (Term("n1", X, Z), Term("n1", Y, Z))
_ON_AXIS = (Term("n2", X), Term("n2", Y))


class Coordinate(NamedTuple):
    """One step of the relative motion that a joint leaves free, about or along a frame axis.

    kind: "turn" or "slide" (one number), "ball" (Euler parameters), "shift" (three lengths).
    """

    kind: str
    axis: int = Z


class Entry(NamedTuple):
    """What a joint constrains, and what motion it leaves.

    Attributes:
        terms: its primitives.
        motion: the steps that lead from frame i to frame j, in turn; None for a joint that
            has no such coordinates and can only close a loop.
        report: the primitives in the report's own rows, where they are others.
    """

    terms: tuple[Term, ...]
    motion: tuple[Coordinate, ...] | None = None
    report: tuple[Term, ...] | None = None


_POINT = Term("point")
_TURN, _SLIDE, _BALL = Coordinate("turn"), Coordinate("slide"), Coordinate("ball")

CATALOGUE: dict[str, Entry] = {
    "weld": Entry((_POINT, Term("n1", X, Y), Term("n1", Y, Z), Term("n1", Z, X)), ()),
    "spherical": Entry((_POINT,), (_BALL,)),
    "universal": Entry((_POINT, Term("n1", X, Y)), (Coordinate("turn", X), Coordinate("turn", Y))),
    "revolute": Entry((_POINT, *_PARALLEL), (_TURN,), (_POINT, Term("p1"))),
    "translational": Entry(
        (*_PARALLEL, *_ON_AXIS, Term("n1", X, Y)),
        (_SLIDE,),
        (Term("p1"), Term("p2"), Term("n1", X, Y)),
    ),
    "cylindrical": Entry((*_PARALLEL, *_ON_AXIS), (_SLIDE, _TURN), (Term("p1"), Term("p2"))),
    "distance": Entry((Term("distance"),)),
    "revolute_spherical": Entry((Term("n2", Z), Term("distance"))),
    "drive_angle": Entry((Term("angle", X, X, Y),)),
    "drive_shift": Entry((Term("shift", Z),)),
}

# The joints that leave an angle about their z axis, or a shift along it, free.
LEAVES_FREE: dict[str, tuple[str, ...]] = {
    which: tuple(kind for kind, entry in CATALOGUE.items() if step in (entry.motion or ()))
    for which, step in (("angle", _TURN), ("shift", _SLIDE))
}


class Joint(eqx.Module):
    """A joint between two named bodies, either of which may be "ground".

    Made by the functions below. Once part of a `System`, points and frames are in the
    bodies' reference frames: `point_i`, `point_j` (3,) [m], `frame_i`, `frame_j` (3, 3)
    with the joint's x, y, z axes as columns; before, they are as given.
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
        """The primitives of this joint, in the chosen rows."""
        entry = CATALOGUE[self.kind]
        return entry.report if rows == "report" and entry.report is not None else entry.terms

    @property
    def n_rows(self) -> int:
        """How many constraint rows the joint has."""
        return sum(ROWS[term.kind] for term in self.terms("body"))

    def data(self, term: Term, com_i: Float[Array, "3"], com_j: Float[Array, "3"]) -> Data:
        """The numbers of one primitive, points taken from the centres of mass."""
        return Data(
            point_i=self.point_i - com_i,
            point_j=self.point_j - com_j,
            axis_i=self.frame_i[:, term.axis_i],
            axis_j=self.frame_j[:, term.axis_j],
            side_i=self.frame_i[:, term.side_i],
            length=self.length,
        )


def resolve(joint: Joint, i: Body | None, j: Body | None) -> Joint:
    """The joint with points and frames in its bodies' reference frames (None is ground)."""
    if not joint.in_world:
        return joint

    def fix(body: Body | None, point: Array, frame: Array) -> tuple[Array, Array]:
        if body is None:
            return point, frame
        R_bw = rotation_matrix(body.orientation).T
        return R_bw @ (point - body.position), R_bw @ frame

    point_i, frame_i = fix(i, joint.point_i, joint.frame_i)
    point_j, frame_j = fix(j, joint.point_j, joint.frame_j)
    return dataclasses.replace(
        joint, in_world=False, point_i=point_i, point_j=point_j, frame_i=frame_i, frame_j=frame_j
    )


def _unit(axis: Numbers, what: str) -> Float[Array, "3"]:
    vector = jnp.asarray(axis, dtype=float)
    check_shape(vector, (3,), what)
    check_finite(vector, what, "")
    length = jnp.sqrt(vector @ vector)
    if concrete(vector) and float(length) == 0:
        raise ModelError(f"{what} has zero length; give any non-zero vector along it.")
    return vector / length


def _frame_about(z: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """A right-handed frame with the given third column; x along the least aligned axis."""
    other = jnp.eye(3, dtype=z.dtype)[jnp.argmin(jnp.abs(z))]
    x = other - (other @ z) * z
    x = x / jnp.sqrt(x @ x)
    return jnp.stack([x, cross(z, x), z], axis=1)


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
    points = jnp.asarray(point_i, dtype=float), jnp.asarray(point_j, dtype=float)
    for value in points:
        check_shape(value, (3,), f"A point of joint '{name}'")
        check_finite(value, f"A point of joint '{name}'", "m")
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
        length=jnp.asarray(length, dtype=float),
    )


_ORIGIN = (0.0, 0.0, 0.0)


def weld(name: str, body_i: str, body_j: str, *, point: Numbers = _ORIGIN) -> Joint:
    """No relative motion; 6 rows. `point` (3,) [m]: where the reaction is reported."""
    return _joint("weld", name, body_i, body_j, point, point, jnp.eye(3))


def spherical(name: str, body_i: str, body_j: str, *, point: Numbers) -> Joint:
    """A common point, world coordinates at the reference posture (3,) [m]; 3 rows."""
    return _joint("spherical", name, body_i, body_j, point, point, jnp.eye(3))


def universal(
    name: str, body_i: str, body_j: str, *, point: Numbers, axis_i: Numbers, axis_j: Numbers
) -> Joint:
    """A common point and two perpendicular axes, one fixed in each body; 4 rows.

    Args:
        point: world coordinates at the reference posture (3,) [m].
        axis_i, axis_j: the axes fixed in body i and in body j, world (3,), of any length.

    Raises:
        ModelError: an axis of zero length, or axes that are not perpendicular.
    """
    x = _unit(axis_i, f"axis_i of joint '{name}'")
    y = _unit(axis_j, f"axis_j of joint '{name}'")
    if concrete(x, y) and abs(float(x @ y)) > 1e-9:
        degrees = float(np.degrees(np.arccos(np.clip(float(x @ y), -1, 1))))
        raise ModelError(
            f"The axes of universal joint '{name}' must be perpendicular, but they are "
            f"{degrees:.6g} degrees apart."
        )
    return _joint(
        "universal", name, body_i, body_j, point, point, jnp.stack([x, y, cross(x, y)], 1)
    )


def revolute(name: str, body_i: str, body_j: str, *, point: Numbers, axis: Numbers) -> Joint:
    """Turning about one axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("revolute", name, body_i, body_j, point, point, frame)


def translational(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Sliding along one axis through `point` (3,) [m], world at reference; 5 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("translational", name, body_i, body_j, point, point, frame)


def cylindrical(
    name: str, body_i: str, body_j: str, *, axis: Numbers, point: Numbers = _ORIGIN
) -> Joint:
    """Sliding along and turning about one axis through `point` (3,) [m]; 4 rows."""
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    return _joint("cylindrical", name, body_i, body_j, point, point, frame)


def _length(name: str, point_i: Numbers, point_j: Numbers, length: Numbers | None) -> Numbers:
    apart = jnp.asarray(point_j, dtype=float) - jnp.asarray(point_i, dtype=float)
    value = jnp.sqrt(apart @ apart) if length is None else jnp.asarray(length, dtype=float)
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
    """A massless rod with a ball at each end; 1 row.

    Args:
        point_i, point_j: its ends on the two bodies, world at reference (3,) [m].
        length: [m]; by default the distance of the points.
    """
    value = _length(name, point_i, point_j, length)
    return _joint("distance", name, body_i, body_j, point_i, point_j, jnp.eye(3), value)


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
    """A massless link that turns about an axis of body i and ends in a ball on body j; 2 rows.

    Args:
        point_i, axis: the axis in body i, world at reference (3,) [m] and (3,).
        point_j: the ball's centre on body j (3,) [m], in the plane through `point_i`
            perpendicular to the axis.
        length: [m]; by default the distance of the points.
    """
    frame = _frame_about(_unit(axis, f"The axis of joint '{name}'"))
    value = _length(name, point_i, point_j, length)
    return _joint("revolute_spherical", name, body_i, body_j, point_i, point_j, frame, value)


def drive(
    name: str, joint: Joint, motion: Motion, *, coordinate: Literal["angle", "shift"]
) -> Joint:
    """Prescribe a relative coordinate of a joint as a function of time; 1 row, rheonomic.

    Args:
        joint: the joint whose frames define the coordinate (its z axis).
        motion: t [s] to the coordinate: an angle [rad] from body i to body j about z, or a
            displacement [m] of j's point along z from i's, zero at the reference posture.
            Must be twice differentiable by JAX.

    Raises:
        ModelError: a joint that does not leave that coordinate free.
    """
    if joint.kind not in LEAVES_FREE[coordinate]:
        raise ModelError(
            f"Driver '{name}' prescribes the {coordinate} of joint '{joint.name}', but a "
            f"{joint.kind} joint does not leave it free; {coordinate} needs one of: "
            f"{', '.join(LEAVES_FREE[coordinate])}."
        )
    return dataclasses.replace(joint, name=name, kind=f"drive_{coordinate}", motion=motion)
