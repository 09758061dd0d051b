"""Command `stmuav estimate`: the report's eight cases of estimation, or a filter on a model's own sensors."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from rich.console import Console

from ..checks.errors import SettingError, named_places
from ..figures.terminal import add_row, make_table, print_line
from .mechanism import PointSettings, scalars_by_name, starting_point
from .options import (
    END,
    Cache,
    Figures,
    Number,
    Params,
    Seed,
    count_range,
    default_text,
    shared_option,
)
from .output import UNTRUSTED, print_paths, results_folder
from .scene_options import chosen_scene, command_or_scene

if TYPE_CHECKING:
    from ..dynamics.simulation import Scene
    from ..dynamics.statespace.tree import TreeSpace

_CASE = Number("number of the case", "", 1, 8)


@dataclasses.dataclass
class Estimate:
    """Estimate the centre of mass in the report's cases; write NetCDF files and figures.

    Example: stmuav estimate --case 4 --seeds 20. The motion of a mechanism with sensors is
    estimated by `stmuav estimate model.toml`; `stmuav estimate model.toml --help` describes that.

    Exit code: 0 all filters are consistent with their innovations; 1 a filter lost its covariance;
    2 wrong input; 3 a filter is inconsistent, as with the report's tuning in all eight cases."""

    case: Annotated[int | None, _CASE, shared_option("case", "all 8")] = None
    tuning: Literal["both", "report", "consistent"] = "both"
    """Covariances of Table 2.4.2 of the report, consistent ones, or both for comparison."""
    model: Literal["default", "observable", "report", "printed", "attitude"] = "default"
    """States of the filter: 5 observable ones; the report's 8, corrected or as printed; 8 with an attitude in SO(3).
    By default the report's tuning has the report's states and the consistent tuning the observable ones."""
    seeds: Annotated[int, count_range("runs", 100_000), shared_option("seeds")] = 50
    seed: Seed = 0
    t1: Annotated[float, END, shared_option("t1")] = 2.0
    params: Params = None
    filter_params: Annotated[Path | None, default_text("the values of --params")] = None
    """TOML file with values for the filters alone, to try a wrong model; --params is for truth and filters alike."""
    out: Annotated[Path | None, shared_option("out", "runs/estimate_CASE")] = None
    figures: Figures = "png"
    cache: Cache = True


# Substeps of the truth in a step of the filter.
_FINER = 4
_RATE = Number("rate", "Hz", above=0.0, high=1e6)
_SIZE = Number("standard deviation", "", above=0.0, high=1e6)


