"""Flight of a mission in chunks of one compiled program, whose samples an interruption leaves."""

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

from ..control.closed_loop import LoopRun, Rollout, rollout, run_of
from ..control.plant import Plant, PlantState
from ..math.compiler import cached_program
from ..uav.battery import Battery
from .mission import Mission

# Time of a chunk [s]: progress is reported and Ctrl-C ends a flight after each.
CHUNK = 1.0
Ending = Literal["", "interrupted", "battery empty", "failed"]


@dataclass(frozen=True)
class MissionFlight:
    """Flight of a mission.

    Attributes:
        mission: the mission. run: run of its closed loop, with the signals of `GAUGES`; its `rollout` has
            NumPy arrays.
        ending: reason for an early end; empty if the flight reached its end.
    """

    mission: Mission
    run: LoopRun
    ending: Ending


def fly(
    mission: Mission,
    *,
    progress: Callable[[float], object] | None = None,
) -> MissionFlight:
    """Fly a mission to its end, to an empty battery, or until Ctrl-C; the samples so far are returned.

    Args:
        mission: mission, from `load_mission` or `make_mission`.
        progress: function that is called with the completed fraction after each second of flight.

    Raises:
        KeyboardInterrupt: an interruption before anything was flown.
    """
    plant, battery, total = mission.plant, mission.battery, mission.samples
    # Chunks of one length share a program; samples beyond the end are computed and left out, which
    # costs less than a program for the rest.
    count = min(max(round(CHUNK * plant.rate), 2), total)
    run = _Chunk(mission.controller, mission.references, mission.gauges, count)
    parts: list[Rollout] = []
    completed, compile_seconds, run_seconds, ending = 0, 0.0, 0.0, ""
    soc = 1.0 if mission.truth.battery is None else float(mission.truth.battery.charge)
    clock = time.perf_counter()
    try:
        # The noise is that of the mission's seed: the same mission is the same flight.
        key = jax.random.key(0 if mission.file.sensors is None else mission.file.sensors.seed)
        start = cached_program(_reset_plant, plant, key)(plant, key)
        memory = mission.controller.start()
        while completed < total and not ending:
            program = cached_program(_fly_chunk, run, plant, start, memory)
            compiled, remaining = time.perf_counter(), total - completed

            def fly_chunk(
                start: PlantState, memory: Any, most: int, program: Any = program
            ) -> Rollout:
                rows = first_rows(program(run, plant, start, memory), most)
                return _replace_rows(rows, signals=dict(rows.signals["gauges"]))

            rows = fly_chunk(start, memory, remaining)
            end: Ending = "failed" if np.any(rows.reason) else ""
            if battery is not None:
                charge = _discharge_battery(battery, soc, rows, plant.rate)
                if charge.ending == "overloaded" and not end and len(rows.ts) < remaining:
                    # a motion that diverges asks for it too, and its numbers break off within a second
                    beyond = fly_chunk(rows.end, rows.memory, remaining - len(rows.ts))
                    if np.any(beyond.reason):
                        rows, end = _join_rows([rows, beyond]), "failed"
                        charge = _discharge_battery(battery, soc, rows, plant.rate)
                rows, soc = _replace_rows(rows, signals=rows.signals | charge.signals), charge.soc
                if charge.ending == "empty" or (charge.ending and not end):
                    rows, end = first_rows(rows, charge.samples), "battery empty"
            parts.append(rows)
            start, memory, ending = rows.end, rows.memory, end
            completed += len(rows.ts)
            compile_seconds += compiled - clock
            run_seconds += time.perf_counter() - compiled
            if progress is not None:
                progress(completed / total)
            clock = time.perf_counter()
    except KeyboardInterrupt:
        ending = "interrupted"
    if not parts:
        raise KeyboardInterrupt
    rows = _join_rows(parts)
    loop_run = run_of(plant, rows, (compile_seconds, run_seconds))
    if loop_run.failure:
        # numbers until the failure: what follows it is no flight
        # The battery may be the first without a number: a demand beyond its largest power has no
        # current.
        broken = rows.reason != 0
        if battery is not None:
            broken |= ~np.isfinite(rows.signals["battery_current"])
        rows = first_rows(rows, max(int(np.argmax(broken)), 1))
        message = describe_failure(mission, rows, loop_run)
        loop_run = dataclasses.replace(loop_run, rollout=rows, failure=message)
    return MissionFlight(mission, loop_run, ending)


