"""Newton's method for few unknowns, each step from one evaluation of residuals and Jacobian.

Residuals and Jacobian at the solution stay in its state: who wants them (a conditioning number,
what is left) needs no second copy of the equations, which would double what is compiled.
"""

from functools import partial
from typing import Any

import equinox as eqx
import equinox.internal as eqxi
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

# Below this a residual that no longer halves is taken for round-off.
_ROUND_OFF = 1e-6


class NewtonState(eqx.Module):
    """y, its residuals r and Jacobian J, the largest residual, and whether to end."""

    y: Float[Array, " n"]
    r: Float[Array, " n"]
    J: Float[Array, "n n"]
    size: Float[Array, ""]
    done: Bool[Array, ""]


class Newton(optx.AbstractRootFinder):
    """For `optimistix.root_find` of a vector of n equations in a vector of n unknowns.

    Ends where no residual is above `atol`, where residuals are down to round-off and no longer
    halve (the better of the last two is kept), or where one is not finite. It is for the caller
    to say by the residuals in the solution's state, `solution.state.r`, whether that is good.
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
        of = lambda y: fn(y, args)
        push = lambda e: jax.jvp(of, (y,), (e,), has_aux=True)
        r, J, aux = jax.vmap(push, out_axes=(None, -1, None))(jnp.eye(y.shape[0], dtype=y.dtype))
        size = self.norm(r)
        stalled = (state.size < _ROUND_OFF) & ~(size < 0.5 * state.size)
        done = (size <= self.atol) | stalled | ~jnp.isfinite(size)
        worse = stalled & ~(size < state.size)
        now = NewtonState(y, r, J, size, done)
        kept = jax.tree.map(lambda a, b: jnp.where(worse, a, b), state, now)
        kept = eqx.tree_at(lambda s: s.done, kept, done)
        moved = kept.y - jnp.linalg.solve(kept.J, kept.r)
        return jnp.where(done, kept.y, moved), kept, aux

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


class Implicit(optx.AbstractAdjoint):
    """Derivatives of a root by the implicit function, dy = -(dr/dy)^-1 dr: in both modes, of any order.

    `optimistix.ImplicitAdjoint` looks at its linear solution by a host callback, and JAX keeps no
    program with callbacks in its compilation cache: it would be compiled again by every process.
    Here a singular Jacobian gives numbers that are not finite.
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
    # by `_rooted` again, so that this has derivatives too
    root, rest = _rooted(primal_fn, rewrite_fn, inputs)
    of = lambda y, given: rewrite_fn(y, rest, eqx.combine(given, still))
    rate = jax.jvp(lambda given: of(root, given), (varied,), (moved,))[1]
    J = jax.jacfwd(lambda y: of(y, varied))(root)
    zeros = jax.tree.map(
        lambda x: jax.custom_derivatives.zero_from_primal(x, symbolic_zeros=True), rest
    )
    return (root, rest), (-jnp.linalg.solve(J, rate), zeros)
