"""Rotor speeds and the wrench that they give.

The squared speeds u = omega^2 of k rotors without curves give thrust and moments linearly: w = B u,
w = (f_z, tau_x, tau_y, tau_z) about a point. `minimum_norm` is the minimum-norm u with B u = w, whose
speeds therefore differ least. Of rotors with curves B is the derivative at given speeds.

Source: report Part II, Eq. 4.10, with B_M built from the arms themselves (corrected).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, check_finite, has_values
from ..checks.numbers import as_floats, as_numpy
from ..checks.shapes import Numbers
from ..math import linalg
from ..math.compiler import quick_jit
from .rotor import Rotors

# Rows of a body-frame wrench (force, moment) that rotors with parallel axes can give.
_ROWS = (2, 3, 4, 5)


@quick_jit
def wrench_map(
    rotors: Rotors, about: Float[Array, "3"], at: Float[Array, " k"] | None = None
) -> Float[Array, "4 k"]:
    """Allocation matrix B: thrust [N] and moments [N m] about a point of the body per unit of u.

    Args:
        at: squared speeds at which the derivative is taken; only rotors with curves need them.

    Raises:
        ModelError: rotors with curves, but no speeds.
    """
    if at is None:
        if rotors.has_curves:
            raise ModelError(
                f"The rotors of body '{rotors.body}' have curves: their wrench is not linear in the squared "
                "speeds, so that wrench_map needs the speeds 'at' which to take its derivative."
            )
        at = jnp.zeros_like(rotors.arms[:, 0])
    return jax.jacfwd(lambda u: rotors.wrench(u, about)[jnp.array(_ROWS)])(at)


def minimum_norm(B: Float[Array, "4 k"], wrench: Float[Array, "4"]) -> Float[Array, " k"]:
    """Minimum-norm u with B u = wrench; NaN where the rotors cannot give every wrench."""
    gram = B @ B.T
    scale = 1 / jnp.sqrt(jnp.diagonal(gram))
    factor = linalg.Factor(linalg.factor_cholesky(scale[:, None] * gram * scale))
    return B.T @ (scale * factor.solve(scale * wrench))


class RotorLimits(NamedTuple):
    """Lowest and highest speeds of the rotors [rad/s], one number () or one for each (k,)."""

    lowest: Numbers
    highest: Numbers

    def squared(self, count: int) -> tuple[Float[Array, " k"], Float[Array, " k"]]:
        """Smallest and largest squared speeds u of `count` rotors (k,) [rad^2/s^2].

        Raises:
            ModelError: limits that are not finite, not 0 <= lowest < highest, or not k.
        """
        speed_limits = []
        for name, value in (("lowest", self.lowest), ("highest", self.highest)):
            check_finite(value, f"The {name} rotor speed", "rad/s")
            speed = as_numpy(as_floats(value))
            if speed.shape not in ((), (count,)):
                raise ModelError(
                    f"The {name} rotor speed must be one number or one for each of {count} rotors, "
                    f"but its shape is {speed.shape}."
                )
            speed_limits.append(speed + np.zeros(count))
        lowest, highest = speed_limits
        if has_values(speed_limits) and not np.all(right := (lowest >= 0) & (lowest < highest)):
            k = int(np.argmin(right))
            raise ModelError(
                f"The speed limits of a rotor must be 0 <= lowest < highest, but those of rotor {k + 1} "
                f"are {float(lowest[k]):g} and {float(highest[k]):g} rad/s."
            )
        return as_floats(lowest**2), as_floats(highest**2)


def check_lift(
    rotors: Rotors, limits: RotorLimits, weight: Numbers
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Smallest and largest thrust [N] of rotors within limits, which must bracket the weight [N].

    Raises:
        ModelError: the weight lies outside; the message has the required and available thrust.
    """
    if rotors.has_curves:
        bounds = limits.squared(rotors.spin.shape[0])
        smallest, largest = (jnp.sum(rotors.thrusts(bound)) for bound in bounds)
    else:
        k_f, *bounds = as_numpy((rotors.k_f, *limits.squared(rotors.spin.shape[0])))
        smallest, largest = (as_floats(k_f * bound.sum()) for bound in bounds)
    if not has_values(smallest, largest, weight):
        return smallest, largest
    range_of = (
        f"rotors of body '{rotors.body}' give {float(smallest):.4g} to {float(largest):.4g} N"
    )
    if (needed := float(as_floats(weight))) > float(largest):
        shortfall = f"{needed:.4g} N are required, but within their speed limits the {range_of}"
        raise ModelError(f"The rotors cannot carry the weight: {shortfall}.")
    if needed < float(smallest):
        raise ModelError(
            f"The rotors cannot turn slowly enough to hover: the weight is {needed:.4g} N, "
            f"but within their speed limits the {range_of}."
        )
    return smallest, largest
