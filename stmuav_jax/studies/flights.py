"""Studies of simulated motions: systems with drawn numbers, their runs, and the quantities stored for each.

The runs go through batch slots, each with its own step sizes; see `dynamics.integration.lanes`.
"""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, get_args

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..checks.errors import SettingError, nearest_names
from ..checks.schema import SHOWN, quote_name, validate_model
from ..dynamics.choices import ExplicitSolverName, solver_named
from ..dynamics.integration.lanes import REASONS, Ending, Plan, RunResult, integrate_batch
from ..dynamics.integration.problem import Problem, prepare_problem
from ..dynamics.method import Method, describe_part
from ..math.compiler import compute_untraced
from ..mechanics.state import State
from .columns import Axis, Column
from .disturbed_flights import AbstractFlights, digest_table, factor_columns
from .schema import STEPS_OF_A_RUN, FailureEntry, Flying, Integrating, QuantityEntry
from .signal import RunPoint, Signal, find_signal
from .study import AbstractBatch, Study

# Runs in one call of the compiled program; results do not depend on it.
BLOCK = 512
# Largest number of kept times of a run, all of which are held in memory.
MOST_TIMES = 100_000
# Method of the runs where a study does not say.
USUAL_METHOD = Method(max_steps=STEPS_OF_A_RUN)
# Columns that every study has.
OWN = {"status", "sample", "time", "end", "steps", "rejected", "residual", "records"}


