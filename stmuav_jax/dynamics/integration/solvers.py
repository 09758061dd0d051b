"""Explicit and implicit Runge-Kutta steps of diffrax's methods, without their dense output.

The stages of an implicit method with an explicit first stage and the same diagonal entry g elsewhere,

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

from collections.abc import Callable
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...checks.shapes import StateVector
from ...math import lapack
from ...math.derivative import directional_derivative
from ...math.native.program import native


class RecordedStep(diffrax.LocalLinearInterpolation):
    """Linear interpolant of a step, with the slopes of its stages (s, k) as a record."""

    slopes: Array


class RungeKutta4(diffrax.AbstractERK):
    """Classical Runge-Kutta method of order 4, for steps of fixed length: it estimates no error.

    It takes steps with everything that a `Method` adds to a solver of diffrax, such as the projection
    onto the constraints; the filters' `rk4_step` takes plain steps of a vector.

    Source: E. Hairer, S. P. Norsett, G. Wanner, Solving Ordinary Differential Equations I (1993),
    section II.1.
    """

    scan_kind: None = None  # pyright: ignore[reportIncompatibleVariableOverride]
    tableau: ClassVar[diffrax.ButcherTableau] = diffrax.ButcherTableau(  # pyright: ignore[reportIncompatibleVariableOverride]
        a_lower=(np.array([0.5]), np.array([0.0, 0.5]), np.array([0.0, 0.0, 1.0])),
        b_sol=np.array([1.0, 2.0, 2.0, 1.0]) / 6.0,
        b_error=np.zeros(4),
        c=np.array([0.5, 0.5, 1.0]),
    )
    interpolation_cls: ClassVar[Any] = diffrax.LocalLinearInterpolation

    def order(self, terms: Any) -> int:
        del terms
        return 4


class AbstractNonDense(diffrax.AbstractAdaptiveSolver):
    """Base of methods that take a method's coefficients from diffrax, without its dense output.

    The interpolation within steps is linear, so steps must end at the output times.

    Attributes:
        method: Runge-Kutta method of diffrax, which has the orders.
    """

    method: eqx.AbstractVar[Any]

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return diffrax.AbstractTerm

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return RecordedStep

    def order(self, terms: Any) -> int | None:
        return self.method.order(terms)

    def strong_order(self, terms: Any) -> Any:
        return self.method.strong_order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.method.error_order(terms)

    def func(self, terms: Any, t0: Any, y0: StateVector, args: Any) -> Any:
        return terms.vf(t0, y0, args)


@cache
def _stage_loop(kind: type[diffrax.AbstractERK]) -> Callable[..., Float[Array, "s k"]]:
    """Loop over the stages of a method, (terms, args, t, h, y, zeros (s, k)) -> their slopes."""
    A, _, _, c = butcher_coefficients(kind)

    @partial(native, tables=(A, c))
    def evaluate_slope(
        terms: Any, args: Any, t: Any, h: Any, y: Any, total: Any, node: Any
    ) -> StateVector:
        return terms.vf(t + node * h, y + h * total, args)

    return evaluate_slope


class NonDenseRungeKutta(AbstractNonDense):
    """Explicit Runge-Kutta method of diffrax without its dense output.

    The tableau and, up to round-off, the steps are those of the method: one loop over the
    stages, their slopes in one array, without the stages that only serve interpolation. The
    interpolation within steps is linear, so steps must end at the output times.

    Args:
        method: explicit Runge-Kutta method of diffrax, such as `diffrax.Dopri8()`.
    """

    method: diffrax.AbstractERK

    def init(self, terms: Any, t0: Any, t1: Any, y0: StateVector, args: Any) -> None:
        return None

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: StateVector,
        args: Any,
        solver_state: None,
        made_jump: Any,
    ) -> tuple[StateVector, StateVector, Any, None, diffrax.RESULTS]:
        del solver_state, made_jump
        _, b, b_error, c = butcher_coefficients(self.method)
        h = terms.contr(t0, t1)
        start = jnp.zeros((len(c), y0.shape[0]), y0.dtype)
        slopes = _stage_loop(type(self.method))(terms, args, t0, h, y0, start)
        y1 = y0 + h * jnp.sum(b[:, None] * slopes, axis=0)
        error = h * jnp.sum(b_error[:, None] * slopes, axis=0)
        dense_info = {"y0": y0, "y1": y1, "slopes": slopes}
        return y1, error, dense_info, None, diffrax.RESULTS.successful


def butcher_coefficients(
    method: diffrax.AbstractERK | type[diffrax.AbstractERK],
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Butcher coefficients A (s, s), b, those of the error, and c (s,).

    Final stages that neither the step nor its error needs are left out.
    """
    tableau: Any = method.tableau
    count = len(tableau.b_sol)
    A = np.zeros((count, count))
    for i, row in enumerate(tableau.a_lower):
        A[i + 1, : i + 1] = row
    c = np.concatenate([[0.0], tableau.c])
    b, b_error = np.asarray(tableau.b_sol), np.asarray(tableau.b_error)
    # Last stages of some methods serve the dense output only, and are left out with it.
    used = np.flatnonzero((b != 0) | (b_error != 0))
    last = int(used[-1]) + 1
    return A[:last, :last], b[:last], b_error[:last], c[:last]


