"""A study as work: blocks of flights through compiled lanes, on all cores or devices.

A sample's numbers are its own. One program, compiled for one device and always of the same shape,
flies every block; the cores of a CPU share it as threads, and other devices have a copy each. What
is left that decides the last digits is the number of lanes, which is part of the study's identity.
"""

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

from ..algebra.compiler import compiler_options
from ..dynamics.problem import Method, Problem, prepare
from ..dynamics.tree import Tree
from ..mechanics.errors import SettingError, SimulationError
from ..mechanics.state import State
from .flights import Drawn
from .lanes import REASONS, Ending, Flown, Plan, fly
from .signal import Signal, View
from .study import Quantity, Study, column_name
from .work import AbstractWork, Axis, Column

# Flights that go on together on one device: on a CPU as many as fit its cache, by measurement
# (docs/throughput.md); a GPU wants thousands.
LANES = {"cpu": 16}
LANES_ELSEWHERE = 4096

# Lanes are computed so many at a time by one instruction of a processor (AVX-512, double
# precision); lanes left over would be rounded otherwise, and a flight's lane would matter.
TOGETHER = 8

# Flights of one call of the compiled program; results do not depend on it.
BLOCK = 512

MOST_DEVICES = 1024

_SOLVERS = {"dopri8": diffrax.Dopri8, "tsit5": diffrax.Tsit5}


