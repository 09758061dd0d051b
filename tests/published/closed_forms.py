"""What the published problems share: closed forms, and readings of a run in NumPy/SciPy."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation
from scipy.special import ellipj

import stmuav_jax as sj


def scene(system: sj.System, state: sj.State | None = None, **span: Any) -> sj.Scene:
    """A scene that starts at the reference posture, or at `state`."""
    start = system.reference if state is None else state
    return sj.Scene("published", "A published test problem", system, start, **span)


def moving(system: sj.System, v: Any, omega: Any) -> sj.State:
    """The reference posture with velocities v [m/s] and body-frame omega [rad/s], (n, 3) each."""
    rest = system.reference
    return sj.State(rest.r, rest.p, jnp.asarray(v, dtype=float), jnp.asarray(omega, dtype=float))


def about_z(angle: float) -> tuple[float, float, float, float]:
    """Euler parameters of a rotation by `angle` [rad] about z."""
    return (float(np.cos(angle / 2)), 0.0, 0.0, float(np.sin(angle / 2)))


def turned_about_z(run: sj.Run) -> np.ndarray:
    """How far every body has turned about z since the start (k, n) [rad], past full turns.

    Needs saved times so close that no body turns by half a turn or more between them.
    """
    p = np.asarray(run.states.p)
    # half angles: p and -p are the same posture
    half = np.unwrap(np.arctan2(p[..., 3], p[..., 0]), axis=0, period=np.pi)
    return 2 * (half - half[0])


def attitude(run: sj.Run, body: int) -> Rotation:
    """Body-to-world rotations of one body at the saved times."""
    return Rotation.from_quat(np.asarray(run.states.p)[:, body], scalar_first=True)


def jacobi_negative(u: np.ndarray, n: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """sn, cn, dn of the negative parameter m = -n, n > 0 (Abramowitz & Stegun 16.10)."""
    sn, cn, dn, _ = ellipj(u * np.sqrt(1 + n), n / (1 + n))
    return sn / dn / np.sqrt(1 + n), cn / dn, 1 / dn
