"""Relative coordinate of a joint: its value, its rate, and the load of an effort along it."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..algebra.rotation import cross
from ..algebra.stacked import apply, dot, multiply
from ..checks.errors import ModelError
from .joint import CATALOGUE, Joint, kinds_that_leave
from .joint_kind import Which
from .load import Load, couple, push
from .motions.axial import whole_turns
from .state import Kinematics


class JointCoordinate(eqx.Module):
    """Angle or displacement of a joint at one state.

    Attributes:
        which: "angle" or "displacement". body_i, body_j: the joint's bodies.
        value: angle about z from body i to body j [rad], in (-pi, pi] except that of a screw, whose
            displacement determines the whole turns; or displacement of j's point along z from i's
            [m]. rate: its time derivative [rad/s] or [m/s].
        axis: z axis of the joint on body i, world (3,). point: j's point, world (3,) [m].
    """

    which: Which = eqx.field(static=True)
    body_i: str = eqx.field(static=True)
    body_j: str = eqx.field(static=True)
    value: Float[Array, ""]
    rate: Float[Array, ""]
    axis: Float[Array, "3"]
    point: Float[Array, "3"]

    def load(self, kin: Kinematics, effort: Float[Array, ""]) -> Load:
        """Load of an effort ([N m] or [N] on the coordinate) on body j, and its opposite on body i.

        Its power is effort times rate. Both forces act at j's point, so that they have no
        net moment.
        """
        along = effort * self.axis
        if self.which == "angle":
            return couple(kin, self.body_j, self.body_i, along)
        arm_i = self.point - kin.r[kin.index(self.body_i)]
        arm_j = self.point - kin.r[kin.index(self.body_j)]
        return push(kin, self.body_j, along, arm_j) + push(kin, self.body_i, -along, arm_i)


def coordinate(kin: Kinematics, joint: Joint, which: Which) -> JointCoordinate:
    """Coordinate of a joint (resolved in a system) at a state."""
    i, j = kin.index(joint.body_i), kin.index(joint.body_j)
    F_i = multiply(kin.R_wb[i], joint.frame_i)
    axis = F_i[:, 2]
    a, a_rate = kin.point(joint.body_i, joint.point_i)
    b, b_rate = kin.point(joint.body_j, joint.point_j)
    if which == "angle":
        x_j = apply(kin.R_wb[j], joint.frame_j[:, 0])
        value = jnp.arctan2(dot(F_i[:, 1], x_j), dot(F_i[:, 0], x_j))
        if joint.pitched:
            value = value + whole_turns(value, dot(axis, b - a), joint.length)
        rate = dot(axis, kin.omega_w[j] - kin.omega_w[i])
    else:
        value = dot(axis, b - a)
        rate = dot(axis, b_rate - a_rate - cross(kin.omega_w[i], b - a))
    return JointCoordinate(which, joint.body_i, joint.body_j, value, rate, axis, b)


def free_coordinates(joint: Joint) -> list[Which]:
    """Coordinates that a joint leaves free: "angle" about its z axis, "displacement" along it."""
    return list(CATALOGUE[joint.kind].leaves_free)


def choose(joint: Joint, which: Which | None, what: str) -> Which:
    """Select a free coordinate of a joint: the named one, or else the only one.

    Args:
        what: subject of the error's sentence.

    Raises:
        ModelError: the joint does not leave it free, or leaves both free and none is named.
    """
    free = free_coordinates(joint)
    if which in free:
        return which
    if which is None and len(free) == 1:
        return free[0]
    if which is None and free:
        raise ModelError(
            f"{what}: a {joint.kind} joint leaves both an angle and a displacement free; say which by "
            "coordinate='angle' or coordinate='displacement'."
        )
    names: tuple[Which, ...] = ("angle", "displacement") if which is None else (which,)
    needed = "; ".join(f"{name} needs one of: {kinds_that_leave(name)}" for name in names)
    wanted = "an angle or a displacement" if which is None else f"the {which}"
    raise ModelError(
        f"{what} acts on {wanted}, but a {joint.kind} joint does not leave that free about or "
        f"along one axis ({needed})."
    )
