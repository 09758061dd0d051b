"""`stmuav trim` and `stmuav linearize`: a steady flight, and small departures from it."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.console import Console
from rich.table import Table

from ..mechanics.errors import ModelError, SettingError
from ..vehicle.parameters import Parameters


@dataclasses.dataclass
class Flight:
    """A steady flight of the UAV with its tracker."""

    phi: float | None = None
    """First angle of the panel [degrees]; default the initial one."""
    theta: float | None = None
    """Second angle of the panel [degrees]."""
    sun: tuple[float, float] | None = None
    """Point the panel at the sun instead: azimuth from north (y) to east (x) and elevation
    [degrees]."""
    climb: float = 0.0
    """Speed upwards [m/s]."""
    speed: float = 0.0
    """Level speed [m/s]."""
    course: float = 0.0
    """Direction of the level speed, from x (east) towards y (north) [degrees]."""
    turn: float = 0.0
    """Rate of turn, from x towards y [degrees/s]."""
    yaw: float = 0.0
    """Heading of the UAV's x axis, from x towards y [degrees]."""
    params: Path | None = None
    """TOML file with values that replace the table's."""
    out: Path | None = None
    """Folder for the results; default runs/trim or runs/linearize."""
    cache: bool = True
    """Keep compiled code in the user's cache folder for the next run."""


@dataclasses.dataclass
class Trim(Flight):
    """Find attitude, rotor speeds and actuator forces of a steady flight; write trim.json."""

    highest: float | None = None
    """Limit of the rotors' speeds [rad/s]."""
    lowest: float = 0.0
    """Least speed of the rotors [rad/s], with --highest."""
    force: float | None = None
    """Limit of the actuators' forces either way [N]."""
    by: tuple[str, ...] = ()
    """Parameters to which the trim's sensitivity is wanted, such as mass.panel_7."""


@dataclasses.dataclass
class Linearize(Flight):
    """Linearise about a steady flight; write A, B, C, D with names to linear.npz."""

    outputs: tuple[str, ...] = ()
    """States that are measured, such as omega_x; default all."""


def table_of(params: Path | None) -> Parameters:
    """Part II of the report, with the user's values."""
    from ..vehicle.airframe import PART_II
    from ..view.io import load_parameters

    return load_parameters(params, PART_II)


def wanted_of(command: Flight, table: Parameters) -> Any:
    """The flight that the options describe."""
    from ..study.trim import climb, cruise, steady_turn
    from ..vehicle.geometry import initial_angles

    if command.sun is not None and (command.phi is not None or command.theta is not None):
        raise SettingError("Give --sun or --phi and --theta, not both.")
    yaw, course = math.radians(command.yaw), math.radians(command.course)
    angles, sun = None, None
    if command.sun is not None:
        if command.turn:
            raise SettingError(
                "In a turn the panel would have to move to stay on the sun, which is no steady "
                "flight: give --phi and --theta with --turn."
            )
        azimuth, height = (math.radians(x) for x in command.sun)
        level = math.cos(height)
        sun = [level * math.sin(azimuth), level * math.cos(azimuth), math.sin(height)]
    else:
        first = np.asarray(initial_angles(table))
        given = (command.phi, command.theta)
        angles = [a if x is None else math.radians(x) for a, x in zip(first, given, strict=True)]
    if command.turn:
        assert angles is not None
        wanted = steady_turn(command.speed, math.radians(command.turn), angles, course, yaw)
    else:
        wanted = cruise(command.speed, course, angles, yaw, sun=sun)
    up = climb(command.climb, angles, yaw, sun=sun)
    return wanted._replace(v=wanted.v + up.v)


def _limits(command: Trim) -> Any:
    from ..study.trim import TrimLimits
    from ..vehicle.allocation import RotorLimits

    rotors = None if command.highest is None else RotorLimits(command.lowest, command.highest)
    if rotors is None and command.lowest:
        raise SettingError("--lowest is for rotors with a limit: give --highest too.")
    return TrimLimits(rotors, math.inf if command.force is None else command.force)


def _unknowns(found: Any) -> Any:
    """What a trim finds, as one vector: attitude (rotation vector), speeds, forces."""
    import jax.numpy as jnp

    from ..algebra.rotation import to_rotation_vector

    turned = to_rotation_vector(found.coordinates.p)
    return jnp.concatenate([turned, found.speeds, found.inputs.forces])


def _labels(count: int) -> list[tuple[str, str]]:
    """Names and units of `_unknowns`."""
    names = [(f"turn_{k}", "rad") for k in "xyz"]
    names += [(f"speed_{k + 1}", "rad/s") for k in range(count)]
    return [*names, ("force_2", "N"), ("force_3", "N")]


