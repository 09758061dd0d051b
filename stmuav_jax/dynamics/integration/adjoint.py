"""Discrete adjoint of an explicit Runge-Kutta method: steps taken again, traversed in reverse.

With slopes k_i = f(t_i, y_i), y_i = y + h sum_j a_ij k_j of a step from y to y1 = y + h sum b_i k_i,
and l the derivative of a function of the result with respect to y1, the derivatives with respect
to the slopes follow from the last stage to the first,

    K_i = h (b_i l + sum_j a_ji L_j),    L_i = (df/dy)^T K_i,    derivative by y: l + sum_i L_i.

An integration through all its output times is divided into windows of a few step attempts: the state at
the start of each and the times of all accepted steps are recorded. In the reverse pass the steps of a
window are taken again from its start at these times, so that differences by round-off do not add up, and
now with their slopes: a second evaluation of the right-hand sides costs less than memory for the slopes of
a flight. Rejected steps cost nothing. Step sizes are constants for differentiation; derivatives with
respect to the times of start and end are those of the flow.

In a batch all members pass through the same windows, and those that have arrived take no steps there: if
each had its own number of passes, JAX would copy all records in every pass.

Source: E. Hairer, C. Lubich, G. Wanner, Geometric Numerical Integration (2006), ch. VI.10.2
(adjoint equations of Runge-Kutta methods).
"""

import dataclasses
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..method import DiscreteAdjoint
from .goals import Goals, Row, Way, pass_goals, reach_goals
from .problem import IntegrationState, Problem, SegmentEnd, read_end
from .solvers import NonDenseRungeKutta, butcher_coefficients

MORE = diffrax.RESULTS.max_steps_reached

# Step attempts of a window, whose slopes are some hundred numbers each.
WINDOW = 64
# States that diffrax keeps, divided among the output times; where they are fewer than the steps, the path
# back may differ.
CHECKPOINTS = 4096

TWICE = (
    "Second derivatives of stmuav_jax.integrate by reverse mode over reverse mode are not available: "
    "take forward mode over reverse mode, jax.jacfwd(jax.grad(f)), or forward mode twice with "
    "Method(adjoint=diffrax.ForwardMode())."
)


class Windows(NamedTuple):
    """Record of an integration in windows of at most n step attempts each.

    Attributes:
        number: number of windows so far, of all members of a batch together.
        starts: y at the start of each window (w, k).
        accepted: number of accepted steps of each window (w,).
        ts: times of these steps (w, n + 1) [s]; after the last one its time.
    """

    number: Int[Array, ""]
    starts: Float[Array, "w k"]
    accepted: Int[Array, " w"]
    ts: Float[Array, "w n+1"]

    @classmethod
    def empty(cls, problem: Problem, y: Float[Array, " k"], goals: int) -> "Windows":
        """Record for `max_steps` attempts on the way to all goals together."""
        adjoint: Any = problem.method.adjoint
        most = problem.method.max_steps
        n = min(adjoint.recorded_steps or WINDOW, most)
        # the last window on the way to each goal may hold few steps
        w = -(-most // n) + goals
        zeros = lambda *shape: jnp.zeros(shape, y.dtype)
        return cls(jnp.zeros((), int), zeros(w, *y.shape), jnp.zeros(w, int), zeros(w, n + 1))

    def with_window(self, *row: Array) -> "Windows":
        rows = (x.at[self.number].set(new) for x, new in zip(self[1:], row, strict=True))
        return Windows(self.number + 1, *rows)


class Steps(NamedTuple):
    """Accepted steps of a window from ts[i], ys[i] to ts[i + 1], the first `accepted` of n rows."""

    accepted: Int[Array, ""]
    ts: Float[Array, " n+1"]
    ys: Float[Array, "n k"]
    slopes: Float[Array, "n s k"]


def is_recorded(problem: Problem) -> bool:
    """True for an explicit method without an event, which `integrate_recorded` differentiates."""
    return isinstance(problem.solver().solver, NonDenseRungeKutta)


def diffrax_adjoint(
    adjoint: DiscreteAdjoint, problem: Problem, goals: int
) -> diffrax.RecursiveCheckpointAdjoint:
    """Adjoint of diffrax for other methods, on the way to each of the goals."""
    checkpoints = adjoint.recorded_steps or max(CHECKPOINTS // max(goals, 1), 64)
    return diffrax.RecursiveCheckpointAdjoint(min(problem.method.max_steps, checkpoints))


def _choose(condition: Any, new: Any, old: Any) -> Any:
    """Pytree of the new or the old entries."""
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), new, old)


