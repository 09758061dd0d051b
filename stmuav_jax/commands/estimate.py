"""Command `stmuav estimate`: the report's eight cases of estimation, and the hover."""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.table import Table

from .models.estimation import ABOUT, UNTRUSTED, EstimateSettings, run_estimate_model
from .options import END, Cache, Figures, Number, Seed, count, default, shared
from .output import results_folder, written
from .simulate import command_or_scene


@dataclasses.dataclass
class Estimate:
    """Estimate the centre of mass in the report's cases; write NetCDF files and figures.

    Example: stmuav estimate --case 4 --seeds 20; stmuav estimate --hover. The motion of a mechanism with sensors is
    estimated by `stmuav estimate model.toml`; `stmuav estimate model.toml --help` describes that.

    Exit code: 0 all filters are consistent with their innovations; 1 a filter lost its covariance;
    2 wrong input; 3 done, but a filter's own account of its errors cannot be trusted. The report's
    tuning is of this kind in all eight cases."""

    case: Annotated[
        int | None, Number("number of the case", "", 1, 8), shared("case"), default("all 8")
    ] = None
    tuning: Literal["both", "report", "consistent"] = "both"
    """Covariances of Table 2.4.2 of the report, consistent ones, or both for comparison."""
    model: Literal["default", "observable", "report", "printed", "attitude"] = "default"
    """States of the filter: 5 observable ones; the report's 8, corrected or as printed; 8 with an attitude in SO(3).
    By default the report's tuning has the report's states and the consistent tuning the observable ones."""
    hover: bool = False
    """Fly a hover, whose controller sees only the estimate, in place of the cases."""
    seeds: Annotated[int, count("runs", 100_000), shared("seeds")] = 50
    seed: Seed = 0
    t1: Annotated[float, END, shared("t1")] = 2.0
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    filter_params: Annotated[Path | None, default("the values of --params")] = None
    """TOML file with values for the filters alone, to try a wrong model; --params is for truth and filters alike."""
    out: Annotated[Path | None, shared("out"), default("runs/estimate_CASE or runs/hover")] = None
    figures: Figures = "png"
    cache: Cache = True


estimate_options = command_or_scene(Estimate, "EstimateModel", EstimateSettings, ABOUT)


def run_estimate(command: Any) -> int:
    """Run the command and print its table; return the exit code."""
    if not isinstance(command, Estimate):
        return run_estimate_model(command)
    from ..checks.errors import SettingError
    from ..figures.estimate import verdict_lines
    from ..files.netcdf import load_parameters
    from ..quadrotor.model import PART_III

    if command.case is not None and command.case not in range(1, 9):
        raise SettingError(f"The report has cases 1 to 8, not {command.case}.")
    if command.case is None and not command.hover:
        from ..algebra.native import use_native_loops

        # eight cases filter for longer than their loops take to compile; where JAX has started
        # already, as in a program that calls this one, they run as they are
        with contextlib.suppress(SettingError):
            use_native_loops()
    table = load_parameters(command.params, PART_III)
    names = ("report", "consistent") if command.tuning == "both" else (command.tuning,)
    work = _hover if command.hover else _cases
    believed = load_parameters(command.filter_params, table)
    shown, paths, verdicts = work(command, names, table, believed)
    out = Console()
    out.print(shown)
    for line in verdict_lines(verdicts):
        out.print(line, highlight=False, markup=False)
    written(out, paths)
    failed = sum(found.failed for found in verdicts.values())
    if failed:
        out.print(f"{failed} filters lost their covariance and are left out.", highlight=False)
        return 1
    return UNTRUSTED if any(found.status == "inconsistent" for found in verdicts.values()) else 0


def _cases(
    command: Estimate, names: tuple, table: Any, believed: Any
) -> tuple[Table, list[Path], dict[str, Any]]:
    from ..figures.estimate import CASE_FIGURES, labelled_case, summary_table
    from ..figures.plot import save_figures
    from ..files.netcdf import save_labelled
    from ..quadrotor.assess import study_case
    from ..quadrotor.tuning import consistent_tuning, report_tuning

    cases = range(1, 9) if command.case is None else (command.case,)
    own: Any = command.model != "default"
    kinds: dict[str, Any] = {
        "report": command.model if own else "report",
        "consistent": command.model if own else "observable",
    }
    made: dict[Any, Any] = {}
    summaries, paths = [], []
    for case in cases:
        tunings = []
        for name in names:
            # one tuning is compiled once for all cases that share it
            key = name, name == "consistent" and case > 4
            if key not in made:
                kind = kinds[name]
                made[key] = (
                    report_tuning(kind, parameters=believed)
                    if name == "report"
                    else consistent_tuning(case, kind, parameters=believed)
                )
            tunings.append(made[key])
        study = study_case(
            case, tunings, seeds=command.seeds, t1=command.t1, seed=command.seed, parameters=table
        )
        summaries += study.summaries.values()
        folder = Path("runs") / f"estimate_{case}"
        if command.out is not None:
            folder = command.out if len(cases) == 1 else command.out / f"case_{case}"
        paths.append(save_labelled(labelled_case(study), folder / "estimate.nc"))
        if command.figures != "none":
            paths += save_figures(CASE_FIGURES, folder, command.figures, study)
    verdicts = {f"Case {s.case}, {s.tuning} tuning": s.verdict for s in summaries}
    return summary_table(summaries), paths, verdicts


def _hover(
    command: Estimate, names: tuple, table: Any, believed: Any
) -> tuple[Table, list[Path], dict[str, Any]]:
    from ..checks.errors import SettingError
    from ..figures.estimate import hover, hover_table, labelled_hover
    from ..figures.plot import save_figures
    from ..files.netcdf import save_labelled
    from ..quadrotor.hover import simulate_hover

    if command.model != "default":
        raise SettingError("--hover has a model of its own (14 states): leave --model out.")
    if command.filter_params is not None:
        raise SettingError("--hover flies with one table: leave --filter-params out.")
    flights = {
        name: simulate_hover(
            command.case or 1, name, seeds=command.seeds, t1=command.t1, seed=command.seed,
            parameters=table,
        )
        for name in names
    }  # fmt: skip
    folder = results_folder(command.out, "hover")
    paths = [save_labelled(labelled_hover(flights), folder / "hover.nc")]
    if command.figures != "none":
        paths += save_figures({"hover": hover}, folder, command.figures, flights)
    verdicts = {f"Hover, {name} tuning": flight.verdict() for name, flight in flights.items()}
    return hover_table(flights), paths, verdicts
