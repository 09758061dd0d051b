"""Discrete adjoint of an explicit Runge-Kutta method: recorded steps, traversed in reverse.

With slopes k_i = f(t_i, y_i), y_i = y + h sum_j a_ij k_j of a step from y to y1 = y + h sum b_i k_i,
and l the derivative of a function of the result with respect to y1, the derivatives with respect
to the slopes follow from the last stage to the first,

    K_i = h (b_i l + sum_j a_ji L_j),    L_i = (df/dy)^T K_i,    derivative by y: l + sum_i L_i.

Accepted steps are recorded with their slopes, so only the right-hand sides are evaluated again,
for their derivatives, and rejected steps cost nothing. An integration of more step attempts than
can be recorded is divided into windows: the state at the start of each, the times of all steps and
the steps of the last window are recorded. In the reverse pass the steps of an earlier window are
computed again from its start at the recorded times, so that differences by round-off do not add
up. Step sizes are constants for differentiation; derivatives with respect to the times of start
and end are those of the flow.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), ch. VI.10.2
(adjoint equations of Runge-Kutta methods).
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nondifferentiable_backward
from jaxtyping import Array, Float, Int

from ...checks.errors import SettingError
from .explicit import NonDenseRungeKutta, coefficients
from .problem import Counts, IntegrationState, Problem, SegmentEnd, landing

TWICE = (
    "Second derivatives of stmuav_jax.integrate by reverse mode over reverse mode are not available: "
    "take forward mode over reverse mode, jax.jacfwd(jax.grad(f)), or forward mode twice with "
    "Method(adjoint=diffrax.ForwardMode())."
)

# Largest number of windows of an integration to one output time.
WINDOWS = 256

_MORE = diffrax.RESULTS.max_steps_reached


# Step attempts recorded at a time, some hundred numbers each, divided among the output times.
KEPT = 4096


class DiscreteAdjoint(diffrax.AbstractAdjoint):
    """Discrete adjoint: reverse-mode derivatives of the accepted steps as they were taken.

    In `integrate` an explicit method without an event is differentiated as the module describes.
    With implicit methods, events, and in `diffrax.diffeqsolve` itself, the adjoint is diffrax's
    `RecursiveCheckpointAdjoint` with `recorded_steps` checkpoints, which takes adaptive steps again.

    Attributes:
        recorded_steps: number of step attempts recorded at a time; None for 4,096 divided among the output
            times, at least 64 for each.

    Raises:
        SettingError: `recorded_steps` is less than one.
    """

    recorded_steps: int | None = None

    def __check_init__(self) -> None:
        if self.recorded_steps is not None and self.recorded_steps < 1:
            raise SettingError(
                f"A DiscreteAdjoint keeps at least one step attempt, not {self.recorded_steps}."
            )

    def of(self, problem: Problem, segments: int) -> diffrax.AbstractAdjoint:
        """Adjoint for a problem, with its number of recorded attempts in each of the segments."""
        kept = (
            max(KEPT // max(segments, 1), 64)
            if self.recorded_steps is None
            else self.recorded_steps
        )
        kept = min(problem.method.max_steps, kept)
        if isinstance(problem.solver().solver, NonDenseRungeKutta):
            return DiscreteAdjoint(kept)
        return diffrax.RecursiveCheckpointAdjoint(checkpoints=kept)

    def loop(self, **how: Any) -> Any:
        """Loop of `diffrax.diffeqsolve`, see there."""
        return diffrax.RecursiveCheckpointAdjoint(checkpoints=self.recorded_steps).loop(**how)


def recorded(
    problem: Problem, carry: IntegrationState, t1: Float[Array, ""], kept: int
) -> SegmentEnd:
    """Integrate to t1 [s] with the discrete adjoint, which records `kept` attempts at a time."""
    bare = eqx.tree_at(lambda p: p.model, problem, None)
    start = _Start(problem.model, carry.y, carry.t, t1)
    memory = (carry.step, carry.solver_state, carry.controller_state)
    found = _recorded(start, _still(bare), _still(memory), kept)
    y = found.y
    # the time reached depends on t1 only
    found, stop = _still(found._replace(y=None)), jax.lax.stop_gradient
    return found._replace(y=y, t=found.t + (t1 - stop(t1)))


def _still(tree: Any) -> Any:
    """Pytree with all arrays, also booleans with tangents in a loop, made constants."""
    still = lambda x: jax.lax.stop_gradient(x.astype(float)).astype(x.dtype)
    return jax.tree.map(lambda x: still(x) if eqx.is_array(x) else x, tree)


class _Start(NamedTuple):
    """Inputs with respect to which an integration is differentiated."""

    model: Any
    y: Float[Array, " k"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]


class _Steps(NamedTuple):
    """Record of accepted steps from ts[i], ys[i] to ts[i + 1], the first `taken` of n rows."""

    taken: Int[Array, ""]
    ts: Float[Array, " n+1"]
    ys: Float[Array, "n k"]
    slopes: Float[Array, "n s k"]
    end: Float[Array, " k"]


class _Windows(NamedTuple):
    """Record of an integration in windows of at most n step attempts each.

    Attributes:
        number: number of windows.
        starts: y at the start of each window (w, k).
        taken: number of accepted steps of each window (w,).
        ts: times of these steps (w, n + 1) [s].
        last: steps of the last window.
    """

    number: Int[Array, ""]
    starts: Float[Array, "w k"]
    taken: Int[Array, " w"]
    ts: Float[Array, "w n+1"]
    last: _Steps


def _begun(start: _Start, problem: Problem, memory: Any) -> tuple[Problem, IntegrationState]:
    problem = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    none = jnp.zeros((), int)
    step, solver_state, controller_state = memory
    counts, fine = Counts(none, none, none), diffrax.RESULTS.successful
    carry = IntegrationState(start.t0, start.y, step, solver_state, controller_state, counts, fine)
    return problem, carry


@eqx.filter_custom_vjp
def _recorded(start: _Start, problem: Problem, memory: Any, kept: int) -> SegmentEnd:
    del kept
    problem, carry = _begun(start, problem, memory)
    return landing(problem.solve(carry, start.t1, diffrax.ForwardMode()))


@_recorded.def_fwd
def _forward(
    perturbed: Any, start: _Start, problem: Problem, memory: Any, kept: int
) -> tuple[SegmentEnd, _Windows]:
    """Integrate window by window, with a record of their starts and of the last one's steps."""
    del perturbed
    problem, carry = _begun(start, problem, memory)
    most = min(-(-problem.method.max_steps // kept), WINDOWS)
    begin = (carry.t, carry.y, carry.solver_state, carry.controller_state)
    none = jnp.zeros((), int)
    _, steps = eqx.filter_eval_shape(_window, problem, begin, start.t1, kept)
    empty = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), steps)
    of_each = lambda x: jnp.zeros((most, *x.shape), x.dtype)
    rows = (of_each(carry.y), of_each(empty.taken), of_each(empty.ts))

    def unfinished(at: tuple[Any, ...]) -> Any:
        number, _, _, result, *_ = at
        return (number == 0) | ((result == _MORE) & (number < most))

    def window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, now, rows, _, counts, _ = at
        end, steps = _window(problem, now, start.t1, kept)
        new = (now[1], steps.taken, steps.ts)
        rows = jax.tree.map(lambda rows, x: rows.at[number].set(x), rows, new)
        counts = (counts[0] + end.accepted, counts[1] + end.rejected)
        now = (end.t, end.y, end.solver_state, end.controller_state)
        return number + 1, now, rows, end.result, counts, steps

    state = (none, begin, rows, diffrax.RESULTS.successful, (none, none), empty)
    count, (t, y, solver_state, controller_state), rows, result, counts, last = jax.lax.while_loop(
        unfinished, window, state
    )
    over = counts[0] + counts[1] > problem.method.max_steps
    result = diffrax.RESULTS.where(over, _MORE, result)
    accepted, rejected = counts
    end = SegmentEnd(t, y, solver_state, controller_state, accepted, rejected, result)
    if most * kept < problem.method.max_steps:
        # derivatives of a part of the motion would be wrong: NaN instead
        end = end._replace(y=jnp.where(result == _MORE, jnp.nan, y))
    starts, taken, ts = rows
    return end, _Windows(count, starts, taken, ts, last._replace(end=end.y))


