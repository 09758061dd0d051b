"""Battery as a voltage source behind a resistance: current, state of charge, endurance.

With the open-circuit voltage U(s) at the state of charge s, capacity Q, resistance R and power P,

    P = (U - R I) I,   I = 2 P / (U + sqrt(U^2 - 4 R P)),   ds/dt = -I / Q.

Of the two currents that give P this is the smaller. No current gives more than U^2 / (4 R).
Polarisation, temperature and ageing are left out.

Source: O. Tremblay, L.-A. Dessaint, Experimental validation of a battery dynamic model for EV
applications, World Electric Vehicle Journal 3 (2009) 289, of which this is the part without
polarisation, with a table for U(s).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, StateError, check_finite, has_values
from ..checks.numbers import as_floats, as_numpy, check_nonnegative, check_positive
from ..checks.shapes import Numbers
from ..math.derivative import safe_sqrt
from ..mechanics.parameters import Parameters
from .airframe import ENERGY

# Gauss-Legendre points on each straight piece of the open-circuit voltage.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(20)
# Largest state of charge: that of a full battery, with round-off.
_FULL = 1.0 + 1e-9


class Battery(eqx.Module):
    """Battery with internal resistance.

    Args:
        capacity: charge Q from full to empty [C]; 1 Ah is 3600 C.
        resistance: R >= 0 [ohm].
        state_of_charge: places (n,) of the table, rising from 0 to 1 [1].
        open_circuit_voltage: U > 0 there (n,) [V], with straight lines between.
        reserve: state of charge at which the battery counts as empty, 0 <= reserve < 1 [1].

    Raises:
        ModelError: numbers out of range, or a table that does not rise from 0 to 1.
    """

    capacity: Float[Array, ""] = eqx.field(converter=as_floats)
    resistance: Float[Array, ""] = eqx.field(converter=as_floats)
    state_of_charge: Float[Array, " n"] = eqx.field(converter=as_floats)
    open_circuit_voltage: Float[Array, " n"] = eqx.field(converter=as_floats)
    reserve: Float[Array, ""] = eqx.field(converter=as_floats, default=0.0)

    def __check_init__(self) -> None:
        check_positive(self.capacity, "The battery's capacity", "C")
        check_nonnegative(self.resistance, "The battery's resistance", "ohm")
        check_nonnegative(self.reserve, "The battery's reserve", "")
        _check_table(self.state_of_charge, self.open_circuit_voltage)
        if has_values(self.reserve) and float(self.reserve) >= 1.0:
            raise ModelError(
                f"The battery's reserve must be below 1, but it is {float(self.reserve):g}: nothing "
                "of the charge is left to use."
            )

    @staticmethod
    def of(parameters: Parameters = ENERGY) -> "Battery":
        """Battery of a parameter table ("battery.")."""
        names = ("capacity", "resistance", "state_of_charge", "open_circuit_voltage", "reserve")
        return Battery(**{name: parameters.value(f"battery.{name}") for name in names})

    def voltage(self, soc: Numbers) -> Float[Array, "*s"]:
        """Open-circuit voltage (...) [V] at states of charge (...) [1].

        Raises:
            StateError: a state of charge outside 0 to 1.
        """
        return _open_voltage(self, _check_charge(soc))

    def largest_power(self, soc: Numbers) -> Float[Array, "*s"]:
        """Largest power U^2 / (4 R) that any current delivers (...) [W]; infinite for R = 0."""
        return self.voltage(soc) ** 2 / (4.0 * self.resistance)

    def current(self, power: Numbers, soc: Numbers) -> Float[Array, "*s"]:
        """Current I (...) [A] that delivers a power (...) [W]; below zero it charges.

        It is NaN beyond the largest power, where the arguments are traced by JAX.

        Raises:
            StateError: a power that is not finite or beyond the largest, or a state of charge outside
                0 to 1.
        """
        soc = _check_charge(soc)
        _check_power(self, power, soc)
        power = as_floats(power)
        margin = _power_margin(self, power, soc)
        root = safe_sqrt(jnp.maximum(margin, 0.0))
        return jnp.where(margin >= 0, 2.0 * power / (_open_voltage(self, soc) + root), jnp.nan)


def endurance(battery: Battery, power: Numbers, start: Numbers = 1.0) -> Float[Array, ""]:
    """Time from a state of charge to the reserve at a constant power, Q integral ds / I(s) [s].

    Args:
        battery: battery, whose leaves may be traced.
        power: P > 0 [W]. It is refused, or gives NaN if traced, beyond the largest power at the reserve.
        start: state of charge at the start [1].

    Raises:
        ModelError: a power that is not positive.
        StateError: a power beyond the largest, or a state of charge outside 0 to 1.
    """
    power, start = check_positive(power, "The power", "W"), _check_charge(start)
    # The integrand 1 / I(s) is smooth on each piece of the voltage's table only; the quadrature is done
    # piece by piece.
    edges = jnp.clip(battery.state_of_charge, battery.reserve, start)
    # Pieces outside of the used charge have length zero and add nothing: the number of pieces is
    # structure.
    half = jnp.diff(edges)[:, None] / 2
    soc = (edges[:-1] + edges[1:])[:, None] / 2 + half * _POINTS[None]
    # The voltage is lowest at the reserve, where a power beyond the largest shows first.
    battery.current(power, battery.reserve)
    time = battery.capacity * jnp.sum(half * _WEIGHTS[None] / battery.current(power, soc))
    return jnp.where(_power_margin(battery, power, battery.reserve) >= 0, time, jnp.nan)


def _power_margin(battery: Battery, power: Array, soc: Array) -> Array:
    """U^2 - 4 R P [V^2], below zero beyond the largest power."""
    return _open_voltage(battery, soc) ** 2 - 4.0 * battery.resistance * power


def _open_voltage(battery: Battery, soc: Array) -> Array:
    """Open-circuit voltage; beyond the table's ends that of its ends."""
    return jnp.interp(soc, battery.state_of_charge, battery.open_circuit_voltage)


