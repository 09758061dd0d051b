"""Diagonally implicit Runge-Kutta steps with one Jacobian for many steps.

The stages of a method with an explicit first stage and the same diagonal entry g elsewhere,

    k_i = f(t + c_i h, y + h sum_j a_ij k_j + h g k_i),

are solved by simplified Newton iterations with one inverse of I - h g df/dy a step. The Jacobian,
by differences, stays the same until convergence slows down; it changes the number of iterations, not
the solution. One loop over all iterations of all stages holds the only copy of the right-hand side.
With the rate of convergence theta = |d_m| / |d_(m-1)| an iteration ends where theta / (1 - theta) |d_m|
is below a small share of the step's tolerance; a step that does not converge is rejected.

Derivatives follow from the stages' equations with the exact df/dy at each of them, not from the
iterations.

Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), ch. IV.8 (simplified
Newton iterations, when they end, and when the Jacobian is computed again).
"""

from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...algebra.derivative import directional
from ...algebra.linalg import inverted
from ...algebra.native import native_loops
from ...checks.shapes import StateVector
from .explicit import AbstractNonDense

# Error of an iteration over the tolerance of the step, and iterations of a stage at most.
SHARE, ITERATIONS = 0.01, 10
# Rate of convergence above which the next step computes the Jacobian again.
SLOW = 0.1


class Iterated(NamedTuple):
    """Slopes of all stages (s, k), whether all converged, and the largest rate of convergence."""

    slopes: Float[Array, "s k"]
    fine: Bool[Array, ""]
    rate: Float[Array, ""]


class Memory(NamedTuple):
    """Jacobian df/dy (k, k) of an earlier step, and whether it is due to be computed again."""

    jacobian: Float[Array, "k k"]
    due: Bool[Array, ""]


class _Stages(eqx.Module):
    """Butcher coefficients: A (s, s) with its diagonal, predictor (s, s), c (s,), weights."""

    A: np.ndarray
    predictor: np.ndarray
    c: np.ndarray
    b: np.ndarray
    b_error: np.ndarray

    @property
    def diagonal(self) -> float:
        """Diagonal entry of all implicit stages."""
        return float(self.A[1, 1])


def stages(method: diffrax.AbstractESDIRK) -> _Stages:
    """Coefficients of a method of diffrax."""
    table: Any = method.tableau
    count = len(table.b_sol)
    A, predictor = np.diag(np.asarray(table.a_diagonal, float)), np.zeros((count, count))
    for i, (row, guess) in enumerate(zip(table.a_lower, table.a_predictor, strict=True), start=1):
        A[i, :i], predictor[i, :i] = row, guess
    c = np.concatenate([[0.0], table.c])
    return _Stages(A, predictor, c, np.asarray(table.b_sol), np.asarray(table.b_error))


class NonDenseESDIRK(AbstractNonDense):
    """Method of diffrax with an explicit first stage and equal diagonal entries, as in the module.

    The interpolation within steps is linear, so steps must end at the output times.

    Args:
        method: method of diffrax, such as `diffrax.Kvaerno5()`; its root finder is not used.
        rtol, atol: tolerances of the step.
        n_state: number of the first entries of y, whose iterations have to converge.
    """

    method: diffrax.AbstractESDIRK
    rtol: Any
    atol: Any
    n_state: int = eqx.field(static=True)

    def init(self, terms: Any, t0: Any, t1: Any, y0: StateVector, args: Any) -> Memory:
        return Memory(jnp.zeros((*y0.shape, *y0.shape), y0.dtype), jnp.asarray(True))

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: StateVector,
        args: Any,
        solver_state: Memory,
        made_jump: Any,
    ) -> tuple[StateVector, StateVector, Any, Memory, diffrax.RESULTS]:
        del made_jump
        table = stages(self.method)
        t0, h = jnp.asarray(t0, y0.dtype), jnp.asarray(t1 - t0, y0.dtype)
        tolerances = (jnp.asarray(self.rtol, y0.dtype), jnp.asarray(self.atol, y0.dtype))
        still = jax.lax.stop_gradient(((t0, h, y0), tolerances, solver_state))
        slopes, fine, memory = _solved(self, terms, args, (t0, h, y0), still[1], still[2])
        y1 = y0 + h * jnp.sum(table.b[:, None] * slopes, axis=0)
        error = h * jnp.sum(table.b_error[:, None] * slopes, axis=0)
        # an infinite error has the step rejected and the next one shortened as far as allowed
        y1, error = jnp.where(fine, y1, y0), jnp.where(fine, error, jnp.inf)
        info = {"y0": y0, "y1": y1, "slopes": slopes}
        return y1, error, info, memory, diffrax.RESULTS.successful

    def norm(self, change: StateVector, y: StateVector, tolerances: Any) -> Float[Array, ""]:
        """Root mean square of a change of y over the tolerance."""
        rtol, atol = tolerances
        part = (change / (atol + rtol * jnp.abs(y)))[: self.n_state]
        return jnp.sqrt(jnp.mean(part * part))


