"""Command `stmuav montecarlo`: Monte Carlo studies and their reports."""

import dataclasses
import os
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from .options import SEED, Cache, Figures, Resume, count, default, shared
from .output import results_folder, written

if TYPE_CHECKING:
    from ..jobs.progress import Outcome


@dataclasses.dataclass
class Montecarlo:
    """Fly a study: a TOML file, or the name of a ready one; write a store and a report.

    Example: stmuav montecarlo collapse --samples 256; stmuav montecarlo study.toml --resume --figures none. The ready
    studies are collapse, hover, case_1 to case_3 and estimate_1 to estimate_8. With --figures none there is no report.
    """

    study: tyro.conf.Positional[str]
    """TOML file (docs/studies.md), or the name of a ready study."""
    samples: Annotated[int | None, count("samples", 1e9), default("the study's")] = None
    """Number of samples. A larger number extends a finished store."""
    seed: Annotated[int | None, SEED, shared("seed"), default("the study's")] = None
    resume: Resume = False
    chunk: Annotated[
        int | None, count("samples written together", 1e9), default("some seconds' worth")
    ] = None
    """Number of samples that are written together."""
    devices: Annotated[int | None, count("devices", 256), default("all")] = None
    """Number of cores or GPUs to use; no result depends on it."""
    lanes: Annotated[int | None, count("lanes", 1e6), default("16")] = None
    """Number of flights that a device computes together, a multiple of 8; part of the study."""
    scheduler: Annotated[str | None, default("none")] = None
    """Address of a Dask scheduler, such as tcp://10.0.0.1:8786."""
    workers: Annotated[int | None, count("workers", 256), default("none")] = None
    """Number of processes of a Dask cluster that is started here."""
    params: Annotated[Path | None, shared("params"), default("the scene's table")] = None
    out: Annotated[Path | None, shared("out"), default("runs/STUDY")] = None
    figures: Figures = "png"
    cache: Cache = True


def cores() -> int:
    """Number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def plain_of(command: Montecarlo) -> dict[str, Any]:
    """Plain data of the study, with the changes by the options."""
    from ..files.study_file import load_study
    from ..montecarlo.examples import READY, ready

    if command.study in READY:
        plain = ready(command.study)
    elif command.study.endswith(".toml") or os.sep in command.study:
        plain = load_study(command.study)
    else:
        plain = ready(command.study)
    if command.seed is not None:
        plain["seed"] = command.seed
    return plain


def _table(command: Montecarlo, plain: Mapping[str, Any]) -> Any:
    from ..files.netcdf import load_parameters
    from ..scenes.registry import SCENES

    if command.params is None:
        return None
    if plain.get("scene") not in SCENES:
        raise SettingError("--params replaces values of a scene's table; this study has no scene.")
    return load_parameters(command.params, SCENES[plain["scene"]].parameters)


def _options(command: Montecarlo, plain: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the `FlightWork` of a study of motions; none for other studies."""
    if plain.get("kind", "flights") != "flights":
        return {}
    import jax

    here = command.scheduler is None and command.workers is None
    devices = command.devices
    if devices is None and here and jax.default_backend() == "cpu":
        devices = cores()
    return {"lanes": command.lanes, "devices": devices}


def _work(command: Montecarlo) -> tuple[Any, dict[str, Any]]:
    """Work of the study and its plain data; errors name the file."""
    from ..montecarlo.examples import READY, make_work

    plain = plain_of(command)
    try:
        if plain.get("kind") == "missions":
            return _missions(command, plain), plain
        return make_work(plain, _table(command, plain), **_options(command, plain)), plain
    except SettingError as error:
        if command.study in READY:
            raise
        raise SettingError(f"{command.study}: {error}") from None


def _missions(command: Montecarlo, plain: Mapping[str, Any]) -> Any:
    """Work of a study of a mission."""
    from ..missions.ensemble import mission_work

    for name in ("lanes", "devices", "params"):
        if getattr(command, name) is not None:
            raise SettingError(
                f"A study of a mission has no --{name}: its flights go side by side in sixteens, with the "
                "parameters of the mission's file."
            )
    return mission_work(plain, Path(command.study).parent)


def run_montecarlo(command: Montecarlo) -> int:
    """Run the command; return the exit code."""
    if command.scheduler is not None and command.workers is not None:
        raise SettingError("Give --scheduler or --workers, not both.")
    from ..jobs.stop import stoppable
    from ..montecarlo.schema import check_count

    for name in ("samples", "chunk", "workers"):
        if (value := getattr(command, name)) is not None:
            check_count(value, f"--{name}")
    with stoppable():
        work, plain = _work(command)
        total = plain.get("samples", 1024) if command.samples is None else command.samples
        folder = results_folder(command.out, str(plain["name"]))
        chunk = plain.get("chunk") if command.chunk is None else command.chunk
        outcome = _carried_out(command, work, folder / "study.zarr", total, chunk)
    out = Console()
    out.print(outcome.words(), highlight=False, markup=False, emoji=False)
    paths = [folder / "study.zarr"]
    if command.figures != "none" or not outcome.interrupted:
        paths += report_study(folder / "study.zarr", folder, command.figures, out)
    written(out, paths)
    return 130 if outcome.interrupted else 0


def _carried_out(
    command: Montecarlo, work: Any, store: Path, total: int, chunk: int | None
) -> "Outcome":
    """Compute the missing samples of the store, here or on a cluster."""
    from ..jobs.cluster import run_on_cluster
    from ..jobs.local import run_study
    from ..jobs.watch import Watch

    settings: dict[str, Any] = {"chunk": chunk, "resume": command.resume}
    with Watch("flights") as watch:
        if command.scheduler is None and command.workers is None:
            return run_study(work, store, total, progress=watch, **settings)
        return run_on_cluster(
            work, store, total, scheduler=command.scheduler, workers=command.workers,
            progress=watch, **settings,
        )  # fmt: skip


def report_study(store: Path, folder: Path, figures: Any, out: Console) -> list[Path]:
    """Verify the store, write its report unless there are to be no figures, and print a summary."""
    from ..figures.studies.analysis import analyse
    from ..figures.studies.data import study_data
    from ..figures.studies.table import summary_lines, summary_table
    from ..files.store import open_store

    with open_store(store) as opened:
        opened.verify()
        dataset = opened.dataset()
        analysis = analyse(study_data(dataset))
        paths = []
        if figures != "none":
            from ..figures.studies.report import write_report

            paths = write_report(dataset, folder, figures, analysis=analysis)
    out.print(summary_table(analysis), markup=False, emoji=False)
    for line in summary_lines(analysis):
        out.print(line, highlight=False, markup=False, emoji=False)
    return paths
