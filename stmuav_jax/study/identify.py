"""Parameters from the record of a flight: values, their uncertainty, and what cannot be told.

With predictions h(q) of a record y whose errors have deviations sigma, the values are those of
least squares, r = (h(q) - y) / sigma, and near them errors are Gaussian with the covariance

    P = (J^T J)^-1,    J = dr/dq.

Directions of q in which J says less than a chosen share of the parameters' own sizes are named,
not fitted.

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

from ..algebra.compiler import quick_jit
from ..algebra.rotation import conjugate, product, to_rotation_vector
from ..algebra.shapes import Numbers
from ..dynamics.integrate import integrate
from ..dynamics.problem import Method
from ..mechanics.errors import ModelError, SettingError, check_finite
from ..vehicle.flyer import Coordinates, Flyer, Inputs
from ..vehicle.kinematics import strokes
from ..vehicle.parameters import Parameters
from .search import Search, search

Predict = Callable[[Float[Array, " p"]], Float[Array, "k m"]]


class Unknown(NamedTuple):
    """A number of a parameter table: name, place in its value, and a typical size.

    `places` are all entries that take it, such as ((0, 1), (1, 0)) of an inertia tensor; () for
    a plain number.
    """

    name: str
    size: float
    places: tuple[tuple[int, ...], ...] = ((),)

    @property
    def label(self) -> str:
        place = self.places[0]
        return self.name + ("[" + ", ".join(map(str, place)) + "]" if place else "")


class IdentifiabilityError(SettingError):
    """A record does not determine the parameters; the message names them and the direction."""


@dataclass(frozen=True)
class Identified:
    """Parameters found from a record.

    Attributes:
        labels: p of them. values: (p,). covariance: (p, p). deviations: (p,).
        strengths: singular values of J in units of the sizes, largest first (p,): one over the
            deviation along each direction, as a share of the parameters' sizes.
        misfit: sum of squares over (numbers in the record less p); near one if sigma is right.
        search: how they were found.
    """

    labels: tuple[str, ...]
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    deviations: Float[np.ndarray, " p"]
    strengths: Float[np.ndarray, " p"]
    misfit: float
    search: Search

    def within(self, truth: Numbers, deviations: float = 3.0) -> bool:
        """Whether every value lies within so many deviations of a known truth (p,)."""
        return bool(np.all(np.abs(self.values - np.asarray(truth)) <= deviations * self.deviations))


def table_with(table: Parameters, unknowns: Sequence[Unknown], q: Float[Array, " p"]) -> Parameters:
    """The table with its unknown numbers set to q, which may be traced."""
    values: dict[str, Any] = {}
    for k, unknown in enumerate(unknowns):
        value = values.get(unknown.name, table.value(unknown.name))
        for place in unknown.places:
            value = jnp.asarray(value, dtype=float).at[place].set(q[k])
        values[unknown.name] = value
    return table.replaced(values, source="identified")


def numbers_of(table: Parameters, unknowns: Sequence[Unknown]) -> Float[np.ndarray, " p"]:
    """What the table says of the unknown numbers."""
    return np.array([float(np.asarray(table.value(u.name))[u.places[0]]) for u in unknowns])


# What a flight's record has in each row, with units: position and attitude (rotation vector from
# level) of the base, its angular velocity in its own axes, strokes of both sliders.
OUTPUTS = (
    *((f"r_{k}", "m") for k in "xyz"),
    *((f"theta_{k}", "rad") for k in "xyz"),
    *((f"omega_{k}", "rad/s") for k in "xyz"),
    ("stroke_2", "m"),
    ("stroke_3", "m"),
)


def flight_model(
    make: Callable[[Parameters], Flyer],
    table: Parameters,
    unknowns: Sequence[Unknown],
    start: Coordinates,
    inputs: Inputs | Callable[[Flyer], Inputs],
    ts: Float[np.ndarray, " k"],
    method: Method | None = None,
) -> Predict:
    """Predictions (k, 11) of a flight's record, see `OUTPUTS`, as a function of unknown numbers.

    Args:
        make: a table -> the flyer. start: at ts[0], known. inputs: known numbers or histories.

    Raises:
        ModelError: an unknown without a number in the table.
    """
    for unknown in unknowns:
        shape = np.shape(table.value(unknown.name))
        for place in unknown.places:
            if len(place) != len(shape) or any(i >= n for i, n in zip(place, shape, strict=True)):
                raise ModelError(f"'{unknown.name}' has shape {shape}; it has no entry {place}.")
    method = (
        Method(rtol=1e-9, atol=1e-9, adjoint=diffrax.ForwardMode()) if method is None else method
    )

    def predict(q: Float[Array, " p"]) -> Float[Array, "k 11"]:
        flyer = make(table_with(table, unknowns, q))
        given = inputs(flyer) if callable(inputs) else inputs
        run = integrate(flyer.with_inputs(given), flyer.state(start), jnp.asarray(ts), method)

        def row(state: Any) -> Float[Array, "11"]:
            at = flyer.coordinates(state)
            turned = to_rotation_vector(product(conjugate(start.p), at.p))
            return jnp.concatenate([at.r, turned, at.omega, strokes(flyer.geometry, at.angles)])

        return jax.vmap(row)(run.states)

    return predict


class Misfit(eqx.Module):
    """Residuals (k, m) of a record in deviations, as a function of z (p,), q = start + sizes z.

    One compiled search serves all records of a flight: only `predict` is compiled in.
    """

    predict: Predict
    record: Float[Array, "k m"]
    sigma: Float[Array, " m"]
    start: Float[Array, " p"]
    sizes: Float[Array, " p"]

    def __call__(self, z: Float[Array, " p"]) -> Float[Array, "k m"]:
        return (self.predict(self.start + self.sizes * z) - self.record) / self.sigma


@quick_jit
def _at(residuals: Misfit, z: Float[Array, " p"]) -> tuple[Float[Array, " n"], Float[Array, "n p"]]:
    """Residuals and their Jacobian."""
    push = lambda e: jax.jvp(residuals, (z,), (e,))
    r, J = jax.vmap(push, out_axes=(None, -1))(jnp.eye(z.shape[0], dtype=z.dtype))
    return r.reshape(-1), J.reshape(-1, z.shape[0])


def check_identifiable(
    J: Float[np.ndarray, "n p"], labels: Sequence[str], weakest: float = 1.0
) -> Float[np.ndarray, " p"]:
    """Singular values of a whitened Jacobian in units of the sizes, largest first.

    Raises:
        IdentifiabilityError: one is below `weakest`: along its direction the record leaves a
            deviation of more than 1 / weakest of the parameters' own sizes.
    """
    _, values, directions = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    values = np.pad(values, (0, J.shape[1] - len(values)))
    weak = np.flatnonzero(values < max(weakest, 1e-12 * values[0]))
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
        f"sizes: {'; '.join(words)}. Singular values of at least {weakest:g} are wanted: leave "
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
    weakest: float = 1.0,
    steps: int = 50,
    report: Callable[[Search], None] | None = None,
    resume: Search | None = None,
) -> Identified:
    """Fit parameters to a record.

    Args:
        predict: parameters (p,) -> predictions (k, m), such as `flight_model`.
        record: (k, m). sigma: standard deviations of its errors (m,).
        start: where the search starts, by label or in order. sizes: typical sizes (p,).
        weakest: see `check_identifiable`.
        report, resume: see `search`.

    Raises:
        IdentifiabilityError: the record leaves a direction open; names it.
        ModelError: a record that is not finite or of another form than the predictions.
        SettingError: deviations or sizes that are not positive, or a start whose predictions, or
            their derivatives, are not finite.
    """
    if isinstance(start, Mapping):
        labels, start = tuple(start), list(start.values())
    q0 = jnp.asarray(start, dtype=float)
    names = tuple(labels) if labels is not None else _numbered(len(q0))
    _check(predict, record, sigma, q0, sizes, names)
    numbers = (jnp.asarray(x, dtype=float) for x in (record, sigma, q0, sizes))
    residuals = Misfit(predict, *numbers)
    r, J = (np.asarray(x) for x in _at(residuals, jnp.zeros_like(q0)))
    _check_start(r, J, q0, names)
    check_identifiable(J, names, weakest)
    return _fitted(residuals, names, weakest, steps, report, resume)


def identify_many(
    predict: Predict,
    records: Float[Array, "s k m"],
    sigma: Numbers,
    starts: Numbers,
    sizes: Numbers,
    *,
    labels: Sequence[str] | None = None,
    weakest: float = 1.0,
    steps: int = 50,
) -> Iterator[Identified]:
    """`identify` for many records of one flight, one after another; compiled once.

    Args:
        starts: where the searches start, (p,) for all or (s, p).

    Raises:
        As `identify`; what came before the record that raises has been yielded.
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
        yield _fitted(Misfit(predict, *numbers), names, weakest, steps, None, None)


