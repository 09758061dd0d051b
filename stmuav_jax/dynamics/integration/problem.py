"""Problem of an integration: a prepared model and a method, in the terms of diffrax."""

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ...algebra.compiler import MOST_PROGRAMS, kept_jit
from ...checks.errors import SettingError
from ...checks.numbers import floats
from ...checks.shapes import Numbers
from ...mechanics.internal import internal_count, internal_rates, internal_states, with_internal
from ...mechanics.state import State
from ...mechanics.system import System
from ..formulations.base import AbstractFormulation, AbstractModel, Residuals
from ..formulations.stabilisation import AbstractStabilisation
from .closed_over import opened
from .esdirk import NonDenseESDIRK
from .explicit import NonDenseRungeKutta
from .rosenbrock import Rodas5P
from .step_bound import Guard, guard
from .stepping import (
    ProjectedSolver,
    ProjectionLimit,
    StepSizeMemory,
    error_norm,
    own_iterations,
    stage_loop,
)

# Step size control. In comparison with diffrax's defaults (0, 1, 0, 0.9, 10), measured on the
# tracker and the UAV: as many or a few fewer step attempts, a third to half as many of them
# rejected, and errors after 1 s smaller by a factor of 2 to 40.
CONTROL: dict[str, Any] = {
    "pcoeff": 0.4,
    "icoeff": 0.7,
    "dcoeff": 0.0,
    "safety": 0.8,
    "factormax": 5.0,
}

# Fields of a method that become arrays, so that other values need no other compilation.
NUMBERS = ("rtol", "atol", "first_step", "max_step")

Event = Callable[[Float[Array, ""], State], Array]


class AbstractMethod(eqx.Module):
    """Fields of a method that integration uses; `Method` has their meanings and defaults."""

    formulation: eqx.AbstractVar[AbstractFormulation]
    solver: eqx.AbstractVar[diffrax.AbstractSolver | Literal["auto"]]
    rtol: eqx.AbstractVar[float | Float[Array, ""]]
    atol: eqx.AbstractVar[float | Float[Array, ""]]
    stabilisation: eqx.AbstractVar[AbstractStabilisation]
    first_step: eqx.AbstractVar[float | Float[Array, ""]]
    max_steps: eqx.AbstractVar[int]
    adjoint: eqx.AbstractVar[diffrax.AbstractAdjoint]
    event: eqx.AbstractVar[Event | None]
    direction: eqx.AbstractVar[bool | None]
    jump_ts: eqx.AbstractVar[Numbers | None]
    balances: eqx.AbstractVar[bool]
    steps: eqx.AbstractVar[Literal["sensitivities", "state"]]
    max_step: eqx.AbstractVar[float | Float[Array, ""]]


class Counts(eqx.Module):
    """Numbers of steps so far.

    Attributes:
        accepted, rejected: steps accepted and rejected by their error estimates.
        at_growth_limit: accepted steps whose error was so far below the tolerance that the next step
            could grow by the largest factor: their length was not chosen by the error.
    """

    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    at_growth_limit: Int[Array, ""]


class IntegrationState(eqx.Module):
    """State of an integration, sufficient to continue it bit for bit, with the next `step` [s]."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    step: Float[Array, ""]
    solver_state: Any
    controller_state: Any
    counts: Counts
    result: diffrax.RESULTS

    @property
    def worst(self) -> Residuals:
        """Largest residuals at any accepted step."""
        return self.solver_state[1]


class SegmentEnd(NamedTuple):
    """End of an integration to one output time, with its own numbers of steps; see `IntegrationState`."""

    t: Float[Array, ""]
    y: Float[Array, " k"]
    solver_state: Any
    controller_state: Any
    accepted: Int[Array, ""]
    rejected: Int[Array, ""]
    result: diffrax.RESULTS


# These functions are jitted in order to be traced once only; otherwise the same equations
# would be traced again at every place where diffrax calls them.
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


def at_internal(model: AbstractModel, z: Float[Array, " m"]) -> Any:
    """Prepared model with the internal states of its system's force elements set to z."""
    return eqx.tree_at(lambda m: m.system, model, with_internal(model.system, z))


