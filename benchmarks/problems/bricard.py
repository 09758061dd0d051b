"""Bricard's linkage, problem A04 of the IFToMM library of computational benchmarks.

Five uniform rods of 1 m and 1 kg lie along edges of a cube, from (0, 0, 0) by (1, 0, 0),
(1, -1, 0), (1, -1, 1), (0, -1, 1) to (0, 0, 1); the sixth edge is ground. Each of the six corners
is a revolute joint across its two edges; g = 9.81 m/s^2 along -y, from rest.

The corners stay alternately on two circles about one axis, 60 degrees apart: of radius a and height
h/2, and of radius b and height -h/2. Edges of length 1 and hinges at right angles across them need

    a^2 + b^2 - a b + h^2 = 1,  a b = 2/3,  so that  a^2 = 5/6 + cos(phi) / 2,  h = sin(phi) / (2 a)

with one coordinate phi, in which the motion is that of one degree of freedom.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

import stmuav_jax as stm

G = 9.81  # m/s^2
CORNERS = np.array(
    [(0, 0, 0), (1, 0, 0), (1, -1, 0), (1, -1, 1), (0, -1, 1), (0, 0, 1)], dtype=float
)
AXES = [(0, 1, 0), (0, 0, 1), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)]
THIN = 1e-3  # kg m^2, along a rod
CUBE = float(np.arccos(-1 / 3))  # phi at the start
# Last edge, the axis of its hinge at the first corner, and their cross product.
GROUND = np.array([(0, 0, -1), (0, -1, 0), (-1, 0, 0)], dtype=float)


def bricard(last: Callable[..., stm.mechanics.Joint] = stm.revolute) -> stm.System:
    """The linkage, with the joint of its last corner."""
    rods = np.diff(CORNERS, axis=0)
    bodies = [
        stm.Body(
            f"rod{k}", 1.0, tuple((1 - np.abs(rod)) / 12 + THIN * np.abs(rod)),
            position=tuple(CORNERS[k] + rod / 2),
        )
        for k, rod in enumerate(rods)
    ]  # fmt: skip
    names = ["ground", *(body.name for body in bodies), "ground"]
    kinds = [stm.revolute] * 5 + [last]
    joints = [
        kind(f"R{k}", names[k], names[k + 1], point=tuple(CORNERS[k]), axis=AXES[k])
        for k, kind in enumerate(kinds)
    ]
    return stm.System(bodies, joints, [stm.Gravity((0.0, -G, 0.0))])


def swing(inertia: Any, potential: Any, start: float, rate: float, ts: np.ndarray) -> np.ndarray:
    """Coordinate x of M(x) x'' + M'(x) x'^2 / 2 + V'(x) = 0 at times [s], by SciPy at 1e-12.

    M and V are smooth and have the period 4 pi: their Fourier series converge to round-off.
    """
    count = 256
    first, places = 2 * np.pi / count, 4 * np.pi * (np.arange(count) + 0.5) / count
    waves = 0.5j * np.arange(count // 2 + 1)
    series = [
        np.fft.rfft([f(x) for x in places]) / count * np.where(waves == 0, 1, 2)
        for f in (inertia, potential)
    ]

    def moved(_: float, at: np.ndarray) -> list[float]:
        x, v = at
        now = np.exp(waves * (x - first))
        M, M_slope = (float(np.real(series[0] @ (now * w))) for w in (1, waves))
        V_slope = float(np.real(series[1] @ (now * waves)))
        return [v, -(0.5 * M_slope * v * v + V_slope) / M]

    how: dict[str, Any] = {"method": "DOP853", "rtol": 1e-12, "atol": 1e-13}
    return solve_ivp(moved, (ts[0], ts[-1]), [start, rate], t_eval=ts, **how).y[0]


def slope_of(f: Callable[[Any], Any], x: float) -> Any:
    """Derivative at a number by a complex step, without round-off of differences."""
    return np.imag(f(x + 1e-30j)) / 1e-30


def posture(phi: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners (6, 3) [m], edges and hinge axes (6, 3) in the world, ground being the last edge."""
    a = np.sqrt(5 / 6 + np.cos(phi) / 2)
    k, even = np.arange(6), np.arange(6) % 2 == 0
    radius, height = np.where(even, a, 2 / (3 * a)), np.where(even, 0.25, -0.25) * np.sin(phi) / a
    own = np.stack([radius * np.cos(k * np.pi / 3), radius * np.sin(k * np.pi / 3), height], 1)
    edges = np.roll(own, -1, axis=0) - own
    # sines of the angles between edges, with the signs that keep the axes smooth where they vanish
    sines = np.where(even, 2 / np.sqrt(3) * np.cos(phi / 2) / a**2, 1.5 * a * np.sin(phi / 2))
    axes = np.cross(np.roll(edges, 1, axis=0), edges) / sines[:, None]
    frame = np.stack([edges[5], axes[0], np.cross(edges[5], axes[0])])
    turn = GROUND.T @ frame
    return (own - own[0]) @ turn.T, edges @ turn.T, axes @ turn.T


def centres(phi: Any) -> np.ndarray:
    """Centres of the five rods (5, 3) [m]."""
    corners, *_ = posture(phi)
    return 0.5 * (corners[:5] + corners[1:])


def inertia(phi: float) -> float:
    """Generalised inertia of phi [kg m^2]."""
    _, edges, axes = posture(phi)
    across = np.cross(edges, axes)[:5]
    spin = np.sum(slope_of(lambda x: posture(x)[2][:5], phi) * across, axis=1)
    moves, turns = slope_of(centres, phi), slope_of(lambda x: posture(x)[1][:5], phi)
    return float(np.sum(moves**2) + np.sum(turns**2) / 12 + THIN * np.sum(spin**2))


def exact_centres(ts: np.ndarray) -> np.ndarray:
    """Centres of the five rods at times [s], (k, 5, 3) [m], from rest in the cube."""
    phi = swing(inertia, lambda x: G * np.sum(centres(x)[:, 1]), CUBE, 0.0, ts)
    return np.stack([centres(x) for x in phi])
