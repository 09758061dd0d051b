"""The command line, `stmuav`: list, simulate, sun, trim, linearize, tune, estimate, montecarlo,
report."""

import dataclasses
import math
import os
import sys
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import diffrax
import jax
import numpy as np
import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from .commands.estimate import Estimate, run_estimate
from .commands.flight import Linearize, Trim, run_linearize, run_trim
from .commands.montecarlo import Montecarlo, Report, run_montecarlo, run_report
from .commands.output import written
from .commands.tune import Tune, run_tune
from .dynamics.augmented import Augmented
from .dynamics.rosenbrock import Rodas5P
from .dynamics.run import Run
from .dynamics.scene import Scene
from .dynamics.simulate import simulate
from .dynamics.solvers import kvaerno3, kvaerno5
from .dynamics.stabilisation import Baumgarte, Projection, Unstabilised
from .dynamics.tree import Tree
from .mechanics.errors import ModelError, SettingError, SimulationError, StateError
from .scenes.registry import SCENES, make_scene
from .view.io import FileError, load_parameters, save, save_certificate
from .view.report import certificate_table

SOLVERS = {
    "dopri8": diffrax.Dopri8,
    "tsit5": diffrax.Tsit5,
    "kvaerno3": kvaerno3,
    "kvaerno5": kvaerno5,
    "rodas5p": Rodas5P,
    "auto": lambda: "auto",
}
FORMULATIONS = {
    "tree": Tree(),
    "augmented": Augmented(),
    "augmented-dense": Augmented(solve="dense"),
    "report": Augmented(solve="dense", rows="report"),
}
STABILISATIONS = {"projection": Projection, "baumgarte": Baumgarte, "none": Unstabilised}


@dataclasses.dataclass
class List:
    """List the scenes, their cases and where the report describes them."""


@dataclasses.dataclass
class Simulate:
    """Simulate a scene; write run.nc, certificate.json and figures."""

    scene: tyro.conf.Positional[Literal["spin", "tracker", "hexacopter", "uav_tracker"]]
    """Which scene; see `stmuav list`."""
    case: int | None = None
    """Case of the report; default the scene's first choice."""
    t1: float | None = None
    """End [s]; default the scene's."""
    rtol: float = 1e-8
    """Relative tolerance of a step."""
    atol: float = 1e-8
    """Absolute tolerance of a step [m, m/s, rad/s]."""
    solver: Literal["dopri8", "tsit5", "kvaerno3", "kvaerno5", "rodas5p", "auto"] = "dopri8"
    """Explicit, or implicit for stiff scenes (kvaerno, rodas5p); auto looks at the start."""
    formulation: Literal["tree", "augmented", "augmented-dense", "report"] = "tree"
    """Relative coordinates; or all bodies' by structure, densely, in the report's rows."""
    stabilisation: Literal["projection", "baumgarte", "none"] = "projection"
    """What keeps the constraints from drifting."""
    save_every: float | None = None
    """Spacing of the saved times [s]; default the scene's."""
    max_steps: int = 100_000
    """Steps allowed between two saved times."""
    params: Path | None = None
    """TOML file with values that replace the table's."""
    actuators: Literal["consistent", "printed"] | None = None
    """Couple of the actuators' force pair; uav_tracker only."""
    out: Path | None = None
    """Folder for the results; default runs/SCENE."""
    figures: Literal["png", "pdf", "svg", "none"] = "png"
    """Format of the figures."""
    loads: bool = False
    """Also find the joints' reaction loads, peaks between saved times too; loads.csv, figure."""
    cache: bool = True
    """Keep compiled code in the user's cache folder for the next run."""


