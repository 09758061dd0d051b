"""Records of measurements, read and checked in one place for all filters.

Measurements (tables, masked arrays, lists) may be missing, by NaN or by a mask; inputs and times may
not. The functions of a model are traced with `jax.eval_shape`, which computes nothing: arrays that
would fit only after broadcasting are refused, since a filter that compares a measurement with the
wrong component may converge without any sign of it.
"""

import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..checks.errors import ModelError, SettingError, check_finite, has_values
from ..math.space import as_reading
from .gaussians import Gaussian
from .model import Inputs, Sensor, StateSpaceModel, insert_axes
from .sigma import AbstractRule

# Coarsest resolution of times, in steps, and largest difference of steps that count as equal.
_RESOLUTION, EQUAL = 0.01, 0.01


def as_numbers(values: Any, subject: str) -> Array | np.ndarray:
    """Array of floating-point numbers from an array, a table, a masked array or a list.

    Masked entries, None and pandas' NA are NaN. Arrays of JAX pass unchanged.

    Raises:
        ModelError: an entry is text, a date, complex or no number; the message has its index.
    """
    if isinstance(values, jax.Array):
        return values
    if not has_values(values):
        return jnp.asarray(values)
    values = _without_masks(values)
    try:
        array = np.asarray(values)
    except ValueError:
        raise ModelError(
            f"{subject} must be an array, but its rows have different lengths."
        ) from None
    if array.dtype.kind == "f":
        return array
    if array.dtype.kind in "iub":
        return array.astype(float)
    numbers = np.full(array.shape, np.nan)
    for index in np.ndindex(array.shape):
        value = array[index]
        if value is None or type(value).__name__ == "NAType":
            continue
        try:
            if np.asarray(value).dtype.kind in "USmMc" or hasattr(value, "year"):
                raise TypeError
            numbers[index] = float(value)
        except (TypeError, ValueError):
            is_text = isinstance(value, str | bytes)
            hint = " pandas.read_csv(..., decimal=',') reads decimal commas." if is_text else ""
            place, entry = index[0] if len(index) == 1 else index, str(value) if is_text else value
            raise ModelError(
                f"{subject} must be numbers, but entry {place} is {entry!r}.{hint}"
            ) from None
    return numbers


def _without_masks(values: Any) -> Any:
    """Array or nested list with NaN in the place of masked entries."""
    if isinstance(values, np.ma.MaskedArray):
        mask = np.ma.getmaskarray(values)
        if not np.any(mask):
            return values.data
        return np.where(mask, np.nan, np.where(mask, 0, values.data))
    if isinstance(values, list | tuple):
        return [_without_masks(part) for part in values]
    return values


def read_measurements(y: Any, dtype: Any) -> Array:
    """Measurements as an array of JAX; those that are no such array get the precision `dtype`.

    Raises:
        ModelError: as `as_numbers`.
    """
    array = as_numbers(y, "Measurements")
    return array if isinstance(array, jax.Array) else jnp.asarray(array, dtype=dtype)


def read_inputs(u: Inputs) -> Inputs:
    """Inputs with tables, masked arrays and nested lists of numbers as arrays.

    Raises:
        ModelError: as `as_numbers`.
    """
    return jax.tree.map(lambda leaf: jnp.asarray(as_numbers(leaf, "Inputs")), u, is_leaf=_is_list)


def _is_list(node: Any) -> bool:
    """True for a nested list of numbers, which JAX would take for a structure of many inputs."""
    if not isinstance(node, list | tuple) or hasattr(node, "_fields") or not node:
        return False
    leaves = jax.tree.leaves(node, is_leaf=lambda x: x is None)
    return all(np.ndim(leaf) == 0 and not isinstance(leaf, jax.Array) for leaf in leaves)


def find_fault(y: Any, u: Inputs, sensor: Sensor) -> str:
    """Sentence on a number of one step that is not finite where it must be; empty if there is none.

    Args:
        y: measurement of the step. u: inputs of the step, a pytree of arrays (k,).
    """
    values = np.asarray(y, dtype=float)
    name = lambda i: sensor.names[i] if len(values) == len(sensor.names) else f"component {i}"
    for i in np.flatnonzero(np.isinf(values)):
        return (
            f"the measurement of {name(i)} is {values[i]:g}, and the filter cannot run with it: a "
            "measurement is finite, or NaN where it is missing."
        )
    if np.any(np.isinf(np.asarray(as_reading(sensor.space, jnp.asarray(values))))):
        return (
            f"the Euler parameters among the measurement {values.tolist()} are not of unit length "
            "within 0.01. Zeros or NaN say that they are missing."
        )
    for path, leaf in jax.tree_util.tree_leaves_with_path(u):
        numbers = np.asarray(leaf, dtype=float)
        for i in np.flatnonzero(~np.isfinite(numbers)):
            input_name = f"input {i}{f' of {jax.tree_util.keystr(path)}' if path else ''}"
            return (
                f"{input_name} is {numbers.flat[i]:g}, and the filter cannot run with it: unlike measurements "
                "inputs cannot be missing; interpolate them, or leave the steps out."
            )
    return ""


