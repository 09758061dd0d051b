"""Monte Carlo studies: sampled factors, simulated runs, and the quantities kept of each run."""

import hashlib
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, get_args

import equinox as eqx
import numpy as np

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, checked, named
from ..dynamics.choices import ExplicitSolverName, solver_named
from ..dynamics.method import Method, described
from ..parameters.table import Parameters
from .disturbed_flights import Flights, flights
from .model_flights import ModelFlights, started
from .sampling import Sampling
from .schema import (
    STEPS_OF_A_RUN,
    Drawing,
    FailureEntry,
    FlightsFile,
    Flying,
    Integrating,
    QuantityEntry,
    flights_file,
)
from .signal import Signal, signal
from .work import column_name

# Largest number of kept times of a run, all of which are held in memory.
MOST_TIMES = 100_000
# Method of the runs where a study does not say.
USUAL_METHOD = Method(max_steps=STEPS_OF_A_RUN)
# Columns that every study has.
OWN = {"status", "sample", "time", "end", "steps", "rejected", "residual", "records"}


@dataclass(frozen=True)
class Quantity:
    """Quantity, a number or a history, that is kept of each run.

    Attributes:
        signal: name of a signal, see `stmuav_jax.montecarlo.signal`.
        take: "final" value; "largest", "smallest" over the run; "path": values every
            `Study.every` seconds; "when_above", "when_below": time at which the signal first
            crosses `level` [s], infinite if it never does.
        level: level in the signal's unit.
        stop: end the run when the signal crosses the level; final values are then those of that
            step, and paths are NaN from there on.

    Raises:
        SettingError: an unknown take, a level where none belongs or none where one does.
    """

    signal: str
    take: str
    level: float | None = None
    stop: bool = False

    def __post_init__(self) -> None:
        checked(QuantityEntry, vars(self), "A quantity")
        crossing = self.take.startswith("when_")
        if crossing != (self.level is not None):
            words = "needs a level" if crossing else "has no level"
            raise SettingError(f"'{self.take}' of signal {named(self.signal)} {words}.")
        if self.stop and not crossing:
            raise SettingError(f"Only a crossing can stop a flight, not '{self.take}'.")

    def column(self, of: Signal) -> tuple[str, str]:
        """Unit and description of the column that holds the quantity."""
        level = f"{self.level:g} {of.unit}" if self.level is not None else ""
        words = {
            "final": f"{of.words}, at the end",
            "path": of.words,
            "when_above": f"time at which {of.words} exceeds {level}",
            "when_below": f"time at which {of.words} falls below {level}",
        }.get(self.take, f"{of.words}, {self.take}")
        return ("s" if self.take.startswith("when_") else of.unit), words


@dataclass(frozen=True)
class Failure:
    """Condition under which a completed run counts as a failure; reports give its probability.

    Attributes:
        quantity: name of one of the study's quantities, not a path.
        above, below: limits in the quantity's unit: a run above the one or below the other has
            failed. A crossing without limits is a failure if it happens at all.

    Raises:
        SettingError: limits that are not finite.
    """

    quantity: str
    above: float | None = None
    below: float | None = None

    def __post_init__(self) -> None:
        checked(FailureEntry, vars(self), "A failure")

    def plain(self) -> dict[str, Any]:
        """Plain data, as in a study's file."""
        limits = {"above": self.above, "below": self.below}
        return {"quantity": self.quantity} | {k: v for k, v in limits.items() if v is not None}