# Error of an iteration over the tolerance of the step, and iterations of a stage at most.
SHARE, ITERATIONS = 0.01, 10
# Rate of convergence above which the next step computes the Jacobian again.
SLOW = 0.1


class Iterated(NamedTuple):
    """Slopes of all stages (s, k), whether all converged, and the largest rate of convergence."""

    slopes: Float[Array, "s k"]
    converged: Bool[Array, ""]
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


def stage_coefficients(method: diffrax.AbstractESDIRK) -> _Stages:
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
        table = stage_coefficients(self.method)
        t0, h = jnp.asarray(t0, y0.dtype), jnp.asarray(t1 - t0, y0.dtype)
        tolerances = (jnp.asarray(self.rtol, y0.dtype), jnp.asarray(self.atol, y0.dtype))
        # The iteration has no derivative of its own: that of the stages follows from their equations.
        constants = jax.lax.stop_gradient(((t0, h, y0), tolerances, solver_state))
        slopes, converged, memory = _solve_stages(
            self, terms, args, (t0, h, y0), constants[1], constants[2]
        )
        y1 = y0 + h * jnp.sum(table.b[:, None] * slopes, axis=0)
        error = h * jnp.sum(table.b_error[:, None] * slopes, axis=0)
        # an infinite error has the step rejected and the next one shortened as far as allowed
        y1, error = jnp.where(converged, y1, y0), jnp.where(converged, error, jnp.inf)
        info = {"y0": y0, "y1": y1, "slopes": slopes}
        return y1, error, info, memory, diffrax.RESULTS.successful

    def norm(self, change: StateVector, y: StateVector, tolerances: Any) -> Float[Array, ""]:
        """Root mean square of a change of y over the tolerance."""
        rtol, atol = tolerances
        part = (change / (atol + rtol * jnp.abs(y)))[: self.n_state]
        return jnp.sqrt(jnp.mean(part * part))


@eqx.filter_custom_jvp
def _solve_stages(
    solver: NonDenseESDIRK, terms: Any, args: Any, start: Any, tolerances: Any, memory: Memory
) -> tuple[Float[Array, "s k"], Bool[Array, ""], Memory]:
    """Slopes of the stages of a step from `start` = (t, h, y), convergence, and new memory."""
    t, h, y = start
    field = lambda t, y: terms.vf(t, y, args)
    gamma = stage_coefficients(solver.method).diagonal

    def attempt_iteration(now: tuple[Any, Memory, Any]) -> tuple[Any, Memory, Any]:
        _, (J, due), _ = now
        J = jax.lax.cond(due, lambda: _difference_jacobian(field, t, y, solver.n_state), lambda: J)
        inverse = lapack.inverse(jnp.eye(y.shape[0], dtype=y.dtype) - h * gamma * J)
        iteration = _iterate_stages(solver, field, start, inverse, tolerances)
        # what fails with the Jacobian of an earlier step is tried again with that of this one
        return iteration, Memory(J, ~iteration.converged), due | iteration.converged

    none = jnp.zeros((len(stage_coefficients(solver.method).c), *y.shape), y.dtype)
    begin = Iterated(none, jnp.asarray(False), jnp.zeros((), y.dtype))
    iteration, memory, _ = jax.lax.while_loop(
        lambda now: ~now[2], attempt_iteration, (begin, memory, jnp.asarray(False))
    )
    due = ~iteration.converged | (iteration.rate > SLOW)
    return iteration.slopes, iteration.converged, Memory(memory.jacobian, due)


def _difference_jacobian(field: Any, t: Any, y: StateVector, n: int) -> Float[Array, "k k"]:
    """Jacobian df/dy by differences, where f depends on the first n entries of y only."""
    # Simplified Newton iterations need an approximate Jacobian only; differences cost less to compile
    # than derivatives.
    increments = jnp.sqrt(jnp.finfo(y.dtype).eps) * (1 + jnp.abs(y))
    # a single copy of the field to compile, for all columns and for y itself
    moves = jnp.concatenate([jnp.zeros((1, y.shape[0]), y.dtype), jnp.diag(increments)[:n]])
    slopes = jax.vmap(lambda move: field(t, y + move))(moves)
    columns = ((slopes[1:] - slopes[:1]) / increments[:n, None]).T
    return jnp.pad(columns, ((0, 0), (0, y.shape[0] - n)))


