"""Command `stmuav estimate MODEL`: a filter on a model's own sensors, over many seeds of their noise."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
from rich.console import Console

from ...checks.errors import SettingError, named_places
from ...figures.terminal import add_row, make_table, print_line
from ..options import Number, Seed, count_range, default_text, shared_option
from ..output import print_paths, results_folder
from ..scene_options import chosen_scene
from .point import PointSettings, scalars_by_name, starting_point

if TYPE_CHECKING:
    from ...dynamics.simulation import Scene
    from ...dynamics.statespace.tree import TreeSpace

_RATE = Number("rate", "Hz", above=0.0, high=1e6)
_SIZE = Number("standard deviation", "", above=0.0, high=1e6)


@dataclasses.dataclass
class EstimateSettings(PointSettings):
    """Options of a filter on a model's sensors."""

    sensors: Annotated[tuple[str, ...], default_text("all of the file")] = ()
    """Sensors whose readings the filter has."""
    t1: Annotated[
        float | None,
        Number("end", "s", above=0.0, high=1e4),
        shared_option("t1"),
        default_text("the file's"),
    ] = None
    rate: Annotated[float | None, _RATE, default_text("the sensors' highest, else 100")] = None
    """Rate of the filter [Hz]; sensors' own rates are whole parts of it."""
    start_deviation: Annotated[float, _SIZE] = 0.05
    """Standard deviation of every state at the start, in its unit."""
    start_deviations: Annotated[tuple[str, ...], default_text("none")] = ()
    """Standard deviations of states at the start, such as A.angle=0.02; 0 for one that is exact."""
    process: Annotated[float, _SIZE] = 0.01
    """Standard deviation of the random change of every velocity in one second, in its unit."""
    seeds: Annotated[int, count_range("runs", 100_000), shared_option("seeds")] = 50
    seed: Seed = 0
    out: Annotated[Path | None, shared_option("out"), default_text("runs/estimate_MODEL")] = None


ABOUT = """Estimate the motion of a model from the sensors of its file, over many seeds; write estimate.npz.

Example: stmuav estimate model.toml --seeds 50 --sensors angle. The truth is the simulator's, with finer steps,
with random starts and random changes of the velocities. The model's file has a table [sensors] (docs/models.md).
Exit codes: 0 consistent, 1 a filter lost its covariance, 2 wrong input, 3 the filter is inconsistent. Without a
model's file: the report's eight cases, stmuav estimate --help.
"""
# Substeps of the truth in a step of the filter.
_FINER = 4
# Exit code of a completed run with an inconsistent filter.
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
    from ...io.netcdf import write_atomically

    scene, settings = chosen_scene(command), command.settings
    instruments = _choose_instruments(scene, settings.sensors)
    space, x = starting_point(scene, settings)
    result = _estimate_records(scene, space, x, instruments, settings)
    state_table = make_table(
        "state", "at the start", "error at the end", "the filter's deviation", "unit"
    )
    error = np.sqrt(np.mean(result.error[-1] ** 2, axis=-1))
    filter_deviation = np.sqrt(np.mean(result.deviation[-1] ** 2, axis=-1))
    first = _start_deviations(space, settings)
    for k, (name, unit) in enumerate(space.names):
        add_row(state_table, name, *(f"{v[k]:.3g}" for v in (first, error, filter_deviation)), unit)
    out = Console()
    out.print(state_table)
    is_consistent = True
    for verdict in end_consistency(result.nees, space.size, result.nis, result.degrees):
        is_consistent = is_consistent and verdict.holds
        print_line(out, verdict.explanation)
    folder = results_folder(settings.out, f"estimate_{scene.name}")
    options = {k: v for k, v in vars(settings).items() if k not in ("out", "cache")}
    options = {k: str(v) if isinstance(v, Path) else v for k, v in options.items()}
    about = {"scene": command.scene} | {k: v for k, v in options.items() if v not in (None, ())}
    title = scene.title or scene.name
    content = record_content(title, space.names, result._asdict(), about)
    print_paths(out, [write_atomically(folder / "estimate.npz", content)])
    lost = int(np.sum(~result.ok))
    if lost:
        print_line(out, f"{lost} filters lost their covariance.")
        return 1
    return 0 if is_consistent else UNTRUSTED


def _choose_instruments(scene: "Scene", names: Sequence[str]) -> list[Any]:
    """Instruments of a scene by name, all of them by default."""
    if not scene.sensors:
        raise SettingError(
            f"{scene.name} has no sensors to estimate from: a model's file has them in tables "
            '[sensors.NAME] with a kind, such as "encoder" (docs/models.md).'
        )
    sensor_names = list(scene.sensors)
    places = named_places(list(names), sensor_names, "The sensors", "sensor")
    result = [scene.sensors[sensor_names[k]] for k in places] or list(scene.sensors.values())
    for instrument in result:
        if instrument.delay:
            raise SettingError(
                f"The filter takes readings without delay, but the sensor '{instrument.name}' has a delay of "
                f"{instrument.delay:g} s; leave it out with --sensors, or set its delay to 0."
            )
        if instrument.noise is None or not np.all(np.asarray(instrument.noise) > 0):
            raise SettingError(
                f"The filter needs the noise of the sensor '{instrument.name}', above 0."
            )
    return result


