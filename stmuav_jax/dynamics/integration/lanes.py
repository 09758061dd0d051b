"""Continuous batching of integrations: the slot of a finished run takes up the next of a queue.

A batch of adaptive integrations, run by `vmap` alone, lasts as long as its slowest. Here the runs
in a fixed number of batch slots ("lanes") take their steps together, each with its own step sizes;
every few steps the results of finished runs are stored and their slots continue with the next
runs of the queue. Slots are idle only at the end of a queue.

The results of a run depend on its own start and parameters, not on its slot or its neighbours: the
compiled step is the same for all, whatever the length of the queue.

Extreme values and first zero crossings of signals are also monitored between steps: there a signal is
Hermite's cubic through its values and rates at both ends, so that extremes and crossings are those of the
motion and not of the steps. A signal without rates (reactions, whose rates cost more than the run) is also
evaluated within the step, a quarter of it apart, and its rates are those of the quartic through its values.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import AbstractReason, first_reason
from ...mechanics.state import State
from .problem import Problem, begin_integration, fit_first_step

# Number of parts of a step at whose ends signals without rates are evaluated, and weights of the
# five values in the rates of their quartic, for places one apart (Fornberg 1988, Math. Comp. 51).
_PARTS = 4
_RATES = (
    (-25 / 12, 4.0, -3.0, 4 / 3, -1 / 4),
    (-1 / 4, -5 / 6, 3 / 2, -1 / 2, 1 / 12),
    (1 / 12, -2 / 3, 0.0, 2 / 3, -1 / 12),
    (-1 / 12, 1 / 2, -3 / 2, 5 / 6, 1 / 4),
    (1 / 4, -4 / 3, 3.0, -4.0, 25 / 12),
)

# Number of halvings of a step that locate a crossing to round-off.
_HALVINGS = 60


class Span(NamedTuple):
    """Values and rates of q signals (or states) at both ends of a step from t0 to t1 [s]."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    g0: Float[Array, " q"]
    g1: Float[Array, " q"]
    rate0: Float[Array, " q"]
    rate1: Float[Array, " q"]


class Cubic(NamedTuple):
    """Cubic polynomials a + b s + c s^2 + d s^3 for s from 0 to 1, (q,) each."""

    a: Float[Array, " q"]
    b: Float[Array, " q"]
    c: Float[Array, " q"]
    d: Float[Array, " q"]

    def __call__(self, s: Float[Array, " q"] | Float[Array, ""]) -> Float[Array, " q"]:
        return self.a + s * (self.b + s * (self.c + s * self.d))


def hermite_cubic(span: Span) -> Cubic:
    """Hermite's cubic of a step."""
    h = span.t1 - span.t0
    b, end, rise = h * span.rate0, h * span.rate1, span.g1 - span.g0
    return Cubic(span.g0, b, 3 * rise - 2 * b - end, b + end - 2 * rise)


def cubic_peak(curve: Cubic) -> Float[Array, " q"]:
    """Place of the cubic's maximum in (0, 1); 1 where there is none inside (q,)."""
    # Extremes between steps are those of the cubic through values and rates: steps are long, and a peak
    # lies inside.
    b, c, d = curve.b, curve.c, curve.d
    square = c * c - 3 * b * d
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    # the form of the quadratic's solution without cancellation
    first = b / jnp.where(root - c == 0, 1.0, root - c)
    second = (-c - root) / jnp.where(d == 0, 1.0, 3 * d)
    s = jnp.where(c <= 0, first, second)
    exists = (square > 0) & jnp.where(c <= 0, root - c != 0, d != 0)
    return jnp.where(exists & (s > 0) & (s < 1), s, 1.0)


def highest_value(span: Span) -> Float[Array, " q"]:
    """Largest value over a step (q,)."""
    curve = hermite_cubic(span)
    # to first order the maximum does not depend on its place, whose derivative may not exist
    top = curve(jax.lax.stop_gradient(cubic_peak(curve)))
    return jnp.maximum(jnp.maximum(span.g0, span.g1), top)