def _iterate_stages(
    solver: NonDenseESDIRK, field: Any, start: Any, inverse: Any, tolerances: Any
) -> Iterated:
    """Simplified Newton iterations for all stages, one after the other, in one loop."""
    table, (t, h, y0) = stage_coefficients(solver.method), start
    A, predictor, c = (jnp.asarray(x, y0.dtype) for x in (table.A, table.predictor, table.c))
    last = len(table.c)

    def pass_on(now: tuple[Any, ...]) -> tuple[Any, ...]:
        i, m, slopes, size, rate, _ = now
        y = y0 + h * jnp.sum(A[i][:, None] * slopes, axis=0)
        f = field(t + c[i] * h, y)
        k = slopes[i]
        step = jnp.where(i == 0, f, inverse @ (f - k))
        length = solver.norm(h * table.diagonal * step, y, tolerances)
        # Rate of convergence as a quotient of successive steps (E. Hairer, G. Wanner, Solving Ordinary
        # Differential Equations II, IV.8).
        ratio = jnp.where(m > 0, length / size, 0.0)
        rate = jnp.where(i == 0, rate, jnp.maximum(rate, ratio))
        # before the first ratio of a step nothing is known about the rate
        theta = jnp.where(rate > 0, rate, 0.5)
        converged = (i == 0) | ((theta < 1) & (theta / (1 - theta) * length <= SHARE))
        bad = ~converged & ((m + 1 >= ITERATIONS) | (ratio >= 2) | ~jnp.isfinite(length))
        slopes = jax.lax.dynamic_update_index_in_dim(slopes, k + step, i, 0)
        after = jnp.minimum(i + 1, last - 1)
        guess = jnp.sum(predictor[after][:, None] * slopes, axis=0)
        predicted = jax.lax.dynamic_update_index_in_dim(slopes, guess, after, 0)
        slopes = jnp.where(converged & (i + 1 < last), predicted, slopes)
        return (
            jnp.where(converged, i + 1, i),
            jnp.where(converged, 0, m + 1),
            slopes,
            length,
            rate,
            bad,
        )

    zero = jnp.zeros((), y0.dtype)
    begin = (jnp.zeros((), int), jnp.zeros((), int), jnp.zeros((last, *y0.shape), y0.dtype))
    i, _, slopes, _, rate, bad = jax.lax.while_loop(
        lambda now: (now[0] < last) & ~now[5], pass_on, (*begin, zero, zero, jnp.asarray(False))
    )
    return Iterated(slopes, (i == last) & ~bad, rate)


@_solve_stages.def_jvp
def _solved_jvp(primals: Any, tangents: Any) -> tuple[Any, Any]:
    """Derivatives of the slopes, stage by stage, from k_i = f(t + c_i h, y + h sum_j a_ij k_j)."""
    solver, terms, args, start, *_ = primals
    slopes, converged, memory = _solve_stages(*primals)
    table, (t, h, y0) = stage_coefficients(solver.method), start

    def stage_tangent(k_dot: Float[Array, "s k"], at: tuple[Any, ...]) -> tuple[Any, None]:
        row, weight, number, implicit = at

        def stage_field(terms: Any, args: Any, start: Any, slopes: Any) -> StateVector:
            t, h, y = start
            y = y + h * jnp.sum(row[:, None] * slopes, axis=0)
            return terms.vf(t + weight * h, y, args)

        arguments = (terms, args, start, slopes)
        _, change = directional_derivative(stage_field, arguments, (*tangents[1:4], k_dot))
        y = y0 + h * jnp.sum(row[:, None] * slopes, axis=0)
        push = lambda v: jax.jvp(lambda y: terms.vf(t + weight * h, y, args), (y,), (v,))[1]
        identity = jnp.eye(y.shape[0], dtype=y.dtype)
        matrix = identity - h * implicit * jax.vmap(push, out_axes=1)(identity)
        # A derivative needs the exact Jacobian, whereas the iteration does with an old one.
        tangent = lapack.solve(matrix, change)
        return jax.lax.dynamic_update_index_in_dim(k_dot, tangent, number, 0), None

    rows = (table.A, table.c, np.arange(len(table.c)), np.diag(table.A))
    k_dot, _ = jax.lax.scan(stage_tangent, jnp.zeros_like(slopes), tuple(map(jnp.asarray, rows)))
    return (slopes, converged, memory), (k_dot, None, Memory(jnp.zeros_like(memory.jacobian), None))  # pyright: ignore
