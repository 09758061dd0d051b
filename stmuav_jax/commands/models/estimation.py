"""Command `stmuav estimate MODEL`: a filter on a model's own sensors, over many seeds of their noise."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from rich.console import Console

from ...checks.errors import SettingError, named_places
from ...figures.terminal import line, row, table
from ..options import Number, Seed, count, default, shared
from ..output import results_folder, written
from ..simulate import chosen_scene
from .point import PointSettings, scalars_by_name, starting_point

if TYPE_CHECKING:
    from ...dynamics.scene import Scene
    from ...dynamics.statespace.tree import TreeSpace

_RATE = Number("rate", "Hz", above=0.0, high=1e6)
_SIZE = Number("standard deviation", "", above=0.0, high=1e6)


@dataclasses.dataclass
class EstimateSettings(PointSettings):
    """Options of a filter on a model's sensors."""

    sensors: Annotated[tuple[str, ...], default("all of the file")] = ()
    """Sensors whose readings the filter has."""
    t1: Annotated[
        float | None, Number("end", "s", above=0.0, high=1e4), shared("t1"), default("the file's")
    ] = None
    rate: Annotated[float | None, _RATE, default("the sensors' highest, else 100")] = None
    """Rate of the filter [Hz]; sensors' own rates are whole parts of it."""
    spread: Annotated[float, _SIZE] = 0.05
    """Standard deviation of every state at the start, in its unit."""
    spreads: Annotated[tuple[str, ...], default("none")] = ()
    """Standard deviations of single states at the start, such as hinge.angle=0.2."""
    process: Annotated[float, _SIZE] = 0.01
    """Standard deviation of the random change of every velocity in one second, in its unit."""
    seeds: Annotated[int, count("runs", 100_000), shared("seeds")] = 50
    seed: Seed = 0
    out: Annotated[Path | None, shared("out"), default("runs/estimate_MODEL")] = None


ABOUT = """Estimate the motion of a model from the sensors of its file, over many seeds; write estimate.npz.

Example: stmuav estimate model.toml --seeds 50 --sensors angle. The truth is the simulator's, with finer steps,
with random starts and random changes of the velocities. The model's file has a table [sensors] (docs/models.md).
Exit codes: 0 consistent, 1 a filter lost its covariance, 2 wrong input, 3 the filter's own account of its errors
cannot be trusted. Without a model's file: the report's eight cases, stmuav estimate --help.
"""
# Substeps of the truth in a step of the filter.
_FINER = 4
# Exit code of a completed run with a filter that cannot be trusted.
UNTRUSTED = 3


class Record(NamedTuple):
    """Results of the filters.

    Attributes:
        t: times (T,) [s]. error, deviation: estimates less truth, and the filters' standard
            deviations (T, n, s). nees, nis: normalised errors and innovations squared (T, s).
        degrees: components that a time's readings have (T,). ok: flags of the filters (s,).
        innovation: normalised innovations, NaN where a reading is missing (T, m, s).
    """

    t: np.ndarray
    error: np.ndarray
    deviation: np.ndarray
    nees: np.ndarray
    nis: np.ndarray
    degrees: np.ndarray
    ok: np.ndarray
    innovation: np.ndarray


def run_estimate_model(command: Any) -> int:
    """Run the filters, print their errors and consistency, write estimate.npz; the exit code."""
    from ...figures.filter_record import end_consistency, record_content
    from ...files.netcdf import write_atomically

    scene, settings = chosen_scene(command), command.settings
    instruments = _chosen(scene, settings.sensors)
    space, x = starting_point(scene, settings)
    found = _estimated(scene, space, x, instruments, settings)
    shown = table("state", "at the start", "error at the end", "the filter's deviation", "unit")
    error = np.sqrt(np.mean(found.error[-1] ** 2, axis=-1))
    own = np.sqrt(np.mean(found.deviation[-1] ** 2, axis=-1))
    first = _spreads(space, settings)
    for k, (name, unit) in enumerate(space.names):
        row(shown, name, *(f"{v[k]:.3g}" for v in (first, error, own)), unit)
    out = Console()
    out.print(shown)
    fine = True
    for one in end_consistency(found.nees, space.size, found.nis, found.degrees):
        fine = fine and one.holds
        line(out, one.words)
    folder = results_folder(settings.out, f"estimate_{scene.name}")
    content = record_content(
        scene.title or scene.name, space.names, found._asdict(), _about(command)
    )
    written(out, [write_atomically(folder / "estimate.npz", content)])
    lost = int(np.sum(~found.ok))
    if lost:
        line(out, f"{lost} filters lost their covariance.")
        return 1
    return 0 if fine else UNTRUSTED


def _about(command: Any) -> dict[str, Any]:
    """Options of the filter as plain data, for its file."""
    given = dataclasses.asdict(command.settings)
    plain = {
        k: str(v) if isinstance(v, Path) else v for k, v in given.items() if v not in (None, ())
    }
    return {"scene": command.scene} | {k: v for k, v in plain.items() if k not in ("out", "cache")}


