"""Bound of the step size that keeps derivatives accurate, from the modes of the linearised motion.

Step size control by the error of the state alone does not bound the error of derivatives: about
an equilibrium the state has no error at all, and the steps would grow without bound, while the
derivatives still oscillate with every mode of the system. Derivatives obey the linearised
equations s' = J s + b with J = df/dy, which a Runge-Kutta or Rosenbrock method of stability
function R integrates with a relative error of |R(h lambda) - exp(h lambda)| a step in a mode of
eigenvalue lambda. The steps are bounded such that this is at most a small share of the tolerance
per radian of the fastest mode.

Arnoldi's method gives a small matrix whose eigenvalues include the largest of J, from products
J v for a few directions v, by differences that cost one right-hand side each; it is repeated
every few steps. For implicit methods all directions are used, and modes that have decayed since
the start count less: by a factor exp(Re lambda tau / order) after the time tau.

Source: Y. Saad, Numerical Methods for Large Eigenvalue Problems (2011), ch. VI (Arnoldi's method);
E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), ch. IV.2 (stability
functions), IV.7 (those of Rosenbrock methods).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...algebra import lapack
from ...checks.shapes import StateVector
from .rosenbrock import Rodas5P, stability

# Relative error of derivatives allowed per radian of the fastest mode, over the tolerance: at the
# default of 1e-8 a period of a pendulum at rest then costs derivatives 1.3e-10 of their size.
SHARE = 1 / 500

# Number of directions of Arnoldi's method: on the seven-body UAV it gives the fastest mode to 3 %,
# in one of fourteen postures to 17 %.
DIRECTIONS = 10

# Accepted steps until the modes are computed again; the smaller number where they bound the steps.
EVERY, EVERY_BOUND = 12, 4


class Modes(NamedTuple):
    """Memory of a run: the longest safe step [s], its age in steps, the initial time [s]."""

    longest: Float[Array, ""]
    age: Int[Array, ""]
    start: Float[Array, ""]


class Krylov(NamedTuple):
    """Orthonormal basis of a Krylov space, a row each, and the matrix of J in it."""

    basis: Float[Array, "m+1 k"]
    matrix: Float[Array, "m+1 m"]


class Guard(eqx.Module):
    """Bound of the step size by the modes of the linearised motion.

    Args:
        radius: largest product of step and magnitude of an eigenvalue.
        order: order of the method.
        implicit: True if steps may be long for modes that have decayed.
        size: number of entries of y with equations of motion; the others are quadratures.
    """

    radius: Float[Array, ""]
    order: int = eqx.field(static=True)
    implicit: bool = eqx.field(static=True)
    size: int = eqx.field(static=True)

    @property
    def directions(self) -> int:
        """Number of directions of Arnoldi's method."""
        return self.size if self.implicit else min(self.size, DIRECTIONS)

    def begin(self, t0: Any, y0: StateVector) -> Modes:
        """Initial memory, without any bound yet."""
        return Modes(jnp.asarray(jnp.inf, y0.dtype), jnp.asarray(EVERY), jnp.asarray(t0, y0.dtype))

    def due(self, modes: Modes, h: Any) -> Bool[Array, ""]:
        """True if the modes are to be computed in a step of length h [s]."""
        often = h > 0.75 * modes.longest
        return modes.age >= jnp.where(often, EVERY_BOUND, EVERY)

    def first(self, y0: StateVector) -> Krylov:
        """Krylov space of a first direction: pseudo-random, always the same, with all modes."""
        m, k = self.directions, y0.shape[0]
        start = np.zeros(k)
        start[: self.size] = np.random.default_rng(0).normal(size=self.size)
        basis = np.zeros((m + 1, k))
        basis[0] = start / np.linalg.norm(start)
        return Krylov(jnp.asarray(basis, y0.dtype), jnp.zeros((m + 1, m), y0.dtype))

    def away(self, y0: StateVector) -> Float[Array, ""]:
        """Length of the difference along a direction."""
        small = jnp.finfo(y0.dtype).eps ** 0.4
        return small * (1 + jnp.max(jnp.abs(y0[: self.size])))

    def with_slope(self, krylov: Krylov, j: Any, change: StateVector) -> Krylov:
        """Krylov space with one more direction: the part of J v_j (`change`) outside of it."""
        change = jnp.where(np.arange(change.shape[0]) < self.size, change, 0.0)
        along = krylov.basis @ change
        left = change - along @ krylov.basis
        more = krylov.basis @ left
        left, along = left - more @ krylov.basis, along + more
        length = jnp.linalg.norm(left)
        # there is no new direction if J v lies in the space
        new = length > 1e-6 * jnp.linalg.norm(change)
        row = jnp.where(new, left / jnp.where(new, length, 1.0), 0.0)
        column = jnp.where(np.arange(along.shape[0]) == j + 1, jnp.where(new, length, 0.0), along)
        put = jax.lax.dynamic_update_index_in_dim
        return Krylov(put(krylov.basis, row, j + 1, 0), put(krylov.matrix, column, j, 1))

    def found(self, krylov: Krylov, modes: Modes, t: Any) -> Modes:
        """Memory with the longest step that the modes allow at t [s]."""
        H = krylov.matrix[:-1]
        if self.implicit:
            values = lapack.eigenvalues(jnp.where(jnp.all(jnp.isfinite(H)), H, 0.0))
            left = jnp.maximum(-values.real, 0.0) * (t - modes.start) / self.order
            fastest = jnp.max(jnp.abs(values) * jnp.exp(-left))
        else:
            fastest = spectral_radius(H)
        fastest = jnp.where(jnp.isfinite(fastest), fastest, 0.0)
        longest = jnp.where(
            fastest > 0, self.radius / jnp.where(fastest > 0, fastest, 1.0), jnp.inf
        )
        return Modes(longest, jnp.zeros_like(modes.age), modes.start)

    def looked(
        self,
        field: Callable[[Any, StateVector], StateVector],
        t0: Any,
        y0: StateVector,
        h: Any,
        modes: Modes,
    ) -> Modes:
        """Memory after a step of length h from y0 at t0, where the modes are computed if due."""
        t0, y0, h = jax.lax.stop_gradient((jnp.asarray(t0, y0.dtype), y0, h))
        due = self.due(modes, h)

        def look() -> Modes:
            away = self.away(y0)

            # the slope at y0 itself comes first, in the same loop: one copy of the field to compile
            def one(
                now: tuple[Krylov, StateVector], j: Any
            ) -> tuple[tuple[Krylov, StateVector], None]:
                krylov, base = now
                first, j = j < 0, jnp.maximum(j, 0)
                slope = field(t0, y0 + jnp.where(first, 0.0, away) * krylov.basis[j])
                more = self.with_slope(krylov, j, (slope - base) / away)
                kept = jax.tree.map(lambda a, b: jnp.where(first, a, b), krylov, more)
                return (kept, jnp.where(first, slope, base)), None

            begin = (self.first(y0), jnp.zeros_like(y0))
            (krylov, _), _ = jax.lax.scan(one, begin, jnp.arange(-1, self.directions))
            return self.found(krylov, modes, t0)

        now = jax.lax.cond(eqxi.unvmap_any(due), look, lambda: modes)
        older = Modes(modes.longest, modes.age + 1, modes.start)
        return jax.lax.stop_gradient(jax.tree.map(lambda a, b: jnp.where(due, a, b), now, older))


