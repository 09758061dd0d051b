"""Root finding: Newton's method for few unknowns, and bisection for the time of an event.

Residuals and Jacobian at the solution stay in Newton's state: a caller that needs them (for a
condition number, or the remaining error) compiles no second copy of the equations.
"""

from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..math import lapack
from .derivative import directional_derivative, held_constant, value_and_jacobian

# Residuals below this that no longer halve are taken for round-off.
_ROUND_OFF = 1e-6
# Singular values of a Jacobian up to this fraction of the largest are those of dependent equations.
_DEPENDENT = 1e-11


class NewtonState(eqx.Module):
    """y, the residuals r and their Jacobian J, the largest residual, and whether to end."""

    y: Float[Array, " n"]
    r: Float[Array, " e"]
    J: Float[Array, "e k"]
    size: Float[Array, ""]
    has_ended: Bool[Array, ""]


class AbstractNewton(optx.AbstractRootFinder):
    """Newton solver whose state determines its end; its subclasses give the steps."""

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: NewtonState, tags: Any
    ) -> tuple[Any, optx.RESULTS]:
        del fn, y, args, options, tags
        return state.has_ended, optx.RESULTS.successful

    def postprocess(
        self,
        fn: Any,
        y: Any,
        aux: Any,
        args: Any,
        options: Any,
        state: NewtonState,
        tags: Any,
        result: optx.RESULTS,
    ) -> tuple[Any, Any, dict[str, Any]]:
        del fn, args, options, state, tags, result
        return y, aux, {}


class Newton(AbstractNewton):
    """Newton solver of n equations in a vector of n unknowns, for `optimistix.root_find`.

    It ends where no residual is above `atol`, where residuals at round-off level no longer halve
    (the better of the last two iterates is kept), or where a residual is not finite. The caller has
    to judge the solution by its residuals, `solution.state.r`.
    """

    atol: float
    rtol: float = 0.0
    norm: Any = eqx.field(static=True, default=optx.max_norm)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> NewtonState:
        del fn, args, options, f_struct, aux_struct, tags
        n = y.shape[0]
        J = jnp.zeros((n, n), y.dtype)
        return NewtonState(
            y, jnp.zeros_like(y), J, jnp.full((), jnp.inf, y.dtype), jnp.array(False)
        )

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: NewtonState, tags: Any
    ) -> tuple[Any, NewtonState, Any]:
        del options, tags
        (r, aux), (J, _) = value_and_jacobian(lambda y: fn(y, args), y)
        size = self.norm(r)
        # Newton's method converges quadratically down to round-off, where residuals stop halving; a fixed
        # tolerance there would be missed by badly scaled equations and cost steps in others.
        stalled = (state.size < _ROUND_OFF) & ~(size < 0.5 * state.size)
        has_ended = (size <= self.atol) | stalled | ~jnp.isfinite(size)
        # At round-off the last step may be a little worse than the one before it, and is then dropped.
        worse = stalled & ~(size < state.size)
        now = NewtonState(y, r, J, size, has_ended)
        best = jax.tree.map(lambda a, b: jnp.where(worse, a, b), state, now)
        best = eqx.tree_at(lambda s: s.has_ended, best, has_ended)
        # Equations may repeat each other, as those of a pendulum below a machine that hovers level: the shortest
        # step meets them all, and the residuals tell where they contradict each other.
        next_y = best.y - lapack.pseudoinverse(best.J, _DEPENDENT) @ best.r
        return jnp.where(has_ended, best.y, next_y), best, aux


class NearestNewton(AbstractNewton):
    """Newton solver of e equations in n > e unknowns z, for the minimum-norm solution.

    It serves `optimistix.root_find` of (z - J^T l, e(z)) in the vector (z, l) of size n + e, with
    J = de/dz (e, n). The Jacobian of that function would need second derivatives of e; the steps
    need J alone, because z' is the minimum-norm solution of J z' = J z - e. The residuals and the
    Jacobian in the solver's state are those of e.

    Attributes:
        equations: function (z, args) -> e.
        count: number n of unknowns.
        atol: absolute tolerance of the residuals, and of the part of z outside the rows of J.
    """

    equations: Any = eqx.field(static=True)
    count: int = eqx.field(static=True)
    atol: float
    rtol: float = 0.0
    norm: Any = eqx.field(static=True, default=optx.max_norm)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> NewtonState:
        del fn, args, options, f_struct, aux_struct, tags
        rows = y.shape[0] - self.count
        J, endless = jnp.zeros((rows, self.count), y.dtype), jnp.full((), jnp.inf, y.dtype)
        return NewtonState(y, jnp.zeros(rows, y.dtype), J, endless, jnp.array(False))

    def step(
        self, fn: Any, y: Any, args: Any, options: Any, state: NewtonState, tags: Any
    ) -> tuple[Any, NewtonState, Any]:
        del fn, options, tags
        z = y[: self.count]
        r, J = value_and_jacobian(lambda z: self.equations(z, args), z)
        # From the singular values of J and not from J J^T, whose condition is the square of that of J; rows may
        # depend on others, as in `Newton`.
        P = lapack.pseudoinverse(J, _DEPENDENT)
        # A point on the constraints is not enough: its part outside the row space of J has to vanish too,
        # else it is not the nearest point.
        size = jnp.maximum(self.norm(r), self.norm(z - P @ (J @ z)))
        # The part outside the rows converges linearly where the constraints are curved, so that the factor is
        # closer to one than for `Newton`.
        stalled = (state.size < _ROUND_OFF) & ~(size < 0.9 * state.size)
        has_ended = (size <= self.atol) | stalled | ~jnp.isfinite(size)
        # where it ends, z stays; the multipliers are those of its own J
        next_z = jnp.where(has_ended, z, P @ (J @ z - r))
        next_y = jnp.concatenate([next_z, P.T @ next_z])
        return next_y, NewtonState(y, r, J, size, has_ended), None


