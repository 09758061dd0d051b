"""From a state to a trajectory: one pure function on top of diffrax.

Output times are reached by steps, not by interpolation between them: diffrax's dense output
is of lower order than its steps. Work and impulse are integrated beside the state for the energy and momentum
balances; they do not steer the step size.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float, Int

from ..mechanics.internal import (
    internal_count,
    internal_rates,
    internal_states,
    with_internal,
)
from ..mechanics.state import State
from ..mechanics.system import System, check_state
from .explicit import Lean
from .formulation import AbstractFormulation, Residuals
from .solvers import Remembering, Stabilised, error_norm, stage_loop
from .stabilisation import AbstractStabilisation, Projection
from .tree import Tree

# Measured on the tracker and the UAV: against diffrax's defaults (0, 1, 0, 0.9, 10) as many or
# a few fewer step attempts, a third to half as many of them rejected, and errors after 1 s
# smaller by a factor of 2 to 40.
CONTROL: dict[str, Any] = {
    "pcoeff": 0.4,
    "icoeff": 0.7,
    "dcoeff": 0.0,
    "safety": 0.8,
    "factormax": 5.0,
}

# Steps kept for reverse mode, some hundred numbers each, shared out among the output times.
KEPT = 4096

Event = Callable[[Float[Array, ""], State], Array]


class Method(eqx.Module):
    """How to integrate: everything but the system, its state and the output times.

    Args:
        formulation: of the equations of motion.
        solver: any diffrax solver with an error estimate.
        rtol, atol: tolerances of a step, on positions [m], Euler parameters, velocities
            [m/s] and angular velocities [rad/s] alike.
        stabilisation: of the constraints.
        first_step: [s].
        max_steps: accepted and rejected steps between two output times.
        adjoint: how reverse-mode derivatives are taken; see diffrax. By default every step is
            kept, up to `KEPT` of them over all output times; beyond that steps are done
            again on the way back. Adaptive steps done again differ by round-off in their
            sizes, which costs a gradient digits: give
            `diffrax.RecursiveCheckpointAdjoint(checkpoints=...)` more than there are steps.
        event: (t, state) -> a number whose change of sign ends the integration, at that
            time; or a truth value, which ends it after the first step that makes it true.
        balances: integrate work and impulse beside the state, for the balances of energy
            and momentum; about a tenth more to compute.
    """

    formulation: AbstractFormulation = Tree()
    solver: diffrax.AbstractSolver = diffrax.Dopri8()
    rtol: float | Float[Array, ""] = 1e-8
    atol: float | Float[Array, ""] = 1e-8
    stabilisation: AbstractStabilisation = Projection()
    first_step: float | Float[Array, ""] = 1e-4
    max_steps: int = eqx.field(static=True, default=100_000)
    adjoint: diffrax.AbstractAdjoint = diffrax.RecursiveCheckpointAdjoint()
    event: Event | None = None
    balances: bool = eqx.field(static=True, default=False)


class Counts(eqx.Module):
    """Steps taken so far."""

    accepted: Int[Array, ""]
    rejected: Int[Array, ""]


class Carry(eqx.Module):
    """Where an integration stands: enough to go on from, bit for bit."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    step: Float[Array, ""]
    solver_state: Any
    controller_state: Any
    counts: Counts
    result: diffrax.RESULTS

    @property
    def worst(self) -> Residuals:
        """The largest residuals at any accepted step."""
        return self.solver_state[1]


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


