"""Instruments: sensors that read at their own rate, with noise, bias and delay."""

import dataclasses
import math
from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..analysis.sensors import AbstractSensor, SensedMotion
from ..checks.errors import SettingError, has_values
from ..checks.numbers import as_floats, check_numbers
from ..checks.shapes import Numbers
from ..math.native.program import native
from ..math.space import Point
from ..mechanics.system import System

# Relative difference from a whole number that counts as round-off of the given rates and delays.
_WHOLE = 1e-9


class SensorFault(NamedTuple):
    """Outage of an instrument, whose readings are NaN, or a step of its bias, for a time.

    Attributes:
        at, until: times of the first reading with the fault, and of the first one without it [s].
        bias: error that is added, as `Instrument.bias`; None for an outage.
    """

    at: Numbers
    until: Numbers = math.inf
    bias: Numbers | None = None


class Instrument(eqx.Module):
    """Sensor with the numbers of its datasheet.

    Args:
        sensor: the ideal sensor.
        rate: readings per second [Hz]; by default one per control period.
        noise: standard deviation of a reading's white noise, one number or one for each
            component (c,), in the units of the sensor's errors. A noise density [unit/sqrt(Hz)]
            becomes one by multiplication with sqrt(rate).
        bias: constant error of every reading, as `noise`.
        delay: time from the motion to the arrival of its reading at the controller [s], whole control periods.
        faults: outages and steps of the bias, each a `SensorFault`; several add up.

    Raises:
        SettingError: a rate or delay that is not finite, a rate that is not positive, a delay or a noise
            below zero, or no sensor.
    """

    sensor: AbstractSensor
    rate: float | None = eqx.field(static=True, default=None)
    noise: Numbers | None = None
    bias: Numbers | None = None
    delay: float = eqx.field(static=True, default=0.0)
    faults: tuple[SensorFault, ...] = ()

    def __check_init__(self) -> None:
        if not isinstance(self.sensor, AbstractSensor):
            raise SettingError(
                f"An instrument needs a sensor such as Gyroscope('base'), not {self.sensor!r}."
            )
        if self.rate is not None and not 0 < self.rate < float("inf"):
            raise SettingError(
                f"The rate of the sensor '{self.name}' must be positive and finite, but it is "
                f"{self.rate} Hz."
            )
        if not 0 <= self.delay < float("inf"):
            raise SettingError(
                f"The delay of the sensor '{self.name}' must be finite and not negative, but it is "
                f"{self.delay} s."
            )
        noise = np.asarray(self.noise if has_values(self.noise) else None)
        if noise.dtype.kind in "biuf" and np.any(noise < 0):
            raise SettingError(
                f"The noise of the sensor '{self.name}' must not be negative, since it is a standard deviation, "
                f"but it is {noise.tolist()}."
            )

    @property
    def name(self) -> str:
        """Name of the sensor."""
        return self.sensor.name

    def periods(self, rate: float) -> int:
        """Number of control periods between readings at a control rate [Hz].

        Raises:
            SettingError: the control rate is not a multiple of the sensor's.
        """
        if self.rate is None:
            return 1
        return count_periods(self.rate, rate, f"The sensor '{self.name}'")

    def delayed(self, rate: float) -> int:
        """Delay as a number of control periods; raises `SettingError` if that is not whole."""
        return whole_periods(self.delay, rate, f"The delay of the sensor '{self.name}'")


def count_periods(reading_rate: float, rate: float, owner: str) -> int:
    """Number of control periods between readings [Hz]; raises `SettingError` if it is not whole."""
    ratio = rate / reading_rate
    whole = round(ratio)
    # Readings at control samples only, since the motion is known there.
    if whole < 1 or abs(ratio - whole) > _WHOLE * ratio:
        floor_count, ceiling_count = max(int(ratio), 1), max(int(ratio), 1) + 1
        raise SettingError(
            f"{owner} reads at {reading_rate:g} Hz, which does not divide the control rate of "
            f"{rate:g} Hz: the nearest valid rates are {rate / floor_count:.6g} Hz (every {floor_count} periods) and "
            f"{rate / ceiling_count:.6g} Hz (every {ceiling_count} periods)."
        )
    return whole


def whole_periods(time: float, rate: float, subject: str) -> int:
    """Number of control periods in a time [s]; raises `SettingError` if it is not whole."""
    count = time * rate
    whole = round(count)
    if abs(count - whole) > _WHOLE * max(count, 1.0):
        raise SettingError(
            f"{subject} must be a whole number of control periods of {1e3 / rate:.6g} ms, but it is "
            f"{1e3 * time:.6g} ms, which are {count:.6g} periods."
        )
    return whole


class Reading(NamedTuple):
    """Reading of an instrument, as passed to the estimator.

    Attributes:
        value: the last reading that has arrived.
        fresh: true if it has arrived at this sample; otherwise it is held from an earlier one.
    """

    value: Any
    fresh: Bool[Array, ""]


