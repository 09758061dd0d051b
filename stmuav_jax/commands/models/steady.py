"""Commands `stmuav trim SCENE` and `stmuav linearize SCENE`, on any mechanism."""

import dataclasses
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from rich.console import Console
from rich.table import Table

from ...checks.errors import SettingError
from ...figures.terminal import line, row, table
from ..options import ANGLE, END, SPEED, TURN, Figures, default, shared
from ..output import results_folder, written
from ..simulate import chosen_scene
from .point import PointSettings, inputs_named, scalars_by_name, starting_point

if TYPE_CHECKING:
    from ...dynamics.statespace.tree import TreeSpace
    from ...flight.equilibrium import Trim
    from ...flight.flight_trim import FlightTrim
    from ...flight.linear import Linear
    from ...flight.steady import FlightCondition


# End of the step responses.
StepEnd = Annotated[float | None, END, shared("t1"), default("as the modes ask")]
# Largest number of outputs in a figure of step responses.
_OUTPUTS = 6


@dataclasses.dataclass
class FlightSettings:
    """Options of a steady flight."""

    climb: Annotated[float, SPEED, shared("climb")] = 0.0
    speed: Annotated[float, SPEED, shared("speed")] = 0.0
    course: Annotated[float, ANGLE, shared("course")] = 0.0
    turn: Annotated[float, TURN, shared("turn")] = 0.0
    yaw: Annotated[float, ANGLE, shared("yaw")] = 0.0


@dataclasses.dataclass
class SteadySettings(FlightSettings, PointSettings):
    """Options of a steady motion of any mechanism."""

    inputs: Annotated[tuple[str, ...], shared("inputs"), default("all")] = ()
    free: Annotated[tuple[str, ...], default("none")] = ()
    """States that may differ from the start, such as hinge.angle."""
    accelerations: Annotated[tuple[str, ...], default("zero")] = ()
    """Wanted rates of velocities, such as rail.displacement_rate=2 [m/s^2, rad/s^2]."""


@dataclasses.dataclass
class TrimSettings(SteadySettings):
    """Options of a trim."""

    out: Annotated[Path | None, shared("out"), default("runs/trim_SCENE")] = None


@dataclasses.dataclass
class LinearSettings(SteadySettings):
    """Options of a linearisation."""

    about: Literal["start", "trim"] = "start"
    """The start, with the options' coordinates and rates, or the trim that is found from there."""
    outputs: Annotated[tuple[str, ...], default("all states")] = ()
    """States that are measured, such as hinge.angle."""
    t1: StepEnd = None
    out: Annotated[Path | None, shared("out"), default("runs/linearize_SCENE")] = None
    figures: Figures = "png"


TRIM = """Find the inputs, and states if wanted, of a steady motion of any mechanism; write trim.json.

Example: stmuav trim model.toml --coordinates hinge=0 --free rail.displacement. Without a scene or a model's
file the command trims the UAV with its tracker: stmuav trim --help. A mechanism with a floating base hovers,
climbs or turns: its attitude is found too.
"""
LINEAR = """Linearise any mechanism about its start, or about a trim; write A, B, C, D to linear.npz, the
poles and the step responses to figures.

Example: stmuav linearize model.toml --about trim --outputs hinge.angle. Without a scene or a model's file the
command linearises the flight of the UAV with its tracker: stmuav linearize --help.
"""


def flight_of(given: FlightSettings, angles: Any = None, sun: Any = None) -> "FlightCondition":
    """Flight condition of the options, with the panel at angles (2,) [rad] or at the sun (3,)."""
    from ...checks.numbers import floats
    from ...flight.steady import climb, cruise, steady_turn

    course, yaw = math.radians(given.course), math.radians(given.yaw)
    if given.turn:
        flight = steady_turn(given.speed, math.radians(given.turn), angles, course, yaw)
    else:
        flight = cruise(given.speed, course, angles, yaw, sun=sun)
    up = climb(given.climb, angles, yaw, sun=sun)
    return flight._replace(v=floats(np.asarray(flight.v) + np.asarray(up.v)))


def trimmed(space: "TreeSpace", x: Any, settings: SteadySettings, t: float) -> "Trim":
    """Trim from a point, of a floating base as a steady flight.

    Raises:
        SettingError: nothing may be chosen, an unknown name, or a flight of what does not float.
        StateError: there is no trim.
    """
    from ...dynamics.tree.topology import spanning_tree
    from ...flight.equilibrium import trim
    from ...flight.steady import trim_condition

    inputs = inputs_named(space, settings.inputs)
    if not len(inputs) and not settings.free:
        states = ", ".join(name for name, _ in space.names[: space.dof])
        raise SettingError(
            "This mechanism has no inputs that a trim could choose: name states that it may change "
            f"with --free, among {states}."
        )
    flying = (settings.climb, settings.speed, settings.turn, settings.yaw)
    if not spanning_tree(space.system).floating:
        if any(flying):
            raise SettingError("--climb, --speed, --turn and --yaw are for a floating base.")
        wanted = _wanted(space, settings)
        return trim(
            space, at=x, free=settings.free, inputs=inputs, accelerations=wanted, t=t,
        )  # fmt: skip
    if settings.accelerations:
        raise SettingError("--accelerations are for mechanisms on the ground; others fly steadily.")
    return trim_condition(space, flight_of(settings), at=x, free=settings.free, inputs=inputs)


def _wanted(space: "TreeSpace", settings: SteadySettings) -> np.ndarray:
    from ...checks.errors import named_places

    given = scalars_by_name(settings.accelerations, "--accelerations")
    names = [name for name, _ in space.names[space.dof : 2 * space.dof]]
    wanted = np.zeros(space.dof)
    places = named_places(list(given), names, "The wanted accelerations", "velocity")
    wanted[list(places)] = list(given.values())
    return wanted


