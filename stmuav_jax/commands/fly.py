"""Command `stmuav fly`: a closed-loop flight from a mission's file, with its verdict."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro
from rich.console import Console

from ..checks.errors import SettingError, SimulationError
from ..figures.terminal import line, row, table
from .options import END, Cache, Figures, Resume, default, shared
from .output import results_folder, written

if TYPE_CHECKING:
    from ..missions.flight import MissionFlight
    from ..missions.mission import Mission


@dataclasses.dataclass
class Fly:
    """Fly a mission under control; write flight.nc and figures.

    A mission is a TOML file (docs/missions.md) or a ready one: hover, case-1 to case-3,
    sun-slew, sun-day, waypoints, wind-step, gusts, rotor-weak, rotor-lost, rotor-lost-known,
    slider-jammed, slew-30, battery, takeoff-and-land.
    Example: stmuav fly case-1 --t1 5. Exit code: 0 all tolerances and limits were kept; 1 the flight
    failed; 2 wrong input; 3 flown, but not as the mission asks."""

    mission: tyro.conf.Positional[str]
    """TOML file, or the name of a ready mission."""
    t1: Annotated[float | None, END, shared("t1"), default("the mission's")] = None
    true_states: bool = False
    """Give the controller the true states in place of estimates from the mission's sensors."""
    native_loops: bool = False
    """Compile the flight into one native function, which takes longer to compile and flies faster."""
    resume: Resume = False
    out: Annotated[Path | None, shared("out"), default("runs/MISSION")] = None
    figures: Figures = "png"
    cache: Cache = True


# Exit code of a flight that was flown, but not as the mission asks.
NOT_KEPT = 3
UNFINISHED = "unfinished.npz"
# Seconds of computing after which an unfinished flight is saved again.
SAVED_EVERY = 20.0


def run_fly(command: Fly) -> int:
    """Run the command; return the exit code."""
    if command.native_loops:
        # before anything else: JAX reads the option only once
        from ..algebra.native import use_native_loops

        use_native_loops()
    from ..files.netcdf import save_sealed
    from ..missions.mission import load_mission
    from ..missions.outcome import labelled_flight, verdict

    mission = load_mission(command.mission, t1=command.t1, true_states=command.true_states)
    folder = results_folder(command.out, mission.file.name)
    flight = _flown(command, mission, folder / UNFINISHED)
    arrays = labelled_flight(flight)
    data, paths = arrays.dataset(), [save_sealed(arrays, folder / "flight.nc")]
    if command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.plot import save_figures
        from ..missions.figures import flight_figures

        paths += save_figures(flight_figures(data), folder, command.figures)
    out = Console()
    _print(out, data, flight)
    if flight.ending == "interrupted":
        line(out, f"Interrupted at t = {flight.run.certificate.t_end:g} s; --resume goes on.")
        written(out, [*paths, folder / UNFINISHED])
        return 130
    written(out, paths)
    if flight.ending == "failed":
        raise SimulationError(f"{flight.run.failure} What was flown is in {folder}.")
    kept, words = verdict(data)
    line(out, words)
    return 0 if kept else NOT_KEPT


def _flown(command: Fly, mission: "Mission", unfinished: Path) -> "MissionFlight":
    """Flight with a progress bar on stderr; an unfinished one is kept in a file."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    from ..jobs.stop import stoppable
    from ..missions.flight import fly
    from ..missions.keep import Keeping, load_reached

    if unfinished.exists() and not command.resume:
        raise SettingError(
            f"There is an unfinished flight in {unfinished.parent}: continue it (--resume), give "
            f"another folder (--out), or remove {unfinished}."
        )
    reached = load_reached(mission, unfinished) if command.resume else None
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with (
        stoppable() as stop,
        Progress(*columns, console=Console(stderr=True), transient=True) as bar,
    ):
        task = bar.add_task(f"{mission.file.name}: compiling", total=1.0)

        def report(done: float) -> None:
            t = done * mission.file.t1
            words = f"{mission.file.name}: {t:.0f} s of {mission.file.t1:g} s"
            bar.update(task, completed=done, description=words)

        keeping = Keeping(mission, unfinished, SAVED_EVERY)
        flight = fly(mission, reached=reached, progress=report, keep=keeping.keep, heard=stop.heard)
        keeping.end(flight)
    return flight


def _print(out: Console, data: Any, flight: "MissionFlight") -> None:
    from ..missions.outcome import measures

    shown = table("quantity", "value", "allowed", title=data.attrs["title"] or None)
    for one in measures(data):
        allowed = "-" if one.allowed is None else f"{one.allowed:g}"
        mark = "" if one.kept else "  (not kept)"
        row(shown, one.name, f"{one.value:.4g} {one.unit}", f"{allowed}{mark}")
    certificate = flight.run.certificate
    seconds = f"{certificate.compile_seconds:.1f} s, {certificate.run_seconds:.1f} s"
    row(shown, "Constraint violation, lengths", f"{certificate.position_violation:.2g} m", "-")
    row(shown, "Time to compile, to run", seconds, "-")
    out.print(shown)