def _record_way(
    problem: Problem, carry: IntegrationState, t1: Float[Array, ""], windows: Windows
) -> tuple[SegmentEnd, Windows, Int[Array, ""]]:
    """Integrate from the carry to t1 [s] window by window: end, record, and number of its windows."""
    capacity, n = len(windows.accepted), windows.ts.shape[1] - 1
    most, none = problem.method.max_steps, jnp.zeros((), int)

    def next_window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        is_going, now, windows = at
        # who has arrived stays there
        goal = jnp.where(is_going, t1, now.t)
        states = (now.solver_state, now.controller_state)
        begin = IntegrationState(
            now.t, now.y, now.controller_state[0], *states, carry.counts,
            diffrax.RESULTS.successful,
        )  # fmt: skip
        solution = problem.solve(begin, goal, diffrax.ForwardMode(), max_steps=n, keeps_times=True)
        end, times = read_end(solution), solution.ts
        ts = jnp.where(np.arange(n) < end.accepted, times[1], end.t)  # pyright: ignore
        ts = jnp.concatenate([now.t[None], ts])
        is_full = windows.number >= capacity
        windows = windows.with_window(now.y, end.accepted, ts)
        accepted, rejected = now.accepted + end.accepted, now.rejected + end.rejected
        end = end._replace(accepted=accepted, rejected=rejected)
        # Windows end where there is room, not where the run's own limit is: one beyond it does not count.
        over = is_full | (accepted + rejected > most)
        end = _choose(over, now._replace(result=MORE), end)
        now = _choose(is_going, end, now)
        return is_going & (end.result == MORE) & ~over, now, windows

    states = (carry.solver_state, carry.controller_state)
    now = SegmentEnd(carry.t, carry.y, *states, none, none, diffrax.RESULTS.successful)
    begin = (jnp.asarray(True), now, windows)
    _, end, windows = jax.lax.while_loop(lambda at: eqxi.unvmap_any(at[0]), next_window, begin)
    return end, windows, windows.number


def _repeat_window(problem: Problem, windows: Windows, number: Any) -> Steps:
    """Steps of a window, taken again from its start."""
    # their lengths are known and none is rejected: no bounds are needed
    solver = dataclasses.replace(problem.solver(), projection_limit=None, guard=None)
    term, ts, start = problem.term(), windows.ts[number], windows.starts[number]
    memory = solver.init(term, ts[0], ts[1], start, problem.model)
    # of windows for which there was no room nothing is known
    count = jnp.where(number < len(windows.accepted), windows.accepted[number], 0)

    def repeat_step(at: tuple[Any, ...]) -> tuple[Any, ...]:
        i, y, ys, slopes = at
        end, _, info, *_ = problem.take_step(ts[i], ts[i + 1], y, memory, solver)
        ys, slopes = ys.at[i].set(y), slopes.at[i].set(info["inner"]["slopes"])
        return i + 1, jnp.where(i < count, end, y), ys, slopes

    inner: Any = solver.solver
    rows = (len(ts) - 1, len(butcher_coefficients(inner.method)[1]))
    ys = jnp.zeros((rows[0], *start.shape), start.dtype)
    slopes = jnp.zeros((*rows, *start.shape), start.dtype)
    last, none = eqxi.unvmap_max(count), jnp.zeros((), int)
    _, _, ys, slopes = jax.lax.while_loop(
        lambda at: at[0] < last, repeat_step, (none, start, ys, slopes)
    )
    return Steps(count, ts, ys, slopes)