@dataclasses.dataclass
class SunDay:
    """Point the panel at the sun for a day; write day.nc and figures."""

    lat: float
    """Latitude, north positive [degrees]."""
    lon: float
    """Longitude, east positive [degrees]."""
    date: str
    """Date at the place, as 2024-03-21."""
    timezone: str | None = None
    """Time zone such as Asia/Phnom_Penh or +07:00; default whole hours by the longitude."""
    altitude: float = 0.0
    """Above sea level [m]."""
    roll: float = 0.0
    """Attitude of the UAV [degrees]: turn about its x axis."""
    pitch: float = 0.0
    """Turn about its y axis [degrees]; positive lowers its x axis."""
    yaw: float = 0.0
    """Its x axis from east towards north [degrees]."""
    attitude: Path | None = None
    """CSV file with a history of the attitude instead: columns t [s], roll, pitch, yaw."""
    step: float = 300.0
    """Time between samples [s]."""
    stroke_step: float = 0.0
    """Smallest step of the linear actuators [m]."""
    attitude_error: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Rotation vector from the true attitude to the one believed, body axes [degrees]."""
    turbidity: float | None = None
    """Linke's turbidity of the air; default the month's mean at the place."""
    params: Path | None = None
    """TOML file with values that replace the table's."""
    out: Path | None = None
    """Folder for the results; default runs/sun_DATE."""
    figures: Literal["png", "pdf", "svg", "none"] = "png"
    """Format of the figures."""
    cache: bool = True
    """Keep compiled code in the user's cache folder for the next run."""


Command = (
    Annotated[List, tyro.conf.subcommand(name="list")]
    | Annotated[Simulate, tyro.conf.subcommand(name="simulate")]
    | Annotated[SunDay, tyro.conf.subcommand(name="sun")]
    | Annotated[Trim, tyro.conf.subcommand(name="trim")]
    | Annotated[Linearize, tyro.conf.subcommand(name="linearize")]
    | Annotated[Tune, tyro.conf.subcommand(name="tune")]
    | Annotated[Estimate, tyro.conf.subcommand(name="estimate")]
    | Annotated[Montecarlo, tyro.conf.subcommand(name="montecarlo")]
    | Annotated[Report, tyro.conf.subcommand(name="report")]
)


def cache_folder() -> Path:
    """Where compiled code is kept: $XDG_CACHE_HOME/stmuav_jax, else ~/.cache/stmuav_jax."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "stmuav_jax"


def _configure(use_cache: bool) -> None:
    jax.config.update("jax_enable_x64", True)
    if use_cache:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def list_scenes(console: Console) -> None:
    """Print the scenes."""
    table = Table("scene", "cases", "what it is", "report", "end [s]")
    for name, entry in SCENES.items():
        cases = ", ".join(map(str, entry.cases)) or "-"
        table.add_row(name, cases, entry.summary, entry.source, f"{make_scene(name).t1:g}")
    console.print(table)


def _scene(command: Simulate) -> Scene:
    entry = SCENES[command.scene]
    table = load_parameters(command.params, entry.parameters)
    options: dict[str, Any] = {}
    if command.actuators is not None:
        if command.scene != "uav_tracker":
            raise SettingError(f"--actuators is for uav_tracker; {command.scene} has no actuators.")
        options["actuators"] = command.actuators
    return make_scene(command.scene, command.case, table, **options)


def run_scene(command: Simulate, console: Console) -> Run:
    """Build and simulate the scene with a progress bar on stderr."""
    scene = _scene(command)
    if command.loads and not scene.system.joints:
        raise SettingError(f"--loads is for scenes with joints; {command.scene} has none.")
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, transient=True) as bar:
        task = bar.add_task(f"{scene.name}: compiling", total=1.0)

        def report(done: float) -> None:
            bar.update(task, completed=done, description=f"{scene.name}: {100 * done:.0f} %")

        return simulate(
            scene,
            formulation=FORMULATIONS[command.formulation],
            solver=SOLVERS[command.solver](),
            stabilisation=STABILISATIONS[command.stabilisation](),
            rtol=command.rtol,
            atol=command.atol,
            t1=command.t1,
            save_every=command.save_every,
            max_steps=command.max_steps,
            throw=False,
            progress=report,
        )


def write_results(run: Run, command: Simulate) -> list[Path]:
    """Write results, certificate and figures; their paths."""
    folder = command.out if command.out is not None else Path("runs") / run.scene.name
    paths = [save(run, folder / "run.nc"), save_certificate(run, folder / "certificate.json")]
    if command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from .view.plot import save_figures

        paths += save_figures(run, folder, command.figures)
    return paths


def write_loads(run: Run, command: Simulate, folder: Path, out: Console) -> list[Path]:
    """Write the joints' reaction loads, resolved between saved times; print their peaks."""
    from .study.loads import resolved_loads
    from .view.loads import loads_table, save_loads, save_loads_figure

    loads = resolved_loads(run)
    out.print(loads_table(run.scene, loads))
    paths = [save_loads(run.scene, loads, folder / "loads.csv")]
    if command.figures != "none":
        paths.append(save_loads_figure(run.scene, loads, folder, command.figures))
    return paths


