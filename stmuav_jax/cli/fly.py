"""Command `stmuav fly`: a closed-loop flight from a mission's file, with its verdict."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from ..checks.errors import SimulationError
from ..figures.terminal import add_row, make_table, print_line
from .options import END, Cache, Figures, default_text, shared_option
from .output import INTERRUPTED, print_paths, results_folder, show_progress


@dataclasses.dataclass
class Fly:
    """Fly a mission under control; write flight.nc and figures.

    A mission is a TOML file (docs/control_and_missions.md) or built in: hover, case-1 to case-3,
    sun-slew, sun-day, waypoints, wind-step, gusts, rotor-weak, rotor-lost, rotor-lost-known,
    slider-jammed, slew-30, battery, takeoff-and-land.
    Example: stmuav fly case-1 --t1 5. Exit code: 0 all tolerances and limits were met; 1 the flight
    failed; 2 wrong input; 3 a tolerance or a limit was exceeded."""

    mission: tyro.conf.Positional[str]
    """TOML file, or the name of a built-in mission."""
    t1: Annotated[float | None, END, shared_option("t1", "the mission's")] = None
    true_states: bool = False
    """Give the controller the true states in place of estimates from the mission's sensors."""
    truth: Annotated[tuple[str, ...], default_text("the mission's")] = ()
    """True parameters that differ from the controller's model, such as bare.mass=2.9; names as in studies."""
    log: bool = False
    """Also write log.csv, the readings and commands of the flight, which `identify` reads."""
    out: Annotated[Path | None, shared_option("out", "runs/MISSION")] = None
    figures: Figures = "png"
    cache: Cache = True


# Exit code of a flight that exceeded a tolerance or a limit.
NOT_KEPT = 3


def run_fly(command: Fly) -> int:
    """Run the command; return the exit code."""
    from ..io.netcdf import save_sealed
    from ..missions.flight import fly
    from ..missions.mission import load_mission
    from ..missions.outcome import labelled_flight, measures, verdict
    from .mechanism import scalars_by_name

    # All checks of a mission happen here, before the compilation.
    mission = load_mission(
        command.mission, t1=command.t1, true_states=command.true_states,
        truth=scalars_by_name(command.truth, "--truth"),
    )  # fmt: skip
    folder = results_folder(command.out, mission.file.name)
    name, end = mission.file.name, mission.file.t1
    with show_progress(f"{name}: compiling") as report:
        tell = lambda share: report(share, f"{name}: {share * end:.0f} s of {end:g} s")
        flight = fly(mission, progress=tell)
    arrays = labelled_flight(flight)
    data, paths = arrays.dataset(), [save_sealed(arrays, folder / "flight.nc")]
    if command.log:
        from ..io.flight_log import save_flight_record
        from ..missions.outcome import to_flight_record

        paths.append(save_flight_record(to_flight_record(flight), folder / "log.csv"))
    if command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.plot import save_figures
        from ..missions.figures import flight_figures

        paths += save_figures(flight_figures(data), folder, command.figures)
    table = make_table("quantity", "value", "allowed", title=data.attrs["title"] or None)
    for measure in measures(data):
        allowed = "-" if measure.allowed is None else f"{measure.allowed:g}"
        mark = "" if measure.is_met else "  (not met)"
        add_row(table, measure.name, measure.text, f"{allowed}{mark}")
    for truth, value in mission.file.truth.items():
        unit = mission.table[truth.partition("[")[0]].unit
        add_row(table, f"True {truth}, unknown to the controller", f"{value:.6g} {unit}", "-")
    certificate = flight.run.certificate
    seconds = f"{certificate.compile_seconds:.1f} s, {certificate.run_seconds:.1f} s"
    violation = f"{certificate.position_violation:.2g} m"
    add_row(table, "Constraint violation, lengths", violation, "-")
    add_row(table, "Time to compile, to run", seconds, "-")
    out = Console()
    out.print(table)
    if flight.ending == "interrupted":
        print_line(out, f"Interrupted at t = {certificate.t_end:g} s.")
    print_paths(out, paths)
    if flight.ending == "interrupted":
        return INTERRUPTED
    is_success, sentence = verdict(data)
    print_line(out, sentence)
    if flight.ending == "failed":
        raise SimulationError(f"{flight.run.failure} Results up to there are in {folder}.")
    # A script tells a flight that failed its aims from one that could not be computed.
    return 0 if is_success else NOT_KEPT