def check_numbers(y: Any, u: Inputs, sensor: Sensor) -> None:
    """Refuse a record with a number that is not finite where it must be, by its index.

    Args:
        y: measurements (T, m, *s). u: inputs, a pytree of arrays (T, k, *s).

    Raises:
        SettingError: a measurement is infinite, or an input is not finite.
    """
    if not has_values(y, u):
        return
    rows = [~np.isinf(y), *(np.isfinite(leaf) for leaf in jax.tree.leaves(u))]
    # The check runs on values before the filter: inside of the compiled loop a bad number would only
    # appear as NaN after some later step.
    good = np.all([np.all(row.reshape(len(row), -1), axis=1) for row in map(np.asarray, rows)], 0)
    if np.all(good):
        return
    k, run = int(np.argmin(good)), 0
    for row in map(np.asarray, rows):
        if row.ndim > 2 and not np.all(row[k]):
            run = int(np.argmin(np.all(row[k], axis=0)))
    pick = lambda a: np.asarray(a)[k][..., run] if np.ndim(a) > 2 else np.asarray(a)[k]
    place = f"step {k}" + (f" of record {run}" if np.ndim(y) > 2 else "")
    raise SettingError(f"At {place} {find_fault(pick(y), jax.tree.map(pick, u), sensor)}")


def step_lengths(dt: Any, t: Any, count: int, dtype: Any) -> Float[Array, " T"]:
    """Lengths of the T steps [s], from differences in double precision.

    Args:
        dt: length of all steps, or of each (T,), as numbers [s] or `numpy.timedelta64`.
        t: instead of dt, T + 1 times as numbers [s], `numpy.datetime64`, or a table's dates.

    Raises:
        SettingError: both or none of dt and t are given, their shape is wrong, one of them is not
            finite, time goes backwards, or the times' precision is too coarse for the steps.
    """
    if (dt is None) == (t is None):
        raise SettingError("Give either dt, the step, or t, the times with the prior's first.")
    if t is not None:
        times = as_seconds(t, "The times") if has_values(t) else jnp.asarray(t)
        if times.shape != (count + 1,):
            raise SettingError(
                f"t must have the prior's time and {count} more, but its shape is {times.shape}."
            )
        # Traced times are differentiated with the record, and their values cannot be checked here; the filter
        # checks them step by step.
        if not isinstance(times, np.ndarray):
            return jnp.diff(times).astype(dtype)
        _check_finite(times, "The times")
        steps = np.diff(times.astype(float))
        if np.any(steps < 0):
            k = int(np.argmax(steps < 0))
            raise SettingError(
                f"The times of a record must not decrease, but after t = {times[k]:g} s comes "
                f"{times[k + 1]:g} s (number {k + 1})."
            )
        # Unix times in single precision resolve 128 s: their differences would be zero or 128 s, without any
        # sign of it in the estimates.
        resolution = float(np.spacing(np.max(np.abs(times))))
        mean = float(np.mean(steps))
        if resolution > (_RESOLUTION * mean if mean > 0 else _RESOLUTION):
            raise SettingError(
                f"The times' precision ({times.dtype}) is too coarse: at t = {np.max(times):.10g} s they "
                f"resolve {resolution:.3g} s, and the mean step is {mean:.3g} s. Give them in double "
                "precision (NumPy), or from the start of the record."
            )
        return jnp.asarray(steps, dtype=dtype)
    steps = as_seconds(dt, "dt") if has_values(dt) else jnp.asarray(dt)
    if steps.shape not in ((), (count,)):
        raise SettingError(f"dt must be a number or have shape ({count},), not {steps.shape}.")
    if isinstance(steps, np.ndarray):
        _check_finite(np.atleast_1d(steps), "dt")
        if np.any(steps < 0):
            raise SettingError(
                f"The steps of a record must be positive, but the smallest is {np.min(steps):g} s."
            )
        return jnp.asarray(np.broadcast_to(steps, (count,)), dtype=dtype)
    return jnp.broadcast_to(steps.astype(dtype), (count,))


