"""What is watched as a flight goes: extreme values and first crossings, between steps too.

Between two accepted steps a signal is the cubic through its values and rates at both (Hermite's),
so that extremes and crossings are those of the motion and not of the steps:

    g(t0 + s h) = a + b s + c s^2 + d s^3,    a = g0,    b = h g0',
    c = 3 (g1 - g0) - h (2 g0' + g1'),        d = 2 (g0 - g1) + h (g0' + g1').

A signal without rates (reactions, whose rates cost more than the flight) is evaluated at places
within the step too, a quarter of it apart, at states on the cubic through the states and slopes of
both ends. Its rates there are those of the quartic through its five values, and from place to place
it is Hermite's cubic again.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Parts of a step at whose ends signals without rates are evaluated, and the rates at these five
# places of the quartic through five values, for places one apart (Fornberg 1988, Math. Comp. 51).
_PARTS = 4
_RATES = (
    (-25 / 12, 4.0, -3.0, 4 / 3, -1 / 4),
    (-1 / 4, -5 / 6, 3 / 2, -1 / 2, 1 / 12),
    (1 / 12, -2 / 3, 0.0, 2 / 3, -1 / 12),
    (-1 / 12, 1 / 2, -3 / 2, 5 / 6, 1 / 4),
    (1 / 4, -4 / 3, 3.0, -4.0, 25 / 12),
)

# Halvings of a step that locate a crossing: to round-off.
_HALVINGS = 60


class Span(NamedTuple):
    """Signals over one step, q of them: times [s], values and rates at both ends (q,)."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    g0: Float[Array, " q"]
    g1: Float[Array, " q"]
    rate0: Float[Array, " q"]
    rate1: Float[Array, " q"]


class Cubic(NamedTuple):
    """a + b s + c s^2 + d s^3 for s from 0 to 1, (q,) each."""

    a: Float[Array, " q"]
    b: Float[Array, " q"]
    c: Float[Array, " q"]
    d: Float[Array, " q"]

    def __call__(self, s: Float[Array, " q"] | Float[Array, ""]) -> Float[Array, " q"]:
        return self.a + s * (self.b + s * (self.c + s * self.d))


def cubic(span: Span) -> Cubic:
    """The cubic of a step."""
    h = span.t1 - span.t0
    b, end, rise = h * span.rate0, h * span.rate1, span.g1 - span.g0
    return Cubic(span.g0, b, 3 * rise - 2 * b - end, b + end - 2 * rise)


def peak(curve: Cubic) -> Float[Array, " q"]:
    """Where in (0, 1) the cubic has its maximum; 1 where it has none inside."""
    b, c, d = curve.b, curve.c, curve.d
    square = c * c - 3 * b * d
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    # of the two forms of the same solution the one without cancellation
    first = b / jnp.where(root - c == 0, 1.0, root - c)
    second = (-c - root) / jnp.where(d == 0, 1.0, 3 * d)
    s = jnp.where(c <= 0, first, second)
    exists = (square > 0) & jnp.where(c <= 0, root - c != 0, d != 0)
    return jnp.where(exists & (s > 0) & (s < 1), s, 1.0)


def highest(span: Span) -> Float[Array, " q"]:
    """The largest value over a step (q,)."""
    curve = cubic(span)
    # its value does not change, to first order, with its place: exact, and defined without one
    top = curve(jax.lax.stop_gradient(peak(curve)))
    return jnp.maximum(jnp.maximum(span.g0, span.g1), top)


class Crossings(eqx.Module):
    """The step in which each of q signals first rises above zero; the last one so far elsewhere."""

    span: Span
    found: Bool[Array, " q"]

    def times(self) -> Float[Array, " q"]:
        """When each of them does [s]; infinite where it never did (q,)."""
        curve = cubic(self.span)
        low, high = jnp.zeros_like(curve.a), peak(curve)
        high = jnp.where(curve(high) > 0, high, 1.0)

        def halve(_: Any, ends: tuple[Array, Array]) -> tuple[Array, Array]:
            low, high = ends
            middle = 0.5 * (low + high)
            above = curve(middle) > 0
            return jnp.where(above, low, middle), jnp.where(above, middle, high)

        _, s = jax.lax.fori_loop(0, _HALVINGS, halve, (low, high))
        s = jnp.where(self.span.g0 > 0, 0.0, s)
        t = self.span.t0 + s * (self.span.t1 - self.span.t0)
        return jnp.where(self.found, t, jnp.inf)


class Monitor(eqx.Module):
    """Running results of one flight.

    Attributes:
        g, rate: signals at the last accepted step (q,).
        extreme: the largest so far (q,).
        crossings: the first rises above zero.
    """

    g: Float[Array, " q"]
    rate: Float[Array, " q"]
    extreme: Float[Array, " q"]
    crossings: Crossings


def start(t: Float[Array, ""], g: Float[Array, " q"], rate: Float[Array, " q"]) -> Monitor:
    """At the start of a flight; a signal above zero there has crossed already."""
    wide = lambda x: jnp.broadcast_to(x, g.shape)
    span = Span(wide(t), wide(t), g, g, rate, rate)
    return Monitor(g, rate, g, Crossings(span, g > 0))


def follow(
    monitor: Monitor,
    t0: Float[Array, ""],
    t1: Float[Array, ""],
    g: Float[Array, " q"],
    rate: Float[Array, " q"],
) -> Monitor:
    """After an accepted step from t0 to t1 with signals g and their rates at its end."""
    span = Span(t0, t1, monitor.g, g, monitor.rate, rate)
    top = highest(span)
    before = monitor.crossings
    kept = jax.tree.map(lambda old, new: jnp.where(before.found, old, new), before.span, span)
    return Monitor(
        g, rate, jnp.maximum(monitor.extreme, top), Crossings(kept, before.found | (top > 0))
    )


class Step(NamedTuple):
    """An accepted step: times [s], states and their slopes at both ends (n,)."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    y0: Float[Array, " n"]
    y1: Float[Array, " n"]
    slope0: Float[Array, " n"]
    slope1: Float[Array, " n"]


def follow_parts(
    monitor: Monitor, step: Step, signals: Callable[[Array, Array], Float[Array, " q"]]
) -> Monitor:
    """After an accepted step with signals (t, y) -> (q,) that have no rates."""
    curve = cubic(Span(*step))
    h = step.t1 - step.t0
    places = jnp.arange(1, _PARTS + 1, dtype=h.dtype) / _PARTS

    def at(s: Array) -> Array:
        # the end is the state that goes on, to the last digit
        return signals(step.t0 + s * h, jnp.where(s < 1, curve(s), step.y1))

    values = jnp.concatenate([monitor.g[None], jax.lax.map(at, places)])
    weights = jnp.asarray(_RATES, h.dtype)
    # term by term, so that it is rounded alike in every lane
    rates = jnp.sum(weights[:, :, None] * values[None], axis=1)
    rates = rates * jnp.where(h > 0, _PARTS / jnp.where(h > 0, h, 1.0), 0.0)
    times = jnp.concatenate([step.t0[None], step.t0 + places[:-1] * h, step.t1[None]])
    for k in range(_PARTS):
        begun = eqx.tree_at(lambda m: m.rate, monitor, rates[k])
        monitor = follow(begun, times[k], times[k + 1], values[k + 1], rates[k + 1])
    return monitor
