"""Parameters from the record of a motion of any mechanism: values, their uncertainty, and what cannot be told.

With predictions h(q) of a record y whose errors have standard deviations sigma, the estimates
minimise the sum of squares of r = (h(q) - y) / sigma, and their errors have the covariance

    P = (J^T J)^-1,    J = dr/dq.

If a singular value of J in units of the parameters' sizes is too small, its direction cannot be
identified: an error names it.

Source: L. Ljung, System Identification (1999), ch. 9.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Float

from ..algebra.least_squares import Search, search, value_and_columns
from ..algebra.space import CyclicVector, Point, Vector
from ..checks.errors import ModelError, SettingError, check_finite, concrete
from ..checks.numbers import increasing_times
from ..checks.shapes import Numbers
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace, places_of
from ..dynamics.statespace.tree import TreeSpace
from ..mechanics.inputs import with_inputs
from ..mechanics.system import System
from ..parameters.table import Parameters
from ..sensing.sensors import AbstractSensor, sensed_motion_at
from .segments import fly

Predict = Callable[[Float[Array, " p"]], Float[Array, "k m"]]


class Unknown(NamedTuple):
    """Unknown number of a parameter table.

    Attributes:
        name: name of the parameter.
        size: typical size of the number, in the parameter's unit.
        places: places of all entries with this value, such as ((0, 1), (1, 0)) of an inertia tensor;
            ((),) for a plain number.
    """

    name: str
    size: float
    places: tuple[tuple[int, ...], ...] = ((),)

    @property
    def label(self) -> str:
        place = self.places[0]
        return self.name + ("[" + ", ".join(map(str, place)) + "]" if place else "")


class IdentifiabilityError(SettingError):
    """Error for a record that does not determine the parameters; the message names them."""


@dataclass(frozen=True)
class Identified:
    """Parameters identified from a record.

    Attributes:
        labels: names of the p parameters.
        values: estimates (p,).
        covariance: covariance of their errors (p, p).
        standard_deviations: standard deviations of their errors (p,).
        singular_values: singular values of J in units of the sizes, largest first (p,): reciprocals of
            the standard deviations along each direction, relative to the parameters' sizes.
        reduced_chi_square: the sum of squares over (numbers in the record less p); near
            one if sigma is right.
        search: the least-squares search.
    """

    labels: tuple[str, ...]
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    standard_deviations: Float[np.ndarray, " p"]
    singular_values: Float[np.ndarray, " p"]
    reduced_chi_square: float
    search: Search

    def within(self, truth: Numbers, deviations: float = 3.0) -> bool:
        """Test whether every value is within so many standard deviations of a known truth (p,)."""
        return bool(
            np.all(np.abs(self.values - np.asarray(truth)) <= deviations * self.standard_deviations)
        )


def table_with(table: Parameters, unknowns: Sequence[Unknown], q: Float[Array, " p"]) -> Parameters:
    """Parameter table with its unknown numbers set to q, which may be traced."""
    values: dict[str, Any] = {}
    for k, unknown in enumerate(unknowns):
        value = values.get(unknown.name, table.value(unknown.name))
        for place in unknown.places:
            value = jnp.asarray(value, dtype=float).at[place].set(q[k])
        values[unknown.name] = value
    return table.replaced(values, source="identified")


def numbers_of(table: Parameters, unknowns: Sequence[Unknown]) -> Float[np.ndarray, " p"]:
    """Values of the unknown numbers in the table."""
    return np.array([float(np.asarray(table.value(u.name))[u.places[0]]) for u in unknowns])


def from_table(
    make: Callable[[Parameters], Any], table: Parameters, unknowns: Sequence[Unknown]
) -> Callable[[Float[Array, " p"]], Any]:
    """A mechanism as a function of some numbers of its parameter table (p,), for `motion_model`.

    Args:
        make: a table -> the mechanism's state space, or its system.

    Raises:
        ModelError: an unknown without a number in the table.
    """
    for unknown in unknowns:
        shape = np.shape(table.value(unknown.name))
        for place in unknown.places:
            if len(place) != len(shape) or any(i >= n for i, n in zip(place, shape, strict=True)):
                raise ModelError(f"'{unknown.name}' has shape {shape}; it has no entry {place}.")
    return lambda q: make(table_with(table, unknowns, q))


Outputs = Sequence[str | AbstractSensor] | Callable[..., Float[Array, " m"]]


def motion_model(
    make: Callable[[Float[Array, " p"]], AbstractStateSpace | System],
    start: Point | Callable[[AbstractStateSpace], Point],
    ts: Numbers,
    outputs: Outputs,
    *,
    inputs: Mapping[str, Any] | None = None,
    space: TreeSpace | None = None,
    method: Method | None = None,
) -> Predict:
    """Predictions (k, m) of the record of a motion, as a function of parameters (p,).

    Args:
        make: function parameters -> mechanism: a state space, or a system, whose coordinates are
            then those of `space`; see `from_table`.
        start: point at the first time, known, or a function of the state space.
        ts: times of the record (k,), increasing [s].
        outputs: columns of the record: names of states, as departures from the start, and
            sensors, in this order; or a function (state space, point) -> (m,).
        inputs: known inputs by name, numbers or histories; see `stmuav_jax.mechanics.with_inputs`.

    Raises:
        SettingError: times that do not increase, an unknown name, a sensor whose readings are no
            vector, or a system without `space`.
    """
    if concrete(ts):
        increasing_times(ts, "The times of the record")
    times = jnp.asarray(ts, dtype=float)
    if method is None:
        method = Method(rtol=1e-9, atol=1e-9, adjoint=diffrax.ForwardMode())

    def predict(q: Float[Array, " p"]) -> Float[Array, "k m"]:
        own = make(q)
        if isinstance(own, System):
            if space is None:
                raise SettingError(
                    "A model that is made as a system needs the state space that has its "
                    "coordinates: motion_model(..., space=TreeSpace(system))."
                )
            own = space.with_system(own)
        first = start(own) if callable(start) else start
        system = with_inputs(own.system, {} if inputs is None else inputs)
        path = fly(own, system, first, times, method)
        if callable(outputs):
            of: Any = outputs
            return jax.vmap(lambda now: of(own, now))(path)
        parts = [_read(own, system, first, times, path, one) for one in outputs]
        return jnp.concatenate(parts, axis=1)

    return predict


def _read(
    space: AbstractStateSpace,
    system: System,
    first: Point,
    ts: Float[Array, " k"],
    path: Point,
    output: str | AbstractSensor,
) -> Float[Array, "k m"]:
    """One output along a path."""
    if isinstance(output, str):
        place = np.array(places_of(space, [output], "The outputs"))
        return jax.vmap(lambda now: space.difference(now, first)[place])(path)
    if not isinstance(output.space(system), Vector | CyclicVector):
        raise SettingError(
            f"The readings of the sensor '{output.name}' are no vector: record the states instead."
        )
    see = lambda t, now: jnp.atleast_1d(output.read(sensed_motion_at(space, now, t, system)))
    return jax.vmap(see)(ts, path)


@eqx.filter_jit
def predicted(predict: Predict, q: Float[Array, " p"]) -> Float[Array, "k m"]:
    """Predictions at parameters q, traced once for their shapes, their derivatives and the search."""
    return predict(q)


class Misfit(eqx.Module):
    """Residuals (k, m) of a record over sigma, as a function of z (p,), q = start + sizes z.

    One compiled search serves all records of a flight: only `predict` is compiled in.
    """

    predict: Predict
    record: Float[Array, "k m"]
    sigma: Float[Array, " m"]
    start: Float[Array, " p"]
    sizes: Float[Array, " p"]

    def __call__(self, z: Float[Array, " p"]) -> Float[Array, "k m"]:
        found = predicted(self.predict, self.start + self.sizes * z)
        # known as soon as the program is made: nothing has to be traced for this check alone
        _check_shape(self.record, found.shape)
        return (found - self.record) / self.sigma


def residuals_and_jacobian(
    residuals: Misfit, z: Float[Array, " p"]
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) and their Jacobian (n, p) at scaled parameters z, by the search's program."""
    r, J = map(np.asarray, value_and_columns(residuals, z))
    return r.reshape(-1), J.reshape(-1, z.shape[0])


