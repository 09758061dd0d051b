"""Conservative problems for long horizons: four published ones and two trackers.

Sources: simple pendulum and N-four-bar are A01 and A02 of the IFToMM library of computational
benchmarks; spherical pendulum: E. T. Whittaker, Analytical Dynamics, section 55; heavy top:
M. Geradin, A. Cardona, Flexible Multibody Dynamics (2001), with a hundredth of its spin. The
numbers are those of tests/published, the trackers those of the report's Part I.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np

import stmuav_jax as sj

DOWN_Y, DOWN_Z = (0.0, -9.81, 0.0), (0.0, 0.0, -9.81)  # m/s^2
SMALL = (1e-3, 1e-3, 1e-3)  # kg m^2, of point masses; plays no part
PANEL_RATE = (10.0, 15.0, 0.0)  # rad/s, body axes, before the joints have their say


@dataclass(frozen=True)
class Problem:
    """A conservative system and its start.

    Attributes:
        name, title: for records and figures.
        redundant: whether the cut joints have dependent rows.
    """

    name: str
    title: str
    system: sj.System
    state: sj.State
    redundant: bool = False


def _moving(system: sj.System, v: Any, omega: Any) -> sj.State:
    rest = system.reference
    return sj.State(rest.r, rest.p, jnp.asarray(v, dtype=float), jnp.asarray(omega, dtype=float))


def _point_on_rod(start: tuple[float, float, float], gravity: Any) -> sj.System:
    bob = sj.Body("bob", 1.0, SMALL, position=start)
    rod = sj.distance("rod", "ground", "bob", point_i=(0.0, 0.0, 0.0), point_j=start)
    return sj.System([bob], [rod], [sj.Gravity(gravity)])


def simple_pendulum() -> Problem:
    """1 kg on a bar of 1 m, released at rest with the bar horizontal."""
    system = _point_on_rod((-1.0, 0.0, 0.0), DOWN_Y)
    return Problem("simple_pendulum", "simple pendulum", system, system.reference)


def spherical_pendulum() -> Problem:
    """The same in space, released 60 degrees from hanging at 1.5 m/s across."""
    system = _point_on_rod((float(np.sin(np.pi / 3)), 0.0, -0.5), DOWN_Z)
    state = _moving(system, [[0.0, 1.5, 0.0]], [[0.0, 0.0, 0.0]])
    return Problem("spherical_pendulum", "spherical pendulum", system, state)


def heavy_top() -> Problem:
    """The heavy top at 1.5 rad/s about its axis: it swings like a pendulum, and turns."""
    body = sj.Body("top", 15.0, (0.234375, 0.46875, 0.234375), com=(0.0, 1.0, 0.0))
    tip = sj.spherical("tip", "ground", "top", point=(0.0, 0.0, 0.0))
    system = sj.System([body], [tip], [sj.Gravity(DOWN_Z)])
    omega = (0.0, 1.5, -0.0461538)
    state = _moving(system, [np.cross(omega, (0.0, 1.0, 0.0))], [omega])
    return Problem("heavy_top", "heavy top, slow", system, state)


def four_bar() -> Problem:
    """N = 2: three cranks and two couplers of 1 m and 1 kg, upright, B_0 at 1 m/s in x.

    It passes postures where all rods lie in line and has dependent rows throughout.
    """
    across, along, z = 1 / 12, 1e-3, (0.0, 0.0, 1.0)
    bodies, joints = [], []
    for i in range(3):
        place = (float(i), 0.5, 0.0)
        bodies.append(sj.Body(f"crank{i}", 1.0, (across, along, across), position=place))
        pivot = (float(i), 0.0, 0.0)
        joints.append(sj.revolute(f"A{i}", "ground", f"crank{i}", point=pivot, axis=z))
    for i in range(2):
        place = (i + 0.5, 1.0, 0.0)
        bodies.append(sj.Body(f"coupler{i}", 1.0, (along, across, across), position=place))
        for k, side in ((i, "left"), (i + 1, "right")):
            name, point = f"B{i} {side}", (float(k), 1.0, 0.0)
            joints.append(sj.revolute(name, f"crank{k}", f"coupler{i}", point=point, axis=z))
    system = sj.System(bodies, joints, [sj.Gravity(DOWN_Y)])
    crank = np.arange(5)[:, None] < 3
    v = np.where(crank, 0.5, 1.0) * [1.0, 0.0, 0.0]
    omega = np.where(crank, -1.0, 0.0) * [0.0, 0.0, 1.0]
    return Problem("four_bar", "four-bar, N = 2", system, _moving(system, v, omega), True)


def tracker_gravity() -> Problem:
    """The tracker on ground under gravity, released from the initial posture."""
    bodies, joints = sj.tracker_bodies(sj.PART_I), sj.tracker_joints(sj.PART_I, sj.GROUND)
    system = sj.System(bodies, joints, [sj.Gravity(DOWN_Z)])
    return Problem("tracker_gravity", "tracker, released under gravity", system, system.reference)


def tracker_turning() -> Problem:
    """The tracker on ground without gravity, its panel set turning."""
    bodies, joints = sj.tracker_bodies(sj.PART_I), sj.tracker_joints(sj.PART_I, sj.GROUND)
    # no gravity as a number, so that both trackers share their compilations
    system = sj.System(bodies, joints, [sj.Gravity((0.0, 0.0, 0.0))])
    omega = np.zeros((len(bodies), 3))
    omega[system.names.index("panel_7")] = PANEL_RATE
    state = sj.assemble(system, _moving(system, np.zeros_like(omega), omega)).state
    return Problem("tracker_turning", "tracker without gravity, set turning", system, state)


PROBLEMS: tuple[Callable[[], Problem], ...] = (
    simple_pendulum,
    spherical_pendulum,
    heavy_top,
    four_bar,
    tracker_gravity,
    tracker_turning,
)
