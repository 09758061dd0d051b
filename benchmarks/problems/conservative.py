"""Conservative problems: pendulums, the heavy top, the four-bar, and two trackers.

Sources: simple pendulum and N-four-bar are A01 and A02 of the IFToMM library of computational
benchmarks; spherical pendulum: E. T. Whittaker, Analytical Dynamics, section 55; heavy top:
M. Geradin, A. Cardona, Flexible Multibody Dynamics (2001). The trackers are those of the report's
Part I.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from problems import four_bar as loops

import stmuav_jax as stm

DOWN_Y, DOWN_Z = (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)  # m/s^2
SMALL = (1e-3, 1e-3, 1e-3)  # kg m^2, of point masses; plays no part
PANEL_RATE = (10.0, 15.0, 0.0)  # rad/s, body axes, before the joints have their say
MASS = 15.0  # kg, of the heavy top
INERTIA = (0.234375, 0.46875, 0.234375)  # kg m^2
FAST = (0.0, 150.0, -4.61538)  # rad/s, body axes
SLOW = (0.0, 1.5, -0.0461538)


class Problem(NamedTuple):
    """A conservative system and its start; redundant: whether cut joints have dependent rows."""

    name: str
    title: str
    system: stm.System
    state: stm.State
    redundant: bool = False


def moving(system: stm.System, v: Any, omega: Any) -> stm.State:
    """The reference posture with velocities v [m/s] and body-frame omega [rad/s], (n, 3) each."""
    rest = system.reference
    return stm.State(rest.r, rest.p, jnp.asarray(v, dtype=float), jnp.asarray(omega, dtype=float))


def _point_on_rod(start: tuple[float, float, float], gravity: Any) -> stm.System:
    bob = stm.Body("bob", 1.0, SMALL, position=start)
    rod = stm.distance("rod", "ground", "bob", point_i=(0.0, 0.0, 0.0), point_j=start)
    return stm.System([bob], [rod], [stm.Gravity(gravity)])


def simple_pendulum() -> Problem:
    """1 kg on a bar of 1 m, released at rest with the bar horizontal."""
    system = _point_on_rod((-1.0, 0.0, 0.0), DOWN_Y)
    return Problem("simple_pendulum", "simple pendulum", system, system.reference)


def spherical_pendulum() -> Problem:
    """The pendulum in space, released 60 degrees from hanging at 1.5 m/s across."""
    system = _point_on_rod((float(np.sin(np.pi / 3)), 0.0, -0.5), DOWN_Z)
    state = moving(system, [[0.0, 1.5, 0.0]], [[0.0, 0.0, 0.0]])
    return Problem("spherical_pendulum", "spherical pendulum", system, state)


def top(omega: tuple[float, float, float]) -> tuple[stm.System, stm.State]:
    """The heavy top with its axis along y, and its start."""
    body = stm.Body("top", MASS, INERTIA, com=(0.0, 1.0, 0.0))
    tip = stm.spherical("tip", "ground", "top", point=(0.0, 0.0, 0.0))
    system = stm.System([body], [tip], [stm.Gravity(DOWN_Z)])
    return system, moving(system, [np.cross(omega, (0.0, 1.0, 0.0))], [omega])


def heavy_top() -> Problem:
    """The heavy top at 1.5 rad/s about its axis: it swings like a pendulum, and turns."""
    return Problem("heavy_top", "heavy top, slow", *top(SLOW))


def four_bar() -> Problem:
    """Two loops; they pass postures where all rods lie in line, with dependent rows throughout."""
    system = loops.four_bar(2)
    return Problem("four_bar", "four-bar, N = 2", system, loops.start(system), True)


def _on_ground(gravity: Any) -> stm.System:
    joints = stm.uav.tracker_joints(stm.PART_I, stm.GROUND)
    return stm.System(stm.uav.tracker_bodies(stm.PART_I), joints, [stm.Gravity(gravity)])


def tracker_gravity() -> Problem:
    """The tracker on ground under gravity, released from the initial posture."""
    system = _on_ground(DOWN_Z)
    return Problem("tracker_gravity", "tracker, released under gravity", system, system.reference)


def tracker_turning() -> Problem:
    """The tracker on ground without gravity, its panel set turning."""
    # no gravity as a number, so that both trackers share their compilations
    system = _on_ground((0.0, 0.0, 0.0))
    omega = np.zeros((system.n_bodies, 3))
    omega[system.names.index("panel_7")] = PANEL_RATE
    state = stm.assemble(system, moving(system, np.zeros_like(omega), omega)).state
    return Problem(
        "tracker_turning", "tracker without gravity, with an initial rotation", system, state
    )


PROBLEMS: tuple[Callable[[], Problem], ...] = (
    simple_pendulum, spherical_pendulum, heavy_top, four_bar, tracker_gravity, tracker_turning,
)  # fmt: skip