def integrate_recorded(
    problem: Problem, carry: IntegrationState, goals: Goals
) -> tuple[IntegrationState, Row]:
    """Integrate to each goal in turn, with the discrete adjoint for the rows' derivatives."""
    # Derivatives are with respect to the model's numbers, the start and the times. All else, such
    # as tolerances, is passed apart and made constant, so that no derivative is computed that
    # nobody reads.
    bare = eqx.tree_at(lambda p: p.model, problem, None)
    memory = eqx.tree_at(lambda c: (c.t, c.y), carry, (None, None))
    start = _Start(problem.model, carry.y, carry.t, goals.times)
    end, rows = _integrate_recorded(
        start, _stop_gradients(bare), _stop_gradients(memory), goals.is_jump
    )
    return _stop_gradients(end), Row(rows.t, rows.y, *_stop_gradients(rows[2:]))


def _stop_gradients(tree: Any) -> Any:
    """Pytree with all arrays, also booleans with tangents in a loop, made constants."""
    constant_of = lambda x: jax.lax.stop_gradient(x.astype(float)).astype(x.dtype)
    return jax.tree.map(lambda x: constant_of(x) if eqx.is_array(x) else x, tree)


class _Start(NamedTuple):
    """Inputs with respect to which an integration is differentiated."""

    model: Any
    y: Float[Array, " k"]
    t0: Float[Array, ""]
    times: Float[Array, " g"]


def _restore_start(
    start: _Start, problem: Problem, memory: Any
) -> tuple[Problem, IntegrationState]:
    is_none = lambda x: x is None
    problem = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=is_none)
    carry = eqx.tree_at(lambda c: (c.t, c.y), memory, (start.t0, start.y), is_leaf=is_none)
    return problem, carry


@eqx.filter_custom_vjp
def _integrate_recorded(
    start: _Start, problem: Problem, memory: Any, is_jump: Bool[Array, " g"] | None
) -> tuple[IntegrationState, Row]:
    problem, carry = _restore_start(start, problem, memory)
    integrate_to = lambda carry, t1: read_end(problem.solve(carry, t1, diffrax.ForwardMode()))
    return reach_goals(problem, carry, Goals(start.times, is_jump), integrate_to)


class _Record(NamedTuple):
    """Record of an integration: its windows, their number at each goal, its rows, and ways to them."""

    windows: Windows
    numbers: Int[Array, " g"]
    rows: Row
    ways: Way


@_integrate_recorded.def_fwd
def _record_goals(
    perturbed: Any, start: _Start, problem: Problem, memory: Any, is_jump: Any
) -> tuple[tuple[IntegrationState, Row], _Record]:
    del perturbed
    problem, carry = _restore_start(start, problem, memory)
    integrate_to = lambda *at: _record_way(problem, *at)
    empty = Windows.empty(problem, start.y, len(start.times))
    end, windows, (rows, ways, numbers) = pass_goals(
        problem, carry, Goals(start.times, is_jump), integrate_to, empty
    )
    return (end, rows), _Record(windows, numbers, rows, ways)