def as_seconds(t: Any, subject: str) -> np.ndarray:
    """Times or their differences as numbers [s]; dates count from the first of them.

    Raises:
        SettingError: an entry is no time.
    """
    array = np.asarray(t)
    dates = array.dtype.kind == "O" and array.size and hasattr(array.flat[0], "utcoffset")
    if dates:
        # dates with a time zone are objects
        since = [value - array.flat[0] for value in array.flat]
        # pandas' NaT is not equal to itself
        durations = [np.timedelta64("NaT") if value != value else value for value in since]
        array = np.array(durations, dtype="timedelta64[ns]").reshape(array.shape)
    elif array.dtype.kind == "M":
        # Dates become seconds from the first one, since nanoseconds since 1970 have more digits than a
        # double.
        array = array - array.flat[0]
    if array.dtype.kind == "m":
        _check_finite(np.where(np.isnat(array), np.nan, 0.0), subject)
        return array / np.timedelta64(1, "s")
    if array.dtype.kind in "US":
        raise SettingError(
            f"{subject} must be numbers [s] or dates, but the first is the text {str(array.flat[0])!r}; "
            "pandas.to_datetime makes dates of text."
        )
    try:
        return np.asarray(as_numbers(t, subject))
    except ModelError as error:
        raise SettingError(str(error)) from None


def _check_finite(times: np.ndarray, subject: str) -> None:
    """Refuse times that are not finite, by the index of the first."""
    bad = np.flatnonzero(~np.isfinite(times))
    if bad.size:
        raise SettingError(
            f"{subject} must be finite, but number {bad[0]} is {times[bad[0]]:g} ({bad.size} of {times.size} "
            "are not finite)."
        )


def check_steps(model: StateSpaceModel, steps: Any) -> None:
    """Warn of process noise per step along a record whose steps have different lengths."""
    if model.noise_per != "step" or not has_values(steps, model.noise):
        return
    lengths = np.asarray(steps)
    lengths = lengths[lengths > 0]
    if not lengths.size or not np.any(model.noise):
        return
    shortest, longest = float(np.min(lengths)), float(np.max(lengths))
    if longest - shortest > EQUAL * longest:
        warn_of_steps(shortest, longest)


def warn_of_steps(shortest: float, longest: float) -> None:
    """Warn that steps of these lengths add the same process noise."""
    warnings.warn(
        f"Steps of {shortest:.4g} to {longest:.4g} s add the same process noise, because Q is given per "
        "step. Give its growth in a second to StateSpaceModel(..., noise_per='second').",
        UserWarning,
        stacklevel=4,
    )


def check_prior(model: StateSpaceModel, prior: Gaussian, rule: AbstractRule) -> None:
    """Refuse a prior or covariances that do not belong to the model, as `kalman_filter` does."""
    n = model.space.size
    if prior.factor.ndim < 2 or prior.factor.shape[:2] != (n, n):
        size = " x ".join(str(length) for length in prior.factor.shape[:2])
        raise ModelError(
            f"The prior's covariance is {size}, but the model's state has {n} components "
            f"({', '.join(model.names)})."
        )
    model.space.check(prior.mean, "The prior's mean")
    check_finite(prior.mean, "The prior's mean", "")
    lanes = prior.factor.shape[2:]
    for leaf in jax.tree.leaves(prior.mean):
        if leaf.shape[1:] != lanes:
            raise ModelError(
                f"The prior's mean has stack axes {leaf.shape[1:]}, its covariance {lanes}."
            )
        _check_precision("The prior's mean is", leaf, prior)
    rule.check(n, prior.factor.dtype)
    for matrix, name in ((model.noise, "Q"), (model.sensor.noise, "R")):
        _check_precision(f"{name} is", matrix, prior)
        if matrix.shape[2:] not in ((), lanes):
            raise ModelError(f"{name} has stack axes {matrix.shape[2:]}, the prior {lanes}.")


def check_record(model: StateSpaceModel, prior: Gaussian, y: Array, u: Inputs) -> None:
    """Refuse measurements or inputs of another shape or precision than model and prior need.

    Args:
        y: measurements (T, m, *s).
        u: inputs, a pytree of arrays (T, k) or (T, k, *s).

    Raises:
        ModelError: a shape does not fit.
        SettingError: the precision is not the prior's.
    """
    m, lanes = model.sensor.space.size, prior.factor.shape[2:]
    shape = ", ".join(["T", str(m), *map(str, lanes)])
    if y.ndim < 2 or y.shape[2:] not in ((), lanes):
        single = " A record of one component is y[:, None]." if y.ndim == 1 and m == 1 else ""
        raise ModelError(f"Measurements must have shape ({shape}), but it is {y.shape}.{single}")
    if not y.shape[0]:
        raise ModelError(f"The record has no measurements: its shape is {y.shape}.")
    check_measurement(model, y.shape[1:])
    for leaf in jax.tree.leaves(u):
        input_shape = jnp.shape(leaf)
        is_long = len(input_shape) > 1 and input_shape[0] == y.shape[0]
        if not is_long or input_shape[2:] not in ((), lanes):
            bank = f" or (T, k, {', '.join(map(str, lanes))})" if lanes else ""
            raise ModelError(
                f"Inputs must have shape (T, k){bank} with T = {y.shape[0]} as the measurements, "
                f"but it is {input_shape}."
            )
    _check_precision("The measurements are", y, prior)