def _fitted(
    residuals: Misfit,
    names: tuple[str, ...],
    weakest: float,
    steps: int,
    report: Callable[[Search], None] | None,
    resume: Search | None,
) -> Identified:
    zero = jnp.zeros_like(residuals.start)
    method = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    found = search(residuals, zero, method, steps=steps, report=report, resume=resume)
    r, J = (np.asarray(x) for x in _at(residuals, found.values))
    strengths = check_identifiable(J, names, weakest)
    scale = np.asarray(residuals.sizes)
    covariance = scale[:, None] * np.linalg.inv(J.T @ J) * scale
    misfit = float(r @ r) / max(r.size - len(scale), 1)
    values = np.asarray(residuals.start + scale * found.values)
    deviations = np.sqrt(np.diag(covariance))
    return Identified(names, values, covariance, deviations, strengths, misfit, found)


def _check_start(r: np.ndarray, J: np.ndarray, q0: Array, names: Sequence[str]) -> None:
    """Refuse a start that cannot be flown: its derivatives say nothing about the record."""
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


def _check(
    predict: Predict, record: Any, sigma: Any, q0: Array, sizes: Any, names: Sequence[str]
) -> None:
    for value, what in ((record, "The record"), (sigma, "The deviations of the record")):
        check_finite(value, what, "")
    shape = jax.eval_shape(predict, q0).shape
    if np.shape(record) != shape:
        raise ModelError(f"The record has shape {np.shape(record)}, but predictions have {shape}.")
    if np.shape(sigma) != shape[-1:] or not np.all(np.asarray(sigma) > 0):
        raise SettingError(f"The record needs {shape[-1]} positive deviations, not {sigma}.")
    if np.shape(sizes) != q0.shape or not np.all(np.asarray(sizes) > 0):
        raise SettingError(f"There must be {len(q0)} positive sizes, not {sizes}.")
    if len(names) != len(q0):
        raise SettingError(f"There are {len(q0)} parameters, but {len(names)} names.")
