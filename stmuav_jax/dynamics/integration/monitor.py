"""Monitors of a run: extreme values and first zero crossings of signals, also between steps.

Between two accepted steps a signal is Hermite's cubic through its values and rates at both, so
that extremes and crossings are those of the motion and not of the steps:

    g(t0 + s h) = a + b s + c s^2 + d s^3,    a = g0,    b = h g0',
    c = 3 (g1 - g0) - h (2 g0' + g1'),        d = 2 (g0 - g1) + h (g0' + g1').

A signal without rates (reactions, whose rates cost more than the run) is also evaluated within
the step, a quarter of it apart, at states on the cubic through the states and slopes of both
ends. Its rates are those of the quartic through its five values, and between neighbouring places
the signal is again Hermite's cubic.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

# Number of parts of a step at whose ends signals without rates are evaluated, and weights of the
# five values in the rates of their quartic, for places one apart (Fornberg 1988, Math. Comp. 51).
_PARTS = 4
_RATES = (
    (-25 / 12, 4.0, -3.0, 4 / 3, -1 / 4),
    (-1 / 4, -5 / 6, 3 / 2, -1 / 2, 1 / 12),
    (1 / 12, -2 / 3, 0.0, 2 / 3, -1 / 12),
    (-1 / 12, 1 / 2, -3 / 2, 5 / 6, 1 / 4),
    (1 / 4, -4 / 3, 3.0, -4.0, 25 / 12),
)

# Number of halvings of a step that locate a crossing to round-off.
_HALVINGS = 60


class Span(NamedTuple):
    """Values and rates of q signals (or states) at both ends of a step from t0 to t1 [s]."""

    t0: Float[Array, ""]
    t1: Float[Array, ""]
    g0: Float[Array, " q"]
    g1: Float[Array, " q"]
    rate0: Float[Array, " q"]
    rate1: Float[Array, " q"]


class Cubic(NamedTuple):
    """Cubic polynomials a + b s + c s^2 + d s^3 for s from 0 to 1, (q,) each."""

    a: Float[Array, " q"]
    b: Float[Array, " q"]
    c: Float[Array, " q"]
    d: Float[Array, " q"]

    def __call__(self, s: Float[Array, " q"] | Float[Array, ""]) -> Float[Array, " q"]:
        return self.a + s * (self.b + s * (self.c + s * self.d))


def cubic(span: Span) -> Cubic:
    """Hermite's cubic of a step."""
    h = span.t1 - span.t0
    b, end, rise = h * span.rate0, h * span.rate1, span.g1 - span.g0
    return Cubic(span.g0, b, 3 * rise - 2 * b - end, b + end - 2 * rise)


def peak(curve: Cubic) -> Float[Array, " q"]:
    """Place of the cubic's maximum in (0, 1); 1 where there is none inside (q,)."""
    b, c, d = curve.b, curve.c, curve.d
    square = c * c - 3 * b * d
    root = jnp.sqrt(jnp.maximum(square, 0.0))
    # the form of the quadratic's solution without cancellation
    first = b / jnp.where(root - c == 0, 1.0, root - c)
    second = (-c - root) / jnp.where(d == 0, 1.0, 3 * d)
    s = jnp.where(c <= 0, first, second)
    exists = (square > 0) & jnp.where(c <= 0, root - c != 0, d != 0)
    return jnp.where(exists & (s > 0) & (s < 1), s, 1.0)


def highest(span: Span) -> Float[Array, " q"]:
    """Largest value over a step (q,)."""
    curve = cubic(span)
    # to first order the maximum does not depend on its place, whose derivative may not exist
    top = curve(jax.lax.stop_gradient(peak(curve)))
    return jnp.maximum(jnp.maximum(span.g0, span.g1), top)


class Crossings(eqx.Module):
    """First rises of q signals above zero.

    `span` is the step of the first rise or, where none was `found` yet, the last step.
    """

    span: Span
    found: Bool[Array, " q"]

    def times(self) -> Float[Array, " q"]:
        """Times of the first rises (q,) [s]; infinite where there is none."""
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
    """Extremes and crossings of one run so far.

    Attributes:
        g, rate: values and rates of the signals after the last accepted step (q,).
        extreme: largest values so far (q,).
        crossings: first rises above zero.
    """

    g: Float[Array, " q"]
    rate: Float[Array, " q"]
    extreme: Float[Array, " q"]
    crossings: Crossings


def start(t: Float[Array, ""], g: Float[Array, " q"], rate: Float[Array, " q"]) -> Monitor:
    """Monitor at the start of a run; a signal above zero there counts as a crossing."""
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
    """Monitor after an accepted step from t0 to t1, with signals g and their rates at its end."""
    span = Span(t0, t1, monitor.g, g, monitor.rate, rate)
    top = highest(span)
    before = monitor.crossings
    kept = jax.tree.map(lambda old, new: jnp.where(before.found, old, new), before.span, span)
    return Monitor(
        g, rate, jnp.maximum(monitor.extreme, top), Crossings(kept, before.found | (top > 0))
    )


def follow_parts(
    monitor: Monitor, step: Span, signals: Callable[[Array, Array], Float[Array, " q"]]
) -> Monitor:
    """Monitor of signals without rates after an accepted step.

    Args:
        step: states and their slopes at both ends of the step (n,), instead of signals and rates.
        signals: function of (t, y) that returns the signals (q,).
    """
    curve = cubic(step)
    h = step.t1 - step.t0
    places = jnp.arange(1, _PARTS + 1, dtype=h.dtype) / _PARTS

    def at(s: Array) -> Array:
        # at the end, exactly the state with which the integration continues
        return signals(step.t0 + s * h, jnp.where(s < 1, curve(s), step.g1))

    values = jnp.concatenate([monitor.g[None], jax.lax.map(at, places)])
    weights = jnp.asarray(_RATES, h.dtype)
    # term by term, so that the rounding is the same in every batch slot
    rates = jnp.sum(weights[:, :, None] * values[None], axis=1)
    rates = rates * jnp.where(h > 0, _PARTS / jnp.where(h > 0, h, 1.0), 0.0)
    times = jnp.concatenate([step.t0[None], step.t0 + places[:-1] * h, step.t1[None]])
    for k in range(_PARTS):
        begun = eqx.tree_at(lambda m: m.rate, monitor, rates[k])
        monitor = follow(begun, times[k], times[k + 1], values[k + 1], rates[k + 1])
    return monitor