@dataclass(frozen=True)
class FlightEvaluation(AbstractBatch):
    """Function of a sample that simulates the system with its numbers and returns the run's quantities.

    Attributes:
        flights: what all runs have in common: scene or model, inputs, wind.
        quantities: quantities by the names of their columns.
        t1: final time [s].
        every: spacing of the saved times of paths [s]; default one thirtieth of t1.
        method: how the runs are integrated: by `diffrax.Dopri8()` or `diffrax.Tsit5()`, with at most
            `max_steps` steps, after which a run has failed. The runs have no derivatives: its `adjoint` and
            `steps` are not used.
        direction: unit vector that the panel should face, world; default its direction at the
            start.

    Raises:
        SettingError: no quantities, invalid names or numbers, or a method that cannot run in batches.
    """

    flights: AbstractFlights
    quantities: Mapping[str, QuantityEntry]
    t1: float = 1.0
    every: float | None = None
    method: Method = USUAL_METHOD
    direction: tuple[float, float, float] | None = None
    block = BLOCK

    def __post_init__(self) -> None:
        object.__setattr__(self, "quantities", dict(self.quantities))
        flying = {name: getattr(self, name) for name in Flying.model_fields if name != "name"}
        validate_model(Flying, flying, "A study")
        settings = method_plain(self.method)
        validate_model(Integrating, {k: settings[k] for k in Integrating.model_fields}, "A study")
        if not self.quantities:
            raise SettingError("The study has no quantities: give it at least one.")
        if self.every is not None and self.every > self.t1:
            raise SettingError(
                f"The spacing 'every' must be at most t1 = {self.t1:g} s, but it is {self.every:g} s."
            )
        if self.every is not None and self.t1 / self.every > MOST_TIMES:
            raise SettingError(
                f"Times {self.every:g} s apart are more than {MOST_TIMES:,} in {self.t1:g} s."
            )
        length = 1.0 if self.direction is None else math.hypot(*self.direction)
        if not abs(length - 1) <= 1e-9:
            raise SettingError(
                f"The direction must be a unit vector, but its length is {length:.12g}."
            )

    def __getstate__(self) -> dict[str, Any]:
        """State without what is found again from the rest."""
        return {part.name: vars(self)[part.name] for part in fields(self)}

    @property
    def times(self) -> np.ndarray:
        """Times of paths and of the end, after the start [s]; without paths the end alone."""
        if not any(q.take == "path" for q in self.quantities.values()):
            return np.array([self.t1])
        every = self.t1 / 30 if self.every is None else self.every
        # A quotient of whole numbers must not lose its last time by round-off.
        count = int(np.floor(self.t1 / every * (1 + 1e-12)))
        times = every * np.arange(count + 1)
        times[-1] = self.t1 if self.t1 - times[-1] < 1e-9 * every else times[-1]
        return times if times[-1] == self.t1 else np.append(times, self.t1)

    def plain(self) -> dict[str, Any]:
        """Plain data of everything on which the numbers depend, except the sampling."""
        plain = lambda q: {
            "signal": q.signal, "take": q.take,
            **({} if q.level is None else {"level": q.level, "stop": q.stop}),
        }  # fmt: skip
        return {
            **self.flights.plain(),
            "t1": self.t1,
            **method_plain(self.method),
            "kind": "flights",
            "parameters": digest_table(self.flights.table),
            "relative": sorted(self.flights.relative),
            "quantities": {name: plain(q) for name, q in self.quantities.items()},
            "times": self.times.tolist(),
            "direction": None if self.direction is None else list(self.direction),
        }

    @cached_property
    def signals(self) -> dict[str, Signal]:
        """Signal of each quantity."""
        system = self.flights.system
        return {name: find_signal(system, q.signal) for name, q in self.quantities.items()}

    @property
    def columns(self) -> dict[str, Column]:
        """Columns of the outcomes: quantities, diagnostics of the integration, and status."""
        result: dict[str, Column] = {}
        for name, quantity in self.quantities.items():
            of, dims = self.signals[name], ("time",) if quantity.take == "path" else ()
            level = f"{quantity.level:g} {of.unit}" if quantity.level is not None else ""
            description = {
                "final": f"{of.label}, at the end",
                "path": of.label,
                "when_above": f"time at which {of.label} exceeds {level}",
                "when_below": f"time at which {of.label} falls below {level}",
            }.get(quantity.take, f"{of.label}, {quantity.take}")
            unit = "s" if quantity.is_crossing else of.unit
            result[name] = Column("float64", unit, description, "quantity", dims)
        return result | {
            "end": Column("float64", "s", "where the flight ended", "diagnostic"),
            "steps": Column("int32", "1", "steps accepted", "diagnostic"),
            "rejected": Column("int32", "1", "steps rejected", "diagnostic"),
            "residual": Column(
                "float64", "m", "largest constraint residual at any step", "diagnostic"
            ),
            "status": Column("int8", "1", "how the flight ended", "status"),
        }

    @property
    def axes(self) -> dict[str, Axis]:
        """Time axis of the paths, if there are any."""
        return {"time": Axis(self.times, "s")} if len(self.times) > 1 else {}

    @cached_property
    def _facing(self) -> np.ndarray:
        """Direction that the panel should face, world (3,)."""
        if self.direction is not None:
            return np.asarray(self.direction)
        # the first to ask may be a program that is being traced
        return compute_untraced(self.flights.facing)

    @cached_property
    def plan(self) -> Plan:
        """Plan of the batch integration, whose numbers are samples and data of their keys (2,)."""
        direction, formulation = self._facing, self.method.formulation
        if self.flights.dependent_rows:
            formulation = formulation.allowing_dependent_rows()
            if formulation is None:
                raise SettingError(
                    "The system has dependent constraint rows, which "
                    f"{self.method.formulation} does not support."
                )
        parts = {"formulation": formulation, "adjoint": diffrax.ForwardMode(), "steps": "state"}
        method = dataclasses.replace(self.method, **parts)

        def make(numbers: tuple[Mapping[str, Any], Any]) -> tuple[Problem, State]:
            sample, key_data = numbers
            # NaN marks an impossible start, which costs nothing
            possible = self.flights.is_possible(sample)
            sample = {name: jnp.where(possible, x, jnp.nan) for name, x in sample.items()}
            system, state0 = self.flights.build(sample, key_data[0])
            return prepare_problem(system, method), state0

        watched, of = self._watched, self.signals

        def watch(smooth: bool) -> Any:
            chosen = [(of[k].of, q) for k, q in watched.items() if of[k].smooth == smooth]

            def signals(problem: Problem, t: Any, y: Any) -> Any:
                point = RunPoint(problem, t, y, jnp.asarray(direction, y.dtype))
                result = [_orient_signal(quantity, signal(point)) for signal, quantity in chosen]
                return jnp.stack(result) if result else jnp.zeros(0, y.dtype)

            return signals

        stops = tuple(q.stop for q in watched.values())
        times: Any = self.times
        return Plan(make, times, 0.0, watch(True), watch(False), stops)

    @cached_property
    def _watched(self) -> dict[str, QuantityEntry]:
        """Quantities that are monitored between the kept times, those with rates first."""
        chosen = self.quantities.items()
        result = [(k, q) for k, q in chosen if q.take not in ("final", "path")]
        # The plan has the signals with rates before the others, and its results are in that order.
        return dict(sorted(result, key=lambda item: not self.signals[item[0]].smooth))

    def evaluate_batch(
        self, samples: Mapping[str, Any], keys: Any, count: Any, lanes: int
    ) -> dict[str, Any]:
        """Outcomes (n, ...) of the first `count` of n samples, by column."""
        numbers = samples, jax.random.key_data(keys)
        runs = integrate_batch(self.plan, numbers, count, lanes)
        return jax.vmap(self._summarise_run)(numbers, runs)

    def _summarise_run(
        self, numbers: tuple[Mapping[str, Any], Any], run: RunResult
    ) -> dict[str, Any]:
        """Outcomes of one run."""
        real = run.last.dtype
        problem, _ = self.plan.make(numbers)
        direction = jnp.asarray(self._facing, real)
        watched = list(self._watched)
        is_fine = run.ending == Ending.FINE
        value = lambda name, t, y: self.signals[name].of(RunPoint(problem, t, y, direction))
        result: dict[str, Any] = {}
        for name, quantity in self.quantities.items():
            # Extremes and crossings lie between the kept times, so the integration has monitored
            # them; final values and paths follow from the kept states.
            if name in watched:
                k = watched.index(name)
                measure = run.when[k] if quantity.is_crossing else run.extreme[k]
                result[name] = -measure if quantity.take == "smallest" else measure
                continue
            if quantity.take == "path":
                path_signal = jax.vmap(lambda t, y, name=name: value(name, t, y))
                measure = path_signal(jnp.asarray(self.times, real), run.saved)
            else:
                measure = value(name, run.t, run.last)
            result[name] = jnp.where(is_fine, measure, jnp.nan)
        possible = self.flights.is_possible(numbers[0])
        return result | {
            "end": run.t, "steps": run.accepted, "rejected": run.rejected,
            "residual": run.residual[0],
            "status": jnp.where(possible, run.ending, Ending.NOT_PHYSICAL),
        }  # fmt: skip


