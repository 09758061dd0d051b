"""Online filter, one measurement at a time from Python, for use beside a running machine.

A call of a compiled function costs some microseconds for each array that goes in or comes out,
more than the arithmetic of a small filter. All numbers of a step therefore go in as two
arrays (estimate; step, measurement and inputs) and come out as one, which the next step takes
as it is and NumPy reads without a copy.

The remaining overhead is the runtime of JAX, which hands a computation to another thread and
waits for it. A program that needs every microsecond calls, before anything else of JAX,

    jax.config.update("jax_cpu_enable_async_dispatch", False)

and the step then runs in the calling thread, in two thirds of the time or less.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from ..algebra.compiler import compiler_options
from ..checks.errors import ModelError, SettingError
from .check import check_functions, check_prior
from .filter import EstimationError, is_finite
from .gaussians import Gaussian
from .model import Inputs, StateSpaceModel
from .update import DEFAULT, AbstractFilter

# Count of the numbers about a step itself: its NIS, missing components, and 1 if it is finite.
TOLD = 3


# A compiled step, the array that it is given, and the places of measurement and inputs in it.
_Made = tuple[Callable[..., Any], np.ndarray, tuple[np.ndarray, ...]]


class _Layout:
    """Layout of mean and factor in the flat array of an estimate."""

    def __init__(self, prior: Gaussian) -> None:
        leaves, self.structure = jax.tree.flatten(prior.mean)
        self.shapes = [leaf.shape for leaf in leaves]
        self.ends = np.cumsum([leaf.size for leaf in leaves]).tolist()
        self.size = self.ends[-1] + prior.factor.size

    def pack(self, g: Gaussian) -> Array:
        """Flat array (size,) of a Gaussian."""
        return jnp.concatenate([jnp.ravel(leaf) for leaf in jax.tree.leaves((g.mean, g.factor))])

    def mean(self, numbers: Any) -> Any:
        """Mean, an array or a pytree of arrays."""
        starts = [0, *self.ends]
        leaves = [
            numbers[a:b].reshape(shape)
            for a, b, shape in zip(starts, self.ends, self.shapes, strict=False)
        ]
        return jax.tree.unflatten(self.structure, leaves)

    def factor(self, numbers: Any) -> Any:
        """Root of the covariance (n, n)."""
        flat = numbers[self.ends[-1] : self.size]
        n = round(flat.shape[0] ** 0.5)
        return flat.reshape(n, n)

    def unpack(self, numbers: Any) -> Gaussian:
        """Gaussian of a flat array."""
        return Gaussian(self.mean(numbers), self.factor(numbers))


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
        """Mean as NumPy arrays, views that cost no time."""
        return self._layout.mean(self._numbers)

    @property
    def standard_deviation(self) -> np.ndarray:
        """Standard deviations (n,) as a NumPy array."""
        return np.sqrt(np.sum(self._layout.factor(self._numbers) ** 2, axis=1))

    @property
    def state(self) -> Gaussian:
        """Gaussian of JAX arrays, which each access creates."""
        return self._layout.unpack(jnp.asarray(self._numbers)[: self._layout.size])


class OnlineFilter:
    """Filter that takes one measurement at a time.

    The first call compiles (`warm_up` does it beforehand). Steps evaluate the same equations as
    `kalman_filter`; the numbers agree to rounding, because code compiled alone and code within
    a loop may take sums in another order.

    Attributes:
        t: time of the estimate [s].
        count, missing: numbers of measurements so far, and of their components that were NaN.
        nis: normalised innovations squared, one number per measurement.

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
                "An online filter is a single one, but its prior's covariance has shape "
                f"{prior.factor.shape}."
            )
        self.model, self.t = model, float(t)
        self.count, self.missing = 0, 0
        self.nis: list[float] = []
        self._prior, self._method = prior, method
        self._layout, self._dtype = _Layout(prior), np.dtype(prior.factor.dtype)
        # result of a step: the estimate, and numbers about the step, which the next one ignores
        self._now = jnp.concatenate([self._layout.pack(prior), jnp.zeros(TOLD, self._dtype)])
        self._programs: dict[Any, _Made] = {}

    @property
    def state(self) -> Gaussian:
        """Current estimate."""
        return self._layout.unpack(self._now[:-TOLD])

    def warm_up(self, u: Inputs = None, *, y: Any = None) -> None:
        """Compile the step for inputs and a measurement (by default m numbers) of these shapes."""
        if y is None:
            seen = jax.eval_shape(self.model.sensor, self._prior.mean, u)
            y = np.full(seen.shape, np.nan)
        program, given = self._prepared(y, 0.0, u)
        jax.block_until_ready(program(self._now, given))

    def step(self, y: Any, t: float, u: Inputs = None) -> OnlineEstimate:
        """Predict to time t with inputs u held since the last measurement, and update with y.

        Args:
            y: measurement (m,), NaN where missing.
            t: time of the measurement [s].
            u: inputs, a pytree of arrays (k,).

        Raises:
            ModelError: y has the wrong size.
            SettingError: t is before the last measurement.
            EstimationError: the covariance was lost; the last good estimate stays.
        """
        if not t >= self.t:
            raise SettingError(f"Time goes backwards: after t = {self.t:g} s comes {t:g} s.")
        program, given = self._prepared(y, t - self.t, u)
        after = program(self._now, given)
        numbers = np.asarray(after)
        nis, missing, fine = numbers[-TOLD:].tolist()
        if not fine:
            raise EstimationError(
                f"The filter failed at t = {t:g} s, measurement {self.count}: its covariance was "
                f"not positive definite or its state not finite. The last NIS: {self.nis[-3:]}."
            )
        self._now, self.t = after, float(t)
        self.count += 1
        self.missing += int(missing)
        self.nis.append(nis)
        return OnlineEstimate(self.t, numbers, self._layout, nis, int(missing))

    def _prepared(self, y: Any, dt: float, u: Inputs) -> tuple[Callable[..., Any], np.ndarray]:
        """Compiled step for arrays of these shapes, and the array of step, measurement and inputs.

        The array is reused, which is quicker than a new one; the caller waits for the program's
        result before the array is filled again.
        """
        dtype = self._dtype
        y = np.asarray(y, dtype)
        leaves, structure = jax.tree.flatten(u)
        leaves = [np.asarray(leaf, dtype) for leaf in leaves]
        key = y.shape, structure, tuple([leaf.shape for leaf in leaves])
        found = self._programs.get(key)
        if found is None:
            found = self._programs[key] = self._made(y, leaves, structure)
        program, given, places = found
        given[0] = dt
        for place, numbers in zip(places, (y, *leaves), strict=True):
            place[...] = numbers
        return program, given

    def _made(self, y: np.ndarray, leaves: list[np.ndarray], structure: Any) -> _Made:
        """Function of one step, compiled at its first call, and the array that it takes."""
        model, method, layout = self.model, self._method, self._layout
        model.sensor.space.check(y, "A measurement")
        m, shapes = y.shape[0], [leaf.shape for leaf in leaves]
        like = [jax.ShapeDtypeStruct(shape, self._dtype) for shape in shapes]
        check_functions(model, self._prior, jax.tree.unflatten(structure, like), m)
        ends = np.cumsum([1 + m, *[leaf.size for leaf in leaves]]).tolist()

        def step(numbers: Array, given: Array) -> Array:
            parts = [
                given[a:b].reshape(shape)
                for a, b, shape in zip(ends, ends[1:], shapes, strict=False)
            ]
            u = jax.tree.unflatten(structure, parts)
            before, y = layout.unpack(numbers), given[1 : 1 + m]
            after, seen = method.step(model, before, y, u, given[0])
            told = jnp.stack([seen.nis, *[
                jnp.asarray(value, seen.nis.dtype) for value in (seen.missing, is_finite(after))
            ]])  # fmt: skip
            return jnp.concatenate([layout.pack(after), told])

        given = np.zeros(ends[-1], self._dtype)
        bounds = zip([1, *ends], ends, [y.shape, *shapes], strict=False)
        places = tuple(given[a:b].reshape(shape) for a, b, shape in bounds)
        return jax.jit(step, compiler_options=compiler_options()), given, places
