"""A study as work: blocks of flights through compiled lanes, on all devices."""

from collections.abc import Mapping
from functools import cached_property
from typing import Any

import diffrax
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

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

# Flights of one call of the compiled program; results do not depend on it.
BLOCK = 2048

_SOLVERS = {"dopri8": diffrax.Dopri8, "tsit5": diffrax.Tsit5}


class FlightWork(AbstractWork):
    """A study's flights by number.

    Args:
        lanes: flights that go on together on a device; default by the kind of device.
        block: flights of one compiled call.
        devices: to be used; default all local ones.

    Raises:
        SettingError: numbers that are not positive, or a study in double precision without x64.
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
        self._lanes, self._block, self._devices = lanes, block, devices

    def __getstate__(self) -> dict[str, Any]:
        """Compiled programs stay here."""
        keep = ("study", "_lanes", "_block", "_devices")
        return {k: self.__dict__[k] for k in keep}

    @property
    def identity(self) -> Mapping[str, Any]:
        """The study's plain data."""
        return self.study.plain()

    @property
    def unit(self) -> int:
        """Flights of one compiled call: chunks of a store are best multiples of it."""
        return self._block

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
        parts = []
        with jax.enable_x64(not study.flights.float32):
            if not study.flights.float32 and jnp.zeros(()).dtype != jnp.float64:
                raise SimulationError("Double precision could not be switched on.")
            for start in range(0, count, self._block):
                part = drawn[start : start + self._block]
                parts.append(self._fly(part, first + start))
        joined = {k: np.concatenate([p[k] for p in parts]) for k in parts[0]} if parts else {}
        inputs = {column_name(name): drawn[:, k] for k, name in enumerate(study.sampling.names)}
        found = inputs | joined
        return {k: np.asarray(found[k], c.dtype) for k, c in self.columns.items()} if parts else {
            k: np.zeros((0, *(len(self.axes[d].values) for d in c.dims)), c.dtype)
            for k, c in self.columns.items()
        }  # fmt: skip

    def _fly(self, drawn: np.ndarray, first: int) -> dict[str, np.ndarray]:
        """One block, filled up to its size by flights that are not flown."""
        count, size = len(drawn), self._block
        values = np.concatenate([drawn, np.zeros((size - count, drawn.shape[1]))])
        seeds = np.concatenate([self.seeds(first, count), np.zeros(size - count, np.uint32)])
        devices = self._mesh.size
        shares = np.array([len(range(d, count, devices)) for d in range(devices)], np.int32)
        # flights go to the devices in turn, so that all have as many
        spread = lambda x: np.ascontiguousarray(
            x.reshape(size // devices, devices, *x.shape[1:]).swapaxes(0, 1)
        )
        real = np.float32 if self.study.flights.float32 else np.float64
        flown = self._program(
            jnp.asarray(spread(values), real), jnp.asarray(spread(seeds)), jnp.asarray(shares)
        )
        gather = lambda x: np.asarray(x).swapaxes(0, 1).reshape(size, *x.shape[2:])[:count]
        return {k: gather(v) for k, v in flown.items()}

    def seeds(self, first: int, count: int) -> np.ndarray:
        """Of the flights' own noise (count,): zeros where they have none."""
        if not self.study.flights.gusts:
            return np.zeros(count, np.uint32)
        own = lambda k: np.random.SeedSequence((self.study.sampling.seed, k)).generate_state(1)[0]
        return np.array([own(first + k) for k in range(count)], np.uint32)

    @cached_property
    def _mesh(self) -> Mesh:
        devices = jax.local_devices()[: self._devices]
        while self._block % len(devices):
            devices = devices[:-1]
        return Mesh(np.array(devices), ("flights",))

    @cached_property
    def _program(self) -> Any:
        """Blocks (devices, flights of each, .) -> columns of the same shape."""
        kind, single = self._mesh.devices.flat[0].platform, self.study.flights.float32
        size = self._block // self._mesh.size
        lanes = self._lanes or LANES.get(kind, LANES_ELSEWHERE)
        if single:
            # JAX keeps NumPy's constants of a trace in the precision of the first that had them
            jax.clear_caches()
        plan = self.plan

        def share(values: Any, seeds: Any, count: Any) -> dict[str, Any]:
            queue = Drawn(values[0], seeds[0])
            flown = fly(plan, queue, count[0], min(lanes, size))
            columns = jax.vmap(self._kept)(queue, flown)
            return {k: v[None] for k, v in columns.items()}

        over = PartitionSpec("flights")
        spread = jax.shard_map(
            share, mesh=self._mesh, in_specs=(over, over, over), out_specs=over, check_vma=False
        )
        program = jax.jit(spread, compiler_options=compiler_options())
        if not single:
            return program
        of = lambda dtype, *more: jax.ShapeDtypeStruct((self._mesh.size, *more), dtype)
        values = of(jnp.float32, size, len(self.study.sampling.names))
        compiled = program.lower(values, of(jnp.uint32, size), of(jnp.int32)).compile()
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
