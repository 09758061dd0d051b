"""Battery as a voltage source behind a resistance: current, state of charge, endurance.

With the open-circuit voltage U(s) at the state of charge s, capacity Q, resistance R and power P,

    P = (U - R I) I,   I = 2 P / (U + sqrt(U^2 - 4 R P)),   ds/dt = -I / Q.

Of the two currents that give P this is the smaller. No current gives more than U^2 / (4 R).
Polarisation, temperature and ageing are left out.

Source: O. Tremblay, L.-A. Dessaint, Experimental validation of a battery dynamic model for EV
applications, World Electric Vehicle Journal 3 (2009) 289, of which this is the part without
polarisation, with a table for U(s).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float, Int

from ..checks.errors import ModelError, SettingError, StateError, check_finite, concrete
from ..checks.numbers import as_numpy, floats, nonnegative, positive
from ..checks.reason import AbstractReason
from ..checks.shapes import Numbers
from ..parameters.energy import ENERGY
from ..parameters.table import Parameters

# Gauss-Legendre points on each straight piece of the open-circuit voltage.
_POINTS, _WEIGHTS = np.polynomial.legendre.leggauss(20)
# A battery counts as full from here, so that one that starts full may discharge.
_FULL = 1.0 + 1e-9


class BatteryReason(AbstractReason):
    """Reason for which a discharge ended."""

    TIME_OVER = 0
    EMPTY = 1
    BEYOND_LARGEST_POWER = 2
    FULL = 3
    NOT_COMPUTED = 4


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

    capacity: Float[Array, ""]
    resistance: Float[Array, ""]
    state_of_charge: Float[Array, " n"]
    open_circuit_voltage: Float[Array, " n"]
    reserve: Float[Array, ""]

    def __init__(
        self,
        *,
        capacity: Numbers,
        resistance: Numbers,
        state_of_charge: Numbers,
        open_circuit_voltage: Numbers,
        reserve: Numbers = 0.0,
    ) -> None:
        self.capacity = positive(capacity, "The battery's capacity", "C")
        self.resistance = nonnegative(resistance, "The battery's resistance", "ohm")
        self.reserve = nonnegative(reserve, "The battery's reserve", "")
        self.state_of_charge = floats(state_of_charge)
        self.open_circuit_voltage = floats(open_circuit_voltage)
        _check_table(self.state_of_charge, self.open_circuit_voltage)
        if concrete(self.reserve) and float(self.reserve) >= 1.0:
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
        """Open-circuit voltage (...) [V] at states of charge (...) [1]."""
        return jnp.interp(floats(soc), self.state_of_charge, self.open_circuit_voltage)

    def largest_power(self, soc: Numbers) -> Float[Array, "*s"]:
        """Largest power U^2 / (4 R) that any current delivers (...) [W]; infinite for R = 0."""
        return self.voltage(soc) ** 2 / (4.0 * self.resistance)

    def current(self, power: Numbers, soc: Numbers) -> Float[Array, "*s"]:
        """Current I (...) [A] that delivers a power (...) [W]; below zero it charges.

        It is NaN beyond the largest power, where the arguments are traced by JAX.

        Raises:
            StateError: a power beyond the largest.
        """
        _check_power(self, power, soc)
        power, soc = floats(power), floats(soc)
        margin = _margin(self, power, soc)
        return jnp.where(margin >= 0, _current(self, power, soc), jnp.nan)

    def stored(self, soc: Numbers) -> Float[Array, "*s"]:
        """Chemical energy Q integral U ds from the reserve to a state of charge (...) [J]."""
        edges = self.state_of_charge
        upto = jnp.clip(floats(soc)[..., None], edges[:-1], edges[1:])
        parts = (upto - edges[:-1]) * (self.voltage(upto) + self.open_circuit_voltage[:-1]) / 2
        below = jnp.clip(self.reserve, edges[:-1], edges[1:])
        kept = (below - edges[:-1]) * (self.voltage(below) + self.open_circuit_voltage[:-1]) / 2
        return self.capacity * (jnp.sum(parts, axis=-1) - jnp.sum(kept))


def endurance(battery: Battery, power: Numbers, start: Numbers = 1.0) -> Float[Array, ""]:
    """Time from a state of charge to the reserve at a constant power, Q integral ds / I(s) [s].

    Args:
        battery: battery, whose leaves may be traced.
        power: P > 0 [W]. It is refused, or gives NaN if traced, beyond the largest power at the
            reserve; `discharge` says when such a flight ends.
        start: state of charge at the start [1].

    Raises:
        ModelError: a power that is not positive.
        StateError: a power beyond the largest.
    """
    power, start = positive(power, "The power", "W"), floats(start)
    edges = jnp.clip(battery.state_of_charge, battery.reserve, start)
    half = jnp.diff(edges)[:, None] / 2
    soc = (edges[:-1] + edges[1:])[:, None] / 2 + half * _POINTS
    battery.current(power, battery.reserve)
    time = battery.capacity * jnp.sum(half * _WEIGHTS / battery.current(power, soc))
    return jnp.where(_margin(battery, power, battery.reserve) >= 0, time, jnp.nan)


class Discharge(NamedTuple):
    """History of a battery at times (k,); NaN after the end.

    Attributes:
        ts: times (k,) [s].
        soc: states of charge (k,) [1].
        power, current, voltage: power (k,) [W], current (k,) [A] and voltage at the poles (k,) [V].
        delivered: energy delivered since the start (k,) [J].
        lost: energy lost as heat in the resistance since the start (k,) [J].
        end: time at which it ended [s].
        at_end: state of charge [1], energies delivered and lost [J] at the end (3,).
        reason: code of `BatteryReason`.
    """

    ts: Float[Array, " k"]
    soc: Float[Array, " k"]
    power: Float[Array, " k"]
    current: Float[Array, " k"]
    voltage: Float[Array, " k"]
    delivered: Float[Array, " k"]
    lost: Float[Array, " k"]
    end: Float[Array, ""]
    at_end: Float[Array, "3"]
    reason: Int[Array, ""]


def discharge(
    battery: Battery,
    power: Callable[[Float[Array, ""]], Any],
    ts: Numbers,
    *,
    start: Numbers = 1.0,
    tolerance: float = 1e-10,
) -> Discharge:
    """Discharge a battery by a power over time until the times are over or it can no more.

    It ends early where the battery is empty or full, or where the power is beyond its largest;
    the reason says so, and what came before is kept. Derivatives are those of reverse mode. Steps
    cross kinks of the voltage's table: there the end is accurate to some ten tolerances only, and its
    derivative to about 1e-5; `endurance` has both to round-off.

    Args:
        battery: battery at the start.
        power: function of the time [s] that gives the power [W]; below zero it charges.
        ts: times (k,) [s], rising; the first is the start.
        start: state of charge there [1].
        tolerance: relative and absolute tolerance of the integration, energies in shares of the
            full battery's.

    Raises:
        SettingError: times that do not rise.
    """
    if (
        np.ndim(ts) != 1
        or np.size(ts) < 2
        or (concrete(ts) and np.any(np.diff(np.asarray(ts)) <= 0))
    ):
        raise SettingError("The times of a discharge must be two or more that rise.")
    ts, start = floats(ts), floats(start)
    size = battery.stored(1.0)
    asked = lambda t: jnp.asarray(power(t), dtype=ts.dtype)

    def rate(t: Any, y: Any, args: Any) -> Array:
        del args
        current = _current(battery, asked(t), y[0])
        heat = battery.resistance * current**2
        return jnp.stack([-current / battery.capacity, asked(t) / size, heat / size])

    def margins(t: Any, y: Any) -> Array:
        left = _margin(battery, asked(t), y[0]) / battery.open_circuit_voltage[-1] ** 2
        return jnp.stack([y[0] - battery.reserve, left, _FULL - y[0]])

    y0 = jnp.stack([start, jnp.zeros_like(start), jnp.zeros_like(start)])
    event = diffrax.Event(
        lambda t, y, args, **_: jnp.min(margins(t, y)),
        optx.Bisection(rtol=1e-13, atol=1e-13),  # pyright: ignore[reportCallIssue]
    )
    found = diffrax.diffeqsolve(
        diffrax.ODETerm(rate), diffrax.Dopri8(), ts[0], ts[-1], None, y0,
        saveat=diffrax.SaveAt(subs=[diffrax.SubSaveAt(ts=ts), diffrax.SubSaveAt(t1=True)]),
        stepsize_controller=diffrax.PIDController(rtol=tolerance, atol=tolerance),
        event=event, throw=False,
    )  # fmt: skip
    over: Any = found.ys
    unable = jnp.min(margins(ts[0], y0)) <= 0
    end = jnp.where(unable, ts[0], found.ts[1][0])  # pyright: ignore
    last = jnp.where(unable, y0, over[1][0])
    early = unable | (found.result == diffrax.RESULTS.event_occurred)
    good = early | (found.result == diffrax.RESULTS.successful)
    which = 1 + jnp.argmin(margins(end, last))
    reason = jnp.where(early, which, jnp.where(good, 0, BatteryReason.NOT_COMPUTED))
    kept = (ts <= end) & good & ~unable
    soc, delivered, lost = jnp.where(kept, over[0].T, jnp.nan)
    asked_then = jnp.where(kept, jax.vmap(asked)(ts), jnp.nan)
    current = jnp.where(kept, _current(battery, asked_then, soc), jnp.nan)
    scale = jnp.stack([jnp.ones_like(size), size, size])
    return Discharge(
        ts, soc, asked_then, current, battery.voltage(soc) - battery.resistance * current,
        delivered * size, lost * size, end, last * scale, reason.astype(jnp.int8),
    )  # fmt: skip


def _margin(battery: Battery, power: Array, soc: Array) -> Array:
    """U^2 - 4 R P [V^2], below zero beyond the largest power."""
    return battery.voltage(soc) ** 2 - 4.0 * battery.resistance * power


def _current(battery: Battery, power: Array, soc: Array) -> Array:
    """Current [A]; beyond the largest power, that of which the voltage is half: the solver's steps
    may look there before they find the end."""
    margin = _margin(battery, power, soc)
    within = margin > 0
    root = jnp.where(within, jnp.sqrt(jnp.where(within, margin, 1.0)), 0.0)
    return 2.0 * power / (battery.voltage(soc) + root)


def _check_power(battery: Battery, power: Numbers, soc: Numbers) -> None:
    """Raise `StateError` for the power that is furthest beyond the largest."""
    if not concrete(battery, power, soc):
        return
    battery = as_numpy(battery)
    voltage = np.interp(soc, battery.state_of_charge, battery.open_circuit_voltage)  # pyright: ignore
    voltage, asked, at = np.broadcast_arrays(voltage, np.asarray(power, float), np.asarray(soc))
    excess = 4.0 * battery.resistance * asked - voltage**2
    if not np.any(excess > 0):
        return
    k = np.unravel_index(np.argmax(excess), excess.shape)
    largest = float(battery.largest_power(at[k]))
    raise StateError(
        f"The battery cannot deliver {asked[k]:g} W at a state of charge of {at[k]:g}: with "
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
    if not concrete(soc, voltage):
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
