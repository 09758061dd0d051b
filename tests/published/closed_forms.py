"""What the published problems share: closed forms, and readings of a run in NumPy/SciPy."""

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import stmuav_jax as stm


def scene(system: stm.System, state: stm.State | None = None, **span: Any) -> stm.Scene:
    """A scene that starts at the reference posture, or at `state`."""
    start = system.reference if state is None else state
    return stm.Scene("published", "A published test problem", system, start, **span)


def turned_about_z(run: stm.Run) -> np.ndarray:
    """How far every body has turned about z since the start (k, n) [rad], past full turns.

    Needs saved times so close that no body turns by half a turn or more between them.
    """
    p = np.asarray(run.states.p)
    # half angles: p and -p are the same posture
    half = np.unwrap(np.arctan2(p[..., 3], p[..., 0]), axis=0, period=np.pi)
    return 2 * (half - half[0])


def attitude(run: stm.Run, body: int) -> Rotation:
    """Body-to-world rotations of one body at the saved times."""
    return Rotation.from_quat(np.asarray(run.states.p)[:, body], scalar_first=True)
