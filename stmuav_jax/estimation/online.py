"""Online filter, one measurement at a time from Python, for use with a running machine.

A call of a compiled function costs some microseconds for each array that goes in or comes out, more
than the arithmetic of a small filter: all numbers of a step go in as two arrays (estimate; step,
measurement and inputs) and come out as one, which NumPy reads without a copy. A program that needs
every microsecond calls, before anything else of JAX,

    jax.config.update("jax_cpu_enable_async_dispatch", False)

and the step then runs in the calling thread, in two thirds of the time or less.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..checks.errors import ModelError, SettingError
from ..math.compiler import compiler_options
from ..math.native.program import evaluate
from .filter import DEFAULT, AbstractFilter, EstimationError, is_finite
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .records import (
    EQUAL,
    as_numbers,
    check_functions,
    check_measurement,
    check_prior,
    find_fault,
    read_inputs,
    warn_of_steps,
)

# Number of the latest measurements whose NIS is kept.
RECENT = 1000

# Count of the numbers about a step itself: its NIS, missing components, and 1 if it is finite.
TOLD = 3


# A compiled step, the array that it is given, and the places of measurement and inputs in it.
_Made = tuple[Callable[..., Any], np.ndarray, tuple[np.ndarray, ...]]


class _Layout:
    """Layout of an estimate's arrays, those of the mean and the factor, in one flat array."""

    def __init__(self, prior: Gaussian) -> None:
        leaves, self.structure = jax.tree.flatten(prior)
        self.shapes = [leaf.shape for leaf in leaves]
        self.ends = np.cumsum([0, *(leaf.size for leaf in leaves)]).tolist()

    def pack(self, g: Gaussian) -> Array:
        """Flat array of a Gaussian."""
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves(g)])

    def unpack(self, numbers: Any) -> Gaussian:
        """Gaussian of a flat array of JAX, or one of views of NumPy's."""
        parts = zip(self.ends, self.ends[1:], self.shapes, strict=False)
        leaves = [numbers[a:b].reshape(shape) for a, b, shape in parts]
        return jax.tree.unflatten(self.structure, leaves)


class OnlineEstimate:
    """Estimate after a measurement.

    Attributes:
        t: time of the measurement [s].
        nis: normalised innovation squared.
        missing: number of components of the measurement that were NaN.
    """

    __slots__ = ("_layout", "_numbers", "missing", "nis", "t")

    def __init__(
        self, t: float, numbers: np.ndarray, layout: _Layout, nis: float, missing: int
    ) -> None:
        self.t, self.nis, self.missing = t, nis, missing
        self._numbers, self._layout = numbers, layout

    @property
    def mean(self) -> Any:
        """Mean as NumPy arrays, without a copy."""
        return self._layout.unpack(self._numbers).mean

    @property
    def standard_deviation(self) -> np.ndarray:
        """Standard deviations (n,) as a NumPy array."""
        return np.sqrt(np.sum(self._layout.unpack(self._numbers).factor ** 2, axis=1))

    @property
    def state(self) -> Gaussian:
        """Gaussian of JAX arrays, which each access creates."""
        return self._layout.unpack(jnp.asarray(self._numbers))


