"""Parameters from the record of a motion of any mechanism: values, uncertainty, unidentifiable combinations.

With predictions h(q, e) of a record y whose errors have standard deviations sigma, the estimates
minimise the sum of squares of

    r = (h(q, e) - y) / sigma    and    e,

where e are the errors of the motion's start in units of its prior. Differences are those of the
readings' own space: angles may be recorded with or without their turns. The errors of the estimates have
the covariance

    P = (J^T J)^-1,    J = d(r, e)/d(q, e)

if r is white; `fit_statistics` has the covariance of correlated residuals, and the verdict.

If a singular value of J in units of the parameters' sizes is too small, its direction cannot be
identified: an error names it.

Source: L. Ljung, System Identification (1999), ch. 9.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

from ..checks.errors import ModelError, SettingError, check_finite, has_values, named_places
from ..checks.numbers import check_inertia, check_mass, increasing_times
from ..checks.shapes import Numbers
from ..dynamics.method import Method
from ..dynamics.statespace.base import AbstractStateSpace, places_of
from ..dynamics.statespace.tree import TreeSpace
from ..estimation.gaussians import Gaussian, covariance_root
from ..math.least_squares import Search, search, value_and_columns
from ..math.space import (
    AbstractSpace,
    Concatenated,
    CyclicVector,
    Point,
    Rotation,
    RotationVector,
    Vector,
)
from ..mechanics.inputs import with_inputs
from ..mechanics.parameters import Parameters
from ..mechanics.system import System
from .fit_statistics import (
    Deviations,
    Fit,
    FitVerdict,
    compute_deviations,
    compute_p_values,
    judge_fit,
)
from .multiple_shooting import integrate_points
from .sensors import AbstractSensor, sensed_motion_at

Predict = Callable[[Float[Array, " p"]], Float[Array, "k c"]]

# First readings of a column from which a start and its deviations are taken.
_FIRST_READINGS = 6
# Fields of force elements that no mechanism has below zero.
_NOT_NEGATIVE = (
    "linear", "quadratic", "damping", "viscous", "coulomb", "stiffness", "friction", "turning",
    "sliding", "k_f",
)  # fmt: skip


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
        covariance: covariance of their errors (p, p): of white residuals, or by blocks where residuals are
            correlated, with the scatter between windows; `deviations` has the parts.
        standard_deviations: standard deviations of their errors (p,), from `covariance`.
        deviations: parts of the standard deviations.
        singular_values: singular values of J in units of the sizes, largest first (p,): reciprocals of
            the standard deviations of white residuals along each direction, relative to the parameters'
            sizes, with an unknown start.
        reduced_chi_square: the sum of squares over (numbers in the record less p); near
            one if sigma is right.
        verdict: whether values and deviations are valid; `verdict.explanation` has the reasons.
        residuals: residuals over sigma (k, m), NaN where the record is missing.
        start: the motion's start by the whole record; None where it was taken as exact.
        search: the least-squares search.
    """

    labels: tuple[str, ...]
    values: Float[np.ndarray, " p"]
    covariance: Float[np.ndarray, "p p"]
    standard_deviations: Float[np.ndarray, " p"]
    deviations: Deviations
    singular_values: Float[np.ndarray, " p"]
    reduced_chi_square: float
    verdict: FitVerdict
    residuals: Float[np.ndarray, "k m"]
    start: Gaussian | None
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
Made = AbstractStateSpace | System | tuple[AbstractStateSpace | System, Point]


class MotionModel(eqx.Module):
    """Predictions (k, c) of the record of a motion, a function of parameters and the start's errors.

    Attributes:
        predict: function (p + s,) -> predictions (k, c).
        readings: function (p + s,) -> space of a row of the record.
        start: function (p + s,) -> state space, mean of the start, and the start itself.
        spread: function of the state space -> root (n, s) of the covariance of the start's errors.
        faults: function (p + s,) -> sentences on unphysical values, such as a negative mass.
        start_count: number s of the start's errors, zero for an exact start.
    """

    predict: Callable[[Float[Array, " q"]], Float[Array, "k c"]]
    readings: Callable[[Float[Array, " q"]], AbstractSpace]
    start: Callable[[Float[Array, " q"]], tuple[AbstractStateSpace, Point, Point]]
    spread: Callable[[AbstractStateSpace], Float[Array | np.ndarray, "n s"]]
    faults: Callable[[Float[Array, " q"]], tuple[str, ...]]
    start_count: int = eqx.field(static=True)

    def __call__(
        self, q: Float[Array, " p"], errors: Float[Array, " s"] | None = None
    ) -> Float[Array, "k c"]:
        """Predictions with parameters (p,) and errors of the start (s,), in units of its prior; by default zero."""
        errors = jnp.zeros(self.start_count) if errors is None else errors
        return self.predict(jnp.concatenate([q, errors]))


