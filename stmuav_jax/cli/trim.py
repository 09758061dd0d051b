"""Command `stmuav trim`: a steady motion of the UAV or of any mechanism, and the linear model about it."""

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ..checks.errors import ModelError, SettingError, named_places
from ..figures.terminal import add_row, make_table, print_line
from .mechanism import (
    PointSettings,
    inputs_named,
    scalars_by_name,
    starting_point,
    values_by_name,
)
from .options import (
    ANGLE,
    FORCE,
    SPEED,
    TURN,
    Cache,
    Figures,
    Number,
    Params,
    default_text,
    shared_option,
)
from .output import print_paths, results_folder
from .scene_options import command_or_scene
from .simulate import chosen_scene

if TYPE_CHECKING:
    from ..analysis.equilibrium import FlightCondition, Trim
    from ..dynamics.simulation import Scene
    from ..dynamics.statespace.tree import TreeSpace
    from ..mechanics.inputs import Inputs
    from ..mechanics.parameters import Parameters
    from ..mechanics.state import State
    from ..mechanics.system import System
    from ..uav.flight import FlightTrim

_ROTOR = Number("speed of the rotors", "rad/s", 0.0, 1e5)
# Values of each coordinate of a survey between two limits.
_SAMPLES = 21
_ROUND_OFF = 1e-12  # numbers of a trim below it are round-off, in the units of the table


@dataclasses.dataclass
class FlightSettings:
    """Options of a steady flight."""

    climb: Annotated[float, SPEED, shared_option("climb")] = 0.0
    speed: Annotated[float, SPEED, shared_option("speed")] = 0.0
    course: Annotated[float, ANGLE, shared_option("course")] = 0.0
    turn: Annotated[float, TURN, shared_option("turn")] = 0.0
    yaw: Annotated[float, ANGLE, shared_option("yaw")] = 0.0


@dataclasses.dataclass
class SteadyFlight(FlightSettings):
    """A steady flight of the UAV with its tracker."""

    phi: Annotated[float | None, ANGLE, default_text("the initial one")] = None
    """First angle of the panel [degrees]."""
    theta: Annotated[float | None, ANGLE, default_text("the initial one")] = None
    """Second angle of the panel [degrees]."""
    sun: Annotated[
        tuple[float, float] | None, ANGLE, shared_option("sun", "panel at --phi and --theta")
    ] = None


@dataclasses.dataclass
class LinearSettings:
    """Options of a linear model."""

    linear: Literal["none", "trim", "start"] = "none"
    """Also linearise about the trim; or, instead of a trim, about a scene's start."""
    outputs: Annotated[tuple[str, ...], default_text("all states")] = ()
    """States that the linear model measures, such as omega_x or hinge.angle."""


# Its options stand beside the command's own, without a prefix.
_Flight = Annotated[SteadyFlight, tyro.conf.arg(name="")]
_Linear = Annotated[LinearSettings, tyro.conf.arg(name="")]


@dataclasses.dataclass
class TrimCommand:
    """Find attitude, rotor speeds and actuator forces of a steady flight; write trim.json.

    With --linear also the modes, and A, B, C, D with names to linear.npz.

    Example: stmuav trim --phi 10 --theta -5 --by mass.panel_7 geometry.rods; stmuav trim --sun 150 60 --linear trim.
    Another mechanism is trimmed by `stmuav trim model.toml`, or by a scene's name; `stmuav trim model.toml --help`
    describes that.
    """

    flight: _Flight = dataclasses.field(default_factory=SteadyFlight)
    highest: Annotated[float | None, _ROTOR, default_text("none")] = None
    """Largest speed of the rotors [rad/s]."""
    lowest: Annotated[float, _ROTOR] = 0.0
    """Smallest speed of the rotors [rad/s], with --highest."""
    force: Annotated[float | None, FORCE, default_text("none")] = None
    """Largest force of the actuators, either way [N]."""
    by: tuple[str, ...] = ()
    """Parameters by which the trim is differentiated, such as mass.panel_7."""
    model: _Linear = dataclasses.field(default_factory=LinearSettings)
    params: Params = None
    out: Annotated[Path | None, shared_option("out", "runs/trim")] = None
    cache: Cache = True


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


