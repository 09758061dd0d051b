"""Batch simulation of a study: blocks of runs through compiled batch slots, on all devices.

A sample's numbers do not depend on other samples. One program, compiled for one device and always
of the same shape, simulates every block; the cores of a CPU share it as threads, and other devices
have a copy each. The last digits depend only on the number of batch slots ("lanes"), which is part
of the study's identity.
"""

import dataclasses
import itertools
import threading
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np

from ..algebra.compiler import program_of_shapes
from ..checks.errors import SettingError, SimulationError
from ..dynamics.formulations.base import AbstractFormulation
from ..dynamics.integration.lanes import REASONS, Ending, Plan, RunResult, fly
from ..dynamics.integration.problem import Problem, prepare
from ..mechanics.state import State
from .disturbed_flights import Drawn
from .signal import RunPoint, Signal
from .study import Quantity, Study
from .work import AbstractWork, Axis, Column, column_name

# Runs integrated together on one device: on a CPU as many as fit its cache, by measurement
# (docs/throughput.md); a GPU needs thousands.
LANES = {"cpu": 16}
LANES_ELSEWHERE = 4096

# Number of batch slots computed by one vector instruction (AVX-512, double precision). Slots left
# over would be rounded differently, and results would depend on the slot.
TOGETHER = 8

# Runs in one call of the compiled program; results do not depend on it.
BLOCK = 512

MOST_DEVICES = 1024


