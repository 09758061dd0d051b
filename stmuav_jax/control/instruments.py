"""Instruments: sensors that read at their own rate, with noise, bias and delay."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..algebra.space import Point
from ..checks.errors import SettingError
from ..checks.numbers import numbers
from ..checks.shapes import Numbers
from ..mechanics.system import System
from ..sensing.sensors import AbstractSensor, SensedMotion

# Relative difference from a whole number that counts as round-off of the given rates and delays.
_WHOLE = 1e-9


class Instrument(eqx.Module):
    """Sensor with the numbers of its datasheet.

    Args:
        sensor: the ideal sensor.
        rate: readings per second [Hz]; by default one per control period.
        noise: standard deviation of a reading's white noise, one number or one for each
            component (c,), in the units of the sensor's errors. A noise density [unit/sqrt(Hz)]
            becomes one by multiplication with sqrt(rate).
        bias: constant error of every reading, as `noise`.
        delay: time from the motion to the controller's sight of it [s], whole control periods.

    Raises:
        SettingError: a rate or delay that is not finite, a rate that is not positive, a delay below
            zero, or no sensor.
    """

    sensor: AbstractSensor
    rate: float | None = eqx.field(static=True, default=None)
    noise: Numbers | None = None
    bias: Numbers | None = None
    delay: float = eqx.field(static=True, default=0.0)

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

    @property
    def name(self) -> str:
        """Name of the sensor."""
        return self.sensor.name

    def periods(self, rate: float) -> int:
        """Number of control periods between readings at a control rate [Hz].

        Raises:
            SettingError: the rates do not divide.
        """
        if self.rate is None:
            return 1
        ratio = rate / self.rate
        whole = round(ratio)
        if whole < 1 or abs(ratio - whole) > _WHOLE * ratio:
            below, above = max(int(ratio), 1), max(int(ratio), 1) + 1
            raise SettingError(
                f"The sensor '{self.name}' reads at {self.rate:g} Hz, which is not a whole part of the "
                f"control rate of {rate:g} Hz: near it are {rate / below:.6g} Hz (every "
                f"{below} periods) and {rate / above:.6g} Hz (every {above} periods)."
            )
        return whole

    def delayed(self, rate: float) -> int:
        """Delay as a number of control periods; raises `SettingError` if that is not whole."""
        return whole_periods(self.delay, rate, f"The delay of the sensor '{self.name}'")


def whole_periods(time: float, rate: float, what: str) -> int:
    """Number of control periods in a time [s]; raises `SettingError` if it is not whole."""
    count = time * rate
    whole = round(count)
    if abs(count - whole) > _WHOLE * max(count, 1.0):
        raise SettingError(
            f"{what} must be a whole number of control periods of {1e3 / rate:.6g} ms, but it is "
            f"{1e3 * time:.6g} ms, which are {count:.6g} periods."
        )
    return whole


class Reading(NamedTuple):
    """Reading of an instrument as the estimator sees it.

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
    every: tuple[int, ...] = eqx.field(static=True)
    late: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, given: tuple[Any, ...], system: System, rate: float) -> None:
        made = []
        for one in given:
            one = one if isinstance(one, Instrument) else Instrument(one)
            size = len(one.sensor.components(system))
            errors = {}
            for name in ("noise", "bias"):
                value = getattr(one, name)
                if value is not None:
                    shape = () if np.ndim(value) == 0 else (size,)
                    what = f"The {name} of the sensor '{one.name}'"
                    errors[name] = jnp.broadcast_to(
                        numbers(value, shape, what, "", SettingError), (size,)
                    )
            made.append(Instrument(one.sensor, one.rate, delay=one.delay, **errors))
        names = [one.name for one in made]
        twice = sorted({name for name in names if names.count(name) > 1})
        if twice:
            raise SettingError(f"Two instruments have the name {', '.join(twice)}.")
        self.instruments = tuple(made)
        self.every = tuple(one.periods(rate) for one in made)
        self.late = tuple(one.delayed(rate) for one in made)

    @property
    def feels(self) -> bool:
        """True if a sensor needs accelerations."""
        return any(one.sensor.needs_accelerations for one in self.instruments)

    def first(self, seen: SensedMotion, system: System, key: Array) -> tuple[Any, ...]:
        """Queues of readings at the start: those of the first motion, as if it had lasted."""
        zero = jnp.zeros((), int)
        values = self._values(seen, system, zero, key)
        found = []
        for value, late in zip(values, self.late, strict=True):
            queue = jax.tree.map(lambda x, late=late: jnp.stack([x] * (late + 1)), value)
            found.append(Reading(queue, jnp.arange(late + 1) == late))
        return tuple(found)

    def later(
        self,
        queues: tuple[Any, ...],
        seen: SensedMotion,
        system: System,
        k: Int[Array, ""],
        key: Array,
    ) -> tuple[Any, ...]:
        """Queues one sample later: what is read at sample k comes in, the oldest goes out."""
        values = self._values(seen, system, k, key)
        found = []
        for queue, value, every in zip(queues, values, self.every, strict=True):
            due = k % every == 0
            last = jax.tree.map(lambda x: x[-1], queue.value)
            now = jax.tree.map(lambda new, old, due=due: jnp.where(due, new, old), value, last)
            join = lambda x, new: jnp.concatenate([x[1:], new[None]])
            found.append(jax.tree.map(join, queue, Reading(now, due)))
        return tuple(found)

    def arrived(self, queues: tuple[Any, ...]) -> dict[str, Reading]:
        """Readings that the estimator sees now, by the sensor's name."""
        first = [jax.tree.map(lambda x: x[0], queue) for queue in queues]
        return {one.name: now for one, now in zip(self.instruments, first, strict=True)}

    def _values(
        self, seen: SensedMotion, system: System, k: Int[Array, ""], key: Array
    ) -> list[Point]:
        found = []
        draws = jax.random.fold_in(key, k) if self.instruments else key
        for number, one in enumerate(self.instruments):
            value, error = one.sensor.read(seen), self._error(one, draws, number)
            if error is not None:
                value = one.sensor.space(system).retract(value, error)
            found.append(value)
        return found

    @staticmethod
    def _error(one: Instrument, key: Array, number: int) -> Float[Array, " c"] | None:
        error = None if one.bias is None else jnp.asarray(one.bias)
        if one.noise is None:
            return error
        scale = jnp.asarray(one.noise)
        white = scale * jax.random.normal(jax.random.fold_in(key, number), scale.shape, scale.dtype)
        return white if error is None else error + white