@dataclasses.dataclass
class TrimSettings(LinearSettings, FlightSettings, PostureSettings):
    """Options of a steady motion of any mechanism."""

    inputs: Annotated[tuple[str, ...], shared_option("inputs", "all")] = ()
    free: Annotated[tuple[str, ...], default_text("none")] = ()
    """States that may differ from the start, such as hinge.angle."""
    accelerations: Annotated[tuple[str, ...], default_text("zero")] = ()
    """Target rates of velocities, such as rail.displacement_rate=2 [m/s^2, rad/s^2]."""
    out: Annotated[Path | None, shared_option("out", "runs/trim_SCENE_CASE or runs/trim_MODEL")] = (
        None
    )


ABOUT = """Find the inputs, and optionally states, of a steady motion of any mechanism; write trim.json.

With --linear also the modes, and A, B, C, D with names to linear.npz. With --path or --survey instead of a trim:
the inputs along a path of joints, or a map of postures.

Example: stmuav trim model.toml --coordinates hinge=0 --free rail.displacement; stmuav trim model.toml --linear start
--outputs hinge.angle; stmuav trim model.toml --path motion.csv. Without a scene or a model's file the command
trims the UAV with its tracker: stmuav trim --help. A mechanism with a floating base hovers, climbs or turns: its
attitude is found too.
"""

trim_options = command_or_scene(TrimCommand, "TrimScene", TrimSettings, ABOUT)


def flight_of(settings: FlightSettings, angles: Any = None, sun: Any = None) -> "FlightCondition":
    """Flight condition of the options, with the panel at angles (2,) [rad] or at the sun (3,)."""
    from ..analysis.equilibrium import climb, cruise, steady_turn
    from ..checks.numbers import as_floats

    course, yaw = math.radians(settings.course), math.radians(settings.yaw)
    if settings.turn:
        flight = steady_turn(settings.speed, math.radians(settings.turn), angles, course, yaw)
    else:
        flight = cruise(settings.speed, course, angles, yaw, sun=sun)
    # Climb and cruise are conditions of one velocity each, and add.
    up = climb(settings.climb, angles, yaw, sun=sun)
    return flight._replace(v=as_floats(np.asarray(flight.v) + np.asarray(up.v)))


def trim_space(space: "TreeSpace", x: Any, settings: TrimSettings, t: float) -> "Trim":
    """Trim from a point, of a floating base as a steady flight.

    Raises:
        SettingError: nothing may be chosen, an unknown name, or a flight of what does not float.
        StateError: there is no trim.
    """
    from ..analysis.equilibrium import trim, trim_condition
    from ..dynamics.tree.topology import spanning_tree

    inputs, values = inputs_named(space, settings.inputs, x, t)
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
        wanted_rates = scalars_by_name(settings.accelerations, "--accelerations")
        names = [name for name, _ in space.names[space.dof : 2 * space.dof]]
        subject, target = "The target accelerations", np.zeros(space.dof)
        target[list(named_places(list(wanted_rates), names, subject, "velocity"))] = list(
            wanted_rates.values()
        )
        return trim(
            space, at=x, free=settings.free, inputs=inputs, values=values, accelerations=target, t=t,
        )  # fmt: skip
    if settings.accelerations:
        raise SettingError(
            "--accelerations needs a mechanism on the ground; a floating one flies steadily (--climb, --speed, --turn)."
        )
    return trim_condition(
        space, flight_of(settings), at=x, free=settings.free, inputs=inputs, values=values
    )


def rotor_speeds(
    system: "System", inputs: "Inputs", values: Sequence[float], highest: float | None = None
) -> tuple[dict[str, dict[str, float | None]], Table]:
    """Speeds of the rotors whose squares are inputs, by the name of the input, and a table of them.

    A rotor has its speed [rad/s], thrust [N], and share of the highest speed, None without limit; one of a
    negative square is left out.

    Args:
        highest: highest speed of all rotors [rad/s], by default that of their motors, if they have one.
    """
    from ..uav.motor import MotorRotors

    heads = ("rotor", "speed [rad/s]", "per minute", "thrust [N]", "of the highest speed")
    rotors, table = {}, make_table(*heads, title="Rotors", right=1)
    for entry, squared in zip(inputs.entries, values, strict=True):
        # A trim without limits may ask for thrust downwards, which no speed of the rotor gives.
        if not entry.field.endswith("speed_squared") or squared < 0:
            continue
        force: Any = system.forces[entry.force]
        limits = force.limits if isinstance(force, MotorRotors) else None
        thrust = float(force.rotors.thrusts(squared))
        speed, limit = math.sqrt(squared), highest
        if limit is None and limits is not None:
            limit = float(np.asarray(limits.highest)[entry.place])
        share = None if limit is None else speed / limit
        rotors[entry.name] = {"speed": speed, "thrust": thrust, "share": share}
        place = entry.name.removeprefix("speed_squared_")
        percent = "-" if share is None else f"{100 * share:.1f} %"
        per_minute = f"{speed * 30 / math.pi:,.0f}"
        add_row(table, place, f"{speed:.6g}", per_minute, f"{thrust:.4g}", percent)
    return rotors, table