def _window(
    problem: Problem, begin: tuple[Any, ...], t1: Float[Array, ""], kept: int
) -> tuple[SegmentEnd, _Steps]:
    """Take at most `kept` step attempts towards t1 [s], with a record of the accepted ones."""
    t, y, solver_state, controller_state = begin
    none, fine = jnp.zeros((), int), diffrax.RESULTS.successful
    step, counts = controller_state[0], Counts(none, none, none)
    carry = IntegrationState(t, y, step, solver_state, controller_state, counts, fine)
    solution = problem.solve(carry, t1, diffrax.ForwardMode(), max_steps=kept, dense=True)
    found: Any = solution.interpolation
    inner = found.infos["inner"]
    end = landing(solution)
    return end, _Steps(end.accepted, found.ts, inner["y0"], inner["slopes"], end.y)


def _again(problem: Problem, windows: _Windows, number: Any) -> _Steps:
    """Steps of a window before the last, computed again from its start."""
    # their lengths are known and none is rejected: no bounds are needed
    solver = dataclasses.replace(problem.solver(), far=None, guard=None)
    term, ts = diffrax.ODETerm(problem.field), windows.ts[number]
    memory = solver.init(term, ts[0], ts[1], windows.starts[number], problem.model)

    def step(at: tuple[Any, ...]) -> tuple[Any, ...]:
        i, y, ys, slopes = at
        end, _, info, *_ = solver.step(term, ts[i], ts[i + 1], y, problem.model, memory, False)
        return i + 1, end, ys.at[i].set(y), slopes.at[i].set(info["inner"]["slopes"])

    taken, last = windows.taken[number], windows.last
    rows = (jnp.zeros_like(last.ys), jnp.zeros_like(last.slopes))
    begin = (jnp.zeros((), int), windows.starts[number], *rows)
    _, end, ys, slopes = jax.lax.while_loop(lambda at: at[0] < taken, step, begin)
    return _Steps(taken, ts, ys, slopes, end)


