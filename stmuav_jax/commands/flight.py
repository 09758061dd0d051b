"""Commands `stmuav trim` and `stmuav linearize`: a steady flight, and its linear model."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from ..checks.errors import ModelError, SettingError
from ..figures.terminal import line, row, table
from .models.steady import (
    LINEAR,
    TRIM,
    FlightSettings,
    LinearSettings,
    StepEnd,
    TrimSettings,
    flight_of,
    measures_of,
    print_linear,
    run_linearize_scene,
    run_trim_scene,
    write_trim,
)
from .options import ANGLE, FORCE, Cache, Figures, Number, default, shared
from .output import results_folder
from .simulate import command_or_scene

if TYPE_CHECKING:
    from ..parameters.table import Parameters

_ROTOR = Number("speed of the rotors", "rad/s", 0.0, 1e5)


@dataclasses.dataclass
class SteadyFlight(FlightSettings):
    """A steady flight of the UAV with its tracker."""

    phi: Annotated[float | None, ANGLE, default("the initial one")] = None
    """First angle of the panel [degrees]."""
    theta: Annotated[float | None, ANGLE, default("the initial one")] = None
    """Second angle of the panel [degrees]."""
    sun: Annotated[
        tuple[float, float] | None, ANGLE, shared("sun"), default("panel at --phi and --theta")
    ] = None


# Its options stand beside the command's own, without a prefix.
_Flight = Annotated[SteadyFlight, tyro.conf.arg(name="")]


@dataclasses.dataclass
class TrimCommand:
    """Find attitude, rotor speeds and actuator forces of a steady flight; write trim.json.

    Example: stmuav trim --phi 10 --theta -5 --by mass.panel_7 geometry.rods. Another mechanism is trimmed by `stmuav
    trim model.toml`, or by a scene's name; `stmuav trim model.toml --help` describes that.
    """

    flight: _Flight = dataclasses.field(default_factory=SteadyFlight)
    highest: Annotated[float | None, _ROTOR, default("none")] = None
    """Largest speed of the rotors [rad/s]."""
    lowest: Annotated[float, _ROTOR] = 0.0
    """Smallest speed of the rotors [rad/s], with --highest."""
    force: Annotated[float | None, FORCE, default("none")] = None
    """Largest force of the actuators, either way [N]."""
    by: tuple[str, ...] = ()
    """Parameters by which the trim is differentiated, such as mass.panel_7."""
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    out: Annotated[Path | None, shared("out"), default("runs/trim")] = None
    cache: Cache = True


@dataclasses.dataclass
class Linearize:
    """Linearise about a steady flight; write A, B, C, D with names to linear.npz, poles and step responses to figures.

    Example: stmuav linearize --sun 150 60 --outputs phi theta. Another mechanism is linearised by `stmuav linearize
    model.toml`, or by a scene's name; `stmuav linearize model.toml --help` describes that.
    """

    flight: _Flight = dataclasses.field(default_factory=SteadyFlight)
    outputs: Annotated[tuple[str, ...], default("all")] = ()
    """States that are measured, such as omega_x."""
    params: Annotated[Path | None, shared("params"), default("the report's values")] = None
    t1: StepEnd = None
    out: Annotated[Path | None, shared("out"), default("runs/linearize")] = None
    figures: Figures = "png"
    cache: Cache = True


trim_options = command_or_scene(TrimCommand, "TrimScene", TrimSettings, TRIM)
linear_options = command_or_scene(Linearize, "LinearizeScene", LinearSettings, LINEAR)


def table_of(params: Path | None) -> "Parameters":
    """Parameter table of the report's Part II, with the user's values."""
    from ..files.netcdf import load_parameters
    from ..parameters.airframe import PART_II

    return load_parameters(params, PART_II)


def wanted_of(given: SteadyFlight, values: "Parameters") -> Any:
    """The flight condition that the options describe."""
    from ..tracker.geometry import initial_angles

    if given.sun is not None and (given.phi is not None or given.theta is not None):
        raise SettingError("Give --sun or --phi and --theta, not both.")
    if given.sun is not None:
        if given.turn:
            raise SettingError(
                "In a turn the panel would have to move to stay on the sun, which is no steady "
                "flight: give --phi and --theta with --turn."
            )
        azimuth, height = (math.radians(x) for x in given.sun)
        level = math.cos(height)
        sun = [level * math.sin(azimuth), level * math.cos(azimuth), math.sin(height)]
        return flight_of(given, sun=sun)
    first = np.asarray(initial_angles(values))
    own = (given.phi, given.theta)
    angles = [a if x is None else math.radians(x) for a, x in zip(first, own, strict=True)]
    return flight_of(given, angles)


def _limits(command: TrimCommand) -> Any:
    from ..flight.flight_trim import TrimLimits
    from ..rotorcraft.allocation import RotorLimits

    rotors = None if command.highest is None else RotorLimits(command.lowest, command.highest)
    if rotors is None and command.lowest:
        raise SettingError("--lowest is for rotors with a limit: give --highest too.")
    return TrimLimits(rotors, math.inf if command.force is None else command.force)


def _solved(
    command: TrimCommand, given: "Parameters", limits: Any
) -> tuple[Any, dict[str, np.ndarray]]:
    """The trim, and the derivatives of its values by parameters of the table, by name."""
    from ..checks.numbers import floats
    from ..flight.flight_trim import TrimReason, trim_flight
    from ..flight.slopes import trim_slopes
    from ..scenes.uav_tracker import uav_flyer

    wanted = wanted_of(command.flight, given)
    values = {name: floats(given.value(name)) for name in command.by}
    if values:
        build = lambda values: uav_flyer(given.replaced(values))
        found, slopes = trim_slopes(build, values, wanted, limits)
        if found.reason == TrimReason.VALID:
            return found, {k: np.asarray(v) for k, v in slopes.items()}
    return trim_flight(uav_flyer(given), wanted, limits), {}


def run_trim(command: Any) -> int:
    """Find the trim, print it and write trim.json; return the exit code."""
    if not isinstance(command, TrimCommand):
        return run_trim_scene(command)
    given = table_of(command.params)
    found, slopes = _solved(command, given, _limits(command))
    unknowns, labels = np.asarray(found.vector), found.names
    out = Console()
    out.print(_trim_table(unknowns, labels))
    degrees = [math.degrees(float(a)) for a in np.asarray(found.coordinates.angles)]
    angles = ", ".join(f"{a:.4f}" for a in degrees)
    line(
        out,
        f"Panel angles {angles} degrees. Accelerations left: {float(found.residual):.1e}; "
        f"{found.null_space_dimension} dimensions of choice among the rotors' speeds, taken nearest each other.",
    )
    content = {
        "values": {name: float(v) for (name, _), v in zip(labels, unknowns, strict=True)},
        "units": dict(labels),
        "panel_angles_deg": degrees,
    }
    if slopes:
        content["sensitivities"] = {k: v.tolist() for k, v in slopes.items()}
        for name, slope in slopes.items():
            out.print(_slope_table(name, given, slope, labels))
    write_trim(out, found, content, results_folder(command.out, "trim"))
    return 0


def _trim_table(unknowns: Any, labels: Sequence[tuple[str, str]]) -> Table:
    shown = table("unknown", "value", "unit", title="Trim")
    for (name, unit), value in zip(labels, unknowns, strict=True):
        row(shown, name, f"{value:.6g}" if abs(value) > 1e-12 else "0", unit)
    return shown


def _slope_table(
    name: str, given: "Parameters", slope: np.ndarray, labels: Sequence[tuple[str, str]]
) -> Table:
    """Table of derivatives by one parameter; of an array by its first three entries."""
    unit = given[name].unit
    flat = slope.reshape(len(labels), -1)
    entries = list(np.ndindex(slope.shape[1:]))
    heads = [name + (str(list(entry)) if entry else "") for entry in entries]
    title = "Sensitivity" + (f", 3 of {len(heads)} entries; all in trim.json" if heads[3:] else "")
    shown = table("by", *(f"{head} [{unit}]" for head in heads[:3]), title=title)
    for (label, own), values in zip(labels, flat, strict=True):
        row(shown, f"{label} [{own}]", *(f"{x:.5g}" for x in values[:3]))
    return shown


def run_linearize(command: Any) -> int:
    """Linearise, print the modes and write linear.npz; return the exit code."""
    if not isinstance(command, Linearize):
        return run_linearize_scene(command)
    from ..checks.numbers import floats
    from ..flight.flight_trim import trim_flight
    from ..flight.linear import linearize
    from ..scenes.uav_tracker import uav_flyer

    if command.flight.turn:
        raise ModelError(
            "A turn has no constant matrices in the world's axes: linearise a straight flight."
        )
    given = table_of(command.params)
    flyer = uav_flyer(given)
    found = trim_flight(flyer, wanted_of(command.flight, given))
    outputs = list(command.outputs) or None
    values = floats(np.concatenate([np.asarray(x) for x in found.inputs]))
    linear = linearize(flyer, found.coordinates, values=values, outputs=outputs)
    words = f"The other modes are those of a free rigid body, at zero. {measures_of(linear)}"
    title = "UAV with its tracker, in steady flight"
    folder = results_folder(command.out, "linearize")
    print_linear(linear, [words], folder, title, command.figures, command.t1)
    return 0