def _simulate(command: Simulate, console: Console, started: float) -> int:
    run = run_scene(command, console)
    clock = time.perf_counter()
    paths = write_results(run, command)
    writing = time.perf_counter() - clock
    out = Console()
    out.print(certificate_table(run))
    if command.loads:
        paths += write_loads(run, command, paths[0].parent, out)
    for note in run.scene.notes:
        out.print(f"Note: {note}", highlight=False)
    out.print(f"Imports {started:.2f} s, results and figures {writing:.2f} s.", highlight=False)
    written(out, paths)
    if run.certificate.result == "interrupted":
        return 130
    if not run.successful:
        raise SimulationError(f"{run.failure} What was reached is in {paths[0].parent}.")
    return 0


def _sun(command: SunDay) -> int:
    # pvlib and matplotlib are slow to import: only here
    from .study.day import Flaws, day_zone, parse_date, track_day
    from .vehicle.airframe import PART_II
    from .vehicle.ephemeris import Place
    from .vehicle.sun import attitude
    from .view.day import day_tables, load_attitude, save_day, save_day_figures

    turned = (command.roll, command.pitch, command.yaw)
    if command.attitude is not None and any(turned):
        raise SettingError("Give --attitude or --roll, --pitch and --yaw, not both.")
    table = load_parameters(command.params, PART_II)
    day = track_day(
        Place.degrees(command.lat, command.lon, command.altitude),
        parse_date(command.date),
        day_zone(command.timezone, command.lon),
        attitude(*(math.radians(angle) for angle in turned))
        if command.attitude is None
        else load_attitude(command.attitude),
        step=command.step,
        flaws=Flaws(command.stroke_step, math.radians(1) * np.array(command.attitude_error)),
        parameters=table,
        turbidity=command.turbidity,
    )
    folder = command.out if command.out is not None else Path("runs") / f"sun_{command.date}"
    paths = [save_day(day, folder / "day.nc")]
    if command.figures != "none":
        paths += save_day_figures(day, folder, command.figures)
    out = Console()
    for each in day_tables(day):
        out.print(each)
    written(out, paths)
    return 0


def main(arguments: list[str] | None = None) -> int:
    """Entry point; returns the exit code: 0, 1 for a failed run, 2 for bad input."""
    started = time.process_time()
    command = tyro.cli(Command, args=arguments, prog="stmuav", description=__doc__)  # pyright: ignore
    console = Console(stderr=True)
    try:
        if isinstance(command, List):
            _configure(False)
            list_scenes(Console())
            return 0
        if isinstance(command, Report):
            return run_report(command)
        _configure(command.cache)
        if isinstance(command, SunDay):
            return _sun(command)
        if isinstance(command, Trim):
            return run_trim(command)
        if isinstance(command, Linearize):
            return run_linearize(command)
        if isinstance(command, Tune):
            return run_tune(command)
        if isinstance(command, Estimate):
            return run_estimate(command)
        if isinstance(command, Montecarlo):
            return run_montecarlo(command)
        return _simulate(command, console, started)
    except SimulationError as error:
        console.print(f"stmuav: {error}", style="red", markup=False, highlight=False)
        return 1
    except (ModelError, StateError, SettingError, FileError, OSError) as error:
        console.print(f"stmuav: {error}", style="red", markup=False, highlight=False)
        return 2
    except KeyboardInterrupt:
        console.print("stmuav: interrupted before anything was reached.", markup=False)
        return 130


if __name__ == "__main__":
    sys.exit(main())