def spectral_radius(H: Float[Array, "m m"]) -> Float[Array, ""]:
    """Upper bound |H^128|^(1/128), by the Frobenius norm, of the magnitudes of the eigenvalues."""

    def square(at: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        power, logarithm = at
        size = jnp.linalg.norm(power)
        power = power / jnp.where(size > 0, size, 1.0)
        return (power @ power, 2 * (logarithm + jnp.log(size))), None

    (power, logarithm), _ = jax.lax.scan(square, (H, jnp.zeros((), H.dtype)), None, length=7)
    return jnp.exp((logarithm + jnp.log(jnp.linalg.norm(power))) / 2**7)


def guard(solver: diffrax.AbstractSolver, rtol: Any, size: int) -> Guard:
    """Bound of the step size for a solver at a tolerance, for `size` equations of motion."""
    order = solver.order(diffrax.ODETerm(lambda t, y, args: y)) or 1
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver | Rodas5P)
    return Guard(radius(solver, order, rtol), order, implicit, size)


def radius(solver: Any, order: int, rtol: Any) -> Float[Array, ""]:
    """Largest |z| at which |R(z) - exp(z)| is at most `SHARE` rtol |z|, at most 2."""
    table = _errors(type(solver), order, stability_function(solver) is not None)
    if table is None:
        # unknown stability function: the next term of the exponential series as the error
        faculty = float(np.prod(np.arange(1.0, order + 2)))
        return jnp.minimum((SHARE * rtol * faculty) ** (1 / order), 2.0)
    sizes, error = table
    target = jnp.log(SHARE * jnp.asarray(rtol))
    return jnp.exp(jnp.interp(target, jnp.asarray(np.log(error)), jnp.asarray(np.log(sizes))))


@cache
def _errors(kind: Any, order: int, known: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Table of |z| and the largest |R(z) - exp(z)| / |z| within that circle, for a solver class.

    None if the stability function R is not known.
    """
    of = stability_function(kind) if known else None
    if of is None:
        return None
    sizes = np.geomspace(1e-5, 2.0, 120)
    ways = np.exp(1j * np.linspace(0.0, np.pi, 7))
    error = np.array([max(abs(of(r * w) - np.exp(r * w)) for w in ways) for r in sizes])
    # smaller errors are round-off; there they are extrapolated by the order of the method
    first = int(np.argmax(error > 1e-13))
    error = np.maximum.accumulate(error[first:] / sizes[first:])
    return sizes, np.concatenate([error[0] * (sizes[:first] / sizes[first]) ** order, error])


def stability_function(solver: Any) -> Callable[[complex], complex] | None:
    """Stability function R(z) of a solver or a class of solvers, None if it is not known."""
    if isinstance(solver, Rodas5P) or solver is Rodas5P:
        return stability
    table: Any = getattr(solver, "tableau", None)
    if not isinstance(table, diffrax.ButcherTableau):
        return None
    count = len(table.b_sol)
    A = np.zeros((count, count))
    for i, row in enumerate(table.a_lower):
        A[i + 1, : i + 1] = row
    if table.a_diagonal is not None:
        A += np.diag(table.a_diagonal)
    b, one = np.asarray(table.b_sol), np.ones(count)
    return lambda z: complex(1 + z * (b @ np.linalg.solve(np.eye(count) - z * A, one)))
