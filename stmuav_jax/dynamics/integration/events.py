"""Events that end an integration, in the terms of diffrax.

A run that starts at a zero of its event function, such as the next arc of a bouncing ball, starts
after that event and not before it. An event function that becomes NaN ends the run with the
result `diffrax.RESULTS.nonfinite`.
"""

from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float

from .problem import IntegrationState, Problem, SegmentEnd, landing

# A run starts at its event if the event function is zero within this many tolerances, in seconds,
# after or before the start.
_NEAR = 1e3


class _OfOne(optx.AbstractRootFinder):
    """Root finder for the sum of several event functions, of which all but one are zero."""

    inner: optx.Bisection

    @property
    def rtol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.rtol

    @property
    def atol(self) -> Any:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.inner.atol

    @property
    def norm(self) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return optx.max_norm

    def init(self, fn: Any, y: Any, args: Any, options: Any, f_struct: Any, *rest: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        one, of = jax.tree.leaves(f_struct)[0], _sum(fn)
        lower, upper = options["lower"], options["upper"]
        low, high = of(lower, args)[0], of(upper, args)[0]
        # bisection needs a change of sign: a zero at one end becomes the negative of the other
        low, high = jnp.where(low == 0, -high, low), jnp.where(high == 0, -low, high)

        def ends(t: Any, args: Any) -> Any:
            value, aux = of(t, args)
            return jnp.where(t <= lower, low, jnp.where(t >= upper, high, value)), aux

        return self.inner.init(ends, y, args, options, one, *rest)

    def step(self, fn: Any, *rest: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.inner.step(_sum(fn), *rest)

    def terminate(self, fn: Any, *rest: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.inner.terminate(_sum(fn), *rest)

    def postprocess(self, fn: Any, *rest: Any) -> Any:  # pyright: ignore[reportIncompatibleMethodOverride]
        return self.inner.postprocess(_sum(fn), *rest)


def _sum(fn: Any) -> Any:
    def summed(y: Any, args: Any) -> Any:
        value, aux = fn(y, args)
        return sum(jax.tree.leaves(value)), aux

    return summed


def to_event(
    problem: Problem,
    carry: IntegrationState,
    t1: Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint,
) -> SegmentEnd:
    """Integrate from the carry to t1 [s], or to an event before it."""
    method = problem.method
    assert method.event is not None
    condition = method.event

    def value(t: Any, y: Any, args: Any, **_: Any) -> Array:
        state = method.formulation.to_state(args, y[: problem.n_state])
        return jnp.asarray(condition(t, state))

    kind = jax.eval_shape(lambda: value(carry.t, carry.y, problem.model)).dtype
    if kind == jnp.bool_:
        event = diffrax.Event(value)
    else:
        start, sign = _at_start(problem, carry, value)

        def crossing(t: Any, y: Any, args: Any, **_: Any) -> Array:
            now = value(t, y, args)
            now = jnp.where(jnp.isnan(now), 1.0, now)
            return jnp.where(start & (t <= carry.t), sign, now)

        lost = lambda t, y, args, **_: jnp.isnan(value(t, y, args))
        finder = _OfOne(inner=optx.Bisection(rtol=1e-12, atol=1e-14))  # pyright: ignore[reportCallIssue]
        # in this order: if the first is true, the second is ignored
        event = diffrax.Event((lost, crossing), finder, (None, method.direction))
    solution = problem.solve(carry, t1, adjoint, event=event)
    found = landing(solution)
    occurred = found.result == diffrax.RESULTS.event_occurred
    if kind != jnp.bool_:
        bad = occurred & solution.event_mask[0]  # pyright: ignore[reportOptionalSubscript]
        nonfinite: Any = diffrax.RESULTS.nonfinite
        result = diffrax.RESULTS.where(bad, nonfinite, found.result)
        found, occurred = found._replace(result=result), occurred & ~bad
    # the event's time comes from interpolation, the state at it from steps
    again = jax.lax.cond(
        occurred, lambda: landing(problem.solve(carry, found.t, adjoint)), lambda: found
    )
    return again._replace(result=found.result)


def _at_start(
    problem: Problem, carry: IntegrationState, value: Any
) -> tuple[Bool[Array, ""], Float[Array, ""]]:
    """True if the run starts at its event, and the event function right after the start."""
    carry_t, y, model = jax.lax.stop_gradient((carry.t, carry.y, problem.model))
    h = jnp.asarray(problem.method.first_step, y.dtype)
    half = y + h / 2 * problem.field(carry_t, y, model)
    after = y + h * problem.field(carry_t + h / 2, half, model)
    first, then = value(carry_t, y, model), value(carry_t + h, after, model)
    near = _NEAR * jnp.maximum(problem.method.rtol, problem.method.atol)
    at_event = jnp.abs(first) <= jnp.abs(then - first) * jnp.minimum(near / h, 1.0)
    return (carry.counts.accepted == 0) & at_event, jax.lax.stop_gradient(then)