def _check_charge(soc: Numbers) -> Array:
    """States of charge as an array; `StateError` outside 0 to 1."""
    if has_values(soc):
        values = np.atleast_1d(np.asarray(soc, dtype=float))
        outside = values[~((values >= 0) & (values <= _FULL))]
        if outside.size:
            raise StateError(
                "A battery's state of charge must lie from 0 (empty) to 1 (full), but it is "
                f"{outside[0]:g}."
            )
    return as_floats(soc)


def _check_power(battery: Battery, power: Numbers, soc: Numbers) -> None:
    """Raise `StateError` for the power that is furthest beyond the largest."""
    if not has_values(battery, power, soc):
        return
    battery = as_numpy(battery)
    voltage = np.interp(soc, battery.state_of_charge, battery.open_circuit_voltage)  # pyright: ignore
    voltage, powers, charges = np.broadcast_arrays(
        voltage, np.asarray(power, float), np.asarray(soc)
    )
    if not np.all(np.isfinite(powers)):
        raise StateError(
            f"The power of a battery must be finite, but it is {powers[~np.isfinite(powers)][0]:g} W."
        )
    excess = 4.0 * battery.resistance * powers - voltage**2
    if np.any(excess > 0):
        k = np.unravel_index(np.argmax(excess), excess.shape)
        largest = float(battery.largest_power(charges[k]))
        raise StateError(
            f"The battery cannot deliver {powers[k]:g} W at a state of charge of {charges[k]:g}: with "
            f"{voltage[k]:.4g} V behind {float(battery.resistance):g} ohm no current gives more than "
            f"{largest:.4g} W."
        )


def _check_table(soc: Array, voltage: Array) -> None:
    if soc.ndim != 1 or soc.shape != voltage.shape or soc.shape[0] < 2:
        raise ModelError(
            "The battery's table needs two or more states of charge and one voltage for each, but "
            f"their shapes are {soc.shape} and {voltage.shape}."
        )
    check_finite((soc, voltage), "The battery's table", "")
    if not has_values(soc, voltage):
        return
    places, volts = np.asarray(soc), np.asarray(voltage)
    if places[0] != 0.0 or places[-1] != 1.0 or np.any(np.diff(places) <= 0):
        raise ModelError(
            f"The battery's states of charge must rise from 0 to 1, but they are {places.tolist()}."
        )
    if np.any(volts <= 0):
        raise ModelError(
            f"The battery's open-circuit voltages must be positive, but the lowest is {volts.min():g} V."
        )
