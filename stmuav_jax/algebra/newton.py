"""Newton's method for few unknowns, each step from one evaluation of residuals and Jacobian.

Residuals and Jacobian at the solution stay in its state: a caller that needs them (for a
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

from . import lapack
from .derivative import directional, held_constant, value_and_jacobian

# Residuals below this that no longer halve are taken for round-off.
_ROUND_OFF = 1e-6


class NewtonState(eqx.Module):
    """y, the residuals r and their Jacobian J, the largest residual, and whether to end."""

    y: Float[Array, " n"]
    r: Float[Array, " e"]
    J: Float[Array, "e k"]
    size: Float[Array, ""]
    done: Bool[Array, ""]


class AbstractNewton(optx.AbstractRootFinder):
    """Newton solver whose state says when to end; its subclasses give the steps."""

    def terminate(
        self, fn: Any, y: Any, args: Any, options: Any, state: NewtonState, tags: Any
    ) -> tuple[Any, optx.RESULTS]:
        del fn, y, args, options, tags
        return state.done, optx.RESULTS.successful

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
        stalled = (state.size < _ROUND_OFF) & ~(size < 0.5 * state.size)
        done = (size <= self.atol) | stalled | ~jnp.isfinite(size)
        worse = stalled & ~(size < state.size)
        now = NewtonState(y, r, J, size, done)
        kept = jax.tree.map(lambda a, b: jnp.where(worse, a, b), state, now)
        kept = eqx.tree_at(lambda s: s.done, kept, done)
        moved = kept.y - lapack.solve(kept.J, kept.r)
        return jnp.where(done, kept.y, moved), kept, aux


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
        Q, R = lapack.qr(J.T)
        size = jnp.maximum(self.norm(r), self.norm(z - Q @ (Q.T @ z)))
        stalled = (state.size < _ROUND_OFF) & ~(size < 0.9 * state.size)
        done = (size <= self.atol) | stalled | ~jnp.isfinite(size)
        along = lapack.solve(R.T, J @ z - r)
        # where it ends, z stays; the multipliers are those of its own J
        along = jnp.where(done, Q.T @ z, along)
        moved = jnp.concatenate([jnp.where(done, z, Q @ along), lapack.solve(R, along)])
        return moved, NewtonState(y, r, J, size, done), None


class Implicit(optx.AbstractAdjoint):
    """Derivatives of a root by the implicit function theorem, dy = -(dr/dy)^-1 dr, in both modes.

    Derivatives of any order exist. `optimistix.ImplicitAdjoint` checks its linear solve by a host
    callback, and JAX's compilation cache keeps no program with callbacks: every process would
    compile it again. Here a singular Jacobian gives numbers that are not finite.
    """

    def apply(self, primal_fn: Any, rewrite_fn: Any, inputs: Any, tags: Any) -> Any:
        del tags
        inputs = (*inputs, partial(eqxi.while_loop, kind="lax"))
        root, rest = _rooted(primal_fn, rewrite_fn, inputs)
        return root, jax.tree.map(eqxi.nondifferentiable_backward, rest)


@eqx.filter_custom_jvp
def _rooted(primal_fn: Any, rewrite_fn: Any, inputs: Any) -> Any:
    del rewrite_fn
    return jax.tree.map(jnp.asarray, primal_fn(inputs))


@_rooted.def_jvp
def _rooted_jvp(primals: Any, tangents: Any) -> Any:
    primal_fn, rewrite_fn, inputs = primals
    moved = tangents[2]
    none = jax.tree.map(lambda x: x is None, moved, is_leaf=lambda x: x is None)
    still, varied = eqx.partition(inputs, none, is_leaf=lambda x: x is None)
    # the root by `_rooted` once more, so that this derivative can be differentiated too
    root, rest = _rooted(primal_fn, rewrite_fn, inputs)
    of = lambda y, given: rewrite_fn(y, rest, eqx.combine(given, still))
    rate = jax.jvp(lambda given: of(root, given), (varied,), (moved,))[1]
    J = _jacobian(root, held_constant(rest), inputs, rewrite_fn)
    zeros = jax.tree.map(
        lambda x: jax.custom_derivatives.zero_from_primal(x, symbolic_zeros=True), rest
    )
    return (root, rest), (-lapack.solve(J, rate), zeros)


@eqx.filter_custom_jvp
def _jacobian(root: Any, rest: Any, inputs: Any, rewrite_fn: Any) -> Float[Array, "n n"]:
    """Jacobian at a root: that of Newton's last step if it has it, else computed.

    The equations are then compiled once less. Derivatives of the Jacobian are those of the
    equations in both cases.
    """
    is_newton = lambda x: isinstance(x, NewtonState)
    for state in filter(is_newton, jax.tree.leaves(rest, is_leaf=is_newton)):
        if state.J.shape == (root.size, root.size):
            return state.J
    return jax.jacfwd(lambda y: rewrite_fn(y, rest, inputs))(root)


@_jacobian.def_jvp
def _jacobian_jvp(primals: Any, tangents: Any) -> tuple[Array, Array]:
    root, rest, inputs, rewrite_fn = primals
    moved = lambda x, inputs: jax.jacfwd(lambda y: rewrite_fn(y, rest, inputs))(x)
    return directional(moved, (root, inputs), (tangents[0], tangents[2]))