def motion_model(
    make: Callable[[Float[Array, " p"]], Made],
    start: Point | Gaussian | Callable[[AbstractStateSpace], Point] | None,
    ts: Numbers,
    outputs: Outputs,
    *,
    inputs: Mapping[str, Any] | None = None,
    space: TreeSpace | None = None,
    method: Method | None = None,
    start_deviations: Mapping[str, float] | Numbers | None = None,
    readings: AbstractSpace | None = None,
) -> MotionModel:
    """Predictions (k, c) of the record of a motion, as a function of parameters (p,).

    A start with deviations, or a `Gaussian` on the state space, is a prior: its errors become unknowns of
    `identify`. A start without deviations is taken as exact, so that its errors bias the parameters.

    Args:
        make: function parameters -> make_space: a state space, or a system, whose coordinates are
            then those of `space`; see `from_table`. With a start that depends on the parameters, pairs
            (mechanism, point).
        start: point at the first time, a function of the state space, or a Gaussian; None where `make`
            returns it.
        ts: times of the record (k,), increasing [s].
        outputs: columns of the record: names of states, as departures from the start (from its mean
            where it is uncertain), and sensors, in this order; or a function (state space, point) -> (c,).
        inputs: known inputs by name, numbers or histories; see `stmuav_jax.mechanics.with_inputs`.
        start_deviations: standard deviations of the start's errors by the state's name (other states are
            exact), or their covariance (n, n).
        readings: space of a row of `outputs` that is a function, such as `CyclicVector((True, False))` where
            the first column is an angle; by default a vector.

    Raises:
        SettingError: times that do not increase, an unknown name, a sensor whose readings are no
            array, one component of a rotation vector without the others, a system without `space`, or two
            priors of the start. ModelError: an invalid covariance.
    """
    if has_values(ts):
        increasing_times(ts, "The times of the record")
    times = jnp.asarray(ts, dtype=float)
    if method is None:
        method = Method(rtol=1e-9, atol=1e-9, adjoint=diffrax.ForwardMode())
    mean: Any = start.mean if isinstance(start, Gaussian) else start
    count, spread = _start_spread(start, start_deviations)

    def make_space(q: Float[Array, " q"]) -> tuple[AbstractStateSpace, Point]:
        """State space, and the mean of the start in it."""
        result: Any = make(q[: len(q) - count])
        # a named tuple would be a point
        model_space, first = result if type(result) is tuple else (result, mean)
        if isinstance(model_space, System):
            if space is None:
                raise SettingError(
                    "A model that is made as a system needs the state space that has its "
                    "coordinates: motion_model(..., space=TreeSpace(system))."
                )
            model_space = space.with_system(model_space)
        if first is None:
            raise SettingError("The motion needs a start: give one, or return it from `make`.")
        return model_space, first(model_space) if callable(first) else first

    def first_point(q: Float[Array, " q"]) -> tuple[AbstractStateSpace, Point, Point]:
        """State space, mean of the start, and the start with its errors."""
        model_space, first = make_space(q)
        if not count:
            return model_space, first, first
        errors = jnp.asarray(spread(model_space)) @ q[len(q) - count :]
        return model_space, first, model_space.retract(first, errors)

    def predict_outputs(q: Float[Array, " q"]) -> Float[Array, "k c"]:
        model_space, origin, first = first_point(q)
        system = with_inputs(model_space.system, {} if inputs is None else inputs)
        path = integrate_points(model_space, system, first, times, method)
        if callable(outputs):
            of: Any = outputs
            return jax.vmap(lambda now: of(model_space, now))(path)
        parts = []
        for output, _ in _list_outputs(model_space, system, outputs):
            if isinstance(output, tuple):
                places = np.array(places_of(model_space, output, "The outputs"))
                departure = lambda now, k=places: model_space.difference(now, origin)[k]
                parts.append(jax.vmap(departure)(path))
            else:
                see = lambda t, now, sensor=output: jnp.atleast_1d(
                    sensor.read(sensed_motion_at(model_space, now, t, system))
                )
                parts.append(jax.vmap(see)(times, path))
        return jnp.concatenate(parts, axis=1)

    def row_space(q: Float[Array, " q"]) -> AbstractSpace:
        model_space, _ = make_space(q)
        if callable(outputs):
            size = eqx.filter_eval_shape(predict_outputs, q).shape[1]
            return Vector(size) if readings is None else readings
        return Concatenated(
            *(part for _, part in _list_outputs(model_space, model_space.system, outputs))
        )

    def list_faults(q: Float[Array, " q"]) -> tuple[str, ...]:
        try:
            model_space, _ = make_space(q)
        except ValueError as error:
            return (f"No mechanism has these values: {error}",)
        return physical_faults(model_space.system)

    return MotionModel(predict_outputs, row_space, first_point, spread, list_faults, count)


