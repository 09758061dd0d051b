"""Sequences of relative motions, as joints have them: which directions tell their coordinates.

Each motion has a frame whose z axis is one axis of the joint's frame. A rotation about one axis is
read from a direction that later motions of the joint leave unchanged: an axis across it where none
of them turns, else the axis of the only one that does.
"""

from collections.abc import Sequence

import numpy as np

from ...checks.errors import ModelError
from .base import CYCLIC, AbstractRelativeMotion

_EYE = np.eye(3)


def frame_columns(axis: int) -> np.ndarray:
    """Axes of a motion's frame at its zero in those of the joint's frame, as columns (3, 3)."""
    return _EYE[:, CYCLIC[axis]]


def references(
    motions: Sequence[tuple[AbstractRelativeMotion, int]], what: str
) -> tuple[np.ndarray, np.ndarray]:
    """Reference directions of n motions (3, n) each: in the last frame, and at zero in their own.

    Args:
        motions: the motions with the axes of the joint's frame that are their z axes.
        what: the joint, subject of the error's sentence.

    Raises:
        ModelError: the coordinates cannot be read from the pose of the last frame alone.
    """
    last = frame_columns(motions[-1][1])
    found = []
    for n, (motion, axis) in enumerate(motions):
        later = motions[n + 1 :]
        turns = [a for other, a in later if turning(other)]
        single = turning(motion) and len(motion.columns) == 1
        several = any(turning(other) and len(other.columns) > 1 for other, _ in later)
        if turning(motion) and turns and not (single and turns in ([0], [1], [2]) and not several):
            raise ModelError(
                f"{what} has more than two rotations in sequence: use `SPHERICAL`, the last that turns."
            )
        if not _told_apart(motion, axis, later):
            raise ModelError(
                f"{what} has a displacement that a later one, turned with the body, cannot be told "
                "from: put it behind the rotation."
            )
        direction = _EYE[turns[0]] if single and turns else frame_columns(axis)[:, 0]
        found.append((last.T @ direction, frame_columns(axis).T @ direction))
    behind, zero = zip(*found, strict=True)
    return np.stack(behind, axis=1), np.stack(zero, axis=1)


def turning(motion: AbstractRelativeMotion) -> bool:
    """True if a motion turns the frame."""
    return any(column.angular for column in motion.columns)


def _told_apart(
    motion: AbstractRelativeMotion, axis: int, later: Sequence[tuple[AbstractRelativeMotion, int]]
) -> bool:
    """False if a later displacement may have a component along this one's axis."""
    slides = lambda m: any(column.linear != 0 for column in m.columns)
    if not slides(motion):
        return True
    for m, (other, along) in enumerate(later):
        between = [a for rotation, a in later[:m] if turning(rotation)]
        if slides(other) and any(a not in (axis, along) for a in between):
            return False
    return True
