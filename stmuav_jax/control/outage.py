"""Rotors lost, and yaw given up: thrust and tilt by the rotors that are left.

Without one rotor of six the others hold thrust and tilt with room to spare, but yaw on the edge of
their limits at best (`stmuav_jax.control.input_margin`). The wanted attitude then turns with the
machine about its thrust, and its angular velocity about z is slowed down with what is left.

Source: M. W. Mueller, R. D'Andrea, Stability and control of a quadrocopter despite the complete loss
of one, two, or three propellers, IEEE International Conference on Robotics and Automation (2014).
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import skew
from ..checks.errors import ModelError
from ..rotorcraft.allocation import RotorLimits
from .geometric import BaseMotion, Waypoint

# Part of the turning moments of the rotors, below which no change of speeds turns without tilting.
_TURNS = 1e-9


def working_rotors(lost: Sequence[int], count: int) -> tuple[int, ...] | None:
    """Places of the rotors that work; None where none is lost.

    Args:
        lost: numbers of the lost rotors, the first being 1. count: number of all rotors.
    """
    for rotor in lost:
        if rotor != int(rotor) or not 1 <= rotor <= count:
            raise ModelError(
                f"The machine has rotors 1 to {count}, but no rotor {rotor} to be lost."
            )
    return tuple(k for k in range(count) if k + 1 not in lost) if len(lost) else None


def inverse_without_yaw(
    wrenches: Float[Array, "4 k"],
    working: tuple[int, ...],
    limits: RotorLimits | None,
    weight: Float[Array, ""],
) -> Float[Array, "w 4"]:
    """Squared speeds of the working rotors per unit of thrust and moments.

    Those of thrust and tilt are of minimum norm without regard to yaw; those of yaw change neither
    thrust nor tilt, and are zero where there are none such.

    Args:
        wrenches: thrust and moments per unit of the squared speeds.
        limits: limits of the speeds. weight: thrust in hover [N].

    Raises:
        ModelError: no limits, or limits within which the working rotors do not hover.
    """
    gone = [k + 1 for k in range(wrenches.shape[1]) if k not in working]
    what = f"without rotor{'s' if len(gone) > 1 else ''} {', '.join(map(str, gone))}"
    if limits is None:
        raise ModelError(
            f"A flight {what} needs limits of the rotor speeds: rotors cannot push down."
        )
    own = np.asarray(wrenches)[:, list(working)]
    inverse = np.linalg.pinv(own[:3])
    lower, upper = (np.asarray(x)[list(working)] for x in limits.squared(wrenches.shape[1]))
    u = inverse[:, 0] * float(weight)
    given = np.allclose(own[:3] @ inverse, np.eye(3), atol=1e-9)
    if not given or np.any(inverse[:, 0] <= 0) or np.any((u <= lower) | (u >= upper)):
        raise ModelError(
            f"Thrust and tilt cannot be held {what}: the hover would take squared speeds of "
            f"{np.array2string(u, precision=3)} rad^2/s^2, and the limits are "
            f"{np.array2string(lower, precision=3)} to {np.array2string(upper, precision=3)}."
        )
    turn = own[3] - inverse @ (own[:3] @ own[3])
    size = turn @ turn
    turn = turn / size if size > _TURNS**2 * (own[3] @ own[3]) else np.zeros_like(turn)
    return jnp.asarray(np.concatenate([inverse, turn[:, None]], axis=1))


def as_it_turns(wanted: Waypoint, base: BaseMotion) -> Waypoint:
    """Waypoint whose heading is that of the base, and goes on turning as it does."""
    x, rate = base.R[:, 0], (base.R @ skew(base.omega))[:, 0]
    turning = (x[0] * rate[1] - x[1] * rate[0]) / (x[0] ** 2 + x[1] ** 2)
    return wanted._replace(
        heading=jnp.arctan2(x[1], x[0]), turning=turning, turning_rate=jnp.zeros_like(turning)
    )
