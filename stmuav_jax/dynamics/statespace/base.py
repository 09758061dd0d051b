"""State spaces of mechanisms: independent coordinates, velocities, and the motion in them.

A point of a state space is a posture and motion of a mechanism that satisfy its joints. Its errors
are vectors

    v = (dq, du, dz):   independent coordinates (dof,), their velocities (dof,), and actuator states
                        of the forces (m,); turns that forces count belong to the coordinates,

such that dq/dt = u: the dq of a rotation is a rotation vector in body axes, and its u the angular
velocity in these axes. Trim, linearisation, shooting and filters use mechanisms by this interface.
"""

from abc import abstractmethod
from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...checks.errors import StateError, has_values, named_places
from ...math.derivative import value_and_jacobian
from ...math.native.program import native
from ...math.space import AbstractSpace, Point
from ...mechanics.state import State
from ...mechanics.system import System

Time = Float[Array, ""] | float

# A conditioning below this number means a singular posture.
SINGULAR = 1e-9


class AbstractStateSpace(AbstractSpace):
    """Manifold of the states of a system in independent coordinates, with differentiable methods.

    Attributes:
        system: mechanism with its forces.
        names: name and unit of every component of an error (size,).
        dof: number of degrees of freedom; the size is 2 dof + m.
    """

    system: eqx.AbstractVar[System]
    names: eqx.AbstractVar[tuple[tuple[str, str], ...]]
    dof: eqx.AbstractVar[int]

    @abstractmethod
    def to_state(self, x: Point, t: Time = 0.0) -> State:
        """Positions and velocities of all bodies (n, .), on the constraints at time t [s]."""

    @abstractmethod
    def state_and_rate(
        self, x: Point, t: Time = 0.0, system: System | None = None
    ) -> tuple[State, State]:
        """State of all bodies as `to_state`, and its rate along the motion, with the accelerations.

        Args:
            system: mechanism with other forces; see `Inputs.applied`.
        """

    @abstractmethod
    def from_state(self, state: State, internal: Float[Array, " m"] | None = None) -> Point:
        """Point that belongs to a state of all bodies on the joints.

        Args:
            internal: internal states of the forces (m,), as a run or a plant has them, which include the whole
                turns of hinges; by default those that the system's forces hold.
        """

    @abstractmethod
    def internal_at(self, x: Point) -> Float[Array, " m"]:
        """Internal states of the forces at a point (m,), with the turns of hinges counted."""

    @abstractmethod
    def rates(self, x: Point, t: Time = 0.0, system: System | None = None) -> Float[Array, " size"]:
        """Velocities u, accelerations du/dt and rates of the actuator states at a point (size,).

        Args:
            system: mechanism with other forces; see `Inputs.applied`.
        """

    @abstractmethod
    def with_closed_loops(self, x: Point, t: Time = 0.0) -> Point:
        """Equal point with closed loops, from which other points can be reached."""

    @abstractmethod
    def conditioning(self, x: Point, t: Time = 0.0) -> Float[Array, ""]:
        """Smallest singular value of the rows in the dependent velocities, over the largest in all.

        It is zero in a singular posture, where the independent coordinates do not determine the
        others; it is 1 for a mechanism without loops, and NaN if the loops do not close.
        """


def error_rate_columns(
    space: AbstractStateSpace,
    x: Point,
    t: Time,
    system: Callable[[Float[Array, " m"]], System],
    count: int,
) -> Float[Array, "size k"]:
    """Derivatives of dv/dt at v = 0 by v and by m more numbers z at zero, k = size + m.

    v is the error between a motion from retract(x, v) and the motion from x. Both have the same rates there,
    which are therefore evaluated once.

    Args:
        system: system with the forces of the first motion, of z; `system(0)` is that of the other.
        count: number of z.
    """
    size = space.size
    # Errors and inputs are differentiated in one pass: both motions have the same rates at the
    # origin.
    origin = jnp.zeros(size + count)
    rates = lambda z: space.rates(space.retract(x, z[:size]), t, system(z[size:]))
    rate, columns = value_and_jacobian(rates, origin)
    error_rate = lambda z, rate_y: _separation_rate(space, x, z[:size], rate_y, rate)
    push = lambda e, column: jax.jvp(error_rate, (origin, rate), (e, column))[1]
    return jax.vmap(push, in_axes=(0, -1), out_axes=-1)(jnp.eye(size + count), columns)


def motion_rates(
    space: AbstractStateSpace,
    x: Point,
    v: Float[Array, " size"],
    t: Time = 0.0,
    system: System | None = None,
) -> Float[Array, " size"]:
    """Rate dv/dt (size,) of the error v of a motion relative to a fixed point x.

    Args:
        system: system with the forces of the motion.
    """
    rates = space.rates(space.retract(x, v), t, system)
    return _separation_rate(space, x, v, rates, jnp.zeros_like(v))


@native
def _separation_rate(
    space: AbstractStateSpace,
    x: Point,
    v: Float[Array, " size"],
    rate_y: Float[Array, " size"],
    rate_x: Float[Array, " size"],
) -> Float[Array, " size"]:
    """Rate dv/dt of the error v between points that move at rate_y and rate_x."""
    # Errors are in a flat space, points on a curved one: the rate of an error is the derivative of
    # a difference of two moving points, which is exact for rotations too.
    y = space.retract(x, v)

    def separate(s: Float[Array, ""]) -> Float[Array, " size"]:
        return space.difference(space.retract(y, s * rate_y), space.retract(x, s * rate_x))

    zero = jnp.zeros((), rate_y.dtype)
    return jax.jvp(separate, (zero,), (jnp.ones_like(zero),))[1]


def check_regular(space: AbstractStateSpace, x: Point, t: Time = 0.0) -> None:
    """Raise `StateError` if the independent coordinates do not determine the others.

    Traced values are not checked.
    """
    conditioning = space.conditioning(x, t)
    if has_values(conditioning) and not float(conditioning) > SINGULAR:
        independent_names = ", ".join(name for name, _ in space.names[: space.dof])
        raise StateError(
            f"The posture is singular for the independent coordinates {independent_names}: they do not determine "
            f"the others there (conditioning {float(conditioning):.2g}, at least {SINGULAR:.0e} is required). "
            "Choose others, by the names in TreeSpace(system, state, independent=...), or another posture."
        )


def places_of(space: AbstractStateSpace, names: Any, subject: str) -> tuple[int, ...]:
    """Indices of the named components of an error.

    Args:
        subject: subject of the error's sentence, such as "The free states".

    Raises:
        SettingError: `names` is not a list of names, or has an unknown or a repeated name.
    """
    state_names = [name for name, _ in space.names]
    return named_places(names, state_names, subject, "state")
