"""Observability of the state by measurements along a path, with an explanation.

The rows of the observability matrix are the derivatives of the measurements, in units of their
noise, with respect to the error of the first state:

    O = [R^-1/2 H_0; R^-1/2 H_1 F_1; R^-1/2 H_2 F_2 F_1; ...]

A direction v with O v = 0 changes no measurement, so no filter can estimate it.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, check_finite, has_values
from ..math.space import Point
from .filter import compiled_once
from .gaussians import divide_lower
from .model import Inputs, StateSpaceModel
from .records import as_numbers, read_inputs

# A component below this fraction of a direction's largest is not named.
_NAMED = 1e-3


class Observability(NamedTuple):
    """Singular values and null directions of the observability matrix.

    Attributes:
        singular_values: singular values (n,), in descending order.
        rank: number of singular values above the tolerance.
        null_space: orthonormal basis of the unobservable directions (n, n - rank).
        names: names of the state's error components.
    """

    singular_values: np.ndarray
    rank: int
    null_space: np.ndarray
    names: tuple[str, ...]

    def describe(self) -> str:
        """Sentences on the rank, the unobservable states and their unobservable combinations."""
        n, null = len(self.names), self.null_space
        if self.rank == n:
            return f"All {n} states are observable."
        lines = [f"{self.rank} of {n} directions are observable."]
        # Share of a state's axis in the null space, whose basis is orthonormal: 1 if it lies within.
        alone = [i for i in range(n) if np.sum(null[i] ** 2) > 1 - 1e-6]
        if alone:
            listed = ", ".join(self.names[i] for i in alone)
            lines.append(f"Not observable at all: {listed}.")
        rest = null.copy()
        rest[alone] = 0.0
        directions, values, _ = np.linalg.svd(rest, full_matrices=False)
        basis = directions[:, values > 1e-6]
        # reduced echelon form: each direction has a component that the others do not have
        for k in range(basis.shape[1]):
            i, j = np.unravel_index(np.argmax(np.abs(basis[:, k:])), basis[:, k:].shape)
            basis[:, [k, k + int(j)]] = basis[:, [k + int(j), k]]
            basis[:, k] /= basis[i, k]
            for other in range(basis.shape[1]):
                if other != k:
                    basis[:, other] -= basis[i, other] * basis[:, k]
        for v in basis.T:
            # A direction has neither length nor sign; the largest component is made one.
            v = v / v[np.argmax(np.abs(v))]
            parts = [
                f"{'-' if c < 0 else '+'} {'' if abs(abs(c) - 1) < 1e-9 else f'{abs(c):.3g} '}{self.names[i]}"
                for i, c in enumerate(v)
                if abs(c) > _NAMED
            ]
            lines.append(f"Not observable together: {' '.join(parts).removeprefix('+ ')}.")
        return " ".join(lines)


def observability_matrix(
    model: StateSpaceModel, start: Point, u: Inputs, dt: Any, count: int
) -> Float[Array, "_ n"]:
    """Observability matrix of `count` + 1 measurements along a path, in units of their noise.

    Args:
        start: initial state.
        u: inputs (count, k) or None.
        dt: length of the steps [s].
    """
    n, sensor = model.space.size, model.sensor
    # a perfect sensor has no noise to be a unit: its readings keep their own
    perfect = jnp.diagonal(sensor.noise) == 0
    noise = sensor.noise + jnp.diag(jnp.where(perfect, 1.0, 0.0).astype(sensor.noise.dtype))
    zero = jnp.zeros(n, model.noise.dtype)

    def sensed_rows(x: Point, now: Inputs) -> Array:
        centre = sensor(x, now)
        error = lambda v: sensor.space.difference(sensor(model.space.retract(x, v), now), centre)
        return divide_lower(noise, jax.jacfwd(error)(zero))

    def propagate_step(carry: tuple, now: Inputs) -> tuple:
        x, F = carry
        propagated = model(x, now, dt)
        error = lambda v: model.space.difference(
            model(model.space.retract(x, v), now, dt), propagated
        )
        F = jax.jacfwd(error)(zero) @ F
        return (propagated, F), sensed_rows(propagated, now) @ F

    first = jax.tree.map(lambda leaf: leaf[0], u)
    path = jax.lax.scan(propagate_step, (start, jnp.eye(n, dtype=zero.dtype)), u, length=count)[1]
    return jnp.concatenate([sensed_rows(start, first), path.reshape(-1, n)])


def observability(
    model: StateSpaceModel,
    start: Point,
    *,
    u: Inputs = None,
    dt: Any,
    count: int,
    tolerance: float = 1e-9,
) -> Observability:
    """Rank, singular values and null directions of the observability matrix along a path.

    Args:
        start, u, dt, count: as in `observability_matrix`.
        tolerance: fraction of the largest singular value below which others count as zero.
    """
    if isinstance(start, list | tuple) and not hasattr(start, "_fields"):
        start = jnp.asarray(as_numbers(start, "The start"), model.noise.dtype)
    u = read_inputs(u)
    model.space.check(start, "The start")
    check_finite(start, "The start", "")
    check_finite(dt, "dt", "s", SettingError)
    for leaf in jax.tree.leaves(u):
        if leaf.shape[0] != count:
            raise ModelError(f"Inputs of {count} steps are needed, but there are {leaf.shape[0]}.")
        if has_values(leaf) and not np.all(np.isfinite(leaf)):
            k = int(np.argwhere(~np.isfinite(np.asarray(leaf)))[0][0])
            raise SettingError(f"The inputs of step {k} are not finite: {np.asarray(leaf[k])}.")
    rows = compiled_once(observability_matrix)(
        model, start, u, jnp.asarray(dt, model.noise.dtype), count
    )
    # double precision: the tolerance lies below the round-off of single precision
    _, values, right = np.linalg.svd(np.asarray(rows, dtype=float), full_matrices=True)
    rank = int(np.sum(values > tolerance * max(values[0], np.finfo(float).tiny)))
    return Observability(values, rank, right[rank:].T, model.names)