class Implicit(optx.AbstractAdjoint):
    """Derivatives of a root by the implicit function theorem, dy = -(dr/dy)^-1 dr, in both modes.

    Derivatives of any order exist. `optimistix.ImplicitAdjoint` checks its linear solve by a host
    callback, and JAX's compilation cache keeps no program with callbacks: every process would
    compile it again. Here a singular Jacobian gives numbers that are not finite.
    """

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        del tags
        # A lax loop has no checkpoints: the derivative comes from the root alone and never goes back through
        # the iterations.
        inputs = (*inputs, partial(eqxi.while_loop, kind="lax"))
        root, rest = _apply_root(primal_fn, rewrite_fn, inputs)
        return root, jax.tree.map(eqxi.nondifferentiable_backward, rest)


@eqx.filter_custom_jvp
def _apply_root(primal_fn: Any, rewrite_fn: Any, inputs: Any) -> Any:
    del rewrite_fn
    return jax.tree.map(jnp.asarray, primal_fn(inputs))


@_apply_root.def_jvp
def _rooted_jvp(primals: Any, tangents: Any) -> Any:
    primal_fn, rewrite_fn, inputs = primals
    tangent = tangents[2]
    # Inputs without a tangent are closed over as constants, so that no derivative with respect to them is
    # computed.
    none = jax.tree.map(lambda x: x is None, tangent, is_leaf=lambda x: x is None)
    constant, varied = eqx.partition(inputs, none, is_leaf=lambda x: x is None)
    # the root by `_apply_root` once more, so that this derivative can be differentiated too
    root, rest = _apply_root(primal_fn, rewrite_fn, inputs)
    of = lambda y, varying: rewrite_fn(y, rest, eqx.combine(varying, constant))
    rate = jax.jvp(lambda varying: of(root, varying), (varied,), (tangent,))[1]
    J = _root_jacobian(root, held_constant(rest), inputs, rewrite_fn)
    zeros = jax.tree.map(
        lambda x: jax.custom_derivatives.zero_from_primal(x, symbolic_zeros=True), rest
    )
    return (root, rest), (-lapack.solve(J, rate), zeros)


@eqx.filter_custom_jvp
def _root_jacobian(root: Any, rest: Any, inputs: Any, rewrite_fn: Any) -> Float[Array, "n n"]:
    """Jacobian at a root: that of Newton's last step if it has it, else computed.

    The equations are then compiled once less. Derivatives of the Jacobian are those of the
    equations in both cases.
    """
    is_newton = lambda x: isinstance(x, NewtonState)
    for state in filter(is_newton, jax.tree.leaves(rest, is_leaf=is_newton)):
        if state.J.shape == (root.size, root.size):
            return state.J
    return jax.jacfwd(lambda y: rewrite_fn(y, rest, inputs))(root)


@_root_jacobian.def_jvp
def _jacobian_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    root, rest, inputs, rewrite_fn = primals
    jacobian_at = lambda x, inputs: jax.jacfwd(lambda y: rewrite_fn(y, rest, inputs))(x)
    return directional_derivative(jacobian_at, (root, inputs), (tangents[0], tangents[2]))


class EventBisection(optx.AbstractRootFinder):
    """Bisection to the last digit for the root finder of a `diffrax.Event`, which checks nothing.

    Under `vmap` every member of a batch goes through the root search if one of them has an event, also
    those without a change of sign, and `optimistix.Bisection` would stop them all for that. Here such a
    search ends at an end of its interval, and the caller does not use it. Several event functions
    are summed, of which all but one are zero. A zero at one end counts as a change of sign.
    """

    rtol: float = 0.0
    atol: float = 0.0
    norm: Any = eqx.field(static=True, default=optx.max_norm)

    def init(
        self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, aux_struct: Any, tags: Any
    ) -> Any:
        del y, f_struct, aux_struct, tags
        lower, upper = options["lower"], options["upper"]
        low, high = _sum_leaves(fn, lower, args)[0], _sum_leaves(fn, upper, args)[0]
        # A run that starts exactly at its event has the value zero at one end: with the opposite sign of the
        # other end it counts as a change of sign.
        low, high = jnp.where(low == 0, -high, low), jnp.where(high == 0, -low, high)
        return lower, upper, low > high

    def step(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
        del tags
        lower, upper, falling = state
        value, aux = _sum_leaves(fn, y, args)
        before = falling ^ (value < 0)
        # the values at the ends have decided which side of the root they are on
        before = jnp.where(y >= options["upper"], False, before | (y <= options["lower"]))
        lower, upper = jnp.where(before, y, lower), jnp.where(before, upper, y)
        return lower + 0.5 * (upper - lower), (lower, upper, falling), aux

    def terminate(self, fn: Any, y: Any, args: Any, options: Any, state: Any, tags: Any) -> Any:
        del fn, args, tags
        lower, upper, _ = state
        size = jnp.abs(y) + (options["upper"] - options["lower"])
        # Bisection ends at the resolution of the interval itself: the time of an event sets all later states,
        # and a coarser one would dominate their error.
        return upper - lower <= jnp.finfo(y.dtype).eps * size, optx.RESULTS.successful

    def postprocess(
        self, fn: Any, y: Any, aux: Any, args: Any, options: Any, state: Any, tags: Any, result: Any
    ) -> Any:
        del fn, args, options, state, tags, result
        return y, aux, {}


def _sum_leaves(fn: Any, y: Any, args: Any) -> Any:
    value, aux = fn(y, args)
    return sum(jax.tree.leaves(value)), aux
