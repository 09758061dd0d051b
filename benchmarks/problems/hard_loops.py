"""Hard cases of closed loops and long times, and starts at which branches of the motion meet.

They go on where `hard.py` ends: loops with dependent rows, a slider-crank through its dead points,
2,000 s of a pendulum. A start at rest in a singular posture has no motion to compare with: it has to
be refused, and its joints named.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from problems.bricard import bricard, exact_centres, slope_of, swing
from problems.conservative import DOWN_Y, SMALL
from problems.hard import CRANK, ROD, G, Hard, Z, apart, four_bars, slider_crank, swinging

import stmuav_jax as stm

LOOPS, SPIN = 4, 12.0  # loops of the chain; rad/s of the crank at the start


def cube() -> tuple[stm.System, stm.State, np.ndarray]:
    """Bricard's linkage, released in the cube."""
    system = bricard()
    return system, system.reference, np.linspace(0.0, 5.0, 21)


def cube_off(run: Any) -> float:
    """Largest error of a rod's centre [m], against the linkage's motion in its one coordinate."""
    off = np.asarray(run.states.r) - exact_centres(np.asarray(run.ts))
    return float(np.max(np.linalg.norm(off, axis=2)))


def free_crank() -> tuple[stm.System, stm.State, np.ndarray]:
    """A slider-crank that is let go turning from a dead point, crank and rod in line."""
    return *slider_crank(SPIN), np.linspace(0.0, 5.0, 41)


def crank_bodies(phi: Any) -> tuple[np.ndarray, Any]:
    """Centres (3, 2) [m] and the rod's angle [rad] at an angle of the crank."""
    knee = CRANK * np.array([np.cos(phi), np.sin(phi)])
    lean = -np.arcsin(knee[1] / ROD)
    wrist = np.array([knee[0] + ROD * np.cos(lean), 0.0 * phi])
    return np.stack([knee / 2, (knee + wrist) / 2, wrist]), lean


def crank_inertia(phi: float) -> float:
    """Generalised inertia of the crank's angle [kg m^2]."""
    places, lean = (slope_of(lambda x, k=k: crank_bodies(x)[k], phi) for k in (0, 1))
    return float(np.sum(places**2) + SMALL[2] * (1 + lean**2))


def crank_off(run: Any) -> float:
    """Largest error of the slider [m], against the motion in the crank's angle alone."""
    potential = lambda x: G * np.sum(crank_bodies(x)[0][:, 1])
    phi = swing(crank_inertia, potential, 0.0, SPIN, np.asarray(run.ts))
    exact = np.array([crank_bodies(x)[0][2, 0] for x in phi])
    return apart(run, 2, exact[:, None])


LOOP_CASES: tuple[Hard, ...] = (
    Hard("redundant loops, Bricard", "one of 30 rows depends on the others wherever the loop closes",
         "equation of its one coordinate, SciPy at 1e-12", 1e-6, "m", cube, cube_off),
    Hard("redundant loops, four-bars", "four loops with twelve dependent rows, through postures in line",
         "closed form", 1e-4, "m", *four_bars(LOOPS)),
    Hard("dead points", "a free slider-crank turns from one dead point through the others",
         "equation of the crank's angle, SciPy at 1e-12", 1e-5, "m", free_crank, crank_off),
    Hard("2,000 s of a pendulum", "errors accumulate over 845 swings, rtol 1e-11",
         "closed form (elliptic functions)", 1e-3, "m", *swinging(1.0, 2000.0 * np.sqrt(G)),
         method={"rtol": 1e-11, "atol": 1e-11}),
)  # fmt: skip


def in_line(centre: float) -> stm.System:
    """A parallelogram whose rods all lie in line; `centre` is the last rod's, its foot at 1 m."""
    small = (1e-2, 1e-2, 1e-2)
    places = (0.5, 1.5, centre)
    bodies = [stm.Body(f"rod{k}", 1.0, small, position=(x, 0.0, 0.0)) for k, x in enumerate(places)]
    ends, names = (0.0, 1.0, 2.0, 1.0), ("ground", "rod0", "rod1", "rod2", "ground")
    joints = [
        stm.revolute(f"R{k}", names[k], names[k + 1], point=(ends[k], 0.0, 0.0), axis=Z)
        for k in range(4)
    ]
    return stm.System(bodies, joints, [stm.Gravity(DOWN_Y)])


STARTS: tuple[tuple[str, str, Callable[[], stm.System]], ...] = (
    ("folded four-bar", "its last rod's weight acts beyond its foot: no branch is in equilibrium",
     lambda: in_line(0.5)),
    ("four-bar in line", "its rods can fall as a parallelogram or crossed: both satisfy the "
     "constraints", lambda: in_line(1.5)),
)  # fmt: skip
