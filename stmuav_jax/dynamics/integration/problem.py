"""Problem of an integration: a prepared model and a method, in the terms of diffrax.

A force written as `lambda t, kin: jnp.stack([a * jnp.sin(t), 0.0, 0.0])` hides the number a from
JAX's rules for reverse mode. `prepare_problem` replaces such a function by a `Closure`, a callable with
these numbers as leaves, like an `equinox.Module` written for the purpose.
"""

import dataclasses
import functools
import inspect
import types
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...checks.errors import SettingError
from ...checks.numbers import array_module, as_floats
from ...math.compiler import kept_jit
from ...math.native.program import native
from ...mechanics.body import has_positive_masses
from ...mechanics.internal import internal_count, internal_rates, internal_starts, with_internal
from ...mechanics.state import State
from ...mechanics.system import System
from ..choices import FIRST_STEP
from ..formulations.base import AbstractFormulation, AbstractModel, Residuals
from ..formulations.constraints import group_constraints
from ..formulations.independence import longest_arm, open_limit
from ..method import Method
from .solvers import NonDenseESDIRK, NonDenseRungeKutta
from .stepping import (
    Guard,
    ProjectedSolver,
    ProjectionLimit,
    StepSizeMemory,
    error_norm,
    make_guard,
    own_iterations,
    stage_loop,
)


class _Same:
    """Wrapper that equals itself alone, for objects beside numbers that a function closes over."""

    def __init__(self, value: Any) -> None:
        self.value = value


class Closure(eqx.Module):
    """Function whose leaves are the numbers that it closes over or has as defaults.

    Attributes:
        values: numbers by place in the function's closure, or under "defaults" and "keywords".
        function: code, globals, closure and defaults of the function.
    """

    values: dict[str, Any]
    function: _Same = eqx.field(static=True)

    def __call__(self, *args: Any, **more: Any) -> Any:
        code, names, cells, defaults, by_name = self.function.value
        at = self.values
        places = enumerate(cells)
        # A new function with other cells and the same code: the user's own function object is
        # never changed, which another thread may be calling.
        closure = tuple(types.CellType(at[str(k)]) if str(k) in at else c for k, c in places)
        function = types.FunctionType(
            code, names, code.co_name, at.get("defaults", defaults), closure
        )
        function.__kwdefaults__ = at.get("keywords", by_name)
        return function(*args, **more)


def convert_closures(tree: Any) -> Any:
    """Pytree whose functions that close over tracers are replaced by `Closure`s."""
    return jax.tree.map(lambda leaf: _convert_leaf(leaf, ()), tree)


def _convert_leaf(leaf: Any, above: tuple[int, ...]) -> Any:
    """Leaf, or its `Closure`; `above` are functions that close over it, maybe itself."""
    # A recursive function closes over itself: followed without end otherwise.
    if id(leaf) in above:
        return leaf
    above = (*above, id(leaf))
    if isinstance(leaf, functools.partial):
        inner = jax.tree.map(
            lambda x: _convert_leaf(x, above), (leaf.func, leaf.args, leaf.keywords)
        )
        return eqx.Partial(inner[0], *inner[1], **inner[2]) if _has_tracers(inner) else leaf
    if not isinstance(leaf, types.FunctionType):
        return leaf
    cells = leaf.__closure__ or ()
    contents = {str(k): _cell_contents(c) for k, c in enumerate(cells)}
    contents |= {"defaults": leaf.__defaults__, "keywords": leaf.__kwdefaults__}
    opened_contents = {
        k: jax.tree.map(lambda x: _convert_leaf(x, above), v) for k, v in contents.items()
    }
    # Functions over known numbers stay as they are: they compare equal from call to call, so that
    # programs are found again.
    values = {k: v for k, v in opened_contents.items() if _has_tracers(v)}
    if not values:
        return leaf
    rest = (leaf.__code__, leaf.__globals__, cells, leaf.__defaults__, leaf.__kwdefaults__)
    return Closure(values, _Same(rest))


