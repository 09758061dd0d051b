"""Studies of many flights: what is drawn, what is flown, what is kept of each flight."""

import hashlib
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import equinox as eqx
import numpy as np

from ..mechanics.errors import SettingError, nearest_names
from ..mechanics.schema import SHOWN, named
from ..vehicle.parameters import Parameters
from .flights import Flights, flights
from .sampling import Sampling, sampling_from_plain
from .schema import check_name, flights_file
from .signal import Signal, signal

TAKES = ("final", "largest", "smallest", "path", "when_above", "when_below")
SOLVERS = ("dopri8", "tsit5")
# Kept times of a flight, which every flight's memory must hold.
MOST_TIMES = 100_000
# Columns that every study has.
OWN = {"status", "sample", "time", "end", "steps", "rejected", "residual", "records"}


@dataclass(frozen=True)
class Quantity:
    """A number, or a history, that is kept of each flight.

    Attributes:
        signal: see `stmuav_jax.montecarlo.signal`.
        take: "final" value; "largest", "smallest" over the flight; "path": values every
            `Study.every` seconds; "when_above", "when_below": time at which it first crosses
            `level` [s], infinite if it never does.
        level: in the signal's unit.
        stop: end the flight when it crosses; what is kept at the end is then of that moment's
            step, and paths have no numbers from there on.

    Raises:
        SettingError: an unknown take, a level where none belongs or none where one does.
    """

    signal: str
    take: str
    level: float | None = None
    stop: bool = False

    def __post_init__(self) -> None:
        if self.take not in TAKES:
            raise SettingError(
                f"Quantities take {', '.join(TAKES)}; not '{self.take}'.{nearest_names(self.take, TAKES)}"
            )
        crossing = self.take.startswith("when_")
        if crossing != (self.level is not None):
            words = "needs a level" if crossing else "has no level"
            raise SettingError(f"'{self.take}' of signal {named(self.signal)} {words}.")
        if self.level is not None and not np.isfinite(self.level):
            raise SettingError(
                f"The level of {named(self.signal)} must be finite, not {self.level}."
            )
        if self.stop and not crossing:
            raise SettingError(f"Only a crossing can stop a flight, not '{self.take}'.")

    def column(self, of: Signal) -> tuple[str, str]:
        """Unit and words of the column that it fills."""
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
    """When a flight that was completed counts as a failure; the report gives its probability.

    Attributes:
        quantity: one of the study's, no path.
        above, below: it fails if the quantity is above or below these, in the quantity's unit. A
            crossing without them fails if it happens at all.

    Raises:
        SettingError: limits that are not finite.
    """

    quantity: str
    above: float | None = None
    below: float | None = None

    def __post_init__(self) -> None:
        for limit in (self.above, self.below):
            if limit is not None and not np.isfinite(limit):
                raise SettingError(f"The limits of a failure must be finite, not {limit}.")

    def plain(self) -> dict[str, Any]:
        """As a file holds it."""
        limits = {"above": self.above, "below": self.below}
        return {"quantity": self.quantity} | {k: v for k, v in limits.items() if v is not None}


@dataclass(frozen=True)
class Study:
    """Many flights of one scene.

    Attributes:
        name: short, for files.
        flights: what they have in common: scene, case, parameters, inputs, wind.
        sampling: how their factors are drawn.
        quantities: by the names of their columns.
        t1: end [s]. every: spacing of the kept times of paths [s]; default one thirtieth of t1.
        rtol, atol: tolerances of a step. solver: one of `SOLVERS`.
        step: constant step [s] instead of adaptive ones.
        max_steps: of a flight, after which it has failed.
        direction: that the panel should face, world; default the one it faces at the start.
        failure: which completed flights count as failures; default none.

    Raises:
        SettingError: no quantities, names that clash or are no names, impossible numbers, a failure
            of a quantity that there is not.
    """

    name: str
    flights: Flights
    sampling: Sampling
    quantities: Mapping[str, Quantity]
    t1: float = 1.0
    every: float | None = None
    rtol: float = 1e-8
    atol: float = 1e-8
    solver: Literal["dopri8", "tsit5"] = "dopri8"
    step: float | None = None
    max_steps: int = 20_000
    direction: tuple[float, float, float] | None = field(default=None)
    failure: Failure | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "quantities", dict(self.quantities))
        check_name(self.name)
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
        """Of paths and of the end, after the start [s]."""
        if not any(q.take == "path" for q in self.quantities.values()):
            return np.array([self.t1])
        every = self.t1 / 30 if self.every is None else self.every
        count = int(np.floor(self.t1 / every * (1 + 1e-12)))
        times = every * np.arange(count + 1)
        times[-1] = self.t1 if self.t1 - times[-1] < 1e-9 * every else times[-1]
        return times if times[-1] == self.t1 else np.append(times, self.t1)

    def plain(self) -> dict[str, Any]:
        """Everything that decides the numbers, as plain data."""
        table = self.flights.table
        numbers = {name: np.asarray(table.value(name)).tolist() for name in table}
        text = json.dumps(numbers, sort_keys=True)
        of = self.flights
        failure = {} if self.failure is None else {"failure": self.failure.plain()}
        return failure | {
            "kind": "flights",
            "name": self.name,
            "scene": of.scene,
            "case": of.case,
            "parameters": hashlib.sha256(text.encode()).hexdigest()[:16],
            "relative": sorted(of.relative),
            "inputs": of.inputs,
            "drag": of.drag,
            "gusts": of.gusts,
            "precision": "float32" if of.float32 else "float64",
            "sampling": self.sampling.plain(),
            "quantities": {k: _plain(q) for k, q in self.quantities.items()},
            "t1": self.t1,
            "times": self.times.tolist(),
            "rtol": self.rtol,
            "atol": self.atol,
            "solver": self.solver,
            "step": self.step,
            "max_steps": self.max_steps,
            "direction": None if self.direction is None else list(self.direction),
        }

    def signals(self) -> dict[str, Signal]:
        """The signal of each quantity."""
        # names are all that is needed of the system
        system, _ = eqx.filter_eval_shape(self.flights.nominal)
        return {name: signal(system, q.signal) for name, q in self.quantities.items()}


