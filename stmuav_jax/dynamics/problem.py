"""What is integrated, and how: a prepared model and a method, in the terms of diffrax."""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..algebra.shapes import Numbers
from ..mechanics.internal import (
    internal_count,
    internal_rates,
    internal_states,
    with_internal,
)
from ..mechanics.state import State
from ..mechanics.system import System
from .closures import opened
from .explicit import Lean
from .formulation import AbstractFormulation, Residuals
from .modes import Guard, guard
from .solvers import Far, Remembering, Stabilised, error_norm, stage_loop
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

# Of a method, given as arrays, so that other values do not mean another compilation.
NUMBERS = ("rtol", "atol", "first_step", "max_step")

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
        adjoint: how reverse-mode derivatives are taken. By default an explicit method without
            events keeps accepted steps with their slopes, some 4,096 of them at a time, and goes
            back through them, see `adjoint`; a longer run is kept in windows whose steps are taken
            again on the way back. Anything else is differentiated by diffrax's
            `RecursiveCheckpointAdjoint`, which takes adaptive steps again; they then differ by
            round-off in their sizes, which costs a gradient digits.
        event: (t, state) -> a number whose change of sign ends the integration, at that
            time; or a truth value, which ends it after the first step that makes it true. A run
            that starts where the number is zero starts after that event. An `equinox.Module`
            with numbers as leaves is not compiled again for other numbers. Where it is not a
            number the run ends with the result `diffrax.RESULTS.nonfinite`.
        direction: of the event's change of sign: True upwards, False downwards, None both.
        jump_ts: times at which forces jump (j,) [s]. A step ends just before each, and the
            next begins just after it; a force is not evaluated at the jump itself.
        balances: integrate work and impulse beside the state, for the balances of energy
            and momentum; about a tenth more to compute.
        steps: what their lengths are safe for. "sensitivities", the default: beside the error
            estimate of the state, the modes of the linearised motion bound them, so that
            derivatives by the start and by constant numbers are as accurate at rest as in
            motion; see `modes`. It takes more right-hand sides, eleven every twelve steps. "state": the
            error estimate alone, for runs that nobody differentiates.
        max_step: no step is longer [s]. It is what makes derivatives safe by inputs that are zero
            in the run itself but would vary faster than the system does.
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
    direction: bool | None = eqx.field(static=True, default=None)
    jump_ts: Numbers | None = None
    balances: bool = eqx.field(static=True, default=False)
    steps: Literal["sensitivities", "state"] = eqx.field(static=True, default="sensitivities")
    max_step: float | Float[Array, ""] = float("inf")


class Counts(eqx.Module):
    """Steps taken so far.

    Attributes:
        accepted, rejected: by their error estimates.
        unsteered: accepted with an error so far below the tolerance that the next step was
            allowed to grow as much as a step may: something else chose its length.
    """

    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    unsteered: Int[Array, ""]


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


class Landing(NamedTuple):
    """Where an integration to one output time has come: time, y, solver's and controller's
    states, steps accepted and rejected, diffrax's result."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    solver_state: Any
    controller_state: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
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
def _at_step(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.at_step(*args)


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

    def at_step(self, t: Any, y: Any, args: Any) -> Any:
        """The model with what is chosen once for a step that starts at y."""
        t, x = jnp.asarray(t, y.dtype), y[: self.n_state]
        return _at_step(self.method.formulation, args, t, x)

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
        held = project if isinstance(how, Projection) else None
        far = Far(self.method.rtol, self.method.atol, n) if held is not None else None
        return Stabilised(inner, held, residuals, self.at_step, far, self._guard())

    def _guard(self) -> Guard | None:
        if self.method.steps == "state":
            return None
        tolerance = jnp.maximum(self.method.rtol, self.method.atol)
        return guard(self.method.solver, tolerance, self.n_state + self.n_internal)

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
            longest=jnp.asarray(self.method.max_step, step.dtype),
        )

    def solve(
        self,
        carry: Carry,
        t1: Float[Array, ""],
        adjoint: diffrax.AbstractAdjoint,
        *,
        max_steps: int | None = None,
        dense: bool = False,
        event: diffrax.Event | None = None,
    ) -> diffrax.Solution:
        """Integrate from the carry to t1 [s], landing on it; dense: with all steps kept."""
        return diffrax.diffeqsolve(
            diffrax.ODETerm(self.field),
            self.solver(),
            carry.t,
            t1,
            None,
            carry.y,
            self.model,
            saveat=diffrax.SaveAt(t1=True, dense=dense, solver_state=True, controller_state=True),
            stepsize_controller=self.controller(carry.step),
            adjoint=adjoint,
            max_steps=self.method.max_steps if max_steps is None else max_steps,
            event=event,
            throw=False,
            solver_state=carry.solver_state,
            controller_state=carry.controller_state,
            # what the solver remembers of the end of a step does not hold after a jump
            made_jump=self.method.jump_ts is not None,
        )


def landing(solution: diffrax.Solution) -> Landing:
    """Where a solution has come."""
    assert solution.ts is not None
    assert solution.ys is not None
    steps = (solution.stats["num_accepted_steps"], solution.stats["num_rejected_steps"])
    states = (solution.solver_state, solution.controller_state)
    return Landing(solution.ts[0], solution.ys[0], *states, *steps, solution.result)


def _as_arrays(event: Any) -> Any:
    """An event with its numbers as arrays: other numbers do not mean another compilation."""
    number = lambda x: isinstance(x, float | np.floating | np.ndarray)
    return jax.tree.map(lambda x: jnp.asarray(x, float) if number(x) else x, event)


def prepare(system: System, method: Method) -> Problem:
    """Gather what does not change with the state."""
    numbers = {k: jnp.asarray(getattr(method, k), float) for k in NUMBERS}
    if method.jump_ts is not None:
        numbers["jump_ts"] = jnp.asarray(method.jump_ts, float)
    method = dataclasses.replace(method, **numbers)
    # numbers that functions close over as leaves, where they can be differentiated
    system, method = opened((system, method))
    method = eqx.tree_at(
        lambda m: m.event, method, _as_arrays(method.event), is_leaf=lambda x: x is None
    )
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
        t0,
        y,
        step,
        solver_state,
        controller_state,
        Counts(none, none, none),
        diffrax.RESULTS.successful,
    )
