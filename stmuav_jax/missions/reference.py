"""References of a mission as functions of time: the base's path and the panel's moves."""

import math
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.derivative import motion_along
from ..algebra.rotation import rotation_matrix
from ..algebra.sampled import Sampled, piecewise
from ..checks.errors import SettingError
from ..control.design.shape import rise
from ..control.geometric import Waypoint, along, at_point
from ..mechanics.state import State
from ..tracker.kinematics import PairMotion, panel_angles


class HeldPath(eqx.Module):
    """Path that holds a place, or leaves it with a constant acceleration.

    Attributes:
        r: place at t = 0 (3,) [m]. a: acceleration (3,) [m/s^2]. heading: yaw [rad].
    """

    r: Float[Array, "3"]
    a: Float[Array, "3"]
    heading: Float[Array, ""]

    def __call__(self, t: Float[Array, ""]) -> Waypoint:
        found = at_point(self.r, self.heading)
        return found._replace(r=self.r + t**2 / 2 * self.a, v=t * self.a, a=self.a)


class WaypointPath(eqx.Module):
    """Path of the least integral of squared snap through waypoints, at rest at both ends.

    It is a spline of degree 7 in position and heading; before the first waypoint and after the last
    it holds them.

    Args:
        ts: times of the waypoints (k,), rising [s]. places: position [m] and heading [rad] (k, 4).

    Raises:
        SettingError: fewer than two waypoints, or times that do not rise.

    Source: D. Mellinger, V. Kumar, Minimum snap trajectory generation and control for quadrotors,
    IEEE Conference on Robotics and Automation (2011), section IV; I. J. Schoenberg's natural splines.
    """

    breaks: Float[Array, " k"]
    coefficients: Float[Array, "8 s 4"]

    def __init__(self, ts: np.ndarray, places: np.ndarray) -> None:
        if len(ts) < 2 or np.any(np.diff(ts) <= 0):
            raise SettingError(
                "The waypoints of a path must be two or more, with times that rise, but the times are "
                f"{np.asarray(ts).tolist()} s."
            )
        # imported here, because SciPy's interpolation is slow to import
        from scipy.interpolate import make_interp_spline

        rest = [(order, np.zeros(4)) for order in (1, 2, 3)]
        spline = make_interp_spline(ts, places, k=7, bc_type=(rest, rest))
        rows = [spline(ts[:-1], nu=k) / math.factorial(k) for k in range(7, -1, -1)]
        self.breaks, self.coefficients = jnp.asarray(ts, float), jnp.asarray(np.stack(rows))

    def place(self, t: Float[Array, ""]) -> Float[Array, "4"]:
        """Position [m] and heading [rad] at a time [s]."""
        t = jnp.clip(t, self.breaks[0], self.breaks[-1])
        return piecewise(self.breaks, self.coefficients, t)

    def __call__(self, t: Float[Array, ""]) -> Waypoint:
        return along(lambda t: self.place(t)[:3], lambda t: self.place(t)[3])(t)


class DirectionMotion(NamedTuple):
    """Motion of a direction of the world: values, rates and accelerations, each (3,)."""

    value: Float[Array, "3"]
    rate: Float[Array, "3"]
    acceleration: Float[Array, "3"]


class PanelMoves(eqx.Module):
    """Moves of the panel one after the other, each with rest at its beginning and end.

    In the base's axes the moves are between panel angles (2,); in the world, between directions of
    any length (3,). A target may itself move.

    Attributes:
        start: angles or direction before the first move.
        targets: constant or function of t [s] for each move.
        ats, durations: beginnings and durations of the moves [s].
        world: true for directions of the world.
        shapes: coefficients of the shape of each move (k,), see `stmuav_jax.control.Slew`; empty where
            all are quintics.
    """

    start: Float[Array, " n"]
    targets: tuple[Float[Array, " n"] | Sampled, ...]
    ats: tuple[Float[Array, ""], ...]
    durations: tuple[Float[Array, ""], ...]
    world: bool = eqx.field(static=True)
    shapes: tuple[Float[Array, " _"], ...] = ()

    def value(self, t: Float[Array, ""]) -> Float[Array, " n"]:
        """Wanted angles [rad] or direction (n,) at a time [s]."""
        found, shapes = self.start, self.shapes or (jnp.zeros(0),) * len(self.targets)
        for target, at, duration, shape in zip(
            self.targets, self.ats, self.durations, shapes, strict=True
        ):
            s = jnp.clip((t - at) / duration, 0.0, 1.0)
            goal = target(t) if callable(target) else target
            found = found + rise(s, shape) * (goal - found)
        return found

    def __call__(self, t: Float[Array, ""]) -> PairMotion | DirectionMotion:
        """Wanted motion of the angles [rad], or of the direction."""
        moved = motion_along(self.value, t)
        return DirectionMotion(*moved) if self.world else PairMotion(*moved)


def facing_motion(wanted: DirectionMotion, state: State) -> PairMotion:
    """Panel angles that face a moving direction of the world, their rates and accelerations.

    The base's own angular acceleration is left out.
    """
    R_bw, omega = rotation_matrix(state.p[0]).T, state.omega[0]
    across = lambda x: jnp.cross(omega, x)
    ahead, rate = R_bw @ wanted.value, R_bw @ wanted.rate
    first = rate - across(ahead)
    second = R_bw @ wanted.acceleration - 2 * across(rate) + across(across(ahead))

    def angles(s: Array) -> Array:
        return panel_angles(ahead + s * first + s**2 / 2 * second)

    return PairMotion(*motion_along(angles, jnp.zeros(())))


class MissionReference(NamedTuple):
    """Reference of a mission at one time: time [s], waypoint, and motion of the panel or None."""

    t: Float[Array, ""]
    waypoint: Waypoint
    panel: PairMotion | DirectionMotion | None


class References(eqx.Module):
    """Function of t [s] that returns the `MissionReference`."""

    path: HeldPath | WaypointPath
    panel: PanelMoves | None

    def __call__(self, t: Float[Array, ""]) -> MissionReference:
        return MissionReference(t, self.path(t), None if self.panel is None else self.panel(t))
