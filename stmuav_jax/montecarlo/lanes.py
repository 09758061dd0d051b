"""Many flights through few lanes: a finished flight's lane takes up the next one.

A batch of adaptive integrations, run by `vmap` alone, lasts as long as its slowest. Here a fixed
number of lanes take their steps together, every flight at its own step sizes; every few steps what
has finished is put away, and the lane goes on with the next flight of the queue. Lanes idle at the
end of a queue only.

A flight's numbers depend on its own start and parameters, not on its lane or its neighbours: the
compiled step is the same for all, whatever the length of the queue.
"""

from collections.abc import Callable
from enum import IntEnum
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..dynamics.problem import Problem, begin
from ..mechanics.state import State
from .monitor import Monitor, Step, follow, follow_parts, start

# Steps between two looks at which lanes have finished: a finished one waits half of these.
ROUND = 8


class Ending(IntEnum):
    """How a flight ended; 0 while it goes on."""

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
    """What is flown.

    Attributes:
        make: (numbers of one flight) -> prepared problem and consistent start.
        times: where the state is kept (k,) [s], increasing, from t0 on; the last is the end.
        t0: [s].
        smooth, sharp: (problem, t, y) -> signals to be watched, (q1,) with rates and (q2,) without;
            q = q1 + q2 signals in this order.
        stops: which of them end the flight when they rise above zero (q,).
        step: constant step [s], or None for adaptive ones.
    """

    make: Callable[[Any], tuple[Problem, State]]
    times: Float[Array, " k"]
    t0: float
    smooth: Callable[[Problem, Array, Array], Float[Array, " q1"]]
    sharp: Callable[[Problem, Array, Array], Float[Array, " q2"]]
    stops: tuple[bool, ...]
    step: float | None


class Lane(eqx.Module):
    """A flight under way.

    Attributes:
        t, y: now [s], (n,). slope: its rate (n,), kept where signals without rates are watched, else
            (0,). next: end of the step to try [s].
        solver_state, controller_state: diffrax's.
        place: how many of the kept times have been reached. kept: states there (k, n).
        monitor: of the watched signals. accepted, rejected: steps. ending: a code of `Ending`.
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


class Flown(NamedTuple):
    """What is left of a flight.

    Attributes:
        t: where it ended [s]. last: state there (n,). kept: states at the plan's times (k, n), NaN
            from its end on.
        extreme: largest values of the watched signals (q,). when: when they first rose above zero
            [s], infinite if never (q,).
        residual: largest constraint residuals at any step: position [m], velocity, norm (3,).
        accepted, rejected: steps. ending: a code of `Ending`.
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
    """Watched signals at one time: values with rates (q1,), values without (q2,), slope of y."""

    smooth: Float[Array, " q1"]
    rate: Float[Array, " q1"]
    sharp: Float[Array, " q2"]
    slope: Float[Array, " m"]


def _count(of: Any, problem: Problem, t: Array, y: Array) -> int:
    return jax.eval_shape(of, problem, t, y).shape[0]


def _seen(plan: Plan, problem: Problem, t: Array, y: Array, *, all_signals: bool) -> _Seen:
    """Those with rates, or all of them; the slope where there are some without."""
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


def launch(plan: Plan, numbers: Any) -> Lane:
    """A flight before its first step."""
    problem, state0 = plan.make(numbers)
    t0 = jnp.asarray(plan.t0, state0.r.dtype)
    carry = begin(problem, t0, state0)
    fine = jnp.all(jnp.isfinite(carry.y))
    step = carry.step if plan.step is None else jnp.asarray(plan.step, carry.y.dtype)
    zero = jnp.zeros((), int)
    # a kept time that is the start has been reached
    reached = sum(bool(t <= plan.t0) for t in plan.times)
    kept = jnp.full((len(plan.times), carry.y.shape[0]), jnp.nan, carry.y.dtype)
    kept = kept.at[:reached].set(carry.y)
    seen = _seen(plan, problem, t0, carry.y, all_signals=True)
    rate = jnp.concatenate([seen.rate, jnp.zeros_like(seen.sharp)])
    monitor = start(t0, jnp.concatenate([seen.smooth, seen.sharp]), rate)
    ending = jnp.where(fine, Ending.RUNNING, Ending.NO_START).astype(int)
    return Lane(
        carry.t, carry.y, seen.slope, carry.t + step, carry.solver_state, carry.controller_state,
        zero + reached, kept, monitor, zero, zero, ending,
    )  # fmt: skip