@dataclass(frozen=True)
class Study:
    """Monte Carlo study of one scene.

    Attributes:
        name: short name for files.
        flights: settings common to all runs: scene, case, parameters, inputs, wind.
        sampling: sampling design of the factors.
        quantities: quantities by the names of their columns.
        t1: final time [s].
        every: spacing of the kept times of paths [s]; default one thirtieth of t1.
        method: how the runs are integrated: by `diffrax.Dopri8()` or `diffrax.Tsit5()`, with at most
            `max_steps` steps, after which a run has failed. Nothing differentiates the runs: its
            `adjoint` and `steps` are not used.
        direction: unit vector that the panel should face, world; default its direction at the
            start.
        failure: condition under which completed runs count as failures; default none.

    Raises:
        SettingError: no quantities, names that clash or are no names, impossible numbers, a failure
            of an unknown quantity, a method that many runs at once cannot have.
    """

    name: str
    flights: Flights | ModelFlights
    sampling: Sampling
    quantities: Mapping[str, Quantity]
    t1: float = 1.0
    every: float | None = None
    method: Method = USUAL_METHOD
    direction: tuple[float, float, float] | None = field(default=None)
    failure: Failure | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "quantities", dict(self.quantities))
        flying = {name: getattr(self, name) for name in Flying.model_fields}
        checked(Flying, flying, "A study")
        settings = method_plain(self.method)
        checked(Integrating, {k: settings[k] for k in Integrating.model_fields}, "A study")
        if not self.quantities:
            raise SettingError(f"Study '{self.name}' keeps nothing: give it quantities.")
        _check_factors(self)
        inputs = {column_name(name) for name in self.sampling.names}
        clash = sorted({*self.quantities} & (inputs | OWN))
        if clash:
            words = ", ".join(clash)
            raise SettingError(f"Other columns have these names, which quantities cannot: {words}.")
        _check_numbers(self)
        if self.failure is not None:
            _check_failure(self.failure, self.quantities)

    @property
    def times(self) -> np.ndarray:
        """Times of paths and of the end, after the start [s]."""
        if not any(q.take == "path" for q in self.quantities.values()):
            return np.array([self.t1])
        every = self.t1 / 30 if self.every is None else self.every
        count = int(np.floor(self.t1 / every * (1 + 1e-12)))
        times = every * np.arange(count + 1)
        times[-1] = self.t1 if self.t1 - times[-1] < 1e-9 * every else times[-1]
        return times if times[-1] == self.t1 else np.append(times, self.t1)

    def plain(self) -> dict[str, Any]:
        """Plain data of everything on which the numbers depend."""
        table = self.flights.table
        numbers = {name: np.asarray(table.value(name)).tolist() for name in table}
        text = json.dumps(numbers, sort_keys=True)
        failure = {} if self.failure is None else {"failure": self.failure.plain()}
        own = {"name": self.name, "t1": self.t1}
        return (
            self.flights.plain()
            | own
            | method_plain(self.method)
            | failure
            | {
                "kind": "flights",
                "parameters": hashlib.sha256(text.encode()).hexdigest()[:16],
                "relative": sorted(self.flights.relative),
                "sampling": self.sampling.plain(),
                "quantities": {k: _plain(q) for k, q in self.quantities.items()},
                "times": self.times.tolist(),
                "direction": None if self.direction is None else list(self.direction),
            }
        )

    def signals(self) -> dict[str, Signal]:
        """Signal of each quantity."""
        # only the names of the system are needed
        system, _ = eqx.filter_eval_shape(self.flights.nominal)
        return {name: signal(system, q.signal) for name, q in self.quantities.items()}


def _plain(quantity: Quantity) -> dict[str, Any]:
    found: dict[str, Any] = {"signal": quantity.signal, "take": quantity.take}
    if quantity.level is not None:
        found |= {"level": quantity.level, "stop": quantity.stop}
    return found


# Parts of a method that a study cannot have, and why.
_NOT_OF_STUDIES = {
    "event": "a quantity with stop = true ends its runs",
    "jump_ts": "its runs do not end their steps at given times",
    "balances": 'it keeps no balances; the signal "energy" is one of its quantities',
}


def _integration(method: Method) -> dict[str, Any]:
    """Entries of a study's file for its method; raises `SettingError` for one that it cannot have."""
    if not isinstance(method, Method):
        raise SettingError(
            f"The method of a study must be a stmuav_jax.Method, not of type {type(method).__name__}."
        )
    for name, why in _NOT_OF_STUDIES.items():
        if getattr(method, name) is not None and getattr(method, name) is not False:
            raise SettingError(f"The method of a study cannot have '{name}': {why}.")
    known = {name: solver_named(name) for name in get_args(ExplicitSolverName)}
    found = [name for name, solver in known.items() if eqx.tree_equal(method.solver, solver)]
    if not found:
        asked = method.solver if isinstance(method.solver, str) else type(method.solver).__name__
        valid = " or ".join(f"{type(solver).__name__}()" for solver in known.values())
        raise SettingError(f"The solver of a study must be diffrax's {valid}, not {asked}.")
    tolerances = {"rtol": float(method.rtol), "atol": float(method.atol)}
    return tolerances | {"solver": found[0], "max_steps": method.max_steps}


def method_plain(method: Method) -> dict[str, Any]:
    """Plain data of a study's method: the file's entries, and other parts where they are not usual.

    Raises:
        SettingError: a part that a study cannot have, or that plain data cannot describe.
    """
    usual, found = Method(), _integration(method)
    for name in ("first_step", "max_step"):
        if (value := float(getattr(method, name))) != float(getattr(usual, name)):
            found[name] = value
    for name in ("formulation", "stabilisation"):
        part = getattr(method, name)
        if not eqx.tree_equal(part, getattr(usual, name)):
            found[name] = described(part)
            if odd := {field.name for field in fields(part)} - found[name].keys():
                raise SettingError(
                    f"The {name} of a study must consist of numbers and texts, but {type(part).__name__} "
                    f"has '{min(odd)}'."
                )
    return found


