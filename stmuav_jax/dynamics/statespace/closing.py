"""Newton's method for the dependent coordinates of closed loops, from where they last closed.

One loop holds the only copy of a Newton step, with the way along the independent coordinates in it:
the compiler's time is that of the rows, and a filter has this in every stage of every step.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..tree.coordinates import TreeCoordinates, moved
from ..tree.topology import SpanningTree

# The independent coordinates are followed in parts of at most `_LONGEST` [rad], [m], with
# `_STEPS_EACH` steps of Newton's method each, so that it stays on its branch; at most `_MOST_PARTS`
# are gone. From there at most `_MOST_STEPS` more are made: steps below `_ROUND_OFF` that no longer
# halve end it.
_LONGEST, _STEPS_EACH, _MOST_PARTS = 0.1, 3, 1000
_MOST_STEPS, _ROUND_OFF = 30, 1e-8

Step = Callable[[TreeCoordinates], tuple[TreeCoordinates, Float[Array, ""]]]


def closed_from(
    tree: SpanningTree, at: TreeCoordinates, ahead: Float[Array, " n"], step: Step
) -> tuple[TreeCoordinates, Bool[Array, ""]]:
    """Coordinates with closed loops, and whether Newton's method has come to rest there.

    Derivatives of the first and second order are those of the implicit function.

    Args:
        at: independent coordinates as wanted, dependent ones as they last were.
        ahead: how far the independent ones have moved since (n,), in the tree's velocities.
        step: Newton's, of the dependent coordinates; and its largest component.
    """
    still = jax.lax.stop_gradient
    ahead = still(ahead)
    parts = jnp.ceil(jnp.max(jnp.abs(ahead), initial=0.0) / _LONGEST)
    part = ahead / jnp.maximum(parts, 1.0)
    # farther away, and where the distance is no number, nothing is followed and nothing found
    near = parts <= _MOST_PARTS
    on_the_way = jnp.where(near, _STEPS_EACH * parts, 0.0)

    def more(carry: Any) -> Array:
        _, size, before, k = carry
        stalled = (size < _ROUND_OFF) & ~(size < 0.5 * before)
        unfinished = (size > 0) & ~stalled & (k < on_the_way + _MOST_STEPS)
        return near & ((k < on_the_way) | unfinished)

    def again(carry: Any) -> Any:
        now, size, _, k = carry
        onwards = (k < on_the_way) & (jnp.mod(k, _STEPS_EACH) == 0)
        after, new = step(moved(tree, now, jnp.where(onwards, part, 0.0)))
        return after, new, size, k + 1

    start = moved(tree, still(at), -ahead)
    # with the axes of a stack from the first on: JAX goes through the loop until they do not change
    endless, none = parts + jnp.inf, 0.0 * parts
    there = jax.lax.while_loop(more, again, (start, endless, endless, none))[0]
    # the values found, with the derivatives of the given ones; of two steps more, the
    # derivatives are right up to the third
    at = jax.tree.map(lambda a, b: b + (a - still(a)), at, still(there))
    at, sizes = jax.lax.scan(lambda now, _: step(now), at, length=2)
    return at, near & (still(sizes[-1]) <= _ROUND_OFF)
