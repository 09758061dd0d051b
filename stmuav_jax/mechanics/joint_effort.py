"""A motor in a joint: a force or moment prescribed over time."""

from collections.abc import Callable

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.shapes import Numbers
from .joint import Motion
from .joint_coordinate import Which
from .joint_force import AbstractJointForce, time_signal, which_coordinate


class JointEffort(AbstractJointForce):
    """A given effort Q(t) on one coordinate of a joint, on body j and its opposite on body i.

    The counterpart of a driver (`stmuav_jax.drive`): what `driver_efforts` finds, given back
    here, repeats the driver's motion.

    Args:
        joint: name of a revolute, translational or cylindrical joint.
        effort: [N] for a shift, [N m] for an angle; a number or a function of t [s] alone.
        coordinate: "angle" or "shift"; needed for a cylindrical joint only.

    Raises:
        ModelError: an effort that is not finite, or no function of t.
    """

    effort: Float[Array, ""] | Motion

    def __init__(
        self,
        joint: str,
        effort: Numbers | Callable[..., object],
        *,
        coordinate: Which | None = None,
    ) -> None:
        self.joint, self.coordinate = joint, which_coordinate(coordinate)
        self.effort = time_signal(effort, f"The effort in joint '{joint}'", "N or N m")

    def law(
        self, x: Float[Array, ""], x_rate: Float[Array, ""], t: Float[Array, ""]
    ) -> Float[Array, ""]:
        return jnp.asarray(self.effort(t) if callable(self.effort) else self.effort, x.dtype)

    def potential_energy(self, x: Float[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.zeros_like(x)

    def centre(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return jnp.zeros_like(t)
