"""Wrappers of diffrax: a solver with projection, a controller with memory, steps that are safe for derivatives.

Step size control by the error of the state alone does not bound the error of derivatives: about
an equilibrium the state has no error at all, and the steps would grow without bound, while the
derivatives still oscillate with every mode of the system. Derivatives obey the linearised
equations s' = J s + b with J = df/dy, which a Runge-Kutta method of stability function R integrates
with a relative error of |R(h lambda) - exp(h lambda)| a step in a mode of eigenvalue lambda. The
steps are bounded such that this is at most a small share of the tolerance per radian of the fastest
mode. Arnoldi's method gives a small matrix whose eigenvalues include the largest of J, from products
J v for a few directions v, by differences that cost one right-hand side each; it is repeated
every few steps. For implicit methods all directions are used, and modes that have decayed since
the start count less: by a factor exp(Re lambda tau / order) after the time tau.

Source: Y. Saad, Numerical Methods for Large Eigenvalue Problems (2011), ch. VI (Arnoldi's method);
E. Hairer, G. Wanner, Solving Ordinary Differential Equations II (1996), ch. IV.2 (stability functions).
"""

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ...checks.shapes import StateVector
from ...math import lapack
from ...math.derivative import safe_sqrt
from ..formulations.base import Residuals

# Relative error of derivatives allowed per radian of the fastest mode, over the tolerance: at the
# default of 1e-8 a period of a pendulum at rest then costs derivatives 1.3e-10 of their size.
SHARE = 1 / 500

# Number of directions of Arnoldi's method: on the seven-body UAV it gives the fastest mode to 3 %,
# in one of fourteen postures to 17 %.
DIRECTIONS = 10

# Accepted steps until the modes are computed again; the smaller number where they bound the steps.
EVERY, EVERY_BOUND = 12, 4


class Modes(NamedTuple):
    """Memory of a run: the longest safe step [s], its age in steps, the initial time [s]."""

    longest: Float[Array, ""]
    age: Int[Array, ""]
    start: Float[Array, ""]


class Krylov(NamedTuple):
    """Orthonormal basis of a Krylov space, a row each, and the matrix of J in it."""

    basis: Float[Array, "m+1 k"]
    matrix: Float[Array, "m+1 m"]