def _start_spread(
    start: Any, deviations: Mapping[str, float] | Numbers | None
) -> tuple[int, Callable[[AbstractStateSpace], Float[Array | np.ndarray, "n s"]]]:
    """Number s of the start's errors, and the root (n, s) of their covariance in a state space."""
    if isinstance(start, Gaussian):
        if deviations is not None:
            raise SettingError(
                "The start is a Gaussian, which contains its deviations: leave start_deviations out."
            )
        factor = np.asarray(start.factor)
    elif deviations is None:
        return 0, lambda space: np.zeros((space.size, 0))
    elif isinstance(deviations, Mapping):
        names = [name for name, value in deviations.items() if value != 0]
        sizes = np.array([float(deviations[name]) for name in names])
        if not np.all(np.isfinite(sizes)) or np.any(sizes < 0):
            raise SettingError(
                f"The start's deviations must be finite and not negative, but they are {dict(deviations)}."
            )

        def spread_columns(space: AbstractStateSpace) -> Float[Array | np.ndarray, "n s"]:
            places_of(space, list(deviations), "The start's deviations")
            places = places_of(space, names, "The start's deviations")
            return np.eye(space.size)[:, list(places)] * sizes

        return len(names), spread_columns
    else:
        factor = np.asarray(
            covariance_root(np.asarray(deviations, dtype=float), "The start's covariance")
        )
    # a direction without variance is no unknown
    factor = factor[:, np.any(factor != 0, axis=0)]

    def spread_start(space: AbstractStateSpace) -> Float[Array | np.ndarray, "n s"]:
        if factor.shape[0] != space.size:
            raise ModelError(
                f"The start's covariance is of {factor.shape[0]} states, but the state space has "
                f"{space.size}: {', '.join(name for name, _ in space.names)}."
            )
        return factor

    return factor.shape[1], spread_start


def start_from_readings(
    space: AbstractStateSpace,
    names: Sequence[str],
    ts: Numbers,
    record: Numbers,
    sigma: Numbers,
    values: Mapping[str, float],
    readings: AbstractSpace | None = None,
    *,
    without: Collection[str] = (),
) -> tuple[Float[np.ndarray, " n"], dict[str, float]]:
    """Step (n,) from an assumed start to that of the first readings, and its wide deviations by state.

    A state whose column is in the record starts at its first reading, a rate whose coordinate is there at the
    slope of the first two; other states keep the assumed start, as exact. Deviations are ten times those of the
    readings, so that using readings twice adds only a hundredth of their information.

    Args:
        names: names of the columns. ts: times (k,) [s]. record: (k, c). sigma: deviations of a row (c,).
        values: values of columns and states at the assumed start, by name.
        readings: space of a row; by default a vector.
        without: states that are left as they are.
    """
    times, y = np.asarray(ts, dtype=float), filled_record(record)
    row = Vector(len(names)) if readings is None else readings
    step, spread = np.zeros(space.size), {}
    for place, (name, _) in enumerate(space.names):
        column = name if name in names else name.removesuffix("_rate")
        if name in without or column not in names:
            continue
        k = list(names).index(column)
        deviation = float(np.asarray(sigma)[k])
        rows = np.flatnonzero(np.isfinite(y[:, k]))[:_FIRST_READINGS]
        difference = lambda a, b, k=k: np.asarray(row.difference(jnp.asarray(a), jnp.asarray(b)))[k]
        # Slopes of an angle are differences in the reading's own space, since a record may wrap between two
        # rows.
        slopes = difference(y[rows[1:]].T, y[rows[:-1]].T) / np.diff(times[rows])
        if column == name:
            now = y[rows[0]].copy()
            now[k] = values[name]
            # A first reading that comes late says less about the start: its deviation grows by the distance that
            # the state may have moved.
            late = float(times[rows[0]] - times[0])
            step[place] = difference(y[rows[0]], now)
            spread[name] = 10 * deviation + late * float(np.max(np.abs(slopes), initial=0.0))
        elif len(slopes):
            # how far a slope may be from that at the start, by those that follow
            bend = float(np.max(np.abs(slopes - slopes[0])))
            step[place] = slopes[0] - values[name]
            spread[name] = (
                10 * np.sqrt(2) * deviation / float(times[rows[1]] - times[rows[0]]) + bend
            )
    return step, spread


