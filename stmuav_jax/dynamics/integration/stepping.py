"""Wrappers of diffrax: a solver with projection, a controller that remembers its step size."""

from collections.abc import Callable
from functools import cache
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from ...algebra.derivative import safe_sqrt
from ...checks.shapes import StateVector
from ..formulations.base import Residuals
from .step_bound import Guard

# The integration fails at a rejected step shorter than this times 1 s plus the time.
_SHORTEST = 1e-14


@cache
def _landed(inner: Callable[..., Any]) -> type:
    """Class of interpolants of projected steps: the inner one plus a linear displacement."""

    class Landed(diffrax.AbstractLocalInterpolation):
        t0: Any
        t1: Any
        inner: Any
        end: StateVector
        shift: StateVector

        def evaluate(self, t0: Any, t1: Any = None, left: bool = True) -> StateVector:
            del left
            if t1 is not None:
                return self.evaluate(t1) - self.evaluate(t0)
            within = inner(t0=self.t0, t1=self.t1, **self.inner).evaluate(t0)
            width = jnp.where(self.t1 == self.t0, 1.0, self.t1 - self.t0)
            moved = within + (t0 - self.t0) / width * self.shift
            return jnp.where(t0 == self.t1, self.end, moved)

    return Landed


# A step whose end the projection moves by more than this many times its tolerance is rejected,
# since its error estimate does not cover that; usual projections move it by less than one.
FARTHEST = 10.0


class ProjectionLimit(eqx.Module):
    """Rejection of steps whose end is moved too far by the projection.

    Args:
        rtol, atol: tolerances of the step.
        n_state: number of the first entries of y, which are projected.
    """

    rtol: Any
    atol: Any
    n_state: int = eqx.field(static=True)

    def error(
        self, y0: StateVector, y1: StateVector, end: StateVector, error: StateVector
    ) -> StateVector:
        """Error estimate of the step; one above the tolerance if its end was moved too far."""
        scale = lambda y: self.atol + self.rtol * jnp.maximum(jnp.abs(y0), jnp.abs(y))
        n = self.n_state
        moved = error_norm(n)(jax.lax.stop_gradient((end - y1) / scale(y1))) / FARTHEST
        moved = jnp.where(jnp.isfinite(moved), moved, jnp.inf)
        # scaled so that the controller's norm of it is `moved`, however large the end is
        return jnp.where(moved > 1, moved * scale(end), error)


