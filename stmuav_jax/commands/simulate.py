"""`stmuav simulate`: one run of a scene, with its certificate, figures and loads."""

import dataclasses
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_type_hints

import tyro
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
from ..figures.drawing import Drawer, drawing
from ..figures.numbers import numbers_of
from ..figures.terminal import line
from ..scenes.registry import SCENES
from .options import END, TOLERANCE, Cache, Figures, Number, count, default, shared
from .output import results_folder, written
from .scene_options import check_known, options_class, plain_of, scene_among

if TYPE_CHECKING:
    from ..dynamics.loads import JointLoads
    from ..dynamics.method import Method
    from ..dynamics.run import Run
    from ..dynamics.scene import Scene

# Saved times are kept in memory: a spacing far below a step's would ask for too many.
SPACING = Number("spacing of the saved times", "s", above=1e-7, high=1e5)
# Steps of the size of round-off would not reach an end.
FIRST = Number("first step", "s", above=1e-12, high=1e5)
LARGEST = Number("largest step", "s", above=1e-12, high=1e5)
JUMP = Number("time of a jump", "s", above=0.0, high=1e5)
GAIN = Number("gain of Baumgarte's feedback", "1/s", 0.0, 1e6)


@dataclasses.dataclass
class Settings:
    """Options of a run and of its files, which all scenes share."""

    case: Annotated[int | None, shared("case"), default("the scene's first choice")] = None
    t1: Annotated[float | None, END, shared("t1"), default("the scene's own")] = None
    rtol: Annotated[float, dataclasses.replace(TOLERANCE, what="relative tolerance")] = (
        STEP_TOLERANCE
    )
    """Relative tolerance of a step."""
    atol: Annotated[float, dataclasses.replace(TOLERANCE, what="absolute tolerance")] = (
        STEP_TOLERANCE
    )
    """Absolute tolerance of a step [m, m/s, rad/s]."""
    solver: SolverName = "dopri8"
    """Solver: explicit, implicit for stiff scenes (kvaerno, rodas5p), or chosen at the start (auto)."""
    formulation: FormulationName = "tree"
    """Relative coordinates of a spanning tree (tree), or coordinates of all bodies: by the structure of the joints
    (augmented), with dense matrices (augmented-dense), with the rows of the report (report)."""
    stabilisation: StabilisationName = "projection"
    """Method that keeps the constraints from drifting."""
    baumgarte_gains: Annotated[tuple[float, float, float] | None, GAIN, default("10 10 10")] = None
    """Gains of baumgarte [1/s]: alpha of the rates, beta of the positions, that of |p| = 1."""
    save_every: Annotated[float | None, SPACING, default("the scene's own")] = None
    """Spacing of the saved times [s]."""
    max_steps: Annotated[int, count("steps between two saved times", 1e8)] = STEPS_ALLOWED
    """Largest number of steps between two saved times."""
    first_step: Annotated[float, FIRST] = FIRST_STEP
    """Length of the first step that is tried [s]."""
    max_step: Annotated[float | None, LARGEST, default("none")] = None
    """Largest step [s]; no step goes beyond a saved time either."""
    jump_times: Annotated[tuple[float, ...], JUMP, default("none")] = ()
    """Times at which forces jump [s]: a step ends before each, the next begins behind it."""
    error_estimate: bool = True
    """Estimate the run's error by a second run beside it."""
    certificate: Literal["standard", "full"] = "standard"
    """With full, the accelerations are also compared with those of another formulation, which compiles longer."""
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    out: Annotated[Path | None, shared("out"), default("runs/SCENE")] = None
    figures: Figures = "png"
    loads: bool = False
    """Also write the reaction loads of the joints, with their peaks between saved times, to loads.csv and a figure."""
    cache: Cache = True