class Guard(eqx.Module):
    """Bound of the step size by the modes of the linearised motion.

    Args:
        radius: largest product of step and magnitude of an eigenvalue.
        order: order of the method.
        implicit: True if steps may be long for modes that have decayed.
        size: number of entries of y with equations of motion; the others are quadratures.
    """

    radius: Float[Array, ""]
    order: int = eqx.field(static=True)
    implicit: bool = eqx.field(static=True)
    size: int = eqx.field(static=True)

    @property
    def directions(self) -> int:
        """Number of directions of Arnoldi's method."""
        # An explicit method is limited by its fastest mode, which few directions show. Long steps
        # of an implicit one are limited by the slowest mode that has not decayed, which only the
        # whole spectrum shows.
        return self.size if self.implicit else min(self.size, DIRECTIONS)

    def begin(self, t0: Any, y0: StateVector) -> Modes:
        """Initial memory, without any bound yet."""
        return Modes(jnp.asarray(jnp.inf, y0.dtype), jnp.asarray(EVERY), jnp.asarray(t0, y0.dtype))

    def is_due(self, modes: Modes, h: Any) -> Bool[Array, ""]:
        """True if the modes are to be computed in a step of length h [s]."""
        often = h > 0.75 * modes.longest
        return modes.age >= jnp.where(often, EVERY_BOUND, EVERY)

    def first_memory(self, y0: StateVector) -> Krylov:
        """Krylov space of a first direction: pseudo-random, always the same, with all modes."""
        m, k = self.directions, y0.shape[0]
        start = np.zeros(k)
        # A direction of ones, or along the motion, could lie in a part without the fastest mode,
        # by symmetry; a random one does not, and the same one every time keeps runs reproducible.
        start[: self.size] = np.random.default_rng(0).normal(size=self.size)
        basis = np.zeros((m + 1, k))
        basis[0] = start / np.linalg.norm(start)
        return Krylov(jnp.asarray(basis, y0.dtype), jnp.zeros((m + 1, m), y0.dtype))

    def difference_step(self, y0: StateVector) -> Float[Array, ""]:
        """Length of the difference along a direction."""
        # Between round-off, which grows as 1/h, and curvature, which grows as h; a modest accuracy
        # of the modes is enough.
        small = jnp.finfo(y0.dtype).eps ** 0.4
        return small * (1 + jnp.max(jnp.abs(y0[: self.size])))

    def with_slope(self, krylov: Krylov, j: Any, change: StateVector) -> Krylov:
        """Krylov space with one more direction: the part of J v_j (`change`) outside of it."""
        change = jnp.where(np.arange(change.shape[0]) < self.size, change, 0.0)
        components = krylov.basis @ change
        remainder = change - components @ krylov.basis
        # Orthogonalised twice: once leaves components of the size of round-off times the ratio of
        # lengths, with which Arnoldi finds modes that are not there.
        more = krylov.basis @ remainder
        remainder, components = remainder - more @ krylov.basis, components + more
        length = jnp.linalg.norm(remainder)
        # there is no new direction if J v lies in the space
        new = length > 1e-6 * jnp.linalg.norm(change)
        row = jnp.where(new, remainder / jnp.where(new, length, 1.0), 0.0)
        column = jnp.where(
            np.arange(components.shape[0]) == j + 1, jnp.where(new, length, 0.0), components
        )
        put = jax.lax.dynamic_update_index_in_dim
        return Krylov(put(krylov.basis, row, j + 1, 0), put(krylov.matrix, column, j, 1))

    def from_krylov(self, krylov: Krylov, modes: Modes, t: Any) -> Modes:
        """Memory with the longest step that the modes allow at t [s]."""
        H = krylov.matrix[:-1]
        if self.implicit:
            # In a step that fails anyway the matrix may not be finite, and then has no eigenvalues
            # to compute.
            values = lapack.compute_eigenvalues(jnp.where(jnp.all(jnp.isfinite(H)), H, 0.0))
            decay = jnp.maximum(-values.real, 0.0) * jnp.abs(t - modes.start) / self.order
            fastest = jnp.max(jnp.abs(values) * jnp.exp(-decay))
        else:
            fastest = spectral_radius(H)
        fastest = jnp.where(jnp.isfinite(fastest), fastest, 0.0)
        longest = jnp.where(
            fastest > 0, self.radius / jnp.where(fastest > 0, fastest, 1.0), jnp.inf
        )
        return Modes(longest, jnp.zeros_like(modes.age), modes.start)

    def update_modes(
        self,
        field: Callable[[Any, StateVector], StateVector],
        t0: Any,
        y0: StateVector,
        h: Any,
        modes: Modes,
    ) -> Modes:
        """Memory after a step of length h from y0 at t0, where the modes are computed if due."""
        # Step sizes have no derivative, and neither has what chooses them.
        t0, y0, h = jax.lax.stop_gradient((jnp.asarray(t0, y0.dtype), y0, h))
        due = self.is_due(modes, h)

        def compute_modes() -> Modes:
            increment = self.difference_step(y0)

            # the slope at y0 itself comes first, in the same loop: one copy of the field to compile
            def arnoldi_step(
                now: tuple[Krylov, StateVector], j: Any
            ) -> tuple[tuple[Krylov, StateVector], None]:
                krylov, base = now
                first, j = j < 0, jnp.maximum(j, 0)
                slope = field(t0, y0 + jnp.where(first, 0.0, increment) * krylov.basis[j])
                more = self.with_slope(krylov, j, (slope - base) / increment)
                next_krylov = jax.tree.map(lambda a, b: jnp.where(first, a, b), krylov, more)
                return (next_krylov, jnp.where(first, slope, base)), None

            begin = (self.first_memory(y0), jnp.zeros_like(y0))
            (krylov, _), _ = jax.lax.scan(arnoldi_step, begin, jnp.arange(-1, self.directions))
            return self.from_krylov(krylov, modes, t0)

        now = jax.lax.cond(eqxi.unvmap_any(due), compute_modes, lambda: modes)
        older = Modes(modes.longest, modes.age + 1, modes.start)
        return jax.lax.stop_gradient(jax.tree.map(lambda a, b: jnp.where(due, a, b), now, older))


def spectral_radius(H: Float[Array, "m m"]) -> Float[Array, ""]:
    """Upper bound |H^128|^(1/128), by the Frobenius norm, of the magnitudes of the eigenvalues."""

    # Powers by squaring take seven products of a small matrix instead of an eigenvalue problem;
    # logarithms keep them from overflowing.
    def square_power(at: tuple[Any, Any], _: None) -> tuple[tuple[Any, Any], None]:
        power, logarithm = at
        size = jnp.linalg.norm(power)
        power = power / jnp.where(size > 0, size, 1.0)
        return (power @ power, 2 * (logarithm + jnp.log(size))), None

    (power, logarithm), _ = jax.lax.scan(square_power, (H, jnp.zeros((), H.dtype)), None, length=7)
    return jnp.exp((logarithm + jnp.log(jnp.linalg.norm(power))) / 2**7)