def _solved(command: Trim, table: Parameters, limits: Any) -> tuple[Any, dict[str, np.ndarray]]:
    """The trim, and its derivatives by parameters of the table, by name: (unknowns, shape of it)."""
    import jax.numpy as jnp

    from ..algebra.compiler import outer_jit
    from ..scenes.uav_tracker import uav_flyer
    from ..study.trim import TrimReason, trim

    wanted = wanted_of(command, table)
    values = {name: jnp.asarray(table.value(name), dtype=float) for name in command.by}

    def of(values: Any) -> Any:
        found = trim(uav_flyer(table.replaced(values)), wanted, limits, throw=False)
        return _unknowns(found), found

    if values:
        slopes, found = outer_jit(jax.jacfwd(of, has_aux=True))(values)
        if found.reason == TrimReason.VALID:
            return found, {k: np.asarray(v) for k, v in slopes.items()}
    return trim(uav_flyer(table), wanted, limits), {}


def run_trim(command: Trim) -> int:
    """Find the trim, print it, write trim.json; the exit code."""
    import json

    from ..view.io import versions, write_atomically

    table = table_of(command.params)
    found, slopes = _solved(command, table, _limits(command))
    unknowns = np.asarray(_unknowns(found))
    labels = _labels(len(found.speeds))
    out = Console()
    out.print(_trim_table(unknowns, labels))
    angles = ", ".join(f"{math.degrees(float(a)):.4f}" for a in found.coordinates.angles)
    out.print(
        f"Panel angles {angles} degrees. Accelerations left: {float(found.residual):.1e}; "
        f"{found.choices} dimensions of choice among the rotors' speeds, taken nearest each other.",
        highlight=False,
    )
    content = {
        "values": {name: float(v) for (name, _), v in zip(labels, unknowns, strict=True)},
        "units": dict(labels),
        "panel_angles_rad": [float(a) for a in found.coordinates.angles],
        "residual": float(found.residual),
        "conditioning": float(found.conditioning),
        "versions": versions(),
    }
    if slopes:
        content["sensitivities"] = {k: v.tolist() for k, v in slopes.items()}
        for name, slope in slopes.items():
            out.print(_slope_table(name, table, slope, labels))
    folder = command.out if command.out is not None else Path("runs") / "trim"
    path = write_atomically(folder / "trim.json", json.dumps(content, indent=2).encode())
    out.print(f"Written: {path}", highlight=False, soft_wrap=True)
    return 0


def _trim_table(unknowns: Any, labels: Sequence[tuple[str, str]]) -> Table:
    shown = Table("unknown", "value", "unit", title="Trim")
    for (name, unit), value in zip(labels, unknowns, strict=True):
        shown.add_row(name, f"{value:.6g}" if abs(value) > 1e-12 else "0", unit)
    return shown


def _slope_table(
    name: str, table: Parameters, slope: np.ndarray, labels: Sequence[tuple[str, str]]
) -> Table:
    """Derivatives by one parameter; of a larger one only for its entries that matter."""
    unit = table[name].unit
    flat = slope.reshape(len(labels), -1)
    entries = list(np.ndindex(slope.shape[1:]))
    heads = [name + (str(list(entry)) if entry else "") for entry in entries]
    shown = Table("by", *(f"{head} [{unit}]" for head in heads[:3]), title="Sensitivity")
    for (label, own), row in zip(labels, flat, strict=True):
        shown.add_row(f"{label} [{own}]", *(f"{x:.5g}" for x in row[:3]))
    return shown


def run_linearize(command: Linearize) -> int:
    """Linearise, print the modes, write linear.npz; the exit code."""
    from ..scenes.uav_tracker import uav_flyer
    from ..study.linear import linearize
    from ..study.trim import trim
    from ..view.tuning import save_linear

    if command.turn:
        raise ModelError(
            "A turn has no constant matrices in the world's axes: linearise a straight flight."
        )
    table = table_of(command.params)
    flyer = uav_flyer(table)
    found = trim(flyer, wanted_of(command, table))
    outputs = list(command.outputs) or None
    linear = linearize(flyer, found.coordinates, found.inputs, outputs=outputs)
    shown = Table("s [1/s]", "doubles in [s]", "states that take part", title="Modes")
    for mode in linear.modes():
        if abs(mode.s) < 1e-3:
            continue
        parts = ", ".join(f"{name} {100 * share:.0f} %" for name, share in mode.states[:3])
        shown.add_row(f"{mode.s:.4g}", f"{mode.doubling:.4g}", parts)
    out = Console()
    out.print(shown)
    out.print(
        "The other modes are those of a free rigid body, at zero. Least measure of "
        f"controllability {np.min(linear.controllability()):.2g}, of observability "
        f"{np.min(linear.observability()):.2g}.",
        highlight=False,
    )
    folder = command.out if command.out is not None else Path("runs") / "linearize"
    path = save_linear(linear, folder / "linear.npz")
    out.print(f"Written: {path}", highlight=False, soft_wrap=True)
    return 0