def modes_table(modes: Sequence[Any]) -> Table:
    """Table of the modes other than those of a free rigid body, whose eigenvalues are zero."""
    from ..analysis.linear import AT_ZERO

    heads = ("s [1/s]", "doubles or halves in [s]", "states that take part")
    mode_table = make_table(*heads, title="Modes")
    for mode in modes:
        # Round-off splits the multiple eigenvalue at zero into a small circle, whose numbers mean nothing.
        if abs(mode.eigenvalue) < AT_ZERO:
            continue
        s = f"{mode.eigenvalue.real:.4g}"
        if abs(mode.eigenvalue.imag) > 1e-9 * abs(mode.eigenvalue):
            s += f" {'+' if mode.eigenvalue.imag > 0 else '-'} {abs(mode.eigenvalue.imag):.4g} i"
        time = "neither"
        if math.isfinite(mode.doubling_time):
            time = f"{'doubles' if mode.doubling_time > 0 else 'halves'} in {abs(mode.doubling_time):.4g}"
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in mode.states[:3])
        add_row(mode_table, s, time, parts or mode.refusal)
    return mode_table


def count_modes_at_zero(modes: Sequence[Any]) -> str:
    """Sentence on the modes that `modes_table` leaves out; empty if there are none."""
    from ..analysis.linear import AT_ZERO

    count = sum(abs(mode.eigenvalue) < AT_ZERO for mode in modes)
    if not count:
        return ""
    return (
        f"Not listed: {count} of {len(modes)} modes with |s| below {AT_ZERO:g} 1/s, those of a free rigid "
        "body or slower ones."
    )


def write_trim(
    out: Console, result: "Trim | FlightTrim", content: dict[str, Any], folder: Path
) -> None:
    """Print the residuals, and write trim.json: the content, with what all trims have, and the versions."""
    from ..analysis.equilibrium import find_largest_residuals, format_residuals
    from ..io.netcdf import list_versions, write_atomically

    residuals = result.residuals, result.residual_units
    print_line(out, f"Residual accelerations: {format_residuals(*residuals)}.")
    content |= {
        "residuals": find_largest_residuals(*residuals),
        "conditioning": float(result.conditioning),
        "versions": list_versions(),
    }
    print_paths(
        out, [write_atomically(folder / "trim.json", json.dumps(content, indent=2).encode())]
    )


def run_trim(command: Any) -> int:
    """Find the trim, print it and write trim.json, and the linear model if asked; return the exit code."""
    return _run_uav(command) if isinstance(command, TrimCommand) else _run_scene(command)


def _run_scene(command: Any) -> int:
    scene, settings = chosen_scene(command), command.settings
    folder, title = results_folder(settings.out, f"trim_{scene.name}"), scene.title or scene.name
    flying = (settings.climb, settings.speed, settings.turn, settings.yaw)
    if settings.path is not None or settings.survey:
        if settings.path is not None and settings.survey:
            raise SettingError(
                "The options --path and --survey exclude each other: give one of them."
            )
        others = (settings.free, settings.accelerations, settings.outputs, *flying)
        if settings.linear != "none" or any(others):
            raise SettingError(
                "--path and --survey exclude --linear, --free, --accelerations and the options of a flight: "
                "leave those out."
            )
        (write_survey if settings.survey else write_path)(scene, settings, folder)
        return 0
    space, x = starting_point(scene, settings)
    inputs, values = None, None
    if settings.linear != "start":
        trim_result = trim_space(space, x, settings, scene.t0)
        _write_scene_trim(space, x, trim_result, folder, title)
        x, inputs, values = trim_result.point, trim_result.inputs, trim_result.values
    if settings.linear == "none":
        return 0
    notes = ["States: " + ", ".join(f"{name} [{unit}]" for name, unit in space.names) + "."]
    if settings.linear == "start":
        inputs, values = inputs_named(space, settings.inputs, x, scene.t0)
        # Without equilibrium the model is of the difference of two motions, not of a motion about a point.
        notes.append("About the start: departures from the motion that begins there.")
    _write_linear(space, x, inputs, values, settings, notes, folder, scene.t0)
    return 0


