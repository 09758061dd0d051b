"""Command `stmuav identify`: parameters of a model from the record of a motion, with their uncertainty, or a
multirotor from its flight log.
"""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import add_row, make_table, print_line
from .mechanism import (
    PointSettings,
    report_search,
    run_search,
    scalars_by_name,
    starting_point,
    values_by_name,
)
from .options import Figures, Resume, count_range, default_text, shared_option
from .output import UNTRUSTED, print_paths, results_folder, show_progress
from .scene_options import MODEL_FILES, chosen_scene, scene_command

if TYPE_CHECKING:
    from ..analysis.fit_statistics import FitVerdict
    from ..dynamics.simulation import Scene
    from ..math.least_squares import Search


@dataclasses.dataclass
class IdentifySettings(PointSettings):
    """Options of a search for parameters."""

    record: Annotated[Path | None, default_text("none")] = None
    """CSV file with the column t [s], columns of joints such as A.angle or A.angle_rate, and of inputs."""
    parameters: Annotated[tuple[str, ...], default_text("none")] = ()
    """Parameters of the model's file with a start for the search, such as mass=0.3."""
    sigma: Annotated[tuple[str, ...], default_text("none")] = ()
    """Standard deviation of each column of the record, such as A.angle=0.001."""
    start_deviations: Annotated[
        tuple[str, ...], default_text("from the first readings of each state")
    ] = ()
    """Standard deviations of states at the start, such as A.angle=0.02; 0 for one that is exact."""
    bounds: Annotated[tuple[str, ...], default_text("none")] = ()
    """Intervals that parameters cannot leave, such as mass=0,inf."""
    steps: Annotated[int, count_range("steps", 1e6), shared_option("steps")] = 60
    resume: Resume = False
    out: Annotated[Path | None, shared_option("out", "runs/identify_MODEL")] = None
    figures: Figures = "png"


ABOUT = """Identify parameters of a model from the record of its motion, by gradients through it.

Example: stmuav identify model.toml --record flight.csv --parameters mass=0.3 --sigma A.angle=0.001.
A flight log in place of a model identifies a multirotor: stmuav identify LOG --airframe FILE, or --list.
Exit codes: 0 converged, 1 not converged, 2 wrong input, 3 identified, but values and deviations cannot be trusted.
"""