class Crossings(eqx.Module):
    """First rises of q signals above zero.

    `span` is the step of the first rise or, where none was `crossed` yet, the last step.
    """

    span: Span
    crossed: Bool[Array, " q"]

    def times(self) -> Float[Array, " q"]:
        """Times of the first rises (q,) [s]; infinite where there is none."""
        curve = hermite_cubic(self.span)
        low, high = jnp.zeros_like(curve.a), cubic_peak(curve)
        high = jnp.where(curve(high) > 0, high, 1.0)

        def halve_interval(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = 0.5 * (low + high)
            above = curve(middle) > 0
            return jnp.where(above, low, middle), jnp.where(above, middle, high)

        # Bisection: a fixed number of rounds cannot fail, and is the same work in all slots.
        _, s = jax.lax.fori_loop(0, _HALVINGS, halve_interval, (low, high))
        s = jnp.where(self.span.g0 > 0, 0.0, s)
        t = self.span.t0 + s * (self.span.t1 - self.span.t0)
        return jnp.where(self.crossed, t, jnp.inf)


class Monitor(eqx.Module):
    """Extremes and crossings of one run so far.

    Attributes:
        g, rate: values and rates of the signals after the last accepted step (q,).
        extreme: largest values so far (q,).
        crossings: first rises above zero.
    """

    g: Float[Array, " q"]
    rate: Float[Array, " q"]
    extreme: Float[Array, " q"]
    crossings: Crossings


def start_monitor(t: Float[Array, ""], g: Float[Array, " q"], rate: Float[Array, " q"]) -> Monitor:
    """Monitor at the start of a run; a signal above zero there counts as a crossing."""
    wide = lambda x: jnp.broadcast_to(x, g.shape)
    span = Span(wide(t), wide(t), g, g, rate, rate)
    return Monitor(g, rate, g, Crossings(span, g > 0))


def follow_step(
    monitor: Monitor,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    g: Float[Array, " q"],
    rate: Float[Array, " q"],
) -> Monitor:
    """Monitor after an accepted step from t0 to t1, with signals g and their rates at its end."""
    span = Span(t0, t1, monitor.g, g, monitor.rate, rate)
    top = highest_value(span)
    before = monitor.crossings
    # The first crossing's step is kept, and its time found once at the end.
    spans = jax.tree.map(lambda old, new: jnp.where(before.crossed, old, new), before.span, span)
    return Monitor(
        g, rate, jnp.maximum(monitor.extreme, top), Crossings(spans, before.crossed | (top > 0))
    )


def follow_parts(
    monitor: Monitor, step: Span, signals: Callable[[Array, Array], Float[Array, " q"]]
) -> Monitor:
    """Monitor of signals without rates after an accepted step.

    Args:
        step: states and their slopes at both ends of the step (n,), instead of signals and rates.
        signals: function of (t, y) that returns the signals (q,).
    """
    curve = hermite_cubic(step)
    h = step.t1 - step.t0
    places = jnp.arange(1, _PARTS + 1, dtype=h.dtype) / _PARTS

    def signals_at(s: Array) -> Array:
        # at the end, exactly the state with which the integration continues
        return signals(step.t0 + s * h, jnp.where(s < 1, curve(s), step.g1))

    values = jnp.concatenate([monitor.g[None], jax.lax.map(signals_at, places)])
    weights = jnp.asarray(_RATES, h.dtype)
    # term by term, so that the rounding is the same in every batch slot
    rates = jnp.sum(weights[:, :, None] * values[None], axis=1)
    rates = rates * jnp.where(h > 0, _PARTS / jnp.where(h > 0, h, 1.0), 0.0)
    times = jnp.concatenate([step.t0[None], step.t0 + places[:-1] * h, step.t1[None]])
    for k in range(_PARTS):
        at_part = eqx.tree_at(lambda m: m.rate, monitor, rates[k])
        monitor = follow_step(at_part, times[k], times[k + 1], values[k + 1], rates[k + 1])
    return monitor


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
        place, saved: number of `Plan.times` reached, and y at these (k, n), NaN at the others.
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
    saved: Float[Array, "k n"]
    monitor: Monitor
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    ending: Int[Array, ""]


class RunResult(NamedTuple):
    """Results of a run.

    Attributes:
        t, last: final time [s] and vector (n,).
        saved: y at the plan's times (k, n), NaN at those after the end.
        extreme: largest values of the monitored signals (q,); NaN if the run failed.
        when: times at which they first rose above zero (q,) [s], infinite if never; NaN likewise.
        residual: largest constraint residuals at any step: position [m], velocity, norm (3,).
        accepted, rejected: numbers of steps.
        ending: code of `Ending`.
    """

    t: Float[Array, ""]
    last: Float[Array, " n"]
    saved: Float[Array, "k n"]
    extreme: Float[Array, " q"]
    when: Float[Array, " q"]
    residual: Float[Array, "3"]
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    ending: Int[Array, ""]


def _select_trees(mask: Any, yes: Any, no: Any) -> Any:
    wide = lambda a: mask.reshape(mask.shape + (1,) * (a.ndim - mask.ndim))
    return jax.tree.map(lambda a, b: jnp.where(wide(a), a, b), yes, no)


class _Seen(NamedTuple):
    """Monitored signals at one time: those with rates (q1,), those without (q2,), slope of y."""

    smooth: Float[Array, " q1"]
    rate: Float[Array, " q1"]
    sharp: Float[Array, " q2"]
    slope: Float[Array, " m"]


def _count_signals(of: Any, problem: Problem, t: Array, y: Array) -> int:
    return jax.eval_shape(of, problem, t, y).shape[0]


def _evaluate_signals(
    plan: Plan, problem: Problem, t: Array, y: Array, *, all_signals: bool
) -> _Seen:
    """Monitored signals at t, y: those with rates, or all; the slope if some have no rates."""
    none = jnp.zeros(0, y.dtype)
    smooth, sharp = (_count_signals(of, problem, t, y) for of in (plan.smooth, plan.sharp))
    slope = problem.field(t, y, problem.model) if smooth or sharp else none
    value = plan.sharp(problem, t, y) if sharp and all_signals else none
    signals = _Seen(none, none, value, slope if sharp else none)
    if not smooth:
        return signals
    smooth_signals = lambda t, y: plan.smooth(problem, t, y)
    value, rate = jax.jvp(smooth_signals, (t, y), (jnp.ones_like(t), slope))
    return signals._replace(smooth=value, rate=rate)


def start_slot(plan: Plan, numbers: Any) -> BatchSlot:
    """Run before its first step."""
    problem, state0 = plan.make(numbers)
    problem = fit_first_step(problem, plan.times[-1] - plan.t0)
    t0 = jnp.asarray(plan.t0, state0.r.dtype)
    carry = begin_integration(problem, t0, state0)
    is_finite = jnp.all(jnp.isfinite(carry.y))
    zero = jnp.zeros((), int)
    # kept times up to the initial time have been reached
    times_reached = sum(bool(t <= plan.t0) for t in plan.times)
    rows = jnp.full((len(plan.times), carry.y.shape[0]), jnp.nan, carry.y.dtype)
    rows = rows.at[:times_reached].set(carry.y)
    signals = _evaluate_signals(plan, problem, t0, carry.y, all_signals=True)
    rate = jnp.concatenate([signals.rate, jnp.zeros_like(signals.sharp)])
    monitor = start_monitor(t0, jnp.concatenate([signals.smooth, signals.sharp]), rate)
    ending = jnp.where(is_finite, Ending.RUNNING, Ending.NO_START).astype(int)
    return BatchSlot(
        carry.t, carry.y, signals.slope, carry.t + carry.step, carry.solver_state, carry.controller_state,
        zero + times_reached, rows, monitor, zero, zero, ending,
    )  # fmt: skip


def try_step(plan: Plan, problem: Problem, lane: BatchSlot) -> BatchSlot:
    """Try one step; a run that has ended keeps its values."""
    # Runs end their steps at kept times: values there need no interpolation, whose error the tolerances
    # do not bound.
    order = problem.solver().error_order(problem.term())
    running = lane.ending == Ending.RUNNING
    goal = jnp.asarray(plan.times, lane.t.dtype)[jnp.minimum(lane.place, len(plan.times) - 1)]
    t0, t1 = lane.t, jnp.where(running & (lane.next < goal), lane.next, goal)
    t1 = jnp.where(running, t1, t0)
    y1, error, _, solver_state, _ = problem.take_step(t0, t1, lane.y, lane.solver_state)
    controller = problem.controller(jnp.asarray(problem.method.first_step)).wrap(1)
    keep, _, _, _, controller_state, result = controller.adapt_step_size(
        t0, t1, lane.y, y1, problem.model, error, order, lane.controller_state
    )
    step = controller_state[0]
    # a rejected step that is NaN or of the size of round-off would be tried for ever
    least = jnp.finfo(y1.dtype).eps * (plan.times[-1] - plan.t0)
    collapsed = (result != diffrax.RESULTS.successful) | (~keep & ~(step > least))
    is_accepted = running & keep
    t, y = jnp.where(is_accepted, t1, t0), jnp.where(is_accepted, y1, lane.y)
    is_reached = is_accepted & (t >= goal)
    row = jnp.where(is_reached, lane.place, len(plan.times))
    place = lane.place + is_reached
    monitor, slope = _update_monitor(plan, problem, lane, is_accepted, t, y)
    accepted = lane.accepted + is_accepted
    rejected = lane.rejected + (running & ~keep)
    is_finished = (place >= len(plan.times)) | jnp.any(
        monitor.crossings.crossed & jnp.asarray(plan.stops, bool)
    )
    most = accepted + rejected >= problem.method.max_steps
    broken = collapsed & ~jnp.all(jnp.isfinite(y1))
    ending = first_reason(
        (is_finished, Ending.FINE),
        (broken, Ending.NOT_FINITE),
        (collapsed, Ending.COLLAPSED),
        (most, Ending.MAX_STEPS),
    ).astype(int)
    return BatchSlot(
        t, y, slope, jnp.where(running, t + step, lane.next),
        _select_trees(is_accepted, solver_state, lane.solver_state),
        _select_trees(running, controller_state, lane.controller_state),
        place, lane.saved.at[row].set(y, mode="drop"), monitor, accepted, rejected,
        jnp.where(running, ending, lane.ending),
    )  # fmt: skip


def _update_monitor(
    plan: Plan, problem: Problem, lane: BatchSlot, is_accepted: Array, t: Array, y: Array
) -> tuple[Monitor, Array]:
    """Monitor and slope after the step to t, y if it was accepted, otherwise before it."""
    if not plan.stops:
        return lane.monitor, lane.slope
    t0, before = lane.t, lane.monitor
    # `follow_parts` evaluates the signals without rates, at the end of the step too
    signals = _evaluate_signals(plan, problem, t, y, all_signals=False)
    count = signals.smooth.shape[0]
    part = lambda rows: jax.tree.map(lambda x: x[rows], before)
    after = follow_step(part(slice(0, count)), t0, t, signals.smooth, signals.rate)
    if signals.slope.shape[0]:
        step = Span(t0, t, lane.y, y, lane.slope, signals.slope)
        rest = follow_parts(part(slice(count, None)), step, lambda t, y: plan.sharp(problem, t, y))
        after = jax.tree.map(lambda a, b: jnp.concatenate([a, b]), after, rest)
    return _select_trees(is_accepted, (after, signals.slope), (before, lane.slope))


def _collect_result(lane: BatchSlot) -> RunResult:
    worst = lane.solver_state[1]
    monitor = lane.monitor
    failed = lane.ending != Ending.FINE
    hide = lambda x: jnp.where(failed, jnp.nan, x)
    return RunResult(
        lane.t, lane.y, lane.saved, hide(monitor.extreme), hide(monitor.crossings.times()),
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


def integrate_batch(plan: Plan, numbers: Any, count: Int[Array, ""], lanes: int) -> RunResult:
    """Integrate the first `count` of a queue of n runs; the results of the others are empty.

    Args:
        numbers: arguments of `plan.make`, each array with a leading axis (n, .).
        lanes: number of batch slots.
    """
    size = jax.tree.leaves(numbers)[0].shape[0]
    take = lambda places: jax.tree.map(lambda x: x[jnp.clip(places, 0, size - 1)], numbers)
    launched = jax.vmap(lambda arguments: start_slot(plan, arguments))

    def run_slot(arguments: Any, lane: BatchSlot) -> BatchSlot:
        problem = fit_first_step(plan.make(arguments)[0], plan.times[-1] - plan.t0)
        return jax.lax.fori_loop(0, ROUND, lambda _, now: try_step(plan, problem, now), lane)

    def run_rounds(queue: _Queue) -> _Queue:
        idle = queue.flight >= size
        # Idle slots take the next runs in order, so that results do not depend on the time that a run takes.
        place = jnp.where(idle, queue.next + jnp.cumsum(idle) - 1, queue.flight)
        fresh = idle & (place < count)
        flight = jnp.where(fresh, place, queue.flight)
        parameters = _select_trees(fresh, take(place), queue.numbers)
        # Starts cost more than a step: they are computed only in rounds with a free slot.
        now = jax.lax.cond(
            jnp.any(fresh),
            lambda: _select_trees(fresh, launched(parameters), queue.lanes),
            lambda: queue.lanes,
        )
        now = jax.vmap(run_slot)(parameters, now)
        is_finished = (now.ending != Ending.RUNNING) & (flight < size)
        row = jnp.where(is_finished, flight, size)
        results = jax.tree.map(
            # A row beyond the end is dropped, which stands for slots without a result.
            lambda all, new: all.at[row].set(new, mode="drop"),
            queue.results,
            jax.vmap(_collect_result)(now),
        )
        flight = jnp.where(is_finished, size, flight)
        return _Queue(now, parameters, flight, queue.next + jnp.sum(fresh), results)

    first = take(jnp.zeros(lanes, int))
    shapes = jax.eval_shape(launched, first)
    none = lambda shape: jnp.full(shape.shape, 0, shape.dtype)
    slots = jax.tree.map(none, shapes)
    slots = eqx.tree_at(lambda lane: lane.ending, slots, jnp.full(lanes, Ending.FINE, int))
    result_shape = jax.eval_shape(
        lambda lane: _collect_result(jax.tree.map(lambda x: x[0], lane)), slots
    )
    empty = jax.tree.map(
        lambda x: jnp.full((size, *x.shape), jnp.nan if x.dtype.kind == "f" else 0, x.dtype),
        result_shape,
    )
    queue = _Queue(slots, first, jnp.full(lanes, size), jnp.zeros((), int), empty)
    going = lambda q: jnp.any(q.flight < size) | (q.next < count)
    return jax.lax.while_loop(going, run_rounds, queue).results