def _write_scene_trim(
    space: "TreeSpace", x: Any, trim_result: "Trim", folder: Path, title: str
) -> None:
    """Print a trim of any mechanism and write it to trim.json."""
    departure = np.asarray(space.difference(trim_result.point, x))
    # The search moves every state by round-off; only what the trim has chosen is listed.
    changes = {
        name: (float(value), unit)
        for (name, unit), value in zip(space.names, departure, strict=True)
        if abs(value) > _ROUND_OFF
    }
    names = trim_result.inputs.names
    values = [float(v) for v in np.asarray(trim_result.values)]
    rotors, rotor_table = rotor_speeds(space.system, trim_result.inputs, values)
    # A squared speed tells a reader little: the rotors' table has speeds and thrusts.
    unknowns = {
        f"input {name}": (value, unit)
        for (name, unit), value in zip(names, values, strict=True)
        if name not in rotors
    }
    # States of the motors are the speeds that the rotors' table lists already.
    unknowns |= {
        f"change of {name}": change
        for name, change in changes.items()
        if not rotors or ": speed of rotor " not in name
    }
    out = Console()
    if unknowns:
        out.print(_trim_table(unknowns, f"Trim: {title}"))
    if rotors:
        out.print(rotor_table)
    for note in trim_result.notes:
        print_line(out, f"Note: {note}")
    content = {
        "inputs": {name: v for (name, _), v in zip(names, values, strict=True)},
        "rotors": rotors,
        "changes": {name: value for name, (value, _) in changes.items()},
        "units": dict(names) | {name: unit for name, (_, unit) in changes.items()},
        "notes": list(trim_result.notes),
    }
    write_trim(out, trim_result, content, folder)


# --- many postures instead of one trim


def write_path(scene: "Scene", settings: Any, folder: Path) -> None:
    """Print the largest inputs along the path of a file; write all of them to efforts.csv and a figure.

    Raises:
        SettingError: a file without joints, a column that is no joint, or times that do not increase.
        ModelError: the path does not determine the motion. StateError: it stops.
    """
    from ..analysis.path_inverse_dynamics import inverse_dynamics
    from ..checks.numbers import increasing_times
    from ..dynamics.assembly.joint_start import state_from_joints
    from ..io.csv_table import read_csv_table
    from ..math.sampled import Sampled

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
    from ..analysis.posture_survey import survey

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
    from ..io.csv_table import write_csv_table

    paths = [write_csv_table(folder / f"{name}.csv", heads, columns, "%.17g")]
    if settings.figures != "none":
        # matplotlib is slow to import: only where figures are drawn
        from ..figures.plot import save_figures
        from ..figures.posture_survey import effort_histories, survey_map

        draw = {"efforts": effort_histories, "survey": survey_map}[name]
        figure = draw(result, scene.title or scene.name)
        paths += save_figures({name: figure}, folder, settings.figures)
    print_paths(out, paths)


# --- the UAV with its tracker, whose trim observes limits


def _solve_uav(
    command: TrimCommand, parameters: "Parameters", limits: Any
) -> tuple[Any, Any, dict[str, np.ndarray]]:
    """The UAV, its trim, and the derivatives of the trim's values by parameters of the table, by name."""
    from ..checks.numbers import as_floats
    from ..uav.flight import TrimReason, trim_flight, trim_slopes
    from ..uav.scenes.uav_tracker import make_uav
    from ..uav.tracker.geometry import initial_angles
    from .view import towards_sun

    settings = command.flight
    option_angles = (settings.phi, settings.theta)
    if settings.sun is None:
        first = np.asarray(initial_angles(parameters))
        target = flight_of(settings, [
            a if x is None else math.radians(x) for a, x in zip(first, option_angles, strict=True)
        ])  # fmt: skip
    elif option_angles != (None, None):
        raise SettingError("The option --sun excludes --phi and --theta: give one or the others.")
    elif settings.turn:
        raise SettingError(
            "--sun is for straight flights, since in a turn the panel would have to move: give "
            "--phi and --theta with --turn."
        )
    else:
        target = flight_of(settings, sun=towards_sun(*settings.sun))
    uav = make_uav(parameters)
    # Parameters to be differentiated by are traced, so that the whole construction of the UAV is part of
    # the derivative.
    values = {name: as_floats(parameters.value(name)) for name in command.by}
    if values:
        build = lambda values: make_uav(parameters.replaced(values))
        trim_result, slopes = trim_slopes(build, values, target, limits)
        if trim_result.reason == TrimReason.VALID:
            return uav, trim_result, {k: np.asarray(v) for k, v in slopes.items()}
    return uav, trim_flight(uav, target, limits), {}


