"""Command `stmuav identify`: parameters of a model from the record of a motion, with their uncertainty."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Console

from ..checks.errors import SettingError
from ..figures.terminal import add_row, make_table, print_line
from .flight_log import IdentifyLog, is_log, run_identify_log
from .models.estimation import UNTRUSTED
from .models.point import PointSettings, scalars_by_name, starting_point, values_by_name
from .models.searching import has_converged, loss_figures, report_search, run_search
from .options import Figures, Resume, count_range, default_text, shared_option
from .output import results_folder
from .scene_options import chosen_scene, scene_command

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
    out: Annotated[Path | None, shared_option("out"), default_text("runs/identify_MODEL")] = None
    figures: Figures = "png"


ABOUT = """Identify parameters of a model from the record of its motion, by gradients through it.

Example: stmuav identify model.toml --record flight.csv --parameters mass=0.3 --sigma A.angle=0.001.
A flight log in place of a model identifies a multirotor: stmuav identify LOG --airframe FILE, or --list.
Exit codes: 0 converged, 1 not converged, 2 wrong input, 3 identified, but values and deviations cannot be trusted.
"""


def identify_options(arguments: Sequence[str]) -> type:
    """The command for tyro: on a flight log if the words name one, else see `scene_command`."""
    if is_log(arguments):
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
    figures = loss_figures(search, folder, settings.figures)
    failure_text = f"the search has not converged; {folder} has what it reached."
    code = report_search(search, parameter_table, folder, figures, is_done, failure_text)
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
    bounds = _parse_bounds(settings.bounds, start)
    run = lambda **options: identify(
        predict, record, deviations, start, sizes, bounds=bounds, **options
    )
    problem = f"identify {scene.name} {','.join(start)}"
    count = len(start) + predict.start_count
    fit_result = run_search(settings, folder, problem, jnp.zeros(count), run)
    parameter_table = make_table("parameter", "start", "found", "deviation", "if white", "unit")
    for k, name in enumerate(start):
        numbers = (start[name], fit_result.values[k], fit_result.standard_deviations[k])
        white = fit_result.deviations.white[k]
        add_row(
            parameter_table,
            name,
            *(f"{value:.6g}" for value in (*numbers, white)),
            model.table[name].unit,
        )
    free = [f"{name} to {value:.3g}" for name, value in start_deviations.items() if value > 0]
    exact = [
        name
        for name, _ in space.names
        if not start_deviations.get(name) and name not in parameter_states
    ]
    parameter_table.caption = (
        f"chi-squared per degree of freedom {fit_result.reduced_chi_square:.3g}; start estimated: "
        f"{', '.join(free) or 'none'}; exact: {', '.join(exact) or 'none'}"
    )
    # A search without progress at a good fit is at the limit of the arithmetic, and counts as done.
    stopped = (
        fit_result.search.reason is SearchReason.PATIENCE and fit_result.verdict.status != "failed"
    )
    return (
        fit_result.search,
        parameter_table,
        has_converged(fit_result.search) or stopped,
        fit_result.verdict,
    )


def _parse_bounds(
    entries: Sequence[str], start: dict[str, float]
) -> dict[str, tuple[float, float]]:
    bound_pairs = values_by_name(entries, "--bounds")
    for name, pair in bound_pairs.items():
        if not isinstance(pair, list) or len(pair) != 2:
            raise SettingError(
                f"--bounds takes two numbers for {name[:80]}, such as {name[:80]}=0,inf."
            )
    return {name: (pair[0], pair[1]) for name, pair in bound_pairs.items()}


def _start_of_parameters(
    model: Any,
    space: Any,
    x: Any,
    unknowns: Any,
    start: dict[str, float],
    settings: IdentifySettings,
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