def attempt(plan: Plan, problem: Problem, lane: Lane) -> Lane:
    """Try one step; a flight that has ended stays where it is."""
    solver, terms = problem.solver(), diffrax.ODETerm(problem.field)
    running = lane.ending == Ending.RUNNING
    goal = jnp.asarray(plan.times, lane.t.dtype)[jnp.minimum(lane.place, len(plan.times) - 1)]
    # a constant step that ends at the goal but for round-off ends there
    near = 0.0 if plan.step is None else 1e-9 * plan.step
    t0, t1 = lane.t, jnp.where(running & (lane.next < goal - near), lane.next, goal)
    t1 = jnp.where(running, t1, t0)
    y1, error, _, solver_state, _ = solver.step(
        terms, t0, t1, lane.y, problem.model, lane.solver_state, True
    )
    if plan.step is None:
        controller = problem.controller(jnp.asarray(problem.method.first_step)).wrap(1)
        order = solver.error_order(terms)
        keep, _, _, _, controller_state, result = controller.adapt_step_size(
            t0, t1, lane.y, y1, problem.model, error, order, lane.controller_state
        )
        step = controller_state[0]
        # a step that is not a number, or too short to be one of many, can only be tried for ever
        least = jnp.finfo(y1.dtype).eps * (plan.times[-1] - plan.t0)
        collapsed = (result != diffrax.RESULTS.successful) | (~keep & ~(step > least))
    else:
        # whole steps from the start, so that cutting one short does not shift the others
        keep, controller_state = jnp.asarray(True), lane.controller_state
        count = jnp.floor((t1 - plan.t0) / plan.step * (1 + 1e-12)) + 1
        step = plan.t0 + count * plan.step - t1
        collapsed = ~jnp.all(jnp.isfinite(y1))
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
    codes = [Ending.FINE, Ending.NOT_FINITE, Ending.COLLAPSED, Ending.MAX_STEPS]
    ending = jnp.select([ended, broken, collapsed, most], codes, Ending.RUNNING)
    return Lane(
        t, y, slope, jnp.where(running, t + step, lane.next),
        _select(taken, solver_state, lane.solver_state),
        _select(running, controller_state, lane.controller_state),
        place, lane.kept.at[row].set(y, mode="drop"), monitor, accepted, rejected,
        jnp.where(running, ending, lane.ending),
    )  # fmt: skip


def _watched(
    plan: Plan, problem: Problem, lane: Lane, taken: Array, t: Array, y: Array
) -> tuple[Monitor, Array]:
    """The monitor after the step to t, y, where it was taken, and the slope there."""
    if not plan.stops:
        return lane.monitor, lane.slope
    t0, before = lane.t, lane.monitor
    # the others' values at the end of the step are among those within it
    seen = _seen(plan, problem, t, y, all_signals=False)
    count = seen.smooth.shape[0]
    part = lambda rows: jax.tree.map(lambda x: x[rows], before)
    after = follow(part(slice(0, count)), t0, t, seen.smooth, seen.rate)
    if seen.slope.shape[0]:
        step = Step(t0, t, lane.y, y, lane.slope, seen.slope)
        rest = follow_parts(part(slice(count, None)), step, lambda t, y: plan.sharp(problem, t, y))
        after = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), after, rest)
    return _select(taken, (after, seen.slope), (before, lane.slope))


def _left(lane: Lane) -> Flown:
    worst = lane.solver_state[1]
    monitor = lane.monitor
    failed = lane.ending != Ending.FINE
    hide = lambda x: jnp.where(failed, jnp.nan, x)
    return Flown(
        lane.t, lane.y, lane.kept, hide(monitor.extreme), hide(monitor.crossings.times()),
        jnp.stack([worst.position, worst.velocity, worst.norm]),
        lane.accepted, lane.rejected, lane.ending,
    )  # fmt: skip


class _Queue(NamedTuple):
    """Lanes (b, .), their flights' numbers and places in the queue (b,), the next place, results."""

    lanes: Lane
    numbers: Any
    flight: Int[Array, " b"]
    next: Int[Array, ""]
    results: Flown


def fly(plan: Plan, numbers: Any, count: Int[Array, ""], lanes: int) -> Flown:
    """Fly the first `count` of a queue of n flights; the results of the others are empty.

    Args:
        numbers: what `plan.make` takes, each with a leading axis (n, .).
        lanes: how many flights go on together.
    """
    size = jax.tree.leaves(numbers)[0].shape[0]
    take = lambda places: jax.tree.map(lambda x: x[jnp.clip(places, 0, size - 1)], numbers)
    launched = jax.vmap(lambda each: launch(plan, each))

    def whole(each: Any, lane: Lane) -> Lane:
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
