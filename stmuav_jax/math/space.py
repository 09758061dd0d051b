"""Spaces of states and measurements: retraction by an error, and differences of points.

    difference(retract(x, v), x) = v  for v shorter than half a turn

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

from ..checks.errors import ModelError, has_values
from ..checks.numbers import UNIT_TOLERANCE
from .derivative import safe_norm
from .rotation import conjugate, from_rotation_vector, product, to_rotation_vector

# Largest distance of a measured rotation's norm from one: numbers of a file are rounded.
READING_TOLERANCE = 1e-2

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
    def check(self, x: Point, subject: str) -> None:
        """Raise `ModelError` unless x has this space's components first."""


def half_turns(space: AbstractSpace, v: Error) -> Float[Array, "*s"] | None:
    """Largest angle of an error v (size, *s) in half turns, beyond one of which `difference` wraps.

    Spaces with angles have a method `half_turns(v)`; the result for others is None.
    """
    method = getattr(space, "half_turns", None)
    return None if method is None else method(v)


def as_reading(space: AbstractSpace, y: Point) -> Point:
    """Measured point as the filters use it, NaN where the measurement is missing.

    Spaces whose points are measured with a rounding of their own have a method `as_reading(y)`.
    """
    method = getattr(space, "as_reading", None)
    return y if method is None else method(y)


class Vector(AbstractSpace):
    """Vector space (size, *s); errors are differences."""

    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=True)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        return y - x

    def check(self, x: Point, subject: str) -> None:
        _check_components(x, self.size, subject)


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
        separation = y - x
        turning = np.array(self.angular).reshape(-1, *(1,) * (separation.ndim - 1))
        # arctan2 brings a difference into (-pi, pi] with a derivative of one everywhere but at half a turn; a
        # remainder of a division would have none at the wrap.
        return jnp.where(turning, jnp.arctan2(jnp.sin(separation), jnp.cos(separation)), separation)

    def half_turns(self, v: Error) -> Float[Array, "*s"]:
        angles = v[np.array(self.angular)]
        return jnp.max(jnp.abs(angles), axis=0, initial=0.0) / np.pi

    def check(self, x: Point, subject: str) -> None:
        _check_components(x, self.size, subject)


class Rotation(AbstractSpace):
    """Space of rotations by Euler parameters (4, *s); errors are body rotation vectors [rad]."""

    size: int = eqx.field(static=True, default=3)
    is_flat: bool = eqx.field(static=True, default=False)

    def retract(self, x: Point, v: Error) -> Point:
        # Errors act from the right, in body axes: process noise and sensors of a vehicle are independent
        # there of its attitude.
        return product(x, from_rotation_vector(v))

    def difference(self, y: Point, x: Point) -> Error:
        return to_rotation_vector(product(conjugate(x), y))

    def half_turns(self, v: Error) -> Float[Array, "*s"]:
        return jnp.sqrt(jnp.sum(v * v, axis=0)) / np.pi

    def as_reading(self, y: Point) -> Point:
        """Unit Euler parameters of measured ones, which files round.

        Zeros are a missing measurement. A norm that is more than `READING_TOLERANCE` from one is no
        rotation: the result is infinite, so that the filter fails there.
        """
        norm = jnp.sqrt(jnp.sum(y * y, axis=0))
        # Logs mark a missing attitude by zeros, which have no direction: NaN is the mark of missing
        # measurements in all filters.
        unit = y / jnp.where(norm == 0, jnp.nan, norm)
        return jnp.where((norm != 0) & (jnp.abs(norm - 1) > READING_TOLERANCE), jnp.inf, unit)

    def check(self, x: Point, subject: str) -> None:
        _check_components(x, 4, subject)
        _check_unit(x, subject)


class RotationVector(AbstractSpace):
    """Rotation vectors (3, *s) [rad]; those of one rotation that differ by whole turns are the same."""

    size: int = eqx.field(static=True, default=3)
    is_flat: bool = eqx.field(static=True, default=False)

    def retract(self, x: Point, v: Error) -> Point:
        return x + v

    def difference(self, y: Point, x: Point) -> Error:
        angle = safe_norm(x)
        # Near the zero vector every axis serves, as no turns are added there.
        axis = x / jnp.where(angle > 0, angle, 1.0)
        # the turns that bring x next to y are constants, not part of a derivative
        turns = jnp.round(jax.lax.stop_gradient(jnp.sum(axis * y, axis=0) - angle) / (2 * jnp.pi))
        return y - x - 2 * jnp.pi * turns * axis

    def check(self, x: Point, subject: str) -> None:
        _check_components(x, 3, subject)


