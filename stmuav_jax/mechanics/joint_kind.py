"""Parts of the joint catalogue's entries: constraint primitives between the axes of a joint's two
frames, and the relative motions that a joint leaves free.
"""

from typing import Literal, NamedTuple, get_args

from .motions.base import AbstractRelativeMotion, MotionColumn

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
        report: primitives of the report's own rows, if they differ.
    """

    terms: tuple[Term, ...]
    motion: tuple[Freedom, ...] | None = None
    report: tuple[Term, ...] | None = None

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        """Columns of the motion subspaces about or along the joint's z axis."""
        own = (f for f in self.motion or () if f.axis == Z and len(f.motion.columns) == 1)
        return tuple(column for freedom in own for column in freedom.motion.columns)

    @property
    def leaves_free(self) -> tuple[Which, ...]:
        """Coordinates that are free about or along the joint's z axis."""
        free = {(c.angular != 0, c.linear != 0) for c in self.columns}
        return tuple(which for k, which in enumerate(get_args(Which)) if any(f[k] for f in free))

    @property
    def pitched(self) -> bool:
        """True if the `length` of such a joint is a pitch [m/rad]."""
        return any(column.linear is None for column in self.columns)