def make_guard(solver: diffrax.AbstractSolver, rtol: Any, size: int) -> Guard:
    """Bound of the step size for a solver at a tolerance, for `size` equations of motion."""
    order = solver.order(diffrax.ODETerm(lambda t, y, args: y)) or 1
    implicit = isinstance(solver, diffrax.AbstractImplicitSolver)
    return Guard(accuracy_radius(solver, order, rtol), order, implicit, size)


def accuracy_radius(solver: Any, order: int, rtol: Any) -> Float[Array, ""]:
    """Largest |z| at which |R(z) - exp(z)| is at most `SHARE` rtol |z|, at most 2."""
    table = _tabulate_errors(type(solver), order, stability_function(solver) is not None)
    if table is None:
        # unknown stability function: the next term of the exponential series as the error
        faculty = float(np.prod(np.arange(1.0, order + 2)))
        return jnp.minimum((SHARE * rtol * faculty) ** (1 / order), 2.0)
    sizes, error = table
    target = jnp.log(SHARE * jnp.asarray(rtol))
    return jnp.exp(jnp.interp(target, jnp.asarray(np.log(error)), jnp.asarray(np.log(sizes))))


@cache
def _tabulate_errors(kind: Any, order: int, is_known: bool) -> tuple[np.ndarray, np.ndarray] | None:
    """Table of |z| and the largest |R(z) - exp(z)| / |z| within that circle, for a solver class.

    None if the stability function R is not known.
    """
    of = stability_function(kind) if is_known else None
    if of is None:
        return None
    sizes = np.geomspace(1e-5, 2.0, 120)
    # Modes may be damped, oscillating or growing: the error is the largest in any direction of the
    # half plane, and the other half is its mirror image.
    ways = np.exp(1j * np.linspace(0.0, np.pi, 7))
    error = np.array([max(abs(of(r * w) - np.exp(r * w)) for w in ways) for r in sizes])
    # smaller errors are round-off; there they are extrapolated by the order of the method
    first = int(np.argmax(error > 1e-13))
    error = np.maximum.accumulate(error[first:] / sizes[first:])
    return sizes, np.concatenate([error[0] * (sizes[:first] / sizes[first]) ** order, error])


def stability_function(solver: Any) -> Callable[[complex], complex] | None:
    """Stability function R(z) of a solver or a class of solvers, None if it is not known."""
    table: Any = getattr(solver, "tableau", None)
    if not isinstance(table, diffrax.ButcherTableau):
        return None
    count = len(table.b_sol)
    A = np.zeros((count, count))
    for i, row in enumerate(table.a_lower):
        A[i + 1, : i + 1] = row
    if table.a_diagonal is not None:
        A += np.diag(table.a_diagonal)
    b, ones = np.asarray(table.b_sol), np.ones(count)
    return lambda z: complex(1 + z * (b @ np.linalg.solve(np.eye(count) - z * A, ones)))


# The integration fails at a rejected step shorter than this times 1 s plus the time.
_SHORTEST = 1e-14


@cache
def _projected_interpolant(inner: Callable[..., Any]) -> type:
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
            # The projection moves the end of a step by less than its error: a linear share of that
            # keeps the interpolant continuous from step to step without changing its order.
            within = inner(t0=self.t0, t1=self.t1, **self.inner).evaluate(t0)
            width = jnp.where(self.t1 == self.t0, 1.0, self.t1 - self.t0)
            shifted_value = within + (t0 - self.t0) / width * self.shift
            return jnp.where(t0 == self.t1, self.end, shifted_value)

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
        displacement = error_norm(n)(jax.lax.stop_gradient((end - y1) / scale(y1))) / FARTHEST
        displacement = jnp.where(jnp.isfinite(displacement), displacement, jnp.inf)
        # scaled so that the controller's norm of it is `moved`, however large the end is
        return jnp.where(displacement > 1, displacement * scale(end), error)