def _start_deviations(space: "TreeSpace", settings: EstimateSettings) -> np.ndarray:
    """Standard deviations of the states at the start (n,)."""
    from ...dynamics.statespace.base import places_of

    deviation_by_name = scalars_by_name(settings.start_deviations, "--start-deviations")
    result = np.full(space.size, settings.start_deviation)
    result[list(places_of(space, list(deviation_by_name), "The start deviations"))] = list(
        deviation_by_name.values()
    )
    if not np.all(result > 0):
        raise SettingError("The standard deviations of --start-deviations must be positive.")
    return result


def _estimate_records(
    scene: "Scene", space: "TreeSpace", x: Any, instruments: Sequence[Any], settings: Any
) -> Record:
    """Filters on simulated records, one for each seed."""
    import jax
    import jax.numpy as jnp

    from ...analysis.sensors import AttitudeFix, system_model
    from ...estimation.consistency import path_nees
    from ...estimation.filter import filter_bank
    from ...estimation.gaussians import gaussian
    from ...figures.filter_record import normalised_innovations
    from ...math.compiler import quick_jit

    rates = [instrument.rate for instrument in instruments if instrument.rate is not None]
    rate = settings.rate or max(rates, default=100.0)
    t1 = scene.t1 - scene.t0 if settings.t1 is None else settings.t1
    steps = max(round(t1 * rate), 1)
    sensors = [instrument.sensor for instrument in instruments]
    sizes = [len(instrument.sensor.components(space.system)) for instrument in instruments]
    noise, bias = (
        np.concatenate([
            np.broadcast_to(np.asarray(getattr(instrument, name) or 0.0, float), (k,))
            if np.ndim(getattr(instrument, name)) == 0 else np.asarray(getattr(instrument, name), float)
            for instrument, k in zip(instruments, sizes, strict=True)
        ])
        for name in ("noise", "bias")
    )  # fmt: skip
    wander = np.zeros(space.size)
    wander[space.dof : 2 * space.dof] = settings.process / np.sqrt(rate)
    model, truth_model = (
        system_model(space, sensors, Q=wander**2, R=noise**2, substeps=substeps)
        for substeps in (1, _FINER)
    )
    deviations, s = _start_deviations(space, settings), settings.seeds
    rng = np.random.default_rng(settings.seed)
    prior = gaussian(x, np.diag(deviations**2))
    normal_sample = lambda deviations, *shape: jnp.asarray(
        deviations[:, None] * rng.standard_normal((*shape, len(deviations), s))
    )
    stack = jax.tree.map(lambda a: a[:, None], x)
    first = space.retract(stack, normal_sample(deviations))

    def next_sample(now: Any, w: Any) -> Any:
        now = truth_model.space.retract(truth_model(now, None, 1.0 / rate), w)
        return now, (now, truth_model.sensor(now, None))

    fly = quick_jit(lambda start, w: jax.lax.scan(next_sample, start, w)[1])
    truth, true_readings = fly(first, normal_sample(wander, steps))
    errors = normal_sample(noise, steps) + bias[:, None]
    y = np.array(jax.vmap(truth_model.sensor.space.retract)(true_readings, errors))
    # an attitude has four numbers, with errors in three components
    lengths = [
        4 if isinstance(sensor, AttitudeFix) else k
        for sensor, k in zip(sensors, sizes, strict=True)
    ]
    fresh_mask = _fresh_readings(y, instruments, lengths, rate)
    out = filter_bank(model, prior, jnp.asarray(y), dt=1.0 / rate)
    every = jax.vmap(space.difference)(out.mean, truth)
    degrees = np.array(
        [sum(k for k, is_fresh in zip(sizes, now, strict=True) if is_fresh) for now in fresh_mask]
    )
    return Record(
        scene.t0 + np.arange(1, steps + 1) / rate, np.asarray(every),
        np.asarray(out.standard_deviation), np.asarray(path_nees(out, truth, space)),
        np.asarray(out.nis), degrees, np.asarray(out.ok)[-1], normalised_innovations(out.innovations),
    )  # fmt: skip


def _fresh_readings(
    y: np.ndarray, instruments: Sequence[Any], lengths: Sequence[int], rate: float
) -> np.ndarray:
    """Flags (T, instruments) of fresh readings; the others are set to NaN in the record."""
    fresh_mask = np.ones((len(y), len(instruments)), bool)
    ends = np.cumsum([0, *lengths])
    for k, instrument in enumerate(instruments):
        every = instrument.periods(rate)
        fresh_mask[:, k] = np.arange(1, len(y) + 1) % every == 0
        y[~fresh_mask[:, k], ends[k] : ends[k + 1]] = np.nan
    return fresh_mask
