"""Rotation about all axes through a point: spherical joints."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.rotation import (
    conjugate,
    euler_parameter_rate,
    from_rotation_vector,
    product,
    rotation_matrix,
    to_rotation_vector,
)
from ...algebra.stacked import multiply
from .base import (
    CYCLIC,
    AbstractRelativeMotion,
    ColumnParts,
    MotionColumn,
    RelativeFrames,
    RelativePose,
)


@dataclass(frozen=True)
class Spherical(AbstractRelativeMotion):
    """Rotation by Euler parameters; u is the angular velocity in the axes of the child frame.

    The joint's coordinates are the rotation vector in the axes of the parent frame, and their
    rates the angular velocity in these axes.
    """

    positions: ClassVar[tuple[int, ...]] = (4,)
    velocities: ClassVar[tuple[int, ...]] = (3,)
    unit_norm: ClassVar[bool] = True
    flat: ClassVar[bool] = False

    name: str = "spherical"

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return tuple((f"rotation vector, {axis}", "rad") for axis in "xyz")

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return tuple(MotionColumn(axis, 1.0, 0.0) for axis in range(3))

    def relative(
        self,
        q: Float[Array, "4 k *s"],
        K: Float[Array, "3 3 k *s"],
        k: Float[Array, "3 k *s"],
        shares: ColumnParts,
    ) -> tuple[Float[Array, "3 3 k ..."], Float[Array, "3 k ..."]]:
        del shares
        return multiply(K, rotation_matrix(q)), k

    def euler_parameters(
        self, q: Float[Array, "4 k *s"], shares: ColumnParts
    ) -> Float[Array, "4 k *s"]:
        del shares
        return q

    def read(
        self, seen: RelativeFrames, shares: ColumnParts
    ) -> tuple[Float[Array, "4 k"], Float[Array, "3 3 k"], Float[Array, "3 k"]]:
        del shares
        q = seen.parameters()
        # frames behind may have other axes than this motion's
        return q, rotation_matrix(q), jnp.zeros_like(seen.offset)

    def rates(self, q: Float[Array, "4 k *s"], u: Float[Array, "3 k *s"]) -> Float[Array, "4 k *s"]:
        return euler_parameter_rate(q, u)

    def retract(
        self, q: Float[Array, "4 k *s"], step: Float[Array, "3 k *s"]
    ) -> Float[Array, "4 k *s"]:
        return product(q, from_rotation_vector(step))

    def difference(
        self, y: Float[Array, "4 k *s"], x: Float[Array, "4 k *s"]
    ) -> Float[Array, "3 k *s"]:
        return to_rotation_vector(product(conjugate(x), y))

    def pose(
        self, x: Float[Array, " c"], x_rate: Float[Array, " c"], axis: int, pitch: Float[Array, ""]
    ) -> RelativePose:
        del pitch
        own = jnp.eye(3, dtype=x.dtype)[:, CYCLIC[axis]]
        zero = jnp.zeros_like(x)
        return RelativePose(from_rotation_vector(own @ x), zero, own @ x_rate, zero)


SPHERICAL = Spherical()