@dataclasses.dataclass
class IdentifyLog:
    """Identify a multirotor from a flight log of PX4 (ULog), ArduPilot (.BIN), Crazyflie (micro-SD) or CSV.

    Example: stmuav identify log15 --airframe crazyflie.toml. Exit codes: 0 identified, 1 nothing
    identified, 2 wrong input or a log that no identification can pass over, 3 identified, but the verdict is
    inconsistent.
    """

    log: tyro.conf.Positional[Path]
    """The log."""
    airframe: Annotated[Path | None, default_text("the log's own parameters")] = None
    """TOML file with positions [m] and spin of the rotors, in the order of the motors, mass [kg], and what a model
    needs that no flight determines."""
    mass: Annotated[float | None, default_text("the airframe's")] = None
    """Mass of the vehicle [kg]; without one, only ratios are identified."""
    columns: Annotated[Path | None, default_text("names in the header")] = None
    """TOML file with the map of columns of a CSV file."""
    flight: Annotated[int | None, default_text("the longest")] = None
    """Number of the stretch in flight, from 0."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"]), default_text("none")] = None
    """Model file to write, with its mission and study, for check, trim, simulate, fly and montecarlo."""
    out: Annotated[Path | None, shared_option("out", "no figures")] = None
    figures: Figures = "png"
    list: bool = False
    """Show what is in the log, and stop."""


def identify_options(arguments: Sequence[str]) -> type:
    """The command for tyro: on a flight log if the words name one, else see `scene_command`."""
    first = arguments[0] if arguments else "--help"
    # a log is a file that is no model's, or comes with options of a log
    if not (first.startswith("--") or first.endswith(MODEL_FILES)) and (
        Path(first).is_file() or {"--list", "--airframe"} & set(arguments)
    ):
        return IdentifyLog
    return scene_command("Identify", IdentifySettings, ABOUT, arguments)


def run_identify(command: Any) -> int:
    """Run the command; return the exit code."""
    if isinstance(command, IdentifyLog):
        return run_identify_log(command)
    settings = command.settings
    for name in ("record", "parameters", "sigma"):
        if not getattr(settings, name):
            raise SettingError(f"identify needs --{name}.")
    scene = chosen_scene(command)
    folder = results_folder(settings.out, f"identify_{scene.name}")
    search, parameter_table, is_done, verdict = _identify_parameters(command, scene, folder)
    failure = None if is_done else f"the search has not converged; {folder} has what it reached."
    code = report_search(search, parameter_table, folder, settings.figures, {}, failure)
    print_line(Console(), verdict.explanation)
    return UNTRUSTED if code == 0 and verdict.status == "inconsistent" else code


def _identify_parameters(
    command: Any, scene: "Scene", folder: Path
) -> tuple["Search", Any, bool, "FitVerdict"]:
    import jax.numpy as jnp

    from ..analysis.identification import (
        Unknown,
        from_table,
        identify,
        motion_model,
        start_from_readings,
    )
    from ..analysis.sensors import joint_output, joint_outputs
    from ..io.model_file import read_model
    from ..math.least_squares import SearchReason
    from ..math.space import CyclicVector
    from ..mechanics.inputs import inputs_of

    settings = command.settings
    if not str(command.scene).endswith(".toml"):
        raise SettingError("identify takes a model's TOML file, whose parameters have names.")
    model = read_model(command.scene)
    start = scalars_by_name(settings.parameters, "--parameters")
    sigma = scalars_by_name(settings.sigma, "--sigma")
    space, x = starting_point(scene, settings)
    read = [joint_output(scene.system, name) for name in sigma]
    every = joint_outputs(scene.system)
    ts, record, input_signals = read_record(settings.record, list(sigma), inputs_of(scene.system))
    # The start's size is the unknown's unit; one of zero would divide by zero.
    unknowns = [Unknown(name, max(abs(value), 1e-12)) for name, value in start.items()]
    point_of, parameter_states = _start_of_parameters(model, space, x, unknowns, start, settings)
    # Angles of a joint may differ from a record by whole turns.
    parts = [name.rpartition(".")[::2] for name in sigma]
    joint_of = lambda name: scene.system.joints[scene.system.joint_index(name)]
    turns = (kind == "angle" and not joint_of(joint).pitched for joint, kind in parts)
    readings = CyclicVector(tuple(turns))
    deviations = np.array(list(sigma.values()))
    state = space.to_state(x)
    values = {name: float(output.of(scene.system, state)) for name, output in every.items()}
    step, start_deviations = start_from_readings(
        space, list(sigma), ts, record, deviations, values, readings, without=parameter_states
    )
    chosen = scalars_by_name(settings.start_deviations, "--start-deviations")
    # Deviations that the user gives replace those from the readings, state by state.
    start_deviations |= chosen

    def evaluate_outputs(run_space: Any, now: Any) -> Any:
        state = run_space.to_state(now)
        return jnp.stack([output.of(run_space.system, state) for output in read])

    def make_point(table: Any) -> Any:
        run_space = space.with_system(model.system(table))
        return run_space, run_space.retract(point_of(run_space, table), jnp.asarray(step))

    predict = motion_model(
        from_table(make_point, model.table, unknowns), None, ts, evaluate_outputs, inputs=input_signals, space=space,
        start_deviations=start_deviations, readings=readings,
    )  # fmt: skip
    sizes = np.array([unknown.size for unknown in unknowns])
    bounds: dict[str, Any] = values_by_name(settings.bounds, "--bounds")
    for name, pair in bounds.items():
        if np.shape(pair) != (2,):
            raise SettingError(
                f"--bounds takes two numbers for {name[:80]}, such as {name[:80]}=0,inf."
            )
    run = lambda **options: identify(
        predict, record, deviations, start, sizes, bounds=bounds, **options
    )
    problem = f"identify {scene.name} {','.join(start)}"
    count = len(start) + predict.start_count
    fit_result = run_search(settings, folder, problem, jnp.zeros(count), run)
    parameter_table = make_table("parameter", "start", "found", "deviation", "if white", "unit")
    columns = (
        start.values(), fit_result.values, fit_result.standard_deviations, fit_result.deviations.white,
    )  # fmt: skip
    for name, *numbers in zip(start, *columns, strict=True):
        texts = [f"{value:.6g}" for value in numbers]
        add_row(parameter_table, name, *texts, model.table[name].unit)
    free = [f"{name} to {value:.3g}" for name, value in start_deviations.items() if value > 0]
    estimated = {name for name, value in start_deviations.items() if value} | parameter_states
    exact = [name for name, _ in space.names if name not in estimated]
    parameter_table.caption = (
        f"chi-squared per degree of freedom {fit_result.reduced_chi_square:.3g}; start estimated: "
        f"{', '.join(free) or 'none'}; exact: {', '.join(exact) or 'none'}"
    )
    # A search without progress at a good fit is at the limit of the arithmetic, and counts as done.
    reason, verdict = fit_result.search.reason, fit_result.verdict
    is_done = reason is SearchReason.CONVERGED
    is_done |= reason is SearchReason.PATIENCE and verdict.status != "failed"
    return fit_result.search, parameter_table, is_done, verdict


def _start_of_parameters(
    model: Any, space: Any, x: Any, unknowns: Any, start: dict[str, float], settings: Any
) -> tuple[Any, set[str]]:
    """Function (space, table) -> point at the start, and the states that the parameters move."""
    import jax
    import jax.numpy as jnp

    from ..analysis.identification import table_with

    start_parameters = sorted(set(start) & model.of_start())
    if not start_parameters:
        return lambda run_space, table: x, set()
    if settings.coordinates or settings.rates:
        raise SettingError(
            f"The parameter '{start_parameters[0]}' sets the start of the file, which --coordinates "
            "and --rates replace: leave out one of them."
        )
    point = lambda run_space, table: run_space.from_state(model.start(run_space.system, table))

    def start_change(q: Any) -> Any:
        table = table_with(model.table, unknowns, q)
        return space.difference(point(space.with_system(model.system(table)), table), x)

    # A state that a parameter moves cannot also be estimated by itself: the two could not be told apart.
    slopes = np.asarray(jax.jacfwd(start_change)(jnp.asarray(list(start.values()))))
    moves = np.any(np.abs(slopes) > 1e-9 * np.max(np.abs(slopes), initial=1e-300), axis=1)
    return point, {name for (name, _), move in zip(space.names, moves, strict=True) if move}


def read_record(
    path: Path, names: Sequence[str], inputs: Any
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Times (k,) [s] and columns (k, m) of a record, and its columns of inputs as cubic splines.

    A blank cell of a column that is read is a missing reading, NaN; times and inputs must be complete.

    Raises:
        FileError: the file is missing or not a text file, or an entry is not a finite number.
        SettingError: a column is missing, or the times do not increase.
        ModelError: too few samples for the splines of the inputs.
    """
    from ..checks.numbers import increasing_times
    from ..io.csv_table import read_csv_table
    from ..math.sampled import Sampled

    table = read_csv_table(path)
    read = table.read_numbers
    ts = increasing_times(read("t"), f"The times of {path}")
    record = np.array([read(name, admits_blanks=True) for name in names]).T
    input_names = [name for name, _ in inputs.names if name in table.heads]
    return ts, record, {name: Sampled(ts, read(name), 3) for name in input_names}


