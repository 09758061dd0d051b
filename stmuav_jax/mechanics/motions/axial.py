"""Motion in one coordinate about and along one axis: revolute, prismatic and helical joints.

With the angular and linear shares a and b of the coordinate q, the child frame is turned by a q
about the z axis and displaced by b q along it: (1, 0) is revolute, (0, 1) prismatic, and (1, h)
a screw of pitch h [m/rad].
"""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...algebra.rotation import from_rotation_vector, rotation_matrix
from ...algebra.stacked import apply
from .base import AbstractRelativeMotion, ColumnParts, MotionColumn, RelativeFrames, RelativePose

_EYE = np.eye(3)


@dataclass(frozen=True)
class Axial(AbstractRelativeMotion):
    """Relative motion of one coordinate q about and along the z axis.

    Attributes:
        name: the field's term. coordinate: name and unit of q.
        angular: rotation about z per unit of q.
        linear: displacement along z per unit of q; None for the joint's pitch [m/rad].
    """

    positions: ClassVar[tuple[int, ...]] = ()
    velocities: ClassVar[tuple[int, ...]] = ()
    unit_norm: ClassVar[bool] = False
    flat: ClassVar[bool] = True

    name: str
    coordinate: tuple[str, str]
    angular: float
    linear: float | None

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return (self.coordinate,)

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return (MotionColumn(2, self.angular, self.linear),)

    def relative(
        self,
        q: Float[Array, "k *s"],
        K: Float[Array, "3 3 k *s"],
        k: Float[Array, "3 k *s"],
        shares: ColumnParts,
    ) -> tuple[Float[Array, "3 3 k *s"], Float[Array, "3 k *s"]]:
        c, s = jnp.cos(shares.angular * q), jnp.sin(shares.angular * q)
        z = jnp.broadcast_to(K[:, 2], (3, *c.shape))
        X = jnp.stack([c * K[:, 0] + s * K[:, 1], c * K[:, 1] - s * K[:, 0], z], axis=1)
        return X, k + (shares.linear * q) * K[:, 2]

    def euler_parameters(
        self, q: Float[Array, "k *s"], shares: ColumnParts
    ) -> Float[Array, "4 k *s"]:
        half, zero = 0.5 * shares.angular * q, jnp.zeros_like(q)
        return jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])

    def read(
        self, seen: RelativeFrames, shares: ColumnParts
    ) -> tuple[Float[Array, " k"], Float[Array, "3 3 k"], Float[Array, "3 k"]]:
        x, y = seen.zero[0], seen.zero[1]
        now = apply(seen.rotation, jnp.asarray(seen.behind))
        sine, cosine = x * now[1] - y * now[0], x * now[0] + y * now[1]
        turning = np.asarray(shares.angular) != 0
        if not np.all(turning):
            # without a turn the direction may be the axis itself, which has no angle or derivative
            sine, cosine = jnp.where(turning, sine, 0.0), jnp.where(turning, cosine, 1.0)
        angle = jnp.arctan2(sine, cosine)
        if np.any(shares.pitched):
            # the displacement determines the number of whole turns of a screw
            pitched = shares.pitched > 0
            angle = angle + shares.pitched * whole_turns(
                angle, seen.offset[2], jnp.where(pitched, shares.linear, 1.0)
            )
        q = angle * shares.angular + seen.offset[2] * (1 - shares.angular)
        half = shares.angular * q / 2
        zero = jnp.zeros_like(q)
        X = rotation_matrix(jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)]))
        return q, X, jnp.stack([zero, zero, shares.linear * q])

    def rates(self, q: Float[Array, "k *s"], u: Float[Array, "k *s"]) -> Float[Array, "k *s"]:
        del q
        return u

    def retract(self, q: Float[Array, "k *s"], step: Float[Array, "k *s"]) -> Float[Array, "k *s"]:
        return q + step

    def difference(self, y: Float[Array, "k *s"], x: Float[Array, "k *s"]) -> Float[Array, "k *s"]:
        return y - x

    def pose(
        self, x: Float[Array, " c"], x_rate: Float[Array, " c"], axis: int, pitch: Float[Array, ""]
    ) -> RelativePose:
        along = _EYE[axis]
        advance = pitch if self.linear is None else self.linear
        turned, moved = self.angular * along, advance * along
        p = from_rotation_vector(x[0] * turned)
        return RelativePose(p, x[0] * moved, x_rate[0] * turned, x_rate[0] * moved)


def whole_turns(
    angle: Float[Array, "*k"], displacement: Float[Array, "*k"], pitch: Float[Array, "*k"]
) -> Float[Array, "*k"]:
    """Whole turns by which displacement / pitch exceeds an angle in (-pi, pi], times 2 pi [rad]."""
    return 2 * jnp.pi * jnp.round((displacement / pitch - angle) / (2 * jnp.pi))


REVOLUTE = Axial("revolute", ("angle", "rad"), 1.0, 0.0)
PRISMATIC = Axial("prismatic", ("displacement", "m"), 0.0, 1.0)
SCREW = Axial("screw", ("angle", "rad"), 1.0, None)