class FlightWork(AbstractWork):
    """Work of a study: its simulations by sample number.

    Args:
        lanes: batch slots, runs integrated together on a device, a multiple of 8; default 16 on a
            CPU and 4096 elsewhere, whatever the number of cores. It is part of the study's
            identity, as the last digits depend on it.
        block: runs in one call of the compiled program; at least the lanes.
        devices: number of threads on a CPU, default one; number of GPUs elsewhere, default all.
            Results do not depend on it.

    Raises:
        SettingError: numbers that are not positive, lanes that are not a multiple of 8, or more
            devices than there are.
    """

    def __init__(
        self,
        study: Study,
        *,
        lanes: int | None = None,
        block: int = BLOCK,
        devices: int | None = None,
    ) -> None:
        self.study = study
        for name, value in (("lanes", lanes), ("block", block), ("devices", devices)):
            if value is not None and value < 1:
                raise SettingError(f"{name} must be at least 1, but it is {value}.")
        kind = jax.default_backend()
        self.lanes = LANES.get(kind, LANES_ELSEWHERE) if lanes is None else lanes
        if self.lanes % TOGETHER:
            raise SettingError(
                f"lanes must be a multiple of {TOGETHER}, but it is {lanes}: a processor computes so "
                "many together, and a flight's numbers may not depend on its lane."
            )
        if devices is not None and devices > (most := _most_devices()):
            raise SettingError(f"There are {most} devices, but {devices} are to be used.")
        self._block, self._devices = max(block, self.lanes), devices

    def __getstate__(self) -> dict[str, Any]:
        """State without the compiled programs, which are not pickled."""
        keep = ("study", "lanes", "_block", "_devices")
        return {k: self.__dict__[k] for k in keep}

    @property
    def identity(self) -> Mapping[str, Any]:
        """Plain data of the study, and the number of lanes."""
        return {**self.study.plain(), "lanes": self.lanes}

    @property
    def unit(self) -> int:
        """Runs that keep all devices busy: chunks of a store are best multiples of this number."""
        return self._block * len(self._places)

    @property
    def columns(self) -> Mapping[str, Column]:
        """Columns of sampled factors, quantities, diagnostics of the integration, and status."""
        return self._columns

    @cached_property
    def _columns(self) -> Mapping[str, Column]:
        study, found = self.study, {}
        real = "float64"
        for name in study.sampling.names:
            entry = study.flights.entry(name)
            words = f"{name}, share of the table's" if name in study.flights.relative else name
            found[column_name(name)] = Column(real, entry.unit, words, "input")
        for name, of in self._signals.items():
            quantity = study.quantities[name]
            unit, words = quantity.column(of)
            dims = ("time",) if quantity.take == "path" else ()
            found[name] = Column(real, unit, words, "quantity", dims)
        note: Any = "diagnostic"
        found["end"] = Column(real, "s", "where the flight ended", note)
        found["steps"] = Column("int32", "1", "steps accepted", note)
        found["rejected"] = Column("int32", "1", "steps rejected", note)
        found["residual"] = Column(real, "m", "largest constraint residual at any step", note)
        found["status"] = Column("int8", "1", "how the flight ended", "status")
        return found

    @property
    def axes(self) -> Mapping[str, Axis]:
        """Time axis of the paths, if there are any."""
        paths = any(q.take == "path" for q in self.study.quantities.values())
        return {"time": Axis(self.study.times, "s")} if paths else {}

    @property
    def reasons(self) -> Mapping[int, str]:
        """Reasons of failed runs by code."""
        return {int(code): words for code, words in REASONS.items()}

    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns of the samples first, first + 1, ...

        Raises:
            SimulationError: JAX cannot be switched to double precision.
        """
        study = self.study
        drawn = study.sampling.draw(first, count)
        if not count:
            shape = lambda c: (0, *(len(self.axes[d].values) for d in c.dims))
            return {k: np.zeros(shape(c), c.dtype) for k, c in self.columns.items()}
        parts = self._on_all(
            [
                (drawn[start:stop], first + start)
                for start, stop in _parts(count, self._block, self.lanes, len(self._places))
            ]
        )
        found = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]}
        found |= {column_name(name): drawn[:, k] for k, name in enumerate(study.sampling.names)}
        return {k: np.asarray(found[k], c.dtype) for k, c in self.columns.items()}

    def _on_all(self, parts: list[tuple[np.ndarray, int]]) -> list[dict[str, np.ndarray]]:
        """Columns of the parts; each device takes the next part that is not taken yet."""
        places = self._places[: len(parts)]
        with _double():
            # programs are compiled here, once for each device, before the threads need them
            programs = [self._programs(place) for place in places]
        found: list[Any] = [None] * len(parts)
        waiting, taking, stop = iter(enumerate(parts)), threading.Lock(), threading.Event()

        def carry_out(program: Any) -> None:
            with _double():
                while not stop.is_set():
                    with taking:
                        number, part = next(waiting, (-1, None))
                    if part is None:
                        return
                    found[number] = self._fly(program, *part)

        if len(places) == 1:
            carry_out(programs[0])
            return found
        with ThreadPoolExecutor(len(places), thread_name_prefix="flights") as pool:
            try:
                for done in [pool.submit(carry_out, program) for program in programs]:
                    done.result()
            finally:
                # after Ctrl-C or an error no further part is begun
                stop.set()
        return found

    def _fly(self, program: Any, drawn: np.ndarray, first: int) -> dict[str, np.ndarray]:
        """Columns of one block, filled up to its size with runs that are not simulated."""
        count, size = len(drawn), self._block
        possible = self.study.flights.possible(self.study.sampling.names, drawn)
        # NaN marks an impossible start, which costs nothing
        drawn = np.where(possible[:, None], drawn, np.nan)
        values = np.concatenate([drawn, np.zeros((size - count, drawn.shape[1]))])
        seeds = np.concatenate([self.seeds(first, count), np.zeros(size - count, np.uint32)])
        flown = program(values, seeds.astype(np.uint32), np.int32(count))
        found = {k: np.array(v[:count]) for k, v in jax.device_get(flown).items()}
        found["status"][~possible] = Ending.NOT_PHYSICAL
        return found

    def seeds(self, first: int, count: int) -> np.ndarray:
        """Seeds of the runs' own noise (count,), zeros where they have none."""
        if not self.study.flights.gusts:
            return np.zeros(count, np.uint32)
        own = lambda k: np.random.SeedSequence((self.study.sampling.seed, k)).generate_state(1)[0]
        return np.array([own(first + k) for k in range(count)], np.uint32)

    @cached_property
    def _places(self) -> list[Any]:
        """Device of each thread: on a CPU always the first; elsewhere all of them."""
        there = jax.local_devices()
        if there[0].platform == "cpu":
            return [there[0]] * (self._devices or 1)
        return there[: self._devices]

    def _programs(self, place: Any) -> Callable[..., dict[str, Any]]:
        """Program of a device, compiled: values (block, d), seeds (block,), count -> columns."""
        if place not in self._compiled:
            self._compiled[place] = self._program(place)
        return self._compiled[place]

    @cached_property
    def _compiled(self) -> dict[Any, Any]:
        return {}

    def _program(self, place: Any) -> Any:
        plan = self.plan

        def block(values: Any, seeds: Any, count: Any) -> dict[str, Any]:
            queue = Drawn(values, seeds)
            return jax.vmap(self._kept)(queue, fly(plan, queue, count, self.lanes))

        # where there is one device, the program is that of later processes too
        at = None if place.platform == "cpu" else jax.sharding.SingleDeviceSharding(place)
        of = lambda dtype, *shape: jax.ShapeDtypeStruct(shape, dtype, sharding=at)
        values = of(jnp.float64, self._block, len(self.study.sampling.names))
        shapes = values, of(jnp.uint32, self._block), of(jnp.int32)
        return program_of_shapes(block, *shapes, parts=self._parts)

    @property
    def _parts(self) -> tuple[Any, ...]:
        """All that the compiled program depends on: not how many samples are drawn, nor from what."""
        drawn = ("name", "sampling", "failure")
        parts = [f.name for f in dataclasses.fields(self.study) if f.name not in drawn]
        own = (tuple(self.study.sampling.names), self.lanes, self._block)
        return *((name, getattr(self.study, name)) for name in parts), *own

    @cached_property
    def direction(self) -> np.ndarray:
        """Direction that the panel should face, world (3,)."""
        of = self.study
        return np.asarray(of.flights.facing() if of.direction is None else of.direction)

    @cached_property
    def _signals(self) -> dict[str, Signal]:
        return self.study.signals()

    @property
    def _formulation(self) -> AbstractFormulation:
        """Formulation of the runs, asked for where nothing is traced."""
        chosen = self.study.method.formulation
        if not self.study.flights.dependent_rows:
            return chosen
        allowing = chosen.allowing_dependent_rows()
        if allowing is None:
            raise SettingError(
                f"Some constraint rows depend on others, for which {chosen} has no equations."
            )
        return allowing

    @cached_property
    def plan(self) -> Plan:
        """Plan of the batch integration, for programs that need its bare results."""
        study, direction = self.study, self.direction
        method = dataclasses.replace(
            study.method,
            formulation=self._formulation,
            adjoint=diffrax.ForwardMode(),
            steps="state",
        )
        names = study.sampling.names

        def make(drawn: Drawn) -> tuple[Problem, State]:
            system, state0 = study.flights.build(names, drawn)
            return prepare(system, method), state0

        watched, of = self._watched, self._signals

        def watch(smooth: bool) -> Any:
            chosen = [(of[k].of, q) for k, q in watched.items() if of[k].smooth == smooth]

            def signals(problem: Problem, t: Any, y: Any) -> Any:
                point = RunPoint(problem, t, y, jnp.asarray(direction, y.dtype))
                found = [_turned(quantity, signal(point)) for signal, quantity in chosen]
                return jnp.stack(found) if found else jnp.zeros(0, y.dtype)

            return signals

        stops = tuple(q.stop for q in watched.values())
        times: Any = study.times
        return Plan(make, times, 0.0, watch(True), watch(False), stops)

    @cached_property
    def _watched(self) -> dict[str, Quantity]:
        """Quantities that are monitored between the kept times, those with rates first."""
        chosen = self.study.quantities.items()
        found = [(k, q) for k, q in chosen if q.take not in ("final", "path")]
        return dict(sorted(found, key=lambda item: not self._signals[item[0]].smooth))

    def _kept(self, drawn: Drawn, flown: RunResult) -> dict[str, Any]:
        """Stored columns of one run."""
        study, real = self.study, flown.last.dtype
        problem, _ = self.plan.make(drawn)
        direction = jnp.asarray(self.direction, real)
        watched = list(self._watched)
        fine = flown.ending == Ending.FINE
        value = lambda name, t, y: self._signals[name].of(RunPoint(problem, t, y, direction))
        found: dict[str, Any] = {}
        for name, quantity in study.quantities.items():
            if name in watched:
                k = watched.index(name)
                taken = flown.when[k] if quantity.take.startswith("when_") else flown.extreme[k]
                found[name] = -taken if quantity.take == "smallest" else taken
            elif quantity.take == "path":
                each = jax.vmap(lambda t, y, name=name: value(name, t, y))
                path = each(jnp.asarray(study.times, real), flown.kept)
                found[name] = jnp.where(fine, path, jnp.nan)
            else:
                found[name] = jnp.where(fine, value(name, flown.t, flown.last), jnp.nan)
        return found | {
            "end": flown.t,
            "steps": flown.accepted,
            "rejected": flown.rejected,
            "residual": flown.residual[0],
            "status": flown.ending,
        }


def _double() -> Any:
    """Context of double precision for this thread."""
    with jax.enable_x64(True):
        if jnp.zeros(()).dtype != jnp.float64:
            raise SimulationError("Double precision could not be switched on.")
    return jax.enable_x64(True)


def _turned(quantity: Quantity, g: Any) -> Any:
    """Monitored signal, whose maximum or rise above zero is the wanted quantity."""
    if quantity.take == "smallest":
        return -g
    if quantity.take == "when_above":
        return g - quantity.level
    return quantity.level - g if quantity.take == "when_below" else g


def _most_devices() -> int:
    """Largest number of threads, or of devices."""
    there = jax.local_devices()
    return MOST_DEVICES if there[0].platform == "cpu" else len(there)


def _parts(count: int, block: int, lanes: int, devices: int) -> Iterator[tuple[int, int]]:
    """Ranges (start, stop) of parts of up to a block, as many as keep the devices busy."""
    least = -(-count // block)
    # no part is so small that some of its batch slots are idle
    number = max(least, min(-(-least // devices) * devices, -(-count // lanes)))
    ends = [count * k // number for k in range(number + 1)]
    return itertools.pairwise(ends)