class Composite(AbstractSpace):
    """Product space whose points are dictionaries; errors are concatenated in the given order."""

    parts: tuple[tuple[str, AbstractSpace], ...]
    size: int = eqx.field(static=True)
    is_flat: bool = eqx.field(static=True, default=False)

    def __init__(self, **parts: AbstractSpace) -> None:
        self.parts = tuple(parts.items())
        self.size = sum(part.size for part in parts.values())

    def _part_slices(self) -> list[tuple[str, AbstractSpace, slice]]:
        start, slices = 0, []
        for name, part in self.parts:
            slices.append((name, part, slice(start, start + part.size)))
            start += part.size
        return slices

    def retract(self, x: Point, v: Error) -> Point:
        return {name: part.retract(x[name], v[at]) for name, part, at in self._part_slices()}

    def difference(self, y: Point, x: Point) -> Error:
        return jnp.concatenate([part.difference(y[name], x[name]) for name, part in self.parts])

    def half_turns(self, v: Error) -> Float[Array, "*s"]:
        return _largest_value([half_turns(part, v[at]) for _, part, at in self._part_slices()], v)

    def check(self, x: Point, subject: str) -> None:
        names = {name for name, _ in self.parts}
        if not isinstance(x, dict) or set(x) != names:
            description = sorted(x) if isinstance(x, dict) else type(x).__name__
            raise ModelError(
                f"{subject} must be a dictionary of {sorted(names)}, not {description}."
            )
        for name, part in self.parts:
            part.check(x[name], f"{subject}['{name}']")


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
            if not isinstance(part, Vector | CyclicVector | Rotation | RotationVector):
                raise ModelError(
                    f"Points of {type(part).__name__} are not arrays and cannot be concatenated."
                )
        self.parts = parts
        self.lengths = tuple(4 if isinstance(part, Rotation) else part.size for part in parts)
        self.size = sum(part.size for part in parts)
        self.is_flat = all(part.is_flat for part in parts)

    def _split_parts(self, x: Point) -> list[Point]:
        return jnp.split(x, np.cumsum(self.lengths)[:-1])

    def retract(self, x: Point, v: Error) -> Point:
        errors = jnp.split(v, np.cumsum([part.size for part in self.parts])[:-1])
        triples = zip(self.parts, self._split_parts(x), errors, strict=True)
        return jnp.concatenate(
            [part.retract(component, error) for part, component, error in triples]
        )

    def difference(self, y: Point, x: Point) -> Error:
        triples = zip(self.parts, self._split_parts(y), self._split_parts(x), strict=True)
        return jnp.concatenate([part.difference(b, a) for part, b, a in triples])

    def half_turns(self, v: Error) -> Float[Array, "*s"]:
        errors = jnp.split(v, np.cumsum([part.size for part in self.parts])[:-1])
        pairs = zip(self.parts, errors, strict=True)
        return _largest_value([half_turns(part, error) for part, error in pairs], v)

    def as_reading(self, y: Point) -> Point:
        pairs = zip(self.parts, self._split_parts(y), strict=True)
        return jnp.concatenate([as_reading(part, component) for part, component in pairs])

    def check(self, x: Point, subject: str) -> None:
        _check_components(x, sum(self.lengths), subject)
        for part, part_point in zip(self.parts, self._split_parts(x), strict=True):
            part.check(part_point, subject)


def _largest_value(values: list[Array | None], v: Error) -> Float[Array, "*s"]:
    """Largest of the values that are there, zero without any."""
    angles = [value for value in values if value is not None]
    return jnp.max(jnp.stack([jnp.zeros(v.shape[1:], v.dtype), *angles]), axis=0)


def _check_components(x: Any, size: int, subject: str) -> None:
    shape = jnp.shape(x)
    if not shape or shape[0] != size:
        raise ModelError(f"{subject} must have {size} components first, but its shape is {shape}.")


def _check_unit(p: Any, subject: str) -> None:
    """Raise `ModelError` unless Euler parameters are unit; NaN entries are skipped."""
    if not has_values(p):
        return
    norm = np.linalg.norm(np.asarray(p, dtype=float), axis=0)
    # tolerance for the rounding of numbers in their own precision
    epsilon = float(jnp.finfo(jnp.asarray(p, dtype=jnp.result_type(p, jnp.float16)).dtype).eps)
    # Single precision rounds a unit quaternion by more than the tolerance for double precision, and must
    # not be rejected for it.
    is_invalid = np.abs(norm - 1) > max(UNIT_TOLERANCE, 10 * epsilon)
    if np.any(is_invalid):
        raise ModelError(
            f"{subject} must be unit Euler parameters (a unit quaternion), but the norm is "
            f"{norm[is_invalid].flat[0]:.9g}. Divide by it if that is only rounding."
        )


def expand_axis(x: Point, axis: int = 1) -> Point:
    """Point with one more axis, for the sigma points."""
    return jax.tree.map(lambda leaf: jnp.expand_dims(leaf, axis), x)
