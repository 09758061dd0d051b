"""`stmuav simulate`: one run of a scene, with its certificate, figures and loads."""

import dataclasses
import importlib
import math
import time
from collections.abc import Sequence
from pathlib import Path
from threading import Thread
from typing import TYPE_CHECKING, Annotated, Any, Literal

from rich.console import Console

from ..checks.errors import SettingError, SimulationError
from ..dynamics.choices import (
    FIRST_STEP,
    STEP_TOLERANCE,
    STEPS_ALLOWED,
    FormulationName,
    SolverName,
    StabilisationName,
    formulation_named,
    solver_named,
    stabilisation_named,
)
from ..figures.terminal import print_line
from .check import CheckSettings
from .options import (
    END,
    TOLERANCE,
    Figures,
    Number,
    count_range,
    default_text,
    shared_option,
)
from .output import INTERRUPTED, print_paths, results_folder, show_progress
from .scene_options import chosen_scene, scene_command

if TYPE_CHECKING:
    from ..dynamics.method import Method
    from ..dynamics.simulation import Run, Scene

# Saved times are kept in memory: a spacing far below a step's would ask for too many.
SPACING = Number("spacing of the saved times", "s", above=1e-7, high=1e5)
# Steps of the size of round-off would not reach an end.
FIRST = Number("first step", "s", above=1e-12, high=1e5)
LARGEST = Number("largest step", "s", above=1e-12, high=1e5)
JUMP = Number("time of a jump", "s", above=0.0, high=1e5)
GAIN = Number("gain of Baumgarte's feedback", "1/s", 0.0, 1e6)


@dataclasses.dataclass
class Settings(CheckSettings):
    """Options of a run and of its files, which all scenes share."""

    t1: Annotated[float | None, END, shared_option("t1", "the scene's own")] = None
    rtol: Annotated[float, dataclasses.replace(TOLERANCE, quantity="relative tolerance")] = (
        STEP_TOLERANCE
    )
    """Relative tolerance of a step."""
    atol: Annotated[float, dataclasses.replace(TOLERANCE, quantity="absolute tolerance")] = (
        STEP_TOLERANCE
    )
    """Absolute tolerance of a step [m, m/s, rad/s]."""
    solver: SolverName = "dopri8"
    """Solver: explicit, implicit for stiff scenes (kvaerno3, kvaerno5), or chosen at the start (auto)."""
    formulation: FormulationName = "tree"
    """Relative coordinates of a spanning tree (tree), or coordinates of all bodies (augmented)."""
    stabilisation: StabilisationName = "projection"
    """Method that keeps the constraints from drifting."""
    baumgarte_gains: Annotated[
        tuple[float, float, float] | None, GAIN, default_text("10 10 10")
    ] = None
    """Gains of baumgarte [1/s]: alpha of the rates, beta of the positions, that of |p| = 1."""
    save_every: Annotated[float | None, SPACING, default_text("the scene's own")] = None
    """Spacing of the saved times [s]."""
    max_steps: Annotated[int, count_range("steps between two saved times", 1e8)] = STEPS_ALLOWED
    """Largest number of steps between two saved times."""
    first_step: Annotated[float, FIRST] = FIRST_STEP
    """Length of the first step that is tried [s]."""
    max_step: Annotated[float | None, LARGEST, default_text("none")] = None
    """Largest step [s]; no step goes beyond a saved time either."""
    jump_times: Annotated[tuple[float, ...], JUMP, default_text("none")] = ()
    """Times at which forces jump [s]: a step ends just before each, the next begins just after it."""
    error_estimate: bool = True
    """Estimate the run's error by a second run."""
    certificate: Literal["standard", "full"] = "standard"
    """With full, the accelerations are also compared with those of another formulation, which compiles longer."""
    out: Annotated[Path | None, shared_option("out", "runs/SCENE_CASE or runs/MODEL")] = None
    figures: Figures = "png"
    verbose: bool = False
    """Print all entries of the accuracy report; by default the six main ones."""
    loads: bool = False
    """Also write the reaction loads of the joints, with their peaks between saved times, to loads.csv and a figure."""


ABOUT = """Simulate a scene, or a model's file; write run.nc, certificate.json and figures.

Example: stmuav simulate uav_tracker --case 2 --t1 1 --loads; stmuav simulate model.toml --t1 1. A scene has
options of its own, such as --drag or --servo.stiffness 1e6: `stmuav simulate SCENE --help` lists them with these.
A model's file has none (docs/models.md). Robots in URDF or MJCF need MuJoCo.
"""