@eqx.filter_custom_jvp
def _solved(
    solver: NonDenseESDIRK, terms: Any, args: Any, start: Any, tolerances: Any, memory: Memory
) -> tuple[Float[Array, "s k"], Bool[Array, ""], Memory]:
    """Slopes of the stages of a step from `start` = (t, h, y), convergence, and new memory."""
    t, h, y = start
    field = lambda t, y: terms.vf(t, y, args)
    gamma = stages(solver.method).diagonal

    def attempt(now: tuple[Any, Memory, Any]) -> tuple[Any, Memory, Any]:
        _, (J, due), _ = now
        J = jax.lax.cond(due, lambda: _differences(field, t, y, solver.n_state), lambda: J)
        factor = inverted(jnp.eye(y.shape[0], dtype=y.dtype) - h * gamma * J)
        found = _iterate(solver, field, start, factor, tolerances)
        # what fails with the Jacobian of an earlier step is tried again with that of this one
        return found, Memory(J, ~found.fine), due | found.fine

    none = jnp.zeros((len(stages(solver.method).c), *y.shape), y.dtype)
    begin = Iterated(none, jnp.asarray(False), jnp.zeros((), y.dtype))
    found, memory, _ = jax.lax.while_loop(
        lambda now: ~now[2], attempt, (begin, memory, jnp.asarray(False))
    )
    due = ~found.fine | (found.rate > SLOW)
    return found.slopes, found.fine, Memory(memory.jacobian, due)


def _differences(field: Any, t: Any, y: StateVector, n: int) -> Float[Array, "k k"]:
    """Jacobian df/dy by differences, where f depends on the first n entries of y only."""
    away = jnp.sqrt(jnp.finfo(y.dtype).eps) * (1 + jnp.abs(y))
    # a single copy of the field to compile, for all columns and for y itself
    moves = jnp.concatenate([jnp.zeros((1, y.shape[0]), y.dtype), jnp.diag(away)[:n]])
    slope = lambda move: field(t, y + move)
    there = jax.lax.map(slope, moves) if native_loops() else jax.vmap(slope)(moves)
    columns = ((there[1:] - there[0]) / away[:n, None]).T
    return jnp.pad(columns, ((0, 0), (0, y.shape[0] - n)))


def _iterate(
    solver: NonDenseESDIRK, field: Any, start: Any, factor: Any, tolerances: Any
) -> Iterated:
    """Simplified Newton iterations for all stages, one after the other, in one loop."""
    table, (t, h, y0) = stages(solver.method), start
    A, predictor, c = (jnp.asarray(x, y0.dtype) for x in (table.A, table.predictor, table.c))
    last = len(table.c)

    def pass_on(now: tuple[Any, ...]) -> tuple[Any, ...]:
        i, m, slopes, size, rate, _ = now
        y = y0 + h * jnp.sum(A[i][:, None] * slopes, axis=0)
        f = field(t + c[i] * h, y)
        k = slopes[i]
        step = jnp.where(i == 0, f, factor.solve(f - k))
        length = solver.norm(h * table.diagonal * step, y, tolerances)
        ratio = jnp.where(m > 0, length / size, 0.0)
        rate = jnp.where(i == 0, rate, jnp.maximum(rate, ratio))
        # before the first ratio of a step nothing is known about the rate
        known = jnp.where(rate > 0, rate, 0.5)
        done = (i == 0) | ((known < 1) & (known / (1 - known) * length <= SHARE))
        bad = ~done & ((m + 1 >= ITERATIONS) | (ratio >= 2) | ~jnp.isfinite(length))
        slopes = jax.lax.dynamic_update_index_in_dim(slopes, k + step, i, 0)
        after = jnp.minimum(i + 1, last - 1)
        guess = jnp.sum(predictor[after][:, None] * slopes, axis=0)
        begun = jax.lax.dynamic_update_index_in_dim(slopes, guess, after, 0)
        slopes = jnp.where(done & (i + 1 < last), begun, slopes)
        return jnp.where(done, i + 1, i), jnp.where(done, 0, m + 1), slopes, length, rate, bad

    zero = jnp.zeros((), y0.dtype)
    begin = (jnp.zeros((), int), jnp.zeros((), int), jnp.zeros((last, *y0.shape), y0.dtype))
    i, _, slopes, _, rate, bad = jax.lax.while_loop(
        lambda now: (now[0] < last) & ~now[5], pass_on, (*begin, zero, zero, jnp.asarray(False))
    )
    return Iterated(slopes, (i == last) & ~bad, rate)


@_solved.def_jvp
def _solved_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Derivatives of the slopes, stage by stage, from k_i = f(t + c_i h, y + h sum_j a_ij k_j)."""
    solver, terms, args, start, *_ = primals
    slopes, fine, memory = _solved(*primals)
    table, (t, h, y0) = stages(solver.method), start

    def stage(moved: Float[Array, "s k"], at: tuple[Any, ...]) -> tuple[Any, None]:
        row, weight, number, implicit = at

        def f(terms: Any, args: Any, start: Any, slopes: Any) -> StateVector:
            t, h, y = start
            y = y + h * jnp.sum(row[:, None] * slopes, axis=0)
            return terms.vf(t + weight * h, y, args)

        own = (terms, args, start, slopes)
        _, change = directional(f, own, (*tangents[1:4], moved))
        y = y0 + h * jnp.sum(row[:, None] * slopes, axis=0)
        push = lambda v: jax.jvp(lambda y: terms.vf(t + weight * h, y, args), (y,), (v,))[1]
        one = jnp.eye(y.shape[0], dtype=y.dtype)
        matrix = one - h * implicit * jax.vmap(push, out_axes=1)(one)
        found = inverted(matrix).solve(change)
        return jax.lax.dynamic_update_index_in_dim(moved, found, number, 0), None

    rows = (table.A, table.c, np.arange(len(table.c)), np.diag(table.A))
    moved, _ = jax.lax.scan(stage, jnp.zeros_like(slopes), tuple(map(jnp.asarray, rows)))
    return (slopes, fine, memory), (moved, None, Memory(jnp.zeros_like(memory.jacobian), None))  # pyright: ignore