def _check_factors(study: Study) -> None:
    """Check that every factor has a target and a column of its own."""
    places: dict[Any, str] = {}
    columns: dict[str, str] = {}
    for name in study.sampling.names:
        entry = study.flights.entry(name)
        column = column_name(name)
        # a factor of a whole array and one of its entries would both set the entry
        for place in entry.places or ((),):
            if (other := places.get((entry.name, place))) is not None:
                raise SettingError(f"'{other}' and '{name}' are the same number; give one of them.")
            places[entry.name, place] = name
        if (other := columns.get(column)) is not None:
            raise SettingError(f"'{other}' and '{name}' would share the column '{column}'.")
        columns[column] = name


def _check_failure(failure: Failure, quantities: Mapping[str, Quantity]) -> None:
    known = [name for name, quantity in quantities.items() if quantity.take != "path"]
    if failure.quantity not in known:
        raise SettingError(
            f"The failure is of {named(failure.quantity)}, which is no quantity with one number a "
            f"flight.{nearest_names(failure.quantity[:SHOWN], known)}"
        )
    crossing = quantities[failure.quantity].take.startswith("when_")
    if not crossing and failure.above is None and failure.below is None:
        raise SettingError(
            f"The failure by '{failure.quantity}' needs a limit: above = ... or below = ..."
        )


def _check_numbers(study: Study) -> None:
    if study.every is not None and study.every > study.t1:
        raise SettingError(
            f"Times {study.every:g} s apart do not fit into a flight of {study.t1:g} s."
        )
    if study.every is not None and study.t1 / study.every > MOST_TIMES:
        raise SettingError(
            f"Times {study.every:g} s apart are more than {MOST_TIMES:,} in {study.t1:g} s."
        )
    if study.direction is not None:
        size = math.hypot(*study.direction)
        if not abs(size - 1) <= 1e-9:
            raise SettingError(
                f"The direction must be a unit vector, but its length is {size:.12g}."
            )


def study_from_plain(
    plain: Mapping[str, Any], table: Parameters | None = None, name: str = "study"
) -> Study:
    """Study from plain data in the form of its TOML file (see docs/studies.md).

    Args:
        plain: plain data of the study.
        table: parameter table of the scene, where the user has changed some.
        name: name of a study whose plain data have none.

    Raises:
        SettingError: an unknown entry (with the nearest known one), or numbers that do not fit.
    """
    given = flights_file(plain)
    factors, relative = factors_of(given.factors)
    of = _flights(given, table, relative)
    drawing = given.model_dump(include=set(Drawing.model_fields))
    sampling = Sampling(factors, **drawing)
    quantities = {k: Quantity(**dict(q)) for k, q in given.quantities.items()}
    failure = None if given.failure is None else Failure(**dict(given.failure))
    flying = given.model_dump(include=set(Flying.model_fields))
    if "name" not in plain:
        flying["name"] = name
    settings = given.model_dump(include=set(Integrating.model_fields))
    method = Method(**settings | {"solver": solver_named(given.solver)})
    more: Any = {"failure": failure, "method": method, **flying}
    return Study(flights=of, sampling=sampling, quantities=quantities, **more)


def _flights(
    given: FlightsFile, table: Parameters | None, relative: frozenset[str]
) -> Flights | ModelFlights:
    """Settings of the runs: of a scene by name, or of a model."""
    if (given.scene is None) == (given.model is None):
        raise SettingError("A study needs a scene or a model's file, and not both.")
    if given.scene is not None:
        return flights(
            given.scene, given.case, table, relative=relative, inputs=given.inputs, drag=given.drag,
            gusts=given.gusts, options=given.options, duration=given.t1,
        )  # fmt: skip
    for name in ("case", "drag", "gusts", "options"):
        if getattr(given, name):
            raise SettingError(f"'{name}' is for scenes; a model's file has its own numbers.")
    if table is not None:
        raise SettingError("A table of parameters is for scenes; a model's file has its own.")
    return ModelFlights(given.model, relative, given.inputs, started(given.factors))


def factors_of(given: Mapping[str, Any]) -> tuple[dict[str, Any], frozenset[str]]:
    """Distributions of the factors in plain form, and the names of relative ones."""
    found: dict[str, Any] = {}
    relative = set()
    for name, what in given.items():
        if isinstance(what, Mapping):
            what = dict(what)
            if what.pop("relative", False):
                relative.add(name)
        found[name] = what
    return found, frozenset(relative)
