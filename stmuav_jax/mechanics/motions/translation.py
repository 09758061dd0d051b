"""Translation in three directions without rotation, as of a free body's centre of mass."""

from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from ...algebra.stacked import apply, eye
from .base import (
    CYCLIC,
    AbstractRelativeMotion,
    ColumnParts,
    MotionColumn,
    RelativeFrames,
    RelativePose,
)


@dataclass(frozen=True)
class Translation(AbstractRelativeMotion):
    """Three displacements along the axes of the frame."""

    positions: ClassVar[tuple[int, ...]] = (3,)
    velocities: ClassVar[tuple[int, ...]] = (3,)
    unit_norm: ClassVar[bool] = False
    flat: ClassVar[bool] = True

    name: str = "translation"

    @property
    def coordinates(self) -> tuple[tuple[str, str], ...]:
        return tuple((f"displacement, {axis}", "m") for axis in "xyz")

    @property
    def columns(self) -> tuple[MotionColumn, ...]:
        return tuple(MotionColumn(axis, 0.0, 1.0) for axis in range(3))

    def relative(
        self,
        q: Float[Array, "3 k *s"],
        K: Float[Array, "3 3 k *s"],
        k: Float[Array, "3 k *s"],
        shares: ColumnParts,
    ) -> tuple[Float[Array, "3 3 k ..."], Float[Array, "3 k ..."]]:
        del shares
        return K, k + apply(K, q)

    def euler_parameters(
        self, q: Float[Array, "3 k *s"], shares: ColumnParts
    ) -> Float[Array, "4 k *s"]:
        del shares
        return jnp.zeros((4, *q.shape[1:]), q.dtype).at[0].set(1.0)

    def read(
        self, seen: RelativeFrames, shares: ColumnParts
    ) -> tuple[Float[Array, "3 k"], Float[Array, "3 3 k"], Float[Array, "3 k"]]:
        del shares
        X = jnp.broadcast_to(eye(seen.offset), seen.rotation.shape)
        return seen.offset, X, seen.offset

    def rates(self, q: Float[Array, "3 k *s"], u: Float[Array, "3 k *s"]) -> Float[Array, "3 k *s"]:
        del q
        return u

    def retract(
        self, q: Float[Array, "3 k *s"], step: Float[Array, "3 k *s"]
    ) -> Float[Array, "3 k *s"]:
        return q + step

    def difference(
        self, y: Float[Array, "3 k *s"], x: Float[Array, "3 k *s"]
    ) -> Float[Array, "3 k *s"]:
        return y - x

    def pose(
        self, x: Float[Array, " c"], x_rate: Float[Array, " c"], axis: int, pitch: Float[Array, ""]
    ) -> RelativePose:
        del pitch
        own = jnp.eye(3, dtype=x.dtype)[:, CYCLIC[axis]]
        zero = jnp.zeros_like(x)
        return RelativePose(jnp.eye(4, dtype=x.dtype)[0], own @ x, zero, own @ x_rate)


TRANSLATION = Translation()
