"""Command `stmuav tune`: inputs that hold a mechanism, or move it to another posture."""

import contextlib
import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro

from ..checks.errors import SettingError, StateError
from ..figures.terminal import add_row, make_table
from .mechanism import (
    PointSettings,
    inputs_named,
    report_search,
    run_search,
    scalars_by_name,
    starting_point,
)
from .options import END, FORCE, Figures, Number, Resume, count_range, default_text, shared_option
from .output import results_folder
from .scene_options import chosen_scene, scene_command

if TYPE_CHECKING:
    from ..dynamics.simulation import Scene
    from ..math.least_squares import Search


@dataclasses.dataclass
class TuneSettings(PointSettings):
    """Options of a search for inputs."""

    to: Annotated[tuple[str, ...], default_text("none")] = ()
    """slew: states at the end, as changes from the start, such as rail.displacement=0.5; the others return to it."""
    t1: Annotated[float | None, END, shared_option("duration", "the scene's own")] = None
    inputs: Annotated[tuple[str, ...], shared_option("inputs", "all")] = ()
    limit: Annotated[tuple[str, ...], default_text("none")] = ()
    """Largest magnitudes of inputs, such as effort=20."""
    reaction: Annotated[float | None, FORCE, default_text("none")] = None
    """Largest reaction force in any joint [N]."""
    knots: Annotated[int, Number("number of knots", "", 4, 200), shared_option("knots")] = 8
    segments: Annotated[int, count_range("segments", 1000), shared_option("segments")] = 1
    steps: Annotated[int, count_range("steps", 1e6), shared_option("steps")] = 60
    resume: Resume = False
    out: Annotated[
        Path | None, shared_option("out", "runs/tune_WHAT_SCENE_CASE or runs/tune_WHAT_MODEL")
    ] = None
    figures: Figures = "png"


ABOUT = """Tune the inputs of any mechanism by gradients through its motion; write inputs, history and figures.

Examples: stmuav tune slew model.toml --to rail.displacement=0.5 --t1 1.5; stmuav tune hold uav_tracker --t1 0.4
--segments 8 --inputs speed_squared force_slider_2 force_slider_3. hold finds constant inputs that keep the start;
slew begins with the inputs of trims at both ends, where there are any.
Exit codes: 0 converged, 1 not converged, 2 wrong input.
"""
What = Literal["hold", "slew"]
# Fields of the command in front of the scene.
WHAT = [("what", Annotated[tyro.conf.Positional[What], shared_option("what")])]
# Weight of a departure or of an end that is missed.
_WEIGHT = 10.0
# Loss below which inputs count as holding: departures of a millimetre or a milliradian.
_HOLDS = 1e-6


def tune_options(arguments: Sequence[str]) -> type:
    """The command for tyro, see `scene_command`."""
    return scene_command("Tune", TuneSettings, ABOUT, arguments, WHAT)


def run_tune(command: Any) -> int:
    """Run the command; return the exit code."""
    from ..math.least_squares import SearchReason

    settings = command.settings
    if (command.what == "slew") != bool(settings.to):
        needed = command.what == "slew"
        raise SettingError("tune slew needs --to." if needed else "--to is for tune slew.")
    scene = chosen_scene(command)
    folder = results_folder(settings.out, f"tune_{command.what}_{scene.name}")
    search, input_table, is_done, figures = _tune_inputs(command, scene, folder)
    failure = None
    if search.reason is SearchReason.CONVERGED and not is_done:
        failure = (
            f"no inputs hold the start: the smallest loss is {search.loss:.3g}, but at most {_HOLDS:g} is "
            f"required. {folder} contains the best inputs."
        )
    elif not is_done:
        failure = (
            f"the search has not converged; {folder} has what it reached; try more --segments, or "
            "--resume with more --steps."
        )
    return report_search(search, input_table, folder, settings.figures, figures, failure)


