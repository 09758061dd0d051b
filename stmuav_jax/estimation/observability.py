"""What measurements along a path can tell about the state, and what they cannot, in words.

The rows of the observability matrix are the derivatives of the measurements, in units of their
noise, by the error of the first state, in units of its prior deviation if one is given:

    O = [R^-1/2 H_0; R^-1/2 H_1 F_1; R^-1/2 H_2 F_2 F_1; ...] L_0

A direction v with O v = 0 changes no measurement: no filter can learn it.
"""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .factor import divide_lower
from .model import Inputs, StateSpaceModel
from .space import AbstractSpace, Point

# A component below this fraction of a direction's largest is not named.
_NAMED = 1e-3


class Observability(NamedTuple):
    """Singular values and null directions of the observability matrix.

    Attributes:
        singular_values: (n,), falling. rank: how many exceed the tolerance.
        null: an orthonormal basis of the scaled directions that cannot be seen, (n, n - rank).
        names: of the state's error components. scale: by which they were divided (n,).
    """

    singular_values: np.ndarray
    rank: int
    null: np.ndarray
    names: tuple[str, ...]
    scale: np.ndarray

    def words(self) -> str:
        """One sentence per thing that cannot be observed."""
        n = len(self.names)
        if self.rank == n:
            return f"All {n} states are observable."
        alone, combined = _separate(self.null)
        lines = [f"{self.rank} of {n} directions are observable."]
        if alone:
            listed = ", ".join(self.names[i] for i in alone)
            lines.append(f"Not observable at all: {listed}.")
        for direction in combined.T:
            lines.append(f"Not observable together: {self._sum(direction * self.scale)}.")
        return " ".join(lines)

    def _sum(self, v: np.ndarray) -> str:
        """A direction as a sum of states, the largest component one."""
        v = v / v[np.argmax(np.abs(v))]
        parts = [
            f"{'-' if c < 0 else '+'} {'' if abs(abs(c) - 1) < 1e-9 else f'{abs(c):.3g} '}{self.names[i]}"
            for i, c in enumerate(v)
            if abs(c) > _NAMED
        ]
        return " ".join(parts).removeprefix("+ ")


def _separate(null: np.ndarray) -> tuple[list[int], np.ndarray]:
    """States that are unobservable by themselves, and a basis of what is left, reduced."""
    inside = np.sum(null**2, axis=1)
    alone = [i for i in range(len(null)) if inside[i] > 1 - 1e-6]
    rest = null.copy()
    rest[alone] = 0.0
    left, values, _ = np.linalg.svd(rest, full_matrices=False)
    basis = left[:, values > 1e-6]
    # row echelon: each direction has a component that the others do not have
    for k in range(basis.shape[1]):
        i, j = np.unravel_index(np.argmax(np.abs(basis[:, k:])), basis[:, k:].shape)
        basis[:, [k, k + int(j)]] = basis[:, [k + int(j), k]]
        basis[:, k] /= basis[i, k]
        for other in range(basis.shape[1]):
            if other != k:
                basis[:, other] -= basis[i, other] * basis[:, k]
    return alone, basis


def observability_matrix(
    model: StateSpaceModel, start: Point, u: Inputs, dt: Any, count: int
) -> Float[Array, "_ n"]:
    """Derivatives of `count` + 1 measurements along the path, in units of their noise.

    Args:
        start: the state at the beginning. u: inputs (count, k) or None. dt: step [s].
    """
    n, sensor = model.space.size, model.sensor
    zero = jnp.zeros(n, model.noise.dtype)

    def seen(x: Point, now: Inputs) -> Array:
        centre = sensor(x, now)
        error = lambda v: sensor.space.difference(sensor(model.space.retract(x, v), now), centre)
        return divide_lower(sensor.noise, jax.jacfwd(error)(zero))

    def step(carry: tuple, now: Inputs) -> tuple:
        x, F = carry
        moved = model(x, now, dt)
        error = lambda v: model.space.difference(model(model.space.retract(x, v), now, dt), moved)
        F = jax.jacfwd(error)(zero) @ F
        return (moved, F), seen(moved, now) @ F

    first = jax.tree.map(lambda leaf: leaf[0], u)
    path = jax.lax.scan(step, (start, jnp.eye(n, dtype=zero.dtype)), u, length=count)[1]
    return jnp.concatenate([seen(start, first), path.reshape(-1, n)])


def observability(
    model: StateSpaceModel,
    start: Point,
    *,
    u: Inputs = None,
    dt: Any,
    count: int,
    scale: Any = None,
    tolerance: float = 1e-9,
    space: AbstractSpace | None = None,
) -> Observability:
    """Rank, singular values and null directions of the observability matrix along a path.

    Args:
        start, u, dt, count: as `observability_matrix`.
        scale: what a notable error of each component is (n,), so that units do not decide; ones
            by default.
        space: whose errors the directions are; the model's by default.
        tolerance: singular values below this fraction of the largest count as zero.
    """
    if space is not None:
        model = eqx.tree_at(lambda m: m.space, model, space)
    model.space.check(start, "The start")
    rows = jax.jit(lambda s, u: observability_matrix(model, s, u, dt, count))(start, u)
    n = rows.shape[1]
    size = np.ones(n) if scale is None else np.asarray(scale, dtype=float)
    _, values, right = np.linalg.svd(np.asarray(rows) * size, full_matrices=True)
    rank = int(np.sum(values > tolerance * max(values[0], np.finfo(float).tiny)))
    return Observability(values, rank, right[rank:].T, model.names, size)
