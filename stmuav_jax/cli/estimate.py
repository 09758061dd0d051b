"""Command `stmuav estimate`: the report's eight cases of estimation."""

import dataclasses
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.table import Table

from .models.estimation import ABOUT, UNTRUSTED, EstimateSettings, run_estimate_model
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
from .output import print_paths
from .scene_options import command_or_scene

_CASE = Number("number of the case", "", 1, 8)


@dataclasses.dataclass
class Estimate:
    """Estimate the centre of mass in the report's cases; write NetCDF files and figures.

    Example: stmuav estimate --case 4 --seeds 20. The motion of a mechanism with sensors is
    estimated by `stmuav estimate model.toml`; `stmuav estimate model.toml --help` describes that.

    Exit code: 0 all filters are consistent with their innovations; 1 a filter lost its covariance;
    2 wrong input; 3 a filter is inconsistent, as with the report's tuning in all eight cases."""

    case: Annotated[int | None, _CASE, shared_option("case"), default_text("all 8")] = None
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
    out: Annotated[Path | None, shared_option("out"), default_text("runs/estimate_CASE")] = None
    figures: Figures = "png"
    cache: Cache = True


estimate_options = command_or_scene(Estimate, "EstimateModel", EstimateSettings, ABOUT)


def run_estimate(command: Any) -> int:
    """Run the command and print its table; return the exit code."""
    if not isinstance(command, Estimate):
        return run_estimate_model(command)
    from ..figures.estimate import verdict_lines
    from ..io.netcdf import load_parameters
    from ..uav.quadrotor.model import PART_III

    table = load_parameters(command.params, PART_III)
    names = ("report", "consistent") if command.tuning == "both" else (command.tuning,)
    # The filter's model may differ from the truth, as it always does in practice.
    filter_table = load_parameters(command.filter_params, table)
    case_table, paths, verdicts = _estimate_cases(command, names, table, filter_table)
    out = Console()
    out.print(case_table)
    for line in verdict_lines(verdicts):
        out.print(line, highlight=False, markup=False)
    print_paths(out, paths)
    failed = sum(result.failed for result in verdicts.values())
    if failed:
        out.print(f"{failed} filters lost their covariance and are left out.", highlight=False)
        return 1
    return UNTRUSTED if any(result.status == "inconsistent" for result in verdicts.values()) else 0


def _estimate_cases(
    command: Estimate, names: tuple, table: Any, filter_table: Any
) -> tuple[Table, list[Path], dict[str, Any]]:
    from ..figures.estimate import CASE_FIGURES, labelled_case, summary_table
    from ..figures.plot import save_figures
    from ..io.netcdf import save_labelled
    from ..uav.quadrotor.assessment import consistent_tuning, report_tuning, study_case

    cases = range(1, 9) if command.case is None else (command.case,)
    kinds: dict[str, Any] = {"report": "report", "consistent": "observable"}
    if command.model != "default":
        kinds = dict.fromkeys(kinds, command.model)
    tuning_by_key: dict[Any, Any] = {}
    summaries, paths = [], []
    for case in cases:
        tunings = []
        for name in names:
            # one tuning is compiled once for all cases that share it
            key = name, name == "consistent" and case > 4
            if key not in tuning_by_key:
                kind = kinds[name]
                tuning_by_key[key] = (
                    report_tuning(kind, parameters=filter_table)
                    if name == "report"
                    else consistent_tuning(case, kind, parameters=filter_table)
                )
            tunings.append(tuning_by_key[key])
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
