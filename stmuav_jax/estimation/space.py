"""Spaces that states and measurements live in: how to move by an error, and errors between points.

    difference(retract(x, v), x) = v  for small v

A rotation, given by Euler parameters, has errors of three dimensions: p * exp(v), v in body axes
[rad], so that the covariance has no direction along which it must be zero. Components first;
further axes (sigma points, filters of a bank) last.

Source: C. Hertzberg et al., Integrating generic sensor fusion algorithms with sound state
representations through encapsulation of manifolds, Information Fusion 14 (2013).
"""

from abc import abstractmethod
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import conjugate, from_rotation_vector, product
from ..algebra.stacked import dot
from ..mechanics.body import UNIT_TOLERANCE
from ..mechanics.errors import ModelError, concrete

Point = Any
Error = Float[Array, "n *s"]

_SMALL_SQUARE = 1e-5


class AbstractSpace(eqx.Module):
    """A set of points with errors that are vectors of `size` components."""

    size: eqx.AbstractVar[int]
    is_flat: eqx.AbstractVar[bool]

    @abstractmethod
    def retract(self, x: Point, v: Error) -> Point:
        """The point at error v from x."""

    @abstractmethod
    def difference(self, y: Point, x: Point) -> Error:
        """The error of y seen from x."""

    @abstractmethod
    def check(self, x: Point, what: str) -> None:
        """Raise `ModelError` unless x has this space's components first."""


class Vector(AbstractSpace):
    """Vectors (size, *s); errors are differences."""

    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=True)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        return y - x

    def check(self, x: Point, what: str) -> None:
        _check_components(x, self.size, what)


class Angle(AbstractSpace):
    """Angles (size, *s) [rad] that are the same after a turn; errors lie in [-pi, pi]."""

    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=False)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        apart = y - x
        return jnp.arctan2(jnp.sin(apart), jnp.cos(apart))

    def check(self, x: Point, what: str) -> None:
        _check_components(x, self.size, what)


class Rotation(AbstractSpace):
    """Rotations by Euler parameters (4, *s); errors are rotation vectors in body axes [rad]."""

    size: int = eqx.field(static=True, default=3)
    is_flat: bool = eqx.field(static=True, default=False)

    def retract(self, x: Point, v: Error) -> Point:
        return product(x, from_rotation_vector(v))

    def difference(self, y: Point, x: Point) -> Error:
        return _rotation_vector(product(conjugate(x), y))

    def check(self, x: Point, what: str) -> None:
        _check_components(x, 4, what)
        _check_unit(x, what)


class Composite(AbstractSpace):
    """Points that are dictionaries; errors follow each other in the given order."""

    parts: tuple[tuple[str, AbstractSpace], ...]
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=False)

    def __init__(self, **parts: AbstractSpace) -> None:
        self.parts = tuple(parts.items())
        self.size = sum(part.size for part in parts.values())

    def _slices(self) -> list[tuple[str, AbstractSpace, slice]]:
        start, found = 0, []
        for name, part in self.parts:
            found.append((name, part, slice(start, start + part.size)))
            start += part.size
        return found

    def retract(self, x: Point, v: Error) -> Point:
        return {name: part.retract(x[name], v[at]) for name, part, at in self._slices()}

    def difference(self, y: Point, x: Point) -> Error:
        return jnp.concatenate([part.difference(y[name], x[name]) for name, part in self.parts])

    def check(self, x: Point, what: str) -> None:
        names = {name for name, _ in self.parts}
        if not isinstance(x, dict) or set(x) != names:
            shown = sorted(x) if isinstance(x, dict) else type(x).__name__
            raise ModelError(f"{what} must be a dictionary of {sorted(names)}, not {shown}.")
        for name, part in self.parts:
            part.check(x[name], f"{what}['{name}']")


def _check_components(x: Any, size: int, what: str) -> None:
    shape = jnp.shape(x)
    if not shape or shape[0] != size:
        raise ModelError(f"{what} must have {size} components first, but its shape is {shape}.")


def _check_unit(p: Any, what: str) -> None:
    """Raise `ModelError` unless Euler parameters are unit where they are there (not NaN)."""
    if not concrete(p):
        return
    norm = np.linalg.norm(np.asarray(p, dtype=float), axis=0)
    # what rounding of numbers in their own precision leaves
    epsilon = float(jnp.finfo(jnp.asarray(p, dtype=jnp.result_type(p, jnp.float16)).dtype).eps)
    off = np.abs(norm - 1) > max(UNIT_TOLERANCE, 10 * epsilon)
    if np.any(off):
        raise ModelError(
            f"{what} must be unit Euler parameters (a unit quaternion), but the norm is "
            f"{norm[off].flat[0]:.9g}. Divide by it if that is only rounding."
        )


def _rotation_vector(p: Float[Array, "4 *s"]) -> Float[Array, "3 *s"]:
    """Rotation vector of unit p for stacks, its length in [0, pi]; p and -p give the same."""
    q = jnp.where(p[:1] < 0, -p, p)
    square = dot(q[1:], q[1:])
    small = square < _SMALL_SQUARE
    length = jnp.sqrt(jnp.where(small, 1.0, square))
    # 2 asin(s) / s, s the sine of half the angle; the first term left out is below 1e-16
    series = 2 + square / 3 + 3 * square**2 / 20
    return jnp.where(small, series, 2 * jnp.arctan2(length, q[0]) / length) * q[1:]


def expanded(x: Point, axis: int = 1) -> Point:
    """A point with one more axis, for the sigma points."""
    return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, axis), x)
