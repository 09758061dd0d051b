"""Integration of a state to a trajectory: one pure function on top of diffrax."""

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from equinox.internal import nondifferentiable_backward
from jaxtyping import Array, Float

from ..algebra.compiler import kept_jit
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .integration.advance import Trajectory, advance
from .integration.problem import AbstractMethod, IntegrationState, Problem, compiled_begin, prepare
from .method import Method

AHEAD = (
    "A run with Method(adjoint=diffrax.ForwardMode()) cannot be differentiated in reverse mode: leave "
    "`adjoint` out for jax.grad, or use jax.jacfwd, also for derivatives of its own derivatives."
)


def integrate(
    system: System, state0: State, ts: Float[Array, " k"], method: AbstractMethod | None = None
) -> Trajectory:
    """Integrate a system from state0 at ts[0] through the output times ts.

    The function is pure: it may be jitted, vmapped and differentiated. It assumes a consistent
    start (see `assemble`) and raises no error for values: `Trajectory.result` holds the outcome.
    `simulate` adds checks, progress and a certificate. Times that a failed run did not reach have
    NaN states and derivatives, so that a sum over runs reveals it. A run that ended at an event
    keeps the state there.

    Args:
        system: bodies, joints, forces.
        state0: state at ts[0], unbatched.
        ts: output times (k,) [s], increasing, beginning with the start.
        method: method of integration; default `Method()`.

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
    """Trajectory with NaN values and derivatives at times that a failed run did not reach."""
    fine = found.result == diffrax.RESULTS.successful
    fine = fine | (found.result == diffrax.RESULTS.event_occurred)
    missed = ~fine & (jax.lax.stop_gradient(found.ts) < ts)
    # multiplication also marks the derivatives
    factor = jnp.where(missed, jnp.nan, 1.0)
    mark = lambda x: x * factor.reshape(-1, *(1,) * (x.ndim - 1)).astype(x.dtype)
    where = lambda path: (path.states, path.work, path.impulse, path.internal)
    return eqx.tree_at(where, found, jax.tree.map(mark, where(found)))


def _path(problem: Problem, start: IntegrationState, ts: Float[Array, " k"]) -> Trajectory:
    return _marked(advance(problem, start, ts)[1], ts)


# An eager call does not compile again for a system of the same structure.
_compiled_path = kept_jit(_path)
