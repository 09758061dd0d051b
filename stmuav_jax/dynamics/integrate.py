"""From a state to a trajectory: one pure function on top of diffrax.

Output times are reached by steps, not by interpolation between them: diffrax's dense output
is of lower order than its steps. Work and impulse are integrated beside the state for the energy and momentum
balances; they do not steer the step size.
"""

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nextafter, nondifferentiable_backward, prevbefore
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .adjoint import recordable, recorded
from .events import to_event
from .formulation import Residuals
from .modes import EVERY
from .problem import Carry, Counts, Landing, Method, Problem, begin, landing, prepare

# Step attempts kept at a time for reverse mode, some hundred numbers each, shared out among the
# output times.
KEPT = 4096


AHEAD = (
    "A run with Method(adjoint=diffrax.ForwardMode()) cannot be differentiated in reverse mode: leave "
    "`adjoint` out for jax.grad, or use jax.jacfwd, also for derivatives of its own derivatives."
)


class Trajectory(eqx.Module):
    """States at the output times.

    Attributes:
        ts: times reached (k,) [s]; after an event or a failure, the time where it stopped.
        states: (k, n, .), see `State`; not numbers at times that a failed run did not reach.
        work: done so far by forces without potential and by drivers (k,) [J]; zero, like
            the impulse, where the method has no `balances`.
        impulse: linear and angular (about the world's origin) so far (k, 6) [N s], [N m s];
            zero for systems on ground.
        internal: states of forces that have any (k, m), see `internal_names`.
        counts: accepted and rejected steps so far, each (k,).
        worst: largest constraint residuals at any accepted step so far, each (k,).
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


def _adjoint(problem: Problem, segments: int) -> diffrax.AbstractAdjoint | int:
    """The method's; by default how many steps to keep in each of so many segments."""
    adjoint = problem.method.adjoint
    if not isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) or adjoint.checkpoints:
        return adjoint
    count = min(problem.method.max_steps, max(KEPT // max(segments, 1), 64))
    return count if recordable(problem) else diffrax.RecursiveCheckpointAdjoint(checkpoints=count)


def _to(
    problem: Problem, carry: Carry, t1: Float[Array, ""], adjoint: diffrax.AbstractAdjoint | int
) -> Landing:
    """Integrate from the carry to t1, or to an event before it."""
    if isinstance(adjoint, int):
        return recorded(problem, carry, t1, adjoint)
    if problem.method.event is not None:
        return to_event(problem, carry, t1, adjoint)
    return landing(problem.solve(carry, t1, adjoint))


def advance(problem: Problem, carry: Carry, ts: Float[Array, " k"]) -> tuple[Carry, Trajectory]:
    """Go on to each of the times ts [s] in turn; after a failure or an event, stay there."""
    jumps = problem.method.jump_ts
    if jumps is None:
        # the first output time is where it starts: nothing to keep there
        end, rows = _through(problem, carry, ts, ts.shape[0] - 1)
        return end, _trajectory(problem, end, rows)
    # the times of jumps among the output times; at the same time outputs come first
    merged = jnp.concatenate([ts, jnp.asarray(jumps)])
    order = jnp.argsort(merged)
    end, rows = _through(problem, carry, (merged[order], order >= ts.shape[0]), len(merged) - 1)
    rows = jax.tree.map(lambda x: x[jnp.argsort(order)[: ts.shape[0]]], rows)
    # an output time at a jump is reached just before it
    reached = jnp.where(rows[0] == prevbefore(ts), ts, rows[0])
    return end, _trajectory(problem, end, (reached, *rows[1:]))


def _past(carry: Carry, jump: Float[Array, ""]) -> Carry:
    """The carry right after a jump that it has come to."""
    at = (carry.t == prevbefore(jump)) | (carry.t == jump)
    at = at & (carry.result == diffrax.RESULTS.successful)
    carry = eqx.tree_at(lambda c: c.t, carry, jnp.where(at, nextafter(jump), carry.t))
    inner, worst, *modes = carry.solver_state
    # the modes may be others now
    modes = [now._replace(age=jnp.where(at, EVERY, now.age)) for now in modes]
    return eqx.tree_at(lambda c: c.solver_state, carry, (inner, worst, *modes))


def _through(
    problem: Problem, carry: Carry, ts: Any, segments: int
) -> tuple[Carry, tuple[Any, ...]]:
    """Through times [s], or through pairs of time and whether it is that of a jump."""
    adjoint = _adjoint(problem, segments)
    jumps = problem.method.jump_ts
    last = None if jumps is None else jnp.max(jnp.where(ts[1], -jnp.inf, ts[0]))

    def to_next(carry: Carry, t1: Any) -> tuple[Carry, Any]:
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
        after = Carry(
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


def _trajectory(problem: Problem, end: Carry, rows: tuple[Any, ...]) -> Trajectory:
    """From what was reached at the output times."""
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


def integrate(
    system: System, state0: State, ts: Float[Array, " k"], method: Method | None = None
) -> Trajectory:
    """Integrate a system from state0 at ts[0] through the output times ts.

    Pure: may be jitted, vmapped and differentiated. It assumes a consistent start (see
    `assemble`) and raises nothing for values: look at `Trajectory.result`. `simulate` is
    the same with checks, progress and a certificate. What a failed run did not reach, and its
    derivatives, are not numbers: a sum over flights shows it. A run that ended at an event
    keeps the state there.

    Args:
        system: bodies, joints, forces.
        state0: at ts[0], unbatched.
        ts: output times (k,) [s], increasing, the start among them.
        method: how to integrate.

    Raises:
        SettingError: shapes or precision of the state do not fit the system.
    """
    check_state(system, state0)
    problem = prepare(system, method if method is not None else Method())
    ts = jnp.asarray(ts, dtype=state0.r.dtype)
    start = compiled_begin(problem, ts[0], state0)
    found = _compiled_path(problem, start, ts)
    if isinstance(problem.method.adjoint, diffrax.ForwardMode):
        return nondifferentiable_backward(found, msg=AHEAD)
    return found


def _marked(found: Trajectory, ts: Float[Array, " k"]) -> Trajectory:
    """Not numbers, and no derivatives, where a run that failed did not come."""
    fine = found.result == diffrax.RESULTS.successful
    fine = fine | (found.result == diffrax.RESULTS.event_occurred)
    missed = ~fine & (jax.lax.stop_gradient(found.ts) < ts)
    # a product, so that the derivatives are marked too
    factor = jnp.where(missed, jnp.nan, 1.0)
    mark = lambda x: x * factor.reshape(-1, *(1,) * (x.ndim - 1)).astype(x.dtype)
    where = lambda path: (path.states, path.work, path.impulse, path.internal)
    return eqx.tree_at(where, found, jax.tree.map(mark, where(found)))


def _path(problem: Problem, start: Carry, ts: Float[Array, " k"]) -> Trajectory:
    return _marked(advance(problem, start, ts)[1], ts)


# Called eagerly, neither compiles again for a system of the same structure.
compiled_begin = kept_jit(begin)
_compiled_path = kept_jit(_path)