def physical_faults(system: System) -> tuple[str, ...]:
    """Sentences on masses, inertia tensors and coefficients of a system that nothing can have.

    Coefficients are those that the force elements themselves refuse: a negative drag, damping or
    stiffness.
    """
    faults: list[str] = []
    masses, inertias = np.asarray(system.bodies.mass), np.asarray(system.bodies.inertia)
    for name, mass, inertia in zip(system.names, masses, inertias, strict=True):
        for check in (
            lambda mass=mass, name=name: check_mass(float(mass), f"body '{name}'"),
            lambda J=inertia, name=name: check_inertia(J, f"body '{name}'", 1e-9),
        ):
            try:
                check()
            except ModelError as error:
                faults.append(str(error))
    for force in system.forces:
        # A force element of a user may have negative coefficients for reasons of its own.
        if not type(force).__module__.startswith("stmuav_jax."):
            continue
        for path, leaf in jax.tree_util.tree_leaves_with_path(force):
            name = jax.tree_util.keystr(path).strip(".")
            if name.split(".")[-1] not in _NOT_NEGATIVE or not eqx.is_array(leaf):
                continue
            if np.any(np.asarray(leaf) < 0):
                owner = getattr(force, "body", None) or getattr(force, "joint", None) or ""
                of = f"{type(force).__name__}{f' of {owner}' if owner else ''}"
                value_text = np.asarray(leaf).tolist()
                faults.append(f"The {name} of {of} must not be negative, but it is {value_text}.")
    return tuple(faults)


def _list_outputs(
    space: AbstractStateSpace, system: System, outputs: Sequence[str | AbstractSensor]
) -> list[tuple[tuple[str, ...] | AbstractSensor, AbstractSpace]]:
    """Sensors and groups of states, one column or the three of a rotation vector, with their spaces."""
    names, parts, rest = [name for name, _ in space.names], [], list(outputs)
    turning = dict(zip(names, getattr(space, "periodic", [False] * len(names)), strict=True))
    while rest:
        output = rest[0]
        if not isinstance(output, str):
            group, reading_space = output, output.space(system)
            if not isinstance(reading_space, Vector | CyclicVector | Rotation):
                raise SettingError(
                    f"The readings of the sensor '{output.name}' are no array: record the states instead."
                )
        else:
            places_of(space, [output], "The outputs")
            group, reading_space, stem = (
                (output,),
                CyclicVector((bool(turning[output]),)),
                output[:-1],
            )
            if output[-2:] in ("_x", "_y", "_z") and stem.endswith(("theta_", "rotation_")):
                # A whole turn changes all three components of a rotation vector, so that one of them alone cannot
                # be compared with a record.
                group, reading_space = tuple(f"{stem}{axis}" for axis in "xyz"), RotationVector()
                if tuple(rest[:3]) != group:
                    raise SettingError(
                        f"The outputs name '{output}', one component of a rotation vector, which whole "
                        f"turns change with the others: name {', '.join(group)} together, in this order."
                    )
        parts.append((group, reading_space))
        rest = rest[len(group) if isinstance(group, tuple) else 1 :]
    return parts


@eqx.filter_jit
def predict_columns(
    predict: Predict, q: Float[Array, " p"], errors: Float[Array, " s"] | None = None
) -> Float[Array, "k c"]:
    """Predictions at parameters q, traced once for their shapes, their derivatives and the search."""
    return predict(q, errors) if isinstance(predict, MotionModel) else predict(q)