def _changed(space: "TreeSpace", x: Any, found: "Trim") -> dict[str, tuple[float, str]]:
    """States that differ from the start, by how much, with their units."""
    moved = np.asarray(space.difference(found.point, x))
    named = zip(space.names, moved, strict=True)
    return {name: (float(v), unit) for (name, unit), v in named if abs(v) > 1e-12}


def modes_table(modes: Sequence[Any]) -> Table:
    """Table of the modes other than those of a free rigid body, which have eigenvalue zero."""
    from ...flight.linear import AT_ZERO

    shown = table("s [1/s]", "doubles or halves in [s]", "states that take part", title="Modes")
    for mode in modes:
        if abs(mode.eigenvalue) < AT_ZERO:
            continue
        s = f"{mode.eigenvalue.real:.4g}"
        if abs(mode.eigenvalue.imag) > 1e-9 * abs(mode.eigenvalue):
            s += f" {'+' if mode.eigenvalue.imag > 0 else '-'} {abs(mode.eigenvalue.imag):.4g} i"
        time = "neither"
        if math.isfinite(mode.doubling_time):
            time = f"{'doubles' if mode.doubling_time > 0 else 'halves'} in {abs(mode.doubling_time):.4g}"
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in mode.states[:3])
        row(shown, s, time, parts)
    return shown


def write_trim(
    out: Console, found: "Trim | FlightTrim", content: dict[str, Any], folder: Path
) -> None:
    """Write trim.json: the content, with what all trims have, and the versions."""
    from ...files.netcdf import versions, write_atomically

    content |= {
        "residual": float(found.residual),
        "conditioning": float(found.conditioning),
        "versions": versions(),
    }
    written(out, [write_atomically(folder / "trim.json", json.dumps(content, indent=2).encode())])


def run_trim_scene(command: Any) -> int:
    """Find the trim, print it and write trim.json; return the exit code."""
    scene, settings = chosen_scene(command), command.settings
    space, x = starting_point(scene, settings)
    found = trimmed(space, x, settings, scene.t0)
    moved = _changed(space, x, found)
    values = [float(v) for v in np.asarray(found.values)]
    shown = table("unknown", "value", "unit", title=f"Trim: {scene.title or scene.name}")
    for (name, unit), value in zip(found.inputs.names, values, strict=True):
        row(shown, f"input {name}", f"{value:.6g}", unit)
    for name, (value, unit) in moved.items():
        row(shown, f"change of {name}", f"{value:.6g}", unit)
    out = Console()
    out.print(shown)
    line(out, f"Accelerations left: {float(found.residual):.1e}.")
    content = {
        "inputs": {name: v for (name, _), v in zip(found.inputs.names, values, strict=True)},
        "changes": {name: value for name, (value, _) in moved.items()},
        "units": dict(found.inputs.names) | {name: unit for name, (_, unit) in moved.items()},
    }
    write_trim(out, found, content, results_folder(settings.out, f"trim_{scene.name}"))
    return 0


def run_linearize_scene(command: Any) -> int:
    """Linearise, print the modes and write linear.npz; return the exit code."""
    from ...flight.linear import linearize

    scene, settings = chosen_scene(command), command.settings
    space, x = starting_point(scene, settings)
    inputs, values = inputs_named(space, settings.inputs), None
    if settings.about == "trim":
        found = trimmed(space, x, settings, scene.t0)
        x, inputs, values = found.point, found.inputs, found.values
    outputs = list(settings.outputs) or None
    linear = linearize(space, x, inputs, values, outputs=outputs, t=scene.t0)
    states = ", ".join(f"{name} [{unit}]" for name, unit in linear.states)
    words = [f"States: {states}.", measures_of(linear)]
    if settings.about == "start":
        words.append("About the start: departures from the motion that begins there.")
    folder = results_folder(settings.out, f"linearize_{scene.name}")
    title = scene.title or scene.name
    print_linear(linear, words, folder, title, settings.figures, settings.t1)
    return 0


def print_linear(
    linear: "Linear",
    words: Sequence[str],
    folder: Path,
    title: str,
    figures: str,
    duration: float | None,
) -> None:
    """Print the modes of a linear system and sentences about it; write linear.npz and its figures."""
    from ...figures.tuning import save_linear

    out = Console()
    out.print(modes_table(linear.modes()))
    for sentence in words:
        line(out, sentence)
    paths = [save_linear(linear, folder / "linear.npz")]
    written(out, paths + _linear_figures(linear, title, folder, figures, duration))


def _linear_figures(
    linear: "Linear", title: str, folder: Path, figures: str, duration: float | None
) -> list[Path]:
    """Write the pole map and the step responses of a linear system; return their paths."""
    if figures == "none":
        return []
    # matplotlib is slow to import: only where figures are drawn
    from ...figures.linear import pole_map, step_response
    from ...figures.plot import save_figures

    drawn: dict[str, Any] = {"poles": pole_map(linear, title)}
    names = [name for name, _ in linear.outputs]
    for first in range(0, len(names) if linear.inputs else 0, _OUTPUTS):
        some = names[first : first + _OUTPUTS]
        name = "steps" if len(names) <= _OUTPUTS else f"steps_{first // _OUTPUTS + 1}"
        drawn[name] = step_response(linear, title, outputs=some, duration=duration)
    return save_figures(drawn, folder, figures)


def measures_of(linear: "Linear") -> str:
    """Sentence on the modes that inputs move and outputs show."""
    seen = f"of observability {np.min(linear.observability()):.2g}"
    if not linear.B.shape[1]:
        return f"There are no inputs. Least measure {seen}."
    return f"Least measure of controllability {np.min(linear.controllability()):.2g}, {seen}."
