"""Integration from output time to output time, through events and jumps of the forces, in chunks.

Steps end at the output times, without interpolation, because diffrax's dense output is of lower
order than its steps. Work and impulse are integrated with the state for the energy and momentum
balances; they do not enter the control of the step size.

A run that starts at a zero of its event function, such as the next arc of a bouncing ball, starts
after that event and not before it. An event function that becomes NaN ends the run with the
result `diffrax.RESULTS.nonfinite`.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from equinox.internal import prevbefore
from jaxtyping import Array, Bool, Float

from ...checks.numbers import as_floats
from ...math.compiler import cached_program
from ...math.newton import EventBisection
from ...mechanics.state import State
from ..formulations.base import Residuals
from ..method import DiscreteAdjoint
from .adjoint import diffrax_adjoint, integrate_recorded, is_recorded
from .goals import Goals, Row, make_row, reach_goals
from .problem import (
    Counts,
    IntegrationState,
    Problem,
    SegmentEnd,
    compiled_begin,
    read_end,
)

# A run starts at its event if the event function is zero within this many tolerances, in seconds,
# after or before the start.
_NEAR = 1e3


def to_event(
    problem: Problem,
    carry: IntegrationState,
    t1: Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint,
) -> SegmentEnd:
    """Integrate from the carry to t1 [s], or to an event before it."""
    method = problem.method
    assert method.event is not None
    condition = method.event

    def condition_value(t: Any, y: Any, args: Any, **_: Any) -> Array:
        state = method.formulation.to_state(args, y[: problem.n_state])
        return jnp.asarray(condition(t, state))

    kind = jax.eval_shape(lambda: condition_value(carry.t, carry.y, problem.model)).dtype
    if kind == jnp.bool_:
        event = diffrax.Event(condition_value)
    else:
        start, sign = _at_start(problem, carry, condition_value)

        def crossing_value(t: Any, y: Any, args: Any, **_: Any) -> Array:
            now = condition_value(t, y, args)
            # A NaN compares as false both ways and would hide the crossing; it has an event of its
            # own, which ends the run with another result.
            now = jnp.where(jnp.isnan(now), 1.0, now)
            return jnp.where(start & (t <= carry.t), sign, now)

        lost = lambda t, y, args, **_: jnp.isnan(condition_value(t, y, args))
        finder = EventBisection()  # pyright: ignore[reportCallIssue]
        # in this order: if the first is true, the second is ignored
        event = diffrax.Event((lost, crossing_value), finder, (None, method.direction))
    solution = problem.solve(carry, t1, adjoint, event=event)
    end = read_end(solution)
    occurred = end.result == diffrax.RESULTS.event_occurred
    if kind != jnp.bool_:
        bad = occurred & solution.event_mask[0]  # pyright: ignore[reportOptionalSubscript]
        nonfinite: Any = diffrax.RESULTS.nonfinite
        result = diffrax.RESULTS.where(bad, nonfinite, end.result)
        end, occurred = end._replace(result=result), occurred & ~bad
    # The event's time comes from interpolation, the state at it from steps. Without an event there is no
    # way to go again; a branch instead would, in a batch, mix up what the members' steps leave for derivatives.
    restarted = read_end(problem.solve(carry, jnp.where(occurred, end.t, carry.t), adjoint))
    restarted = restarted._replace(result=end.result)
    return jax.tree.map(lambda a, b: jnp.where(occurred, a, b), restarted, end)


def _at_start(
    problem: Problem, carry: IntegrationState, value: Any
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """True if the run starts at its event, and the event function right after the start."""
    # The start's slope is found by a midpoint step of the motion: the event function has no
    # derivative in time of its own, and may be of any form.
    carry_t, y, model = jax.lax.stop_gradient((carry.t, carry.y, problem.model))
    h = jnp.asarray(problem.method.first_step, y.dtype)
    half = y + h / 2 * problem.field(carry_t, y, model)
    after = y + h * problem.field(carry_t + h / 2, half, model)
    first, second = value(carry_t, y, model), value(carry_t + h, after, model)
    tolerance = _NEAR * jnp.maximum(problem.method.rtol, problem.method.atol)
    at_event = jnp.abs(first) <= jnp.abs(second - first) * jnp.minimum(tolerance / h, 1.0)
    return (carry.counts.accepted == 0) & at_event, jax.lax.stop_gradient(second)


class Trajectory(eqx.Module):
    """Trajectory: states at the output times, and sums over the motion so far.

    Attributes:
        ts: times reached (k,) [s]; after an event or a failure, the time where it stopped.
        states: states of all bodies (k, n, .); NaN at times that a failed run did not reach.
        work: work of forces without potential and of drivers (k,) [J]; zero, like the impulse,
            if the method has no `balances`.
        impulse: linear and angular (about the world's origin) impulse (k, 6) [N s], [N m s];
            zero for systems on ground.
        internal: internal states of force elements (k, m), see `internal_names`.
        counts: numbers of steps, each (k,).
        worst: largest constraint residuals at any accepted step, each (k,).
        result: diffrax's result code of the whole integration.
    """

    ts: Float[Array, " k"]
    states: State
    work: Float[Array, " k"]
    impulse: Float[Array, "k 6"]
    internal: Float[Array, "k m"]
    counts: Counts
    worst: Residuals
    result: diffrax.RESULTS


def integrate_times(
    problem: Problem, carry: IntegrationState, ts: Float[Array, " k"]
) -> tuple[IntegrationState, Trajectory]:
    """Integrate to each of the times ts [s] in turn; after a failure or an event, stay there."""
    end, rows = _integrate_rows(problem, carry, ts)
    return end, _make_trajectory(problem, end, rows)


def integrate_path(problem: Problem, begin: IntegrationState, ts: Float[Array, " k"]) -> Trajectory:
    """Trajectory at times ts [s], the first of which is that of the start."""
    # the start takes no steps, nor a place in the record of them
    end, rows = _integrate_rows(problem, begin, ts[1:])
    first = jax.tree.map(lambda x, xs: jnp.asarray(x, xs.dtype)[None], make_row(begin), rows)
    rows = jax.tree.map(lambda *parts: jnp.concatenate(parts), first, rows)
    return _make_trajectory(problem, end, rows)


def _integrate_rows(
    problem: Problem, carry: IntegrationState, ts: Float[Array, " k"]
) -> tuple[IntegrationState, Row]:
    """End of an integration, and its rows at the output times [s]."""
    jumps = problem.method.jump_ts
    if jumps is None:
        return _integrate_goals(problem, carry, Goals(ts, None))
    # merge the times of jumps into the output times; outputs come first at equal times
    merged = jnp.concatenate([ts, jnp.asarray(jumps)])
    # Jumps are integrated to like output times, whose rows are dropped afterwards: steps then end
    # at both, in one loop.
    order = jnp.argsort(merged)
    goals = Goals(merged[order], order >= ts.shape[0])
    end, rows = _integrate_goals(problem, carry, goals)
    rows = jax.tree.map(lambda x: x[jnp.argsort(order)[: ts.shape[0]]], rows)
    # an output time at a jump is reached just before it
    return end, rows._replace(t=jnp.where(rows.t == prevbefore(ts), ts, rows.t))


def _integrate_goals(
    problem: Problem, carry: IntegrationState, goals: Goals
) -> tuple[IntegrationState, Row]:
    """Integrate through all goals, differentiable by the method's adjoint."""
    adjoint: Any = problem.method.adjoint
    if isinstance(adjoint, DiscreteAdjoint):
        if is_recorded(problem):
            return integrate_recorded(problem, carry, goals)
        adjoint = diffrax_adjoint(adjoint, problem, len(goals.times))

    if problem.method.event is not None:
        integrate_to = lambda carry, t1: to_event(problem, carry, t1, adjoint)
    else:
        integrate_to = lambda carry, t1: read_end(problem.solve(carry, t1, adjoint))
    return reach_goals(problem, carry, goals, integrate_to)


def _make_trajectory(problem: Problem, end: IntegrationState, rows: Row) -> Trajectory:
    """Trajectory from the rows at the output times."""
    times, ys, counts, worst = rows
    first = problem.n_state
    n = first + problem.n_internal
    to_state = lambda y: problem.method.formulation.to_state(problem.model, y[:first])
    work, impulse = jnp.zeros_like(times), jnp.zeros((ys.shape[0], 6), ys.dtype)
    if problem.method.balances:
        work = ys[:, n]
        impulse = ys[:, n + 1 :] if problem.floating else impulse
    states = jax.vmap(to_state)(ys)
    internal = ys[:, first:n]
    return Trajectory(times, states, work, impulse, internal, counts, worst, end.result)


# Number of output times for one call of the compiled program, between two signs of progress.
CHUNK = 16


class March:
    """Integration of one problem, in chunks of output times.

    Args:
        problem: prepared model and method. Problems that differ in numbers only, such as
            tolerances, share their program.
        t0: initial time [s].
        state0: initial state.

    Attributes:
        parts: trajectories reached so far, as NumPy arrays, one for every call of `to`.
    """

    def __init__(self, problem: Problem, t0: float, state0: State) -> None:
        self.problem = problem
        self.carry: Any = compiled_begin(problem, as_floats(t0), state0)
        chunk = as_floats(np.full(CHUNK, float(t0)))
        self.program = cached_program(integrate_times, problem, self.carry, chunk)
        self.parts: list[Trajectory] = []

    def to(self, times: np.ndarray) -> Trajectory:
        """Continue to each of the times (k,) [s], or to an earlier event or failure.

        Returns this part of the trajectory.
        """
        trajectories = []
        for start in range(0, len(times), CHUNK):
            part = times[start : start + CHUNK]
            # The program has a fixed number of output times; the rest repeats the last one, to
            # which no step is taken.
            chunk = np.append(part, np.full(CHUNK - len(part), part[-1]))
            self.carry, trajectory = self.program(self.problem, self.carry, as_floats(chunk))
            trajectories.append(_cut_trajectory(trajectory, len(part)))
            if not self.going:
                break
        self.parts.append(_join_trajectories(trajectories))
        return self.parts[-1]

    @property
    def going(self) -> bool:
        """True if neither an event nor a failure has ended the integration."""
        return same_result(self.carry.result, diffrax.RESULTS.successful)

    def trajectory(self) -> Trajectory:
        """Trajectory of all parts, without repeats of the last state after an event or failure."""
        joined = _join_trajectories(self.parts)
        fresh = np.append(True, np.diff(joined.ts) > 0)
        count = len(joined.ts) if np.all(fresh) else int(np.argmin(fresh))
        return _cut_trajectory(joined, max(count, 1))


def same_result(a: Any, b: Any) -> bool:
    """Test whether two known results are the same, by their numbers, which compiles nothing."""
    return int(jax.tree.leaves(a)[0]) == int(jax.tree.leaves(b)[0])


def _read_result(trajectory: Trajectory) -> Any:
    return trajectory.result


def _join_trajectories(parts: list[Trajectory]) -> Trajectory:
    bare = [eqx.tree_at(_read_result, part, None) for part in parts]
    joined = jax.tree.map(lambda *x: np.concatenate(x), *bare)
    return eqx.tree_at(_read_result, joined, parts[-1].result, is_leaf=lambda x: x is None)


def _cut_trajectory(trajectory: Trajectory, count: int) -> Trajectory:
    bare = eqx.tree_at(_read_result, trajectory, None)
    bare = jax.tree.map(lambda x: np.asarray(x)[:count], bare)
    return eqx.tree_at(_read_result, bare, trajectory.result, is_leaf=lambda x: x is None)