def _orient_signal(quantity: QuantityEntry, g: Any) -> Any:
    """Monitored signal, whose maximum or rise above zero is the quantity."""
    if quantity.take == "smallest":
        return -g
    if quantity.take == "when_above":
        return g - quantity.level
    return quantity.level - g if quantity.take == "when_below" else g


def make_flight_study(
    evaluation: FlightEvaluation,
    factors: Mapping[str, Any],
    *,
    failure: FailureEntry | None = None,
    **settings: Any,
) -> Study:
    """Study of simulated motions.

    Args:
        evaluation: simulation of each run, and its stored quantities. factors: distributions by name.
        failure: condition under which completed runs count as failures; default none.
        settings: samples, seed, design, lanes and others of `Study`.

    Raises:
        SettingError: factors and quantities that are unknown or share a column, a failure of an unknown
            quantity; also as for `Study`.
    """
    flights, quantities = evaluation.flights, evaluation.quantities
    # Quantities, factors and diagnostics are columns of one dataset.
    if clash := sorted(OWN & {*quantities}):
        name_list = ", ".join(clash)
        raise SettingError(f"Quantities must not have the names of other columns: {name_list}.")
    identity = evaluation.plain()
    if failure is not None:
        scalars = [name for name, quantity in quantities.items() if quantity.take != "path"]
        if failure.quantity not in scalars:
            raise SettingError(
                f"The failure is of {quote_name(failure.quantity)}, which is no quantity with one number "
                f"a flight.{nearest_names(failure.quantity[:SHOWN], scalars)}"
            )
        identity["failure"] = failure.model_dump(exclude_none=True)
        if len(identity["failure"]) == 1 and not quantities[failure.quantity].is_crossing:
            raise SettingError(
                f"The failure by '{failure.quantity}' needs a limit: above = ... or below = ..."
            )
    columns = factor_columns(factors, flights.entry, flights.relative, evaluation.columns)
    reasons = {int(code): reason for code, reason in REASONS.items()}
    return Study(
        evaluation, factors, columns=columns, axes=evaluation.axes, reasons=reasons, identity=identity,
        **settings,
    )  # fmt: skip


# Parts of a method that a study cannot have, and why.
_NOT_OF_STUDIES = {
    "event": "a quantity with stop = true ends its runs",
    "jump_ts": "its runs do not end their steps at given times",
    "balances": 'it keeps no balances; the signal "energy" is one of its quantities',
}


def method_plain(method: Method) -> dict[str, Any]:
    """Plain data of a study's method: the file's entries, and other parts where they are not usual.

    Raises:
        SettingError: a part that a study cannot have, or that plain data cannot describe.
    """
    if not isinstance(method, Method):
        raise SettingError(
            f"The method of a study must be a stmuav_jax.Method, not of type {type(method).__name__}."
        )
    for name, reason in _NOT_OF_STUDIES.items():
        if getattr(method, name) is not None and getattr(method, name) is not False:
            raise SettingError(f"The method of a study cannot have '{name}': {reason}.")
    solvers = {name: solver_named(name) for name in get_args(ExplicitSolverName)}
    # A study's file has names for solvers; one with other settings could not be read back.
    names = [name for name, solver in solvers.items() if eqx.tree_equal(method.solver, solver)]
    if not names:
        solver: Any = method.solver
        solver_name = solver if isinstance(solver, str) else type(solver).__name__
        valid = " or ".join(f"{type(solver).__name__}()" for solver in solvers.values())
        raise SettingError(f"The solver of a study must be diffrax's {valid}, not {solver_name}.")
    usual = Method()
    result: dict[str, Any] = {
        "rtol": float(method.rtol), "atol": float(method.atol), "solver": names[0],
        "max_steps": method.max_steps,
    }  # fmt: skip
    for name in ("first_step", "max_step"):
        if (value := float(getattr(method, name))) != float(getattr(usual, name)):
            result[name] = value
    for name in ("formulation", "stabilisation"):
        part = getattr(method, name)
        if not eqx.tree_equal(part, getattr(usual, name)):
            result[name] = describe_part(part)
            # What plain data leaves out would be no part of the identity, and two different studies
            # could then share a store.
            if odd := {field.name for field in fields(part)} - result[name].keys():
                raise SettingError(
                    f"The {name} of a study must consist of numbers and texts, but {type(part).__name__} "
                    f"has '{min(odd)}'."
                )
    return result