def simulate_class(arguments: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Simulate", Settings, ABOUT, arguments)


def scene_of(command: Any) -> "Scene":
    """The scene with its case, parameters and options, or that of a model's file."""
    scene = chosen_scene(command)
    if command.settings.loads and not scene.system.joints:
        raise SettingError(f"--loads is for scenes with joints; {command.scene} has none.")
    return scene


def method_of(settings: Settings, scene: "Scene") -> "Method":
    """Method of integration that the settings describe.

    Raises:
        SettingError: gains without their stabilisation, or a jump outside the run.
    """
    from ..dynamics.formulations.stabilisation import Baumgarte
    from ..dynamics.method import Method

    stabilisation: Any = stabilisation_named(settings.stabilisation)
    if settings.baumgarte_gains is not None:
        if settings.stabilisation != "baumgarte":
            raise SettingError(
                "--baumgarte-gains is for --stabilisation baumgarte, but it is "
                f"{settings.stabilisation}."
            )
        stabilisation = Baumgarte(*settings.baumgarte_gains)
    end = scene.t1 if settings.t1 is None else settings.t1
    for jump in settings.jump_times:
        if not scene.t0 < jump < end:
            raise SettingError(
                f"The times of jumps must lie within the run, between {scene.t0:g} and {end:g} s, but "
                f"one is {jump:g} s (--jump-times)."
            )
    return Method(
        formulation=formulation_named(settings.formulation),
        solver=solver_named(settings.solver),
        stabilisation=stabilisation,
        rtol=settings.rtol,
        atol=settings.atol,
        first_step=settings.first_step,
        max_steps=settings.max_steps,
        jump_ts=settings.jump_times or None,
        max_step=math.inf if settings.max_step is None else settings.max_step,
    )


def run_scene(scene: "Scene", settings: Settings) -> "Run":
    """Simulate the scene with a progress bar on stderr."""
    from ..dynamics.simulation import simulate

    with show_progress(scene.name) as report:
        return simulate(
            scene,
            method=method_of(settings, scene),
            t1=settings.t1,
            save_every=settings.save_every,
            error_estimate=settings.error_estimate,
            certificate=settings.certificate,
            # A run that fails is written up to its failure, where the reason can be seen.
            throw=False,
            progress=report,
        )


def run_simulate(command: Any) -> int:
    """Build and simulate the scene, print and write what comes out; the exit code."""
    from ..dynamics.loads import resolved_loads
    from ..figures.terminal import certificate_table, loads_table
    from ..io.run_file import save, save_certificate

    settings: Settings = command.settings
    scene = scene_of(command)
    if settings.figures != "none":
        # slow to import: it is done while the equations are compiled, which leaves Python free
        Thread(target=importlib.import_module, args=("stmuav_jax.figures.run",)).start()
    run = run_scene(scene, settings)
    clock = time.perf_counter()
    folder = results_folder(settings.out, run.scene.name)
    paths = [save(run, folder / "run.nc"), save_certificate(run, folder / "certificate.json")]
    # after the run is written: nothing that happens here can lose it
    loads = resolved_loads(run) if settings.loads else None
    if loads is not None or settings.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.plot import save_figures
        from ..figures.run import FIGURES, loads_figure, save_loads

        figures: dict[str, Any] = dict(FIGURES)
        if loads is not None:
            paths.append(save_loads(run.scene, loads, folder / "loads.csv"))
            figures["loads"] = loads_figure(run.scene, loads)
        if settings.figures != "none":
            paths += save_figures(figures, folder, settings.figures, run)
    writing = time.perf_counter() - clock
    out = Console()
    out.print(certificate_table(run, verbose=settings.verbose))
    if loads is not None:
        out.print(loads_table(run.scene, loads))
    for kind, sentences in (("Warning", run.scene.warnings), ("Note", run.scene.notes)):
        for sentence in sentences:
            print_line(out, f"{kind}: {sentence}")
    out.print(f"Results and figures {writing:.2f} s.", highlight=False)
    print_paths(out, paths)
    if run.certificate.result == "interrupted":
        return INTERRUPTED
    if not run.successful:
        raise SimulationError(f"{run.failure} Results up to there are in {folder}.")
    return 0
