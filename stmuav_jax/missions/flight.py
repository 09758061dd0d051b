"""Flight of a mission: in chunks of one compiled program, interrupted and resumed."""

import dataclasses
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import program
from ..control.closed_loop import LoopRun, run_of
from ..control.plant import Plant, PlantState
from ..control.rolling import Rollout, rollout
from ..rotorcraft.battery import Battery
from .mission import Mission

# Time of a chunk [s]: progress is reported and Ctrl-C is heard after each.
CHUNK = 1.0
Ending = Literal["", "interrupted", "battery empty", "failed"]


class Reached(NamedTuple):
    """Flight as far as it has come.

    Attributes:
        rows: samples, NumPy arrays; their `end` and `memory` continue the flight. None at the start.
        soc: state of charge after them [1].
        seconds: times of compiling and running [s].
    """

    rows: Rollout | None
    soc: float
    seconds: tuple[float, float]

    @property
    def samples(self) -> int:
        """Number of samples."""
        return 0 if self.rows is None else len(self.rows.ts)


@dataclass(frozen=True)
class MissionFlight:
    """Flight of a mission.

    Attributes:
        mission: the mission. run: run of its closed loop, with the signals of `GAUGES`.
        reached: samples from which it can go on.
        ending: reason for an early end; empty if the flight reached its end.
    """

    mission: Mission
    run: LoopRun
    reached: Reached
    ending: Ending


def start_of(mission: Mission) -> Reached:
    """Flight that has not begun."""
    given = mission.file.battery
    return Reached(None, 1.0 if given is None else given.state_of_charge, (0.0, 0.0))


def fly(
    mission: Mission,
    *,
    reached: Reached | None = None,
    progress: Callable[[float], object] | None = None,
    keep: Callable[[Reached], object] | None = None,
    heard: Callable[[], object] | None = None,
) -> MissionFlight:
    """Fly a mission to its end, to an empty battery, or until Ctrl-C; what was flown is kept.

    Args:
        mission: mission, from `load_mission` or `make_mission`.
        reached: samples from which an interrupted flight goes on; by default it begins.
        progress: function that is called with the completed fraction after each second of flight.
        keep: function that is called with the samples so far at the same times.
        heard: function that is called once an interruption is noticed.

    Raises:
        KeyboardInterrupt: an interruption before anything was flown.
    """
    now = start_of(mission) if reached is None else reached
    ending: Ending = ""
    chunk = min(max(round(CHUNK * mission.plant.rate), 2), mission.samples)
    run = _Chunk(mission.controller, mission.references, mission.gauges, chunk)
    try:
        while now.samples < mission.samples and not ending:
            now, ending = _onwards(mission, run, now)
            if progress is not None:
                progress(now.samples / mission.samples)
            if keep is not None and not ending and now.samples < mission.samples:
                keep(now)
    except KeyboardInterrupt:
        if heard is not None:
            heard()
        ending = "interrupted"
    if now.rows is None:
        raise KeyboardInterrupt
    return MissionFlight(mission, run_of(mission.plant, now.rows, now.seconds), now, ending)


class _Chunk(eqx.Module):
    """Parts of a closed loop other than its plant, and the samples of a chunk."""

    controller: Any
    reference: Any
    gauges: Any
    samples: int = eqx.field(static=True)


def _begun(plant: Plant, key: Array) -> PlantState:
    return plant.reset(key)


def _chunk(run: _Chunk, plant: Plant, start: PlantState, memory: Any) -> Rollout:
    return rollout(
        plant, run.controller, run.samples, reference=run.reference, memory=memory,
        signals={"gauges": run.gauges}, start=start,
    )  # fmt: skip


def _onwards(mission: Mission, run: _Chunk, now: Reached) -> tuple[Reached, Ending]:
    """Flight after one more chunk, and the reason if it ends there early."""
    clock = time.perf_counter()
    plant = mission.plant
    if now.rows is None:
        seed = 0 if mission.file.sensors is None else mission.file.sensors.seed
        key = jax.random.key(seed)
        start, memory = program(_begun, plant, key)(plant, key), mission.controller.start()
    else:
        start, memory = now.rows.end, now.rows.memory
    made = program(_chunk, run, plant, start, memory)
    compiled = time.perf_counter()
    found = made(run, plant, start, memory)
    seconds = now.seconds[0] + compiled - clock, now.seconds[1] + time.perf_counter() - compiled
    rows = first_rows(found, mission.samples - now.samples)
    rows = _with(rows, signals=dict(rows.signals["gauges"]))
    ending: Ending = "failed" if np.any(rows.reason) else ""
    soc = now.soc
    if mission.battery is not None:
        rows, soc, empty = _discharged(mission.battery, soc, rows, plant.rate)
        ending = "battery empty" if empty else ending
    return Reached(_joined(now.rows, rows), soc, seconds), ending


def _rows(found: Rollout) -> dict[str, Any]:
    """Arrays with a row for each sample."""
    names = [field.name for field in dataclasses.fields(found)]
    return {name: getattr(found, name) for name in names if name not in ("end", "memory")}


def _with(found: Rollout, **rows: Any) -> Rollout:
    """Rollout with other rows, which may be NumPy arrays."""
    return eqx.tree_at(lambda r: [getattr(r, name) for name in rows], found, list(rows.values()))


def first_rows(found: Rollout, count: int) -> Rollout:
    """Rollout of the first samples, as NumPy arrays."""
    return _with(found, **jax.tree.map(lambda x: np.asarray(x)[:count], _rows(found)))


def _joined(before: Rollout | None, after: Rollout) -> Rollout:
    if before is None:
        return after
    both = jax.tree.map(lambda a, b: np.concatenate([a, b]), _rows(before), _rows(after))
    return _with(after, **both)


def _drained(
    battery: Battery, soc: Float[Array, ""], power: Float[Array, " k"], period: Float[Array, ""]
) -> tuple[Array, Array, Array]:
    """State of charge and current at each sample, and the state of charge after the last.

    The power is held from sample to sample, and the current is that at the state of charge before.
    """

    def one(soc: Array, power: Array) -> tuple[Array, tuple[Array, Array]]:
        current = battery.current(power, soc)
        return soc - period * current / battery.capacity, (soc, current)

    last, (socs, currents) = jax.lax.scan(one, soc, power)
    return socs, currents, last


def _discharged(
    battery: Battery, soc: float, rows: Rollout, rate: float
) -> tuple[Rollout, float, bool]:
    """Samples with the battery's signals, up to the one at which it can no more, if there is one."""
    power = jnp.asarray(rows.signals["electric_power"])
    given = (battery, jnp.asarray(soc), power, jnp.asarray(1.0 / rate))
    socs, currents, last = (np.asarray(x) for x in program(_drained, *given)(*given))
    voltage = np.asarray(battery.voltage(socs)) - float(battery.resistance) * currents
    own = {"state_of_charge": socs, "battery_current": currents, "battery_voltage": voltage}
    rows = _with(rows, signals=rows.signals | own)
    over = (socs <= float(battery.reserve)) | (np.isfinite(power) & ~np.isfinite(currents))
    if not np.any(over):
        return rows, float(last), bool(last <= battery.reserve)
    k = int(np.argmax(over))
    return first_rows(rows, k + 1), float(socs[k]), True