class Problem(eqx.Module):
    """Prepared model and method in the form that diffrax needs.

    The vector y has the `n_state` entries of the formulation's x, then the `n_internal` internal
    states of force elements, then, if the method has `balances`, work and impulse.
    """

    model: AbstractModel
    method: AbstractMethod
    floating: bool = eqx.field(static=True)
    n_state: int = eqx.field(static=True)
    n_internal: int = eqx.field(static=True)

    def field(self, t: Any, y: Any, args: Any) -> Float[Array, " k"]:
        """Right-hand side y': rates of x and of internal states, flows of energy and momentum."""
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
        """Model with the choices that are made once for a step that starts at y."""
        t, x = jnp.asarray(t, y.dtype), y[: self.n_state]
        return _at_step(self.method.formulation, args, t, x)

    def solver(self) -> ProjectedSolver:
        """Solver of the method, with stabilisation of the constraints."""
        iterations = self.method.stabilisation.iterations_after_step()
        formulation, n = self.method.formulation, self.n_state

        def project(t: Any, y: Any, args: Any) -> Any:
            x, left = _project(formulation, args, jnp.asarray(t, y.dtype), y[:n], iterations)
            return jnp.concatenate([x, y[n:]]), jax.lax.stop_gradient(left)

        def residuals(t: Any, y: Any, args: Any) -> Residuals:
            now = _residuals(formulation, args, jnp.asarray(t, y.dtype), y[:n])
            return jax.lax.stop_gradient(now)

        inner: Any = self.method.solver
        if isinstance(inner, diffrax.AbstractERK) and self.method.event is None:
            inner = NonDenseRungeKutta(inner)
        if self.method.event is None and own_iterations(inner):
            size = n + self.n_internal
            own: Any = inner
            inner = NonDenseESDIRK(own, self.method.rtol, self.method.atol, size)
        if isinstance(inner, Rodas5P):
            inner = Rodas5P(n + self.n_internal)
        inner = stage_loop(inner, self.method.adjoint)
        held = project if iterations else None
        far = ProjectionLimit(self.method.rtol, self.method.atol, n) if held is not None else None
        return ProjectedSolver(inner, held, residuals, self.at_step, far, self._guard())

    def _guard(self) -> Guard | None:
        if self.method.steps == "state":
            return None
        tolerance = jnp.maximum(self.method.rtol, self.method.atol)
        solver: Any = self.method.solver
        return guard(solver, tolerance, self.n_state + self.n_internal)

    def controller(self, step: Float[Array, ""]) -> StepSizeMemory:
        """Step size controller by the local error of the state, with the first step [s]."""
        return StepSizeMemory(  # pyright: ignore[reportCallIssue]
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
        carry: IntegrationState,
        t1: Float[Array, ""],
        adjoint: diffrax.AbstractAdjoint,
        *,
        max_steps: int | None = None,
        dense: bool = False,
        event: diffrax.Event | None = None,
    ) -> diffrax.Solution:
        """Integrate from the carry to t1 [s], where the last step ends; `dense` keeps all steps."""
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
            # the solver's evaluation at the end of a step is invalid after a jump
            made_jump=self.method.jump_ts is not None,
        )


def landing(solution: diffrax.Solution) -> SegmentEnd:
    """End of a solution by diffrax."""
    assert solution.ts is not None
    assert solution.ys is not None
    steps = (solution.stats["num_accepted_steps"], solution.stats["num_rejected_steps"])
    states = (solution.solver_state, solution.controller_state)
    return SegmentEnd(solution.ts[0], solution.ys[0], *states, *steps, solution.result)


def _as_arrays(event: Any) -> Any:
    """Event with its numbers as arrays, so that other numbers need no other compilation."""
    number = lambda x: isinstance(x, float | np.floating | np.ndarray)
    return jax.tree.map(lambda x: floats(x) if number(x) else x, event)


def prepare(system: System, method: AbstractMethod) -> Problem:
    """Prepare a problem: all that does not depend on the state.

    Raises:
        SettingError: the method's solver is "auto", which only `simulate` can choose.
    """
    if isinstance(method.solver, str):
        raise SettingError(
            'The solver "auto" is for simulate, which sees the values of the start. Elsewhere give '
            "Method(solver=choose_solver(system, state))."
        )
    numbers = {k: floats(getattr(method, k)) for k in NUMBERS}
    if method.jump_ts is not None:
        numbers["jump_ts"] = floats(method.jump_ts)
    method = dataclasses.replace(method, **numbers)
    # numbers that functions close over become leaves, so that they can be differentiated
    system, method = opened((system, method))
    method = eqx.tree_at(
        lambda m: m.event, method, _as_arrays(method.event), is_leaf=lambda x: x is None
    )
    model = method.formulation.prepare(system)
    n_state = _vector_size(method.formulation, model, system.reference)
    return Problem(model, method, system.floating, n_state, internal_count(system))


def _vector_size(formulation: AbstractFormulation, model: AbstractModel, state: State) -> int:
    """Number of entries of the formulation's vector.

    It follows from structure and shapes, and tracing takes longer than a short run: once for each.
    """
    leaves, structure = jax.tree.flatten((formulation, model, state))
    shape = lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype) if eqx.is_array(x) else x
    return _traced_size(structure, tuple(map(shape, leaves)))


@lru_cache(maxsize=MOST_PROGRAMS)
def _traced_size(structure: Any, leaves: tuple[Any, ...]) -> int:
    formulation, model, state = jax.tree.unflatten(structure, leaves)
    return eqx.filter_eval_shape(formulation.to_vector, model, state).shape[0]


def begin(problem: Problem, t0: Float[Array, ""], state0: State) -> IntegrationState:
    """Initial carry of an integration at t0 [s]."""
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
    # as arrays, so that the initial and the later controller states have the same structure
    controller_state = jax.tree.map(jnp.asarray, controller_state)
    none = jnp.zeros((), int)
    return IntegrationState(
        t0,
        y,
        step,
        solver_state,
        controller_state,
        Counts(none, none, none),
        diffrax.RESULTS.successful,
    )


# Eager calls of this do not compile again for a system of the same structure.
compiled_begin = kept_jit(begin)