def check_measurement(model: StateSpaceModel, shape: tuple[int, ...]) -> None:
    """Refuse a measurement of another shape than the sensor's; its values are the filter's affair."""
    model.sensor.space.check(np.full(shape, np.nan), "A measurement")


def check_functions(
    model: StateSpaceModel, prior: Gaussian, u: Inputs, m: int | None = None
) -> None:
    """Refuse functions f or h whose results have the wrong shape or precision.

    Args:
        u: shapes of the inputs of one step.
        m: number of components of a measurement; None leaves h out.
    """
    dtype, lanes = prior.factor.dtype, prior.factor.shape[2:]
    sized = lambda leaf, shape: jax.ShapeDtypeStruct(shape, jnp.result_type(leaf))
    for part, function_name in (
        (model, "The model's function f(x, u, dt)"),
        (model.sensor, "The sensor's function h(x, u)"),
    ):
        if part is model.sensor and m is None:
            return
        # the axes that the filter will use: sigma points, and filters of a bank
        stack = (2 * model.space.size + 1, *lanes) if part.stacked else ()
        x = jax.tree.map(lambda leaf, s=stack: sized(leaf, (leaf.shape[0], *s)), prior.mean)
        now = u
        if part.stacked:
            wide = partial(jax.eval_shape, partial(insert_axes, ndim=1 + len(stack)))
            now = jax.tree.map(wide, u)
        elif lanes:
            now = jax.tree.map(lambda leaf: sized(leaf, leaf.shape[:1]), u)
        more = (jax.ShapeDtypeStruct((), dtype),) if part is model else ()
        out = _trace_shapes(part.function, (x, now, *more), function_name, part.stacked)
        expected = x if part is model else jax.ShapeDtypeStruct((m, *stack), dtype)
        same = jax.tree.structure(expected) == jax.tree.structure(out)
        pairs = list(zip(jax.tree.leaves(out), jax.tree.leaves(expected), strict=False))
        if not same or any(a.shape != b.shape for a, b in pairs):
            raise ModelError(
                f"{function_name} must return {_show_tree(expected)} for a state {_show_tree(x)}, but it returned "
                f"{_show_tree(out)}."
            )
        for a, b in pairs:
            if a.dtype != b.dtype:
                raise SettingError(
                    f"{function_name} returned {a.dtype} for a state of {b.dtype}: give inputs and "
                    "constants the precision of the prior."
                )


def _trace_shapes(
    function: Callable[..., Any], arguments: tuple, function_name: str, stacked: bool
) -> Any:
    """Shapes of a function's result; an exception in it becomes a `ModelError` with a hint."""
    try:
        return jax.eval_shape(function, *arguments)
    except (ModelError, SettingError):
        raise
    except Exception as error:
        hints = ""
        if not jax.tree.leaves(arguments[1]):
            hints = " No inputs were given: pass u if the function uses them."
        if stacked:
            hints += (
                " stacked=True says that the function takes stacks of states, components first "
                "and further axes last; leave it out where it does not."
            )
        first = (str(error).strip().splitlines() or [""])[0].removesuffix(".")
        raise ModelError(
            f"{function_name} failed for a state {_show_tree(arguments[0])} and inputs {_show_tree(arguments[1])}: "
            f"{type(error).__name__}: {first}.{hints}"
        ) from error


def _show_tree(tree: Any) -> str:
    """Description of a pytree's shapes for messages."""
    if tree is None:
        return "None"
    if isinstance(tree, jax.ShapeDtypeStruct):
        return f"an array of shape {tree.shape}"
    if isinstance(tree, dict):
        return "{" + ", ".join(f"{name}: {_show_tree(part)}" for name, part in tree.items()) + "}"
    return f"a {type(tree).__name__} of {len(jax.tree.leaves(tree))} arrays"


def _check_precision(clause: str, array: Any, prior: Gaussian) -> None:
    if array.dtype != prior.factor.dtype:
        raise SettingError(
            f"{clause} {array.dtype}, but the prior's covariance {prior.factor.dtype}: "
            "use one precision."
        )
