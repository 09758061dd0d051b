"""Contact of a body's feet with level ground, as a regularised, smooth force. docs/contact.md."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.rotation import cross
from ...checks.errors import ModelError, check_finite, shape_of
from ...checks.numbers import floats, nonnegative, positive, scalar
from ...checks.shapes import Numbers
from ..body import GROUND
from ..load import AbstractForce, ActsOn, Load, push
from ..state import Kinematics
from .ramp import one_sided_push, ramp, ramp_area


class GroundContact(AbstractForce):
    """Springs, dampers and friction between feet of a body and level ground, which only push.

    With the depth d of a foot below the ground's height, its horizontal velocity v_t, and ramp, E
    and D as of `EndStop`:

        N = E/2 + ramp(E + D, E)               upwards,   E = k ramp(d, w), D = c ramp'(d, w) d_rate
        F = -mu N v_t / sqrt(|v_t|^2 + v0^2)   along the ground

    The force is zero above the ground and twice continuously differentiable in the motion. A foot
    that carries a weight W rests at the depth W / k + w / 2, and impacts last some
    pi sqrt(m / k): the stiffness sets the step size. The friction is a damper of mu N / v0 near
    rest, so that a foot creeps under any load along the ground: on a slope of angle theta, with
    tan(theta) below mu, at v0 tan(theta) / sqrt(mu^2 - tan(theta)^2). It never sticks.

    Args:
        body: name of the body.
        feet: points of the body that may touch the ground, in its reference frame (k, 3) [m].
        height: height of the ground, z in the world [m].
        stiffness: k > 0 of each foot [N/m]. damping: c >= 0 of each foot [N s/m].
        width: depth w > 0 over which a foot's spring reaches its stiffness [m].
        friction: coefficient mu >= 0 [1].
        slip_speed: smoothing speed v0 > 0 [m/s]; friction is 71 % of mu N at v0, 98 % at 5 v0.

    Raises:
        ModelError: a number is not finite or out of its range, there is no foot, or the body is
            ground.
    """

    body: str = eqx.field(static=True)
    feet: Float[Array, "k 3"]
    height: Float[Array, ""]
    stiffness: Float[Array, ""]
    damping: Float[Array, ""]
    width: Float[Array, ""]
    friction: Float[Array, ""]
    slip_speed: Float[Array, ""]

    def __init__(
        self,
        body: str,
        *,
        feet: Numbers,
        height: Numbers = 0.0,
        stiffness: Numbers,
        damping: Numbers,
        width: Numbers,
        friction: Numbers,
        slip_speed: Numbers,
    ) -> None:
        if body == GROUND:
            raise ModelError("A ground contact needs a body that moves, but it is given ground.")
        self.body = body
        of = f"of the ground contact of body '{body}'"
        self.feet = _feet(feet, f"The feet {of}")
        self.height = scalar(height, f"The height {of}", "m")
        self.stiffness = positive(stiffness, f"The stiffness {of}", "N/m")
        self.damping = nonnegative(damping, f"The damping {of}", "N s/m")
        self.width = positive(width, f"The width {of}", "m")
        self.friction = nonnegative(friction, f"The friction coefficient {of}", "1")
        self.slip_speed = positive(slip_speed, f"The slip speed {of}", "m/s")

    def acts_on(self) -> ActsOn:
        return ActsOn(bodies=(self.body,))

    def depths(self, kin: Kinematics) -> Float[Array, " k"]:
        """Depths of the feet below the ground's height (k,) [m], negative above it."""
        return self.height - self._feet(kin)[0][:, 2]

    def normal_forces(self, kin: Kinematics) -> Float[Array, " k"]:
        """Forces N of the ground on the feet, upwards (k,) [N]."""
        place, velocity = self._feet(kin)
        return self._pushes(self.height - place[:, 2], -velocity[:, 2])

    def _feet(self, kin: Kinematics) -> tuple[Float[Array, "k 3"], Float[Array, "k 3"]]:
        """Positions [m] and velocities [m/s] of the feet, world."""
        return jax.vmap(lambda foot: kin.point(self.body, foot))(self.feet)

    def _pushes(self, depth: Float[Array, " k"], rate: Float[Array, " k"]) -> Float[Array, " k"]:
        law = self.stiffness, self.damping, self.width
        return jax.vmap(lambda d, d_rate: one_sided_push(d, d_rate, *law))(depth, rate)

    def load(self, t: Float[Array, ""], kin: Kinematics) -> Load:
        del t
        place, velocity = self._feet(kin)
        depth, rate = self.height - place[:, 2], -velocity[:, 2]
        normal = self._pushes(depth, rate)
        along = velocity[:, :2]
        drag = (
            self.friction * normal / jnp.sqrt(jnp.sum(along * along, axis=1) + self.slip_speed**2)
        )
        force = jnp.concatenate([-drag[:, None] * along, normal[:, None]], axis=1)
        total = jnp.sum(force, axis=0)
        arms = place - kin.r[kin.index(self.body)]
        moments = [jnp.sum(cross(at.T, force.T), axis=1) for at in (arms, place)]
        # ground has its centre of mass at the origin of the world
        load = push(kin, self.body, total, moment_w=moments[0])
        load = load + push(kin, GROUND, -total, moment_w=-moments[1])
        of_springs = self.stiffness * jax.vmap(lambda d: ramp(d, self.width))(depth)
        lost = (of_springs - normal) * rate - drag * jnp.sum(along * along, axis=1)
        energy = self.stiffness * jax.vmap(lambda d: ramp_area(d, self.width))(depth)
        return Load(load.force, load.moment, jnp.sum(energy), jnp.sum(lost))


def _feet(value: Numbers, what: str) -> Float[Array, "k 3"]:
    """Checked points (k, 3) [m], at least one."""
    try:
        shape = shape_of(value)
    except ValueError:
        shape = None
    if shape is None or len(shape) != 2 or shape[0] == 0 or shape[1] != 3:
        found = "rows of unequal length" if shape is None else f"of shape {shape}"
        raise ModelError(
            f"{what} must be points of shape (k, 3) [m], at least one, but are {found}."
        )
    check_finite(value, what, "m")
    return floats(value)