ABOUT = """Simulate a scene, or a model's file; write run.nc, certificate.json and figures.

Example: stmuav simulate uav_tracker --case 2 --t1 1 --loads; stmuav simulate model.toml --t1 1. A scene has
options of its own, such as --drag or --servo.stiffness 1e6: `stmuav simulate SCENE --help` lists them with these.
A model's file has none (docs/models.md). Robots in URDF or MJCF need MuJoCo.
"""


def simulate_class(words: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Simulate", Settings, ABOUT, words)


def _flags(settings: type) -> list[str]:
    """Options of a dataclass that no value follows."""
    kinds = get_type_hints(settings)
    switches = [field.name for field in dataclasses.fields(settings) if kinds[field.name] is bool]
    return [f"--{no}{each}".replace("_", "-") for each in switches for no in ("", "no-")]


def named_scene(settings: type, words: Sequence[str]) -> str | None:
    """Scene or model's file that the words after a command name; None if there is none."""
    return scene_among(words, _flags(settings))


def scene_command(
    name: str, settings: type, about: str, words: Sequence[str], before: Sequence[Any] = ()
) -> type:
    """Command on a scene for tyro, with the options of the scene that the words after it name.

    Its fields are scene, settings and, if the scene is known, options.

    Args:
        settings: dataclass of the options that all scenes share. about: the command's help.
        before: fields of positional arguments in front of the scene.

    Raises:
        SettingError: an option that the scene does not have.
    """
    shared, flags = dataclasses.fields(settings), _flags(settings)
    scene = named_scene(settings, words)
    which = tyro.conf.arg(
        help="Name of a scene, as `stmuav list` has it, or a model's file: .toml, .xml, .urdf."
    )
    flat = tyro.conf.arg(name="")
    model = () if scene is None or scene in SCENES else (scene,)
    fields: list[Any] = [
        *before,
        ("scene", Annotated[tyro.conf.Positional[Literal[(*SCENES, *model)]], which]),  # pyright: ignore[reportInvalidTypeForm]
        ("settings", Annotated[settings, flat]),
    ]
    if scene in SCENES:
        own = [f"--{field.name}".replace("_", "-") for field in shared]
        check_known(scene, words, [*own, *flags, "--help"])
        titled = tyro.conf.arg(name=scene)
        own = options_class(scene)
        fields.append(("options", Annotated[own, titled, tyro.conf.OmitArgPrefixes]))
    cache = property(lambda command: command.settings.cache)
    return dataclasses.make_dataclass(name, fields, namespace={"__doc__": about, "cache": cache})


def command_or_scene(
    own: type, name: str, settings: type, about: str, before: Sequence[Any] = ()
) -> Callable[[Sequence[str]], type]:
    """Function of the words after a command: its own class, or a `scene_command` if they name a scene.

    Args:
        own: dataclass of the command without a scene or model's file; the others as in `scene_command`.
    """

    def options(words: Sequence[str]) -> type:
        if named_scene(settings, words) is None:
            return own
        return scene_command(name, settings, about, words, before)

    return options


def chosen_scene(command: Any) -> "Scene":
    """Scene of a `scene_command`, with its case, parameters and options, or of a model's file."""
    return _loaded(command) if command.scene not in SCENES else _registered(command)


def scene_of(command: Any) -> "Scene":
    """The scene with its case, parameters and options, or that of a model's file."""
    scene = chosen_scene(command)
    if command.settings.loads and not scene.system.joints:
        raise SettingError(f"--loads is for scenes with joints; {command.scene} has none.")
    return scene


def _registered(command: Any) -> "Scene":
    from ..files.netcdf import load_parameters
    from ..scenes.registry import make_scene, options_from_plain

    settings = command.settings
    table = load_parameters(settings.params, SCENES[command.scene].parameters)
    options = options_from_plain(command.scene, plain_of(command.scene, command.options))
    return make_scene(command.scene, settings.case, table, **options)


def _loaded(command: Any) -> "Scene":
    from ..files.model_file import load_model
    from ..files.mujoco_import import load_robot

    for option in ("case", "params"):
        if getattr(command.settings, option) is not None:
            raise SettingError(
                f"--{option} is for the report's scenes; a model's file holds its own numbers."
            )
    load = load_model if command.scene.endswith(".toml") else load_robot
    return load(command.scene)


def _stabilisation(settings: Settings) -> Any:
    """Stabilisation of the settings; raises `SettingError` for gains of one that has none."""
    if settings.baumgarte_gains is None:
        return stabilisation_named(settings.stabilisation)
    if settings.stabilisation != "baumgarte":
        raise SettingError(
            "--baumgarte-gains is for --stabilisation baumgarte, but it is "
            f"{settings.stabilisation}."
        )
    from ..dynamics.formulations.stabilisation import Baumgarte

    return Baumgarte(*settings.baumgarte_gains)


def method_of(settings: Settings, scene: "Scene") -> "Method":
    """Method of integration that the settings describe.

    Raises:
        SettingError: gains without their stabilisation, or a jump outside the run.
    """
    from ..dynamics.method import Method

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
        stabilisation=_stabilisation(settings),
        rtol=settings.rtol,
        atol=settings.atol,
        first_step=settings.first_step,
        max_steps=settings.max_steps,
        jump_ts=settings.jump_times or None,
        max_step=math.inf if settings.max_step is None else settings.max_step,
    )


