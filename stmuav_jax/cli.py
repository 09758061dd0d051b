"""The command line, `stmuav`: list, simulate, sun, trim, linearize, tune, estimate, montecarlo,
report.

Options are read without JAX; what a command needs is imported when it runs.
"""

import dataclasses
import os
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from rich.console import Console

from .commands.estimate import Estimate, run_estimate
from .commands.flight import Linearize, Trim, run_linearize, run_trim
from .commands.montecarlo import Montecarlo, Report, run_montecarlo, run_report
from .commands.options import (
    END,
    TOLERANCE,
    Number,
    arguments_of,
    check_options,
    check_words,
    count,
    default,
)
from .commands.output import explain, working, written
from .commands.sun import SunDay, run_sun
from .commands.tune import Tune, run_tune
from .mechanics.errors import SettingError, SimulationError
from .scenes.catalogue import CATALOGUE
from .view.terminal import line, row, table

if TYPE_CHECKING:
    from .dynamics.run import Run
    from .dynamics.scene import Scene

ABOUT = """Simulate, trim, tune and estimate a UAV that carries a parallel-mechanism solar tracker,
from the command line. Results go to files in runs/; `stmuav COMMAND --help` describes a command.

Examples: stmuav simulate uav_tracker --case 2; stmuav sun --lat 11.55 --lon 104.92 --date 2024-03-21;
stmuav trim --phi 10 --theta -5. Exit codes: 0 done, 1 failed, 2 bad input, 130 interrupted.
`--version` prints the version; `--debug` with a command prints the traceback of an error.
"""


def _solver(name: str) -> Any:
    import diffrax

    from .dynamics.rosenbrock import Rodas5P
    from .dynamics.solvers import kvaerno3, kvaerno5

    makers: dict[str, Callable[[], Any]] = {
        "dopri8": diffrax.Dopri8,
        "tsit5": diffrax.Tsit5,
        "kvaerno3": kvaerno3,
        "kvaerno5": kvaerno5,
        "rodas5p": Rodas5P,
        "auto": lambda: "auto",
    }
    return makers[name]()


def _formulation(name: str) -> Any:
    from .dynamics.augmented import Augmented
    from .dynamics.tree import Tree

    return {
        "tree": Tree(),
        "augmented": Augmented(),
        "augmented-dense": Augmented(solve="dense"),
        "report": Augmented(solve="dense", rows="report"),
    }[name]


def _stabilisation(name: str) -> Any:
    from .dynamics.stabilisation import Baumgarte, Projection, Unstabilised

    return {"projection": Projection, "baumgarte": Baumgarte, "none": Unstabilised}[name]()


# Saved times are kept in memory: a spacing far below a step's would ask for too many.
SPACING = Number("spacing of the saved times", "s", above=1e-7, high=1e5)


@dataclasses.dataclass
class List:
    """List the scenes, their cases and where the report describes them."""


@dataclasses.dataclass
class Simulate:
    """Simulate a scene; write run.nc, certificate.json and figures.

    Example: stmuav simulate uav_tracker --case 2 --t1 1 --loads
    """

    scene: tyro.conf.Positional[Literal["spin", "tracker", "hexacopter", "uav_tracker"]]
    """Which scene; see `stmuav list`."""
    case: Annotated[int | None, default("the scene's first choice")] = None
    """Case of the report."""
    t1: Annotated[float | None, END, default("the scene's own")] = None
    """End [s]."""
    rtol: Annotated[float, dataclasses.replace(TOLERANCE, what="relative tolerance")] = 1e-8
    """Relative tolerance of a step."""
    atol: Annotated[float, dataclasses.replace(TOLERANCE, what="absolute tolerance")] = 1e-8
    """Absolute tolerance of a step [m, m/s, rad/s]."""
    solver: Literal["dopri8", "tsit5", "kvaerno3", "kvaerno5", "rodas5p", "auto"] = "dopri8"
    """Explicit, or implicit for stiff scenes (kvaerno, rodas5p); auto looks at the start."""
    formulation: Literal["tree", "augmented", "augmented-dense", "report"] = "tree"
    """Relative coordinates; or all bodies' by structure, densely, in the report's rows."""
    stabilisation: Literal["projection", "baumgarte", "none"] = "projection"
    """What keeps the constraints from drifting."""
    save_every: Annotated[float | None, SPACING, default("the scene's own")] = None
    """Spacing of the saved times [s]."""
    max_steps: Annotated[int, count("steps allowed", 1e8)] = 100_000
    """Steps allowed between two saved times."""
    error_estimate: bool = True
    """Estimate the run's error by a second run beside it."""
    params: Annotated[Path | None, default("the report's values")] = None
    """TOML file with values that replace the table's."""
    actuators: Annotated[Literal["consistent", "printed"] | None, default("consistent")] = None
    """Couple of the actuators' force pair; uav_tracker only."""
    out: Annotated[Path | None, default("runs/SCENE")] = None
    """Folder for the results."""
    figures: Literal["png", "pdf", "svg", "none"] = "png"
    """Format of the figures."""
    loads: bool = False
    """Also find the joints' reaction loads, peaks between saved times too; loads.csv, figure."""
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
    import jax

    jax.config.update("jax_enable_x64", True)
    if use_cache:
        jax.config.update("jax_compilation_cache_dir", str(cache_folder()))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
        jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def list_scenes(console: Console) -> None:
    """Print the scenes."""
    shown = table("scene", "cases", "what it is", "report", "end [s]")
    for name, entry in CATALOGUE.items():
        cases = ", ".join(map(str, entry.cases)) or "-"
        row(shown, name, cases, entry.summary, entry.source, f"{entry.t1:g}")
    console.print(shown)