class Bench(eqx.Module):
    """Instruments of a plant with the numbers of periods between and before their readings.

    Attributes:
        instruments: the instruments, with `noise` and `bias` as arrays of the components.
        every, late: periods between readings, and of delay, of each instrument.
    """

    instruments: tuple[Instrument, ...]
    rate: float = eqx.field(static=True)
    every: tuple[int, ...] = eqx.field(static=True)
    late: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, entries: tuple[Any, ...], system: System, rate: float) -> None:
        instruments = []
        for instrument in entries:
            instrument = (
                instrument if isinstance(instrument, Instrument) else Instrument(instrument)
            )
            size = len(instrument.sensor.components(system))

            def spread(
                value: Any, label: str, size: int = size, name: str = instrument.name
            ) -> Any:
                if value is None:
                    return None
                shape = () if np.ndim(value) == 0 else (size,)
                quantity = f"The {label} of the sensor '{name}'"
                numbers = check_numbers(value, shape, quantity, "", SettingError)
                return jnp.broadcast_to(numbers, (size,))

            faults = tuple(
                SensorFault(as_floats(at), as_floats(until), spread(bias, "step of the bias"))
                for at, until, bias in instrument.faults
            )
            errors = {name: spread(getattr(instrument, name), name) for name in ("noise", "bias")}
            instruments.append(dataclasses.replace(instrument, faults=faults, **errors))
        names = [instrument.name for instrument in instruments]
        duplicates = sorted({name for name in names if names.count(name) > 1})
        if duplicates:
            raise SettingError(f"Two instruments have the name {', '.join(duplicates)}.")
        self.instruments, self.rate = tuple(instruments), float(rate)
        self.every = tuple(instrument.periods(rate) for instrument in instruments)
        self.late = tuple(instrument.delayed(rate) for instrument in instruments)

    @property
    def feels(self) -> bool:
        """True if a sensor needs accelerations."""
        return any(instrument.sensor.needs_accelerations for instrument in self.instruments)

    def fill_queues(self, motion: SensedMotion, system: System, key: Array) -> tuple[Any, ...]:
        """Queues of readings at the start: those of the first motion, as if it had lasted."""
        zero = jnp.zeros((), int)
        values = self._read_values(motion, system, zero, self._draw_noise(zero, key))
        queues = []
        for value, late in zip(values, self.late, strict=True):
            # A delayed sensor would have nothing to say at first; it reads as if the start had lasted.
            queue = jax.tree.map(lambda x, late=late: jnp.stack([x] * (late + 1)), value)
            queues.append(Reading(queue, jnp.arange(late + 1) == late))
        return tuple(queues)

    def advance_queues(
        self, queues: tuple[Any, ...], motion: SensedMotion, system: System, k: Int[Array, ""],
        key: Array,
    ) -> tuple[Any, ...]:  # fmt: skip
        """Queues one sample later: what is read at sample k comes in, the oldest goes out."""
        return _advance_queues(self, queues, motion, system, k, self._draw_noise(k, key))

    def oldest_readings(self, queues: tuple[Any, ...]) -> dict[str, Reading]:
        """Readings passed to the estimator at this sample, by the sensor's name."""
        names = [instrument.name for instrument in self.instruments]
        oldest = jax.tree.map(lambda x: x[0], queues)
        return dict(zip(names, oldest, strict=True))

    def _read_values(
        self, motion: SensedMotion, system: System, k: Int[Array, ""], noise: Float[Array, "i c"]
    ) -> list[Point]:
        readings, rows = [], iter(noise)
        for instrument in self.instruments:
            value = instrument.sensor.read(motion)
            error = None if instrument.bias is None else jnp.asarray(instrument.bias)
            if instrument.noise is not None:
                scale = jnp.asarray(instrument.noise)
                white = scale * next(rows)[: scale.size]
                error = white if error is None else error + white
            outages = []
            for fault in instrument.faults:
                is_present = k >= jnp.asarray(fault.at) * self.rate
                is_present &= k < jnp.asarray(fault.until) * self.rate
                if fault.bias is None:
                    outages.append(is_present)
                    continue
                step = jnp.where(is_present, jnp.asarray(fault.bias), 0.0)
                error = step if error is None else error + step
            if error is not None:
                # Errors of an attitude are rotations, and are composed and not added.
                value = instrument.sensor.space(system).retract(value, error)
            for is_lost in outages:
                value = jax.tree.map(lambda x, lost=is_lost: jnp.where(lost, jnp.nan, x), value)
            readings.append(value)
        return readings

    def _draw_noise(self, k: Int[Array, ""], key: Array) -> Float[Array, "i c"]:
        """Standard normal numbers of the noisy instruments at sample k."""
        sizes = [np.size(i.noise) for i in self.instruments if i.noise is not None]
        numbers = [number for number, i in enumerate(self.instruments) if i.noise is not None]
        if not numbers:
            return jnp.zeros((0, 0))
        # Noise depends on sample and instrument alone: another sensor or rate leaves the noise of the others
        # as it is. All instruments draw at once, since each draw is a loop of its own in a compiled
        # program, and a number does not depend on how many follow it.
        keys = jax.vmap(partial(jax.random.fold_in, jax.random.fold_in(key, k)))(np.array(numbers))
        return jax.vmap(lambda key: jax.random.normal(key, (max(sizes),), float))(keys)


@native
def _advance_queues(
    bench: Bench, queues: tuple[Any, ...], motion: SensedMotion, system: System, k: Int[Array, ""],
    noise: Float[Array, "i c"],
) -> tuple[Any, ...]:  # fmt: skip
    values = bench._read_values(motion, system, k, noise)
    new_queues = []
    for queue, value, every in zip(queues, values, bench.every, strict=True):
        due = k % every == 0
        latest = lambda new, x, due=due: jnp.where(due, new, x[-1])
        join = lambda x, new: jnp.concatenate([x[1:], new[None]])
        reading = Reading(jax.tree.map(latest, value, queue.value), due)
        new_queues.append(jax.tree.map(join, queue, reading))
    return tuple(new_queues)
