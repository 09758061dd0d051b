"""States of flying scenes and of the tracker from the numbers of their start."""

import numpy as np
from jaxtyping import Array, Float

from ..algebra.compiler import quick_jit
from ..algebra.rotation import product, turn_about
from ..checks.errors import StateError, check_finite, concrete
from ..checks.numbers import as_numpy, floats, stacked
from ..flight.flyer import FlyerPoint, whole_state
from ..mechanics.state import State
from ..parameters.table import Parameters
from ..tracker.geometry import initial_angles, tracker_geometry
from ..tracker.placement import posture
from ..tracker.tracker_options import PanelStart
from .flight_options import AbstractStart, BaseStart, FlightStart

# Note of a scene that starts elsewhere.
STARTED = "The start is not the report's."


def _numbers(start: object, *names: str) -> Float[Array, " k"]:
    values = [getattr(start, name) for name in names]
    for name, value in zip(names, values, strict=True):
        check_finite(value, f"The start's {name}", "")
    return stacked([floats(value) for value in values])


def _base(start: AbstractStart) -> tuple[Array, Array, Array, Array]:
    """Position, Euler parameters, velocity and angular velocity of the base."""
    turns = _numbers(start, "yaw", "pitch", "roll")
    r, v, omega = (
        _numbers(start, *names) for names in (("x", "y", "z"), ("vx", "vy", "vz"), ("p", "q", "r"))
    )
    return r, _turned(turns), v, omega


@quick_jit
def _turned(turns: Float[Array, "3"]) -> Float[Array, "4"]:
    """Euler parameters of turns about z, y and x, one after the other [rad]."""
    yaw, pitch, roll = (turn_about(turns[k], axis) for k, axis in enumerate((2, 1, 0)))
    return product(product(yaw, pitch), roll)


def _panel(start: PanelStart | FlightStart, table: Parameters) -> tuple[Array, Array]:
    """Panel angles and their rates."""
    given, usual = (start.phi, start.theta), initial_angles(table)
    for name, value in zip(("phi", "theta"), given, strict=True):
        if value is not None:
            check_finite(value, f"The start's {name}", "rad")
    angles = [u if g is None else floats(g) for g, u in zip(given, as_numpy(usual), strict=True)]
    return stacked(angles), _numbers(start, "phi_rate", "theta_rate")


def base_state(start: BaseStart) -> State:
    """State of the bare hexacopter."""
    r, p, v, omega = _base(start)
    return State(*(stacked([x]) for x in (r, p, v, omega)))


def panel_state(start: PanelStart, table: Parameters) -> State:
    """State of the tracker's six bodies on fixed ground.

    Raises:
        StateError: a posture out of the rods' reach; traced numbers give NaN there.
    """
    angles, rates = _panel(start, table)
    return _reached(posture(tracker_geometry(table), angles, rates), angles)


def flight_state(start: FlightStart, table: Parameters) -> State:
    """State of the seven bodies.

    Raises:
        StateError: a posture out of the rods' reach; traced numbers give NaN there.
    """
    r, p, v, omega = _base(start)
    angles, rates = _panel(start, table)
    shift = floats(table.value("mount.shift"))
    at = FlyerPoint(r, p, angles, v, omega, rates)
    return _reached(whole_state(tracker_geometry(table), shift, at), angles)


def _reached(state: State, angles: Float[Array, "2"]) -> State:
    if concrete(state.r) and not np.all(np.isfinite(np.asarray(state.r))):
        phi, theta = (float(angle) for angle in angles)
        raise StateError(
            f"The tracker cannot start with the panel angles phi = {phi:g} rad, theta = {theta:g} "
            "rad: its rods do not reach so far."
        )
    return state
