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
up. If the windows of all output times together would need too much memory, an integration is
divided into pieces of many windows each: of a piece before the last only the start is recorded, and
in the reverse pass it is integrated again to the start of the next. Step sizes are constants for
differentiation; derivatives with respect to the times of start and end are those of the flow.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), ch. VI.10.2
(adjoint equations of Runge-Kutta methods).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nondifferentiable_backward
from jaxtyping import Array, Bool, Float, Int

from ..method import DiscreteAdjoint
from .problem import Counts, IntegrationState, Problem, SegmentEnd, read_end
from .solvers import NonDenseRungeKutta, butcher_coefficients

MORE = diffrax.RESULTS.max_steps_reached

# An integration to one output time has as many windows as the steps that it may take at most, as long
# as the windows of all output times record no more than `ROOM` numbers; otherwise it has pieces, of
# at least `WINDOWS` windows each.
WINDOWS, ROOM = 256, 10_000_000


class RecordCapacity(NamedTuple):
    """Capacity for the record of an integration to one output time.

    Attributes:
        steps: step attempts of a window.
        windows: windows of a piece. pieces: largest number of pieces.
    """

    steps: int
    windows: int
    pieces: int

    @classmethod
    def of(cls, steps: int, max_steps: int, segments: int, numbers: int) -> "RecordCapacity":
        """Capacity for all of max_steps attempts, in each of the segments, of a state of so many numbers."""
        needed = -(-max_steps // steps)
        # Arrays of a compiled program have fixed sizes, set aside for the largest number of steps
        # that a run may take, whether it takes them or not: hence the bound in numbers.
        windows = max(WINDOWS, ROOM // (segments * (steps + numbers)))
        if needed <= windows:
            return cls(steps, needed, 1)
        # one window less: an earlier piece, integrated again, ends by a step cut short
        return cls(steps, windows, -(-needed // (windows - 1)))


class Steps(NamedTuple):
    """Record of accepted steps from ts[i], ys[i] to ts[i + 1], the first `accepted` of n rows."""

    accepted: Int[Array, ""]
    ts: Float[Array, " n+1"]
    ys: Float[Array, "n k"]
    slopes: Float[Array, "n s k"]
    end: Float[Array, " k"]


class Windows(NamedTuple):
    """Record of a piece of an integration in windows of at most n step attempts each.

    Attributes:
        number: number of windows.
        starts: y at the start of each window (w, k).
        accepted: number of accepted steps of each window (w,).
        ts: times of these steps (w, n + 1) [s].
        last: steps of the last window.
    """

    number: Int[Array, ""]
    starts: Float[Array, "w k"]
    accepted: Int[Array, " w"]
    ts: Float[Array, "w n+1"]
    last: Steps


class Now(NamedTuple):
    """Integration at the start of a window."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    solver_state: Any
    controller_state: Any


class RecordedPieces(NamedTuple):
    """Record of an integration: number of pieces, their starts (if there may be many), the last one."""

    number: Int[Array, ""]
    starts: Now | None
    last: Windows


def _empty_rows(tree: Any, *rows: int) -> Any:
    """Zeros of the shapes of a pytree, this many rows of each."""
    return jax.tree.map(lambda x: jnp.zeros((*rows, *x.shape), x.dtype), tree)


def _repeat_parts(
    run: Callable[[Now], tuple[SegmentEnd, Any]],
    begin: Now,
    capacity: int,
    most: int,
    row: Callable[[Now, Any], Any],
    is_requested: Bool[Array, ""] | bool = True,
) -> tuple[SegmentEnd, Array, Any, Any]:
    """Integrate part by part, until one does not say `MORE`: end, number, a row of each, last record."""

    def integrate_part(now: Now) -> tuple[SegmentEnd, Any, Any]:
        end, record = run(now)
        return end, row(now, record), record

    def is_unfinished(at: tuple[Any, ...]) -> Any:
        number, _, result, *_ = at
        return is_requested & ((number == 0) | ((result == MORE) & (number < most)))

    def next_part(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, now, _, (accepted, rejected), rows, _ = at
        end, new, record = integrate_part(now)
        rows = jax.tree.map(lambda rows, x: rows.at[number].set(x), rows, new)
        counts = (accepted + end.accepted, rejected + end.rejected)
        now = Now(end.t, end.y, end.solver_state, end.controller_state)
        return number + 1, now, end.result, counts, rows, record

    # The shapes of the record are found by tracing, which runs nothing.
    _, rows, record = eqx.filter_eval_shape(integrate_part, begin)
    none, success = jnp.zeros((), int), diffrax.RESULTS.successful
    state = (none, begin, success, (none, none), _empty_rows(rows, capacity), _empty_rows(record))
    number, now, result, counts, rows, record = jax.lax.while_loop(is_unfinished, next_part, state)
    accepted, rejected = counts
    states = (now.solver_state, now.controller_state)
    end = SegmentEnd(now.t, now.y, *states, accepted, rejected, result)
    return end, number, rows, record


def in_pieces(
    problem: Problem, begin: Now, t1: Float[Array, ""], capacity: RecordCapacity
) -> tuple[SegmentEnd, RecordedPieces]:
    """Integrate to t1 [s] piece by piece, each one window shorter than there is capacity for."""
    run = lambda now: piece_of(problem, now, t1, capacity, capacity.windows - 1)
    end, number, starts, last = _repeat_parts(
        run, begin, capacity.pieces, capacity.pieces, lambda now, _: now
    )
    return end, RecordedPieces(number, starts, last)


def piece_of(
    problem: Problem,
    begin: Now,
    t1: Float[Array, ""],
    capacity: RecordCapacity,
    most: int,
    is_recorded: Bool[Array, ""] | bool = True,
) -> tuple[SegmentEnd, Windows]:
    """Integrate towards t1 [s] by at most so many windows, with a record, if it is wanted at all."""
    run = lambda now: _integrate_window(problem, now, t1, capacity.steps)
    row = lambda now, steps: (now.y, steps.accepted, steps.ts)
    end, number, rows, last = _repeat_parts(run, begin, capacity.windows, most, row, is_recorded)
    ys, step_counts, ts = rows
    return end, Windows(number, ys, step_counts, ts, last)


def _make_carry(now: Now, step: Float[Array, ""]) -> IntegrationState:
    """State of an integration that has taken no steps yet, the first of which is `step` [s]."""
    none, success = jnp.zeros((), int), diffrax.RESULTS.successful
    counts, states = Counts(none, none, none), (now.solver_state, now.controller_state)
    return IntegrationState(now.t, now.y, step, *states, counts, success)


def _integrate_window(
    problem: Problem, begin: Now, t1: Float[Array, ""], attempt_limit: int
) -> tuple[SegmentEnd, Steps]:
    """Take at most `attempt_limit` step attempts towards t1 [s], with a record of the accepted ones."""
    # Dense output is used as a record: it has the start and the slopes of every accepted step, and
    # diffrax fills it as it goes.
    carry = _make_carry(begin, begin.controller_state[0])
    solution = problem.solve(carry, t1, diffrax.ForwardMode(), max_steps=attempt_limit, dense=True)
    interpolation: Any = solution.interpolation
    inner = interpolation.infos["inner"]
    end = read_end(solution)
    return end, Steps(end.accepted, interpolation.ts, inner["y0"], inner["slopes"], end.y)


def repeat_window(problem: Problem, windows: Windows, number: Any) -> Steps:
    """Steps of a window before the last, computed again from its start."""
    # their lengths are known and none is rejected: no bounds are needed
    solver = dataclasses.replace(problem.solver(), projection_limit=None, guard=None)
    term, ts = problem.term(), windows.ts[number]
    memory = solver.init(term, ts[0], ts[1], windows.starts[number], problem.model)

    def repeat_step(at: tuple[Any, ...]) -> tuple[Any, ...]:
        i, y, ys, slopes = at
        end, _, info, *_ = problem.take_step(ts[i], ts[i + 1], y, memory, solver)
        return i + 1, end, ys.at[i].set(y), slopes.at[i].set(info["inner"]["slopes"])

    step_count, last = windows.accepted[number], windows.last
    rows = (jnp.zeros_like(last.ys), jnp.zeros_like(last.slopes))
    begin = (jnp.zeros((), int), windows.starts[number], *rows)
    _, end, ys, slopes = jax.lax.while_loop(lambda at: at[0] < step_count, repeat_step, begin)
    return Steps(step_count, ts, ys, slopes, end)


TWICE = (
    "Second derivatives of stmuav_jax.integrate by reverse mode over reverse mode are not available: "
    "take forward mode over reverse mode, jax.jacfwd(jax.grad(f)), or forward mode twice with "
    "Method(adjoint=diffrax.ForwardMode())."
)

# Step attempts recorded at a time, some hundred numbers each, divided among the output times. Setting
# their memory aside takes time: with 4,096 a gradient of a second of flight took two to three times as
# long, while of a longer flight the steps of all windows but the last are taken again.
KEPT = 1024
# Those of diffrax are states alone; where they are fewer than the steps, the path back may differ.
CHECKPOINTS = 4096


def capacity_of(
    adjoint: DiscreteAdjoint, problem: Problem, segments: int
) -> "diffrax.AbstractAdjoint | RecordCapacity":
    """Adjoint for a problem with this number of output times, or the capacity for its record."""
    segments, most = max(segments, 1), problem.method.max_steps
    explicit = isinstance(problem.solver().solver, NonDenseRungeKutta)
    steps = adjoint.recorded_steps or max((KEPT if explicit else CHECKPOINTS) // segments, 64)
    if explicit:
        return RecordCapacity.of(
            min(most, steps), most, segments, problem.n_state + problem.n_internal
        )
    return diffrax.RecursiveCheckpointAdjoint(checkpoints=min(most, steps))


def integrate_recorded(
    problem: Problem, carry: IntegrationState, t1: Float[Array, ""], capacity: RecordCapacity
) -> SegmentEnd:
    """Integrate to t1 [s] with the discrete adjoint, which has this capacity for its record."""
    # Derivatives are with respect to the model's numbers, the start and the times. All else, such
    # as tolerances, is passed apart and made constant, so that no derivative is computed that
    # nobody reads.
    bare = eqx.tree_at(lambda p: p.model, problem, None)
    start = _Start(problem.model, carry.y, carry.t, t1)
    memory = (carry.step, carry.solver_state, carry.controller_state)
    end = _integrate_recorded(start, _stop_gradients(bare), _stop_gradients(memory), capacity)
    y = end.y
    # the time reached depends on t1 only
    end, stop = _stop_gradients(end._replace(y=None)), jax.lax.stop_gradient
    return end._replace(y=y, t=end.t + (t1 - stop(t1)))


def _stop_gradients(tree: Any) -> Any:
    """Pytree with all arrays, also booleans with tangents in a loop, made constants."""
    constant_of = lambda x: jax.lax.stop_gradient(x.astype(float)).astype(x.dtype)
    return jax.tree.map(lambda x: constant_of(x) if eqx.is_array(x) else x, tree)


class _Start(NamedTuple):
    """Inputs with respect to which an integration is differentiated."""

    model: Any
    y: Float[Array, " k"]
    t0: Float[Array, ""]
    t1: Float[Array, ""]


def _restore_start(
    start: _Start, problem: Problem, memory: Any
) -> tuple[Problem, IntegrationState]:
    problem = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    step, *states = memory
    return problem, _make_carry(Now(start.t0, start.y, *states), step)


@eqx.filter_custom_vjp
def _integrate_recorded(
    start: _Start, problem: Problem, memory: Any, capacity: RecordCapacity
) -> SegmentEnd:
    del capacity
    problem, carry = _restore_start(start, problem, memory)
    return read_end(problem.solve(carry, start.t1, diffrax.ForwardMode()))


@_integrate_recorded.def_fwd
def _record_pieces(
    perturbed: Any, start: _Start, problem: Problem, memory: Any, capacity: RecordCapacity
) -> tuple[SegmentEnd, RecordedPieces]:
    """Integrate piece by piece, with a record of their starts and of the last one's windows."""
    del perturbed
    problem, carry = _restore_start(start, problem, memory)
    begin = Now(carry.t, carry.y, carry.solver_state, carry.controller_state)
    if capacity.pieces == 1:
        end, windows = piece_of(problem, begin, start.t1, capacity, capacity.windows)
        pieces = RecordedPieces(windows.number, None, windows)
    else:
        end, pieces = in_pieces(problem, begin, start.t1, capacity)
    # Windows end where there is capacity, not where the run's own limit is: that is applied to the
    # sum.
    over = end.accepted + end.rejected > problem.method.max_steps
    end = end._replace(result=diffrax.RESULTS.where(over, MORE, end.result))
    return end, pieces


@_integrate_recorded.def_bwd
def _propagate_cotangents(
    pieces: RecordedPieces,
    cotangent: SegmentEnd,
    perturbed: Any,
    start: _Start,
    problem: Problem,
    memory: Any,
    capacity: RecordCapacity,
) -> _Start:
    del memory
    # of all numbers of the model only those that depend on what is differentiated by
    arrays, rest = eqx.partition(start.model, perturbed.model)
    field = lambda t, y, args: problem.field(t, y, eqx.combine(args, rest))
    end = pieces.last.last.end
    last = jnp.zeros_like(end) if cotangent.y is None else cotangent.y
    # A run that failed has NaN values; without this its derivatives could be finite where a
    # cotangent is zero.
    last = jnp.where(jnp.isnan(end), jnp.nan, last)
    whole = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    # NaN also where there is no step to traverse
    none = jnp.where(jnp.any(jnp.isnan(last)), jnp.nan, 0.0)
    at_end = (last, jax.tree.map(lambda x: jnp.full_like(x, none), arrays))

    def back_piece(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        windows, reaches_end = _piece_again(whole, pieces, number, capacity)
        by_end = jnp.where(reaches_end, by_end, jnp.nan)
        return number - 1, *_through_windows(whole, windows, arrays, rest, (by_end, by_model))

    if pieces.starts is None:
        first, by_model = _through_windows(whole, pieces.last, arrays, rest, at_end)
    else:
        _, first, by_model = jax.lax.while_loop(
            lambda at: at[0] >= 0, back_piece, (pieces.number - 1, *at_end)
        )
    by_t0, by_t1 = None, None
    if perturbed.t0:
        # A later start removes motion at its beginning, a later end adds motion at its end.
        by_t0 = -jnp.vdot(first, field(start.t0, start.y, arrays))
    if perturbed.t1:
        by_t1 = jnp.vdot(last, field(start.t1, end, arrays))
    none = jax.tree.map(lambda _: None, rest)
    derivatives = _Start(eqx.combine(by_model, none), first, by_t0, by_t1)  # pyright: ignore
    return nondifferentiable_backward(derivatives, msg=TWICE)


def _piece_again(
    problem: Problem, pieces: RecordedPieces, number: Int[Array, ""], capacity: RecordCapacity
) -> tuple[Windows, Bool[Array, ""]]:
    """Windows of a piece, integrated again if it is not the last; False if they miss its end."""
    final = number == pieces.number - 1
    now, later = (jax.tree.map(lambda x, k=k: x[k], pieces.starts) for k in (number, number + 1))

    def integrate_again() -> tuple[Windows, Bool[Array, ""]]:
        # the condition is for batches, in which both branches are carried out
        end, windows = piece_of(problem, now, later.t, capacity, capacity.windows, ~final)
        return windows, end.result == diffrax.RESULTS.successful

    return jax.lax.cond(final, lambda: (pieces.last, jnp.array(True)), integrate_again)


def _through_windows(
    problem: Problem, windows: Windows, arrays: Any, rest: Any, at_end: tuple[Array, Any]
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of a piece and the model, from those of its end."""

    def back_window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        final = number == windows.number - 1
        steps = windows.last
        # The last window is still recorded, so that most runs, which have one, repeat nothing.
        if len(windows.starts) > 1:
            steps = jax.lax.cond(
                final, lambda: steps, lambda: repeat_window(problem, windows, number)
            )

        def back_step(at: tuple[Any, ...]) -> tuple[Any, ...]:
            i, by_end, by_model = at
            by_start, more = _step_back(problem, arrays, rest, steps, i, by_end)
            return i - 1, by_start, jax.tree.map(jnp.add, by_model, more)

        begin = (steps.accepted - 1, by_end, by_model)
        _, by_start, by_model = jax.lax.while_loop(lambda at: at[0] >= 0, back_step, begin)
        return number - 1, by_start, by_model

    begin = (windows.number - 1, *at_end)
    return jax.lax.while_loop(lambda at: at[0] >= 0, back_window, begin)[1:]


def _step_back(
    problem: Problem, arrays: Any, rest: Any, steps: Steps, i: Int[Array, ""], by_end: Array
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of step i and the model, from those of its end."""
    solver = problem.solver()
    A, b, _, c = butcher_coefficients(solver.solver.method)  # pyright: ignore
    t, y, slopes = steps.ts[i], steps.ys[i], steps.slopes[i]
    t1 = steps.ts[i + 1]
    h = t1 - t
    # The projection comes after the stages, so that in reverse it is first. Its derivative is at
    # the end of the unprojected step, which follows from the recorded slopes and is not stored.
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

    def back_stage(now: tuple[Any, Any], at: tuple[Any, ...]) -> tuple[Any, None]:
        by_slopes, by_model = now
        row, column, weight, share, number = at
        # Stages are put together again from their slopes: memory for slopes alone, and no
        # evaluation but the one that is differentiated.
        y_i = y + h * jnp.sum(row[:, None] * slopes, axis=0)
        field = lambda y, args: problem.field(t + share * h, y, eqx.combine(args, rest))
        _, pull = jax.vjp(field, y_i, arrays)
        by_y, more = pull(h * (weight * by_end + jnp.sum(column[:, None] * by_slopes, axis=0)))
        by_slopes = jax.lax.dynamic_update_index_in_dim(by_slopes, by_y, number, 0)
        return (by_slopes, jax.tree.map(jnp.add, by_model, more)), None

    table = (*(jnp.asarray(x) for x in (A, A.T, b, c)), jnp.arange(len(b)))
    begin = (jnp.zeros_like(slopes), by_model)
    (by_slopes, by_model), _ = jax.lax.scan(back_stage, begin, table, reverse=True)
    return by_end + jnp.sum(by_slopes, axis=0), by_model