@_integrate_recorded.def_bwd
def _propagate_cotangents(
    record: _Record,
    cotangent: tuple[IntegrationState, Row],
    perturbed: Any,
    start: _Start,
    problem: Problem,
    memory: Any,
    is_jump: Any,
) -> _Start:
    del memory, is_jump
    # of all numbers of the model only those that depend on what is differentiated by
    arrays, rest = eqx.partition(start.model, perturbed.model)
    windows, numbers, rows, ways = record
    by_row = lambda x, ct: jnp.zeros_like(x) if ct is None else ct
    by_rows = (by_row(rows.y, cotangent[1].y), by_row(rows.t, cotangent[1].t))
    whole = eqx.tree_at(lambda p: p.model, problem, start.model, is_leaf=lambda x: x is None)
    has_times = perturbed.t0 or perturbed.times

    def by_time(by_y: Array, t: Any, y: Array) -> Float[Array, ""]:
        """Derivative by the time of a state, along whose motion it then is."""
        field = lambda: problem.field(t, y, eqx.combine(arrays, rest))
        return jnp.vdot(by_y, field()) if has_times else jnp.zeros((), y.dtype)

    def back_way(at: tuple[Any, ...], row: tuple[Any, ...]) -> tuple[Any, Any]:
        by_y, by_t, by_model = at
        (y1, t1), (by_y1, by_t1), (y0, way), (first, last) = row
        by_y = by_y + by_y1
        # A run that failed has NaN values; without this its derivatives could be finite where a
        # cotangent is zero, also where there is no step to traverse.
        by_y = jnp.where(jnp.isnan(y1), jnp.nan, by_y)
        none = jnp.where(jnp.any(jnp.isnan(by_y)), jnp.nan, 0.0)
        by_model = jax.tree.map(lambda x: x + none, by_model)
        # a later end adds motion at the end of a way, a later start removes motion at its beginning
        by_end = by_t + by_t1 + by_time(by_y, t1, y1)
        by_y, by_model = _through_windows(
            whole, windows, arrays, rest, (first, last), (by_y, by_model)
        )
        by_begin = -by_time(by_y, way.t0, y0)
        by_goal = jnp.where(way.stays, 0.0, by_end)
        return (by_y, by_begin + by_end - by_goal, by_model), by_goal

    starts = jnp.concatenate([start.y[None], rows.y[:-1]])
    firsts = jnp.concatenate([jnp.zeros(1, int), numbers[:-1]])
    table = ((rows.y, rows.t), by_rows, (starts, ways), (firsts, numbers))
    begin = (
        jnp.zeros_like(start.y),
        jnp.zeros_like(start.t0),
        jax.tree.map(jnp.zeros_like, arrays),
    )
    (by_y, by_t0, by_model), by_times = jax.lax.scan(back_way, begin, table, reverse=True)
    by_model = eqx.combine(by_model, jax.tree.map(lambda _: None, rest))
    times: tuple[Any, Any] = (
        by_t0 if perturbed.t0 else None,
        by_times if perturbed.times else None,
    )
    return eqxi.nondifferentiable_backward(_Start(by_model, by_y, *times), msg=TWICE)


def _through_windows(
    problem: Problem, windows: Windows, arrays: Any, rest: Any, span: Any, at_end: tuple[Array, Any]
) -> tuple[Array, Any]:
    """Derivatives with respect to the start of a way and the model, from those of its end.

    Args:
        span: numbers of its first window and of that after its last one.
    """

    def back_window(at: tuple[Any, ...]) -> tuple[Any, ...]:
        number, by_end, by_model = at
        steps = _repeat_window(problem, windows, number)

        def back_step(at: tuple[Any, ...]) -> tuple[Any, ...]:
            i, by_end, by_model = at
            by_start, more = _step_back(problem, arrays, rest, steps, i, by_end)
            new = (by_start, jax.tree.map(jnp.add, by_model, more))
            return i - 1, *_choose(i < steps.accepted, new, (by_end, by_model))

        begin = (eqxi.unvmap_max(steps.accepted) - 1, by_end, by_model)
        _, by_start, by_model = jax.lax.while_loop(lambda at: at[0] >= 0, back_step, begin)
        return number - 1, by_start, by_model

    first, last = map(eqxi.unvmap_max, span)
    begin = (last - 1, *at_end)
    return jax.lax.while_loop(lambda at: at[0] >= first, back_window, begin)[1:]


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
