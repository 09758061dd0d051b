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
import optimistix as optx
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .adjoint import recordable, recorded
from .formulation import Residuals
from .problem import Carry, Counts, Landing, Method, Problem, begin, landing, prepare

# Steps kept for reverse mode, some hundred numbers each, shared out among the output times.
KEPT = 4096


class Trajectory(eqx.Module):
    """States at the output times.

    Attributes:
        ts: times reached (k,) [s]; after an event or a failure, the time where it stopped.
        states: (k, n, .), see `State`.
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
    condition = problem.method.event
    if condition is None:
        return landing(problem.solve(carry, t1, adjoint))

    def cond_fn(t: Any, y: Any, args: Any, **_: Any) -> Array:
        return condition(t, problem.method.formulation.to_state(args, y[: problem.n_state]))

    kind = jax.eval_shape(lambda: cond_fn(carry.t, carry.y, problem.model)).dtype
    finder = None if kind == jnp.bool_ else optx.Bisection(rtol=1e-12, atol=1e-14)
    found = landing(problem.solve(carry, t1, adjoint, event=diffrax.Event(cond_fn, finder)))
    # the event's time comes from interpolation; the state there from steps
    again = jax.lax.cond(
        found.result == diffrax.RESULTS.event_occurred,
        lambda: landing(problem.solve(carry, found.t, adjoint)),
        lambda: found,
    )
    return again._replace(result=found.result)


def advance(problem: Problem, carry: Carry, ts: Float[Array, " k"]) -> tuple[Carry, Trajectory]:
    """Go on to each of the times ts [s] in turn; after a failure or an event, stay there."""
    adjoint = _adjoint(problem, ts.shape[0])

    def to_next(carry: Carry, t1: Float[Array, ""]) -> tuple[Carry, Any]:
        fine = carry.result == diffrax.RESULTS.successful
        found = _to(problem, carry, jnp.where(fine, t1, carry.t), adjoint)
        counts = Counts(
            carry.counts.accepted + found.accepted, carry.counts.rejected + found.rejected
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
        return after, (after.t, after.y, counts, after.worst)

    end, (reached, ys, counts, worst) = jax.lax.scan(to_next, carry, ts)
    first = problem.n_state
    n = first + problem.n_internal
    to_state = lambda y: problem.method.formulation.to_state(problem.model, y[:first])
    work, impulse = jnp.zeros_like(reached), jnp.zeros((ys.shape[0], 6), ys.dtype)
    if problem.method.balances:
        work = ys[:, n]
        impulse = ys[:, n + 1 :] if problem.floating else impulse
    states = jax.vmap(to_state)(ys)
    own = ys[:, first:n]
    return end, Trajectory(reached, states, work, impulse, own, counts, worst, end.result)


def integrate(
    system: System, state0: State, ts: Float[Array, " k"], method: Method | None = None
) -> Trajectory:
    """Integrate a system from state0 at ts[0] through the output times ts.

    Pure: may be jitted, vmapped and differentiated. It assumes a consistent start (see
    `assemble`) and raises nothing for values: look at `Trajectory.result`. `simulate` is
    the same with checks, progress and a certificate.

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
    return compiled_advance(problem, start, ts)[1]


# Called eagerly, neither compiles again for a system of the same structure.
compiled_begin = kept_jit(begin)
compiled_advance = kept_jit(advance)
