"""Flight conditions: hover, climb, cruise and steady turn, and what they want of a trim.

Any mechanism with a floating base can fly (`trim_condition`): its attitude and angular velocity are
free, and beside the accelerations of a steady flight there are conditions on them,

    sin(yaw) R_00 = cos(yaw) R_10,    omega = rate R^T z,

with the rotation R of the base: the heading, and that everything revolves about the vertical.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..algebra.rotation import conjugate, product, rotation_matrix, to_rotation_vector
from ..algebra.space import Point
from ..checks.errors import ModelError, SettingError, concrete
from ..checks.numbers import array_module, as_numpy, floats, numbers
from ..checks.shapes import Numbers
from ..dynamics.statespace.base import AbstractStateSpace, places_of
from ..dynamics.statespace.names import BASE
from ..dynamics.tree.topology import spanning_tree
from ..mechanics.inputs import Inputs
from ..mechanics.state import State
from .equilibrium import Trim, trim

_UP = np.array([0.0, 0.0, 1.0])
_TURNED, _TURNING = ("theta_x", "theta_y", "theta_z"), ("omega_x", "omega_y", "omega_z")
_MOVING = ("v_x", "v_y", "v_z")


class FlightCondition(NamedTuple):
    """A steady flight; see `hover`, `climb`, `cruise` and `steady_turn`.

    Attributes:
        angles: panel angles of the UAV (2,) [rad], or None where it points at the sun.
        sun: direction to the sun, world (3,), or None.
        yaw: heading [rad]. v: velocity of the base, world (3,) [m/s].
        rate: rate of turn about the vertical [rad/s].
        acceleration: acceleration of the base beside that of the turn, world (3,) [m/s^2].
    """

    angles: Float[Array, "2"] | None
    sun: Float[Array, "3"] | None
    yaw: Float[Array, ""]
    v: Float[Array, "3"]
    rate: Float[Array, ""]
    acceleration: Float[Array, "3"]


def hover(angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> FlightCondition:
    """Standing still with the panel at angles (2,) [rad], or at the sun (3,), world.

    A machine without a panel needs neither; see `trim_condition`.

    Raises:
        ModelError: arguments that are not finite or of another shape, or not exactly one of angles
            and sun (here and in the functions below).
    """
    return _flight(angles, sun, yaw, jnp.zeros(3), 0.0)


def climb(speed: Any, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None) -> FlightCondition:
    """Straight up at a speed [m/s]; negative for a descent."""
    speed = numbers(speed, (), "The speed of the climb", "m/s")
    return _flight(angles, sun, yaw, floats(as_numpy(speed) * _UP), 0.0)


def cruise(
    speed: Any, course: Any = 0.0, angles: Any = None, yaw: Any = 0.0, *, sun: Any = None
) -> FlightCondition:
    """Level flight at a speed [m/s] towards a course from x to y [rad]."""
    speed = numbers(speed, (), "The level speed", "m/s")
    course = numbers(course, (), "The course", "rad")
    module, (speed, course) = array_module(speed, course), as_numpy((speed, course))
    along = module.stack([module.cos(course), module.sin(course), module.zeros_like(course)])
    return _flight(angles, sun, yaw, floats(speed * along), 0.0)


def steady_turn(
    speed: Any, rate: Any, angles: Any = None, course: Any = 0.0, yaw: Any = 0.0
) -> FlightCondition:
    """A level turn at a speed [m/s] and a rate [rad/s], positive from x to y; at its start."""
    straight = cruise(speed, course, angles, yaw)
    return straight._replace(rate=numbers(rate, (), "The rate of turn", "rad/s"))


def turn_acceleration(wanted: FlightCondition) -> Float[Array, "3"]:
    """Acceleration of the base, world (3,) [m/s^2]: that of the turn, and what is wanted beside it."""
    x, y, _ = wanted.v
    return wanted.rate * jnp.stack([-y, x, jnp.zeros_like(x)]) + wanted.acceleration


class _Steady(eqx.Module):
    """Conditions of a steady flight on the motion of the bodies; see above.

    With the sun, the components across it of a direction in the pointing body vanish too.
    """

    wanted: FlightCondition
    axis: Float[Array, "3"]
    base: int = eqx.field(static=True)
    pointing: int | None = eqx.field(static=True)

    def __call__(self, state: State) -> Float[Array, " c"]:
        yaw, sun = self.wanted.yaw, self.wanted.sun
        R = rotation_matrix(state.p[self.base])
        heading = jnp.cos(yaw) * R[1, 0] - jnp.sin(yaw) * R[0, 0]
        turning = state.omega[self.base] - self.wanted.rate * R[2]
        if sun is None or self.pointing is None:
            return jnp.concatenate([heading[None], turning])
        s = sun / jnp.sqrt(sun @ sun)
        other = jnp.where(jnp.abs(s[0]) < 0.7, jnp.array([1.0, 0, 0]), jnp.array([0.0, 1.0, 0]))
        across = jnp.cross(s, other)
        n = rotation_matrix(state.p[self.pointing]) @ self.axis
        aside = jnp.stack([across @ n, jnp.cross(s, across) @ n])
        return jnp.concatenate([heading[None], turning, aside])


def trim_condition(
    space: AbstractStateSpace,
    condition: FlightCondition,
    *,
    at: Point,
    free: Sequence[str] = (),
    inputs: Inputs | None = None,
    values: Numbers | None = None,
    sizes: Numbers | None = None,
    pointing: str | None = None,
    axis: Numbers = (0.0, 0.0, 1.0),
    throw: bool = True,
) -> Trim:
    """Attitude and inputs of a steady flight of any mechanism with a floating base; see `trim`.

    Args:
        condition: flight without panel angles: joints stay as they are in `at`.
        at: posture from which the search starts, with the base level and at the heading.
        free: names of further states that may be changed; with the sun at least two, such as the
            coordinates of the panel's joints.
        inputs, values: inputs that may be chosen, and their values at the start of the search.
        sizes: sizes of the unknowns: three turns, three rates of turn, free states, then inputs.
        pointing: name of the body that points at the sun. axis: direction that does, body axes (3,).

    Raises:
        SettingError: nothing floats, angles of a panel, or a sun without a body that points at it.
        And as `trim`.
    """
    tree = spanning_tree(space.system)
    if not tree.floating or space.names[:6] != BASE[:6]:
        raise SettingError("Only a mechanism with a floating base flies: declare one body free.")
    if condition.angles is not None:
        raise SettingError("Give the posture of the joints in `at`, not as angles of a panel.")
    if (condition.sun is None) != (pointing is None):
        raise SettingError("Pointing at the sun needs its direction and the name of a body.")
    towards = None if pointing is None else space.system.index(pointing)
    axis = numbers(axis, (3,), "The axis that points at the sun", "")
    held = _Steady(condition, axis, tree.root, towards)
    acceleration = jnp.zeros(space.dof).at[:3].set(turn_acceleration(condition))
    return trim(
        space, at=_level(space, condition, at, tree.root), free=[*_TURNED, *_TURNING, *free],
        inputs=inputs, values=values, accelerations=acceleration, conditions=held, sizes=sizes,
        throw=throw,
    )  # fmt: skip


def _level(space: AbstractStateSpace, wanted: FlightCondition, at: Point, base: int) -> Point:
    """The point with its base level, at the heading, with the velocity and the rate of turn."""
    state, half = space.to_state(at), wanted.yaw / 2
    zero = jnp.zeros_like(half)
    p = jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)])
    by = {
        _TURNED: to_rotation_vector(product(conjugate(state.p[base]), p)),
        _MOVING: wanted.v - state.v[base],
        _TURNING: wanted.rate * _UP - state.omega[base],
    }
    v = jnp.zeros(space.size)
    for names, step in by.items():
        v = v.at[np.array(places_of(space, names, "The base"))].set(step)
    return space.retract(at, v)


def _flight(angles: Any, sun: Any, yaw: Any, v: Array, rate: Any) -> FlightCondition:
    if angles is not None and sun is not None:
        raise ModelError(
            "A flight needs either the panel's angles or the direction to the sun, and not both."
        )
    if angles is not None:
        angles = numbers(angles, (2,), "The pair of the panel's angles", "rad")
    if sun is not None:
        sun = numbers(sun, (3,), "The direction to the sun", "")
        if concrete(sun) and not np.linalg.norm(np.asarray(sun)) > 0:
            raise ModelError("The direction to the sun must not be zero.")
    yaw = numbers(yaw, (), "The heading", "rad")
    return FlightCondition(angles, sun, yaw, v, floats(rate), floats(np.zeros(3)))