def _run_uav(command: TrimCommand) -> int:
    from ..io.netcdf import load_parameters
    from ..uav.airframe import PART_II
    from ..uav.allocation import RotorLimits
    from ..uav.flight import TrimLimits

    is_linear = command.model.linear == "trim"
    if command.model.linear == "start":
        raise SettingError("--linear start is for a scene or a model's file: name one after trim.")
    if is_linear and command.flight.turn:
        raise ModelError(
            "A turn has no constant matrices in the world's axes: linearise a straight flight."
        )
    parameters = load_parameters(command.params, PART_II)
    limits = None if command.highest is None else RotorLimits(command.lowest, command.highest)
    if limits is None and command.lowest:
        raise SettingError("--lowest is for rotors with a limit: give --highest too.")
    limits = TrimLimits(limits, math.inf if command.force is None else command.force)
    uav, trim_result, slopes = _solve_uav(command, parameters, limits)
    unknowns, labels = np.asarray(trim_result.vector).tolist(), trim_result.names
    out = Console()
    rotors, rotor_table = rotor_speeds(
        uav.system, uav.inputs, np.asarray(trim_result.values).tolist(), command.highest
    )
    pairs = {name: (value, unit) for (name, unit), value in zip(labels, unknowns, strict=True)}
    listed = {name: pair for name, pair in pairs.items() if not name.startswith("speed_")}
    out.print(_trim_table(listed, "Trim"))
    out.print(rotor_table)
    degrees = [math.degrees(float(a)) for a in np.asarray(trim_result.angles)]
    angles = ", ".join(f"{a:.4f}" for a in degrees)
    print_line(
        out,
        f"Panel angles {angles} degrees; {trim_result.null_space_dimension} dimensions of choice among the rotors' "
        "speeds, taken nearest each other.",
    )
    content = {
        "values": {name: value for name, (value, _) in pairs.items()},
        "units": dict(labels),
        "rotors": rotors,
        "panel_angles_deg": degrees,
    }
    if slopes:
        content["sensitivities"] = {k: v.tolist() for k, v in slopes.items()}
    for by, slope in slopes.items():
        # of an array its first three entries
        heads = [by + (str(list(k)) if k else "") for k in np.ndindex(slope.shape[1:])]
        title = (
            f"Sensitivity, 3 of {len(heads)} entries; all in trim.json"
            if heads[3:]
            else "Sensitivity"
        )
        heads = [f"{head} [{parameters[by].unit}]" for head in heads[:3]]
        slope_table = make_table("by", *heads, title=title)
        for (name, unit), row in zip(labels, slope.reshape(len(labels), -1), strict=True):
            add_row(slope_table, f"{name} [{unit}]", *(f"{x:.5g}" for x in row[:3]))
        out.print(slope_table)
    folder = results_folder(command.out, "trim")
    write_trim(out, trim_result, content, folder)
    if is_linear:
        notes = ["The other modes are those of a free rigid body, at zero."]
        _write_linear(
            uav.space, trim_result.point, uav.inputs, trim_result.values, command.model, notes, folder
        )  # fmt: skip
    return 0


def _trim_table(unknowns: Mapping[str, tuple[float, str]], title: str) -> Table:
    unknown_table = make_table("unknown", "value", "unit", title=title)
    for name, (value, unit) in unknowns.items():
        add_row(unknown_table, name, f"{value:.6g}" if abs(value) > _ROUND_OFF else "0", unit)
    return unknown_table


# --- the linear model


def _write_linear(
    space: "TreeSpace", x: Any, inputs: Any, values: Any, settings: LinearSettings,
    notes: Sequence[str], folder: Path, t: float = 0.0,
) -> None:  # fmt: skip
    """Linearise about a point, print the modes and write linear.npz."""
    from ..analysis.linear import linearize
    from ..figures.tuning import save_linear

    outputs = list(settings.outputs) or None
    linear = linearize(space, x, inputs, values, outputs=outputs, t=t)
    out, modes = Console(), linear.modes()
    out.print(modes_table(modes))
    measures = f"of observability {np.min(linear.observability()):.2g}"
    if linear.B.shape[1]:
        measures = (
            f"Smallest measure of controllability {np.min(linear.controllability()):.2g}, {measures}, over all "
            "modes (1 is full, 0 is none)."
        )
    else:
        measures = f"There are no inputs. Smallest measure {measures} (1: fully observable, 0: unobservable)."
    for sentence in filter(None, (count_modes_at_zero(modes), *notes, measures)):
        print_line(out, sentence)
    print_paths(out, [save_linear(linear, folder / "linear.npz")])
