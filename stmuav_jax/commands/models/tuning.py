"""Command `stmuav tune WHAT SCENE`: tuned inputs, and identified parameters, of any mechanism."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro

from ...checks.errors import SettingError
from ...figures.terminal import row, table
from ..options import END, Figures, Number, Resume, count, default, shared
from ..output import results_folder
from ..simulate import chosen_scene
from .point import PointSettings, inputs_named, scalars_by_name, starting_point
from .searching import HOLDS, What, converged, ended, loss_figures, watched

if TYPE_CHECKING:
    from ...algebra.least_squares import Search
    from ...dynamics.scene import Scene


@dataclasses.dataclass
class TuneSettings(PointSettings):
    """Options of a search on any mechanism."""

    to: Annotated[tuple[str, ...], default("none")] = ()
    """slew: states at the end, as changes from the start, such as rail.displacement=0.5; the others return to it."""
    t1: Annotated[float | None, END, shared("duration"), default("the scene's own")] = None
    inputs: Annotated[tuple[str, ...], shared("inputs"), default("all")] = ()
    limit: Annotated[tuple[str, ...], default("none")] = ()
    """Largest magnitudes of inputs, such as effort=20."""
    knots: Annotated[int, Number("number of knots", "", 4, 200), shared("knots")] = 8
    segments: Annotated[int, count("segments", 1000), shared("segments")] = 1
    record: Annotated[Path | None, default("none")] = None
    """identify: CSV file with the column t [s], columns of joints such as A.angle or A.angle_rate, and of inputs."""
    parameters: Annotated[tuple[str, ...], default("none")] = ()
    """identify: parameters of the model's file with a start for the search, such as mass=0.3."""
    sigma: Annotated[tuple[str, ...], default("none")] = ()
    """identify: standard deviation of each column of the record, such as A.angle=0.001."""
    steps: Annotated[int, count("steps", 1e6), shared("steps")] = 60
    resume: Resume = False
    out: Annotated[Path | None, shared("out"), default("runs/tune_WHAT_SCENE")] = None
    figures: Figures = "png"


ABOUT = """Tune the inputs of any mechanism by gradients through its motion, or identify its parameters.

Examples: stmuav tune slew model.toml --to rail.displacement=0.5 --t1 1.5; stmuav tune identify model.toml
--record flight.csv --parameters mass=0.3 --sigma A.angle=0.001. hold finds constant inputs that keep the start.
Without a scene or a model's file the command tunes the UAV with its tracker: stmuav tune --help.
"""
# Fields of the command in front of the scene.
WHAT = [("what", Annotated[tyro.conf.Positional[What], shared("what")])]
# Weight of a departure or of an end that is missed.
_WEIGHT = 10.0


def run_tune_scene(command: Any) -> int:
    """Run the command; return the exit code."""
    scene, settings = chosen_scene(command), command.settings
    folder = results_folder(settings.out, f"tune_{command.what}_{scene.name}")
    _check(command.what, settings)
    work = _identified if command.what == "identify" else _tuned
    found, shown, done = work(command, scene, folder)
    figures = loss_figures(found, folder, settings.figures)
    return ended(found, shown, folder, figures, done, f"{folder} has what it reached.")


def _check(what: str, settings: TuneSettings) -> None:
    """Raise `SettingError` for options that belong to another kind of search, or are missing."""
    own = {"to": "slew", "record": "identify", "parameters": "identify", "sigma": "identify"}
    for name, kind in own.items():
        if getattr(settings, name) and what != kind:
            raise SettingError(f"--{name} is for tune {kind}.")
        if kind == what and not getattr(settings, name):
            raise SettingError(f"tune {what} needs --{name}.")


def _tuned(command: Any, scene: "Scene", folder: Path) -> tuple["Search", Any, bool]:
    from ...checks.numbers import floats
    from ...dynamics.statespace.base import places_of
    from ...flight.tuning import departures, end_at, tune_inputs

    settings = command.settings
    space, x = starting_point(scene, settings)
    slews = command.what == "slew"
    t1 = scene.t1 - scene.t0 if settings.t1 is None else settings.t1
    inputs = inputs_named(space, settings.inputs)
    to = scalars_by_name(settings.to, "--to")
    v = np.zeros(space.size)
    v[list(places_of(space, list(to), "The states at the end"))] = list(to.values())
    target = space.retract(x, floats(v))
    residuals: list[Any] = [end_at(space, target) if slews else departures(space, x)]
    residuals += _limits(inputs, scalars_by_name(settings.limit, "--limit"))
    tuning = tune_inputs(
        space, residuals, start=x, duration=t1, inputs=inputs, weight=_WEIGHT,
        knots=settings.knots if slews else None, segments=settings.segments,
        name=f"{command.what} {scene.name}",
    )  # fmt: skip
    run = lambda **options: tuning.search(patience=15, **options)
    found = watched(settings, folder, tuning.name, tuning.start, run)
    done = converged(found) and (slews or found.loss < HOLDS)
    every = np.asarray(tuning.motion(found.values).inputs)
    shown = table("input", "at the start", "at the end", "smallest", "largest", "unit")
    for k, (name, unit) in enumerate(inputs.names):
        numbers = (every[0, k], every[-1, k], every[:, k].min(), every[:, k].max())
        row(shown, name, *(f"{value:.6g}" for value in numbers), unit)
    return found, shown, done


