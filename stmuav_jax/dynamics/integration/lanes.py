"""Continuous batching of integrations: the slot of a finished run takes up the next of a queue.

A batch of adaptive integrations, run by `vmap` alone, lasts as long as its slowest. Here the runs
in a fixed number of batch slots ("lanes") take their steps together, each with its own step sizes;
every few steps the results of finished runs are stored and their slots continue with the next
runs of the queue. Slots are idle only at the end of a queue.

The results of a run depend on its own start and parameters, not on its slot or its neighbours: the
compiled step is the same for all, whatever the length of the queue.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ...checks.reason import AbstractReason, first_reason
from ...mechanics.state import State
from .monitor import Monitor, Span, follow, follow_parts, start
from .problem import Problem, begin

# Number of steps between two refills of the slots: a finished one waits half of it on average.
ROUND = 8


class Ending(AbstractReason):
    """Reason for which a run ended; 0 while it continues."""

    RUNNING = 0
    FINE = 1
    NO_START = 2
    MAX_STEPS = 3
    COLLAPSED = 4
    NOT_PHYSICAL = 5
    NOT_FINITE = 6


REASONS = {
    Ending.NOT_PHYSICAL: "a mass that is not positive, or an inertia tensor that no body can have",
    Ending.NOT_FINITE: "accelerations are not finite: forces too large or bodies too light",
    Ending.NO_START: "the start cannot be made: out of the mechanism's reach, or not finite",
    Ending.MAX_STEPS: "the most steps allowed did not reach the end",
    Ending.COLLAPSED: "the step size fell to round-off: the motion cannot be followed",
}


class Plan(NamedTuple):
    """Definition of the runs of a queue.

    Attributes:
        make: function of the parameters of one run that returns the prepared problem and the
            consistent initial state.
        times: times at which the state is kept (k,) [s], increasing from t0; the last is the end.
        t0: initial time [s].
        smooth, sharp: functions of (problem, t, y) that return the monitored signals, (q1,) with
            rates and (q2,) without; q = q1 + q2 signals in this order.
        stops: True for signals that end the run when they rise above zero (q,).
    """

    make: Callable[[Any], tuple[Problem, State]]
    times: Float[Array, " k"]
    t0: float
    smooth: Callable[[Problem, Array, Array], Float[Array, " q1"]]
    sharp: Callable[[Problem, Array, Array], Float[Array, " q2"]]
    stops: tuple[bool, ...]


class BatchSlot(eqx.Module):
    """Run in a batch slot.

    Attributes:
        t, y, next: current time [s] and vector (n,), end of the step to try [s].
        slope: rate of y (n,), kept if signals without rates are monitored, else (0,).
        place, kept: number of `Plan.times` reached, and y at these (k, n), NaN at the others.
        monitor: extremes and crossings of the monitored signals.
        accepted, rejected: numbers of steps.
        ending: code of `Ending`.
    """

    t: Float[Array, ""]
    y: Float[Array, " n"]
    slope: Float[Array, " m"]
    next: Float[Array, ""]
    solver_state: Any
    controller_state: Any
    place: Int[Array, ""]
    kept: Float[Array, "k n"]
    monitor: Monitor
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    ending: Int[Array, ""]


class RunResult(NamedTuple):
    """Results of a run.

    Attributes:
        t, last: final time [s] and vector (n,).
        kept: y at the plan's times (k, n), NaN at those after the end.
        extreme: largest values of the monitored signals (q,); NaN if the run failed.
        when: times at which they first rose above zero (q,) [s], infinite if never; NaN likewise.
        residual: largest constraint residuals at any step: position [m], velocity, norm (3,).
        accepted, rejected: numbers of steps.
        ending: code of `Ending`.
    """

    t: Float[Array, ""]
    last: Float[Array, " n"]
    kept: Float[Array, "k n"]
    extreme: Float[Array, " q"]
    when: Float[Array, " q"]
    residual: Float[Array, "3"]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    ending: Int[Array, ""]


def _select(which: Any, yes: Any, no: Any) -> Any:
    wide = lambda a: which.reshape(which.shape + (1,) * (a.ndim - which.ndim))
    return jax.tree.map(lambda a, b: jnp.where(wide(a), a, b), yes, no)


class _Seen(NamedTuple):
    """Monitored signals at one time: those with rates (q1,), those without (q2,), slope of y."""

    smooth: Float[Array, " q1"]
    rate: Float[Array, " q1"]
    sharp: Float[Array, " q2"]
    slope: Float[Array, " m"]


def _count(of: Any, problem: Problem, t: Array, y: Array) -> int:
    return jax.eval_shape(of, problem, t, y).shape[0]


def _seen(plan: Plan, problem: Problem, t: Array, y: Array, *, all_signals: bool) -> _Seen:
    """Monitored signals at t, y: those with rates, or all; the slope if some have no rates."""
    none = jnp.zeros(0, y.dtype)
    smooth, sharp = (_count(of, problem, t, y) for of in (plan.smooth, plan.sharp))
    slope = problem.field(t, y, problem.model) if smooth or sharp else none
    value = plan.sharp(problem, t, y) if sharp and all_signals else none
    found = _Seen(none, none, value, slope if sharp else none)
    if not smooth:
        return found
    along = lambda t, y: plan.smooth(problem, t, y)
    value, rate = jax.jvp(along, (t, y), (jnp.ones_like(t), slope))
    return found._replace(smooth=value, rate=rate)


def launch(plan: Plan, numbers: Any) -> BatchSlot:
    """Run before its first step."""
    problem, state0 = plan.make(numbers)
    t0 = jnp.asarray(plan.t0, state0.r.dtype)
    carry = begin(problem, t0, state0)
    fine = jnp.all(jnp.isfinite(carry.y))
    zero = jnp.zeros((), int)
    # kept times up to the initial time have been reached
    reached = sum(bool(t <= plan.t0) for t in plan.times)
    kept = jnp.full((len(plan.times), carry.y.shape[0]), jnp.nan, carry.y.dtype)
    kept = kept.at[:reached].set(carry.y)
    seen = _seen(plan, problem, t0, carry.y, all_signals=True)
    rate = jnp.concatenate([seen.rate, jnp.zeros_like(seen.sharp)])
    monitor = start(t0, jnp.concatenate([seen.smooth, seen.sharp]), rate)
    ending = jnp.where(fine, Ending.RUNNING, Ending.NO_START).astype(int)
    return BatchSlot(
        carry.t, carry.y, seen.slope, carry.t + carry.step, carry.solver_state, carry.controller_state,
        zero + reached, kept, monitor, zero, zero, ending,
    )  # fmt: skip


def attempt(plan: Plan, problem: Problem, lane: BatchSlot) -> BatchSlot:
    """Try one step; a run that has ended keeps its values."""
    solver, terms = problem.solver(), diffrax.ODETerm(problem.field)
    running = lane.ending == Ending.RUNNING
    goal = jnp.asarray(plan.times, lane.t.dtype)[jnp.minimum(lane.place, len(plan.times) - 1)]
    t0, t1 = lane.t, jnp.where(running & (lane.next < goal), lane.next, goal)
    t1 = jnp.where(running, t1, t0)
    y1, error, _, solver_state, _ = solver.step(
        terms, t0, t1, lane.y, problem.model, lane.solver_state, True
    )
    controller = problem.controller(jnp.asarray(problem.method.first_step)).wrap(1)
    keep, _, _, _, controller_state, result = controller.adapt_step_size(
        t0, t1, lane.y, y1, problem.model, error, solver.error_order(terms), lane.controller_state
    )
    step = controller_state[0]
    # a rejected step that is NaN or of the size of round-off would be tried for ever
    least = jnp.finfo(y1.dtype).eps * (plan.times[-1] - plan.t0)
    collapsed = (result != diffrax.RESULTS.successful) | (~keep & ~(step > least))
    taken = running & keep
    t, y = jnp.where(taken, t1, t0), jnp.where(taken, y1, lane.y)
    reached = taken & (t >= goal)
    row = jnp.where(reached, lane.place, len(plan.times))
    place = lane.place + reached
    monitor, slope = _watched(plan, problem, lane, taken, t, y)
    accepted = lane.accepted + taken
    rejected = lane.rejected + (running & ~keep)
    ended = (place >= len(plan.times)) | jnp.any(
        monitor.crossings.found & jnp.asarray(plan.stops, bool)
    )
    most = accepted + rejected >= problem.method.max_steps
    broken = collapsed & ~jnp.all(jnp.isfinite(y1))
    ending = first_reason(
        (ended, Ending.FINE),
        (broken, Ending.NOT_FINITE),
        (collapsed, Ending.COLLAPSED),
        (most, Ending.MAX_STEPS),
    ).astype(int)
    return BatchSlot(
        t, y, slope, jnp.where(running, t + step, lane.next),
        _select(taken, solver_state, lane.solver_state),
        _select(running, controller_state, lane.controller_state),
        place, lane.kept.at[row].set(y, mode="drop"), monitor, accepted, rejected,
        jnp.where(running, ending, lane.ending),
    )  # fmt: skip


def _watched(
    plan: Plan, problem: Problem, lane: BatchSlot, taken: Array, t: Array, y: Array
) -> tuple[Monitor, Array]:
    """Monitor and slope after the step to t, y if it was accepted, otherwise before it."""
    if not plan.stops:
        return lane.monitor, lane.slope
    t0, before = lane.t, lane.monitor
    # `follow_parts` evaluates the signals without rates, at the end of the step too
    seen = _seen(plan, problem, t, y, all_signals=False)
    count = seen.smooth.shape[0]
    part = lambda rows: jax.tree.map(lambda x: x[rows], before)
    after = follow(part(slice(0, count)), t0, t, seen.smooth, seen.rate)
    if seen.slope.shape[0]:
        step = Span(t0, t, lane.y, y, lane.slope, seen.slope)
        rest = follow_parts(part(slice(count, None)), step, lambda t, y: plan.sharp(problem, t, y))
        after = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), after, rest)
    return _select(taken, (after, seen.slope), (before, lane.slope))


def _left(lane: BatchSlot) -> RunResult:
    worst = lane.solver_state[1]
    monitor = lane.monitor
    failed = lane.ending != Ending.FINE
    hide = lambda x: jnp.where(failed, jnp.nan, x)
    return RunResult(
        lane.t, lane.y, lane.kept, hide(monitor.extreme), hide(monitor.crossings.times()),
        jnp.stack([worst.position, worst.velocity, worst.norm]),
        lane.accepted, lane.rejected, lane.ending,
    )  # fmt: skip


class _Queue(NamedTuple):
    """Queue of n runs, of which b at a time are in the batch slots.

    Attributes:
        lanes, numbers: runs in the slots and their parameters (b, .).
        flight, next: places in the queue of these runs (b,), n if idle, and of the next run.
        results: results of all runs (n, .).
    """

    lanes: BatchSlot
    numbers: Any
    flight: Int[Array, " b"]
    next: Int[Array, ""]
    results: RunResult


def fly(plan: Plan, numbers: Any, count: Int[Array, ""], lanes: int) -> RunResult:
    """Integrate the first `count` of a queue of n runs; the results of the others are empty.

    Args:
        numbers: arguments of `plan.make`, each array with a leading axis (n, .).
        lanes: number of batch slots.
    """
    size = jax.tree.leaves(numbers)[0].shape[0]
    take = lambda places: jax.tree.map(lambda x: x[jnp.clip(places, 0, size - 1)], numbers)
    launched = jax.vmap(lambda each: launch(plan, each))

    def whole(each: Any, lane: BatchSlot) -> BatchSlot:
        problem, _ = plan.make(each)
        return jax.lax.fori_loop(0, ROUND, lambda _, now: attempt(plan, problem, now), lane)

    def rounds(queue: _Queue) -> _Queue:
        idle = queue.flight >= size
        place = jnp.where(idle, queue.next + jnp.cumsum(idle) - 1, queue.flight)
        fresh = idle & (place < count)
        flight = jnp.where(fresh, place, queue.flight)
        given = _select(fresh, take(place), queue.numbers)
        now = jax.lax.cond(
            jnp.any(fresh),
            lambda: _select(fresh, launched(given), queue.lanes),
            lambda: queue.lanes,
        )
        now = jax.vmap(whole)(given, now)
        done = (now.ending != Ending.RUNNING) & (flight < size)
        row = jnp.where(done, flight, size)
        results = jax.tree.map(
            lambda all, new: all.at[row].set(new, mode="drop"),
            queue.results,
            jax.vmap(_left)(now),
        )
        flight = jnp.where(done, size, flight)
        return _Queue(now, given, flight, queue.next + jnp.sum(fresh), results)

    first = take(jnp.zeros(lanes, int))
    shapes = jax.eval_shape(launched, first)
    none = lambda shape: jnp.full(shape.shape, 0, shape.dtype)
    begun = jax.tree.map(none, shapes)
    begun = eqx.tree_at(lambda lane: lane.ending, begun, jnp.full(lanes, Ending.FINE, int))
    one = jax.eval_shape(lambda lane: _left(jax.tree.map(lambda x: x[0], lane)), begun)
    empty = jax.tree.map(
        lambda x: jnp.full((size, *x.shape), jnp.nan if x.dtype.kind == "f" else 0, x.dtype), one
    )
    queue = _Queue(begun, first, jnp.full(lanes, size), jnp.zeros((), int), empty)
    going = lambda q: jnp.any(q.flight < size) | (q.next < count)
    return jax.lax.while_loop(going, rounds, queue).results
