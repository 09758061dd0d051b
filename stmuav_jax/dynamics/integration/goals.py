"""Goals of an integration: output times, and times of jumps of the forces between them.

Jumps are integrated to like output times: the step before a jump ends at the last number before it and
the next begins at the first after it, so that a force that compares t with the jump is evaluated on the
right side in every stage.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nextafter, prevbefore
from jaxtyping import Array, Bool, Float

from ..formulations.base import Residuals
from .problem import Counts, IntegrationState, Problem, SegmentEnd, continue_from
from .stepping import EVERY


class Goals(NamedTuple):
    """Times (g,) [s] to be reached in turn, and which of them are jumps; None where there is none."""

    times: Float[Array, " g"]
    is_jump: Bool[Array, " g"] | None


class Row(NamedTuple):
    """Integration at its arrival: time [s], y, numbers of steps so far, largest residuals so far."""

    t: Float[Array, "*g"]
    y: Float[Array, "*g k"]
    counts: Counts
    worst: Residuals


class Way(NamedTuple):
    """Way to a goal: time of its start [s], and whether the integration stays there."""

    t0: Float[Array, "*g"]
    stays: Bool[Array, "*g"]


def make_row(carry: IntegrationState) -> Row:
    return Row(carry.t, carry.y, carry.counts, carry.worst)


def pass_goals(
    problem: Problem,
    carry: IntegrationState,
    goals: Goals,
    integrate: Callable[[IntegrationState, Any, Any], tuple[SegmentEnd, Any, Any]],
    memory: Any,
) -> tuple[IntegrationState, Any, tuple[Row, Way, Any]]:
    """Integrate to each goal in turn; after a failure or an event, stay there.

    Args:
        integrate: (carry, time [s], memory) -> end there, memory for the next goal, record of this one.

    Returns:
        End, memory, and for each goal its row, the way to it, and its record.
    """
    jumps, is_jump = problem.method.jump_ts, goals.is_jump
    last = jnp.max(goals.times if is_jump is None else jnp.where(is_jump, -jnp.inf, goals.times))

    def to_next(at: tuple[IntegrationState, Any], goal: Goals) -> tuple[Any, Any]:
        carry, memory = at
        t1, stays = goal.times, carry.result != diffrax.RESULTS.successful
        if goal.is_jump is not None:
            t1 = jnp.where(jnp.any(t1 == jumps), prevbefore(t1), t1)
            # Jumps after the last output time are not gone to, and a time that was passed already
            # is not gone back to.
            stays = stays | (goal.is_jump & (goal.times > last)) | (t1 < carry.t)
        end, memory, record = integrate(carry, jnp.where(stays, carry.t, t1), memory)
        after = continue_from(carry, end)
        row, way = make_row(after), Way(carry.t, stays)
        if goal.is_jump is not None:
            passed = lambda: _pass_jump(after, goal.times)
            after = jax.lax.cond(goal.is_jump, passed, lambda: after)
        return (after, memory), (row, way, record)

    (end, memory), rows = jax.lax.scan(to_next, (carry, memory), goals)
    return end, memory, rows


def reach_goals(
    problem: Problem,
    carry: IntegrationState,
    goals: Goals,
    integrate_to: Callable[[IntegrationState, Any], SegmentEnd],
) -> tuple[IntegrationState, Row]:
    """`pass_goals` without a record: end and rows."""
    integrate = lambda carry, t1, _: (integrate_to(carry, t1), None, None)
    end, _, (rows, *_) = pass_goals(problem, carry, goals, integrate, None)
    return end, rows


def _pass_jump(carry: IntegrationState, jump: Float[Array, ""]) -> IntegrationState:
    """Carry right after a jump, if it has reached the jump."""
    at = (carry.t == prevbefore(jump)) | (carry.t == jump)
    at = at & (carry.result == diffrax.RESULTS.successful)
    carry = eqx.tree_at(lambda c: c.t, carry, jnp.where(at, nextafter(jump), carry.t))
    inner, worst, *modes = carry.solver_state
    # the modes may differ after the jump and are computed again
    modes = [now._replace(age=jnp.where(at, EVERY, now.age)) for now in modes]
    return eqx.tree_at(lambda c: c.solver_state, carry, (inner, worst, *modes))
