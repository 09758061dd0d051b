"""Integration from output time to output time, through events and jumps of the forces.

Steps end at the output times, without interpolation, because diffrax's dense output is of lower
order than its steps. Work and impulse are integrated beside the state for the energy and momentum
balances; they do not enter the control of the step size.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nextafter, prevbefore
from jaxtyping import Array, Float

from ...mechanics.state import State
from ..formulations.base import Residuals
from .adjoint import DiscreteAdjoint, recorded
from .events import to_event
from .problem import Counts, IntegrationState, Problem, SegmentEnd, landing
from .record import RecordRoom
from .step_bound import EVERY


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


def _to(
    problem: Problem,
    carry: IntegrationState,
    t1: Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint | RecordRoom,
) -> SegmentEnd:
    """Integrate from the carry to t1 [s], or to an event before it."""
    if isinstance(adjoint, RecordRoom):
        return recorded(problem, carry, t1, adjoint)
    if problem.method.event is not None:
        return to_event(problem, carry, t1, adjoint)
    return landing(problem.solve(carry, t1, adjoint))


def advance(
    problem: Problem, carry: IntegrationState, ts: Float[Array, " k"]
) -> tuple[IntegrationState, Trajectory]:
    """Integrate to each of the times ts [s] in turn; after a failure or an event, stay there."""
    jumps = problem.method.jump_ts
    if jumps is None:
        # the first output time is the start, which takes no steps
        end, rows = _through(problem, carry, ts, ts.shape[0] - 1)
        return end, _trajectory(problem, end, rows)
    # merge the times of jumps into the output times; outputs come first at equal times
    merged = jnp.concatenate([ts, jnp.asarray(jumps)])
    order = jnp.argsort(merged)
    end, rows = _through(problem, carry, (merged[order], order >= ts.shape[0]), len(merged) - 1)
    rows = jax.tree.map(lambda x: x[jnp.argsort(order)[: ts.shape[0]]], rows)
    # an output time at a jump is reached just before it
    reached = jnp.where(rows[0] == prevbefore(ts), ts, rows[0])
    return end, _trajectory(problem, end, (reached, *rows[1:]))


def _past(carry: IntegrationState, jump: Float[Array, ""]) -> IntegrationState:
    """Carry right after a jump, if it has reached the jump."""
    at = (carry.t == prevbefore(jump)) | (carry.t == jump)
    at = at & (carry.result == diffrax.RESULTS.successful)
    carry = eqx.tree_at(lambda c: c.t, carry, jnp.where(at, nextafter(jump), carry.t))
    inner, worst, *modes = carry.solver_state
    # the modes may differ after the jump and are computed again
    modes = [now._replace(age=jnp.where(at, EVERY, now.age)) for now in modes]
    return eqx.tree_at(lambda c: c.solver_state, carry, (inner, worst, *modes))


def _through(
    problem: Problem, carry: IntegrationState, ts: Any, segments: int
) -> tuple[IntegrationState, tuple[Any, ...]]:
    """Integrate through times [s], or pairs of a time and True if it is that of a jump."""
    adjoint: Any = problem.method.adjoint
    if isinstance(adjoint, DiscreteAdjoint):
        adjoint = adjoint.of(problem, segments)
    jumps = problem.method.jump_ts
    last = None if jumps is None else jnp.max(jnp.where(ts[1], -jnp.inf, ts[0]))

    def to_next(carry: IntegrationState, t1: Any) -> tuple[IntegrationState, Any]:
        fine = carry.result == diffrax.RESULTS.successful
        goal, jumping = (t1, False) if jumps is None else t1
        if jumps is not None:
            t1 = jnp.where(jnp.any(goal == jumps), prevbefore(goal), goal)
            t1 = jnp.where((jumping & (goal > last)) | (t1 < carry.t), carry.t, t1)
        found = _to(problem, carry, jnp.where(fine, t1, carry.t), adjoint)
        counts = Counts(
            carry.counts.accepted + found.accepted,
            carry.counts.rejected + found.rejected,
            found.controller_state[2],
        )
        after = IntegrationState(
            t=found.t,
            y=found.y,
            step=found.controller_state[0],
            solver_state=found.solver_state,
            controller_state=found.controller_state,
            counts=counts,
            result=diffrax.RESULTS.where(fine, found.result, carry.result),
        )
        row = (after.t, after.y, counts, after.worst)
        if jumps is not None:
            after = jax.lax.cond(jumping, lambda: _past(after, goal), lambda: after)
        return after, row

    return jax.lax.scan(to_next, carry, ts)


def _trajectory(problem: Problem, end: IntegrationState, rows: tuple[Any, ...]) -> Trajectory:
    """Trajectory from the rows (time, y, counts, residuals) at the output times."""
    reached, ys, counts, worst = rows
    first = problem.n_state
    n = first + problem.n_internal
    to_state = lambda y: problem.method.formulation.to_state(problem.model, y[:first])
    work, impulse = jnp.zeros_like(reached), jnp.zeros((ys.shape[0], 6), ys.dtype)
    if problem.method.balances:
        work = ys[:, n]
        impulse = ys[:, n + 1 :] if problem.floating else impulse
    states = jax.vmap(to_state)(ys)
    own = ys[:, first:n]
    return Trajectory(reached, states, work, impulse, own, counts, worst, end.result)
