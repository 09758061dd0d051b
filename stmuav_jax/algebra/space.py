"""Spaces of states and measurements: retraction by an error, and differences of points.

    difference(retract(x, v), x) = v  for small v

A rotation, given by Euler parameters, has errors of three dimensions: p * exp(v), v in body axes
[rad], so that the covariance is not singular in any direction. Components come first;
further axes (sigma points, filters of a bank) come last.

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

from ..checks.errors import ModelError, concrete
from ..checks.physical import UNIT_TOLERANCE
from .rotation import conjugate, from_rotation_vector, product, to_rotation_vector

Point = Any
Error = Float[Array, "n *s"]


class AbstractSpace(eqx.Module):
    """Manifold of points whose errors are vectors of `size` components."""

    size: eqx.AbstractVar[int]
    is_flat: eqx.AbstractVar[bool]

    @abstractmethod
    def retract(self, x: Point, v: Error) -> Point:
        """Point at the error v (size, *s) from x."""

    @abstractmethod
    def difference(self, y: Point, x: Point) -> Error:
        """Error (size, *s) of y relative to x."""

    @abstractmethod
    def check(self, x: Point, what: str) -> None:
        """Raise `ModelError` unless x has this space's components first."""


class Vector(AbstractSpace):
    """Vector space (size, *s); errors are differences."""

    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=True)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        return y - x

    def check(self, x: Point, what: str) -> None:
        _check_components(x, self.size, what)


class CyclicVector(AbstractSpace):
    """Vectors (size, *s), some components of which are angles that are the same after a turn.

    Attributes:
        angular: for every component, whether it is such an angle [rad].
    """

    angular: tuple[bool, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True)

    def __init__(self, angular: tuple[bool, ...]) -> None:
        self.angular, self.size, self.is_flat = angular, len(angular), not any(angular)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        apart = y - x
        turning = np.array(self.angular).reshape(-1, *(1,) * (apart.ndim - 1))
        return jnp.where(turning, jnp.arctan2(jnp.sin(apart), jnp.cos(apart)), apart)

    def check(self, x: Point, what: str) -> None:
        _check_components(x, self.size, what)


class Rotation(AbstractSpace):
    """Space of rotations by Euler parameters (4, *s); errors are body rotation vectors [rad]."""

    size: int = eqx.field(static=True, default=3)
    is_flat: bool = eqx.field(static=True, default=False)

    def retract(self, x: Point, v: Error) -> Point:
        return product(x, from_rotation_vector(v))

    def difference(self, y: Point, x: Point) -> Error:
        return to_rotation_vector(product(conjugate(x), y))

    def check(self, x: Point, what: str) -> None:
        _check_components(x, 4, what)
        _check_unit(x, what)


class Composite(AbstractSpace):
    """Product space whose points are dictionaries; errors are concatenated in the given order."""

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


class Concatenated(AbstractSpace):
    """Product of vectors and rotations, whose points are one array: one part after the other.

    Raises:
        ModelError: a part's points are no arrays.
    """

    parts: tuple[AbstractSpace, ...]
    lengths: tuple[int, ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True)

    def __init__(self, *parts: AbstractSpace) -> None:
        for part in parts:
            if not isinstance(part, Vector | CyclicVector | Rotation):
                raise ModelError(
                    f"Points of {type(part).__name__} are no arrays to be put together."
                )
        self.parts = parts
        self.lengths = tuple(4 if isinstance(part, Rotation) else part.size for part in parts)
        self.size = sum(part.size for part in parts)
        self.is_flat = all(part.is_flat for part in parts)

    def _split(self, x: Point) -> list[Point]:
        return jnp.split(x, np.cumsum(self.lengths)[:-1])

    def retract(self, x: Point, v: Error) -> Point:
        errors = jnp.split(v, np.cumsum([part.size for part in self.parts])[:-1])
        each = zip(self.parts, self._split(x), errors, strict=True)
        return jnp.concatenate([part.retract(own, error) for part, own, error in each])

    def difference(self, y: Point, x: Point) -> Error:
        each = zip(self.parts, self._split(y), self._split(x), strict=True)
        return jnp.concatenate([part.difference(b, a) for part, b, a in each])

    def check(self, x: Point, what: str) -> None:
        _check_components(x, sum(self.lengths), what)
        for part, own in zip(self.parts, self._split(x), strict=True):
            part.check(own, what)


def _check_components(x: Any, size: int, what: str) -> None:
    shape = jnp.shape(x)
    if not shape or shape[0] != size:
        raise ModelError(f"{what} must have {size} components first, but its shape is {shape}.")


def _check_unit(p: Any, what: str) -> None:
    """Raise `ModelError` unless Euler parameters are unit; NaN entries are skipped."""
    if not concrete(p):
        return
    norm = np.linalg.norm(np.asarray(p, dtype=float), axis=0)
    # tolerance for the rounding of numbers in their own precision
    epsilon = float(jnp.finfo(jnp.asarray(p, dtype=jnp.result_type(p, jnp.float16)).dtype).eps)
    off = np.abs(norm - 1) > max(UNIT_TOLERANCE, 10 * epsilon)
    if np.any(off):
        raise ModelError(
            f"{what} must be unit Euler parameters (a unit quaternion), but the norm is "
            f"{norm[off].flat[0]:.9g}. Divide by it if that is only rounding."
        )


def expanded(x: Point, axis: int = 1) -> Point:
    """Point with one more axis, for the sigma points."""
    return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, axis), x)
