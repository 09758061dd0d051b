"""State of a mechanism at which a command begins, from options that name joints, and searches by gradients."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from rich.console import Console
from rich.table import Table

from ..checks.errors import SettingError
from ..figures.terminal import print_line
from .check import CheckSettings
from .options import default_text
from .output import INTERRUPTED, print_paths, show_progress

if TYPE_CHECKING:
    from ..dynamics.simulation import Scene
    from ..dynamics.statespace.tree import TreeSpace
    from ..math.least_squares import Search
    from ..math.space import Point


@dataclasses.dataclass
class PointSettings(CheckSettings):
    """Options of commands that begin at a state of a mechanism."""

    coordinates: Annotated[tuple[str, ...], default_text("those of the start")] = ()
    """Coordinates of joints instead of those of the start, such as hinge=0.3 [rad, m]."""
    rates: Annotated[tuple[str, ...], default_text("those of the start")] = ()
    """Rates of these coordinates, such as hinge=1.5 [rad/s, m/s]; zero where only coordinates are given."""
    independent: Annotated[
        tuple[str, ...], default_text("those that the loops determine best")
    ] = ()
    """States that must be independent coordinates where loops are closed, such as A.angle."""


def values_by_name(assignments: Sequence[str], option: str) -> dict[str, Any]:
    """Numbers by name from words such as `hinge=0.3` or, for a vector, `ball=0.1,0.2,0`.

    Raises:
        SettingError: a word of another form, or a name that occurs twice.
    """
    result: dict[str, Any] = {}
    for word in assignments:
        name, equals, text = word.rpartition("=")
        try:
            numbers = [float(part) for part in text.split(",")]
        except ValueError:
            numbers = []
        if not (name and equals and numbers):
            raise SettingError(
                f"{option} takes names with numbers, such as A=0.3, not '{word[:80]}'."
            )
        if name in result:
            raise SettingError(f"{option} names {name[:80]} twice.")
        result[name] = numbers[0] if len(numbers) == 1 else numbers
    return result


def scalars_by_name(assignments: Sequence[str], option: str) -> dict[str, float]:
    """Numbers by name, see `values_by_name`; raises `SettingError` for a vector."""
    result = values_by_name(assignments, option)
    for name, value in result.items():
        if isinstance(value, list):
            raise SettingError(f"{option} takes one number for {name[:80]}, not {len(value)}.")
    return result


def starting_point(scene: "Scene", settings: PointSettings) -> tuple["TreeSpace", "Point"]:
    """State space of a scene's mechanism, and the point at its start, with the options' changes.

    Raises:
        SettingError: a name that is unknown, or a word that names no number.
        StateError: the mechanism has no such state. ModelError: a singular posture.
    """
    from ..dynamics.assembly.joint_start import state_from_joints
    from ..dynamics.statespace.tree import TreeSpace

    coordinates = values_by_name(settings.coordinates, "--coordinates")
    rates = values_by_name(settings.rates, "--rates")
    state = scene.state0
    if coordinates or rates:
        state = state_from_joints(scene.system, coordinates, rates, start=state, t=scene.t0)
    space = TreeSpace(scene.system, state, independent=settings.independent, t=scene.t0)
    return space, space.from_state(state)


def inputs_named(space: "TreeSpace", names: Sequence[str], x: "Point", t: float) -> tuple[Any, Any]:
    """Inputs of a mechanism, and their values at a point and time: those named, or all that are constant.

    An input that is a function of time and named is taken as a number from there on.
    """
    from ..mechanics.inputs import inputs_of

    every = inputs_of(space.system)
    inputs = every.chosen(list(names)) if names else every.constant(space.system)
    return inputs, inputs.values_at(space.system, space.to_state(x, t), t)


# --- searches by gradients: progress, checkpoints, and the final message


def run_search(settings: Any, folder: Path, problem: str, start: Any, run: Any) -> Any:
    """Call run(steps=, report=, resume=) with progress, checkpoints and the search to resume."""
    from ..figures.tuning import load_search, save_search

    path, steps = folder / "search.npz", settings.steps
    before = load_search(path, problem, start) if settings.resume else None
    with show_progress("compiling") as report:

        def report_step(now: "Search") -> None:
            losses = f"loss {now.history[-1]:.4g}, best {now.loss:.4g}"
            report(now.steps / steps, f"step {now.steps} of {steps}: {losses}")
            save_search(now, problem, path)

        return run(steps=steps, report=report_step, resume=before)


def report_search(
    search: "Search", table: Table, folder: Path, kind: str, figures: dict[str, Any],
    failure: str | None,
) -> int:  # fmt: skip
    """Draw the losses and other figures in a format, or none for "none"; print results and files.

    Args:
        failure: what is said of a search that has not succeeded; None for one that has.

    Returns:
        exit code.
    """
    from ..figures.plot import save_figures
    from ..figures.tuning import loss_history
    from ..math.least_squares import SearchReason

    paths = [folder / "search.npz"]
    if kind != "none":
        paths += save_figures({"loss": loss_history(search.history)} | figures, folder, kind)
    out = Console()
    out.print(table)
    print_line(out, search.describe())
    print_paths(out, paths)
    if search.reason is SearchReason.INTERRUPTED:
        return INTERRUPTED
    if failure is not None:
        print_line(Console(stderr=True), f"stmuav: {failure}")
    return 0 if failure is None else 1