def _chosen(scene: "Scene", names: Sequence[str]) -> list[Any]:
    """Instruments of a scene by name, all of them by default."""
    if not scene.sensors:
        raise SettingError(
            f"{scene.name} has no sensors to estimate from: a model's file has them in tables "
            '[sensors.NAME] with a kind, such as "encoder" (docs/models.md).'
        )
    known = list(scene.sensors)
    places = named_places(list(names), known, "The sensors", "sensor")
    found = [scene.sensors[known[k]] for k in places] or list(scene.sensors.values())
    for one in found:
        if one.delay:
            raise SettingError(
                f"The filter takes readings without delay, but the sensor '{one.name}' is late by "
                f"{one.delay:g} s; leave it out with --sensors, or set its delay to 0."
            )
        if one.noise is None or not np.all(np.asarray(one.noise) > 0):
            raise SettingError(f"The filter needs the noise of the sensor '{one.name}', above 0.")
    return found


def _spreads(space: "TreeSpace", settings: EstimateSettings) -> np.ndarray:
    """Standard deviations of the states at the start (n,)."""
    from ...dynamics.statespace.base import places_of

    given = scalars_by_name(settings.spreads, "--spreads")
    found = np.full(space.size, settings.spread)
    found[list(places_of(space, list(given), "The spreads"))] = list(given.values())
    if not np.all(found > 0):
        raise SettingError("The standard deviations of --spreads must be positive.")
    return found


def _estimated(
    scene: "Scene", space: "TreeSpace", x: Any, instruments: Sequence[Any], settings: Any
) -> Record:
    """Filters on simulated records, one for each seed."""
    import jax
    import jax.numpy as jnp

    from ...algebra.compiler import quick_jit
    from ...estimation.bank import filter_bank
    from ...estimation.consistency import path_nees
    from ...estimation.gaussians import gaussian
    from ...figures.filter_record import normalised_innovations
    from ...sensing.process import system_model

    rate, steps = _times(scene, instruments, settings)
    sensors = [one.sensor for one in instruments]
    sizes = [len(one.sensor.components(space.system)) for one in instruments]
    noise, bias = (
        np.concatenate([
            np.broadcast_to(np.asarray(getattr(one, name) or 0.0, float), (k,))
            if np.ndim(getattr(one, name)) == 0 else np.asarray(getattr(one, name), float)
            for one, k in zip(instruments, sizes, strict=True)
        ])
        for name in ("noise", "bias")
    )  # fmt: skip
    wander = np.zeros(space.size)
    wander[space.dof : 2 * space.dof] = settings.process / np.sqrt(rate)
    model, fine = (
        system_model(space, sensors, Q=wander**2, R=noise**2, substeps=substeps)
        for substeps in (1, _FINER)
    )
    spread, s = _spreads(space, settings), settings.seeds
    rng = np.random.default_rng(settings.seed)
    prior = gaussian(x, np.diag(spread**2))
    drawn = lambda deviations, *shape: jnp.asarray(
        deviations[:, None] * rng.standard_normal((*shape, len(deviations), s))
    )
    stack = jax.tree.map(lambda a: a[:, None], x)
    first = space.retract(stack, drawn(spread))

    def onwards(now: Any, w: Any) -> Any:
        now = fine.space.retract(fine(now, None, 1.0 / rate), w)
        return now, (now, fine.sensor(now, None))

    fly = quick_jit(lambda start, w: jax.lax.scan(onwards, start, w)[1])
    truth, seen = fly(first, drawn(wander, steps))
    errors = drawn(noise, steps) + bias[:, None]
    y = np.array(jax.vmap(fine.sensor.space.retract)(seen, errors))
    there = _readable(y, instruments, [_length(one, space) for one in instruments], rate)
    out = filter_bank(model, prior, jnp.asarray(y), dt=1.0 / rate)
    every = jax.vmap(space.difference)(out.mean, truth)
    degrees = np.array(
        [sum(k for k, here in zip(sizes, now, strict=True) if here) for now in there]
    )
    return Record(
        scene.t0 + np.arange(1, steps + 1) / rate, np.asarray(every),
        np.asarray(out.standard_deviation), np.asarray(path_nees(out, truth, space)),
        np.asarray(out.nis), degrees, np.asarray(out.ok)[-1], normalised_innovations(out.innovations),
    )  # fmt: skip


def _times(scene: "Scene", instruments: Sequence[Any], settings: Any) -> tuple[float, int]:
    """Rate of the filter [Hz] and number of its steps."""
    rates = [one.rate for one in instruments if one.rate is not None]
    rate = settings.rate or max(rates, default=100.0)
    t1 = scene.t1 - scene.t0 if settings.t1 is None else settings.t1
    return rate, max(round(t1 * rate), 1)


def _length(instrument: Any, space: "TreeSpace") -> int:
    """Numbers in a reading: an attitude has four, with errors in three components."""
    from ...sensing.sensors import AttitudeFix

    sensor = instrument.sensor
    return 4 if isinstance(sensor, AttitudeFix) else len(sensor.components(space.system))


def _readable(
    y: np.ndarray, instruments: Sequence[Any], lengths: Sequence[int], rate: float
) -> np.ndarray:
    """Flags (T, instruments) of fresh readings; the others are set to NaN in the record."""
    there = np.ones((len(y), len(instruments)), bool)
    ends = np.cumsum([0, *lengths])
    for k, one in enumerate(instruments):
        every = one.periods(rate)
        there[:, k] = np.arange(1, len(y) + 1) % every == 0
        y[~there[:, k], ends[k] : ends[k + 1]] = np.nan
    return there
