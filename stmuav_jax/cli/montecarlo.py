"""Command `stmuav montecarlo`: Monte Carlo studies, their summaries and figures."""

import dataclasses
import os
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import print_line
from .options import SEED, Cache, Figures, Resume, count_range, default_text, shared_option
from .output import INTERRUPTED, print_paths, results_folder, show_progress

if TYPE_CHECKING:
    from ..studies.study import Study, StudyOutcome, StudyProgress


@dataclasses.dataclass
class Montecarlo:
    """Run a study: a TOML file, or the name of a built-in one; write a store, a summary and figures.

    Example: stmuav montecarlo collapse --samples 256; stmuav montecarlo study.toml --resume --figures none. Built-in
    studies are collapse, hover, case_1 to case_3 and estimate_1 to estimate_8. With --figures none only the store is
    written.
    """

    study: tyro.conf.Positional[str]
    """TOML file (docs/studies.md), or the name of a built-in study."""
    samples: Annotated[int | None, count_range("samples", 1e9), default_text("the study's")] = None
    """Number of samples. A larger number extends a finished store."""
    seed: Annotated[int | None, SEED, shared_option("seed", "the study's")] = None
    resume: Resume = False
    chunk: Annotated[
        int | None,
        count_range("samples written together", 1e9),
        default_text("some seconds' worth"),
    ] = None
    """Number of samples that are written together."""
    devices: Annotated[int | None, count_range("devices", 256), default_text("all")] = None
    """Number of cores or GPUs to use; no result depends on it."""
    lanes: Annotated[int | None, count_range("lanes", 1e6), default_text("16")] = None
    """Number of flights that a device computes together, a multiple of 8; part of the study."""
    scheduler: Annotated[str | None, default_text("none")] = None
    """Address of a Dask scheduler, such as tcp://10.0.0.1:8786."""
    workers: Annotated[int | None, count_range("workers", 256), default_text("none")] = None
    """Number of processes of a Dask cluster that is started here."""
    params: Annotated[Path | None, shared_option("params", "the scene's table")] = None
    out: Annotated[Path | None, shared_option("out", "runs/STUDY")] = None
    figures: Figures = "png"
    cache: Cache = True


def _make_study(command: Montecarlo) -> "Study":
    """Study of the command; errors name the file."""
    import jax

    from ..io.netcdf import load_parameters
    from ..studies.examples import READY, load_builtin_study
    from ..studies.study_file import load_study, make_study
    from ..uav.scenes.registry import SCENES

    is_file = command.study.endswith(".toml") or os.sep in command.study
    plain = load_study(command.study) if is_file else load_builtin_study(command.study)
    if command.seed is not None:
        plain["seed"] = command.seed
    devices = command.devices
    if command.scheduler is None and command.workers is None and jax.default_backend() == "cpu":
        # All cores of a CPU, unless a cluster's workers choose for themselves.
        has_affinity = hasattr(os, "sched_getaffinity")
        cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count()
        devices = devices or cores or 1
    settings = {"lanes": command.lanes, "devices": devices}
    try:
        if plain.get("kind") == "missions":
            from ..missions.ensemble import load_mission_study

            if command.params is not None:
                raise SettingError(
                    "A study of a mission has no --params: its file has the parameters."
                )
            return load_mission_study(plain, Path(command.study).parent, **settings)
        table = None
        if command.params is not None:
            if plain.get("scene") not in SCENES:
                raise SettingError(
                    "--params replaces values of a scene's table; this study has no scene."
                )
            table = load_parameters(command.params, SCENES[plain["scene"]].parameters)
        return make_study(plain, table, **settings)
    # A message about an entry helps only with the file's name.
    except SettingError as error:
        if command.study in READY:
            raise
        raise SettingError(f"{command.study}: {error}") from None


def run_montecarlo(command: Montecarlo) -> int:
    """Run the command; return the exit code."""
    if command.scheduler is not None and command.workers is not None:
        raise SettingError(
            "The options --scheduler and --workers exclude each other: give one of them."
        )
    from ..studies.schema import check_count

    for name in ("samples", "chunk", "workers"):
        if (value := getattr(command, name)) is not None:
            check_count(value, f"--{name}")
    study = _make_study(command)
    folder = results_folder(command.out, study.name)
    outcome = _run_with_progress(command, study, folder / "study.zarr")
    out, paths = Console(), [folder / "study.zarr"]
    print_line(out, outcome.describe())
    if command.figures != "none" or not outcome.interrupted:
        from ..figures.study_data import (
            analyse,
            save_summary,
            study_data,
            summary_lines,
            summary_table,
        )
        from ..studies.store import open_store

        with open_store(folder / "study.zarr") as store:
            # A summary of damaged data would look like any other.
            store.verify()
            data = study_data(store.dataset())
            analysis = analyse(data)
            if command.figures != "none":
                from ..figures.plot import save_figures
                from ..figures.study import study_figures

                paths.append(save_summary(data, analysis, folder / "summary.json"))
                figures = {name: figure for name, _, figure in study_figures(data, analysis)}
                paths += save_figures(figures, folder / "figures", command.figures, dpi=160)
        out.print(summary_table(analysis), markup=False, emoji=False)
        for line in summary_lines(analysis):
            print_line(out, line)
    print_paths(out, paths)
    return INTERRUPTED if outcome.interrupted else 0


def _run_with_progress(command: Montecarlo, study: "Study", store: Path) -> "StudyOutcome":
    """Compute the missing samples of the store, with a progress bar on stderr."""
    with show_progress("samples") as report:

        def show_state(progress: "StudyProgress") -> None:
            if progress.note:
                print_line(Console(stderr=True), progress.note)
            else:
                completed, total = progress.completed, progress.total
                report(completed / total, f"{completed:,} of {total:,} samples")

        return study.run(
            store, command.samples, chunk=command.chunk, resume=command.resume, progress=show_state,
            scheduler=command.scheduler, workers=command.workers,
        )  # fmt: skip