class ProjectedSolver(diffrax.AbstractWrappedSolver):
    """Solver of diffrax with a projection after each step, and a record of the residuals.

    The projection moves the end of the step, so the inner solver's evaluation there is not
    reused: a first-same-as-last evaluation is repeated (`made_jump`), and the interpolant is
    corrected linearly to meet the projected end.

    Args:
        solver: solver of diffrax, explicit or implicit.
        project: function (t, y, args) -> projected y and its `Residuals`, or None.
        residuals: function (t, y, args) -> `Residuals`; their maxima over all accepted steps
            are kept in the solver state.
        at_step: function (t, y, args) -> args, with choices made once for a step that starts at y.
        far: rejection of steps that the projection moves too far, or None.
        guard: bound of the steps that keeps derivatives accurate, or None. With it, the error
            estimate is a pair with the longest safe step.
    """

    solver: diffrax.AbstractSolver  # pyright: ignore[reportIncompatibleVariableOverride]
    project: Callable[[Any, StateVector, Any], tuple[StateVector, Residuals]] | None
    residuals: Callable[[Any, StateVector, Any], Residuals]
    at_step: Callable[[Any, StateVector, Any], Any]
    far: ProjectionLimit | None
    guard: Guard | None = None

    @property
    def root_finder(self) -> Any:
        """Root finder of the implicit inner solver, which diffrax gives its tolerances."""
        assert isinstance(self.solver, diffrax.AbstractImplicitSolver)
        return self.solver.root_finder

    @property
    def scan_kind(self) -> str:
        """Placeholder that is not None, since `stage_loop` has set the inner solver's loop."""
        return "chosen"

    @property
    def term_structure(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.solver.term_structure

    @property
    def interpolation_cls(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return _landed(self.solver.interpolation_cls)

    @property
    def term_compatible_contr_kwargs(  # pyright: ignore[reportIncompatibleVariableOverride]
        self,
    ) -> Any:
        return self.solver.term_compatible_contr_kwargs

    def order(self, terms: Any) -> int | None:
        return self.solver.order(terms)

    def strong_order(self, terms: Any) -> Any:
        return self.solver.strong_order(terms)

    def error_order(self, terms: Any) -> Any:
        return self.solver.error_order(terms)

    def init(self, terms: Any, t0: Any, t1: Any, y0: StateVector, args: Any) -> Any:
        none = jnp.zeros((), y0.dtype)
        start = (self.solver.init(terms, t0, t1, y0, args), Residuals(*(none,) * 5))
        return start if self.guard is None else (*start, self.guard.begin(t0, y0))

    def step(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: StateVector,
        args: Any,
        solver_state: Any,
        made_jump: Any,
    ) -> tuple[StateVector, Any, Any, Any, diffrax.RESULTS]:
        inner, worst, *modes = solver_state
        jump = made_jump if self.project is None else True
        args = self.at_step(t0, y0, args)
        if self.guard is not None:
            # of constants, so that the modes, which have no derivative, compile without any
            still = jax.lax.stop_gradient(eqx.filter(args, eqx.is_inexact_array))
            still = eqx.combine(still, args)
            field = lambda t, y: terms.vf(t, y, still)
            modes = [self.guard.looked(field, t0, y0, t1 - t0, *modes)]
        y1, y_error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, inner, jump
        )
        if self.project is None:
            end, now = y1, self.residuals(t1, y1, args)
        else:
            end, now = self.project(t1, y1, args)
        if self.far is not None and y_error is not None:
            y_error = self.far.error(y0, y1, end, y_error)
        worst = jax.tree.map(jnp.maximum, worst, now)
        info = {"inner": dense_info, "end": end, "shift": end - y1}
        y_error = (y_error, modes[0].longest) if modes else y_error
        return end, y_error, info, (inner, worst, *modes), result

    def func(self, terms: Any, t0: Any, y0: StateVector, args: Any) -> Any:
        return self.solver.func(terms, t0, y0, args)


def stage_loop(
    solver: diffrax.AbstractSolver, adjoint: diffrax.AbstractAdjoint
) -> diffrax.AbstractSolver:
    """Solver with a loop over its stages that the adjoint can differentiate.

    diffrax chooses this loop for its own solvers, but not inside a wrapped one.
    """
    kinds = {diffrax.ForwardMode: "lax", diffrax.DirectAdjoint: "bounded"}
    kind = kinds.get(type(adjoint))
    if kind is None or not isinstance(solver, diffrax.AbstractRungeKutta):
        return solver
    return eqx.tree_at(lambda s: s.scan_kind, solver, kind, is_leaf=lambda x: x is None)


class StepSizeMemory(diffrax.AbstractAdaptiveStepSizeController):
    """Step size controller that keeps its step size when a step is cut short.

    A step that ends at an output time is cut short; without this controller the next step size
    would derive from the short one and grow again only by a bounded factor a step. The state
    holds the next step size and the number of steps that were followed by the largest growth:
    their error was far below the tolerance and did not choose their length.

    Args:
        controller: controller that accepts and rejects steps and proposes their sizes.
        step: first step size [s]. It is given here and not to diffrax as dt0, which would add
            a check by host callback, and code with callbacks is not kept in JAX's
            compilation cache.
        longest: largest step size [s].
    """

    controller: diffrax.PIDController
    step: Float[Array, ""]
    longest: Float[Array, ""] | float = float("inf")

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.rtol

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.controller.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.controller.norm

    def wrap(self, direction: Any) -> "StepSizeMemory":
        return StepSizeMemory(  # pyright: ignore[reportCallIssue]
            controller=self.controller.wrap(direction), step=self.step, longest=self.longest
        )

    def init(
        self,
        terms: Any,
        t0: Any,
        t1: Any,
        y0: Any,
        dt0: Any,
        args: Any,
        func: Any,
        error_order: Any,
    ) -> Any:
        del dt0
        step = jnp.minimum(self.step, self.longest)
        end, inner = self.controller.init(terms, t0, t1, y0, step, args, func, error_order)
        return end, (step, inner, jnp.zeros((), int))

    def adapt_step_size(
        self,
        t0: Any,
        t1: Any,
        y0: Any,
        y1_candidate: Any,
        args: Any,
        y_error: Any,
        error_order: Any,
        controller_state: Any,
    ) -> Any:
        step, inner, grown = controller_state
        longest = self.longest
        if isinstance(y_error, tuple):
            y_error, safe = y_error
            longest = jnp.minimum(longest, safe)
        keep, next_t0, next_t1, jump, inner, result = self.controller.adapt_step_size(
            t0, t1, y0, y1_candidate, args, y_error, error_order, inner
        )
        proposed = next_t1 - next_t0
        cut_short = keep & (t1 - t0 < step)
        most = 0.999 * float(self.controller.factormax) * (t1 - t0)
        grown = grown + jnp.where(keep & (proposed >= most), 1, 0)
        step = jnp.where(cut_short, jnp.maximum(step, proposed), proposed)
        step = jnp.minimum(step, longest)
        # a state that is not finite has a step that is not either
        collapsed = ~keep & ~(step >= _SHORTEST * (1 + jnp.abs(t0)))
        result = diffrax.RESULTS.where(collapsed, diffrax.RESULTS.dt_min_reached, result)
        return keep, next_t0, next_t0 + step, jump, (step, inner, grown), result


def kvaerno3() -> diffrax.Kvaerno3:
    """Implicit method Kvaerno3 of diffrax, with the chord method as root finder.

    diffrax's default root finder takes few iterations and rejects the step if they do not
    converge, which on the seven-body UAV means many more steps than with the chord method. Without an event
    `Method` solves the stages by `esdirk`, with one Jacobian for many steps.
    """
    return diffrax.Kvaerno3(root_finder=_chord())


def kvaerno5() -> diffrax.Kvaerno5:
    """Implicit method Kvaerno5 of diffrax, with the root finder of `kvaerno3`."""
    return diffrax.Kvaerno5(root_finder=_chord())


def _chord() -> Any:
    return diffrax.with_stepsize_controller_tols(optx.Chord)()


def own_iterations(solver: Any) -> bool:
    """True for the methods of `kvaerno3` and `kvaerno5`, whose stages `esdirk` solves.

    A method with any other root finder is carried out by diffrax with that.
    """
    known = isinstance(solver, diffrax.Kvaerno3 | diffrax.Kvaerno4 | diffrax.Kvaerno5)
    return known and isinstance(solver.root_finder, optx.Chord)


def error_norm(n_state: int) -> Callable[[StateVector], Float[Array, ""]]:
    """Root-mean-square norm of the first `n_state` entries, which leaves out quadratures."""

    def norm(error: StateVector) -> Float[Array, ""]:
        part = error[:n_state]
        return safe_sqrt(jnp.mean(part * part))

    return norm