class _Over:
    """Excess of an input over its limit, as a share of the limit."""

    def __init__(self, place: int, limit: float) -> None:
        self.place, self.limit = place, limit

    def __call__(self, motion: Any) -> Any:
        value = motion.extremes[:, self.place]
        return abs(value) / self.limit - 1.0


def _limits(inputs: Any, given: dict[str, float]) -> list[Any]:
    from ...flight.tuning import Limit

    known, found = [entry.name for entry in inputs.entries], []
    for name, value in given.items():
        chosen = inputs.chosen([name]).entries
        if not value > 0:
            raise SettingError(f"The limit of {name} must be positive, but it is {value:g}.")
        found += [Limit(_Over(known.index(entry.name), value)) for entry in chosen]
    return found


def _identified(command: Any, scene: "Scene", folder: Path) -> tuple["Search", Any, bool]:
    import jax.numpy as jnp

    from ...files.model_file import read_model
    from ...flight.identification import Unknown, from_table, identify, motion_model
    from ...mechanics.inputs import inputs_of
    from ...sensing.outputs import joint_output

    settings = command.settings
    if not str(command.scene).endswith(".toml"):
        raise SettingError("tune identify takes a model's TOML file, whose parameters have names.")
    model = read_model(command.scene)
    start = scalars_by_name(settings.parameters, "--parameters")
    for name in start:
        if name in model.of_start():
            raise SettingError(
                f"The parameter '{name}' sets the start, which the record must know."
            )
    sigma = scalars_by_name(settings.sigma, "--sigma")
    space, x = starting_point(scene, settings)
    read = [joint_output(scene.system, name).of for name in sigma]
    ts, record, given = read_record(settings.record, list(sigma), inputs_of(scene.system))
    unknowns = [Unknown(name, max(abs(value), 1e-12)) for name, value in start.items()]

    def outputs(own: Any, now: Any) -> Any:
        state = own.to_state(now)
        return jnp.stack([of(own.system, state) for of in read])

    predict = motion_model(
        from_table(model.system, model.table, unknowns), x, ts, outputs, inputs=given, space=space
    )
    sizes = np.array([unknown.size for unknown in unknowns])
    deviations = np.array(list(sigma.values()))
    run = lambda **options: identify(predict, record, deviations, start, sizes, **options)
    problem = f"identify {scene.name} {','.join(start)}"
    found = watched(settings, folder, problem, jnp.zeros(len(start)), run)
    shown = table("parameter", "start", "found", "deviation", "unit")
    for k, name in enumerate(start):
        numbers = (start[name], found.values[k], found.standard_deviations[k])
        row(shown, name, *(f"{value:.6g}" for value in numbers), model.table[name].unit)
    shown.caption = f"chi-squared per degree of freedom {found.reduced_chi_square:.3g}"
    return found.search, shown, converged(found.search)


def read_record(
    path: Path, names: Sequence[str], inputs: Any
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Times (k,) [s] and columns (k, m) of a record, and its columns of inputs as cubic splines.

    Raises:
        FileError: the file is missing or not a text file.
        SettingError: a column is missing, an entry is not a finite number, or the times do not
            increase.
        ModelError: too few samples for the splines of the inputs.
    """
    import csv

    from ...algebra.sampled import Sampled
    from ...checks.numbers import increasing_times
    from ...files.study_file import column

    ts = increasing_times(column(path, "t"), f"The times of {path}")
    record = np.array([column(path, name) for name in names]).T
    with path.open(newline="", encoding="utf-8") as file:
        head = next(csv.reader(file), [])
    known = [name for name, _ in inputs.names if name in head]
    return ts, record, {name: Sampled(ts, np.array(column(path, name)), 3) for name in known}