class FlightWork(AbstractWork):
    """A study's flights by number.

    Args:
        lanes: flights that go on together on a device, a multiple of 8; default 16 on a CPU and
            4096 elsewhere, whatever the number of cores. Part of the study's identity, as the last
            digits depend on it.
        block: flights of one call of the compiled program; at least the lanes.
        devices: threads on a CPU, default one; GPUs elsewhere, default all. Numbers do not depend
            on it.

    Raises:
        SettingError: numbers that are not positive, lanes that are not a multiple of 8, more
            devices than there are, or a study in double precision without x64.
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
        """Compiled programs stay here."""
        keep = ("study", "lanes", "_block", "_devices")
        return {k: self.__dict__[k] for k in keep}

    @property
    def identity(self) -> Mapping[str, Any]:
        """The study's plain data, and the lanes."""
        return {**self.study.plain(), "lanes": self.lanes}

    @property
    def unit(self) -> int:
        """Flights that keep all devices busy: chunks of a store are best multiples of it."""
        return self._block * len(self._places)

    @property
    def columns(self) -> Mapping[str, Column]:
        """Drawn numbers, quantities, what the integration says, and the status."""
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
        """The times of paths."""
        paths = any(q.take == "path" for q in self.study.quantities.values())
        return {"time": Axis(self.study.times, "s")} if paths else {}

    @property
    def reasons(self) -> Mapping[int, str]:
        """Of flights that failed."""
        return {int(code): words for code, words in REASONS.items()}

    def run(self, first: int, count: int) -> dict[str, np.ndarray]:
        """Columns of the flights first, first + 1, ...

        Raises:
            SimulationError: JAX is not set up for the study's precision.
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
        """The parts' columns: each device takes the next part that nobody has taken."""
        places = self._places[: len(parts)]
        with self._precision():
            # compiled here, once for each device, before threads ask for it
            programs = [self._programs(place) for place in places]
        found: list[Any] = [None] * len(parts)
        waiting, taking, stop = iter(enumerate(parts)), threading.Lock(), threading.Event()

        def carry_out(program: Any) -> None:
            with self._precision():
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
                # after Ctrl-C or an error the parts at hand are the last
                stop.set()
        return found

    def _precision(self) -> Any:
        """The study's, for this thread."""
        double = not self.study.flights.float32
        context = jax.enable_x64(double)
        with context:
            if double and jnp.zeros(()).dtype != jnp.float64:
                raise SimulationError("Double precision could not be switched on.")
        return jax.enable_x64(double)

    def _fly(self, program: Any, drawn: np.ndarray, first: int) -> dict[str, np.ndarray]:
        """One block, filled up to its size by flights that are not flown."""
        count, size = len(drawn), self._block
        possible = self.study.flights.possible(self.study.sampling.names, drawn)
        # NaN is a start that cannot be made, which costs nothing
        drawn = np.where(possible[:, None], drawn, np.nan)
        values = np.concatenate([drawn, np.zeros((size - count, drawn.shape[1]))])
        seeds = np.concatenate([self.seeds(first, count), np.zeros(size - count, np.uint32)])
        real = np.float32 if self.study.flights.float32 else np.float64
        flown = program(values.astype(real), seeds.astype(np.uint32), np.int32(count))
        found = {k: np.array(v[:count]) for k, v in jax.device_get(flown).items()}
        found["status"][~possible] = Ending.NOT_PHYSICAL
        return found

    def seeds(self, first: int, count: int) -> np.ndarray:
        """Of the flights' own noise (count,): zeros where they have none."""
        if not self.study.flights.gusts:
            return np.zeros(count, np.uint32)
        own = lambda k: np.random.SeedSequence((self.study.sampling.seed, k)).generate_state(1)[0]
        return np.array([own(first + k) for k in range(count)], np.uint32)

    @cached_property
    def _places(self) -> list[Any]:
        """A device for each thread: the first, again and again, on a CPU; all of them elsewhere."""
        there = jax.local_devices()
        if there[0].platform == "cpu":
            return [there[0]] * (self._devices or 1)
        return there[: self._devices]

    def _programs(self, place: Any) -> Callable[..., dict[str, Any]]:
        """The compiled program of a device: values (block, d), seeds (block,), count -> columns."""
        if place not in self._compiled:
            self._compiled[place] = self._program(place)
        return self._compiled[place]

    @cached_property
    def _compiled(self) -> dict[Any, Any]:
        return {}

    def _program(self, place: Any) -> Any:
        single, plan = self.study.flights.float32, self.plan
        if single:
            # JAX keeps NumPy's constants of a trace in the precision of the first that had them
            jax.clear_caches()

        def block(values: Any, seeds: Any, count: Any) -> dict[str, Any]:
            queue = Drawn(values, seeds)
            return jax.vmap(self._kept)(queue, fly(plan, queue, count, self.lanes))

        at = jax.sharding.SingleDeviceSharding(place)
        of = lambda dtype, *shape: jax.ShapeDtypeStruct(shape, dtype, sharding=at)
        values = of(
            jnp.float32 if single else jnp.float64, self._block, len(self.study.sampling.names)
        )
        program = jax.jit(block, compiler_options=compiler_options())
        compiled = program.lower(values, of(jnp.uint32, self._block), of(jnp.int32)).compile()
        if single:
            jax.clear_caches()
        return compiled

    @cached_property
    def direction(self) -> np.ndarray:
        """That the panel should face, world (3,)."""
        of = self.study
        return np.asarray(of.flights.facing() if of.direction is None else of.direction)

    @cached_property
    def _signals(self) -> dict[str, Signal]:
        return self.study.signals()

    @cached_property
    def plan(self) -> Plan:
        """What `lanes.fly` flies, for programs that want its bare results."""
        study, direction = self.study, self.direction
        method = Method(
            formulation=Tree(), solver=_SOLVERS[study.solver](), rtol=study.rtol, atol=study.atol,
            max_steps=study.max_steps, adjoint=diffrax.ForwardMode(), steps="state",
        )  # fmt: skip
        names = study.sampling.names

        def make(drawn: Drawn) -> tuple[Problem, State]:
            system, state0 = study.flights.build(names, drawn)
            # NumPy's arrays stay in double precision, whatever JAX is set to
            plain = lambda x: jnp.asarray(x) if isinstance(x, np.ndarray) else x
            return jax.tree.map(plain, prepare(system, method)), state0

        watched, of = self._watched, self._signals

        def watch(smooth: bool) -> Any:
            chosen = [(of[k].of, q) for k, q in watched.items() if of[k].smooth == smooth]

            def signals(problem: Problem, t: Any, y: Any) -> Any:
                view = View(problem, t, y, jnp.asarray(direction, y.dtype))
                found = [_turned(quantity, signal(view)) for signal, quantity in chosen]
                return jnp.stack(found) if found else jnp.zeros(0, y.dtype)

            return signals

        stops = tuple(q.stop for q in watched.values())
        times: Any = study.times
        return Plan(make, times, 0.0, watch(True), watch(False), stops, study.step)

    @cached_property
    def _watched(self) -> dict[str, Quantity]:
        """Quantities that need watching between the kept times, those with rates first."""
        chosen = self.study.quantities.items()
        found = [(k, q) for k, q in chosen if q.take not in ("final", "path")]
        return dict(sorted(found, key=lambda item: not self._signals[item[0]].smooth))

    def _kept(self, drawn: Drawn, flown: Flown) -> dict[str, Any]:
        """What the store keeps of one flight."""
        study, real = self.study, flown.last.dtype
        problem, _ = self.plan.make(drawn)
        direction = jnp.asarray(self.direction, real)
        watched = list(self._watched)
        fine = flown.ending == Ending.FINE
        value = lambda name, t, y: self._signals[name].of(View(problem, t, y, direction))
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


def _turned(quantity: Quantity, g: Any) -> Any:
    """So that its maximum, or its rise above zero, is what is wanted."""
    if quantity.take == "smallest":
        return -g
    if quantity.take == "when_above":
        return g - quantity.level
    return quantity.level - g if quantity.take == "when_below" else g


def _most_devices() -> int:
    """Threads, or devices that there are."""
    there = jax.local_devices()
    return MOST_DEVICES if there[0].platform == "cpu" else len(there)


def _parts(count: int, block: int, lanes: int, devices: int) -> Iterator[tuple[int, int]]:
    """(start, stop) of parts of up to a block, as many as keep the devices busy."""
    least = -(-count // block)
    # no part so small that lanes of it stand idle
    number = max(least, min(-(-least // devices) * devices, -(-count // lanes)))
    ends = [count * k // number for k in range(number + 1)]
    return itertools.pairwise(ends)