def check_identifiable(
    J: Float[np.ndarray, "n p"], labels: Sequence[str], min_singular_value: float = 1.0
) -> Float[np.ndarray, " p"]:
    """Singular values of a whitened Jacobian in units of the sizes, largest first.

    Raises:
        IdentifiabilityError: one is below `min_singular_value`: the standard deviation along its direction
            exceeds 1 / min_singular_value of the parameters' sizes.
    """
    _, values, directions = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    values = np.pad(values, (0, J.shape[1] - len(values)))
    weak = np.flatnonzero(values < max(min_singular_value, 1e-12 * values[0]))
    if not len(weak):
        return values
    words = []
    for k in weak:
        direction = directions[k]
        order = np.argsort(-np.abs(direction))
        parts = [f"{direction[i]:+.2f} {labels[i]}" for i in order if abs(direction[i]) > 0.1]
        words.append(", ".join(parts) + f" (singular value {values[k]:.2g})")
    raise IdentifiabilityError(
        "The record does not determine these combinations of parameters, in units of their "
        f"sizes: {'; '.join(words)}. Singular values of at least {min_singular_value:g} are wanted: leave "
        "one of the parameters out, or record a flight that moves them apart."
    )


def identify(
    predict: Predict,
    record: Numbers,
    sigma: Numbers,
    start: Mapping[str, float] | Numbers,
    sizes: Numbers,
    *,
    labels: Sequence[str] | None = None,
    min_singular_value: float = 1.0,
    steps: int = 50,
    report: Callable[[Search], None] | None = None,
    resume: Search | None = None,
) -> Identified:
    """Identify parameters by least squares from a record.

    Args:
        predict: function parameters (p,) -> predictions (k, m), such as `motion_model`.
        record: measurements (k, m). sigma: standard deviations of their errors (m,).
        start: parameters at which the search starts, by label or in order.
        sizes: typical sizes of the parameters (p,).
        min_singular_value: bound of `check_identifiable`.
        report, resume: arguments of `search`.

    Raises:
        IdentifiabilityError: the record does not determine a direction; the message names it.
        ModelError: a record that is not finite or of another shape than the predictions.
        SettingError: standard deviations or sizes that are not positive, or a start whose
            predictions, or their derivatives, are not finite.
    """
    if isinstance(start, Mapping):
        labels, start = tuple(start), list(start.values())
    q0 = jnp.asarray(start, dtype=float)
    names = tuple(labels) if labels is not None else _numbered(len(q0))
    _check(predict, record, sigma, q0, sizes, names)
    numbers = (jnp.asarray(x, dtype=float) for x in (record, sigma, q0, sizes))
    residuals = Misfit(predict, *numbers)
    r, J = (np.asarray(x) for x in residuals_and_jacobian(residuals, jnp.zeros_like(q0)))
    _check_start(r, J, q0, names)
    check_identifiable(J, names, min_singular_value)
    return _fitted(residuals, names, min_singular_value, steps, report, resume)


