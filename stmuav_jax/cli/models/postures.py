"""Options of `stmuav trim` that leave one posture: efforts along a path, and a survey of postures."""

import dataclasses
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from rich.console import Console

from ...checks.errors import SettingError
from ...figures.terminal import add_row, make_table, print_line
from ..options import Figures, default_text
from ..output import print_paths
from .point import PointSettings, inputs_named, starting_point, values_by_name

if TYPE_CHECKING:
    from ...dynamics.simulation import Scene
    from ...mechanics.inputs import Inputs
    from ...mechanics.state import State

# Values of each coordinate between two limits.
_SAMPLES = 21


@dataclasses.dataclass
class PostureSettings(PointSettings):
    """Options that ask for many postures instead of one trim."""

    path: Annotated[Path | None, default_text("none")] = None
    """CSV file with times t [s] and a column for each joint that moves, such as hinge [rad, m]: write the
    inputs along this path."""
    survey: Annotated[tuple[str, ...], default_text("none")] = ()
    """Two coordinates with their limits, such as A.angle=-1,1 B.angle=-1,1 [rad, m]: write a map of the
    postures between them."""
    figures: Figures = "png"


def write_path(scene: "Scene", settings: Any, folder: Path) -> None:
    """Print the largest inputs along the path of a file; write all of them to efforts.csv and a figure.

    Raises:
        SettingError: a file without joints, a column that is no joint, or times that do not increase.
        ModelError: the path does not determine the motion. StateError: it stops.
    """
    from ...analysis.path_inverse_dynamics import inverse_dynamics
    from ...checks.numbers import increasing_times
    from ...dynamics.assembly.joint_start import state_from_joints
    from ...io.csv_table import read_csv_table
    from ...math.sampled import Sampled

    table = read_csv_table(settings.path)
    joints = [name for name in table.heads if name != "t"]
    if not joints:
        raise SettingError(f"{settings.path} needs a column for each joint that moves, beside t.")
    ts = increasing_times(table.read_numbers("t"), f"The times of {settings.path}")
    if len(ts) < 6:
        raise SettingError(f"A path needs at least 6 times; {settings.path} has {len(ts)}.")
    samples = {name: table.read_numbers(name) for name in joints}
    motions = {name: Sampled(ts, values, 5) for name, values in samples.items()}
    inputs, state = _start(scene, settings)
    first_values = {name: float(values[0]) for name, values in samples.items()}
    start = state_from_joints(scene.system, first_values, start=state, t=ts[0])
    efforts = inverse_dynamics(scene.system, motions, ts, inputs=inputs, state=start)
    largest = np.max(np.abs(efforts.values), axis=0)
    largest_table = make_table("input", "largest size", "unit", title=f"Along {settings.path}")
    for (name, unit), value in zip(efforts.inputs, largest, strict=True):
        add_row(largest_table, name, f"{value:.6g}", unit)
    out = Console()
    out.print(largest_table)
    rest = float(np.max(efforts.unbalanced))
    print_line(out, f"Largest load that the inputs leave: {rest:.1e} of the weight.")
    heads = ["t [s]", *_name_columns(efforts.inputs)]
    _write_results(out, scene, settings, folder, "efforts", efforts, heads, [ts, efforts.values])


def write_survey(scene: "Scene", settings: Any, folder: Path) -> None:
    """Print what a survey of postures found; write each posture to survey.csv, and a map.

    Raises:
        SettingError: other than two coordinates with two limits each, or names that are unknown.
        ModelError: coordinates that depend on each other, or a singular start.
    """
    from ...analysis.posture_survey import survey

    limits = values_by_name(settings.survey, "--survey")
    if len(limits) != 2 or any(np.shape(ends) != (2,) for ends in limits.values()):
        raise SettingError(
            "--survey takes two coordinates with two limits each, such as A.angle=-1,1 B.angle=-1,1."
        )
    inputs, state = _start(scene, settings)
    result = survey(
        scene.system, list(limits), list(limits.values()), inputs=inputs, state=state, samples=_SAMPLES, t=scene.t0,
    )  # fmt: skip
    out = Console()
    count = int(np.sum(result.reachable))
    print_line(out, f"Postures: {count} of {result.reachable.size} can be reached from the start.")
    # the smallest of no numbers would be a warning
    if count:
        print_line(
            out,
            f"Smallest hold of the inputs {np.nanmin(result.hold):.3g}, mobility of {result.body} "
            f"{np.nanmin(result.mobility):.3g}; both are 0 at a singular posture.",
        )
    heads = _name_columns(result.coordinates)
    heads += ["reachable", "conditioning", "hold", f"mobility of {result.body}", "unbalanced"]
    heads += _name_columns(result.inputs.names)
    measures = (result.reachable, result.conditioning, result.hold, result.mobility)
    grids = [*np.meshgrid(result.first, result.second, indexing="ij"), *measures, result.unbalanced]
    columns = [*(grid.ravel() for grid in grids), result.values.reshape(grids[0].size, -1)]
    _write_results(out, scene, settings, folder, "survey", result, heads, columns)


def _start(scene: "Scene", settings: Any) -> tuple["Inputs", "State"]:
    """Inputs that the options name, and the state at which the mechanism starts."""
    space, x = starting_point(scene, settings)
    inputs, _ = inputs_named(space, settings.inputs, x, scene.t0)
    return inputs, space.to_state(x, scene.t0)


def _name_columns(names: Iterable[tuple[str, str]]) -> list[str]:
    return [f"{name} [{unit}]" for name, unit in names]


def _write_results(
    out: Console, scene: "Scene", settings: Any, folder: Path, name: str, result: Any,
    heads: list[str], columns: list[np.ndarray],
) -> None:  # fmt: skip
    """Write the numbers of a result as a table, and its figure; print their paths."""
    from ...io.csv_table import write_csv_table

    paths = [write_csv_table(folder / f"{name}.csv", heads, columns, "%.17g")]
    if settings.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ...figures.plot import save_figures
        from ...figures.posture_survey import effort_histories, survey_map

        draw = {"efforts": effort_histories, "survey": survey_map}[name]
        figure = draw(result, scene.title or scene.name)
        paths += save_figures({name: figure}, folder, settings.figures)
    print_paths(out, paths)