def run_identify_log(command: Any) -> int:
    """Run the command; return the exit code."""
    from ..io.flight_log import read_flight_log, read_rotor_layout
    from ..io.netcdf import read_toml
    from ..uav.flight_identification.stages import identify_flight

    out = Console()
    if command.output is not None and command.output.suffix != ".toml":
        raise SettingError(f"A model's file ends in .toml, but --output is {command.output}.")
    if command.out is not None and command.out.exists() and not command.out.is_dir():
        raise SettingError(f"--out must be a folder, but {command.out} is a file.")
    log = read_flight_log(command.log, command.columns)
    if command.list:
        print_line(out, log.describe())
        return 0
    # refusals come as the error
    for note in (note for note in log.notes if note not in log.refusals):
        print_line(out, note)
    record = log.to_record(command.flight)
    layout = log.to_layout() if command.airframe is None else read_rotor_layout(command.airframe)
    if command.airframe is not None and "thrust_model_factor" not in read_toml(command.airframe):
        setting = log.settings.get("thrust_model_factor")
        if setting is not None:
            layout = layout._replace(thrust_model_factor=setting.value)
        source = (
            "it is not given" if setting is None else f"only the log gives it ({setting.source})"
        )
        print_line(out, f"The thrust model factor is {layout.thrust_model_factor:g}, as {source}.")
    if command.mass is not None:
        if not 0 < command.mass < float("inf"):
            raise SettingError(f"The mass must be positive, but it is {command.mass:g} kg.")
        layout = layout._replace(mass=command.mass)
    print_line(out, f"Identifying {record.ts[0]:.1f} to {record.ts[-1]:.1f} s of {log.name}.")
    with show_progress(log.name) as progress:
        result = identify_flight(record, layout, progress=progress)
    estimates = make_table(
        "quantity", "value", "deviation", "blocks", "windows", "variants", "unit", right=1
    )
    for name, e in result.estimates.items():
        parts = (f"{x:.2g}" for x in (e.deviation, e.blocks, e.windows, e.variants))
        add_row(estimates, name.replace("_", " "), f"{e.value:.4g}", *parts, e.unit)
    out.print(estimates)
    for sentence in (*result.refusals.values(), result.verdict.explanation):
        print_line(out, sentence)
    if command.out is not None and command.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.flight_log import FLIGHT_LOG_FIGURES, IdentifiedFlight
        from ..figures.plot import save_figures

        subject = IdentifiedFlight(log, record, result)
        print_paths(out, save_figures(FLIGHT_LOG_FIGURES, command.out, command.figures, subject))
    if not result.estimates:
        return 1
    if command.output is not None:
        from ..io.identified_model import write_identified_model

        *paths, notes = write_identified_model(result, command.output, source=log.name)
        for note in notes:
            print_line(out, note)
        print_paths(out, paths)
    return UNTRUSTED if result.verdict.status == "inconsistent" else 0