def _undirected(terms: Any, t0: Any, t1: Any) -> tuple[Any, Any, Any]:
    """Terms and times [s] of a step as they were given to diffrax.

    diffrax counts time forwards also where a motion goes back, with terms that turn the sign again; forces,
    drivers and stages need the time itself.
    """
    direction = getattr(terms, "direction", None)
    return (terms, t0, t1) if direction is None else (terms.term, t0 * direction, t1 * direction)


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
        projection_limit: rejection of steps that the projection moves too far, or None.
        guard: bound of the steps that keeps derivatives accurate, or None. With it, the error
            estimate is a pair with the longest safe step.
    """

    solver: diffrax.AbstractSolver  # pyright: ignore[reportIncompatibleVariableOverride]
    project: Callable[[Any, StateVector, Any], tuple[StateVector, Residuals]] | None
    residuals: Callable[[Any, StateVector, Any], Residuals]
    at_step: Callable[[Any, StateVector, Any], Any]
    projection_limit: ProjectionLimit | None
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
        return _projected_interpolant(self.solver.interpolation_cls)

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
        terms, t0, t1 = _undirected(terms, t0, t1)
        inner, worst, *modes = solver_state
        # After a projection the solver's last evaluation belongs to a state that is no longer
        # there.
        jump = made_jump if self.project is None else True
        args = self.at_step(t0, y0, args)
        if self.guard is not None:
            # of constants, so that the modes, which have no derivative, compile without any
            constants = jax.lax.stop_gradient(eqx.filter(args, eqx.is_inexact_array))
            constants = eqx.combine(constants, args)
            field = lambda t, y: terms.vf(t, y, constants)
            modes = [self.guard.update_modes(field, t0, y0, jnp.abs(t1 - t0), *modes)]
        y1, y_error, dense_info, inner, result = self.solver.step(
            terms, t0, t1, y0, args, inner, jump
        )
        if self.project is None:
            end, now = y1, self.residuals(t1, y1, args)
        else:
            end, now = self.project(t1, y1, args)
        if self.projection_limit is not None and y_error is not None:
            y_error = self.projection_limit.error(y0, y1, end, y_error)
        # Kept as a maximum in the state: a record of every step would need an array of unknown
        # length.
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
        unit: time [s] of which a step that is round-off is 1e-14.
    """

    controller: diffrax.PIDController
    step: Float[Array, ""]
    longest: Float[Array, ""] | float = float("inf")
    unit: Float[Array, ""] | float = 1.0

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
            controller=self.controller.wrap(direction), step=self.step, longest=self.longest,
            unit=self.unit,
        )  # fmt: skip

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
        # A step that was cut short says nothing against the longer one that was proposed before.
        cut_short = keep & (t1 - t0 < step)
        most = 0.999 * float(self.controller.factormax) * (t1 - t0)
        grown = grown + jnp.where(keep & (proposed >= most), 1, 0)
        step = jnp.where(cut_short, jnp.maximum(step, proposed), proposed)
        step = jnp.minimum(step, longest)
        # a state that is not finite has a step that is not either
        # Only a rejected step that is round-off is a failure: an accepted one may be short because
        # an output time is near.
        collapsed = ~keep & ~(step >= _SHORTEST * (self.unit + jnp.abs(t0)))
        result = diffrax.RESULTS.where(collapsed, diffrax.RESULTS.dt_min_reached, result)
        return keep, next_t0, next_t0 + step, jump, (step, inner, grown), result


def kvaerno3() -> diffrax.Kvaerno3:
    """Implicit method Kvaerno3 of diffrax, with the chord method as root finder.

    diffrax's default root finder takes few iterations and rejects the step if they do not
    converge, which on the seven-body UAV means many more steps than with the chord method. Without an event
    `Method` solves the stages by `esdirk`, with one Jacobian for many steps.
    """
    return diffrax.Kvaerno3(root_finder=_make_chord())


def kvaerno5() -> diffrax.Kvaerno5:
    """Implicit method Kvaerno5 of diffrax, with the root finder of `kvaerno3`."""
    return diffrax.Kvaerno5(root_finder=_make_chord())


def _make_chord() -> Any:
    return diffrax.with_stepsize_controller_tols(optx.Chord)()


def own_iterations(solver: Any) -> bool:
    """True for the methods of `kvaerno3` and `kvaerno5`, whose stages `esdirk` solves.

    A method with any other root finder is carried out by diffrax with that.
    """
    is_kvaerno = isinstance(solver, diffrax.Kvaerno3 | diffrax.Kvaerno4 | diffrax.Kvaerno5)
    return is_kvaerno and isinstance(solver.root_finder, optx.Chord)


def error_norm(n_state: int) -> Callable[[StateVector], Float[Array, ""]]:
    """Root-mean-square norm of the first `n_state` entries, which leaves out quadratures."""

    def scaled_norm(error: StateVector) -> Float[Array, ""]:
        part = error[:n_state]
        # a structure of welded bodies has no coordinates, and no errors
        return safe_sqrt(jnp.sum(part * part) / max(n_state, 1))

    return scaled_norm
