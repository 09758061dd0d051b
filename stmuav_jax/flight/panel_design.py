"""Design study of a panel on a hovering UAV: the area, mass and efficiency at which it pays.

Rotors take a m^1.5 for a mass m. A panel of area A gives p A and weighs f + sigma A; it pays where

    gain = p A - a ((m0 + f + sigma A)^1.5 - m0^1.5) >= 0.

With x = sqrt(m) and s = p / sigma this is a cubic in x, s (x^2 - m0 - f) = a (x^3 - m0^1.5). The least
power per panel mass at which any area pays is that of the tangent through (m0 + f, a m0^1.5); for f = 0
it is dP/dm = 1.5 a sqrt(m0).

Source: docs/energy.md.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..checks.numbers import floats, nonnegative, positive
from ..checks.shapes import Numbers


class PanelDesign(NamedTuple):
    """Panel on a carrier, and what it costs to carry it.

    Attributes:
        power_factor: a, power of the carrier at 1 kg [W/kg^1.5]; it is `hover_power` of 1 kg over the
            efficiency of the motors.
        carrier_mass: m0 of the carrier without panel [kg].
        fixed_mass: f of what the panel needs whatever its area, such as a tracker [kg].
        areal_power: p, power of the cells per area [W/m^2].
        areal_mass: sigma, mass of the panel per area [kg/m^2].
    """

    power_factor: Numbers
    carrier_mass: Numbers
    fixed_mass: Numbers
    areal_power: Numbers
    areal_mass: Numbers


class BreakEven(NamedTuple):
    """Areas between which a panel pays; NaN where none does.

    Attributes:
        needed: least power per panel mass p / sigma at which some area pays [W/kg].
        pays: true where p / sigma reaches it.
        smallest, largest: areas of gain zero [m^2].
        best: area of largest gain [m^2]. gain: the gain there [W].
    """

    needed: Float[Array, ""]
    pays: Bool[Array, ""]
    smallest: Float[Array, ""]
    largest: Float[Array, ""]
    best: Float[Array, ""]
    gain: Float[Array, ""]


def panel_gain(design: PanelDesign, area: Numbers) -> Float[Array, "*s"]:
    """Power of the cells less the rotors' for its mass, at areas (...) [m^2], in W (...)."""
    a, m0, f, p, sigma = (floats(value) for value in design)
    A = floats(area)
    return p * A - a * ((m0 + f + sigma * A) ** 1.5 - m0**1.5)


def break_even(design: PanelDesign) -> BreakEven:
    """Areas at which a panel begins and ceases to pay, in closed form.

    At a fixed mass of exactly zero, `needed` has no finite derivative by that mass; the one that JAX
    returns there leaves the infinite part out. Its other derivatives are right.

    Raises:
        ModelError: a mass or a power that is negative, or zero where that makes no sense.
    """
    a = positive(design.power_factor, "The power of the carrier at 1 kg", "W/kg^1.5")
    m0 = positive(design.carrier_mass, "The carrier's mass", "kg")
    f = nonnegative(design.fixed_mass, "The mass that does not depend on the area", "kg")
    p = nonnegative(design.areal_power, "The power of the cells per area", "W/m^2")
    sigma = positive(design.areal_mass, "The panel's mass per area", "kg/m^2")
    start, total = m0**1.5, m0 + f
    # tangent: x^3 - 3 (m0 + f) x + 2 m0^1.5 = 0, its root above sqrt(m0 + f)
    tangent = 2.0 * jnp.sqrt(total) * jnp.cos(_arccos(-start / total**1.5) / 3.0)
    needed = 1.5 * a * tangent
    pays = p / sigma >= needed
    h = jnp.where(pays, p / sigma, needed) / (3.0 * a)
    # x = h (1 + 2 cos t), cos 3 t = 1 - c / (2 h^3)
    angle = _arccos(1.0 - (3.0 * h * total - start) / (2.0 * h**3)) / 3.0
    masses = jnp.stack([
        h * (1.0 + 2.0 * jnp.cos(angle - 2.0 * jnp.pi / 3.0)),
        h * (1.0 + 2.0 * jnp.cos(angle)),
        2.0 * h,
    ]) ** 2  # fmt: skip
    smallest, largest, best = jnp.where(pays, (masses - total) / sigma, jnp.nan)
    return BreakEven(needed, pays, smallest, largest, best, panel_gain(design, best))


def _arccos(cosine: Array) -> Array:
    """Angle of a cosine; at -1, where a rounding error may lead beyond, it is pi and has no slope."""
    inside = jnp.abs(cosine) < 1.0
    angle = jnp.arccos(jnp.where(inside, cosine, 0.0))
    return jnp.where(inside, angle, jnp.where(cosine < 0, jnp.pi, 0.0))