class Misfit(eqx.Module):
    """Residuals of a record over sigma, and the start's errors, as a function of unknowns z (p + s,).

    The first p unknowns give the parameters, q = start + sizes z within their bounds; the others are the
    start's errors in units of its prior. One compiled search serves all records of a flight: only
    `predict` is compiled in.

    Attributes:
        record: NaN where a number is missing.
        readings: space of a row of the record; None for a vector.
        lower, upper: bounds of the parameters (p,); None without any.
        follows_turns: angles are compared with the turns of the record, which helps a search that begins
            far off; otherwise by their nearest difference.
    """

    predict: Predict
    record: Float[Array, "k c"]
    sigma: Float[Array, " m"]
    start: Float[Array, " p"]
    sizes: Float[Array, " p"]
    readings: AbstractSpace | None = None
    lower: Float[Array, " p"] | None = None
    upper: Float[Array, " p"] | None = None
    follows_turns: Bool[Array, ""] | bool = False

    def __call__(self, z: Float[Array, " q"]) -> Float[Array, " r"]:
        p = self.start.shape[0]
        predictions = predict_columns(self.predict, self.values(z[:p]), z[p:])
        # known as soon as the program is made: nothing has to be traced for this check alone
        _check_shape(self.record, predictions.shape)
        # A missing number takes the prediction's place before the difference is formed: a NaN that is masked
        # afterwards would still make the derivative NaN.
        record = jnp.where(jnp.isnan(self.record), predictions, self.record)
        residuals = (
            predictions - record
            if self.readings is None
            else self.readings.difference(predictions.T, record.T).T
        )
        measured = self.measured
        if self.readings is not None:
            # components of an error that are angles
            turning = np.concatenate([
                part.angular if isinstance(part, CyclicVector) else np.zeros(part.size, bool)
                for part in _list_spaces(self.readings)
            ]).astype(bool)  # fmt: skip
            if np.any(turning):
                whole = jax.lax.stop_gradient(_count_turns(residuals, measured))
                residuals = residuals + jnp.where(
                    turning & self.follows_turns, 2 * jnp.pi * whole, 0.0
                )
        r = jnp.where(measured, residuals, 0.0) / self.sigma
        # The start's errors in units of their prior are residuals as well: least squares is then the maximum
        # of the posterior.
        return jnp.concatenate([r.reshape(-1), z[p:]])

    def values(self, z: Float[Array, " p"]) -> Float[Array, " p"]:
        """Parameters from their unknowns: logarithmic at one bound, logistic between two."""
        q, size = self.start, self.sizes
        if self.lower is None or self.upper is None:
            return q + size * z
        # All four maps have the slope `size` at the start, so that the search begins alike with bounds and
        # without.
        low, high = jnp.isfinite(self.lower), jnp.isfinite(self.upper)
        lower, upper = jnp.where(low, self.lower, q - 1.0), jnp.where(high, self.upper, q + 1.0)
        below, above = q - lower, upper - q
        share = below / (below + above)
        middle = jnp.log(below / above) + size * z / ((below + above) * share * (1 - share))
        between = lower + (upper - lower) * jax.nn.sigmoid(middle)
        over = lower + below * jnp.exp(size * z / below)
        under = upper - above * jnp.exp(-size * z / above)
        free = q + size * z
        return jnp.where(low & high, between, jnp.where(low, over, jnp.where(high, under, free)))

    @property
    def measured(self) -> Bool[Array, "k m"]:
        """False where a number of the errors is missing: one component of a rotation takes the others."""
        present, flags, k = ~jnp.isnan(self.record), [], 0
        if self.readings is None:
            return present
        for part in _list_spaces(self.readings):
            columns = 4 if isinstance(part, Rotation) else part.size
            part_flags = present[:, k : k + columns]
            if not isinstance(part, Vector | CyclicVector):
                whole = jnp.all(part_flags, axis=1, keepdims=True)
                part_flags = jnp.repeat(whole, part.size, axis=1)
            flags.append(part_flags)
            k += columns
        return jnp.concatenate(flags, axis=1)


def _list_spaces(space: AbstractSpace) -> tuple[AbstractSpace, ...]:
    return space.parts if isinstance(space, Concatenated) else (space,)