class OnlineFilter:
    """Filter that takes one measurement at a time.

    The first call compiles (`warm_up` does it beforehand). Steps evaluate the same equations as
    `kalman_filter`; the numbers agree to rounding, because code compiled alone and code within
    a loop may take sums in another order.

    Attributes:
        t: time of the estimate [s].
        count, missing: numbers of measurements so far, and of their components that were NaN.
        nis: normalised innovations squared of the latest measurements, at most `RECENT`.

    Raises:
        ModelError, SettingError: as in `kalman_filter`; functions are checked at the first call.
    """

    def __init__(
        self,
        model: StateSpaceModel,
        prior: Gaussian,
        *,
        t: float = 0.0,
        method: AbstractFilter = DEFAULT,
    ) -> None:
        check_prior(model, prior, method.rule)
        if prior.factor.ndim != 2:
            raise ModelError(
                "An online filter takes a single prior, but its covariance has shape "
                f"{prior.factor.shape}."
            )
        self.model, self.t = model, float(t)
        self.count, self.missing = 0, 0
        self._nis: deque[float] = deque(maxlen=RECENT)
        self._shortest, self._longest = np.inf, 0.0
        self._prior, self._method = prior, method
        self._layout, self._dtype = _Layout(prior), np.dtype(prior.factor.dtype)
        # result of a step: the estimate, and numbers about the step, which the next one ignores
        self._now = jnp.concatenate([self._layout.pack(prior), jnp.zeros(TOLD, self._dtype)])
        self._programs: dict[Any, _Made] = {}

    @property
    def state(self) -> Gaussian:
        """Current estimate."""
        return self._layout.unpack(self._now)

    @property
    def nis(self) -> list[float]:
        """Normalised innovations squared of the latest measurements, at most `RECENT`."""
        return list(self._nis)

    def warm_up(self, u: Inputs = None, *, y: Any = None) -> None:
        """Compile the step for inputs and a measurement (by default m numbers) of these shapes."""
        if y is None:
            reading = jax.eval_shape(self.model.sensor, self._prior.mean, u)
            y = np.full(reading.shape, np.nan)
        program, step_input = self._prepare_arrays(y, 0.0, u)
        jax.block_until_ready(program(self._now, step_input))

    def step(self, y: Any, t: float, u: Inputs = None) -> OnlineEstimate:
        """Predict to time t with inputs u held since the last measurement, and update with y.

        Args:
            y: measurement (m,) as an array or a list; NaN, masked or None where missing.
            t: time of the measurement [s].
            u: inputs, a pytree of arrays or lists (k,), all finite.

        Raises:
            ModelError: y has the wrong size, or something else than numbers.
            SettingError: t is before the last measurement.
            EstimationError: the covariance was lost, or a measurement or an input is not finite; the
                last good estimate stays.

        Warns:
            UserWarning: Q is given per step, and the steps have different lengths.
        """
        if isinstance(t, np.datetime64 | str):
            raise SettingError(f"t must be a number of seconds, but it is {t!r}.")
        if not t >= self.t:
            raise SettingError(
                f"The times of an online filter must not decrease, but after t = {self.t:g} s comes {t:g} s."
            )
        # Process noise given per step is the same for any length of step, which is wrong for uneven ones.
        dt = t - self.t
        if self.model.noise_per == "step" and dt > 0 and not np.isnan(self._longest):
            self._shortest, self._longest = min(self._shortest, dt), max(self._longest, dt)
            is_uneven = self._longest - self._shortest > EQUAL * self._longest
            if is_uneven and np.any(self.model.noise):
                warn_of_steps(self._shortest, self._longest)
                # once is enough
                self._longest = np.nan
        program, step_input = self._prepare_arrays(y, dt, u)
        # The estimate stays on the device from step to step, and one array goes each way.
        after = program(self._now, step_input)
        numbers = np.asarray(after)
        nis, missing, finite = numbers[-TOLD:].tolist()
        # The state of the filter is replaced only after this check; a bad measurement leaves it as it was.
        if not finite:
            fault = find_fault(as_numbers(y, "A measurement"), read_inputs(u), self.model.sensor)
            raise EstimationError(
                f"The filter failed at t = {t:g} s, measurement {self.count}: "
                + (
                    fault
                    or "its covariance was not positive definite or its state not finite. "
                    f"The last NIS: {self.nis[-3:]}."
                )
            )
        self._now, self.t = after, float(t)
        self.count += 1
        self.missing += int(missing)
        self._nis.append(nis)
        return OnlineEstimate(self.t, numbers, self._layout, nis, int(missing))

    def _prepare_arrays(
        self, y: Any, dt: float, u: Inputs
    ) -> tuple[Callable[..., Any], np.ndarray]:
        """Compiled step for arrays of these shapes, and the array of step, measurement and inputs.

        The array is reused, which is quicker than a new one; the caller waits for the program's
        result before the array is filled again.
        """
        dtype = self._dtype
        # what is no array yet is read as in a record; an array of numbers costs nothing more
        if type(y) is not np.ndarray or y.dtype.kind != "f":
            y = as_numbers(y, "A measurement")
        y = np.asarray(y, dtype)
        if u is not None and type(u) is not np.ndarray:
            u = read_inputs(u)
        leaves, structure = jax.tree.flatten(u)
        leaves = [np.asarray(leaf, dtype) for leaf in leaves]
        # A sensor at a lower rate has its own shape of measurement, and with it a program.
        key = y.shape, structure, tuple([leaf.shape for leaf in leaves])
        if key not in self._programs:
            self._programs[key] = self._build_program(y, leaves, structure)
        program, step_input, places = self._programs[key]
        step_input[0] = dt
        for place, numbers in zip(places, (y, *leaves), strict=True):
            place[...] = numbers
        return program, step_input

    def _build_program(self, y: np.ndarray, leaves: list[np.ndarray], structure: Any) -> _Made:
        """Function of one step, compiled at its first call, and the array that it takes."""
        model, method, layout = self.model, self._method, self._layout
        check_measurement(model, y.shape)
        m, shapes = y.shape[0], [leaf.shape for leaf in leaves]
        like = [jax.ShapeDtypeStruct(shape, self._dtype) for shape in shapes]
        check_functions(model, self._prior, jax.tree.unflatten(structure, like), m)
        ends = np.cumsum([1 + m, *[leaf.size for leaf in leaves]]).tolist()

        def filter_step(numbers: Array, step_input: Array) -> Array:
            parts = [
                step_input[a:b].reshape(shape)
                for a, b, shape in zip(ends, ends[1:], shapes, strict=False)
            ]
            u = jax.tree.unflatten(structure, parts)
            before, y = layout.unpack(numbers), step_input[1 : 1 + m]
            after, innovation = evaluate(method.step, model, before, y, u, step_input[0])
            step_numbers = jnp.stack([innovation.nis, *[
                jnp.asarray(value, innovation.nis.dtype) for value in (innovation.missing, is_finite(after))
            ]])  # fmt: skip
            return jnp.concatenate([layout.pack(after), step_numbers])

        step_input = np.zeros(ends[-1], self._dtype)
        bounds = zip([1, *ends], ends, [y.shape, *shapes], strict=False)
        # Views of the one array, into which each step copies its numbers without an allocation.
        places = tuple(step_input[a:b].reshape(shape) for a, b, shape in bounds)
        return jax.jit(filter_step, compiler_options=compiler_options()), step_input, places