def _cell_contents(cell: Any) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # not assigned yet
        return None


def _has_tracers(tree: Any) -> bool:
    return any(isinstance(leaf, jax.core.Tracer) for leaf in jax.tree.leaves(tree))


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

# Without its own `jit`, whose cache would keep a trace of thousands of objects for every mechanism.
_diffeqsolve = inspect.unwrap(diffrax.diffeqsolve)

# Result of a run that was not started, as a mass or a tensor of inertia is not positive or not finite.
MASSES_REFUSED = diffrax.RESULTS.nonfinite_input

# Fields of a method that become arrays, so that other values need no other compilation.
NUMBERS = ("rtol", "atol", "first_step", "max_step")


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


# These functions are traced once only, where otherwise the same equations would be traced again at
# every place where diffrax calls them, and are machine code of their own on a CPU.
@native
def _get_derivative(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.derivative(*args)


@native
def _get_projection(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.project(*args)


@native
def _at_step(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.at_step(*args)


@native
def _get_residuals(formulation: AbstractFormulation, *args: Any) -> Any:
    return formulation.residuals(*args)


@native
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
    method: Method
    floating: bool = eqx.field(static=True)
    n_state: int = eqx.field(static=True)
    n_internal: int = eqx.field(static=True)

    def field(self, t: Any, y: Any, args: Any) -> Float[Array, " k"]:
        """Right-hand side y': rates of x and of internal states, flows of energy and momentum."""
        stabilisation, formulation = self.method.stabilisation, self.method.formulation
        t, x = jnp.asarray(t, y.dtype), y[: self.n_state]
        if self.n_internal:
            z = y[self.n_state : self.n_state + self.n_internal]
            args = at_internal(args, z)
        # Flows of energy and momentum come with the derivative, since loads are computed there
        # anyway; without balances nothing reads them, and they are dropped.
        rate, flows = _get_derivative(formulation, args, t, x, stabilisation)
        parts = [rate]
        if self.n_internal:
            parts.append(_internal_rates(formulation, args, t, x))
        if not self.method.balances:
            return jnp.concatenate(parts) if self.n_internal else rate
        parts.append(flows.power[None])
        if self.floating:
            parts += [flows.force, flows.moment]
        return jnp.concatenate(parts)

    def term(self) -> diffrax.ODETerm:
        """Right-hand side as a term of diffrax, whose argument is the model, so that it holds none itself."""
        return diffrax.ODETerm(eqx.tree_at(lambda p: p.model, self, None).field)

    def at_step(self, t: Any, y: Any, args: Any) -> Any:
        """Model with the choices that are made once for a step that starts at y."""
        t, x = jnp.asarray(t, y.dtype), y[: self.n_state]
        return _at_step(self.method.formulation, args, t, x)

    def solver(self) -> ProjectedSolver:
        """Solver of the method, with stabilisation of the constraints."""
        iterations = self.method.stabilisation.iterations_after_step()
        formulation, n = self.method.formulation, self.n_state

        def project_vector(t: Any, y: Any, args: Any) -> Any:
            x, remaining = _get_projection(
                formulation, args, jnp.asarray(t, y.dtype), y[:n], iterations
            )
            return jnp.concatenate([x, y[n:]]), jax.lax.stop_gradient(remaining)

        def vector_residuals(t: Any, y: Any, args: Any) -> Residuals:
            now = _get_residuals(formulation, args, jnp.asarray(t, y.dtype), y[:n])
            return jax.lax.stop_gradient(now)

        inner: Any = self.method.solver
        # Dense output costs stages and memory, which only events need: output times end steps
        # here.
        if isinstance(inner, diffrax.AbstractERK) and self.method.event is None:
            inner = NonDenseRungeKutta(inner)
        if self.method.event is None and own_iterations(inner):
            size = n + self.n_internal
            esdirk: Any = inner
            inner = NonDenseESDIRK(esdirk, self.method.rtol, self.method.atol, size)
        inner = stage_loop(inner, self.method.adjoint)
        projection = project_vector if iterations else None
        # An error estimate is that of the step before its projection. Without this limit a step
        # from which Newton goes to another branch would be accepted.
        limit = ProjectionLimit(self.method.rtol, self.method.atol, n) if iterations else None
        return ProjectedSolver(
            inner, projection, vector_residuals, self.at_step, limit, self._make_guard()
        )

    def _make_guard(self) -> Guard | None:
        size = self.n_state + self.n_internal
        if self.method.steps == "state" or not size:
            return None
        tolerance = jnp.maximum(self.method.rtol, self.method.atol)
        solver: Any = self.method.solver
        return make_guard(solver, tolerance, size)

    def take_step(
        self, t0: Any, t1: Any, y: Float[Array, " k"], solver_state: Any, solver: Any = None
    ) -> tuple[Any, Any, Any, Any, diffrax.RESULTS]:
        """Step from y at t0 to t1 [s]: its end, error estimate, stages, the solver's state, and result.

        Args:
            solver: that of the problem by default.
        """
        solver, term = self.solver() if solver is None else solver, self.term()
        return solver.step(term, t0, t1, y, self.model, solver_state, True)

    def controller(self, step: Float[Array, ""]) -> StepSizeMemory:
        """Step size controller by the local error of the state, with the first step [s]."""
        return StepSizeMemory(  # pyright: ignore[reportCallIssue]
            controller=diffrax.PIDController(
                rtol=self.method.rtol,
                atol=self.method.atol,
                # Work and impulse are quadratures of the motion: their errors follow its own, and
                # must not choose its steps.
                norm=error_norm(self.n_state + self.n_internal),
                **CONTROL,
            ),
            step=step,
            longest=jnp.asarray(self.method.max_step, step.dtype),
            unit=jnp.minimum(self.method.first_step / FIRST_STEP, 1.0),
        )

    def is_open(self, worst: Residuals) -> Bool[Array, "*k"]:
        """True where joints have come open: residuals exceed what size and tolerance allow."""
        if not self.model.system.joints:
            return jnp.zeros(jnp.shape(worst.position), bool)
        # The same gap is large in a small mechanism and round-off in a large one: it is compared
        # with the longest arm.
        arm = longest_arm(self.model.system, group_constraints(self.model.system))
        projected = self.method.stabilisation.iterations_after_step() > 0
        tolerance = jnp.maximum(self.method.rtol, self.method.atol)
        limit = open_limit(tolerance, projected=projected)
        return ~(jnp.maximum(worst.position / arm, worst.angle) <= limit)

    def solve(
        self,
        carry: IntegrationState,
        t1: Float[Array, ""],
        adjoint: diffrax.AbstractAdjoint,
        *,
        max_steps: int | None = None,
        keeps_times: bool = False,
        event: diffrax.Event | None = None,
    ) -> diffrax.Solution:
        """Integrate from the carry to t1 [s], where the last step ends.

        Args:
            keeps_times: the solution's `ts` are those of the end and of the ends of all steps.
        """
        records: Any = diffrax.SubSaveAt(t1=True)
        if keeps_times:
            records = (records, diffrax.SubSaveAt(steps=True, fn=lambda t, y, args: None))
        return _diffeqsolve(
            self.term(),
            self.solver(),
            carry.t,
            t1,
            None,
            carry.y,
            self.model,
            saveat=diffrax.SaveAt(subs=records, solver_state=True, controller_state=True),
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


def read_end(solution: diffrax.Solution) -> SegmentEnd:
    """End of a solution by diffrax."""
    t, y = (jax.tree.leaves(x)[0][0] for x in (solution.ts, solution.ys))
    steps = (solution.stats["num_accepted_steps"], solution.stats["num_rejected_steps"])
    states = (solution.solver_state, solution.controller_state)
    return SegmentEnd(t, y, *states, *steps, solution.result)


def continue_from(carry: IntegrationState, end: SegmentEnd) -> IntegrationState:
    """State of an integration at the end of a segment that began with the carry; a failure stays."""
    counts = Counts(
        carry.counts.accepted + end.accepted,
        carry.counts.rejected + end.rejected,
        end.controller_state[2],
    )
    success = carry.result == diffrax.RESULTS.successful
    result = diffrax.RESULTS.where(success, end.result, carry.result)
    step, memory = end.controller_state[0], (end.solver_state, end.controller_state)
    return IntegrationState(end.t, end.y, step, *memory, counts, result)


def _as_arrays(event: Any) -> Any:
    """Event with its numbers as arrays, so that other numbers need no other compilation."""
    number = lambda x: isinstance(x, float | np.floating | np.ndarray)
    return jax.tree.map(lambda x: as_floats(x) if number(x) else x, event)


def prepare_problem(system: System, method: Method) -> Problem:
    """Prepare a problem: all that does not depend on the state.

    Raises:
        SettingError: the method's solver is "auto", which only `simulate` can choose.
    """
    if isinstance(method.solver, str):
        raise SettingError(
            'The solver "auto" is for simulate, which sees the values of the start. Elsewhere give '
            "Method(solver=choose_solver(system, state))."
        )
    # Tolerances are arrays of the problem, so that a second run at others uses the first one's
    # program.
    numbers = {k: as_floats(getattr(method, k)) for k in NUMBERS}
    if method.jump_ts is not None:
        numbers["jump_ts"] = as_floats(method.jump_ts)
    method = dataclasses.replace(method, **numbers)
    # numbers that functions close over become leaves, so that they can be differentiated
    system, method = convert_closures((system, method))
    method = eqx.tree_at(
        lambda m: m.event, method, _as_arrays(method.event), is_leaf=lambda x: x is None
    )
    model = method.formulation.prepare(system)
    n_state = method.formulation.vector_size(model)
    return Problem(model, method, system.floating, n_state, internal_count(system))


def fit_first_step(problem: Problem, span: Any) -> Problem:
    """Problem whose first step is at most a hundredth of the run's time [s], in any unit of time."""
    first = problem.method.first_step
    # numbers that are not traced pass through NumPy, which compiles nothing
    module = array_module(span, first)
    share = module.abs(span if module is np else jax.lax.stop_gradient(span)) / 100
    step = module.where((share > 0) & (share < first), share, first)
    return eqx.tree_at(lambda problem: problem.method.first_step, problem, as_floats(step))


def begin_integration(problem: Problem, t0: Float[Array, ""], state0: State) -> IntegrationState:
    """Initial carry of an integration at t0 [s]."""
    formulation = problem.method.formulation
    x = formulation.to_vector(problem.model, state0)
    if len(x) != problem.n_state:
        raise SettingError(
            f"The vector of {formulation} must have as many entries as its vector_size says, "
            f"{problem.n_state}, but it has {len(x)}."
        )
    extra = (7 if problem.floating else 1) if problem.method.balances else 0
    system = problem.model.system
    internal = [internal_starts(system, system.kinematics(state0))] if problem.n_internal else []
    y = jnp.concatenate([x, *internal, jnp.zeros(extra, x.dtype)])
    step = jnp.asarray(problem.method.first_step, dtype=y.dtype)
    # diffrax makes these states itself at the start of a solve. They are made here, since an
    # integration in chunks hands them on and a loop needs their structure beforehand.
    solver, controller = problem.solver(), problem.controller(step).wrap(1)
    terms = problem.term()
    solver_state = solver.init(terms, t0, t0 + step, y, problem.model)
    _, controller_state = controller.init(
        terms, t0, t0 + step, y, None, problem.model, solver.func, solver.error_order(terms)
    )
    # a run without positive masses takes no step: with negative ones it may look plausible
    refused: Any = MASSES_REFUSED
    positive = has_positive_masses(system.bodies)
    result = diffrax.RESULTS.where(positive, diffrax.RESULTS.successful, refused)
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
        result,
    )


# Eager calls of this do not compile again for a system of the same structure.
compiled_begin = kept_jit(begin_integration)