def _count_turns(misfit: Float[Array, "k m"], measured: Bool[Array, "k m"]) -> Float[Array, "k m"]:
    """Whole turns by which wrapped differences (k, m) must be moved to be continuous in time."""
    rows = jnp.arange(misfit.shape[0])[:, None]
    # Gaps are bridged by the last reading before them: the difference across a gap is the one that has to
    # be continuous.
    last = jax.lax.cummax(jnp.where(measured, rows, 0), axis=0)
    # before the first reading there is nothing that the first difference could continue
    first = jnp.argmax(measured, axis=0)
    filled = jnp.take_along_axis(misfit, jnp.maximum(last, first), axis=0)
    jumps = jnp.round(jnp.diff(filled, axis=0) / (2 * jnp.pi))
    return -jnp.concatenate([jnp.zeros_like(misfit[:1]), jnp.cumsum(jumps, axis=0)])


def residuals_and_jacobian(
    residuals: Misfit, z: Float[Array, " q"]
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (n,) and their Jacobian (n, q) at scaled unknowns z, by the search's program."""
    r, J = map(np.asarray, value_and_columns(residuals, z))
    return r, J


def check_identifiable(
    J: Float[np.ndarray, "n p"], labels: Sequence[str], min_singular_value: float = 1.0
) -> Float[np.ndarray, " p"]:
    """Singular values of a whitened Jacobian in units of the sizes, largest first.

    Raises:
        IdentifiabilityError: one is below `min_singular_value`: the standard deviation along its direction
            exceeds 1 / min_singular_value of the parameters' sizes.
    """
    # In units of the typical sizes a singular value of one means a standard deviation as large as the
    # parameter: below it, the record says nothing about that combination.
    _, values, directions = np.linalg.svd(J, full_matrices=len(J) < J.shape[1])
    values = np.pad(values, (0, J.shape[1] - len(values)))
    weak = np.flatnonzero(values < max(min_singular_value, 1e-12 * values[0]))
    if not len(weak):
        return values
    combinations = []
    for k in weak:
        order = np.argsort(-np.abs(directions[k]))
        direction = directions[k] * np.sign(
            directions[k][order[0]]
        )  # its sign is free: the largest share is +
        parts = [f"{direction[i]:+.2f} {labels[i]}" for i in order if abs(direction[i]) > 0.1]
        combinations.append(", ".join(parts) + f" (singular value {values[k]:.2g})")
    raise IdentifiabilityError(
        "The record does not determine these combinations of parameters, in units of their "
        f"sizes: {'; '.join(combinations)}. Singular values of at least {min_singular_value:g} are "
        f"required: leave one of the parameters out, or record a flight that moves them apart."
    )


def identify(
    predict: Predict,
    record: Numbers,
    sigma: Numbers,
    start: Mapping[str, float] | Numbers,
    sizes: Numbers,
    *,
    labels: Sequence[str] | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    readings: AbstractSpace | None = None,
    min_singular_value: float = 1.0,
    steps: int = 50,
    report: Callable[[Search], None] | None = None,
    resume: Search | None = None,
) -> Identified:
    """Identify parameters by least squares from a record, with a verdict on their validity.

    Standard deviations are those of white residuals if the residuals are white, enlarged by the root of the
    reduced chi-squared where that is larger than chance allows, and else by blocks of residuals; where
    windows of the record disagree, their scatter is added. The verdict says which.

    Args:
        predict: function parameters (p,) -> predictions (k, c), such as `motion_model`, whose uncertain start
            is estimated too.
        record: measurements (k, c), rows in time; NaN or masked where one is missing.
        sigma: standard deviations of the errors of a row (m,); m = c, but three for a rotation.
        start: parameters at which the search starts, by label or in order.
        sizes: typical sizes of the parameters (p,).
        bounds: open intervals of parameters by label, such as {"mass": (0, inf)}; the search cannot leave them.
        readings: space of a row of the record, such as `CyclicVector((True, False))` where the first column is an
            angle; by default that of `motion_model`, else a vector.
        min_singular_value: bound of `check_identifiable`.
        report, resume: arguments of `search`.

    Raises:
        IdentifiabilityError: the record does not determine a direction; the message names it.
        ModelError: a record with infinite numbers, without numbers, or of another shape than the predictions.
        SettingError: standard deviations or sizes that are not positive, a start outside of its
            bounds, or a start whose predictions, or their derivatives, are not finite.
    """
    if isinstance(start, Mapping):
        labels, start = tuple(start), list(start.values())
    q0 = jnp.asarray(start, dtype=float)
    p = len(q0)
    names = tuple(f"q_{k}" for k in range(p)) if labels is None else tuple(labels)
    y = filled_record(record)
    if readings is None and isinstance(predict, MotionModel):
        unknowns = jnp.concatenate([q0, jnp.zeros(predict.start_count)])
        readings = eqx.filter_eval_shape(predict.readings, unknowns)
    if readings is not None and all(isinstance(x, Vector) for x in _list_spaces(readings)):
        readings = None
    check_finite(sigma, "The deviations of the record", "")
    if np.shape(sigma) != (np.shape(y)[-1:] if readings is None else (readings.size,)) or not (
        np.all(np.asarray(sigma) > 0)
    ):
        # which of the two is wrong, only the predictions tell
        shape = eqx.filter_eval_shape(predict_columns, predict, q0).shape
        _check_shape(y, shape)
        count = shape[-1] if readings is None else readings.size
        raise SettingError(f"The record needs {count} positive deviations, not {sigma}.")
    if np.shape(sizes) != (p,) or not np.all(np.asarray(sizes) > 0):
        raise SettingError(f"There must be {p} positive sizes, not {sizes}.")
    if len(names) != p:
        raise SettingError(f"There are {p} parameters, but {len(names)} names.")
    lower, upper = _parameter_limits(bounds, q0, names)
    residuals = Misfit(
        predict, jnp.asarray(y, dtype=float), jnp.asarray(sigma, dtype=float), q0, jnp.asarray(sizes, dtype=float),
        readings, lower, upper, follows_turns=jnp.asarray(True),
    )  # fmt: skip
    z = jnp.zeros(p + getattr(predict, "start_count", 0))
    # Identifiability is judged before the search, which would run along an undetermined direction without
    # end, and once more at its result.
    r, J = residuals_and_jacobian(residuals, z)
    for numbers, name in ((r, "predictions"), (J, "derivatives of the predictions")):
        # a start that cannot be flown has derivatives without information
        if not np.all(np.isfinite(numbers)):
            values = ", ".join(f"{name} = {float(q):g}" for name, q in zip(names, q0, strict=True))
            raise SettingError(
                f"The {name} at the start of the search are not finite: the model cannot be evaluated with "
                f"{values}. Start from valid values."
            )
    _check_determined(residuals, z, r, J, names, min_singular_value)
    # Six digits are a thousandth of a standard deviation in any record that passed the test of
    # identifiability.
    method = optx.LevenbergMarquardt(rtol=1e-6, atol=1e-6)
    run = lambda misfit, before: search(
        misfit, z, method, steps=steps, report=report, resume=before
    )
    outcome = run(residuals, resume)
    # in the end angles are compared by their nearest difference: a reading far out, or a gap in the record,
    # may have been taken for a turn
    residuals = eqx.tree_at(lambda m: m.follows_turns, residuals, jnp.asarray(False))
    r, J = residuals_and_jacobian(residuals, outcome.values)
    if 0.5 * float(r @ r) < outcome.loss * (1 - 1e-6):
        outcome = run(residuals, outcome)
        r, J = residuals_and_jacobian(residuals, outcome.values)
    singular_values, fit = _check_determined(
        residuals, outcome.values, r, J, names, min_singular_value
    )
    sizes = np.asarray(residuals.sizes)
    values = np.asarray(residuals.values(outcome.values[:p]))
    p_values, chi_square, interval = compute_p_values(fit)
    # Deviations depend on the residuals found to be white or not: the tests come first.
    total, deviations, p_windows = compute_deviations(fit, p_values, chi_square, values / sizes)
    if p_windows is not None:
        p_values["windows"] = p_windows
    scale = np.append(sizes, np.ones(len(fit.start)))
    covariance = scale[:, None] * total * scale
    deviations = deviations.scaled(sizes)
    distance = np.full(p, np.inf)
    if lower is not None and upper is not None:
        distance = np.minimum(values - np.asarray(lower), np.asarray(upper) - values)
    at_bounds = np.array(names)[distance < 0.1 * deviations.white].tolist()
    faults, is_start_exact, estimated_start = (), False, None
    if isinstance(predict, MotionModel):
        unknowns = jnp.asarray(np.append(values, fit.start))
        faults, is_start_exact = predict.faults(unknowns), not predict.start_count
        if predict.start_count:
            # The estimate of the start is a Gaussian in the state space's errors; products of roots keep its
            # covariance symmetric and positive. It exists also where no mechanism has the values.
            first, spread = _start_and_spread(predict, unknowns)
            L = np.asarray(spread) @ np.linalg.cholesky(covariance[p:, p:])
            P = L @ L.T
            root = covariance_root((P + P.T) / 2, "The start's covariance")
            estimated_start = Gaussian(first, root)
    verdict = judge_fit(
        fit, p_values, chi_square, interval, deviations, total, names, bound_labels=tuple(at_bounds),
        faults=faults, is_start_exact=is_start_exact,
    )  # fmt: skip
    return Identified(
        names, values, covariance[:p, :p], np.sqrt(np.diag(covariance)[:p]), deviations, singular_values,
        chi_square, verdict, np.where(fit.measured, fit.residuals, np.nan), estimated_start, outcome,
    )  # fmt: skip


def filled_record(record: Any, subject: str = "The record") -> np.ndarray:
    """Record as an array with NaN where a number is missing or masked.

    Raises:
        ModelError: infinite numbers, or no number at all.
    """
    # Masked arrays carry fill values of 1e20, which would pass for readings.
    masked = np.ma.asarray(record)
    values = np.ma.filled(masked.astype(float), np.nan)
    if np.any(np.isinf(values)):
        place = np.argwhere(np.isinf(values))[0].tolist()
        raise ModelError(
            f"{subject} must have finite numbers, or NaN where one is missing, but it is infinite at {place}."
        )
    if values.size and np.all(np.isnan(values)):
        raise ModelError(f"{subject} has no numbers: all of them are missing.")
    return values


def _parameter_limits(
    bounds: Mapping[str, tuple[float, float]] | None, q0: Array, names: tuple[str, ...]
) -> tuple[Array | None, Array | None]:
    """Lower and upper bounds of all parameters (p,), or None without any."""
    if not bounds:
        return None, None
    places = named_places(list(bounds), list(names), "The bounds", "parameter")
    lower, upper = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for place, (name, pair) in zip(places, bounds.items(), strict=True):
        if len(pair) != 2:
            raise SettingError(f"The bounds of {name} must be a pair of numbers, not {pair}.")
        lower[place], upper[place] = pair
        value = float(q0[place])
        if not lower[place] < value < upper[place]:
            raise SettingError(
                f"The start of {name} must lie between its bounds {pair[0]:g} and {pair[1]:g}, but it is "
                f"{value:g}."
            )
    return jnp.asarray(lower), jnp.asarray(upper)


@eqx.filter_jit
def _start_and_spread(
    predict: MotionModel, q: Float[Array, " q"]
) -> tuple[Point, Float[Array, "n s"]]:
    """Start of a motion and the root of its prior's covariance."""
    space, _, first = predict.start(q)
    return first, jnp.asarray(predict.spread(space))


def _check_determined(
    residuals: Misfit, z: Any, r: np.ndarray, J: np.ndarray, names: Sequence[str],
    min_singular_value: float,
) -> tuple[Float[np.ndarray, " p"], Fit]:  # fmt: skip
    """Singular values, as of `check_identifiable`, of an uncertain start's rest, and the fit at unknowns z."""
    p = len(names)
    # derivatives by the parameters over their sizes, whatever their bounds make of the unknowns
    _, slope = jax.jvp(residuals.values, (z[:p],), (jnp.ones(p),))
    J = J / np.append(np.asarray(slope / residuals.sizes), np.ones(J.shape[1] - p))
    measured = np.asarray(residuals.measured)
    k, m = measured.shape
    fit = Fit(r[: k * m].reshape(k, m), measured, J[: k * m].reshape(k, m, -1), r[k * m :])
    return check_identifiable(fit.projected, names, min_singular_value), fit


def _check_shape(record: Any, shape: tuple[int, ...]) -> None:
    if np.shape(record) != shape:
        raise ModelError(f"The record has shape {np.shape(record)}, but predictions have {shape}.")