def run_scene(scene: "Scene", settings: Settings, console: Console) -> "Run":
    """Simulate the scene with a progress bar on stderr."""
    from rich.progress import (
        BarColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    from ..dynamics.simulation import simulate

    method = method_of(settings, scene)
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
            method=method,
            t1=settings.t1,
            save_every=settings.save_every,
            error_estimate=settings.error_estimate,
            certificate=settings.certificate,
            throw=False,
            progress=report,
        )


def write_results(
    run: "Run", settings: Settings, drawer: Drawer
) -> tuple[list[Path], "JointLoads | None"]:
    """Write results, certificate, reaction loads and figures; their paths, and the loads."""
    from ..dynamics.loads import resolved_loads
    from ..figures.loads import loads_numbers, save_loads
    from ..files.netcdf import save, save_certificate, write_atomically

    folder, drawn = results_folder(settings.out, run.scene.name), settings.figures != "none"
    loads = None
    if drawn and not settings.loads:
        drawer.ask(numbers_of(run), settings.figures)
    paths = [save(run, folder / "run.nc"), save_certificate(run, folder / "certificate.json")]
    if settings.loads:
        # after the run is written: nothing that happens here can lose it
        loads = resolved_loads(run)
        paths.append(save_loads(run.scene, loads, folder / "loads.csv"))
        if drawn:
            more = {"loads": loads_numbers(run.scene, loads)}
            drawer.ask({**numbers_of(run), **more}, settings.figures)
    if drawn:
        for name, content in drawer.files().items():
            path = folder / f"{name}.{settings.figures}"
            paths.append(write_atomically(path, content))
    return paths, loads


def run_simulate(command: Any) -> int:
    """Build and simulate the scene, print and write what comes out; the exit code."""
    from ..figures.loads import loads_table
    from ..figures.report import certificate_table

    settings: Settings = command.settings
    with drawing(settings.figures != "none") as drawer:
        run = run_scene(scene_of(command), settings, Console(stderr=True))
        clock = time.perf_counter()
        paths, loads = write_results(run, settings, drawer)
        writing = time.perf_counter() - clock
    out = Console()
    out.print(certificate_table(run))
    if loads is not None:
        out.print(loads_table(run.scene, loads))
    for note in run.scene.notes:
        line(out, f"Note: {note}")
    out.print(f"Results and figures {writing:.2f} s.", highlight=False)
    written(out, paths)
    if run.certificate.result == "interrupted":
        return 130
    if not run.successful:
        raise SimulationError(f"{run.failure} What was reached is in {paths[0].parent}.")
    return 0
