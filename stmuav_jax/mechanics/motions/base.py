"""Interface of a relative motion: everything that a spanning tree needs of a joint's freedom.

A relative motion leads from a parent frame to the child frame. Its motion subspace, whose
columns multiply the velocities u, is constant in the axes of the child frame. A joint is a
sequence of such motions, see `stmuav_jax.mechanics.joint.CATALOGUE`; a new motion is a class here.

Arrays have their components first, then the k frames that are evaluated together; states of a
batch, if any, come last.

Source: R. Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 4.4 (joint models).
"""

from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np
from jaxtyping import Array, Float

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

    p: Float[Array, "4"]
    d: Float[Array, "3"]
    w: Float[Array, "3"]
    v: Float[Array, "3"]


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
        self,
        q: Float[Array, "..."],
        K: Float[Array, "3 3 k *s"],
        k: Float[Array, "3 k *s"],
        shares: ColumnParts,
    ) -> tuple[Float[Array, "3 3 k ..."], Float[Array, "3 k ..."]]:
        """Rotation and position [m] of the child frames in their parents.

        Args:
            K, k: rotation and position [m] at zero of the motion.
        """

    @abstractmethod
    def euler_parameters(
        self, q: Float[Array, "..."], shares: ColumnParts
    ) -> Float[Array, "4 k ..."]:
        """Euler parameters of the motion's rotation, continuous in q."""

    @abstractmethod
    def read(
        self, seen: RelativeFrames, shares: ColumnParts
    ) -> tuple[Array, Float[Array, "3 3 k"], Float[Array, "3 k"]]:
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
    def pose(
        self, x: Float[Array, " c"], x_rate: Float[Array, " c"], axis: int, pitch: Float[Array, ""]
    ) -> RelativePose:
        """Pose of the child frame from the joint's coordinates and their rates.

        Args:
            x, x_rate: coordinates and rates, see `coordinates`.
            axis: axis of the joint's frame that is this motion's z axis.
            pitch: pitch of the joint [m/rad].
        """