@_recorded.def_bwd
def _backward(
    windows: _Windows,
    wanted: SegmentEnd,
    perturbed: Any,
    start: _Start,
    problem: Problem,
    memory: Any,
    kept: int,
) -> _Start:
    del memory
    # of all numbers of the model only those that depend on what is differentiated by
    arrays, rest = eqx.partition(start.model, perturbed.model)
    field = lambda t, y, args: problem.field(t, y, eqx.combine(args, rest))
    end = windows.last.end
    last = jnp.zeros_like(end) if wanted.y is None else wanted.y
    last = jnp.where(jnp.isnan(end), jnp.nan, last)
    whole = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)

    def back_window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        final = number == windows.number - 1
        steps = windows.last
        if len(windows.starts) > 1:
            steps = jax.lax.cond(final, lambda: steps, lambda: _again(whole, windows, number))

        def back(at: tuple[Any, ...]) -> tuple[Any, ...]:
            i, by_end, by_model = at
            by_start, more = _step_back(problem, arrays, rest, steps, i, by_end)
            return i - 1, by_start, jax.tree.map(jnp.add, by_model, more)

        begin = (steps.taken - 1, by_end, by_model)
        _, by_start, by_model = jax.lax.while_loop(lambda at: at[0] >= 0, back, begin)
        return number - 1, by_start, by_model

    # NaN also where there is no step to traverse
    none = jnp.where(jnp.any(jnp.isnan(last)), jnp.nan, 0.0)
    zero = jax.tree.map(lambda x: jnp.full_like(x, none), arrays)
    _, first, by_model = jax.lax.while_loop(
        lambda at: at[0] >= 0, back_window, (windows.number - 1, last, zero)
    )
    by_t0, by_t1 = None, None
    if perturbed.t0:
        by_t0 = -jnp.vdot(first, field(start.t0, start.y, arrays))
    if perturbed.t1:
        by_t1 = jnp.vdot(last, field(start.t1, end, arrays))
    none = jax.tree.map(lambda _: None, rest)
    found = _Start(eqx.combine(by_model, none), first, by_t0, by_t1)  # pyright: ignore
    return nondifferentiable_backward(found, msg=TWICE)


def _step_back(
    problem: Problem, arrays: Any, rest: Any, steps: _Steps, i: Int[Array, ""], by_end: Array
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of step i and the model, from those of its end."""
    solver = problem.solver()
    A, b, _, c = coefficients(solver.solver.method)  # pyright: ignore
    t, y, slopes = steps.ts[i], steps.ys[i], steps.slopes[i]
    t1 = steps.ts[i + 1]
    h = t1 - t
    by_model = jax.tree.map(jnp.zeros_like, arrays)
    # choices made at the start of the step have no derivative and are no parameters of the model
    numbers, others = eqx.partition(
        problem.at_step(t, y, eqx.combine(arrays, rest)), eqx.is_inexact_array
    )
    is_none = lambda x: x is None
    fixed = jax.tree.map(lambda x, a: a if x is None else None, arrays, numbers, is_leaf=is_none)
    rest = eqx.combine(fixed, others)
    if solver.project is not None:
        y1 = y + h * jnp.sum(b[:, None] * slopes, axis=0)
        project = lambda y, args: solver.project(t1, y, eqx.combine(args, rest))[0]  # pyright: ignore
        _, pull = jax.vjp(project, y1, arrays)
        by_end, by_model = pull(by_end)

    def stage(now: tuple[Any, Any], at: tuple[Any, ...]) -> tuple[Any, None]:
        by_slopes, by_model = now
        row, column, weight, share, number = at
        y_i = y + h * jnp.sum(row[:, None] * slopes, axis=0)
        field = lambda y, args: problem.field(t + share * h, y, eqx.combine(args, rest))
        _, pull = jax.vjp(field, y_i, arrays)
        by_y, more = pull(h * (weight * by_end + jnp.sum(column[:, None] * by_slopes, axis=0)))
        by_slopes = jax.lax.dynamic_update_index_in_dim(by_slopes, by_y, number, 0)
        return (by_slopes, jax.tree.map(jnp.add, by_model, more)), None

    table = (*(jnp.asarray(x) for x in (A, A.T, b, c)), jnp.arange(len(b)))
    begin = (jnp.zeros_like(slopes), by_model)
    (by_slopes, by_model), _ = jax.lax.scan(stage, begin, table, reverse=True)
    return by_end + jnp.sum(by_slopes, axis=0), by_model