def _scene(command: Simulate) -> "Scene":
    from .scenes.registry import SCENES, make_scene
    from .view.io import load_parameters

    entry = SCENES[command.scene]
    table = load_parameters(command.params, entry.parameters)
    options: dict[str, Any] = {}
    if command.actuators is not None:
        if command.scene != "uav_tracker":
            raise SettingError(f"--actuators is for uav_tracker; {command.scene} has no actuators.")
        options["actuators"] = command.actuators
    return make_scene(command.scene, command.case, table, **options)


def run_scene(command: Simulate, console: Console) -> "Run":
    """Build and simulate the scene with a progress bar on stderr."""
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from .dynamics.simulate import simulate

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
            formulation=_formulation(command.formulation),
            solver=_solver(command.solver),
            stabilisation=_stabilisation(command.stabilisation),
            rtol=command.rtol,
            atol=command.atol,
            t1=command.t1,
            save_every=command.save_every,
            max_steps=command.max_steps,
            error_estimate=command.error_estimate,
            throw=False,
            progress=report,
        )


def write_results(run: "Run", command: Simulate) -> list[Path]:
    """Write results, certificate and figures; their paths."""
    from .view.io import save, save_certificate

    folder = command.out if command.out is not None else Path("runs") / run.scene.name
    paths = [save(run, folder / "run.nc"), save_certificate(run, folder / "certificate.json")]
    if command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from .view.plot import save_figures

        paths += save_figures(run, folder, command.figures)
    return paths


def write_loads(run: "Run", command: Simulate, folder: Path, out: Console) -> list[Path]:
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
    from .view.report import certificate_table

    run = run_scene(command, console)
    clock = time.perf_counter()
    paths = write_results(run, command)
    writing = time.perf_counter() - clock
    out = Console()
    out.print(certificate_table(run))
    if command.loads:
        paths += write_loads(run, command, paths[0].parent, out)
    for note in run.scene.notes:
        line(out, f"Note: {note}")
    out.print(f"Imports {started:.2f} s, results and figures {writing:.2f} s.", highlight=False)
    written(out, paths)
    if run.certificate.result == "interrupted":
        return 130
    if not run.successful:
        raise SimulationError(f"{run.failure} What was reached is in {paths[0].parent}.")
    return 0


def _run(command: Any, started: float) -> int:
    """Run one command; its exit code."""
    if isinstance(command, List):
        list_scenes(Console())
        return 0
    if isinstance(command, Report):
        with working("Reading the store and drawing"):
            return run_report(command)
    _configure(command.cache)
    if isinstance(command, Montecarlo):
        return run_montecarlo(command)
    if isinstance(command, Tune):
        return run_tune(command)
    if isinstance(command, Simulate):
        return _simulate(command, Console(stderr=True), started)
    silent: dict[type, tuple[str, Callable[[Any], int]]] = {
        SunDay: ("Following the sun through the day", run_sun),
        Trim: ("Compiling and solving the trim", run_trim),
        Linearize: ("Compiling and solving trim and linear equations", run_linearize),
        Estimate: ("Compiling and running the filters", run_estimate),
    }
    words, run = silent[type(command)]
    with working(words):
        return run(command)


def main(arguments: Sequence[str] | None = None) -> int:
    """Entry point; the exit code: 0, 1 for a failed run, 2 for bad input, 130 for Ctrl-C."""
    started = time.process_time()
    words = arguments_of(arguments)
    debug = "--debug" in words
    words = [word for word in words if word != "--debug"]
    if words == ["--version"]:
        # the package itself is loaded by now, and is above all floors
        line(Console(), f"stmuav_jax {sys.modules['stmuav_jax'].__version__}")
        return 0
    try:
        check_words(words)
        command: Any = tyro.cli(Command, args=words, prog="stmuav", description=ABOUT)  # pyright: ignore
        check_options(command, words)
        return _run(command, started)
    except SystemExit as stop:
        return stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 2
    except (Exception, KeyboardInterrupt) as error:
        return explain(error, debug)


if __name__ == "__main__":
    sys.exit(main())