# Traced once and called from several places; without this the same equations are traced
# again at every place where diffrax calls them.
@eqx.filter_jit
def _derivative(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.derivative(*args)


@eqx.filter_jit
def _project(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.project(*args)


@eqx.filter_jit
def _residuals(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.residuals(*args)


@eqx.filter_jit
def _internal_rates(formulation: AbstractFormulation, model: Any, t: Any, x: Any) -> Any:
    system: System = model.system
    return internal_rates(system, t, system.kinematics(formulation.to_state(model, x)))


def at_internal(model: Any, z: Float[Array, " m"]) -> Any:
    """A prepared model with the states of its system's forces set to z."""
    return eqx.tree_at(lambda m: m.system, model, with_internal(model.system, z))


class Problem(eqx.Module):
    """A prepared model and a method, as diffrax needs them."""

    model: Any
    method: Method
    floating: bool = eqx.field(static=True)
    n_state: int = eqx.field(static=True)
    n_internal: int = eqx.field(static=True)

    def field(self, t: Any, y: Any, args: Any) -> Float[Array, " k"]:
        """y': the formulation's x', the forces' own states', the flows of energy and momentum."""
        how, formulation = self.method.stabilisation, self.method.formulation
        t, x = jnp.asarray(t, y.dtype), y[: self.n_state]
        if self.n_internal:
            z = y[self.n_state : self.n_state + self.n_internal]
            args = at_internal(args, z)
        rate, flows = _derivative(formulation, args, t, x, how)
        parts = [rate]
        if self.n_internal:
            parts.append(_internal_rates(formulation, args, t, x))
        if not self.method.balances:
            return jnp.concatenate(parts) if self.n_internal else rate
        parts.append(flows.power[None])
        if self.floating:
            parts += [flows.force, flows.moment]
        return jnp.concatenate(parts)

    def solver(self) -> Stabilised:
        """The method's solver, with the constraints held."""
        how = self.method.stabilisation
        formulation, n = self.method.formulation, self.n_state

        def project(t: Any, y: Any, args: Any) -> Any:
            x, left = _project(formulation, args, jnp.asarray(t, y.dtype), y[:n], how.iterations)  # pyright: ignore
            return jnp.concatenate([x, y[n:]]), jax.lax.stop_gradient(left)

        def residuals(t: Any, y: Any, args: Any) -> Residuals:
            now = _residuals(formulation, args, jnp.asarray(t, y.dtype), y[:n])
            return jax.lax.stop_gradient(now)

        inner: Any = self.method.solver
        if isinstance(inner, diffrax.AbstractERK) and self.method.event is None:
            inner = Lean(inner)
        inner = stage_loop(inner, self.method.adjoint)
        return Stabilised(inner, project if isinstance(how, Projection) else None, residuals)

    def controller(self, step: Float[Array, ""]) -> Remembering:
        """Step size control by the local error of the state, to start with `step` [s]."""
        return Remembering(  # pyright: ignore[reportCallIssue]
            controller=diffrax.PIDController(
                rtol=self.method.rtol,
                atol=self.method.atol,
                norm=error_norm(self.n_state + self.n_internal),
                **CONTROL,
            ),
            step=step,
        )


def prepare(system: System, method: Method) -> Problem:
    """Gather what does not change with the state."""
    # as arrays, so that other tolerances do not mean another compilation
    numbers = {k: jnp.asarray(getattr(method, k), float) for k in ("rtol", "atol", "first_step")}
    method = dataclasses.replace(method, **numbers)
    model = method.formulation.prepare(system)
    n_state = eqx.filter_eval_shape(method.formulation.to_vector, model, system.reference).shape[0]
    return Problem(model, method, system.floating, n_state, internal_count(system))


def begin(problem: Problem, t0: Float[Array, ""], state0: State) -> Carry:
    """The start of an integration at t0 [s]."""
    x = problem.method.formulation.to_vector(problem.model, state0)
    extra = (7 if problem.floating else 1) if problem.method.balances else 0
    own = [internal_states(problem.model.system)] if problem.n_internal else []
    y = jnp.concatenate([x, *own, jnp.zeros(extra, x.dtype)])
    step = jnp.asarray(problem.method.first_step, dtype=y.dtype)
    solver, controller = problem.solver(), problem.controller(step).wrap(1)
    terms = diffrax.ODETerm(problem.field)
    solver_state = solver.init(terms, t0, t0 + step, y, problem.model)
    _, controller_state = controller.init(
        terms, t0, t0 + step, y, None, problem.model, solver.func, solver.error_order(terms)
    )
    # as arrays, so that the start and what it becomes have the same structure
    controller_state = jax.tree.map(jnp.asarray, controller_state)
    none = jnp.zeros((), int)
    return Carry(
        t0, y, step, solver_state, controller_state, Counts(none, none), diffrax.RESULTS.successful
    )


def _kept(problem: Problem, segments: int) -> Problem:
    """With the default adjoint told how many steps to keep in each of so many segments."""
    adjoint = problem.method.adjoint
    if not isinstance(adjoint, diffrax.RecursiveCheckpointAdjoint) or adjoint.checkpoints:
        return problem
    count = min(problem.method.max_steps, max(KEPT // max(segments, 1), 64))
    adjoint = diffrax.RecursiveCheckpointAdjoint(checkpoints=count)
    return dataclasses.replace(problem, method=dataclasses.replace(problem.method, adjoint=adjoint))


def _segment(problem: Problem, carry: Carry, t1: Float[Array, ""], event: bool) -> diffrax.Solution:
    """Integrate from the carry to t1, landing on it."""
    method = problem.method
    watch = None
    if event and method.event is not None:
        condition = method.event

        def cond_fn(t: Any, y: Any, args: Any, **_: Any) -> Array:
            return condition(t, method.formulation.to_state(args, y[: problem.n_state]))

        kind = jax.eval_shape(lambda: cond_fn(carry.t, carry.y, problem.model)).dtype
        finder = None if kind == jnp.bool_ else optx.Bisection(rtol=1e-12, atol=1e-14)
        watch = diffrax.Event(cond_fn, finder)
    return diffrax.diffeqsolve(
        diffrax.ODETerm(problem.field),
        problem.solver(),
        carry.t,
        t1,
        None,
        carry.y,
        problem.model,
        saveat=diffrax.SaveAt(t1=True, solver_state=True, controller_state=True),
        stepsize_controller=problem.controller(carry.step),
        adjoint=method.adjoint,
        max_steps=method.max_steps,
        event=watch,
        throw=False,
        solver_state=carry.solver_state,
        controller_state=carry.controller_state,
    )


def _outcome(solution: diffrax.Solution) -> tuple[Any, ...]:
    """Time, y, solver and controller state, accepted and rejected steps at a segment's end."""
    assert solution.ts is not None
    assert solution.ys is not None
    steps = (solution.stats["num_accepted_steps"], solution.stats["num_rejected_steps"])
    states = (solution.solver_state, solution.controller_state)
    return (solution.ts[0], solution.ys[0], *states, *steps)


def advance(problem: Problem, carry: Carry, ts: Float[Array, " k"]) -> tuple[Carry, Trajectory]:
    """Go on to each of the times ts [s] in turn; after a failure or an event, stay there."""
    problem = _kept(problem, ts.shape[0])

    def to_next(carry: Carry, t1: Float[Array, ""]) -> tuple[Carry, Any]:
        fine = carry.result == diffrax.RESULTS.successful
        target = jnp.where(fine, t1, carry.t)
        solution = _segment(problem, carry, target, event=True)
        outcome = _outcome(solution)
        if problem.method.event is not None:
            # the event's time comes from interpolation; the state there from steps
            outcome = jax.lax.cond(
                solution.result == diffrax.RESULTS.event_occurred,
                lambda: _outcome(_segment(problem, carry, outcome[0], event=False)),
                lambda: outcome,
            )
        t, y, solver_state, controller_state, accepted, rejected = outcome
        counts = Counts(carry.counts.accepted + accepted, carry.counts.rejected + rejected)
        after = Carry(
            t=t,
            y=y,
            step=controller_state[0],
            solver_state=solver_state,
            controller_state=controller_state,
            counts=counts,
            result=diffrax.RESULTS.where(fine, solution.result, carry.result),
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
    start = begin(problem, ts[0], state0)
    return advance(problem, start, ts)[1]
