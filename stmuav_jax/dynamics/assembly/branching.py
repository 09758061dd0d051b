"""Branches of the motion at a start in a singular posture, from second-order terms of the constraints.

In a singular posture rows of the constraint Jacobian J are dependent that are independent beside it.
With W the combinations of rows that vanish there, and N the free velocities, both orthonormal, the
rank that a free velocity u gains is, to first order, that of

    W^T (dJ/dq u) N.

It is zero for every u where rows are dependent all along the motion. Velocities that gain as much
rank as any others say along which branch the motion goes on. At rest nothing says so.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...mechanics.state import State
from ..formulations.augmented import AugmentedModel
from .singular import owners

# Singular values below this fraction of the largest count as zero.
_ZERO = 1e-9
# Displacement for differences, as an angle [rad], and the gain that is not their round-off.
_STEP, _GAINED = 1e-4, 1e-5
# Velocities up to this many radians, or lengths of the mechanism, per second count as rest.
RESTING = 1e-6

Look = Callable[[State], Float[np.ndarray, "k m v"]]


class Branching(NamedTuple):
    """Rank that the constraint Jacobian gains beside a posture.

    Attributes:
        gained: largest rank that is gained along a free motion; zero unless the posture is singular.
        followed: rank that is gained along the velocities of the state.
        resting: true if the velocities are zero.
        names: names of the joints whose rows are dependent in this posture alone.
        free: free velocities (6 n, d), in the order of the columns of the Jacobian.
    """

    gained: int
    followed: int
    resting: bool
    names: tuple[str, ...]
    free: Float[np.ndarray, "v d"]

    @property
    def undetermined(self) -> bool:
        """True if the velocities do not say along which branch the motion goes on."""
        return self.followed < self.gained


def branching(
    model: AugmentedModel, state: State, matrix: Float[np.ndarray, "m v"], look: Look
) -> Branching:
    """Rank gained beside a posture, along its velocities and along any.

    Args:
        model: system prepared for maximal coordinates, with the rows of all joints.
        matrix: constraint Jacobian in (v, omega') at the state.
        look: function that returns the constraint Jacobians of states (k, n, .).
    """
    units = _units(model, matrix)
    sizes = np.linalg.norm(matrix * units, axis=1, keepdims=True)
    scaled = lambda J: J * units / np.where(sizes > 0, sizes, 1.0)
    left, values, right = np.linalg.svd(scaled(matrix))
    rank = int(np.sum(values > _ZERO * values[0]))
    W, N = left[:, rank:], right[rank:].T
    u = np.concatenate([np.asarray(state.v), np.asarray(state.omega)], axis=1).reshape(-1) / units
    speed = np.max(np.abs(u))
    none = Branching(0, 0, bool(speed <= RESTING), (), units[:, None] * N)
    if not W.size or not N.size:
        return none
    ways = [*(N / np.max(np.abs(N), axis=0)).T, *([] if none.resting else [u / speed])]
    steps = _STEP * units * np.array(ways)
    there, back = np.split(scaled(look(_displaced(state, np.concatenate([steps, -steps])))), 2)
    gains = W.T @ ((there - back) / (2 * _STEP)) @ N
    count = N.shape[1]
    # a combination without any pattern gains as much as any
    mixed = np.tensordot(np.random.default_rng(0).normal(size=count), gains[:count], 1)
    gained = _rank(mixed / np.sqrt(count))
    if not gained:
        return none
    followed = 0 if none.resting else min(_rank(gains[-1]), gained)
    vectors, values, _ = np.linalg.svd(np.concatenate(gains[:count], axis=1))
    momentary = W @ vectors[:, : np.sum(values > _GAINED)]
    names = owners(model, np.sum(momentary**2, axis=1))
    return none._replace(gained=gained, followed=followed, names=names)


def _units(model: AugmentedModel, matrix: Float[np.ndarray, "m v"]) -> Float[np.ndarray, " v"]:
    """Sizes of the columns: the longest arm of a joint [m] for velocities, one for rates of turning."""
    rows = matrix[~model.constraints.angular].reshape(-1, matrix.shape[1] // 6, 6)
    push, turn = (np.max(np.abs(x), initial=0.0) for x in (rows[..., :3], rows[..., 3:]))
    arm = turn / push if push > 0 and turn > 0 else 1.0
    return np.tile(np.repeat([arm, 1.0], 3), matrix.shape[1] // 6)


def _rank(gain: Float[np.ndarray, "a b"]) -> int:
    return int(np.sum(np.linalg.svd(gain, compute_uv=False) > _GAINED))


def _displaced(state: State, steps: Float[np.ndarray, "k v"]) -> State:
    """Postures (k, n, .) after small steps in world translations [m] and rotation vectors [rad].

    An error of third order in the angle is left.
    """
    r, p, v, omega = (np.asarray(x) for x in (state.r, state.p, state.v, state.omega))
    shift, turn = np.split(steps.reshape(len(steps), -1, 6), 2, axis=2)
    # p times the quaternion (1, turn / 2)
    scalar = -np.sum(p[:, 1:] * turn, axis=2, keepdims=True)
    vector = p[:, :1] * turn + np.cross(p[:, 1:], turn)
    turned = p + 0.5 * np.concatenate([scalar, vector], axis=2)
    turned /= np.linalg.norm(turned, axis=2, keepdims=True)
    still = [np.tile(x, (len(steps), 1, 1)) for x in (v, omega)]
    return State(*(jnp.asarray(x) for x in (r + shift, turned, *still)))
