"""Smooth one-sided push of a spring and damper: a ramp with a smooth start, its slope and its area.

`EndStop` and `GroundContact` push by it. The derivation is in docs/dynamics.md.
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float


def ramp(d: Float[Array, ""], w: Float[Array, ""]) -> Float[Array, ""]:
    """Smooth ramp: 0 up to d = 0, d - w/2 from d = w, three times continuously differentiable."""
    u = jnp.clip(d / w, 0.0, 1.0)
    inner = w * u**4 * (2.5 - 3 * u + u * u)
    return jnp.where(d < w, inner, d - 0.5 * w)


def ramp_slope(d: Float[Array, ""], w: Float[Array, ""]) -> Float[Array, ""]:
    """Derivative of `ramp` with respect to d, from 0 to 1."""
    u = jnp.clip(d / w, 0.0, 1.0)
    return u**3 * (10 - 15 * u + 6 * u * u)


def ramp_area(d: Float[Array, ""], w: Float[Array, ""]) -> Float[Array, ""]:
    """Integral of `ramp` from 0 to d."""
    u = jnp.clip(d / w, 0.0, 1.0)
    inner = w * w * u**5 * (0.5 - 0.5 * u + u * u / 7)
    return jnp.where(d < w, inner, 0.5 * (d - 0.5 * w) ** 2 + w * w / 56)


def one_sided_push(
    depth: Float[Array, ""],
    rate: Float[Array, ""],
    stiffness: Float[Array, ""],
    damping: Float[Array, ""],
    width: Float[Array, ""],
) -> Float[Array, ""]:
    """Push of a spring and damper at a depth, E/2 + ramp(E + D, E), which is never negative.

        E = stiffness ramp(depth, width)     D = damping ramp'(depth, width) rate

    It is zero up to the depth 0 and twice continuously differentiable in depth and rate. Less the
    spring's E, it is the damper's part, which always dissipates energy.

    Args:
        depth: depth of the contact d [m] or [rad]. rate: its rate [m/s] or [rad/s].
        stiffness: [N/m] or [N m/rad]. damping: [N s/m] or [N m s/rad]. width: of the ramp's start,
            as the depth.
    """
    spring = stiffness * ramp(depth, width)
    damper = damping * ramp_slope(depth, width) * rate
    # the division's derivatives contain 1 / spring^3, which overflows for smaller values
    contact = spring > np.finfo(spring.dtype).tiny ** 0.25
    span = jnp.where(contact, spring, 1.0)
    # half of the push remains: if all of it vanished before the spring is slack, no force would
    # show the step control that the spring's potential is still being released
    return jnp.where(contact, 0.5 * span + ramp(span + damper, span), 0.0)