def identify_many(
    predict: Predict,
    records: Float[Array, "s k m"],
    sigma: Numbers,
    starts: Numbers,
    sizes: Numbers,
    *,
    labels: Sequence[str] | None = None,
    min_singular_value: float = 1.0,
    steps: int = 50,
) -> Iterator[Identified]:
    """Identify parameters from many records of one flight, one after another, compiled once.

    Args:
        starts: initial parameters, (p,) for all records or (s, p).

    Raises:
        As `identify`; results of the records before the one that raises have been yielded.
    """
    starts = jnp.asarray(starts, dtype=float)
    starts = jnp.broadcast_to(starts, (len(records), starts.shape[-1]))
    names = tuple(labels) if labels is not None else _numbered(starts.shape[-1])
    if not len(records):
        return
    _check(predict, records[0], sigma, starts[0], sizes, names)
    for k, record in enumerate(records):
        check_finite(record, f"Record {k}", "")
        numbers = (jnp.asarray(x, dtype=float) for x in (record, sigma, starts[k], sizes))
        yield _fitted(Misfit(predict, *numbers), names, min_singular_value, steps, None, None)


def _fitted(
    residuals: Misfit,
    names: tuple[str, ...],
    min_singular_value: float,
    steps: int,
    report: Callable[[Search], None] | None,
    resume: Search | None,
) -> Identified:
    zero = jnp.zeros_like(residuals.start)
    method = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    found = search(residuals, zero, method, steps=steps, report=report, resume=resume)
    r, J = (np.asarray(x) for x in residuals_and_jacobian(residuals, found.values))
    singular_values = check_identifiable(J, names, min_singular_value)
    scale = np.asarray(residuals.sizes)
    covariance = scale[:, None] * np.linalg.inv(J.T @ J) * scale
    reduced = float(r @ r) / max(r.size - len(scale), 1)
    values = np.asarray(residuals.start + scale * found.values)
    deviations = np.sqrt(np.diag(covariance))
    return Identified(names, values, covariance, deviations, singular_values, reduced, found)


def _check_start(r: np.ndarray, J: np.ndarray, q0: Array, names: Sequence[str]) -> None:
    """Raise if the start cannot be flown, so that its derivatives carry no information."""
    if np.all(np.isfinite(r)) and np.all(np.isfinite(J)):
        return
    what = "predictions" if not np.all(np.isfinite(r)) else "derivatives of the predictions"
    values = ", ".join(f"{name} = {float(q):g}" for name, q in zip(names, q0, strict=True))
    raise SettingError(
        f"The {what} at the start of the search are not finite: the model cannot be evaluated with "
        f"{values}. Start from values that it can have."
    )


def _numbered(count: int) -> tuple[str, ...]:
    return tuple(f"q_{k}" for k in range(count))


def _check_shape(record: Any, shape: tuple[int, ...]) -> None:
    if np.shape(record) != shape:
        raise ModelError(f"The record has shape {np.shape(record)}, but predictions have {shape}.")


def _check(
    predict: Predict, record: Any, sigma: Any, q0: Array, sizes: Any, names: Sequence[str]
) -> None:
    for value, what in ((record, "The record"), (sigma, "The deviations of the record")):
        check_finite(value, what, "")
    shape = np.shape(record)
    if np.shape(sigma) != shape[-1:] or not np.all(np.asarray(sigma) > 0):
        # which of the two is wrong, only the predictions tell
        shape = eqx.filter_eval_shape(predicted, predict, q0).shape
        _check_shape(record, shape)
        raise SettingError(f"The record needs {shape[-1]} positive deviations, not {sigma}.")
    if np.shape(sizes) != q0.shape or not np.all(np.asarray(sizes) > 0):
        raise SettingError(f"There must be {len(q0)} positive sizes, not {sizes}.")
    if len(names) != len(q0):
        raise SettingError(f"There are {len(q0)} parameters, but {len(names)} names.")