def _plain(quantity: Quantity) -> dict[str, Any]:
    found: dict[str, Any] = {"signal": quantity.signal, "take": quantity.take}
    if quantity.level is not None:
        found |= {"level": quantity.level, "stop": quantity.stop}
    return found


def _check_factors(study: Study) -> None:
    """Every factor has a place and a column of its own."""
    places: dict[Any, str] = {}
    columns: dict[str, str] = {}
    for name in study.sampling.names:
        entry = study.flights.entry(name)
        column = column_name(name)
        # a whole array's factor and one of an entry of it would both write the entry
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
    numbers = {"t1": study.t1, "rtol": study.rtol, "atol": study.atol}
    optional = {"every": study.every, "step": study.step}
    numbers |= {k: v for k, v in optional.items() if v is not None}
    for name, value in numbers.items():
        if not (np.isfinite(value) and value > 0):
            raise SettingError(f"{name} must be finite and positive, but it is {value}.")
    least = 1e-7 if study.flights.float32 else 1e-15
    for name in ("rtol", "atol"):
        if numbers[name] < least:
            raise SettingError(
                f"{name} must be at least {least:g}, the round-off of this precision, but it is "
                f"{numbers[name]:g}."
            )
    if study.solver not in SOLVERS:
        raise SettingError(f"Studies integrate by {' or '.join(SOLVERS)}, not '{study.solver}'.")
    if study.max_steps < 1:
        raise SettingError(f"max_steps must be at least 1, but it is {study.max_steps}.")
    if study.step is not None and study.step > study.t1:
        raise SettingError(
            f"A step of {study.step:g} s is longer than the flight of {study.t1:g} s."
        )
    if study.every is not None and study.every > study.t1:
        raise SettingError(
            f"Times {study.every:g} s apart do not fit into a flight of {study.t1:g} s."
        )
    if study.step is not None and study.t1 / study.step > study.max_steps:
        raise SettingError(
            f"Steps of {study.step:g} s need more than the {study.max_steps} of max_steps for "
            f"{study.t1:g} s."
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


def column_name(factor: str) -> str:
    """A factor's name as that of a column: "inertia.hexacopter_1[0, 1]" has no dots and brackets."""
    return re.sub(r"\W+", "_", factor).strip("_")


def study_from_plain(
    plain: Mapping[str, Any], table: Parameters | None = None, name: str = "study"
) -> Study:
    """A study from plain data, as a TOML file holds it (see docs/studies.md).

    Args:
        table: of the scene's parameters, where the user has changed some.

    Raises:
        SettingError: an unknown entry (with the nearest known one), or numbers that do not fit.
    """
    given = flights_file(plain)
    factors, relative = _factors(given.factors)
    of = flights(
        given.scene, given.case, table, relative=relative, inputs=given.inputs, drag=given.drag,
        gusts=given.gusts, duration=given.t1, float32=given.precision == "float32",
    )  # fmt: skip
    drawn: dict[str, Any] = {"seed": given.seed, "design": given.design, "factors": factors}
    if given.stratum is not None:
        drawn["stratum"] = given.stratum
    sampling = sampling_from_plain(drawn | {"correlation": list(given.correlation)})
    quantities = {k: Quantity(**dict(q)) for k, q in given.quantities.items()}
    failure = None if given.failure is None else Failure(**dict(given.failure))
    return Study(
        given.name if "name" in plain else name, of, sampling, quantities, t1=given.t1,
        every=given.every, rtol=given.rtol, atol=given.atol, solver=given.solver, step=given.step,
        max_steps=given.max_steps, direction=given.direction, failure=failure,
    )  # fmt: skip


def _factors(given: Mapping[str, Any]) -> tuple[dict[str, Any], frozenset[str]]:
    """Their distributions in plain form, and which are relative."""
    found: dict[str, Any] = {}
    relative = set()
    for name, what in given.items():
        if isinstance(what, Mapping):
            what = dict(what)
            if what.pop("relative", False):
                relative.add(name)
        found[name] = what
    return found, frozenset(relative)


def with_precision(study: Study, *, float32: bool, **tolerances: float) -> Study:
    """The same study in the given precision, with other tolerances if there are some."""
    return replace(study, flights=replace(study.flights, float32=float32), **tolerances)
