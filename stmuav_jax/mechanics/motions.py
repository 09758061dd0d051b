"""Relative motions that joints leave free: revolute, prismatic, helical, spherical, translation.

A relative motion leads from a parent frame to the child frame. Its motion subspace, whose
columns multiply the velocities u, is constant in the axes of the child frame. A joint is a
sequence of such motions, see `stmuav_jax.mechanics.joint.CATALOGUE`; a new motion is a class here.
A rotation about one axis is read from a direction that later motions of the joint leave unchanged:
an axis across it where none of them turns, else the axis of the only one that does.

Arrays have their components first, then the k frames that are evaluated together; states of a
batch, if any, come last.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4.4 (joint models).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError
from ..checks.shapes import Quat, Scalar, Vec3
from ..math.rotation import (
    conjugate,
    euler_parameter_rate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ..math.stacked import apply_matrix, multiply_matrices, unit_matrix

# Rotations, Euler parameters and vectors of k frames, and a joint's c coordinates or rates.
Rotations = Float[Array, "3 3 k ..."]
Quaternions = Float[Array, "4 k ..."]
Offsets = Float[Array, "3 k ..."]
Coordinates = Float[Array, " c"]

# Columns of a joint's frame in the cyclic order that makes the given axis the third.
CYCLIC = {0: (1, 2, 0), 1: (2, 0, 1), 2: (0, 1, 2)}


class MotionColumn(NamedTuple):
    """One column of a motion subspace: a unit twist about and along an axis of the frame.

    Attributes:
        axis: 0, 1 or 2, in the child frame.
        angular: angular velocity about the axis per unit of the velocity u.
        linear: velocity along it per unit of u; None for the joint's pitch [m/rad].
    """

    axis: int
    angular: float
    linear: float | None


class ColumnParts(NamedTuple):
    """Angular and linear parts of the columns of k frames, (*velocities, k, ...) each.

    Attributes:
        angular: constants.
        linear: constants, or an array if a joint has a pitch.
        pitched: 1.0 where the linear part is a joint's pitch, else 0.0.
    """

    angular: np.ndarray
    linear: np.ndarray | Array
    pitched: np.ndarray


class RelativeFrames(NamedTuple):
    """Observed child frames of k motions, relative to their poses at the motions' zero.

    Attributes:
        rotation: rotation of the joint's last frame (3, 3, k), to which later motions contribute.
        behind, zero: a direction (3, k) that later motions leave unchanged: in the last frame, and
            at zero of this motion in the axes of its own frame.
        offset: position of the joint's last frame (3, k) [m].
        parameters: function () of the Euler parameters of `rotation` (4, k), continuous in sign.
    """

    rotation: Float[Array, "3 3 k"]
    behind: np.ndarray
    zero: np.ndarray
    offset: Float[Array, "3 k"]
    parameters: Callable[[], Float[Array, "4 k"]]


class RelativePose(NamedTuple):
    """Pose of a child frame: Euler parameters, displacement [m], rates in the parent's axes."""

    p: Quat
    d: Vec3
    w: Vec3
    v: Vec3