def describe_failure(mission: Mission, rows: Rollout, run: LoopRun) -> str:
    """Reason for a failed flight: the first limit that it had left before, if there is one.

    Args:
        rows: samples until the failure.
    """
    machine, signals, exits = mission.machine, rows.signals, []

    def note_first(outside: np.ndarray, describe: Callable[[Any], str]) -> None:
        if np.any(outside):
            place = np.argwhere(outside)[0]
            exits.append((int(place[0]), describe(place)))

    if machine.limits is not None:
        low, high = np.asarray(machine.limits.lower), np.asarray(machine.limits.upper)
        q = np.asarray(signals["displacement"])
        note_first(
            (q < low) | (q > high),
            lambda k: f"slider {k[1] + 2} left its stroke of {low[k[1]]:.4g} to {high[k[1]]:.4g} m",
        )
    if machine.force is not None:
        note_first(
            np.abs(signals["commanded_force"]) > machine.force,
            lambda k: f"the servo commanded slider {k[1] + 2} more than {machine.force:g} N",
        )
    note_first(signals["tilt_error"] > np.pi / 2, lambda k: "the base was upside down")
    # A flight that diverges passes limits long before its numbers overflow: the first of them is
    # the useful message.
    t_end = run.certificate.t_end
    if rows.ts[-1] < t_end:
        exits.append((len(rows.ts), "its power demand exceeded that of the battery"))
    if not exits:
        return run.failure
    k, exit_text = min(exits)
    return (
        f"The flight got out of control: at t = {run.ts[k]:.6g} s {exit_text}, and after t = "
        f"{t_end:.6g} s its motion had diverged: its numbers were no longer finite."
    )


class _Chunk(eqx.Module):
    """Parts of a closed loop other than its plant, and the samples of a chunk."""

    controller: Any
    reference: Any
    gauges: Any
    samples: int = eqx.field(static=True)


def _reset_plant(plant: Plant, key: Array) -> PlantState:
    return plant.reset(key)


def _fly_chunk(run: _Chunk, plant: Plant, start: PlantState, memory: Any) -> Rollout:
    return rollout(
        plant, run.controller, run.samples, reference=run.reference, memory=memory,
        signals={"gauges": run.gauges}, start=start,
    )  # fmt: skip


def _sample_arrays(flight_rollout: Rollout) -> dict[str, Any]:
    """Arrays with a row for each sample."""
    names = [field.name for field in dataclasses.fields(flight_rollout)]
    return {name: getattr(flight_rollout, name) for name in names if name not in ("end", "memory")}


def _replace_rows(flight_rollout: Rollout, **rows: Any) -> Rollout:
    """Rollout with other rows, which may be NumPy arrays."""
    return eqx.tree_at(
        lambda r: [getattr(r, name) for name in rows], flight_rollout, list(rows.values())
    )


def first_rows(samples: Rollout, count: int) -> Rollout:
    """Rollout of the first samples, as NumPy arrays."""
    return _replace_rows(
        samples, **jax.tree.map(lambda x: np.asarray(x)[:count], _sample_arrays(samples))
    )


def _join_rows(parts: list[Rollout]) -> Rollout:
    """Rollout of parts that follow one another, as NumPy arrays."""
    rows = jax.tree.map(lambda *x: np.concatenate(x), *map(_sample_arrays, parts))
    return _replace_rows(parts[-1], **rows)


def drain_samples(
    battery: Battery, soc: Float[Array, ""], power: Float[Array, " k"], period: Float[Array, ""]
) -> tuple[Array, Array, Array, Array]:
    """State of charge, current and voltage at each sample, and the state of charge after the last.

    The power is held from sample to sample, and the current is that at the state of charge before.
    """

    # Explicit steps of a control period, within which the charge hardly changes.
    def discharge_step(soc: Array, power: Array) -> tuple[Array, tuple[Array, Array]]:
        current = battery.current(power, soc)
        return soc - period * current / battery.capacity, (soc, current)

    last, (socs, currents) = jax.lax.scan(discharge_step, soc, power)
    return socs, currents, battery.voltage(socs) - battery.resistance * currents, last


class _Discharge(NamedTuple):
    """Signals of the battery, its charge afterwards, and the samples until it ends, with the reason."""

    signals: dict[str, np.ndarray]
    soc: float
    samples: int
    ending: Literal["", "empty", "overloaded"]


def _discharge_battery(battery: Battery, soc: float, rows: Rollout, rate: float) -> _Discharge:
    """Discharge by samples: until its reserve is used up, or the demand exceeds its power."""
    power = jnp.asarray(rows.signals["electric_power"])
    arguments = (battery, jnp.asarray(soc), power, jnp.asarray(1.0 / rate))
    socs, currents, voltages, last = (
        np.asarray(x) for x in cached_program(drain_samples, *arguments)(*arguments)
    )
    signals = {"state_of_charge": socs, "battery_current": currents, "battery_voltage": voltages}
    empty = socs <= float(battery.reserve)
    over = empty | (np.isfinite(power) & ~np.isfinite(currents))
    if not np.any(over):
        ending = "empty" if last <= battery.reserve else ""
        return _Discharge(signals, float(last), len(socs), ending)
    k = int(np.argmax(over))
    return _Discharge(signals, float(socs[k]), k + 1, "empty" if empty[k] else "overloaded")
