"""Motor in a joint: a force or moment prescribed over time."""

from collections.abc import Callable
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...checks.shapes import Numbers
from ..joint import Motion
from ..joint_kind import Which
from .joint import AbstractJointForce, time_signal, which_coordinate


class JointEffort(AbstractJointForce):
    """Given effort Q(t) on one coordinate of a joint, acting on body j and oppositely on body i.

    It is the counterpart of a driver (`stmuav_jax.drive`): the efforts that `driver_efforts`
    computes repeat the driver's motion when they are applied by this class.

    Args:
        joint: name of a revolute, translational, cylindrical or screw joint.
        effort: [N] along a displacement, [N m] about an angle; a number or a function of t [s].
        coordinate: "angle" or "displacement"; needed for a cylindrical joint or a screw only.

    Raises:
        ModelError: the effort is not finite, or no function of t.
    """

    inputs: ClassVar[tuple[tuple[str, str], ...]] = (("effort", "N or N m"),)
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