@dataclasses.dataclass
class EstimateSettings(PointSettings):
    """Options of a filter on a model's sensors."""

    sensors: Annotated[tuple[str, ...], default_text("all of the file")] = ()
    """Sensors whose readings the filter has."""
    t1: Annotated[
        float | None, Number("end", "s", above=0.0, high=1e4), shared_option("t1", "the file's")
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
    out: Annotated[Path | None, shared_option("out", "runs/estimate_MODEL")] = None


MODEL_ABOUT = """Estimate the motion of a model from the sensors of its file, over many seeds; write estimate.npz.

Example: stmuav estimate model.toml --seeds 50 --sensors angle. The truth is the simulator's, with finer steps,
with random starts and random changes of the velocities. The model's file has a table [sensors] (docs/models.md).
Exit codes: 0 consistent, 1 a filter lost its covariance, 2 wrong input, 3 the filter is inconsistent. Without a
model's file: the report's eight cases, stmuav estimate --help.
"""

estimate_options = command_or_scene(Estimate, "EstimateModel", EstimateSettings, MODEL_ABOUT)


def run_estimate(command: Any) -> int:
    """Run the command and print its table; return the exit code."""
    return _run_cases(command) if isinstance(command, Estimate) else _run_model(command)


def _run_cases(command: Estimate) -> int:
    """Estimate in the report's cases."""
    from ..figures.estimate import CASE_FIGURES, labelled_case, summary_table, verdict_lines
    from ..figures.plot import save_figures
    from ..io.netcdf import load_parameters, save_labelled
    from ..uav.quadrotor.assessment import consistent_tuning, report_tuning, study_case
    from ..uav.quadrotor.model import PART_III

    table = load_parameters(command.params, PART_III)
    # The filter's model may differ from the truth, as it always does in practice.
    filter_table = load_parameters(command.filter_params, table)
    names = ("report", "consistent") if command.tuning == "both" else (command.tuning,)
    cases = range(1, 9) if command.case is None else (command.case,)
    kinds: dict[str, Any] = {"report": "report", "consistent": "observable"}
    if command.model != "default":
        kinds = dict.fromkeys(kinds, command.model)
    tunings: dict[Any, Any] = {}
    summaries, paths = [], []
    for case in cases:
        # one tuning is compiled once for all cases that share it
        keys = [(name, name == "consistent" and case > 4) for name in names]
        for name, _ in (key for key in keys if key not in tunings):
            tunings[name, name == "consistent" and case > 4] = (
                report_tuning(kinds[name], parameters=filter_table)
                if name == "report"
                else consistent_tuning(case, kinds[name], parameters=filter_table)
            )
        study = study_case(
            case, [tunings[key] for key in keys], seeds=command.seeds, t1=command.t1,
            seed=command.seed, parameters=table,
        )  # fmt: skip
        summaries += study.summaries.values()
        folder = results_folder(command.out, f"estimate_{case}")
        if command.out is not None and len(cases) > 1:
            folder = command.out / f"case_{case}"
        paths.append(save_labelled(labelled_case(study), folder / "estimate.nc"))
        if command.figures != "none":
            paths += save_figures(CASE_FIGURES, folder, command.figures, study)
    verdicts = {f"Case {s.case}, {s.tuning} tuning": s.verdict for s in summaries}
    out = Console()
    out.print(summary_table(summaries))
    for line in verdict_lines(verdicts):
        out.print(line, highlight=False, markup=False)
    print_paths(out, paths)
    failed = sum(result.failed for result in verdicts.values())
    if failed:
        out.print(f"{failed} filters lost their covariance and are left out.", highlight=False)
        return 1
    return UNTRUSTED if any(result.status == "inconsistent" for result in verdicts.values()) else 0


# --- a filter on a model's sensors


def _run_model(command: Any) -> int:
    """Run the filters, print their errors and consistency, write estimate.npz; the exit code."""
    from ..figures.filter_record import end_consistency, record_content
    from ..io.netcdf import write_atomically

    scene, settings = chosen_scene(command), command.settings
    instruments = _choose_instruments(scene, settings.sensors)
    space, x = starting_point(scene, settings)
    first = _start_deviations(space, settings)
    record = _estimate_records(scene, space, x, first, instruments, settings)
    heads = ("state", "at the start", "error at the end", "the filter's deviation", "unit")
    state_table = make_table(*heads)
    error, deviation = (
        np.sqrt(np.mean(record[name][-1] ** 2, axis=-1)) for name in ("error", "deviation")
    )
    for (name, unit), *numbers in zip(space.names, first, error, deviation, strict=True):
        add_row(state_table, name, *(f"{number:.3g}" for number in numbers), unit)
    out = Console()
    out.print(state_table)
    verdicts = end_consistency(record["nees"], space.size, record["nis"], record["degrees"])
    for verdict in verdicts:
        print_line(out, verdict.explanation)
    folder = results_folder(settings.out, f"estimate_{scene.name}")
    about = {"scene": command.scene} | {
        name: str(value) if isinstance(value, Path) else value
        for name, value in vars(settings).items()
        if name not in ("out", "cache") and value not in (None, ())
    }
    content = record_content(scene.title or scene.name, space.names, record, about)
    print_paths(out, [write_atomically(folder / "estimate.npz", content)])
    lost = int(np.sum(~record["ok"]))
    if lost:
        print_line(out, f"{lost} filters lost their covariance.")
        return 1
    return 0 if all(verdict.holds for verdict in verdicts) else UNTRUSTED


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
    from ..dynamics.statespace.base import places_of

    deviation_by_name = scalars_by_name(settings.start_deviations, "--start-deviations")
    result = np.full(space.size, settings.start_deviation)
    result[list(places_of(space, list(deviation_by_name), "The start deviations"))] = list(
        deviation_by_name.values()
    )
    if not np.all(result > 0):
        raise SettingError("The standard deviations of --start-deviations must be positive.")
    return result


def _estimate_records(
    scene: "Scene", space: "TreeSpace", x: Any, deviations: np.ndarray, instruments: Sequence[Any],
    settings: Any,
) -> dict[str, np.ndarray]:  # fmt: skip
    """Filters on simulated records, one for each of s seeds, as arrays by name.

    t: times (T,) [s]. error, deviation: estimates less truth, and the filters' standard deviations
    (T, n, s). nees, nis: normalised errors and innovations squared (T, s). degrees: components that a time's
    readings have (T,). ok: flags of the filters (s,). innovation: normalised innovations, NaN where a
    reading is missing (T, m, s).
    """
    import jax
    import jax.numpy as jnp

    from ..analysis.sensors import AttitudeFix, system_model
    from ..estimation.consistency import path_nees
    from ..estimation.filter import filter_bank
    from ..estimation.gaussians import gaussian
    from ..figures.filter_record import normalised_innovations
    from ..math.compiler import quick_jit

    rates = [instrument.rate for instrument in instruments if instrument.rate is not None]
    rate = settings.rate or max(rates, default=100.0)
    t1 = scene.t1 - scene.t0 if settings.t1 is None else settings.t1
    steps = max(round(t1 * rate), 1)
    sensors = [instrument.sensor for instrument in instruments]
    sizes = [len(sensor.components(space.system)) for sensor in sensors]
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
    s, rng = settings.seeds, np.random.default_rng(settings.seed)
    normal_sample = lambda deviations, *shape: jnp.asarray(
        deviations[:, None] * rng.standard_normal((*shape, len(deviations), s))
    )
    first = space.retract(jax.tree.map(lambda a: a[:, None], x), normal_sample(deviations))

    def next_sample(now: Any, w: Any) -> Any:
        now = truth_model.space.retract(truth_model(now, None, 1.0 / rate), w)
        return now, (now, truth_model.sensor(now, None))

    fly = quick_jit(lambda start, w: jax.lax.scan(next_sample, start, w)[1])
    truth, true_readings = fly(first, normal_sample(wander, steps))
    errors = normal_sample(noise, steps) + bias[:, None]
    y = np.array(jax.vmap(truth_model.sensor.space.retract)(true_readings, errors))
    degrees, column = np.zeros(steps, int), 0
    for instrument, size in zip(instruments, sizes, strict=True):
        # an attitude has four numbers, with errors in three components
        length = 4 if isinstance(instrument.sensor, AttitudeFix) else size
        is_fresh = np.arange(1, steps + 1) % instrument.periods(rate) == 0
        y[~is_fresh, column : column + length] = np.nan
        degrees += size * is_fresh
        column += length
    out = filter_bank(model, gaussian(x, np.diag(deviations**2)), jnp.asarray(y), dt=1.0 / rate)
    record = {
        "t": scene.t0 + np.arange(1, steps + 1) / rate,
        "error": jax.vmap(space.difference)(out.mean, truth),
        "deviation": out.standard_deviation,
        "nees": path_nees(out, truth, space),
        "nis": out.nis,
        "degrees": degrees,
        "ok": out.ok[-1],
        "innovation": normalised_innovations(out.innovations),
    }
    return {name: np.asarray(array) for name, array in record.items()}