class AbstractRelativeMotion(ABC):
    """Relative motion of a joint; subclasses are frozen dataclasses, equal if their fields are.

    Frames whose motions are of one class are evaluated together by one of them: the differences
    between them are in their columns, which are passed as `ColumnParts`.

    Attributes:
        positions, velocities: shapes of q and u of one frame, () for a single number.
        unit_norm: true if q is a unit vector.
        flat: true if the rates of q are the velocities u.
        name: the field's term.
        coordinates: names and units of the joint's coordinates, as many as the velocities.
    """

    positions: ClassVar[tuple[int, ...]]
    velocities: ClassVar[tuple[int, ...]]
    unit_norm: ClassVar[bool]
    flat: ClassVar[bool]
    name: str

    @property
    @abstractmethod
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        """Names and units of the joint's coordinates."""

    @property
    @abstractmethod
    def columns(self) -> tuple[MotionColumn, ...]:
        """Columns of the motion subspace, one for each velocity."""

    @abstractmethod
    def relative(
        self, q: Array, K: Rotations, k: Offsets, shares: ColumnParts
    ) -> tuple[Rotations, Offsets]:
        """Rotation and position [m] of the child frames in their parents.

        Args:
            K, k: rotation and position [m] at zero of the motion.
        """

    @abstractmethod
    def euler_parameters(self, q: Array, shares: ColumnParts) -> Quaternions:
        """Euler parameters of the motion's rotation, continuous in q."""

    @abstractmethod
    def read(self, frames: RelativeFrames, shares: ColumnParts) -> tuple[Array, Rotations, Offsets]:
        """Positions q (*positions, k), and rotation and displacement [m] of this motion alone."""

    @abstractmethod
    def rates(self, q: Float[Array, "..."], u: Float[Array, "..."]) -> Float[Array, "..."]:
        """Rates dq/dt at the velocities u."""

    @abstractmethod
    def retract(self, q: Float[Array, "..."], step: Float[Array, "..."]) -> Float[Array, "..."]:
        """Positions q after a small step along the velocities."""

    @abstractmethod
    def difference(self, y: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Step along the velocities that leads from x to y, so that retract(x, step) is y."""

    @abstractmethod
    def pose(self, x: Coordinates, x_rate: Coordinates, axis: int, pitch: Scalar) -> RelativePose:
        """Pose of the child frame from the joint's coordinates and their rates.

        Args:
            x, x_rate: coordinates and rates, see `coordinates`.
            axis: axis of the joint's frame that is this motion's z axis.
            pitch: pitch of the joint [m/rad].
        """


class AbstractFlatMotion(AbstractRelativeMotion):
    """Relative motion whose positions are integrals of its velocities."""

    unit_norm: ClassVar[bool] = False
    flat: ClassVar[bool] = True

    def rates(self, q: Float[Array, "..."], u: Float[Array, "..."]) -> Float[Array, "..."]:
        return u

    def retract(self, q: Float[Array, "..."], step: Float[Array, "..."]) -> Float[Array, "..."]:
        return q + step

    def difference(self, y: Float[Array, "..."], x: Float[Array, "..."]) -> Float[Array, "..."]:
        return y - x


_EYE = np.eye(3)


@dataclass(frozen=True)
class Axial(AbstractFlatMotion):
    """Relative motion of one coordinate q about and along the z axis.

    Attributes:
        name: the field's term. coordinate: name and unit of q.
        angular: rotation about z per unit of q.
        linear: displacement along z per unit of q; None for the joint's pitch [m/rad].
    """

    positions: ClassVar[tuple[int, ...]] = ()
    velocities: ClassVar[tuple[int, ...]] = ()

    name: str
    coordinate: tuple[str, str]
    angular: float
    linear: float | None

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return (self.coordinate,)

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return (MotionColumn(2, self.angular, self.linear),)

    def relative(
        self, q: Array, K: Rotations, k: Offsets, shares: ColumnParts
    ) -> tuple[Rotations, Offsets]:
        # A revolute, a prismatic and a helical joint are one formula with other constants: frames of all
        # three are evaluated as one array without a branch.
        c, s = jnp.cos(shares.angular * q), jnp.sin(shares.angular * q)
        z = jnp.broadcast_to(K[:, 2], (3, *c.shape))
        c, s = c[None], s[None]
        X = jnp.stack([c * K[:, 0] + s * K[:, 1], c * K[:, 1] - s * K[:, 0], z], axis=1)
        return X, k + (shares.linear * q)[None] * K[:, 2]

    def euler_parameters(self, q: Array, shares: ColumnParts) -> Quaternions:
        half, zero = 0.5 * shares.angular * q, jnp.zeros_like(q)
        return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])

    def read(self, frames: RelativeFrames, shares: ColumnParts) -> tuple[Array, Rotations, Offsets]:
        x, y = frames.zero[0], frames.zero[1]
        # The angle is read from a direction that later motions of the joint do not move, so that a sequence
        # of motions is solved one after the other.
        now = apply_matrix(frames.rotation, jnp.asarray(frames.behind))
        sine, cosine = x * now[1] - y * now[0], x * now[0] + y * now[1]
        turning = np.asarray(shares.angular) != 0
        if not np.all(turning):
            # without a turn the direction may be the axis itself, which has no angle or derivative
            sine, cosine = jnp.where(turning, sine, 0.0), jnp.where(turning, cosine, 1.0)
        angle = jnp.arctan2(sine, cosine)
        if np.any(shares.pitched):
            # the displacement determines the number of whole turns of a screw
            pitched = shares.pitched > 0
            angle = angle + shares.pitched * whole_turns(
                angle, frames.offset[2], jnp.where(pitched, shares.linear, 1.0)
            )
        # An angle where the motion turns, a displacement where it does not; a screw has both, tied by its
        # pitch.
        q = angle * shares.angular + frames.offset[2] * (1 - shares.angular)
        half = shares.angular * q / 2
        zero = jnp.zeros_like(q)
        X = rotation_matrix(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)]))
        return q, X, jnp.stack([zero, zero, shares.linear * q])

    def pose(self, x: Coordinates, x_rate: Coordinates, axis: int, pitch: Scalar) -> RelativePose:
        axis_vector = _EYE[axis]
        # The pitch is a number of the joint and may be differentiated; all other columns are constants.
        advance = pitch if self.linear is None else self.linear
        angular_axis, linear_axis = self.angular * axis_vector, advance * axis_vector
        p = from_rotation_vector(x[0] * angular_axis)
        return RelativePose(
            p, x[0] * linear_axis, x_rate[0] * angular_axis, x_rate[0] * linear_axis
        )


def whole_turns(
    angle: Float[Array, "*k"], displacement: Float[Array, "*k"], pitch: Float[Array, "*k"]
) -> Float[Array, "*k"]:
    """Whole turns by which displacement / pitch exceeds an angle in (-pi, pi], times 2 pi [rad]."""
    return 2 * jnp.pi * jnp.round((displacement / pitch - angle) / (2 * jnp.pi))


REVOLUTE = Axial("revolute", ("angle", "rad"), 1.0, 0.0)
PRISMATIC = Axial("prismatic", ("displacement", "m"), 0.0, 1.0)
SCREW = Axial("screw", ("angle", "rad"), 1.0, None)


@dataclass(frozen=True)
class Spherical(AbstractRelativeMotion):
    """Rotation by Euler parameters; u is the angular velocity in the axes of the child frame.

    The joint's coordinates are the rotation vector in the axes of the parent frame, and their
    rates the angular velocity in these axes.
    """

    positions: ClassVar[tuple[int, ...]] = (4,)
    velocities: ClassVar[tuple[int, ...]] = (3,)
    unit_norm: ClassVar[bool] = True
    flat: ClassVar[bool] = False

    name: str = "spherical"

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return tuple((f"rotation vector, {axis}", "rad") for axis in "xyz")

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return tuple(MotionColumn(axis, 1.0, 0.0) for axis in range(3))

    def relative(
        self, q: Array, K: Rotations, k: Offsets, shares: ColumnParts
    ) -> tuple[Rotations, Offsets]:
        return multiply_matrices(K, rotation_matrix(q)), k

    def euler_parameters(self, q: Array, shares: ColumnParts) -> Quaternions:
        return q

    def read(self, frames: RelativeFrames, shares: ColumnParts) -> tuple[Array, Rotations, Offsets]:
        # Euler parameters of a ball joint are chosen with a sign: both describe one rotation, and
        # the motion from there is the same.
        q = frames.parameters()
        # frames behind may have other axes than this motion's
        return q, rotation_matrix(q), jnp.zeros_like(frames.offset)

    def rates(self, q: Quaternions, u: Offsets) -> Quaternions:
        return euler_parameter_rate(q, u)

    def retract(self, q: Quaternions, step: Offsets) -> Quaternions:
        # Steps are multiplied on, not added: the norm stays one to round-off, and no direction of
        # the four numbers is wasted on it.
        return product(q, from_rotation_vector(step))

    def difference(self, y: Quaternions, x: Quaternions) -> Offsets:
        return to_rotation_vector(product(conjugate(x), y))

    def pose(self, x: Coordinates, x_rate: Coordinates, axis: int, pitch: Scalar) -> RelativePose:
        axis_frame = jnp.eye(3, dtype=x.dtype)[:, CYCLIC[axis]]
        zero = jnp.zeros_like(x)
        return RelativePose(from_rotation_vector(axis_frame @ x), zero, axis_frame @ x_rate, zero)


SPHERICAL = Spherical()


@dataclass(frozen=True)
class Translation(AbstractFlatMotion):
    """Three displacements along the axes of the frame."""

    positions: ClassVar[tuple[int, ...]] = (3,)
    velocities: ClassVar[tuple[int, ...]] = (3,)

    name: str = "translation"

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return tuple((f"displacement, {axis}", "m") for axis in "xyz")

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return tuple(MotionColumn(axis, 0.0, 1.0) for axis in range(3))

    def relative(
        self, q: Array, K: Rotations, k: Offsets, shares: ColumnParts
    ) -> tuple[Rotations, Offsets]:
        return K, k + apply_matrix(K, q)

    def euler_parameters(self, q: Array, shares: ColumnParts) -> Quaternions:
        return jnp.zeros((4, *q.shape[1:]), q.dtype).at[0].set(1.0)

    def read(self, frames: RelativeFrames, shares: ColumnParts) -> tuple[Array, Rotations, Offsets]:
        X = jnp.broadcast_to(unit_matrix(frames.offset), frames.rotation.shape)
        return frames.offset, X, frames.offset

    def pose(self, x: Coordinates, x_rate: Coordinates, axis: int, pitch: Scalar) -> RelativePose:
        axis_frame = jnp.eye(3, dtype=x.dtype)[:, CYCLIC[axis]]
        zero = jnp.zeros_like(x)
        return RelativePose(jnp.eye(4, dtype=x.dtype)[0], axis_frame @ x, zero, axis_frame @ x_rate)


TRANSLATION = Translation()


def frame_columns(axis: int) -> np.ndarray:
    """Axes of a motion's frame at its zero in those of the joint's frame, as columns (3, 3)."""
    return _EYE[:, CYCLIC[axis]]


def reference_directions(
    motions: Sequence[tuple[AbstractRelativeMotion, int]], subject: str
) -> tuple[np.ndarray, np.ndarray]:
    """Reference directions of n motions (3, n) each: in the last frame, and at zero in their own.

    Args:
        motions: the motions with the axes of the joint's frame that are their z axes.
        subject: the joint, subject of the error's sentence.

    Raises:
        ModelError: the coordinates cannot be read from the pose of the last frame alone.
    """
    # A joint's coordinates are read from the poses of its two bodies alone: frames between its
    # motions have no body. That works if each motion has a direction that later ones leave alone,
    # which is known before any number is.
    last = frame_columns(motions[-1][1])
    direction_pairs = []
    for n, (motion, axis) in enumerate(motions):
        later = motions[n + 1 :]
        turns = [a for other, a in later if is_turning(other)]
        single = is_turning(motion) and len(motion.columns) == 1
        several = any(is_turning(other) and len(other.columns) > 1 for other, _ in later)
        if (
            is_turning(motion)
            and turns
            and not (single and turns in ([0], [1], [2]) and not several)
        ):
            raise ModelError(
                f"{subject} has more than two rotations in sequence: use `SPHERICAL` as the last rotation."
            )
        if not _told_apart(motion, axis, later):
            raise ModelError(
                f"{subject} has a displacement along an axis that a later displacement, turned with the "
                "body, repeats: put it behind the rotation."
            )
        direction = _EYE[turns[0]] if single and turns else frame_columns(axis)[:, 0]
        direction_pairs.append((last.T @ direction, frame_columns(axis).T @ direction))
    behind, zero = zip(*direction_pairs, strict=True)
    return np.stack(behind, axis=1), np.stack(zero, axis=1)


def is_turning(motion: AbstractRelativeMotion) -> bool:
    """True if a motion turns the frame."""
    return any(column.angular for column in motion.columns)


def _told_apart(
    motion: AbstractRelativeMotion, axis: int, later: Sequence[tuple[AbstractRelativeMotion, int]]
) -> bool:
    """False if a later displacement may have a component along this one's axis."""
    slides = lambda m: any(column.linear != 0 for column in m.columns)
    if not slides(motion):
        return True
    for m, (other, other_axis) in enumerate(later):
        # A rotation about the axis of either displacement does not mix them; any other one turns
        # the later displacement into the direction of the earlier.
        between = [a for rotation, a in later[:m] if is_turning(rotation)]
        if slides(other) and any(a not in (axis, other_axis) for a in between):
            return False
    return True