def _tune_inputs(
    command: Any, scene: "Scene", folder: Path
) -> tuple["Search", Any, bool, dict[str, Any]]:
    """The search, a table of its inputs, whether it has succeeded, and figures."""
    from ..analysis.equilibrium import trim
    from ..analysis.tuning import Limit, departures, tune_inputs, tune_slew
    from ..checks.numbers import as_floats
    from ..dynamics.statespace.base import places_of
    from ..figures.tuning import flight_figure, tuned_curves
    from ..math.least_squares import SearchReason

    settings, slews = command.settings, command.what == "slew"
    space, x = starting_point(scene, settings)
    inputs, values = inputs_named(space, settings.inputs, x, scene.t0)
    input_names, limits = [entry.name for entry in inputs.entries], []
    for name, value in scalars_by_name(settings.limit, "--limit").items():
        chosen = inputs.chosen([name]).entries
        if not value > 0:
            raise SettingError(f"The limit of {name} must be positive, but it is {value:g}.")
        limits += [Limit(_Over(input_names.index(entry.name), value)) for entry in chosen]
    if settings.reaction is not None:
        limits.append(Limit(_Reaction(settings.reaction)))
    options = {
        "inputs": inputs, "segments": settings.segments, "weight": _WEIGHT,
        "name": f"{command.what} {scene.name}",
    }  # fmt: skip
    duration = scene.t1 - scene.t0 if settings.t1 is None else settings.t1
    if slews:
        to = scalars_by_name(settings.to, "--to")
        v = np.zeros(space.size)
        v[list(places_of(space, list(to), "The states at the end"))] = list(to.values())
        target = space.retract(x, as_floats(v))
        # Without equilibrium at an end the search begins with the inputs given.
        ends = [values, values]
        for k, point in enumerate((x, target)):
            with contextlib.suppress(SettingError, StateError):
                ends[k] = trim(space, at=point, inputs=inputs, values=values).values
        tuning = tune_slew(
            space, x, target, duration, limits, values=ends[0], end_values=ends[1],
            knots=settings.knots, **options,
        )  # fmt: skip
    else:
        residuals = [departures(space, x), *limits]
        tuning = tune_inputs(space, residuals, start=x, duration=duration, values=values, **options)
    # Steps without progress end the search; how many there are depends on the problem.
    run = lambda **options: tuning.search(patience=15, **options)
    search = run_search(settings, folder, tuning.name, tuning.start, run)
    # A converged search may still not hold the posture, if the inputs cannot.
    has_converged = search.reason is SearchReason.CONVERGED
    is_done = has_converged and (slews or search.loss < _HOLDS)
    every = np.asarray(tuning.motion(search.values).inputs)
    title = f"Inputs that {'lead there' if slews else 'hold'}"
    if not is_done:
        state = "NOT HELD" if has_converged else "NOT CONVERGED"
        title = f"{state}: the best of {search.steps} steps ({title.lower()})"
    heads = ("input", "at the start", "at the end", "smallest", "largest", "unit")
    input_table = make_table(*heads, title=title)
    for k, (name, unit) in enumerate(inputs.names):
        numbers = (every[0, k], every[-1, k], every[:, k].min(), every[:, k].max())
        add_row(input_table, name, *(f"{value:.6g}" for value in numbers), unit)
    figures = {"motion": lambda: flight_figure(*tuned_curves(tuning, search.values), {})}
    return search, input_table, is_done, figures


class _Over:
    """Excess of an input over its limit, as a share of the limit."""

    def __init__(self, place: int, limit: float) -> None:
        self.place, self.limit = place, limit

    def __call__(self, motion: Any) -> Any:
        value = motion.extremes[:, self.place]
        return abs(value) / self.limit - 1.0


class _Reaction:
    """Excess of the reaction force in any joint over its limit, as a share of the limit."""

    def __init__(self, limit: float) -> None:
        self.limit = limit

    def __call__(self, motion: Any) -> Any:
        from ..analysis.tuning import joint_forces

        return joint_forces(motion) / self.limit - 1.0
